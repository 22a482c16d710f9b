//! ROS `camera_info` pairs, as `camera_calibration` writes them. A point in the left camera goes to
//! the right one by `R2^T (R1 x + (P2[3] / P2[0], 0, 0))`.

use super::lens::{Lens, Pinhole, camera};
use super::{ImportError, Imported, finite, numbers, read, right_of_left, rotation, stem};
use crate::{Camera, Eye, Rig};
use emberfix_frames::{Matrix3, Vector3};
use serde::Deserialize;
use std::path::{Path, PathBuf};

const FORMAT: &str = "ROS camera_info";

#[derive(Deserialize)]
struct Info {
    image_width: u32,
    image_height: u32,
    camera_name: Option<String>,
    camera_matrix: Data,
    distortion_model: Option<String>,
    distortion_coefficients: Data,
    rectification_matrix: Data,
    projection_matrix: Data,
}

#[derive(Deserialize)]
struct Data {
    data: Vec<f64>,
}

struct Side {
    path: PathBuf,
    name: Option<String>,
    camera: Camera,
    note: Option<String>,
    rectified_from_raw: Matrix3<f64>,
    /// Focal length times minus baseline over focal length: x of the left eye's origin, metres.
    along_m: f64,
}

pub(super) fn import(files: &[PathBuf]) -> Result<Imported, ImportError> {
    let [first, second] = files else {
        return Err(ImportError::Files {
            format: FORMAT,
            needed: "two files, left and right",
            given: files.len(),
        });
    };
    let (first, second) = (side(first)?, side(second)?);
    // The left eye is the origin of both: nothing stands in the fourth column of its P.
    let (left, right) = if first.along_m == 0.0 {
        (first, second)
    } else {
        (second, first)
    };
    if left.along_m != 0.0 || right.along_m == 0.0 {
        return Err(ImportError::Missing {
            path: right.path,
            key: "the baseline, which is the fourth number of projection_matrix over the first,"
                .to_owned(),
            remedy: "calibrate both cameras together (one of the two files has 0 there, the other not)",
        });
    }
    let along = Vector3::new(right.along_m, 0.0, 0.0);
    right_of_left(&right.path, &along)?;
    Ok(Imported {
        name: left.name.unwrap_or_else(|| stem(&left.path)),
        right_from_left: right.rectified_from_raw.transpose() * left.rectified_from_raw,
        translation_m: right.rectified_from_raw.transpose() * along,
        left: left.camera,
        right: right.camera,
        mount: None,
        time_offset_s: None,
        notes: left.note.into_iter().chain(right.note).collect(),
    })
}

fn side(path: &Path) -> Result<Side, ImportError> {
    let info: Info = serde_saphyr::from_str(&read(path)?).map_err(|error| ImportError::Syntax {
        path: path.to_owned(),
        format: FORMAT,
        problem: super::one_line(&error),
    })?;
    let k: [f64; 9] = numbers(path, "camera_matrix", &info.camera_matrix.data, "9")?;
    let r: [f64; 9] = numbers(
        path,
        "rectification_matrix",
        &info.rectification_matrix.data,
        "9",
    )?;
    let p: [f64; 12] = numbers(
        path,
        "projection_matrix",
        &info.projection_matrix.data,
        "12",
    )?;
    let pinhole = Pinhole {
        size: (info.image_width, info.image_height),
        focal_px: (k[0], k[4]),
        principal_point_px: (k[2], k[5]),
    };
    let lens = lens(path, &info)?;
    let (camera, note) = camera(path, "camera_matrix", &pinhole, &lens)?;
    let rectified_from_raw = rotation(path, "rectification_matrix", &Matrix3::from_row_slice(&r))?;
    Ok(Side {
        path: path.to_owned(),
        name: info.camera_name,
        camera,
        note,
        rectified_from_raw,
        along_m: if p[0] == 0.0 { 0.0 } else { p[3] / p[0] },
    })
}

fn lens(path: &Path, info: &Info) -> Result<Lens, ImportError> {
    let key = "distortion_coefficients";
    let terms = &info.distortion_coefficients.data;
    finite(path, key, terms)?;
    match info.distortion_model.as_deref() {
        Some("plumb_bob" | "rational_polynomial") | None => Ok(Lens::Brown(terms.clone())),
        Some("equidistant" | "fisheye") => Ok(Lens::Equidistant(numbers(path, key, terms, "4")?)),
        Some(other) => Err(ImportError::LensModel {
            path: path.to_owned(),
            key: "distortion_model".to_owned(),
            model: other.to_owned(),
            known: "plumb_bob, rational_polynomial, equidistant",
        }),
    }
}

/// A rig as ROS has it: the text of the left and of the right `camera_info` file. The mount has no place
/// in it.
#[must_use]
pub fn export_ros(rig: &Rig) -> (String, String) {
    (info(rig, Eye::Left), info(rig, Eye::Right))
}

fn info(rig: &Rig, eye: Eye) -> String {
    let camera = rig.camera(eye);
    let rectification = rig.rectification();
    let (name, along) = match eye {
        Eye::Left => ("left", 0.0),
        Eye::Right => ("right", -rectification.focal_px() * rig.baseline_m()),
    };
    let ((fx, fy), (cx, cy)) = (camera.focal_px, camera.principal_point_px);
    let projection = rectification.projection(eye);
    let p = |row: usize, column: usize| projection[(row, column)];
    let turn = rectification.rectified_from_raw(eye);
    let r: Vec<f64> = turn.transpose().iter().copied().collect();
    format!(
        "image_width: {}\nimage_height: {}\ncamera_name: {}\n{}distortion_model: plumb_bob\n{}{}{}",
        camera.image_size_px.0,
        camera.image_size_px.1,
        serde_json::Value::from(format!("{}/{name}", rig.name())),
        matrix(
            "camera_matrix",
            3,
            3,
            &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        ),
        matrix("distortion_coefficients", 1, 5, &camera.distortion),
        matrix("rectification_matrix", 3, 3, &r),
        matrix(
            "projection_matrix",
            3,
            4,
            &[
                p(0, 0),
                0.0,
                p(0, 2),
                along, //
                0.0,
                p(1, 1),
                p(1, 2),
                0.0, //
                0.0,
                0.0,
                1.0,
                0.0,
            ]
        ),
    )
}

fn matrix(key: &str, rows: usize, columns: usize, values: &[f64]) -> String {
    let values: Vec<String> = values.iter().map(|value| format!("{value:?}")).collect();
    format!(
        "{key}:\n  rows: {rows}\n  cols: {columns}\n  data: [{}]\n",
        values.join(", ")
    )
}
