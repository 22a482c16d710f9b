//! An alarm as one MAVLink command with a place, and back; both sides use this file.
//!
//! `COMMAND_INT`, command `MAV_CMD_SPATIAL_USER_1`, frame `MAV_FRAME_GLOBAL`:
//!
//! | field | meaning |
//! |---|---|
//! | `x`, `y` | latitude, longitude, 1e-7 degrees |
//! | `z` | altitude above mean sea level, metres |
//! | `param1` | fire number, 1 to 16 777 215 |
//! | `param2` | whole number: state + 8 class + 16 confidence + 2048 revision |
//! | `param3` | CE90, metres |
//! | `param4` | whole number: LE90 code + 256 range code + 65536 age code |
//!
//! State counts from 0 as [`FireState`] lists them; class is 0 fire, 1 smoke; confidence is in whole
//! percent; revision saturates at 8191. Whole numbers stay below 2^24, which a 32-bit float holds
//! exactly. A code k stands for `0.1 * 1.05^k` (metres, or seconds of age since the latest
//! sighting; 25 km or 7 hours at most) and is rounded up, so that nothing looks better or newer
//! than it is; 0 stands for 0.1 or less.
//!
//! The answer is a `COMMAND_ACK` whose `result_param2` is fire number + 2^24 (revision mod 128):
//! see [`receipt`]. A plain fire number is understood as "the revision that I got".

use super::{alarm_id, fire_number};
use crate::alarm::{Alarm, AlarmClass, AlarmProperties, FireId, FireState};
use emberfix_frames::{
    Covariance, GeoidUndulation, MissionEnu, MslAltitude, PlaceError, ServiceTime, Wgs84Parts,
    place_from_degrees, seconds,
};
use emberfix_mav::Address;
use emberfix_mav::outgoing::{command, degrees_e7};
use emberfix_mav::telemetry::CommandInt;

/// Greatest fire number: what a 32-bit float holds exactly.
pub const GREATEST_NUMBER: u32 = (1 << 24) - 1;
/// Greatest revision that is told apart.
pub const GREATEST_REVISION: u32 = (1 << 13) - 1;
/// `MAV_FRAME_GLOBAL`: latitude, longitude, altitude above mean sea level.
const FRAME_GLOBAL: u8 = 0;
/// Radius that holds 90 %, in sigmas, of a round horizontal error: `sqrt(2 ln 10)`.
const CE90_PER_SIGMA: f64 = 2.145_966_026_289_347;
/// Half-height that holds 90 %, in sigmas.
const LE90_PER_SIGMA: f64 = 1.644_853_626_951_472_6;
/// Said in the alarm that the ground makes of a summary.
pub const DEGRADED_SUMMARY: &str = "mavlink_summary";

/// What fits into one command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpatialAlarm {
    /// Number of the fire on its aircraft.
    pub fire: FireId,
    /// Revision, at most [`GREATEST_REVISION`].
    pub revision: u32,
    /// Fire or smoke.
    pub class: AlarmClass,
    /// Where in its life the fire is.
    pub state: FireState,
    /// In whole percent of probability, 0 to 1.
    pub confidence: f64,
    /// Geodetic latitude of the base of the fire, degrees.
    pub latitude_deg: f64,
    /// Longitude of the base of the fire, degrees.
    pub longitude_deg: f64,
    /// Altitude of the base of the fire.
    pub altitude: MslAltitude,
    /// Radius that holds the truth in 90 %, metres.
    pub ce90_m: f64,
    /// Half-height that holds the truth in 90 %, metres; up to 5 % more than was known.
    pub le90_m: f64,
    /// Straight line from the camera at the latest sighting, metres; up to 5 % more than it was.
    pub range_m: f64,
    /// From the latest sighting to the sending, seconds; up to 5 % more than it was.
    pub age_s: f64,
}

/// Why an alarm does not fit, or a command is none.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SpatialError {
    /// No number behind the aircraft's name.
    #[error("alarm id {id:?} does not end in -NUMBER")]
    Id {
        /// The id.
        id: String,
    },
    /// Beyond what a 32-bit float holds exactly, or 0.
    #[error("fire number {number} is outside 1 to {limit}")]
    Number {
        /// The number.
        number: f64,
        /// Greatest one.
        limit: u32,
    },
    /// Another command.
    #[error("command {command} in frame {frame} is no alarm")]
    NotAnAlarm {
        /// `MAV_CMD`.
        command: u32,
        /// `MAV_FRAME`.
        frame: u8,
    },
    /// A parameter that no sender writes.
    #[error("{parameter} is {value}, which no alarm has")]
    Parameter {
        /// Which one.
        parameter: &'static str,
        /// What stood there.
        value: f64,
    },
    /// No place.
    #[error(transparent)]
    Place(#[from] PlaceError),
}

