//! The normal equations of one view: how its corners' errors move with the rig, the board's corners,
//! the board's pose, and the board's step between the eyes.

use super::project::{INTRINSICS, project};
use super::state::{
    BoardPose, GLOBALS, OWN, OwnVector, ROTATION, STEP, State, Step, TRANSLATION, matrix_of,
};
use super::weights::Weights;
use super::{Board, Corner, View};
use emberfix_frames::{Matrix3, Vector3};
use nalgebra::{DMatrix, DVector, SMatrix, Vector2};

pub(super) type OwnMatrix = SMatrix<f64, OWN, OWN>;

/// One corner: how far off, and how its projection changes with everything.
pub(super) struct Row {
    pub off: Vector2<f64>,
    by_rig: SMatrix<f64, 2, GLOBALS>,
    by_corner: SMatrix<f64, 2, 3>,
    by_own: SMatrix<f64, 2, OWN>,
}

pub(super) fn left_row(state: &State, view: usize, board: &Board, corner: &Corner) -> Row {
    let pose = &state.boards[view];
    let on_board = state.on_board_m(board, corner.id);
    let seen = project(&state.left, &pose.point_m(&on_board));
    let mut by_rig = SMatrix::<f64, 2, GLOBALS>::zeros();
    by_rig
        .fixed_view_mut::<2, INTRINSICS>(0, 0)
        .copy_from(&seen.by_intrinsics);
    let mut by_own = SMatrix::<f64, 2, OWN>::zeros();
    by_own
        .fixed_view_mut::<2, 6>(0, 0)
        .copy_from(&(seen.by_point * by_pose(pose, &on_board)));
    Row {
        off: found(corner) - seen.pixel,
        by_rig,
        by_corner: seen.by_point * pose.left_from_board,
        by_own,
    }
}

pub(super) fn right_row(state: &State, view: usize, board: &Board, corner: &Corner) -> Row {
    let (pose, step) = (&state.boards[view], &state.steps[view]);
    let on_board = state.on_board_m(board, corner.id);
    let stepped = Stepped::of(pose, step, board, &on_board);
    let turned = state.right_from_left * stepped.point_m;
    let seen = project(&state.right, &(turned + state.translation_m));
    let by_left_point = seen.by_point * state.right_from_left;

    let mut by_rig = SMatrix::<f64, 2, GLOBALS>::zeros();
    by_rig
        .fixed_view_mut::<2, INTRINSICS>(0, INTRINSICS)
        .copy_from(&seen.by_intrinsics);
    by_rig
        .fixed_view_mut::<2, 3>(0, ROTATION)
        .copy_from(&(seen.by_point * -turned.cross_matrix()));
    by_rig
        .fixed_view_mut::<2, 3>(0, TRANSLATION)
        .copy_from(&seen.by_point);
    Row {
        off: found(corner) - seen.pixel,
        by_rig,
        by_corner: by_left_point * stepped.turn * pose.left_from_board,
        by_own: by_left_point * stepped.by_own,
    }
}

/// A corner where the right eye saw it, in the left camera.
struct Stepped {
    point_m: Vector3<f64>,
    turn: Matrix3<f64>,
    by_own: SMatrix<f64, 3, OWN>,
}

impl Stepped {
    fn of(pose: &BoardPose, step: &Step, board: &Board, on_board: &Vector3<f64>) -> Self {
        let middle = board.middle_m();
        let turn = matrix_of(&step.turn_rad);
        let arm = turn * (pose.left_from_board * (on_board - middle));
        let (by_point, by_middle) = (by_pose(pose, on_board), by_pose(pose, &middle));
        let mut by_own = SMatrix::<f64, 3, OWN>::zeros();
        by_own
            .fixed_view_mut::<3, 6>(0, 0)
            .copy_from(&(turn * (by_point - by_middle) + by_middle));
        // For small turns: exact where there is none.
        by_own
            .fixed_view_mut::<3, 3>(0, STEP)
            .copy_from(&-arm.cross_matrix());
        by_own
            .fixed_view_mut::<3, 3>(0, STEP + 3)
            .copy_from(&Matrix3::identity());
        Self {
            point_m: pose.point_m(&middle) + arm + step.move_m,
            turn,
            by_own,
        }
    }
}

fn found(corner: &Corner) -> Vector2<f64> {
    Vector2::new(corner.pixel.u, corner.pixel.v)
}

fn by_pose(pose: &BoardPose, on_board: &Vector3<f64>) -> SMatrix<f64, 3, 6> {
    let mut derivative = SMatrix::<f64, 3, 6>::zeros();
    let arm = pose.left_from_board * on_board;
    derivative
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&-arm.cross_matrix());
    derivative
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&Matrix3::identity());
    derivative
}

/// The normal equations of one view, over the shared parameters (the rig, and the board's corners where
/// they are solved for) and the view's own.
pub(super) struct ViewEquations {
    pub shared: DMatrix<f64>,
    cross: DMatrix<f64>,
    pub own: OwnMatrix,
    shared_gradient: DVector<f64>,
    own_gradient: OwnVector,
    /// Weighted squares of the corners' errors, and of the step.
    pub cost: f64,
    /// Squares of the corners' errors, pixels²: left, right.
    pub squares_px2: [f64; 2],
}

