//! The ground station over IP: does it live, and does a test alarm get through.

use crate::alarm::{Alarm, AlarmClass, AlarmProperties, FireState, Method};
use crate::deliver::http::{HttpError, HttpLink};
use crate::mission::Mission;
use emberfix_frames::{Geoid, ServiceTime, SignedDuration, Wgs84Parts};
use std::time::{Duration, Instant};

/// What the ground station showed.
#[derive(Debug)]
pub struct GroundSeen {
    /// Its address.
    pub url: String,
    /// Its own word on its health; or why there is none.
    pub health: Result<GroundHealth, HttpError>,
    /// A test alarm, there and back; or why not.
    pub test: Result<Duration, HttpError>,
}

/// The ground's own word.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GroundHealth {
    /// Its version.
    pub version: String,
    /// The ground's clock minus ours, as far as the round trip lets us tell.
    pub ahead: Option<SignedDuration>,
}

/// Asks it; `None` for a mission without an IP path to the ground.
#[must_use]
pub fn ask(mission: &Mission, now: ServiceTime) -> Option<GroundSeen> {
    let url = mission.ground.url.clone()?;
    let link = match HttpLink::new(&url) {
        Ok(link) => link,
        Err(error) => {
            let again = HttpLink::new(&url)
                .err()
                .unwrap_or(HttpError::Url { url: url.clone() });
            return Some(GroundSeen {
                url,
                health: Err(error),
                test: Err(again),
            });
        }
    };
    let clock = crate::service::service_clock();
    let health = link.health().map(|health| GroundHealth {
        ahead: health.now.map(|theirs| theirs - clock()),
        version: health.version,
    });
    let begun = Instant::now();
    let test = link
        .send_test(&test_alarm(mission, now))
        .map(|()| begun.elapsed());
    Some(GroundSeen { url, health, test })
}

/// An alarm that nobody can take for a real one: its id ends in `-test`, its reasons say so, and it
/// goes where nothing is kept.
fn test_alarm(mission: &Mission, now: ServiceTime) -> Alarm {
    let undulation =
        Geoid::new().undulation(mission.datum.latitude_deg(), mission.datum.longitude_deg());
    Alarm {
        place: mission.datum,
        properties: AlarmProperties {
            id: format!("{}-test", mission.uav),
            revision: 1,
            uav: mission.uav.clone(),
            class: AlarmClass::Fire,
            state: FireState::Suspected,
            confidence: 0.0,
            first_seen_at: now,
            captured_at: now,
            altitude_msl_m: (mission.datum.height() - undulation).m(),
            height_above_ground_m: None,
            ce90_m: 10.0,
            le90_m: 10.0,
            covariance_enu_m2: [21.7, 0.0, 0.0, 0.0, 21.7, 0.0, 0.0, 0.0, 36.9],
            methods: vec![Method::Stereo],
            sightings: 0,
            range_m: 0.0,
            size_m: None,
            trend: None,
            advice: None,
            burning: Default::default(),
            degraded: vec!["test".to_owned()],
        },
    }
}
