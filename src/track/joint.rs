//! One fire and the errors that it was seen through, together: mean and covariance.
//!
//! Numbers: the fire's ([`OF_FIRE`], see [`Chart`](super::chart::Chart)), then the [`LASTING`] shared errors of this
//! moment, constant ones first, each in units of its own prior sigma (so that a sigma that changes
//! in flight needs no bookkeeping). Errors that are new in each frame are noise of its sightings.

use super::chart::{INVERSE_DEPTH, OF_FIRE, State, TANGENTS};
use super::odometer::Reading;
use crate::locate::{CONSTANT, Lens, SHARED, Shared, SharedPriors, WANDERING};
use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

/// Shared errors that last beyond a frame.
pub const LASTING: usize = CONSTANT + WANDERING;
/// Numbers of a fire with its errors.
pub const JOINT: usize = OF_FIRE + LASTING;

/// Numbers of a fire with its errors.
pub type JointVector = SVector<f64, JOINT>;
type JointMatrix = SMatrix<f64, JOINT, JOINT>;

/// What constant errors do in a minute after all (heat, load, a clock's own rate), one sigma, in the
/// order of the shared errors: metres, radians, pixels, seconds.
const DRIFT_PER_MINUTE: [f64; CONSTANT] = [
    0.0, 0.0, 0.0, 0.0, 2e-4, 2e-4, 2e-4, 0.01, 5e-4, 0.0, 0.0, 0.0,
];

/// How shared errors change with time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    correlations_s: [f64; WANDERING],
    /// Variance per second, prior variances.
    drifts: [f64; CONSTANT],
    /// Sigmas of the receiver's error that wanders, and of that which is new in each report, metres.
    gnss_m: [Vector3<f64>; 2],
}

/// What some seconds do to the shared errors.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Passed {
    keeps: [f64; WANDERING],
    drifted: [f64; CONSTANT],
    receiver: [Strayed; 3],
}

/// How the receiver's error changed along one axis, as the velocity tells it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Strayed {
    /// Sigmas of what wanders and of what is new in each report, metres.
    sigmas_m: Vector2<f64>,
    /// What is left of each.
    keeps: Vector2<f64>,
    /// By how much the error changed, metres, and the variance of that, m².
    by_m: f64,
    variance_m2: f64,
}

impl Pace {
    /// For the priors of a mission, at the sigmas of a moment.
    #[must_use]
    pub fn new(priors: &SharedPriors, sigmas: &SVector<f64, SHARED>) -> Self {
        let drift = |i: usize| (DRIFT_PER_MINUTE[i] / sigmas[i].max(f64::MIN_POSITIVE)).powi(2);
        Self {
            correlations_s: priors.correlations_s(),
            drifts: std::array::from_fn(|i| drift(i).min(1.0) / 60.0),
            gnss_m: [Shared::Gnss, Shared::GnssNoise]
                .map(|from| sigmas.fixed_rows::<3>(from as usize).into_owned()),
        }
    }

    /// What is left of each wandering error after some seconds.
    #[must_use]
    pub fn keeps(&self, dt_s: f64) -> [f64; WANDERING] {
        let correlations_s = &self.correlations_s;
        let mut keeps = [1.0; WANDERING];
        if dt_s == 0.0 {
            return keeps;
        }
        for i in 0..WANDERING {
            // Axes of one error are alike, and an exponential is dear.
            let is_alike = i > 0 && correlations_s[i] == correlations_s[i - 1];
            keeps[i] = if is_alike {
                keeps[i - 1]
            } else {
                (-dt_s.abs() / correlations_s[i]).exp()
            };
        }
        keeps
    }

    /// Variances of how much the receiver's error changes in some seconds, by itself: m².
    #[must_use]
    pub fn receiver_variances(&self, dt_s: f64) -> Vector3<f64> {
        let [wanders, new] = self.gnss_m.map(|sigmas| sigmas.component_mul(&sigmas));
        let keep = (-dt_s.abs() / self.correlations_s[0]).exp();
        wanders * (2.0 * (1.0 - keep)) + new * 2.0
    }

