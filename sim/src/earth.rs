//! WGS84 in our own words: latitude, longitude, height; ECEF; the tangent plane at the datum.
//!
//! **In, out:** degrees and metres. Written apart from crate `frames` on purpose: an error in one of
//! the two shows as a position error in a simulated flight. **Known limits.** Within 1 nm below
//! 10 000 km height; nearer to the Earth's centre than 40 km the latitude is not defined well.

use nalgebra::{Matrix3, Vector3};

/// Semi-major axis of WGS84, metres.
const A_M: f64 = 6_378_137.0;
/// Flattening of WGS84.
const F: f64 = 1.0 / 298.257_223_563;
/// First eccentricity, squared.
const E2: f64 = F * (2.0 - F);

/// A place: geodetic latitude and longitude in degrees, height above the ellipsoid in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lla {
    /// North positive, degrees.
    pub latitude_deg: f64,
    /// East positive, degrees.
    pub longitude_deg: f64,
    /// Above the WGS84 ellipsoid, metres.
    pub height_m: f64,
}

impl Lla {
    /// To Earth-centred, Earth-fixed metres.
    #[must_use]
    pub fn to_ecef_m(self) -> Vector3<f64> {
        let (sin_lat, cos_lat) = self.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude_deg.to_radians().sin_cos();
        let normal = A_M / (1.0 - E2 * sin_lat * sin_lat).sqrt();
        let across = (normal + self.height_m) * cos_lat;
        let along = (normal * (1.0 - E2) + self.height_m) * sin_lat;
        Vector3::new(across * cos_lon, across * sin_lon, along)
    }

    /// From Earth-centred, Earth-fixed metres: Bowring's iteration (Survey Review 23, 1976) on the
    /// parametric latitude; three rounds are exact to rounding at all heights that fly.
    #[must_use]
    pub fn from_ecef_m(ecef: Vector3<f64>) -> Self {
        let b_m = A_M * (1.0 - F);
        let second_e2 = E2 / (1.0 - E2);
        let axis_m = ecef.x.hypot(ecef.y);
        let mut parametric = (ecef.z * A_M).atan2(axis_m * b_m);
        let mut latitude = 0.0_f64;
        for _ in 0..3 {
            let (sin, cos) = parametric.sin_cos();
            let up = ecef.z + second_e2 * b_m * sin.powi(3);
            let out = axis_m - E2 * A_M * cos.powi(3);
            latitude = up.atan2(out);
            parametric = ((1.0 - F) * latitude.sin()).atan2(latitude.cos());
        }
        let (sin, cos) = latitude.sin_cos();
        Self {
            latitude_deg: latitude.to_degrees(),
            longitude_deg: ecef.y.atan2(ecef.x).to_degrees(),
            height_m: axis_m * cos + ecef.z * sin - A_M * (1.0 - E2 * sin * sin).sqrt(),
        }
    }
}

/// The plane that touches the ellipsoid's parallel surface at a datum: east, north, up.
#[derive(Debug, Clone, Copy)]
pub struct TangentPlane {
    origin_ecef_m: Vector3<f64>,
    /// Rows: east, north, up as ECEF directions.
    enu_from_ecef: Matrix3<f64>,
}

impl TangentPlane {
    /// The plane at `datum`.
    #[must_use]
    pub fn at(datum: Lla) -> Self {
        let (sin_lat, cos_lat) = datum.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = datum.longitude_deg.to_radians().sin_cos();
        #[rustfmt::skip]
        let enu_from_ecef = Matrix3::new(
            -sin_lon, cos_lon, 0.0,
            -sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat,
            cos_lat * cos_lon, cos_lat * sin_lon, sin_lat,
        );
        Self {
            origin_ecef_m: datum.to_ecef_m(),
            enu_from_ecef,
        }
    }

    /// East, north, up in metres to ECEF metres.
    #[must_use]
    pub fn to_ecef_m(&self, enu_m: Vector3<f64>) -> Vector3<f64> {
        self.origin_ecef_m + self.enu_from_ecef.transpose() * enu_m
    }

    /// ECEF metres to east, north, up in metres.
    #[must_use]
    pub fn from_ecef_m(&self, ecef_m: Vector3<f64>) -> Vector3<f64> {
        self.enu_from_ecef * (ecef_m - self.origin_ecef_m)
    }

