//! What the numbers of a fire mean: from where it was first seen, in which direction, and how far.
//!
//! The way is a direction and an inverse depth (Civera, Davison, Montiel, "Inverse depth parametrization
//! for monocular SLAM", 2008: bearings from far away are nearly linear in it). The camera's place at the
//! first look is among the numbers, since it has its errors: an offset of GNSS moves it and leaves the
//! way alone. In a plain position, or from a fixed place, both would be bound to the length at which
//! they were linearised, and each better length would seem to say something of GNSS that no sighting
//! does.

use crate::locate::{Distant, GNSS, Lens, Linear, SHARED, Shared};
use emberfix_frames::{Matrix3, Vector3};
use nalgebra::{SMatrix, SVector};

/// Numbers of a fire: the camera's place at the first look (east, north, up, m), tangents to the right
/// and down, inverse depth (1/m), and by how much the ground beneath is above its model (m).
pub const OF_FIRE: usize = 7;
/// Index of the tangents.
pub const TANGENTS: usize = 3;
/// Index of the inverse depth.
pub const INVERSE_DEPTH: usize = TANGENTS + 2;
/// Index of the terrain's offset, metres.
pub const TERRAIN: usize = INVERSE_DEPTH + 1;

/// Numbers of a fire.
pub type State = SVector<f64, OF_FIRE>;
/// Three numbers over those of the fire.
pub type ByState = SMatrix<f64, 3, OF_FIRE>;

/// What the numbers are counted from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Chart {
    /// The camera at the first look, without the GNSS errors that were taken out.
    origin: Vector3<f64>,
    /// Right, down, forward of the first line of sight; mission plane.
    axes: Matrix3<f64>,
}

/// Inverse depth below which nothing is told apart from infinity, 1/m.
const LEAST_INVERSE_DEPTH: f64 = 2e-4;
/// Times the variance of a way that its square must exceed to count as flown at all.
const SURELY: f64 = 3.0;

impl Chart {
    /// About a line of sight.
    #[must_use]
    pub fn along(lens: &Lens, errors: &SVector<f64, SHARED>, ray: &Vector3<f64>) -> Self {
        let right = lens.enu_from_cam().column(0).into_owned();
        let right = (right - ray * right.dot(ray)).normalize();
        Self {
            origin: without_gnss(lens, errors),
            axes: Matrix3::from_columns(&[right, ray.cross(&right), *ray]),
        }
    }

    /// The point for the camera's model, and the slopes of its `at` and `over`.
    #[must_use]
    pub fn distant(&self, state: &State) -> (Distant, ByState, SMatrix<f64, 1, OF_FIRE>) {
        let (mut by, mut over_by) = (ByState::zeros(), SMatrix::<f64, 1, OF_FIRE>::zeros());
        let over = state[INVERSE_DEPTH].max(LEAST_INVERSE_DEPTH);
        let place = place(state);
        let way = Vector3::new(state[TANGENTS], state[TANGENTS + 1], 1.0);
        let at = place * over + self.axes * way;
        by.fixed_columns_mut::<3>(0)
            .copy_from(&(Matrix3::identity() * over));
        by.fixed_columns_mut::<2>(TANGENTS)
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

    /// Position over the numbers.
    #[must_use]
    pub fn position_by_state(&self, state: &State) -> ByState {
        let (point, by, over_by) = self.distant(state);
        by / point.over - point.at * over_by / (point.over * point.over)
    }

    /// What is seen over the numbers, where a `way` from the first camera counts as flown.
    ///
    /// GNSS errors that the lens took out are no part of it: where the fire's range and the receiver's
    /// wander are sought together, a near fire makes a little wander explain much, and the most likely
    /// pair of both is far too near. The way as reported, less what may not have been flown, is not
    /// bent by what is sought (see [`Chart::flown_share`]).
    #[must_use]
    pub fn slopes(
        &self,
        linear: &Linear,
        state: &State,
        lens: &Lens,
        way: &Vector3<f64>,
    ) -> ByState {
        let (_, by, over_by) = self.distant(state);
        let not_flown = lens.centre() - place(state) - way;
        linear.by_at * by + (linear.by_over + linear.by_at * not_flown) * over_by
    }

    /// The way from the first camera to this one, without the GNSS errors that the lens took out.
    #[must_use]
    pub fn way(&self, lens: &Lens, errors: &SVector<f64, SHARED>) -> Vector3<f64> {
        without_gnss(lens, errors) - self.origin
    }

    /// Share of a reported way since the first look that was surely flown, when its error has these
    /// variances (east, north, up, m²): James and Stein's, across the line of sight.
    ///
    /// A camera that hovers is reported to wander about by what GNSS does. The fire does not move in
    /// the image with that; if each report counted as flown, each look would say that the fire is
    /// far away (errors in variables; the remedy is regression calibration).
    #[must_use]
    pub fn flown_share(&self, way: &Vector3<f64>, variances: &Vector3<f64>) -> f64 {
        let ray = self.axes.column(2);
        let across = way - ray * ray.dot(way);
        let variance: f64 = (0..3)
            .map(|axis| variances[axis] * (1.0 - ray[axis] * ray[axis]))
            .sum();
        let length = across.norm_squared().max(f64::MIN_POSITIVE);
        (1.0 - SURELY * variance / length).max(0.0)
    }
}

/// Where the camera was at the first look.
fn place(state: &State) -> Vector3<f64> {
    state.fixed_rows::<3>(0).into_owned()
}

/// Where the camera would be if GNSS were right.
fn without_gnss(lens: &Lens, errors: &SVector<f64, SHARED>) -> Vector3<f64> {
    let moved = |from: Shared| {
        let by = lens.centre_by_shared().fixed_columns::<3>(from as usize);
        by * errors.fixed_rows::<3>(from as usize)
    };
    lens.centre() - GNSS.map(moved).iter().sum::<Vector3<f64>>()
}
