//! Seeded randomness as functions of time, so that the order of questions changes nothing.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// A stream of random numbers of its own for every seed and purpose.
#[must_use]
pub fn stream(seed: u64, purpose: &str) -> ChaCha8Rng {
    // FNV-1a (Fowler, Noll, Vo): a stable hash, unlike the standard library's.
    let hash = purpose.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |h, byte| {
        (h ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
    });
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(hash);
    rng
}

/// One draw from the standard normal distribution.
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(rng)
}

/// A first-order Gauss-Markov (Ornstein-Uhlenbeck) process, sampled on a grid and joined smoothly.
///
/// `E[x(t) x(t + d)] = sigma^2 exp(-d / correlation)`; stationary from the start.
#[derive(Debug, Clone)]
pub struct GaussMarkov {
    step_s: f64,
    samples: Vec<f64>,
}

/// Grid points per correlation time: the curve between them is smooth, which shortens the
/// correlation by less than the grid step.
const STEPS_PER_CORRELATION: f64 = 10.0;
/// Longest step, so that slow processes still bend softly.
const MAX_STEP_S: f64 = 2.0;
/// Grid before the start and after the end, for callers that look around a moment.
const MARGIN_STEPS: usize = 4;

impl GaussMarkov {
    /// A process for `0 <= t <= duration_s`; constant beyond.
    #[must_use]
    pub fn new(rng: &mut ChaCha8Rng, sigma: f64, correlation_s: f64, duration_s: f64) -> Self {
        let step_s = (correlation_s / STEPS_PER_CORRELATION).min(MAX_STEP_S);
        let keep = (-step_s / correlation_s).exp();
        let renew = sigma * (1.0 - keep * keep).sqrt();
        let count = (duration_s / step_s).ceil() as usize + 2 * MARGIN_STEPS;
        let mut value = sigma * normal(rng);
        let samples = (0..count)
            .map(|_| {
                let now = value;
                value = keep * value + renew * normal(rng);
                now
            })
            .collect();
        Self { step_s, samples }
    }

    /// The value `t_s` seconds after the start: a Catmull-Rom curve through the grid.
    #[must_use]
    pub fn at(&self, t_s: f64) -> f64 {
        let grid = t_s / self.step_s + MARGIN_STEPS as f64 - 1.0;
        let grid = grid.clamp(1.0, self.samples.len() as f64 - 3.0);
        let (before, share) = (grid.floor() as usize, grid.fract());
        let [a, b, c, d] =
            [-1_isize, 0, 1, 2].map(|k| self.sample(before.saturating_add_signed(k)));
        let slope_b = (c - a) / 2.0;
        let slope_c = (d - b) / 2.0;
        let (s2, s3) = (share * share, share * share * share);
        b * (2.0 * s3 - 3.0 * s2 + 1.0)
            + slope_b * (s3 - 2.0 * s2 + share)
            + c * (3.0 * s2 - 2.0 * s3)
            + slope_c * (s3 - s2)
    }

    fn sample(&self, index: usize) -> f64 {
        self.samples[index.min(self.samples.len() - 1)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Products of the process with itself `lag_s` later, averaged over many runs.
    fn covariance(sigma: f64, correlation_s: f64, lag_s: f64) -> f64 {
        let runs = 4000_u32;
        let sum: f64 = (0..runs)
            .map(|run| {
                let mut rng = stream(u64::from(run), "test");
                let process = GaussMarkov::new(&mut rng, sigma, correlation_s, 200.0);
                process.at(37.0) * process.at(37.0 + lag_s)
            })
            .sum();
        sum / f64::from(runs)
    }

    #[test]
    fn the_process_has_the_stated_sigma_and_correlation_time() {
        let variance = covariance(1.5, 60.0, 0.0);
        // Standard error of a variance from 4000 draws: 2.2 %; the smooth join takes up to 5 %.
        assert!((variance / 2.25 - 1.0).abs() < 0.10, "variance {variance}");
        let after_one = covariance(1.5, 60.0, 60.0);
        assert!(
            (after_one / 2.25 - (-1.0_f64).exp()).abs() < 0.08,
            "after one time {after_one}"
        );
    }

    #[test]
    fn streams_differ_by_seed_and_purpose_and_repeat() {
        let draw = |seed, purpose| normal(&mut stream(seed, purpose));
        assert_eq!(draw(1, "gnss"), draw(1, "gnss"));
        assert_ne!(draw(1, "gnss"), draw(2, "gnss"));
        assert_ne!(draw(1, "gnss"), draw(1, "heading"));
    }
}
