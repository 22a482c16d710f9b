//! Where a ray meets the ground.
//!
//! The ray is followed by steps that can't pass through the ground: from a clearance `h`, on ground
//! that nowhere is steeper than `G`, a ray that goes `c` along and sinks `s` per metre needs at least
//! `h / (c G + s)` metres to come down. Then the last step is halved. A void far beneath a ray does
//! not stop it.

use super::{Ground, Terrain};
use crate::locate::View;
use emberfix_frames::{Coordinate, Metres, Vector3, Wgs84Parts};

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
    /// It comes down too flat to say where, or where ground that lay one sigma lower would let it
    /// pass.
    Grazing,
    /// Where it could come down next, the ground has no known height.
    Void {
        /// Slant range of that place, metres.
        range_m: f64,
    },
    /// It leaves the tiles before it comes down.
    OffTiles {
        /// Slant range of the first place that was looked for beyond them, metres.
        range_m: f64,
    },
    /// The camera itself is at or below the ground: one of the two heights is wrong.
    Below,
}

/// Furthest that a ray is followed, metres.
const REACH_M: f64 = 2_000.0;
/// Flatter than this (sine of the depression against the ground) is grazing.
const GRAZING: f64 = 0.03;
/// Shortest step, metres; on a grid at least this share of its spacing. What a ray may pass through
/// unseen is a sliver no longer than that.
const SHORTEST_M: f64 = 0.2;
const SHORTEST_SHARE: f64 = 0.005;
/// The vertical turns by 3e-4 over the reach, and rounding: added to each bound on a slope.
const MARGIN: f64 = 1e-3;
/// To this the meeting is found, metres.
const EXACT_M: f64 = 1e-3;

/// Follows a ray (unit vector, mission plane) from the camera to where it first meets the ground.
///
/// The range's sigma is how far it moves when all of the ground lies one sigma higher or lower:
/// behind a ridge that is much more than the slope at the meeting says.
#[must_use]
pub fn meet_terrain(
    camera: &Vector3<f64>,
    ray: &Vector3<f64>,
    terrain: &dyn Terrain,
    view: &View<'_>,
) -> TerrainHit {
    let march = March {
        camera,
        ray,
        terrain,
        view,
    };
    let (range_m, sigma_m) = match march.first(0.0) {
        Ok(found) => found,
        Err(missed) => return missed,
    };
    if march.sink(range_m).is_none_or(|sink| sink < GRAZING) {
        return TerrainHit::Grazing;
    }
    // Higher ground is met sooner; at the camera already, then the whole range is in doubt.
    let sooner = march.first(sigma_m).map_or(0.0, |(range, _)| range);
    let Ok((later, _)) = march.first(-sigma_m) else {
        return TerrainHit::Grazing;
    };
    TerrainHit::Met {
        range_m,
        sigma_m: (range_m - sooner).max(later - range_m),
    }
}

struct March<'a> {
    camera: &'a Vector3<f64>,
    ray: &'a Vector3<f64>,
    terrain: &'a dyn Terrain,
    view: &'a View<'a>,
}

impl March<'_> {
    /// Range and terrain sigma of the first meeting with ground that lies `raised_m` higher.
    fn first(&self, raised_m: f64) -> Result<(f64, f64), TerrainHit> {
        if self.clearance(0.0, raised_m)?.0 <= 0.0 {
            return Err(TerrainHit::Below);
        }
        let (steepest_fall, shortest) = (self.steepest_fall(), self.shortest_step());
        let (mut near, mut far) = (0.0, 0.0);
        loop {
            let (clearance, _) = self.clearance(far, raised_m)?;
            if clearance <= 0.0 {
                break;
            }
            if far >= REACH_M || steepest_fall <= 0.0 {
                return Err(TerrainHit::Above);
            }
            near = far;
            far = (far + (clearance / steepest_fall).max(shortest)).min(REACH_M);
        }
        while far - near > EXACT_M {
            let middle = 0.5 * (near + far);
            match self.clearance(middle, raised_m) {
                Ok((clearance, _)) if clearance > 0.0 => near = middle,
                _ => far = middle,
            }
        }
        let (_, sigma_m) = self.clearance(far, raised_m)?;
        Ok((far, sigma_m))
    }

    /// Height of the ray over the ground at a range, and the ground's sigma there.
    fn clearance(&self, range_m: f64, raised_m: f64) -> Result<(f64, f64), TerrainHit> {
        let point = Coordinate::from_metres(self.camera + self.ray * range_m);
        let place = self
            .view
            .place(&point)
            .ok_or(TerrainHit::OffTiles { range_m })?;
        match self.terrain.ground_at(&place) {
            Ground::Known { height, sigma_m } => {
                Ok((place.height().m() - height.m() - raised_m, sigma_m))
            }
            Ground::Void => Err(TerrainHit::Void { range_m }),
            Ground::OffTiles => Err(TerrainHit::OffTiles { range_m }),
        }
    }

    /// Metres of clearance that a metre of the ray can lose at most; not positive when it can't
    /// come down at all.
    fn steepest_fall(&self) -> f64 {
        let sink = -self.ray.dot(self.view.up());
        let along = (1.0 - sink * sink).max(0.0).sqrt();
        along * self.terrain.steepest() + sink + MARGIN
    }

    fn shortest_step(&self) -> f64 {
        let spacing = self.terrain.spacing_m().unwrap_or(0.0);
        SHORTEST_M.max(SHORTEST_SHARE * spacing)
    }

    /// Metres by which a metre of the ray comes nearer to the ground at its meeting.
    fn sink(&self, range_m: f64) -> Option<f64> {
        let (upper, _) = self.clearance(range_m - 0.5, 0.0).ok()?;
        let (lower, _) = self.clearance(range_m + 0.5, 0.0).ok()?;
        Some(upper - lower)
    }
}
