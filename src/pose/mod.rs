//! Where the vehicle was at a shutter time.
//!
//! **In:** attitude (50 Hz and up), global position (10 Hz and up), GNSS quality, TIMESYNC; all on
//! the autopilot's clock; a gimbal's attitude (5 Hz and up) on its own. **Out:** [`Pose`] at a moment
//! of the service clock, with the reasons why it is worse than it could be.
//!
//! With a gimbal, the pose is that of the platform that carries the rig: its place is the gimbal's
//! pivot, its attitude the platform's. Without one it is the airframe's.
//!
//! ```text
//! NeverSeen --first sample--> Fresh --no sample within the limit--> Stale --sample--> Fresh
//! ```
//!
//! **Assumptions.** One autopilot; a reboot (its clock runs backwards) starts a new epoch, and
//! nothing is interpolated across it. **Known limits.** Attitude and position errors that stay the
//! same from frame to frame are not in the pose: they are the estimator's shared errors.

mod gimbal;
mod heights;
mod history;

pub use gimbal::GimbalConfig;
pub use history::{Bracket, History};

use emberfix_frames::{
    Attitude, BootTime, EllipsoidHeight, GeoidUndulation, MslAltitude, ServiceTime, SignedDuration,
    SyncQuality, TimeSync, TimeSyncSample, Vector3, Wgs84, Wgs84Parts, ecef_from_enu,
    place_from_degrees,
};
use emberfix_frames::{Coordinate, Metres, VehicleEnu};
use emberfix_mav::ComponentId;
use emberfix_mav::telemetry::GimbalDeviceAttitude;
use gimbal::{Airframe, Gimbal, Platform};
use heights::{Heights, Separation};
use std::collections::BTreeSet;

/// Why a pose, and with it a position, is worse than it could be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Degraded {
    /// The clocks are related by arrival times only, or by few exchanges.
    ClockNotSynced,
    /// The GNSS receiver states no accuracy: the mission's default is used.
    GnssAccuracyUnknown,
    /// Ellipsoid height comes from EGM96, the receiver gives no own separation.
    GeoidApplied,
    /// Attitude samples are further apart than the limit for interpolation.
    AttitudeSlow,
    /// Position samples are further apart than the limit for interpolation.
    PositionSlow,
    /// The receiver's separation of geoid and ellipsoid is none: EGM96 is used.
    GeoidDisagrees,
    /// The autopilot's altitude jumped or drifted away from the receiver's: barometer alone?
    AltitudeDisagrees,
    /// The autopilot says that its vertical position is not valid.
    AltitudeNotEstimated,
    /// Gimbal samples are further apart than the limit for interpolation.
    GimbalSlow,
    /// The camera turned while its rows were exposed one after the other.
    RollingShutter,
    /// One eye only: no stereo.
    Mono,
}

impl Degraded {
    /// The reason as the alarm names it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::ClockNotSynced => "clock_not_synced",
            Self::GnssAccuracyUnknown => "gnss_accuracy_unknown",
            Self::GeoidApplied => "geoid_applied",
            Self::AttitudeSlow => "attitude_slow",
            Self::PositionSlow => "position_slow",
            Self::GeoidDisagrees => "geoid_disagrees",
            Self::AltitudeDisagrees => "altitude_disagrees",
            Self::AltitudeNotEstimated => "altitude_not_estimated",
            Self::GimbalSlow => "gimbal_slow",
            Self::RollingShutter => "rolling_shutter",
            Self::Mono => "mono",
        }
    }
}

/// Where the body origin was and how the airframe stood, at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Pose {
    /// The moment.
    pub at: ServiceTime,
    /// Place of the body origin (IMU).
    pub place: Wgs84,
    /// How the airframe stood.
    pub attitude: Attitude,
    /// East, north, up, m/s.
    pub velocity_enu_m_s: Vector3<f64>,
    /// About forward, right, down, rad/s.
    pub rate_rad_s: Vector3<f64>,
    /// GNSS error, slow, horizontal, one sigma per axis, metres.
    pub gnss_horizontal_m: f64,
    /// GNSS error, slow, vertical, one sigma, metres.
    pub gnss_vertical_m: f64,
    /// Error that is new in each frame (interpolation, age of samples), radians per axis.
    pub attitude_noise_rad: f64,
    /// Error that is new in each frame, metres per axis.
    pub position_noise_m: f64,
    /// Error of the clock relation, one sigma, seconds.
    pub time_sigma_s: f64,
    /// Why it is worse than it could be.
    pub degraded: BTreeSet<Degraded>,
}

