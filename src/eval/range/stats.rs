//! Means and spreads.

/// Mean of some values.
pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Root of the mean square.
pub(super) fn rms(values: &[f64]) -> Option<f64> {
    mean(&values.iter().map(|value| value * value).collect::<Vec<_>>()).map(f64::sqrt)
}

/// Standard deviation of the population that a sample is from.
pub(super) fn deviation(values: &[f64]) -> Option<f64> {
    let middle = mean(values)?;
    let squares: f64 = values.iter().map(|value| (value - middle).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// Half of the 95 % interval of the mean, by Student's t.
pub(super) fn half_interval95(values: &[f64]) -> Option<f64> {
    let freedom = values.len().checked_sub(1)? as f64;
    Some(student95(freedom) * deviation(values)? / (values.len() as f64).sqrt())
}

/// Student's t at 97.5 %: Cornish and Fisher's expansion of the normal's 1.96; 2.09 at 19.
fn student95(freedom: f64) -> f64 {
    let z = 1.959_964_f64;
    let first = (z.powi(3) + z) / 4.0;
    let second = (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / 96.0;
    let third = (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / 384.0;
    z + first / freedom + second / freedom.powi(2) + third / freedom.powi(3)
}

/// Middle of some values.
pub(super) fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    match sorted.len() {
        0 => None,
        n if n % 2 == 1 => Some(sorted[middle]),
        _ => Some(0.5 * (sorted[middle - 1] + sorted[middle])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_of_twenty_is_the_papers() {
        // P1's first row: 51.08 +- 2.06 cm, 20 times, gives [50.11, 52.05].
        let values: Vec<f64> = (0..20)
            .map(|k| if k % 2 == 0 { -1.0 } else { 1.0 })
            .collect();
        let scale = 2.06 / deviation(&values).unwrap();
        let values: Vec<f64> = values.iter().map(|value| 51.08 + scale * value).collect();
        let half = half_interval95(&values).unwrap();
        assert!((half - 0.965).abs() < 0.005, "{half}");
    }

    #[test]
    fn a_median_is_the_middle() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[4.0, 1.0]), Some(2.5));
        assert_eq!(median(&[]), None);
    }
}
