//! The measurement model: what the left camera sees of a point, and how each error moves it.

use super::shared::{SHARED, Shared, SharedPriors};
use crate::pose::Pose;
use emberfix_calib::{RectifiedPixel, Rig};
use emberfix_frames::{
    BodyFrd, CamLeft, Coordinate, Covariance, Ecef, Matrix3, Metres, MissionEnu,
    RigidBodyTransform, Rotation, Vector3, Wgs84, ecef_from_enu, enu_from_ecef, rotation_matrix,
};
use nalgebra::{Rotation3, SMatrix, SVector};

/// The vehicle's reported motion about one shutter.
pub trait Motion {
    /// The pose that was reported for `later_s` seconds after the view's own moment (negative:
    /// before); `None` where the telemetry says nothing.
    fn at(&self, later_s: f64) -> Option<Pose>;
}

impl<F: Fn(f64) -> Option<Pose>> Motion for F {
    fn at(&self, later_s: f64) -> Option<Pose> {
        self(later_s)
    }
}

/// One camera at one moment, in the plane at the mission datum: everything as it was reported.
#[derive(Clone)]
pub struct View<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// The pose as reported.
    pub pose: &'a Pose,
    /// Optical centre of the left camera, mission plane, metres.
    pub camera_enu: Vector3<f64>,
    /// Takes rectified left camera components to mission-plane components.
    pub enu_from_cam: Matrix3<f64>,
    priors: SharedPriors,
    sigmas: SVector<f64, SHARED>,
    mission_from_ecef: RigidBodyTransform<Ecef, MissionEnu>,
    up: Vector3<f64>,
    motion: Option<&'a dyn Motion>,
    reported: Lens,
}

/// The left camera with some of the shared errors taken out, and how it moves with each of them.
#[derive(Debug, Clone)]
pub struct Lens {
    centre: Vector3<f64>,
    enu_from_cam: Matrix3<f64>,
    /// Metres that the centre moves per sigma of each shared error.
    centre_by_shared: SMatrix<f64, 3, SHARED>,
    /// Rotation vector (mission plane, radians) per sigma of each shared error.
    turn_by_shared: SMatrix<f64, 3, SHARED>,
    focal_px: f64,
    principal_point_px: (f64, f64),
    baseline_m: f64,
    infinity_px: f64,
    disparity_sigma_px: f64,
    disparity_offset_px: f64,
}

/// A point as `at / over`: far ones have a small `over`, one at infinity has zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distant {
    /// Position times `over`, mission plane, metres times 1/m.
    pub at: Vector3<f64>,
    /// 1 for a plain position; 1/m for an inverse depth.
    pub over: f64,
}

impl Distant {
    /// A plain position.
    #[must_use]
    pub fn near(point: Vector3<f64>) -> Self {
        Self {
            at: point,
            over: 1.0,
        }
    }
}

/// What the camera is predicted to see of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Predicted {
    /// Pixel in the rectified left image.
    pub pixel: RectifiedPixel,
    /// Depth along the boresight, metres.
    pub depth_m: f64,
    /// Disparity, rectified pixels.
    pub disparity_px: f64,
}

/// The same with its slopes; rows are column, row, disparity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Linear {
    /// Column, row, disparity.
    pub value: Vector3<f64>,
    /// Over `at` of the point.
    pub by_at: Matrix3<f64>,
    /// Over `over` of the point.
    pub by_over: Vector3<f64>,
    /// Over the shared errors, each in units of its sigma.
    pub by_shared: SMatrix<f64, 3, SHARED>,
}

/// Where the body was and how it stood, mission plane.
#[derive(Debug, Clone, Copy)]
struct Station {
    body_enu: Vector3<f64>,
    enu_from_body: Matrix3<f64>,
}

/// Shortest and longest clock error over which the motion's slope is taken, seconds.
const CLOCK_STEP_S: (f64, f64) = (0.005, 0.6);
/// Acceleration, and turn acceleration, that going straight on does not see: m/s², rad/s².
const UNSEEN: (f64, f64) = (2.0, 3.0);

