//! The ground, and where a ray meets it.
//!
//! **In:** places on the Earth; a ray in the plane at the mission datum. **Out:** ellipsoid height of
//! the ground with one sigma, or by name why there is none; slant range of the meeting with one
//! sigma. Pure: tiles are read elsewhere ([`crate::terrain`]) and only held here.
//!
//! **Assumptions.** The ground is one height over each place: no overhangs. **Known limits.** A
//! model of a surface has tree tops and roofs in it; how far, the mission's allowance for canopy
//! says, not the tile.

mod meet;
mod tiles;

pub use meet::{TerrainHit, meet_terrain};
pub use tiles::{Tile, TileError, TileParts, TileSigmas, Tiles, VerticalDatum};

use emberfix_frames::{EllipsoidHeight, Wgs84};

/// What is known of the ground at a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Ground {
    /// Its height.
    Known {
        /// Height of the ground.
        height: EllipsoidHeight,
        /// One sigma of it: data, slope, canopy, datum; metres.
        sigma_m: f64,
    },
    /// A tile covers the place, but holds no height there.
    Void,
    /// No tile covers the place.
    OffTiles,
}

/// A rectangle on the Earth, degrees; `west_deg` may be greater than `east_deg` where it crosses
/// the antimeridian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Area {
    /// Southern edge, geodetic latitude.
    pub south_deg: f64,
    /// Western edge, longitude.
    pub west_deg: f64,
    /// Northern edge, geodetic latitude.
    pub north_deg: f64,
    /// Eastern edge, longitude.
    pub east_deg: f64,
}

impl Area {
    /// The rectangle that holds everything within `radius_m` of a place; near a pole all longitudes.
    #[must_use]
    pub fn around(latitude_deg: f64, longitude_deg: f64, radius_m: f64) -> Self {
        let half = radius_m / METRES_PER_DEGREE;
        let (south_deg, north_deg) = (
            (latitude_deg - half).max(-90.0),
            (latitude_deg + half).min(90.0),
        );
        let narrowest = south_deg.abs().max(north_deg.abs()).to_radians().cos();
        let wide = half / narrowest.max(1e-6);
        if wide >= 180.0 {
            return Self {
                south_deg,
                west_deg: -180.0,
                north_deg,
                east_deg: 180.0,
            };
        }
        Self {
            south_deg,
            west_deg: wrapped(longitude_deg - wide),
            north_deg,
            east_deg: wrapped(longitude_deg + wide),
        }
    }

    /// How far it reaches to the east of its western edge, degrees.
    #[must_use]
    pub fn width_deg(&self) -> f64 {
        let width = self.east_deg - self.west_deg;
        if width < 0.0 { width + 360.0 } else { width }
    }
}

/// How much of an area the terrain knows, as shares of its surface (0 to 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coverage {
    /// Height known.
    pub known: f64,
    /// On a tile, but without a height.
    pub void: f64,
    /// On no tile.
    pub off_tiles: f64,
}

impl Coverage {
    /// True when the height is known everywhere.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        self.void == 0.0 && self.off_tiles == 0.0
    }
}

/// Height of the ground at a place.
pub trait Terrain: Send + Sync {
    /// Ellipsoid height of the ground; `None` where nothing is known.
    fn height_at(&self, place: &Wgs84) -> Option<EllipsoidHeight>;

    /// One sigma of that height, metres.
    fn sigma_m(&self, place: &Wgs84) -> f64;

    /// Height, sigma, or why there is none.
    fn ground_at(&self, place: &Wgs84) -> Ground {
        match self.height_at(place) {
            Some(height) => Ground::Known {
                height,
                sigma_m: self.sigma_m(place),
            },
            None => Ground::Void,
        }
    }

    /// Spacing of the finest heights that it rests on, metres; `None` for a surface without a grid.
    fn spacing_m(&self) -> Option<f64> {
        None
    }

    /// Greatest slope anywhere on it, metres per metre.
    fn steepest(&self) -> f64 {
        STEEPEST_UNSAID
    }

    /// How much of an area is known, from places no further apart than the spacing of its heights
    /// (at most 300 along each side).
    fn covers(&self, area: &Area) -> Coverage {
        let mut counts = [0_usize; 3];
        for place in sampled(area, self.spacing_m()) {
            counts[match self.ground_at(&place) {
                Ground::Known { .. } => 0,
                Ground::Void => 1,
                Ground::OffTiles => 2,
            }] += 1;
        }
        let all = counts.iter().sum::<usize>().max(1) as f64;
        let [known, void, off_tiles] = counts.map(|count| count as f64 / all);
        Coverage {
            known,
            void,
            off_tiles,
        }
    }
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
    fn steepest(&self) -> f64 {
        // Constant above the ellipsoid: level wherever it is.
        0.0
    }
}

/// A degree of latitude, at least; metres.
const METRES_PER_DEGREE: f64 = 110_574.0;
/// Slope of a surface that does not say its own: steeper than loose ground lies.
const STEEPEST_UNSAID: f64 = 2.0;
/// Most places along one side of an area that is looked at.
const MOST_SAMPLES: usize = 300;

/// A longitude in -180..=180.
fn wrapped(longitude_deg: f64) -> f64 {
    if (-180.0..=180.0).contains(&longitude_deg) {
        longitude_deg
    } else {
        (longitude_deg + 180.0).rem_euclid(360.0) - 180.0
    }
}

fn sampled(area: &Area, spacing_m: Option<f64>) -> Vec<Wgs84> {
    let step = spacing_m.unwrap_or(f64::MAX) / METRES_PER_DEGREE;
    let count = |side_deg: f64| ((side_deg / step).ceil() as usize).clamp(2, MOST_SAMPLES);
    let (height, width) = (area.north_deg - area.south_deg, area.width_deg());
    let (rows, columns) = (count(height), count(width));
    let share = |index: usize, of: usize| index as f64 / (of - 1) as f64;
    (0..rows * columns)
        .filter_map(|index| {
            let (row, column) = (index / columns, index % columns);
            emberfix_frames::place_from_degrees(
                area.south_deg + height * share(row, rows),
                wrapped(area.west_deg + width * share(column, columns)),
                EllipsoidHeight::from_m(0.0),
            )
            .ok()
        })
        .collect()
}

#[cfg(test)]
mod tests;
