//! Burns of 12.5 s whose infrared truth is known, and what two channels show of them.
//!
//! **In:** a [`Model`] (every constant of the noise, told with the results), a seed. **Out:**
//! [`Burn`]s at [`RATE_HZ`]. The models were fixed before any fusion was tuned: their strengths were
//! chosen so that the single channels, smoothed as in P1, come near to what P1 printed for them
//! (88 % spectral, 86 % visible).
//!
//! **The truth** is the burning's radiant intensity as an infrared camera sees it, 1 = the burn's full
//! scale: it rises and falls along half cosines. Flicker that the infrared camera sees as well is
//! part of neither; what is left of it in a channel is that channel's noise.

use emberfix_sim::noise::{normal, stream};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Samples a second; P1: five samples are about half a second.
pub const RATE_HZ: f64 = 10.0;
/// Samples that are scored: 12.5 s.
pub const SCORED: usize = 125;
/// Samples before those: filters and normalisation settle, the same for all methods.
pub const LEAD: usize = 25;
/// Seconds between samples.
pub const STEP_S: f64 = 1.0 / RATE_HZ;

/// A range from which a uniform value is drawn.
pub type Span = (f64, f64);

/// How a fuel burns.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Fuel {
    /// Its name.
    pub name: &'static str,
    /// Seconds from one turning point to the next.
    pub leg_s: Span,
    /// Change from one turning point to the next, of full scale.
    pub swing: Span,
    /// Light of the sodium and potassium lines against wood's.
    pub line_light: f64,
    /// Exponent of the visible signal over intensity: soot and saturation flatten it.
    pub visible_power: f64,
}

/// What spoils one channel. Rates are per second.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spoils {
    /// White noise, of full scale.
    pub white: f64,
    /// Flicker that infrared does not share: share of the signal, for each of [`Model::colours_s`].
    pub flicker: f64,
    /// Single samples that are wrong.
    pub spike_rate: f64,
    /// Half to one and a half times this, of full scale; two in three upwards.
    pub spike: f64,
    /// Share of the smoke's optical depth that this channel sees.
    pub smoke: f64,
    /// Sudden changes of gain: exposure that its statement lags behind, dirt on the lens.
    pub jump_rate: f64,
    /// One sigma of their logarithm.
    pub jump: f64,
    /// Seconds after which a third of one is left.
    pub jump_fades_s: f64,
    /// Spells without a sample: missed detections, a stalled instrument.
    pub gap_rate: f64,
    /// Their length, seconds.
    pub gap_s: Span,
    /// Level above which it saturates, of full scale.
    pub ceiling: f64,
    /// One sigma of a wandering offset, of full scale, over ten seconds.
    pub drift: f64,
}

/// Everything that a set of burns is drawn from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Model {
    /// Its name.
    pub name: &'static str,
    /// One fuel per group, in turn.
    pub fuels: Vec<Fuel>,
    /// Correlation times of the flicker, seconds: one is a plain first-order noise, several make it
    /// pink.
    pub colours_s: Vec<f64>,
    /// Flicker that both channels share and infrared does not: share of the signal.
    pub common_flicker: f64,
    /// Puffs of smoke per second.
    pub smoke_rate: f64,
    /// Their length, seconds.
    pub smoke_s: Span,
    /// Their optical depth.
    pub smoke_depth: Span,
    /// Seconds that smoke takes to come and to go.
    pub smoke_edge_s: f64,
    /// What spoils the spectral channel.
    pub spectral: Spoils,
    /// What spoils the visible channel.
    pub visible: Spoils,
}

/// One burn.
#[derive(Debug, Clone, PartialEq)]
pub struct Burn {
    /// Infrared truth, 1 = full scale.
    pub truth: Vec<f64>,
    /// Light of the lines, wood's full scale = 1; missing samples are missing.
    pub spectral: Vec<Option<f64>>,
    /// Visible signal, full scale = 1; missing samples are missing.
    pub visible: Vec<Option<f64>>,
}

