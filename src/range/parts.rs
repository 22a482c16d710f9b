//! The disparities of a target's parts as one, with its error.
//!
//! A flame is as deep as it is wide, so near ones have no single disparity. The parts' disparities are
//! pooled as a random-effects mean: as far as the parts truly differ each counts alike, as far as they
//! only differ by noise the sharper one counts more. Their scatter is the error that the mean states.

use super::refine::Refined;

/// Fewer parts than this have no scatter to speak of.
const FEWEST_PARTS: usize = 4;
/// Parts farther than this many sigmas from the rest are not flame but what is behind or before it.
const OUTLIER_SIGMAS: f64 = 3.0;
/// How much a disparity may change from row to row, one sigma: what stands upright before a camera that
/// looks down.
const TILT: f64 = 0.006;

/// Random-effects mean of the parts, less their common slope over rows: between-part scatter as the
/// median of absolute deviations, which what is behind the flame does not widen.
pub(super) fn pooled(parts: &[Refined]) -> Option<Refined> {
    if parts.len() < FEWEST_PARTS {
        return None;
    }
    let middle = |value: fn(&Refined) -> f64| median(parts.iter().map(value).collect());
    let noise = middle(|found| found.sigma_px)?;
    let mut line = Line {
        mean: middle(|found| found.disparity_px)?,
        slope: 0.0,
        row: middle(|found| found.at.1)?,
    };
    let mut found = None;
    for _ in 0..5 {
        let off = parts.iter().map(|part| line.off(part).abs());
        let spread = 1.4826 * median(off.collect())?;
        let between = (spread.powi(2) - noise.powi(2)).max(0.0);
        found = line.through(parts, between);
    }
    found
}

/// A disparity at a row and its change from row to row.
struct Line {
    mean: f64,
    slope: f64,
    row: f64,
}

impl Line {
    fn off(&self, part: &Refined) -> f64 {
        part.disparity_px - self.mean - self.slope * (part.at.1 - self.row)
    }

    /// The line that fits the parts near this one, and what it says of their middle.
    fn through(&mut self, parts: &[Refined], between: f64) -> Option<Refined> {
        let weighed: Vec<(f64, &Refined)> = parts
            .iter()
            .map(|part| (part.sigma_px.powi(2) + between, part))
            .filter(|(variance, part)| self.off(part).powi(2) < OUTLIER_SIGMAS.powi(2) * variance)
            .map(|(variance, part)| (1.0 / variance, part))
            .collect();
        let sum = |value: &dyn Fn(&Refined) -> f64| -> f64 {
            let weighted = |(weight, part): &(f64, &Refined)| weight * value(part);
            weighed.iter().map(weighted).sum()
        };
        let w = sum(&|_| 1.0);
        let (column, row) = (sum(&|part| part.at.0) / w, sum(&|part| part.at.1) / w);
        let mean = sum(&|part| part.disparity_px) / w;
        let rows = sum(&|part| (part.at.1 - row).powi(2)) + TILT.powi(-2);
        let slope = sum(&|part| (part.at.1 - row) * (part.disparity_px - mean)) / rows;
        *self = Self { mean, slope, row };
        let squares: f64 = weighed
            .iter()
            .map(|(weight, part)| (weight * self.off(part)).powi(2))
            .sum();
        let n = weighed.len() as f64;
        let scattered = (squares * n / (n - 1.0)).max(w).sqrt() / w;
        (weighed.len() > 1 && scattered.is_finite()).then_some(Refined {
            disparity_px: mean,
            sigma_px: scattered,
            at: (column, row),
        })
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_behind_the_flame_do_not_count_and_scatter_is_stated() {
        let part = |disparity_px| Refined {
            disparity_px,
            sigma_px: 0.02,
            at: (1.0, 2.0),
        };
        let mut parts: Vec<Refined> = (0..9)
            .map(|k| part(5.0 + 0.01 * f64::from(k % 3)))
            .collect();
        let tight = pooled(&parts).unwrap();
        parts.extend([part(3.0), part(3.1)]);
        let found = pooled(&parts).unwrap();
        assert!((found.disparity_px - 5.01).abs() < 0.01, "{found:?}");
        let wide: Vec<Refined> = (0..9).map(|k| part(5.0 + 0.3 * f64::from(k % 3))).collect();
        assert!(pooled(&wide).unwrap().sigma_px > 5.0 * tight.sigma_px);
    }
}
