//! Truth against alarms. Pure: no I/O, no clock.
//!
//! **In:** the true fires (metres in the plane at the datum) and the alarms as GeoJSON. **Out:** one
//! row per true fire, what was false, and the figures with the bounds that they must hold.
//! **Rules.** A fire alarm belongs to the nearest true fire within [`FIRE_GATE_M`], one alarm to one
//! fire; what remains is a false alarm, a second alarm for a found fire too. A smoke alarm near true
//! smoke, or near a fire, whose incident it then is, is never false. What is only suspected was
//! never told.

use crate::earth::{Lla, TangentPlane};
use emberfix_frames::{Matrix3, ServiceTime, Vector3};
use emberfix_report::{Bound, Figure};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Beyond this an alarm does not mean that fire, metres.
pub const FIRE_GATE_M: f64 = 15.0;
/// Smoke drifts and has no edge: beyond this an alarm does not mean it, metres.
pub const SMOKE_GATE_M: f64 = 30.0;
/// Chi square of two degrees of freedom at 90 %.
const CHI2_90: f64 = 4.605_170_185_988_091;

/// Fire or smoke.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Class {
    /// Flame.
    Fire,
    /// Smoke.
    Smoke,
}

/// A fire or smoke that is there.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    /// Its name in the mission.
    pub name: String,
    /// What it is.
    pub class: Class,
    /// Base: east, north, up from the datum, metres.
    pub base_m: Vector3<f64>,
}

/// An alarm that was told, as far as the score needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct ToldAlarm {
    /// The alarm's id.
    pub id: String,
    /// What it says it is.
    pub class: Class,
    /// East, north, up from the datum, metres.
    pub place_m: Vector3<f64>,
    /// Row-major, m².
    pub covariance_m2: Matrix3<f64>,
    /// Radius that is to hold the truth in 90 %, metres.
    pub ce90_m: f64,
    /// How many sightings it rests on.
    pub sightings: u32,
    /// Mid-exposure of the first sighting.
    pub first_seen_at: ServiceTime,
    /// When the ground first had it, if that was watched.
    pub told_at: Option<ServiceTime>,
}

/// Why a text is no list of alarms.
#[derive(Debug, thiserror::Error)]
pub enum AlarmsError {
    /// Not a GeoJSON FeatureCollection of alarms.
    #[error("alarms: {source}")]
    Syntax {
        /// What the JSON reader said.
        #[from]
        source: serde_json::Error,
    },
    /// A time that is none.
    #[error("alarm {id}: first_seen_at is {text:?}, allowed is RFC 3339")]
    Time {
        /// Alarm.
        id: String,
        /// What stood there.
        text: String,
    },
}

#[derive(Deserialize)]
struct Collection {
    features: Vec<Feature>,
}

#[derive(Deserialize)]
struct Feature {
    geometry: Geometry,
    properties: Properties,
}

#[derive(Deserialize)]
struct Geometry {
    coordinates: [f64; 3],
}

#[derive(Deserialize)]
struct Properties {
    id: String,
    class: Class,
    state: String,
    first_seen_at: String,
    ce90_m: f64,
    covariance_enu_m2: [f64; 9],
    sightings: u32,
}

/// Reads the alarms of a GeoJSON FeatureCollection; `told_at` says when each id was first seen at
/// the ground.
///
/// # Errors
/// [`AlarmsError`] when it is none.
pub fn read_alarms(
    geojson: &str,
    plane: &TangentPlane,
    told_at: &BTreeMap<String, ServiceTime>,
) -> Result<Vec<ToldAlarm>, AlarmsError> {
    let collection: Collection = serde_json::from_str(geojson)?;
    let told = collection
        .features
        .into_iter()
        .filter(|f| f.properties.state != "suspected");
    told.map(|feature| alarm(feature, plane, told_at)).collect()
}

