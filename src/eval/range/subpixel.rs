//! Bias over the fraction of a pixel.

use super::outcome::{BEST, Bench, NAMES};
use super::stage::{Recipe, RigName, Stage};
use super::stats::{mean, rms};
use super::tables::rounds;
use super::{Options, RangeEvalError, Tick};
use emberfix_sim::world::World;
use std::sync::Arc;

/// Whole part of the disparities, pixels.
const WHOLE_PX: f64 = 5.0;

/// What each method finds at one fraction of a pixel.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Step {
    pub fraction_px: f64,
    pub methods: Vec<Offset>,
}

/// Of one method.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Offset {
    pub method: &'static str,
    pub bias_px: Option<f64>,
    pub rms_px: Option<f64>,
    pub n: usize,
}

/// The same flames at every fraction, so that only the fraction differs.
pub(super) fn measure(
    world: &Arc<World>,
    options: &Options,
    tick: Tick,
) -> Result<Vec<Step>, RangeEvalError> {
    let stage = Stage::new(RigName::Ours120, world)?;
    let bench = Bench::new(&stage);
    let steps = if options.quick { 4 } else { 16 };
    let count = if options.quick {
        8
    } else {
        3 * options.repeats
    };
    let step = |k: usize| {
        let fraction_px = k as f64 / steps as f64;
        let depth_m = stage
            .rig
            .depth_m(stage.rig.rectification().infinity_disparity_px() + WHOLE_PX + fraction_px)
            .ok_or(RangeEvalError::Methods)?;
        let recipe = Recipe {
            depth_m: depth_m..depth_m,
            width_m: 0.8..1.4,
            u_px: 400.0..900.0,
            v_px: 250.0..470.0,
            daylight: 0.1..0.6,
            exposure: 0.8..1.4,
            wind_m_s: 0.0..0.5,
            indoors: false,
            hardness: None,
        };
        let found = rounds(&bench, &recipe, options, 0x2000, count)?;
        tick(1);
        let offset = |method: usize| {
            let off: Vec<f64> = found
                .iter()
                .filter_map(|round| round.said[method].off_px())
                .collect();
            Offset {
                method: NAMES[method],
                bias_px: mean(&off),
                rms_px: rms(&off),
                n: off.len(),
            }
        };
        Ok(Step {
            fraction_px,
            methods: (0..NAMES.len()).map(offset).collect(),
        })
    };
    (0..steps).map(step).collect()
}

/// Steps of the suite.
pub(super) fn steps(options: &Options) -> u64 {
    if options.quick { 4 } else { 16 }
}

/// Greatest mean error of the default at any fraction.
pub(super) fn worst_bias_px(steps: &[Step]) -> Option<f64> {
    let biases: Option<Vec<f64>> = steps
        .iter()
        .map(|step| step.methods[BEST].bias_px)
        .collect();
    biases?.into_iter().map(f64::abs).reduce(f64::max)
}
