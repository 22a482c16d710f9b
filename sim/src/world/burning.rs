//! Flames and smoke as clouds of soft splats that both eyes see.
//!
//! A cloud is a function of the fire and the time alone, so that two cameras at one moment see the
//! same flame from two places, and the next moment shows another one.

use super::texture::hash;
use nalgebra::{Vector2, Vector3};
use std::f64::consts::TAU;

/// What a cloud is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SplatKind {
    /// Shines, and hides some of what is behind it.
    Flame,
    /// Is lit, and hides what is behind it.
    Smoke,
    /// Shines and hides nothing: a lamp, a glint, a halo.
    Light,
}

/// A soft ellipsoid.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Splat {
    pub kind: SplatKind,
    /// East, north, up.
    pub centre_m: Vector3<f64>,
    /// Half the long axis; its length is where the splat ends.
    pub half_axis_m: Vector3<f64>,
    /// Half the width across the long axis.
    pub half_width_m: f64,
    /// Linear red, green, blue; 1 saturates a pixel.
    pub colour: [f32; 3],
    /// Share of the light from behind that the middle holds back.
    pub opacity: f32,
    /// Where in the billow texture this splat is cut out.
    pub billow: (f32, f32),
}

/// How one fire burns at one time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Flame {
    pub seed: u64,
    pub base_m: Vector3<f64>,
    pub width_m: f64,
    pub height_m: f64,
    pub wind_m_s: Vector2<f64>,
    pub t_s: f64,
}

/// Radius of the burning bed against the flame's width.
pub(crate) const BED: f64 = 0.3;

impl Flame {
    /// Brightness against its mean: puffs of a few hertz and flicker up to 15 Hz, less of it the
    /// faster it is.
    pub(crate) fn flicker(&self) -> f64 {
        let puffing = 1.5 / self.width_m.max(0.1).sqrt();
        let tones = [0.4, 1.0, 2.3, 3.9, 5.7, 8.1, 10.7, 13.9]
            .iter()
            .enumerate();
        let sum: f64 = tones
            .map(|(k, tone)| {
                let frequency = tone * puffing.clamp(0.8, 1.1);
                let phase = TAU * (frequency * self.t_s + unit(self.seed, k as u32, 900));
                phase.sin() / (1.0 + tone).sqrt()
            })
            .sum();
        (1.0 + 0.16 * sum).clamp(0.55, 1.5)
    }

    /// Brightness of this fire against a bright one: fuel and soot differ.
    pub(crate) fn temper(&self) -> f64 {
        0.42 + 0.58 * unit(self.seed, 0, 910)
    }

    /// Everything that shines and stands on the base.
    pub(crate) fn splats(&self) -> Vec<Splat> {
        let mut splats = self.bed();
        for tongue in 0..self.tongues() {
            splats.extend((0..STEPS).filter_map(|step| self.tongue_splat(tongue, step)));
        }
        splats
    }

    fn tongues(&self) -> u32 {
        // A wide low fire is a row of tongues, a slim one a few.
        (5.0 + 4.0 * self.width_m / self.height_m.max(0.1)).clamp(5.0, 16.0) as u32
    }

    /// A glowing bed: low splats that never leave the ground.
    fn bed(&self) -> Vec<Splat> {
        let glow = self.flicker() * self.temper();
        (0..12)
            .map(|k| {
                let (x, y) = self.bed_place(k, 500);
                let half = 0.13 * self.width_m;
                Splat {
                    kind: SplatKind::Flame,
                    centre_m: self.base_m + Vector3::new(x, y, 0.8 * half),
                    half_axis_m: Vector3::new(0.0, 0.0, 0.8 * half),
                    half_width_m: half,
                    colour: scaled(HOT, glow * (0.6 + 0.6 * unit(self.seed, k, 501))),
                    opacity: 0.35,
                    billow: self.billow(k, 0.3),
                }
            })
            .collect()
    }

    /// A place on the bed, evenly strewn.
    fn bed_place(&self, k: u32, salt: u32) -> (f64, f64) {
        let radius = BED * self.width_m * unit(self.seed, k, salt).sqrt() * 0.75;
        let (sin, cos) = (TAU * unit(self.seed, k, salt + 7)).sin_cos();
        (radius * cos, radius * sin)
    }

