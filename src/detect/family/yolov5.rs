//! YOLOv5: output `[1, rows, 5 + classes]`; columns are the box's middle, width and height in input
//! pixels, objectness, class scores, all through their sigmoid already. Three anchors a cell over
//! strides 8, 16 and 32. A box's score is objectness times class score.

use super::{
    Corners, Head, HeadProblem, InputBox, ModelShape, Output, best_class, grid, lowest,
    wrong_output,
};

const STRIDES: [usize; 3] = [8, 16, 32];
const ANCHORS: usize = 3;
const BEFORE_CLASSES: usize = 5;

/// The decoder of one class count.
struct Yolov5 {
    classes: usize,
}

pub fn head(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> Result<Box<dyn Head>, HeadProblem> {
    let rows = (ANCHORS * grid::count(model.input, &STRIDES)) as i64;
    let classes = model.classes;
    match outputs {
        [output] if matches!(*output.shape, [1, found, _] if found == rows) => {
            let scored = output.shape[2] - BEFORE_CLASSES as i64;
            if scored == classes as i64 {
                Ok(Box::new(Yolov5 { classes }))
            } else {
                Err(HeadProblem::ClassCount { scored })
            }
        }
        _ => Err(wrong_output(format!("[1, {rows}, classes + 5]"), outputs)),
    }
}

impl Head for Yolov5 {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        decode_rows(outputs, self.classes, floors, |_, row| {
            Corners::about([row[0], row[1]], [row[2], row[3]])
        })
    }
}

/// Boxes of rows of four numbers for the box, objectness and class scores (as probabilities).
pub fn decode_rows(
    outputs: &[&[f32]],
    classes: usize,
    floors: &[f32],
    corners: impl Fn(usize, &[f32]) -> Corners,
) -> Vec<InputBox> {
    let Some(output) = outputs.first() else {
        return Vec::new();
    };
    let lowest = lowest(floors);
    let rows = output.chunks_exact(BEFORE_CLASSES + classes).enumerate();
    rows.filter(|(_, row)| row[4] >= lowest)
        .filter_map(|(index, row)| {
            let scores = row[BEFORE_CLASSES..].iter().map(|class| class * row[4]);
            let best = best_class(scores, floors)?;
            Some(corners(index, row).found(best, index))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::Family;
    use super::super::testing::{SQUARE_640, head_of};
    use super::*;

    #[test]
    fn a_score_is_objectness_times_class() {
        let head = Yolov5 { classes: 2 };
        let mut output = vec![0.0; 25_200 * 7];
        output[7 * 99..][..7].copy_from_slice(&[100.0, 50.0, 20.0, 10.0, 0.5, 0.4, 0.9]);
        // 0.5 * 0.9 reaches the second floor, 0.5 * 0.4 not the first.
        let found = head.decode(&[&output], &[0.3, 0.44]);
        let expected = InputBox {
            class: 1,
            score: 0.45,
            left: 90.0,
            top: 45.0,
            right: 110.0,
            bottom: 55.0,
            row: 99,
        };
        assert_eq!(found, [expected]);
    }

    #[test]
    fn shapes_decide() {
        let of = |shape: &[i64]| head_of(Family::Yolov5, SQUARE_640, 2, &[(shape, 0.0)]).err();
        assert_eq!(of(&[1, 25_200, 7]), None);
        assert_eq!(
            of(&[1, 25_200, 85]),
            Some(HeadProblem::ClassCount { scored: 80 })
        );
        assert!(matches!(
            of(&[1, 8400, 7]),
            Some(HeadProblem::Output { .. })
        ));
    }
}
