//! OpenCV FileStorage, YAML or XML, with the names of OpenCV's own stereo samples and their relatives.
//! Neither the unit of T nor, often, the image size stands in it: both are asked for.

use super::lens::{Lens, Pinhole, camera};
use super::{
    Answers, ImportError, Imported, LengthUnit, finite, numbers, right_of_left, rotation, stem,
};
use crate::{Eye, Rig};
use emberfix_frames::{Matrix3, Vector3};
use opencv::core::{
    CV_64F, FileStorage, FileStorage_BASE64, FileStorage_FORMAT_XML, FileStorage_FORMAT_YAML,
    FileStorage_MEMORY, FileStorage_READ, FileStorage_WRITE, Mat,
};
use opencv::prelude::{
    FileNodeTraitConst, FileStorageTrait, FileStorageTraitConst, MatTraitConst, MatTraitConstManual,
};
use std::path::{Path, PathBuf};

const FORMAT: &str = "OpenCV FileStorage";

const LEFT_K: &[&str] = &[
    "M1",
    "K1",
    "cameraMatrix1",
    "camera_matrix_left",
    "left_K",
    "CM1",
    "K_left",
];
const RIGHT_K: &[&str] = &[
    "M2",
    "K2",
    "cameraMatrix2",
    "camera_matrix_right",
    "right_K",
    "CM2",
    "K_right",
];
const LEFT_D: &[&str] = &["D1", "distCoeffs1", "dist_coeffs_left", "left_D", "D_left"];
const RIGHT_D: &[&str] = &[
    "D2",
    "distCoeffs2",
    "dist_coeffs_right",
    "right_D",
    "D_right",
];
const WIDTH: &[&str] = &["image_width", "image_Width", "width", "imageWidth"];
const HEIGHT: &[&str] = &["image_height", "image_Height", "height", "imageHeight"];

/// Files of one rig, looked through together (the samples write intrinsics and extrinsics apart).
struct Stores<'a> {
    files: &'a [PathBuf],
    stores: Vec<FileStorage>,
}

pub(super) fn import(files: &[PathBuf], answers: Answers) -> Result<Imported, ImportError> {
    let mut stores = Vec::new();
    for path in files {
        stores.push(open(path)?);
    }
    let stores = Stores { files, stores };
    let size = match (stores.whole(WIDTH)?, stores.whole(HEIGHT)?) {
        (Some(width), Some(height)) => (width, height),
        _ => answers.image_size_px.ok_or_else(|| ImportError::Asked {
            path: stores.path(),
            what: "how large its images are",
            flag: "--image-size 1280x720",
        })?,
    };
    let (left, left_note) = stores.eye(LEFT_K, LEFT_D, size)?;
    let (right, right_note) = stores.eye(RIGHT_K, RIGHT_D, size)?;
    let r: [f64; 9] = numbers(&stores.path(), "R", &stores.matrix(&["R"])?, "9")?;
    let t: [f64; 3] = numbers(&stores.path(), "T", &stores.matrix(&["T"])?, "3")?;
    let unit = stores.unit(answers)?;
    let translation_m = Vector3::from(t) * unit.in_m();
    right_of_left(&stores.path(), &translation_m)?;
    Ok(Imported {
        name: stem(&stores.path()),
        left,
        right,
        right_from_left: rotation(&stores.path(), "R", &Matrix3::from_row_slice(&r))?,
        translation_m,
        mount: None,
        time_offset_s: None,
        notes: left_note.into_iter().chain(right_note).collect(),
    })
}

fn open(path: &Path) -> Result<FileStorage, ImportError> {
    // Read by us: OpenCV's own messages about files it can't open go to the terminal.
    let text = super::read(path)?;
    let syntax = |error: opencv::Error| ImportError::Syntax {
        path: path.to_owned(),
        format: FORMAT,
        problem: what_it_said(&error),
    };
    let store =
        FileStorage::new(&text, FileStorage_READ | FileStorage_MEMORY, "").map_err(syntax)?;
    if store.is_opened().map_err(syntax)? {
        return Ok(store);
    }
    Err(ImportError::Syntax {
        path: path.to_owned(),
        format: FORMAT,
        problem: "it holds nothing".to_owned(),
    })
}

/// The end of OpenCV's message: before it stand its version, its source file and its function.
fn what_it_said(error: &opencv::Error) -> String {
    let message = error.message.replace('\n', " ");
    let said = message.rsplit("in function").next().unwrap_or_default();
    format!(
        "line {}",
        said.trim_matches([' ', '\'', '(']).replacen("):", ":", 1)
    )
}

