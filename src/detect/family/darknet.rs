//! Darknet's anchors: YOLOv3, YOLOv4 and their tiny forms.
//!
//! Raw maps `[1, 3 * (5 + classes), rows, columns]`, one a stride; per anchor tx, ty, tw, th,
//! objectness, classes. With a sigmoid s the middle is `((s(tx) - 0.5) * g + 0.5 + column) * stride`
//! (g is YOLOv4's `scale_x_y`), the width `exp(tw) * anchor` (Redmon and Farhadi 2018; Bochkovskiy et
//! al. 2020). Or, decoded by the export: boxes `[1, rows, 1, 4]` as shares of the input and scores
//! `[1, rows, classes]`.

use super::yolo_nas::BoxesAndScores;
use super::{
    Corners, Head, HeadProblem, InputBox, InputSize, ModelShape, Output, best_class, lowest,
    sigmoid, wrong_output,
};

const ANCHORS: usize = 3;
const BEFORE_CLASSES: usize = 5;

/// Width and height, input pixels.
type Anchor = [f32; 2];

/// One stride of a family: its anchors and its `scale_x_y`, as the published configurations have
/// them. A model that was trained with others says so in its metadata or its mission.
pub struct Level {
    stride: usize,
    anchors: [Anchor; ANCHORS],
    grown: f32,
}

const fn level(stride: usize, anchors: [Anchor; ANCHORS], grown: f32) -> Level {
    Level {
        stride,
        anchors,
        grown,
    }
}

pub const YOLOV3: [Level; 3] = [
    level(8, [[10.0, 13.0], [16.0, 30.0], [33.0, 23.0]], 1.0),
    level(16, [[30.0, 61.0], [62.0, 45.0], [59.0, 119.0]], 1.0),
    level(32, [[116.0, 90.0], [156.0, 198.0], [373.0, 326.0]], 1.0),
];
pub const YOLOV3_TINY: [Level; 2] = [
    level(16, [[10.0, 14.0], [23.0, 27.0], [37.0, 58.0]], 1.0),
    level(32, [[81.0, 82.0], [135.0, 169.0], [344.0, 319.0]], 1.0),
];
pub const YOLOV4: [Level; 3] = [
    level(8, [[12.0, 16.0], [19.0, 36.0], [40.0, 28.0]], 1.2),
    level(16, [[36.0, 75.0], [76.0, 55.0], [72.0, 146.0]], 1.1),
    level(32, [[142.0, 110.0], [192.0, 243.0], [459.0, 401.0]], 1.05),
];
/// The finer stride's mask is 1, 2, 3 in the published configuration, not 0, 1, 2.
pub const YOLOV4_TINY: [Level; 2] = [
    level(16, [[23.0, 27.0], [37.0, 58.0], [81.0, 82.0]], 1.05),
    level(32, [[81.0, 82.0], [135.0, 169.0], [344.0, 319.0]], 1.05),
];

