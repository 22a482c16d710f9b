//! Position of one fire, given the shared errors.
//!
//! State `f`: east, north, up of the fire's base in the mission plane, and by how much the ground
//! there is above the terrain model; metres. With the shared errors `n` (unit covariance a priori),
//! a fire is kept as `f = m + G n + e`, `e ~ N(0, Q)`: given `n`, fires are independent of each
//! other, so a sighting of one changes `n` and that one only, and all others follow through their
//! `G`. This is the arrow-shaped joint estimate of all fires and shared errors, at a cost linear in
//! fires.
//!
//! Source: the extended Kalman filter on the joint state (n, f), as in Bar-Shalom, Li, Kirubarajan,
//! "Estimation with Applications to Tracking and Navigation" (2001), 10.3, iterated as in 10.5.2;
//! the factored form is that of Montemerlo et al., "FastSLAM" (2002), with a Gaussian instead of
//! particles for the shared part. Errors that wander correlate fires beyond `n`; that rest is
//! neglected, which makes differences between fires look less sure than they are.

use super::shared::{Passage, SharedEstimate};
use crate::alarm::Method;
use crate::locate::{Fix, SHARED, Shared, Sighting, Terrain, View};
use emberfix_frames::{
    Coordinate, Covariance, Matrix3, Metres, MissionEnu, Vector3, Wgs84Parts,
};
use nalgebra::{SMatrix, SVector};
use std::collections::BTreeSet;

const STATES: usize = 4;
const TERRAIN: usize = 3;
const JOINT: usize = SHARED + STATES;
type State = SVector<f64, STATES>;
type StateCovariance = SMatrix<f64, STATES, STATES>;
type ByShared = SMatrix<f64, STATES, SHARED>;

/// Where a fire is, how sure, and how its error hangs together with the shared errors.
#[derive(Debug, Clone)]
pub struct Estimate {
    given_zero: State,
    by_shared: ByShared,
    own: StateCovariance,
    /// The marginal, kept beside for those who only read.
    state: State,
    covariance: StateCovariance,
    methods: BTreeSet<Method>,
    first_sight: Vector3<f64>,
}

/// A linearised measurement: residual to the prediction at `state` and zero shared errors.
struct Measurement<const M: usize> {
    residual: SVector<f64, M>,
    by_state: SMatrix<f64, M, STATES>,
    by_shared: SMatrix<f64, M, SHARED>,
    noise: SMatrix<f64, M, M>,
}

/// Range sigma over range before disparity and terrain have spoken.
const DIFFUSE: f64 = 0.6;
/// How well a position can be held to the terrain model plus its offset, metres.
const TERRAIN_NOISE_M: f64 = 0.1;
/// Passes of the iterated update.
const PASSES: usize = 3;
/// Bearings further apart than this make a parallax, radians.
const PARALLAX_RAD: f64 = 0.05;
/// Step of the terrain's numeric slope, metres.
const SLOPE_STEP_M: f64 = 5.0;

impl Estimate {
    /// Starts from a first fix: bearing known, range diffuse; [`Estimate::refine`] then takes in
    /// what disparity and terrain say.
    #[must_use]
    pub fn start(
        sighting: &Sighting,
        fix: &Fix,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        shared: &SharedEstimate,
    ) -> Option<Self> {
        let point = fix.enu.metres();
        let ray = (point - view.camera_enu).try_normalize(1e-6)?;
        let along = ray * (DIFFUSE * fix.range_m);
        let across = view.across_covariance(&ray, fix.range_m, sighting.base_sigma_px);
        let position: Matrix3<f64> = along * along.transpose() + across.m2();
        let terrain_sigma = terrain.map_or(0.0, |t| t.sigma_m(&fix.place));
        let mut own = StateCovariance::zeros();
        own.fixed_view_mut::<3, 3>(0, 0).copy_from(&position);
        own[(TERRAIN, TERRAIN)] = terrain_sigma * terrain_sigma;
        let mut placed_by_shared = scaled(view.position_by_shared(&point), view);
        placed_by_shared.set_column(Shared::Disparity as usize, &Vector3::zeros());
        let mut by_shared = ByShared::zeros();
        // The placed point is truth plus D n: the truth is the placed point minus D n.
        by_shared.fixed_view_mut::<3, SHARED>(0, 0).copy_from(&-placed_by_shared);
        let mut started = Self {
            given_zero: State::new(point.x, point.y, point.z, 0.0),
            by_shared,
            own,
            state: State::zeros(),
            covariance: StateCovariance::zeros(),
            methods: BTreeSet::new(),
            first_sight: ray,
        };
        started.read_off(shared);
        Some(started)
    }