    fn passed(&self, from: &Reading, to: &Reading) -> Passed {
        let dt_s = (to.at - from.at).as_secs_f64().max(0.0);
        let keeps = self.keeps(dt_s);
        let by_m = to.strayed_m - from.strayed_m;
        Passed {
            keeps,
            drifted: self.drifts.map(|drift| drift * dt_s),
            receiver: std::array::from_fn(|axis| Strayed {
                sigmas_m: Vector2::from_fn(|i, _| self.gnss_m[i][axis]),
                keeps: Vector2::new(keeps[axis], keeps[NEW + axis]),
                by_m: by_m[axis],
                variance_m2: to.variance_m2 - from.variance_m2,
            }),
        }
    }
}

/// Index of the receiver's error that is new in each report, among what wanders.
const NEW: usize = Shared::GnssNoise as usize - CONSTANT;

/// Lets the shared errors, which stand from index `from` on, change.
fn age<const N: usize>(
    mean: &mut SVector<f64, N>,
    covariance: &mut SMatrix<f64, N, N>,
    from: usize,
    passed: &Passed,
) {
    for (i, drifted) in passed.drifted.iter().enumerate() {
        covariance[(from + i, from + i)] += drifted;
    }
    // The receiver's share is left to `stray`.
    let mut keeps = SVector::<f64, N>::repeat(1.0);
    for (i, keep) in passed.keeps.iter().enumerate().take(NEW).skip(3) {
        let at = from + CONSTANT + i;
        keeps[at] = *keep;
        mean[at] *= keep;
    }
    for (mut column, keep) in covariance.column_iter_mut().zip(keeps.iter()) {
        column.component_mul_assign(&(keeps * *keep));
    }
    for i in 3..NEW {
        let (at, keep) = (from + CONSTANT + i, passed.keeps[i]);
        covariance[(at, at)] += 1.0 - keep * keep;
    }
    stray(mean, covariance, from + CONSTANT, &passed.receiver);
}

/// Lets the receiver's error change; what wanders of it stands from index `from` on, what is new in each
/// report [`NEW`] further.
///
/// Along an axis, with `x` those two numbers, `s` their sigmas, `x' = A x + w` and `w` of variance `Q`, the
/// velocity says `d = s' (x' - x) + n = a' x + s' w + n` with `a = (A - 1) s`. That is news of `x` first;
/// then `w = k (d - a' x)` with `k = Q s / (s' Q s + r)`, and what is left of it varies by `Q - k s' Q`.
fn stray<const N: usize>(
    mean: &mut SVector<f64, N>,
    covariance: &mut SMatrix<f64, N, N>,
    from: usize,
    receiver: &[Strayed; 3],
) {
    let before = receiver.map(|axis| axis.sigmas_m.component_mul(&axis.keeps.add_scalar(-1.0)));
    let mut levers = SMatrix::<f64, N, 3>::zeros();
    for (axis, share) in before.iter().enumerate() {
        let old = [from + axis, from + axis + NEW].map(|i| covariance.column(i));
        levers.column_mut(axis).axpy(share[0], &old[0], 0.0);
        levers.column_mut(axis).axpy(share[1], &old[1], 1.0);
    }
    let seen = |i: usize, j: usize| {
        let (wanders, new) = (levers[(from + i, j)], levers[(from + i + NEW, j)]);
        before[i].dot(&Vector2::new(wanders, new))
    };
    let spread =
        Matrix3::from_fn(|i, j| seen(i, j) + if i == j { receiver[i].variance() } else { 0.0 });
    // Where no time has passed, nothing has changed.
    let whitener = spread
        .cholesky()
        .and_then(|factor| factor.l().try_inverse());
    let Some(whitener) = whitener else { return };
    let left = Vector3::from_fn(|i, _| {
        receiver[i].by_m - before[i].dot(&Vector2::new(mean[from + i], mean[from + i + NEW]))
    });
    let whitened = levers * whitener.transpose();
    *mean += whitened * (whitener * left);
    subtract_squared(covariance, &whitened);
    for (axis, strayed) in receiver.iter().enumerate() {
        let at = [from + axis, from + axis + NEW];
        strayed.go_on(mean, covariance, at, &before[axis]);
    }
}

