//! DepthAI's EEPROM as JSON: cameras by socket, translations in centimetres, extrinsics that take this
//! camera's components to those of `toCameraSocket`.

use super::lens::{Lens, Pinhole, camera};
use super::{ImportError, Imported, numbers, right_of_left, rotation, stem};
use crate::Camera;
use emberfix_frames::{Matrix3, Vector3};
use serde::Deserialize;
use std::path::Path;

const FORMAT: &str = "DepthAI EEPROM";
/// Sockets of the stereo pair where the file does not say: CAM_B and CAM_C.
const LEFT_SOCKET: i64 = 1;
const RIGHT_SOCKET: i64 = 2;
const M_PER_CM: f64 = 0.01;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Eeprom {
    #[serde(default)]
    board_name: String,
    camera_data: Vec<(i64, Entry)>,
    stereo_rectification_data: Option<Sockets>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Sockets {
    left_camera_socket: i64,
    right_camera_socket: i64,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Entry {
    #[serde(default)]
    camera_type: i64,
    width: u32,
    height: u32,
    intrinsic_matrix: Vec<Vec<f64>>,
    distortion_coeff: Vec<f64>,
    extrinsics: Extrinsics,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Extrinsics {
    rotation_matrix: Vec<Vec<f64>>,
    translation: Translation,
    to_camera_socket: i64,
}

#[derive(Deserialize)]
struct Translation {
    x: f64,
    y: f64,
    z: f64,
}

/// Takes one camera's components to another's: `x' = turn x + move_m`.
#[derive(Clone, Copy)]
struct Step {
    turn: Matrix3<f64>,
    move_m: Vector3<f64>,
}

impl Step {
    const NONE: Self = Self {
        turn: Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        move_m: Vector3::new(0.0, 0.0, 0.0),
    };

    fn then(self, next: Self) -> Self {
        Self {
            turn: next.turn * self.turn,
            move_m: next.turn * self.move_m + next.move_m,
        }
    }

    fn inverse(self) -> Self {
        let turn = self.turn.transpose();
        Self {
            turn,
            move_m: -(turn * self.move_m),
        }
    }
}

pub(super) fn import(path: &Path, text: &str) -> Result<Imported, ImportError> {
    let eeprom: Eeprom = serde_json::from_str(text).map_err(|error| ImportError::Syntax {
        path: path.to_owned(),
        format: FORMAT,
        problem: error.to_string(),
    })?;
    let (left_socket, right_socket) = match &eeprom.stereo_rectification_data {
        Some(said) if said.left_camera_socket >= 0 && said.right_camera_socket >= 0 => {
            (said.left_camera_socket, said.right_camera_socket)
        }
        _ => (LEFT_SOCKET, RIGHT_SOCKET),
    };
    let (left, left_note) = eye(path, &eeprom, left_socket)?;
    let (right, right_note) = eye(path, &eeprom, right_socket)?;
    let between = between(path, &eeprom, left_socket, right_socket)?;
    right_of_left(path, &between.move_m)?;
    let named = !eeprom.board_name.is_empty();
    Ok(Imported {
        name: if named { eeprom.board_name } else { stem(path) },
        left,
        right,
        right_from_left: between.turn,
        translation_m: between.move_m,
        mount: None,
        time_offset_s: None,
        notes: left_note.into_iter().chain(right_note).collect(),
    })
}

fn entry<'a>(path: &Path, eeprom: &'a Eeprom, socket: i64) -> Result<&'a Entry, ImportError> {
    let found = eeprom.camera_data.iter().find(|(at, _)| *at == socket);
    found
        .map(|(_, entry)| entry)
        .ok_or_else(|| ImportError::Missing {
            path: path.to_owned(),
            key: format!("cameraData of socket {socket}"),
            remedy: "the device's stereo pair must be calibrated",
        })
}

fn eye(path: &Path, eeprom: &Eeprom, socket: i64) -> Result<(Camera, Option<String>), ImportError> {
    let entry = entry(path, eeprom, socket)?;
    let key = format!("cameraData[{socket}]");
    let flat: Vec<f64> = entry.intrinsic_matrix.iter().flatten().copied().collect();
    let k: [f64; 9] = numbers(path, &format!("{key}.intrinsicMatrix"), &flat, "9")?;
    super::finite(
        path,
        &format!("{key}.distortionCoeff"),
        &entry.distortion_coeff,
    )?;
    let terms = &entry.distortion_coeff;
    let lens = match entry.camera_type {
        0 if terms.iter().skip(12).all(|tilt| *tilt == 0.0) => Lens::Brown(terms.clone()),
        1 => Lens::Equidistant(numbers(
            path,
            &format!("{key}.distortionCoeff"),
            terms.get(..4).unwrap_or(terms),
            "4 or more",
        )?),
        other => {
            return Err(ImportError::LensModel {
                path: path.to_owned(),
                key,
                model: format!("cameraType {other}, {} terms", terms.len()),
                known: "0 (perspective, without tilt), 1 (fisheye)",
            });
        }
    };
    let pinhole = Pinhole {
        size: (entry.width, entry.height),
        focal_px: (k[0], k[4]),
        principal_point_px: (k[2], k[5]),
    };
    camera(path, &key, &pinhole, &lens)
}

/// The way from the left camera to the right one, along the chain in either direction.
fn between(path: &Path, eeprom: &Eeprom, left: i64, right: i64) -> Result<Step, ImportError> {
    if let Some(step) = follow(path, eeprom, left, right)? {
        return Ok(step);
    }
    if let Some(step) = follow(path, eeprom, right, left)? {
        return Ok(step.inverse());
    }
    Err(ImportError::Missing {
        path: path.to_owned(),
        key: format!("a chain of extrinsics between sockets {left} and {right}"),
        remedy: "calibrate the device again",
    })
}

fn follow(path: &Path, eeprom: &Eeprom, from: i64, to: i64) -> Result<Option<Step>, ImportError> {
    let (mut at, mut way) = (from, Step::NONE);
    for _ in 0..eeprom.camera_data.len() {
        let Some((_, here)) = eeprom.camera_data.iter().find(|(socket, _)| *socket == at) else {
            return Ok(None);
        };
        if here.extrinsics.to_camera_socket < 0 {
            return Ok(None);
        }
        way = way.then(step(path, at, &here.extrinsics)?);
        at = here.extrinsics.to_camera_socket;
        if at == to {
            return Ok(Some(way));
        }
    }
    Ok(None)
}

fn step(path: &Path, socket: i64, extrinsics: &Extrinsics) -> Result<Step, ImportError> {
    let key = format!("cameraData[{socket}].extrinsics");
    let flat: Vec<f64> = extrinsics
        .rotation_matrix
        .iter()
        .flatten()
        .copied()
        .collect();
    let flat: [f64; 9] = numbers(path, &format!("{key}.rotationMatrix"), &flat, "9")?;
    let Translation { x, y, z } = extrinsics.translation;
    super::finite(path, &format!("{key}.translation"), &[x, y, z])?;
    Ok(Step {
        turn: rotation(
            path,
            &format!("{key}.rotationMatrix"),
            &Matrix3::from_row_slice(&flat),
        )?,
        move_m: Vector3::new(x, y, z) * M_PER_CM,
    })
}
