//! One fire, given the common errors: coordinates `f = offset + by_common s + e`, `e ~ N(0, own)`.
//!
//! Given the common state `s` fires are independent, so a sighting of one never touches another's
//! block: what it says of `s` goes to [`Common`] once, and all fires follow.
//!
//! A fire starts as a direction and an inverse depth from where it was first seen (Civera, Davison,
//! Montiel, "Inverse depth parametrization for monocular SLAM", 2008: bearings from far away are
//! nearly linear in it), and stays one.

use super::common::{COMMON, Common, Passage};
use crate::locate::{Distant, Lens, Linear, SHARED};
use emberfix_frames::{Matrix3, Vector3};
use nalgebra::{DMatrix, DVector, SMatrix, SVector};

/// Numbers per fire: where the camera was at the first sighting (east, north, up in the mission plane,
/// metres), by how much the ground at the fire is above its model, and the way to the fire.
pub const PER_FIRE: usize = 7;
/// Index of the terrain's offset, metres.
pub const TERRAIN: usize = 3;
/// Index of the way: tangents to the right and down, inverse depth (1/m).
const WAY: usize = 4;
/// Index of the inverse depth.
pub const INVERSE_DEPTH: usize = WAY + 2;
/// Numbers of one sighting: column, row, disparity, height above the terrain.
pub const MEASURED: usize = 4;

/// Coordinates of a fire.
pub type State = SVector<f64, PER_FIRE>;
/// How coordinates follow the common state.
pub type ByCommon = SMatrix<f64, PER_FIRE, COMMON>;
/// Three numbers over the coordinates.
pub type ByState = SMatrix<f64, 3, PER_FIRE>;
type Own = SMatrix<f64, PER_FIRE, PER_FIRE>;

/// What the way's coordinates mean: right, down, forward of it; mission plane.
///
/// The camera's place at the first sighting is part of the state, since it has its errors: an offset
/// of GNSS moves it and leaves the way alone, and a turned camera turns the way by the same angle,
/// whatever the way's length turns out to be. In a plain position both would be bound to the length
/// that was believed when they were linearised, and each better length would seem to say something
/// of them that no sighting does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Chart {
    axes: Matrix3<f64>,
}

/// A linearised sighting of one fire, whitened noise apart: rows that say nothing are zero and have
/// unit noise.
#[derive(Debug, Clone, Copy)]
pub struct Measurement {
    /// What is left at the fire's state that it was linearised at, and the common mean.
    pub residual: SVector<f64, MEASURED>,
    /// Over the fire's coordinates.
    pub by_state: SMatrix<f64, MEASURED, PER_FIRE>,
    /// Over the shared errors of this moment.
    pub by_shared: SMatrix<f64, MEASURED, SHARED>,
    /// Variances; rows are independent.
    pub noise: SVector<f64, MEASURED>,
}

impl Measurement {
    /// One that says nothing.
    #[must_use]
    pub fn silent() -> Self {
        Self {
            residual: SVector::zeros(),
            by_state: SMatrix::zeros(),
            by_shared: SMatrix::zeros(),
            noise: SVector::repeat(1.0),
        }
    }

    /// True when a row says something.
    #[must_use]
    pub fn says(&self, row: usize) -> bool {
        self.by_state.row(row).iter().any(|by| *by != 0.0)
    }
}

/// A fire's coordinates as a function of the common state.
#[derive(Debug, Clone)]
pub struct Block {
    chart: Chart,
    offset: State,
    by_common: ByCommon,
    own: Own,
}

/// What one sighting says of the common state, fire apart.
#[derive(Debug, Clone)]
pub struct Told {
    /// Rows over the common state.
    pub rows: SMatrix<f64, MEASURED, COMMON>,
    /// What is left.
    pub residual: SVector<f64, MEASURED>,
    /// Inverse square root of the covariance given the common state.
    pub whitener: SMatrix<f64, MEASURED, MEASURED>,
}

/// Inverse depth below which nothing is told apart from infinity, 1/m.
const LEAST_INVERSE_DEPTH: f64 = 2e-4;
/// Times the variance of a way that its square must exceed to count as flown at all.
const SURELY: f64 = 3.0;
/// Tangents are unknown beforehand: one sigma.
const ANY_TANGENT: f64 = 3.0;

