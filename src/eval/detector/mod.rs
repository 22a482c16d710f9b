//! How well a detector finds fire in labelled pictures, and what it costs.
//!
//! **In:** a model, others to stand beside it, a data set (see [`dataset`]). **Out:** average precision
//! as COCO has it ([`coco`]), precision and recall at the shipped threshold, false alarms, calibration,
//! by class, by size and by clip, with intervals over clips ([`scores`]); the worst pictures; files that
//! other programs score; the time around inference; what tiles bring ([`tiling`]). **Assumptions.**
//! Where a picture's smoke was not labelled, smoke is not scored in it. Pictures are looked at whole,
//! once, but where tiles are what is measured.

pub mod coco;
mod coco_files;
mod contact_sheet;
pub mod dataset;
pub mod events;
mod hsv_rule;
mod overhead;
mod report;
pub mod scores;
#[cfg(test)]
mod second_look;
pub mod spectra;
pub mod tiling;

pub use contact_sheet::SheetError;
pub use dataset::{DatasetError, Spectrum};
pub use overhead::OverheadError;

use super::Report;
use crate::detect::{
    ClassPolicy, DetectError, Detection, DetectionClass, Detector, DetectorConfig, DetectorInfo,
    LeftImage, ModelError, OnnxDetector,
};
use crate::range::HsvMask;
use coco::Thing;
use contact_sheet::{Reviewed, Worst};
use dataset::{Loaded, Picture};
use emberfix_frames::ServiceTime;
use hsv_rule::HsvRule;
use opencv::core::{Mat, MatTraitConst};
use scores::{ClassScore, Shown, class_score};
use serde::Serialize;
use std::path::PathBuf;

/// What is measured.
#[derive(Debug, Clone)]
pub struct Options {
    /// The detector.
    pub model: DetectorConfig,
    /// Others, in the same tables.
    pub beside: Vec<DetectorConfig>,
    /// The data set.
    pub dataset: PathBuf,
    /// Its split, where it has splits.
    pub split: String,
    /// Its spectrum, where it has both.
    pub spectrum: Spectrum,
    /// Pictures that are looked at in a second, for rates of false alarms.
    pub hz: f64,
}