impl<'a> View<'a> {
    /// The view of `rig` at `pose`, in the plane whose origin is `datum`. The vehicle is taken to
    /// go straight on, and turn on, about this moment, until [`View::with_motion`] knows better.
    #[must_use]
    pub fn new(rig: &'a Rig, pose: &'a Pose, priors: &SharedPriors, datum: &Wgs84) -> Self {
        let mission_from_ecef = enu_from_ecef::<MissionEnu>(datum);
        let up_rotation = ecef_from_enu::<emberfix_frames::VehicleEnu>(&pose.place).rotation()
            * mission_from_ecef.rotation();
        let up = rotation_matrix(&up_rotation) * Vector3::z();
        let sigmas = priors.sigmas(pose, rig);
        let station = station(pose, &mission_from_ecef);
        let corrected = Corrected::new(&station, rig, &up, &SVector::zeros());
        let clock = ClockSlope::straight_on(&station, pose, &corrected);
        let reported = corrected.lens(rig, &up, &sigmas, &clock, 0.0);
        Self {
            rig,
            pose,
            camera_enu: reported.centre,
            enu_from_cam: reported.enu_from_cam,
            priors: *priors,
            sigmas,
            mission_from_ecef,
            up,
            motion: None,
            reported,
        }
    }

    /// The same view, knowing what was reported for the moments about it.
    #[must_use]
    pub fn with_motion(mut self, motion: &'a dyn Motion) -> Self {
        self.motion = Some(motion);
        self
    }

    /// What is known beforehand of the shared errors.
    #[must_use]
    pub fn priors(&self) -> &SharedPriors {
        &self.priors
    }

    /// Prior sigmas of the shared errors at this moment, in the order of [`Shared`].
    #[must_use]
    pub fn sigmas(&self) -> &SVector<f64, SHARED> {
        &self.sigmas
    }

    /// Local vertical at the vehicle, mission plane.
    #[must_use]
    pub fn up(&self) -> &Vector3<f64> {
        &self.up
    }

    /// A point of the mission plane on the Earth; `None` when it is nowhere near its surface.
    #[must_use]
    pub fn place(&self, point: &Coordinate<MissionEnu>) -> Option<Wgs84> {
        emberfix_frames::place_from_ecef(&self.mission_from_ecef.inverse_transform(*point))
    }

    /// Unit vector of a pixel's ray in the mission plane.
    #[must_use]
    pub fn ray_enu(&self, pixel: RectifiedPixel) -> Vector3<f64> {
        self.enu_from_cam * self.rig.ray(pixel).metres().normalize()
    }

    /// Slant range of a pixel at a depth along the boresight, metres.
    #[must_use]
    pub fn slant(&self, pixel: RectifiedPixel, depth_m: f64) -> f64 {
        self.rig.ray(pixel).metres().norm() * depth_m
    }

    /// Range along `ray` at which it passes beneath `point` (see [`range_beneath`]).
    #[must_use]
    pub fn range_beneath(&self, point: &Vector3<f64>, ray: &Vector3<f64>) -> Option<f64> {
        range_beneath(&(point - self.camera_enu), ray, &self.up)
    }

    /// Error across the ray at a range, from pixels.
    #[must_use]
    pub fn across_covariance(
        &self,
        ray: &Vector3<f64>,
        range_m: f64,
        (sigma_u, sigma_v): (f64, f64),
    ) -> Covariance<MissionEnu> {
        let focal = self.rig.rectification().focal_px();
        let (right, down) = (self.enu_from_cam.column(0), self.enu_from_cam.column(1));
        let flat = |axis: Vector3<f64>| (axis - ray * axis.dot(ray)) * range_m;
        let jacobian = SMatrix::<f64, 3, 2>::from_columns(&[
            flat(right.into_owned()),
            flat(down.into_owned()),
        ]);
        let sigmas = SVector::<f64, 2>::new(sigma_u / focal, sigma_v / focal);
        Covariance::from_sources(&jacobian, &sigmas)
    }

