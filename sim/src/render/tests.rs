use super::*;
use crate::world::{
    BurningClass, FireConfig, LookalikeConfig, LookalikeKind, WindConfig, WorldConfig,
};
use emberfix_calib::Rig;
use emberfix_frames::{Attitude, BodyFrd, Coordinate, Metres, Vector as FrameVector, VehicleEnu};
use nalgebra::{Matrix3, Rotation3};
use std::io::Write;

fn oakd() -> Rig {
    Rig::load(concat!(env!("CARGO_MANIFEST_DIR"), "/../calib/rigs/oakd-75mm.toml").as_ref())
        .unwrap()
}

/// A small rig without distortion or turn between the eyes: 0.3 m baseline, 300 px.
fn ideal(depression_deg: f64) -> Rig {
    let eye = "image_size_px = [320, 240]\nfocal_px = [300.0, 300.0]\n\
               principal_point_px = [160.0, 120.0]\ndistortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n";
    let text = format!(
        "name = \"ideal\"\n[left]\n{eye}[right]\n{eye}[stereo]\n\
         right_from_left_rotation_deg = [0.0, 0.0, 0.0]\n\
         right_from_left_translation_m = [-0.3, 0.0, 0.0]\nmax_skew_s = 0.001\n[mount]\n\
         yaw_deg = 0.0\ndepression_deg = {depression_deg}\nroll_deg = 0.0\n\
         lever_arm_m = [0.0, 0.0, 0.0]\n[time]\ncamera_offset_s = 0.0\n[sigma]\n\
         disparity_bias_px = 0.1\nboresight_deg = 0.1\nlever_arm_m = 0.01\ntime_offset_s = 0.001\n"
    );
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(text.as_bytes()).unwrap();
    Rig::load(file.path()).unwrap()
}

/// Heading, pitch and roll by hand: north-east-down turned, then east-north-up.
fn body(position_m: Vector3<f64>, roll_deg: f64, pitch_deg: f64, heading_deg: f64) -> BodyState {
    let turn = |axis, deg: f64| Rotation3::from_axis_angle(&axis, deg.to_radians());
    let ned_from_body = turn(Vector3::z_axis(), heading_deg)
        * turn(Vector3::y_axis(), pitch_deg)
        * turn(Vector3::x_axis(), roll_deg);
    let enu_from_ned = Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    BodyState {
        t_s: 0.0,
        position_m,
        enu_from_body: enu_from_ned * ned_from_body.into_inner(),
        velocity_m_s: Vector3::zeros(),
        rate_rad_s: Vector3::zeros(),
    }
}

fn renderer(rig: &Rig, config: &WorldConfig) -> Renderer {
    let world = Arc::new(World::new(config, 11).unwrap());
    Renderer::new(world, StereoCamera::new(rig), RenderConfig::default())
}

fn fire(east_m: f64, north_m: f64, width_m: f64) -> FireConfig {
    FireConfig {
        name: "a".to_owned(),
        east_m,
        north_m,
        width_m,
        height_m: 1.5 * width_m,
        smoke: false,
        ignites_at_s: 0.0,
        growth_m_s: 0.0,
    }
}

fn still(config: WorldConfig) -> WorldConfig {
    WorldConfig {
        wind: WindConfig {
            east_m_s: 0.0,
            north_m_s: 0.0,
        },
        ..config
    }
}

#[test]
fn thirty_degrees_down_the_axis_meets_the_papers_point() {
    let camera = StereoCamera::new(&ideal(30.0));
    let state = body(Vector3::new(7.0, -3.0, 50.0), 0.0, 0.0, 0.0);
    let pose = camera.pose(Eye::Left, &state);
    let along = pose.enu_from_camera * Vector3::new(0.0, 0.0, 10.0);
    assert!(
        (along - Vector3::new(0.0, 8.660_254, -5.0)).norm() < 1e-6,
        "{along}"
    );
    let renderer = renderer(&ideal(30.0), &WorldConfig::default());
    let (u, v) = renderer
        .project(Eye::Left, state.position_m + along, &state)
        .unwrap();
    assert!(
        (u - 160.0).abs() < 1e-9 && (v - 120.0).abs() < 1e-9,
        "{u} {v}"
    );
}

