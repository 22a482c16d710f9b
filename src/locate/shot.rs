//! One shutter, kept: the left camera as it was reported for each moment at which it may have opened.
//!
//! The clock error is a state that is found after many looks. To look at an old one again with what
//! is known now, the reported motion about its shutter is kept as a short table.

use super::lens::{Lens, Optics};
use super::shared::{SHARED, Shared};
use crate::pose::Pose;
use emberfix_frames::{
    BodyFrd, Coordinate, Ecef, Matrix3, Metres, MissionEnu, RigidBodyTransform, Rotation, Vector3,
    ecef_from_enu, rotation_matrix,
};
use nalgebra::{Rotation3, SMatrix, SVector};

/// Where the body was and how it stood, mission plane.
#[derive(Debug, Clone, Copy)]
pub(super) struct Station {
    body_enu: Vector3<f64>,
    enu_from_body: Matrix3<f64>,
}

/// Shortest and longest clock error over which the motion's slope is taken, seconds.
const CLOCK_STEP_S: (f64, f64) = (0.005, 0.6);
/// Acceleration, and turn acceleration, that going straight on does not see: m/s², rad/s².
const UNSEEN: (f64, f64) = (2.0, 3.0);

/// One shutter of the left camera, with the motion that was reported about it.
#[derive(Debug, Clone)]
pub struct Shot {
    optics: Optics,
    up: Vector3<f64>,
    sigmas: SVector<f64, SHARED>,
    /// Stands as in the middle of the table.
    enu_from_body: Matrix3<f64>,
    moments: Vec<Moment>,
    /// Of the first moment, after the reported shutter.
    first_s: f64,
    step_s: f64,
}

/// The body at one moment of the table.
#[derive(Debug, Clone, Copy)]
struct Moment {
    body_enu: Vector3<f64>,
    /// Against the middle of the table, body axes, rotation vector.
    turn: Vector3<f64>,
    is_known: bool,
}

/// The table reaches this many sigmas of the clock error, within limits, to either side, seconds.
const REACH_SIGMAS: f64 = 2.5;
const REACH_S: (f64, f64) = (0.02, 0.9);
/// Seconds between two moments at most: gusts turn an airframe within a second.
const MOMENT_S: f64 = 0.15;
/// Moments that one is interpolated from.
const NODES: usize = 4;
/// What makes up the receiver's error.
pub const GNSS: [Shared; 3] = [Shared::GnssConstant, Shared::Gnss, Shared::GnssNoise];

impl Shot {
    /// Keeps what `station_at` says of the moments where the shutter may have opened: the reported
    /// pose is that of `clock` of its sigmas later, known to `clock_sigma` of them.
    pub(super) fn new(
        optics: Optics,
        up: Vector3<f64>,
        sigmas: SVector<f64, SHARED>,
        (clock, clock_sigma): (f64, f64),
        station_at: impl Fn(f64) -> (Station, bool),
    ) -> Self {
        let sigma_s = sigmas[Shared::Clock as usize];
        let reach_s = (REACH_SIGMAS * clock_sigma * sigma_s).clamp(REACH_S.0, REACH_S.1);
        let half = (reach_s / MOMENT_S).ceil().max(1.0);
        let step_s = reach_s / half;
        let first_s = -clock * sigma_s - reach_s;
        let count = 2 * half as usize + 1;
        let all: Vec<_> = (0..count)
            .map(|i| station_at(first_s + step_s * i as f64))
            .collect();
        let enu_from_body = all[count / 2].0.enu_from_body;
        let moment = |(station, is_known): &(Station, bool)| Moment {
            body_enu: station.body_enu,
            turn: Rotation3::from_matrix_unchecked(
                enu_from_body.transpose() * station.enu_from_body,
            )
            .scaled_axis(),
            is_known: *is_known,
        };
        Self {
            optics,
            up,
            sigmas,
            enu_from_body,
            moments: all.iter().map(moment).collect(),
            first_s,
            step_s,
        }
    }

    /// Local vertical at the vehicle, mission plane.
    #[must_use]
    pub fn up(&self) -> &Vector3<f64> {
        &self.up
    }

    /// The clock error nearest to `clock` (both in its sigmas) whose pose the table holds.
    #[must_use]
    pub fn held_clock(&self, clock: f64) -> f64 {
        let sigma_s = self.sigmas[Shared::Clock as usize];
        if sigma_s <= 0.0 {
            return clock;
        }
        let last_s = self.first_s + self.step_s * (self.moments.len() - 1) as f64;
        clock.clamp(-last_s / sigma_s, -self.first_s / sigma_s)
    }

