//! Two signals of one fire to one: how brightly it burns, and how that changes now.
//!
//! **In:** samples of up to two [`Channel`]s, in time order, any rate, missing ones missing. **Out:**
//! [`Fused`]: intensity (1 = when the fire was first seen), its rate of change with its error, and
//! what is wrong with the channels. Causal: nothing ahead is looked at, and nothing is delayed.
//!
//! **How.** A Kalman filter over level, rate, acceleration and each channel's own offset. Each
//! channel's noise is estimated as it goes, from its clipped innovations, so that the quieter one
//! weighs more (inverse local noise variance). A sample further off than `OUTLIER` sigmas is not
//! used; when `LASTING` in a row are, the channel has jumped (exposure, smoke, dirt), not the fire:
//! its offset is set free, and its rate counts again from there. So a channel that goes missing,
//! black or frozen hands over to the other one without a step.
//!
//! **Known limits.** What both channels show alike is taken for the fire. With one channel left, its
//! slow fading can't be told from the fire's.

use nalgebra::{SMatrix, SVector};
use serde::Serialize;
use std::collections::VecDeque;

/// Where a sample comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// Sodium and potassium lines, or a near-infrared eye.
    Spectral,
    /// The flame in the left image.
    Visible,
}

impl Channel {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Spectral, Self::Visible];
}

/// Why a channel is not used at the moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ChannelFault {
    /// No sample for [`SILENCE_S`], though there were some.
    Silent,
    /// Far below what the fire was seen to be: covered, black.
    Blinded,
    /// The same value again and again: a stalled instrument, or saturation.
    Frozen,
}

impl ChannelFault {
    /// As it stands in an alarm's `degraded`.
    #[must_use]
    pub fn reason(self, channel: Channel) -> &'static str {
        match (channel, self) {
            (Channel::Spectral, Self::Silent) => "spectral_silent",
            (Channel::Spectral, Self::Blinded) => "spectral_blinded",
            (Channel::Spectral, Self::Frozen) => "spectral_frozen",
            (Channel::Visible, Self::Silent) => "visible_silent",
            (Channel::Visible, Self::Blinded) => "visible_blinded",
            (Channel::Visible, Self::Frozen) => "visible_frozen",
        }
    }

    /// For the operator.
    #[must_use]
    pub fn words(self, channel: Channel) -> &'static str {
        match (channel, self) {
            (Channel::Spectral, Self::Silent) => {
                "intensity without the spectral channel: it is silent"
            }
            (Channel::Spectral, Self::Blinded) => {
                "intensity without the spectral channel: it is blinded"
            }
            (Channel::Spectral, Self::Frozen) => {
                "intensity without the spectral channel: it is frozen"
            }
            (Channel::Visible, Self::Silent) => {
                "intensity without the camera: no flame in its picture"
            }
            (Channel::Visible, Self::Blinded) => "intensity without the camera: it is blinded",
            (Channel::Visible, Self::Frozen) => "intensity without the camera: its light is frozen",
        }
    }
}

/// The fire's intensity at one time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Fused {
    /// 1 when it was first seen.
    pub level: f64,
    /// One sigma of the level.
    pub level_sigma: f64,
    /// Change of the level, per second.
    pub rate: f64,
    /// One sigma of the rate, per second.
    pub rate_sigma: f64,
    /// What is wrong with the spectral and the visible channel.
    pub faults: [Option<ChannelFault>; 2],
}

/// Sigma of the acceleration, of the level first seen, per second squared.
const ACCELERATION: f64 = 0.12;
/// Seconds over which it stays alike: a burn swings over several seconds.
const ACCELERATION_S: f64 = 20.0;
/// Sigma of the rate when nothing is known, per second.
const FIRST_RATE: f64 = 0.3;
/// Sigma of a channel's offset against the other's at its beginning.
const FIRST_OFFSET: f64 = 0.05;
/// How far an offset wanders, per square root of a second.
const OFFSET_WALK: f64 = 0.003;
/// A jump that set an offset free may have been this large.
const JUMP: f64 = 0.5;
/// Noise of a channel: at the start, and its least and greatest.
const FIRST_NOISE: f64 = 0.1;
const NOISE: (f64, f64) = (0.008, 0.5);
/// Share of a new squared innovation in the noise's estimate.
const NOISE_GAIN: f64 = 0.03;
/// Sigmas from which a sample is an outlier.
const OUTLIER: f64 = 1.8;
/// Outliers in a row from which the channel has jumped.
const LASTING: u32 = 3;
/// Seconds without a sample from which a channel is silent.
pub const SILENCE_S: f64 = 0.5;
/// Share of the expected value below which a channel is blinded, if it got there by a jump.
const BLINDED: f64 = 0.15;
/// Equal samples in a row from which a channel is frozen.
const FROZEN: u32 = 4;
/// Samples that set a channel's scale.
const SCALE_SAMPLES: usize = 5;
/// Seconds in which the told level closes in on the filter's.
const CLOSING_S: f64 = 10.0;
/// Level beyond which, up or down, everything is scaled back.
const RESCALE: f64 = 4.0;

