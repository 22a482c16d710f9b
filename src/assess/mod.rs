//! How a fire changes: size in metres, intensity, trend. Pure: no I/O, no clock.
//!
//! **In:** a sighting and the fire's position. **Out:** [`SizeM`] in metres.
//! **Known limits.** Size only; intensity and trend are not assessed yet, and the alarm says so
//! with `null`.

use crate::alarm::SizeM;
use crate::locate::{Sighting, View};
use emberfix_frames::Vector3;

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
