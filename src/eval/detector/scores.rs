//! What one detector's findings come to: by class, by size, by threshold, by score, by clip.

use super::coco::{
    ANY_SIZE, Judgement, OVERLAPS, Outline, SIZES, Scene, Thing, judge, mean_precision,
};
use crate::detect::DetectionClass;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::BTreeMap;

/// Draws of clips for an interval.
const DRAWS: usize = 1000;
/// Bins of the calibration curve.
const BINS: usize = 10;
/// False alarms an hour at which recall is told.
pub const RATES_PER_HOUR: [f64; 4] = [1.0, 10.0, 36.0, 72.0];

/// What is known of a picture, beside what was found in it.
#[derive(Debug, Clone)]
pub struct Shown {
    /// Clip that it is a frame of.
    pub clip: String,
    /// Whether smoke was labelled.
    pub smoke_labelled: bool,
    /// What is there.
    pub truth: Vec<(DetectionClass, Thing)>,
}

/// A value and the interval that holds it in 95 % of draws of clips.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    /// Over all pictures.
    pub value: f64,
    /// 2.5 % lie below.
    pub low: f64,
    /// 2.5 % lie above.
    pub high: f64,
}

/// Precision, recall and their harmonic mean at a threshold, at IoU 0.5.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AtThreshold {
    /// Least score.
    pub threshold: f64,
    /// Right ones among the found; none found is none wrong.
    pub precision: f64,
    /// Found ones among those that are there.
    pub recall: f64,
    /// Harmonic mean of both.
    pub f1: f64,
}

/// One bin of the calibration curve.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bin {
    /// Mean score.
    pub score: f64,
    /// Share that was right.
    pub right: f64,
    /// Findings.
    pub n: usize,
}

/// Recall where false alarms stay below a rate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AtRate {
    /// False alarms an hour.
    pub per_hour: f64,
    /// Least score that keeps to it.
    pub threshold: f64,
    /// Recall at it.
    pub recall: f64,
}

/// One clip.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClipScore {
    /// Name.
    pub clip: String,
    /// Pictures of it.
    pub pictures: usize,
    /// Truths in them.
    pub truths: usize,
    /// Right and false boxes at the threshold.
    pub right: usize,
    /// False boxes at the threshold.
    pub wrong: usize,
    /// Average precision at IoU 0.5, where there is something to be found.
    pub ap50: Option<f64>,
}

/// Everything of one class.
#[derive(Debug, Clone, Serialize)]
pub struct ClassScore {
    /// Which.
    pub class: DetectionClass,
    /// Truths.
    pub truths: usize,
    /// Pictures where the class was labelled.
    pub pictures: usize,
    /// Average precision at IoU 0.5.
    pub ap50: Option<Interval>,
    /// Its mean over IoU 0.5 to 0.95.
    pub ap50_95: Option<f64>,
    /// At IoU 0.5 by size: small, medium, large.
    pub ap50_by_size: [Option<f64>; 3],
    /// Truths of these sizes.
    pub truths_by_size: [usize; 3],
    /// Over IoU 0.5 to 0.95 by size.
    pub ap50_95_by_size: [Option<f64>; 3],
    /// Of masks, where truth has them: at IoU 0.5 and over 0.5 to 0.95.
    pub mask_ap: Option<[f64; 2]>,
    /// At the shipped threshold.
    pub shipped: AtThreshold,
    /// Pictures without anything that was labelled, and false boxes on them at the shipped threshold.
    pub negatives: usize,
    /// See `negatives`.
    pub false_boxes: usize,
    /// Share of pictures with the class in which at least one is found at the shipped threshold.
    pub frame_recall: Option<f64>,
    /// Where false alarms on negatives stay below a rate.
    pub at_rates: Vec<AtRate>,
    /// Calibration.
    pub reliability: Vec<Bin>,
    /// Mean distance of score and share of right ones.
    pub calibration_error: Option<f64>,
    /// By clip, most missed first.
    pub clips: Vec<ClipScore>,
    /// Recall and precision from the surest on.
    #[serde(skip)]
    pub curve: Vec<(f64, f64)>,
    #[serde(skip)]
    pub(super) judgement: Judgement,
    /// Scenes of the judgement are these pictures.
    #[serde(skip)]
    pub(super) of_picture: Vec<usize>,
}

