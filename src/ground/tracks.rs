//! Where the aircraft are and were: a bounded memory of positions, for the map.

use emberfix_frames::{EllipsoidHeight, PlaceError, ServiceTime, place_from_degrees};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};

/// Positions kept of one aircraft: an hour at one a second. The oldest go first.
pub const MAX_POINTS: usize = 3_600;
/// Aircraft kept; another one is refused.
pub const MAX_AIRCRAFT: usize = 64;
/// Positions closer in time than this are not passed on (autopilots send up to 50 a second).
const MIN_STEP_NS: i64 = 150_000_000;
/// As long as an aircraft's own service says where it is, its autopilot is not asked as well.
const SERVICE_LEADS_NS: i64 = 3_000_000_000;

/// One aircraft at one moment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ping {
    /// Name of the aircraft, 1 to 32 characters.
    pub uav: String,
    /// When; UTC, RFC 3339.
    #[serde(with = "crate::alarm::rfc3339")]
    pub at: ServiceTime,
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Above the WGS84 ellipsoid, metres.
    pub height_ellipsoid_m: f64,
    /// Where the nose points, degrees from true north clockwise; absent when unknown.
    pub heading_deg: Option<f64>,
    /// `ok`, or why not, in a few words (up to 120 characters).
    pub health: String,
}

/// Why a position was refused.
#[derive(Debug, thiserror::Error)]
pub enum PingError {
    /// Not the JSON object that a position is.
    #[error("not a position: {source}")]
    Syntax {
        /// What the JSON reader said.
        #[from]
        source: serde_json::Error,
    },
    /// No such place.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A value that no position has.
    #[error("position key {name} is {value}, allowed is {allowed}")]
    Value {
        /// Key.
        name: &'static str,
        /// What stood there.
        value: String,
        /// What would have been accepted.
        allowed: &'static str,
    },
    /// Too many aircraft.
    #[error("{uav} would be aircraft number {}, allowed are {MAX_AIRCRAFT}", MAX_AIRCRAFT + 1)]
    Aircraft {
        /// Name of the one too many.
        uav: String,
    },
}

impl Ping {
    /// Reads and checks a position.
    ///
    /// # Errors
    /// [`PingError`] naming what is wrong.
    pub fn from_json(text: &[u8]) -> Result<Self, PingError> {
        let ping: Self = serde_json::from_slice(text)?;
        ping.check()?;
        Ok(ping)
    }

    fn check(&self) -> Result<(), PingError> {
        let height = EllipsoidHeight::from_m(self.height_ellipsoid_m);
        place_from_degrees(self.latitude_deg, self.longitude_deg, height)?;
        length("uav", &self.uav, 1..=32, "1 to 32 characters")?;
        length("health", &self.health, 1..=120, "1 to 120 characters")?;
        match self.heading_deg {
            Some(heading) if !(0.0..=360.0).contains(&heading) => Err(PingError::Value {
                name: "heading_deg",
                value: heading.to_string(),
                allowed: "0 to 360, or null",
            }),
            _ => Ok(()),
        }
    }

    fn coordinates(&self) -> [f64; 3] {
        [
            self.longitude_deg,
            self.latitude_deg,
            self.height_ellipsoid_m,
        ]
    }
}

fn length(
    name: &'static str,
    text: &str,
    range: std::ops::RangeInclusive<usize>,
    allowed: &'static str,
) -> Result<(), PingError> {
    if range.contains(&text.chars().count()) {
        return Ok(());
    }
    Err(PingError::Value {
        name,
        value: format!("{text:?}"),
        allowed,
    })
}

/// Who says where an aircraft is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// The emberfix service aboard: knows its heading and its health.
    Service,
    /// The autopilot, over MAVLink.
    Autopilot,
}

#[derive(Debug)]
struct Track {
    points: VecDeque<[f64; 3]>,
    latest: Ping,
    /// Latest time at which the service itself spoke.
    service_at: Option<ServiceTime>,
}

/// Tracks of all aircraft. Bounds: [`MAX_AIRCRAFT`], [`MAX_POINTS`].
#[derive(Debug, Default)]
pub struct Tracks {
    by_uav: BTreeMap<String, Track>,
}