impl Block {
    /// Nothing known but where it was looked for: from `lens` along `ray`, at an inverse depth.
    #[must_use]
    pub fn unseen(
        lens: &Lens,
        ray: &Vector3<f64>,
        inverse_depth: (f64, f64),
        terrain_sigma_m: f64,
        common: &Common,
    ) -> Self {
        let right = lens.enu_from_cam().column(0).into_owned();
        let right = (right - ray * right.dot(ray)).normalize();
        let axes = Matrix3::from_columns(&[right, ray.cross(&right), *ray]);
        let (depth, depth_sigma) = inverse_depth;
        let mut sigmas = State::zeros();
        sigmas[TERRAIN] = terrain_sigma_m;
        sigmas[WAY] = ANY_TANGENT;
        sigmas[WAY + 1] = ANY_TANGENT;
        sigmas[INVERSE_DEPTH] = depth_sigma;
        let mut by_common = ByCommon::zeros();
        by_common
            .fixed_view_mut::<3, SHARED>(0, 0)
            .copy_from(lens.centre_by_shared());
        let mut offset = State::zeros();
        offset
            .fixed_rows_mut::<3>(0)
            .copy_from(&(lens.centre() - lens.centre_by_shared() * common.now()));
        offset[INVERSE_DEPTH] = depth;
        Self {
            chart: Chart { axes },
            offset,
            by_common,
            own: Own::from_diagonal(&sigmas.component_mul(&sigmas)),
        }
    }

    /// Coordinates at the common mean.
    #[must_use]
    pub fn state(&self, common: &Common) -> State {
        let mut state = self.offset;
        state.gemv(1.0, &self.by_common, common.mean(), 1.0);
        state
    }

    /// Its own covariance, given the common state.
    #[must_use]
    pub fn own(&self) -> &Own {
        &self.own
    }

    /// What the coordinates mean.
    #[must_use]
    pub fn chart(&self) -> &Chart {
        &self.chart
    }

    /// How its coordinates follow the common state.
    #[must_use]
    pub fn by_common(&self) -> &ByCommon {
        &self.by_common
    }

    /// Share of the way from the first camera to `centre` that was surely flown, when it may be off by
    /// `variances` (east, north, up, m²): James and Stein's, across the line of sight.
    ///
    /// A camera that hovers is reported to wander about by what GNSS does. The fire does not move in
    /// the image with that; if each report counted as flown, each look would say that the fire is
    /// far away (errors in variables; the remedy is regression calibration).
    #[must_use]
    pub fn flown_share(&self, state: &State, centre: &Vector3<f64>, variances: &[f64; 3]) -> f64 {
        let flown = centre - state.fixed_rows::<3>(0);
        let ray = self.chart.axes.column(2);
        let across = flown - ray * ray.dot(&flown);
        let variance: f64 = (0..3)
            .map(|axis| variances[axis] * (1.0 - ray[axis] * ray[axis]))
            .sum();
        let length = across.norm_squared();
        (1.0 - SURELY * variance / length.max(f64::MIN_POSITIVE)).max(0.0)
    }

    /// Expresses what rested on replaced numbers of the common state by the new ones.
    pub fn carry(&mut self, passage: &Passage) {
        let rests_on = |index: &usize| self.by_common.column(*index).iter().any(|by| *by != 0.0);
        if !passage.replaced.iter().any(rests_on) {
            return;
        }
        let mut by_old = nalgebra::OMatrix::<f64, nalgebra::Const<PER_FIRE>, nalgebra::Dyn>::zeros(
            passage.replaced.len(),
        );
        for (column, index) in passage.replaced.iter().enumerate() {
            by_old.set_column(column, &self.by_common.column(*index));
            self.by_common.column_mut(*index).fill(0.0);
        }
        self.by_common.gemm(1.0, &by_old, &passage.by_new, 1.0);
        self.offset.gemv(1.0, &by_old, &passage.offset, 1.0);
        self.own += &by_old * &passage.spread * by_old.transpose();
    }

