//! The joint problem: both cameras, the pair, and every board pose at once, by Levenberg-Marquardt on
//! the reduced normal equations (board poses eliminated by the Schur complement, as in bundle
//! adjustment: Triggs et al., "Bundle adjustment, a modern synthesis", 2000).

use super::project::{INTRINSICS, camera, intrinsics, project};
use super::{Board, Corner, Residual, SolveError, StereoSolution, View, ViewResiduals};
use crate::Camera;
use emberfix_frames::{Matrix3, UnitQuaternion, Vector3};
use nalgebra::{SMatrix, SVector, Vector2, Vector6};

/// Parameters that all views share: nine of each camera, rotation, translation.
pub const GLOBALS: usize = 2 * INTRINSICS + 6;
/// A matrix over the shared parameters.
pub type GlobalMatrix = SMatrix<f64, GLOBALS, GLOBALS>;
/// A vector of the shared parameters.
pub type GlobalVector = SVector<f64, GLOBALS>;
/// Parameters of one view: its board's pose.
const OWN: usize = 6;
type Cross = SMatrix<f64, GLOBALS, OWN>;
type OwnMatrix = SMatrix<f64, OWN, OWN>;
type OwnVector = SVector<f64, OWN>;

const ROTATION: usize = 2 * INTRINSICS;
const TRANSLATION: usize = ROTATION + 3;

/// Names of the shared parameters with their units, in the order of the covariance.
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

/// The shared parameters of a solution as a list.
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

/// Everything that is solved for.
#[derive(Debug, Clone)]
pub(super) struct State {
    pub left: Camera,
    pub right: Camera,
    pub right_from_left: Matrix3<f64>,
    pub translation_m: Vector3<f64>,
    pub boards: Vec<BoardPose>,
}

impl State {
    pub(super) fn from_solution(solution: &StereoSolution, boards: Vec<BoardPose>) -> Self {
        Self {
            left: solution.left.clone(),
            right: solution.right.clone(),
            right_from_left: solution.right_from_left,
            translation_m: solution.translation_m,
            boards,
        }
    }

    /// Moved by a step of the shared parameters; boards stay.
    pub(super) fn moved(&self, step: &GlobalVector) -> Self {
        let add = |of: &Camera, from: usize| {
            let mut values = intrinsics(of);
            for (value, change) in values.iter_mut().zip(&step.as_slice()[from..]) {
                *value += change;
            }
            camera(of.image_size_px, values)
        };
        Self {
            left: add(&self.left, 0),
            right: add(&self.right, INTRINSICS),
            right_from_left: turned(
                &self.right_from_left,
                &step.fixed_rows::<3>(ROTATION).into_owned(),
            ),
            translation_m: self.translation_m + step.fixed_rows::<3>(TRANSLATION),
            boards: self.boards.clone(),
        }
    }
}

impl BoardPose {
    fn moved(&self, step: &Vector6<f64>) -> Self {
        Self {
            left_from_board: turned(&self.left_from_board, &step.fixed_rows::<3>(0).into_owned()),
            origin_m: self.origin_m + step.fixed_rows::<3>(3),
        }
    }

    fn point_m(&self, on_board: &Vector3<f64>) -> Vector3<f64> {
        self.left_from_board * on_board + self.origin_m
    }
}

fn turned(rotation: &Matrix3<f64>, by_rad: &Vector3<f64>) -> Matrix3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(*by_rad);
    turn.to_rotation_matrix().into_inner() * rotation
}

/// The normal equations of one eye in one view, over the parameters that move it.
struct EyeSum<const N: usize> {
    shared: SMatrix<f64, N, N>,
    cross: SMatrix<f64, N, OWN>,
    own: OwnMatrix,
    shared_gradient: SVector<f64, N>,
    own_gradient: OwnVector,
    cost: f64,
}

impl<const N: usize> EyeSum<N> {
    fn of(corners: &[Corner], weight: f64, row: impl Fn(&Corner) -> Row<N>) -> Self {
        let mut sum = Self {
            shared: SMatrix::zeros(),
            cross: SMatrix::zeros(),
            own: SMatrix::zeros(),
            shared_gradient: SVector::zeros(),
            own_gradient: SVector::zeros(),
            cost: 0.0,
        };
        for row in corners.iter().map(row) {
            let shared_t = row.by_shared.transpose() * weight;
            let own_t = row.by_own.transpose() * weight;
            sum.shared += shared_t * row.by_shared;
            sum.cross += shared_t * row.by_own;
            sum.own += own_t * row.by_own;
            sum.shared_gradient += shared_t * row.off;
            sum.own_gradient += own_t * row.off;
            sum.cost += weight * row.off.norm_squared();
        }
        sum
    }
}

