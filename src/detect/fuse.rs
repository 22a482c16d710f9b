//! What two spectra say together: a visible eye's detections and those of a near-infrared or thermal eye
//! beside it (P4: fusion of decisions by confidence and GIoU).
//!
//! **In:** both eyes' detections as boxes of the rectified pictures, where one thing stands in one row.
//! **Out:** one list in the left eye's place, each with the [`Verdict`] that it came by. Pure.
//!
//! Which boxes mean one thing is told by GIoU (Rezatofighi et al. 2019): it falls on, below 0, where boxes
//! do not even touch. A thing's disparity is not known yet, so that the right box may be shifted along its
//! row by any disparity that the range of things allows. P4 gives no thresholds: these are ours.

use super::{BoxPx, DetectionClass};

/// How decisions are fused.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusionConfig {
    /// GIoU from which two boxes mean one thing.
    pub agree_giou: f64,
    /// GIoU from which two boxes that do not agree still contend for one place.
    pub contend_giou: f64,
    /// What a flame's score is worth that the other eye should see and does not.
    pub one_sided: f64,
    /// What the right eye's scores are worth against the left's.
    pub right_trust: f64,
    /// Least fused score that counts.
    pub threshold: f64,
}

impl Default for FusionConfig {
    fn default() -> Self {
        Self {
            agree_giou: 0.3,
            contend_giou: 0.0,
            one_sided: 1.0,
            right_trust: 0.4,
            threshold: 0.6,
        }
    }
}

impl FusionConfig {
    /// Every number that is out of range: key, value, allowed range. Empty when all is well.
    #[must_use]
    pub fn problems(&self) -> Vec<String> {
        let ranges = [
            ("agree_giou", self.agree_giou, -1.0, 1.0),
            ("contend_giou", self.contend_giou, -1.0, self.agree_giou),
            ("one_sided", self.one_sided, 0.0, 1.0),
            ("right_trust", self.right_trust, 0.0, 1.0),
            ("threshold", self.threshold, 0.01, 1.0),
        ];
        let outside = ranges
            .into_iter()
            .filter(|(_, value, low, high)| !(*low..=*high).contains(value));
        outside
            .map(|(key, value, low, high)| format!("{key} is {value}, allowed is {low} to {high}"))
            .collect()
    }
}

/// One eye's detection in its rectified picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sided {
    /// What.
    pub class: DetectionClass,
    /// Score, 0..1.
    pub score: f64,
    /// Where.
    pub box_px: BoxPx,
    /// Whether the other eye's picture holds the place.
    pub in_both: bool,
}

/// The rule that a decision came by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Both eyes show it: as sure as that not both are wrong, `1 - (1 - a)(1 - b)`, and it stands where
    /// both say, each weighed by its score.
    Agreement,
    /// One eye shows it where the other shows nothing: a flame is worth less for it, since both spectra
    /// show flames; smoke is not, since it hides in infrared. What the other eye can't see is left as it is.
    OneSided,
    /// Both eyes show something there, and not the same: the surer stands, as sure as that the other is
    /// wrong, `a (1 - b)`. What only looks like fire contends with what is taken for one.
    Conflict,
}

/// One decision.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fused {
    /// What.
    pub class: DetectionClass,
    /// Fused score, 0..1.
    pub score: f64,
    /// Where, in the left eye's rectified picture.
    pub box_px: BoxPx,
    /// By which rule.
    pub verdict: Verdict,
    /// Which of the left eye's detections it is, if that eye had one.
    pub left: Option<usize>,
}

/// Fuses both eyes' detections. `disparity_px` is what the right eye's place (column, row) is expected to
/// have; `reach_px` are the least and the greatest that any thing has.
#[must_use]
pub fn fuse(
    left: &[Sided],
    right: &[Sided],
    config: &FusionConfig,
    reach_px: (f64, f64),
    disparity_px: impl Fn(f64, f64) -> f64,
) -> Vec<Fused> {
    let trusted = |one: &Sided| Sided {
        score: one.score * config.right_trust,
        ..*one
    };
    let right: &[Sided] = &right.iter().map(trusted).collect::<Vec<_>>();
    let mut pairs = pairs(left, right, config.contend_giou, reach_px);
    pairs.sort_by(|a, b| b.giou.total_cmp(&a.giou));
    let (mut left_free, mut right_free) = (vec![true; left.len()], vec![true; right.len()]);
    let mut fused = Vec::new();
    for pair in pairs {
        if left_free[pair.left] && right_free[pair.right] {
            (left_free[pair.left], right_free[pair.right]) = (false, false);
            fused.push(pair.decision(left, right, config));
        }
    }
    for (index, one) in left
        .iter()
        .enumerate()
        .filter(|(index, _)| left_free[*index])
    {
        fused.push(alone(one, one.box_px, Some(index), config));
    }
    for (one, _) in right
        .iter()
        .zip(&right_free)
        .filter(|(_, is_free)| **is_free)
    {
        let (column, row) = one.box_px.base();
        let place = shifted(
            &one.box_px,
            disparity_px(column, row).clamp(reach_px.0, reach_px.1),
        );
        fused.push(alone(one, place, None, config));
    }
    fused.retain(|one| one.score >= config.threshold);
    fused.sort_by(|a, b| b.score.total_cmp(&a.score));
    fused
}

/// Two boxes that may be of one thing.
struct Pair {
    left: usize,
    right: usize,
    /// The right box where it comes to lie best.
    place: BoxPx,
    giou: f64,
}

