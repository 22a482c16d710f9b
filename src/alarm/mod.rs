//! When to tell, what to tell; the alarm that every link sends.
//!
//! **In:** fires from [`crate::track`]. **Out:** [`Alarm`], a GeoJSON Feature (RFC 7946: longitude,
//! latitude, ellipsoid height). The position is the base of the fire: where the burning thing
//! stands, beneath the flame's centre. Pure: no I/O, no clock.

mod action;
mod burning;
mod desk;

pub use action::{Action, ActionKind, Attention};
pub use burning::{Area, Burning, TrendProbability};
pub use desk::{AlarmDesk, LEAST_S, REPEAT_S, Situation};

use emberfix_frames::{Covariance, EllipsoidHeight, MissionEnu, ServiceTime, Wgs84, Wgs84Parts};
use serde::{Deserialize, Serialize};

/// Number of a fire, unique on one aircraft and stable over restarts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct FireId(pub u32);

/// What burns, or seems to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlarmClass {
    /// Flame.
    Fire,
    /// Smoke without a visible flame.
    Smoke,
}

/// Life of a fire: `Suspected -> Confirmed -> Growing | Steady | Dying -> Out`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FireState {
    /// Seen, not yet often enough to alarm.
    Suspected,
    /// Seen often enough.
    Confirmed,
    /// Confirmed, and its extent or intensity rises.
    Growing,
    /// Confirmed, and neither rises nor falls.
    Steady,
    /// Confirmed, and its extent or intensity falls.
    Dying,
    /// Looked at again, and no longer there.
    Out,
}

/// What a position rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Disparity between the eyes.
    Stereo,
    /// Bearings from different places.
    Parallax,
    /// The ray's meeting with the terrain.
    Terrain,
}

/// Width and height of a fire in metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SizeM {
    /// Across the line of sight, metres.
    pub width: f64,
    /// Upwards, metres.
    pub height: f64,
}

/// A course that makes a position better.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Advice {
    /// Course over ground to fly, degrees clockwise from north, 0 to 360.
    pub course_deg: f64,
    /// How far, metres.
    pub distance_m: f64,
    /// CE90 to be expected then, metres.
    pub ce90_m: f64,
}

/// One revision of one fire's alarm. Serialised by [`Alarm::to_geojson`], read by
/// [`Alarm::from_geojson`]; field meanings are the contract's (`README.md`, "The alarm").
#[derive(Debug, Clone, PartialEq)]
pub struct Alarm {
    /// Place of the base of the fire.
    pub place: Wgs84,
    /// Everything else.
    pub properties: AlarmProperties,
}

/// The properties of the alarm's GeoJSON Feature, named as in the contract.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlarmProperties {
    /// Stable over restarts: `<uav>-<fire number>`.
    pub id: String,
    /// Counts up from 1 with every change that is told.
    pub revision: u32,
    /// Name of the aircraft.
    pub uav: String,
    /// Fire or smoke.
    pub class: AlarmClass,
    /// Where in its life the fire is.
    pub state: FireState,
    /// Probability in 0..1 that this is what `class` says.
    pub confidence: f64,
    /// Mid-exposure of the first sighting.
    #[serde(with = "rfc3339")]
    pub first_seen_at: ServiceTime,
    /// Mid-exposure of the latest sighting in this revision.
    #[serde(with = "rfc3339")]
    pub captured_at: ServiceTime,
    /// Altitude above mean sea level, metres.
    pub altitude_msl_m: f64,
    /// Height above the terrain model, metres; absent without one.
    pub height_above_ground_m: Option<f64>,
    /// Radius that holds the truth in 90 %, metres.
    pub ce90_m: f64,
    /// Half-height that holds the truth in 90 %, metres.
    pub le90_m: f64,
    /// Row-major 3x3 in the tangent plane at the position, m²; all of the error is in it.
    pub covariance_enu_m2: [f64; 9],
    /// What the position rests on, sorted.
    pub methods: Vec<Method>,
    /// Sightings that went into it.
    pub sightings: u32,
    /// Straight line from the left camera at the latest sighting, metres.
    pub range_m: f64,
    /// Extent, if measured.
    pub size_m: Option<SizeM>,
    /// How the fire changes (slope of its relative size, per second), if known.
    pub trend: Option<f64>,
    /// Which way to fly so that the ellipse shrinks most; absent when nothing is worth it.
    #[serde(default)]
    pub advice: Option<Advice>,
    /// How it burns.
    #[serde(flatten)]
    pub burning: Burning,
    /// Reasons why the ellipse is wider than it could be; empty when all is well.
    pub degraded: Vec<String>,
}

