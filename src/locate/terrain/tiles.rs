//! Heights on a grid of latitude and longitude: SRTM, Copernicus, and what has their shape.
//!
//! Between posts the ground is bilinear. Heights stay in the datum of their data; an ellipsoid height
//! is height plus undulation (EGM96) at the place. EGM2008 heights are converted with EGM96 too, and
//! what the two models differ by enters the sigma.
//!
//! The sigma of a place is the root of the sum of squares of: the data's own vertical error, its
//! horizontal error times the slope there, what lies between posts (from how the ground bends
//! there), the mission's allowance for canopy, and the datum's.

use super::{Ground, Terrain};
use emberfix_frames::{EllipsoidHeight, Geoid, GeoidUndulation, MslAltitude, Wgs84, Wgs84Parts};

/// The surface from which a tile's heights count.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VerticalDatum {
    /// Mean sea level by EGM96: SRTM.
    Egm96,
    /// Mean sea level by EGM2008: Copernicus. Converted by EGM96, at the price of
    /// [`VerticalDatum::sigma_m`].
    Egm2008,
    /// The WGS84 ellipsoid.
    Ellipsoid,
}

impl VerticalDatum {
    /// One sigma of the conversion to ellipsoid heights, metres.
    #[must_use]
    pub fn sigma_m(self) -> f64 {
        match self {
            Self::Egm96 | Self::Ellipsoid => 0.0,
            Self::Egm2008 => EGM2008_SIGMA_M,
        }
    }

    /// The word for it in a mission.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Egm96 => "egm96",
            Self::Egm2008 => "egm2008",
            Self::Ellipsoid => "ellipsoid",
        }
    }
}

/// The two models differ by 0.5 m (rms over the Earth), by more under mountains.
const EGM2008_SIGMA_M: f64 = 1.0;

/// One-sigma errors of a tile's heights, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileSigmas {
    /// Vertical, on open level ground.
    pub vertical_m: f64,
    /// Horizontal: where a post really lies.
    pub horizontal_m: f64,
    /// How far trees and roofs lift the model off the ground.
    pub canopy_m: f64,
}

/// What a tile is made of.
#[derive(Debug, Clone, PartialEq)]
pub struct TileParts {
    /// Name, for messages.
    pub name: String,
    /// Geodetic latitude of the first (northern) row of posts, degrees.
    pub north_deg: f64,
    /// Longitude of the first (western) column of posts, degrees.
    pub west_deg: f64,
    /// From row to row southwards, degrees.
    pub row_pitch_deg: f64,
    /// From column to column eastwards, degrees.
    pub column_pitch_deg: f64,
    /// Posts from north to south.
    pub rows: usize,
    /// Posts from west to east.
    pub columns: usize,
    /// Row by row from the north-west; not-a-number is a void.
    pub heights_m: Vec<f32>,
    /// What the heights count from.
    pub datum: VerticalDatum,
    /// Their errors.
    pub sigmas: TileSigmas,
}

/// Why a tile was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TileError {
    /// Fewer than 2 x 2 posts, or not as many heights as posts.
    #[error("{rows} rows of {columns} posts with {heights} heights; at least 2 x 2, one each")]
    Size {
        /// Posts from north to south.
        rows: usize,
        /// Posts from west to east.
        columns: usize,
        /// Heights that came with them.
        heights: usize,
    },
    /// No spacing that a terrain tile has.
    #[error(
        "posts are {row_deg} degrees apart southwards and {column_deg} eastwards, allowed is {least} to {most}"
    )]
    Pitch {
        /// Southwards, degrees.
        row_deg: f64,
        /// Eastwards, degrees.
        column_deg: f64,
        /// Least allowed, degrees.
        least: f64,
        /// Most allowed, degrees.
        most: f64,
    },
    /// Reaches over a pole, or more than once around.
    #[error(
        "reaches from latitude {north_deg} to {south_deg} and {width_deg} degrees of longitude from {west_deg}, which is not on the Earth"
    )]
    Extent {
        /// First row, degrees.
        north_deg: f64,
        /// Last row, degrees.
        south_deg: f64,
        /// First column, degrees.
        west_deg: f64,
        /// Last column from there, degrees.
        width_deg: f64,
    },
    /// A height that no ground has: wrong unit, or a void that is not declared.
    #[error(
        "height {height_m} m in row {row}, column {column} is outside {least_m} to {most_m} m; an undeclared void, or another unit?"
    )]
    Height {
        /// What stands there, metres.
        height_m: f32,
        /// Row from the north.
        row: usize,
        /// Column from the west.
        column: usize,
        /// Least allowed, metres.
        least_m: f32,
        /// Most allowed, metres.
        most_m: f32,
    },
    /// Not one height.
    #[error("all {posts} posts are void")]
    AllVoid {
        /// How many.
        posts: usize,
    },
}

