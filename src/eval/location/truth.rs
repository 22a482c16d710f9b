//! The world without pictures: a true camera on a true airframe, errors that wander, and what the
//! service is told of all that.
//!
//! Projection and rotations are written out here, apart from `locate` and `frames`: an error in one
//! of the two shows as a position error. The fire's place is near the origin of an east-north-up
//! plane; the plane's datum and the way to the Earth are the simulator's.

use super::flight::{Course, normal3};
use super::law::{Draw, Law, Sines};
use crate::assess::patch::Patch;
use emberfix_sim::noise::normal;
use emberfix_sim::state::BodyState;
use nalgebra::{Matrix3, Rotation3, SVector, Vector3};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Number of errors that stay from look to look.
pub const SLOW: usize = 17;

/// Errors that stay from look to look: what must be added to the truth to get what is reported.
/// Order: GNSS east, north, up (m); heading (rad, clockwise); tilt about the nose and about the
/// right wing (rad); boresight about the three body axes (rad); disparity (px); camera clock late
/// (s); lever arm along the three body axes (m); velocity east, north, up (m/s).
pub type Slow = SVector<f64, SLOW>;

/// First index of each group in [`Slow`].
pub mod slow {
    /// GNSS east.
    pub const GNSS: usize = 0;
    /// Heading.
    pub const HEADING: usize = 3;
    /// Tilt about the nose.
    pub const TILT: usize = 4;
    /// Boresight about the nose.
    pub const BORESIGHT: usize = 6;
    /// Disparity.
    pub const DISPARITY: usize = 9;
    /// Clock.
    pub const CLOCK: usize = 10;
    /// Lever arm ahead.
    pub const LEVER: usize = 11;
    /// Velocity east.
    pub const VELOCITY: usize = 14;
}

/// How large errors are and how fast they wander: what the service is told in its rig and mission,
/// and, under [`Law::Assumed`], what is true.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorModel {
    /// Horizontal GNSS sigma per axis, metres.
    pub gnss_horizontal_m: f64,
    /// Vertical GNSS sigma, metres.
    pub gnss_vertical_m: f64,
    /// Share of the GNSS variance that is constant in a flight.
    pub gnss_constant_share: f64,
    /// Correlation time of the rest, seconds.
    pub gnss_correlation_s: f64,
    /// Velocity sigma per axis, m/s.
    pub velocity_m_s: f64,
    /// Correlation time of all of it, seconds.
    pub velocity_correlation_s: f64,
    /// Heading sigma, degrees.
    pub heading_deg: f64,
    /// Share of the heading variance that is constant in a flight.
    pub heading_constant_share: f64,
    /// Correlation time of the rest, seconds.
    pub heading_correlation_s: f64,
    /// Tilt sigma per axis, degrees.
    pub tilt_deg: f64,
    /// Share of the tilt variance that is constant in a flight.
    pub tilt_constant_share: f64,
    /// Correlation time of the rest, seconds.
    pub tilt_correlation_s: f64,
    /// Boresight sigma per axis, constant, degrees.
    pub boresight_deg: f64,
    /// Disparity offset sigma, constant, pixels.
    pub disparity_bias_px: f64,
    /// Clock offset sigma, constant, seconds.
    pub clock_s: f64,
    /// Lever arm sigma per axis, constant, metres.
    pub lever_arm_m: f64,
    /// New in each look: box edge, pixels per axis.
    pub pixel_px: f64,
    /// New in each look: disparity, pixels.
    pub disparity_px: f64,
    /// New in each look: attitude, radians per axis.
    pub attitude_noise_rad: f64,
    /// New in each look: position, metres per axis.
    pub position_noise_m: f64,
}

impl ErrorModel {
    /// A consumer receiver, or RTK, with heading of a given quality.
    #[must_use]
    pub fn of(gnss: Gnss, heading_deg: f64) -> Self {
        let (gnss_horizontal_m, gnss_vertical_m) = gnss.sigmas_m();
        Self {
            gnss_horizontal_m,
            gnss_vertical_m,
            gnss_constant_share: 0.5,
            gnss_correlation_s: 60.0,
            velocity_m_s: 0.05,
            velocity_correlation_s: 1.0,
            heading_deg,
            heading_constant_share: 0.7,
            heading_correlation_s: 60.0,
            tilt_deg: 0.5,
            tilt_constant_share: 0.5,
            tilt_correlation_s: 30.0,
            boresight_deg: 0.3,
            disparity_bias_px: 0.1,
            clock_s: 0.005,
            lever_arm_m: 0.02,
            pixel_px: 2.0,
            disparity_px: 0.25,
            attitude_noise_rad: 0.002,
            position_noise_m: gnss.position_noise_m(),
        }
    }

