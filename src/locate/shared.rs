//! The errors that all sightings share: what they are, how large, how they change.

use crate::pose::Pose;
use emberfix_calib::Rig;
use nalgebra::SVector;

/// Number of shared errors at one moment.
pub const SHARED: usize = 27;
/// Of these, how many are constant in a flight; they stand first.
pub const CONSTANT: usize = 12;
/// How many wander; they stand after the constant ones. The rest is new in each frame.
pub const WANDERING: usize = 9;

/// Index of the first of each kind of shared error, in the shared error vector.
///
/// Signs: the value is what must be ADDED to the truth to get what was reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(usize)]
pub enum Shared {
    /// GNSS offset that stays for the flight: east, north, up, metres.
    GnssConstant = 0,
    /// Heading offset that stays for the flight, radians clockwise.
    HeadingConstant = 3,
    /// Rotation of the camera against the attitude reference about the body's forward, right and
    /// down axes, radians: boresight, and the tilt error that stays for the flight.
    Boresight = 4,
    /// Disparity offset, pixels.
    Disparity = 7,
    /// The reported pose is that of this much later than the exposure, seconds.
    Clock = 8,
    /// Lever arm: forward, right, down, metres.
    LeverArm = 9,
    /// GNSS offset that wanders: east, north, up, metres.
    Gnss = 12,
    /// Heading error that wanders, radians clockwise.
    Heading = 15,
    /// Tilt error that wanders, about the body's forward and right axes, radians.
    Tilt = 16,
    /// GNSS error that is new in each report: east, north, up, metres. It wanders in no time at all, and
    /// stands among what wanders since a velocity tells the two apart.
    GnssNoise = 18,
    /// Attitude error that is new in each frame, about the body's axes, radians.
    AttitudeJitter = 21,
    /// Position error that is new in each frame and that no report had: east, north, up, metres.
    PositionJitter = 24,
}

/// What is known beforehand of the shared errors, beside what the rig and the receiver say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SharedPriors {
    /// Share of the GNSS error's variance that stays for the flight, 0..1.
    pub gnss_constant_share: f64,
    /// Seconds after which the rest of it has become another one.
    pub gnss_correlation_s: f64,
    /// Reported velocity, one sigma per axis, m/s.
    pub velocity_m_s: f64,
    /// Seconds after which its error has become another one.
    pub velocity_correlation_s: f64,
    /// Heading of the autopilot, one sigma, radians.
    pub heading_rad: f64,
    /// Share of its variance that stays for the flight, 0..1.
    pub heading_constant_share: f64,
    /// Seconds after which the rest of it has become another one.
    pub heading_correlation_s: f64,
    /// Tilt of the autopilot, one sigma per axis, radians.
    pub tilt_rad: f64,
    /// Share of its variance that stays for the flight, 0..1.
    pub tilt_constant_share: f64,
    /// Seconds after which the rest of it has become another one.
    pub tilt_correlation_s: f64,
}

impl Default for SharedPriors {
    /// A consumer receiver and compass. What is said of the velocity is an assumption; the one real flight it
    /// was held against (`tests/telemetry_logs.rs`) parts from its velocities as fast, to a third.
    fn default() -> Self {
        Self {
            gnss_constant_share: 0.5,
            gnss_correlation_s: 100.0,
            velocity_m_s: 0.1,
            velocity_correlation_s: 1.0,
            heading_rad: 2_f64.to_radians(),
            heading_constant_share: 0.75,
            heading_correlation_s: 100.0,
            tilt_rad: 0.5_f64.to_radians(),
            tilt_constant_share: 0.5,
            tilt_correlation_s: 100.0,
        }
    }
}

impl SharedPriors {
    /// Prior sigmas in the order of [`Shared`], for one pose and rig.
    #[must_use]
    pub fn sigmas(&self, pose: &Pose, rig: &Rig) -> SVector<f64, SHARED> {
        let rig = rig.sigmas();
        let (gnss_stays, gnss_wanders) = parts(self.gnss_constant_share);
        let (heading_stays, heading_wanders) = parts(self.heading_constant_share);
        let (tilt_stays, tilt_wanders) = parts(self.tilt_constant_share);
        let gnss = [
            pose.gnss_horizontal_m,
            pose.gnss_horizontal_m,
            pose.gnss_vertical_m,
        ];
        let tilt = rig.boresight_rad.hypot(self.tilt_rad * tilt_stays);
        let mut sigmas = SVector::zeros();
        let mut set = |from: Shared, values: &[f64]| {
            for (index, value) in values.iter().enumerate() {
                sigmas[from as usize + index] = *value;
            }
        };
        set(Shared::GnssConstant, &gnss.map(|sigma| sigma * gnss_stays));
        set(Shared::HeadingConstant, &[self.heading_rad * heading_stays]);
        set(Shared::Boresight, &[tilt, tilt, rig.boresight_rad]);
        set(Shared::Disparity, &[rig.disparity_bias_px]);
        set(Shared::Clock, &[pose.time_sigma_s.hypot(rig.time_offset_s)]);
        set(Shared::LeverArm, &[rig.lever_arm_m; 3]);
        set(Shared::Gnss, &gnss.map(|sigma| sigma * gnss_wanders));
        set(Shared::Heading, &[self.heading_rad * heading_wanders]);
        set(Shared::Tilt, &[self.tilt_rad * tilt_wanders; 2]);
        set(Shared::AttitudeJitter, &[pose.attitude_noise_rad; 3]);
        set(Shared::GnssNoise, &[pose.position_noise_m; 3]);
        sigmas
    }

    /// Correlation times of the [`WANDERING`] errors, in their order, seconds.
    #[must_use]
    pub fn correlations_s(&self) -> [f64; WANDERING] {
        let (gnss, tilt) = (self.gnss_correlation_s, self.tilt_correlation_s);
        let heading = self.heading_correlation_s;
        [gnss, gnss, gnss, heading, tilt, tilt, 0.0, 0.0, 0.0]
    }

    /// How fast a way that is summed up from velocities strays, m² per second and axis: twice the
    /// integral of the velocity's autocovariance.
    #[must_use]
    pub fn way_variance_m2_per_s(&self) -> f64 {
        2.0 * self.velocity_m_s.powi(2) * self.velocity_correlation_s
    }
}

/// Sigmas of the two parts of an error whose whole sigma is 1.
fn parts(constant_share: f64) -> (f64, f64) {
    let share = constant_share.clamp(0.0, 1.0);
    (share.sqrt(), (1.0 - share).sqrt())
}
