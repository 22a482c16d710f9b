//! Position of one fire: a Schmidt-Kalman filter over position and terrain offset, with the shared
//! errors considered.
//!
//! State: east, north, up of the fire's base in the mission plane, and by how much the ground there
//! is above the terrain model; metres. Shared errors are in units of their own sigma (`n`, unit
//! covariance), so that a sigma that changes in flight needs no bookkeeping.
//!
//! Source: S. F. Schmidt's consider filter as in Tapley, Schutz, Born, "Statistical Orbit
//! Determination" (2004), chapter 6: with measurement `y = H x + N n + v`, covariance `P`, and
//! cross-covariance `C = E[x n']`,
//! `S = H P H' + H C N' + N C' H' + N N' + R`, `K = (P H' + C N') S^-1`,
//! `P <- P - K (P H' + C N')'`, `C <- C - K (H C + N)`.

use super::TrackConfig;
use crate::alarm::Method;
use crate::locate::{Fix, SHARED, Shared, Sighting, Terrain, View};
use emberfix_frames::{
    Coordinate, Covariance, Matrix3, Metres, MissionEnu, ServiceTime, Vector3, Wgs84Parts,
};
use nalgebra::{SMatrix, SVector};
use std::collections::BTreeSet;

const STATES: usize = 4;
const TERRAIN: usize = 3;
type State = SVector<f64, STATES>;

/// Where a fire is, how sure, and how its error hangs together with the shared errors.
#[derive(Debug, Clone)]
pub struct Estimate {
    state: State,
    covariance: SMatrix<f64, STATES, STATES>,
    with_shared: SMatrix<f64, STATES, SHARED>,
    at: ServiceTime,
    methods: BTreeSet<Method>,
    first_sight: Vector3<f64>,
}

