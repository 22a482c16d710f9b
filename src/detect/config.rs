//! What a mission says of its detector.

use super::{DetectionClass, Family, Provider};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// What a class of the model means to the mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClassPolicy {
    /// Flame: alarms.
    Fire,
    /// Smoke: alarms.
    Smoke,
    /// Looks like fire and is not: suppresses an overlapping fire.
    NonFire,
    /// Not looked at.
    Ignore,
}

impl ClassPolicy {
    /// What detections of this class are reported as; `None` when they are not.
    #[must_use]
    pub fn class(self) -> Option<DetectionClass> {
        match self {
            Self::Fire => Some(DetectionClass::Fire),
            Self::Smoke => Some(DetectionClass::Smoke),
            Self::NonFire => Some(DetectionClass::NonFire),
            Self::Ignore => None,
        }
    }
}

/// What a YOLOX export leaves to its reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum YoloxOutput {
    /// Boxes in cells, scores without their sigmoid.
    Raw,
    /// Boxes in cells, scores in 0..1.
    RawBoxes,
    /// Boxes in input pixels, scores in 0..1.
    Decoded,
}

/// What the shapes of a model's outputs do not tell. Each from the model's metadata when absent.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ModelForm {
    /// What a YOLOX export leaves to do; by the values of its first answer when nobody says.
    pub yolox_output: Option<YoloxOutput>,
    /// Anchors of a Darknet model, width and height in input pixels: three a stride, finest stride
    /// first; the published ones when nobody says.
    pub anchors: Option<Vec<[[f32; 2]; 3]>>,
}

/// How to detect. [`DetectorConfig::problems`] checks the numbers, loading checks the model.
#[derive(Debug, Clone, PartialEq)]
pub struct DetectorConfig {
    /// ONNX file.
    pub model: PathBuf,
    /// Hash that the file must have, 64 hexadecimal digits.
    pub sha256: Option<String>,
    /// Family of the model; from its metadata when absent.
    pub family: Option<Family>,
    /// Names of the model's classes in order; from its metadata when absent.
    pub names: Option<Vec<String>>,
    /// What its outputs' shapes do not tell.
    pub form: ModelForm,
    /// Least score that counts, 0..1, for every class; from the metadata when absent.
    pub threshold: Option<f64>,
    /// Overlap over union above which two boxes are one, 0..1.
    pub nms_iou: f64,
    /// Side of the tiles in pixels of the raw image; `None` looks at the whole frame only.
    pub tile_px: Option<u32>,
    /// Least overlap of neighbouring tiles, pixels: a flame up to this size is whole in one tile.
    pub overlap_px: u32,
    /// Time for one image, milliseconds: so many views are looked at as fit into it at the speed that is
    /// measured at load; all of them when absent.
    pub frame_budget_ms: Option<f64>,
    /// Threads of one inference.
    pub threads: usize,
    /// What may compute it: the first that takes all of the model does.
    pub providers: Vec<Provider>,
    /// Whether what it finds is looked at again (light that eyes see only).
    pub second_look: bool,
    /// Meaning of the model's class names; [`default_classes`](Self::default_classes) covers the
    /// usual ones.
    pub classes: BTreeMap<String, ClassPolicy>,
}

impl DetectorConfig {
    /// A model with the usual settings: whole frame and 416 px tiles, two threads.
    #[must_use]
    pub fn new(model: impl Into<PathBuf>) -> Self {
        Self {
            model: model.into(),
            sha256: None,
            family: None,
            names: None,
            form: ModelForm::default(),
            threshold: None,
            nms_iou: 0.5,
            tile_px: Some(416),
            overlap_px: 96,
            frame_budget_ms: None,
            threads: 2,
            providers: vec![Provider::Cpu],
            second_look: false,
            classes: Self::default_classes(),
        }
    }

    /// The names that fire data sets use.
    #[must_use]
    pub fn default_classes() -> BTreeMap<String, ClassPolicy> {
        let known = [
            ("fire", ClassPolicy::Fire),
            ("flame", ClassPolicy::Fire),
            ("smoke", ClassPolicy::Smoke),
            ("non-fire", ClassPolicy::NonFire),
            ("non_fire", ClassPolicy::NonFire),
            ("nonfire", ClassPolicy::NonFire),
            ("other", ClassPolicy::Ignore),
        ];
        known
            .into_iter()
            .map(|(name, policy)| (name.to_owned(), policy))
            .collect()
    }

    /// Every number that is out of range: key, value, allowed range. Empty when all is well.
    #[must_use]
    pub fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut within = |key: &str, value: f64, low: f64, high: f64| {
            if !(low..=high).contains(&value) {
                problems.push(format!("{key} is {value}, allowed is {low} to {high}"));
            }
        };
        within("threshold", self.threshold.unwrap_or(0.5), 0.01, 1.0);
        within("nms_iou", self.nms_iou, 0.05, 0.95);
        within("providers' number", self.providers.len() as f64, 1.0, 4.0);
        within(
            "frame_budget_ms",
            self.frame_budget_ms.unwrap_or(100.0),
            1.0,
            1e4,
        );
        within("threads", self.threads as f64, 1.0, 64.0);
        if let Some(tile_px) = self.tile_px {
            within("tile_px", f64::from(tile_px), 64.0, 8192.0);
            within(
                "overlap_px",
                f64::from(self.overlap_px),
                0.0,
                f64::from(tile_px) / 2.0,
            );
        }
        let anchors = self.form.anchors.iter().flatten().flatten().flatten();
        if let Some(bad) = anchors
            .into_iter()
            .find(|side| !(1.0..=4096.0).contains(*side))
        {
            problems.push(format!("anchors hold {bad}, allowed is 1 to 4096"));
        }
        if let Some(hash) = self.sha256.as_deref().filter(|hash| !is_sha256(hash)) {
            problems.push(format!(
                "sha256 is {hash:?}, needed are 64 hexadecimal digits"
            ));
        }
        problems
    }
}

fn is_sha256(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_out_of_range_is_named() {
        let config = DetectorConfig {
            threshold: Some(f64::NAN),
            nms_iou: 1.5,
            tile_px: Some(100),
            overlap_px: 80,
            threads: 0,
            sha256: Some("12".to_owned()),
            form: ModelForm {
                anchors: Some(vec![[[10.0, f32::NAN]; 3]]),
                ..ModelForm::default()
            },
            ..DetectorConfig::new("model.onnx")
        };
        let problems = config.problems();
        for key in [
            "threshold",
            "nms_iou",
            "overlap_px",
            "threads",
            "sha256",
            "anchors",
        ] {
            assert!(
                problems.iter().any(|line| line.starts_with(key)),
                "{key}: {problems:?}"
            );
        }
        assert_eq!(problems.len(), 6, "{problems:?}");
        assert!(DetectorConfig::new("model.onnx").problems().is_empty());
    }
}