    /// Position in the mission plane, metres.
    #[must_use]
    pub fn position_m(&self) -> Vector3<f64> {
        self.state.fixed_rows::<3>(0).into_owned()
    }

    /// Covariance of the position.
    #[must_use]
    pub fn covariance(&self) -> Covariance<MissionEnu> {
        let block: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        // Non-negative by construction; rounding may leave a trace below zero, which reads as zero.
        Covariance::new(block).unwrap_or_else(|_| {
            let eigen = block.symmetric_eigen();
            let kept = Matrix3::from_diagonal(&eigen.eigenvalues.map(|v| v.max(0.0)));
            let m2 = eigen.eigenvectors * kept * eigen.eigenvectors.transpose();
            Covariance::new((m2 + m2.transpose()) * 0.5).unwrap_or_else(|_| Covariance::zero())
        })
    }

    /// What it rests on, sorted.
    #[must_use]
    pub fn methods(&self) -> Vec<Method> {
        self.methods.iter().copied().collect()
    }

    /// Follows the shared errors over time.
    pub fn pass(&mut self, passage: &Passage) {
        let by_shared = self.by_shared * passage.old_by_new;
        self.given_zero +=
            self.by_shared * passage.mean_before - by_shared * passage.mean_after;
        self.own += self.by_shared * passage.unsaid * self.by_shared.transpose();
        self.by_shared = by_shared;
    }

    /// Computes position and covariance from what is known of the shared errors now.
    pub fn read_off(&mut self, shared: &SharedEstimate) {
        self.state = self.given_zero + self.by_shared * shared.mean;
        let covariance =
            self.own + self.by_shared * shared.covariance * self.by_shared.transpose();
        self.covariance = (covariance + covariance.transpose()) * 0.5;
    }

    /// Squared Mahalanobis distance of a sighting, its disparity included when it has one; `None`
    /// when the fire can't be seen from there.
    #[must_use]
    pub fn distance(
        &self,
        sighting: &Sighting,
        view: &View<'_>,
        shared: &SharedEstimate,
    ) -> Option<f64> {
        let m = self.optical(sighting, view, &self.state)?;
        let residual = m.residual - m.by_shared * shared.mean;
        let by_joint = by_joint(&m);
        let spread = by_joint * self.joint_covariance(shared) * by_joint.transpose() + m.noise;
        Some(residual.dot(&spread.cholesky()?.solve(&residual)))
    }

    /// Squared Mahalanobis distance, horizontal, between two fires, given that their shared errors
    /// are the same ones; `extent_m` is how large the larger of them is.
    #[must_use]
    pub fn distance_between(&self, other: &Self, extent_m: f64, shared: &SharedEstimate) -> f64 {
        let by_shared = self.by_shared - other.by_shared;
        let spread =
            self.own + other.own + by_shared * shared.covariance * by_shared.transpose();
        let extent = nalgebra::Matrix2::identity() * (0.25 * extent_m * extent_m);
        let spread = spread.fixed_view::<2, 2>(0, 0) + extent;
        let difference = (self.state - other.state).fixed_rows::<2>(0).into_owned();
        match spread.cholesky() {
            Some(cholesky) => difference.dot(&cholesky.solve(&difference)),
            None => f64::INFINITY,
        }
    }

    /// Takes a sighting in: bearing, disparity, terrain. The shared errors learn from it.
    pub fn update(
        &mut self,
        sighting: &Sighting,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        shared: &mut SharedEstimate,
    ) {
        let sight = (self.position_m() - view.camera_enu).normalize();
        if sight.angle(&self.first_sight) > PARALLAX_RAD {
            self.methods.insert(Method::Parallax);
        }
        self.take_optical(sighting, view, shared);
        self.note_stereo(sighting);
        self.take_terrain(view, terrain, shared);
    }

    /// Takes disparity and terrain of the first sighting in; its bearing is in the start already.
    pub fn refine(
        &mut self,
        sighting: &Sighting,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        shared: &mut SharedEstimate,
    ) {
        if let Some(disparity) = self.disparity(sighting, view, &self.state) {
            self.apply(&disparity, shared);
        }
        self.note_stereo(sighting);
        self.take_terrain(view, terrain, shared);
    }

