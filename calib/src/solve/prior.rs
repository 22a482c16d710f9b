//! What is known of lenses and prints before any picture is taken.
//!
//! Sensors have square pixels; lenses are centred to a thousandth; prints are even to a half of a
//! thousandth of their size, and the paper lies flat to a few thousandths, or bends as a whole (after
//! Strobl and Hirzinger, "More accurate pinhole camera calibration with imperfect planar target", ICCV
//! workshops 2011, with priors where they fix corners).

use super::project::INTRINSICS;
use super::state::{GLOBALS, State};
use super::{Board, Model};
use crate::Camera;
use nalgebra::{DMatrix, DVector};

/// One sigma of the difference of the two focal lengths of a lens, as a share.
const SQUARE_PIXELS: f64 = 1e-3;
/// One sigma of each decentring term (p1, p2).
const DECENTRED: f64 = 1e-3;
/// One sigma of the third radial term: what the gate calls believable is two of these.
const THIRD_TERM: f64 = 0.5;
/// One sigma of a printed corner along the paper, as a share of the board's half diagonal.
const PRINTED: f64 = 5e-4;
/// One sigma of a corner's height over the board's plane, as a share of the half diagonal.
const ROUGH: f64 = 2e-3;
/// One sigma of the sag of a bent board at its outermost corner, as a share of the half diagonal.
const BENT: f64 = 1e-2;

/// Precision of the shared parameters beforehand, and what it says of a state.
pub(super) struct PriorEquations {
    pub matrix: DMatrix<f64>,
    pub gradient: DVector<f64>,
    pub cost: f64,
}

/// The parts that do not depend on the state.
pub(super) struct Prior {
    lens: bool,
    /// Precision of the corners' heights.
    heights: Option<DMatrix<f64>>,
    /// Precision of a corner's place along the paper.
    printed: f64,
}

impl Prior {
    pub(super) fn of(model: Model, board: &Board) -> Option<Self> {
        let half_m = half_diagonal_m(board);
        let heights = match model.uneven_board {
            true => Some(heights(board, half_m).cholesky()?.inverse()),
            false => None,
        };
        Some(Self {
            lens: model.lens_priors,
            heights,
            printed: (PRINTED * half_m).powi(-2),
        })
    }

    pub(super) fn equations(&self, state: &State, shared: usize) -> PriorEquations {
        let mut sum = PriorEquations {
            matrix: DMatrix::zeros(shared, shared),
            gradient: DVector::zeros(shared),
            cost: 0.0,
        };
        if self.lens {
            sum.hold_lens(&state.left, 0);
            sum.hold_lens(&state.right, INTRINSICS);
        }
        if let Some(heights) = &self.heights {
            sum.hold_print(state, self.printed);
            sum.hold_heights(state, heights);
        }
        sum
    }
}

impl PriorEquations {
    /// A sum of parameters, whose value should be zero.
    fn hold(&mut self, parts: &[(usize, f64)], value: f64, weight: f64) {
        for &(a, by_a) in parts {
            self.gradient[a] -= weight * by_a * value;
            for &(b, by_b) in parts {
                self.matrix[(a, b)] += weight * by_a * by_b;
            }
        }
        self.cost += weight * value * value;
    }

    fn hold_lens(&mut self, camera: &Camera, from: usize) {
        let (fx, fy) = camera.focal_px;
        let [_, _, p1, p2, k3] = camera.distortion;
        let square = (SQUARE_PIXELS * fx).powi(-2);
        self.hold(&[(from, 1.0), (from + 1, -1.0)], fx - fy, square);
        self.hold(&[(from + 6, 1.0)], p1, DECENTRED.powi(-2));
        self.hold(&[(from + 7, 1.0)], p2, DECENTRED.powi(-2));
        self.hold(&[(from + 8, 1.0)], k3, THIRD_TERM.powi(-2));
    }

    fn hold_print(&mut self, state: &State, weight: f64) {
        for (corner, off) in state.uneven_m.iter().enumerate() {
            let at = GLOBALS + 3 * corner;
            self.hold(&[(at, 1.0)], off.x, weight);
            self.hold(&[(at + 1, 1.0)], off.y, weight);
        }
    }

    fn hold_heights(&mut self, state: &State, precision: &DMatrix<f64>) {
        let count = state.uneven_m.len();
        let found = DVector::from_fn(count, |corner, _| state.uneven_m[corner].z);
        let pull = precision * &found;
        let at = |corner: usize| GLOBALS + 3 * corner + 2;
        for a in 0..count {
            self.gradient[at(a)] -= pull[a];
            for b in 0..count {
                self.matrix[(at(a), at(b))] += precision[(a, b)];
            }
        }
        self.cost += pull.dot(&found);
    }
}

fn half_diagonal_m(board: &Board) -> f64 {
    board.middle_m().norm()
}

/// Covariance of the corners' heights: each by itself, and all by one bend along two axes.
fn heights(board: &Board, half_m: f64) -> DMatrix<f64> {
    let count = board.corners();
    let mut covariance = DMatrix::identity(count, count) * (ROUGH * half_m).powi(2);
    let from_middle = |corner: usize| (board.point_m(corner) - board.middle_m()) / half_m;
    let bends: [fn(f64, f64) -> f64; 3] = [|x, _| x * x, |x, y| x * y, |_, y| y * y];
    for bend in bends {
        let shape = DVector::from_fn(count, |corner, _| {
            let place = from_middle(corner);
            bend(place.x, place.y)
        });
        covariance += &shape * shape.transpose() * (BENT * half_m).powi(2);
    }
    covariance
}
