//! One fire, given the common errors: coordinates `f = offset + by_common s + e`, `e ~ N(0, own)`.
//!
//! Given the common state `s` fires are independent, so a sighting of one never touches another's
//! block: what it says of `s` goes to [`Common`] once, and all fires follow.
//!
//! A fire starts as a direction and an inverse depth from where it was first seen (Civera, Davison,
//! Montiel, "Inverse depth parametrization for monocular SLAM", 2008: bearings from far away are
//! nearly linear in it) and becomes a plain position once it is held well enough.

use super::common::{COMMON, Common, Passage};
use crate::locate::{Distant, Lens};
use emberfix_frames::{Matrix3, Vector3};
use nalgebra::{DMatrix, DVector, SMatrix, SVector};

/// Numbers per fire: three coordinates, and by how much the ground there is above its model, metres.
pub const PER_FIRE: usize = 4;
/// Index of the terrain's offset.
pub const TERRAIN: usize = 3;
/// Numbers of one sighting: column, row, disparity, height above the terrain.
pub const MEASURED: usize = 4;

/// Coordinates of a fire.
pub type State = SVector<f64, PER_FIRE>;
/// How coordinates follow the common state.
pub type ByCommon = SMatrix<f64, PER_FIRE, COMMON>;
type Own = SMatrix<f64, PER_FIRE, PER_FIRE>;

/// What the first three coordinates mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Chart {
    /// Tangents to the right and down, and inverse depth (1/m), seen from a fixed origin.
    Anchored {
        /// Fixed, mission plane, metres.
        origin: Vector3<f64>,
        /// Right, down, forward; mission plane.
        axes: Matrix3<f64>,
    },
    /// East, north, up in the mission plane, metres.
    Plane,
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
    pub by_shared: SMatrix<f64, MEASURED, { crate::locate::SHARED }>,
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
/// Tangents are unknown beforehand: one sigma.
const ANY_TANGENT: f64 = 3.0;
/// Sigma over value of the inverse depth, all errors and own ones, below which a plain position is as linear.
const HELD: (f64, f64) = (0.2, 0.1);

impl Block {
    /// Nothing known but where it was looked for: `lens` at the pixel's ray, and an inverse depth.
    #[must_use]
    pub fn unseen(
        lens: &Lens,
        ray: &Vector3<f64>,
        inverse_depth: (f64, f64),
        terrain_sigma_m: f64,
    ) -> Self {
        let right = lens.enu_from_cam().column(0).into_owned();
        let right = (right - ray * right.dot(ray)).normalize();
        let axes = Matrix3::from_columns(&[right, ray.cross(&right), *ray]);
        let (depth, depth_sigma) = inverse_depth;
        let sigmas = State::new(ANY_TANGENT, ANY_TANGENT, depth_sigma, terrain_sigma_m);
        Self {
            chart: Chart::Anchored {
                origin: *lens.centre(),
                axes,
            },
            offset: State::new(0.0, 0.0, depth, 0.0),
            by_common: ByCommon::zeros(),
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
        let mut now = rows.fixed_columns_mut::<{ crate::locate::SHARED }>(0);
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

    /// Covariance of the coordinates, all errors.
    #[must_use]
    pub fn covariance(&self, common: &DMatrix<f64>) -> Own {
        let mut with_common = ByCommon::zeros();
        with_common.gemm(1.0, &self.by_common, common, 0.0);
        let all = with_common * self.by_common.transpose() + self.own;
        (all + all.transpose()) * 0.5
    }

    /// Becomes a plain position when that is as linear.
    pub fn settle(&mut self, common: &Common, covariance: &Own) -> bool {
        let Chart::Anchored { .. } = self.chart else {
            return false;
        };
        let state = self.state(common);
        let relative = |variance: f64| variance.max(0.0).sqrt() / state[2].max(LEAST_INVERSE_DEPTH);
        if relative(covariance[(2, 2)]) > HELD.0 || relative(self.own[(2, 2)]) > HELD.1 {
            return false;
        }
        let mut by_state = Own::identity();
        by_state
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&self.chart.position_by_state(&state));
        let mut settled = state;
        settled
            .fixed_rows_mut::<3>(0)
            .copy_from(&self.chart.position(&state));
        self.chart = Chart::Plane;
        self.by_common = by_state * self.by_common;
        let own = by_state * self.own * by_state.transpose();
        self.own = (own + own.transpose()) * 0.5;
        self.offset = settled;
        self.offset.gemv(-1.0, &self.by_common, common.mean(), 1.0);
        true
    }
}

impl Chart {
    /// The point for the camera's model, and its slopes over the three coordinates.
    #[must_use]
    pub fn distant(&self, state: &State) -> (Distant, Matrix3<f64>, Vector3<f64>) {
        match self {
            Self::Plane => {
                let point = state.fixed_rows::<3>(0).into_owned();
                (Distant::near(point), Matrix3::identity(), Vector3::zeros())
            }
            Self::Anchored { origin, axes } => {
                let over = state[2].max(LEAST_INVERSE_DEPTH);
                let at = origin * over + axes * Vector3::new(state[0], state[1], 1.0);
                let mut by = *axes;
                by.set_column(2, origin);
                (Distant { at, over }, by, Vector3::z())
            }
        }
    }

    /// Position in the mission plane, metres.
    #[must_use]
    pub fn position(&self, state: &State) -> Vector3<f64> {
        let (point, _, _) = self.distant(state);
        point.at / point.over
    }

    /// Position over the three coordinates.
    #[must_use]
    pub fn position_by_state(&self, state: &State) -> Matrix3<f64> {
        let (point, by, over_by) = self.distant(state);
        by / point.over - point.at * over_by.transpose() / (point.over * point.over)
    }
}
