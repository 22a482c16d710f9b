//! Many disparities to one, with its error.

/// One pixel's disparity, where there is a valid one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
    /// Column and row in the patch.
    pub at: (i32, i32),
    pub disparity_px: f64,
}

/// What most samples agree on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pooled {
    pub disparity_px: f64,
    pub support: u32,
    /// Share of all samples that agree.
    pub agreement: f64,
    /// Mean column and row of the samples that agree.
    pub centroid: (f64, f64),
}

/// Samples within this of the mode belong to it. Flames are about as deep as they are wide, which
/// beyond a few metres is below a pixel; what lies behind them is mostly farther off.
const REACH_PX: f64 = 1.0;

/// The mean of the samples around the mode; `None` without samples.
///
/// The mean is of disparities, and only of valid ones: P3 eq. 12 divides by the whole mask and so
/// counts every unmatched pixel as infinitely far (checklist E3).
pub(super) fn pool(samples: &[Sample]) -> Option<Pooled> {
    let mut middle = mode(samples)?;
    let near = |middle: f64| {
        samples
            .iter()
            .filter(move |sample| (sample.disparity_px - middle).abs() <= REACH_PX)
    };
    // The window re-centres on its own mean, so that its edges cut both tails alike.
    for _ in 0..5 {
        middle = mean(near(middle).map(|sample| sample.disparity_px));
    }
    let support = near(middle).count();
    Some(Pooled {
        disparity_px: middle,
        support: support as u32,
        agreement: support as f64 / samples.len() as f64,
        centroid: (
            mean(near(middle).map(|sample| f64::from(sample.at.0))),
            mean(near(middle).map(|sample| f64::from(sample.at.1))),
        ),
    })
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

/// Middle of the window of `2 * REACH_PX` that holds the most samples.
fn mode(samples: &[Sample]) -> Option<f64> {
    let mut sorted: Vec<f64> = samples.iter().map(|sample| sample.disparity_px).collect();
    sorted.sort_by(f64::total_cmp);
    let mut first = 0;
    let mut best: Option<(usize, f64)> = None;
    for (last, value) in sorted.iter().enumerate() {
        while value - sorted[first] > 2.0 * REACH_PX {
            first += 1;
        }
        let count = last - first + 1;
        // Of equals the nearer one: the flame stands in front of what is behind it.
        if best.is_none_or(|(most, _)| count >= most) {
            best = Some((count, (value + sorted[first]) / 2.0));
        }
    }
    best.map(|(_, middle)| middle)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(disparities: &[f64]) -> Vec<Sample> {
        let sample = |(k, d): (usize, &f64)| Sample {
            at: (k as i32, 0),
            disparity_px: *d,
        };
        disparities.iter().enumerate().map(sample).collect()
    }

    #[test]
    fn no_samples_are_no_disparity() {
        assert_eq!(pool(&[]), None);
    }

    /// Checklist E3. Of 100 masked pixels 70 match at 6 px, and a block matcher writes 0 for the others.
    /// The printed division by the mask's size makes 4.2 px of them, which puts an 11 m fire at 15.8 m.
    #[test]
    fn unmatched_pixels_do_not_pull_the_mean_as_the_printed_division_does() {
        let mut disparities = vec![6.0; 70];
        disparities.extend([0.0; 30]);
        let pooled = pool(&samples(&disparities)).unwrap();
        assert_eq!(pooled.disparity_px, 6.0);
        assert_eq!((pooled.support, pooled.agreement), (70, 0.7));
    }

    #[test]
    fn background_behind_the_flame_does_not_count() {
        let mut disparities = vec![2.0; 40];
        disparities.extend((0..60).map(|k| 5.0 + 0.01 * f64::from(k % 5)));
        let pooled = pool(&samples(&disparities)).unwrap();
        assert!((pooled.disparity_px - 5.02).abs() < 1e-9, "{pooled:?}");
        assert_eq!((pooled.support, pooled.agreement), (60, 0.6));
        assert_eq!(pooled.centroid.0, 69.5);
    }

    #[test]
    fn of_two_equal_clusters_the_nearer_counts() {
        let pooled = pool(&samples(&[2.0, 2.0, 7.0, 7.0])).unwrap();
        assert_eq!(pooled.disparity_px, 7.0);
    }
}
