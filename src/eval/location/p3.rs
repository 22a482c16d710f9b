//! P3's own flight: low, fast, 30 degrees down, a consumer receiver and a poor compass.

use super::bound::bound;
use super::estimator::{Pilot, SetupError};
use super::flight::{Course, Gusts, Kind};
use super::law::Law;
use super::monte_carlo::{Scene, stage};
use super::printed::{one_look, printed};
use super::score::mean;
use super::truth::{ErrorModel, Flame, Gnss, Lens};
use nalgebra::{Matrix2, Matrix3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::f64::consts::{FRAC_2_PI, FRAC_PI_2};

/// Sightings after which P3's flight is scored.
pub const SIGHTINGS: usize = 10;

const P3_REACH_M: f64 = 28.0;
/// The picture ends 22 degrees below the boresight, which is 30 degrees below the nose, which a
/// multirotor lowers by 3 degrees for 10 m/s; gusts take up to 6.
const LAST_DEPRESSION_DEG: f64 = 47.0;

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
    /// Direction of the flight, level.
    pub course: Vector3<f64>,
    /// GNSS offset, mean over the looks, metres.
    pub gnss: Vector3<f64>,
    /// Mean horizontal error that the Cramér-Rao bound allows, metres.
    pub bound_mean_m: Option<f64>,
    /// The same with the GNSS offset known.
    pub bound_bias_m: Option<f64>,
}

/// 8 to 15 m up, 10 m/s, towards the fire; ten looks, evenly from where P3's stereo begins to reach
/// (28 m, checklist item 40) to where the fire leaves the picture below.
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
    let far_m = (P3_REACH_M * P3_REACH_M - height_m * height_m).sqrt();
    let near_m = height_m / LAST_DEPRESSION_DEG.to_radians().tan();
    let duration_s = (far_m - near_m) / speed_m_s;
    let course = Course {
        kind: Kind::StraightIn,
        ground_range_m: far_m,
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
        above_m: 0.0,
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
    let seeing = staged.looks.iter().filter(|look| look.seen.is_some());
    let truths: Vec<_> = seeing.map(|look| look.truth.clone()).collect();
    let allowed = |errors: &ErrorModel| {
        let bound = bound(&lens, errors, &staged.flame, &truths, None)?;
        Some(mean_radius_m(&bound))
    };
    let without_gnss = ErrorModel {
        gnss_horizontal_m: 1e-6,
        gnss_vertical_m: 1e-6,
        ..errors
    };
    let gnss: Vector3<f64> = staged.looks.iter().map(|look| look.gnss_m).sum();
    Ok(P3Flown {
        ours: pilot.fires().first().map(|fire| fire.position_m),
        corrected: printed(&lens, &told, false),
        as_printed: printed(&lens, &told, true),
        single_m: (!singles.is_empty()).then(|| mean(singles)),
        course: -Vector3::new(course.azimuth_rad.sin(), course.azimuth_rad.cos(), 0.0),
        gnss: gnss / staged.looks.len() as f64,
        bound_mean_m: allowed(&errors),
        bound_bias_m: allowed(&without_gnss),
    })
}

/// Mean length of a horizontal error that is normal with this covariance: the complete elliptic
/// integral of the second kind, as a sum over a quarter turn.
fn mean_radius_m(covariance: &Matrix3<f64>) -> f64 {
    let flat: Matrix2<f64> = covariance.fixed_view::<2, 2>(0, 0).into_owned();
    let axes = flat.symmetric_eigenvalues();
    let (long, short) = (axes.max(), axes.min());
    let steps = 64;
    let angle = |i: i32| FRAC_PI_2 * (f64::from(i) + 0.5) / f64::from(steps);
    let part = |i: i32| (long * angle(i).cos().powi(2) + short * angle(i).sin().powi(2)).sqrt();
    let integral = (0..steps).map(part).sum::<f64>() * FRAC_PI_2 / f64::from(steps);
    FRAC_2_PI.sqrt() * integral
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
    /// Length of the mean error over all flights without GNSS, forward along each flight's course and
    /// to its right: what does not average out even over flights.
    pub common_bias_m: f64,
    /// What the bound allows for the first, and for the second.
    pub bound_m: (f64, f64),
    /// Mean horizontal error of P3's method, corrected.
    pub corrected_mean_m: f64,
    /// The same with E3.
    pub as_printed_mean_m: f64,
    /// Mean horizontal error of its single looks.
    pub single_mean_m: f64,
}

/// Sums up.
#[must_use]
pub fn summary(flown: &[P3Flown]) -> P3Summary {
    let horizontal = |error: fn(&P3Flown) -> Option<Vector3<f64>>| {
        mean(flown.iter().filter_map(error).map(|e| e.xy().norm()))
    };
    let placed = flown.iter().filter(|f| f.ours.is_some()).count();
    let common: Vector3<f64> = flown
        .iter()
        .filter_map(|f| {
            let left = f.ours? - f.gnss;
            let right = f.course.cross(&Vector3::z());
            Some(Vector3::new(f.course.dot(&left), right.dot(&left), 0.0))
        })
        .sum::<Vector3<f64>>()
        / placed.max(1) as f64;
    P3Summary {
        flights: flown.len(),
        placed_share: placed as f64 / flown.len().max(1) as f64,
        horizontal_mean_m: horizontal(|f| f.ours),
        bias_m: horizontal(|f| Some(f.ours? - f.gnss)),
        common_bias_m: common.xy().norm(),
        bound_m: (
            mean(flown.iter().filter_map(|f| f.bound_mean_m)),
            mean(flown.iter().filter_map(|f| f.bound_bias_m)),
        ),
        corrected_mean_m: horizontal(|f| f.corrected),
        as_printed_mean_m: horizontal(|f| f.as_printed),
        single_mean_m: mean(flown.iter().filter_map(|f| f.single_m)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_length_of_a_round_error_is_rayleighs_and_of_a_line_half_normals() {
        let round = mean_radius_m(&Matrix3::from_diagonal(&Vector3::new(4.0, 4.0, 1.0)));
        assert!((round - 2.0 * (std::f64::consts::PI / 2.0).sqrt()).abs() < 1e-9);
        let line = mean_radius_m(&Matrix3::from_diagonal(&Vector3::new(4.0, 0.0, 1.0)));
        assert!((line - 2.0 * FRAC_2_PI.sqrt()).abs() < 1e-3);
    }
}