/// Level, rate, acceleration, offsets.
const STATES: usize = 5;
const OFFSET: usize = 3;

/// The filter of one fire.
#[derive(Debug, Clone)]
pub struct Fusion {
    mean: SVector<f64, STATES>,
    covariance: SMatrix<f64, STATES, STATES>,
    channels: [ChannelState; 2],
    /// What is told: follows the rate, and closes in on the level.
    told: f64,
    /// Level now over level first seen is this times the state's level.
    scale: f64,
    started: bool,
}

#[derive(Debug, Clone, Default)]
struct ChannelState {
    first: VecDeque<f64>,
    /// One unit of the state's level, in the channel's own unit.
    unit: Option<f64>,
    noise: f64,
    samples: u32,
    outliers: u32,
    last: Option<f64>,
    same: u32,
    silent_s: f64,
    blinded: bool,
}

impl Default for Fusion {
    fn default() -> Self {
        let sigmas = [0.1, FIRST_RATE, ACCELERATION, FIRST_OFFSET, FIRST_OFFSET];
        Self {
            mean: SVector::from([1.0, 0.0, 0.0, 0.0, 0.0]),
            covariance: SMatrix::from_diagonal(&SVector::from(sigmas.map(|s: f64| s * s))),
            channels: [ChannelState::new(), ChannelState::new()],
            told: 1.0,
            scale: 1.0,
            started: false,
        }
    }
}

impl ChannelState {
    fn new() -> Self {
        Self {
            noise: FIRST_NOISE,
            ..Self::default()
        }
    }

    /// The sample in units of the level, once the scale is known.
    fn scaled(&mut self, sample: Option<f64>, dt_s: f64, level: f64) -> Option<f64> {
        let Some(sample) = sample.filter(|sample| sample.is_finite() && *sample >= 0.0) else {
            self.silent_s += dt_s;
            return None;
        };
        self.silent_s = 0.0;
        let same = self.last == Some(sample);
        self.same = if same { self.same.saturating_add(1) } else { 0 };
        self.last = Some(sample);
        if self.unit.is_none() {
            self.first.push_back(sample);
            if self.first.len() < SCALE_SAMPLES {
                return None;
            }
            let mut first: Vec<f64> = self.first.drain(..).collect();
            first.sort_by(f64::total_cmp);
            let middle = first[SCALE_SAMPLES / 2];
            if middle > 0.0 {
                self.unit = Some(middle / level);
            }
        }
        self.unit.map(|unit| sample / unit)
    }

    fn fault(&self) -> Option<ChannelFault> {
        if self.unit.is_none() {
            None
        } else if self.silent_s >= SILENCE_S {
            Some(ChannelFault::Silent)
        } else if self.same + 1 >= FROZEN {
            Some(ChannelFault::Frozen)
        } else {
            self.blinded.then_some(ChannelFault::Blinded)
        }
    }
}

impl Fusion {
    /// Lets `dt_s` pass and takes what the channels show then: spectral, visible, each in its own
    /// unit, proportional to what burns. `None` until a channel's scale is known.
    pub fn step(&mut self, dt_s: f64, samples: [Option<f64>; 2]) -> Option<Fused> {
        if self.started {
            self.predict(dt_s);
        }
        for (channel, sample) in samples.into_iter().enumerate() {
            let level = self.mean[0].max(0.05);
            if let Some(value) = self.channels[channel].scaled(sample, dt_s, level) {
                self.started = true;
                self.update(channel, value);
            }
        }
        if !self.started {
            return None;
        }
        self.told += dt_s * (self.mean[1] + (self.mean[0] - self.told) / CLOSING_S);
        let fused = self.fused();
        self.rescale();
        Some(fused)
    }