/// What there is at a moment.
#[derive(Debug, Clone, PartialEq)]
pub enum PoseAnswer {
    /// Good to use.
    Fresh(Box<Pose>),
    /// Samples on both sides have not come yet; ask again when later telemetry is in.
    NotYet,
    /// Something that a pose needs has never come.
    NeverSeen {
        /// What is missing.
        what: &'static str,
    },
    /// Something has come, but too long before or after the moment.
    Stale {
        /// What is stale.
        what: &'static str,
        /// Time to the nearest sample.
        nearest: SignedDuration,
        /// What would have been accepted.
        limit: SignedDuration,
    },
    /// GNSS has no three-dimensional fix: any position would be false.
    NoGnssFix,
    /// Two sources contradict each other: one of them is false.
    Conflict {
        /// Which.
        what: &'static str,
        /// How far they are apart, degrees.
        apart_deg: f64,
        /// What would have been accepted, degrees.
        limit_deg: f64,
    },
    /// The camera turned too far while its rows were exposed.
    TooFast {
        /// By how much, degrees.
        turned_deg: f64,
        /// What would have been accepted, degrees.
        limit_deg: f64,
    },
}

/// Default errors and limits, from the mission.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseConfig {
    /// Horizontal GNSS sigma per axis when the receiver gives none, metres.
    pub gnss_horizontal_m: f64,
    /// Vertical GNSS sigma when the receiver gives none, metres.
    pub gnss_vertical_m: f64,
    /// The receiver's own accuracy is trusted down to this, metres.
    pub gnss_floor_m: f64,
    /// Furthest that a sample may be from the shutter.
    pub limit: SignedDuration,
    /// From the exposure of an image's first row to that of its last, seconds.
    pub rolling_readout_s: f64,
    /// The gimbal that carries the rig, if one does.
    pub gimbal: Option<GimbalConfig>,
}

impl Default for PoseConfig {
    fn default() -> Self {
        Self {
            gnss_horizontal_m: 1.5,
            gnss_vertical_m: 2.5,
            gnss_floor_m: 0.02,
            limit: SignedDuration::from_millis(500),
            rolling_readout_s: 0.0,
            gimbal: None,
        }
    }
}

/// Samples further apart than this are still used, and said to be slow.
const SLOW: SignedDuration = SignedDuration::from_millis(110);
/// GNSS quality older than this says nothing any more.
const GNSS_QUALITY_LIMIT: SignedDuration = SignedDuration::from_secs(3);
/// Vibration and interpolation, new in each frame, radians.
const ATTITUDE_NOISE_RAD: f64 = 0.002;
/// Turn acceleration that interpolation between samples can't see, rad/s².
const TURN_ACCELERATION_RAD_S2: f64 = 3.0;
/// Acceleration that interpolation between samples can't see, m/s².
const ACCELERATION_M_S2: f64 = 2.0;
/// A turn within one readout beyond this is named, and beyond that gives no pose, radians.
const ROLLING_NAMED_RAD: f64 = 0.005;
const ROLLING_REFUSED_RAD: f64 = 0.052;
/// Error of the geoid model where the receiver does not say its own separation, metres: half a metre to
/// a metre over most of the Earth (Lemoine et al., NASA/TP-1998-206861, 1998).
const EGM96_SIGMA_M: f64 = 1.0;
/// Vertical sigma of an altitude that the autopilot itself calls not valid, metres.
const NOT_ESTIMATED_M: f64 = 10.0;
/// An altitude older than this is not held against the receiver's.
const ALTITUDE_LIMIT: SignedDuration = SignedDuration::from_secs(1);
/// Quantisation of MAVLink positions and short noise of the estimator, metres.
const POSITION_NOISE_M: f64 = 0.05;

#[derive(Debug, Clone, Copy)]
struct AttitudeSample {
    attitude: Attitude,
    rate_rad_s: Vector3<f64>,
}

