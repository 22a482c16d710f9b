//! The errors that all fires share: mean, covariance, and how time passes for them.
//!
//! State: [`SHARED`] errors of this moment, each in units of its own prior sigma (so that a sigma
//! that changes in flight needs no bookkeeping), then [`KNOTS`] copies of the wandering ones as
//! they were at moments of the past.
//!
//! **Why knots.** Each fire is kept as a linear function of this state plus an error of its own
//! ([`super::block`]): given the state, fires are independent, and the cost is linear in them. What
//! a fire learned minutes ago, though, rests on what the wandering errors were then, and that is
//! common to all fires that were seen then. The copies keep it: without them a hundred fires would
//! count as a hundred independent landmarks, and every ellipse would shrink by what they share.
//!
//! Sources: consider states and their augmentation by past values, Bar-Shalom, Li, Kirubarajan,
//! "Estimation with Applications to Tracking and Navigation" (2001), 10.3 and 8.5; Roumeliotis and
//! Burdick, "Stochastic cloning" (ICRA 2002). Ours differ in that a copy that goes is not dropped
//! but expressed by those that stay, so every fire's own covariance stays exact.

use crate::locate::{CONSTANT, SHARED, SharedPriors, WANDERING};
use nalgebra::{DMatrix, DVector, SVector};

/// Copies of the wandering errors that are kept.
pub const KNOTS: usize = 6;
/// Numbers in the common state.
pub const COMMON: usize = SHARED + KNOTS * WANDERING;

/// Share of the shortest correlation time after which a copy is taken.
const KNOT_SPACING: f64 = 0.15;
/// What constant errors do in a minute after all (heat, load, a clock's own rate), one sigma, in the
/// order of the shared errors: metres, radians, pixels, seconds.
const DRIFT_PER_MINUTE: [f64; CONSTANT] = [
    0.0, 0.0, 0.0, 0.0, 2e-4, 2e-4, 2e-4, 0.01, 5e-4, 0.0, 0.0, 0.0,
];
/// Least variance that a step leaves between the old and the new value, so that the one can be told
/// by the other; prior variances.
const LEAST_STEP: f64 = 1e-9;

/// Mean and covariance of the common state.
#[derive(Debug, Clone)]
pub struct Common {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    /// Age of each copy, seconds; `None` where there is none yet.
    knots: [Option<f64>; KNOTS],
    since_knot_s: f64,
}

/// How old numbers of the common state are told by the new state: `old = by_new s + offset + r`,
/// with `r` of covariance `spread` independent of `s`. Fires that rest on the old numbers are
/// carried over by it.
#[derive(Debug, Clone)]
pub struct Passage {
    /// Which numbers were replaced.
    pub replaced: Vec<usize>,
    /// Row for each replaced number.
    pub by_new: DMatrix<f64>,
    /// For each replaced number.
    pub offset: DVector<f64>,
    /// Of what the new state does not tell.
    pub spread: DMatrix<f64>,
}

impl Default for Common {
    fn default() -> Self {
        Self {
            mean: DVector::zeros(COMMON),
            covariance: DMatrix::identity(COMMON, COMMON),
            knots: [None; KNOTS],
            since_knot_s: f64::INFINITY,
        }
    }
}

impl Common {
    /// Best guess, sigmas.
    #[must_use]
    pub fn mean(&self) -> &DVector<f64> {
        &self.mean
    }

    /// Covariance, sigmas squared.
    #[must_use]
    pub fn covariance(&self) -> &DMatrix<f64> {
        &self.covariance
    }

    /// Best guess of the errors of this moment, sigmas.
    #[must_use]
    pub fn now(&self) -> SVector<f64, SHARED> {
        self.mean.fixed_rows::<SHARED>(0).into_owned()
    }

    /// One sigma of one error of this moment, in its prior sigmas.
    #[must_use]
    pub fn sigma(&self, index: usize) -> f64 {
        self.covariance[(index, index)].max(0.0).sqrt()
    }