/// The command that tells `alarm` to `ground` at `now`.
///
/// # Errors
/// [`SpatialError::Id`] or [`SpatialError::Number`].
pub fn encode(
    alarm: &Alarm,
    ground: Address,
    now: ServiceTime,
) -> Result<CommandInt, SpatialError> {
    let properties = &alarm.properties;
    let fire = fire_number(&properties.id).ok_or_else(|| SpatialError::Id {
        id: properties.id.clone(),
    })?;
    check_number(f64::from(fire.0))?;
    let age_s = (now - properties.captured_at).as_secs_f64();
    let whole = [
        code(properties.le90_m),
        code(properties.range_m),
        code(age_s),
    ];
    Ok(CommandInt {
        command: command::SPATIAL_USER_1,
        frame: FRAME_GLOBAL,
        params: [
            fire.0 as f32,
            description(properties) as f32,
            properties.ce90_m as f32,
            u32::from_le_bytes([whole[0], whole[1], whole[2], 0]) as f32,
        ],
        x: degrees_e7(alarm.place.latitude_deg()),
        y: degrees_e7(alarm.place.longitude_deg()),
        z: properties.altitude_msl_m as f32,
        target: ground,
    })
}

/// What a command tells.
///
/// # Errors
/// [`SpatialError`], with what cannot be.
pub fn decode(order: &CommandInt) -> Result<SpatialAlarm, SpatialError> {
    if order.command != command::SPATIAL_USER_1 || order.frame != FRAME_GLOBAL {
        return Err(SpatialError::NotAnAlarm {
            command: order.command,
            frame: order.frame,
        });
    }
    let [number, description, ce90_m, codes] = order.params.map(f64::from);
    let ce90_m = checked("param3", ce90_m, f64::MAX)?;
    let description = checked("param2", description, f64::from(GREATEST_NUMBER))? as u32;
    let codes = checked("param4", codes, f64::from(GREATEST_NUMBER))? as u32;
    let [le90, range, age, _] = codes.to_le_bytes();
    Ok(SpatialAlarm {
        fire: check_number(number)?,
        revision: description >> 11,
        class: class(description >> 3 & 1),
        state: state(description & 7)?,
        confidence: checked("param2", f64::from(description >> 4 & 127) / 100.0, 1.0)?,
        latitude_deg: f64::from(order.x) * 1e-7,
        longitude_deg: f64::from(order.y) * 1e-7,
        altitude: MslAltitude::from_m(f64::from(order.z)),
        ce90_m,
        le90_m: meaning(le90),
        range_m: meaning(range),
        age_s: meaning(age),
    })
}

/// `result_param2` of the answer to a command.
#[must_use]
pub fn receipt(fire: FireId, revision: u32) -> i32 {
    ((revision & 0x7F) << 24 | fire.0 & GREATEST_NUMBER) as i32
}

/// What a `result_param2` says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpatialReceipt {
    /// Which fire.
    pub fire: FireId,
    /// Revision modulo 128; 0 where the ground does not say it.
    revision_mod_128: u32,
}

impl SpatialReceipt {
    /// From an answer's `result_param2`.
    #[must_use]
    pub fn read(result_param2: i32) -> Self {
        let bits = result_param2 as u32;
        Self {
            fire: FireId(bits & GREATEST_NUMBER),
            revision_mod_128: bits >> 24 & 0x7F,
        }
    }

    /// Whether it can mean this revision of the fire.
    #[must_use]
    pub fn means(self, revision: u32) -> bool {
        let sent = revision.min(GREATEST_REVISION) & 0x7F;
        self.revision_mod_128 == 0 || self.revision_mod_128 == sent
    }
}

impl SpatialAlarm {
    /// The alarm that the ground keeps until it gets the whole one: its ellipse is a circle of the
    /// same CE90, and it says so ([`DEGRADED_SUMMARY`]).
    ///
    /// # Errors
    /// [`SpatialError::Place`].
    pub fn into_alarm(
        self,
        uav: &str,
        received_at: ServiceTime,
        undulation: GeoidUndulation,
    ) -> Result<Alarm, SpatialError> {
        let height = self.altitude + undulation;
        let place = place_from_degrees(self.latitude_deg, self.longitude_deg, height)?;
        let (horizontal_m, vertical_m) =
            (self.ce90_m / CE90_PER_SIGMA, self.le90_m / LE90_PER_SIGMA);
        let covariance =
            Covariance::<MissionEnu>::from_sigmas_m(horizontal_m, horizontal_m, vertical_m);
        let captured_at = received_at - seconds(self.age_s);
        Ok(Alarm {
            place,
            properties: AlarmProperties {
                id: alarm_id(uav, self.fire),
                revision: self.revision,
                uav: uav.to_owned(),
                class: self.class,
                state: self.state,
                confidence: self.confidence,
                first_seen_at: captured_at,
                captured_at,
                altitude_msl_m: self.altitude.m(),
                height_above_ground_m: None,
                ce90_m: self.ce90_m,
                le90_m: self.le90_m,
                covariance_enu_m2: covariance.row_major(),
                methods: Vec::new(),
                sightings: 0,
                range_m: self.range_m,
                size_m: None,
                trend: None,
                advice: None,
                burning: Default::default(),
                degraded: vec![DEGRADED_SUMMARY.to_owned()],
            },
        })
    }
}

