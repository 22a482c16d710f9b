//! Matching and average precision as COCO defines them (Lin et al. 2014; its published evaluation code):
//! greedy by score, truths outside the asked sizes neither found nor missed, precision at 101 recalls.

use crate::detect::{BoxPx, Mask};
use std::ops::Range;
use std::sync::Arc;

/// Found things of a class that count in one picture; the surest.
const MOST: usize = 100;
/// Recalls at which precision is read: 0, 0.01 .. 1.
const RECALLS: usize = 101;
/// Overlaps over which mAP50-95 is the mean.
pub const OVERLAPS: [f64; 10] = [0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95];
/// Areas of small, medium and large things, square pixels of the picture.
pub const SIZES: [(&str, Range<f64>); 3] = [
    ("small", 0.0..1024.0),
    ("medium", 1024.0..9216.0),
    ("large", 9216.0..1e10),
];
/// Everything.
pub const ANY_SIZE: Range<f64> = 0.0..1e10;

/// One thing in a picture, of one class.
#[derive(Debug, Clone)]
pub struct Thing {
    /// Where.
    pub box_px: BoxPx,
    /// Which pixels, if known.
    pub mask: Option<Arc<Mask>>,
    /// How sure; 1 for truth.
    pub score: f64,
}

/// What a thing's place is compared by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outline {
    /// Its box.
    Box,
    /// Its mask.
    Mask,
}

/// One picture, one class: what is there and what was found, the surest first.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    /// What is there.
    pub truth: Vec<Thing>,
    /// What was found.
    pub found: Vec<Thing>,
}

/// How one found thing fared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Judged {
    /// Number of the scene.
    pub scene: usize,
    /// Number within `found` of that scene.
    pub found: usize,
    /// Its score.
    pub score: f64,
    /// The truth that it found, if any.
    pub truth: Option<usize>,
}

impl Judged {
    /// Whether it found anything.
    #[must_use]
    pub fn is_right(&self) -> bool {
        self.truth.is_some()
    }
}

/// How all found things of a class fared at one overlap.
#[derive(Debug, Clone)]
pub struct Judgement {
    /// Best first; those that count neither way are left out.
    pub judged: Vec<Judged>,
    /// Truths that count, per scene.
    pub truths: Vec<usize>,
}

impl Outline {
    fn overlap(self, a: &Thing, b: &Thing) -> f64 {
        match self {
            Self::Box => a.box_px.iou(&b.box_px),
            Self::Mask => {
                let masks = a.mask.as_ref().zip(b.mask.as_ref());
                masks.map_or(0.0, |(a, b)| a.iou(b))
            }
        }
    }

    fn area(self, thing: &Thing) -> f64 {
        match self {
            Self::Box => thing.box_px.width * thing.box_px.height,
            Self::Mask => thing
                .mask
                .as_ref()
                .map_or(0.0, |mask| mask.area_px() as f64),
        }
    }
}

/// Judges what was found in all scenes at one overlap; `area` is what counts, both ends included.
#[must_use]
pub fn judge(scenes: &[Scene], overlap: f64, area: &Range<f64>, by: Outline) -> Judgement {
    let counts = |thing: &Thing| {
        let found = by.area(thing);
        found >= area.start && found <= area.end
    };
    let mut judged = Vec::new();
    for (number, scene) in scenes.iter().enumerate() {
        let mut taken = vec![false; scene.truth.len()];
        for (place, found) in scene.found.iter().take(MOST).enumerate() {
            let truth = best_free(scene, found, &taken, overlap, &counts, by);
            if let Some(truth) = truth {
                taken[truth] = true;
            }
            let is_counted =
                truth.map_or_else(|| counts(found), |truth| counts(&scene.truth[truth]));
            if is_counted {
                judged.push(Judged {
                    scene: number,
                    found: place,
                    score: found.score,
                    truth,
                });
            }
        }
    }
    judged.sort_by(|a, b| b.score.total_cmp(&a.score));
    let truths = |scene: &Scene| scene.truth.iter().filter(|truth| counts(truth)).count();
    Judgement {
        judged,
        truths: scenes.iter().map(truths).collect(),
    }
}

/// The truth that a found thing overlaps most and enough: one that counts before one that does not; of
/// equal overlap the later.
fn best_free(
    scene: &Scene,
    found: &Thing,
    taken: &[bool],
    overlap: f64,
    counts: &impl Fn(&Thing) -> bool,
    by: Outline,
) -> Option<usize> {
    let best_of = |counted: bool| {
        let mut best = None;
        let mut least = overlap.min(1.0 - 1e-10);
        for (number, truth) in scene.truth.iter().enumerate() {
            let shared = by.overlap(found, truth);
            if !taken[number] && counts(truth) == counted && shared >= least {
                least = shared;
                best = Some(number);
            }
        }
        best
    };
    best_of(true).or_else(|| best_of(false))
}

impl Judgement {
    /// Truths that count.
    #[must_use]
    pub fn total(&self) -> usize {
        self.truths.iter().sum()
    }

    /// Average precision; `None` where nothing is there to be found.
    #[must_use]
    pub fn average_precision(&self) -> Option<f64> {
        self.weighted_precision(|_| 1.0)
    }

