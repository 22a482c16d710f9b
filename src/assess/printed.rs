//! P1's fusion (Ni et al., Eq. 4 to 6, Algorithm 1), as printed and with its weight turned right.
//!
//! Baselines, not what flies. The printed score `|x - mean| / sigma` is large for an outlier, and the
//! printed weight gives the channel with the larger score more say. Turned, each channel gets the
//! other one's score as its weight, so that the outlier loses. Algorithm 1 takes the scores as
//! they are (the text's scaling to 0..1 is not in it), and its window is centred: the value of sample
//! `i` is known `r` samples later.

/// P1's constant against division by zero.
const EPSILON: f64 = 1e-6;

/// Which way the weight goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Weight {
    /// As printed: the larger score weighs more.
    Printed,
    /// The smaller score weighs more.
    Turned,
}

/// Fused values for the samples `r ..= T - 1 - r` of two normalised signals of equal length, by a
/// centred window of `2 r + 1` samples; empty when they are shorter than the window.
#[must_use]
pub fn fuse(spectral: &[f64], visible: &[f64], r: usize, weight: Weight) -> Vec<f64> {
    let windows = spectral.windows(2 * r + 1).zip(visible.windows(2 * r + 1));
    windows
        .map(|(spectral, visible)| {
            let (s, v) = (score(spectral, r), score(visible, r));
            let alpha = match weight {
                Weight::Printed => s / (s + v + EPSILON),
                // Two scores of nothing (both flat) leave neither channel the better one.
                Weight::Turned => (v + EPSILON) / (s + v + 2.0 * EPSILON),
            };
            alpha * spectral[r] + (1.0 - alpha) * visible[r]
        })
        .collect()
}

/// Eq. 4 for the middle of a window.
fn score(window: &[f64], middle: usize) -> f64 {
    let count = window.len() as f64;
    let mean = window.iter().sum::<f64>() / count;
    let variance = window.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count;
    (window[middle] - mean).abs() / (variance.sqrt() + EPSILON)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both channels rise alike; one sample of the visible one is wrong.
    fn spiked() -> (Vec<f64>, Vec<f64>) {
        let clean: Vec<f64> = (0..21).map(|k| 0.3 + 0.02 * f64::from(k)).collect();
        let mut visible = clean.clone();
        visible[10] += 0.5;
        (clean, visible)
    }

    fn error_at_the_spike(weight: Weight) -> f64 {
        let (clean, visible) = spiked();
        let fused = fuse(&clean, &visible, 2, weight);
        assert_eq!(fused.len(), 17);
        (fused[8] - clean[10]).abs()
    }

    #[test]
    fn the_printed_weight_follows_an_outlier_and_the_turned_one_leaves_it() {
        // Half of the spike is what a plain mean of the channels would let through.
        assert!(error_at_the_spike(Weight::Turned) < 0.01);
        assert!(
            error_at_the_spike(Weight::Printed) > 0.4,
            "E15: if the printed rule ever passes, it is no longer the printed rule"
        );
    }

    #[test]
    fn equal_channels_stay_as_they_are() {
        let (clean, _) = spiked();
        for weight in [Weight::Printed, Weight::Turned] {
            for (fused, clean) in fuse(&clean, &clean, 2, weight).iter().zip(&clean[2..]) {
                assert!((fused - clean).abs() < 1e-12);
            }
        }
        assert!(fuse(&clean[..3], &clean[..3], 2, Weight::Printed).is_empty());
    }
}
