use super::*;
use crate::pose::Pose;
use crate::testing::{datum, pose, rig};
use emberfix_calib::{RectifiedPixel, Rig};
use emberfix_frames::{Attitude, Ecef, EllipsoidHeight, Matrix3, Vector3, Wgs84Parts, enu_offset};
use std::f64::consts::FRAC_PI_2;

pub(super) const SIGMAS: SharedPriors = SharedPriors {
    gnss_constant_share: 0.5,
    gnss_correlation_s: 100.0,
    velocity_m_s: 0.1,
    velocity_correlation_s: 1.0,
    heading_rad: 0.03,
    heading_constant_share: 0.5,
    heading_correlation_s: 100.0,
    tilt_rad: 0.005,
    tilt_constant_share: 0.5,
    tilt_correlation_s: 100.0,
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

type Perturb = fn(&mut Pose, f64);

/// Index of an error, its size (metres, radians), and what it does to the reported pose.
const ERRORS: [(usize, f64, Perturb); 6] = [
    (Shared::GnssConstant as usize, 2.0, |p, e| {
        shift(p, Vector3::new(e, 0.0, 0.0))
    }),
    (Shared::Gnss as usize + 2, -3.0, |p, e| {
        shift(p, Vector3::new(0.0, 0.0, e))
    }),
    (Shared::HeadingConstant as usize, 0.05, turn_heading),
    (Shared::Boresight as usize, -0.05, |p, e| {
        turn_body(p, Vector3::new(e, 0.0, 0.0))
    }),
    (Shared::Tilt as usize + 1, 0.05, |p, e| {
        turn_body(p, Vector3::new(0.0, e, 0.0))
    }),
    (Shared::AttitudeJitter as usize + 2, 0.03, |p, e| {
        turn_body(p, Vector3::new(0.0, 0.0, e))
    }),
];

fn in_sigmas(view: &View<'_>, index: usize, error: f64) -> nalgebra::SVector<f64, SHARED> {
    let mut shared = nalgebra::SVector::zeros();
    shared[index] = error / view.sigmas()[index];
    shared
}

/// Three degrees and metres: no expansion about nothing would do.
#[test]
fn a_reported_pose_with_its_error_taken_out_sees_what_the_true_one_sees() {
    let (rig, truth) = (rig(30.0), pose(0.1, -0.05, 0.7));
    let point = point_on_axis(&truth, &rig, 20.0) + Vector3::new(1.0, -2.0, 0.5);
    let seen = View::new(&rig, &truth, &SIGMAS, &datum())
        .predict(&point)
        .unwrap();
    for (index, error, perturb) in ERRORS {
        let mut reported = truth.clone();
        perturb(&mut reported, error);
        let view = View::new(&rig, &reported, &SIGMAS, &datum());
        let lens = view.lens(&in_sigmas(&view, index, error), 0.0);
        let mended = lens.predict(&Distant::near(point)).unwrap();
        let off = (mended.pixel.u - seen.pixel.u).hypot(mended.pixel.v - seen.pixel.v);
        // The tangent planes of the two places differ by their distance over the Earth's radius.
        assert!(off < 0.01, "{index}: {off} px");
    }
}

/// A vehicle that swings: its attitude 300 ms later has nothing to do with its present rate.
fn swinging(later_s: f64) -> Option<Pose> {
    let mut pose = pose(
        0.2 * (4.0 * later_s).sin(),
        0.1 * (6.0 * later_s).cos(),
        0.7,
    );
    shift(&mut pose, Vector3::new(5.0 * later_s, 2.0 * later_s, 0.0));
    Some(pose)
}

#[test]
fn a_clock_error_takes_the_pose_of_another_moment() {
    let rig = rig(30.0);
    let (reported, truth) = (swinging(0.3).unwrap(), swinging(0.0).unwrap());
    let point = point_on_axis(&truth, &rig, 20.0) + Vector3::new(1.0, -2.0, 0.5);
    let seen = View::new(&rig, &truth, &SIGMAS, &datum())
        .predict(&point)
        .unwrap();
    let motion = |later_s: f64| swinging(0.3 + later_s);
    let view = View::new(&rig, &reported, &SIGMAS, &datum()).with_motion(&motion);
    let shared = in_sigmas(&view, Shared::Clock as usize, 0.3);
    let mended = view
        .lens(&shared, 0.0)
        .predict(&Distant::near(point))
        .unwrap();
    let off = (mended.pixel.u - seen.pixel.u).hypot(mended.pixel.v - seen.pixel.v);
    assert!(off < 0.01, "{off} px");
}

#[test]
fn a_vague_clock_widens_the_errors_of_the_frame_by_what_the_motion_bends() {
    let (rig, reported) = (rig(30.0), swinging(0.0).unwrap());
    let point = point_on_axis(&reported, &rig, 20.0);
    let view = View::new(&rig, &reported, &SIGMAS, &datum()).with_motion(&swinging);
    let jitter_px = |clock_sigma: f64| {
        let lens = view.lens(&nalgebra::SVector::zeros(), clock_sigma);
        let linear = lens.linear(&Distant::near(point)).unwrap();
        linear.by_shared[(0, Shared::AttitudeJitter as usize + 2)].abs()
    };
    let vague = 0.2 / view.sigmas()[Shared::Clock as usize];
    assert!(jitter_px(vague) > 10.0 * jitter_px(0.0));
}

/// Every slope against differences of the model itself, for a near point and a distant one.
#[test]
fn slopes_are_those_of_the_model() {
    let (rig, reported) = (rig(30.0), pose(0.1, -0.05, 0.7));
    let view = View::new(&rig, &reported, &SIGMAS, &datum());
    let near = point_on_axis(&reported, &rig, 20.0) + Vector3::new(1.0, -2.0, 0.5);
    let far = Distant {
        at: near * 0.02,
        over: 0.02,
    };
    let at = nalgebra::SVector::<f64, SHARED>::from_fn(|i, _| 0.3 - 0.02 * i as f64);
    for point in [Distant::near(near), far] {
        let linear = view.lens(&at, 0.0).linear(&point).unwrap();
        let value = |shared: &nalgebra::SVector<f64, SHARED>, point: &Distant| {
            view.lens(shared, 0.0).linear(point).unwrap().value
        };
        for index in 0..SHARED {
            let mut step = nalgebra::SVector::zeros();
            step[index] = 1e-3;
            let slope = (value(&(at + step), &point) - value(&(at - step), &point)) / 2e-3;
            let model = linear.by_shared.column(index);
            // Angles of three sigmas turn each other's axes a little.
            let limit = 0.03 * slope.norm() + 1e-3;
            assert!((slope - model).norm() < limit, "{index}: {slope} {model}");
        }
        for axis in 0..3 {
            let mut moved = point;
            moved.at[axis] += 1e-5;
            let slope = (value(&at, &moved) - linear.value) / 1e-5;
            let limit = 1e-3 * slope.norm() + 1e-3;
            assert!((slope - linear.by_at.column(axis)).norm() < limit);
        }
        let mut moved = point;
        moved.over += 1e-7;
        let slope = (value(&at, &moved) - linear.value) / 1e-7;
        assert!((slope - linear.by_over).norm() < 1e-3 * slope.norm());
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
