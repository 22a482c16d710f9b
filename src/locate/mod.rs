//! One sighting to one fix: camera to body to ENU to ECEF to latitude, longitude, height.
//!
//! **In:** a [`Sighting`] (pixels of the rectified left image, disparity if stereo gave one), the
//! [`Pose`](crate::pose::Pose) at its mid-exposure, the rig, the terrain. **Out:** a [`Fix`] with its covariance in
//! the tangent plane at the mission datum. Pure: no I/O, no clock.
//!
//! **Assumptions.** A flame stands upright above its base; the lower edge of the box is where it
//! stands. **Known limits.** A fix is one look: errors that stay the same from look to look are in
//! its covariance, but only [`crate::track`] knows that they do not average out.

mod geometry;
mod lens;
mod shared;
mod shot;
mod terrain;

pub use geometry::{Motion, Scrutiny, View, range_beneath};
pub use lens::{Distant, Lens, Linear, Predicted};
pub use shared::{CONSTANT, SHARED, Shared, SharedPriors, WANDERING};
pub use shot::{GNSS, Shot};
pub use terrain::{
    Area, ConstantPlane, Coverage, Ground, Terrain, TerrainHit, Tile, TileError, TileParts,
    TileSigmas, Tiles, VerticalDatum, meet_terrain,
};

use crate::alarm::Method;
use emberfix_calib::RectifiedPixel;
use emberfix_frames::{Coordinate, Covariance, Metres, MissionEnu, ServiceTime, Wgs84};

/// One detection, in the pixels of the rectified left image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// Mid-exposure.
    pub at: ServiceTime,
    /// Where the flame stands: middle of the box's lower edge.
    pub base: RectifiedPixel,
    /// One sigma of `base` along columns and rows, pixels.
    pub base_sigma_px: (f64, f64),
    /// Width and height of the box, pixels.
    pub size_px: (f64, f64),
    /// Disparity of the flame, if stereo gave one; with `at_least_m` beside it too weak to be a range.
    pub disparity: Option<DisparityOf>,
    /// Light of the box above a plain scene: sum over its pixels of what they exceed
    /// [`crate::assess::PLAIN_LEVEL`] by, grey levels times pixels.
    pub glow: Option<f64>,
    /// Depth that stereo excludes: nearer than this it would have been measured, metres.
    pub at_least_m: Option<f64>,
}

/// A measured disparity and what it was measured on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisparityOf {
    /// `u_left - u_right`, rectified pixels.
    pub px: f64,
    /// One sigma of matching, pixels.
    pub sigma_px: f64,
    /// Centroid of the matched pixels, rectified left.
    pub centroid: RectifiedPixel,
}

/// One position from one sighting.
#[derive(Debug, Clone, PartialEq)]
pub struct Fix {
    /// Base of the fire: latitude, longitude, ellipsoid height.
    pub place: Wgs84,
    /// The same in the plane at the mission datum.
    pub enu: Coordinate<MissionEnu>,
    /// All of its error: range, bearing, attitude, GNSS, calibration, time, terrain.
    pub covariance: Covariance<MissionEnu>,
    /// What it rests on.
    pub methods: Vec<Method>,
    /// Straight line from the left camera, metres.
    pub range_m: f64,
}

/// Furthest depth at which a fix is believed, metres: beyond it a pixel is metres wide.
const FURTHEST_M: f64 = 2_000.0;
/// Largest slant-range sigma over range that still makes a first position.
const MAX_RELATIVE_SIGMA: f64 = 0.5;

/// A first position from one sighting: stereo and terrain weighed by their errors along the ray.
///
/// `None` when neither says anything useful (a bearing alone): expected, not an error.
#[must_use]
pub fn fix(sighting: &Sighting, view: &View<'_>, terrain: Option<&dyn Terrain>) -> Option<Fix> {
    let ray = view.ray_enu(sighting.base);
    // A disparity too weak to be a range of its own counts in the estimator, where it stays linear.
    let stereo = sighting
        .disparity
        .filter(|_| sighting.at_least_m.is_none())
        .and_then(|d| stereo_range(sighting, &d, view));
    let on_ground = terrain.and_then(|t| match meet_terrain(&view.camera_enu, &ray, t, view) {
        TerrainHit::Met { range_m, sigma_m } => Some((range_m, sigma_m)),
        _ => None,
    });
    let on_ground = on_ground.filter(|(range, _)| {
        sighting
            .at_least_m
            .is_none_or(|least| *range >= 0.7 * least)
    });
    let (range_m, sigma_m, methods) = weigh(stereo, on_ground)?;
    if range_m > FURTHEST_M || sigma_m > MAX_RELATIVE_SIGMA * range_m {
        return None;
    }
    let point = view.camera_enu + ray * range_m;
    let along = Covariance::from_sources(&ray, &nalgebra::vector![sigma_m]);
    let covariance = along
        + view.across_covariance(&ray, range_m, sighting.base_sigma_px)
        + view.shared_covariance(&point);
    let enu = Coordinate::from_metres(point);
    let place = view.place(&enu)?;
    Some(Fix {
        place,
        enu,
        covariance,
        methods,
        range_m,
    })
}

/// Slant range along the base's ray and its sigma, from disparity: the flame's upright axis is
/// where the disparity was measured, the base is beneath it.
fn stereo_range(sighting: &Sighting, d: &DisparityOf, view: &View<'_>) -> Option<(f64, f64)> {
    let depth = view.rig.depth_m(d.px)?;
    let centroid = view.camera_enu + view.ray_enu(d.centroid) * view.slant(d.centroid, depth);
    let ray = view.ray_enu(sighting.base);
    let range = view.range_beneath(&centroid, &ray)?;
    // dZ/dd = -Z² / (f b)
    let metres_per_px =
        depth * depth / (view.rig.rectification().focal_px() * view.rig.baseline_m());
    Some((range, metres_per_px * d.sigma_px * range / depth))
}

/// Inverse-variance mean of what there is.
fn weigh(
    stereo: Option<(f64, f64)>,
    terrain: Option<(f64, f64)>,
) -> Option<(f64, f64, Vec<Method>)> {
    match (stereo, terrain) {
        (None, None) => None,
        (Some((range, sigma)), None) => Some((range, sigma, vec![Method::Stereo])),
        (None, Some((range, sigma))) => Some((range, sigma, vec![Method::Terrain])),
        (Some((a, sa)), Some((b, sb))) => {
            let (wa, wb) = (sa.powi(-2), sb.powi(-2));
            let range = (a * wa + b * wb) / (wa + wb);
            Some((
                range,
                (wa + wb).powf(-0.5),
                vec![Method::Stereo, Method::Terrain],
            ))
        }
    }
}

#[cfg(test)]
mod tests;
