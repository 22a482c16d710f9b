//! How firmly the fit believes in corners and in still boards: found from what it leaves.

use super::equations::inverse;
use super::joint::{Equations, Problem, scaled_inverse};
use super::state::{STEP, State};

/// One sigma of everything that the fit takes for random.
#[derive(Debug, Clone)]
pub(super) struct Weights {
    /// Corners, per axis, pixels: left eye, right eye.
    pub corner_px: [f64; 2],
    /// Turns of the board between the eyes, per axis, radians.
    pub turn_rad: f64,
    /// Moves of the board between the eyes, per axis, metres.
    pub move_m: f64,
    /// For each view, how much firmer than that its board is held: against turns, against moves.
    pub of_view: Vec<[f64; 2]>,
}

/// Where the search begins: hands are still to a tenth of a degree and a fifth of a millimetre.
const FIRST_TURN_RAD: f64 = 1e-3;
const FIRST_MOVE_M: f64 = 2e-4;
/// Boards that stand on a tripod before eyes in step: below what any corner could show.
const STILL_TURN_RAD: f64 = 1e-7;
const STILL_MOVE_M: f64 = 1e-8;
/// Corners that fit perfectly have noise all the same: a thousandth of a pixel.
const LEAST_CORNER_PX: f64 = 1e-3;
/// Degrees of freedom of Student's distribution of the steps: hands hold still, and now and then do not.
/// Turns and moves each have theirs: a hand that twists a board has not therefore shifted it.
const FREEDOM: f64 = 2.0;
/// Numbers of a turn, and of a move.
const PARTS: f64 = 3.0;

impl Weights {
    pub(super) fn first(views: usize, moving_board: bool) -> Self {
        let (turn_rad, move_m) = if moving_board {
            (FIRST_TURN_RAD, FIRST_MOVE_M)
        } else {
            (STILL_TURN_RAD, STILL_MOVE_M)
        };
        Self {
            corner_px: [0.2; 2],
            turn_rad,
            move_m,
            of_view: vec![[1.0; 2]; views],
        }
    }

    pub(super) fn of_corners(&self) -> [f64; 2] {
        self.corner_px.map(|sigma| sigma.powi(-2))
    }

    /// Of a view's turn, of its move.
    pub(super) fn of_step(&self, view: usize) -> [f64; 2] {
        let firmer = self.of_view[view];
        [
            firmer[0] / self.turn_rad.powi(2),
            firmer[1] / self.move_m.powi(2),
        ]
    }

    /// Whether another round would change nothing that counts.
    pub(super) fn are_near(&self, other: &Self) -> bool {
        let near = |a: f64, b: f64| (a / b).ln().abs() < 0.02;
        near(self.corner_px[0], other.corner_px[0])
            && near(self.corner_px[1], other.corner_px[1])
            && near(self.turn_rad, other.turn_rad)
            && near(self.move_m, other.move_m)
    }

    /// The weights that the residuals speak for: MacKay's fixed point of the evidence ("Bayesian
    /// interpolation", 1992) for the spreads, Student's weights for the views (Lange et al., 1989).
    pub(super) fn again(
        &self,
        problem: &Problem<'_>,
        state: &State,
        of: &Equations,
    ) -> Option<Self> {
        let mut steps = Steps::default();
        let mut of_view = Vec::with_capacity(of.views.len());
        for (at, view) in of.views.iter().enumerate() {
            let variance = inverse(&view.own)?.diagonal();
            let part = Steps::of_view(self, state, at, |index| variance[STEP + index]);
            of_view.push(
                part.distance
                    .map(|distance| (FREEDOM + PARTS) / (FREEDOM + distance)),
            );
            steps.add(&part);
        }
        let mut next = Self {
            corner_px: self.corner_sigmas(problem, of, &steps)?,
            ..self.clone()
        };
        if problem.model.moving_board {
            next.of_view = of_view;
            next.turn_rad = spread(steps.turn_squares, steps.turn_seen, self.turn_rad);
            next.move_m = spread(steps.move_squares, steps.move_seen, self.move_m);
            next.turn_rad = next.turn_rad.max(STILL_TURN_RAD);
            next.move_m = next.move_m.max(STILL_MOVE_M);
        }
        Some(next)
    }

    /// One sigma of a corner along one axis; what was fitted is counted, half to an eye.
    fn corner_sigmas(
        &self,
        problem: &Problem<'_>,
        of: &Equations,
        steps: &Steps,
    ) -> Option<[f64; 2]> {
        let covariance = scaled_inverse(&of.information()?)?;
        // What the priors held was not fitted.
        let held = of.prior.matrix.component_mul(&covariance).sum();
        let shared = of.prior.matrix.nrows() as f64 - held;
        let own = STEP as f64 * of.views.len() as f64 + steps.turn_seen + steps.move_seen;
        let mut sigmas = [0.0; 2];
        for (eye, sigma) in sigmas.iter_mut().enumerate() {
            let squares: f64 = of.views.iter().map(|view| view.squares_px2[eye]).sum();
            let free = problem.readings(eye) - (shared + own) / 2.0;
            *sigma = (squares / free.max(1.0)).sqrt().max(LEAST_CORNER_PX);
        }
        Some(sigmas)
    }
}

/// A spread from weighted squares and from how many numbers the pictures (not the prior) tell.
fn spread(squares: f64, seen: f64, was: f64) -> f64 {
    // Nothing seen of it: the prior stays, and shrinks.
    let new = (squares / seen.max(1e-3)).sqrt();
    new.clamp(0.1 * was, 10.0 * was)
}

/// What the boards did between the eyes, all views together.
#[derive(Default)]
struct Steps {
    turn_squares: f64,
    move_squares: f64,
    turn_seen: f64,
    move_seen: f64,
    distance: [f64; 2],
}

impl Steps {
    fn of_view(
        weights: &Weights,
        state: &State,
        at: usize,
        variance: impl Fn(usize) -> f64,
    ) -> Self {
        let (step, [turn, way]) = (&state.steps[at], weights.of_step(at));
        let firmer = weights.of_view[at];
        let mut sum = Self::default();
        for axis in 0..3 {
            let (turned, moved) = (step.turn_rad[axis], step.move_m[axis]);
            let (turn_variance, move_variance) = (variance(axis), variance(3 + axis));
            sum.turn_squares += firmer[0] * turned * turned;
            sum.move_squares += firmer[1] * moved * moved;
            sum.turn_seen += (1.0 - turn * turn_variance).max(0.0);
            sum.move_seen += (1.0 - way * move_variance).max(0.0);
            sum.distance[0] += (turned * turned + turn_variance) * turn / firmer[0];
            sum.distance[1] += (moved * moved + move_variance) * way / firmer[1];
        }
        sum
    }

    fn add(&mut self, other: &Self) {
        self.turn_squares += other.turn_squares;
        self.move_squares += other.move_squares;
        self.turn_seen += other.turn_seen;
        self.move_seen += other.move_seen;
    }
}