    /// The camera with the `shared` errors (in units of their sigmas) taken out. The clock error is
    /// known to `clock_sigma` of its own sigma only: over that span the motion is taken as its best
    /// straight line, and what strays from it widens the errors of this frame.
    #[must_use]
    pub fn lens(&self, shared: &SVector<f64, SHARED>, clock_sigma: f64) -> Lens {
        let clock_s = shared[Shared::Clock as usize] * self.sigmas[Shared::Clock as usize];
        let spread_s = clock_sigma * self.sigmas[Shared::Clock as usize];
        let step_s = (3_f64.sqrt() * spread_s).clamp(CLOCK_STEP_S.0, CLOCK_STEP_S.1);
        let errors = shared.component_mul(&self.sigmas);
        let at = |later_s: f64| {
            let (station, is_known) = self.station_at(later_s);
            let corrected = Corrected::new(&station, &self.optics, &self.up, &errors);
            (corrected, is_known)
        };
        let [(here, a), (ahead, b), (behind, c)] =
            [-clock_s, -clock_s - step_s, -clock_s + step_s].map(at);
        let mut clock = ClockSlope::between(&here, &ahead, &behind, step_s);
        if !(a && b && c) {
            clock.widen(clock_s.abs() + step_s);
        }
        let sigmas = clock.widened(&self.sigmas);
        let offset_px = errors[Shared::Disparity as usize];
        here.lens(&self.optics, &self.up, &sigmas, &clock, offset_px)
    }

    /// The body at a moment, interpolated (Lagrange) through the nearest of the table, and whether all
    /// of those were reported.
    fn station_at(&self, later_s: f64) -> (Station, bool) {
        let x = (later_s - self.first_s) / self.step_s;
        let nodes = self.moments.len().min(NODES);
        let last = self.moments.len() - nodes;
        let from = (x - 0.5 * (nodes as f64 - 1.0))
            .round()
            .clamp(0.0, last as f64) as usize;
        let (mut body_enu, mut turn, mut is_known) = (Vector3::zeros(), Vector3::zeros(), true);
        for i in from..from + nodes {
            let weight: f64 = (from..from + nodes)
                .filter(|j| *j != i)
                .map(|j| (x - j as f64) / (i as f64 - j as f64))
                .product();
            let moment = &self.moments[i];
            body_enu += moment.body_enu * weight;
            turn += moment.turn * weight;
            is_known &= moment.is_known || weight.abs() < 1e-6;
        }
        let enu_from_body = self.enu_from_body * Rotation3::new(turn).matrix();
        let station = Station {
            body_enu,
            enu_from_body,
        };
        (station, is_known)
    }
}

/// Body to the vehicle's own plane to ECEF to the mission's plane: typed.
pub(super) fn station(
    pose: &Pose,
    mission_from_ecef: &RigidBodyTransform<Ecef, MissionEnu>,
) -> Station {
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
    pub(super) fn straight_on(&self, pose: &Pose, later_s: f64) -> Self {
        let turn = Rotation3::new(pose.rate_rad_s * later_s);
        Self {
            body_enu: self.body_enu + pose.velocity_enu_m_s * later_s,
            enu_from_body: self.enu_from_body * turn.matrix(),
        }
    }
}

/// Body and camera with the shared errors (SI units) taken out.
pub(super) struct Corrected {
    enu_from_body: Matrix3<f64>,
    enu_from_cam: Matrix3<f64>,
    /// From the body's origin to the camera, mission plane.
    arm: Vector3<f64>,
    centre: Vector3<f64>,
}

impl Corrected {
    /// The reported attitude is `turn(-up, heading) R exp(body)` of the true one, `R`.
    pub(super) fn new(
        station: &Station,
        optics: &Optics,
        up: &Vector3<f64>,
        errors: &SVector<f64, SHARED>,
    ) -> Self {
        let three = |from: Shared| errors.fixed_rows::<3>(from as usize).into_owned();
        let tilt = errors.fixed_rows::<2>(Shared::Tilt as usize);
        let heading = errors[Shared::HeadingConstant as usize] + errors[Shared::Heading as usize];
        let body = three(Shared::Boresight)
            + three(Shared::AttitudeJitter)
            + Vector3::new(tilt[0], tilt[1], 0.0);
        let enu_from_body = Rotation3::new(up * heading).matrix()
            * station.enu_from_body
            * Rotation3::new(-body).matrix();
        let arm = enu_from_body * (optics.lever_arm_m - three(Shared::LeverArm));
        let gnss = GNSS.map(three).iter().sum::<Vector3<f64>>() + three(Shared::PositionJitter);
        Self {
            enu_from_body,
            enu_from_cam: enu_from_body * optics.body_from_cam,
            arm,
            centre: station.body_enu - gnss + arm,
        }
    }

    pub(super) fn lens(
        &self,
        optics: &Optics,
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
        for from in GNSS.into_iter().chain([Shared::PositionJitter]) {
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
        Lens {
            optics: *optics,
            centre: self.centre,
            enu_from_cam: self.enu_from_cam,
            centre_by_shared: centre * scale,
            turn_by_shared: turn * scale,
            disparity_sigma_px: sigmas[Shared::Disparity as usize],
            disparity_offset_px,
        }
    }
}

/// How the camera moves with the clock error, and what strays from that straight line.
pub(super) struct ClockSlope {
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
    pub(super) fn straight_on(station: &Station, pose: &Pose, corrected: &Corrected) -> Self {
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
