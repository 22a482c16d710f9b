//! What the ground keeps of one fire: every aircraft's alarms of it as one incident.
//!
//! **In:** members, each the newest revision of one alarm, and what operators said of them.
//! **Out:** [`Incident`], which every screen is drawn from. Pure: no I/O, no clock.
//!
//! An incident carries the id of the alarm that founded it. It keeps that id over restarts and while
//! other alarms join and leave; when two incidents prove to be one fire, the older id stands and
//! the other one points to it ([`News::Gone`]).

use super::merge::fuse::{self, Estimate};
use crate::alarm::{Alarm, AlarmClass, FireState, Method, SizeM};
use emberfix_frames::{Covariance, MissionEnu, ServiceTime, Wgs84, Wgs84Parts};
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};

/// One fire as the ground knows it. Serialised by [`Incident::to_geojson`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Incident {
    /// Id of the alarm that founded it.
    pub id: String,
    /// Row of the journal at which it last changed; every screen can resume from it.
    pub row: i64,
    /// Its alarms in the order in which they first came.
    pub alarms: Vec<Member>,
    /// Fused place of the base of the fire.
    #[serde(skip)]
    pub place: Wgs84,
    /// Altitude above mean sea level, metres.
    pub altitude_msl_m: f64,
    /// Row-major 3x3 in the tangent plane at the place, m².
    pub covariance_enu_m2: [f64; 9],
    /// Radius that holds the truth in at least 90 %, metres.
    pub ce90_m: f64,
    /// Half-height that holds the truth in at least 90 %, metres.
    pub le90_m: f64,
    /// Fire as soon as one aircraft sees flame.
    pub class: AlarmClass,
    /// By the aircraft that looked last.
    pub state: FireState,
    /// The highest that an aircraft gives; never multiplied up, detectors err together.
    pub confidence: f64,
    /// First sighting by any aircraft.
    #[serde(with = "crate::alarm::rfc3339")]
    pub first_seen_at: ServiceTime,
    /// Latest sighting by any aircraft.
    #[serde(with = "crate::alarm::rfc3339")]
    pub captured_at: ServiceTime,
    /// Extent by the aircraft that measured it last.
    pub size_m: Option<SizeM>,
    /// By the aircraft that measured it last, per second.
    pub trend: Option<f64>,
    /// What people on the ground say of it.
    pub operator: Operator,
    /// Alarm revisions and operator actions on record.
    pub history: u64,
    /// Whether there is an image to show.
    pub chip: bool,
    /// What the positions rest on, sorted.
    pub methods: Vec<Method>,
    /// Sightings by all aircraft.
    pub sightings: u32,
    /// Reasons why the ellipses are wider than they could be.
    pub degraded: Vec<String>,
    /// Set by the station's configuration: nothing of this is real.
    pub exercise: bool,
    #[serde(skip)]
    text: Text,
}

/// The feature as text, made once for all who show it.
#[derive(Debug, Clone, Default)]
struct Text(OnceLock<Arc<str>>);

impl PartialEq for Text {
    fn eq(&self, _: &Self) -> bool {
        true // it follows from the rest
    }
}

/// One alarm of an incident.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Member {
    /// Alarm id.
    pub alarm: String,
    /// Newest revision.
    pub revision: u32,
    /// Aircraft.
    pub uav: String,
    /// Latest sighting.
    #[serde(with = "crate::alarm::rfc3339")]
    pub captured_at: ServiceTime,
    /// Its own state.
    pub state: FireState,
    /// Its own radius of 90 %, metres.
    pub ce90_m: f64,
    /// Longitude, latitude, ellipsoid height of its own position.
    pub coordinates: [f64; 3],
    /// The aircraft has fetched what operators said of this alarm; absent when they said nothing.
    pub aircraft_knows: Option<bool>,
}

/// Where an incident stands with the people on the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum OperatorState {
    /// Said to be no fire.
    Dismissed,
    /// Nobody has said anything.
    #[default]
    New,
    /// Somebody is on it.
    Acknowledged,
    /// Somebody says that it burns.
    Confirmed,
}

/// What people on the ground say, who and when.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Default)]
pub struct Operator {
    /// Where it stands.
    pub state: OperatorState,
    /// Who said so.
    pub by: Option<String>,
    /// When, by the ground's clock, RFC 3339.
    pub at: Option<String>,
    /// In their words.
    pub note: Option<String>,
}

/// What changed, for whoever draws.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// New, or other than before.
    Changed(Arc<Incident>),
    /// It is no longer an incident of its own: take it off the screen.
    Gone {
        /// Row of the change.
        row: i64,
        /// Its id.
        id: String,
        /// The incident that has its alarms now.
        into: String,
    },
}

impl News {
    /// The incident's id.
    #[must_use]
    pub fn id(&self) -> &str {
        match self {
            Self::Changed(incident) => &incident.id,
            Self::Gone { id, .. } => id,
        }
    }

    /// Row of the change.
    #[must_use]
    pub fn row(&self) -> i64 {
        match self {
            Self::Changed(incident) => incident.row,
            Self::Gone { row, .. } => *row,
        }
    }
}

/// What makes an incident, beside its alarms.
#[derive(Debug, Clone)]
pub(crate) struct Circumstances {
    pub id: String,
    pub row: i64,
    pub history: u64,
    pub chip: bool,
    pub exercise: bool,
}

/// One alarm and what was said of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Part<'a> {
    pub alarm: &'a Alarm,
    pub operator: &'a Operator,
    pub aircraft_knows: Option<bool>,
}

