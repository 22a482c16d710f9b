//! The joint problem: both cameras, the pair, the board's corners, every board pose and the board's step
//! between the eyes at once, by Levenberg-Marquardt on the reduced normal equations (what a view has for
//! itself is eliminated by the Schur complement, as in bundle adjustment: Triggs et al., "Bundle
//! adjustment, a modern synthesis", 2000).

use super::equations::ViewEquations;
use super::leftover;
use super::prior::{Prior, PriorEquations};
use super::state::{GLOBALS, GlobalMatrix, GlobalVector, State};
use super::weights::Weights;
use super::{Board, Model, SolveError, StereoSolution, View};
use nalgebra::{DMatrix, DVector};

/// What is asked.
pub(super) struct Problem<'a> {
    pub board: &'a Board,
    pub views: &'a [View],
    pub model: Model,
    prior: Prior,
    /// Parameters that all views share.
    shared: usize,
}

impl<'a> Problem<'a> {
    fn new(board: &'a Board, views: &'a [View], model: Model) -> Result<Self, SolveError> {
        let corners = if model.uneven_board {
            3 * board.corners()
        } else {
            0
        };
        Ok(Self {
            board,
            views,
            model,
            prior: Prior::of(model, board).ok_or(SolveError::Undetermined)?,
            shared: GLOBALS + corners,
        })
    }

    /// Numbers that were read in an eye's pictures: two a corner.
    pub(super) fn readings(&self, eye: usize) -> f64 {
        let corners = self.views.iter().map(|view| match eye {
            0 => view.left.len(),
            _ => view.right.len(),
        });
        2.0 * corners.sum::<usize>() as f64
    }

    fn equations(&self, state: &State, weights: &Weights) -> Equations {
        let of_view =
            |(at, view)| ViewEquations::new(state, at, self.board, view, weights, self.shared);
        Equations {
            views: self.views.iter().enumerate().map(of_view).collect(),
            prior: self.prior.equations(state, self.shared),
        }
    }
}

/// The normal equations of everything.
pub(super) struct Equations {
    pub views: Vec<ViewEquations>,
    pub prior: PriorEquations,
}

impl Equations {
    fn cost(&self) -> f64 {
        self.prior.cost + self.views.iter().map(|view| view.cost).sum::<f64>()
    }

    /// Of the shared parameters, priors included.
    pub(super) fn information(&self) -> Option<DMatrix<f64>> {
        let mut sum = self.prior.matrix.clone();
        for view in &self.views {
            sum += view.reduced(0.0)?.0;
        }
        Some(sum)
    }

    fn step(&self, from: &State, damping: f64) -> Option<State> {
        let mut matrix = self.prior.matrix.clone();
        let mut gradient = self.prior.gradient.clone();
        let mut stiffness = self.prior.matrix.diagonal();
        for view in &self.views {
            let (part, slope) = view.reduced(damping)?;
            matrix += part;
            gradient += slope;
            stiffness += view.shared.diagonal();
        }
        for index in 0..matrix.nrows() {
            matrix[(index, index)] += damping * stiffness[index];
        }
        let shared = scaled_solve(&matrix, &gradient)?;
        let mut next = from.moved(shared.as_view());
        for (at, view) in self.views.iter().enumerate() {
            next.move_view(at, &view.own_step(&shared, damping)?);
        }
        Some(next)
    }
}

const GREATEST_ITERATIONS: usize = 100;
/// Rounds of finding the weights.
const GREATEST_ROUNDS: usize = 25;
/// The fit ends when the cost falls by less than this share; between rounds a rough one does.
const COST_SHARE: f64 = 1e-9;
const ROUGH_COST_SHARE: f64 = 1e-4;

/// Solves from a start; corners and steps are weighted by what they turn out to stray.
pub(super) fn solve(
    board: &Board,
    views: &[View],
    start: State,
    model: Model,
) -> Result<StereoSolution, SolveError> {
    let problem = Problem::new(board, views, model)?;
    let mut weights = Weights::first(views.len(), model.moving_board);
    let mut state = start;
    for _ in 0..GREATEST_ROUNDS {
        state = minimise(&problem, state, &weights, ROUGH_COST_SHARE)?;
        let equations = problem.equations(&state, &weights);
        let next = weights
            .again(&problem, &state, &equations)
            .ok_or(SolveError::Undetermined)?;
        let settled = next.are_near(&weights);
        weights = next;
        if settled {
            break;
        }
    }
    let state = minimise(&problem, state, &weights, COST_SHARE)?;
    finish(&problem, state, &weights)
}