    /// Average precision over scenes that count as often as their weights say.
    #[must_use]
    pub fn weighted_precision(&self, weight: impl Fn(usize) -> f64) -> Option<f64> {
        let truths = self.truths.iter().enumerate();
        let total: f64 = truths.map(|(scene, n)| weight(scene) * *n as f64).sum();
        if total <= 0.0 {
            return None;
        }
        let (mut right, mut all) = (0.0, 0.0);
        let mut curve: Vec<(f64, f64)> = self
            .judged
            .iter()
            .map(|judged| {
                let weight = weight(judged.scene);
                all += weight;
                right += if judged.is_right() { weight } else { 0.0 };
                (right / total, right / f64::max(all, f64::MIN_POSITIVE))
            })
            .collect();
        // The best precision at this recall or a greater one.
        let mut best = 0.0_f64;
        for (_, precision) in curve.iter_mut().rev() {
            best = best.max(*precision);
            *precision = best;
        }
        let at = |k: usize| {
            // As multiples of 0.01, not as hundredths: on the last bit hangs which side of a step it is.
            let recall = (k as f64 * 0.01).min(1.0);
            let reached = curve.partition_point(|(reached, _)| *reached < recall);
            curve.get(reached).map_or(0.0, |(_, precision)| *precision)
        };
        Some((0..RECALLS).map(at).sum::<f64>() / RECALLS as f64)
    }

    /// Right and false ones among those of at least this score.
    #[must_use]
    pub fn counts(&self, threshold: f64) -> (usize, usize) {
        let reached = self
            .judged
            .partition_point(|judged| judged.score >= threshold);
        let right = self.judged[..reached]
            .iter()
            .filter(|j| j.is_right())
            .count();
        (right, reached - right)
    }

    /// Points (recall, precision), best scores first.
    #[must_use]
    pub fn curve(&self) -> Vec<(f64, f64)> {
        let total = self.total().max(1) as f64;
        let mut right = 0.0;
        let of = |(before, judged): (usize, &Judged)| {
            right += f64::from(u8::from(judged.is_right()));
            (right / total, right / (before + 1) as f64)
        };
        self.judged.iter().enumerate().map(of).collect()
    }
}

/// Mean of average precision over [`OVERLAPS`].
#[must_use]
pub fn mean_precision(scenes: &[Scene], area: &Range<f64>, by: Outline) -> Option<f64> {
    let at = |overlap: &f64| judge(scenes, *overlap, area, by).average_precision();
    let precisions: Option<Vec<f64>> = OVERLAPS.iter().map(at).collect();
    precisions.map(|found| found.iter().sum::<f64>() / OVERLAPS.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn thing(x: f64, side: f64, score: f64) -> Thing {
        Thing {
            box_px: BoxPx {
                x,
                y: 0.0,
                width: side,
                height: side,
            },
            mask: None,
            score,
        }
    }

    fn judged(scene: Scene, overlap: f64, area: Range<f64>) -> Judgement {
        judge(&[scene], overlap, &area, Outline::Box)
    }

    #[test]
    fn a_truth_is_found_once_and_the_curve_is_read_at_101_recalls() {
        let scene = Scene {
            truth: vec![thing(0.0, 10.0, 1.0), thing(50.0, 10.0, 1.0)],
            found: vec![
                thing(0.0, 10.0, 0.9),
                thing(1.0, 10.0, 0.8),
                thing(50.0, 10.0, 0.7),
            ],
        };
        let judgement = judged(scene, 0.5, ANY_SIZE);
        assert_eq!(judgement.counts(0.75), (1, 1));
        // Precision 1 up to recall 0.5 (51 points), then 2 of 3.
        let expected = (51.0 + 50.0 * 2.0 / 3.0) / 101.0;
        assert!((judgement.average_precision().unwrap() - expected).abs() < 1e-12);
    }

    #[test]
    fn what_is_outside_the_sizes_counts_neither_way() {
        let scene = Scene {
            truth: vec![thing(0.0, 100.0, 1.0)],
            found: vec![
                thing(0.0, 100.0, 0.9),
                thing(300.0, 90.0, 0.8),
                thing(500.0, 9.0, 0.7),
            ],
        };
        let small = judged(scene.clone(), 0.5, SIZES[0].1.clone());
        assert_eq!(small.average_precision(), None);
        // The large ones are left out; the small one is false.
        assert_eq!((small.judged.len(), small.counts(0.0)), (1, (0, 1)));
        let large = judged(scene, 0.5, SIZES[1].1.clone());
        assert_eq!(large.counts(0.0), (0, 1));
    }

    #[test]
    fn weights_are_as_good_as_copies() {
        let scenes = [
            Scene {
                truth: vec![thing(0.0, 10.0, 1.0)],
                found: vec![thing(0.0, 10.0, 0.6)],
            },
            Scene {
                truth: vec![thing(0.0, 10.0, 1.0)],
                found: vec![thing(30.0, 10.0, 0.8)],
            },
        ];
        let copies = [scenes[0].clone(), scenes[0].clone(), scenes[1].clone()];
        let of = |scenes: &[Scene]| judge(scenes, 0.5, &ANY_SIZE, Outline::Box);
        let weighted = of(&scenes).weighted_precision(|scene| [2.0, 1.0][scene]);
        assert_eq!(weighted, of(&copies).average_precision());
    }
}