fn alarm(
    feature: Feature,
    plane: &TangentPlane,
    told_at: &BTreeMap<String, ServiceTime>,
) -> Result<ToldAlarm, AlarmsError> {
    let Feature {
        geometry,
        properties,
    } = feature;
    let [longitude_deg, latitude_deg, height_m] = geometry.coordinates;
    let first_seen_at =
        ServiceTime::from_rfc3339(&properties.first_seen_at).ok_or_else(|| AlarmsError::Time {
            id: properties.id.clone(),
            text: properties.first_seen_at.clone(),
        })?;
    Ok(ToldAlarm {
        told_at: told_at.get(&properties.id).copied(),
        id: properties.id,
        class: properties.class,
        place_m: plane.from_lla(Lla {
            latitude_deg,
            longitude_deg,
            height_m,
        }),
        covariance_m2: Matrix3::from_row_slice(&properties.covariance_enu_m2),
        ce90_m: properties.ce90_m,
        sightings: properties.sightings,
        first_seen_at,
    })
}

/// One true fire and the alarm that means it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Name of the truth.
    pub truth: String,
    /// What it is.
    pub class: Class,
    /// The alarm, if one means it.
    pub found: Option<Found>,
}

/// An alarm that means a true fire.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    /// The alarm's id.
    pub alarm: String,
    /// Alarm minus truth, metres.
    pub error_east_m: f64,
    /// Alarm minus truth, metres.
    pub error_north_m: f64,
    /// Alarm minus truth, metres.
    pub error_up_m: f64,
    /// Length of the horizontal error, metres.
    pub horizontal_error_m: f64,
    /// Radius that the alarm gave, metres.
    pub ce90_m: f64,
    /// Whether the truth lies in the alarm's 90 % ellipse.
    pub inside_ellipse: bool,
    /// How many sightings it rests on.
    pub sightings: u32,
    /// From the first sighting's mid-exposure to the ground, seconds.
    pub first_sight_to_alarm_s: Option<f64>,
}

/// What a whole flight came to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Score {
    /// One row per true fire or smoke.
    pub rows: Vec<Row>,
    /// Alarms that mean nothing true, and second alarms for one fire.
    pub false_alarms: Vec<FalseAlarm>,
}

/// An alarm that should not have been.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FalseAlarm {
    /// The alarm's id.
    pub alarm: String,
    /// What it says it is.
    pub class: Class,
    /// The true fire that it tells a second time, if that is its fault.
    pub duplicate_of: Option<String>,
    /// East of the datum, metres.
    pub east_m: f64,
    /// North of the datum, metres.
    pub north_m: f64,
}

/// Greatest mean horizontal error, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorBound {
    /// The bound, metres; a flight whose GNSS draw may be anything has none.
    pub horizontal_mean_m: Option<f64>,
}

impl ErrorBound {
    /// With the mission's sensor errors (its own bound, if it states one), or with all sensors
    /// exact.
    #[must_use]
    pub fn for_errors(off: bool, with_errors_m: Option<f64>) -> Self {
        Self {
            horizontal_mean_m: if off { Some(0.5) } else { with_errors_m },
        }
    }
}

/// Holds the truth against what was told.
#[must_use]
pub fn score(truths: &[Truth], alarms: &[ToldAlarm]) -> Score {
    let mut rows: Vec<Row> = truths
        .iter()
        .map(|truth| Row {
            truth: truth.name.clone(),
            class: truth.class,
            found: None,
        })
        .collect();
    let mut matched = vec![false; alarms.len()];
    for (truth, alarm) in pairs_nearest_first(truths, alarms) {
        if rows[truth].found.is_none() && !matched[alarm] {
            rows[truth].found = Some(found(&truths[truth], &alarms[alarm]));
            matched[alarm] = true;
        }
    }
    let unmatched = alarms
        .iter()
        .zip(&matched)
        .filter(|(_, matched)| !**matched);
    let false_alarms = unmatched
        .filter_map(|(alarm, _)| false_alarm(truths, alarm))
        .collect();
    Score { rows, false_alarms }
}