#[test]
fn headings_and_banks_move_known_points_to_known_sides() {
    let renderer = renderer(&ideal(0.0), &WorldConfig::default());
    let eye = Vector3::new(0.0, 0.0, 10.0);
    let east_ahead = eye + Vector3::new(20.0, 0.0, 0.0);
    let (u, v) = renderer
        .project(Eye::Left, east_ahead, &body(eye, 0.0, 0.0, 90.0))
        .unwrap();
    assert!((u - 160.0).abs() < 1e-9 && (v - 120.0).abs() < 1e-9);
    // Nose up: what was ahead sinks in the picture.
    let (_, v) = renderer
        .project(Eye::Left, east_ahead, &body(eye, 0.0, 10.0, 90.0))
        .unwrap();
    assert!((v - 120.0 - 300.0 * 10_f64.to_radians().tan()).abs() < 1e-9);
    // Right wing down: what was level on the right rises.
    let right = eye + Vector3::new(20.0, -5.0, 0.0);
    let (u, v) = renderer
        .project(Eye::Left, right, &body(eye, 20.0, 0.0, 90.0))
        .unwrap();
    assert!(u > 160.0 && v < 120.0, "{u} {v}");
    assert_eq!(
        renderer.project(Eye::Left, eye - Vector3::x(), &body(eye, 0.0, 0.0, 90.0)),
        None
    );
}

#[test]
fn the_lens_agrees_with_the_calibration_and_inverts_itself() {
    let rig = oakd();
    let camera = StereoCamera::new(&rig);
    for eye in [Eye::Left, Eye::Right] {
        for k in 0..400 {
            let (u, v) = (f64::from(k % 20) * 67.0, f64::from(k / 20) * 37.7);
            let (x, y) = camera.lens(eye).unproject(u, v);
            let theirs = rig
                .camera(eye)
                .project(&Vector3::new(7.0 * x, 7.0 * y, 7.0));
            assert!(
                (theirs.u - u).abs() < 1e-6 && (theirs.v - v).abs() < 1e-6,
                "{u} {v}"
            );
            let ours = camera
                .lens(eye)
                .project(&Vector3::new(7.0 * x, 7.0 * y, 7.0))
                .unwrap();
            assert!(
                (ours.0 - u).abs() < 1e-6 && (ours.1 - v).abs() < 1e-6,
                "{u} {v}"
            );
        }
    }
}

/// The two chains, from the point to the pixel, written twice from the definitions.
#[test]
fn the_chain_of_frames_leads_to_the_same_pixel() {
    let rig = oakd();
    let renderer = renderer(&rig, &WorldConfig::default());
    let eye = Vector3::new(4.0, 5.0, 60.0);
    for k in 0..60 {
        let (roll, pitch, heading) = (
            f64::from(k % 7) * 9.0 - 27.0,
            f64::from(k % 5) * 6.0 - 12.0,
            f64::from(k) * 31.0,
        );
        let state = body(eye, roll, pitch, heading);
        let attitude =
            Attitude::from_angles(roll.to_radians(), pitch.to_radians(), heading.to_radians());
        // A point before the rectified left camera, the long way through `frames` and `calib`.
        let seen = Vector3::new(
            f64::from(k % 3) * 4.0 - 4.0,
            f64::from(k % 4) * 2.0 - 3.0,
            25.0,
        );
        let in_camera = FrameVector::from_metres(seen);
        let in_body =
            rig.body_from_cam_left().transform(in_camera).metres() + rig.lever_arm().metres();
        let in_enu: FrameVector<VehicleEnu> =
            attitude
                .enu_from_body()
                .transform(FrameVector::<BodyFrd>::from_metres(in_body));
        let left = renderer
            .project(Eye::Left, eye + in_enu.metres(), &state)
            .unwrap();
        let right = renderer
            .project(Eye::Right, eye + in_enu.metres(), &state)
            .unwrap();
        let pixel = |(u, v)| emberfix_calib::RawPixel { u, v };
        let rect = rig.rectification();
        let left = rect.rectify(Eye::Left, &[pixel(left)]).unwrap()[0];
        let right = rect.rectify(Eye::Right, &[pixel(right)]).unwrap()[0];
        let back: Coordinate<_> = rig.point(left, rig.depth_m(left.u - right.u).unwrap());
        // A hundred-millionth of a pixel of OpenCV's undistortion is some micrometres at 25 m.
        assert!(
            (back.metres() - seen).norm() < 1e-3,
            "{seen} came back as {}",
            back.metres()
        );
        assert!(
            (left.v - right.v).abs() < 1e-5,
            "rows differ by {}",
            left.v - right.v
        );
    }
}

