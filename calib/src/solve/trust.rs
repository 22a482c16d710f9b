//! What the fit alone does not tell: views that spoil it, and how well it foretells views that it
//! has not seen.

use super::leftover::held_out;
use super::{Board, SolveError, StereoSolution, View, ViewResiduals, rms_px, solve_again};

/// A view that was left out, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Dropped {
    /// Its name.
    pub name: String,
    /// Root mean square of its corners' errors before it was left out, pixels.
    pub rms_px: f64,
    /// What was allowed at that moment, pixels.
    pub limit_px: f64,
}

/// How the cameras do on views that they were not solved with.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOut {
    /// Root mean square of the corners' errors, pixels; only the board's pose was fitted.
    pub rms_px: f64,
    /// The same corners' in the fit of everything, pixels.
    pub fitted_rms_px: f64,
    /// How many groups of views took their turn.
    pub folds: usize,
}

/// A view is worse than the others from this multiple of the median on.
const OUTLIER_RATIO: f64 = 2.5;
/// But never below this: corners are not found better than that, pixels.
const LEAST_LIMIT_PX: f64 = 0.15;
/// At most one view in so many is dropped.
const KEPT_OF: usize = 4;

/// Leaves out the worst view, solves again, and goes on while one stands out; returns the views that
/// stay, their solution, and those that went.
///
/// # Errors
/// [`SolveError`].
pub fn drop_worst(
    board: &Board,
    views: Vec<View>,
    solution: StereoSolution,
) -> Result<(Vec<View>, StereoSolution, Vec<Dropped>), SolveError> {
    let most = views.len() / KEPT_OF;
    let (mut views, mut solution, mut dropped) = (views, solution, Vec::new());
    while dropped.len() < most && views.len() > super::FEWEST_VIEWS {
        let Some((worst, found)) = worst_view(&solution) else {
            break;
        };
        let rest: Vec<usize> = (0..views.len()).filter(|&index| index != worst).collect();
        solution = solve_again(board, &views, &solution, &rest)?;
        views.remove(worst);
        dropped.push(found);
    }
    Ok((views, solution, dropped))
}

fn worst_view(solution: &StereoSolution) -> Option<(usize, Dropped)> {
    let errors: Vec<f64> = solution
        .residuals
        .iter()
        .map(ViewResiduals::rms_px)
        .collect();
    let limit_px = (OUTLIER_RATIO * median(&errors)?).max(LEAST_LIMIT_PX);
    let (worst, &rms_px) = errors
        .iter()
        .enumerate()
        .max_by(|a, b| a.1.total_cmp(b.1))?;
    let name = solution.residuals[worst].name.clone();
    (rms_px > limit_px).then_some((
        worst,
        Dropped {
            name,
            rms_px,
            limit_px,
        },
    ))
}

fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

/// Groups of views, each of which is held out once.
const FOLDS: usize = 5;

/// Solves without each fifth of the views in turn and looks at those that were held out.
///
/// # Errors
/// [`SolveError`].
pub fn cross_validate(
    board: &Board,
    views: &[View],
    solution: &StereoSolution,
) -> Result<HeldOut, SolveError> {
    let folds = FOLDS.min(views.len());
    let mut unseen = Vec::new();
    for fold in 0..folds {
        let (out, kept): (Vec<usize>, Vec<usize>) =
            (0..views.len()).partition(|index| index % folds == fold);
        let without = solve_again(board, views, solution, &kept)?;
        for index in out {
            let view = held_out(&without, board, &views[index], solution.boards[index]);
            unseen.extend(view.left.into_iter().chain(view.right));
        }
    }
    Ok(HeldOut {
        rms_px: rms_px(unseen.iter()),
        fitted_rms_px: solution.rms_px(),
        folds,
    })
}