impl Strayed {
    /// Of what is new by chance, metres times prior sigmas.
    fn fresh(&self) -> (Vector2<f64>, Vector2<f64>) {
        let fresh = self.keeps.map(|keep| 1.0 - keep * keep);
        (fresh, self.sigmas_m.component_mul(&fresh))
    }

    /// Variance of what the velocity says of the change, for the part that is new, m².
    fn variance(&self) -> f64 {
        self.fresh().1.dot(&self.sigmas_m) + self.variance_m2
    }

    /// The second step of [`stray`], for the numbers at two indices.
    fn go_on<const N: usize>(
        &self,
        mean: &mut SVector<f64, N>,
        covariance: &mut SMatrix<f64, N, N>,
        at: [usize; 2],
        before: &Vector2<f64>,
    ) {
        let (fresh, spread) = self.fresh();
        let gain = spread / self.variance();
        let moves = Matrix2::from_diagonal(&self.keeps) - gain * before.transpose();
        let moved = moves * Vector2::new(mean[at[0]], mean[at[1]]) + gain * self.by_m;
        let own = Matrix2::from_fn(|k, l| covariance[(at[k], at[l])]);
        let own = moves * own * moves.transpose() + Matrix2::from_diagonal(&fresh)
            - gain * spread.transpose();
        for r in 0..N {
            let with = moves * Vector2::new(covariance[(r, at[0])], covariance[(r, at[1])]);
            for (k, i) in at.into_iter().enumerate() {
                covariance[(r, i)] = with[k];
                covariance[(i, r)] = with[k];
            }
        }
        for (k, i) in at.into_iter().enumerate() {
            mean[i] = moved[k];
            for (l, j) in at.into_iter().enumerate() {
                covariance[(i, j)] = own[(k, l)];
            }
        }
    }
}

/// `P - W W'` in one pass, in place: what a fire costs in a frame is mostly this.
fn subtract_squared<const N: usize>(p: &mut SMatrix<f64, N, N>, w: &SMatrix<f64, N, 3>) {
    for (j, mut column) in p.column_iter_mut().enumerate() {
        let [a, b, c] = [0, 1, 2].map(|k| w[(j, k)]);
        for i in 0..N {
            column[i] -= w[(i, 0)] * a + w[(i, 1)] * b + w[(i, 2)] * c;
        }
    }
}

/// What is known of the shared errors alone.
#[derive(Debug, Clone)]
pub struct Known {
    /// Best guess, prior sigmas.
    pub mean: SVector<f64, LASTING>,
    /// Prior sigmas squared.
    pub covariance: SMatrix<f64, LASTING, LASTING>,
}

impl Default for Known {
    fn default() -> Self {
        Self {
            mean: SVector::zeros(),
            covariance: SMatrix::identity(),
        }
    }
}

impl Known {
    /// Lets time pass.
    pub fn age(&mut self, from: &Reading, to: &Reading, pace: &Pace) {
        let passed = pace.passed(from, to);
        age(&mut self.mean, &mut self.covariance, 0, &passed);
    }

    /// Best guess of all shared errors; those that are new in each frame are nothing.
    #[must_use]
    pub fn all(&self) -> SVector<f64, SHARED> {
        let mut all = SVector::<f64, SHARED>::zeros();
        all.fixed_rows_mut::<LASTING>(0).copy_from(&self.mean);
        all
    }

    /// Whether its error has the smaller volume.
    #[must_use]
    pub fn knows_more_than(&self, other: &Self) -> bool {
        match (self.log_volume(), other.log_volume()) {
            (Some(this), Some(that)) => this < that,
            _ => false,
        }
    }

    fn log_volume(&self) -> Option<f64> {
        let factor = self.covariance.cholesky()?;
        Some(factor.l_dirty().diagonal().map(f64::ln).sum())
    }
}

/// A sighting linearised: `seen = model(at) + rows (x - at) + noise`, rows column, row, disparity.
#[derive(Debug, Clone, Copy)]
pub struct Measured {
    /// What was seen less what the model says at the point of linearisation.
    pub residual: Vector3<f64>,
    /// Over the fire and its errors.
    pub rows: SMatrix<f64, 3, JOINT>,
    /// Of the pixels, and of what is new in each frame.
    pub noise: Matrix3<f64>,
    /// Whether the third row says anything.
    pub has_disparity: bool,
}

