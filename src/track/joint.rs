//! One fire and the errors that it was seen through, together: mean and covariance.
//!
//! Numbers: the fire's ([`OF_FIRE`], see [`Chart`](super::chart::Chart)), then the [`LASTING`] shared errors of this
//! moment, constant ones first, each in units of its own prior sigma (so that a sigma that changes
//! in flight needs no bookkeeping). Errors that are new in each frame are noise of its sightings.

use super::chart::{INVERSE_DEPTH, OF_FIRE, State, TANGENTS};
use crate::locate::{CONSTANT, Lens, SHARED, SharedPriors, WANDERING};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

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
}

/// What some seconds do to the shared errors.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Passed {
    keeps: [f64; WANDERING],
    drifted: [f64; CONSTANT],
}

impl Pace {
    /// For the priors of a mission, at the sigmas of a moment.
    #[must_use]
    pub fn new(priors: &SharedPriors, sigmas: &SVector<f64, SHARED>) -> Self {
        let drift = |i: usize| (DRIFT_PER_MINUTE[i] / sigmas[i].max(f64::MIN_POSITIVE)).powi(2);
        Self {
            correlations_s: priors.correlations_s(),
            drifts: std::array::from_fn(|i| drift(i).min(1.0) / 60.0),
        }
    }

    /// What is left of each wandering error after some seconds.
    #[must_use]
    pub fn keeps(&self, dt_s: f64) -> [f64; WANDERING] {
        self.correlations_s
            .map(|correlation_s| (-dt_s.abs() / correlation_s).exp())
    }

    fn passed(&self, dt_s: f64) -> Passed {
        let dt_s = dt_s.max(0.0);
        Passed {
            keeps: self.keeps(dt_s),
            drifted: self.drifts.map(|drift| drift * dt_s),
        }
    }
}

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
    for (i, keep) in passed.keeps.iter().enumerate() {
        let at = from + CONSTANT + i;
        mean[at] *= keep;
        covariance.row_mut(at).scale_mut(*keep);
        covariance.column_mut(at).scale_mut(*keep);
        covariance[(at, at)] += 1.0 - keep * keep;
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
    pub fn age(&mut self, dt_s: f64, pace: &Pace) {
        age(&mut self.mean, &mut self.covariance, 0, &pace.passed(dt_s));
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
    pub fn age(&mut self, dt_s: f64, pace: &Pace) {
        let passed = pace.passed(dt_s);
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
        let lever = self.covariance * m.rows.transpose();
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
        self.covariance -= whitened * whitened.transpose();
        self.keep_positive();
        Some(squared / if m.has_disparity { 3.0 } else { 2.0 })
    }

    /// Takes one number in: `residual = row' (x - at) + noise`.
    pub fn take_one(&mut self, row: &JointVector, residual: f64, variance: f64, at: &JointVector) {
        let lever = self.covariance * row;
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