#[test]
fn parallax_is_focal_length_times_baseline_over_depth() {
    let renderer = renderer(&ideal(90.0), &WorldConfig::default());
    let state = body(Vector3::new(0.0, 0.0, 15.0), 0.0, 0.0, 40.0);
    let point = Vector3::new(1.0, -2.0, 3.0);
    let (left, right) = (
        renderer.project(Eye::Left, point, &state).unwrap(),
        renderer.project(Eye::Right, point, &state).unwrap(),
    );
    assert!((left.0 - right.0 - 300.0 * 0.3 / 12.0).abs() < 1e-9);
    assert!((left.1 - right.1).abs() < 1e-9);
}

/// The picture itself moves by the parallax of the ground, 300 * 0.3 / 15 = 6 px, to the right in
/// the left eye.
#[test]
fn the_ground_in_the_two_pictures_moves_by_its_parallax() {
    let renderer = renderer(&ideal(90.0), &WorldConfig::default());
    let state = body(Vector3::new(0.0, 0.0, 15.0), 0.0, 0.0, 0.0);
    let (left, right) = (
        renderer.render(Eye::Left, &state, 0.0),
        renderer.render(Eye::Right, &state, 0.0),
    );
    let grey = |u: usize, v: usize| f64::from(left.bytes[(v * 320 + u) * 3 + 1]);
    let other = |u: usize, v: usize| f64::from(right.bytes[v * 320 + u]);
    let unlike = |shift: usize| -> f64 {
        let pixels = (80..160).flat_map(|v| (100..220).map(move |u| (u, v)));
        let differences = pixels.map(|(u, v)| {
            // Slopes, so that the eyes' gains do not matter.
            let slope = grey(u + 2, v) - grey(u, v);
            (slope - (other(u + 2 - shift, v) - other(u - shift, v))).abs()
        });
        differences.sum()
    };
    let best = (0..20)
        .min_by(|a, b| unlike(*a).total_cmp(&unlike(*b)))
        .unwrap();
    assert_eq!(best, 6);
    assert!(
        unlike(6) < 0.75 * unlike(5).min(unlike(7)),
        "the texture is too soft to match"
    );
}

#[test]
fn the_same_moment_gives_the_same_bytes_and_the_next_one_others() {
    let config = WorldConfig {
        fires: vec![fire(0.0, 12.0, 1.5)],
        ..WorldConfig::default()
    };
    let (one, two) = (
        renderer(&ideal(30.0), &config),
        renderer(&ideal(30.0), &config),
    );
    let state = body(Vector3::new(0.0, 0.0, 8.0), 5.0, 0.0, 0.0);
    for eye in [Eye::Left, Eye::Right] {
        assert_eq!(one.render(eye, &state, 1.0), two.render(eye, &state, 1.0));
        assert_ne!(one.render(eye, &state, 1.0), one.render(eye, &state, 1.1));
    }
    assert_eq!(one.label_boxes(&state, 1.0), two.label_boxes(&state, 1.0));
}

/// Seen from so low that the depth of the burning bed does not reach down in the picture.
#[test]
fn a_flame_stands_on_the_lower_middle_of_its_box() {
    let config = still(WorldConfig {
        fires: vec![fire(0.0, 20.0, 1.2)],
        ..WorldConfig::default()
    });
    let renderer = renderer(&oakd(), &config);
    let state = body(Vector3::new(0.0, 0.0, 1.2), 0.0, 28.0, 0.0);
    for k in 0..10 {
        let label = renderer.label_boxes(&state, f64::from(k) * 0.37)[0];
        let (u, v) = renderer
            .project(Eye::Left, renderer.world().fires()[0].base_m, &state)
            .unwrap();
        assert!((label.bottom_px - v).abs() < 2.0, "foot {v}, box {label:?}");
        let width = label.right_px - label.left_px;
        assert!(
            (label.left_px + label.right_px - 2.0 * u).abs() < 0.5 * width,
            "{u} {label:?}"
        );
        assert!(
            (25.0..75.0).contains(&width),
            "1.2 m at 20 m are 53 px, not {width}"
        );
    }
}

