//! Files of other programs: round trips lose nothing, broken ones are refused in one line.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

use emberfix_calib::exchange::{
    Answers, Imported, ImuAxes, LengthUnit, export_opencv, export_ros, import,
};
use emberfix_calib::{Eye, Rig};
use emberfix_frames::Matrix3;
use std::path::{Path, PathBuf};

fn rig() -> Rig {
    Rig::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/oakd-75mm.toml")).unwrap()
}

fn written(folder: &tempfile::TempDir, name: &str, text: &str) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, text).unwrap();
    path
}

/// The format holds everything but the mount; `to` is what its way of writing rotations costs.
fn assert_same(found: &Imported, rig: &Rig, to: f64) {
    for (found, eye) in [(&found.left, Eye::Left), (&found.right, Eye::Right)] {
        let truth = rig.camera(eye);
        assert_eq!(found.image_size_px, truth.image_size_px);
        assert_eq!(found.focal_px, truth.focal_px, "every bit");
        assert_eq!(found.principal_point_px, truth.principal_point_px);
        assert_eq!(found.distortion, truth.distortion);
    }
    let turned = (found.right_from_left - rig.right_from_left()).norm();
    let moved = (found.translation_m - rig.right_from_left_translation_m()).norm();
    assert!(turned < to && moved < to, "{turned} {moved}");
    assert_eq!(found.mount, None, "nothing is assumed");
}

#[test]
fn ros_there_and_back_is_the_same_rig_in_either_order() {
    let folder = tempfile::tempdir().unwrap();
    let (left, right) = export_ros(&rig());
    let left = written(&folder, "left.yaml", &left);
    let right = written(&folder, "right.yaml", &right);
    for files in [[left.clone(), right.clone()], [right, left]] {
        // R and T come out of R1, R2 and P: products of rotations, good to rounding.
        assert_same(&import(&files, Answers::default()).unwrap(), &rig(), 1e-12);
    }
}

#[test]
fn opencv_there_and_back_is_the_same_rig() {
    for (xml, name) in [(false, "rig.yml"), (true, "rig.xml")] {
        let folder = tempfile::tempdir().unwrap();
        let text = export_opencv(&rig(), xml).unwrap();
        let file = written(&folder, name, &text);
        assert_same(&import(&[file], Answers::default()).unwrap(), &rig(), 1e-12);
    }
}

const KALIBR: &str = "\
cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.037]
  - [-0.5, 0.0, 0.8660254037844386, 0.008038475772933]
  - [0.8660254037844386, 0.0, 0.5, -0.133923048454133]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.7e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -0.0125
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0004]
  - [0.0, 0.0, 1.0, -0.0006]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.27, 0.06, 0.0001, 2.0e-05]
  distortion_model: radtan
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  resolution: [752, 480]
";

fn frd() -> Answers {
    Answers {
        imu_axes: Some(ImuAxes::Frd),
        ..Answers::default()
    }
}

#[test]
fn kalibr_brings_the_mount_and_the_time_shift() {
    let folder = tempfile::tempdir().unwrap();
    let file = written(&folder, "camchain-imucam.yaml", KALIBR);
    let found = import(&[file], frd()).unwrap();
    assert_eq!(found.left.focal_px, (458.6, 457.3));
    assert_eq!(found.right.distortion, [-0.27, 0.06, 0.0001, 2.0e-05, 0.0]);
    assert_eq!(found.translation_m.as_slice(), [-0.11, 0.0004, -0.0006]);
    assert_eq!(found.right_from_left, Matrix3::identity());
    assert_eq!(found.time_offset_s, Some(-0.0125));
    let (angles, arm) = found.mount.unwrap();
    // The shipped rig's mount: 30 degrees down, and its lever arm.
    assert!(
        (angles.depression_rad.to_degrees() - 30.0).abs() < 1e-9,
        "{angles:?}"
    );
    assert!(angles.yaw_rad.abs() < 1e-9 && angles.roll_rad.abs() < 1e-9);
    assert!(
        (arm - emberfix_frames::Vector3::new(0.12, -0.037, 0.06)).norm() < 1e-9,
        "{arm}"
    );
}

#[test]
fn the_same_camera_on_an_imu_with_ros_axes_has_the_same_mount() {
    let folder = tempfile::tempdir().unwrap();
    let flu = KALIBR
        .replace("[0.0, 1.0, 0.0, 0.037]", "[0.0, -1.0, 0.0, 0.037]")
        .replace(
            "[-0.5, 0.0, 0.8660254037844386, 0.0",
            "[-0.5, 0.0, -0.8660254037844386, 0.0",
        )
        .replace(
            "[0.8660254037844386, 0.0, 0.5, -",
            "[0.8660254037844386, 0.0, -0.5, -",
        );
    let answers = Answers {
        imu_axes: Some(ImuAxes::Flu),
        ..Answers::default()
    };
    let found = import(&[written(&folder, "flu.yaml", &flu)], answers).unwrap();
    let (angles, arm) = found.mount.unwrap();
    assert!(
        (angles.depression_rad.to_degrees() - 30.0).abs() < 1e-9,
        "{angles:?}"
    );
    assert!(
        (arm - emberfix_frames::Vector3::new(0.12, -0.037, 0.06)).norm() < 1e-9,
        "{arm}"
    );
}