pub fn head(
    levels: &[Level],
    model: &ModelShape<'_>,
    outputs: &[Output<'_>],
) -> Result<Box<dyn Head>, HeadProblem> {
    if outputs.len() == levels.len() && outputs.iter().all(|output| output.shape.len() == 4) {
        return raw(levels, model, outputs);
    }
    match outputs {
        [boxes, scores] if is_decoded(boxes.shape, scores.shape) => {
            let unit = [model.input.width as f32, model.input.height as f32];
            BoxesAndScores::head(model, outputs, (0, 1), unit)
        }
        _ => Err(wrong_output(expected(levels, model.input), outputs)),
    }
}

fn is_decoded(boxes: &[i64], scores: &[i64]) -> bool {
    matches!((boxes, scores), ([1, rows, 1, 4], [1, same, _]) if rows == same && *rows > 0)
}

fn expected(levels: &[Level], input: InputSize) -> String {
    let maps: Vec<String> = levels
        .iter()
        .map(|level| {
            let (columns, rows) = input.grid(level.stride);
            format!("[1, 3 * (classes + 5), {rows}, {columns}]")
        })
        .collect();
    format!(
        "{}, or [1, rows, 1, 4] and [1, rows, classes]",
        maps.join(" and ")
    )
}

/// One map: which output it is, and how to read it.
struct Map {
    output: usize,
    columns: usize,
    cells: usize,
    stride: f32,
    anchors: [Anchor; ANCHORS],
    grown: f32,
}

struct Maps {
    classes: usize,
    maps: Vec<Map>,
}

fn raw(
    levels: &[Level],
    model: &ModelShape<'_>,
    outputs: &[Output<'_>],
) -> Result<Box<dyn Head>, HeadProblem> {
    let refused = || wrong_output(expected(levels, model.input), outputs);
    let mut maps = Vec::with_capacity(levels.len());
    for (index, level) in levels.iter().enumerate() {
        let (columns, rows) = model.input.grid(level.stride);
        let of_level = |output: &Output<'_>| matches!(*output.shape, [1, _, r, c] if (r, c) == (rows as i64, columns as i64));
        let output = outputs.iter().position(of_level).ok_or_else(refused)?;
        let channels = outputs[output].shape[1];
        let anchors = ANCHORS as i64;
        if channels != anchors * (BEFORE_CLASSES + model.classes) as i64 {
            return match channels / anchors - BEFORE_CLASSES as i64 {
                scored if channels % anchors == 0 && scored > 0 => {
                    Err(HeadProblem::ClassCount { scored })
                }
                _ => Err(refused()),
            };
        }
        let told = model.form.anchors.as_ref();
        maps.push(Map {
            output,
            columns,
            cells: columns * rows,
            stride: level.stride as f32,
            anchors: told
                .and_then(|told| told.get(index).copied())
                .unwrap_or(level.anchors),
            grown: level.grown,
        });
    }
    Ok(Box::new(Maps {
        classes: model.classes,
        maps,
    }))
}

impl Head for Maps {
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox> {
        let mut found = Vec::new();
        for map in &self.maps {
            if let Some(values) = outputs.get(map.output) {
                self.decode_map(map, values, floors, &mut found);
            }
        }
        found
    }
}

impl Maps {
    fn decode_map(&self, map: &Map, values: &[f32], floors: &[f32], found: &mut Vec<InputBox>) {
        let lowest = lowest(floors);
        let planes = values.chunks_exact(map.cells * (BEFORE_CLASSES + self.classes));
        for (planes, anchor) in planes.zip(map.anchors) {
            let at = |channel: usize, cell: usize| planes[channel * map.cells + cell];
            for cell in 0..map.cells {
                let objectness = sigmoid(at(4, cell));
                if objectness < lowest {
                    continue;
                }
                let class = |class| sigmoid(at(BEFORE_CLASSES + class, cell)) * objectness;
                let Some(best) = best_class((0..self.classes).map(class), floors) else {
                    continue;
                };
                let along = |channel: usize, place: usize| {
                    let offset = (sigmoid(at(channel, cell)) - 0.5) * map.grown + 0.5;
                    (offset + place as f32) * map.stride
                };
                let middle = [along(0, cell % map.columns), along(1, cell / map.columns)];
                let size = [at(2, cell).exp() * anchor[0], at(3, cell).exp() * anchor[1]];
                found.push(Corners::about(middle, size).found(best, found.len()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Family;
    use super::super::testing::{SQUARE_416, head_of};
    use super::*;

    const COARSE: [i64; 4] = [1, 21, 13, 13];
    const FINE: [i64; 4] = [1, 21, 26, 26];

    #[test]
    fn a_cell_set_by_hand_comes_back_whatever_the_order_of_the_maps() {
        let head = head_of(
            Family::Yolov4Tiny,
            SQUARE_416,
            2,
            &[(&COARSE, -9.0), (&FINE, -9.0)],
        )
        .unwrap();
        let coarse = vec![-9.0_f32; 21 * 169];
        let mut fine = vec![-9.0_f32; 21 * 676];
        // Second anchor of stride 16 (37 by 58), column 5, row 7; objectness and smoke certain.
        let cell = 7 * 26 + 5;
        for (channel, value) in [0.0, 0.0, 0.0, 2_f32.ln(), 20.0, -20.0, 20.0]
            .into_iter()
            .enumerate()
        {
            fine[(7 + channel) * 676 + cell] = value;
        }
        let found = head.decode(&[&coarse, &fine], &[0.5, 0.5]);
        assert_eq!(found.len(), 1);
        // Middle (5.5, 7.5) * 16 = (88, 120); 37 by 116.
        let InputBox {
            left,
            top,
            right,
            bottom,
            class,
            ..
        } = found[0];
        assert_eq!(class, 1);
        for (got, want) in [(left, 69.5), (right, 106.5), (top, 62.0), (bottom, 178.0)] {
            assert!((got - want).abs() < 1e-3, "{got} {want}");
        }
    }

    #[test]
    fn shapes_decide() {
        let of =
            |filled: &[(&[i64], f32)]| head_of(Family::Yolov3Tiny, SQUARE_416, 2, filled).err();
        assert_eq!(of(&[(&FINE, 0.0), (&COARSE, 0.0)]), None);
        assert_eq!(of(&[(&[1, 2535, 1, 4], 0.0), (&[1, 2535, 2], 0.0)]), None);
        assert_eq!(
            of(&[(&[1, 255, 26, 26], 0.0), (&[1, 255, 13, 13], 0.0)]),
            Some(HeadProblem::ClassCount { scored: 80 })
        );
        for wrong in [
            &[(&FINE[..], 0.0), (&FINE, 0.0)][..],
            &[(&FINE, 0.0)],
            &[(&[1, 22, 26, 26], 0.0), (&[1, 22, 13, 13], 0.0)],
        ] {
            assert!(matches!(of(wrong), Some(HeadProblem::Output { .. })));
        }
    }
}