/// The normal equations of one view.
struct ViewEquations {
    shared: GlobalMatrix,
    cross: Cross,
    own: OwnMatrix,
    shared_gradient: GlobalVector,
    own_gradient: OwnVector,
    cost: f64,
}

/// How far corners stray, one sigma per axis, pixels.
#[derive(Debug, Clone, Copy)]
struct Noise {
    left_px: f64,
    right_px: f64,
}

impl Noise {
    fn weights(self) -> [f64; 2] {
        [self.left_px.powi(-2), self.right_px.powi(-2)]
    }
}

/// One corner: how far off, and how that changes with `N` shared parameters that stand in a row and with
/// the board's pose.
struct Row<const N: usize> {
    off: Vector2<f64>,
    by_shared: SMatrix<f64, 2, N>,
    by_own: SMatrix<f64, 2, OWN>,
}

/// The left eye moves with its own camera and with the board.
type LeftRow = Row<INTRINSICS>;
/// The right eye moves with its own camera, the pair, and the board.
type RightRow = Row<RIGHT>;
const RIGHT: usize = INTRINSICS + 6;

fn left_row(state: &State, pose: &BoardPose, board: &Board, corner: &Corner) -> LeftRow {
    let on_board = board.point_m(corner.id);
    let seen = project(&state.left, &pose.point_m(&on_board));
    Row {
        off: found(corner) - seen.pixel,
        by_shared: seen.by_intrinsics,
        by_own: seen.by_point * point_by_pose(pose, &on_board),
    }
}

fn right_row(state: &State, pose: &BoardPose, board: &Board, corner: &Corner) -> RightRow {
    let on_board = board.point_m(corner.id);
    let turned = state.right_from_left * pose.point_m(&on_board);
    let seen = project(&state.right, &(turned + state.translation_m));
    let mut by_shared = SMatrix::<f64, 2, RIGHT>::zeros();
    let mut put = by_shared.fixed_view_mut::<2, INTRINSICS>(0, 0);
    put.copy_from(&seen.by_intrinsics);
    let mut put = by_shared.fixed_view_mut::<2, 3>(0, INTRINSICS);
    put.copy_from(&(seen.by_point * -turned.cross_matrix()));
    let mut put = by_shared.fixed_view_mut::<2, 3>(0, INTRINSICS + 3);
    put.copy_from(&seen.by_point);
    Row {
        off: found(corner) - seen.pixel,
        by_shared,
        by_own: seen.by_point * state.right_from_left * point_by_pose(pose, &on_board),
    }
}

fn found(corner: &Corner) -> Vector2<f64> {
    Vector2::new(corner.pixel.u, corner.pixel.v)
}

