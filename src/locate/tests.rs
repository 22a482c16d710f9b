use super::*;
use crate::pose::Pose;
use crate::testing::{datum, pose, rig};
use emberfix_calib::{RectifiedPixel, Rig};
use emberfix_frames::{Attitude, Ecef, EllipsoidHeight, Matrix3, Vector3, Wgs84Parts, enu_offset};
use std::f64::consts::FRAC_PI_2;

const SIGMAS: SharedSigmas = SharedSigmas {
    heading_rad: 0.03,
    tilt_rad: 0.005,
};
const CENTRE: RectifiedPixel = RectifiedPixel { u: 640.0, v: 360.0 };

fn point_on_axis(pose: &Pose, rig: &Rig, depth_m: f64) -> Vector3<f64> {
    let view = View::new(rig, pose, &SIGMAS, &datum());
    view.camera_enu + view.ray_enu(CENTRE) * depth_m
}

/// Checklist item 48.
#[test]
fn ten_metres_on_the_axis_thirty_degrees_down_heading_north() {
    let point = point_on_axis(&pose(0.0, 0.0, 0.0), &rig(30.0), 10.0);
    assert!(
        (point - Vector3::new(0.0, 8.660_254, -5.0)).norm() < 1e-6,
        "{point}"
    );
}

#[test]
fn a_nose_to_the_east_sees_the_east_and_a_right_bank_looks_left_of_it() {
    let level = point_on_axis(&pose(0.0, 0.0, FRAC_PI_2), &rig(30.0), 10.0);
    assert!(
        (level - Vector3::new(8.660_254, 0.0, -5.0)).norm() < 1e-6,
        "{level}"
    );
    // Right wing down: what was below the nose swings to the left, which is north.
    let banked = point_on_axis(&pose(0.3, 0.0, FRAC_PI_2), &rig(30.0), 10.0);
    assert!(banked.y > 1.0, "{banked}");
}

/// Checklist E5 and E4: the printed 4x4-times-3 product taken as a rotation only forgets where the
/// vehicle is; the printed longitude, arctan(y/x), is on the other side of the Earth.
#[test]
fn the_chain_to_longitude_and_latitude_mends_the_printed_forms() {
    let (rig, pose) = (rig(30.0), pose(0.0, 0.0, 0.0));
    let view = View::new(&rig, &pose, &SIGMAS, &datum());
    let point = point_on_axis(&pose, &rig, 10.0);
    let ecef =
        Coordinate::<Ecef>::from_wgs84(&view.place(&Coordinate::from_metres(point)).unwrap())
            .metres();
    let (lat, lon) = (
        datum().latitude_deg().to_radians(),
        datum().longitude_deg().to_radians(),
    );
    let (sp, cp, sl, cl) = (lat.sin(), lat.cos(), lon.sin(), lon.cos());
    #[rustfmt::skip]
    let printed_rotation = Matrix3::new(
        -sl, -sp * cl, cp * cl,
        cl, -sp * sl, cp * sl,
        0.0, cp, sp,
    );
    let vehicle = Coordinate::<Ecef>::from_wgs84(&datum()).metres();
    assert!((ecef - (vehicle + printed_rotation * point)).norm() < 1e-6);
    assert!(
        (ecef - printed_rotation * point).norm() > 6e6,
        "rotation alone is no position"
    );

    let place = view.place(&Coordinate::from_metres(point)).unwrap();
    let printed_longitude = (ecef.y / ecef.x).atan().to_degrees();
    assert!(
        (printed_longitude + 60.888).abs() < 0.001,
        "{printed_longitude}"
    );
    assert!((place.longitude_deg() - 119.112_016_7).abs() < 1e-9);
    assert!((enu_offset(&datum(), &place) - point).norm() < 1e-6);
}

