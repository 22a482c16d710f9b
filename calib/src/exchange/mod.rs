//! Calibrations of other programs, in and out.
//!
//! **In:** Kalibr camchain, a pair of ROS `camera_info` files, OpenCV FileStorage (YAML, XML), DepthAI
//! EEPROM JSON. **Out:** [`Imported`]: what the file holds; what it lacks (the mount, most of all) stays
//! open and is asked for by whoever calls. [`export_ros`] and [`export_opencv`] write a rig.
//!
//! **Assumptions.** Pixel centres at whole numbers, `x_right = R x_left + T`, as all of these programs
//! have it. **Known limits.** Lens models beyond five terms are brought to five by least squares over the
//! image; where that misses by more than [`REFIT_LIMIT_PX`], the file is refused.

mod depthai;
mod kalibr;
mod lens;
mod opencv_storage;
mod ros;

pub use lens::REFIT_LIMIT_PX;
pub use opencv_storage::export_opencv;
pub use ros::export_ros;

use crate::Camera;
use emberfix_frames::{Matrix3, MountAngles, Vector3};
use std::path::{Path, PathBuf};

/// What a file of another program holds.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// Name, from the file or its name.
    pub name: String,
    /// Left camera.
    pub left: Camera,
    /// Right camera.
    pub right: Camera,
    /// Takes left-camera components to right-camera components (OpenCV's R).
    pub right_from_left: Matrix3<f64>,
    /// Left camera's origin in right-camera components, metres (OpenCV's T).
    pub translation_m: Vector3<f64>,
    /// Mount and lever arm (forward, right, down, metres), if the file has them.
    pub mount: Option<(MountAngles, Vector3<f64>)>,
    /// Autopilot time = camera time + this, seconds, if the file has it.
    pub time_offset_s: Option<f64>,
    /// What was changed on the way, for people.
    pub notes: Vec<String>,
}

/// Unit of a translation in a file that does not say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LengthUnit {
    /// Metres.
    Metre,
    /// Millimetres.
    Millimetre,
}

impl LengthUnit {
    fn in_m(self) -> f64 {
        match self {
            Self::Metre => 1.0,
            Self::Millimetre => 1e-3,
        }
    }
}

/// Axes of the IMU that a Kalibr file was made with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImuAxes {
    /// Forward, right, down: PX4.
    Frd,
    /// Forward, left, up: ROS.
    Flu,
}

/// What some formats do not say.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Answers {
    /// Unit of OpenCV's T.
    pub translation_unit: Option<LengthUnit>,
    /// Size of OpenCV's images.
    pub image_size_px: Option<(u32, u32)>,
    /// Axes of Kalibr's IMU, which must be the autopilot's.
    pub imu_axes: Option<ImuAxes>,
}

/// Why a file was refused.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file can't be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// None of the formats.
    #[error(
        "{}: neither a Kalibr camchain, nor ROS camera_info, nor OpenCV FileStorage, nor a DepthAI \
         EEPROM (in JSON)",
        path.display()
    )]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// The format needs another number of files.
    #[error("{format} needs {needed}, given are {given} files")]
    Files {
        /// The format.
        format: &'static str,
        /// What it needs.
        needed: &'static str,
        /// How many were given.
        given: usize,
    },
    /// Not readable as its format.
    #[error("{}: not readable as {format}: {problem}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The format.
        format: &'static str,
        /// What its reader said, in one line.
        problem: String,
    },
    /// Something is not there.
    #[error("{}: {key} is missing; {remedy}", path.display())]
    Missing {
        /// The file.
        path: PathBuf,
        /// What is missing.
        key: String,
        /// What to do.
        remedy: &'static str,
    },
    /// Something is there in the wrong number.
    #[error("{}: {key} has {found} numbers, needed are {needed}", path.display())]
    Count {
        /// The file.
        path: PathBuf,
        /// What.
        key: String,
        /// How many there are.
        found: usize,
        /// How many there should be.
        needed: &'static str,
    },
    /// A number that is not one.
    #[error("{}: {key} holds a number that is not finite", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// What.
        key: String,
    },
    /// A matrix that turns nothing.
    #[error(
        "{}: {key} is no rotation: {}", path.display(),
        if *mirrors { "it mirrors (left-handed axes); exchange two axes or one sign".to_owned() }
        else { format!("it is off by {off:.3}, allowed is 0.01") }
    )]
    NotRotation {
        /// The file.
        path: PathBuf,
        /// What.
        key: String,
        /// How far from a rotation it is.
        off: f64,
        /// Whether its determinant is negative.
        mirrors: bool,
    },
    /// The eyes are the wrong way round.
    #[error(
        "{}: the second camera stands {right_mm:.0} mm to the LEFT of the first: the eyes are swapped; \
         exchange them", path.display()
    )]
    Swapped {
        /// The file.
        path: PathBuf,
        /// How far, millimetres.
        right_mm: f64,
    },
    /// A lens model that five terms can't follow.
    #[error(
        "{}: {key}: the lens model {model} can't be brought to k1, k2, p1, p2, k3: it would be missed by \
         {missed_px:.2} px, allowed is {REFIT_LIMIT_PX}; calibrate the pictures again with `emberfix \
         calibrate stereo`, or crop the image", path.display()
    )]
    Lens {
        /// The file.
        path: PathBuf,
        /// Which camera.
        key: String,
        /// The model's name in the file.
        model: String,
        /// Greatest miss in the image, pixels.
        missed_px: f64,
    },
    /// A lens model that nobody here knows.
    #[error("{}: {key}: lens model {model:?} is unknown; known are {known}", path.display())]
    LensModel {
        /// The file.
        path: PathBuf,
        /// Which camera.
        key: String,
        /// The model's name in the file.
        model: String,
        /// Known names.
        known: &'static str,
    },
    /// Something that the format does not say.
    #[error("{}: does not say {what}; give {flag}", path.display())]
    Asked {
        /// The file.
        path: PathBuf,
        /// What.
        what: &'static str,
        /// How to tell.
        flag: &'static str,
    },
    /// OpenCV failed.
    #[error("{}: OpenCV: {}", path.display(), source.message.replace('\n', " "))]
    OpenCv {
        /// The file.
        path: PathBuf,
        /// What it said.
        source: opencv::Error,
    },
}