#[test]
fn a_flame_is_brighter_and_redder_than_what_is_around_it() {
    let config = WorldConfig {
        fires: vec![fire(0.0, 20.0, 1.5)],
        ..WorldConfig::default()
    };
    let renderer = renderer(&oakd(), &config);
    let state = body(Vector3::new(0.0, 0.0, 12.0), 0.0, 0.0, 0.0);
    let frame = renderer.render(Eye::Left, &state, 2.0);
    let label = renderer.label_boxes(&state, 2.0)[0];
    let (u, v) = (
        0.5 * (label.left_px + label.right_px),
        0.3 * label.top_px + 0.7 * label.bottom_px,
    );
    let offset = (v as usize * frame.width as usize + u as usize) * 3;
    let [blue, green, red] = [0, 1, 2].map(|c| frame.bytes[offset + c]);
    assert!(red > 240 && red > blue, "{red} {green} {blue}");
    assert_eq!(label.class, BurningClass::Fire);
}

#[test]
fn a_flame_behind_a_house_or_before_its_time_is_not_labelled() {
    let state = body(Vector3::new(0.0, 0.0, 3.0), 0.0, 20.0, 0.0);
    let house = LookalikeConfig {
        kind: LookalikeKind::RedRoof,
        east_m: 0.0,
        north_m: 20.0,
        size_m: 9.0,
    };
    let open = WorldConfig {
        fires: vec![fire(0.0, 32.0, 0.8)],
        ..WorldConfig::default()
    };
    let hidden = WorldConfig {
        lookalikes: vec![house],
        ..open.clone()
    };
    assert_eq!(renderer(&oakd(), &open).label_boxes(&state, 0.0).len(), 1);
    assert_eq!(renderer(&oakd(), &hidden).label_boxes(&state, 0.0), vec![]);
    let mut later = open;
    later.fires[0].ignites_at_s = 5.0;
    assert_eq!(renderer(&oakd(), &later).label_boxes(&state, 4.0), vec![]);
}

#[test]
fn the_horizon_is_level_in_level_flight_and_falls_to_the_right_when_the_left_wing_is_down() {
    let renderer = renderer(&ideal(0.0), &WorldConfig::default());
    let sky_rows = |roll_deg: f64, column: usize| {
        let frame = renderer.render(
            Eye::Left,
            &body(Vector3::new(0.0, 0.0, 30.0), roll_deg, 0.0, 0.0),
            0.0,
        );
        // The sky is bluer than red; grass and soil are not.
        let is_sky = |row: &usize| {
            let pixel = &frame.bytes[(row * 320 + column) * 3..][..3];
            f64::from(pixel[0]) > 0.95 * f64::from(pixel[2])
        };
        (0..240).filter(is_sky).count() as f64
    };
    assert!((sky_rows(0.0, 40) - 120.0).abs() < 14.0 && (sky_rows(0.0, 280) - 120.0).abs() < 14.0);
    let (left, right) = (sky_rows(-20.0, 40), sky_rows(-20.0, 280));
    // 240 columns at 20 degrees: 87 rows.
    assert!((right - left - 87.0).abs() < 25.0, "{left} {right}");
}

#[test]
fn a_jpeg_begins_and_ends_as_one() {
    let frame = Frame {
        width: 16,
        height: 8,
        format: PixelFormat::Mono8,
        bytes: vec![90; 128],
    };
    let jpeg = encode_jpeg(&frame, 80);
    assert!(jpeg.starts_with(&[0xFF, 0xD8]) && jpeg.ends_with(&[0xFF, 0xD9]));
    assert!(
        encode_jpeg(
            &Frame {
                bytes: vec![90; 127],
                ..frame
            },
            80
        )
        .is_empty()
    );
}