impl Tracks {
    /// Takes a position; its JSON when it is news, `None` when it is older than what is known or
    /// too soon after it.
    ///
    /// # Errors
    /// [`PingError::Aircraft`] when there are too many aircraft.
    pub fn take(&mut self, ping: Ping, source: Source) -> Result<Option<String>, PingError> {
        let told = serde_json::to_string(&ping)?;
        let service_at = (source == Source::Service).then_some(ping.at);
        let Some(track) = self.by_uav.get_mut(&ping.uav) else {
            if self.by_uav.len() >= MAX_AIRCRAFT {
                return Err(PingError::Aircraft { uav: ping.uav });
            }
            let points = VecDeque::from([ping.coordinates()]);
            let uav = ping.uav.clone();
            self.by_uav.insert(
                uav,
                Track {
                    points,
                    latest: ping,
                    service_at,
                },
            );
            return Ok(Some(told));
        };
        if !track.wants(&ping, source) {
            return Ok(None);
        }
        if track.points.len() >= MAX_POINTS {
            track.points.pop_front();
        }
        track.points.push_back(ping.coordinates());
        track.service_at = service_at.or(track.service_at);
        track.latest = ping;
        Ok(Some(told))
    }

    /// All tracks as a GeoJSON FeatureCollection: per aircraft its line (a point while it has one
    /// position only) with the properties of its latest [`Ping`].
    #[must_use]
    pub fn to_geojson(&self) -> serde_json::Value {
        let features: Vec<_> = self.by_uav.values().map(Track::feature).collect();
        serde_json::json!({ "type": "FeatureCollection", "features": features })
    }

    /// The latest position of every aircraft.
    pub fn latest(&self) -> impl Iterator<Item = &Ping> {
        self.by_uav.values().map(|track| &track.latest)
    }
}

impl Track {
    fn wants(&self, ping: &Ping, source: Source) -> bool {
        let step = ping.at.unix_ns() - self.latest.at.unix_ns();
        let led = self
            .service_at
            .is_some_and(|at| ping.at.unix_ns() - at.unix_ns() < SERVICE_LEADS_NS);
        step >= MIN_STEP_NS && !(source == Source::Autopilot && led)
    }

    fn feature(&self) -> serde_json::Value {
        let geometry = match self.points.len() {
            1 => serde_json::json!({ "type": "Point", "coordinates": self.latest.coordinates() }),
            _ => serde_json::json!({ "type": "LineString", "coordinates": self.points }),
        };
        serde_json::json!({
            "type": "Feature",
            "id": self.latest.uav,
            "geometry": geometry,
            "properties": self.latest,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ping(uav: &str, at_ms: i64) -> Ping {
        Ping {
            uav: uav.to_owned(),
            at: ServiceTime::from_unix_ns(at_ms * 1_000_000),
            latitude_deg: 31.4,
            longitude_deg: 119.1,
            height_ellipsoid_m: 25.0,
            heading_deg: Some(90.0),
            health: "ok".to_owned(),
        }
    }

    #[test]
    fn a_track_is_bounded_and_so_is_the_number_of_aircraft() {
        let mut tracks = Tracks::default();
        for second in 0..MAX_POINTS as i64 + 5 {
            tracks
                .take(ping("a", second * 1000), Source::Service)
                .unwrap();
        }
        assert_eq!(tracks.by_uav["a"].points.len(), MAX_POINTS);
        for other in 1..MAX_AIRCRAFT {
            tracks
                .take(ping(&other.to_string(), 0), Source::Service)
                .unwrap();
        }
        let refused = tracks.take(ping("one too many", 0), Source::Service);
        assert!(matches!(refused, Err(PingError::Aircraft { .. })));
    }

    #[test]
    fn the_autopilot_is_heard_only_while_the_service_is_silent() {
        let mut tracks = Tracks::default();
        let mut is_news = |at_ms, source| tracks.take(ping("a", at_ms), source).unwrap().is_some();
        assert!(is_news(0, Source::Autopilot));
        assert!(is_news(1_000, Source::Service));
        assert!(!is_news(2_000, Source::Autopilot));
        assert!(!is_news(500, Source::Service), "older than what is known");
        assert!(is_news(4_500, Source::Autopilot));
    }

    #[test]
    fn a_position_off_the_earth_or_with_an_unknown_key_is_refused_by_name() {
        let text = |latitude: f64, key: &str| {
            format!(
                r#"{{"uav":"a","at":"2026-03-01T12:00:00Z","latitude_deg":{latitude},
                "longitude_deg":0,"height_ellipsoid_m":10,"{key}":null,"health":"ok"}}"#
            )
        };
        assert!(Ping::from_json(text(10.0, "heading_deg").as_bytes()).is_ok());
        let error = Ping::from_json(text(91.0, "heading_deg").as_bytes()).unwrap_err();
        assert!(error.to_string().contains("latitude 91"), "{error}");
        let error = Ping::from_json(text(10.0, "heading").as_bytes()).unwrap_err();
        assert!(error.to_string().contains("heading"), "{error}");
    }
}
