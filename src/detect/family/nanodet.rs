//! NanoDet and NanoDet-Plus: class scores (sigmoid applied) and, per side (left, top, right, bottom),
//! eight logits. A side is `stride * sum(softmax(logits) * 0..7)` (generalised focal loss, Li et al.
//! 2020).
//!
//! - NanoDet-Plus: one output `[1, cells, classes + 32]` over strides 8, 16, 32 and 64; a cell stands
//!   at `index * stride`, without a half.
//! - NanoDet: scores `[cells, classes]` and sides `[cells, 32]` of strides 8, 16 and 32, in six
//!   outputs, with or without a batch axis; a cell stands at its middle. The names of these outputs
//!   have been seen to lie, so shapes alone say which is which.

use super::grid::{self, Cell};
use super::{
    Colour, Corners, Head, HeadProblem, InputBox, ModelShape, Normalisation, Output, best_class,
    wrong_output,
};

pub const NORMALISATION: Normalisation = Normalisation {
    colour: Colour::Bgr,
    mean: [103.53, 116.28, 123.675],
    std: [57.375, 57.12, 58.395],
};

const PLUS_STRIDES: [usize; 4] = [8, 16, 32, 64];
const STRIDES: [usize; 3] = [8, 16, 32];
const BINS: usize = 8;
const SIDES: usize = 4;
const LOGITS: usize = SIDES * BINS;

/// The decoder of NanoDet-Plus.
pub fn plus(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> Result<Box<dyn Head>, HeadProblem> {
    let cells = grid::cells(model.input, &PLUS_STRIDES);
    let (count, logits) = (cells.len() as i64, LOGITS as i64);
    match outputs {
        [output] if matches!(*output.shape, [1, found, wide] if found == count && wide > logits) => {
            let scored = output.shape[2] - logits;
            if scored != model.classes as i64 {
                return Err(HeadProblem::ClassCount { scored });
            }
            Ok(Box::new(Plus {
                classes: model.classes,
                cells,
            }))
        }
        _ => Err(wrong_output(
            format!("[1, {count}, classes + {LOGITS}]"),
            outputs,
        )),
    }
}

struct Plus {
    classes: usize,
    cells: Vec<Cell>,
}

impl Head for Plus {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let rows = outputs
            .iter()
            .take(1)
            .flat_map(|output| output.chunks_exact(self.classes + LOGITS));
        rows.zip(&self.cells)
            .enumerate()
            .filter_map(|(index, (row, cell))| {
                let (scores, logits) = row.split_at(self.classes);
                let best = best_class(scores.iter().copied(), floors)?;
                Some(corners(cell, 0.0, logits).found(best, index))
            })
            .collect()
    }
}

