//! What the error of a disparity is made of. The causes are independent of each other: their squares add.
//!
//! - **Scatter**: noise, and parts of the flame at depths of their own. Each method sees it on the spot, in
//!   how its parts or bands disagree; neighbours err alike, so that a factor makes one sigma of it.
//! - **Unlikeness**: where one eye shows less of the flame than the other (smoke or a branch before it, dirt
//!   on its lens), outlines that match lie apart by a share of the flame's width: the more is missing to full
//!   likeness, and the duller the one eye is against the other.
//! - **Depth**: what shines lies before and behind the flame's axis, which the disparity is meant for. It
//!   is the same for every method, so that asking another one does not lessen it.
//! - **Sampling**: what pixels and interpolation leave, however much is seen.
//!
//! Skew between the exposures is no cause of its own: what it does to a disparity is seen as scatter and
//! unlikeness. Calibration's share stands in the rig. Factors were settled on the tuning set of `emberfix
//! eval range`, hard flames included.

use super::Disparity;

/// A method's disparity before its error is complete.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Matched {
    /// Its sigma is the scatter alone.
    pub found: Disparity,
    /// How much of the target the other eye shows as well, 0 to 1.
    pub likeness: f64,
    /// By what share one eye is duller than the other, 0 to 1; 1 where a method can't tell.
    pub dullness: f64,
    /// What the method makes of them.
    pub factors: &'static Factors,
}

/// How a method's error follows from what it saw.
#[derive(Debug, PartialEq)]
pub(super) struct Factors {
    /// Of the stated scatter.
    pub scatter: f64,
    /// Share of the width for likeness that is missing altogether to an eye that is dull altogether.
    pub unlike: f64,
    /// Sampling, pixels.
    pub least_px: f64,
}

/// One sigma of a disparity by cause, pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sigma {
    /// Of this method by itself.
    pub own_px: f64,
    /// Of what every method sees alike.
    pub shared_px: f64,
}

/// Between what matches of a flame and its axis, one sigma, as a share of the flame's width. In rendered
/// flames the light lies 0.035 widths before the axis (soot hides the soot behind it) with a scatter of
/// 0.055 (in still air) to 0.080 (leaning in the wind); the outlines that match are of single tongues and
/// scatter more.
const DEPTH: f64 = 0.10;

impl Matched {
    /// What its error comes to, for a target whose width is as much disparity as `depth_px`.
    pub fn sigma(&self, width_px: f64, depth_px: f64) -> Sigma {
        let Factors {
            scatter,
            unlike,
            least_px,
        } = *self.factors;
        let apart = unlike * (1.0 - self.likeness).max(0.0) * self.dullness;
        let own_px = (scatter * self.found.sigma_px)
            .hypot(apart * width_px)
            .hypot(least_px);
        Sigma {
            own_px,
            shared_px: DEPTH * depth_px,
        }
    }
}

impl Sigma {
    /// Of both.
    pub fn px(self) -> f64 {
        self.own_px.hypot(self.shared_px)
    }
}
