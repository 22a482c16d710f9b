//! How a fire changes: size in metres, intensity, trend. Pure: no I/O, no clock.
//!
//! **In:** sightings and the fire's position; the light of the flame and of its sodium and potassium
//! lines. **Out:** [`watch::Assessment`]: width, height, burning ground with their errors, intensity
//! and its trend, direction and speed of the front; whether a small light flickers.
//!
//! [`outline`] turns boxes into rays and planes, [`extent`] those into size and, with `front`, into an
//! oval and its motion, [`fusion`] two channels into one intensity, [`trend`] that into growing, steady or dying; [`watch`] keeps all
//! of it per fire. [`patch`] compares pictures. [`printed`] is P1's fusion, to measure against.
//!
//! **Known limits.** A spectrometer sees the whole scene: its light is used while one fire is seen. A near-infrared
//! eye shows each fire by itself.

pub mod extent;
mod front;
pub mod fusion;
pub mod height;
pub mod outline;
pub mod patch;
pub mod printed;
pub mod spectrum;
pub mod trend;
pub mod watch;

use crate::alarm::SizeM;
use crate::locate::{Sighting, View};
use emberfix_frames::{ServiceTime, Vector3};

/// Share of a new size that is taken over: flames flicker, boxes jitter.
const GAIN: f64 = 0.2;

/// Width across the line of sight and height upwards of what a box shows, at the fire's position.
///
/// The flame stands upright and is looked down upon: a box height of `h` pixels at slant range `r`
/// is `h r / f` across the sight, which upwards is longer by 1 / cos(depression).
#[must_use]
pub fn size(sighting: &Sighting, view: &View<'_>, position: &Vector3<f64>) -> Option<SizeM> {
    let predicted = view.predict(position)?;
    let sight = position - view.camera_enu;
    let depression_sin = -sight.dot(view.up()) / sight.norm();
    let cos = (1.0 - depression_sin * depression_sin).max(0.0).sqrt();
    let metres_per_px = predicted.depth_m / view.rig.rectification().focal_px();
    let (width_px, height_px) = sighting.size_px;
    Some(SizeM {
        width: width_px * metres_per_px,
        // Looking straight down shows the top only; the height is then not measurable.
        height: height_px * metres_per_px / cos.max(0.3),
    })
}

/// The old size moved towards the new one.
#[must_use]
pub fn smoothed_size(old: Option<SizeM>, new: SizeM) -> SizeM {
    match old {
        None => new,
        Some(old) => SizeM {
            width: old.width + GAIN * (new.width - old.width),
            height: old.height + GAIN * (new.height - old.height),
        },
    }
}

/// Grey level (mean of red and green) that a sunlit scene rarely exceeds and a flame does.
pub const PLAIN_LEVEL: f64 = 150.0;

/// How a light changes from look to look.
///
/// A flame flickers at 1 to 15 Hz, so two looks a fraction of a second apart see different light:
/// on flames of up to 2 m the relative change is 0.1 to 0.25, on lamps and glints that keep still
/// 0.02 to 0.05 (noise and the change of view). Larger fires flicker less as a whole, since their
/// tongues are independent; so this speaks of small lights only.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Flicker {
    last: Option<(ServiceTime, f64)>,
    changes: u32,
    small_changes: u32,
}

/// Looks further apart than this say nothing about flicker: the view has changed too, seconds.
const FLICKER_GAP_S: f64 = 1.5;
/// Changes before a light is judged.
const FLICKER_LOOKS: u32 = 6;
/// Relative change below which a look saw the same light: noise, and the change of view.
const SAME_LIGHT: f64 = 0.08;
/// Share of such looks from which a light is steady. A flame has one look in three of that kind at most, a lamp five in six.
const STEADY_SHARE: f64 = 0.6;
/// Sightings after which a light that could not be judged counts as a flame.
pub const ENOUGH_SIGHTINGS: u32 = 12;
/// A light larger than this is not judged, metres.
const SMALL_LIGHT_M: f64 = 2.0;

impl Flicker {
    /// Takes in the light of one look: `glow` as in [`Sighting::glow`], seen from `range_m`.
    pub fn add(&mut self, at: ServiceTime, glow: f64, range_m: f64) {
        let light = (glow * range_m * range_m).max(f64::MIN_POSITIVE).ln();
        if let Some((before, old)) = self.last
            && (at - before).as_secs_f64() < FLICKER_GAP_S
        {
            self.changes = self.changes.saturating_add(1);
            self.small_changes += u32::from((light - old).abs() < SAME_LIGHT);
        }
        self.last = Some((at, light));
    }

    /// A small light that has not been seen to flicker: it may be a lamp. One that was never seen
    /// often enough in a row to tell gets the benefit of the doubt after [`ENOUGH_SIGHTINGS`].
    #[must_use]
    pub fn may_be_lamp(&self, size: Option<SizeM>, sightings: u32) -> bool {
        let small = size.is_some_and(|size| size.width.max(size.height) < SMALL_LIGHT_M);
        let steady = f64::from(self.small_changes) >= STEADY_SHARE * f64::from(self.changes);
        let unjudged = self.changes < FLICKER_LOOKS;
        small
            && if unjudged {
                sightings < ENOUGH_SIGHTINGS
            } else {
                steady
            }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_frames::SignedDuration;

    fn watch(light: impl Fn(i64) -> f64) -> Flicker {
        let mut flicker = Flicker::default();
        for look in 0..8 {
            let at = ServiceTime::from_unix_ns(0) + SignedDuration::from_millis(400 * look);
            let range_m = 20.0 - look as f64;
            flicker.add(at, light(look) / (range_m * range_m), range_m);
        }
        flicker
    }

    #[test]
    fn a_lamp_is_steady_while_we_come_nearer_and_a_flame_is_not() {
        let small = Some(SizeM {
            width: 0.6,
            height: 0.8,
        });
        let large = Some(SizeM {
            width: 6.0,
            height: 4.0,
        });
        let lamp = watch(|look| 5000.0 * (1.0 + 0.01 * (look % 2) as f64));
        let flame = watch(|look| 5000.0 * (1.0 + 0.3 * (look % 3) as f64));
        assert!(lamp.may_be_lamp(small, 8) && !flame.may_be_lamp(small, 8));
        assert!(
            !lamp.may_be_lamp(large, 8),
            "large fires flicker little as a whole"
        );
        assert!(Flicker::default().may_be_lamp(small, 4), "not judged yet");
        assert!(
            !Flicker::default().may_be_lamp(small, 12),
            "never judged: a flame"
        );
    }
}