fn minimise(
    problem: &Problem<'_>,
    start: State,
    weights: &Weights,
    cost_share: f64,
) -> Result<State, SolveError> {
    let mut state = start;
    let mut current = problem.equations(&state, weights);
    let mut damping = 1e-4;
    for _ in 0..GREATEST_ITERATIONS {
        let Some(next) = current.step(&state, damping) else {
            damping *= 10.0;
            if damping > 1e8 {
                return Err(SolveError::Undetermined);
            }
            continue;
        };
        let there = problem.equations(&next, weights);
        let (before, after) = (current.cost(), there.cost());
        if after.is_nan() || after > before {
            damping *= 10.0;
            if damping > 1e12 {
                break;
            }
            continue;
        }
        (state, current) = (next, there);
        damping = (damping * 0.1).max(1e-12);
        if before - after <= cost_share * before {
            break;
        }
    }
    Ok(state)
}

/// One over the root of each diagonal element: parameters differ in scale by many orders.
fn scales(matrix: &DMatrix<f64>) -> DVector<f64> {
    matrix
        .diagonal()
        .map(|value| value.max(1e-300).sqrt().recip())
}

fn scaled(matrix: &DMatrix<f64>, scales: &DVector<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |row, column| {
        matrix[(row, column)] * scales[row] * scales[column]
    })
}

fn scaled_solve(matrix: &DMatrix<f64>, right_side: &DVector<f64>) -> Option<DVector<f64>> {
    let by = scales(matrix);
    let solved = scaled(matrix, &by)
        .cholesky()?
        .solve(&right_side.component_mul(&by));
    Some(solved.component_mul(&by))
}

/// The inverse of a positive matrix.
pub(super) fn scaled_inverse(matrix: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let by = scales(matrix);
    let inverse = scaled(matrix, &by).cholesky()?.inverse();
    Some(scaled(&inverse, &by))
}

fn finish(
    problem: &Problem<'_>,
    state: State,
    weights: &Weights,
) -> Result<StereoSolution, SolveError> {
    let equations = problem.equations(&state, weights);
    let information = equations.information().ok_or(SolveError::Undetermined)?;
    let covariance = scaled_inverse(&information).ok_or(SolveError::Undetermined)?;
    let rig: GlobalMatrix = covariance.fixed_view::<GLOBALS, GLOBALS>(0, 0).into_owned();
    let widening = jackknife_widening(&information, &equations, &rig);
    let stretch = GlobalMatrix::from_diagonal(&widening);
    Ok(StereoSolution {
        corner_sigma_px: weights.corner_px,
        step_sigma: (weights.turn_rad, weights.move_m),
        covariance: stretch * rig * stretch,
        widened_by: widening.max(),
        residuals: leftover::of_all(problem.board, problem.views, &state, weights.corner_px),
        model: problem.model,
        left: state.left,
        right: state.right,
        right_from_left: state.right_from_left,
        translation_m: state.translation_m,
        uneven_m: state.uneven_m,
        boards: state.boards,
        steps: state.steps,
    })
}

/// For each of the rig's parameters, how much further it moves when one view is left out than the
/// model's own noise would move it, at least 1. Each has its own: what whole views disagree about is not
/// what corners disagree about.
fn jackknife_widening(
    information: &DMatrix<f64>,
    equations: &Equations,
    covariance: &GlobalMatrix,
) -> GlobalVector {
    let count = equations.views.len() as f64;
    let mut moves = Vec::with_capacity(equations.views.len());
    for view in &equations.views {
        let without = view
            .reduced(0.0)
            .and_then(|(part, gradient)| scaled_solve(&(information - part), &-gradient));
        match without {
            Some(moved) => moves.push(moved.fixed_rows::<GLOBALS>(0).into_owned()),
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