/// Scores one class. `found` lists what was found, per picture; `hz` are pictures looked at a second.
pub fn class_score(
    class: DetectionClass,
    shown: &[Shown],
    found: &[Vec<(DetectionClass, Thing)>],
    threshold: f64,
    hz: f64,
) -> ClassScore {
    let is_labelled =
        |picture: &usize| class != DetectionClass::Smoke || shown[*picture].smoke_labelled;
    let of_picture: Vec<usize> = (0..shown.len()).filter(is_labelled).collect();
    let of_class = |things: &[(DetectionClass, Thing)]| -> Vec<Thing> {
        let of_class = things.iter().filter(|(of, _)| *of == class);
        of_class.map(|(_, thing)| thing.clone()).collect()
    };
    let scenes: Vec<Scene> = of_picture
        .iter()
        .map(|&picture| Scene {
            truth: of_class(&shown[picture].truth),
            found: of_class(&found[picture]),
        })
        .collect();
    let judgement = judge(&scenes, OVERLAPS[0], &ANY_SIZE, Outline::Box);
    let clips: Vec<&str> = of_picture.iter().map(|&k| shown[k].clip.as_str()).collect();
    let sized = |area: usize| judge(&scenes, OVERLAPS[0], &SIZES[area].1, Outline::Box);
    let sizes = [0, 1, 2].map(sized);
    let masked = scenes
        .iter()
        .flat_map(|scene| &scene.truth)
        .any(|truth| truth.mask.is_some());
    let mask_ap = || {
        let at_half = judge(&scenes, OVERLAPS[0], &ANY_SIZE, Outline::Mask).average_precision()?;
        Some([at_half, mean_precision(&scenes, &ANY_SIZE, Outline::Mask)?])
    };
    let is_empty: Vec<bool> = of_picture
        .iter()
        .map(|&k| shown[k].truth.is_empty())
        .collect();
    let negatives = Negatives::of(&is_empty, &judgement);
    let reliability = reliability(&judgement);
    ClassScore {
        class,
        truths: judgement.total(),
        pictures: scenes.len(),
        ap50: interval(&judgement, &clips),
        ap50_95: mean_precision(&scenes, &ANY_SIZE, Outline::Box),
        ap50_by_size: [0, 1, 2].map(|k: usize| sizes[k].average_precision()),
        truths_by_size: [0, 1, 2].map(|k: usize| sizes[k].total()),
        ap50_95_by_size: [0, 1, 2]
            .map(|k: usize| mean_precision(&scenes, &SIZES[k].1, Outline::Box)),
        mask_ap: masked.then(mask_ap).flatten(),
        shipped: at_threshold(&judgement, threshold),
        negatives: negatives.pictures,
        false_boxes: negatives.at(threshold),
        frame_recall: frame_recall(&judgement, threshold),
        at_rates: RATES_PER_HOUR
            .map(|per_hour| negatives.at_rate(&judgement, per_hour, hz))
            .to_vec(),
        calibration_error: calibration_error(&reliability),
        reliability,
        clips: by_clip(&judgement, &clips, threshold),
        curve: judgement.curve(),
        judgement,
        of_picture,
    }
}

/// Counts and shares of those of at least this score.
fn at_threshold(judgement: &Judgement, threshold: f64) -> AtThreshold {
    let (right, wrong) = judgement.counts(threshold);
    let share = |of: usize, none: f64| {
        if of > 0 {
            right as f64 / of as f64
        } else {
            none
        }
    };
    let (precision, recall) = (share(right + wrong, 1.0), share(judgement.total(), 0.0));
    AtThreshold {
        threshold,
        precision,
        recall,
        f1: harmonic_mean(&[precision, recall]),
    }
}