#[derive(Debug, Clone, Copy)]
struct PositionSample {
    latitude_deg: f64,
    longitude_deg: f64,
    altitude: MslAltitude,
    velocity_enu_m_s: Vector3<f64>,
}

#[derive(Debug, Clone, Copy)]
struct GnssQuality {
    at: ServiceTime,
    has_fix: bool,
    horizontal_m: Option<f64>,
    vertical_m: Option<f64>,
}

/// Collects telemetry and answers where the vehicle was.
#[derive(Debug)]
pub struct PoseEstimator {
    config: PoseConfig,
    sync: TimeSync,
    attitudes: History<AttitudeSample>,
    positions: History<PositionSample>,
    gnss: Option<GnssQuality>,
    /// What the receiver last said of its own accuracy, horizontal and vertical, metres.
    stated_m: (Option<f64>, Option<f64>),
    heights: Heights,
    latest_altitude: Option<(ServiceTime, MslAltitude)>,
    gimbal: Option<Gimbal>,
}

impl PoseEstimator {
    /// Nothing known yet.
    #[must_use]
    pub fn new(config: PoseConfig) -> Self {
        Self {
            config,
            sync: TimeSync::new(),
            attitudes: History::new(),
            positions: History::new(),
            gnss: None,
            stated_m: (None, None),
            heights: Heights::default(),
            latest_altitude: None,
            gimbal: config.gimbal.map(Gimbal::new),
        }
    }

    /// Takes an attitude sample in.
    pub fn add_attitude(
        &mut self,
        boot: BootTime,
        arrived: ServiceTime,
        attitude: Attitude,
        rate_rad_s: Vector3<f64>,
    ) {
        self.note_boot(boot, arrived);
        self.attitudes.push(
            boot,
            AttitudeSample {
                attitude,
                rate_rad_s,
            },
        );
    }

    /// Takes a global position sample in; velocity is north, east, down in m/s.
    pub fn add_position(
        &mut self,
        boot: BootTime,
        arrived: ServiceTime,
        (latitude_deg, longitude_deg): (f64, f64),
        altitude: MslAltitude,
        velocity_ned_m_s: Vector3<f64>,
    ) {
        self.note_boot(boot, arrived);
        self.latest_altitude = Some((arrived, altitude));
        let v = velocity_ned_m_s;
        let velocity_enu_m_s = Vector3::new(v.y, v.x, -v.z);
        self.positions.push(
            boot,
            PositionSample {
                latitude_deg,
                longitude_deg,
                altitude,
                velocity_enu_m_s,
            },
        );
    }

    /// Takes the receiver's word on its own quality in. The separation (ellipsoid height minus
    /// MSL altitude) is the receiver's own geoid and is kept, slowly filtered.
    pub fn add_gnss(
        &mut self,
        arrived: ServiceTime,
        has_3d_fix: bool,
        sigmas_m: (Option<f64>, Option<f64>),
        separation: Option<GeoidUndulation>,
    ) {
        let (horizontal_m, vertical_m) = sigmas_m;
        self.stated_m = (
            horizontal_m.or(self.stated_m.0),
            vertical_m.or(self.stated_m.1),
        );
        self.gnss = Some(GnssQuality {
            at: arrived,
            has_fix: has_3d_fix,
            horizontal_m,
            vertical_m,
        });
        if let Some(separation) = separation.filter(|_| has_3d_fix) {
            self.heights.note_separation(separation);
        }
    }

    /// Takes the receiver's altitude in, to hold the autopilot's against it.
    pub fn add_gnss_altitude(&mut self, arrived: ServiceTime, altitude: MslAltitude) {
        if let Some((at, own)) = self.latest_altitude
            && arrived - at <= ALTITUDE_LIMIT
        {
            self.heights.note_altitudes(own.m(), altitude.m());
        }
    }

    /// Takes the separation that a second receiver gives in; it counts while the first gives none.
    pub fn add_second_separation(&mut self, separation: GeoidUndulation) {
        self.heights.note_second_separation(separation);
    }

    /// Takes in whether the autopilot's estimator calls its vertical position valid.
    pub fn add_vertical_validity(&mut self, valid: bool) {
        self.heights.note_estimated(valid);
    }