    /// What the shared errors and those of this frame do to a point that was placed along its ray
    /// at a known range. The disparity offset is not in it: it counts as far as stereo was used.
    #[must_use]
    pub fn shared_covariance(&self, point: &Vector3<f64>) -> Covariance<MissionEnu> {
        let by_shared = self.reported.carried_by_shared(point);
        Covariance::from_sources(&by_shared, &SVector::repeat(1.0))
    }

    /// What the camera should see of a point of the mission plane, if everything were as reported;
    /// `None` behind the camera.
    #[must_use]
    pub fn predict(&self, point: &Vector3<f64>) -> Option<Predicted> {
        self.reported.predict(&Distant::near(*point))
    }

    /// The camera as reported.
    #[must_use]
    pub fn reported(&self) -> &Lens {
        &self.reported
    }

    /// The camera with the `shared` errors (in units of their sigmas) taken out. The clock error is
    /// known to `clock_sigma` of its own sigma only: over that span the motion is taken as its best
    /// straight line, and what strays from it widens the errors of this frame.
    #[must_use]
    pub fn lens(&self, shared: &SVector<f64, SHARED>, clock_sigma: f64) -> Lens {
        let clock_s = shared[Shared::Clock as usize] * self.sigmas[Shared::Clock as usize];
        let spread_s = clock_sigma * self.sigmas[Shared::Clock as usize];
        let step_s = (3_f64.sqrt() * spread_s).clamp(CLOCK_STEP_S.0, CLOCK_STEP_S.1);
        let (now, known) = self.station_at(-clock_s);
        let (later, known_later) = self.station_at(-clock_s - step_s);
        let (sooner, known_sooner) = self.station_at(-clock_s + step_s);
        let corrected = |station: &Station, sigmas: &SVector<f64, SHARED>| {
            Corrected::new(station, self.rig, &self.up, &shared.component_mul(sigmas))
        };
        let [here, ahead, behind] =
            [&now, &later, &sooner].map(|station| corrected(station, &self.sigmas));
        let mut clock = ClockSlope::between(&here, &ahead, &behind, step_s);
        if !(known && known_later && known_sooner) {
            clock.widen(clock_s.abs() + step_s);
        }
        let sigmas = clock.widened(&self.sigmas);
        let offset_px = shared[Shared::Disparity as usize] * sigmas[Shared::Disparity as usize];
        corrected(&now, &sigmas).lens(self.rig, &self.up, &sigmas, &clock, offset_px)
    }

    /// Where the body was at another moment, and whether that was reported or is straight on.
    fn station_at(&self, later_s: f64) -> (Station, bool) {
        match self.motion.and_then(|motion| motion.at(later_s)) {
            Some(pose) => (station(&pose, &self.mission_from_ecef), true),
            None => {
                let here = station(self.pose, &self.mission_from_ecef);
                (
                    here.straight_on(self.pose, later_s),
                    later_s.abs() < CLOCK_STEP_S.0 * 2.0,
                )
            }
        }
    }
}

impl std::fmt::Debug for View<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("View")
            .field("pose", self.pose)
            .field("camera_enu", &self.camera_enu)
            .field("knows_motion", &self.motion.is_some())
            .finish_non_exhaustive()
    }
}

/// Range along `ray` at which it passes beneath a point `to_point` away: the plane through the
/// point that contains the vertical and faces the camera. `None` when the ray runs along it.
#[must_use]
pub fn range_beneath(
    to_point: &Vector3<f64>,
    ray: &Vector3<f64>,
    up: &Vector3<f64>,
) -> Option<f64> {
    let horizontal = |v: &Vector3<f64>| v - up * v.dot(up);
    let (flat_point, flat_ray) = (horizontal(to_point), horizontal(ray));
    let facing = flat_point.norm();
    if facing < 1e-3 * to_point.norm() {
        // Straight beneath: the vertical plane is no help, the height is.
        return Some(to_point.norm());
    }
    let along = flat_ray.dot(&flat_point) / facing;
    (along > 0.02).then(|| facing / along)
}