/// A linearised measurement.
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
    ) -> Option<Self> {
        let point = fix.enu.metres();
        let sight = point - view.camera_enu;
        let ray = sight.try_normalize(1e-6)?;
        let along = ray * (DIFFUSE * fix.range_m);
        let across = view.across_covariance(&ray, fix.range_m, sighting.base_sigma_px);
        let scale = SMatrix::<f64, SHARED, SHARED>::from_diagonal(view.shared_sigmas());
        let mut by_shared = view.position_by_shared(&point) * scale;
        by_shared.set_column(Shared::Disparity as usize, &Vector3::zeros());
        let position = along * along.transpose()
            + across.m2()
            + by_shared * by_shared.transpose();
        let terrain_sigma = terrain.map_or(0.0, |t| t.sigma_m(&fix.place));
        let mut covariance = SMatrix::<f64, STATES, STATES>::zeros();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&position);
        covariance[(TERRAIN, TERRAIN)] = terrain_sigma * terrain_sigma;
        let mut with_shared = SMatrix::<f64, STATES, SHARED>::zeros();
        // The placed point is truth plus D b: its error (truth minus estimate) is minus D b.
        with_shared.fixed_view_mut::<3, SHARED>(0, 0).copy_from(&-by_shared);
        let state = State::new(point.x, point.y, point.z, 0.0);
        Some(Self {
            state,
            covariance,
            with_shared,
            at: view.pose.at,
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

    /// Lets time pass: errors that wander become other errors, so what they have in common with
    /// this fire fades.
    pub fn age(&mut self, now: ServiceTime, config: &TrackConfig) {
        let dt_s = (now - self.at).as_secs_f64().max(0.0);
        self.at = now;
        let fade = |correlation_s: f64| (-dt_s / correlation_s).exp();
        for axis in 0..3 {
            self.fade_column(Shared::GnssEast as usize + axis, fade(config.gnss_correlation_s));
        }
        self.fade_column(Shared::Heading as usize, fade(config.heading_correlation_s));
    }

    fn fade_column(&mut self, column: usize, by: f64) {
        let faded = self.with_shared.column(column) * by;
        self.with_shared.set_column(column, &faded);
    }

    /// Squared Mahalanobis distance of a sighting, its disparity included when it has one; `None`
    /// when the fire can't be seen from there.
    #[must_use]
    pub fn distance(&self, sighting: &Sighting, view: &View<'_>) -> Option<f64> {
        let m = self.optical(sighting, view, &self.state)?;
        let spread = self.innovation(&m);
        let solved = spread.cholesky()?.solve(&m.residual);
        Some(m.residual.dot(&solved))
    }

    /// Squared Mahalanobis distance, horizontal, between two fires, given that their shared errors
    /// are the same ones; `extent_m` is how large the larger of them is.
    #[must_use]
    pub fn distance_between(&self, other: &Self, extent_m: f64) -> f64 {
        let common = self.with_shared * other.with_shared.transpose();
        let spread = self.covariance + other.covariance - common - common.transpose();
        let extent = nalgebra::Matrix2::identity() * (0.25 * extent_m * extent_m);
        let spread = spread.fixed_view::<2, 2>(0, 0) + extent;
        let difference = (self.state - other.state).fixed_rows::<2>(0).into_owned();
        match spread.cholesky() {
            Some(cholesky) => difference.dot(&cholesky.solve(&difference)),
            None => f64::INFINITY,
        }
    }

    /// Takes a sighting in: bearing, disparity, terrain.
    pub fn update(&mut self, sighting: &Sighting, view: &View<'_>, terrain: Option<&dyn Terrain>) {
        let sight = (self.position_m() - view.camera_enu).normalize();
        if sight.angle(&self.first_sight) > PARALLAX_RAD {
            self.methods.insert(Method::Parallax);
        }
        self.take_optical(sighting, view);
        self.note_stereo(sighting);
        self.take_terrain(view, terrain);
    }

    /// Takes disparity and terrain of the first sighting in; its bearing is in the start already.
    pub fn refine(&mut self, sighting: &Sighting, view: &View<'_>, terrain: Option<&dyn Terrain>) {
        if let Some(disparity) = self.disparity(sighting, view, &self.state) {
            self.apply(&disparity);
        }
        self.note_stereo(sighting);
        self.take_terrain(view, terrain);
    }

    fn note_stereo(&mut self, sighting: &Sighting) {
        if sighting.disparity.is_some() {
            self.methods.insert(Method::Stereo);
        }
    }

    /// Iterated update: linearises anew at each better position, but counts the sighting once.
    fn take_optical(&mut self, sighting: &Sighting, view: &View<'_>) {
        let prior = self.state;
        let mut at = prior;
        for _ in 0..PASSES {
            let Some(mut m) = self.optical(sighting, view, &at) else {
                return;
            };
            m.residual -= m.by_state * (prior - at);
            let Some(gain) = self.gain(&m) else {
                return;
            };
            at = prior + gain * m.residual;
        }
        if let Some(mut m) = self.optical(sighting, view, &at) {
            m.residual -= m.by_state * (prior - at);
            self.apply(&m);
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
        m.by_shared.fixed_view_mut::<2, SHARED>(0, 0).copy_from(&predicted.by_shared);
        m.noise[(0, 0)] = variance(sigma_u);
        m.noise[(1, 1)] = variance(sigma_v);
        if let Some(disparity) = self.disparity(sighting, view, at) {
            m.residual[2] = disparity.residual[0];
            m.by_state.set_row(2, &disparity.by_state.row(0));
            m.by_shared.set_row(2, &disparity.by_shared.row(0));
            m.noise[(2, 2)] = disparity.noise[(0, 0)];
        } else {
            m.by_shared = scaled(m.by_shared, view);
            return Some(m);
        }
        let optical = scaled(m.by_shared.fixed_rows::<2>(0).into_owned(), view);
        m.by_shared.fixed_rows_mut::<2>(0).copy_from(&optical);
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
    fn take_terrain(&mut self, view: &View<'_>, terrain: Option<&dyn Terrain>) {
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
        self.apply(&Measurement {
            residual: SVector::<f64, 1>::new(ground + self.state[TERRAIN] - here.z),
            by_state,
            by_shared: SMatrix::zeros(),
            noise: SMatrix::<f64, 1, 1>::new(TERRAIN_NOISE_M * TERRAIN_NOISE_M),
        });
        self.methods.insert(Method::Terrain);
    }

    fn innovation<const M: usize>(&self, m: &Measurement<M>) -> SMatrix<f64, M, M> {
        let cross = m.by_state * self.with_shared * m.by_shared.transpose();
        m.by_state * self.covariance * m.by_state.transpose()
            + cross
            + cross.transpose()
            + m.by_shared * m.by_shared.transpose()
            + m.noise
    }

    fn lever<const M: usize>(&self, m: &Measurement<M>) -> SMatrix<f64, STATES, M> {
        self.covariance * m.by_state.transpose() + self.with_shared * m.by_shared.transpose()
    }

    fn gain<const M: usize>(&self, m: &Measurement<M>) -> Option<SMatrix<f64, STATES, M>> {
        let inverse = self.innovation(m).try_inverse()?;
        Some(self.lever(m) * inverse)
    }

    fn apply<const M: usize>(&mut self, m: &Measurement<M>) {
        let Some(gain) = self.gain(m) else {
            return;
        };
        let lever = self.lever(m);
        self.state += gain * m.residual;
        let covariance = self.covariance - gain * lever.transpose();
        self.covariance = (covariance + covariance.transpose()) * 0.5;
        self.with_shared -= gain * (m.by_state * self.with_shared + m.by_shared);
    }
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