    /// Takes a gimbal's report in; false when no gimbal carries the rig, when it is another one's,
    /// or when the gimbal itself reports a fault.
    pub fn add_gimbal(
        &mut self,
        sender: ComponentId,
        arrived: ServiceTime,
        said: &GimbalDeviceAttitude,
    ) -> bool {
        self.gimbal
            .as_mut()
            .is_some_and(|gimbal| gimbal.add(sender, arrived, said))
    }

    /// Takes one TIMESYNC exchange in.
    pub fn add_timesync(&mut self, sample: TimeSyncSample) -> bool {
        self.sync.add(sample)
    }

    /// The relation of the clocks.
    #[must_use]
    pub fn sync(&self) -> &TimeSync {
        &self.sync
    }

    /// Geoid undulation at a place: the receiver's own if it gives one, EGM96 otherwise.
    pub fn undulation(&self, place: &Wgs84) -> GeoidUndulation {
        self.heights.undulation(place).0
    }

    /// The pose at a moment of the autopilot's clock, given as service time. `now` is the latest
    /// arrival; it decides whether to wait for a sample on the far side.
    pub fn at(&self, moment: ServiceTime, now: ServiceTime) -> PoseAnswer {
        let Some(boot) = self.sync.to_boot(moment) else {
            return PoseAnswer::NeverSeen {
                what: "autopilot clock",
            };
        };
        let waiting = now - moment < WAIT;
        let attitude = match bracket(
            &self.attitudes,
            boot,
            "attitude",
            self.config.limit,
            waiting,
        ) {
            Ok(bracket) => bracket,
            Err(answer) => return answer,
        };
        let position = match bracket(
            &self.positions,
            boot,
            "position",
            self.config.limit,
            waiting,
        ) {
            Ok(bracket) => bracket,
            Err(answer) => return answer,
        };
        let Some(gnss) = self.gnss else {
            return PoseAnswer::NeverSeen {
                what: "GNSS quality",
            };
        };
        if now - gnss.at > GNSS_QUALITY_LIMIT {
            let (nearest, limit) = (now - gnss.at, GNSS_QUALITY_LIMIT);
            return PoseAnswer::Stale {
                what: "GNSS quality",
                nearest,
                limit,
            };
        }
        if !gnss.has_fix {
            return PoseAnswer::NoGnssFix;
        }
        let airframe = airframe(&attitude);
        let platform = match &self.gimbal {
            None => None,
            Some(gimbal) => {
                match gimbal.at(moment, boot, &airframe, (self.config.limit, waiting)) {
                    Ok(platform) => Some(platform),
                    Err(answer) => return answer,
                }
            }
        };
        let Some(mut pose) = self.assemble(moment, &airframe, &attitude, &position) else {
            return PoseAnswer::NeverSeen {
                what: "a position on the Earth",
            };
        };
        self.judge_gnss(&mut pose, gnss);
        if let (Some(platform), Some(gimbal)) = (platform, &self.gimbal) {
            on_platform(&mut pose, &platform, gimbal);
        }
        through_shutter(pose, self.config.rolling_readout_s)
    }

    /// The airframe's pose; what is known of its errors by now.
    fn assemble(
        &self,
        moment: ServiceTime,
        airframe: &Airframe,
        attitude: &Bracket<AttitudeSample>,
        position: &Bracket<PositionSample>,
    ) -> Option<Pose> {
        let mut degraded = BTreeSet::new();
        if self.sync.quality() != SyncQuality::Converged {
            degraded.insert(Degraded::ClockNotSynced);
        }
        if attitude.gap() > SLOW {
            degraded.insert(Degraded::AttitudeSlow);
        }
        if position.gap() > SLOW {
            degraded.insert(Degraded::PositionSlow);
        }
        Some(Pose {
            at: moment,
            place: self.place(position)?,
            attitude: airframe.attitude,
            velocity_enu_m_s: between(position, |sample| sample.velocity_enu_m_s),
            rate_rad_s: airframe.rate_rad_s,
            gnss_horizontal_m: self.config.gnss_horizontal_m,
            gnss_vertical_m: self.config.gnss_vertical_m,
            attitude_noise_rad: ATTITUDE_NOISE_RAD
                .hypot(unseen(TURN_ACCELERATION_RAD_S2, attitude.span_s())),
            position_noise_m: POSITION_NOISE_M.hypot(unseen(ACCELERATION_M_S2, position.span_s())),
            time_sigma_s: self.sync.sigma_s().unwrap_or(0.0),
            degraded,
        })
    }