impl Incident {
    /// Puts alarms together; `None` when there are none.
    pub(crate) fn of(parts: &[Part<'_>], about: Circumstances) -> Option<Self> {
        let latest = parts
            .iter()
            .map(|part| part.alarm)
            .max_by_key(|alarm| (alarm.properties.captured_at, alarm.properties.revision))?;
        let estimates: Vec<Estimate> = parts.iter().map(|part| Estimate::of(part.alarm)).collect();
        let fused = fuse::fuse(&estimates)?;
        let each = || parts.iter().map(|part| &part.alarm.properties);
        let undulation = latest.place.height().m() - latest.properties.altitude_msl_m;
        Some(Self {
            alarms: parts.iter().map(Member::of).collect(),
            altitude_msl_m: fused.place.height().m() - undulation,
            covariance_enu_m2: fused.covariance.row_major(),
            ce90_m: only_or(parts, |alarm| alarm.ce90_m, || fused.covariance.ce90_m()),
            le90_m: only_or(parts, |alarm| alarm.le90_m, || fused.covariance.le90_m()),
            place: fused.place,
            class: class(parts),
            state: latest.properties.state,
            confidence: each().map(|alarm| alarm.confidence).fold(0.0, f64::max),
            first_seen_at: each().map(|alarm| alarm.first_seen_at).min()?,
            captured_at: latest.properties.captured_at,
            size_m: last_measured(parts, |alarm| alarm.size_m),
            trend: last_measured(parts, |alarm| alarm.trend),
            operator: operator(parts),
            methods: sorted(each().flat_map(|alarm| alarm.methods.iter().copied())),
            sightings: each().fold(0, |sum, alarm| sum.saturating_add(alarm.sightings)),
            degraded: sorted(each().flat_map(|alarm| alarm.degraded.iter().cloned())),
            id: about.id,
            row: about.row,
            history: about.history,
            chip: about.chip,
            exercise: about.exercise,
            text: Text::default(),
        })
    }

    /// Longitude, latitude (degrees), height above the ellipsoid (metres), as GeoJSON has them.
    #[must_use]
    pub fn coordinates(&self) -> [f64; 3] {
        coordinates(&self.place)
    }

    /// The covariance of its place.
    ///
    /// # Errors
    /// Never for an incident of the ground: it was computed as one.
    pub fn covariance(&self) -> Result<Covariance<MissionEnu>, emberfix_frames::CovarianceError> {
        Covariance::new(emberfix_frames::Matrix3::from_row_slice(
            &self.covariance_enu_m2,
        ))
    }

    /// The aircraft that see it.
    pub fn aircraft(&self) -> impl Iterator<Item = &str> {
        let names: BTreeSet<&str> = self.alarms.iter().map(|alarm| alarm.uav.as_str()).collect();
        names.into_iter()
    }

    /// The same as text on one line, made once.
    #[must_use]
    pub fn feature(&self) -> Arc<str> {
        let text = || self.to_geojson().to_string().into();
        Arc::clone(self.text.0.get_or_init(text))
    }

    /// The incident as a GeoJSON Feature.
    #[must_use]
    pub fn to_geojson(&self) -> Value {
        json!({
            "type": "Feature",
            "id": self.id,
            "geometry": { "type": "Point", "coordinates": self.coordinates() },
            "properties": self,
        })
    }
}

impl Member {
    fn of(part: &Part<'_>) -> Self {
        let alarm = &part.alarm.properties;
        Self {
            alarm: alarm.id.clone(),
            revision: alarm.revision,
            uav: alarm.uav.clone(),
            captured_at: alarm.captured_at,
            state: alarm.state,
            ce90_m: alarm.ce90_m,
            coordinates: coordinates(&part.alarm.place),
            aircraft_knows: part.aircraft_knows,
        }
    }
}

fn coordinates(place: &Wgs84) -> [f64; 3] {
    [
        place.longitude_deg(),
        place.latitude_deg(),
        place.height().m(),
    ]
}

/// A single aircraft's radius stands as it was told; a fused one is computed.
fn only_or(
    parts: &[Part<'_>],
    told: impl Fn(&crate::alarm::AlarmProperties) -> f64,
    fused: impl FnOnce() -> f64,
) -> f64 {
    match parts {
        [only] => told(&only.alarm.properties),
        _ => fused(),
    }
}

fn class(parts: &[Part<'_>]) -> AlarmClass {
    let flame = |part: &Part<'_>| part.alarm.properties.class == AlarmClass::Fire;
    if parts.iter().any(flame) {
        AlarmClass::Fire
    } else {
        AlarmClass::Smoke
    }
}

fn last_measured<T>(
    parts: &[Part<'_>],
    value: impl Fn(&crate::alarm::AlarmProperties) -> Option<T>,
) -> Option<T> {
    parts
        .iter()
        .map(|part| &part.alarm.properties)
        .filter_map(|alarm| value(alarm).map(|value| (alarm.captured_at, value)))
        .max_by_key(|(at, _)| *at)
        .map(|(_, value)| value)
}

/// The strongest word that was said of any of its alarms. Of an alarm that nobody has looked at
/// beside dismissed ones the incident is new again: another aircraft says that there is a fire.
fn operator(parts: &[Part<'_>]) -> Operator {
    parts
        .iter()
        .map(|part| part.operator)
        .max_by_key(|operator| (operator.state, operator.at.clone()))
        .cloned()
        .unwrap_or_default()
}

fn sorted<T: Ord>(all: impl Iterator<Item = T>) -> Vec<T> {
    all.collect::<BTreeSet<T>>().into_iter().collect()
}