/// Squared distances beyond which noise counts as more than was said: chi-square 99 % of two and
/// three numbers.
const USUAL: [f64; 2] = [9.21, 11.34];

/// A fire with the errors that it was seen through.
#[derive(Debug, Clone)]
pub struct Joint {
    mean: JointVector,
    covariance: JointMatrix,
}

/// How much more the sightings scatter than was said, as variances; 1 when they do as was said.
///
/// Whoever states the noise of a box, an attitude or a stamp may be wrong, and what is believed of it
/// decides how sure everything else is. So the squared distances of the sightings from where they
/// should be (1 on average) are followed, slowly, and all noise is taken that much larger, never smaller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scatter(f64);

/// Share of what one sighting says of the scatter that is believed, and what it can say at most.
const SCATTER_GAIN: f64 = 0.02;
const SCATTER_TOLD: f64 = 6.0;
/// Scatter at most: five times the sigmas that were said.
const SCATTER_MOST: f64 = 25.0;

impl Default for Scatter {
    fn default() -> Self {
        Self(1.0)
    }
}

impl Scatter {
    /// Variance over what was said.
    #[must_use]
    pub fn variance(self) -> f64 {
        self.0
    }

    /// Whether that is worth telling: sigmas half as large again.
    #[must_use]
    pub fn is_large(self) -> bool {
        self.0 > 2.25
    }

    /// A sighting lay at this squared distance over its numbers, the noise being taken as this large.
    pub fn note(&mut self, squared: f64) {
        let told = squared.min(SCATTER_TOLD) - 1.0;
        self.0 = (self.0 * (1.0 + SCATTER_GAIN * told)).clamp(1.0, SCATTER_MOST);
    }
}