/// Body to the vehicle's own plane to ECEF to the mission's plane: typed.
fn station(pose: &Pose, mission_from_ecef: &RigidBodyTransform<Ecef, MissionEnu>) -> Station {
    let to_mission: Rotation<BodyFrd, MissionEnu> = pose.attitude.enu_from_body()
        * ecef_from_enu(&pose.place).rotation()
        * mission_from_ecef.rotation();
    let body_enu = mission_from_ecef.transform(Coordinate::<Ecef>::from_wgs84(&pose.place));
    Station {
        body_enu: body_enu.metres(),
        enu_from_body: rotation_matrix(&to_mission),
    }
}

impl Station {
    fn straight_on(&self, pose: &Pose, later_s: f64) -> Self {
        let turn = Rotation3::new(pose.rate_rad_s * later_s);
        Self {
            body_enu: self.body_enu + pose.velocity_enu_m_s * later_s,
            enu_from_body: self.enu_from_body * turn.matrix(),
        }
    }
}

/// Body and camera with the shared errors (SI units) taken out.
struct Corrected {
    enu_from_body: Matrix3<f64>,
    enu_from_cam: Matrix3<f64>,
    /// From the body's origin to the camera, mission plane.
    arm: Vector3<f64>,
    centre: Vector3<f64>,
}

impl Corrected {
    /// The reported attitude is `turn(-up, heading) R exp(body)` of the true one, `R`.
    fn new(station: &Station, rig: &Rig, up: &Vector3<f64>, errors: &SVector<f64, SHARED>) -> Self {
        let three = |from: Shared| errors.fixed_rows::<3>(from as usize).into_owned();
        let tilt = errors.fixed_rows::<2>(Shared::Tilt as usize);
        let heading = errors[Shared::HeadingConstant as usize] + errors[Shared::Heading as usize];
        let body = three(Shared::Boresight)
            + three(Shared::AttitudeJitter)
            + Vector3::new(tilt[0], tilt[1], 0.0);
        let enu_from_body = Rotation3::new(up * heading).matrix()
            * station.enu_from_body
            * Rotation3::new(-body).matrix();
        let cam: Rotation<CamLeft, BodyFrd> = rig.body_from_cam_left();
        let arm = enu_from_body * (rig.lever_arm().metres() - three(Shared::LeverArm));
        let gnss =
            three(Shared::GnssConstant) + three(Shared::Gnss) + three(Shared::PositionJitter);
        Self {
            enu_from_body,
            enu_from_cam: enu_from_body * rotation_matrix(&cam),
            arm,
            centre: station.body_enu - gnss + arm,
        }
    }

