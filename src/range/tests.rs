//! Synthetic pairs whose disparities are known, through a rig that rectification leaves as it is.

use super::*;
use emberfix_calib::Rig;
use opencv::core::{CV_8UC1, CV_8UC3, Mat, MatTrait, Scalar, Vec3b};
use std::path::Path;

const WIDTH: i32 = 360;
const HEIGHT: i32 = 200;
const FOCAL_PX: f64 = 500.0;
const BASELINE_M: f64 = 0.1;

fn rig() -> Rig {
    Rig::load(rig_file().path()).unwrap()
}

fn rig_file() -> tempfile::NamedTempFile {
    let camera = format!(
        "image_size_px = [{WIDTH}, {HEIGHT}]\nfocal_px = [{FOCAL_PX}, {FOCAL_PX}]\n\
         principal_point_px = [179.5, 99.5]\ndistortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n"
    );
    let text = format!(
        "name = \"plain\"\n[left]\n{camera}[right]\n{camera}[stereo]\n\
         right_from_left_rotation_deg = [0.0, 0.0, 0.0]\n\
         right_from_left_translation_m = [-{BASELINE_M}, 0.0, 0.0]\nmax_skew_s = 0.001\n\
         [mount]\nyaw_deg = 0.0\ndepression_deg = 0.0\nroll_deg = 0.0\nlever_arm_m = [0.0, 0.0, 0.0]\n\
         [time]\ncamera_offset_s = 0.0\n[sigma]\ndisparity_bias_px = 0.05\nboresight_deg = 0.1\n\
         lever_arm_m = 0.01\ntime_offset_s = 0.001\n"
    );
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    file
}

/// Smooth noise of a few pixels' grain, defined between pixels as well: a sum of waves.
fn texture(u: f64, v: f64, seed: f64) -> f64 {
    (1..=8)
        .map(|k| {
            let k = f64::from(k);
            let (fu, fv) = (
                0.9 * (k * 1.7 + seed).sin(),
                0.9 * (k * 2.3 + seed * 1.3).cos(),
            );
            (fu * u + fv * v + k * k + seed).sin()
        })
        .sum::<f64>()
        / 3.0
}

/// A flame-coloured ellipse with a ragged rim in front of a gray ground, each at its disparity.
#[derive(Clone, Copy)]
struct Scene {
    flame_px: f64,
    ground_px: f64,
    /// Middle and half axes of the flame in the left image.
    flame: (f64, f64, f64, f64),
    noise: f64,
}

const MIDDLE: (f64, f64, f64, f64) = (180.0, 100.0, 22.0, 34.0);

impl Scene {
    fn pair(&self) -> RawPair {
        let mut left =
            Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(0.0)).unwrap();
        let mut right =
            Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC1, Scalar::all(0.0)).unwrap();
        let mut noise = Noise(1);
        for v in 0..HEIGHT {
            for u in 0..WIDTH {
                // A right pixel shows what the left eye sees `disparity` to its right.
                let (seen, other) = (
                    self.colour(f64::from(u), f64::from(v), false),
                    self.colour(f64::from(u), f64::from(v), true),
                );
                let level = |value: f64, noise: &mut Noise| {
                    (value + self.noise * noise.next())
                        .round()
                        .clamp(0.0, 255.0) as u8
                };
                let bgr = seen.map(|value| level(value, &mut noise));
                *left.at_2d_mut::<Vec3b>(v, u).unwrap() = Vec3b::from(bgr);
                let gray = 0.114 * other[0] + 0.587 * other[1] + 0.299 * other[2];
                *right.at_2d_mut::<u8>(v, u).unwrap() = level(gray, &mut noise);
            }
        }
        RawPair {
            at: ServiceTime::from_unix_ns(0),
            left_bgr: left,
            right_gray: Some(right),
        }
    }

    fn colour(&self, u: f64, v: f64, right: bool) -> [f64; 3] {
        let shift = |disparity: f64| if right { u + disparity } else { u };
        let (x, y) = (shift(self.flame_px), v);
        let (middle_u, middle_v, half_u, half_v) = self.flame;
        let rim = 1.0 + 0.12 * texture(x, y, 5.0);
        let reach = ((x - middle_u) / half_u).hypot((y - middle_v) / half_v) / rim;
        // Soft over a pixel, as a lens makes it.
        let cover = ((1.0 - reach) * half_u).clamp(-0.5, 0.5) + 0.5;
        let glow = (1.0 - reach).max(0.0).sqrt() + 0.12 * texture(x, y, 3.0);
        let flame = [40.0 + 60.0 * glow, 110.0 + 110.0 * glow, 245.0];
        let ground = 90.0 + 35.0 * texture(shift(self.ground_px), v, 1.0);
        flame.map(|value| cover * value.min(250.0) + (1.0 - cover) * ground)
    }

    fn target(&self) -> Target {
        let (middle_u, middle_v, half_u, half_v) = self.flame;
        let (reach_u, reach_v) = (half_u * 1.15, half_v * 1.15);
        let box_px = BoxPx {
            x: middle_u - reach_u,
            y: middle_v - reach_v,
            width: 2.0 * reach_u,
            height: 2.0 * reach_v,
        };
        Target {
            class: DetectionClass::Fire,
            box_px,
        }
    }
}

