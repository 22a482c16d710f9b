//! YOLOX: output `[1, cells, 5 + classes]` over strides 8, 16 and 32, row-major.
//!
//! A raw box is `x = (tx + column) * stride`, `width = exp(tw) * stride`, likewise down (Ge et al.
//! 2021). Exports differ in what the graph does itself: nothing, the sigmoid of the scores, or boxes
//! as well. The shape is the same for all three: the mission or the metadata say which, or the values
//! of the first answer show it.

use super::yolov5::decode_rows;
use super::{
    Colour, Corners, Head, HeadProblem, InputBox, ModelShape, Normalisation, Output, grid, sigmoid,
    wrong_output,
};
use crate::detect::YoloxOutput;
use grid::Cell;

pub const NORMALISATION: Normalisation = Normalisation {
    colour: Colour::Bgr,
    mean: [0.0; 3],
    std: [1.0; 3],
};

const STRIDES: [usize; 3] = [8, 16, 32];
const BEFORE_CLASSES: usize = 5;
/// How many times nearer boxes must lie to their cells by one reading than by the other.
const CLEARLY: f32 = 3.0;

/// The decoder for one input size, class count and form.
struct Yolox {
    classes: usize,
    cells: Vec<Cell>,
    form: YoloxOutput,
}

pub fn head(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> Result<Box<dyn Head>, HeadProblem> {
    let cells = grid::cells(model.input, &STRIDES);
    let rows = cells.len() as i64;
    let output = match outputs {
        [output] if matches!(*output.shape, [1, found, _] if found == rows) => output,
        _ => return Err(wrong_output(format!("[1, {rows}, classes + 5]"), outputs)),
    };
    let scored = output.shape[2] - BEFORE_CLASSES as i64;
    if scored != model.classes as i64 {
        return Err(HeadProblem::ClassCount { scored });
    }
    let width = BEFORE_CLASSES + model.classes;
    let form = model
        .form
        .yolox_output
        .or_else(|| shown(output.values, width, &cells))
        .ok_or(HeadProblem::Undecided {
            what: "whether its boxes and scores are raw",
        })?;
    Ok(Box::new(Yolox {
        classes: model.classes,
        cells,
        form,
    }))
}

/// The form that values show, if they do. Scores outside 0..1 had no sigmoid. Boxes are decoded where
/// their middles lie about their cells in pixels, raw where they do in cells.
fn shown(values: &[f32], width: usize, cells: &[Cell]) -> Option<YoloxOutput> {
    let rows = || values.chunks_exact(width).zip(cells);
    let mut scores = rows().flat_map(|(row, _)| &row[4..]);
    if !scores.all(|score| (0.0..=1.0).contains(score)) {
        return Some(YoloxOutput::Raw);
    }
    let away = |of: fn(f32, f32, f32) -> f32| -> f32 {
        rows()
            .map(|(row, cell)| {
                of(row[0], cell.column, cell.stride) + of(row[1], cell.row, cell.stride)
            })
            .sum()
    };
    let raw = away(|value, _, _| (value - 0.5).abs());
    let decoded = away(|value, index, stride| (value / stride - index - 0.5).abs());
    if raw * CLEARLY < decoded {
        // Scores that are all the same may be logits of nothing as well.
        let first = values.get(4)?;
        let differ = rows().any(|(row, _)| row[4..].iter().any(|score| score != first));
        differ.then_some(YoloxOutput::RawBoxes)
    } else {
        (decoded * CLEARLY < raw).then_some(YoloxOutput::Decoded)
    }
}

impl Head for Yolox {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let in_cell = |index: usize, row: &[f32]| {
            let cell = self.cells[index];
            let middle = [
                (row[0] + cell.column) * cell.stride,
                (row[1] + cell.row) * cell.stride,
            ];
            Corners::about(
                middle,
                [row[2].exp() * cell.stride, row[3].exp() * cell.stride],
            )
        };
        match self.form {
            YoloxOutput::Decoded => decode_rows(outputs, self.classes, floors, |_, row| {
                Corners::about([row[0], row[1]], [row[2], row[3]])
            }),
            YoloxOutput::RawBoxes => decode_rows(outputs, self.classes, floors, in_cell),
            YoloxOutput::Raw => {
                let probable = self.with_sigmoid(outputs);
                decode_rows(&[&probable], self.classes, floors, in_cell)
            }
        }
    }
}

impl Yolox {
    /// The output with its scores through the sigmoid.
    fn with_sigmoid(&self, outputs: &[&[f32]]) -> Vec<f32> {
        let mut values = outputs
            .first()
            .map_or_else(Vec::new, |output| output.to_vec());
        for row in values.chunks_exact_mut(BEFORE_CLASSES + self.classes) {
            row[4..]
                .iter_mut()
                .for_each(|score| *score = sigmoid(*score));
        }
        values
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::SQUARE_416;
    use super::*;
    use crate::detect::ModelForm;

    /// Values of one form: boxes 0.3 of a cell off its corner and a stride wide, scores about 0.1.
    fn values(form: YoloxOutput) -> Vec<f32> {
        let cells = grid::cells(SQUARE_416, &STRIDES);
        let row = |(index, cell): (usize, &Cell)| {
            let score = 0.1 + 0.001 * (index % 7) as f32;
            let logit = (score / (1.0 - score)).ln();
            match form {
                YoloxOutput::Raw => [0.3, 0.3, 0.0, 0.0, logit, logit],
                YoloxOutput::RawBoxes => [0.3, 0.3, 0.0, 0.0, score, score],
                YoloxOutput::Decoded => {
                    let along = |place: f32| (place + 0.3) * cell.stride;
                    let (x, y) = (along(cell.column), along(cell.row));
                    [x, y, cell.stride, cell.stride, score, score]
                }
            }
        };
        cells.iter().enumerate().flat_map(row).collect()
    }

    fn head_for(values: &[f32], named: Option<YoloxOutput>) -> Result<Box<dyn Head>, HeadProblem> {
        let form = ModelForm {
            yolox_output: named,
            ..ModelForm::default()
        };
        let model = ModelShape {
            input: SQUARE_416,
            classes: 1,
            form: &form,
        };
        let shape = [1, 3549, 6];
        head(
            &model,
            &[Output {
                shape: &shape,
                values,
            }],
        )
    }

    #[test]
    fn values_show_their_form_and_all_forms_mean_the_same_boxes() {
        let found = [
            YoloxOutput::Raw,
            YoloxOutput::RawBoxes,
            YoloxOutput::Decoded,
        ]
        .map(|form| {
            let values = values(form);
            head_for(&values, None).unwrap().decode(&[&values], &[0.01])
        });
        assert_eq!(found[0].len(), 3549);
        for other in &found[1..] {
            for (a, b) in found[0].iter().zip(other) {
                // Rounding of f32 at 416 px.
                assert!((a.left - b.left).abs() < 1e-3 && (a.bottom - b.bottom).abs() < 1e-3);
                assert!((a.score - b.score).abs() < 1e-6, "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn what_values_do_not_show_must_be_named() {
        let nothing = vec![0.0; 3549 * 6];
        let undecided = head_for(&nothing, None).err();
        assert!(matches!(undecided, Some(HeadProblem::Undecided { .. })));
        assert!(head_for(&nothing, Some(YoloxOutput::Raw)).is_ok());
    }
}