/// One sigma, horizontal and vertical, metres: of a round error with the alarm's CE90 and LE90.
#[must_use]
pub fn round_sigmas_m(properties: &AlarmProperties) -> (f64, f64) {
    (
        properties.ce90_m / CE90_PER_SIGMA,
        properties.le90_m / LE90_PER_SIGMA,
    )
}

fn description(properties: &AlarmProperties) -> u32 {
    let percent = (properties.confidence.clamp(0.0, 1.0) * 100.0).round() as u32;
    let class = match properties.class {
        AlarmClass::Fire => 0,
        AlarmClass::Smoke => 1,
    };
    let state = match properties.state {
        FireState::Suspected => 0,
        FireState::Confirmed => 1,
        FireState::Growing => 2,
        FireState::Steady => 3,
        FireState::Dying => 4,
        FireState::Out => 5,
    };
    state | class << 3 | percent << 4 | properties.revision.min(GREATEST_REVISION) << 11
}

fn class(bit: u32) -> AlarmClass {
    if bit == 0 {
        AlarmClass::Fire
    } else {
        AlarmClass::Smoke
    }
}

fn state(number: u32) -> Result<FireState, SpatialError> {
    match number {
        0 => Ok(FireState::Suspected),
        1 => Ok(FireState::Confirmed),
        2 => Ok(FireState::Growing),
        3 => Ok(FireState::Steady),
        4 => Ok(FireState::Dying),
        5 => Ok(FireState::Out),
        _ => Err(SpatialError::Parameter {
            parameter: "param2",
            value: f64::from(number),
        }),
    }
}

fn check_number(number: f64) -> Result<FireId, SpatialError> {
    if (1.0..=f64::from(GREATEST_NUMBER)).contains(&number) && number.fract() == 0.0 {
        return Ok(FireId(number as u32));
    }
    Err(SpatialError::Number {
        number,
        limit: GREATEST_NUMBER,
    })
}

fn checked(parameter: &'static str, value: f64, limit: f64) -> Result<f64, SpatialError> {
    if (0.0..=limit).contains(&value) {
        return Ok(value);
    }
    Err(SpatialError::Parameter { parameter, value })
}

/// Least value that a code tells from 0, in metres or seconds.
const CODE_UNIT: f64 = 0.1;
/// From one code to the next.
const CODE_STEP: f64 = 1.05;

fn code(value: f64) -> u8 {
    // A hair of slack, so that a decoded value codes to itself.
    ((value / CODE_UNIT).ln() / CODE_STEP.ln() - 1e-9)
        .ceil()
        .clamp(0.0, 255.0) as u8
}

fn meaning(code: u8) -> f64 {
    CODE_UNIT * CODE_STEP.powi(code.into())
}

#[cfg(test)]
mod tests {
    use super::super::tests_support::alarm;
    use super::*;
    use emberfix_mav::outgoing::{Encoder, command_int};
    use emberfix_mav::{RawFrame, Telemetry};
    use proptest::prelude::*;

    const GROUND: Address = Address::new(254, 191);

    fn over_the_wire(order: &CommandInt) -> CommandInt {
        let message = command_int(order).unwrap();
        let bytes = Encoder::new(Address::new(1, 191)).encode(&message);
        match emberfix_mav::decode(&RawFrame::at_start(&bytes).unwrap().0).unwrap() {
            Telemetry::CommandInt(order) => order,
            other => panic!("{other:?}"),
        }
    }

    fn states() -> impl Strategy<Value = FireState> {
        prop::sample::select(vec![
            FireState::Suspected,
            FireState::Confirmed,
            FireState::Growing,
            FireState::Steady,
            FireState::Dying,
            FireState::Out,
        ])
    }