/// A centimetre to a degree.
const PITCHES_DEG: (f64, f64) = (1e-7, 1.0);
/// From the shore of the Dead Sea, dug, to above Everest.
const HEIGHTS_M: (f32, f32) = (-600.0, 9_100.0);
/// Share of a cell by which rounding may put a place outside its tile.
const EDGE: f64 = 1e-6;
/// Of the second difference of posts, what a place half-way between them strays from the straight
/// line (one sigma): for ground whose roughness scales like terrain's (Hurst exponent 0.7) it is
/// 0.31; of two real SRTM tiles it is 0.35.
const BETWEEN_POSTS: f64 = 0.35;
/// Metres in a degree of latitude, roughly: for slopes.
const METRES_PER_DEGREE: f64 = 111_320.0;
/// The geoid tilts by less than this against the ellipsoid.
const GEOID_SLOPE: f64 = 5e-4;

/// One checked tile.
#[derive(Debug, Clone)]
pub struct Tile {
    parts: TileParts,
    undulations: Option<Undulations>,
    steepest: f64,
}

impl Tile {
    /// Checks the parts, and takes the undulation over the tile from the geoid model.
    ///
    /// # Errors
    /// [`TileError`], the first that is found.
    pub fn new(parts: TileParts) -> Result<Self, TileError> {
        check_shape(&parts)?;
        check_heights(&parts)?;
        let undulations = match parts.datum {
            VerticalDatum::Ellipsoid => None,
            VerticalDatum::Egm96 | VerticalDatum::Egm2008 => Some(Undulations::over(&parts)),
        };
        let mut tile = Self {
            parts,
            undulations,
            steepest: 0.0,
        };
        tile.steepest = tile.steepest_cell() + GEOID_SLOPE;
        Ok(tile)
    }

    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.parts.name
    }

    /// Southern, western, northern, eastern posts, degrees; east is counted on from west.
    #[must_use]
    pub fn bounds_deg(&self) -> (f64, f64, f64, f64) {
        let p = &self.parts;
        let south = p.north_deg - (p.rows - 1) as f64 * p.row_pitch_deg;
        let east = p.west_deg + (p.columns - 1) as f64 * p.column_pitch_deg;
        (south, p.west_deg, p.north_deg, east)
    }

    /// Smallest spacing of its posts, metres.
    #[must_use]
    pub fn spacing_m(&self) -> f64 {
        let (along, across) = self.post_spacing_m(0);
        let (_, across_south) = self.post_spacing_m(self.parts.rows - 1);
        along.min(across.min(across_south))
    }

    /// Spacing southwards and eastwards at a row, metres.
    fn post_spacing_m(&self, row: usize) -> (f64, f64) {
        let p = &self.parts;
        let latitude = p.north_deg - row as f64 * p.row_pitch_deg;
        let across = latitude.to_radians().cos().max(1e-6);
        (
            p.row_pitch_deg * METRES_PER_DEGREE,
            p.column_pitch_deg * METRES_PER_DEGREE * across,
        )
    }

    /// Row and column of a place, in fractions; `None` more than `beyond` cells off the posts.
    fn grid(&self, latitude_deg: f64, longitude_deg: f64, beyond: f64) -> Option<(f64, f64)> {
        let p = &self.parts;
        let middle = 0.5 * (p.columns - 1) as f64;
        let middle_deg = p.west_deg + middle * p.column_pitch_deg;
        // Counted from the tile's middle, so that the antimeridian is never within it.
        let from_middle = (longitude_deg - middle_deg + 180.0).rem_euclid(360.0) - 180.0;
        let row = (p.north_deg - latitude_deg) / p.row_pitch_deg;
        let column = middle + from_middle / p.column_pitch_deg;
        let inside = |at: f64, count: usize| (-beyond..=(count - 1) as f64 + beyond).contains(&at);
        (inside(row, p.rows) && inside(column, p.columns)).then_some((row, column))
    }

    fn post(&self, row: usize, column: usize) -> f64 {
        f64::from(self.parts.heights_m[row * self.parts.columns + column])
    }

    /// Between the posts; [`Ground::OffTiles`] outside of them.
    fn ground(&self, latitude_deg: f64, longitude_deg: f64) -> Ground {
        let Some((row, column)) = self.grid(latitude_deg, longitude_deg, EDGE) else {
            return Ground::OffTiles;
        };
        let (row, down) = split(row, self.parts.rows);
        let (column, right) = split(column, self.parts.columns);
        let corners = [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(r, c)| self.post(row + r, column + c));
        let height = bilinear(corners, down, right);
        if height.is_nan() {
            return Ground::Void;
        }
        let undulation = self
            .undulations
            .as_ref()
            .map_or(0.0, |u| u.at(latitude_deg, self.eastwards(longitude_deg)));
        Ground::Known {
            height: MslAltitude::from_m(height) + GeoidUndulation::from_m(undulation),
            sigma_m: self.sigma_m(row, column, corners),
        }
    }

    /// A longitude counted on from the tile's western edge.
    fn eastwards(&self, longitude_deg: f64) -> f64 {
        let west = self.parts.west_deg;
        let from_west = longitude_deg - west;
        // A place on the edge may round to just west of it.
        west + if from_west < -1.0 {
            from_west + 360.0
        } else {
            from_west
        }
    }

    fn sigma_m(&self, row: usize, column: usize, corners: [f64; 4]) -> f64 {
        let sigmas = &self.parts.sigmas;
        [
            sigmas.vertical_m,
            sigmas.horizontal_m * self.slope(row, corners),
            BETWEEN_POSTS * self.bend_m(row, column),
            sigmas.canopy_m,
            self.parts.datum.sigma_m(),
        ]
        .iter()
        .map(|sigma| sigma * sigma)
        .sum::<f64>()
        .sqrt()
    }

    /// Steepest slope within a cell, metres per metre; voids count as level.
    fn slope(&self, row: usize, [nw, ne, sw, se]: [f64; 4]) -> f64 {
        let (_, across) = self.post_spacing_m(row);
        let (along, across_south) = self.post_spacing_m(row + 1);
        let eastwards = (ne - nw).abs().max((se - sw).abs()) / across.min(across_south);
        let southwards = (sw - nw).abs().max((se - ne).abs()) / along;
        eastwards.max(0.0).hypot(southwards.max(0.0))
    }

    /// Root mean square of the second differences of the posts about a cell, metres; 0 where there
    /// are none.
    fn bend_m(&self, row: usize, column: usize) -> f64 {
        let (mut sum, mut count) = (0.0, 0);
        for (r, c) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let (r, c) = (row + r, column + c);
            let southwards = (r > 0 && r + 1 < self.parts.rows)
                .then(|| self.post(r - 1, c) + self.post(r + 1, c) - 2.0 * self.post(r, c));
            let eastwards = (c > 0 && c + 1 < self.parts.columns)
                .then(|| self.post(r, c - 1) + self.post(r, c + 1) - 2.0 * self.post(r, c));
            for bend in [southwards, eastwards].into_iter().flatten() {
                if bend.is_finite() {
                    sum += bend * bend;
                    count += 1;
                }
            }
        }
        if count == 0 {
            0.0
        } else {
            (sum / f64::from(count)).sqrt()
        }
    }

    fn steepest_cell(&self) -> f64 {
        let (rows, columns) = (self.parts.rows, self.parts.columns);
        let mut steepest = 0.0_f64;
        for row in 0..rows - 1 {
            for column in 0..columns - 1 {
                let corners =
                    [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(r, c)| self.post(row + r, column + c));
                let slope = self.slope(row, corners);
                if slope > steepest {
                    steepest = slope;
                }
            }
        }
        steepest
    }
}

