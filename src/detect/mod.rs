//! What burns, in one image; the only user of ONNX Runtime.
//!
//! **In:** [`LeftImage`], the raw (not rectified) left image. **Out:** [`Detection`]s in pixels of
//! that image.

use emberfix_frames::ServiceTime;
use opencv::core::Mat;
use serde::{Deserialize, Serialize};

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

    /// Area of overlap over area of union, 0..1.
    #[must_use]
    pub fn iou(&self, other: &Self) -> f64 {
        let overlap = |a: f64, a_len: f64, b: f64, b_len: f64| {
            ((a + a_len).min(b + b_len) - a.max(b)).max(0.0)
        };
        let shared = overlap(self.x, self.width, other.x, other.width)
            * overlap(self.y, self.height, other.y, other.height);
        let all = self.width * self.height + other.width * other.height - shared;
        if all > 0.0 { shared / all } else { 0.0 }
    }
}

/// One thing found in one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// What it is.
    pub class: DetectionClass,
    /// Score in 0..1 as the model gives it.
    pub score: f64,
    /// Where, in the raw left image.
    pub box_px: BoxPx,
}

/// Finds fire and smoke in one image. A miss is an empty list, not an error.
pub trait Detector: Send {
    /// All detections above the detector's threshold, best first.
    ///
    /// # Errors
    /// [`DetectError`] when the frame's result can't be trusted; the next frame may be fine.
    fn detect(&mut self, image: &LeftImage) -> Result<Vec<Detection>, DetectError>;
}

/// Why a frame has no result.
#[derive(Debug, thiserror::Error)]
pub enum DetectError {
    /// Not the pixels that the detector reads.
    #[error("image is {found}, the detector reads 8-bit BGR")]
    Image {
        /// What came.
        found: String,
    },
}
