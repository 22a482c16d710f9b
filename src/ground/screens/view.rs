//! The words that all screens share: what they say of one incident.

use super::rings::rings;
use crate::alarm::{AlarmClass, FireState};
use crate::ground::incident::{Incident, OperatorState};
use emberfix_frames::{
    Coordinate, Metres, MissionEnu, ServiceTime, Vector3, Wgs84, Wgs84Parts, ecef_from_enu,
    place_from_ecef,
};

/// Whether it belongs on a picture of what is going on.
pub(super) fn is_shown(incident: &Incident) -> bool {
    incident.operator.state != OperatorState::Dismissed
}

/// Whether it still burns, as far as is known.
pub(super) fn is_open(incident: &Incident) -> bool {
    is_shown(incident) && incident.state != FireState::Out
}

/// When something last happened to it: an aircraft saw it, or a person said something.
pub(super) fn changed_at(incident: &Incident) -> ServiceTime {
    let said = incident
        .operator
        .at
        .as_deref()
        .and_then(ServiceTime::from_rfc3339);
    said.map_or(incident.captured_at, |said| said.max(incident.captured_at))
}

/// A short name, such as radio and map labels want: `FIRE uav-1-7`.
pub(super) fn callsign(incident: &Incident) -> String {
    let kind = match incident.class {
        AlarmClass::Fire => "FIRE",
        AlarmClass::Smoke => "SMOKE",
    };
    format!("{}{kind} {}", exercise(incident), incident.id)
}

/// Flame or smoke, and where in its life it is: `Fire, growing`.
pub(super) fn title(incident: &Incident) -> String {
    let kind = match incident.class {
        AlarmClass::Fire => "Fire",
        AlarmClass::Smoke => "Smoke",
    };
    format!(
        "{}{kind}, {}",
        exercise(incident),
        state_word(incident.state)
    )
}

fn exercise(incident: &Incident) -> &'static str {
    if incident.exercise { "EXERCISE " } else { "" }
}

/// What there is to say, a line each; the same on every screen.
pub(super) fn lines(incident: &Incident) -> Vec<String> {
    let seen_by: Vec<&str> = incident.aircraft().collect();
    let mut lines = vec![
        format!(
            "{} ({:.0} % sure), {}",
            title(incident),
            100.0 * incident.confidence,
            operator_words(incident)
        ),
        format!(
            "CE90 {:.1} m, LE90 {:.1} m (90 % of cases)",
            incident.ce90_m, incident.le90_m
        ),
        format!(
            "Last seen {} by {}",
            second(incident.captured_at),
            seen_by.join(", ")
        ),
    ];
    if let Some(size) = incident.size_m {
        lines.push(format!(
            "{:.1} m wide, {:.1} m high",
            size.width, size.height
        ));
    }
    if !incident.degraded.is_empty() {
        lines.push(format!(
            "Less sure because of: {}",
            incident.degraded.join(", ")
        ));
    }
    lines
}

fn operator_words(incident: &Incident) -> String {
    let by = incident.operator.by.as_deref().unwrap_or("an operator");
    match incident.operator.state {
        OperatorState::New => "not yet acknowledged".to_owned(),
        OperatorState::Acknowledged => format!("acknowledged by {by}"),
        OperatorState::Confirmed => format!("confirmed by {by}"),
        OperatorState::Dismissed => format!("dismissed by {by}"),
    }
}

/// The 90 % ellipse on the Earth as closed rings that cross neither the antimeridian nor a pole: longitude
/// and latitude, anticlockwise; none where the covariance is none.
pub(super) fn ellipse90(incident: &Incident, corners: u32) -> Vec<Vec<[f64; 2]>> {
    let Ok(covariance) = incident.covariance() else {
        return Vec::new();
    };
    let corners: Vec<[f64; 2]> = covariance
        .ellipse90_m(corners)
        .into_iter()
        .filter_map(|(east_m, north_m)| offset(&incident.place, east_m, north_m))
        .collect();
    let mut rings = rings(&corners);
    for ring in &mut rings {
        ring.extend(ring.first().copied());
    }
    rings
}

/// Longitude and latitude of a point in the tangent plane of `origin`.
fn offset(origin: &Wgs84, east_m: f64, north_m: f64) -> Option<[f64; 2]> {
    let point = Coordinate::<MissionEnu>::from_metres(Vector3::new(east_m, north_m, 0.0));
    let place = place_from_ecef(&ecef_from_enu(origin).transform(point))?;
    Some([place.longitude_deg(), place.latitude_deg()])
}

/// UTC to the second: `2026-03-01T12:00:00Z`.
pub(super) fn second(at: ServiceTime) -> String {
    let text = at.rfc3339();
    format!("{}Z", text.get(..19).unwrap_or(&text))
}

fn state_word(state: FireState) -> &'static str {
    match state {
        FireState::Suspected => "suspected",
        FireState::Confirmed => "confirmed",
        FireState::Growing => "growing",
        FireState::Steady => "steady",
        FireState::Dying => "dying down",
        FireState::Out => "out",
    }
}
