//! What the left camera sees of the marker, as a function of everything that may be wrong.

use super::flight::Marker;
use super::wander::{WANDERING, Wandering};
use crate::mission::Mission;
use crate::pose::Pose;
use emberfix_calib::{Camera, Eye, RawPixel, Rig};
use emberfix_frames::{
    BodyFrd, CamLeftRaw, Coordinate, Ecef, Metres, MissionEnu, MountAngles, Rotation, ServiceTime,
    UnitQuaternion, Vector3, Wgs84, body_from_camera, ecef_from_enu, enu_from_ecef,
    rotation_matrix,
};
use nalgebra::{Matrix3, Rotation3, SVector};

/// Number of parameters.
pub(super) const N: usize = 16;
pub(super) type Parameters = SVector<f64, N>;

/// Place of each parameter in the vector. Angles in radians, lengths in metres, the clock in seconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(usize)]
pub enum Parameter {
    /// Turn of the camera against the rig file about body forward; right and down follow.
    MountRoll = 0,
    /// About body right.
    MountPitch = 1,
    /// About body down.
    MountYaw = 2,
    /// Lever arm minus the rig file's: forward; right and down follow.
    Arm = 3,
    /// `time.camera_offset_s` minus the rig file's: positive, the camera's stamps are earlier still.
    Clock = 6,
    /// Autopilot's heading minus true heading, clockwise. This, tilt and position may wander, see
    /// [`Wandering`].
    Heading = 7,
    /// Autopilot's tilt minus the true one, about east; about north follows.
    Tilt = 8,
    /// Autopilot's position minus the true one: east; north and up follow.
    Gnss = 10,
    /// The marker: east, north, up of the datum's plane.
    Marker = 13,
}

/// The airframe at one moment, in the plane at the mission datum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyAt {
    /// Body origin, metres.
    pub position_m: Vector3<f64>,
    /// Takes forward, right, down to east, north, up of the datum.
    pub enu_from_body: UnitQuaternion<f64>,
}

impl BodyAt {
    /// A pose in the plane at `datum`.
    #[must_use]
    pub fn new(pose: &Pose, datum: &Wgs84) -> Self {
        let mission_from_ecef = enu_from_ecef::<MissionEnu>(datum);
        let turn: Rotation<BodyFrd, MissionEnu> = pose.attitude.enu_from_body()
            * ecef_from_enu(&pose.place).rotation()
            * mission_from_ecef.rotation();
        let place = mission_from_ecef.transform(Coordinate::<Ecef>::from_wgs84(&pose.place));
        Self {
            position_m: place.metres(),
            enu_from_body: quaternion(&rotation_matrix(&turn)),
        }
    }
}

/// In closed form: the iterative way of `from_matrix` may stop short near half a turn, which is where
/// forward-right-down stands to east-north-up.
pub(super) fn quaternion(turn: &Matrix3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*turn))
}

/// Where the airframe was about one moment, at even steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Way {
    /// Seconds of the first step from the moment; the last is as far on the other side.
    pub from_s: f64,
    /// Seconds between steps.
    pub step_s: f64,
    /// One sigma of the autopilot's clock against ours, seconds: the same in all pictures.
    pub time_sigma_s: f64,
    /// The steps.
    pub bodies: Vec<BodyAt>,
}

impl Way {
    /// Where it was `offset_s` after the moment; the ends hold beyond the ends.
    #[must_use]
    pub fn at(&self, offset_s: f64) -> Option<BodyAt> {
        let last = self.bodies.len().checked_sub(1)?;
        let place = ((offset_s - self.from_s) / self.step_s).clamp(0.0, last as f64);
        let index = (place as usize).min(last.saturating_sub(1));
        let (a, b) = (
            self.bodies.get(index)?,
            self.bodies.get((index + 1).min(last))?,
        );
        let share = place - index as f64;
        Some(BodyAt {
            position_m: a.position_m.lerp(&b.position_m, share),
            enu_from_body: a.enu_from_body.slerp(&b.enu_from_body, share),
        })
    }

    /// Turn rate of the nose about the vertical at the moment, rad/s, clockwise.
    #[must_use]
    pub fn yaw_rate_rad_s(&self) -> f64 {
        let (Some(a), Some(b)) = (self.at(-self.step_s), self.at(self.step_s)) else {
            return 0.0;
        };
        let turn = (b.enu_from_body * a.enu_from_body.inverse()).scaled_axis();
        -turn.z / (2.0 * self.step_s)
    }