impl Stores<'_> {
    fn path(&self) -> PathBuf {
        self.files.first().cloned().unwrap_or_default()
    }

    fn failed(&self, source: opencv::Error) -> ImportError {
        ImportError::OpenCv {
            path: self.path(),
            source,
        }
    }

    fn node(&self, names: &[&str]) -> Result<Option<opencv::core::FileNode>, ImportError> {
        for store in &self.stores {
            for name in names {
                let node = store.get_node(name).map_err(|error| self.failed(error))?;
                if !node.empty().map_err(|error| self.failed(error))? {
                    return Ok(Some(node));
                }
            }
        }
        Ok(None)
    }

    fn needed(&self, names: &[&str]) -> Result<opencv::core::FileNode, ImportError> {
        self.node(names)?.ok_or_else(|| ImportError::Missing {
            path: self.path(),
            key: names.join(" or "),
            remedy: "give all files of the rig at once, or rename what it is called there",
        })
    }

    fn matrix(&self, names: &[&str]) -> Result<Vec<f64>, ImportError> {
        let mat = self
            .needed(names)?
            .mat()
            .map_err(|error| self.failed(error))?;
        let mut doubles = Mat::default();
        mat.convert_to(&mut doubles, CV_64F, 1.0, 0.0)
            .map_err(|error| self.failed(error))?;
        let values = doubles
            .data_typed::<f64>()
            .map_err(|error| self.failed(error))?;
        Ok(values.to_vec())
    }

    fn whole(&self, names: &[&str]) -> Result<Option<u32>, ImportError> {
        let Some(node) = self.node(names)? else {
            return Ok(None);
        };
        let value = node.real().map_err(|error| self.failed(error))?;
        Ok((value >= 1.0 && value <= f64::from(u16::MAX)).then_some(value as u32))
    }

    fn unit(&self, answers: Answers) -> Result<LengthUnit, ImportError> {
        let said = match self.node(&["translation_unit"])? {
            Some(node) => Some(node.string().map_err(|error| self.failed(error))?),
            None => None,
        };
        let from_file = match said.as_deref() {
            Some("m") => Some(LengthUnit::Metre),
            Some("mm") => Some(LengthUnit::Millimetre),
            _ => None,
        };
        from_file
            .or(answers.translation_unit)
            .ok_or_else(|| ImportError::Asked {
                path: self.path(),
                what: "in which unit T is (that of the squares it was calibrated with)",
                flag: "--translation-unit mm or --translation-unit m",
            })
    }

    fn eye(
        &self,
        k_names: &[&str],
        d_names: &[&str],
        size: (u32, u32),
    ) -> Result<(crate::Camera, Option<String>), ImportError> {
        let k: [f64; 9] = numbers(&self.path(), k_names[0], &self.matrix(k_names)?, "9")?;
        let terms = self.matrix(d_names)?;
        finite(&self.path(), d_names[0], &terms)?;
        let pinhole = Pinhole {
            size,
            focal_px: (k[0], k[4]),
            principal_point_px: (k[2], k[5]),
        };
        camera(&self.path(), k_names[0], &pinhole, &Lens::Brown(terms))
    }
}

/// A rig as OpenCV has it, with image size and unit, and with R1, R2, P1, P2 and Q for those who want
/// them; XML when `xml`, else YAML. The mount has no place in it.
///
/// # Errors
/// [`ImportError::OpenCv`].
pub fn export_opencv(rig: &Rig, xml: bool) -> Result<String, ImportError> {
    write(rig, xml).map_err(|source| ImportError::OpenCv {
        path: PathBuf::from(rig.name()),
        source,
    })
}

fn write(rig: &Rig, xml: bool) -> opencv::Result<String> {
    let (format, name) = if xml {
        (FileStorage_FORMAT_XML, "rig.xml")
    } else {
        (FileStorage_FORMAT_YAML, "rig.yml")
    };
    let flags = (FileStorage_WRITE | FileStorage_MEMORY | format) & !FileStorage_BASE64;
    let mut store = FileStorage::new(name, flags, "")?;
    let (width, height) = rig.camera(Eye::Left).image_size_px;
    store.write_i32("image_width", width as i32)?;
    store.write_i32("image_height", height as i32)?;
    store.write_str("translation_unit", "m")?;
    for (eye, k, d) in [(Eye::Left, "M1", "D1"), (Eye::Right, "M2", "D2")] {
        let camera = rig.camera(eye);
        let ((fx, fy), (cx, cy)) = (camera.focal_px, camera.principal_point_px);
        let matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
        put(&mut store, k, 3, &matrix)?;
        put(&mut store, d, 1, &camera.distortion)?;
    }
    put(
        &mut store,
        "R",
        3,
        rig.right_from_left().transpose().as_slice(),
    )?;
    put(
        &mut store,
        "T",
        3,
        rig.right_from_left_translation_m().as_slice(),
    )?;
    let rectification = rig.rectification();
    for (eye, r, p) in [(Eye::Left, "R1", "P1"), (Eye::Right, "R2", "P2")] {
        put(
            &mut store,
            r,
            3,
            rectification.rectified_from_raw(eye).transpose().as_slice(),
        )?;
        let k = rectification.projection(eye);
        let along = match eye {
            Eye::Left => 0.0,
            Eye::Right => -k[(0, 0)] * rig.baseline_m(),
        };
        #[rustfmt::skip]
        let matrix = [
            k[(0, 0)], 0.0, k[(0, 2)], along,
            0.0, k[(1, 1)], k[(1, 2)], 0.0,
            0.0, 0.0, 1.0, 0.0,
        ];
        put(&mut store, p, 3, &matrix)?;
    }
    let (focal, (cx, cy)) = (rectification.focal_px(), rectification.principal_point_px());
    let inverse = 1.0 / rig.baseline_m();
    let apart = -rectification.infinity_disparity_px() * inverse;
    #[rustfmt::skip]
    let q = [
        1.0, 0.0, 0.0, -cx,
        0.0, 1.0, 0.0, -cy,
        0.0, 0.0, 0.0, focal,
        0.0, 0.0, inverse, apart,
    ];
    put(&mut store, "Q", 4, &q)?;
    store.release_and_get_string()
}

fn put(store: &mut FileStorage, name: &str, rows: i32, values: &[f64]) -> opencv::Result<()> {
    let flat = Mat::from_slice(values)?;
    store.write_mat(name, &flat.reshape(1, rows)?)
}