/// Roughly normal, from a congruential generator.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        let mut sum = -6.0;
        for _ in 0..12 {
            self.0 = self
                .0
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            sum += (self.0 >> 11) as f64 / (1_u64 << 53) as f64;
        }
        sum
    }
}

fn ranger(method: Method) -> Box<dyn Ranger> {
    open(method, &rig(), &RangeConfig::default()).unwrap()
}

fn measure(scene: &Scene, method: Method) -> Ranging {
    ranger(method)
        .range(&scene.pair(), &scene.target())
        .unwrap()
}

fn disparity(ranging: Ranging) -> f64 {
    match ranging {
        Ranging::Measured { disparity_px, .. } => disparity_px,
        other => panic!("not measured: {other:?}"),
    }
}

const SCENE: Scene = Scene {
    flame_px: 5.0,
    ground_px: 3.5,
    flame: MIDDLE,
    noise: 2.0,
};

#[test]
fn a_flames_disparity_is_found_at_every_fraction_of_a_pixel() {
    for method in [Method::Sgbm, Method::Correlate] {
        let (mut sum, mut squares) = (0.0, 0.0_f64);
        for step in 0..8 {
            let truth = 4.0 + 0.125 * f64::from(step);
            let found = disparity(measure(
                &Scene {
                    flame_px: truth,
                    ..SCENE
                },
                method,
            ));
            sum += found - truth;
            squares += (found - truth).powi(2);
        }
        let (bias, rms) = (sum / 8.0, (squares / 8.0).sqrt());
        println!("{method:?}: bias {bias:.3} px, rms {rms:.3} px");
        // SGBM pulls towards whole pixels by up to 0.14 px; correlation does not.
        let limit = if method == Method::Sgbm { 0.15 } else { 0.05 };
        assert!(
            rms < limit && bias.abs() < limit,
            "{method:?}: bias {bias}, rms {rms}"
        );
    }
}

/// Checklist E1 (P3 eq. 7 adds the columns) and E2 (P4 eq. 8 subtracts them the other way round):
/// both forms put this fire somewhere else or behind the camera.
#[test]
fn a_point_in_front_has_a_positive_disparity_and_the_printed_forms_fail() {
    let truth_m = FOCAL_PX * BASELINE_M / SCENE.flame_px;
    let Ranging::Measured {
        disparity_px,
        centroid,
        ..
    } = measure(&SCENE, Method::Correlate)
    else {
        panic!("not measured");
    };
    let rig = rig();
    assert!((rig.depth_m(disparity_px).unwrap() - truth_m).abs() < 0.2);
    let (u_left, u_right) = (centroid.u, centroid.u - disparity_px);
    let printed_sum = FOCAL_PX * BASELINE_M / (u_left + u_right);
    let printed_reverse = FOCAL_PX * BASELINE_M / (u_right - u_left);
    assert!(printed_sum < 1.0, "E1 puts a 10 m fire at {printed_sum} m");
    assert!(
        printed_reverse < -9.0,
        "E2 puts it behind the camera at {printed_reverse} m"
    );
}

#[test]
fn every_way_finds_the_flame_and_says_that_it_did() {
    for method in Method::ALL {
        let Ranging::Measured {
            disparity_px,
            sigma_px,
            used,
            ..
        } = measure(&SCENE, method)
        else {
            panic!("{} did not measure", method.name());
        };
        let off = (disparity_px - SCENE.flame_px).abs();
        assert!(
            off < 3.0 * sigma_px && off < 0.4,
            "{}: {disparity_px} +- {sigma_px}",
            method.name()
        );
        let said = match method {
            Method::Best => used.contains(Method::Correlate),
            _ => used == Methods::only(method),
        };
        assert!(said, "{}: {used}", method.name());
    }
}