    /// Turn rate about all axes at the moment, rad/s.
    #[must_use]
    pub fn rate_rad_s(&self) -> f64 {
        let (Some(a), Some(b)) = (self.at(-self.step_s), self.at(self.step_s)) else {
            return 0.0;
        };
        a.enu_from_body.angle_to(&b.enu_from_body) / (2.0 * self.step_s)
    }
}

/// The marker in one picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Sight {
    /// Mid-exposure by the camera's stamp.
    pub at: ServiceTime,
    /// Where, in the raw left image.
    pub pixel: RawPixel,
    /// One sigma of that, pixels per axis.
    pub sigma_px: f64,
    /// The airframe about that moment (the rig file's clock offset is in it already).
    pub way: Way,
    /// How far stereo says that it is, where somebody asked.
    pub stereo: Option<Stereo>,
}

/// Inverse depth along the rectified boresight by stereo alone, without the rig's correction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stereo {
    /// 1/m.
    pub per_m: f64,
    /// One sigma, 1/m.
    pub sigma_per_m: f64,
}

/// What is known before the flight is looked at.
#[derive(Debug, Clone)]
pub struct Start {
    /// The left camera.
    pub camera: Camera,
    /// Takes left-camera components to body components, by the rig file.
    pub body_from_camera: Matrix3<f64>,
    /// Takes raw left-camera components to those of the rectified left camera.
    pub rectified_from_raw: Matrix3<f64>,
    /// Lever arm by the rig file, metres.
    pub arm_m: Vector3<f64>,
    /// Where the marker is, if it was surveyed, metres in the plane at the datum.
    pub marker_m: Option<Vector3<f64>>,
    /// One sigma of every parameter beforehand; of what wanders, the part that stays.
    pub sigmas: Parameters,
    /// How heading, tilt (2) and GNSS (3) wander, in the order of [`Parameter`].
    pub wandering: [Wandering; WANDERING],
}

impl Start {
    /// A mission's rig and errors; the mount and the clock may be far off.
    #[must_use]
    pub fn of(mission: &Mission, marker: Option<Marker>) -> Self {
        let (rig, arm) = (&mission.rig, Parameter::Arm as usize);
        let mut sigmas = Parameters::from_element(MOUNT_SIGMA_RAD);
        let mut set = |first: usize, count: usize, sigma: f64| {
            sigmas.fixed_rows_mut::<N>(0).as_mut_slice()[first..first + count].fill(sigma);
        };
        set(arm, 3, rig.sigmas().lever_arm_m.max(LEAST_ARM_M));
        set(Parameter::Clock as usize, 1, CLOCK_SIGMA_S);
        let slow = slow_errors(mission);
        for (index, error) in (Parameter::Heading as usize..).zip(slow) {
            set(index, 1, error.sigma);
        }
        let marker_sigma_m = marker.map_or(NOWHERE_M, |marker| marker.sigma_m);
        set(Parameter::Marker as usize, 3, marker_sigma_m);
        Self {
            camera: rig.camera(Eye::Left).clone(),
            body_from_camera: rotation_matrix(&body_from_camera::<CamLeftRaw>(rig.mount())),
            rectified_from_raw: *rig.rectification().rectified_from_raw(Eye::Left),
            arm_m: arm_of(rig),
            marker_m: marker.map(|marker| marker.enu_m(&mission.datum)),
            sigmas,
            wandering: slow,
        }
    }

    /// The same, for a rig whose mount and clock were calibrated: they are as good as its file says.
    #[must_use]
    pub fn of_calibrated(mission: &Mission, marker: Option<Marker>) -> Self {
        let mut start = Self::of(mission, marker);
        let known = mission.rig.sigmas();
        start
            .sigmas
            .fixed_rows_mut::<3>(Parameter::MountRoll as usize)
            .fill(known.boresight_rad);
        start.sigmas[Parameter::Clock as usize] = known.time_offset_s;
        start
    }

    /// Where the surveyed marker should be seen if the rig file were right and the clock off by
    /// `clock_s`; `None` behind the camera.
    pub(super) fn predict(&self, way: &Way, clock_s: f64) -> Option<RawPixel> {
        let mut x = Parameters::zeros();
        x[Parameter::Clock as usize] = clock_s;
        x.fixed_rows_mut::<3>(Parameter::Marker as usize)
            .copy_from(&self.marker_m?);
        Model::new(self, &x).predict(way)
    }
}