fn check_shape(parts: &TileParts) -> Result<(), TileError> {
    let (rows, columns) = (parts.rows, parts.columns);
    if rows < 2 || columns < 2 || rows.checked_mul(columns) != Some(parts.heights_m.len()) {
        return Err(TileError::Size {
            rows,
            columns,
            heights: parts.heights_m.len(),
        });
    }
    let (least, most) = PITCHES_DEG;
    let (row_deg, column_deg) = (parts.row_pitch_deg, parts.column_pitch_deg);
    if !(least..=most).contains(&row_deg) || !(least..=most).contains(&column_deg) {
        return Err(TileError::Pitch {
            row_deg,
            column_deg,
            least,
            most,
        });
    }
    let south_deg = parts.north_deg - (rows - 1) as f64 * row_deg;
    let width_deg = (columns - 1) as f64 * column_deg;
    let on_earth = parts.north_deg <= 90.0 + row_deg
        && south_deg >= -90.0 - row_deg
        && (-360.0..=360.0).contains(&parts.west_deg)
        && width_deg <= 360.0;
    if !on_earth {
        return Err(TileError::Extent {
            north_deg: parts.north_deg,
            south_deg,
            west_deg: parts.west_deg,
            width_deg,
        });
    }
    Ok(())
}

fn check_heights(parts: &TileParts) -> Result<(), TileError> {
    let (least_m, most_m) = HEIGHTS_M;
    let outside = |height: &f32| !height.is_nan() && !(least_m..=most_m).contains(height);
    if let Some(index) = parts.heights_m.iter().position(outside) {
        return Err(TileError::Height {
            height_m: parts.heights_m[index],
            row: index / parts.columns,
            column: index % parts.columns,
            least_m,
            most_m,
        });
    }
    if parts.heights_m.iter().all(|height| height.is_nan()) {
        let posts = parts.heights_m.len();
        return Err(TileError::AllVoid { posts });
    }
    Ok(())
}

