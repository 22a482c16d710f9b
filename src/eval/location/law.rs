//! What errors are drawn from: what the estimator assumes, and what it does not.

use super::flight::log_uniform;
use super::truth::{Slow, gauss, slow};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StudentT};
use serde::Serialize;
use std::f64::consts::TAU;

/// The distributions that the errors of a flight come from. All keep the sigmas that the service is
/// told; what differs is their shape, or how they hang together in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Law {
    /// As the estimator assumes: normal, first-order Gauss-Markov, white in each look.
    Assumed,
    /// Pixel, disparity noise from Student's t with three degrees of freedom.
    HeavyTails,
    /// Box edges err alike from look to look (correlation 0.7).
    StickyBoxes,
    /// Constant parts of heading, tilt, boresight, disparity, clock, lever arm from uniform
    /// distributions.
    UniformMount,
    /// The same from Laplace distributions.
    LaplaceMount,
    /// GNSS errors that forget three times faster than assumed.
    FastGnss,
    /// GNSS errors that forget three times slower.
    SlowGnss,
    /// GNSS errors that walk away from a normal start by 0.1 of their moving sigma per root second,
    /// unbounded: doubled variance after 100 s.
    WalkingGnss,
    /// GNSS errors that stay and then jump to another value, as often as they would have forgotten
    /// the old one: the assumed correlation in time, by jumps of metres within a look.
    JumpingGnss,
    /// Velocity errors that forget ten times slower than assumed: the way that is summed up from them
    /// strays three times further.
    SlowVelocity,
    /// All that wanders (GNSS, heading, tilt) is a sine of a period by chance, 20 to 120 s.
    SineDrift,
    /// Tails, sticky boxes, Laplace mounts and fast GNSS together.
    Everything,
}

impl Law {
    /// Those that the estimator does not assume.
    pub const FOREIGN: [Self; 11] = [
        Self::HeavyTails,
        Self::StickyBoxes,
        Self::UniformMount,
        Self::LaplaceMount,
        Self::FastGnss,
        Self::SlowGnss,
        Self::WalkingGnss,
        Self::JumpingGnss,
        Self::SlowVelocity,
        Self::SineDrift,
        Self::Everything,
    ];

    /// As tables name it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Assumed => "as assumed",
            Self::HeavyTails => "Student t (3) pixels and disparity",
            Self::StickyBoxes => "box edges correlated 0.7 from look to look",
            Self::UniformMount => "uniform heading, tilt, boresight, disparity, clock",
            Self::LaplaceMount => "Laplace heading, tilt, boresight, disparity, clock",
            Self::FastGnss => "GNSS correlation time / 3",
            Self::SlowGnss => "GNSS correlation time x 3",
            Self::WalkingGnss => "GNSS random walk, 0.1 sigma per root second",
            Self::JumpingGnss => "GNSS in jumps instead of a drift",
            Self::SlowVelocity => "velocity correlation time x 10",
            Self::SineDrift => "sine drift of GNSS, heading, tilt, 20 to 120 s",
            Self::Everything => "t pixels, sticky boxes, Laplace, fast GNSS together",
        }
    }

    pub(super) fn correlations(self, assumed: &Slow) -> Slow {
        let mut seconds = *assumed;
        let factor = match self {
            Self::FastGnss | Self::Everything => 1.0 / 3.0,
            Self::SlowGnss => 3.0,
            _ => 1.0,
        };
        seconds.rows_mut(slow::GNSS, 3).scale_mut(factor);
        if self == Self::SlowVelocity {
            seconds.rows_mut(slow::VELOCITY, 3).scale_mut(10.0);
        }
        seconds
    }

    /// The part that is constant in a flight.
    pub(super) fn constant(self, rng: &mut ChaCha8Rng, index: usize, sigma: f64) -> f64 {
        let of_mount = index >= slow::HEADING;
        match self {
            Self::UniformMount if of_mount => sigma * rng.random_range(-1.0..1.0) * 3.0_f64.sqrt(),
            Self::LaplaceMount | Self::Everything if of_mount => laplace(rng, sigma),
            _ => gauss(rng, sigma),
        }
    }

    /// The part that wanders, `dt_s` later.
    pub(super) fn next(
        self,
        rng: &mut ChaCha8Rng,
        index: usize,
        now: f64,
        sigma: f64,
        dt_s: f64,
        correlation_s: f64,
    ) -> f64 {
        let of_mount = index >= slow::HEADING;
        let fresh = gauss(rng, 1.0);
        if self == Self::WalkingGnss && !of_mount {
            return now + WALK * sigma * dt_s.sqrt() * fresh;
        }
        let keep = (-dt_s / correlation_s).exp();
        if self == Self::JumpingGnss && !of_mount {
            return if rng.random_bool(keep) {
                now
            } else {
                sigma * fresh
            };
        }
        keep * now + sigma * (1.0 - keep * keep).sqrt() * fresh
    }
}