    fn tongue_splat(&self, tongue: u32, step: u32) -> Option<Splat> {
        let s = (f64::from(step) + 0.5) / f64::from(STEPS);
        let reach = self.reach(tongue);
        // Gaps travel upwards: the tip tears off.
        let torn = wander(
            self.seed,
            40 + tongue,
            2.2 * s - self.rise_rate() * self.t_s,
        );
        if s > 0.45 && torn < 1.6 * (s - 0.45) - 0.55 {
            return None;
        }
        let (x, y) = self.bed_place(tongue, 100);
        let sway = self.sway(tongue, s);
        let lean = self.wind_m_s * (0.10 * self.height_m * s);
        let height = s * reach;
        let half_height = (0.11 + 0.06 * (1.0 - s)) * reach;
        let half_width = self.girth(tongue, s);
        let spread = 1.0 + 0.7 * (1.0 - (2.0 * s - 0.7).abs()).max(0.0) - 0.9 * s * s;
        let centre = Vector3::new(
            spread * x + sway.x + lean.x,
            spread * y + sway.y + lean.y,
            height.max(0.85 * half_height),
        );
        let heat = self.flicker() * self.temper() * (1.15 - 0.75 * s) * (0.75 + 0.35 * torn);
        Some(Splat {
            kind: SplatKind::Flame,
            centre_m: self.base_m + centre,
            half_axis_m: Vector3::new(
                0.12 * sway.x + lean.x / 6.0,
                0.12 * sway.y + lean.y / 6.0,
                half_height,
            ),
            half_width_m: half_width,
            colour: scaled(blend(HOT, COOL, (1.25 * s).min(1.0)), heat),
            opacity: (0.62 - 0.25 * s) as f32,
            billow: self.billow(20 + tongue * STEPS + step, 1.0 - s),
        })
    }

    /// Height of a tongue now; the middle ones are the tallest.
    fn reach(&self, tongue: u32) -> f64 {
        let own = 0.55 + 0.45 * unit(self.seed, tongue, 300);
        let breath = wander(self.seed, 300 + tongue, 1.3 * self.rise_rate() * self.t_s);
        let puff = wander(self.seed, 399, 0.8 * self.rise_rate() * self.t_s);
        self.height_m * own * (1.0 + 0.28 * breath + 0.15 * puff)
    }

    fn girth(&self, tongue: u32, s: f64) -> f64 {
        let own = 0.10 + 0.09 * unit(self.seed, tongue, 310);
        let taper = (1.0 - s).powf(0.6) * (0.75 + 0.9 * s * (1.0 - s));
        (own * taper * self.width_m).max(0.02 * self.width_m)
    }

    fn sway(&self, tongue: u32, s: f64) -> Vector2<f64> {
        let upward = 1.4 * s - self.rise_rate() * self.t_s;
        let reach = 0.16 * self.width_m * s.sqrt();
        Vector2::new(
            reach * wander(self.seed, 200 + tongue, upward),
            reach * wander(self.seed, 250 + tongue, upward + 5.3),
        )
    }

    /// Flame heights that the hot gas climbs in a second.
    fn rise_rate(&self) -> f64 {
        let speed = 0.8 * (9.81 * self.height_m.max(0.05)).sqrt();
        (speed / self.height_m.max(0.05)).min(9.0)
    }

    fn billow(&self, k: u32, s: f64) -> (f32, f32) {
        let climb = 0.9 * self.rise_rate() * self.t_s;
        let shift = unit(self.seed, k, 600) + climb * (0.4 + 0.6 * s);
        (unit(self.seed, k, 601) as f32, shift.rem_euclid(1.0) as f32)
    }
}

/// Splats along a tongue.
const STEPS: u32 = 11;
/// The camera sees these through a red filter that saturates first: overlapping splats go from red
/// over orange and yellow to white, as flames do.
const HOT: [f32; 3] = [2.3, 0.92, 0.20];
const COOL: [f32; 3] = [1.25, 0.27, 0.03];

fn scaled(colour: [f32; 3], factor: f64) -> [f32; 3] {
    colour.map(|c| c * factor as f32)
}

fn blend(a: [f32; 3], b: [f32; 3], weight: f64) -> [f32; 3] {
    std::array::from_fn(|c| a[c] + (b[c] - a[c]) * weight as f32)
}

/// A plume over one foot at one time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plume {
    pub seed: u64,
    pub foot_m: Vector3<f64>,
    pub width_m: f64,
    /// Where it has thinned out.
    pub height_m: f64,
    pub wind_m_s: Vector2<f64>,
    /// Age of the fire: a young plume has not yet risen far.
    pub age_s: f64,
    pub t_s: f64,
    /// Linear red, green, blue in the light of the day.
    pub colour: [f32; 3],
}

/// Puffs in a plume.
const PUFFS: u32 = 56;

