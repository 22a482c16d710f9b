//! Kalibr's `camchain.yaml` and `camchain-imucam.yaml`: `T_cn_cnm1` takes the camera before to this
//! one, `T_cam_imu` the IMU to the camera, `timeshift_cam_imu` is IMU time minus camera time.

use super::lens::{Lens, Pinhole, camera};
use super::{Answers, ImportError, Imported, ImuAxes, numbers, right_of_left, rotation, stem};
use crate::{Camera, mount_angles};
use emberfix_frames::{Matrix3, MountAngles, Vector3};
use serde::Deserialize;
use std::path::Path;

const FORMAT: &str = "Kalibr camchain";

#[derive(Deserialize)]
struct Chain {
    cam0: Option<Entry>,
    cam1: Option<Entry>,
}

#[derive(Deserialize)]
struct Entry {
    camera_model: Option<String>,
    intrinsics: Vec<f64>,
    distortion_model: Option<String>,
    #[serde(default)]
    distortion_coeffs: Vec<f64>,
    resolution: Vec<u32>,
    #[serde(rename = "T_cn_cnm1")]
    from_previous: Option<Vec<Vec<f64>>>,
    #[serde(rename = "T_cam_imu")]
    from_imu: Option<Vec<Vec<f64>>>,
    timeshift_cam_imu: Option<f64>,
}

pub(super) fn import(path: &Path, text: &str, answers: Answers) -> Result<Imported, ImportError> {
    let chain: Chain = serde_saphyr::from_str(text).map_err(|error| ImportError::Syntax {
        path: path.to_owned(),
        format: FORMAT,
        problem: super::one_line(&error),
    })?;
    let missing = |key: &str, remedy| ImportError::Missing {
        path: path.to_owned(),
        key: key.to_owned(),
        remedy,
    };
    let pair = "a stereo rig needs both cameras in one chain";
    let first = chain.cam0.ok_or_else(|| missing("cam0", pair))?;
    let second = chain.cam1.ok_or_else(|| missing("cam1", pair))?;
    let between = second.from_previous.as_ref().ok_or_else(|| {
        missing(
            "cam1.T_cn_cnm1",
            "calibrate both cameras together, so that Kalibr writes it",
        )
    })?;
    let (right_from_left, translation_m) = transform(path, "cam1.T_cn_cnm1", between)?;
    right_of_left(path, &translation_m)?;
    let (left, left_note) = eye(path, "cam0", &first)?;
    let (right, right_note) = eye(path, "cam1", &second)?;
    Ok(Imported {
        name: stem(path),
        left,
        right,
        right_from_left,
        translation_m,
        mount: mount(path, &first, answers)?,
        time_offset_s: first.timeshift_cam_imu,
        notes: left_note.into_iter().chain(right_note).collect(),
    })
}

fn eye(path: &Path, key: &str, entry: &Entry) -> Result<(Camera, Option<String>), ImportError> {
    let unknown = |model: &str, known| ImportError::LensModel {
        path: path.to_owned(),
        key: key.to_owned(),
        model: model.to_owned(),
        known,
    };
    if let Some(model) = entry
        .camera_model
        .as_deref()
        .filter(|model| *model != "pinhole")
    {
        return Err(unknown(model, "pinhole"));
    }
    let [fx, fy, cx, cy] = numbers(path, &format!("{key}.intrinsics"), &entry.intrinsics, "4")?;
    let &[width, height] = entry.resolution.as_slice() else {
        return Err(ImportError::Count {
            path: path.to_owned(),
            key: format!("{key}.resolution"),
            found: entry.resolution.len(),
            needed: "2",
        });
    };
    let terms_key = format!("{key}.distortion_coeffs");
    let lens = match entry.distortion_model.as_deref() {
        Some("radtan" | "plumb_bob") => {
            let terms: [f64; 4] = numbers(path, &terms_key, &entry.distortion_coeffs, "4")?;
            Lens::Brown(terms.to_vec())
        }
        Some("equidistant" | "equi") => {
            Lens::Equidistant(numbers(path, &terms_key, &entry.distortion_coeffs, "4")?)
        }
        Some("none") | None => Lens::Brown(Vec::new()),
        Some(other) => return Err(unknown(other, "radtan, equidistant, none")),
    };
    let pinhole = Pinhole {
        size: (width, height),
        focal_px: (fx, fy),
        principal_point_px: (cx, cy),
    };
    camera(path, key, &pinhole, &lens)
}

fn transform(
    path: &Path,
    key: &str,
    rows: &[Vec<f64>],
) -> Result<(Matrix3<f64>, Vector3<f64>), ImportError> {
    let flat: Vec<f64> = rows.iter().flatten().copied().collect();
    let flat: [f64; 16] = numbers(path, key, &flat, "16 (4 rows of 4)")?;
    let row = |index: usize| [flat[4 * index], flat[4 * index + 1], flat[4 * index + 2]];
    let matrix = Matrix3::from_row_slice(&[row(0), row(1), row(2)].concat());
    let translation_m = Vector3::new(flat[3], flat[7], flat[11]);
    Ok((rotation(path, key, &matrix)?, translation_m))
}

/// The body's origin is the autopilot's IMU: Kalibr's mount is ours once its IMU's axes are known.
fn mount(
    path: &Path,
    entry: &Entry,
    answers: Answers,
) -> Result<Option<(MountAngles, Vector3<f64>)>, ImportError> {
    let Some(rows) = &entry.from_imu else {
        return Ok(None);
    };
    let (camera_from_imu, imu_in_camera_m) = transform(path, "cam0.T_cam_imu", rows)?;
    let axes = answers.imu_axes.ok_or_else(|| ImportError::Asked {
        path: path.to_owned(),
        what: "how the axes of the IMU in T_cam_imu lie (it must be the autopilot's)",
        flag: "--imu-axes frd (PX4) or --imu-axes flu (ROS)",
    })?;
    let body_from_imu = match axes {
        ImuAxes::Frd => Matrix3::identity(),
        ImuAxes::Flu => Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)),
    };
    let body_from_camera = body_from_imu * camera_from_imu.transpose();
    let lever_arm_m = -(body_from_camera * imu_in_camera_m);
    Ok(Some((mount_angles(&body_from_camera), lever_arm_m)))
}
