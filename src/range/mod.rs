//! Box to a range with its error, or why not; the only stereo use of OpenCV.
//!
//! **Purpose.** Finds the disparity of one target: rectifies what is around its box (`patch`), keeps
//! the pixels that look like flame (`mask`), leaves out what a branch before them hides (`hidden`), matches
//! the rest in the right eye by each method, with the left eye's colours mixed as the right eye sees them
//! (`scene`), and says what the error of the answer is made of (`error`).
//! **In:** the decoded pair, raw, and a box in the raw left image; once per detection. **Out:**
//! [`Ranging`]: a disparity in rectified pixels (`u_left - u_right`, positive in front), its sigma
//! and the centroid of the pixels that it rests on, or a named reason why there is none.
//!
//! **Assumptions.** Both eyes were exposed within the rig's skew, and the rig's calibration holds.
//! Depth follows from the *mean disparity*; the mean of depths would be pulled outwards.
//!
//! **What a flame's disparity means.** Flames have no surface; what both eyes match is light from all their
//! depth. The disparity is meant for the flame's *axis*: the vertical through its base, at the row of the
//! centroid. That is what an estimator needs who looks for the base. The light that is seen lies a little
//! before the axis, by 3 % of the flame's width in rendered flames; matching follows outlines more than
//! brightness and gets half of that. It is not corrected, for it depends on the soot; the sigma covers it
//! (`error`).
//!
//! **Known limits.** What is matched in smoke is the ground that shows through it (on rendered plumes at 20 m
//! the disparity came out a quarter too small), so smoke is always [`Ranging::NoMatch`]. Branches are left
//! out in the left eye, where colour tells them from ground; in the right one they are outliers.
//! [`Method::CrossSpectral`] by itself may still follow a branch that is a pixel nearer than the flame. The
//! sigma is that of matching alone: calibration's share stands in the rig.

mod best;
mod centroid;
mod config;
mod correlate;
mod cross_spectral;
mod error;
mod eyes;
mod hidden;
mod mask;
mod parts;
mod patch;
mod pool;
mod raster;
mod reach;
mod refine;
mod scene;
mod search;
mod sgbm;
#[cfg(test)]
mod tests;
mod ways;

pub use config::{Method, Methods, RangeConfig};
pub use eyes::{EyeComparer, EyesCompared, SamePlace};
pub use mask::HsvMask;

use crate::detect::{BoxPx, DetectionClass};
use emberfix_calib::{RectifiedPixel, Rig};
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

/// A disparity of a flame's axis and what it rests on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disparity {
    /// `u_left - u_right` of the vertical through the flame's base, at the centroid's row; rectified pixels.
    pub px: f64,
    /// One sigma of it (matching only; calibration comes on top), pixels.
    pub sigma_px: f64,
    /// Pixels that it rests on.
    pub support: u32,
    /// Centroid of those pixels in the rectified left image.
    pub centroid: RectifiedPixel,
}

/// What stereo says of one target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Ranging {
    /// A disparity with its error.
    Measured {
        /// `u_left - u_right` of the vertical through the flame's base, at the centroid's row; rectified
        /// pixels.
        disparity_px: f64,
        /// One sigma of it (matching only; calibration comes on top), pixels.
        sigma_px: f64,
        /// Pixels that it rests on.
        support: u32,
        /// Centroid of those pixels in the rectified left image.
        centroid: RectifiedPixel,
        /// The methods that it was made of.
        used: Methods,
    },
    /// Too far to say more than this by stereo alone; an estimator still gains from the disparity.
    BeyondReach {
        /// Least depth along the boresight that agrees with what was seen, metres.
        at_least_m: f64,
        /// The weak disparity itself; it may lie below that of infinity, within its sigma.
        weak: Disparity,
        /// The methods that it was made of.
        used: Methods,
    },
    /// Nothing that could be believed.
    NoMatch {
        /// Why not.
        why: Refusal,
    },
}

/// Why a target has no disparity. An expected outcome, not an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Refusal {
    /// The right eye is missing: dead, dark or out of step.
    NoSecondEye,
    /// It is smoke: what matches there is the ground that shows through it.
    Smoke,
    /// Nothing of the box is in the rectified image.
    OutsideImage,
    /// Too few pixels to match.
    TooSmall,
    /// The right eye has no contrast where the target should be.
    Flat,
    /// Nothing in the right eye resembles the target.
    NoPeak,
    /// Two places in the right eye resemble the target alike.
    Ambiguous,
    /// What matches in the right eye matches another thing in the left one better.
    OneSided,
    /// The best match lies at the end of the disparities that are tried, nearer than any of them.
    TooNear,
    /// The best match would lie beyond infinity: swapped eyes or a wrong match.
    BeyondInfinity,
    /// The parts of the target do not agree on one disparity.
    Inconsistent,
    /// The methods contradict each other.
    Disagreement,
    /// The eyes see other light, and the method compares light as it is.
    OtherSpectrum,
}

impl Refusal {
    /// One word for counters.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::NoSecondEye => "no_second_eye",
            Self::Smoke => "smoke",
            Self::OutsideImage => "outside_image",
            Self::TooSmall => "too_small",
            Self::Flat => "flat",
            Self::NoPeak => "no_peak",
            Self::Ambiguous => "ambiguous",
            Self::OneSided => "one_sided",
            Self::TooNear => "too_near",
            Self::BeyondInfinity => "beyond_infinity",
            Self::Inconsistent => "inconsistent",
            Self::Disagreement => "disagreement",
            Self::OtherSpectrum => "other_spectrum",
        }
    }
}

/// Ranges one target in one pair.
pub trait Ranger: Send {
    /// The target's disparity, or why there is none. Touches no pixel that its box and the epipolar
    /// strip beside it do not cover.
    ///
    /// # Errors
    /// [`RangeError`] when the pair can't be used at all.
    fn range(&mut self, pair: &RawPair, target: &Target) -> Result<Ranging, RangeError>;
}

/// The ranger of a method for one rig.
///
/// # Errors
/// [`RangeError::OpenCv`] when OpenCV refuses the configuration or the rig.
pub fn open(
    method: Method,
    rig: &Rig,
    config: &RangeConfig,
) -> Result<Box<dyn Ranger>, RangeError> {
    Ok(Box::new(ways::Ways::new(method, rig, config)?))
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

/// Why a method has no disparity: an outcome, or a failure.
enum Miss {
    Refused(Refusal),
    Failed(RangeError),
}

impl From<Refusal> for Miss {
    fn from(why: Refusal) -> Self {
        Self::Refused(why)
    }
}

impl From<RangeError> for Miss {
    fn from(error: RangeError) -> Self {
        Self::Failed(error)
    }
}