impl Plume {
    pub(crate) fn splats(&self) -> Vec<Splat> {
        (0..PUFFS).filter_map(|k| self.puff(k)).collect()
    }

    /// Each puff is born at the foot, rises, drifts, grows and thins; then it begins again.
    fn puff(&self, k: u32) -> Option<Splat> {
        let rise = 0.5 + 0.35 * self.height_m.max(0.1).sqrt();
        let life_s = self.height_m / rise;
        let cycle = self.t_s / life_s + unit(self.seed, k, 1);
        let s = cycle.rem_euclid(1.0);
        if s * life_s > self.age_s {
            return None;
        }
        let birth = cycle.floor().rem_euclid(1e6) as u32;
        let own = self.seed ^ hash(u64::from(birth), k, 77);
        let radius = self.width_m * (0.28 + 0.2 * unit(own, k, 2)) + 0.17 * s * self.height_m;
        let swirl = 0.35 * self.width_m + 0.16 * s * self.height_m;
        let drift = self.wind_m_s * (s * life_s);
        let around = Vector3::new(
            swirl * (2.0 * unit(own, k, 3) - 1.0),
            swirl * (2.0 * unit(own, k, 4) - 1.0),
            0.06 * self.height_m * (unit(own, k, 5) - 0.5),
        );
        let centre = Vector3::new(drift.x, drift.y, (s * self.height_m).max(0.5 * radius)) + around;
        // Dense above the foot, gone at the top.
        let opacity = 0.42 * (1.0 - s).powf(1.1) * (s / 0.06).min(1.0);
        let shade = 0.8 + 0.35 * unit(own, k, 6);
        Some(Splat {
            kind: SplatKind::Smoke,
            centre_m: self.foot_m + centre,
            half_axis_m: Vector3::new(0.0, 0.0, radius),
            half_width_m: radius,
            colour: scaled(self.colour, shade),
            opacity: opacity as f32,
            billow: (
                unit(own, k, 8) as f32,
                (unit(own, k, 9) - 0.05 * self.t_s).rem_euclid(1.0) as f32,
            ),
        })
    }
}

/// Uniform in 0 to 1.
pub(crate) fn unit(seed: u64, a: u32, b: u32) -> f64 {
    (hash(seed, a, b) >> 11) as f64 / (1u64 << 53) as f64
}

/// Smooth noise along one line, -1 to 1, about one turn per unit.
fn wander(seed: u64, line: u32, x: f64) -> f64 {
    let cell = x.floor();
    let at = |k: f64| 2.0 * unit(seed, line, (cell + k).rem_euclid(65536.0) as u32) - 1.0;
    let f = x - cell;
    let smooth = f * f * (3.0 - 2.0 * f);
    let slow = at(0.0) + (at(1.0) - at(0.0)) * smooth;
    let ripple = (TAU * (2.7 * x + unit(seed, line, 70_000))).sin();
    0.8 * slow + 0.2 * ripple
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flame(t_s: f64) -> Flame {
        Flame {
            seed: 5,
            base_m: Vector3::new(3.0, 4.0, 5.0),
            width_m: 1.0,
            height_m: 1.5,
            wind_m_s: Vector2::zeros(),
            t_s,
        }
    }

    #[test]
    fn a_flame_stands_on_its_base_and_reaches_its_height() {
        let mut tallest: f64 = 0.0;
        for k in 0..60 {
            for splat in flame(f64::from(k) * 0.1).splats() {
                let lowest = splat.centre_m.z - splat.half_axis_m.z;
                assert!(
                    lowest > 5.0 - 0.12,
                    "a splat hangs {lowest} m under the base"
                );
                tallest = tallest.max(splat.centre_m.z - 5.0);
            }
        }
        assert!((1.2..2.4).contains(&tallest), "{tallest}");
    }

    #[test]
    fn a_flame_changes_from_frame_to_frame_and_repeats_for_one_time() {
        let places = |t| {
            flame(t)
                .splats()
                .iter()
                .map(|s| s.centre_m)
                .collect::<Vec<_>>()
        };
        assert_eq!(places(1.0), places(1.0));
        assert_ne!(places(1.0), places(1.1));
        let brightness: Vec<f64> = (0..300)
            .map(|k| flame(f64::from(k) / 30.0).flicker())
            .collect();
        let mean = brightness.iter().sum::<f64>() / 300.0;
        let sigma = (brightness.iter().map(|b| (b - mean).powi(2)).sum::<f64>() / 300.0).sqrt();
        assert!(
            (0.9..1.1).contains(&mean) && (0.08..0.3).contains(&sigma),
            "{mean} {sigma}"
        );
    }
}
