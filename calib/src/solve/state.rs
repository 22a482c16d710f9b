//! Everything that is solved for, and how a step of the solver moves it.

use super::project::{INTRINSICS, camera, intrinsics};
use super::{Board, StereoSolution};
use crate::Camera;
use emberfix_frames::{Matrix3, UnitQuaternion, Vector3};
use nalgebra::{DVectorView, SMatrix, SVector};

/// Parameters of the rig: nine of each camera, rotation, translation.
pub const GLOBALS: usize = 2 * INTRINSICS + 6;
/// A matrix over the rig's parameters.
pub type GlobalMatrix = SMatrix<f64, GLOBALS, GLOBALS>;
/// A vector of the rig's parameters.
pub type GlobalVector = SVector<f64, GLOBALS>;
/// Parameters of one view: its board's pose, and the board's step between the eyes.
pub(super) const OWN: usize = 12;
/// Where the step's turn begins among them; its move follows.
pub(super) const STEP: usize = 6;
pub(super) type OwnVector = SVector<f64, OWN>;

pub(super) const ROTATION: usize = 2 * INTRINSICS;
pub(super) const TRANSLATION: usize = ROTATION + 3;

/// Names of the rig's parameters with their units, in the order of the covariance.
#[must_use]
pub fn parameter_names() -> [&'static str; GLOBALS] {
    [
        "left.fx_px",
        "left.fy_px",
        "left.cx_px",
        "left.cy_px",
        "left.k1",
        "left.k2",
        "left.p1",
        "left.p2",
        "left.k3",
        "right.fx_px",
        "right.fy_px",
        "right.cx_px",
        "right.cy_px",
        "right.k1",
        "right.k2",
        "right.p1",
        "right.p2",
        "right.k3",
        "rotation.x_rad",
        "rotation.y_rad",
        "rotation.z_rad",
        "translation.x_m",
        "translation.y_m",
        "translation.z_m",
    ]
}

/// The rig's parameters of a solution as a list.
pub(super) fn values(solution: &StereoSolution) -> GlobalVector {
    let turn = UnitQuaternion::from_matrix(&solution.right_from_left).scaled_axis();
    let values = intrinsics(&solution.left).into_iter();
    GlobalVector::from_iterator(
        values
            .chain(intrinsics(&solution.right))
            .chain(turn.iter().copied())
            .chain(solution.translation_m.iter().copied()),
    )
}

/// A board in the left camera: takes board components to left-camera components.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardPose {
    /// Rotation.
    pub left_from_board: Matrix3<f64>,
    /// The board's first corner, metres.
    pub origin_m: Vector3<f64>,
}

impl BoardPose {
    pub(super) fn moved(&self, step: &OwnVector) -> Self {
        Self {
            left_from_board: turned(&self.left_from_board, &step.fixed_rows::<3>(0).into_owned()),
            origin_m: self.origin_m + step.fixed_rows::<3>(3),
        }
    }

    pub(super) fn point_m(&self, on_board: &Vector3<f64>) -> Vector3<f64> {
        self.left_from_board * on_board + self.origin_m
    }
}

/// How a board moved from the left eye's exposure to the right eye's, in left-camera axes: nothing where
/// the eyes are in step or the board was held still.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Step {
    /// Turn about the board's middle, a rotation vector, radians.
    pub turn_rad: Vector3<f64>,
    /// Way of the board's middle, metres.
    pub move_m: Vector3<f64>,
}

impl Step {
    fn moved(&self, step: &OwnVector) -> Self {
        Self {
            turn_rad: self.turn_rad + step.fixed_rows::<3>(STEP),
            move_m: self.move_m + step.fixed_rows::<3>(STEP + 3),
        }
    }
}

/// Everything that is solved for.
#[derive(Debug, Clone)]
pub(super) struct State {
    pub left: Camera,
    pub right: Camera,
    pub right_from_left: Matrix3<f64>,
    pub translation_m: Vector3<f64>,
    /// How far each corner of the board lies from where it should have been printed, board axes, metres.
    pub uneven_m: Vec<Vector3<f64>>,
    pub boards: Vec<BoardPose>,
    pub steps: Vec<Step>,
}

impl State {
    /// That of a solution, with some of its views.
    pub(super) fn from_solution(solution: &StereoSolution, views: &[usize]) -> Self {
        Self {
            left: solution.left.clone(),
            right: solution.right.clone(),
            right_from_left: solution.right_from_left,
            translation_m: solution.translation_m,
            uneven_m: solution.uneven_m.clone(),
            boards: views.iter().map(|&view| solution.boards[view]).collect(),
            steps: views.iter().map(|&view| solution.steps[view]).collect(),
        }
    }

    /// Moved by a step of the rig's parameters, and of the board's corners if it has those; poses stay.
    pub(super) fn moved(&self, step: DVectorView<'_, f64>) -> Self {
        let add = |of: &Camera, from: usize| {
            let mut values = intrinsics(of);
            for (value, change) in values.iter_mut().zip(step.iter().skip(from)) {
                *value += change;
            }
            camera(of.image_size_px, values)
        };
        let part = |from: usize| Vector3::new(step[from], step[from + 1], step[from + 2]);
        let mut uneven_m = self.uneven_m.clone();
        for (corner, off) in uneven_m.iter_mut().enumerate() {
            let at = GLOBALS + 3 * corner;
            if at < step.len() {
                *off += part(at);
            }
        }
        Self {
            left: add(&self.left, 0),
            right: add(&self.right, INTRINSICS),
            right_from_left: turned(&self.right_from_left, &part(ROTATION)),
            translation_m: self.translation_m + part(TRANSLATION),
            uneven_m,
            boards: self.boards.clone(),
            steps: self.steps.clone(),
        }
    }

    pub(super) fn move_view(&mut self, view: usize, step: &OwnVector) {
        self.boards[view] = self.boards[view].moved(step);
        self.steps[view] = self.steps[view].moved(step);
    }

    /// Where a corner really is on the board, metres.
    pub(super) fn on_board_m(&self, board: &Board, corner: usize) -> Vector3<f64> {
        board.point_m(corner) + self.uneven_m[corner]
    }
}

pub(super) fn turned(rotation: &Matrix3<f64>, by_rad: &Vector3<f64>) -> Matrix3<f64> {
    matrix_of(by_rad) * rotation
}

pub(super) fn matrix_of(turn_rad: &Vector3<f64>) -> Matrix3<f64> {
    UnitQuaternion::from_scaled_axis(*turn_rad)
        .to_rotation_matrix()
        .into_inner()
}