/// P1's experiment: wood, near-white noise, spikes, smoke, flicker, exposure jumps.
#[must_use]
pub fn first() -> Model {
    let wood = Fuel {
        name: "wood",
        leg_s: (5.0, 9.0),
        swing: (0.35, 0.65),
        line_light: 1.0,
        visible_power: 1.0,
    };
    let quiet = Spoils {
        white: 0.0,
        flicker: 0.004,
        spike_rate: 0.0,
        spike: 0.0,
        smoke: 1.0,
        jump_rate: 0.0,
        jump: 0.2,
        jump_fades_s: 0.6,
        gap_rate: 0.0,
        gap_s: (0.3, 1.0),
        ceiling: f64::MAX,
        drift: 0.0,
    };
    Model {
        name: "first: wood, near-white noise, spikes, smoke, flicker, exposure jumps",
        fuels: vec![wood],
        colours_s: vec![0.12],
        common_flicker: 0.002,
        smoke_rate: 0.05,
        smoke_s: (0.6, 2.5),
        smoke_depth: (0.25, 0.7),
        smoke_edge_s: 0.4,
        spectral: Spoils {
            white: 0.004,
            spike_rate: 0.33,
            spike: 0.2,
            smoke: 0.15,
            ..quiet
        },
        visible: Spoils {
            white: 0.003,
            spike_rate: 0.15,
            spike: 0.15,
            jump_rate: 0.09,
            ..quiet
        },
    }
}

/// Kept aside: three other fuels, pink noise, gaps, a dirty lens, saturation, a drifting offset.
#[must_use]
pub fn second() -> Model {
    let fuel = |name, leg_s, swing, line_light, visible_power| Fuel {
        name,
        leg_s,
        swing,
        line_light,
        visible_power,
    };
    Model {
        name: "second: kerosene, straw and plastic, pink noise, gaps, dirt, saturation, drift",
        fuels: vec![
            fuel("kerosene", (6.0, 10.0), (0.35, 0.6), 0.5, 0.8),
            fuel("straw", (4.5, 7.5), (0.4, 0.7), 1.3, 1.0),
            fuel("plastic", (6.0, 11.0), (0.35, 0.65), 0.7, 0.65),
        ],
        colours_s: vec![0.1, 0.5, 2.5],
        common_flicker: 0.001,
        smoke_rate: 0.04,
        smoke_s: (0.8, 3.0),
        smoke_depth: (0.3, 1.0),
        smoke_edge_s: 0.6,
        spectral: Spoils {
            white: 0.0015,
            flicker: 0.002,
            spike_rate: 0.12,
            spike: 0.3,
            smoke: 0.2,
            jump_rate: 0.0,
            jump: 0.0,
            jump_fades_s: 0.6,
            gap_rate: 0.05,
            gap_s: (0.4, 1.5),
            ceiling: f64::MAX,
            drift: 0.003,
        },
        visible: Spoils {
            white: 0.002,
            flicker: 0.002,
            spike_rate: 0.07,
            spike: 0.2,
            smoke: 1.0,
            jump_rate: 0.03,
            jump: 0.35,
            // Dirt stays.
            jump_fades_s: 60.0,
            gap_rate: 0.05,
            gap_s: (0.2, 1.0),
            ceiling: 0.98,
            drift: 0.0,
        },
    }
}

impl Model {
    /// One burn of a group; the same numbers give the same burn.
    #[must_use]
    pub fn burn(&self, seed: u64, group: usize, burn: usize) -> Burn {
        let fuel = self.fuels[group % self.fuels.len()];
        let mut rng = stream(seed, &format!("{} {group} {burn}", self.name));
        let rng = &mut rng;
        let truth = truth(&fuel, rng);
        let common = self.flicker(self.common_flicker, rng);
        let smoke = self.smoke(rng);
        let spectral = |level: f64| fuel.line_light * level;
        let visible = |level: f64| level.powf(fuel.visible_power);
        let shown = |spoils: &Spoils, light: &dyn Fn(f64) -> f64, rng: &mut ChaCha8Rng| {
            let clean = truth.iter().zip(&common).zip(&smoke);
            let clean = clean.map(|((level, common), smoke)| {
                light(*level) * (1.0 + common) * (-spoils.smoke * smoke).exp()
            });
            self.spoil(spoils, clean.collect(), rng)
        };
        Burn {
            spectral: shown(&self.spectral, &spectral, rng),
            visible: shown(&self.visible, &visible, rng),
            truth,
        }
    }

    fn flicker(&self, sigma: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
        let each = sigma / (self.colours_s.len() as f64).sqrt();
        let mut sum = vec![0.0; SCORED + LEAD];
        for colour_s in &self.colours_s {
            for (sum, value) in sum.iter_mut().zip(wander(each, *colour_s, rng)) {
                *sum += value;
            }
        }
        sum
    }