    /// What a measurement at `at` says of the common state.
    #[must_use]
    pub fn tells(&self, m: &Measurement, at: &State, common: &Common) -> Option<Told> {
        let mut rows = m.by_state * self.by_common;
        let mut now = rows.fixed_columns_mut::<SHARED>(0);
        now += m.by_shared;
        let residual = m.residual - m.by_state * (self.state(common) - at);
        let mut spread = m.by_state * self.own * m.by_state.transpose();
        for row in 0..MEASURED {
            spread[(row, row)] += m.noise[row];
        }
        let whitener = spread.cholesky()?.l().try_inverse()?;
        Some(Told {
            rows,
            residual,
            whitener,
        })
    }

    /// Takes a measurement in, given the common state; `told` is what it said, `mean` the common
    /// mean that it was taken at.
    pub fn learn(&mut self, m: &Measurement, told: &Told, mean: &DVector<f64>) {
        let weight = told.whitener.transpose() * told.whitener;
        let gain = self.own * m.by_state.transpose() * weight;
        // f | s, z = offset + A s + K (residual - G (s - mean)) + e'
        self.offset += gain * told.residual;
        let mut at_mean = SVector::<f64, MEASURED>::zeros();
        at_mean.gemv(1.0, &told.rows, mean, 0.0);
        self.offset += gain * at_mean;
        self.by_common -= gain * told.rows;
        let keep = Own::identity() - gain * m.by_state;
        let noise = SMatrix::<f64, MEASURED, MEASURED>::from_diagonal(&m.noise);
        let own = keep * self.own * keep.transpose() + gain * noise * gain.transpose();
        self.own = (own + own.transpose()) * 0.5;
    }

    /// Covariance of the position, all errors, m².
    #[must_use]
    pub fn position_covariance(&self, state: &State, common: &DMatrix<f64>) -> Matrix3<f64> {
        let slope = self.chart.position_by_state(state);
        let by_common = slope * self.by_common;
        let mut with_common = SMatrix::<f64, 3, COMMON>::zeros();
        with_common.gemm(1.0, &by_common, common, 0.0);
        let all = with_common * by_common.transpose() + slope * self.own * slope.transpose();
        (all + all.transpose()) * 0.5
    }
}

impl Chart {
    /// The point for the camera's model, and the slopes of its `at` and `over`.
    #[must_use]
    pub fn distant(&self, state: &State) -> (Distant, ByState, SMatrix<f64, 1, PER_FIRE>) {
        let place = state.fixed_rows::<3>(0).into_owned();
        let (mut by, mut over_by) = (ByState::zeros(), SMatrix::<f64, 1, PER_FIRE>::zeros());
        let over = state[INVERSE_DEPTH].max(LEAST_INVERSE_DEPTH);
        let at = place * over + self.axes * Vector3::new(state[WAY], state[WAY + 1], 1.0);
        by.fixed_columns_mut::<3>(0)
            .copy_from(&(Matrix3::identity() * over));
        by.fixed_columns_mut::<2>(WAY)
            .copy_from(&self.axes.fixed_columns::<2>(0));
        by.set_column(INVERSE_DEPTH, &place);
        over_by[INVERSE_DEPTH] = 1.0;
        (Distant { at, over }, by, over_by)
    }

    /// Position in the mission plane, metres.
    #[must_use]
    pub fn position(&self, state: &State) -> Vector3<f64> {
        let (point, _, _) = self.distant(state);
        point.at / point.over
    }

    /// The point's `over` slopes as if only a `share` of the way from the first camera to `centre`
    /// had been flown (see [`Block::flown_share`]).
    #[must_use]
    pub fn slopes(
        &self,
        linear: &Linear,
        state: &State,
        centre: &Vector3<f64>,
        share: f64,
    ) -> ByState {
        let (_, by, over_by) = self.distant(state);
        let place = state.fixed_rows::<3>(0).into_owned();
        let not_flown = linear.by_at * (centre - place) * (1.0 - share);
        linear.by_at * by + (linear.by_over + not_flown) * over_by
    }

    /// Position over the coordinates.
    #[must_use]
    pub fn position_by_state(&self, state: &State) -> ByState {
        let (point, by, over_by) = self.distant(state);
        by / point.over - point.at * over_by / (point.over * point.over)
    }
}