/// 0 when any of them is.
pub fn harmonic_mean(values: &[f64]) -> f64 {
    if values.iter().any(|value| *value <= 0.0) {
        return 0.0;
    }
    values.len() as f64 / values.iter().map(|value| 1.0 / value).sum::<f64>()
}

/// The mean, of some.
pub fn arithmetic_mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// AP50 over draws of whole clips with replacement: frames of a clip are no independent samples.
fn interval(judgement: &Judgement, clips: &[&str]) -> Option<Interval> {
    let value = judgement.average_precision()?;
    let mut numbers: BTreeMap<&str, usize> = BTreeMap::new();
    for clip in clips {
        let next = numbers.len();
        numbers.entry(clip).or_insert(next);
    }
    let of_scene: Vec<usize> = clips.iter().map(|clip| numbers[clip]).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut drawn: Vec<f64> = (0..DRAWS)
        .filter_map(|_| {
            let mut times = vec![0.0; numbers.len()];
            for _ in 0..numbers.len() {
                times[rng.random_range(0..numbers.len())] += 1.0;
            }
            judgement.weighted_precision(|scene| times[of_scene[scene]])
        })
        .collect();
    drawn.sort_by(f64::total_cmp);
    let at = |share: f64| drawn.get((share * drawn.len() as f64) as usize).copied();
    Some(Interval {
        value,
        low: at(0.025)?,
        high: at(0.975)?,
    })
}

/// Pictures without anything, and the scores of what was found in them, best first.
struct Negatives {
    pictures: usize,
    scores: Vec<f64>,
}

impl Negatives {
    fn of(is_empty: &[bool], judgement: &Judgement) -> Self {
        let on_negatives = judgement.judged.iter().filter(|j| is_empty[j.scene]);
        Self {
            pictures: is_empty.iter().filter(|empty| **empty).count(),
            scores: on_negatives.map(|judged| judged.score).collect(),
        }
    }

    fn at(&self, threshold: f64) -> usize {
        self.scores.partition_point(|score| *score >= threshold)
    }

    fn at_rate(&self, judgement: &Judgement, per_hour: f64, hz: f64) -> AtRate {
        let allowed = (per_hour / (hz * 3600.0) * self.pictures as f64) as usize;
        // Just above the first false box too many.
        let threshold = self
            .scores
            .get(allowed)
            .map_or(0.0, |score| score.next_up());
        AtRate {
            per_hour,
            threshold,
            recall: at_threshold(judgement, threshold).recall,
        }
    }
}

fn frame_recall(judgement: &Judgement, threshold: f64) -> Option<f64> {
    let with = judgement
        .truths
        .iter()
        .filter(|truths| **truths > 0)
        .count();
    let mut seen: Vec<usize> = judgement
        .judged
        .iter()
        .filter(|judged| judged.is_right() && judged.score >= threshold)
        .map(|judged| judged.scene)
        .collect();
    seen.sort_unstable();
    seen.dedup();
    (with > 0).then(|| seen.len() as f64 / with as f64)
}

fn reliability(judgement: &Judgement) -> Vec<Bin> {
    let bin = |number: usize| {
        let inside = |score: f64| ((score * BINS as f64) as usize).min(BINS - 1) == number;
        let of_bin: Vec<_> = judgement
            .judged
            .iter()
            .filter(|j| inside(j.score))
            .collect();
        let n = of_bin.len();
        let right = of_bin.iter().filter(|judged| judged.is_right()).count();
        (n > 0).then(|| Bin {
            score: of_bin.iter().map(|judged| judged.score).sum::<f64>() / n as f64,
            right: right as f64 / n as f64,
            n,
        })
    };
    (0..BINS).filter_map(bin).collect()
}