/// Reads the files of one rig in whatever of the formats they are.
///
/// # Errors
/// [`ImportError`], one line that names file, key and remedy.
pub fn import(files: &[PathBuf], answers: Answers) -> Result<Imported, ImportError> {
    let Some(first) = files.first() else {
        return Err(ImportError::Files {
            format: "an import",
            needed: "at least one file",
            given: 0,
        });
    };
    let text = read(first)?;
    match format(first, &text)? {
        Format::Kalibr => kalibr::import(one(files, "Kalibr's camchain")?, &text, answers),
        Format::DepthAi => depthai::import(one(files, "DepthAI's EEPROM")?, &text),
        Format::Ros => ros::import(files),
        Format::OpenCv => opencv_storage::import(files, answers),
    }
}

fn one<'a>(files: &'a [PathBuf], format: &'static str) -> Result<&'a Path, ImportError> {
    match files {
        [file] => Ok(file),
        _ => Err(ImportError::Files {
            format,
            needed: "one file",
            given: files.len(),
        }),
    }
}

/// A calibration is a few kilobytes.
const GREATEST_BYTES: u64 = 4 << 20;

fn read(path: &Path) -> Result<String, ImportError> {
    let io = |source| ImportError::Io {
        path: path.to_owned(),
        source,
    };
    let size = std::fs::metadata(path).map_err(io)?.len();
    if size > GREATEST_BYTES {
        return Err(ImportError::UnknownFormat {
            path: path.to_owned(),
        });
    }
    std::fs::read_to_string(path).map_err(io)
}

enum Format {
    Kalibr,
    Ros,
    OpenCv,
    DepthAi,
}

fn format(path: &Path, text: &str) -> Result<Format, ImportError> {
    let start = text.trim_start();
    let has_key = |key: &str| text.lines().any(|line| line.trim_start().starts_with(key));
    if text.contains("opencv-matrix") || text.contains("<opencv_storage") {
        Ok(Format::OpenCv)
    } else if start.starts_with('{') && text.contains("cameraData") {
        Ok(Format::DepthAi)
    } else if has_key("cam0:") || has_key("cam1:") {
        Ok(Format::Kalibr)
    } else if has_key("camera_matrix:") || has_key("projection_matrix:") {
        Ok(Format::Ros)
    } else if start.starts_with("%YAML:") {
        Ok(Format::OpenCv)
    } else {
        Err(ImportError::UnknownFormat {
            path: path.to_owned(),
        })
    }
}

fn stem(path: &Path) -> String {
    path.file_stem().map_or_else(
        || "rig".to_owned(),
        |stem| stem.to_string_lossy().into_owned(),
    )
}

/// How far from orthonormal a printed rotation may be: five decimals are, by 1e-5.
const ROTATION_LIMIT: f64 = 0.01;

/// The nearest rotation, if the matrix is nearly one.
fn rotation(path: &Path, key: &str, matrix: &Matrix3<f64>) -> Result<Matrix3<f64>, ImportError> {
    let off = (matrix.transpose() * matrix - Matrix3::identity()).norm();
    let mirrors = matrix.determinant() < 0.0;
    if mirrors || off.is_nan() || off > ROTATION_LIMIT {
        return Err(ImportError::NotRotation {
            path: path.to_owned(),
            key: key.to_owned(),
            off,
            mirrors,
        });
    }
    let svd = matrix.svd(true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => Ok(u * v_t),
        _ => Ok(*matrix),
    }
}

fn finite(path: &Path, key: &str, values: &[f64]) -> Result<(), ImportError> {
    if values.iter().all(|value| value.is_finite()) {
        return Ok(());
    }
    Err(ImportError::NotFinite {
        path: path.to_owned(),
        key: key.to_owned(),
    })
}

/// So many finite numbers.
fn numbers<const N: usize>(
    path: &Path,
    key: &str,
    values: &[f64],
    needed: &'static str,
) -> Result<[f64; N], ImportError> {
    finite(path, key, values)?;
    values.try_into().map_err(|_| ImportError::Count {
        path: path.to_owned(),
        key: key.to_owned(),
        found: values.len(),
        needed,
    })
}

/// The second camera must stand to the right of the first.
fn right_of_left(path: &Path, translation_m: &Vector3<f64>) -> Result<(), ImportError> {
    if translation_m.x <= 0.0 {
        return Ok(());
    }
    Err(ImportError::Swapped {
        path: path.to_owned(),
        right_mm: 1e3 * translation_m.x,
    })
}

/// The first line of what a reader said; the rest draws the place in the file.
fn one_line(error: &impl std::fmt::Display) -> String {
    let text = error.to_string();
    text.lines().next().unwrap_or_default().trim().to_owned()
}
