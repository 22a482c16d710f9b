//! What a rig leaves of its views: one pose of the board for both eyes, however it moved between them.

use super::equations::{ViewEquations, left_row, right_row};
use super::state::{BoardPose, GLOBALS, State, Step};
use super::weights::Weights;
use super::{Board, Corner, Residual, StereoSolution, View, ViewResiduals};
use nalgebra::Vector2;

/// Of every view.
pub(super) fn of_all(
    board: &Board,
    views: &[View],
    state: &State,
    corner_px: [f64; 2],
) -> Vec<ViewResiduals> {
    let views = views.iter().zip(&state.boards);
    views
        .map(|(view, pose)| of_view(board, view, state, corner_px, *pose))
        .collect()
}

/// Of a view that the rig was not solved with; the pose is searched from a near one.
pub(super) fn held_out(
    solution: &StereoSolution,
    board: &Board,
    view: &View,
    near: BoardPose,
) -> ViewResiduals {
    let state = State::from_solution(solution, &[]);
    of_view(board, view, &state, solution.corner_sigma_px, near)
}

fn of_view(
    board: &Board,
    view: &View,
    rig: &State,
    corner_px: [f64; 2],
    near: BoardPose,
) -> ViewResiduals {
    let mut state = State {
        boards: vec![near],
        steps: vec![Step::default()],
        ..rig.clone()
    };
    let weights = Weights {
        corner_px,
        ..Weights::first(1, false)
    };
    for _ in 0..10 {
        let here = ViewEquations::new(&state, 0, board, view, &weights, GLOBALS);
        let Some(step) = here.pose_step() else {
            break;
        };
        state.move_view(0, &step);
    }
    residuals(&state, board, view)
}

fn residuals(state: &State, board: &Board, view: &View) -> ViewResiduals {
    let residual = |corner: &Corner, off: Vector2<f64>| Residual {
        at: corner.pixel,
        off_px: (off.x, off.y),
    };
    let (left, right) = (view.left.iter(), view.right.iter());
    ViewResiduals {
        name: view.name.clone(),
        left: left
            .map(|corner| residual(corner, left_row(state, 0, board, corner).off))
            .collect(),
        right: right
            .map(|corner| residual(corner, right_row(state, 0, board, corner).off))
            .collect(),
    }
}
