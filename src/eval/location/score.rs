//! Errors against what was promised: NEES, coverage, CE90.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use serde::Serialize;

/// One alarm against the truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Scored {
    /// Horizontal error, metres.
    pub error_m: f64,
    /// Horizontal error squared over its covariance: chi-square of two degrees of freedom.
    pub nees: f64,
    /// Predicted CE90, metres.
    pub ce90_m: f64,
    /// Root of the trace of the horizontal covariance, metres.
    pub predicted_m: f64,
}

/// Chi-square of two degrees of freedom, 90 %: the 90 % ellipse.
pub const CHI2_2_90: f64 = 4.605_170;

/// An estimate against the truth; `None` when its covariance is not one.
#[must_use]
pub fn score(error: &Vector3<f64>, covariance: &Matrix3<f64>, ce90_m: f64) -> Option<Scored> {
    let flat = Vector2::new(error.x, error.y);
    let spread: Matrix2<f64> = covariance.fixed_view::<2, 2>(0, 0).into_owned();
    let nees = flat.dot(&(spread.try_inverse()? * flat));
    (nees.is_finite() && nees >= 0.0).then_some(Scored {
        error_m: flat.norm(),
        nees,
        ce90_m,
        predicted_m: spread.trace().sqrt(),
    })
}

/// Many alarms together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Consistency {
    /// How many.
    pub count: usize,
    /// Share inside the 90 % ellipse.
    pub coverage90: f64,
    /// Mean NEES over its two degrees of freedom: 1 when honest, above when over-confident.
    pub anees: f64,
    /// Interval that holds it in 95 % of runs of an honest estimator.
    pub anees_95: (f64, f64),
    /// Sample CE90 over predicted CE90: 90th percentile of error over its own predicted CE90.
    pub ce90_ratio: f64,
}

impl Consistency {
    /// Whether ANEES is inside its interval.
    #[must_use]
    pub fn anees_is_inside(&self) -> bool {
        (self.anees_95.0..=self.anees_95.1).contains(&self.anees)
    }
}

/// Figures of many alarms; `None` of none.
#[must_use]
pub fn consistency(alarms: &[Scored]) -> Option<Consistency> {
    let count = alarms.len();
    if count == 0 {
        return None;
    }
    let share = |inside: usize| inside as f64 / count as f64;
    let mut ratios: Vec<f64> = alarms.iter().map(|a| a.error_m / a.ce90_m).collect();
    Some(Consistency {
        count,
        coverage90: share(alarms.iter().filter(|a| a.nees <= CHI2_2_90).count()),
        anees: alarms.iter().map(|a| a.nees).sum::<f64>() / (2.0 * count as f64),
        anees_95: anees_interval(count),
        ce90_ratio: percentile(&mut ratios, 0.9),
    })
}

/// Ends of the 95 % interval of a mean of `count` chi-squares of two degrees, over two: chi-square
/// quantiles after Wilson and Hilferty (1931), within 0.1 % from 20 degrees on.
#[must_use]
pub fn anees_interval(count: usize) -> (f64, f64) {
    let degrees = 2.0 * count as f64;
    let end = |z: f64| {
        let k = 2.0 / (9.0 * degrees);
        (1.0 - k + z * k.sqrt()).powi(3)
    };
    (end(-1.959_964), end(1.959_964))
}

/// The value below which a share of the values lies, interpolated; NaN of none.
pub fn percentile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let Some(last) = values.len().checked_sub(1) else {
        return f64::NAN;
    };
    let at = share * last as f64;
    let (low, part) = (at.floor() as usize, at.fract());
    values[low] + part * (values[(low + 1).min(last)] - values[low])
}

/// Mean; NaN of none.
pub fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0_u32);
    for value in values {
        sum += value;
        count += 1;
    }
    sum / f64::from(count)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// limits.md T13: dim 2, N = 400: [0.904, 1.100]; N = 1000: [0.939, 1.063].
    #[test]
    fn intervals_are_those_of_the_tables() {
        for (count, low, high) in [(400, 0.904, 1.100), (1000, 0.939, 1.063)] {
            let (a, b) = anees_interval(count);
            assert!((a - low).abs() < 1e-3 && (b - high).abs() < 1e-3, "{a} {b}");
        }
    }

    #[test]
    fn an_error_of_one_sigma_per_axis_has_a_nees_of_two() {
        let covariance = Matrix3::from_diagonal(&Vector3::new(4.0, 9.0, 1.0));
        let scored = score(&Vector3::new(2.0, -3.0, 50.0), &covariance, 5.0).unwrap();
        assert!((scored.nees - 2.0).abs() < 1e-12);
        assert!((scored.predicted_m - 13.0_f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn percentiles_interpolate() {
        assert!((percentile(&mut [3.0, 1.0, 2.0], 0.75) - 2.5).abs() < 1e-12);
        assert!(percentile(&mut [], 0.5).is_nan());
    }
}