    fn lens(
        &self,
        rig: &Rig,
        up: &Vector3<f64>,
        sigmas: &SVector<f64, SHARED>,
        clock: &ClockSlope,
        disparity_offset_px: f64,
    ) -> Lens {
        let mut turn = SMatrix::<f64, 3, SHARED>::zeros();
        let mut centre = SMatrix::<f64, 3, SHARED>::zeros();
        for heading in [Shared::HeadingConstant, Shared::Heading] {
            turn.set_column(heading as usize, up);
        }
        for (from, axes) in [
            (Shared::Boresight, 3),
            (Shared::Tilt, 2),
            (Shared::AttitudeJitter, 3),
        ] {
            for axis in 0..axes {
                turn.set_column(from as usize + axis, &-self.enu_from_body.column(axis));
            }
        }
        for index in 0..SHARED {
            let moved = turn.column(index).cross(&self.arm);
            centre.set_column(index, &moved);
        }
        for from in [Shared::GnssConstant, Shared::Gnss, Shared::PositionJitter] {
            centre
                .fixed_view_mut::<3, 3>(0, from as usize)
                .copy_from(&-Matrix3::identity());
        }
        centre
            .fixed_view_mut::<3, 3>(0, Shared::LeverArm as usize)
            .copy_from(&-self.enu_from_body);
        centre.set_column(Shared::Clock as usize, &clock.centre);
        turn.set_column(Shared::Clock as usize, &clock.turn);
        let scale = SMatrix::<f64, SHARED, SHARED>::from_diagonal(sigmas);
        let rectification = rig.rectification();
        Lens {
            centre: self.centre,
            enu_from_cam: self.enu_from_cam,
            centre_by_shared: centre * scale,
            turn_by_shared: turn * scale,
            focal_px: rectification.focal_px(),
            principal_point_px: rectification.principal_point_px(),
            baseline_m: rig.baseline_m(),
            infinity_px: rectification.infinity_disparity_px(),
            disparity_sigma_px: sigmas[Shared::Disparity as usize],
            disparity_offset_px,
        }
    }
}

/// How the camera moves with the clock error, and what strays from that straight line.
struct ClockSlope {
    centre: Vector3<f64>,
    turn: Vector3<f64>,
    stray_m: f64,
    stray_turn_rad: f64,
}

/// Sigma of what a parabola strays from the line through its middle, over its height at sqrt(3)
/// sigma: three points with the weights 1/6, 2/3, 1/6 (Gauss-Hermite) leave the variance 1/3.
const PARABOLA: f64 = 0.577_350_269_189_625_8;

impl ClockSlope {
    /// From the slope at one moment.
    fn straight_on(station: &Station, pose: &Pose, corrected: &Corrected) -> Self {
        let turn = -(station.enu_from_body * pose.rate_rad_s);
        Self {
            centre: -pose.velocity_enu_m_s + turn.cross(&corrected.arm),
            turn,
            stray_m: 0.0,
            stray_turn_rad: 0.0,
        }
    }

    /// Regression over the clock error's spread. Source: statistical linear regression, Arasaratnam,
    /// Haykin, Elliott, "Discrete-Time Nonlinear Filtering Algorithms Using Gauss-Hermite
    /// Quadrature", Proc. IEEE 95(5), 2007.
    fn between(now: &Corrected, later: &Corrected, sooner: &Corrected, step_s: f64) -> Self {
        let turned = |to: &Corrected| {
            Rotation3::from_matrix_unchecked(to.enu_from_cam * now.enu_from_cam.transpose())
                .scaled_axis()
        };
        let (turn_later, turn_sooner) = (turned(later), turned(sooner));
        let bend = (later.centre + sooner.centre) * 0.5 - now.centre;
        let turn_bend = (turn_later + turn_sooner) * 0.5;
        Self {
            centre: (later.centre - sooner.centre) / (2.0 * step_s),
            turn: (turn_later - turn_sooner) / (2.0 * step_s),
            stray_m: PARABOLA * bend.norm(),
            stray_turn_rad: PARABOLA * turn_bend.norm(),
        }
    }

    /// Sigmas whose errors of this frame hold what strays from the line.
    fn widened(&self, sigmas: &SVector<f64, SHARED>) -> SVector<f64, SHARED> {
        let mut sigmas = *sigmas;
        for axis in 0..3 {
            let attitude = &mut sigmas[Shared::AttitudeJitter as usize + axis];
            *attitude = attitude.hypot(self.stray_turn_rad);
            let position = &mut sigmas[Shared::PositionJitter as usize + axis];
            *position = position.hypot(self.stray_m);
        }
        sigmas
    }

    /// Nothing was reported for moments that far away.
    fn widen(&mut self, span_s: f64) {
        let half = 0.5 * span_s * span_s;
        self.stray_m = self.stray_m.hypot(UNSEEN.0 * half);
        self.stray_turn_rad = self.stray_turn_rad.hypot(UNSEEN.1 * half);
    }
}

