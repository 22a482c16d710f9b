//! An alarm to test with.

use super::alarm_id;
use super::envelope::{Envelope, Origin, Sealed};
use super::link::Letter;
use crate::alarm::{Alarm, AlarmClass, AlarmProperties, Attention, FireId, FireState, Method};
use emberfix_frames::{EllipsoidHeight, ServiceTime, place_from_degrees};
use std::sync::Arc;

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

/// The alarm as a letter, unsigned; its sequence is 1000 times the fire's number plus the revision.
pub(super) fn letter(number: u32, revision: u32) -> Letter {
    sealed(alarm(number, revision))
}

/// Likewise, in another state.
pub(super) fn letter_in(number: u32, revision: u32, state: FireState) -> Letter {
    let mut alarm = alarm(number, revision);
    alarm.properties.state = state;
    sealed(alarm)
}

fn sealed(alarm: Alarm) -> Letter {
    let properties = &alarm.properties;
    let number = super::fire_number(&properties.id).unwrap().0;
    let envelope = Envelope {
        origin: Origin {
            uav: "uav-1".to_owned(),
            outbox: 7,
        },
        sequence: u64::from(number) * 1_000 + u64::from(properties.revision),
        count: properties.revision,
        alarm: alarm.to_geojson().to_string().into_bytes(),
    };
    Letter {
        alarm: Arc::new(alarm),
        sealed: Arc::new(Sealed {
            envelope,
            signature: None,
        }),
        attention: Attention::Wanted,
    }
}