fn calibration_error(bins: &[Bin]) -> Option<f64> {
    let all: usize = bins.iter().map(|bin| bin.n).sum();
    let error: f64 = bins
        .iter()
        .map(|bin| (bin.score - bin.right).abs() * bin.n as f64)
        .sum();
    (all > 0).then(|| error / all as f64)
}

fn by_clip(judgement: &Judgement, clips: &[&str], threshold: f64) -> Vec<ClipScore> {
    let mut scores: BTreeMap<&str, ClipScore> = BTreeMap::new();
    for (clip, truths) in clips.iter().zip(&judgement.truths) {
        let score = scores.entry(clip).or_insert_with(|| ClipScore {
            clip: (*clip).to_owned(),
            pictures: 0,
            truths: 0,
            right: 0,
            wrong: 0,
            ap50: None,
        });
        score.pictures += 1;
        score.truths += truths;
    }
    for judged in judgement.judged.iter().filter(|j| j.score >= threshold) {
        if let Some(score) = scores.get_mut(clips[judged.scene]) {
            score.right += usize::from(judged.is_right());
            score.wrong += usize::from(!judged.is_right());
        }
    }
    for score in scores.values_mut() {
        let is_of_clip = |scene: usize| f64::from(u8::from(clips[scene] == score.clip));
        score.ap50 = judgement.weighted_precision(is_of_clip);
    }
    let mut scores: Vec<ClipScore> = scores.into_values().collect();
    scores.sort_by_key(|score| std::cmp::Reverse(score.truths - score.right.min(score.truths)));
    scores
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detect::BoxPx;

    fn thing(x: f64, score: f64) -> (DetectionClass, Thing) {
        let box_px = BoxPx {
            x,
            y: 0.0,
            width: 10.0,
            height: 10.0,
        };
        let thing = Thing {
            box_px,
            mask: None,
            score,
        };
        (DetectionClass::Fire, thing)
    }

    fn shown(clip: &str, truth: Vec<(DetectionClass, Thing)>) -> Shown {
        Shown {
            clip: clip.to_owned(),
            smoke_labelled: false,
            truth,
        }
    }

    #[test]
    fn counts_at_the_threshold_and_on_negatives() {
        let pictures = [
            shown("a", vec![thing(0.0, 1.0), thing(50.0, 1.0)]),
            shown("a", vec![]),
            shown("b", vec![]),
        ];
        let found = [
            vec![thing(0.0, 0.9), thing(80.0, 0.6), thing(50.0, 0.3)],
            vec![thing(0.0, 0.55)],
            vec![thing(0.0, 0.1)],
        ];
        let score = class_score(DetectionClass::Fire, &pictures, &found, 0.5, 1.0);
        assert_eq!(
            (score.shipped.precision, score.shipped.recall),
            (1.0 / 3.0, 0.5)
        );
        assert_eq!((score.negatives, score.false_boxes), (2, 1));
        assert_eq!(score.frame_recall, Some(1.0));
        // No false box allowed at so few negatives: only what is surer than 0.55 counts.
        assert_eq!(score.at_rates[0].recall, 0.5);
        assert_eq!(score.clips[0].clip, "a");
        assert_eq!((score.clips[0].right, score.clips[0].wrong), (1, 2));
    }

    #[test]
    fn smoke_is_scored_only_where_it_was_labelled() {
        let (_, smoke) = thing(0.0, 0.9);
        let pictures = [shown("a", vec![])];
        let found = [vec![(DetectionClass::Smoke, smoke)]];
        let score = class_score(DetectionClass::Smoke, &pictures, &found, 0.5, 1.0);
        assert_eq!(
            (score.pictures, score.negatives, score.false_boxes),
            (0, 0, 0)
        );
        assert!(score.ap50.is_none());
    }

    #[test]
    fn the_harmonic_mean_is_that_of_the_papers() {
        assert!((harmonic_mean(&[0.5, 1.0]) - 2.0 / 3.0).abs() < 1e-12);
        assert_eq!(harmonic_mean(&[0.0, 1.0]), 0.0);
    }
}
