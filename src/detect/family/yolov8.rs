//! YOLOv8: output `[1, 4 + classes, cells]`, channel-major; rows are the box's middle, width and
//! height in input pixels, then the class scores (sigmoid applied), over strides 8, 16 and 32.
//!
//! - Segmenting models, YOLO-EB among them, add mask coefficients behind the classes and a second
//!   output of prototypes (see [`super::prototypes`]).
//! - End-to-end exports give `[1, rows, 6]` instead (rows of left, top, right, bottom, score, class),
//!   with the coefficients behind it where they segment.

use super::prototypes::Prototypes;
use super::{
    Corners, Head, HeadProblem, InputBox, ModelShape, Output, best_class, grid, wrong_output,
};
use crate::detect::mask::MaskLogits;

const STRIDES: [usize; 3] = [8, 16, 32];
const BOX_ROWS: usize = 4;
const END_TO_END: usize = 6;

pub fn head(model: &ModelShape<'_>, outputs: &[Output<'_>]) -> Result<Box<dyn Head>, HeadProblem> {
    match outputs {
        [output] => made(model, output, None),
        _ => Err(wrong_output(expected(model, 0), outputs)),
    }
}

/// With prototypes, whichever output they are.
pub fn segmenting(
    model: &ModelShape<'_>,
    outputs: &[Output<'_>],
) -> Result<Box<dyn Head>, HeadProblem> {
    let refused = || {
        let boxes = expected(model, 32);
        wrong_output(
            format!("{boxes} and prototypes [1, 32, rows, columns]"),
            outputs,
        )
    };
    let [first, second] = outputs else {
        return Err(refused());
    };
    let (boxes, place) = match (first.shape.len(), second.shape.len()) {
        (3, 4) => (first, 1),
        (4, 3) => (second, 0),
        _ => return Err(refused()),
    };
    let prototypes =
        Prototypes::new(model.input, outputs[place].shape, place).ok_or_else(refused)?;
    made(model, boxes, Some((1 - place, prototypes)))
}

fn expected(model: &ModelShape<'_>, coefficients: usize) -> String {
    let cells = grid::count(model.input, &STRIDES);
    let (rows, columns) = (BOX_ROWS + coefficients, END_TO_END + coefficients);
    format!("[1, classes + {rows}, {cells}] or [1, rows, {columns}]")
}

fn made(
    model: &ModelShape<'_>,
    boxes: &Output<'_>,
    prototypes: Option<(usize, Prototypes)>,
) -> Result<Box<dyn Head>, HeadProblem> {
    let cells = grid::count(model.input, &STRIDES);
    let (place, prototypes) = prototypes.map_or((0, None), |(place, found)| (place, Some(found)));
    let coefficients = prototypes.as_ref().map_or(0, Prototypes::count);
    let behind = (BOX_ROWS + coefficients) as i64;
    let layout = match *boxes.shape {
        [1, rows, columns] if columns == cells as i64 && rows > behind => {
            let scored = rows - behind;
            if scored != model.classes as i64 {
                return Err(HeadProblem::ClassCount { scored });
            }
            Layout::ByChannel { cells }
        }
        [1, _, columns] if columns == (END_TO_END + coefficients) as i64 => Layout::EndToEnd {
            columns: columns as usize,
        },
        _ => return Err(wrong_output(expected(model, coefficients), &[*boxes])),
    };
    Ok(Box::new(Yolov8 {
        classes: model.classes,
        place,
        layout,
        prototypes,
    }))
}

/// The decoder for one input size and class count.
struct Yolov8 {
    classes: usize,
    /// Which output holds the boxes.
    place: usize,
    layout: Layout,
    prototypes: Option<Prototypes>,
}

enum Layout {
    ByChannel { cells: usize },
    EndToEnd { columns: usize },
}

impl Head for Yolov8 {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let Some(output) = outputs.get(self.place) else {
            return Vec::new();
        };
        match self.layout {
            Layout::ByChannel { cells } => self.by_channel(output, cells, floors),
            Layout::EndToEnd { columns } => end_to_end(output, columns, floors),
        }
    }

    fn mask(&self, outputs: &[&[f32]], found: &InputBox) -> Option<MaskLogits> {
        let prototypes = self.prototypes.as_ref()?;
        let boxes = outputs.get(self.place)?;
        let coefficient = |index: usize| match self.layout {
            Layout::ByChannel { cells } => {
                boxes[(BOX_ROWS + self.classes + index) * cells + found.row]
            }
            Layout::EndToEnd { columns } => boxes[found.row * columns + END_TO_END + index],
        };
        let coefficients: Vec<f32> = (0..prototypes.count()).map(coefficient).collect();
        prototypes.logits(outputs, &coefficients)
    }
}

