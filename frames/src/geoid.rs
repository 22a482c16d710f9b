//! Mean sea level above the ellipsoid (EGM96), for receivers that do not say it themselves.

use crate::GeoidUndulation;
use std::collections::HashMap;

/// EGM96, evaluated by its full harmonics and cached on a lattice.
///
/// One evaluation costs about a millisecond, so values are taken at the corners of 0.02 degree
/// cells (2.2 km) and interpolated between them; within a cell EGM96 (whose shortest wave is
/// 110 km) is linear to a few millimetres.
#[derive(Debug, Default)]
pub struct Geoid {
    corners: HashMap<(i32, i32), f64>,
}

/// Lattice pitch in degrees.
const CELL_DEG: f64 = 0.02;
/// Corners kept before the cache starts anew: bounds memory on a flight around the world.
const MAX_CORNERS: usize = 10_000;

impl Geoid {
    /// An empty cache.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Undulation at a place, in metres above the WGS84 ellipsoid.
    pub fn undulation(&mut self, latitude_deg: f64, longitude_deg: f64) -> GeoidUndulation {
        let (row, column) = (latitude_deg / CELL_DEG, longitude_deg / CELL_DEG);
        let (south, west) = (row.floor(), column.floor());
        let (up, right) = (row - south, column - west);
        let mut at = |row: f64, column: f64| self.corner(row as i32, column as i32);
        let lower = at(south, west) * (1.0 - right) + at(south, west + 1.0) * right;
        let upper = at(south + 1.0, west) * (1.0 - right) + at(south + 1.0, west + 1.0) * right;
        GeoidUndulation::from_m(lower * (1.0 - up) + upper * up)
    }

    fn corner(&mut self, row: i32, column: i32) -> f64 {
        if self.corners.len() >= MAX_CORNERS {
            self.corners.clear();
        }
        *self.corners.entry((row, column)).or_insert_with(|| {
            let latitude = (f64::from(row) * CELL_DEG).clamp(-90.0, 90.0);
            egm96::egm96_compute_altitude_offset(latitude, f64::from(column) * CELL_DEG)
        })
    }
}
