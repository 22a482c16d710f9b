//! Growing, steady or dying: the slope of a fire's intensity, its error, and what that means.
//!
//! **In:** the fused intensity over the last [`WINDOW_S`]. **Out:** [`Trend`]: relative slope per
//! second by least squares with its error, probabilities, and a [`Course`] with hysteresis.

use super::extent::{Line, Measured};
use serde::{Deserialize, Serialize};

/// Seconds over which the slope is taken.
pub const WINDOW_S: f64 = 15.0;
/// Least span and number of samples for a slope.
const LEAST_SPAN_S: f64 = 5.0;
const LEAST_SAMPLES: usize = 10;
/// Relative slope per second that still counts as steady: a tenth in ten seconds.
pub const STEADY: f64 = 0.01;
/// Probability from which a course is entered, and below which it is left.
const ENTER: f64 = 0.9;
const LEAVE: f64 = 0.6;

/// What a fire does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Course {
    /// Its intensity rises, or its front runs.
    Growing,
    /// Neither.
    Steady,
    /// Its intensity falls.
    Dying,
}

/// How a fire's intensity changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trend {
    /// Relative slope, per second, with one sigma.
    pub slope: Measured,
    /// Probability that it rises by more than [`STEADY`].
    pub growing: f64,
    /// Probability that it falls by more than that.
    pub dying: f64,
    /// With hysteresis.
    pub course: Course,
}

impl Trend {
    /// From (seconds, intensity) in time order; `drift` is one sigma of a false relative slope that
    /// the samples themselves can't show (a range that is wrong while we come nearer). `before` is
    /// the course so far. `None` while there are too few samples.
    #[must_use]
    pub fn of(samples: &[(f64, f64)], drift: f64, before: Option<Course>) -> Option<Self> {
        let (first, last) = (samples.first()?, samples.last()?);
        if samples.len() < LEAST_SAMPLES || last.0 - first.0 < LEAST_SPAN_S {
            return None;
        }
        let mean = samples.iter().map(|sample| sample.1).sum::<f64>() / samples.len() as f64;
        let line = Line::through(samples)?;
        if mean <= 0.0 {
            return None;
        }
        let slope = Measured {
            value: line.slope / mean,
            sigma: (line.slope_sigma / mean).hypot(drift),
        };
        let growing = above((slope.value - STEADY) / slope.sigma.max(1e-9));
        let dying = above((-slope.value - STEADY) / slope.sigma.max(1e-9));
        Some(Self {
            slope,
            growing,
            dying,
            course: course(growing, dying, before),
        })
    }
}

fn course(growing: f64, dying: f64, before: Option<Course>) -> Course {
    let stays = match before {
        Some(Course::Growing) => growing >= LEAVE,
        Some(Course::Dying) => dying >= LEAVE,
        Some(Course::Steady) | None => false,
    };
    match before {
        Some(before) if stays => before,
        _ if growing >= ENTER => Course::Growing,
        _ if dying >= ENTER => Course::Dying,
        _ => Course::Steady,
    }
}

/// Standard normal probability of being below `z` (logistic form, within 0.01).
fn above(z: f64) -> f64 {
    1.0 / (1.0 + (-1.702 * z).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(rate: f64, wiggle: f64) -> Vec<(f64, f64)> {
        let at = |k: u32| f64::from(k) * 0.25;
        let value = |k: u32| (rate * at(k)).exp() + wiggle * (f64::from(k) * 2.3).sin();
        (0..60).map(|k| (at(k), value(k))).collect()
    }

    #[test]
    fn a_clear_slope_is_a_course_and_a_flat_one_is_steady() {
        let of = |rate, wiggle| Trend::of(&samples(rate, wiggle), 0.0, None).unwrap();
        assert_eq!(of(0.05, 0.05).course, Course::Growing);
        assert_eq!(of(-0.05, 0.05).course, Course::Dying);
        assert_eq!(of(0.0, 0.05).course, Course::Steady);
        assert!((of(0.03, 0.0).slope.value - 0.03).abs() < 0.003);
    }

    #[test]
    fn a_course_is_left_later_than_it_is_entered() {
        // Probability between the two thresholds: nothing new, but what was stays.
        let doubtful = samples(0.02, 0.0);
        let drift = 0.015;
        assert_eq!(
            Trend::of(&doubtful, drift, None).unwrap().course,
            Course::Steady
        );
        let kept = Trend::of(&doubtful, drift, Some(Course::Growing)).unwrap();
        assert_eq!(kept.course, Course::Growing, "{kept:?}");
    }

    #[test]
    fn a_slope_that_a_wrong_range_could_make_is_no_growth() {
        let trend = Trend::of(&samples(0.05, 0.0), 0.05, None).unwrap();
        assert_eq!(trend.course, Course::Steady, "{trend:?}");
    }

    #[test]
    fn too_few_samples_say_nothing() {
        assert_eq!(Trend::of(&samples(0.05, 0.0)[..9], 0.0, None), None);
    }
}