    /// Nothing was seen for long: the level is doubtful, the rate unknown, and the channels may have
    /// jumped meanwhile.
    pub fn after_gap(&mut self) {
        let sigmas = [JUMP, FIRST_RATE, ACCELERATION, FIRST_OFFSET, FIRST_OFFSET];
        self.covariance = SMatrix::from_diagonal(&SVector::from(sigmas.map(|s: f64| s * s)));
        self.mean[1] = 0.0;
        self.mean[2] = 0.0;
    }

    fn predict(&mut self, dt_s: f64) {
        let keep = (-dt_s / ACCELERATION_S).exp();
        let mut step = SMatrix::<f64, STATES, STATES>::identity();
        step[(0, 1)] = dt_s;
        step[(0, 2)] = 0.5 * dt_s * dt_s;
        step[(1, 2)] = dt_s;
        step[(2, 2)] = keep;
        self.mean = step * self.mean;
        self.covariance = step * self.covariance * step.transpose();
        self.covariance[(2, 2)] += ACCELERATION.powi(2) * (1.0 - keep * keep);
        for channel in 0..2 {
            let at = (OFFSET + channel, OFFSET + channel);
            self.covariance[at] += OFFSET_WALK * OFFSET_WALK * dt_s;
        }
    }

    fn update(&mut self, channel: usize, value: f64) {
        let mut sees = SVector::<f64, STATES>::zeros();
        sees[0] = 1.0;
        sees[OFFSET + channel] = 1.0;
        let off = value - self.mean.dot(&sees);
        let expected = (self.covariance * sees).dot(&sees);
        let state = &mut self.channels[channel];
        let sigma = (expected + state.noise * state.noise).sqrt();
        let is_outlier = off.abs() > OUTLIER * sigma;
        state.learn_noise(off.abs().min(OUTLIER * sigma));
        state.outliers = if is_outlier { state.outliers + 1 } else { 0 };
        let has_jumped = state.outliers >= LASTING;
        if has_jumped {
            state.blinded = value < BLINDED * self.mean[0];
        } else if value > 2.0 * BLINDED * self.mean[0] {
            state.blinded = false;
        }
        if state.fault().is_some() {
            // When it comes back, its offset is another one.
            self.free_offset(channel);
        } else if has_jumped {
            self.free_offset(channel);
            self.correct(&sees, off, channel);
        } else if !is_outlier {
            self.correct(&sees, off, channel);
        }
    }

    fn free_offset(&mut self, channel: usize) {
        let at = (OFFSET + channel, OFFSET + channel);
        self.covariance[at] = (self.covariance[at] + JUMP * JUMP).min(4.0 * JUMP * JUMP);
    }

    fn correct(&mut self, sees: &SVector<f64, STATES>, off: f64, channel: usize) {
        let seen = self.covariance * sees;
        let noise = self.channels[channel].noise;
        let gain = seen / (seen.dot(sees) + noise * noise);
        self.mean += gain * off;
        self.covariance -= gain * seen.transpose();
        self.covariance = (self.covariance + self.covariance.transpose()) * 0.5;
    }

    fn fused(&self) -> Fused {
        let sigma = |k: usize| self.scale * self.covariance[(k, k)].max(0.0).sqrt();
        Fused {
            level: self.scale * self.told,
            level_sigma: sigma(0),
            rate: self.scale * self.mean[1],
            rate_sigma: sigma(1),
            faults: [0, 1].map(|channel: usize| self.channels[channel].fault()),
        }
    }

    /// Keeps the level near 1: a fire ten times as bright flickers ten times as much.
    fn rescale(&mut self) {
        let level = self.mean[0];
        if (1.0 / RESCALE..=RESCALE).contains(&level) || level <= 1e-3 {
            return;
        }
        self.scale *= level;
        self.told /= level;
        self.mean /= level;
        self.covariance /= level * level;
        for channel in &mut self.channels {
            channel.unit = channel.unit.map(|unit| unit * level);
            channel.noise = (channel.noise / level).clamp(NOISE.0, NOISE.1);
        }
    }
}