const DEPTHAI: &str = r#"{
  "batchName": "", "boardName": "BW1098OBC", "boardRev": "R0M0E0", "version": 7,
  "cameraData": [
    [0, {"cameraType": 0, "width": 1920, "height": 1080, "lensPosition": 135, "specHfovDeg": 68.8,
      "intrinsicMatrix": [[1480.0, 0.0, 960.0], [0.0, 1480.0, 540.0], [0.0, 0.0, 1.0]],
      "distortionCoeff": [0.1, -0.2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
      "extrinsics": {"rotationMatrix": [], "specTranslation": {"x": 0, "y": 0, "z": 0},
        "toCameraSocket": -1, "translation": {"x": 0, "y": 0, "z": 0}}}],
    [1, {"cameraType": 0, "width": 1280, "height": 800, "lensPosition": 0, "specHfovDeg": 71.9,
      "intrinsicMatrix": [[800.5, 0.0, 640.5], [0.0, 800.25, 401.5], [0.0, 0.0, 1.0]],
      "distortionCoeff": [0.05, -0.02, 0.0001, 0.0002, 0.003, 0, 0, 0, 0, 0, 0, 0, 0, 0],
      "extrinsics": {"rotationMatrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "specTranslation": {"x": -7.5, "y": 0, "z": 0}, "toCameraSocket": 2,
        "translation": {"x": -7.52, "y": 0.01, "z": -0.02}}}],
    [2, {"cameraType": 0, "width": 1280, "height": 800, "lensPosition": 0, "specHfovDeg": 71.9,
      "intrinsicMatrix": [[801.5, 0.0, 638.5], [0.0, 801.25, 399.5], [0.0, 0.0, 1.0]],
      "distortionCoeff": [0.06, -0.03, 0.0003, 0.0001, 0.004, 0, 0, 0, 0, 0, 0, 0, 0, 0],
      "extrinsics": {"rotationMatrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "specTranslation": {"x": 3.75, "y": 0, "z": 0}, "toCameraSocket": 0,
        "translation": {"x": 3.75, "y": 0, "z": 0}}}]
  ],
  "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2,
    "rectifiedRotationLeft": [], "rectifiedRotationRight": []}
}"#;

#[test]
fn depthai_is_in_centimetres() {
    let folder = tempfile::tempdir().unwrap();
    let file = written(&folder, "eeprom.json", DEPTHAI);
    let found = import(&[file], Answers::default()).unwrap();
    assert_eq!(found.name, "BW1098OBC");
    assert!((found.translation_m.norm() - 0.0752).abs() < 1e-6);
    assert_eq!(found.left.image_size_px, (1280, 800));
    assert_eq!(found.right.distortion, [0.06, -0.03, 0.0003, 0.0001, 0.004]);
    assert_eq!(found.mount, None);
}

#[test]
fn a_chain_of_sockets_is_followed_backwards_too() {
    // Only the right camera says how it stands to the left one.
    let turned = DEPTHAI
        .replace("\"toCameraSocket\": 2", "\"toCameraSocket\": -1")
        .replace("\"toCameraSocket\": 0", "\"toCameraSocket\": 1")
        .replace(
            "\"translation\": {\"x\": 3.75",
            "\"translation\": {\"x\": 7.5",
        );
    let folder = tempfile::tempdir().unwrap();
    let found = import(&[written(&folder, "e.json", &turned)], Answers::default()).unwrap();
    assert!(
        (found.translation_m.x + 0.075).abs() < 1e-9,
        "{}",
        found.translation_m
    );
}

fn opencv_text() -> String {
    export_opencv(&rig(), false).unwrap()
}

