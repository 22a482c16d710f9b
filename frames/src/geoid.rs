//! Mean sea level above the ellipsoid (EGM96), for receivers that do not say it themselves.

use crate::GeoidUndulation;
use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

/// EGM96, evaluated by its full harmonics and cached on a lattice.
///
/// One evaluation costs about a millisecond, so values are taken at the corners of 0.02 degree
/// cells (2.2 km) and interpolated between them; within a cell EGM96 (whose shortest wave is
/// 110 km) is linear to a few millimetres.
#[derive(Debug, Default)]
pub struct Geoid {
    corners: Mutex<HashMap<(i32, i32), f64>>,
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

    /// Undulation at a place, in metres above the WGS84 ellipsoid: by the full harmonics, without
    /// the cache. Latitudes beyond a pole count as the pole.
    #[must_use]
    pub fn exact(latitude_deg: f64, longitude_deg: f64) -> GeoidUndulation {
        let latitude = latitude_deg.clamp(-90.0, 90.0);
        GeoidUndulation::from_m(egm96::egm96_compute_altitude_offset(
            latitude,
            longitude_deg,
        ))
    }

    /// Undulation at a place, in metres above the WGS84 ellipsoid.
    #[must_use]
    pub fn undulation(&self, latitude_deg: f64, longitude_deg: f64) -> GeoidUndulation {
        let (row, column) = (latitude_deg / CELL_DEG, longitude_deg / CELL_DEG);
        let (south, west) = (row.floor(), column.floor());
        let (up, right) = (row - south, column - west);
        let at = |row: f64, column: f64| self.corner(row as i32, column as i32);
        let lower = at(south, west) * (1.0 - right) + at(south, west + 1.0) * right;
        let upper = at(south + 1.0, west) * (1.0 - right) + at(south + 1.0, west + 1.0) * right;
        GeoidUndulation::from_m(lower * (1.0 - up) + upper * up)
    }

    fn corner(&self, row: i32, column: i32) -> f64 {
        // A thread that panicked while it held the cache left whole entries behind.
        let mut corners = self.corners.lock().unwrap_or_else(PoisonError::into_inner);
        if corners.len() >= MAX_CORNERS {
            corners.clear();
        }
        *corners.entry((row, column)).or_insert_with(|| {
            Self::exact(f64::from(row) * CELL_DEG, f64::from(column) * CELL_DEG).m()
        })
    }
}