    /// The same with every sigma times `scale`; times and shares stay.
    #[must_use]
    pub fn scaled(self, scale: f64) -> Self {
        Self {
            gnss_horizontal_m: scale * self.gnss_horizontal_m,
            gnss_vertical_m: scale * self.gnss_vertical_m,
            velocity_m_s: scale * self.velocity_m_s,
            heading_deg: scale * self.heading_deg,
            tilt_deg: scale * self.tilt_deg,
            boresight_deg: scale * self.boresight_deg,
            disparity_bias_px: scale * self.disparity_bias_px,
            clock_s: scale * self.clock_s,
            lever_arm_m: scale * self.lever_arm_m,
            pixel_px: scale * self.pixel_px,
            disparity_px: scale * self.disparity_px,
            attitude_noise_rad: scale * self.attitude_noise_rad,
            position_noise_m: scale * self.position_noise_m,
            ..self
        }
    }

    /// Sigmas in the order of [`Slow`].
    #[must_use]
    pub fn sigmas(&self) -> Slow {
        let (tilt, boresight) = (self.tilt_deg.to_radians(), self.boresight_deg.to_radians());
        Slow::from([
            self.gnss_horizontal_m,
            self.gnss_horizontal_m,
            self.gnss_vertical_m,
            self.heading_deg.to_radians(),
            tilt,
            tilt,
            boresight,
            boresight,
            boresight,
            self.disparity_bias_px,
            self.clock_s,
            self.lever_arm_m,
            self.lever_arm_m,
            self.lever_arm_m,
            self.velocity_m_s,
            self.velocity_m_s,
            self.velocity_m_s,
        ])
    }

    /// Shares of the variances that are constant in a flight, in the order of [`Slow`].
    #[must_use]
    pub fn constant_shares(&self) -> Slow {
        self.wanderers(
            1.0,
            [
                self.gnss_constant_share,
                self.heading_constant_share,
                self.tilt_constant_share,
                0.0,
            ],
        )
    }

    /// Correlation times of what is not constant, in the order of [`Slow`], seconds.
    #[must_use]
    pub fn correlations_s(&self) -> Slow {
        self.wanderers(
            1.0,
            [
                self.gnss_correlation_s,
                self.heading_correlation_s,
                self.tilt_correlation_s,
                self.velocity_correlation_s,
            ],
        )
    }

    fn wanderers(&self, others: f64, [gnss, heading, tilt, velocity]: [f64; 4]) -> Slow {
        let mut values = Slow::repeat(others);
        values.rows_mut(slow::GNSS, 3).fill(gnss);
        values[slow::HEADING] = heading;
        values.rows_mut(slow::TILT, 2).fill(tilt);
        values.rows_mut(slow::VELOCITY, 3).fill(velocity);
        values
    }
}

/// Class of the receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Gnss {
    /// 1.5 m horizontally, 2.5 m vertically.
    Consumer,
    /// 2 cm horizontally, 3 cm vertically.
    Rtk,
}

impl Gnss {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Consumer, Self::Rtk];

    /// As figures name it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Consumer => "consumer",
            Self::Rtk => "rtk",
        }
    }

    const fn sigmas_m(self) -> (f64, f64) {
        match self {
            Self::Consumer => (1.5, 2.5),
            Self::Rtk => (0.02, 0.03),
        }
    }

    const fn position_noise_m(self) -> f64 {
        match self {
            Self::Consumer => 0.05,
            Self::Rtk => 0.02,
        }
    }
}

/// The rectified left camera of a pair, and how it is meant to stand on the airframe.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Lens {
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Between the eyes, metres.
    pub baseline_m: f64,
    /// Below the nose, degrees.
    pub depression_deg: f64,
}

/// Columns and rows.
pub const IMAGE_PX: (f64, f64) = (1280.0, 720.0);
/// Body origin to the left camera, body axes, metres.
pub const LEVER_ARM_M: [f64; 3] = [0.12, -0.04, 0.06];

impl Lens {
    /// P3's camera: f b = 66 px m.
    #[must_use]
    pub const fn short() -> Self {
        Self {
            focal_px: 882.5,
            baseline_m: 0.075,
            depression_deg: 30.0,
        }
    }

    /// A wide bar: f b = 265 px m.
    #[must_use]
    pub const fn wide() -> Self {
        Self {
            baseline_m: 0.3,
            ..Self::short()
        }
    }