/// Whole cell and the share of it, so that the last post belongs to the last cell.
fn split(at: f64, count: usize) -> (usize, f64) {
    let cell = (at.max(0.0).floor() as usize).min(count - 2);
    (cell, (at - cell as f64).clamp(0.0, 1.0))
}

/// Between north-west, north-east, south-west, south-east. A corner of no weight does not count,
/// even where it is a void.
fn bilinear([nw, ne, sw, se]: [f64; 4], down: f64, right: f64) -> f64 {
    let mix = |a: f64, b: f64, share: f64| {
        if share == 0.0 {
            a
        } else if share == 1.0 {
            b
        } else {
            a + share * (b - a)
        }
    };
    mix(mix(nw, ne, right), mix(sw, se, right), down)
}

/// Undulation on a lattice over one tile. EGM96's shortest wave is a degree long: on a lattice of a
/// tenth of that, straight lines stray by less than a centimetre.
#[derive(Debug, Clone)]
struct Undulations {
    south_deg: f64,
    west_deg: f64,
    row_pitch_deg: f64,
    column_pitch_deg: f64,
    rows: usize,
    columns: usize,
    values_m: Vec<f64>,
}

/// Coarsest lattice of undulations.
const LATTICE_DEG: f64 = 0.1;

impl Undulations {
    fn over(parts: &TileParts) -> Self {
        let height_deg = (parts.rows - 1) as f64 * parts.row_pitch_deg;
        let width_deg = (parts.columns - 1) as f64 * parts.column_pitch_deg;
        let cells = |side_deg: f64| (side_deg / LATTICE_DEG).ceil().max(1.0) as usize;
        let (rows, columns) = (cells(height_deg) + 1, cells(width_deg) + 1);
        let mut lattice = Self {
            south_deg: parts.north_deg - height_deg,
            west_deg: parts.west_deg,
            row_pitch_deg: height_deg / (rows - 1) as f64,
            column_pitch_deg: width_deg / (columns - 1) as f64,
            rows,
            columns,
            values_m: Vec::with_capacity(rows * columns),
        };
        for row in 0..rows {
            for column in 0..columns {
                let latitude = lattice.south_deg + row as f64 * lattice.row_pitch_deg;
                let longitude = lattice.west_deg + column as f64 * lattice.column_pitch_deg;
                lattice.values_m.push(Geoid::exact(latitude, longitude).m());
            }
        }
        lattice
    }

    fn at(&self, latitude_deg: f64, longitude_deg: f64) -> f64 {
        let (row, up) = split(
            (latitude_deg - self.south_deg) / self.row_pitch_deg,
            self.rows,
        );
        let (column, right) = split(
            (longitude_deg - self.west_deg) / self.column_pitch_deg,
            self.columns,
        );
        let at = |r: usize, c: usize| self.values_m[(row + r) * self.columns + column + c];
        bilinear([at(0, 0), at(0, 1), at(1, 0), at(1, 1)], up, right)
    }
}

