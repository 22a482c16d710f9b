//! Box to a range with its error, or why not; the only stereo use of OpenCV.
//!
//! **Purpose.** Finds the disparity of one target: rectifies what is around its box (`patch`), keeps
//! the pixels that look like flame (`mask`), matches them in the right eye by semi-global matching
//! or by correlation, and pools them (`pool`) to one disparity with its error.
//! **In:** the decoded pair, raw, and a box in the raw left image; once per detection. **Out:**
//! [`Ranging`]: a disparity in rectified pixels (`u_left - u_right`, positive in front), its sigma
//! and the centroid of the pixels that it rests on, or a named reason why there is none.
//!
//! **Assumptions.** Both eyes were exposed within the rig's skew, and the rig's calibration holds.
//! Depth follows from the *mean disparity*; the mean of depths would be pulled outwards.
//!
//! **Known limits.** Flames have no surface: the disparity is that of their visible outline and
//! texture. What is matched in smoke is the ground that shows through it (on rendered plumes at 20 m
//! the disparity came out a quarter too small), so smoke is always [`Ranging::NoMatch`]. The sigma
//! is that of matching alone: calibration's share stands in the rig.

mod correlate;
mod mask;
mod patch;
mod pool;
mod sgbm;
#[cfg(test)]
mod tests;

pub use mask::HsvMask;
pub use sgbm::{MatchMethod, SgbmConfig, SgbmRanger};

use crate::detect::{BoxPx, DetectionClass};
use emberfix_calib::RectifiedPixel;
use emberfix_frames::ServiceTime;
use opencv::core::Mat;

/// Both eyes of one moment, decoded, raw; rectified on demand by whoever needs it.
#[derive(Debug, Clone)]
pub struct RawPair {
    /// Mid-exposure of the left eye.
    pub at: ServiceTime,
    /// Left eye, 8-bit BGR.
    pub left_bgr: Mat,
    /// Right eye, 8-bit gray; absent when it is dead, dark or out of step.
    pub right_gray: Option<Mat>,
}

/// What to range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// What it is: the ground behind shows through smoke, so only the rest is matched.
    pub class: DetectionClass,
    /// Box in the raw left image.
    pub box_px: BoxPx,
}

/// What stereo says of one target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Ranging {
    /// A disparity with its error.
    Measured {
        /// Mean of the valid disparities of the flame, `u_left - u_right`, rectified pixels.
        disparity_px: f64,
        /// One sigma of it (matching only; calibration comes on top), pixels.
        sigma_px: f64,
        /// Pixels that it rests on.
        support: u32,
        /// Centroid of those pixels in the rectified left image.
        centroid: RectifiedPixel,
    },
    /// Too far to say more than this.
    BeyondReach {
        /// Least depth along the boresight that agrees with what was seen, metres.
        at_least_m: f64,
    },
    /// The right eye shows nothing that matches, or there is no right eye.
    NoMatch,
}

/// Ranges one target in one pair.
pub trait Ranger: Send {
    /// Starts on a new pair (work that all of its targets share).
    ///
    /// # Errors
    /// [`RangeError`] when the pair can't be used at all.
    fn range(&mut self, pair: &RawPair, target: &Target) -> Result<Ranging, RangeError>;
}

/// Why a pair can't be ranged.
#[derive(Debug, thiserror::Error)]
pub enum RangeError {
    /// Image size is not the rig's.
    #[error("image is {found_width}x{found_height}, the rig was calibrated at {width}x{height}")]
    Size {
        /// Columns that came.
        found_width: i32,
        /// Rows that came.
        found_height: i32,
        /// Columns of the rig.
        width: u32,
        /// Rows of the rig.
        height: u32,
    },
    /// Not the pixels that are matched.
    #[error("image is {found}, needed are 8-bit BGR on the left and 8-bit gray on the right")]
    Pixels {
        /// What came.
        found: String,
    },
    /// OpenCV refused.
    #[error("stereo matching failed: {source}")]
    OpenCv {
        /// What it said.
        #[from]
        source: opencv::Error,
    },
}
