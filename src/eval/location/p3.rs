//! P3's own flight: low, fast, 30 degrees down, a consumer receiver and a poor compass.

use super::estimator::{Pilot, SetupError};
use super::flight::{Course, Gusts, Kind};
use super::law::Law;
use super::monte_carlo::{Scene, stage};
use super::printed::{one_look, printed};
use super::score::mean;
use super::truth::{ErrorModel, Flame, Gnss, Lens};
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Sightings after which P3's flight is scored.
pub const SIGHTINGS: usize = 10;
/// What P3 prints: mean horizontal error and its constant part, metres (checklist item 51).
pub const PRINTED_M: (f64, f64) = (8.28, 8.08);

/// One of P3's flights after ten sightings.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct P3Flown {
    /// Error of our position, metres; none when no fire was told.
    pub ours: Option<Vector3<f64>>,
    /// Error of P3's method, corrected: the looks' mean, metres.
    pub corrected: Option<Vector3<f64>>,
    /// The same with the zeros of the disparity map counted (E3).
    pub as_printed: Option<Vector3<f64>>,
    /// Mean horizontal error of its single looks, metres.
    pub single_m: Option<f64>,
    /// GNSS offset, mean over the looks, metres.
    pub gnss: Vector3<f64>,
}

/// 8 to 15 m up, 10 m/s, towards the fire; ten looks at three per second, the last one before the
/// fire leaves the picture below (54 degrees down).
///
/// # Errors
/// [`SetupError`] when the rig is refused.
pub fn fly(rng: &mut ChaCha8Rng) -> Result<P3Flown, SetupError> {
    let errors = ErrorModel {
        pixel_px: 2.0,
        disparity_px: 0.25,
        ..ErrorModel::of(Gnss::Consumer, 2.0)
    };
    let height_m = rng.random_range(8.0..15.0);
    let speed_m_s = 10.0;
    let duration_s = SIGHTINGS as f64 / 3.0;
    let course = Course {
        kind: Kind::StraightIn,
        // The last look has the fire about 40 degrees below the horizon.
        ground_range_m: speed_m_s * duration_s + 1.2 * height_m,
        height_m,
        speed_m_s,
        azimuth_rad: rng.random_range(0.0..std::f64::consts::TAU),
        duration_s,
        gusts: Gusts::new(rng, 1.5, 0.2),
    };
    let lens = Lens::short();
    let times_s = course.looks(SIGHTINGS, 0.1);
    let scene = Scene {
        course: &course,
        lens,
        flame: Flame {
            base_m: Vector3::zeros(),
            size_m: 1.0,
        },
        ground: None,
        errors: &errors,
        law: Law::Assumed,
        times_s: &times_s,
    };
    let staged = stage(&scene, rng);
    let mut pilot = Pilot::new(&lens, &errors, None)?;
    for look in &staged.looks {
        pilot.look(&look.autopilot, look.seen.as_slice());
    }
    let told: Vec<_> = staged
        .looks
        .iter()
        .filter_map(|look| Some((look.autopilot.report(0.0), look.seen?)))
        .collect();
    let singles: Vec<f64> = told
        .iter()
        .filter_map(|(reported, seen)| one_look(&lens, reported, seen, false))
        .map(|place| place.xy().norm())
        .collect();
    let gnss: Vector3<f64> = staged.looks.iter().map(|look| look.gnss_m).sum();
    Ok(P3Flown {
        ours: pilot.fires().first().map(|fire| fire.position_m),
        corrected: printed(&lens, &told, false),
        as_printed: printed(&lens, &told, true),
        single_m: (!singles.is_empty()).then(|| mean(singles)),
        gnss: gnss / staged.looks.len() as f64,
    })
}

/// Many of them together, metres.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct P3Summary {
    /// Flights.
    pub flights: usize,
    /// Share of them with a position after ten looks.
    pub placed_share: f64,
    /// Mean horizontal error.
    pub horizontal_mean_m: f64,
    /// Mean horizontal distance of what is left without the GNSS offset: a flight's own constant
    /// error other than GNSS, its noise included.
    pub bias_m: f64,
    /// Length of the mean error over all flights, along the line of sight and across, without GNSS:
    /// what does not average out even over flights.
    pub common_bias_m: f64,
    /// Mean horizontal error of P3's method, corrected.
    pub corrected_mean_m: f64,
    /// The same with E3.
    pub as_printed_mean_m: f64,
    /// Mean horizontal error of its single looks.
    pub single_mean_m: f64,
}

/// Sums up; errors without GNSS are turned into the flight's own axes by `azimuths`.
#[must_use]
pub fn summary(flown: &[P3Flown]) -> P3Summary {
    let horizontal = |error: fn(&P3Flown) -> Option<Vector3<f64>>| {
        mean(flown.iter().filter_map(error).map(|e| e.xy().norm()))
    };
    let placed = flown.iter().filter(|f| f.ours.is_some()).count();
    let common: Vector3<f64> = flown
        .iter()
        .filter_map(|f| Some(f.ours? - f.gnss))
        .sum::<Vector3<f64>>()
        / placed.max(1) as f64;
    P3Summary {
        flights: flown.len(),
        placed_share: placed as f64 / flown.len().max(1) as f64,
        horizontal_mean_m: horizontal(|f| f.ours),
        bias_m: horizontal(|f| Some(f.ours? - f.gnss)),
        common_bias_m: common.xy().norm(),
        corrected_mean_m: horizontal(|f| f.corrected),
        as_printed_mean_m: horizontal(|f| f.as_printed),
        single_mean_m: mean(flown.iter().filter_map(|f| f.single_m)),
    }
}