    /// Optical depth of the smoke in front of the flame.
    fn smoke(&self, rng: &mut ChaCha8Rng) -> Vec<f64> {
        let mut depth = vec![0.0; SCORED + LEAD];
        for (start_s, length_s) in spells(self.smoke_rate, self.smoke_s, rng) {
            let full = draw(self.smoke_depth, rng);
            for (k, depth) in depth.iter_mut().enumerate() {
                let t_s = k as f64 * STEP_S;
                let edge = |since_s: f64| (since_s / self.smoke_edge_s).clamp(0.0, 1.0);
                *depth += full * edge(t_s - start_s) * edge(start_s + length_s - t_s);
            }
        }
        depth
    }

    fn spoil(&self, spoils: &Spoils, clean: Vec<f64>, rng: &mut ChaCha8Rng) -> Vec<Option<f64>> {
        let flicker = self.flicker(spoils.flicker, rng);
        let drift = wander(spoils.drift, 10.0, rng);
        let gaps = spells(spoils.gap_rate, spoils.gap_s, rng);
        let (mut log_gain, fade) = (0.0_f64, (-STEP_S / spoils.jump_fades_s).exp());
        let mut out = Vec::with_capacity(clean.len());
        for (k, clean) in clean.into_iter().enumerate() {
            log_gain *= fade;
            if rng.random_bool(spoils.jump_rate * STEP_S) {
                log_gain += spoils.jump * normal(rng);
            }
            let spike = spike(spoils, rng);
            let noise = spoils.white * normal(rng) + drift[k] + spike;
            let value =
                (clean * (1.0 + flicker[k]) * log_gain.exp() + noise).clamp(0.0, spoils.ceiling);
            let t_s = k as f64 * STEP_S;
            let missing = gaps
                .iter()
                .any(|(at, long)| (*at..at + long).contains(&t_s));
            out.push((!missing).then_some(value));
        }
        out
    }
}

fn spike(spoils: &Spoils, rng: &mut ChaCha8Rng) -> f64 {
    let (hit, size) = (
        rng.random_bool(spoils.spike_rate * STEP_S),
        draw((0.5, 1.5), rng),
    );
    let sign = if rng.random_bool(0.65) { 1.0 } else { -1.0 };
    f64::from(u8::from(hit)) * sign * size * spoils.spike
}

fn truth(fuel: &Fuel, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut start_s = -draw((0.0, fuel.leg_s.0), rng);
    let mut level = draw((0.25, 0.45), rng);
    let (mut rises, mut out) = (true, Vec::with_capacity(SCORED + LEAD));
    while out.len() < SCORED + LEAD {
        let long_s = draw(fuel.leg_s, rng);
        let swing = draw(fuel.swing, rng);
        let next = (level + if rises { swing } else { -swing }).clamp(0.15, 1.0);
        while out.len() < SCORED + LEAD && out.len() as f64 * STEP_S < start_s + long_s {
            let share = (out.len() as f64 * STEP_S - start_s) / long_s;
            let along = (1.0 - (std::f64::consts::PI * share).cos()) / 2.0;
            out.push(level + (next - level) * along);
        }
        (start_s, level, rises) = (start_s + long_s, next, !rises);
    }
    out
}

/// First-order noise, stationary from the start.
fn wander(sigma: f64, correlation_s: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let keep = (-STEP_S / correlation_s).exp();
    let mut value = normal(rng);
    let mut next = || {
        let now = value;
        value = keep * value + (1.0 - keep * keep).sqrt() * normal(rng);
        sigma * now
    };
    (0..SCORED + LEAD).map(|_| next()).collect()
}

/// Starts and lengths, seconds, of what comes at a rate.
fn spells(rate: f64, length_s: Span, rng: &mut ChaCha8Rng) -> Vec<(f64, f64)> {
    let mut spells = Vec::new();
    if rate <= 0.0 {
        return spells;
    }
    let mut at_s = 0.0;
    loop {
        at_s -= (1.0 - rng.random::<f64>()).ln() / rate;
        if at_s > (SCORED + LEAD) as f64 * STEP_S {
            return spells;
        }
        spells.push((at_s, draw(length_s, rng)));
    }
}

fn draw((low, high): Span, rng: &mut ChaCha8Rng) -> f64 {
    low + (high - low) * rng.random::<f64>()
}