impl ChannelState {
    fn learn_noise(&mut self, clipped_off: f64) {
        self.samples = self.samples.saturating_add(1);
        // The first ones count more: nothing is known yet.
        let gain = NOISE_GAIN.max(1.0 / (f64::from(self.samples) + 1.0));
        let squared = (1.0 - gain) * self.noise * self.noise + gain * clipped_off * clipped_off;
        self.noise = squared.sqrt().clamp(NOISE.0, NOISE.1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.1;

    /// Runs both channels through; `None` in a channel is a missing sample.
    fn run(samples: impl Iterator<Item = [Option<f64>; 2]>) -> Vec<Fused> {
        let mut fusion = Fusion::default();
        samples
            .filter_map(|sample| fusion.step(DT, sample))
            .collect()
    }

    /// A little repeatable noise, one percent.
    fn noise(k: usize) -> f64 {
        0.01 * ((k as f64 * 12.9898).sin() * 43758.5453).fract()
    }

    fn steady(k: usize) -> [Option<f64>; 2] {
        [
            Some(7.0 * (1.0 + noise(k))),
            Some(300.0 * (1.0 + noise(k + 999))),
        ]
    }

    fn worst_rate(fused: &[Fused]) -> f64 {
        fused[40..].iter().map(|f| f.rate).fold(f64::MAX, f64::min)
    }

    #[test]
    fn a_channel_that_dies_black_frozen_faded_or_missing_makes_no_dying_fire() {
        type Channel = fn(usize, f64) -> Option<f64>;
        let dead: [(&str, Channel); 5] = [
            ("missing", |_, _| None),
            ("black", |_, _| Some(0.0)),
            ("nearly black", |k, value| {
                Some(0.02 * value * (1.0 + noise(k)))
            }),
            ("frozen", |_, _| Some(2.5)),
            ("fades within two seconds", |k, value| {
                Some(value * (1.0 - (k as f64 - 80.0) / 20.0).max(0.01))
            }),
        ];
        for (name, death) in dead {
            for channel in 0..2 {
                let fused = run((0..200).map(|k| {
                    let mut samples = steady(k);
                    if k >= 80 {
                        samples[channel] = samples[channel].and_then(|value| death(k, value));
                    }
                    samples
                }));
                let last = fused.last().unwrap();
                assert!(
                    last.faults[channel].is_some(),
                    "{name} {channel} is not told"
                );
                assert!(last.faults[1 - channel].is_none(), "{name} {channel}");
                assert!(
                    worst_rate(&fused) > -0.06,
                    "{name} {channel}: {}",
                    worst_rate(&fused)
                );
                assert!((last.level - 1.0).abs() < 0.1, "{name} {channel}: {last:?}");
            }
        }
    }

    #[test]
    fn both_channels_falling_are_a_dying_fire() {
        let fused = run((0..200).map(|k| {
            let left = (-0.02 * k as f64).exp();
            steady(k).map(|sample| sample.map(|value| value * left))
        }));
        let middle = &fused[100];
        assert!(middle.rate < -3.0 * middle.rate_sigma, "{middle:?}");
        assert!((fused[150].level / (-0.02_f64 * 150.0).exp() - 1.0).abs() < 0.5);
    }

    #[test]
    fn a_spike_that_the_printed_rule_follows_is_left_alone() {
        let spiked = |k: usize, by: f64| {
            let mut samples = steady(k);
            if k == 80 {
                samples[1] = samples[1].map(|value| (1.0 + by) * value);
            }
            samples
        };
        let level = |by: f64| run((0..90).map(|k| spiked(k, by)));
        // E15: the printed weight lets at least half of a spike through.
        for (with, without) in level(0.5).iter().zip(&level(0.0)) {
            assert!(
                (with.level - without.level).abs() < 0.03,
                "{with:?} {without:?}"
            );
        }
    }

    #[test]
    fn a_jump_of_exposure_is_no_growth() {
        let fused = run((0..200).map(|k| {
            let mut samples = steady(k);
            if k >= 80 {
                samples[1] = samples[1].map(|value| 1.8 * value);
            }
            samples
        }));
        let last = fused.last().unwrap();
        assert!((last.level - 1.0).abs() < 0.15, "{last:?}");
        let greatest = fused[40..].iter().map(|f| f.rate).fold(0.0, f64::max);
        assert!(greatest < 0.1, "{greatest}");
    }

    #[test]
    fn not_a_number_and_negative_light_are_missing_samples() {
        let bad = run((0..60).map(|_| [Some(f64::NAN), Some(-1.0)]));
        assert!(bad.is_empty());
    }
}
