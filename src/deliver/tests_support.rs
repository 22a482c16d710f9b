//! An alarm to test with.

use super::alarm_id;
use crate::alarm::{Alarm, AlarmClass, AlarmProperties, FireId, FireState, Method};
use emberfix_frames::{EllipsoidHeight, ServiceTime, place_from_degrees};

/// A confirmed fire at Gaochun, of aircraft `uav-1`.
pub(super) fn alarm(number: u32, revision: u32) -> Alarm {
    let height = EllipsoidHeight::from_m(20.5);
    let captured_at = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);
    Alarm {
        place: place_from_degrees(31.409_422, 119.112_017, height).unwrap(),
        properties: AlarmProperties {
            id: alarm_id("uav-1", FireId(number)),
            revision,
            uav: "uav-1".to_owned(),
            class: AlarmClass::Fire,
            state: FireState::Confirmed,
            confidence: 0.91,
            first_seen_at: captured_at,
            captured_at,
            altitude_msl_m: 10.25,
            height_above_ground_m: None,
            ce90_m: 2.5,
            le90_m: 3.5,
            covariance_enu_m2: [1.36, 0.0, 0.0, 0.0, 1.36, 0.0, 0.0, 0.0, 4.53],
            methods: vec![Method::Stereo],
            sightings: 5,
            range_m: 12.5,
            size_m: None,
            trend: None,
            advice: None,
            burning: Default::default(),
            degraded: Vec::new(),
        },
    }
}