/// Least score that is kept: below it nothing is drawn on any curve.
const FLOOR: f64 = 0.01;
/// Pictures on which time is taken.
const TIMED: usize = 12;
/// A rule that has no threshold of its own.
const RULE_THRESHOLD: f64 = 0.0;

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
pub enum DetectorEvalError {
    /// The data set.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A model was refused.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A picture was not looked at.
    #[error("picture {number}: {source}")]
    Detect {
        /// From 0, in the data set's order.
        number: usize,
        /// Why.
        source: DetectError,
    },
    /// Time could not be taken.
    #[error(transparent)]
    Overhead(#[from] OverheadError),
    /// OpenCV refused.
    #[error(transparent)]
    OpenCv(#[from] opencv::Error),
    /// A flight was not flown.
    #[error(transparent)]
    Events(#[from] events::EventsError),
    /// The worst pictures could not be drawn.
    #[error(transparent)]
    Sheet(#[from] SheetError),
}

/// What was measured.
pub struct Measured {
    /// Figures, tables, plots.
    pub report: Report,
    /// Pictures of the worst, by the stem of their file's name.
    pub sheets: Vec<(&'static str, Mat)>,
    /// COCO's files of the detector, by the stem of their name.
    pub files: Vec<(&'static str, serde_json::Value)>,
}

/// One detector's scores.
#[derive(Debug, Clone, Serialize)]
pub struct Scored {
    /// Name of its file, or of the rule.
    pub name: String,
    /// Fire, then smoke.
    pub classes: Vec<ClassScore>,
}

/// A detector that is scored, and what it was shipped with.
struct Contender {
    name: String,
    detector: Box<dyn Detector>,
    /// Fire, smoke.
    thresholds: [f64; 2],
}

const CLASSES: [DetectionClass; 2] = [DetectionClass::Fire, DetectionClass::Smoke];

/// Pictures of this choice.
///
/// # Errors
/// [`DatasetError`].
pub fn pictures(options: &Options) -> Result<Vec<Picture>, DatasetError> {
    dataset::pictures(&options.dataset, &options.split, options.spectrum)
}

/// Measures on these pictures. `told` hears of each picture that is done with.
///
/// # Errors
/// [`DetectorEvalError`].
pub fn measure(
    options: &Options,
    pictures: &[Picture],
    told: &dyn Fn(),
) -> Result<Measured, DetectorEvalError> {
    let mut contenders = vec![Contender::load(&options.model)?];
    for beside in &options.beside {
        contenders.push(Contender::load(beside)?);
    }
    contenders.push(Contender::rule());
    let looked = look(&mut contenders, pictures, told)?;
    let scored: Vec<Scored> = contenders
        .iter()
        .zip(&looked.found)
        .map(|(contender, found)| contender.scored(&looked.shown, found, options.hz))
        .collect();
    let spent = overhead::measure(&options.model, &looked.timed)?;
    let first = &looked.found[0];
    let fire = &scored[0].classes[0];
    let reviewed = Reviewed {
        pictures,
        shown: &looked.shown,
        found: first,
    };
    let worst = Worst::of(fire, &looked.shown);
    let draw = |chosen: &[usize]| reviewed.sheet(chosen, fire.class, fire.shipped.threshold);
    Ok(Measured {
        sheets: vec![
            ("detector_misses", draw(&worst.misses)?),
            ("detector_false_alarms", draw(&worst.false_alarms)?),
        ],
        files: vec![
            (
                "detector_truth",
                coco_files::truth(&looked.shown, &looked.sizes),
            ),
            (
                "detector_found",
                coco_files::found(&looked.shown, first, &looked.sizes),
            ),
        ],
        report: report::report(options, &scored, &spent),
    })
}

/// What all detectors found in all pictures.
struct Looked {
    shown: Vec<Shown>,
    sizes: Vec<(u32, u32)>,
    /// By detector, by picture, the surest first.
    found: Vec<Vec<Vec<(DetectionClass, Thing)>>>,
    /// Some of the pictures themselves, evenly chosen.
    timed: Vec<Mat>,
}

fn look(
    contenders: &mut [Contender],
    pictures: &[Picture],
    told: &dyn Fn(),
) -> Result<Looked, DetectorEvalError> {
    let mut looked = Looked {
        shown: Vec::new(),
        sizes: Vec::new(),
        found: vec![Vec::new(); contenders.len()],
        timed: Vec::new(),
    };
    let every = pictures.len().div_ceil(TIMED);
    for (number, picture) in pictures.iter().enumerate() {
        let Loaded { bgr, truth } = picture.load()?;
        looked.sizes.push((bgr.cols() as u32, bgr.rows() as u32));
        if number.is_multiple_of(every) {
            looked.timed.push(bgr.clone());
        }
        for (contender, all) in contenders.iter_mut().zip(&mut looked.found) {
            all.push(contender.look(&bgr, number)?);
        }
        looked.shown.push(Shown {
            clip: picture.clip.clone(),
            smoke_labelled: picture.smoke_labelled,
            truth,
        });
        told();
    }
    Ok(looked)
}

impl Contender {
    /// A model at a threshold so low that its whole curve is seen, and the thresholds it ships with.
    fn load(config: &DetectorConfig) -> Result<Self, ModelError> {
        Self::load_with(config, None)
    }

    fn load_with(config: &DetectorConfig, tile_px: Option<u32>) -> Result<Self, ModelError> {
        let shipped = OnnxDetector::load(config)?;
        let all = DetectorConfig {
            threshold: Some(FLOOR),
            tile_px,
            ..config.clone()
        };
        let name = config.model.file_stem().unwrap_or_default();
        Ok(Self {
            name: name.to_string_lossy().into_owned(),
            detector: Box::new(OnnxDetector::load(&all)?),
            thresholds: [ClassPolicy::Fire, ClassPolicy::Smoke]
                .map(|policy| threshold(shipped.info(), policy)),
        })
    }

    fn rule() -> Self {
        Self {
            name: "HSV rule (P3)".to_owned(),
            detector: Box::new(HsvRule(HsvMask::printed())),
            thresholds: [RULE_THRESHOLD; 2],
        }
    }

    fn look(
        &mut self,
        bgr: &Mat,
        number: usize,
    ) -> Result<Vec<(DetectionClass, Thing)>, DetectorEvalError> {
        let image = LeftImage {
            at: ServiceTime::from_unix_ns(0),
            sequence: number as u64,
            bgr: bgr.clone(),
            ground: None,
        };
        let found = self.detector.detect(&image);
        let found = found.map_err(|source| DetectorEvalError::Detect { number, source })?;
        let thing = |one: Detection| {
            let thing = Thing {
                box_px: one.box_px,
                mask: one.mask,
                score: one.score,
            };
            (one.class, thing)
        };
        Ok(found.into_iter().map(thing).collect())
    }

    fn scored(&self, shown: &[Shown], found: &[Vec<(DetectionClass, Thing)>], hz: f64) -> Scored {
        let of = |(class, threshold): (DetectionClass, f64)| {
            class_score(class, shown, found, threshold, hz)
        };
        Scored {
            name: self.name.clone(),
            classes: CLASSES.into_iter().zip(self.thresholds).map(of).collect(),
        }
    }
}

/// Least score of the classes that mean this; above all scores where none does.
fn threshold(info: &DetectorInfo, policy: ClassPolicy) -> f64 {
    let of_policy = info.classes.iter().filter(|class| class.policy == policy);
    let least = of_policy.map(|class| class.threshold).reduce(f64::min);
    least.unwrap_or(f64::INFINITY)
}
