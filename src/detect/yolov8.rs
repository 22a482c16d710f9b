//! YOLOv8: output `[1, 4 + classes, cells]`, channel-major; rows are the box's middle, width and
//! height in input pixels, then the class scores (sigmoid applied), over strides 8, 16 and 32.

use super::family::{
    Colour, Head, InputBox, InputSize, Normalisation, ShapeProblem, best_class, shape_text,
};

pub(super) const NORMALISATION: Normalisation = Normalisation {
    colour: Colour::Rgb,
    mean: [0.0; 3],
    std: [255.0; 3],
};

const STRIDES: [usize; 3] = [8, 16, 32];
const BOX_ROWS: usize = 4;

/// The decoder for one input size and class count.
pub(super) struct Yolov8 {
    classes: usize,
    cells: usize,
}

impl Yolov8 {
    pub fn new(
        input: InputSize,
        classes: usize,
        outputs: &[Vec<i64>],
    ) -> Result<Self, ShapeProblem> {
        let grids = STRIDES.map(|stride| input.grid(stride));
        let cells: usize = grids.iter().map(|(columns, rows)| columns * rows).sum();
        let rows = BOX_ROWS as i64;
        match outputs {
            [shape] if shape[..] == [1, rows + classes as i64, cells as i64] => {
                Ok(Self { classes, cells })
            }
            [shape]
                if shape.len() == 3
                    && shape[0] == 1
                    && shape[2] == cells as i64
                    && shape[1] > rows =>
            {
                Err(ShapeProblem::ClassCount {
                    scored: shape[1] - rows,
                })
            }
            _ => Err(ShapeProblem::Output {
                expected: format!("[1, classes + {rows}, {cells}]"),
                found: shape_text(outputs),
            }),
        }
    }
}

impl Head for Yolov8 {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let Some(output) = outputs.first() else {
            return Vec::new();
        };
        let at = |row: usize, cell: usize| output[row * self.cells + cell];
        (0..self.cells)
            .filter_map(|cell| {
                let scores = (0..self.classes).map(|class| at(BOX_ROWS + class, cell));
                let (class, score) = best_class(scores, floors)?;
                let (half_width, half_height) = (at(2, cell) / 2.0, at(3, cell) / 2.0);
                Some(InputBox {
                    class,
                    score,
                    left: at(0, cell) - half_width,
                    top: at(1, cell) - half_height,
                    right: at(0, cell) + half_width,
                    bottom: at(1, cell) + half_height,
                })
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INPUT: InputSize = InputSize {
        width: 640,
        height: 640,
    };

    #[test]
    fn rows_are_read_channel_major() {
        let head = Yolov8::new(INPUT, 2, &[vec![1, 6, 8400]]).unwrap();
        let mut output = vec![0.0; 6 * 8400];
        for (row, value) in [100.0, 50.0, 20.0, 10.0, 0.2, 0.8].into_iter().enumerate() {
            output[row * 8400 + 1234] = value;
        }
        let expected = InputBox {
            class: 1,
            score: 0.8,
            left: 90.0,
            top: 45.0,
            right: 110.0,
            bottom: 55.0,
        };
        assert_eq!(head.decode(&[&output], &[0.5, 0.5]), [expected]);
    }

    #[test]
    fn a_wrong_class_count_is_told_apart_from_a_wrong_shape() {
        let of = |shape: &[i64]| Yolov8::new(INPUT, 2, &[shape.to_vec()]).err();
        assert_eq!(
            of(&[1, 84, 8400]),
            Some(ShapeProblem::ClassCount { scored: 80 })
        );
        assert!(matches!(
            of(&[1, 3598, 34]),
            Some(ShapeProblem::Output { .. })
        ));
    }
}
