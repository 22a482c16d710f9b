//! What burns, in one image; the only user of ONNX Runtime.
//!
//! **Purpose.** Runs a detector over one image and says where fire and smoke stand in it.
//! **In:** [`LeftImage`], the raw (not rectified) left image, 8-bit BGR, as often as the caller has
//! one. **Out:** [`Detection`]s in pixels of that image, best first, one list per image.
//!
//! - [`OnnxDetector`] runs an ONNX model over the whole frame and over tiles at native resolution,
//!   and merges what they see: `preprocess` cuts the views, one file of `family` per model family turns
//!   tensors into boxes and masks, `nms` makes one box of one flame.
//!   Where a frame's time is bounded, `attention` says which tiles are worth it.
//! - `second_look` enlarges what was found and says how sure it is that it burns.
//! - [`BoxFileDetector`] reads given boxes from a file.
//!
//! **Assumptions.** A model file is trusted as far as its hash, its size and its tensors were
//! checked at load; family, classes and thresholds come from its metadata unless the configuration
//! says otherwise, and the tensors' shapes decide whether that is true.
//!
//! **Known limits.** Batch is 1; weights must stand in the model file itself. A flame of fewer than
//! about 10 px at the network's input is not seen: without tiles a 1 m fire goes unseen beyond 26 m
//! at 1280 px, with native tiles beyond 80 m.

mod attention;
mod boxfile;
mod config;
mod error;
mod family;
pub mod fuse;
#[cfg(test)]
mod lookalike;
mod mask;
mod metadata;
mod model_file;
mod network;
mod nms;
mod onnx;
mod preprocess;
mod runtime;
mod second_look;

pub use attention::{GroundScale, Looked};
pub use boxfile::{BoxFileDetector, BoxFileError, GivenBox};
pub use config::{ClassPolicy, DetectorConfig, ModelForm, YoloxOutput};
pub use error::ModelError;
pub use family::Family;
pub use mask::Mask;
pub use network::{PassedOver, Provider};
pub use onnx::{ClassInfo, DetectorInfo, OnnxDetector, Spent};
pub use second_look::Twice;

use emberfix_frames::ServiceTime;
use opencv::core::Mat;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// What a detector's class means to us.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DetectionClass {
    /// Flame: alarms.
    Fire,
    /// Smoke: alarms.
    Smoke,
    /// Looks like fire and is not: suppresses an overlapping fire.
    NonFire,
}

/// The decoded left image as the camera gave it, 8-bit BGR, not rectified.
#[derive(Debug, Clone)]
pub struct LeftImage {
    /// Mid-exposure.
    pub at: ServiceTime,
    /// Number of the pair in its source, from 0.
    pub sequence: u64,
    /// Pixels: rows x columns x 3, 8 bit, BGR.
    pub bgr: Mat,
    /// How large things on the ground appear in it, where that is known.
    pub ground: Option<GroundScale>,
}

/// A box in pixels of the raw left image; pixel centres at whole numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BoxPx {
    /// Left edge.
    pub x: f64,
    /// Upper edge.
    pub y: f64,
    /// Width, above 0.
    pub width: f64,
    /// Height, above 0.
    pub height: f64,
}

impl BoxPx {
    /// Middle of the box: column, row.
    #[must_use]
    pub fn centre(&self) -> (f64, f64) {
        (self.x + self.width / 2.0, self.y + self.height / 2.0)
    }

    /// Middle of the lower edge: column, row. Where a flame stands.
    #[must_use]
    pub fn base(&self) -> (f64, f64) {
        (self.x + self.width / 2.0, self.y + self.height)
    }

    /// Square pixels.
    #[must_use]
    pub fn area_px2(&self) -> f64 {
        self.width * self.height
    }

    /// Area of overlap, square pixels.
    #[must_use]
    pub fn shared_px2(&self, other: &Self) -> f64 {
        let overlap = |a: f64, a_len: f64, b: f64, b_len: f64| {
            ((a + a_len).min(b + b_len) - a.max(b)).max(0.0)
        };
        overlap(self.x, self.width, other.x, other.width)
            * overlap(self.y, self.height, other.y, other.height)
    }

