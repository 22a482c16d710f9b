//! One box per flame: suppression per class, pieces joined across tile borders, lookalikes.

use super::mask::Mask;
use super::{BoxPx, Detection, DetectionClass};
use std::sync::Arc;

/// Boxes that enter suppression, of one view and of all, at most; the best ones. Bounds its time at any
/// output.
const MAX_CANDIDATES: usize = 512;

/// Share of the smaller box inside the other from which boxes of two views are one flame.
const CONTAINED: f64 = 0.6;

/// Share of the smaller piece that two pieces of a cut flame have in common.
const JOINED: f64 = 0.15;

/// One box as one view saw it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Candidate {
    pub class: DetectionClass,
    pub score: f64,
    pub box_px: BoxPx,
    pub mask: Option<Arc<Mask>>,
    /// Its number among the boxes that the view's answer held.
    pub number: usize,
    /// Which view.
    pub view: usize,
    /// Input pixels per raw pixel in it.
    pub scale: f64,
    /// A border inside the image ends it.
    pub cut: bool,
}

/// What one view saw, each thing once, best first: plain class-wise suppression.
pub(super) fn within_view(mut candidates: Vec<Candidate>, iou: f64) -> Vec<Candidate> {
    best_first(&mut candidates);
    keep_first(candidates, |kept, next| kept.box_px.iou(&next.box_px) > iou)
}

/// What all views saw, best first, from what each view saw.
pub(super) fn merge(mut candidates: Vec<Candidate>, iou: f64) -> Vec<Detection> {
    best_first(&mut candidates);
    let kept = suppress(join_pieces(candidates), iou);
    let mut detections: Vec<Detection> = without_lookalikes(&kept, iou)
        .map(|kept| Detection {
            class: kept.class,
            score: kept.score,
            box_px: kept.box_px,
            mask: kept.mask.clone(),
            second_look: None,
        })
        .collect();
    detections.sort_by(|a, b| b.score.total_cmp(&a.score));
    detections
}

fn best_first(candidates: &mut Vec<Candidate>) {
    candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
    candidates.truncate(MAX_CANDIDATES);
}

/// Joins pieces of one flame that tile borders cut, where no view shows it whole.
fn join_pieces(candidates: Vec<Candidate>) -> Vec<Candidate> {
    let (pieces, mut whole): (Vec<_>, Vec<_>) = candidates.into_iter().partition(|c| c.cut);
    let mut joined: Vec<Candidate> = Vec::new();
    for piece in pieces {
        let mut union = piece;
        // A piece can bridge two groups: take in every group that it touches.
        joined.retain(|group| {
            let touches = group.class == union.class && shared_of_smaller(group, &union) > JOINED;
            if touches {
                union = united(group, &union);
            }
            !touches
        });
        joined.push(union);
    }
    whole.extend(joined);
    whole
}

/// Class-wise suppression across views. The view that shows a box best comes first: one that does
/// not cut it, at the finest scale, by score.
fn suppress(mut candidates: Vec<Candidate>, iou: f64) -> Vec<Candidate> {
    candidates.sort_by(|a, b| {
        let finer = b.scale.total_cmp(&a.scale);
        a.cut
            .cmp(&b.cut)
            .then(finer)
            .then(b.score.total_cmp(&a.score))
    });
    keep_first(candidates, |kept, next| {
        let contained = kept.view != next.view && shared_of_smaller(kept, next) > CONTAINED;
        contained || kept.box_px.iou(&next.box_px) > iou
    })
}

fn keep_first(
    candidates: Vec<Candidate>,
    same: impl Fn(&Candidate, &Candidate) -> bool,
) -> Vec<Candidate> {
    let mut kept: Vec<Candidate> = Vec::new();
    for next in candidates {
        if !kept
            .iter()
            .any(|kept| kept.class == next.class && same(kept, &next))
        {
            kept.push(next);
        }
    }
    kept
}

/// A fire that a lookalike overlaps goes when the model is at least as sure of the lookalike.
fn without_lookalikes(kept: &[Candidate], iou: f64) -> impl Iterator<Item = &Candidate> {
    kept.iter().filter(move |fire| {
        fire.class != DetectionClass::Fire
            || !kept.iter().any(|other| {
                other.class == DetectionClass::NonFire
                    && other.score >= fire.score
                    && (other.box_px.iou(&fire.box_px) > iou
                        || shared_of_smaller(other, fire) > CONTAINED)
            })
    })
}

fn united(a: &Candidate, b: &Candidate) -> Candidate {
    let best = if a.score >= b.score { a } else { b };
    let (x, y) = (a.box_px.x.min(b.box_px.x), a.box_px.y.min(b.box_px.y));
    let right = (a.box_px.x + a.box_px.width).max(b.box_px.x + b.box_px.width);
    let bottom = (a.box_px.y + a.box_px.height).max(b.box_px.y + b.box_px.height);
    let box_px = BoxPx {
        x,
        y,
        width: right - x,
        height: bottom - y,
    };
    let masks = a.mask.as_ref().zip(b.mask.as_ref());
    Candidate {
        box_px,
        mask: masks.map(|(a, b)| Arc::new(a.united(b, &box_px))),
        ..best.clone()
    }
}