impl Yolov8 {
    fn by_channel(&self, output: &[f32], cells: usize, floors: &[f32]) -> Vec<InputBox> {
        let at = |row: usize, cell: usize| output[row * cells + cell];
        (0..cells)
            .filter_map(|cell| {
                let scores = (0..self.classes).map(|class| at(BOX_ROWS + class, cell));
                let best = best_class(scores, floors)?;
                let (middle, size) = ([at(0, cell), at(1, cell)], [at(2, cell), at(3, cell)]);
                Some(Corners::about(middle, size).found(best, cell))
            })
            .collect()
    }
}

/// Rows that say their class; one that no class has is skipped.
fn end_to_end(output: &[f32], columns: usize, floors: &[f32]) -> Vec<InputBox> {
    let found = |(index, row): (usize, &[f32])| {
        let class = row[5].round();
        let floor = floors.get(class as usize).filter(|_| class >= 0.0)?;
        let corners = Corners([row[0], row[1], row[2], row[3]]);
        (row[4] >= *floor).then(|| corners.found((class as usize, row[4]), index))
    };
    let rows = output.chunks_exact(columns).enumerate();
    rows.filter_map(found).collect()
}

#[cfg(test)]
mod tests {
    use super::super::Family;
    use super::super::testing::{SQUARE_640, head_of};
    use super::*;

    const EXPECTED: InputBox = InputBox {
        class: 1,
        score: 0.8,
        left: 90.0,
        top: 45.0,
        right: 110.0,
        bottom: 55.0,
        row: 0,
    };

    #[test]
    fn rows_are_read_channel_major() {
        let head = head_of(Family::Yolov8, SQUARE_640, 2, &[(&[1, 6, 8400], 0.0)]).unwrap();
        let mut output = vec![0.0; 6 * 8400];
        for (row, value) in [100.0, 50.0, 20.0, 10.0, 0.2, 0.8].into_iter().enumerate() {
            output[row * 8400 + 1234] = value;
        }
        let expected = InputBox {
            row: 1234,
            ..EXPECTED
        };
        assert_eq!(head.decode(&[&output], &[0.5, 0.5]), [expected]);
    }

    #[test]
    fn an_end_to_end_export_says_its_classes_itself() {
        let head = head_of(Family::Yolov8, SQUARE_640, 2, &[(&[1, 300, 6], 0.0)]).unwrap();
        let mut output = vec![0.0; 300 * 6];
        for (index, class) in [(3, 1.0), (4, 7.0), (5, -1.0)] {
            output[index * 6..][..6].copy_from_slice(&[90.0, 45.0, 110.0, 55.0, 0.8, class]);
        }
        let expected = InputBox { row: 3, ..EXPECTED };
        assert_eq!(head.decode(&[&output], &[0.5, 0.5]), [expected]);
    }

    #[test]
    fn a_wrong_class_count_is_told_apart_from_a_wrong_shape() {
        let of = |shape: &[i64]| head_of(Family::Yolov8, SQUARE_640, 2, &[(shape, 0.0)]).err();
        assert_eq!(
            of(&[1, 84, 8400]),
            Some(HeadProblem::ClassCount { scored: 80 })
        );
        assert!(matches!(
            of(&[1, 3598, 34]),
            Some(HeadProblem::Output { .. })
        ));
    }

    #[test]
    fn coefficients_count_behind_the_classes_and_prototypes_may_come_first() {
        let of = |filled: &[(&[i64], f32)]| head_of(Family::Yolov8Seg, SQUARE_640, 2, filled).err();
        let (boxes, prototypes) = ([1, 38, 8400], [1, 32, 160, 160]);
        assert_eq!(of(&[(&boxes, 0.0), (&prototypes, 0.0)]), None);
        assert_eq!(of(&[(&prototypes, 0.0), (&boxes, 0.0)]), None);
        assert_eq!(of(&[(&[1, 300, 38], 0.0), (&prototypes, 0.0)]), None);
        assert_eq!(
            of(&[(&[1, 116, 8400], 0.0), (&prototypes, 0.0)]),
            Some(HeadProblem::ClassCount { scored: 80 })
        );
        for wrong in [
            &[(&boxes[..], 0.0)][..],
            &[(&boxes, 0.0), (&[1, 32, 0, 160], 0.0)],
            &[(&boxes, 0.0), (&boxes, 0.0)],
        ] {
            assert!(matches!(of(wrong), Some(HeadProblem::Output { .. })));
        }
    }
}