    /// Takes camera components (right, down, ahead) to body components (ahead, right, down).
    fn body_from_cam(&self) -> Matrix3<f64> {
        let (sin, cos) = self.depression_deg.to_radians().sin_cos();
        #[rustfmt::skip]
        let columns = Matrix3::new(
            0.0, -sin, cos,
            1.0, 0.0, 0.0,
            0.0, cos, sin,
        );
        columns
    }

    /// Columns, rows and disparity of a point seen by a camera; `None` behind it.
    fn project(
        &self,
        from_m: Vector3<f64>,
        enu_from_cam: &Matrix3<f64>,
        point: Vector3<f64>,
    ) -> Option<Vector3<f64>> {
        let x = enu_from_cam.transpose() * (point - from_m);
        (x.z > 0.2).then(|| {
            Vector3::new(
                self.focal_px * x.x / x.z + 0.5 * IMAGE_PX.0,
                self.focal_px * x.y / x.z + 0.5 * IMAGE_PX.1,
                self.focal_px * self.baseline_m / x.z,
            )
        })
    }

    /// Disparity below which a matcher has no range to tell: its sigma is a quarter of the depth.
    #[must_use]
    pub const fn least_disparity_px(&self) -> f64 {
        4.0 * 0.25
    }
}

/// What burns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Flame {
    /// Where it stands, east, north, up, metres.
    pub base_m: Vector3<f64>,
    /// Width and height, metres.
    pub size_m: f64,
}

/// What the service is told of the airframe.
#[derive(Debug, Clone, PartialEq)]
pub struct Reported {
    /// Seconds of flight at which it says that the pair was taken.
    pub t_s: f64,
    /// Body origin, metres.
    pub position_m: Vector3<f64>,
    /// Takes body to east, north, up.
    pub enu_from_body: Matrix3<f64>,
    /// East, north, up, m/s.
    pub velocity_m_s: Vector3<f64>,
    /// Body axes, rad/s.
    pub rate_rad_s: Vector3<f64>,
}

/// What the detector and the matcher say of a flame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Middle of the box's lower edge: column, row.
    pub base_px: (f64, f64),
    /// Width and height of the box, pixels.
    pub size_px: (f64, f64),
    /// Disparity, where the matcher has one.
    pub disparity_px: Option<f64>,
    /// Centroid of what was matched: column, row.
    pub centroid_px: (f64, f64),
    /// Light of the box.
    pub glow: f64,
    /// What it looks like, where that is drawn.
    pub picture: Option<Patch>,
}

/// The camera that really is: true airframe, true mount, true clock.
#[derive(Debug, Clone, Copy)]
pub struct TrueCamera<'a> {
    /// Its optics.
    pub lens: &'a Lens,
    /// The airframe at mid-exposure.
    pub state: &'a BodyState,
    /// What is wrong with mount and disparity at that moment.
    pub slow: &'a Slow,
}

/// What one flame looks like without noise: base and middle as columns, rows, disparity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Base.
    pub base: Vector3<f64>,
    /// Middle.
    pub middle: Vector3<f64>,
}

impl TrueCamera<'_> {
    fn enu_from_cam(&self) -> Matrix3<f64> {
        let boresight: Vector3<f64> = self.slow.fixed_rows::<3>(slow::BORESIGHT).into_owned();
        let mount =
            Rotation3::from_scaled_axis(-boresight).into_inner() * self.lens.body_from_cam();
        self.state.enu_from_body * mount
    }

    /// Where it is, metres.
    #[must_use]
    pub fn position_m(&self) -> Vector3<f64> {
        // What the rig file says is the true arm plus its error.
        let error: Vector3<f64> = self.slow.fixed_rows::<3>(slow::LEVER).into_owned();
        self.state.position_m + self.state.enu_from_body * (Vector3::from(LEVER_ARM_M) - error)
    }

    /// What a flame looks like; `None` behind the camera.
    #[must_use]
    pub fn sight(&self, flame: &Flame) -> Option<Sight> {
        let (from, turned) = (self.position_m(), self.enu_from_cam());
        let middle = flame.base_m + Vector3::z() * (0.5 * flame.size_m);
        let offset = Vector3::z() * self.slow[slow::DISPARITY];
        Some(Sight {
            base: self.lens.project(from, &turned, flame.base_m)?,
            middle: self.lens.project(from, &turned, middle)? + offset,
        })
    }

    /// What detector and matcher make of a flame; `None` when its base is outside of the image.
    pub fn see(&self, flame: &Flame, errors: &ErrorModel, chance: &mut Draw) -> Option<Seen> {
        let sight = self.sight(flame)?;
        // All that is drawn is drawn whether it is used or not: the stream stays in step.
        let (du, dv) = (
            chance.pixel(0, errors.pixel_px),
            chance.pixel(1, errors.pixel_px),
        );
        let dd = chance.white(errors.disparity_px);
        let (cu, cv, flicker) = (
            chance.white(0.25 * errors.pixel_px),
            chance.white(0.25 * errors.pixel_px),
            chance.white(0.3),
        );
        let inside =
            (0.0..IMAGE_PX.0).contains(&sight.base.x) && (0.0..IMAGE_PX.1).contains(&sight.base.y);
        let depth = self.lens.focal_px * self.lens.baseline_m / sight.base.z;
        let size = self.lens.focal_px * flame.size_m / depth;
        let in_reach = sight.base.z >= self.lens.least_disparity_px();
        inside.then_some(Seen {
            base_px: (sight.base.x + du, sight.base.y + dv),
            size_px: (size, size),
            disparity_px: in_reach.then_some(sight.middle.z + dd),
            centroid_px: (sight.middle.x + cu, sight.middle.y + cv),
            glow: 1e7 * (1.0 + flicker.abs()) / (depth * depth),
            picture: None,
        })
    }
}