/// Slanted dark bars at twice the flame's disparity, drawn over both eyes.
fn barred(mut pair: RawPair, disparity_px: f64) -> RawPair {
    let right = pair.right_gray.as_mut().unwrap();
    for v in 0..HEIGHT {
        for u in 0..WIDTH {
            let dark = |u: f64| {
                let bar = |from: f64, slope: f64| (u - from - slope * f64::from(v)).abs() < 2.5;
                bar(120.0, 0.55) || bar(235.0, -0.6) || bar(165.0, 0.3)
            };
            if dark(f64::from(u)) {
                *pair.left_bgr.at_2d_mut::<Vec3b>(v, u).unwrap() = Vec3b::all(20);
            }
            if dark(f64::from(u) + disparity_px) {
                *right.at_2d_mut::<u8>(v, u).unwrap() = 20;
            }
        }
    }
    pair
}

/// Bars are sharper than the flame behind them: whoever compares grey levels without leaving them out
/// follows them.
#[test]
fn branches_before_a_flame_do_not_draw_it_near() {
    for method in [Method::Sgbm, Method::Correlate, Method::Best] {
        for bars_px in [6.5, 8.0, 11.0] {
            let pair = barred(SCENE.pair(), bars_px);
            let found = ranger(method).range(&pair, &SCENE.target()).unwrap();
            let Ranging::Measured {
                disparity_px,
                sigma_px,
                ..
            } = found
            else {
                // Nothing is better than something near, where hardly any of the flame is seen by both eyes.
                assert!(method != Method::Best || bars_px > 10.0, "{found:?}");
                continue;
            };
            let off = disparity_px - SCENE.flame_px;
            println!(
                "{} bars at {bars_px}: {off:+.3} +- {sigma_px:.3} px",
                method.name()
            );
            assert!(
                off.abs() < 3.0 * sigma_px,
                "{}: {off} +- {sigma_px}",
                method.name()
            );
            assert!(
                off < 0.2 * (bars_px - SCENE.flame_px),
                "{}: {off}",
                method.name()
            );
        }
    }
}

/// What a near-infrared eye makes of it: bright where the visible one is dark.
#[test]
fn the_cross_spectral_way_survives_reversed_contrast_and_grey_levels_do_not() {
    let mut pair = SCENE.pair();
    let mut reversed = Mat::default();
    opencv::core::bitwise_not_def(&pair.right_gray.unwrap(), &mut reversed).unwrap();
    pair.right_gray = Some(reversed);
    let range = |method| ranger(method).range(&pair, &SCENE.target()).unwrap();
    assert!(matches!(range(Method::Correlate), Ranging::NoMatch { .. }));
    // Census bits flip as well; only their share tells, and gradients stay.
    let found = range(Method::CrossSpectral);
    if let Ranging::Measured { disparity_px, .. } = found {
        assert!((disparity_px - SCENE.flame_px).abs() < 0.4, "{found:?}");
    }
}

/// A mirror image of the same flame beside it in the right eye alone.
#[test]
fn two_places_that_look_alike_are_refused_by_name() {
    let mut pair = SCENE.pair();
    let right = pair.right_gray.take().unwrap();
    let mut doubled = right.clone();
    for v in 60..140 {
        for u in 140..210 {
            *doubled.at_2d_mut::<u8>(v, u - 70).unwrap() =
                *opencv::prelude::MatTraitConst::at_2d::<u8>(&right, v, u).unwrap();
        }
    }
    pair.right_gray = Some(doubled);
    let found = ranger(Method::Best).range(&pair, &SCENE.target()).unwrap();
    assert_eq!(
        found,
        Ranging::NoMatch {
            why: Refusal::Ambiguous
        }
    );
}