fn pairs(left: &[Sided], right: &[Sided], least_giou: f64, reach_px: (f64, f64)) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for (index, one) in left.iter().enumerate() {
        for (other_index, other) in right.iter().enumerate() {
            let apart = one.box_px.centre().0 - other.box_px.centre().0;
            let place = shifted(&other.box_px, apart.clamp(reach_px.0, reach_px.1));
            let giou = one.box_px.giou(&place);
            if giou >= least_giou {
                pairs.push(Pair {
                    left: index,
                    right: other_index,
                    place,
                    giou,
                });
            }
        }
    }
    pairs
}

impl Pair {
    fn decision(&self, left: &[Sided], right: &[Sided], config: &FusionConfig) -> Fused {
        let (a, b) = (&left[self.left], &right[self.right]);
        if a.class == b.class && self.giou >= config.agree_giou {
            return Fused {
                class: a.class,
                score: 1.0 - (1.0 - a.score) * (1.0 - b.score),
                box_px: between(&a.box_px, a.score, &self.place, b.score),
                verdict: Verdict::Agreement,
                left: Some(self.left),
            };
        }
        let (class, score, box_px) = if a.score >= b.score {
            (a.class, a.score * (1.0 - b.score), a.box_px)
        } else {
            (b.class, b.score * (1.0 - a.score), self.place)
        };
        Fused {
            class,
            score,
            box_px,
            verdict: Verdict::Conflict,
            left: Some(self.left),
        }
    }
}

fn alone(one: &Sided, box_px: BoxPx, left: Option<usize>, config: &FusionConfig) -> Fused {
    let should_show = one.in_both && one.class == DetectionClass::Fire;
    Fused {
        class: one.class,
        score: one.score * if should_show { config.one_sided } else { 1.0 },
        box_px,
        verdict: Verdict::OneSided,
        left,
    }
}

fn shifted(box_px: &BoxPx, by_px: f64) -> BoxPx {
    BoxPx {
        x: box_px.x + by_px,
        ..*box_px
    }
}

/// Edges between two boxes', each weighed.
fn between(a: &BoxPx, weight_a: f64, b: &BoxPx, weight_b: f64) -> BoxPx {
    let share = weight_b / (weight_a + weight_b).max(f64::MIN_POSITIVE);
    let mid = |a: f64, b: f64| a + share * (b - a);
    BoxPx {
        x: mid(a.x, b.x),
        y: mid(a.y, b.y),
        width: mid(a.width, b.width),
        height: mid(a.height, b.height),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(x: f64, y: f64, score: f64) -> Sided {
        Sided {
            class: DetectionClass::Fire,
            score,
            box_px: BoxPx {
                x,
                y,
                width: 20.0,
                height: 30.0,
            },
            in_both: true,
        }
    }

    fn fused(left: &[Sided], right: &[Sided]) -> Vec<Fused> {
        let config = FusionConfig {
            agree_giou: 0.2,
            contend_giou: 0.0,
            one_sided: 0.7,
            right_trust: 1.0,
            threshold: 0.0,
        };
        fuse(left, right, &config, (0.0, 12.0), |_, _| 5.0)
    }

    #[test]
    fn eyes_that_agree_are_surer_than_either_wherever_in_the_row_the_thing_stands() {
        let found = fused(&[seen(100.0, 50.0, 0.5)], &[seen(92.0, 50.0, 0.5)]);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].verdict, Verdict::Agreement);
        assert!((found[0].score - 0.75).abs() < 1e-12);
        assert!(
            (found[0].box_px.x - 100.0).abs() < 1e-12,
            "shifted by its disparity"
        );
    }

    #[test]
    fn no_disparity_reaches_another_row_or_beyond_the_nearest_thing() {
        for other in [
            seen(100.0, 95.0, 0.6),
            seen(60.0, 50.0, 0.6),
            seen(130.0, 50.0, 0.6),
        ] {
            let found = fused(&[seen(100.0, 50.0, 0.5)], &[other]);
            assert_eq!(found.len(), 2);
            assert!(found.iter().all(|one| one.verdict == Verdict::OneSided));
            assert_eq!(
                found[0].box_px.x,
                other.box_px.x + 5.0,
                "at the expected disparity"
            );
        }
    }

    #[test]
    fn a_flame_that_one_eye_alone_shows_is_worth_less_unless_the_other_cannot_see_it() {
        let lone = seen(100.0, 50.0, 0.8);
        assert!(fused(&[lone], &[])[0].score < 0.8);
        let outside = Sided {
            in_both: false,
            ..lone
        };
        assert_eq!(fused(&[outside], &[])[0].score, 0.8);
        let smoke = Sided {
            class: DetectionClass::Smoke,
            ..lone
        };
        assert_eq!(
            fused(&[smoke], &[])[0].score,
            0.8,
            "smoke hides in infrared"
        );
    }

    #[test]
    fn eyes_that_contradict_each_other_leave_the_surer_in_doubt() {
        let cold = Sided {
            class: DetectionClass::NonFire,
            ..seen(98.0, 50.0, 0.6)
        };
        let found = fused(&[seen(100.0, 50.0, 0.9)], &[cold]);
        assert_eq!((found.len(), found[0].verdict), (1, Verdict::Conflict));
        assert_eq!(found[0].class, DetectionClass::Fire);
        assert!((found[0].score - 0.36).abs() < 1e-12);
    }
}