fn point_by_pose(pose: &BoardPose, on_board: &Vector3<f64>) -> SMatrix<f64, 3, 6> {
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

impl ViewEquations {
    fn new(
        state: &State,
        pose: &BoardPose,
        board: &Board,
        view: &View,
        [left_weight, right_weight]: [f64; 2],
    ) -> Self {
        let left = EyeSum::of(&view.left, left_weight, |corner| {
            left_row(state, pose, board, corner)
        });
        let right = EyeSum::of(&view.right, right_weight, |corner| {
            right_row(state, pose, board, corner)
        });
        let mut sum = Self {
            shared: GlobalMatrix::zeros(),
            cross: Cross::zeros(),
            own: OwnMatrix::zeros(),
            shared_gradient: GlobalVector::zeros(),
            own_gradient: OwnVector::zeros(),
            cost: 0.0,
        };
        sum.add(&left, 0);
        sum.add(&right, INTRINSICS);
        sum
    }

    /// Adds an eye whose shared parameters begin at `from`.
    fn add<const N: usize>(&mut self, eye: &EyeSum<N>, from: usize) {
        let mut shared = self.shared.fixed_view_mut::<N, N>(from, from);
        shared += &eye.shared;
        let mut cross = self.cross.fixed_view_mut::<N, OWN>(from, 0);
        cross += &eye.cross;
        let mut gradient = self.shared_gradient.fixed_rows_mut::<N>(from);
        gradient += &eye.shared_gradient;
        self.own += eye.own;
        self.own_gradient += eye.own_gradient;
        self.cost += eye.cost;
    }

    /// The shared parameters' part once the view's own are eliminated.
    fn reduced(&self, damping: f64) -> Option<(GlobalMatrix, GlobalVector)> {
        let inverse = damped(self.own, damping).cholesky()?.inverse();
        let gain = self.cross * inverse;
        Some((
            damped(self.shared, damping) - gain * self.cross.transpose(),
            self.shared_gradient - gain * self.own_gradient,
        ))
    }

    fn own_step(&self, shared_step: &GlobalVector, damping: f64) -> Option<OwnVector> {
        let right_side = self.own_gradient - self.cross.transpose() * shared_step;
        Some(damped(self.own, damping).cholesky()?.solve(&right_side))
    }
}

fn damped<const N: usize>(matrix: SMatrix<f64, N, N>, damping: f64) -> SMatrix<f64, N, N> {
    let mut matrix = matrix;
    for index in 0..N {
        matrix[(index, index)] *= 1.0 + damping;
    }
    matrix
}

fn equations(state: &State, board: &Board, views: &[View], noise: Noise) -> Vec<ViewEquations> {
    let views = views.iter().zip(&state.boards);
    views
        .map(|(view, pose)| ViewEquations::new(state, pose, board, view, noise.weights()))
        .collect()
}

fn cost(equations: &[ViewEquations]) -> f64 {
    equations.iter().map(|view| view.cost).sum()
}

const GREATEST_ITERATIONS: usize = 100;
/// Ends when the cost falls by less than this share.
const COST_SHARE: f64 = 1e-9;

/// Solves from a start; the eyes are weighted by their own corner noise.
pub(super) fn solve(
    board: &Board,
    views: &[View],
    start: State,
) -> Result<StereoSolution, SolveError> {
    let equal = Noise {
        left_px: 1.0,
        right_px: 1.0,
    };
    let state = minimise(board, views, start, equal)?;
    let [left_px, right_px] = corner_sigmas(&residuals(&state, board, views));
    let noise = Noise { left_px, right_px };
    let state = minimise(board, views, state, noise)?;
    finish(board, views, state, noise)
}

fn minimise(
    board: &Board,
    views: &[View],
    start: State,
    noise: Noise,
) -> Result<State, SolveError> {
    let mut state = start;
    let mut current = equations(&state, board, views, noise);
    let mut damping = 1e-4;
    for _ in 0..GREATEST_ITERATIONS {
        let Some(next) = step(&state, &current, damping) else {
            damping *= 10.0;
            if damping > 1e8 {
                return Err(SolveError::Undetermined);
            }
            continue;
        };
        let there = equations(&next, board, views, noise);
        let (before, after) = (cost(&current), cost(&there));
        if after.is_nan() || after > before {
            damping *= 10.0;
            if damping > 1e12 {
                break;
            }
            continue;
        }
        (state, current) = (next, there);
        damping = (damping * 0.1).max(1e-12);
        if before - after <= COST_SHARE * before {
            break;
        }
    }
    Ok(state)
}

fn step(state: &State, equations: &[ViewEquations], damping: f64) -> Option<State> {
    let mut matrix = GlobalMatrix::zeros();
    let mut gradient = GlobalVector::zeros();
    for view in equations {
        let (part, slope) = view.reduced(damping)?;
        matrix += part;
        gradient += slope;
    }
    let shared = scaled_inverse(&matrix)? * gradient;
    let mut next = state.moved(&shared);
    for (pose, view) in next.boards.iter_mut().zip(equations) {
        *pose = pose.moved(&view.own_step(&shared, damping)?);
    }
    Some(next)
}

/// The inverse of a positive matrix whose parameters differ in scale by many orders.
fn scaled_inverse(matrix: &GlobalMatrix) -> Option<GlobalMatrix> {
    let scale = matrix
        .diagonal()
        .map(|value| value.max(1e-300).sqrt().recip());
    let diagonal = GlobalMatrix::from_diagonal(&scale);
    let inverse = (diagonal * matrix * diagonal).cholesky()?.inverse();
    Some(diagonal * inverse * diagonal)
}

fn finish(
    board: &Board,
    views: &[View],
    state: State,
    noise: Noise,
) -> Result<StereoSolution, SolveError> {
    let equations = equations(&state, board, views, noise);
    let mut parts = Vec::with_capacity(equations.len());
    for view in &equations {
        parts.push(view.reduced(0.0).ok_or(SolveError::Undetermined)?);
    }
    let information: GlobalMatrix = parts.iter().map(|(matrix, _)| matrix).sum();
    let covariance = scaled_inverse(&information).ok_or(SolveError::Undetermined)?;
    let widening = jackknife_widening(&information, &parts, &covariance);
    let stretch = GlobalMatrix::from_diagonal(&widening);
    Ok(StereoSolution {
        corner_sigma_px: [noise.left_px, noise.right_px],
        covariance: stretch * covariance * stretch,
        widened_by: widening.max(),
        residuals: residuals(&state, board, views),
        left: state.left,
        right: state.right,
        right_from_left: state.right_from_left,
        translation_m: state.translation_m,
        boards: state.boards,
    })
}

/// For each parameter, how much further it moves when one view is left out than independent corners
/// would move it, at least 1. Each has its own: what whole views disagree about (the pair, most of all)
/// is not what corners disagree about.
fn jackknife_widening(
    information: &GlobalMatrix,
    parts: &[(GlobalMatrix, GlobalVector)],
    covariance: &GlobalMatrix,
) -> GlobalVector {
    let count = parts.len() as f64;
    let mut moves = Vec::with_capacity(parts.len());
    for (part, gradient) in parts {
        match scaled_inverse(&(information - part)) {
            Some(inverse) => moves.push(inverse * -gradient),
            // A view without which nothing is determined: the jackknife can't be told.
            None => return GlobalVector::repeat(1.0),
        }
    }
    let mean: GlobalVector = moves.iter().sum::<GlobalVector>() / count;
    GlobalVector::from_fn(|index, _| {
        let squares: f64 = moves.iter().map(|m| (m[index] - mean[index]).powi(2)).sum();
        let ratio = squares * (count - 1.0) / count / covariance[(index, index)];
        ratio.max(1.0).sqrt()
    })
}

/// One sigma of a corner along one axis, an eye each; the fitted parameters are counted, half an eye.
fn corner_sigmas(residuals: &[ViewResiduals]) -> [f64; 2] {
    let fitted = (GLOBALS + OWN * residuals.len()) as f64 / 2.0;
    let sigma = |eye: fn(&ViewResiduals) -> &Vec<Residual>| {
        let (mut count, mut squares) = (0.0, 0.0);
        for Residual { off_px: (u, v), .. } in residuals.iter().flat_map(eye) {
            count += 2.0;
            squares += u * u + v * v;
        }
        // Corners that fit perfectly have noise all the same: a thousandth of a pixel.
        (squares / f64::max(count - fitted, 1.0)).sqrt().max(1e-3)
    };
    [sigma(|view| &view.left), sigma(|view| &view.right)]
}

fn residuals(state: &State, board: &Board, views: &[View]) -> Vec<ViewResiduals> {
    let views = views.iter().zip(&state.boards);
    views
        .map(|(view, pose)| view_residuals(state, board, view, pose))
        .collect()
}

fn view_residuals(state: &State, board: &Board, view: &View, pose: &BoardPose) -> ViewResiduals {
    let residual = |corner: &Corner, off: Vector2<f64>| Residual {
        at: corner.pixel,
        off_px: (off.x, off.y),
    };
    let left = view.left.iter();
    let right = view.right.iter();
    ViewResiduals {
        name: view.name.clone(),
        left: left
            .map(|corner| residual(corner, left_row(state, pose, board, corner).off))
            .collect(),
        right: right
            .map(|corner| residual(corner, right_row(state, pose, board, corner).off))
            .collect(),
    }
}

/// What is left of a view that the cameras were not solved with: only its board's pose is fitted.
pub(super) fn held_out(
    solution: &StereoSolution,
    board: &Board,
    view: &View,
    near: BoardPose,
) -> ViewResiduals {
    let weights = solution.corner_sigma_px.map(|sigma| sigma.powi(-2));
    let state = State::from_solution(solution, Vec::new());
    let mut pose = near;
    for _ in 0..10 {
        let here = ViewEquations::new(&state, &pose, board, view, weights);
        let Some(step) = here.own_step(&GlobalVector::zeros(), 0.0) else {
            break;
        };
        pose = pose.moved(&step);
    }
    view_residuals(&state, board, view, &pose)
}