/// Why a text is no alarm.
#[derive(Debug, thiserror::Error)]
pub enum AlarmError {
    /// Not a GeoJSON Feature with the alarm's properties.
    #[error("not an alarm: {source}")]
    Syntax {
        /// What the JSON reader said.
        #[from]
        source: serde_json::Error,
    },
    /// A value that no alarm can have.
    #[error("alarm property {name} is {value}, allowed is {allowed}")]
    Value {
        /// Property or coordinate.
        name: &'static str,
        /// What stood there.
        value: String,
        /// What would have been accepted.
        allowed: &'static str,
    },
}

#[derive(Serialize, Deserialize)]
struct Feature {
    #[serde(rename = "type")]
    kind: String,
    geometry: Geometry,
    properties: AlarmProperties,
}

#[derive(Serialize, Deserialize)]
struct Geometry {
    #[serde(rename = "type")]
    kind: String,
    coordinates: [f64; 3],
}

impl Alarm {
    /// The alarm as a GeoJSON Feature.
    #[must_use]
    pub fn to_geojson(&self) -> serde_json::Value {
        serde_json::json!({
            "type": "Feature",
            "geometry": {
                "type": "Point",
                "coordinates":
                    [self.place.longitude_deg(), self.place.latitude_deg(), self.place.height().m()],
            },
            "properties": self.properties,
        })
    }

    /// Reads and checks a GeoJSON Feature.
    ///
    /// # Errors
    /// [`AlarmError`] naming what is wrong.
    pub fn from_geojson(text: &[u8]) -> Result<Self, AlarmError> {
        let feature: Feature = serde_json::from_slice(text)?;
        let [longitude, latitude, height] = feature.geometry.coordinates;
        let place = emberfix_frames::place_from_degrees(
            latitude,
            longitude,
            EllipsoidHeight::from_m(height),
        )
        .map_err(|error| AlarmError::Value {
            name: "coordinates",
            value: error.to_string(),
            allowed: "longitude, latitude, ellipsoid height",
        })?;
        check_kind(&feature.kind, "Feature")?;
        check_kind(&feature.geometry.kind, "Point")?;
        check_properties(&feature.properties)?;
        Ok(Self {
            place,
            properties: feature.properties,
        })
    }

    /// Position covariance, in a plane parallel to the one at the position.
    ///
    /// # Errors
    /// When the carried matrix is no covariance.
    pub fn covariance(&self) -> Result<Covariance<MissionEnu>, emberfix_frames::CovarianceError> {
        let m2 = emberfix_frames::Matrix3::from_row_slice(&self.properties.covariance_enu_m2);
        Covariance::new(m2)
    }
}

fn check_kind(kind: &str, allowed: &'static str) -> Result<(), AlarmError> {
    if kind == allowed {
        return Ok(());
    }
    Err(AlarmError::Value {
        name: "type",
        value: kind.to_owned(),
        allowed,
    })
}

fn check_properties(properties: &AlarmProperties) -> Result<(), AlarmError> {
    let value = |name, value: f64, allowed| AlarmError::Value {
        name,
        value: value.to_string(),
        allowed,
    };
    if !(0.0..=1.0).contains(&properties.confidence) {
        return Err(value("confidence", properties.confidence, "0 to 1"));
    }
    if !(properties.ce90_m >= 0.0 && properties.ce90_m.is_finite()) {
        return Err(value("ce90_m", properties.ce90_m, "0 and up"));
    }
    if properties.id.is_empty() || properties.id.len() > 64 {
        return Err(AlarmError::Value {
            name: "id",
            value: properties.id.clone(),
            allowed: "1 to 64 characters",
        });
    }
    Ok(())
}

/// Serialises a [`ServiceTime`] as RFC 3339 text.
pub(crate) mod rfc3339 {
    use emberfix_frames::ServiceTime;
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub fn serialize<S: Serializer>(at: &ServiceTime, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&at.rfc3339())
    }
    pub fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<ServiceTime, D::Error> {
        let text = String::deserialize(deserializer)?;
        ServiceTime::from_rfc3339(&text)
            .ok_or_else(|| D::Error::custom(format!("{text:?} is no RFC 3339 time")))
    }
}