/// Heading, tilt about two axes, GNSS along three: in the order of [`Parameter`]. How much of an error stays
/// for a flight is not known well enough to lean on: what stays and what wanders have the whole sigma each.
fn slow_errors(mission: &Mission) -> [Wandering; WANDERING] {
    let (shared, pose) = (&mission.shared, &mission.pose);
    let heading = Wandering {
        sigma: shared.heading_rad,
        correlation_s: shared.heading_correlation_s,
    };
    let tilt = Wandering {
        sigma: shared.tilt_rad,
        correlation_s: shared.tilt_correlation_s,
    };
    let gnss = |sigma| Wandering {
        sigma,
        correlation_s: shared.gnss_correlation_s,
    };
    let (level, up) = (pose.gnss_horizontal_m, pose.gnss_vertical_m);
    [heading, tilt, tilt, gnss(level), gnss(level), gnss(up)]
}

fn arm_of(rig: &Rig) -> Vector3<f64> {
    rig.lever_arm().metres()
}

/// What the mount may be off beforehand, radians: ten degrees.
const MOUNT_SIGMA_RAD: f64 = 0.175;
/// What the clock may be off beforehand, seconds.
const CLOCK_SIGMA_S: f64 = 0.3;
/// Nobody measures an arm better than this, metres.
const LEAST_ARM_M: f64 = 0.005;
/// Sigma of a marker of which nothing is known, metres.
const NOWHERE_M: f64 = 1e4;

pub(super) fn part(x: &Parameters, first: Parameter) -> Vector3<f64> {
    x.fixed_rows::<3>(first as usize).into_owned()
}

/// Everything that does not change from picture to picture, made from one set of parameters.
#[derive(Debug, Clone)]
pub(super) struct Model<'a> {
    start: &'a Start,
    clock_s: f64,
    /// True attitude from the reported one. Reported minus true is turned back: heading against the
    /// clock, seen from above.
    true_from_reported: UnitQuaternion<f64>,
    body_from_camera: Matrix3<f64>,
    arm_m: Vector3<f64>,
    gnss_m: Vector3<f64>,
    marker_m: Vector3<f64>,
}

impl<'a> Model<'a> {
    pub fn new(start: &'a Start, x: &Parameters) -> Self {
        let tilt = Parameter::Tilt as usize;
        let heading =
            UnitQuaternion::from_scaled_axis(Vector3::z() * x[Parameter::Heading as usize]);
        let untilt = UnitQuaternion::from_scaled_axis(-Vector3::new(x[tilt], x[tilt + 1], 0.0));
        let mount = UnitQuaternion::from_scaled_axis(part(x, Parameter::MountRoll));
        Self {
            start,
            clock_s: x[Parameter::Clock as usize],
            true_from_reported: heading * untilt,
            body_from_camera: mount.to_rotation_matrix().into_inner() * start.body_from_camera,
            arm_m: start.arm_m + part(x, Parameter::Arm),
            gnss_m: part(x, Parameter::Gnss),
            marker_m: part(x, Parameter::Marker),
        }
    }

    /// The marker in raw left-camera components, metres; `None` behind the camera.
    fn seen_m(&self, way: &Way) -> Option<Vector3<f64>> {
        let body = way.at(self.clock_s)?;
        let enu_from_body = self.true_from_reported * body.enu_from_body;
        let from_body = self.marker_m - (body.position_m - self.gnss_m);
        let in_body = enu_from_body.inverse_transform_vector(&from_body) - self.arm_m;
        let seen = self.body_from_camera.tr_mul(&in_body);
        (seen.z > 0.05 * seen.norm()).then_some(seen)
    }

    /// Where the marker should be seen; `None` behind the camera.
    pub fn predict(&self, way: &Way) -> Option<RawPixel> {
        Some(self.start.camera.project(&self.seen_m(way)?))
    }

    /// The marker's inverse depth along the rectified boresight, 1/m; `None` behind the camera.
    pub fn per_m(&self, way: &Way) -> Option<f64> {
        let depth_m = (self.start.rectified_from_raw * self.seen_m(way)?).z;
        (depth_m > 0.0).then(|| 1.0 / depth_m)
    }
}

/// The mount angles of a rotation from camera to body: the inverse of
/// [`body_from_camera`](emberfix_frames::body_from_camera).
pub(crate) fn mount_of(body_from_camera: &Matrix3<f64>) -> MountAngles {
    let boresight = body_from_camera.column(2);
    let yaw_rad = boresight.y.atan2(boresight.x);
    let depression_rad = boresight.z.atan2(boresight.xy().norm());
    let level_right = Vector3::new(-yaw_rad.sin(), yaw_rad.cos(), 0.0);
    let level_down = boresight.cross(&level_right);
    let right = body_from_camera.column(0);
    MountAngles {
        yaw_rad,
        depression_rad,
        roll_rad: right.dot(&level_down).atan2(right.dot(&level_right)),
    }
}