/// Periods of [`Law::SineDrift`], seconds.
const PERIODS_S: (f64, f64) = (20.0, 120.0);

/// Errors that swing, each with a phase and a rate of its own.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sines {
    phases_rad: Slow,
    rates_rad_s: Slow,
}

impl Sines {
    pub(super) fn drawn(rng: &mut ChaCha8Rng) -> Self {
        Self {
            phases_rad: Slow::from_fn(|_, _| rng.random_range(0.0..TAU)),
            rates_rad_s: Slow::from_fn(|_, _| TAU / log_uniform(rng, PERIODS_S.0, PERIODS_S.1)),
        }
    }

    /// At a time, for these sigmas.
    pub(super) fn at(&self, t_s: f64, sigmas: &Slow) -> Slow {
        let phases = self.phases_rad + self.rates_rad_s * t_s;
        phases.map(f64::sin).component_mul(sigmas) * 2.0_f64.sqrt()
    }
}

/// Sigmas per root second of [`Law::WalkingGnss`].
const WALK: f64 = 0.1;
/// Correlation of box edges from look to look.
const STICKY: f64 = 0.7;

fn laplace(rng: &mut ChaCha8Rng, sigma: f64) -> f64 {
    let u: f64 = rng.random_range(-0.5..0.5);
    -sigma / 2.0_f64.sqrt() * u.signum() * (1.0 - 2.0 * u.abs()).max(1e-300).ln()
}

/// What is new in each look of one flame, with the memory that [`Law::StickyBoxes`] needs.
#[derive(Debug, Clone)]
pub struct Draw {
    rng: ChaCha8Rng,
    law: Law,
    sticky: [Option<f64>; 2],
}

impl Draw {
    /// A source of noise.
    #[must_use]
    pub fn new(rng: ChaCha8Rng, law: Law) -> Self {
        Self {
            rng,
            law,
            sticky: [None; 2],
        }
    }

    /// Noise that is new.
    pub fn white(&mut self, sigma: f64) -> f64 {
        match self.law {
            // Variance of t(3) is 3.
            Law::HeavyTails | Law::Everything => {
                StudentT::new(3.0).map_or(0.0, |t| t.sample(&mut self.rng) * sigma / 3.0_f64.sqrt())
            }
            _ => gauss(&mut self.rng, sigma),
        }
    }

    /// Noise of a box's edge along columns (0) or rows (1).
    pub fn pixel(&mut self, axis: usize, sigma: f64) -> f64 {
        let fresh = self.white(sigma);
        if !matches!(self.law, Law::StickyBoxes | Law::Everything) {
            return fresh;
        }
        let value = self.sticky[axis].map_or(fresh, |old| {
            STICKY * old + (1.0 - STICKY * STICKY).sqrt() * fresh
        });
        self.sticky[axis] = Some(value);
        value
    }

    /// True with a probability.
    pub fn happens(&mut self, probability: f64) -> bool {
        self.rng.random_bool(probability)
    }

    /// An even draw.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        self.rng.random_range(low..high)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::location::truth::{ErrorModel, Gnss, wander};
    use emberfix_sim::noise::stream;

    /// 4000 draws: the standard error of a variance is 2.2 % for normal, 3.5 % for Laplace.
    #[test]
    fn every_law_keeps_the_sigmas_at_the_start() {
        let errors = ErrorModel::of(Gnss::Consumer, 2.0);
        for law in [
            Law::Assumed,
            Law::UniformMount,
            Law::LaplaceMount,
            Law::JumpingGnss,
            Law::SineDrift,
        ] {
            let mut squares = Slow::zeros();
            for seed in 0..4000 {
                let slow = wander(&mut stream(seed, "law"), &errors, &[0.0], law)[0];
                squares += slow.component_div(&errors.sigmas()).map(|x| x * x);
            }
            for ratio in (squares / 4000.0).iter() {
                assert!((ratio - 1.0).abs() < 0.14, "{law:?} {ratio}");
            }
        }
    }

    #[test]
    fn errors_that_drift_and_that_jump_forget_as_their_correlation_time_says() {
        let errors = ErrorModel::of(Gnss::Consumer, 2.0);
        for law in [Law::Assumed, Law::JumpingGnss] {
            let product: f64 = (0..4000)
                .map(|seed| {
                    let mut rng = stream(seed, "law");
                    let values = wander(&mut rng, &errors, &[0.0, 30.0, 100.0], law);
                    values[0][0] * values[2][0] / (1.5 * 1.5)
                })
                .sum();
            // 0.5 + 0.5 exp(-100 / 60); one sigma of the mean of 4000 products is 0.017.
            assert!(
                (product / 4000.0 - 0.5944).abs() < 0.06,
                "{law:?} {product}"
            );
        }
    }
}