/// The decoder of the first NanoDet.
pub fn maps(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> Result<Box<dyn Head>, HeadProblem> {
    let levels = STRIDES
        .iter()
        .map(|&stride| Level::find(stride, model, outputs))
        .collect::<Result<_, _>>()?;
    Ok(Box::new(Maps {
        classes: model.classes,
        levels,
    }))
}

struct Maps {
    classes: usize,
    levels: Vec<Level>,
}

/// One stride: its cells, and which outputs are its.
struct Level {
    cells: Vec<Cell>,
    scores: usize,
    sides: usize,
}

impl Level {
    fn find(
        stride: usize,
        model: &ModelShape<'_>,
        outputs: &[Output<'_>],
    ) -> Result<Self, HeadProblem> {
        let cells = grid::cells(model.input, &[stride]);
        let columns = |output: &Output<'_>| match *output.shape {
            [rows, columns] | [1, rows, columns] if rows == cells.len() as i64 => Some(columns),
            _ => None,
        };
        let of_level = |(index, output)| Some((index, columns(output)?));
        let level: Vec<(usize, i64)> = outputs.iter().enumerate().filter_map(of_level).collect();
        let (classes, logits) = (model.classes as i64, LOGITS as i64);
        let (scores, sides) = match level[..] {
            _ if outputs.len() != 2 * STRIDES.len() => return Err(wrong_maps(model, outputs)),
            [(first, a), (second, b)] if (a, b) == (logits, logits) && classes == logits => {
                by_value((first, second), outputs)
            }
            [(first, a), (second, b)] if (a, b) == (classes, logits) => (first, second),
            [(first, a), (second, b)] if (a, b) == (logits, classes) => (second, first),
            [(_, scored), (_, wide)] | [(_, wide), (_, scored)] if wide == logits => {
                return Err(HeadProblem::ClassCount { scored });
            }
            _ => return Err(wrong_maps(model, outputs)),
        };
        Ok(Self {
            cells,
            scores,
            sides,
        })
    }
}

/// Scores and sides of one shape: logits are no probabilities. In doubt scores come first.
fn by_value((first, second): (usize, usize), outputs: &[Output<'_>]) -> (usize, usize) {
    if !outputs[first].is_probable() && outputs[second].is_probable() {
        (second, first)
    } else {
        (first, second)
    }
}

fn wrong_maps(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> HeadProblem {
    let of = |stride: &usize| {
        let cells = grid::count(model.input, &[*stride]);
        format!("[{cells}, classes] and [{cells}, {LOGITS}]")
    };
    wrong_output(
        STRIDES.iter().map(of).collect::<Vec<_>>().join(" and "),
        outputs,
    )
}

impl Head for Maps {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let mut found = Vec::new();
        let mut before = 0;
        for level in &self.levels {
            let (scores, sides) = (outputs[level.scores], outputs[level.sides]);
            let rows = scores
                .chunks_exact(self.classes)
                .zip(sides.chunks_exact(LOGITS))
                .zip(&level.cells)
                .enumerate();
            found.extend(rows.filter_map(|(index, ((scores, logits), cell))| {
                let best = best_class(scores.iter().copied(), floors)?;
                Some(corners(cell, 0.5, logits).found(best, before + index))
            }));
            before += level.cells.len();
        }
        found
    }
}

/// The box that a cell's logits say; the cell stands at `index + within` strides.
fn corners(cell: &Cell, within: f32, logits: &[f32]) -> Corners {
    let side = |index: usize| distance(&logits[index * BINS..][..BINS]);
    let at = |index: f32, sides: f32| (index + within + sides) * cell.stride;
    Corners([
        at(cell.column, -side(0)),
        at(cell.row, -side(1)),
        at(cell.column, side(2)),
        at(cell.row, side(3)),
    ])
}

/// Mean bin under the softmax of the logits, in strides.
fn distance(logits: &[f32]) -> f32 {
    let greatest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let (mut sum, mut weighted) = (0.0, 0.0);
    for (bin, logit) in logits.iter().enumerate() {
        let weight = (logit - greatest).exp();
        sum += weight;
        weighted += weight * bin as f32;
    }
    weighted / sum
}

#[cfg(test)]
mod tests {
    use super::super::Family;
    use super::super::testing::{SQUARE_416, head_of};
    use super::*;

    fn head(classes: usize) -> Box<dyn Head> {
        let shape = [1, 3598, classes as i64 + 32];
        head_of(Family::NanodetPlus, SQUARE_416, classes, &[(&shape, 0.0)]).unwrap()
    }

    /// One cell set by hand: stride 16, column 10, row 7 of 26x26, behind 2704 cells of stride 8.
    /// Logits that put all weight on two bins have a mean that can be worked out on paper.
    #[test]
    fn a_box_set_by_hand_comes_back() {
        let index = 2704 + 7 * 26 + 10;
        let mut output = vec![0.0_f32; 3598 * 34];
        let row = &mut output[index * 34..][..34];
        row[1] = 0.9;
        // Equal logits on bins a and b, -100 elsewhere: mean (a + b) / 2.
        for (side, (a, b)) in [(0, 1), (2, 3), (4, 6), (7, 7)].into_iter().enumerate() {
            for bin in 0..8 {
                row[2 + side * 8 + bin] = if bin == a || bin == b { 3.0 } else { -100.0 };
            }
        }
        let boxes = head(2).decode(&[&output], &[0.4, 0.5]);
        // x 160 - 16 * 0.5, y 112 - 16 * 2.5, x 160 + 16 * 5, y 112 + 16 * 7
        let expected = InputBox {
            class: 1,
            score: 0.9,
            left: 152.0,
            top: 72.0,
            right: 240.0,
            bottom: 224.0,
            row: index,
        };
        assert_eq!(boxes, [expected]);
    }

    /// Random logits against a plain f64 computation that shares nothing with the code above.
    #[test]
    fn random_outputs_agree_with_a_plain_computation() {
        let mut seed = 7_u64;
        let mut random = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (seed >> 40) as f32 / (1_u64 << 24) as f32
        };
        let output: Vec<f32> = (0..3598 * 34)
            .map(|k| {
                if k % 34 < 2 {
                    random()
                } else {
                    random() * 12.0 - 5.0
                }
            })
            .collect();
        let boxes = head(2).decode(&[&output], &[0.999, 0.999]);
        assert!(!boxes.is_empty());
        for found in &boxes {
            let index = (0..3598)
                .find(|k| output[k * 34 + found.class] == found.score)
                .unwrap();
            let (level, stride, columns) = match index {
                0..2704 => (index, 8.0, 52),
                2704..3380 => (index - 2704, 16.0, 26),
                3380..3549 => (index - 3380, 32.0, 13),
                _ => (index - 3549, 64.0, 7),
            };
            let side = |k: usize| {
                let logits = &output[index * 34 + 2 + 8 * k..][..8];
                let weights: Vec<f64> = logits.iter().map(|x| f64::from(*x).exp()).collect();
                let mean: f64 = weights
                    .iter()
                    .enumerate()
                    .map(|(bin, w)| bin as f64 * w)
                    .sum();
                stride * mean / weights.iter().sum::<f64>()
            };
            let (x, y) = (
                (level % columns) as f64 * stride,
                (level / columns) as f64 * stride,
            );
            // f32 sums of eight terms times stride 64: 1e-3 px is generous and far below a pixel.
            for (got, want) in [
                (found.left, x - side(0)),
                (found.top, y - side(1)),
                (found.right, x + side(2)),
                (found.bottom, y + side(3)),
            ] {
                assert!((f64::from(got) - want).abs() < 1e-3, "{got} {want}");
            }
        }
    }

    #[test]
    fn huge_logits_do_not_overflow() {
        assert_eq!(distance(&[1e30, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e30]), 3.5);
    }

    #[test]
    fn other_shapes_are_named_and_a_wrong_class_count_is_told_apart() {
        let of = |shape: &[i64]| head_of(Family::NanodetPlus, SQUARE_416, 2, &[(shape, 0.0)]).err();
        assert_eq!(
            of(&[1, 3598, 112]),
            Some(HeadProblem::ClassCount { scored: 80 })
        );
        for wrong in [
            &[1, 2125, 34][..],
            &[1, 84, 8400],
            &[3598, 34],
            &[1, 3598, 32],
        ] {
            assert!(matches!(of(wrong), Some(HeadProblem::Output { .. })));
        }
    }

    /// Form B: no batch axis, and names in an order that says nothing of what they hold.
    const MAPS: [[i64; 2]; 6] = [
        [2704, 2],
        [676, 2],
        [169, 2],
        [2704, 32],
        [676, 32],
        [169, 32],
    ];

    #[test]
    fn maps_are_told_apart_by_shape_in_any_order() {
        for turn in 0..6 {
            let mut order = MAPS;
            order.rotate_left(turn);
            let filled: Vec<(&[i64], f32)> = order.iter().map(|shape| (&shape[..], 0.1)).collect();
            let head = head_of(Family::Nanodet, SQUARE_416, 2, &filled).unwrap();
            let mut values: Vec<Vec<f32>> = order
                .iter()
                .map(|shape| vec![0.0; (shape[0] * shape[1]) as usize])
                .collect();
            let place = |wanted: [i64; 2]| order.iter().position(|shape| *shape == wanted).unwrap();
            // Stride 16, column 10, row 7: middle (168, 120), equal logits reach 3.5 strides.
            values[place([676, 2])][(7 * 26 + 10) * 2] = 0.9;
            let outputs: Vec<&[f32]> = values.iter().map(Vec::as_slice).collect();
            let expected = InputBox {
                class: 0,
                score: 0.9,
                left: 112.0,
                top: 64.0,
                right: 224.0,
                bottom: 176.0,
                row: 2704 + 7 * 26 + 10,
            };
            assert_eq!(head.decode(&outputs, &[0.5, 0.5]), [expected]);
        }
    }

    #[test]
    fn as_many_classes_as_logits_are_told_apart_by_value() {
        let shapes = [[2704, 32], [676, 32], [169, 32]];
        let of = |first: f32, second: f32| {
            let filled = shapes.iter().map(|shape| (&shape[..], first));
            let filled: Vec<_> = filled
                .chain(shapes.iter().map(|shape| (&shape[..], second)))
                .collect();
            let head = head_of(Family::Nanodet, SQUARE_416, 32, &filled).unwrap();
            let values = |cells: i64, value: f32| vec![value; (cells * 32) as usize];
            let outputs: Vec<Vec<f32>> = [(2704, first), (676, first), (169, first)]
                .into_iter()
                .chain([(2704, second), (676, second), (169, second)])
                .map(|(cells, value)| values(cells, value))
                .collect();
            let outputs: Vec<&[f32]> = outputs.iter().map(Vec::as_slice).collect();
            head.decode(&outputs, &[0.3; 32])[0].score
        };
        assert_eq!((of(0.4, 5.0), of(5.0, 0.4)), (0.4, 0.4));
    }

    #[test]
    fn maps_of_another_model_are_refused() {
        let of = |shapes: &[&[i64]]| {
            let filled: Vec<_> = shapes.iter().map(|shape| (*shape, 0.0)).collect();
            head_of(Family::Nanodet, SQUARE_416, 2, &filled).err()
        };
        let eighty: Vec<[i64; 2]> = MAPS
            .iter()
            .map(|[cells, wide]| [*cells, if *wide == 2 { 80 } else { 32 }])
            .collect();
        let eighty: Vec<&[i64]> = eighty.iter().map(|shape| &shape[..]).collect();
        assert_eq!(of(&eighty), Some(HeadProblem::ClassCount { scored: 80 }));
        for wrong in [&[&[1, 3598, 34][..]][..], &[&[2704, 2][..]; 6]] {
            assert!(matches!(of(wrong), Some(HeadProblem::Output { .. })));
        }
    }
}
