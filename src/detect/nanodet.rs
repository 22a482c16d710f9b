//! NanoDet-Plus: output `[1, cells, classes + 32]`; per cell the class scores (sigmoid applied),
//! then four sides (left, top, right, bottom) of eight logits.
//!
//! A side is `stride * sum(softmax(logits) * 0..7)` (generalised focal loss, Li et al. 2020); a cell
//! stands at `index * stride`, without a half, on strides 8, 16, 32 and 64, row-major.

use super::family::{
    Colour, Head, InputBox, InputSize, Normalisation, ShapeProblem, best_class, shape_text,
};

pub(super) const NORMALISATION: Normalisation = Normalisation {
    colour: Colour::Bgr,
    mean: [103.53, 116.28, 123.675],
    std: [57.375, 57.12, 58.395],
};

const STRIDES: [usize; 4] = [8, 16, 32, 64];
const BINS: usize = 8;
const SIDES: usize = 4;

/// The decoder for one input size and class count.
pub(super) struct NanodetPlus {
    classes: usize,
    cells: Vec<Cell>,
}

#[derive(Clone, Copy)]
struct Cell {
    x: f32,
    y: f32,
    stride: f32,
}

impl NanodetPlus {
    pub fn new(
        input: InputSize,
        classes: usize,
        outputs: &[Vec<i64>],
    ) -> Result<Self, ShapeProblem> {
        let cells = cells(input);
        let count = cells.len() as i64;
        let distances = (SIDES * BINS) as i64;
        match outputs {
            [shape] if shape[..] == [1, count, classes as i64 + distances] => {
                Ok(Self { classes, cells })
            }
            [shape] if shape.len() == 3 && shape[..2] == [1, count] && shape[2] > distances => {
                Err(ShapeProblem::ClassCount {
                    scored: shape[2] - distances,
                })
            }
            _ => Err(ShapeProblem::Output {
                expected: format!("[1, {count}, classes + {distances}]"),
                found: shape_text(outputs),
            }),
        }
    }
}

impl Head for NanodetPlus {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let width = self.classes + SIDES * BINS;
        let rows = outputs
            .iter()
            .take(1)
            .flat_map(|output| output.chunks_exact(width));
        rows.zip(&self.cells)
            .filter_map(|(row, cell)| {
                let (scores, logits) = row.split_at(self.classes);
                let (class, score) = best_class(scores.iter().copied(), floors)?;
                let side = |index: usize| distance(&logits[index * BINS..][..BINS]) * cell.stride;
                Some(InputBox {
                    class,
                    score,
                    left: cell.x - side(0),
                    top: cell.y - side(1),
                    right: cell.x + side(2),
                    bottom: cell.y + side(3),
                })
            })
            .collect()
    }
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

fn cells(input: InputSize) -> Vec<Cell> {
    let mut cells = Vec::new();
    for stride in STRIDES {
        let (columns, rows) = input.grid(stride);
        let step = stride as f32;
        cells.extend((0..rows * columns).map(|index| Cell {
            x: (index % columns) as f32 * step,
            y: (index / columns) as f32 * step,
            stride: step,
        }));
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;

    const INPUT: InputSize = InputSize {
        width: 416,
        height: 416,
    };

    fn head(classes: usize) -> NanodetPlus {
        NanodetPlus::new(INPUT, classes, &[vec![1, 3598, classes as i64 + 32]]).unwrap()
    }

    #[test]
    fn cell_counts_are_the_published_ones() {
        assert_eq!(cells(INPUT).len(), 3598);
        assert_eq!(
            cells(InputSize {
                width: 320,
                height: 320
            })
            .len(),
            2125
        );
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
        let of = |shape: &[i64]| NanodetPlus::new(INPUT, 2, &[shape.to_vec()]).err();
        assert_eq!(
            of(&[1, 3598, 112]),
            Some(ShapeProblem::ClassCount { scored: 80 })
        );
        assert!(matches!(
            of(&[1, 2125, 34]),
            Some(ShapeProblem::Output { .. })
        ));
        assert!(matches!(
            of(&[1, 84, 8400]),
            Some(ShapeProblem::Output { .. })
        ));
        assert!(matches!(of(&[3598, 34]), Some(ShapeProblem::Output { .. })));
    }
}