impl Joint {
    /// A fire of which nothing is known but from where it was looked for, and the errors as known. The
    /// camera stands at `lens`, which was made with those errors.
    #[must_use]
    pub fn unseen(
        known: &Known,
        lens: &Lens,
        inverse_depth: (f64, f64),
        terrain_sigma_m: f64,
    ) -> Self {
        let (mut mean, mut covariance) = (JointVector::zeros(), JointMatrix::zeros());
        let (depth, depth_sigma) = inverse_depth;
        mean.fixed_rows_mut::<3>(0).copy_from(lens.centre());
        mean[INVERSE_DEPTH] = depth;
        mean.fixed_rows_mut::<LASTING>(OF_FIRE)
            .copy_from(&known.mean);
        let sigmas = [ANY_TANGENT, ANY_TANGENT, depth_sigma, terrain_sigma_m];
        for (i, sigma) in (TANGENTS..OF_FIRE).zip(sigmas) {
            covariance[(i, i)] = sigma * sigma;
        }
        // The camera's place is a function of the errors.
        let by_errors = lens.centre_by_shared().fixed_columns::<LASTING>(0);
        let with_errors = by_errors * known.covariance;
        covariance
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&(with_errors * by_errors.transpose()));
        covariance
            .fixed_view_mut::<3, LASTING>(0, OF_FIRE)
            .copy_from(&with_errors);
        covariance
            .fixed_view_mut::<LASTING, 3>(OF_FIRE, 0)
            .copy_from(&with_errors.transpose());
        covariance
            .fixed_view_mut::<LASTING, LASTING>(OF_FIRE, OF_FIRE)
            .copy_from(&known.covariance);
        Self { mean, covariance }
    }

    /// Best guess.
    #[must_use]
    pub fn mean(&self) -> &JointVector {
        &self.mean
    }

    /// Its covariance.
    #[must_use]
    pub fn covariance(&self) -> &JointMatrix {
        &self.covariance
    }

    /// Best guess of the fire alone.
    #[must_use]
    pub fn fire(&self) -> State {
        self.mean.fixed_rows::<OF_FIRE>(0).into_owned()
    }

    /// One sigma of one number.
    #[must_use]
    pub fn sigma(&self, index: usize) -> f64 {
        self.covariance[(index, index)].max(0.0).sqrt()
    }

    /// What it knows of the shared errors.
    #[must_use]
    pub fn known(&self) -> Known {
        Known {
            mean: self.mean.fixed_rows::<LASTING>(OF_FIRE).into_owned(),
            covariance: self
                .covariance
                .fixed_view::<LASTING, LASTING>(OF_FIRE, OF_FIRE)
                .into_owned(),
        }
    }

    /// Lets time pass.
    pub fn age(&mut self, from: &Reading, to: &Reading, pace: &Pace) {
        let passed = pace.passed(from, to);
        age(&mut self.mean, &mut self.covariance, OF_FIRE, &passed);
    }

    /// What is left of a sighting that was linearised at `at`.
    #[must_use]
    pub fn left(&self, m: &Measured, at: &JointVector) -> Vector3<f64> {
        m.residual - m.rows * (self.mean - at)
    }

    /// Takes a sighting in. One that lies further off than its noise allows has more noise than was
    /// said: it counts as much less as it lies further off (squared distance beyond the usual,
    /// squared, so that what is far off moves nothing; Huber, "Robust Statistics", 1981, ch. 4).
    ///
    /// Returns its squared distance over the numbers that it has: 1 on average.
    pub fn take(&mut self, m: &Measured, at: &JointVector) -> Option<f64> {
        let left = self.left(m, at);
        #[expect(clippy::op_ref, reason = "by value all of it would be copied")]
        let lever = &self.covariance * m.rows.transpose();
        let spread = m.rows * lever;
        let factor = (spread + m.noise).cholesky()?;
        let squared = left.dot(&factor.solve(&left));
        let excess = squared / USUAL[usize::from(m.has_disparity)];
        let factor = if excess > 1.0 {
            (spread + m.noise * (excess * excess)).cholesky()
        } else {
            Some(factor)
        };
        // P - lever S^-1 lever' = P - w w' with w = lever L^-T: stays symmetric.
        let whitener = factor?.l().try_inverse()?;
        let whitened = lever * whitener.transpose();
        self.mean += whitened * (whitener * left);
        subtract_squared(&mut self.covariance, &whitened);
        self.keep_positive();
        Some(squared / if m.has_disparity { 3.0 } else { 2.0 })
    }

    /// Takes one number in: `residual = row' (x - at) + noise`.
    pub fn take_one(&mut self, row: &JointVector, residual: f64, variance: f64, at: &JointVector) {
        #[expect(clippy::op_ref, reason = "by value all of it would be copied")]
        let lever = &self.covariance * row;
        let spread = row.dot(&lever) + variance;
        if spread > 0.0 {
            self.mean += lever * ((residual - row.dot(&(self.mean - at))) / spread);
            self.covariance -= lever * lever.transpose() / spread;
            self.keep_positive();
        }
    }

    /// Rounding leaves no variance below nothing.
    fn keep_positive(&mut self) {
        for i in 0..JOINT {
            let variance = &mut self.covariance[(i, i)];
            *variance = variance.max(0.0);
        }
    }

    /// Keeps its inverse depth in front of the camera, and within reach of where it was linearised.
    pub fn hold(&mut self, near: f64) {
        self.mean = Self::clamped(self.mean, near);
    }

    /// Numbers with an inverse depth in front of the camera and within reach of another one.
    #[must_use]
    pub fn clamped(mut mean: JointVector, near: f64) -> JointVector {
        let depth = mean[INVERSE_DEPTH].clamp(near / MOST_CHANGE, near * MOST_CHANGE);
        mean[INVERSE_DEPTH] = depth.clamp(INVERSE_DEPTHS.0, INVERSE_DEPTHS.1);
        mean
    }
}