    /// East, north, up in metres to a place.
    #[must_use]
    pub fn to_lla(&self, enu_m: Vector3<f64>) -> Lla {
        Lla::from_ecef_m(self.to_ecef_m(enu_m))
    }

    /// A place to east, north, up in metres.
    #[must_use]
    pub fn from_lla(&self, place: Lla) -> Vector3<f64> {
        self.from_ecef_m(place.to_ecef_m())
    }

    /// Takes components in this plane to components in the plane at `place`: 100 m away the two
    /// differ by a thousandth of a degree, 10 km away by a tenth.
    #[must_use]
    pub fn local_from_here(&self, place: Lla) -> Matrix3<f64> {
        Self::at(place).enu_from_ecef * self.enu_from_ecef.transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Row {
        id: String,
        op: String,
        input: Vector3<f64>,
        reference: Lla,
        output: Vector3<f64>,
        tolerance_m: f64,
    }

    fn shared_data() -> std::path::PathBuf {
        let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared");
        std::env::var_os("EMBERFIX_SHARED")
            .unwrap_or_else(|| beside.into())
            .into()
    }

    fn rows(text: &str) -> Vec<Row> {
        let vector = |cells: &[&str]| {
            let number = |i: usize| cells[i].parse().unwrap_or(0.0);
            Vector3::new(number(0), number(1), number(2))
        };
        text.lines()
            .skip(1)
            .map(|line| line.split(',').collect::<Vec<_>>())
            .filter(|cells| cells[2] == "WGS84")
            .map(|cells| Row {
                id: cells[0].to_owned(),
                op: cells[1].to_owned(),
                input: vector(&cells[3..6]),
                reference: lla(vector(&cells[6..9])),
                output: vector(&cells[9..12]),
                tolerance_m: cells[12].parse().unwrap(),
            })
            .collect()
    }

    fn lla(cells: Vector3<f64>) -> Lla {
        Lla {
            latitude_deg: cells.x,
            longitude_deg: cells.y,
            height_m: cells.z,
        }
    }

    fn apart_m(a: Lla, b: Lla) -> f64 {
        (a.to_ecef_m() - b.to_ecef_m()).norm()
    }

    fn error_m(row: &Row) -> f64 {
        let plane = TangentPlane::at(row.reference);
        let metres = |found: Vector3<f64>| (found - row.output).norm();
        match row.op.as_str() {
            "lla_to_ecef" => metres(lla(row.input).to_ecef_m()),
            "ecef_to_lla" => apart_m(Lla::from_ecef_m(row.input), lla(row.output)),
            "lla_to_enu" => metres(plane.from_lla(lla(row.input))),
            "enu_to_lla" => apart_m(plane.to_lla(row.input), lla(row.output)),
            "ecef_to_enu" => metres(plane.from_ecef_m(row.input)),
            "enu_to_ecef" => metres(plane.to_ecef_m(row.input)),
            "ecef_vec_to_enu" => metres(plane.enu_from_ecef * row.input),
            "enu_vec_to_ecef" => metres(plane.enu_from_ecef.transpose() * row.input),
            other => panic!("unknown operation {other}"),
        }
    }

    #[test]
    fn earth_maths_agrees_with_independent_programs() {
        let Ok(text) = std::fs::read_to_string(shared_data().join("data/geo/golden_vectors.csv"))
        else {
            eprintln!("skipped: no shared data");
            return;
        };
        let rows = rows(&text);
        assert!(rows.len() > 90, "only {} rows", rows.len());
        for row in &rows {
            let error = error_m(row);
            assert!(
                error <= row.tolerance_m,
                "{} {}: {error:.3e} m",
                row.id,
                row.op
            );
        }
    }

    #[test]
    fn east_is_east_and_up_is_up() {
        let datum = Lla {
            latitude_deg: 31.4,
            longitude_deg: 119.1,
            height_m: 20.0,
        };
        let plane = TangentPlane::at(datum);
        let east = plane.to_lla(Vector3::new(100.0, 0.0, 0.0));
        assert!(east.longitude_deg > datum.longitude_deg);
        let up = plane.to_lla(Vector3::new(0.0, 0.0, 5.0));
        // 1e-8 m: rounding of ECEF components in 6.4e6 m.
        assert!((up.height_m - 25.0).abs() < 1e-8);
        let north = plane.to_lla(Vector3::new(0.0, 100.0, 0.0));
        assert!(north.latitude_deg > datum.latitude_deg);
    }
}