/// Shared area over the smaller of the two areas.
fn shared_of_smaller(a: &Candidate, b: &Candidate) -> f64 {
    let (a, b) = (&a.box_px, &b.box_px);
    let (area_a, area_b) = (a.width * a.height, b.width * b.height);
    // From IoU s / (A + B - s): s = IoU (A + B) / (1 + IoU).
    let iou = a.iou(b);
    iou * (area_a + area_b) / (1.0 + iou) / area_a.min(area_b)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fire(x: f64, y: f64, width: f64, height: f64, score: f64) -> Candidate {
        Candidate {
            class: DetectionClass::Fire,
            score,
            box_px: BoxPx {
                x,
                y,
                width,
                height,
            },
            mask: None,
            number: 0,
            view: 1,
            scale: 1.0,
            cut: false,
        }
    }

    /// What one view or more saw, as a detector puts it together.
    fn merge(candidates: Vec<Candidate>, iou: f64) -> Vec<Detection> {
        let views = candidates.iter().map(|candidate| candidate.view).max();
        let of = |view| {
            let seen = candidates.iter().filter(move |seen| seen.view == view);
            within_view(seen.cloned().collect(), iou)
        };
        super::merge((0..=views.unwrap_or(0)).flat_map(of).collect(), iou)
    }

    #[test]
    fn the_mask_of_a_joined_flame_is_that_of_its_pieces() {
        let piece = |view, x: f64| {
            let mut piece = fire(x, 0.0, 10.0, 10.0, 0.6);
            piece.mask = Some(Arc::new(Mask::within(&piece.box_px, |_, row| row < 5.0)));
            Candidate {
                view,
                cut: true,
                ..piece
            }
        };
        let found = merge(vec![piece(1, 0.0), piece(2, 6.0)], 0.5);
        assert_eq!(found.len(), 1);
        // Columns 0 to 16, rows 0 to 4.
        assert_eq!(found[0].mask.as_ref().unwrap().area_px(), 17 * 5);
    }

    #[test]
    fn the_best_of_overlapping_boxes_stays_and_classes_do_not_mix() {
        let smoke = Candidate {
            class: DetectionClass::Smoke,
            ..fire(0.0, 0.0, 10.0, 10.0, 0.5)
        };
        let found = merge(
            vec![
                fire(0.0, 0.0, 10.0, 10.0, 0.6),
                fire(1.0, 0.0, 10.0, 10.0, 0.9),
                smoke,
                fire(50.0, 0.0, 10.0, 10.0, 0.7),
            ],
            0.5,
        );
        let scores: Vec<f64> = found.iter().map(|detection| detection.score).collect();
        assert_eq!(scores, [0.9, 0.7, 0.5]);
    }

    #[test]
    fn a_flame_that_a_border_cuts_becomes_one_box() {
        // Tiles end at 416 and begin at 288: 128 px in common; the flame spans 200 to 520.
        let left = Candidate {
            cut: true,
            ..fire(200.0, 100.0, 216.0, 50.0, 0.8)
        };
        let right = Candidate {
            cut: true,
            view: 2,
            ..fire(288.0, 98.0, 232.0, 54.0, 0.7)
        };
        let found = merge(vec![left, right], 0.5);
        assert_eq!(found.len(), 1);
        assert_eq!(
            found[0].box_px,
            BoxPx {
                x: 200.0,
                y: 98.0,
                width: 320.0,
                height: 54.0
            }
        );
    }

    #[test]
    fn four_tiles_around_a_corner_make_one_box() {
        let piece = |view, x, y| Candidate {
            cut: true,
            view,
            ..fire(x, y, 140.0, 140.0, 0.6)
        };
        let found = merge(
            vec![
                piece(1, 0.0, 0.0),
                piece(4, 80.0, 80.0),
                piece(2, 80.0, 0.0),
                piece(3, 0.0, 80.0),
            ],
            0.5,
        );
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(
            found[0].box_px,
            BoxPx {
                x: 0.0,
                y: 0.0,
                width: 220.0,
                height: 220.0
            }
        );
    }

    #[test]
    fn a_piece_gives_way_to_the_view_that_shows_it_whole() {
        let whole = fire(380.0, 100.0, 60.0, 80.0, 0.5);
        let piece = Candidate {
            cut: true,
            view: 2,
            ..fire(380.0, 100.0, 36.0, 80.0, 0.9)
        };
        let found = merge(vec![whole.clone(), piece], 0.5);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].box_px, whole.box_px);
    }

    #[test]
    fn two_flames_that_a_tile_tells_apart_stay_two() {
        let coarse = Candidate {
            view: 0,
            scale: 0.325,
            ..fire(100.0, 100.0, 60.0, 30.0, 0.95)
        };
        let found = merge(
            vec![
                coarse,
                fire(100.0, 100.0, 25.0, 30.0, 0.6),
                fire(135.0, 100.0, 25.0, 30.0, 0.6),
            ],
            0.5,
        );
        assert_eq!(found.len(), 2, "{found:?}");
    }

    #[test]
    fn a_surer_lookalike_suppresses_the_fire_and_a_weaker_one_does_not() {
        let lookalike = |score| Candidate {
            class: DetectionClass::NonFire,
            ..fire(0.0, 0.0, 10.0, 10.0, score)
        };
        let fires = |score| {
            merge(vec![fire(1.0, 1.0, 9.0, 9.0, 0.6), lookalike(score)], 0.5)
                .iter()
                .filter(|detection| detection.class == DetectionClass::Fire)
                .count()
        };
        assert_eq!((fires(0.7), fires(0.5)), (0, 1));
    }

    #[test]
    fn ten_thousand_boxes_take_bounded_time() {
        let many = (0..10_000).map(|k| {
            fire(
                f64::from(k % 100) * 12.0,
                f64::from(k / 100) * 12.0,
                10.0,
                10.0,
                0.5,
            )
        });
        assert_eq!(merge(many.collect(), 0.5).len(), MAX_CANDIDATES);
    }
}
