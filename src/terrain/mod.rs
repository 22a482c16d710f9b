//! Terrain tiles from disk into the pure [`crate::locate::Tiles`].
//!
//! **In:** GeoTIFF files (SRTM, Copernicus, or the like: [`geotiff`]) and the area that matters.
//! **Out:** checked tiles that hold the posts of that area only, so that memory is bounded by the
//! area and not by the folder; or every problem, one line each.
//!
//! **Assumptions.** Latitude and longitude on WGS84. **Known limits.** No projected tiles, no
//! `.hgt`; tiles are read once, at the start.

pub mod geotiff;

pub use geotiff::GeoTiffError;

use crate::locate::{Area, Tile, TileError, TileParts, TileSigmas, Tiles, VerticalDatum};
use std::path::{Path, PathBuf};

/// Which tiles, and what is known of them.
#[derive(Debug, Clone, PartialEq)]
pub struct TileSource {
    /// Files, and folders whose `.tif` and `.tiff` files count; the preferred first.
    pub paths: Vec<PathBuf>,
    /// What heights count from; `None` believes what each tile says.
    pub datum: Option<VerticalDatum>,
    /// Errors of the heights.
    pub sigmas: TileSigmas,
    /// Posts outside are not kept.
    pub near: Area,
}

/// Why tiles were refused.
#[derive(Debug, thiserror::Error)]
pub enum TerrainError {
    /// A folder can't be listed.
    #[error("{path}: {source}", path = path.display())]
    List {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A folder without tiles.
    #[error("{path}: holds no .tif", path = path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// A file that is no tile that we read.
    #[error("{path}: {source}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        source: GeoTiffError,
    },
    /// A tile with contents that can't be.
    #[error("{path}: {source}", path = path.display())]
    Tile {
        /// The file.
        path: PathBuf,
        /// Why.
        source: TileError,
    },
    /// Neither the tile nor the mission says what its heights count from.
    #[error(
        "{path}: does not say what its heights count from; set vertical_datum (egm96 for SRTM, egm2008 for Copernicus)",
        path = path.display()
    )]
    NoDatum {
        /// The file.
        path: PathBuf,
    },
    /// The tile and the mission disagree.
    #[error("{path}: heights count from {tile}, vertical_datum says {mission}",
        path = path.display(), tile = tile.name(), mission = mission.name())]
    OtherDatum {
        /// The file.
        path: PathBuf,
        /// What the tile says.
        tile: VerticalDatum,
        /// What the mission says.
        mission: VerticalDatum,
    },
    /// Not one post in the area.
    #[error(
        "none of {files} tiles holds ground near latitude {latitude_deg:.4}, longitude {longitude_deg:.4}"
    )]
    Elsewhere {
        /// Files that were looked at.
        files: usize,
        /// Middle of the area, degrees.
        latitude_deg: f64,
        /// Middle of the area, degrees.
        longitude_deg: f64,
    },
    /// More than memory should hold.
    #[error("{posts} posts lie in the area, allowed are {most}; lower reach_m or name fewer tiles")]
    TooMany {
        /// Posts so far.
        posts: usize,
        /// Most allowed.
        most: usize,
    },
}

/// 256 MB of heights: 100 km around at 1 arc-second, twice over.
const MOST_POSTS: usize = 64 << 20;

/// Reads the tiles.
///
/// # Errors
/// Every [`TerrainError`] at once.
pub fn load(source: &TileSource) -> Result<Tiles, Vec<TerrainError>> {
    let files = files(&source.paths)?;
    let (mut tiles, mut problems, mut posts) = (Vec::new(), Vec::new(), 0);
    for path in &files {
        match tile(path, source) {
            Ok(None) => {}
            Ok(Some((tile, count))) => {
                tiles.push(tile);
                posts += count;
            }
            Err(problem) => problems.push(problem),
        }
        if posts > MOST_POSTS {
            problems.push(TerrainError::TooMany {
                posts,
                most: MOST_POSTS,
            });
            break;
        }
    }
    if !problems.is_empty() {
        return Err(problems);
    }
    Tiles::new(tiles).ok_or_else(|| vec![elsewhere(&source.near, files.len())])
}

fn elsewhere(near: &Area, files: usize) -> TerrainError {
    let longitude = near.west_deg + 0.5 * near.width_deg();
    TerrainError::Elsewhere {
        files,
        latitude_deg: 0.5 * (near.south_deg + near.north_deg),
        longitude_deg: if longitude > 180.0 {
            longitude - 360.0
        } else {
            longitude
        },
    }
}

/// The files themselves, and those in the folders by name.
fn files(paths: &[PathBuf]) -> Result<Vec<PathBuf>, Vec<TerrainError>> {
    let (mut files, mut problems) = (Vec::new(), Vec::new());
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        match in_folder(path) {
            Ok(found) => files.extend(found),
            Err(problem) => problems.push(problem),
        }
    }
    if problems.is_empty() {
        Ok(files)
    } else {
        Err(problems)
    }
}

fn in_folder(path: &Path) -> Result<Vec<PathBuf>, TerrainError> {
    let is_tile = |file: &PathBuf| {
        file.extension().is_some_and(|ending| {
            ending.eq_ignore_ascii_case("tif") || ending.eq_ignore_ascii_case("tiff")
        })
    };
    let listed: std::io::Result<Vec<PathBuf>> = std::fs::read_dir(path)
        .and_then(|entries| entries.map(|entry| entry.map(|e| e.path())).collect());
    let mut found: Vec<PathBuf> = listed
        .map_err(|source| TerrainError::List {
            path: path.to_owned(),
            source,
        })?
        .into_iter()
        .filter(is_tile)
        .collect();
    if found.is_empty() {
        return Err(TerrainError::Empty {
            path: path.to_owned(),
        });
    }
    found.sort();
    Ok(found)
}

fn tile(path: &Path, source: &TileSource) -> Result<Option<(Tile, usize)>, TerrainError> {
    let file = |error| TerrainError::File {
        path: path.to_owned(),
        source: error,
    };
    let Some(window) = geotiff::read(path, &source.near).map_err(file)? else {
        return Ok(None);
    };
    let datum = agreed(path, window.datum, source.datum)?;
    let posts = window.heights_m.len();
    let name = path
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    let parts = TileParts {
        name,
        north_deg: window.north_deg,
        west_deg: window.west_deg,
        row_pitch_deg: window.row_pitch_deg,
        column_pitch_deg: window.column_pitch_deg,
        rows: window.rows,
        columns: window.columns,
        heights_m: window.heights_m,
        datum,
        sigmas: source.sigmas,
    };
    match Tile::new(parts) {
        Ok(tile) => Ok(Some((tile, posts))),
        // The area's corner of a tile may well be sea.
        Err(TileError::AllVoid { .. }) => Ok(None),
        Err(source) => Err(TerrainError::Tile {
            path: path.to_owned(),
            source,
        }),
    }
}

fn agreed(
    path: &Path,
    tile: Option<VerticalDatum>,
    mission: Option<VerticalDatum>,
) -> Result<VerticalDatum, TerrainError> {
    match (tile, mission) {
        (Some(tile), Some(mission)) if tile != mission => Err(TerrainError::OtherDatum {
            path: path.to_owned(),
            tile,
            mission,
        }),
        (Some(said), _) | (None, Some(said)) => Ok(said),
        (None, None) => Err(TerrainError::NoDatum {
            path: path.to_owned(),
        }),
    }
}

#[cfg(test)]
mod tests;
