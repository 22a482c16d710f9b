//! How far a disparity reaches: measured, only "at least this far", or not to be believed.

use super::{Disparity, Method, Methods, RangeConfig, Ranging, Refusal};
use emberfix_calib::Rig;

/// What decides it.
#[derive(Debug, Clone)]
pub(super) struct Reach {
    rig: Rig,
    max_sigma_over_range: f64,
    sigma_floor_px: f64,
}

/// How much of its scatter and of a flame's depth a method's error is: measured on rendered flames (the
/// tuning set of `emberfix eval range`).
struct Honesty {
    /// Standard deviation of its error against the scatter that it states itself.
    scatter: f64,
    /// What is seen of a flame is not just its axis, and a flame is about as deep as it is wide: one
    /// sigma of the difference, as a share of the disparity that its depth spans.
    depth: f64,
    /// What sampling and the eyes' different looks leave however much is seen, pixels.
    least_px: f64,
}

fn honesty(method: Method) -> Honesty {
    let (scatter, depth, least_px) = match method {
        Method::Sgbm => (1.0, 0.0, 0.12),
        Method::Centroid => (2.1, 0.16, 0.02),
        Method::Correlate => (0.7, 0.07, 0.05),
        Method::CrossSpectral => (1.1, 0.10, 0.02),
        // It is made of the others, whose sigmas are honest already.
        Method::Best => (1.0, 0.0, 0.0),
    };
    Honesty {
        scatter,
        depth,
        least_px,
    }
}

/// A method's disparity with the sigma that its errors truly have, for a target of a width.
pub(super) fn honest(
    method: Method,
    found: &Disparity,
    width_px: usize,
    focal_px: f64,
) -> Disparity {
    let Honesty {
        scatter,
        depth,
        least_px,
    } = honesty(method);
    let depth_px = found.px.abs() * width_px as f64 / focal_px;
    Disparity {
        sigma_px: (scatter * found.sigma_px)
            .hypot(depth * depth_px)
            .hypot(least_px),
        ..*found
    }
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