impl ViewEquations {
    /// `shared` is how many parameters all views share.
    pub(super) fn new(
        state: &State,
        at: usize,
        board: &Board,
        view: &View,
        weights: &Weights,
        shared: usize,
    ) -> Self {
        let mut sum = Self {
            shared: DMatrix::zeros(shared, shared),
            cross: DMatrix::zeros(shared, OWN),
            own: OwnMatrix::zeros(),
            shared_gradient: DVector::zeros(shared),
            own_gradient: OwnVector::zeros(),
            cost: 0.0,
            squares_px2: [0.0; 2],
        };
        let [left, right] = weights.of_corners();
        for corner in &view.left {
            let row = left_row(state, at, board, corner);
            sum.squares_px2[0] += row.off.norm_squared();
            sum.add(&row, corner.id, left);
        }
        for corner in &view.right {
            let row = right_row(state, at, board, corner);
            sum.squares_px2[1] += row.off.norm_squared();
            sum.add(&row, corner.id, right);
        }
        sum.hold_step(&state.steps[at], weights.of_step(at));
        sum
    }

    fn add(&mut self, row: &Row, corner: usize, weight: f64) {
        let rig_t = row.by_rig.transpose() * weight;
        let own_t = row.by_own.transpose() * weight;
        let mut block = self.shared.fixed_view_mut::<GLOBALS, GLOBALS>(0, 0);
        block += rig_t * row.by_rig;
        let mut block = self.cross.fixed_view_mut::<GLOBALS, OWN>(0, 0);
        block += rig_t * row.by_own;
        let mut block = self.shared_gradient.fixed_rows_mut::<GLOBALS>(0);
        block += rig_t * row.off;
        self.own += own_t * row.by_own;
        self.own_gradient += own_t * row.off;
        self.cost += weight * row.off.norm_squared();
        let at = GLOBALS + 3 * corner;
        if at < self.shared.nrows() {
            self.add_corner(row, at, weight);
        }
    }

    fn add_corner(&mut self, row: &Row, at: usize, weight: f64) {
        let corner_t = row.by_corner.transpose() * weight;
        let with_rig = corner_t * row.by_rig;
        let mut block = self.shared.fixed_view_mut::<3, 3>(at, at);
        block += corner_t * row.by_corner;
        let mut block = self.shared.fixed_view_mut::<3, GLOBALS>(at, 0);
        block += with_rig;
        let mut block = self.shared.fixed_view_mut::<GLOBALS, 3>(0, at);
        block += with_rig.transpose();
        let mut block = self.cross.fixed_view_mut::<3, OWN>(at, 0);
        block += corner_t * row.by_own;
        let mut block = self.shared_gradient.fixed_rows_mut::<3>(at);
        block += corner_t * row.off;
    }

    /// The board is held to its place between the eyes as firmly as the weights say.
    fn hold_step(&mut self, step: &Step, [turn, way]: [f64; 2]) {
        for axis in 0..3 {
            for (at, value, weight) in [
                (STEP + axis, step.turn_rad[axis], turn),
                (STEP + 3 + axis, step.move_m[axis], way),
            ] {
                self.own[(at, at)] += weight;
                self.own_gradient[at] -= weight * value;
                self.cost += weight * value * value;
            }
        }
    }

    /// The shared parameters' part once the view's own are eliminated.
    pub(super) fn reduced(&self, damping: f64) -> Option<(DMatrix<f64>, DVector<f64>)> {
        let inverse = inverse(&damped(self.own, damping))?;
        let gain = &self.cross * inverse;
        Some((
            &self.shared - &gain * self.cross.transpose(),
            &self.shared_gradient - &gain * self.own_gradient,
        ))
    }

    /// The view's own step once the shared one is known.
    pub(super) fn own_step(&self, shared_step: &DVector<f64>, damping: f64) -> Option<OwnVector> {
        let moved = self.cross.tr_mul(shared_step);
        let inverse = inverse(&damped(self.own, damping))?;
        Some(inverse * (self.own_gradient - OwnVector::from_column_slice(moved.as_slice())))
    }

    /// The pose's step alone: the board is held still between the eyes.
    pub(super) fn pose_step(&self) -> Option<OwnVector> {
        let pose = self.own.fixed_view::<STEP, STEP>(0, 0).into_owned();
        let step = pose
            .cholesky()?
            .solve(&self.own_gradient.fixed_rows::<STEP>(0).into_owned());
        let mut own = OwnVector::zeros();
        own.fixed_rows_mut::<STEP>(0).copy_from(&step);
        Some(own)
    }
}

fn damped(matrix: OwnMatrix, damping: f64) -> OwnMatrix {
    let mut matrix = matrix;
    for index in 0..OWN {
        matrix[(index, index)] *= 1.0 + damping;
    }
    matrix
}

/// Of a positive matrix whose parameters differ in scale by many orders.
pub(super) fn inverse(matrix: &OwnMatrix) -> Option<OwnMatrix> {
    let scale = OwnMatrix::from_diagonal(&matrix.diagonal().map(|value| value.sqrt().recip()));
    Some(scale * (scale * matrix * scale).cholesky()?.inverse() * scale)
}