    /// Lets `dt_s` pass. The passages carry every fire over, in their order.
    pub fn age(
        &mut self,
        dt_s: f64,
        priors: &SharedPriors,
        sigmas: &SVector<f64, SHARED>,
    ) -> Vec<Passage> {
        let dt_s = dt_s.max(0.0);
        let correlations = priors.correlations_s();
        let shortest = correlations.iter().copied().fold(f64::INFINITY, f64::min);
        let mut passages = Vec::new();
        let mut drift_s = 0.0;
        if self.since_knot_s >= KNOT_SPACING * shortest {
            drift_s = if self.since_knot_s.is_finite() {
                self.since_knot_s
            } else {
                0.0
            };
            passages.extend(self.make_room(&correlations));
            self.take_knot();
        }
        let mut steps: Vec<Step> = (0..WANDERING)
            .map(|i| Step::fading(CONSTANT + i, (-dt_s / correlations[i]).exp()))
            .collect();
        steps.extend((CONSTANT + WANDERING..SHARED).map(|i| Step::fading(i, 0.0)));
        if drift_s > 0.0 {
            steps.extend((0..CONSTANT).filter_map(|i| Step::drifting(i, drift_s, sigmas[i])));
        }
        passages.extend(self.pass(&steps));
        self.since_knot_s += dt_s;
        for age_s in self.knots.iter_mut().flatten() {
            *age_s += dt_s;
        }
        passages
    }

    /// A free place for a copy: the copy that the others tell best goes, if there is no free one.
    fn make_room(&mut self, correlations: &[f64; WANDERING]) -> Option<Passage> {
        if self.knots.iter().any(Option::is_none) {
            return None;
        }
        let fastest = correlations.iter().copied().fold(f64::INFINITY, f64::min);
        let knot = self.most_dispensable(fastest)?;
        self.knots[knot] = None;
        let steps: Vec<Step> = knot_indices(knot).map(|i| Step::fading(i, 0.0)).collect();
        self.pass(&steps)
    }

