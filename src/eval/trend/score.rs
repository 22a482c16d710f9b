//! P1's Eq. 7, causally and alike for all methods.
//!
//! At each sample the trend that a method can state then is compared with the trend of the infrared
//! truth then: a method whose window looks ahead pays for it in latency. Signals and truth are
//! scaled by their own median before the scored part, a missing sample leaves the last
//! one standing, and what the paper smooths is smoothed by a mean of the last five samples.

use super::burns::{Burn, LEAD, STEP_S};
use crate::assess::fusion::Fusion;
use crate::assess::printed::{Weight, fuse};
use serde::Serialize;

/// Dead-band of Eq. 7: change per sample, of the level before the scored part.
pub const DEAD_BAND: f64 = 0.002;
/// Samples of the causal smoothing: P1's window of 2 r + 1.
pub const SMOOTHING: usize = 2 * RADIUS + 1;
/// P1's r.
pub const RADIUS: usize = 2;

/// Ways to state the trend.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The spectral channel alone.
    Spectral,
    /// The visible channel alone.
    Visible,
    /// P1's fusion as printed.
    Printed,
    /// P1's fusion with its weight turned right.
    Turned,
    /// What flies: [`crate::assess::fusion`].
    Ours,
}

impl Method {
    /// All of them, in the order of the tables.
    pub const ALL: [Self; 5] = [
        Self::Spectral,
        Self::Visible,
        Self::Printed,
        Self::Turned,
        Self::Ours,
    ];

    /// Its name in figures and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Spectral => "spectral",
            Self::Visible => "visible",
            Self::Printed => "printed",
            Self::Turned => "turned",
            Self::Ours => "ours",
        }
    }

    /// Its place in [`Method::ALL`].
    #[must_use]
    pub fn column(self) -> usize {
        self as usize
    }

    /// As [`Method::accuracy`], with the samples by which P1's window looks ahead given for nothing:
    /// what the paper's own way of scoring would say.
    #[must_use]
    pub fn accuracy_aligned(self, burn: &Burn) -> f64 {
        let mut signal = self.signal(burn);
        signal.drain(..RADIUS);
        accuracy(&signal, &scaled(&burn.truth))
    }

    /// What flies, with one of its channels alone: shows what fusing adds to filtering.
    #[must_use]
    pub fn accuracy_alone(burn: &Burn, channel: usize) -> f64 {
        accuracy(&ours(burn, |kept| kept == channel), &scaled(&burn.truth))
    }

    /// The method's signal, as it can be known at each sample.
    #[must_use]
    pub fn signal(self, burn: &Burn) -> Vec<f64> {
        let (spectral, visible) = (prepared(&burn.spectral), prepared(&burn.visible));
        match self {
            Self::Spectral => spectral,
            Self::Visible => visible,
            Self::Printed => late(&fuse(&spectral, &visible, RADIUS, Weight::Printed)),
            Self::Turned => late(&fuse(&spectral, &visible, RADIUS, Weight::Turned)),
            Self::Ours => ours(burn, |_| true),
        }
    }

    /// Share of the scored samples whose trend is the truth's.
    #[must_use]
    pub fn accuracy(self, burn: &Burn) -> f64 {
        accuracy(&self.signal(burn), &scaled(&burn.truth))
    }
}

/// Raw samples of the channels that are kept into the filter that flies, scaled as the others are.
fn ours(burn: &Burn, keeps: impl Fn(usize) -> bool) -> Vec<f64> {
    let mut fusion = Fusion::default();
    let mut level = 1.0;
    let told = burn.spectral.iter().zip(&burn.visible);
    let told = told.map(|(spectral, visible)| {
        level = fusion
            .step(
                STEP_S,
                [spectral.filter(|_| keeps(0)), visible.filter(|_| keeps(1))],
            )
            .map_or(level, |fused| fused.level);
        level
    });
    scaled(&told.collect::<Vec<f64>>())
}

