//! How far a disparity reaches: measured, only "at least this far", or not to be believed.

use super::{Disparity, Methods, RangeConfig, Ranging, Refusal};
use emberfix_calib::Rig;

/// What decides it.
#[derive(Debug, Clone)]
pub(super) struct Reach {
    rig: Rig,
    max_sigma_over_range: f64,
    sigma_floor_px: f64,
}

impl Reach {
    pub fn new(rig: &Rig, config: &RangeConfig) -> Self {
        Self {
            rig: rig.clone(),
            max_sigma_over_range: config.max_sigma_over_range,
            sigma_floor_px: config.sigma_floor_px,
        }
    }

    /// Corrects what the rig's known distances showed and judges the rest.
    pub fn judge(&self, found: &Disparity, used: Methods) -> Ranging {
        let rectification = self.rig.rectification();
        let found = &Disparity {
            px: self.rig.corrected_disparity_px(found.px),
            sigma_px: found.sigma_px.hypot(self.sigma_floor_px) / self.rig.inverse_depth().scale,
            ..*found
        };
        let from_infinity = found.px - rectification.infinity_disparity_px();
        let sigma = found
            .sigma_px
            .hypot(self.rig.disparity_bias_sigma_px(found.px));
        if from_infinity < -2.0 * sigma {
            // Swapped eyes or a wrong match, not a far fire.
            return Ranging::NoMatch {
                why: Refusal::BeyondInfinity,
            };
        }
        if from_infinity < 2.0 * sigma || sigma > self.max_sigma_over_range * from_infinity {
            let focal_baseline = rectification.focal_px() * self.rig.baseline_m();
            return Ranging::BeyondReach {
                at_least_m: focal_baseline / (from_infinity.max(0.0) + 2.0 * sigma),
                weak: *found,
                used,
            };
        }
        Ranging::Measured {
            disparity_px: found.px,
            sigma_px: found.sigma_px,
            support: found.support,
            centroid: found.centroid,
            used,
        }
    }
}
