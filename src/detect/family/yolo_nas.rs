//! YOLO-NAS: boxes `[1, rows, 4]` (left, top, right, bottom in input pixels) and scores
//! `[1, rows, classes]` (sigmoid applied), without objectness. Their names and order vary.

use super::{Corners, Head, HeadProblem, InputBox, ModelShape, Output, best_class, wrong_output};

const SIDES: i64 = 4;

/// Boxes in one output, scores in another.
pub struct BoxesAndScores {
    classes: usize,
    boxes: usize,
    scores: usize,
    /// Input pixels per unit of the boxes: across, down.
    unit: [f32; 2],
}

pub fn head(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> Result<Box<dyn Head>, HeadProblem> {
    let (boxes, scores) = tell_apart(model, outputs)
        .ok_or_else(|| wrong_output("[1, rows, 4] and [1, rows, classes]", outputs))?;
    BoxesAndScores::head(model, outputs, (boxes, scores), [1.0; 2])
}

/// Which output holds boxes and which scores: by the last axis, and by value where that is 4 for
/// both, and by order where values do not decide.
fn tell_apart(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> Option<(usize, usize)> {
    let [first, second] = outputs else {
        return None;
    };
    let (a, b) = match (first.shape, second.shape) {
        (&[1, rows, a], &[1, same, b]) if rows == same && rows > 0 => (a, b),
        _ => return None,
    };
    match (a == SIDES, b == SIDES) {
        (true, false) => Some((0, 1)),
        (false, true) => Some((1, 0)),
        (true, true) if model.classes == SIDES as usize => {
            let swapped = first.is_probable() && !second.is_probable();
            Some(if swapped { (1, 0) } else { (0, 1) })
        }
        _ => None,
    }
}

impl BoxesAndScores {
    /// For outputs whose rows are the same; `places` are those of the boxes and of the scores.
    pub fn head(
        model: &ModelShape<'_>,
        outputs: &[Output<'_>],
        places: (usize, usize),
        unit: [f32; 2],
    ) -> Result<Box<dyn Head>, HeadProblem> {
        let scored = outputs[places.1].shape.last().copied().unwrap_or(0);
        if scored != model.classes as i64 {
            return Err(HeadProblem::ClassCount { scored });
        }
        Ok(Box::new(Self {
            classes: model.classes,
            boxes: places.0,
            scores: places.1,
            unit,
        }))
    }
}

impl Head for BoxesAndScores {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let (Some(boxes), Some(scores)) = (outputs.get(self.boxes), outputs.get(self.scores))
        else {
            return Vec::new();
        };
        let rows = boxes
            .as_chunks::<4>()
            .0
            .iter()
            .zip(scores.chunks_exact(self.classes));
        let [across, down] = self.unit;
        rows.enumerate()
            .filter_map(|(index, (corners, scores))| {
                let best = best_class(scores.iter().copied(), floors)?;
                let [left, top, right, bottom] = *corners;
                let corners = [left * across, top * down, right * across, bottom * down];
                Some(Corners(corners).found(best, index))
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::Family;
    use super::super::testing::{SQUARE_640, head_of};
    use super::*;

    fn decoded(filled: &[(&[i64], f32)], outputs: &[&[f32]]) -> Vec<InputBox> {
        let classes = outputs.iter().map(|values| values.len() / 8400).max();
        head_of(Family::YoloNas, SQUARE_640, classes.unwrap(), filled)
            .unwrap()
            .decode(outputs, &[0.5; 4])
    }

    #[test]
    fn boxes_and_scores_are_told_apart_by_shape_and_by_value() {
        let boxes = [10.0_f32, 20.0, 30.0, 40.0].repeat(8400);
        let (five, four) = (vec![0.6; 5 * 8400], vec![0.6; 4 * 8400]);
        let shape = |last: i64| [1, 8400, last];
        let expected = Corners([10.0, 20.0, 30.0, 40.0]);
        for found in [
            decoded(&[(&shape(4), 9.0), (&shape(5), 0.6)], &[&boxes, &five]),
            decoded(&[(&shape(5), 0.6), (&shape(4), 9.0)], &[&five, &boxes]),
            decoded(&[(&shape(4), 0.6), (&shape(4), 9.0)], &[&four, &boxes]),
            decoded(&[(&shape(4), 9.0), (&shape(4), 0.6)], &[&boxes, &four]),
        ] {
            assert_eq!(found.len(), 8400);
            let InputBox {
                left,
                top,
                right,
                bottom,
                ..
            } = found[77];
            assert_eq!(Corners([left, top, right, bottom]), expected);
        }
    }

    #[test]
    fn other_shapes_are_refused() {
        let of = |filled: &[(&[i64], f32)]| head_of(Family::YoloNas, SQUARE_640, 2, filled).err();
        assert_eq!(
            of(&[(&[1, 100, 4], 9.0), (&[1, 100, 80], 0.1)]),
            Some(HeadProblem::ClassCount { scored: 80 })
        );
        for wrong in [
            &[(&[1, 100, 4][..], 9.0)][..],
            &[(&[1, 100, 4], 9.0), (&[1, 99, 2], 0.1)],
            &[(&[1, 100, 5], 9.0), (&[1, 100, 2], 0.1)],
            &[(&[100, 4], 9.0), (&[100, 2], 0.1)],
        ] {
            assert!(matches!(of(wrong), Some(HeadProblem::Output { .. })));
        }
    }
}
