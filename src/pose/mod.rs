//! Where the vehicle was at a shutter time.
//!
//! **In:** attitude (50 Hz and up), global position (10 Hz and up), GNSS quality, TIMESYNC; all on
//! the autopilot's clock. **Out:** [`Pose`] at a moment of the service clock, with the reasons why
//! it is worse than it could be.
//!
//! ```text
//! NeverSeen --first sample--> Fresh --no sample within the limit--> Stale --sample--> Fresh
//! ```
//!
//! **Assumptions.** One autopilot; a reboot (its clock runs backwards) starts a new epoch, and
//! nothing is interpolated across it. **Known limits.** Attitude and position errors that stay the
//! same from frame to frame are not in the pose: they are the estimator's shared errors.

mod history;

pub use history::{Bracket, History};

use emberfix_frames::{
    Attitude, BootTime, EllipsoidHeight, Geoid, GeoidUndulation, MslAltitude, ServiceTime,
    SignedDuration, SyncQuality, TimeSync, TimeSyncSample, Vector3, Wgs84, Wgs84Parts,
    ecef_from_enu, place_from_degrees,
};
use emberfix_frames::{Coordinate, Metres, VehicleEnu};
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
}

impl Default for PoseConfig {
    fn default() -> Self {
        Self {
            gnss_horizontal_m: 1.5,
            gnss_vertical_m: 2.5,
            gnss_floor_m: 0.02,
            limit: SignedDuration::from_millis(500),
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
    separation: Option<f64>,
    geoid: Geoid,
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
            separation: None,
            geoid: Geoid::new(),
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
        self.gnss = Some(GnssQuality {
            at: arrived,
            has_fix: has_3d_fix,
            horizontal_m,
            vertical_m,
        });
        if let Some(n) = separation.filter(|_| has_3d_fix) {
            let old = self.separation.unwrap_or(n.m());
            self.separation = Some(old + SEPARATION_GAIN * (n.m() - old));
        }
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
        match self.separation {
            Some(separation) => GeoidUndulation::from_m(separation),
            None => self
                .geoid
                .undulation(place.latitude_deg(), place.longitude_deg()),
        }
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
        self.assemble(moment, &attitude, &position, gnss)
    }

    fn assemble(
        &self,
        moment: ServiceTime,
        attitude: &Bracket<AttitudeSample>,
        position: &Bracket<PositionSample>,
        gnss: GnssQuality,
    ) -> PoseAnswer {
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
        if self.separation.is_none() {
            degraded.insert(Degraded::GeoidApplied);
        }
        if gnss.horizontal_m.is_none() || gnss.vertical_m.is_none() {
            degraded.insert(Degraded::GnssAccuracyUnknown);
        }
        let Some(place) = self.place(position) else {
            return PoseAnswer::NeverSeen {
                what: "a position on the Earth",
            };
        };
        let (near, share) = (attitude.nearest(), attitude.share());
        let turned = match attitude.later {
            Some((_, later)) => attitude.earlier.1.attitude.slerp(&later.attitude, share),
            None => attitude
                .earlier
                .1
                .attitude
                .rotated(near.rate_rad_s, attitude.age_s()),
        };
        let sigma =
            |own: Option<f64>, default: f64| own.unwrap_or(default).max(self.config.gnss_floor_m);
        PoseAnswer::Fresh(Box::new(Pose {
            at: moment,
            place,
            attitude: turned,
            velocity_enu_m_s: position.nearest().velocity_enu_m_s,
            rate_rad_s: near.rate_rad_s,
            gnss_horizontal_m: sigma(gnss.horizontal_m, self.config.gnss_horizontal_m),
            gnss_vertical_m: sigma(gnss.vertical_m, self.config.gnss_vertical_m),
            attitude_noise_rad: ATTITUDE_NOISE_RAD
                .hypot(unseen(TURN_ACCELERATION_RAD_S2, attitude.span_s())),
            position_noise_m: POSITION_NOISE_M.hypot(unseen(ACCELERATION_M_S2, position.span_s())),
            time_sigma_s: self.sync.sigma_s().unwrap_or(0.0),
            degraded,
        }))
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

/// Poses at any moment, for whoever learns that the camera's clock is off.
pub trait PoseAt {
    /// The pose at a moment of the service clock from what is known by now; `None` where there is
    /// no honest one.
    fn pose_at(&self, moment: ServiceTime) -> Option<Pose>;
}

impl PoseAt for PoseEstimator {
    fn pose_at(&self, moment: ServiceTime) -> Option<Pose> {
        match self.at(moment, moment + WAIT) {
            PoseAnswer::Fresh(pose) => Some(*pose),
            _ => None,
        }
    }
}

impl<F: Fn(ServiceTime) -> Option<Pose>> PoseAt for F {
    fn pose_at(&self, moment: ServiceTime) -> Option<Pose> {
        self(moment)
    }
}

/// A boot clock that falls back by this much is a reboot, not a late message.
const REBOOT: SignedDuration = SignedDuration::from_secs(1);
/// Share of a new separation that is taken over: 5 Hz GNSS settles in 4 s.
const SEPARATION_GAIN: f64 = 0.05;
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