    fn note_stereo(&mut self, sighting: &Sighting) {
        if sighting.disparity.is_some() {
            self.methods.insert(Method::Stereo);
        }
    }

    /// Iterated update: linearises anew at each better position, but counts the sighting once.
    fn take_optical(
        &mut self,
        sighting: &Sighting,
        view: &View<'_>,
        shared: &mut SharedEstimate,
    ) {
        let prior = self.state;
        let covariance = self.joint_covariance(shared);
        let mut at = prior;
        for pass in 0..=PASSES {
            let Some(mut m) = self.optical(sighting, view, &at) else {
                return;
            };
            m.residual -= m.by_state * (prior - at);
            if pass == PASSES {
                self.apply(&m, shared);
                return;
            }
            let Some(gain) = gain(&m, &covariance) else {
                return;
            };
            let step = gain * (m.residual - m.by_shared * shared.mean);
            at = prior + step.fixed_rows::<STATES>(SHARED);
        }
    }

    /// Bearing and, when there is one, disparity. Without one the third row is void.
    fn optical(&self, sighting: &Sighting, view: &View<'_>, at: &State) -> Option<Measurement<3>> {
        let point = at.fixed_rows::<3>(0).into_owned();
        let predicted = view.predict(&point)?;
        let focal = view.rig.rectification().focal_px();
        let per_frame_px = focal * view.pose.attitude_noise_rad;
        let position_px = focal * view.pose.position_noise_m / predicted.depth_m;
        let (sigma_u, sigma_v) = sighting.base_sigma_px;
        let variance = |sigma: f64| sigma * sigma + per_frame_px.powi(2) + position_px.powi(2);
        let mut m = Measurement::<3> {
            residual: SVector::zeros(),
            by_state: SMatrix::zeros(),
            by_shared: SMatrix::zeros(),
            noise: SMatrix::identity(),
        };
        m.residual[0] = sighting.base.u - predicted.pixel.u;
        m.residual[1] = sighting.base.v - predicted.pixel.v;
        m.by_state.fixed_view_mut::<2, 3>(0, 0).copy_from(&predicted.by_position);
        let by_shared = scaled(predicted.by_shared, view);
        m.by_shared.fixed_rows_mut::<2>(0).copy_from(&by_shared);
        m.noise[(0, 0)] = variance(sigma_u);
        m.noise[(1, 1)] = variance(sigma_v);
        if let Some(disparity) = self.disparity(sighting, view, at) {
            m.residual[2] = disparity.residual[0];
            m.by_state.set_row(2, &disparity.by_state.row(0));
            m.by_shared.set_row(2, &disparity.by_shared.row(0));
            m.noise[(2, 2)] = disparity.noise[(0, 0)];
        }
        Some(m)
    }

    /// Disparity of the flame, which was measured above the base: by how much, the pixels say.
    fn disparity(&self, sighting: &Sighting, view: &View<'_>, at: &State) -> Option<Measurement<1>> {
        let measured = sighting.disparity?;
        let base = at.fixed_rows::<3>(0).into_owned();
        let ray = view.ray_enu(measured.centroid);
        let above = view.camera_enu + ray * view.range_beneath(&base, &ray)?;
        let height = (above - base).dot(view.up());
        let predicted = view.predict(&(base + view.up() * height))?;
        let mut by_state = SMatrix::<f64, 1, STATES>::zeros();
        by_state.fixed_view_mut::<1, 3>(0, 0).copy_from(&predicted.disparity_by_position);
        Some(Measurement {
            residual: SVector::<f64, 1>::new(measured.px - predicted.disparity_px),
            by_state,
            by_shared: scaled(predicted.disparity_by_shared, view),
            noise: SMatrix::<f64, 1, 1>::new(measured.sigma_px * measured.sigma_px),
        })
    }