/// Each column of the model against what a really perturbed pose sees, by central differences.
#[test]
fn shared_errors_move_the_prediction_as_the_model_says() {
    let (rig, truth) = (rig(30.0), pose(0.1, -0.05, 0.7));
    let point = point_on_axis(&truth, &rig, 20.0) + Vector3::new(1.0, -2.0, 0.5);
    let view = View::new(&rig, &truth, &SIGMAS, &datum());
    let model = view.predict(&point).unwrap();
    type Perturb = fn(&mut Pose, f64);
    let cases: [(usize, f64, Perturb); 6] = [
        (Shared::GnssEast as usize, 1e-3, |p, e| {
            shift(p, Vector3::new(e, 0.0, 0.0))
        }),
        (Shared::GnssEast as usize + 2, 1e-3, |p, e| {
            shift(p, Vector3::new(0.0, 0.0, e))
        }),
        (Shared::Heading as usize, 1e-5, |p, e| turn_heading(p, e)),
        (Shared::BodyRoll as usize, 1e-5, |p, e| {
            turn_body(p, Vector3::new(e, 0.0, 0.0))
        }),
        (Shared::BodyRoll as usize + 1, 1e-5, |p, e| {
            turn_body(p, Vector3::new(0.0, e, 0.0))
        }),
        (Shared::Clock as usize, 1e-5, |p, e| {
            shift(p, p.velocity_enu_m_s * e);
            turn_body(p, p.rate_rad_s * e);
        }),
    ];
    for (index, step, perturb) in cases {
        // The pixel that the true pose sees is fixed; a reported pose with an error places the
        // point at p + D e, so by_shared e must equal the change of pixel from p to p + D e.
        let mut reported = truth.clone();
        perturb(&mut reported, step);
        let other = View::new(&rig, &reported, &SIGMAS, &datum());
        let x_true = view.enu_from_cam.transpose() * (point - view.camera_enu);
        let placed = other.camera_enu + other.enu_from_cam * x_true;
        let seen = view.predict(&placed).unwrap();
        let change = nalgebra::vector![seen.pixel.u - model.pixel.u, seen.pixel.v - model.pixel.v];
        let expected = model.by_shared.column(index) * step;
        let limit = 0.01 * expected.norm() + 1e-6;
        assert!(
            (change - expected).norm() < limit,
            "{index}: {change} against {expected}"
        );
    }
}

fn shift(pose: &mut Pose, by: Vector3<f64>) {
    let point = Coordinate::<emberfix_frames::VehicleEnu>::from_metres(by);
    pose.place = emberfix_frames::ecef_from_enu(&pose.place)
        .transform(point)
        .to_wgs84();
}

fn turn_heading(pose: &mut Pose, by: f64) {
    let (roll, pitch, heading) = pose.attitude.angles();
    pose.attitude = Attitude::from_angles(roll, pitch, heading + by);
}

fn turn_body(pose: &mut Pose, by: Vector3<f64>) {
    pose.attitude = pose.attitude.rotated(by, 1.0);
}

fn sighting(view: &View<'_>, base: &Vector3<f64>, height_m: f64) -> Sighting {
    let foot = view.predict(base).unwrap();
    let middle = view
        .predict(&(base + view.up() * (height_m / 2.0)))
        .unwrap();
    Sighting {
        at: view.pose.at,
        base: foot.pixel,
        base_sigma_px: (1.0, 1.0),
        size_px: (20.0, 40.0),
        disparity: Some(DisparityOf {
            px: middle.disparity_px,
            sigma_px: 0.1,
            centroid: middle.pixel,
        }),
        glow: None,
        at_least_m: None,
    }
}

#[test]
fn stereo_places_the_base_not_the_flame() {
    let (rig, pose) = (rig(30.0), pose(0.05, 0.02, 1.0));
    let view = View::new(&rig, &pose, &SIGMAS, &datum());
    let base = point_on_axis(&pose, &rig, 15.0);
    let fix = fix(&sighting(&view, &base, 2.0), &view, None).unwrap();
    assert!(
        (fix.enu.metres() - base).norm() < 1e-3,
        "{} {base}",
        fix.enu.metres()
    );
    assert_eq!(fix.methods, [Method::Stereo]);
    assert!((fix.range_m - 15.0).abs() < 1e-3);
}

#[test]
fn terrain_places_what_stereo_cannot_reach_and_the_sky_gives_nothing() {
    let (rig, pose) = (rig(30.0), pose(0.0, 0.0, 0.0));
    let view = View::new(&rig, &pose, &SIGMAS, &datum());
    let ground = ConstantPlane {
        height: EllipsoidHeight::from_m(8.7067 - 50.0),
        sigma_m: 1.0,
    };
    let base = Vector3::new(0.0, 50.0 / 30_f64.to_radians().tan(), -50.0);
    let mut seen = sighting(&view, &base, 1.0);
    seen.disparity = None;
    let found = fix(&seen, &view, Some(&ground)).unwrap();
    // The plane bends with the Earth by 0.6 mm over 87 m.
    assert!(
        (found.enu.metres() - base).norm() < 5e-3,
        "{}",
        found.enu.metres()
    );
    assert_eq!(found.methods, [Method::Terrain]);
    // A metre of height costs 1 / sin 30 = 2 m of range.
    assert!(found.covariance.m2().trace() > 4.0);
    let sky = View::new(&rig, &pose, &SIGMAS, &datum());
    seen.base = RectifiedPixel {
        u: 640.0,
        v: -600.0,
    };
    assert_eq!(fix(&seen, &sky, Some(&ground)), None);
}
