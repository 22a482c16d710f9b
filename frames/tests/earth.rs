//! Properties over the whole Earth, against GeographicLib's geodesics and our own way back.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

use emberfix_frames::{
    Coordinate, Ecef, EllipsoidHeight, Metres, MissionEnu, Vector3, Wgs84, Wgs84Parts,
    ecef_from_enu, enu_offset, place_from_degrees,
};
use geographiclib_rs::{DirectGeodesic, Geodesic};
use proptest::prelude::*;

fn place(latitude: f64, longitude: f64, height: f64) -> Wgs84 {
    place_from_degrees(latitude, longitude, EllipsoidHeight::from_m(height)).unwrap()
}

proptest! {
    /// Walking a geodesic of up to 300 m on the ellipsoid is walking east and north in the plane.
    /// Curvature: the plane is left by s²/2R (7 mm at 300 m) downwards and s³/6R² (0.1 µm) along;
    /// the azimuth turns by less than s tan(latitude)/R, hence the looser limit near the poles.
    #[test]
    fn east_and_north_are_those_of_geographiclib(
        latitude in -89.0..89.0_f64,
        longitude in -180.0..180.0_f64,
        azimuth in 0.0..360.0_f64,
        walked in 1.0..300.0_f64,
    ) {
        let (latitude2, longitude2): (f64, f64) =
            Geodesic::wgs84().direct(latitude, longitude, azimuth, walked);
        let offset = enu_offset(&place(latitude, longitude, 0.0), &place(latitude2, longitude2, 0.0));
        let (sin, cos) = azimuth.to_radians().sin_cos();
        let expected = Vector3::new(walked * sin, walked * cos, -walked * walked / (2.0 * 6.37e6));
        prop_assert!((offset - expected).norm() < 1e-4, "{offset} {expected}");
    }

    /// There and back, poles and antimeridian included.
    #[test]
    fn a_point_comes_back_from_the_tangent_plane(
        latitude in -90.0..=90.0_f64,
        longitude in -180.0..=180.0_f64,
        height in -400.0..9000.0_f64,
        east in -3000.0..3000.0_f64,
        north in -3000.0..3000.0_f64,
        up in -500.0..500.0_f64,
    ) {
        let origin = place(latitude, longitude, height);
        let offset = Vector3::new(east, north, up);
        let there = ecef_from_enu(&origin).transform(Coordinate::<MissionEnu>::from_metres(offset));
        let found = there.to_wgs84();
        prop_assert!((-90.0..=90.0).contains(&found.latitude_deg()));
        prop_assert!((-180.0..=180.0).contains(&found.longitude_deg()));
        // f64 metres at 6.4e6 m resolve 1 nm; a few operations later 1 µm is safe.
        let again = Coordinate::<Ecef>::from_wgs84(&found).metres();
        prop_assert!((again - there.metres()).norm() < 1e-6);
        prop_assert!((enu_offset(&origin, &found) - offset).norm() < 1e-6);
    }

    /// Height is measured along the vertical: straight up changes nothing else.
    #[test]
    fn up_is_up(
        latitude in -90.0..=90.0_f64,
        longitude in -180.0..=180.0_f64,
        climb in 0.0..500.0_f64,
    ) {
        let origin = place(latitude, longitude, 100.0);
        let offset = enu_offset(&origin, &place(latitude, longitude, 100.0 + climb));
        prop_assert!((offset - Vector3::new(0.0, 0.0, climb)).norm() < 1e-6);
    }
}

#[test]
fn impossible_places_are_refused_with_their_value() {
    let height = EllipsoidHeight::from_m(0.0);
    for (latitude, longitude) in [
        (90.1, 0.0),
        (f64::NAN, 0.0),
        (0.0, f64::INFINITY),
        (0.0, 400.0),
    ] {
        assert!(place_from_degrees(latitude, longitude, height).is_err());
    }
    assert!(place_from_degrees(0.0, 0.0, EllipsoidHeight::from_m(1e7)).is_err());
    assert!((place(10.0, 190.0, 0.0).longitude_deg() + 170.0).abs() < 1e-9);
}