/// What is broken, its file, and the words that the refusal must have.
fn broken() -> Vec<(&'static str, String, &'static str)> {
    let kalibr = |from: &str, to: &str| {
        assert!(KALIBR.contains(from), "{from}");
        KALIBR.replacen(from, to, 1)
    };
    let depthai = |from: &str, to: &str| {
        assert!(DEPTHAI.contains(from), "{from}");
        DEPTHAI.replacen(from, to, 1)
    };
    let opencv = |from: &str, to: &str| {
        assert!(opencv_text().contains(from), "{from}");
        opencv_text().replacen(from, to, 1)
    };
    vec![
        ("empty.yaml", String::new(), "neither a Kalibr"),
        (
            "photo.yaml",
            "\u{1}\u{2}JFIF".to_owned(),
            "neither a Kalibr",
        ),
        ("cut.yaml", KALIBR[..700].to_owned(), "cam"),
        (
            "tab.yaml",
            kalibr("  T_cn", "\t T_cn"),
            "not readable as Kalibr",
        ),
        (
            "one.yaml",
            KALIBR[..KALIBR.find("cam1:").unwrap()].to_owned(),
            "cam1 is missing",
        ),
        (
            "apart.yaml",
            kalibr("T_cn_cnm1", "T_nothing"),
            "T_cn_cnm1 is missing",
        ),
        ("swapped.yaml", kalibr("-0.11]", "0.11]"), "swapped"),
        (
            "mirrored.yaml",
            kalibr("[0.0, 0.0, 1.0, -0.0006]", "[0.0, 0.0, -1.0, -0.0006]"),
            "left-handed",
        ),
        (
            "left-handed-mount.yaml",
            kalibr("[0.0, 1.0, 0.0, 0.037]", "[0.0, -1.0, 0.0, 0.037]"),
            "left-handed",
        ),
        (
            "sheared.yaml",
            kalibr("[0.0, 1.0, 0.0, 0.0004]", "[0.2, 1.0, 0.0, 0.0004]"),
            "no rotation",
        ),
        (
            "three.yaml",
            kalibr("[458.6, 457.3, 367.2, 248.4]", "[458.6, 457.3, 367.2]"),
            "has 3 numbers, needed are 4",
        ),
        ("nan.yaml", kalibr("458.6", ".nan"), "not finite"),
        (
            "omni.yaml",
            kalibr("camera_model: pinhole", "camera_model: omni"),
            "\"omni\" is unknown",
        ),
        (
            "fisheye.yaml",
            kalibr("radtan", "equidistant").replace("458.6, 457.3", "200.0, 200.0"),
            "missed by",
        ),
        (
            "cut.json",
            DEPTHAI[..900].to_owned(),
            "not readable as DepthAI",
        ),
        (
            "uncalibrated.json",
            depthai("[2, {", "[5, {"),
            "socket 2 is missing",
        ),
        (
            "island.json",
            depthai("\"toCameraSocket\": 2", "\"toCameraSocket\": -1")
                .replace("\"toCameraSocket\": 0", "\"toCameraSocket\": -1"),
            "chain of extrinsics",
        ),
        (
            "tilted.json",
            depthai(
                "0, 0, 0, 0, 0, 0, 0, 0, 0],\n      \"extrinsics\": {\"rotationMatrix\": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],\n        \"specTranslation\": {\"x\": -7.5",
                "0, 0, 0, 0, 0, 0, 0, 0.1, 0],\n      \"extrinsics\": {\"rotationMatrix\": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],\n        \"specTranslation\": {\"x\": -7.5",
            ),
            "without tilt",
        ),
        ("cut.yml", opencv_text()[..400].to_owned(), "OpenCV"),
        ("no-t.yml", opencv("\nT:", "\nTT:"), "T is missing"),
        (
            "unitless.yml",
            opencv("translation_unit", "other"),
            "--translation-unit",
        ),
        (
            "sizeless.yml",
            opencv("image_width", "breadth"),
            "--image-size",
        ),
    ]
}

#[test]
fn broken_files_are_refused_in_one_line_that_helps() {
    let folder = tempfile::tempdir().unwrap();
    assert!(broken().len() >= 20);
    for (name, text, words) in broken() {
        let file = written(&folder, name, &text);
        let message = match import(&[file], frd()) {
            Ok(found) => panic!("{name} was accepted: {found:?}"),
            Err(error) => error.to_string(),
        };
        println!(
            "{}",
            message.replace(&folder.path().display().to_string(), "")
        );
        assert!(message.contains(words), "{name}: {message}");
        assert!(message.contains(name), "{message}");
        assert!(!message.contains('\n') && message.len() < 400, "{message}");
    }
}

#[test]
fn what_a_file_does_not_say_is_asked_for_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let file = written(&folder, "chain.yaml", KALIBR);
    let message = import(&[file], Answers::default()).unwrap_err().to_string();
    assert!(message.contains("--imu-axes frd"), "{message}");
    let unitless = opencv_text().replacen("translation_unit", "other", 1);
    let millimetres = Answers {
        translation_unit: Some(LengthUnit::Millimetre),
        ..Answers::default()
    };
    let found = import(&[written(&folder, "mm.yml", &unitless)], millimetres).unwrap();
    assert!(
        (found.translation_m.norm() - 0.000_075).abs() < 1e-7,
        "{}",
        found.translation_m
    );
}

#[test]
fn a_ros_pair_without_a_baseline_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (left, right) = export_ros(&rig());
    let left = written(&folder, "left.yaml", &left);
    let message = import(&[left.clone(), left.clone()], Answers::default()).unwrap_err();
    assert!(message.to_string().contains("baseline"), "{message}");
    let alone = import(std::slice::from_ref(&left), Answers::default()).unwrap_err();
    assert!(alone.to_string().contains("two files"), "{alone}");
    // Left and right exchanged while calibrating: the baseline has the other sign.
    let along = right.split("projection_matrix").nth(1).unwrap();
    let number = along
        .split("data: [")
        .nth(1)
        .unwrap()
        .split(", ")
        .nth(3)
        .unwrap();
    let other = number.trim_start_matches('-');
    let swapped = written(&folder, "right.yaml", &right.replace(number, other));
    let message = import(&[left, swapped], Answers::default())
        .unwrap_err()
        .to_string();
    assert!(message.contains("swapped"), "{message}");
}
