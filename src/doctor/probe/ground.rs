//! The ground station over IP: does it live, and does a test alarm get through.

use crate::alarm::{Alarm, AlarmClass, AlarmProperties, FireState, Method};
use crate::deliver::datagram::wire::{Ask, RECEIVE_BUFFER, ToAircraft, ToGround};
use crate::deliver::envelope::Origin;
use crate::deliver::http::{HttpError, HttpLink};
use crate::deliver::keys::SecretKey;
use crate::mission::Mission;
use crate::service::courier::connect;
use emberfix_frames::{Geoid, ServiceTime, SignedDuration, Wgs84Parts};
use std::time::{Duration, Instant};

/// Between two datagrams that ask, and longest wait for an answer to any.
const DATAGRAM_RETRY: Duration = Duration::from_millis(200);
const DATAGRAM_PATIENCE: Duration = Duration::from_secs(2);

/// What the ground station showed.
#[derive(Debug)]
pub struct GroundSeen {
    /// Its address.
    pub url: String,
    /// Its own word on its health; or why there is none.
    pub health: Result<GroundHealth, HttpError>,
    /// A test alarm, there and back; or why not.
    pub test: Result<Duration, HttpError>,
    /// A datagram, there and back; or why not. None where the mission wants none, or nobody is there.
    pub datagrams: Option<Result<Duration, String>>,
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
    let ask = || HttpLink::with(&url, &mission.ground.credentials);
    let link = match ask() {
        Ok(link) => link,
        Err(error) => {
            let again = ask().err().unwrap_or(HttpError::Url { url: url.clone() });
            return Some(GroundSeen {
                url,
                health: Err(error),
                test: Err(again),
                datagrams: None,
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
    let wanted = mission.ground.datagrams && health.is_ok();
    let datagrams = wanted.then(|| datagram(mission, &link.place()));
    Some(GroundSeen {
        url,
        health,
        test,
        datagrams,
    })
}

/// Asks by datagram for operators' actions after the last that can be: it is signed as alarms are, and
/// changes nothing at the ground.
fn datagram(mission: &Mission, place: &str) -> Result<Duration, String> {
    let key_file = mission.key_file();
    let key = key_file
        .exists()
        .then(|| SecretKey::load_or_make(&key_file))
        .transpose()
        .map_err(|error| error.to_string())?;
    let stamp = rand::random();
    let ask = ToGround::Ask(Ask {
        origin: Origin {
            uav: mission.uav.clone(),
            outbox: 0,
        },
        stamp,
        after: i64::MAX.cast_unsigned(),
    });
    let said = |error: std::io::Error| format!("{place}: {error}");
    let socket = connect(place, DATAGRAM_RETRY).map_err(said)?;
    let begun = Instant::now();
    let mut buffer = vec![0; RECEIVE_BUFFER];
    while begun.elapsed() < DATAGRAM_PATIENCE {
        let sent = Instant::now();
        // What nobody listens to is refused on the next call; that, too, is no answer.
        if socket.send(&ask.datagram(key.as_ref())).is_ok()
            && let Ok(length) = socket.recv(&mut buffer)
            && let Ok((ToAircraft::Actions { stamp: told, .. }, signed)) =
                ToAircraft::read(&buffer[..length])
            && told == stamp
        {
            let ours = mission.ground.public_key;
            return match ours.is_none_or(|ground| signed.is_by(&ground)) {
                true => Ok(sent.elapsed()),
                false => Err("the answer is not signed by ground.public_key".to_owned()),
            };
        }
        std::thread::sleep(DATAGRAM_RETRY.saturating_sub(sent.elapsed()));
    }
    Err(match key {
        Some(key) => format!("no answer at {place}; our public key is {}", key.public()),
        None => format!("no answer at {place}; this aircraft has no key yet"),
    })
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