    /// GNSS's own accuracy, and what its heights disagree by. Nothing here makes an error smaller
    /// than the receiver says it is.
    fn judge_gnss(&self, pose: &mut Pose, gnss: GnssQuality) {
        let floor = self.config.gnss_floor_m;
        // A receiver that falls silent is no better than it last said.
        let unsaid = |usual_m: f64, last: Option<f64>| usual_m.max(last.unwrap_or(0.0));
        pose.gnss_horizontal_m = gnss
            .horizontal_m
            .unwrap_or(unsaid(pose.gnss_horizontal_m, self.stated_m.0));
        pose.gnss_vertical_m = gnss
            .vertical_m
            .unwrap_or(unsaid(pose.gnss_vertical_m, self.stated_m.1));
        if gnss.horizontal_m.is_none() || gnss.vertical_m.is_none() {
            pose.degraded.insert(Degraded::GnssAccuracyUnknown);
        }
        pose.gnss_horizontal_m = pose.gnss_horizontal_m.max(floor);
        let mut stated = pose.gnss_vertical_m.max(floor);
        let mut doubts = vec![self.heights.watch().disagreement_m()];
        if self.heights.watch().is_doubtful(stated) {
            pose.degraded.insert(Degraded::AltitudeDisagrees);
        }
        if !self.heights.is_estimated() {
            pose.degraded.insert(Degraded::AltitudeNotEstimated);
            doubts.push(NOT_ESTIMATED_M);
        }
        match self.heights.undulation(&pose.place).1 {
            Separation::Receiver => {}
            Separation::Model => {
                pose.degraded.insert(Degraded::GeoidApplied);
                stated = stated.hypot(EGM96_SIGMA_M);
            }
            Separation::ModelAgainstReceiver { by_m } => {
                pose.degraded.insert(Degraded::GeoidDisagrees);
                doubts.push(by_m.abs());
            }
        }
        pose.gnss_vertical_m = doubts.into_iter().fold(stated, f64::max);
    }

    /// Cubic Hermite between two samples (their velocities count), straight on after the last.
    fn place(&self, position: &Bracket<PositionSample>) -> Option<Wgs84> {
        let first = self.sample_place(&position.earlier.1)?;
        let v0 = position.earlier.1.velocity_enu_m_s;
        let offset = match &position.later {
            None => v0 * position.age_s(),
            Some((_, later)) => {
                let second = self.sample_place(later)?;
                let step = emberfix_frames::enu_offset(&first, &second);
                let h = position.span_s();
                hermite(step, v0 * h, later.velocity_enu_m_s * h, position.share())
            }
        };
        let point = Coordinate::<VehicleEnu>::from_metres(offset);
        emberfix_frames::place_from_ecef(&ecef_from_enu(&first).transform(point))
    }

    fn sample_place(&self, sample: &PositionSample) -> Option<Wgs84> {
        let flat = place_from_degrees(
            sample.latitude_deg,
            sample.longitude_deg,
            EllipsoidHeight::from_m(0.0),
        )
        .ok()?;
        let height = sample.altitude + self.undulation(&flat);
        Some(flat.at_height(height))
    }

    fn note_boot(&mut self, boot: BootTime, arrived: ServiceTime) {
        self.sync.add_arrival(boot, arrived);
        let rebooted = self
            .attitudes
            .latest()
            .is_some_and(|last| boot < last - REBOOT);
        if rebooted {
            self.attitudes.clear();
            self.positions.clear();
        }
    }
}

/// A boot clock that falls back by this much is a reboot, not a late message.
const REBOOT: SignedDuration = SignedDuration::from_secs(1);
/// Time that telemetry may take to reach us after the shutter before we go on without it.
const WAIT: SignedDuration = SignedDuration::from_millis(250);