/// Tangents are unknown beforehand: one sigma.
const ANY_TANGENT: f64 = 3.0;
/// Inverse depths that are looked at, 1/m, and how much they change in one pass at most.
const INVERSE_DEPTHS: (f64, f64) = (5e-4, 2.0);
const MOST_CHANGE: f64 = 3.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{pose, rig};
    use emberfix_frames::{ServiceTime, seconds};
    use nalgebra::{DMatrix, DVector};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn reading(at_s: f64, strayed_m: Vector3<f64>, variance_m2: f64) -> Reading {
        Reading {
            at: ServiceTime::from_unix_ns(0) + seconds(at_s),
            strayed_m,
            variance_m2,
        }
    }

    fn known(seed: u64) -> Known {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let factor = SMatrix::<f64, LASTING, LASTING>::from_fn(|_, _| rng.random_range(-0.3..0.3));
        Known {
            mean: SVector::from_fn(|_, _| rng.random_range(-1.0..1.0)),
            covariance: factor * factor.transpose() + SMatrix::identity() * 0.1,
        }
    }

    /// Old errors and what is new of them written out as one normal vector, of which the velocity shows
    /// three sums; then `x' = A x + w`.
    fn by_hand(known: &Known, pace: &Pace, passed: &Passed) -> (DVector<f64>, DMatrix<f64>) {
        let (n, all) = (LASTING, 2 * LASTING);
        let mut prior = DMatrix::<f64>::zeros(all, all);
        prior.view_mut((0, 0), (n, n)).copy_from(&known.covariance);
        let mut keeps = DVector::repeat(n, 1.0);
        for (i, keep) in passed.keeps.iter().enumerate() {
            keeps[CONSTANT + i] = *keep;
            prior[(n + CONSTANT + i, n + CONSTANT + i)] = 1.0 - keep * keep;
        }
        for (i, drifted) in passed.drifted.iter().enumerate() {
            prior[(n + i, n + i)] = *drifted;
        }
        let mut rows = DMatrix::<f64>::zeros(3, all);
        let mut told = DVector::<f64>::zeros(3);
        let mut noise = DMatrix::<f64>::zeros(3, 3);
        for (axis, strayed) in passed.receiver.iter().enumerate() {
            for (of, i) in [CONSTANT + axis, CONSTANT + axis + NEW]
                .into_iter()
                .enumerate()
            {
                let sigma_m = pace.gnss_m[of][axis];
                rows[(axis, i)] = sigma_m * (keeps[i] - 1.0);
                rows[(axis, n + i)] = sigma_m;
            }
            told[axis] = strayed.by_m;
            noise[(axis, axis)] = strayed.variance_m2;
        }
        let mut mean = DVector::<f64>::zeros(all);
        mean.rows_mut(0, n).copy_from(&known.mean);
        let lever = &prior * rows.transpose();
        let gain = &lever * (&rows * &lever + noise).try_inverse().unwrap();
        let mean = &mean + &gain * (told - &rows * &mean);
        let covariance = &prior - &gain * lever.transpose();
        let mut next = DMatrix::<f64>::zeros(n, all);
        next.view_mut((0, 0), (n, n))
            .copy_from(&DMatrix::from_diagonal(&keeps));
        next.view_mut((0, n), (n, n)).fill_with_identity();
        (&next * mean, &next * covariance * next.transpose())
    }

    #[test]
    fn what_the_velocity_says_of_the_receiver_is_taken_in_exactly() {
        let priors = SharedPriors::default();
        let pace = Pace::new(&priors, &priors.sigmas(&pose(0.0, 0.0, 0.0), &rig(30.0)));
        for seed in 0..20 {
            let mut aged = known(seed);
            let (from, to) = (
                reading(1.0, Vector3::zeros(), 0.2),
                reading(1.4, Vector3::new(0.3, -0.2, 0.05), 0.21),
            );
            let (mean, covariance) = by_hand(&aged, &pace, &pace.passed(&from, &to));
            aged.age(&from, &to, &pace);
            assert!((aged.mean - mean).amax() < 1e-12);
            assert!((aged.covariance - covariance).amax() < 1e-12);
        }
    }

    #[test]
    fn in_no_time_nothing_changes() {
        let priors = SharedPriors::default();
        let pace = Pace::new(&priors, &priors.sigmas(&pose(0.0, 0.0, 0.0), &rig(30.0)));
        let (before, mut after) = (known(1), known(1));
        let now = reading(3.0, Vector3::new(1.0, 2.0, 3.0), 0.4);
        after.age(&now, &now, &pace);
        assert_eq!(
            (before.mean, before.covariance),
            (after.mean, after.covariance)
        );
    }
}