    proptest! {
        #[test]
        fn what_the_aircraft_writes_the_ground_reads(
            number in 1_u32..=GREATEST_NUMBER,
            revision in 1_u32..=GREATEST_REVISION,
            state in states(),
            smoke in any::<bool>(),
            percent in 0_u32..=100,
            latitude_deg in -90.0_f64..=90.0,
            longitude_deg in -180.0_f64..=180.0,
            altitude_m in -500.0_f64..9_000.0,
            ce90_m in 0.01_f64..5_000.0,
            le90_m in 0.1_f64..5_000.0,
            range_m in 0.1_f64..5_000.0,
            age_s in 0.0_f64..20_000.0,
        ) {
            let mut sent = alarm(number, revision);
            sent.place = place_from_degrees(
                latitude_deg,
                longitude_deg,
                emberfix_frames::EllipsoidHeight::from_m(altitude_m),
            ).unwrap();
            sent.properties.state = state;
            sent.properties.class = class(u32::from(smoke));
            sent.properties.confidence = f64::from(percent) / 100.0;
            sent.properties.altitude_msl_m = altitude_m;
            sent.properties.ce90_m = ce90_m;
            sent.properties.le90_m = le90_m;
            sent.properties.range_m = range_m;
            let now = sent.properties.captured_at + seconds(age_s);
            let got = decode(&over_the_wire(&encode(&sent, GROUND, now).unwrap())).unwrap();
            prop_assert_eq!((got.fire, got.revision), (FireId(number), revision));
            prop_assert_eq!((got.state, got.class), (state, sent.properties.class));
            prop_assert!((got.confidence - sent.properties.confidence).abs() < 1e-9);
            // Half of the wire's 1e-7 degrees; f32 for metres.
            prop_assert!((got.latitude_deg - latitude_deg).abs() <= 0.51e-7);
            prop_assert!((got.longitude_deg - sent.place.longitude_deg()).abs() <= 0.51e-7);
            prop_assert!((got.altitude.m() - altitude_m).abs() < 1e-3);
            prop_assert!((got.ce90_m / ce90_m - 1.0).abs() < 1e-6);
            // Codes round up by at most one step, never down.
            for (told, true_value) in [(got.le90_m, le90_m), (got.range_m, range_m)] {
                prop_assert!(told >= true_value * 0.999_999 && told <= true_value * CODE_STEP * 1.000_001);
            }
            prop_assert!(got.age_s >= age_s * 0.999_999 && got.age_s <= age_s.max(0.1) * 1.050_001);
        }

        #[test]
        fn a_receipt_names_its_revision(number in 1_u32..=GREATEST_NUMBER, revision in 1_u32..20_000) {
            let told = revision.min(GREATEST_REVISION);
            let read = SpatialReceipt::read(receipt(FireId(number), told));
            prop_assert_eq!(read.fire, FireId(number));
            prop_assert!(read.means(revision));
            prop_assert!(told % 128 == 0 || !read.means(told - 1));
        }
    }

    #[test]
    fn the_grounds_alarm_has_the_same_ce90_and_says_that_it_is_a_summary() {
        let sent = alarm(7, 2);
        let now = sent.properties.captured_at + seconds(3.0);
        let got = decode(&encode(&sent, GROUND, now).unwrap()).unwrap();
        let kept = got
            .into_alarm("uav-1", now, GeoidUndulation::from_m(10.0))
            .unwrap();
        assert_eq!(kept.properties.id, "uav-1-7");
        assert_eq!(
            kept.place.height().m() - kept.properties.altitude_msl_m,
            10.0
        );
        let ce90_m = kept.covariance().unwrap().ce90_m();
        assert!((ce90_m - sent.properties.ce90_m).abs() < 1e-4, "{ce90_m}");
        assert_eq!(kept.properties.degraded, [DEGRADED_SUMMARY]);
        let late_s = (sent.properties.captured_at - kept.properties.captured_at).as_secs_f64();
        assert!((0.0..0.16).contains(&late_s), "{late_s}");
        assert!(Alarm::from_geojson(kept.to_geojson().to_string().as_bytes()).is_ok());
    }

    #[test]
    fn what_is_no_alarm_is_refused() {
        let good = encode(&alarm(7, 2), GROUND, ServiceTime::from_unix_ns(0)).unwrap();
        let refused = |change: fn(&mut CommandInt)| {
            let mut bad = good;
            change(&mut bad);
            decode(&bad).unwrap_err().to_string()
        };
        assert!(refused(|o| o.command = 16).contains("no alarm"));
        assert!(refused(|o| o.frame = 3).contains("no alarm"));
        assert!(refused(|o| o.params[0] = 0.0).contains("fire number"));
        assert!(refused(|o| o.params[0] = f32::NAN).contains("fire number"));
        assert!(refused(|o| o.params[1] = -1.0).contains("param2"));
        assert!(refused(|o| o.params[1] = 7.0).contains("param2"));
        assert!(refused(|o| o.params[2] = f32::INFINITY).contains("param3"));
        assert!(refused(|o| o.params[3] = 3.4e38).contains("param4"));
    }

    #[test]
    fn an_id_without_a_number_cannot_be_told() {
        let mut nameless = alarm(7, 1);
        nameless.properties.id = "uav".to_owned();
        let refused = encode(&nameless, GROUND, ServiceTime::from_unix_ns(0));
        assert!(matches!(refused, Err(SpatialError::Id { .. })));
    }
}
