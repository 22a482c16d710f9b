//! What is said of a fire: to people, and to a camera's display.

use super::super::spatial::round_sigmas_m;
use crate::alarm::{Alarm, AlarmClass, AlarmProperties, FireId, FireState};
use emberfix_frames::{MslAltitude, ServiceTime, SignedDuration, Wgs84Parts};
use emberfix_mav::telemetry::{CameraTrackingGeoStatus, Severity, StatusText};

/// From this age on a text says how old its news are.
const OLD_NEWS: SignedDuration = SignedDuration::from_secs(60);

pub(super) fn text(fire: FireId, alarm: &Alarm, now: ServiceTime) -> StatusText {
    let properties = &alarm.properties;
    let what = match properties.class {
        AlarmClass::Fire => "FIRE",
        AlarmClass::Smoke => "SMOKE",
    };
    let out = if properties.state == FireState::Out {
        " OUT"
    } else {
        ""
    };
    let (latitude, longitude) = (alarm.place.latitude_deg(), alarm.place.longitude_deg());
    let ce90_m = properties.ce90_m.ceil().max(1.0);
    let percent = (properties.confidence * 100.0).round();
    let age = age(properties, now);
    StatusText {
        severity: severity(properties.state),
        text: format!(
            "{what} {}{out} {latitude:.6},{longitude:.6} +-{ce90_m}m {percent}%{age}",
            fire.0
        ),
    }
}

fn age(properties: &AlarmProperties, now: ServiceTime) -> String {
    let age = now - properties.captured_at;
    if age < OLD_NEWS {
        String::new()
    } else {
        format!(" {}min", age.as_mins())
    }
}

fn severity(state: FireState) -> Severity {
    match state {
        FireState::Suspected => Severity::Warning,
        FireState::Out => Severity::Notice,
        FireState::Confirmed | FireState::Growing | FireState::Steady | FireState::Dying => {
            Severity::Alert
        }
    }
}

pub(super) fn camera_status(alarm: &Alarm) -> CameraTrackingGeoStatus {
    let (horizontal_m, vertical_m) = round_sigmas_m(&alarm.properties);
    CameraTrackingGeoStatus {
        tracking: true,
        latitude_deg: alarm.place.latitude_deg(),
        longitude_deg: alarm.place.longitude_deg(),
        altitude: MslAltitude::from_m(alarm.properties.altitude_msl_m),
        horizontal_sigma_m: Some(horizontal_m),
        vertical_sigma_m: Some(vertical_m),
        range_m: Some(alarm.properties.range_m),
    }
}