    /// The base stands on the ground: up = terrain(east, north) + the fire's own terrain offset.
    fn take_terrain(
        &mut self,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        shared: &mut SharedEstimate,
    ) {
        let Some(terrain) = terrain else {
            return;
        };
        let here = self.position_m();
        let Some(ground) = ground_up(&here, view, terrain) else {
            return;
        };
        let slope = |axis: usize| {
            let mut there = here;
            there[axis] += SLOPE_STEP_M;
            ground_up(&there, view, terrain).map_or(0.0, |up| (up - ground) / SLOPE_STEP_M)
        };
        let by_state = SMatrix::<f64, 1, STATES>::new(-slope(0), -slope(1), 1.0, -1.0);
        let m = Measurement {
            residual: SVector::<f64, 1>::new(ground + self.state[TERRAIN] - here.z),
            by_state,
            by_shared: SMatrix::zeros(),
            noise: SMatrix::<f64, 1, 1>::new(TERRAIN_NOISE_M * TERRAIN_NOISE_M),
        };
        self.apply(&m, shared);
        self.methods.insert(Method::Terrain);
    }

    /// Covariance of (shared errors, this fire).
    fn joint_covariance(&self, shared: &SharedEstimate) -> SMatrix<f64, JOINT, JOINT> {
        let with_shared = self.by_shared * shared.covariance;
        let mut joint = SMatrix::<f64, JOINT, JOINT>::zeros();
        joint.fixed_view_mut::<SHARED, SHARED>(0, 0).copy_from(&shared.covariance);
        joint.fixed_view_mut::<STATES, SHARED>(SHARED, 0).copy_from(&with_shared);
        joint.fixed_view_mut::<SHARED, STATES>(0, SHARED).copy_from(&with_shared.transpose());
        joint.fixed_view_mut::<STATES, STATES>(SHARED, SHARED).copy_from(&self.covariance);
        joint
    }

    /// One update of (shared errors, this fire); then the fire is conditioned on the shared errors
    /// anew. A measurement that numbers can't take in is left out.
    fn apply<const M: usize>(&mut self, m: &Measurement<M>, shared: &mut SharedEstimate) {
        let prior = self.joint_covariance(shared);
        let Some(gain) = gain(m, &prior) else {
            return;
        };
        let step = gain * (m.residual - m.by_shared * shared.mean);
        let posterior = prior - gain * by_joint(m) * prior;
        let posterior = (posterior + posterior.transpose()) * 0.5;
        let of_shared = posterior.fixed_view::<SHARED, SHARED>(0, 0).into_owned();
        let Some(inverse) = of_shared.try_inverse() else {
            return;
        };
        shared.mean += step.fixed_rows::<SHARED>(0);
        shared.covariance = of_shared;
        let state = self.state + step.fixed_rows::<STATES>(SHARED);
        let with_shared = posterior.fixed_view::<STATES, SHARED>(SHARED, 0).into_owned();
        let covariance = posterior.fixed_view::<STATES, STATES>(SHARED, SHARED).into_owned();
        self.by_shared = with_shared * inverse;
        self.given_zero = state - self.by_shared * shared.mean;
        let own = covariance - self.by_shared * with_shared.transpose();
        self.own = (own + own.transpose()) * 0.5;
        self.read_off(shared);
    }
}

fn by_joint<const M: usize>(m: &Measurement<M>) -> SMatrix<f64, M, JOINT> {
    let mut by_joint = SMatrix::<f64, M, JOINT>::zeros();
    by_joint.fixed_view_mut::<M, SHARED>(0, 0).copy_from(&m.by_shared);
    by_joint.fixed_view_mut::<M, STATES>(0, SHARED).copy_from(&m.by_state);
    by_joint
}

fn gain<const M: usize>(
    m: &Measurement<M>,
    joint: &SMatrix<f64, JOINT, JOINT>,
) -> Option<SMatrix<f64, JOINT, M>> {
    let by_joint = by_joint(m);
    let lever = joint * by_joint.transpose();
    let inverse = (by_joint * lever + m.noise).try_inverse()?;
    Some(lever * inverse)
}

/// From units of the shared errors to units of their sigmas.
fn scaled<const M: usize>(
    by_shared: SMatrix<f64, M, SHARED>,
    view: &View<'_>,
) -> SMatrix<f64, M, SHARED> {
    by_shared * SMatrix::<f64, SHARED, SHARED>::from_diagonal(view.shared_sigmas())
}

/// Height of the terrain model beneath a point, in the mission plane.
fn ground_up(point: &Vector3<f64>, view: &View<'_>, terrain: &dyn Terrain) -> Option<f64> {
    let place = view.place(&Coordinate::<MissionEnu>::from_metres(*point))?;
    let ground = terrain.height_at(&place)?;
    Some(point.z + ground.m() - place.height().m())
}