    /// The copy that its neighbours in time leave the least unknown of.
    fn most_dispensable(&self, correlation_s: f64) -> Option<usize> {
        let ages: Vec<f64> = self.knots.iter().flatten().copied().collect();
        let unknown = |age: f64| {
            let younger = ages
                .iter()
                .copied()
                .filter(|a| *a < age)
                .fold(0.0, f64::max);
            let older = ages
                .iter()
                .copied()
                .filter(|a| *a > age)
                .fold(f64::INFINITY, f64::min);
            let to = |gap: f64| (-2.0 * gap / correlation_s).exp();
            let (a, b) = (to(age - younger), to(older - age));
            (1.0 - a) * (1.0 - b) / (1.0 - a * b).max(f64::MIN_POSITIVE)
        };
        let knots = (0..KNOTS).filter_map(|knot| Some((knot, unknown(self.knots[knot]?))));
        knots
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(knot, _)| knot)
    }

    /// Copies the wandering errors, as they are now, into the free place.
    fn take_knot(&mut self) {
        let Some(knot) = self.knots.iter().position(Option::is_none) else {
            return;
        };
        self.knots[knot] = Some(0.0);
        self.since_knot_s = 0.0;
        for (to, from) in knot_indices(knot).zip(CONSTANT..CONSTANT + WANDERING) {
            self.mean[to] = self.mean[from];
            let row = self.covariance.row(from).into_owned();
            self.covariance.set_row(to, &row);
            let column = self.covariance.column(from).into_owned();
            self.covariance.set_column(to, &column);
        }
    }

    /// Lets the steps happen, and says how the old numbers are told by the new ones: the backward
    /// gain of a Rauch-Tung-Striebel smoother.
    fn pass(&mut self, steps: &[Step]) -> Option<Passage> {
        let replaced: Vec<usize> = steps.iter().map(|step| step.index).collect();
        let old_mean = self.mean.select_rows(&replaced);
        let mut with_new = self.covariance.select_rows(&replaced);
        let old = with_new.select_columns(&replaced);
        for step in steps {
            self.mean[step.index] *= step.keep;
            self.covariance.row_mut(step.index).scale_mut(step.keep);
            self.covariance.column_mut(step.index).scale_mut(step.keep);
            self.covariance[(step.index, step.index)] += step.added;
            with_new.column_mut(step.index).scale_mut(step.keep);
        }
        let factor = self.covariance.clone().cholesky()?;
        let by_new = factor.solve(&with_new.transpose()).transpose();
        let offset = old_mean - &by_new * &self.mean;
        let mut spread = old - &by_new * with_new.transpose();
        symmetrise(&mut spread);
        Some(Passage {
            replaced,
            by_new,
            offset,
            spread,
        })
    }

    /// Takes measurements in: `residual = columns' (s - mean) + noise` of unit variance.
    pub fn update(&mut self, columns: &DMatrix<f64>, residual: &DVector<f64>) {
        if columns.ncols() == 0 {
            return;
        }
        if columns.ncols() <= COMMON / 2 {
            self.update_by_gain(columns, residual);
        } else {
            self.update_by_information(columns, residual);
        }
        symmetrise(&mut self.covariance);
    }

    /// Few: the Kalman gain.
    fn update_by_gain(&mut self, columns: &DMatrix<f64>, residual: &DVector<f64>) {
        let lever = &self.covariance * columns;
        let mut spread = columns.transpose() * &lever;
        for i in 0..columns.ncols() {
            spread[(i, i)] += 1.0;
        }
        symmetrise(&mut spread);
        let Some(factor) = spread.cholesky() else {
            return;
        };
        // P - lever S^-1 lever' = P - w' w with w = L^-1 lever': stays symmetric.
        let Some(whitened) = factor.l().solve_lower_triangular(&lever.transpose()) else {
            return;
        };
        self.mean += &lever * factor.solve(residual);
        self.covariance -= whitened.transpose() * &whitened;
    }

    /// Many: summed up, then one solve. With `P = C C'`, the new covariance is
    /// `C (I + C' L C)^-1 C'`, which stays non-negative.
    fn update_by_information(&mut self, columns: &DMatrix<f64>, residual: &DVector<f64>) {
        let Some(root) = self.covariance.clone().cholesky().map(|factor| factor.l()) else {
            return;
        };
        let told = columns * columns.transpose();
        let mut information = root.transpose() * told * &root;
        for i in 0..COMMON {
            information[(i, i)] += 1.0;
        }
        symmetrise(&mut information);
        let Some(factor) = information.cholesky() else {
            return;
        };
        let Some(whitened) = factor.l().solve_lower_triangular(&root.transpose()) else {
            return;
        };
        let pull = root.transpose() * (columns * residual);
        self.mean += &root * factor.solve(&pull);
        self.covariance = whitened.transpose() * &whitened;
    }
}

/// What happens to one number of the common state.
#[derive(Debug, Clone, Copy)]
struct Step {
    index: usize,
    keep: f64,
    added: f64,
}

impl Step {
    /// Towards its prior.
    fn fading(index: usize, keep: f64) -> Self {
        Self {
            index,
            keep,
            added: (1.0 - keep * keep).max(LEAST_STEP),
        }
    }

    /// Away from where it was; nothing when it does not drift.
    fn drifting(index: usize, dt_s: f64, sigma: f64) -> Option<Self> {
        let drift = DRIFT_PER_MINUTE[index] / sigma.max(f64::MIN_POSITIVE);
        let added = drift * drift * dt_s / 60.0;
        (added > 0.0 && sigma > 0.0).then_some(Self {
            index,
            keep: 1.0,
            added: added.min(1.0),
        })
    }
}

fn knot_indices(knot: usize) -> std::ops::Range<usize> {
    let from = SHARED + knot * WANDERING;
    from..from + WANDERING
}

fn symmetrise(matrix: &mut DMatrix<f64>) {
    let size = matrix.nrows();
    for i in 0..size {
        for j in 0..i {
            let mean = 0.5 * (matrix[(i, j)] + matrix[(j, i)]);
            matrix[(i, j)] = mean;
            matrix[(j, i)] = mean;
        }
    }
}