/// Eq. 7 over the scored samples.
#[must_use]
pub fn accuracy(signal: &[f64], truth: &[f64]) -> f64 {
    let steps = signal.windows(2).zip(truth.windows(2)).skip(LEAD - 1);
    let (mut right, mut all) = (0_u32, 0_u32);
    for (signal, truth) in steps {
        all += 1;
        right += u32::from(sign(signal[1] - signal[0]) == sign(truth[1] - truth[0]));
    }
    f64::from(right) / f64::from(all.max(1))
}

fn sign(change: f64) -> i8 {
    i8::from(change > DEAD_BAND) - i8::from(change < -DEAD_BAND)
}

/// What is known at the end of a centred window: the value of its middle.
fn late(fused: &[f64]) -> Vec<f64> {
    let first = fused.first().copied().unwrap_or_default();
    let mut known = vec![first; 2 * RADIUS];
    known.extend(fused);
    known
}

/// Held over gaps, smoothed, scaled.
fn prepared(samples: &[Option<f64>]) -> Vec<f64> {
    scaled(&smoothed(&held(samples)))
}

/// A missing sample leaves the last one standing.
fn held(samples: &[Option<f64>]) -> Vec<f64> {
    let mut last = samples.iter().flatten().next().copied().unwrap_or_default();
    let mut hold = |sample: &Option<f64>| {
        last = sample.unwrap_or(last);
        last
    };
    samples.iter().map(&mut hold).collect()
}

fn smoothed(samples: &[f64]) -> Vec<f64> {
    let mean = |k: usize| {
        let window = &samples[(k + 1).saturating_sub(SMOOTHING)..=k];
        window.iter().sum::<f64>() / window.len() as f64
    };
    (0..samples.len()).map(mean).collect()
}

/// Of the level before the scored part.
#[must_use]
pub fn scaled(samples: &[f64]) -> Vec<f64> {
    let mut before = samples[..LEAD.min(samples.len())].to_vec();
    before.sort_by(f64::total_cmp);
    let level = before
        .get(before.len() / 2)
        .copied()
        .unwrap_or(1.0)
        .max(1e-9);
    samples.iter().map(|sample| sample / level).collect()
}

#[cfg(test)]
mod tests {
    use super::super::burns::{SCORED, first, second};
    use super::*;

    fn mean(model: &super::super::burns::Model, method: Method) -> f64 {
        let burns = (0..300).map(|k| model.burn(7, k % 10, k / 10));
        burns.map(|burn| method.accuracy(&burn)).sum::<f64>() / 300.0
    }

    #[test]
    fn the_single_channels_score_near_what_p1_printed() {
        let model = first();
        let (spectral, visible) = (
            mean(&model, Method::Spectral),
            mean(&model, Method::Visible),
        );
        println!("first: spectral {spectral:.4}, visible {visible:.4}");
        println!(
            "second: spectral {:.4}, visible {:.4}",
            mean(&second(), Method::Spectral),
            mean(&second(), Method::Visible)
        );
        // P1's standard deviation over its groups is 1.5 and 1.8 points.
        assert!((spectral - 0.8808).abs() < 0.015, "{spectral}");
        assert!((visible - 0.8622).abs() < 0.018, "{visible}");
    }

    #[test]
    fn e15_the_printed_fusion_is_worse_than_the_better_channel_and_the_turned_one_better() {
        let model = first();
        let single = mean(&model, Method::Spectral).max(mean(&model, Method::Visible));
        let (printed, turned) = (mean(&model, Method::Printed), mean(&model, Method::Turned));
        let ours = mean(&model, Method::Ours);
        println!(
            "ours {ours:.4}; best single {single:.4}, printed {printed:.4}, turned {turned:.4}"
        );
        assert!(printed < single, "{printed} against {single}");
        assert!(turned > printed + 0.02, "{turned} against {printed}");
    }

    #[test]
    fn the_truth_agrees_with_itself_and_its_opposite_does_not() {
        let truth = scaled(&first().burn(1, 0, 0).truth);
        assert_eq!(truth.len(), LEAD + SCORED);
        assert_eq!(accuracy(&truth, &truth), 1.0);
        let opposite: Vec<f64> = truth.iter().map(|level| -level).collect();
        assert!(accuracy(&opposite, &truth) < 0.2);
    }
}
