//! What the error of a disparity is made of. The causes are independent of each other: their squares add.
//!
//! - **Scatter**: noise, and parts of the flame at depths of their own. Each method sees it on the spot, in
//!   how its parts or bands disagree; neighbours err alike, so that a factor makes one sigma of it.
//! - **Unlikeness**: where one eye is duller than the other, or shows less of the flame (smoke before it, dirt on
//!   its lens), what matches is worth less: scatter counts more, the duller and the less alike the eyes are, and
//!   the more of the flame is in parts that do not go with the whole.
//! - **Motion**: a flame that is seen at two moments has risen in between. Rectified eyes show nothing lower of
//!   what stands still, so the rise is seen, and what moved up moved sideways as well; the more so where parts of
//!   the flame do not go with the whole.
//! - **Layers**: a branch before the flame is left out where it is seen (`hidden`); what it leaves behind shows in
//!   how much it hides, in parts whose mean is not the whole's, and in a whole that moves away from the pixel
//!   that was matched.
//! - **Depth**: what shines lies before and behind the flame's axis, which the disparity is meant for. It
//!   is the same for every method, so that asking another one does not lessen it.
//! - **Sampling**: what pixels and interpolation leave, however much is seen. Semi-global matching is pulled
//!   towards whole pixels; least squares at the same place show by how much.
//!
//! Calibration's share stands in the rig. Factors were settled on the tuning set of `emberfix eval range`: those
//! that make errors most likely and the normalised error of every table and every hard case closest to 1.

use super::Disparity;

/// A method's disparity before its error is complete.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Matched {
    /// Its sigma is the scatter alone.
    pub found: Disparity,
    /// How much of the target the other eye shows as well, 0 to 1.
    pub likeness: f64,
    pub signs: Signs,
    /// What the method makes of them.
    pub factors: &'static Factors,
}

/// What a method saw of why it may be wrong; 0 where it can't tell.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Signs {
    /// By what share one eye is duller than the other, 0 to 1.
    pub dullness: f64,
    /// Between the disparity of the target as one and that of its parts or pixels together, pixels.
    pub split_px: f64,
    /// By how much one eye shows it lower than the other, pixels.
    pub rise_px: f64,
    /// Share of the target whose parts do not go with the whole.
    pub astray: f64,
    /// From the whole pixel that was matched to the disparity of the target as one, pixels.
    pub moved_px: f64,
    /// Share of the target that something dark before it hides, with what lies beside it.
    pub hidden: f64,
}

/// How a method's error follows from what it saw.
#[derive(Debug, PartialEq)]
pub(super) struct Factors {
    /// Of the stated scatter.
    pub scatter: f64,
    /// Of the scatter once more, times dullness.
    pub dull: f64,
    /// Of the scatter once more, times likeness that is missing.
    pub unlike: f64,
    /// Of the scatter once more, times the share that is astray.
    pub astray: f64,
    /// Of the scatter once more, times what is hidden.
    pub hidden: f64,
    /// Of how far its parts or pixels together are from the whole.
    pub split: f64,
    /// Of the rise.
    pub rise: f64,
    /// Of the rise, times the share that is astray.
    pub rise_astray: f64,
    /// Of the way from the whole pixel beyond what is usual, times the share that is astray.
    pub moved_astray: f64,
    /// Pixels, if all were hidden.
    pub hidden_px: f64,
    /// Pixels, if one eye were dull altogether.
    pub dull_px: f64,
    /// Share of the width for likeness that is missing altogether.
    pub unlike_width: f64,
    /// Share of the width for likeness that is missing altogether, times dullness.
    pub unlike_dull: f64,
    /// Sampling, pixels.
    pub least_px: f64,
}

/// Nothing but the scatter.
pub(super) const PLAIN: Factors = Factors {
    scatter: 1.0,
    dull: 0.0,
    unlike: 0.0,
    astray: 0.0,
    hidden: 0.0,
    split: 0.0,
    rise: 0.0,
    rise_astray: 0.0,
    moved_astray: 0.0,
    hidden_px: 0.0,
    dull_px: 0.0,
    unlike_width: 0.0,
    unlike_dull: 0.0,
    least_px: 0.0,
};

/// A whole pixel is half a pixel off at most, and a little more by noise.
const USUAL_MOVE_PX: f64 = 0.6;

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
        let (signs, by) = (&self.signs, self.factors);
        let unlike = (1.0 - self.likeness).max(0.0);
        let moved_px = (signs.moved_px - USUAL_MOVE_PX).max(0.0);
        let causes_px = [
            by.scatter * self.found.sigma_px,
            by.dull * signs.dullness * self.found.sigma_px,
            by.unlike * unlike * self.found.sigma_px,
            by.astray * signs.astray * self.found.sigma_px,
            by.hidden * signs.hidden * self.found.sigma_px,
            by.split * signs.split_px,
            by.rise * signs.rise_px,
            by.rise_astray * signs.rise_px * signs.astray,
            by.moved_astray * moved_px * signs.astray,
            by.hidden_px * signs.hidden,
            by.dull_px * signs.dullness,
            by.unlike_width * unlike * width_px,
            by.unlike_dull * unlike * signs.dullness * width_px,
            by.least_px,
        ];
        let own_px = causes_px.into_iter().fold(0.0, f64::hypot);
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

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_calib::RectifiedPixel;

    static BY: Factors = Factors {
        dull: 3.0,
        rise: 0.5,
        rise_astray: 4.0,
        moved_astray: 2.0,
        least_px: 0.03,
        ..PLAIN
    };

    fn own_px(signs: Signs) -> f64 {
        let found = Disparity {
            px: 5.0,
            sigma_px: 0.04,
            support: 100,
            centroid: RectifiedPixel { u: 0.0, v: 0.0 },
        };
        let matched = Matched {
            found,
            likeness: 1.0,
            signs,
            factors: &BY,
        };
        matched.sigma(40.0, 0.0).px()
    }

    #[test]
    fn causes_add_by_their_squares_and_what_is_not_seen_adds_nothing() {
        let still = own_px(Signs::default());
        assert!((still - 0.05).abs() < 1e-12, "{still}");
        let risen = Signs {
            rise_px: 0.24,
            ..Signs::default()
        };
        assert!((own_px(risen) - 0.13).abs() < 1e-12, "{}", own_px(risen));
        let astray = Signs {
            astray: 0.5,
            ..risen
        };
        assert!(own_px(astray) > 3.0 * own_px(risen));
    }

    #[test]
    fn half_a_pixel_from_the_whole_one_is_no_move() {
        let moved = |moved_px| {
            own_px(Signs {
                moved_px,
                astray: 1.0,
                ..Signs::default()
            })
        };
        assert_eq!(moved(0.5), moved(0.0));
        assert!(moved(1.6) > 2.0, "{}", moved(1.6));
    }
}