/// Tiles beside each other, as one terrain. Where they overlap, the first that knows a height is
/// asked. Between tiles that do not share their border posts (Copernicus) the ground is bilinear
/// between the posts of both.
#[derive(Debug, Clone)]
pub struct Tiles {
    tiles: Vec<Tile>,
    spacing_m: f64,
    steepest: f64,
}

impl Tiles {
    /// Of checked tiles, the preferred first; `None` of none.
    #[must_use]
    pub fn new(tiles: Vec<Tile>) -> Option<Self> {
        let spacing_m = tiles.iter().map(Tile::spacing_m).reduce(f64::min)?;
        let steepest = tiles.iter().map(|tile| tile.steepest).fold(0.0, f64::max);
        Some(Self {
            tiles,
            spacing_m,
            steepest,
        })
    }

    /// The tiles.
    #[must_use]
    pub fn tiles(&self) -> &[Tile] {
        &self.tiles
    }

    fn within(&self, latitude_deg: f64, longitude_deg: f64) -> Ground {
        let mut best = Ground::OffTiles;
        for tile in &self.tiles {
            match tile.ground(latitude_deg, longitude_deg) {
                known @ Ground::Known { .. } => return known,
                Ground::Void => best = Ground::Void,
                Ground::OffTiles => {}
            }
        }
        best
    }

    /// In the one cell between a tile's last posts and the first of its neighbour.
    fn between(&self, latitude_deg: f64, longitude_deg: f64) -> Ground {
        self.tiles
            .iter()
            .filter_map(|tile| self.seam(tile, latitude_deg, longitude_deg))
            .next()
            .unwrap_or(Ground::OffTiles)
    }

    fn seam(&self, tile: &Tile, latitude_deg: f64, longitude_deg: f64) -> Option<Ground> {
        let (row, column) = tile.grid(latitude_deg, longitude_deg, 1.0)?;
        let (north, west) = (row.floor(), column.floor());
        let p = &tile.parts;
        let corner = |r: f64, c: f64| {
            self.within(
                p.north_deg - (north + r) * p.row_pitch_deg,
                p.west_deg + (west + c) * p.column_pitch_deg,
            )
        };
        let corners = [
            corner(0.0, 0.0),
            corner(0.0, 1.0),
            corner(1.0, 0.0),
            corner(1.0, 1.0),
        ];
        if corners.contains(&Ground::OffTiles) {
            return None;
        }
        let known = |ground: &Ground| match ground {
            Ground::Known { height, sigma_m } => (height.m(), *sigma_m),
            Ground::Void | Ground::OffTiles => (f64::NAN, 0.0),
        };
        let heights = corners.map(|ground| known(&ground).0);
        let sigma_m = corners.map(|ground| known(&ground).1);
        let height = bilinear(heights, row - north, column - west);
        Some(if height.is_nan() {
            Ground::Void
        } else {
            Ground::Known {
                height: EllipsoidHeight::from_m(height),
                sigma_m: sigma_m.into_iter().fold(0.0, f64::max),
            }
        })
    }
}

impl Terrain for Tiles {
    fn height_at(&self, place: &Wgs84) -> Option<EllipsoidHeight> {
        match self.ground_at(place) {
            Ground::Known { height, .. } => Some(height),
            Ground::Void | Ground::OffTiles => None,
        }
    }

    /// One sigma of the height; 0 where there is none.
    fn sigma_m(&self, place: &Wgs84) -> f64 {
        match self.ground_at(place) {
            Ground::Known { sigma_m, .. } => sigma_m,
            Ground::Void | Ground::OffTiles => 0.0,
        }
    }

    fn ground_at(&self, place: &Wgs84) -> Ground {
        let (latitude_deg, longitude_deg) = (place.latitude_deg(), place.longitude_deg());
        match self.within(latitude_deg, longitude_deg) {
            Ground::OffTiles => self.between(latitude_deg, longitude_deg),
            found => found,
        }
    }

    fn spacing_m(&self) -> Option<f64> {
        Some(self.spacing_m)
    }

    fn steepest(&self) -> f64 {
        self.steepest
    }
}
