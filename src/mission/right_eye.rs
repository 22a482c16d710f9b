//! The right eye's model, where that eye sees another spectrum, and how both are heard.

use super::{Checks, RawModel, detector};
use crate::detect::DetectorConfig;
use crate::detect::fuse::FusionConfig;
use serde::Deserialize;
use std::path::{Path, PathBuf};

#[derive(Deserialize, Default)]
pub(super) struct RawFusion {
    agree_giou: Option<f64>,
    contend_giou: Option<f64>,
    one_sided: Option<f64>,
    right_trust: Option<f64>,
    threshold: Option<f64>,
}

/// The right eye's detector and how it is heard.
#[derive(Debug, Clone, PartialEq)]
pub struct RightEyeConfig {
    /// Its detector.
    pub detector: DetectorConfig,
    /// How both are heard.
    pub fusion: FusionConfig,
}

/// What the mission says of it, if anything.
pub(super) fn right_eye(
    model: Option<&RawModel>,
    fusion: Option<&RawFusion>,
    beside: &dyn Fn(&Path) -> PathBuf,
) -> Option<RightEyeConfig> {
    let usual = FusionConfig::default();
    let said = fusion.map_or(usual, |raw| FusionConfig {
        agree_giou: raw.agree_giou.unwrap_or(usual.agree_giou),
        contend_giou: raw.contend_giou.unwrap_or(usual.contend_giou),
        one_sided: raw.one_sided.unwrap_or(usual.one_sided),
        right_trust: raw.right_trust.unwrap_or(usual.right_trust),
        threshold: raw.threshold.unwrap_or(usual.threshold),
    });
    Some(RightEyeConfig {
        detector: detector(model?, beside),
        fusion: said,
    })
}

/// Numbers out of range, and a fusion of nothing.
pub(super) fn check(checks: &mut Checks, model: Option<&RawModel>, fusion: Option<&RawFusion>) {
    let as_written = right_eye(model, fusion, &Path::to_owned);
    let Some(RightEyeConfig { detector, fusion }) = as_written else {
        if fusion.is_some() {
            checks.problem("fusion needs a right_model".to_owned());
        }
        return;
    };
    for problem in detector.problems() {
        checks.problem(format!("right_model.{problem}"));
    }
    for problem in fusion.problems() {
        checks.problem(format!("fusion.{problem}"));
    }
}