/// The autopilot's side of one look: it answers for its own clock, with errors that hold for the
/// moments around the look.
#[derive(Debug, Clone)]
pub struct Autopilot<'a> {
    course: &'a Course,
    t_s: f64,
    slow: Slow,
    turn_rad: Vector3<f64>,
    moved_m: Vector3<f64>,
    rate_rad_s: Vector3<f64>,
}

impl<'a> Autopilot<'a> {
    /// With the slow errors of a moment, and what is new in each look.
    pub fn new(
        course: &'a Course,
        t_s: f64,
        slow: &Slow,
        errors: &ErrorModel,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        Self {
            course,
            t_s,
            slow: *slow,
            turn_rad: normal3(rng, errors.attitude_noise_rad),
            moved_m: normal3(rng, errors.position_noise_m),
            rate_rad_s: normal3(rng, 0.002),
        }
    }

    /// What it reports for the moment `later_s` after the look's stamp.
    #[must_use]
    pub fn report(&self, later_s: f64) -> Reported {
        let state = self
            .course
            .state(self.t_s + self.slow[slow::CLOCK] + later_s);
        let gnss: Vector3<f64> = self.slow.fixed_rows::<3>(slow::GNSS).into_owned();
        let tilt = Vector3::new(self.slow[slow::TILT], self.slow[slow::TILT + 1], 0.0);
        // Clockwise seen from above is negative about up.
        let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), -self.slow[slow::HEADING]);
        let turned = Rotation3::from_scaled_axis(tilt + self.turn_rad);
        Reported {
            t_s: self.t_s + later_s,
            position_m: state.position_m + gnss + self.moved_m,
            enu_from_body: heading.into_inner() * state.enu_from_body * turned.into_inner(),
            velocity_m_s: state.velocity_m_s + self.slow.fixed_rows::<3>(slow::VELOCITY),
            rate_rad_s: state.rate_rad_s + self.rate_rad_s,
        }
    }
}

/// Slow errors at each of `times_s`: a constant and a first-order Gauss-Markov process under
/// [`Law::Assumed`], sampled exactly; see [`Law`] for the others.
pub fn wander(rng: &mut ChaCha8Rng, errors: &ErrorModel, times_s: &[f64], law: Law) -> Vec<Slow> {
    let (sigmas, shares) = (errors.sigmas(), errors.constant_shares());
    let correlations = law.correlations(&errors.correlations_s());
    let constant = Slow::from_fn(|i, _| law.constant(rng, i, sigmas[i] * shares[i].sqrt()));
    let moving = Slow::from_fn(|i, _| sigmas[i] * (1.0 - shares[i]).sqrt());
    let mut now = Slow::from_fn(|i, _| gauss(rng, moving[i]));
    let sines = (law == Law::SineDrift).then(|| Sines::drawn(rng));
    let mut values = Vec::with_capacity(times_s.len());
    for (look, t_s) in times_s.iter().enumerate() {
        if look > 0 {
            let dt_s = t_s - times_s[look - 1];
            now = Slow::from_fn(|i, _| law.next(rng, i, now[i], moving[i], dt_s, correlations[i]));
        }
        if let Some(sines) = sines {
            let swung = sines.at(*t_s, &moving);
            now.rows_mut(0, slow::VELOCITY)
                .copy_from(&swung.rows(0, slow::VELOCITY));
        }
        values.push(constant + now);
    }
    values
}

/// One standard normal draw times sigma.
pub fn gauss(rng: &mut ChaCha8Rng, sigma: f64) -> f64 {
    sigma * normal(rng)
}
