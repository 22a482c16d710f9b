//! Position of one fire: its sightings linearised, and taken into the [`Joint`] estimate.

use super::joint::{Joint, LOCAL, PER_FIRE};
use crate::alarm::Method;
use crate::locate::{Fix, SHARED, Shared, Sighting, Terrain, View};
use emberfix_frames::{Coordinate, Covariance, Matrix3, Metres, MissionEnu, Vector3, Wgs84Parts};
use nalgebra::{SMatrix, SVector};
use std::collections::BTreeSet;

const TERRAIN: usize = 3;
type State = SVector<f64, PER_FIRE>;

/// Where a fire is and how sure, read off the joint estimate, and what that rests on.
#[derive(Debug, Clone)]
pub struct Estimate {
    state: State,
    covariance: SMatrix<f64, PER_FIRE, PER_FIRE>,
    methods: BTreeSet<Method>,
    first_sight: Vector3<f64>,
}

/// A linearised measurement: residual to the prediction at a state and zero shared errors.
struct Measurement<const M: usize> {
    residual: SVector<f64, M>,
    by_state: SMatrix<f64, M, PER_FIRE>,
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
    /// Starts from a first fix, as the last fire of the joint estimate: bearing known, range
    /// diffuse; [`Estimate::refine`] then takes in what disparity and terrain say.
    #[must_use]
    pub fn start(
        sighting: &Sighting,
        fix: &Fix,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        joint: &mut Joint,
        slot: usize,
    ) -> Option<Self> {
        let point = fix.enu.metres();
        let ray = (point - view.camera_enu).try_normalize(1e-6)?;
        let along = ray * (DIFFUSE * fix.range_m);
        let across = view.across_covariance(&ray, fix.range_m, sighting.base_sigma_px);
        let position: Matrix3<f64> = along * along.transpose() + across.m2();
        let terrain_sigma = terrain.map_or(0.0, |t| t.sigma_m(&fix.place));
        let mut own = SMatrix::<f64, PER_FIRE, PER_FIRE>::zeros();
        own.fixed_view_mut::<3, 3>(0, 0).copy_from(&position);
        own[(TERRAIN, TERRAIN)] = terrain_sigma * terrain_sigma;
        let mut placed_by_shared = scaled(view.position_by_shared(&point), view);
        placed_by_shared.set_column(Shared::Disparity as usize, &Vector3::zeros());
        let mut by_shared = SMatrix::<f64, PER_FIRE, SHARED>::zeros();
        // The placed point is truth plus D n: the truth is the placed point minus D n.
        by_shared
            .fixed_view_mut::<3, SHARED>(0, 0)
            .copy_from(&-placed_by_shared);
        joint.add(
            &State::new(point.x, point.y, point.z, 0.0),
            &by_shared,
            &own,
        );
        Some(Self {
            state: joint.fire(slot),
            covariance: joint.between(slot, slot),
            methods: BTreeSet::new(),
            first_sight: ray,
        })
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

    /// Reads position and covariance off the joint estimate.
    pub fn read_off(&mut self, joint: &Joint, slot: usize) {
        self.state = joint.fire(slot);
        self.covariance = joint.between(slot, slot);
    }

    /// Squared Mahalanobis distance of a sighting, its disparity included when it has one; `None`
    /// when the fire can't be seen from there.
    #[must_use]
    pub fn distance(
        &self,
        sighting: &Sighting,
        view: &View<'_>,
        joint: &Joint,
        slot: usize,
    ) -> Option<f64> {
        let m = self.optical(sighting, view, &self.state)?;
        let residual = m.residual - m.by_shared * joint.shared();
        let by_local = by_local(&m);
        let spread = by_local * joint.local(slot) * by_local.transpose() + m.noise;
        Some(residual.dot(&spread.cholesky()?.solve(&residual)))
    }

    /// Takes a sighting in: bearing, disparity, terrain. The shared errors learn from it.
    pub fn update(
        &mut self,
        sighting: &Sighting,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        joint: &mut Joint,
        slot: usize,
    ) {
        let sight = (self.position_m() - view.camera_enu).normalize();
        if sight.angle(&self.first_sight) > PARALLAX_RAD {
            self.methods.insert(Method::Parallax);
        }
        self.take_optical(sighting, view, joint, slot);
        self.note_stereo(sighting);
        self.take_terrain(view, terrain, joint, slot);
    }

    /// Takes disparity and terrain of the first sighting in; its bearing is in the start already.
    pub fn refine(
        &mut self,
        sighting: &Sighting,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        joint: &mut Joint,
        slot: usize,
    ) {
        if let Some(disparity) = self.disparity(sighting, view, &self.state) {
            self.apply(&disparity, joint, slot);
        }
        self.note_stereo(sighting);
        self.take_terrain(view, terrain, joint, slot);
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
        joint: &mut Joint,
        slot: usize,
    ) {
        let prior = self.state;
        let covariance = joint.local(slot);
        let mut at = prior;
        for pass in 0..=PASSES {
            let Some(mut m) = self.optical(sighting, view, &at) else {
                return;
            };
            m.residual -= m.by_state * (prior - at);
            if pass == PASSES {
                self.apply(&m, joint, slot);
                return;
            }
            let Some(gain) = gain(&m, &covariance) else {
                return;
            };
            let step = gain * (m.residual - m.by_shared * joint.shared());
            at = prior + step.fixed_rows::<PER_FIRE>(SHARED);
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
        m.by_state
            .fixed_view_mut::<2, 3>(0, 0)
            .copy_from(&predicted.by_position);
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
    fn disparity(
        &self,
        sighting: &Sighting,
        view: &View<'_>,
        at: &State,
    ) -> Option<Measurement<1>> {
        let measured = sighting.disparity?;
        let base = at.fixed_rows::<3>(0).into_owned();
        let ray = view.ray_enu(measured.centroid);
        let above = view.camera_enu + ray * view.range_beneath(&base, &ray)?;
        let height = (above - base).dot(view.up());
        let predicted = view.predict(&(base + view.up() * height))?;
        let mut by_state = SMatrix::<f64, 1, PER_FIRE>::zeros();
        by_state
            .fixed_view_mut::<1, 3>(0, 0)
            .copy_from(&predicted.disparity_by_position);
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
        joint: &mut Joint,
        slot: usize,
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
        let by_state = SMatrix::<f64, 1, PER_FIRE>::new(-slope(0), -slope(1), 1.0, -1.0);
        let m = Measurement {
            residual: SVector::<f64, 1>::new(ground + self.state[TERRAIN] - here.z),
            by_state,
            by_shared: SMatrix::zeros(),
            noise: SMatrix::<f64, 1, 1>::new(TERRAIN_NOISE_M * TERRAIN_NOISE_M),
        };
        self.apply(&m, joint, slot);
        self.methods.insert(Method::Terrain);
    }

    fn apply<const M: usize>(&mut self, m: &Measurement<M>, joint: &mut Joint, slot: usize) {
        let residual = m.residual - m.by_shared * joint.shared();
        joint.update(slot, &residual, &by_local(m), &m.noise);
        self.read_off(joint, slot);
    }
}

fn by_local<const M: usize>(m: &Measurement<M>) -> SMatrix<f64, M, LOCAL> {
    let mut by_local = SMatrix::<f64, M, LOCAL>::zeros();
    by_local
        .fixed_view_mut::<M, SHARED>(0, 0)
        .copy_from(&m.by_shared);
    by_local
        .fixed_view_mut::<M, PER_FIRE>(0, SHARED)
        .copy_from(&m.by_state);
    by_local
}

fn gain<const M: usize>(
    m: &Measurement<M>,
    local: &SMatrix<f64, LOCAL, LOCAL>,
) -> Option<SMatrix<f64, LOCAL, M>> {
    let by_local = by_local(m);
    let lever = local * by_local.transpose();
    let inverse = (by_local * lever + m.noise).try_inverse()?;
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