/// The left eye sees two flames alike, the right one only the other: its picture fits ours too, which
/// would put ours near.
#[test]
fn a_partner_that_belongs_to_another_flame_is_no_phantom() {
    let near = |found: &Ranging| matches!(found, Ranging::Measured { disparity_px, .. } if *disparity_px > 20.0);
    let mut pair = SCENE.pair();
    let own = pair.left_bgr.clone();
    for v in 40..160 {
        for u in 140..220 {
            let pixel = *opencv::prelude::MatTraitConst::at_2d::<Vec3b>(&own, v, u).unwrap();
            *pair.left_bgr.at_2d_mut::<Vec3b>(v, u - 90).unwrap() = pixel;
        }
    }
    let mut right = pair.right_gray.take().unwrap();
    let whole = right.clone();
    for v in 40..160 {
        for u in 130..220 {
            let ground = *opencv::prelude::MatTraitConst::at_2d::<u8>(&whole, v, u - 100).unwrap();
            let flame = *opencv::prelude::MatTraitConst::at_2d::<u8>(&whole, v, u).unwrap();
            *right.at_2d_mut::<u8>(v, u - 90).unwrap() = flame;
            *right.at_2d_mut::<u8>(v, u).unwrap() = ground;
        }
    }
    pair.right_gray = Some(right);
    for method in [Method::Correlate, Method::Best] {
        let found = ranger(method).range(&pair, &SCENE.target()).unwrap();
        assert!(!near(&found), "{}: {found:?}", method.name());
    }
}

#[test]
fn a_rigs_inverse_depth_correction_is_applied_once_to_disparities() {
    let plain = rig();
    let text = std::fs::read_to_string(rig_file().path()).unwrap();
    let corrected = emberfix_calib::InverseDepth {
        scale: 0.98,
        offset_per_m: -0.004,
        covariance: [1e-6, 0.0, 1e-8],
    };
    let text = corrected.written_into(&text);
    let other = Rig::parse(&text, Path::new("corrected")).unwrap();
    let depth = |rig: &Rig| {
        let found = open(Method::Correlate, rig, &RangeConfig::default())
            .unwrap()
            .range(&SCENE.pair(), &SCENE.target())
            .unwrap();
        rig.depth_m(disparity(found)).unwrap()
    };
    let (before, after) = (depth(&plain), depth(&other));
    let want = 1.0 / corrected.corrected_per_m(1.0 / before);
    assert!((after - want).abs() < 1e-9, "{before} {after} {want}");
    assert!(after < before, "it read too far");
}

#[test]
fn the_centroid_is_the_flames() {
    let Ranging::Measured {
        centroid, support, ..
    } = measure(&SCENE, Method::Correlate)
    else {
        panic!("not measured");
    };
    // It is the middle of the evidence, and texture is not even: inside the flame, near its middle.
    let (column, row, half_width, half_height) = MIDDLE;
    assert!(
        (centroid.u - column).abs() < half_width / 3.0
            && (centroid.v - row).abs() < half_height / 3.0,
        "{centroid:?}"
    );
    assert!(support > 500, "{support}");
}

#[test]
fn the_stated_sigma_covers_the_error() {
    let mut worst: f64 = 0.0;
    for step in 0..10 {
        let truth = 3.0 + 0.37 * f64::from(step);
        let scene = Scene {
            flame_px: truth,
            ground_px: 2.0,
            noise: 3.0,
            ..SCENE
        };
        let Ranging::Measured {
            disparity_px,
            sigma_px,
            ..
        } = measure(&scene, Method::Correlate)
        else {
            panic!("not measured");
        };
        worst = worst.max((disparity_px - truth).abs() / sigma_px);
    }
    assert!(worst < 3.0, "{worst} sigma");
}

#[test]
fn flames_at_the_borders_of_the_image_are_measured() {
    for (u, v) in [(24.0, 100.0), (335.0, 100.0), (180.0, 34.0), (180.0, 170.0)] {
        let scene = Scene {
            flame: (u, v, 22.0, 34.0),
            ..SCENE
        };
        let found = disparity(measure(&scene, Method::Correlate));
        assert!((found - SCENE.flame_px).abs() < 0.15, "at {u} {v}: {found}");
    }
}

#[test]
fn boxes_beyond_the_image_are_no_match() {
    let pair = SCENE.pair();
    for (x, y) in [(-200.0, 10.0), (400.0, 10.0), (10.0, -90.0), (10.0, 300.0)] {
        let target = Target {
            class: DetectionClass::Fire,
            box_px: BoxPx {
                x,
                y,
                width: 50.0,
                height: 50.0,
            },
        };
        let found = ranger(Method::Sgbm).range(&pair, &target).unwrap();
        assert!(matches!(found, Ranging::NoMatch { .. }));
    }
}