fn bracket<T: Copy>(
    history: &History<T>,
    boot: BootTime,
    what: &'static str,
    limit: SignedDuration,
    waiting: bool,
) -> Result<Bracket<T>, PoseAnswer> {
    let Some(found) = history.bracket(boot) else {
        let Some(nearest) = history.nearest_distance(boot) else {
            return Err(PoseAnswer::NeverSeen { what });
        };
        return Err(PoseAnswer::Stale {
            what,
            nearest,
            limit,
        });
    };
    if found.later.is_none() && waiting {
        return Err(PoseAnswer::NotYet);
    }
    if found.distance() > limit {
        return Err(PoseAnswer::Stale {
            what,
            nearest: found.distance(),
            limit,
        });
    }
    Ok(found)
}

/// The airframe at the moment of a bracket: slerp between two samples, turned on after the last.
fn airframe(attitude: &Bracket<AttitudeSample>) -> Airframe {
    let earlier = attitude.earlier.1;
    Airframe {
        attitude: match attitude.later {
            Some((_, later)) => earlier.attitude.slerp(&later.attitude, attitude.share()),
            None => earlier
                .attitude
                .rotated(earlier.rate_rad_s, attitude.age_s()),
        },
        rate_rad_s: between(attitude, |sample| sample.rate_rad_s),
    }
}

/// A vector at the moment of a bracket: straight between two samples, the last one after it.
fn between<T: Copy>(found: &Bracket<T>, of: impl Fn(&T) -> Vector3<f64>) -> Vector3<f64> {
    let earlier = of(&found.earlier.1);
    found.later.map_or(earlier, |(_, later)| {
        earlier.lerp(&of(&later), found.share())
    })
}

/// From the airframe to the gimbal's pivot and the platform on it.
fn on_platform(pose: &mut Pose, platform: &Platform, gimbal: &Gimbal) {
    let pivot = pose
        .attitude
        .enu_from_body()
        .transform(emberfix_frames::Vector::from_metres(gimbal.pivot_m()));
    let offset = Coordinate::<VehicleEnu>::from_metres(pivot.metres());
    let moved = ecef_from_enu(&pose.place).transform(offset);
    if let Some(place) = emberfix_frames::place_from_ecef(&moved) {
        pose.place = place;
    }
    pose.attitude = platform.attitude;
    pose.rate_rad_s = platform.rate_rad_s;
    pose.attitude_noise_rad = pose.attitude_noise_rad.hypot(platform.noise_rad);
    pose.time_sigma_s = pose.time_sigma_s.hypot(gimbal.time_sigma_s());
    if platform.gap > SLOW {
        pose.degraded.insert(Degraded::GimbalSlow);
    }
}

/// A row that is exposed before or after mid-exposure sees the world from another pose: any row's
/// bearing is off by its share of what the camera turned and moved meanwhile (one sigma of a uniform
/// spread).
fn through_shutter(mut pose: Pose, readout_s: f64) -> PoseAnswer {
    let turned_rad = pose.rate_rad_s.norm() * readout_s;
    if turned_rad > ROLLING_REFUSED_RAD {
        return PoseAnswer::TooFast {
            turned_deg: turned_rad.to_degrees(),
            limit_deg: ROLLING_REFUSED_RAD.to_degrees(),
        };
    }
    if turned_rad > ROLLING_NAMED_RAD {
        pose.degraded.insert(Degraded::RollingShutter);
    }
    let share = 12_f64.sqrt().recip();
    let moved_m = pose.velocity_enu_m_s.norm() * readout_s;
    pose.attitude_noise_rad = pose.attitude_noise_rad.hypot(turned_rad * share);
    pose.position_noise_m = pose.position_noise_m.hypot(moved_m * share);
    PoseAnswer::Fresh(Box::new(pose))
}

/// One sigma of what a constant unseen acceleration does in the middle of a gap: `a h² / 8`.
fn unseen(acceleration: f64, span_s: f64) -> f64 {
    acceleration * span_s * span_s / 8.0
}

/// Cubic Hermite from the origin to `step` with end tangents `m0`, `m1` (per unit share).
fn hermite(step: Vector3<f64>, m0: Vector3<f64>, m1: Vector3<f64>, s: f64) -> Vector3<f64> {
    let (s2, s3) = (s * s, s * s * s);
    m0 * (s3 - 2.0 * s2 + s) + step * (3.0 * s2 - 2.0 * s3) + m1 * (s3 - s2)
}

#[cfg(test)]
mod tests;