    /// Area of overlap over area of union, 0..1.
    #[must_use]
    pub fn iou(&self, other: &Self) -> f64 {
        let shared = self.shared_px2(other);
        let all = self.area_px2() + other.area_px2() - shared;
        if all > 0.0 { shared / all } else { 0.0 }
    }

    /// IoU, less what the smallest box about both holds besides them, as a share of it: -1..1.
    #[must_use]
    pub fn giou(&self, other: &Self) -> f64 {
        let about = |a: f64, a_len: f64, b: f64, b_len: f64| (a + a_len).max(b + b_len) - a.min(b);
        let about = about(self.x, self.width, other.x, other.width)
            * about(self.y, self.height, other.y, other.height);
        let iou = self.iou(other);
        let union = self.area_px2() + other.area_px2() - self.shared_px2(other);
        if about > 0.0 {
            iou - (about - union) / about
        } else {
            0.0
        }
    }
}

/// One thing found in one image.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// What it is.
    pub class: DetectionClass,
    /// Score in 0..1 as the model gives it.
    pub score: f64,
    /// Where, in the raw left image.
    pub box_px: BoxPx,
    /// Which pixels, where the model tells.
    pub mask: Option<Arc<Mask>>,
    /// Log-odds, by a second look at it alone, that it is what its class says; `None` where nobody looked.
    pub second_look: Option<f64>,
}

/// Finds fire and smoke in one image. A miss is an empty list, not an error.
pub trait Detector: Send {
    /// All detections above the detector's threshold, best first.
    ///
    /// # Errors
    /// [`DetectError`] when the frame's result can't be trusted; the next frame may be fine.
    fn detect(&mut self, image: &LeftImage) -> Result<Vec<Detection>, DetectError>;

    /// Where the latest image was looked at; everywhere, unless a detector says otherwise.
    fn looked(&self) -> Looked {
        Looked::default()
    }
}

/// Loads the model that a mission names.
///
/// # Errors
/// [`ModelError`] that names the file, what was expected and what was found.
pub fn open(config: &DetectorConfig) -> Result<Box<dyn Detector>, ModelError> {
    let detector = OnnxDetector::load(config)?;
    let info = detector.info();
    for (provider, why) in &info.passed_over {
        tracing::warn!(provider = provider.name(), %why, "execution provider does not run the model");
    }
    tracing::info!(?info, "model loaded");
    Ok(if config.second_look {
        Box::new(Twice::open(detector)?)
    } else {
        Box::new(detector)
    })
}

/// Why a frame has no result. The next frame may have one: count it and go on.
#[derive(Debug, thiserror::Error)]
pub enum DetectError {
    /// Not the pixels that the detector reads.
    #[error("image is {found}, the detector reads 8-bit BGR")]
    Image {
        /// What came.
        found: String,
    },
    /// The model's answer holds NaN or infinity.
    #[error("the model's output has {count} values that are not finite numbers, of {of}")]
    NotFinite {
        /// How many.
        count: usize,
        /// Of how many.
        of: usize,
    },
    /// The model's answer has another shape than at load.
    #[error("the model answered {found:?}, expected {expected:?}")]
    Shape {
        /// As checked at load.
        expected: Vec<i64>,
        /// What came.
        found: Vec<i64>,
    },
    /// ONNX Runtime failed.
    #[error("inference failed: {source}")]
    Inference {
        /// What it said.
        #[from]
        source: ort::Error,
    },
    /// OpenCV refused the image.
    #[error("preparing the image failed: {source}")]
    OpenCv {
        /// What it said.
        #[from]
        source: opencv::Error,
    },
}

impl DetectError {
    /// A word for counters.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Image { .. } => "image",
            Self::NotFinite { .. } => "not_finite",
            Self::Shape { .. } => "shape",
            Self::Inference { .. } => "inference",
            Self::OpenCv { .. } => "opencv",
        }
    }
}