#[test]
fn a_dead_dark_or_flat_right_eye_is_no_match() {
    let mut pair = SCENE.pair();
    for level in [0.0, 80.0, 255.0] {
        let flat =
            Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC1, Scalar::all(level)).unwrap();
        pair.right_gray = Some(flat);
        let found = ranger(Method::Correlate)
            .range(&pair, &SCENE.target())
            .unwrap();
        assert!(matches!(found, Ranging::NoMatch { .. }), "level {level}");
    }
    pair.right_gray = None;
    let found = ranger(Method::Correlate)
        .range(&pair, &SCENE.target())
        .unwrap();
    assert!(matches!(found, Ranging::NoMatch { .. }));
}

/// What matches in smoke is the ground behind it.
#[test]
fn smoke_is_no_match() {
    let target = Target {
        class: DetectionClass::Smoke,
        ..SCENE.target()
    };
    let found = ranger(Method::Correlate)
        .range(&SCENE.pair(), &target)
        .unwrap();
    assert!(matches!(found, Ranging::NoMatch { .. }));
}

#[test]
fn another_scene_in_the_right_eye_is_no_match() {
    let mut pair = SCENE.pair();
    let other = Scene {
        flame: (60.0, 160.0, 10.0, 10.0),
        ground_px: 77.3,
        ..SCENE
    };
    pair.right_gray = other.pair().right_gray;
    for method in [Method::Sgbm, Method::Correlate] {
        let found = ranger(method).range(&pair, &SCENE.target()).unwrap();
        assert!(matches!(found, Ranging::NoMatch { .. }), "{method:?}");
    }
}

#[test]
fn a_flame_too_far_for_the_baseline_is_said_to_be_at_least_so_far() {
    let scene = Scene {
        flame_px: 0.12,
        ground_px: 0.1,
        ..SCENE
    };
    let Ranging::BeyondReach { at_least_m, .. } = measure(&scene, Method::Correlate) else {
        panic!("{:?}", measure(&scene, Method::Correlate));
    };
    let truth_m = FOCAL_PX * BASELINE_M / 0.12;
    assert!(at_least_m > 80.0 && at_least_m < truth_m, "{at_least_m}");
}

#[test]
fn swapped_eyes_are_no_match() {
    let scene = Scene {
        flame_px: -3.0,
        ground_px: -2.0,
        ..SCENE
    };
    let found = measure(&scene, Method::Correlate);
    assert!(matches!(found, Ranging::NoMatch { .. }));
}

#[test]
fn images_that_are_not_the_rigs_are_refused_by_size_and_kind() {
    let mut pair = SCENE.pair();
    pair.right_gray =
        Some(Mat::new_rows_cols_with_default(100, 100, CV_8UC1, Scalar::all(9.0)).unwrap());
    let error = ranger(Method::Sgbm)
        .range(&pair, &SCENE.target())
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "image is 100x100, the rig was calibrated at 360x200"
    );
    pair.right_gray = Some(pair.left_bgr.clone());
    let error = ranger(Method::Sgbm)
        .range(&pair, &SCENE.target())
        .unwrap_err();
    assert!(error.to_string().contains("CV_8UC3"), "{error}");
}

/// Middlebury 2003 `cones`, where the truth is known; the reference settings of OpenCV's matcher
/// reach a mean error of 0.57 px where they give a value.
#[test]
fn the_matcher_reaches_the_reference_figure_on_cones() {
    let folder = shared().join("data/stereo/middlebury2003/cones");
    if !folder.is_dir() {
        eprintln!("skipped: no shared data");
        return;
    }
    let read = |name: &str| {
        opencv::imgcodecs::imread(folder.join(name), opencv::imgcodecs::IMREAD_GRAYSCALE).unwrap()
    };
    let (left, right, truth) = (read("im2.ppm"), read("im6.ppm"), read("disp2.pgm"));
    let (mean, share) =
        sgbm::mean_error_px(&RangeConfig::default(), &left, &right, &truth, 4.0).unwrap();
    println!(
        "cones: mean error {mean:.3} px over {:.0} % of the image",
        share * 100.0
    );
    assert!(mean < 0.75, "mean error {mean} px");
    assert!(share > 0.6, "valid share {share}");
}

fn shared() -> std::path::PathBuf {
    match std::env::var_os("EMBERFIX_SHARED") {
        Some(folder) => folder.into(),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
    }
}
