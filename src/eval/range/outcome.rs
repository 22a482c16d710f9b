//! What a method said of a trial, against the truth.

use super::RangeEvalError;
use super::papers::FullFrame;
use super::stage::{Stage, Trial, Truth};
use crate::range::{Method, RangeConfig, Ranger, Ranging, open};
use std::sync::Mutex;

/// Who measures: our methods, and the papers' two readings of full-frame matching.
pub(super) const NAMES: [&str; 8] = [
    "sgbm",
    "centroid",
    "correlate",
    "cross_spectral",
    "best",
    "full-frame SGBM, P3's mask",
    "full-frame SGBM, P4's pixel",
    "full-frame SGBM, our mask",
];
/// The default's place among the names.
pub(super) const BEST: usize = 4;
/// Readings of the whole frame matched.
pub(super) const FULL_FRAME: std::ops::Range<usize> = 5..8;
/// Our methods.
pub(super) const OURS: usize = 5;
/// Sigma that a reading is taken to have whose method states none.
const UNSTATED_SIGMA_PX: f64 = 0.25;
/// A disparity that is wrong and puts the fire nearer than this share of its range is a phantom.
const PHANTOM_SHARE: f64 = 0.9;

/// What one method said of one trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Said {
    /// Disparity and sigma, if it gave any, weak or not.
    pub disparity: Option<(f64, f64)>,
    /// Whether it stands by the disparity as a range.
    pub measured: bool,
    pub truth_px: f64,
    pub verdict: Verdict,
}

/// How it did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Verdict {
    /// Within three of its sigmas, or beyond a reach that is true.
    Right,
    /// It gave no range.
    Refused,
    /// A range that is wrong and too near.
    PhantomNear,
    /// Any other wrong range.
    OtherWrong,
}

impl Verdict {
    pub(super) const ALL: [Self; 4] = [
        Self::Right,
        Self::Refused,
        Self::PhantomNear,
        Self::OtherWrong,
    ];
}

/// What everyone said of one trial, and the truth.
#[derive(Debug, Clone)]
pub(super) struct Round {
    pub truth: Truth,
    pub said: [Said; NAMES.len()],
}

/// Rangers of one stage, lent to one trial at a time.
pub(super) struct Bench<'a> {
    pub stage: &'a Stage,
    sets: Mutex<Vec<Set>>,
}

struct Set {
    ours: Vec<Box<dyn Ranger>>,
    papers: FullFrame,
}

impl<'a> Bench<'a> {
    pub(super) fn new(stage: &'a Stage) -> Self {
        Self {
            stage,
            sets: Mutex::new(Vec::new()),
        }
    }

    pub(super) fn round(&self, trial: &Trial) -> Result<Round, RangeEvalError> {
        let idle = self.sets.lock().ok().and_then(|mut sets| sets.pop());
        let mut set = match idle {
            Some(set) => set,
            None => self.set()?,
        };
        let said = self.said(&mut set, trial)?;
        if let Ok(mut sets) = self.sets.lock() {
            sets.push(set);
        }
        Ok(Round {
            truth: trial.truth,
            said,
        })
    }

    fn set(&self) -> Result<Set, RangeEvalError> {
        let config = config(self.stage);
        let ours = Method::ALL.map(|method| open(method, &self.stage.rig, &config));
        Ok(Set {
            ours: ours.into_iter().collect::<Result<_, _>>()?,
            papers: FullFrame::new(&self.stage.rig, self.stage.num_disparities)?,
        })
    }

    fn said(&self, set: &mut Set, trial: &Trial) -> Result<[Said; NAMES.len()], RangeEvalError> {
        let mut said = Vec::with_capacity(NAMES.len());
        for ranger in &mut set.ours {
            let ranging = ranger.range(&trial.pair, &trial.target)?;
            said.push(self.judge(&ranging, &trial.truth));
        }
        let reading = set.papers.read(&trial.pair, &trial.target.box_px)?;
        for disparity in [reading.masked_px, reading.single_px, reading.median_px] {
            let truth_px = trial.truth.disparity_px(reading.row);
            let disparity = disparity.map(|px| (px, UNSTATED_SIGMA_PX));
            said.push(Said::new(
                disparity,
                disparity.is_some(),
                truth_px,
                &trial.truth,
            ));
        }
        said.try_into().map_err(|_| RangeEvalError::Methods)
    }

    fn judge(&self, ranging: &Ranging, truth: &Truth) -> Said {
        match *ranging {
            Ranging::Measured {
                disparity_px,
                sigma_px,
                centroid,
                ..
            } => {
                let truth_px = truth.disparity_px(centroid.v);
                Said::new(Some((disparity_px, sigma_px)), true, truth_px, truth)
            }
            Ranging::BeyondReach {
                at_least_m, weak, ..
            } => {
                let truth_px = truth.disparity_px(weak.centroid.v);
                let said = Said::new(Some((weak.px, weak.sigma_px)), false, truth_px, truth);
                // "At least" is meant at two sigmas; a tenth beyond it is a claim that is wrong.
                let wrong = at_least_m > 1.1 * truth.depth_m(truth_px);
                Said {
                    verdict: if wrong {
                        Verdict::OtherWrong
                    } else {
                        Verdict::Refused
                    },
                    ..said
                }
            }
            Ranging::NoMatch { .. } => {
                Said::new(None, false, truth.disparity_px(truth.row()), truth)
            }
        }
    }
}

/// The service's own numbers, with the disparities that this stage needs.
pub(super) fn config(stage: &Stage) -> RangeConfig {
    RangeConfig {
        num_disparities: stage.num_disparities,
        ..RangeConfig::default()
    }
}

impl Said {
    fn new(disparity: Option<(f64, f64)>, measured: bool, truth_px: f64, truth: &Truth) -> Self {
        let verdict = match disparity {
            Some((px, sigma)) if measured => {
                let depth_m = truth.depth_m(truth_px);
                let off = px - truth_px;
                if off.abs() <= 3.0 * sigma {
                    Verdict::Right
                } else if off > 0.0 && truth.depth_m(px) < PHANTOM_SHARE * depth_m {
                    Verdict::PhantomNear
                } else {
                    Verdict::OtherWrong
                }
            }
            _ => Verdict::Refused,
        };
        Self {
            disparity,
            measured,
            truth_px,
            verdict,
        }
    }

    /// For the details.
    pub(super) fn told(&self, method: &str) -> serde_json::Value {
        let (px, sigma_px) = self.disparity.unzip();
        serde_json::json!({
            "method": method,
            "disparity_px": px,
            "sigma_px": sigma_px,
            "truth_px": self.truth_px,
            "measured": self.measured,
            "verdict": self.verdict,
        })
    }

    /// Error in pixels of the disparity, weak or not.
    pub(super) fn off_px(&self) -> Option<f64> {
        self.disparity.map(|(px, _)| px - self.truth_px)
    }

    /// The same in its own sigmas.
    pub(super) fn off_sigmas(&self) -> Option<f64> {
        self.disparity
            .map(|(px, sigma)| (px - self.truth_px) / sigma)
    }

    /// The measured disparity, if the method stands by it.
    pub(super) fn measured_px(&self) -> Option<f64> {
        self.disparity.filter(|_| self.measured).map(|(px, _)| px)
    }
}
