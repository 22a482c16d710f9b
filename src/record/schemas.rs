//! JSON schemas of the topics that are not Foxglove's.

/// `/fire/alarms`: the contract's alarm.
pub(super) const ALARM: &str = r#"{
  "$schema": "https://json-schema.org/draft/2020-12/schema",
  "title": "emberfix.Alarm",
  "description": "One revision of one fire's alarm: a GeoJSON Feature at the base of the fire",
  "type": "object",
  "required": ["type", "geometry", "properties"],
  "properties": {
    "type": {"const": "Feature"},
    "geometry": {
      "type": "object",
      "required": ["type", "coordinates"],
      "properties": {
        "type": {"const": "Point"},
        "coordinates": {
          "description": "longitude deg, latitude deg, ellipsoid height m",
          "type": "array", "minItems": 3, "maxItems": 3, "items": {"type": "number"}
        }
      }
    },
    "properties": {
      "type": "object",
      "required": ["id", "revision", "uav", "class", "state", "confidence", "first_seen_at",
        "captured_at", "altitude_msl_m", "height_above_ground_m", "ce90_m", "le90_m",
        "covariance_enu_m2", "methods", "sightings", "range_m", "size_m", "trend", "degraded"],
      "properties": {
        "id": {"type": "string", "minLength": 1, "maxLength": 64},
        "revision": {"type": "integer", "minimum": 1},
        "uav": {"type": "string"},
        "class": {"enum": ["fire", "smoke"]},
        "state": {"enum": ["suspected", "confirmed", "growing", "steady", "dying", "out"]},
        "confidence": {"type": "number", "minimum": 0, "maximum": 1},
        "first_seen_at": {"type": "string", "format": "date-time"},
        "captured_at": {"type": "string", "format": "date-time"},
        "altitude_msl_m": {"type": "number"},
        "height_above_ground_m": {"type": ["number", "null"]},
        "ce90_m": {"type": "number", "minimum": 0},
        "le90_m": {"type": "number", "minimum": 0},
        "covariance_enu_m2": {
          "type": "array", "minItems": 9, "maxItems": 9, "items": {"type": "number"}
        },
        "methods": {"type": "array", "items": {"enum": ["stereo", "parallax", "terrain"]}},
        "sightings": {"type": "integer", "minimum": 0},
        "range_m": {"type": "number", "minimum": 0},
        "size_m": {
          "type": ["object", "null"],
          "required": ["width", "height"],
          "properties": {"width": {"type": "number"}, "height": {"type": "number"}}
        },
        "advice": {
          "type": ["object", "null"],
          "required": ["course_deg", "distance_m", "ce90_m"],
          "properties": {
            "course_deg": {"type": "number", "minimum": 0, "maximum": 360},
            "distance_m": {"type": "number", "minimum": 0},
            "ce90_m": {"type": "number", "minimum": 0}
          }
        },
        "trend": {"description": "relative slope of the intensity, per second",
          "type": ["number", "null"]},
        "size_sigma_m": {
          "type": ["object", "null"],
          "required": ["width", "height"],
          "properties": {"width": {"type": "number"}, "height": {"type": "number"}}
        },
        "size_class": {"enum": ["small", "medium", "large", null]},
        "trend_sigma": {"type": ["number", "null"]},
        "trend_probability": {"type": ["object", "null"],
          "properties": {"growing": {"type": "number"}, "dying": {"type": "number"}}},
        "intensity": {"type": ["object", "null"],
          "properties": {"value": {"type": "number"}, "sigma": {"type": "number"}}},
        "intensity_history": {"description": "seconds before captured_at, intensity",
          "type": "array", "maxItems": 24,
          "items": {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "number"}}},
        "area": {"type": ["object", "null"],
          "required": ["polygon", "edge_sigma_m", "square_metres", "front"]},
        "spread": {"type": ["object", "null"],
          "required": ["azimuth_deg", "speed_m_s", "used_wind"]},
        "degraded": {"type": "array", "items": {"type": "string"}}
      }
    }
  }
}"#;

/// `/spectrometer`: one reading.
pub(super) const SPECTRUM: &str = r#"{
  "$schema": "https://json-schema.org/draft/2020-12/schema",
  "title": "emberfix.Spectrum",
  "description": "One reading; publish time is mid-integration",
  "type": "object",
  "required": ["wavelengths_nm", "intensity"],
  "properties": {
    "wavelengths_nm": {"type": "array", "items": {"type": "number"}},
    "intensity": {"type": "array", "items": {"type": "number"}}
  }
}"#;

/// `/fire/fixes`: one sighting with its position, as far as it has the alarm's properties.
pub(super) const FIX: &str = r#"{
  "$schema": "https://json-schema.org/draft/2020-12/schema",
  "title": "emberfix.Fix",
  "description": "One sighting: a GeoJSON Feature; properties are the alarm's as far as one sighting has them",
  "type": "object",
  "required": ["type", "geometry", "properties"],
  "properties": {
    "type": {"const": "Feature"},
    "geometry": {"type": ["object", "null"]},
    "properties": {
      "type": "object",
      "properties": {
        "fire": {"description": "number of the fire", "type": ["integer", "string", "null"]},
        "box_px": {
          "description": "x, y, width, height in the raw left image",
          "type": "array", "minItems": 4, "maxItems": 4, "items": {"type": "number"}
        }
      }
    }
  }
}"#;

/// `/operator/actions`: what a person on the ground did about an alarm.
pub(super) const ACTION: &str = r#"{
  "$schema": "https://json-schema.org/draft/2020-12/schema",
  "title": "emberfix.Action",
  "description": "What a person on the ground did about an alarm",
  "type": "object",
  "required": ["number", "alarm", "kind", "at"],
  "properties": {
    "number": {"description": "at the ground station, rising", "type": "integer"},
    "alarm": {"description": "id of the alarm", "type": "string"},
    "kind": {"enum": ["acknowledge", "confirm", "dismiss", "merge", "split", "undo"]},
    "at": {"description": "UTC, RFC 3339, by the ground's clock", "type": "string"},
    "by": {"type": "string"}
  }
}"#;