impl Lens {
    /// Optical centre, mission plane, metres.
    #[must_use]
    pub fn centre(&self) -> &Vector3<f64> {
        &self.centre
    }

    /// Takes rectified left camera components to mission-plane components.
    #[must_use]
    pub fn enu_from_cam(&self) -> &Matrix3<f64> {
        &self.enu_from_cam
    }

    /// Metres that the centre moves per sigma of each shared error.
    #[must_use]
    pub fn centre_by_shared(&self) -> &SMatrix<f64, 3, SHARED> {
        &self.centre_by_shared
    }

    /// Unit vector of a pixel's ray in the mission plane.
    #[must_use]
    pub fn ray_enu(&self, pixel: RectifiedPixel) -> Vector3<f64> {
        let (cx, cy) = self.principal_point_px;
        let f = self.focal_px;
        (self.enu_from_cam * Vector3::new((pixel.u - cx) / f, (pixel.v - cy) / f, 1.0)).normalize()
    }

    /// Camera components of a point (times its `over`), if it is in front of the camera.
    fn in_camera(&self, point: &Distant) -> Option<Vector3<f64>> {
        let x = self.enu_from_cam.transpose() * (point.at - self.centre * point.over);
        (x.z > 0.1 * point.over && x.z > 1e-6).then_some(x)
    }

    fn seen(&self, x: &Vector3<f64>, over: f64) -> Vector3<f64> {
        let (cx, cy) = self.principal_point_px;
        let disparity = self.focal_px * self.baseline_m * over / x.z
            + self.infinity_px
            + self.disparity_offset_px;
        Vector3::new(
            self.focal_px * x.x / x.z + cx,
            self.focal_px * x.y / x.z + cy,
            disparity,
        )
    }

    /// What is seen of a point; `None` behind the camera.
    #[must_use]
    pub fn predict(&self, point: &Distant) -> Option<Predicted> {
        let x = self.in_camera(point)?;
        let seen = self.seen(&x, point.over);
        Some(Predicted {
            pixel: RectifiedPixel {
                u: seen.x,
                v: seen.y,
            },
            depth_m: x.z / point.over,
            disparity_px: seen.z,
        })
    }

    /// The same with its slopes.
    ///
    /// With `x = R' (p - c)` in camera components, pixel = f (x/z, y/z) + principal point, and
    /// disparity = f b / z + d_infinity + offset; all of it times `over` where the point is.
    #[must_use]
    pub fn linear(&self, point: &Distant) -> Option<Linear> {
        let x = self.in_camera(point)?;
        let (f, fb) = (self.focal_px, self.focal_px * self.baseline_m);
        let z2 = x.z * x.z;
        #[rustfmt::skip]
        let by_x = Matrix3::new(
            f / x.z, 0.0, -f * x.x / z2,
            0.0, f / x.z, -f * x.y / z2,
            0.0, 0.0, -fb * point.over / z2,
        );
        let by_at = by_x * self.enu_from_cam.transpose();
        let sight = point.at - self.centre * point.over;
        let moved = sight.cross_matrix() * self.turn_by_shared - self.centre_by_shared * point.over;
        let mut by_shared = by_at * moved;
        by_shared[(2, Shared::Disparity as usize)] += self.disparity_sigma_px;
        let mut by_over = -(by_at * self.centre);
        by_over.z += fb / x.z;
        Some(Linear {
            value: self.seen(&x, point.over),
            by_at,
            by_over,
            by_shared,
        })
    }

    /// Metres by which each shared error's sigma moves a point that is held by its pixel and depth.
    fn carried_by_shared(&self, point: &Vector3<f64>) -> SMatrix<f64, 3, SHARED> {
        let sight = point - self.centre;
        self.centre_by_shared - sight.cross_matrix() * self.turn_by_shared
    }
}