/// Indices of truths and alarms of one class within its gate.
fn pairs_nearest_first(truths: &[Truth], alarms: &[ToldAlarm]) -> Vec<(usize, usize)> {
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (t, truth) in truths.iter().enumerate() {
        for (a, alarm) in alarms.iter().enumerate() {
            let apart = apart_m(truth, alarm);
            if truth.class == alarm.class && apart <= gate_m(truth.class) {
                pairs.push((apart, t, a));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    pairs
        .into_iter()
        .map(|(_, truth, alarm)| (truth, alarm))
        .collect()
}

fn gate_m(class: Class) -> f64 {
    match class {
        Class::Fire => FIRE_GATE_M,
        Class::Smoke => SMOKE_GATE_M,
    }
}

fn apart_m(truth: &Truth, alarm: &ToldAlarm) -> f64 {
    (alarm.place_m - truth.base_m).xy().norm()
}

fn found(truth: &Truth, alarm: &ToldAlarm) -> Found {
    let error = alarm.place_m - truth.base_m;
    Found {
        alarm: alarm.id.clone(),
        error_east_m: error.x,
        error_north_m: error.y,
        error_up_m: error.z,
        horizontal_error_m: error.xy().norm(),
        ce90_m: alarm.ce90_m,
        inside_ellipse: inside_ellipse(&error, &alarm.covariance_m2),
        sightings: alarm.sightings,
        first_sight_to_alarm_s: alarm
            .told_at
            .map(|told| (told - alarm.first_seen_at).as_secs_f64()),
    }
}

fn inside_ellipse(error: &Vector3<f64>, covariance_m2: &Matrix3<f64>) -> bool {
    let horizontal = covariance_m2.fixed_view::<2, 2>(0, 0).into_owned();
    let inverse = horizontal.try_inverse();
    inverse.is_some_and(|inverse| (error.xy().transpose() * inverse * error.xy()).x <= CHI2_90)
}

/// `None` when the unmatched alarm is forgiven: smoke of something true.
fn false_alarm(truths: &[Truth], alarm: &ToldAlarm) -> Option<FalseAlarm> {
    let near = |truth: &&Truth| apart_m(truth, alarm) <= gate_m(alarm.class);
    if alarm.class == Class::Smoke && truths.iter().any(|truth| near(&truth)) {
        return None;
    }
    let duplicate = truths
        .iter()
        .filter(|truth| truth.class == alarm.class)
        .find(near);
    Some(FalseAlarm {
        alarm: alarm.id.clone(),
        class: alarm.class,
        duplicate_of: duplicate.map(|truth| truth.name.clone()),
        east_m: alarm.place_m.x,
        north_m: alarm.place_m.y,
    })
}

impl Score {
    /// The demo's figures. Fires count; smoke is reported in the rows only.
    #[must_use]
    pub fn figures(&self, bound: ErrorBound) -> Vec<Figure> {
        let fires: Vec<&Row> = self
            .rows
            .iter()
            .filter(|row| row.class == Class::Fire)
            .collect();
        let found: Vec<&Found> = fires.iter().filter_map(|row| row.found.as_ref()).collect();
        let errors = mean(found.iter().map(|found| found.horizontal_error_m));
        let delays: Vec<f64> = found
            .iter()
            .filter_map(|f| f.first_sight_to_alarm_s)
            .collect();
        let count = |number: usize| Some(number as f64);
        let false_count = self.false_alarms.len();
        let error = match bound.horizontal_mean_m {
            Some(limit) => Figure::bounded(
                "demo.horizontal_error_mean_m",
                errors,
                "m",
                Bound::AtMost(limit),
                found.len(),
            ),
            None => Figure::told("demo.horizontal_error_mean_m", errors, "m", found.len()),
        };
        vec![
            Figure::told("demo.fires_true", count(fires.len()), "fires", fires.len()),
            Figure::bounded(
                "demo.fires_found",
                count(found.len()),
                "fires",
                Bound::Equals(fires.len() as f64),
                fires.len(),
            ),
            Figure::bounded(
                "demo.false_alarms",
                count(false_count),
                "alarms",
                Bound::AtMost(0.0),
                found.len() + false_count,
            ),
            error,
            Figure::told(
                "demo.first_sight_to_alarm_s",
                mean(delays.iter().copied()),
                "s",
                delays.len(),
            ),
        ]
    }
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> Option<f64> {
    let count = values.len();
    (count > 0).then(|| values.sum::<f64>() / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fire(name: &str, east: f64, north: f64) -> Truth {
        Truth {
            name: name.into(),
            class: Class::Fire,
            base_m: Vector3::new(east, north, 0.0),
        }
    }

    fn alarm(id: &str, class: Class, east: f64, north: f64) -> ToldAlarm {
        ToldAlarm {
            id: id.into(),
            class,
            place_m: Vector3::new(east, north, 0.5),
            covariance_m2: Matrix3::identity() * 2.25,
            ce90_m: 3.2,
            sightings: 12,
            first_seen_at: ServiceTime::from_unix_ns(1_000_000_000),
            told_at: Some(ServiceTime::from_unix_ns(2_500_000_000)),
        }
    }

    fn value(score: &Score, name: &str) -> (Option<f64>, bool) {
        let figures = score.figures(ErrorBound::for_errors(false, Some(3.0)));
        let figure = figures.iter().find(|figure| figure.name == name).unwrap();
        (figure.value, figure.holds)
    }

    #[test]
    fn a_fire_found_once_holds_every_figure() {
        let score = score(
            &[fire("pot", 0.0, 0.0)],
            &[alarm("a-1", Class::Fire, 1.0, -1.0)],
        );
        let found = score.rows[0].found.as_ref().unwrap();
        assert_eq!(
            (found.error_east_m, found.error_north_m, found.error_up_m),
            (1.0, -1.0, 0.5)
        );
        assert!(found.inside_ellipse);
        assert_eq!(
            value(&score, "demo.first_sight_to_alarm_s"),
            (Some(1.5), true)
        );
        assert!(
            score
                .figures(ErrorBound::for_errors(false, Some(3.0)))
                .iter()
                .all(|figure| figure.holds)
        );
        assert!(
            !score
                .figures(ErrorBound::for_errors(true, Some(3.0)))
                .iter()
                .all(|figure| figure.holds)
        );
    }

    #[test]
    fn a_missed_fire_fails_and_leaves_no_error_to_average() {
        let score = score(&[fire("pot", 0.0, 0.0)], &[]);
        assert_eq!(value(&score, "demo.fires_found"), (Some(0.0), false));
        assert_eq!(value(&score, "demo.horizontal_error_mean_m"), (None, false));
        assert_eq!(value(&score, "demo.false_alarms"), (Some(0.0), true));
    }

    #[test]
    fn the_second_alarm_for_one_fire_is_false_and_named_a_duplicate() {
        let told = [
            alarm("far", Class::Fire, 6.0, 0.0),
            alarm("near", Class::Fire, 1.0, 0.0),
        ];
        let score = score(&[fire("pot", 0.0, 0.0)], &told);
        assert_eq!(score.rows[0].found.as_ref().unwrap().alarm, "near");
        assert_eq!(score.false_alarms[0].alarm, "far");
        assert_eq!(score.false_alarms[0].duplicate_of.as_deref(), Some("pot"));
        assert_eq!(value(&score, "demo.false_alarms"), (Some(1.0), false));
    }

    #[test]
    fn an_alarm_beyond_the_gate_is_false_and_finds_nothing() {
        let score = score(
            &[fire("pot", 0.0, 0.0)],
            &[alarm("roof", Class::Fire, 15.1, 0.0)],
        );
        assert!(score.rows[0].found.is_none());
        assert_eq!(score.false_alarms[0].duplicate_of, None);
    }

    #[test]
    fn two_fires_in_one_gate_take_one_alarm_each() {
        let truths = [fire("west", 0.0, 0.0), fire("east", 10.0, 0.0)];
        let told = [
            alarm("a", Class::Fire, 4.0, 0.0),
            alarm("b", Class::Fire, -1.0, 0.0),
        ];
        let score = score(&truths, &told);
        let alarm_of = |row: usize| score.rows[row].found.as_ref().unwrap().alarm.as_str();
        assert_eq!((alarm_of(0), alarm_of(1)), ("b", "a"));
        assert!(score.false_alarms.is_empty());
    }

    #[test]
    fn smoke_over_a_fire_is_its_incident_and_smoke_elsewhere_is_false() {
        let told = [
            alarm("flame", Class::Fire, 0.5, 0.0),
            alarm("plume", Class::Smoke, 9.0, 9.0),
            alarm("cloud", Class::Smoke, 90.0, 0.0),
        ];
        let score = score(&[fire("pot", 0.0, 0.0)], &told);
        assert_eq!(score.false_alarms.len(), 1);
        assert_eq!(score.false_alarms[0].alarm, "cloud");
        assert_eq!(value(&score, "demo.fires_found"), (Some(1.0), true));
    }

    #[test]
    fn a_fire_alarm_on_true_smoke_is_false() {
        let smoke = Truth {
            class: Class::Smoke,
            ..fire("smoulder", 0.0, 0.0)
        };
        let score = score(&[smoke], &[alarm("a", Class::Fire, 0.0, 0.0)]);
        assert_eq!(score.false_alarms.len(), 1);
    }

    #[test]
    fn the_ellipse_decides_by_its_own_shape_not_by_its_radius() {
        let mut told = alarm("a", Class::Fire, 3.0, 0.0);
        told.covariance_m2 = Matrix3::from_diagonal(&Vector3::new(4.0, 0.01, 1.0));
        let east = score(&[fire("pot", 0.0, 0.0)], std::slice::from_ref(&told));
        assert!(east.rows[0].found.as_ref().unwrap().inside_ellipse);
        told.place_m = Vector3::new(0.0, 3.0, 0.0);
        let north = score(&[fire("pot", 0.0, 0.0)], &[told]);
        assert!(!north.rows[0].found.as_ref().unwrap().inside_ellipse);
    }

    #[test]
    fn alarms_are_read_from_the_contracts_geojson() {
        let datum = Lla {
            latitude_deg: 31.4,
            longitude_deg: 119.1,
            height_m: 10.0,
        };
        let text = r#"{"type": "FeatureCollection", "features": [
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": [119.1, 31.4, 12.0]},
             "properties": {"id": "uav-1-3", "class": "fire", "state": "confirmed", "ce90_m": 3.0,
              "covariance_enu_m2": [1, 0.5, 0, 0.5, 2, 0, 0, 0, 3], "sightings": 4, "revision": 2,
              "first_seen_at": "2026-03-01T12:00:00.5Z"}},
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": [119.1, 31.4, 12.0]},
             "properties": {"id": "uav-1-4", "class": "smoke", "state": "suspected", "ce90_m": 3.0,
              "covariance_enu_m2": [1, 0, 0, 0, 1, 0, 0, 0, 1], "sightings": 1,
              "first_seen_at": "2026-03-01T12:00:00.5Z"}}]}"#;
        let told = BTreeMap::from([(
            "uav-1-3".to_owned(),
            ServiceTime::from_rfc3339("2026-03-01T12:00:02Z").unwrap(),
        )]);
        let alarms = read_alarms(text, &TangentPlane::at(datum), &told).unwrap();
        assert_eq!(alarms.len(), 1, "what is only suspected was never told");
        // 1e-8 m: rounding of ECEF components in 6.4e6 m.
        assert!((alarms[0].place_m - Vector3::new(0.0, 0.0, 2.0)).norm() < 1e-8);
        assert_eq!(alarms[0].covariance_m2[(0, 1)], 0.5);
        assert!(alarms[0].told_at.is_some());
    }
}
