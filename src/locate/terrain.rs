//! The ground, and where a ray meets it.

use super::View;
use emberfix_frames::{Coordinate, EllipsoidHeight, Metres, Vector3, Wgs84, Wgs84Parts};

/// Height of the ground at a place.
pub trait Terrain: Send + Sync {
    /// Ellipsoid height of the ground; `None` where nothing is known.
    fn height_at(&self, place: &Wgs84) -> Option<EllipsoidHeight>;
    /// One sigma of that height, metres.
    fn sigma_m(&self, place: &Wgs84) -> f64;
}

/// Flat ground at one ellipsoid height.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConstantPlane {
    /// Height of the ground.
    pub height: EllipsoidHeight,
    /// One sigma: how far the real ground strays from it, metres.
    pub sigma_m: f64,
}

impl Terrain for ConstantPlane {
    fn height_at(&self, _place: &Wgs84) -> Option<EllipsoidHeight> {
        Some(self.height)
    }
    fn sigma_m(&self, _place: &Wgs84) -> f64 {
        self.sigma_m
    }
}

/// Where a ray meets the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TerrainHit {
    /// It does.
    Met {
        /// Slant range from the camera, metres.
        range_m: f64,
        /// One sigma of it from the terrain's own error, metres.
        sigma_m: f64,
    },
    /// It points to the sky or never comes down within reach.
    Above,
    /// It comes down too flat to say where.
    Grazing,
    /// No terrain is known along it.
    Unknown,
}

/// Furthest that a ray is followed, metres.
const REACH_M: f64 = 2_000.0;
/// Flatter than this (sine of the depression against the ground) is grazing.
const GRAZING: f64 = 0.03;
/// First step along the ray, metres; steps grow with range.
const STEP_M: f64 = 5.0;

/// Follows a ray (unit vector, mission plane) from the camera until it is under the ground, then
/// halves the last step until it is known to a millimetre.
#[must_use]
pub fn meet_terrain(
    camera: &Vector3<f64>,
    ray: &Vector3<f64>,
    terrain: &dyn Terrain,
    view: &View<'_>,
) -> TerrainHit {
    let above = |range: f64| {
        let point = Coordinate::from_metres(camera + ray * range);
        let place = view.place(&point)?;
        let ground = terrain.height_at(&place)?;
        Some((place.height().m() - ground.m(), terrain.sigma_m(&place)))
    };
    let Some((start, _)) = above(0.0) else {
        return TerrainHit::Unknown;
    };
    if start <= 0.0 {
        return TerrainHit::Unknown;
    }
    let (mut near, mut far) = (0.0, STEP_M);
    loop {
        match above(far) {
            None => return TerrainHit::Unknown,
            Some((height, _)) if height <= 0.0 => break,
            Some(_) if far > REACH_M => return TerrainHit::Above,
            Some(_) => (near, far) = (far, far * 1.1 + STEP_M),
        }
    }
    while far - near > 1e-3 {
        let middle = 0.5 * (near + far);
        match above(middle) {
            Some((height, _)) if height > 0.0 => near = middle,
            _ => far = middle,
        }
    }
    slope_at(far, &above)
}

/// How fast the ray sinks into the ground decides what a metre of terrain error costs in range.
fn slope_at(range: f64, above: &dyn Fn(f64) -> Option<(f64, f64)>) -> TerrainHit {
    let (Some((lower, sigma)), Some((upper, _))) = (above(range + 0.5), above(range - 0.5)) else {
        return TerrainHit::Unknown;
    };
    let sink = upper - lower;
    if sink < GRAZING {
        return TerrainHit::Grazing;
    }
    TerrainHit::Met {
        range_m: range,
        sigma_m: sigma / sink,
    }
}
