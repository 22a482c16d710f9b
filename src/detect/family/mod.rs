//! The families of models that can be decoded, one file each. A family is named by the mission or by
//! the model's metadata; the tensors of its first answer decide whether that is true.

mod boxes;
mod darknet;
mod grid;
mod nanodet;
mod prototypes;
mod yolo_nas;
mod yolov5;
mod yolov8;
mod yolox;

use super::{ModelForm, mask::MaskLogits};
use boxes::Corners;
use serde::{Deserialize, Serialize};

/// A family of detectors: what its tensors are and mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Family {
    /// NanoDet (the first one): score and distance maps of three strides, six outputs.
    Nanodet,
    /// NanoDet-Plus: one output, class scores and binned distances per cell.
    NanodetPlus,
    /// YOLOv5: one output, decoded boxes, objectness and class scores.
    Yolov5,
    /// YOLOv8: one output, box and class scores, channel-major; or its end-to-end form.
    Yolov8,
    /// YOLOv8-seg and what has its outputs (YOLO-EB): boxes, mask coefficients, prototypes.
    Yolov8Seg,
    /// YOLOX: one output, boxes raw or decoded, scores with or without sigmoid.
    Yolox,
    /// YOLO-NAS: boxes and scores in two outputs.
    YoloNas,
    /// YOLOv3 of Darknet: three maps, or boxes and scores.
    Yolov3,
    /// YOLOv3-tiny of Darknet: two maps, or boxes and scores.
    Yolov3Tiny,
    /// YOLOv4 of Darknet: three maps, or boxes and scores.
    Yolov4,
    /// YOLOv4-tiny of Darknet: two maps, or boxes and scores.
    Yolov4Tiny,
}

impl Family {
    /// All of them, with their names in missions and in model metadata.
    const NAMES: [(Self, &'static str); 11] = [
        (Self::Nanodet, "nanodet"),
        (Self::NanodetPlus, "nanodet-plus"),
        (Self::Yolov5, "yolov5"),
        (Self::Yolov8, "yolov8"),
        (Self::Yolov8Seg, "yolov8-seg"),
        (Self::Yolox, "yolox"),
        (Self::YoloNas, "yolo-nas"),
        (Self::Yolov3, "yolov3"),
        (Self::Yolov3Tiny, "yolov3-tiny"),
        (Self::Yolov4, "yolov4"),
        (Self::Yolov4Tiny, "yolov4-tiny"),
    ];

    /// All of them.
    pub fn all() -> impl Iterator<Item = Self> {
        Self::NAMES.into_iter().map(|(family, _)| family)
    }

    /// As written in missions and in model metadata.
    #[must_use]
    pub fn name(self) -> &'static str {
        let mut names = Self::NAMES.into_iter();
        names
            .find(|(family, _)| *family == self)
            .map_or("", |(_, name)| name)
    }

    pub(super) fn from_name(name: &str) -> Option<Self> {
        Self::all().find(|family| family.name() == name)
    }

    pub(super) fn known() -> String {
        Self::NAMES.map(|(_, name)| name).join(", ")
    }

    /// What its published trainings read; a model's metadata may say otherwise.
    pub(super) fn normalisation(self) -> Normalisation {
        match self {
            Self::Nanodet | Self::NanodetPlus => nanodet::NORMALISATION,
            Self::Yolox => yolox::NORMALISATION,
            _ => Normalisation::RGB_TO_ONE,
        }
    }

    /// The decoder for the tensors of a first answer, or what is wrong with them.
    pub(super) fn head(
        self,
        model: &ModelShape<'_>,
        outputs: &[Output<'_>],
    ) -> Result<Box<dyn Head>, HeadProblem> {
        match self {
            Self::Nanodet => nanodet::maps(model, outputs),
            Self::NanodetPlus => nanodet::plus(model, outputs),
            Self::Yolov5 => yolov5::head(model, outputs),
            Self::Yolov8 => yolov8::head(model, outputs),
            Self::Yolov8Seg => yolov8::segmenting(model, outputs),
            Self::Yolox => yolox::head(model, outputs),
            Self::YoloNas => yolo_nas::head(model, outputs),
            Self::Yolov3 => darknet::head(&darknet::YOLOV3, model, outputs),
            Self::Yolov3Tiny => darknet::head(&darknet::YOLOV3_TINY, model, outputs),
            Self::Yolov4 => darknet::head(&darknet::YOLOV4, model, outputs),
            Self::Yolov4Tiny => darknet::head(&darknet::YOLOV4_TINY, model, outputs),
        }
    }
}

/// Order of the colour channels that a model reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Colour {
    Bgr,
    Rgb,
}

/// How 8-bit values become the model's: `(value - mean) / std`, channels in the model's order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Normalisation {
    pub colour: Colour,
    pub mean: [f32; 3],
    pub std: [f32; 3],
}

impl Normalisation {
    /// Red first, 0 to 1.
    const RGB_TO_ONE: Self = Self {
        colour: Colour::Rgb,
        mean: [0.0; 3],
        std: [255.0; 3],
    };
}

/// The network's input, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct InputSize {
    pub width: usize,
    pub height: usize,
}

impl InputSize {
    /// Cells of a grid of one stride: columns, rows; a partial cell counts.
    pub fn grid(self, stride: usize) -> (usize, usize) {
        (self.width.div_ceil(stride), self.height.div_ceil(stride))
    }
}

/// What is known of a model beside its outputs.
#[derive(Debug, Clone, Copy)]
pub(super) struct ModelShape<'a> {
    pub input: InputSize,
    pub classes: usize,
    /// What shapes cannot tell, as far as mission or metadata do.
    pub form: &'a ModelForm,
}

/// One output of a model.
#[derive(Debug, Clone, Copy)]
pub(super) struct Output<'a> {
    pub shape: &'a [i64],
    pub values: &'a [f32],
}

impl Output<'_> {
    /// Whether all values may be probabilities.
    fn is_probable(&self) -> bool {
        self.values.iter().all(|value| (0.0..=1.0).contains(value))
    }
}

/// A box in pixels of the network's input, edges (pixel 0 spans 0 to 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InputBox {
    pub class: usize,
    pub score: f32,
    pub left: f32,
    pub top: f32,
    pub right: f32,
    pub bottom: f32,
    /// Which of the head's rows it stood in.
    pub row: usize,
}

/// Why a model's outputs are not the family's.
#[derive(Debug, PartialEq)]
pub(super) enum HeadProblem {
    Output {
        expected: String,
        found: String,
    },
    ClassCount {
        scored: i64,
    },
    /// Neither shapes nor values decide.
    Undecided {
        what: &'static str,
    },
}

/// Turns the outputs of one run into boxes.
pub(super) trait Head: Send {
    /// Boxes whose score reaches its class's floor, in no order. `outputs` have the shapes that the
    /// head was made for and hold finite numbers.
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox>;

    /// The mask of one of these boxes, for models that have masks.
    fn mask(&self, _outputs: &[&[f32]], _found: &InputBox) -> Option<MaskLogits> {
        None
    }
}

/// The class with the best score that reaches its floor.
fn best_class(scores: impl Iterator<Item = f32>, floors: &[f32]) -> Option<(usize, f32)> {
    scores
        .zip(floors)
        .enumerate()
        .filter(|(_, (score, floor))| score >= floor)
        .map(|(class, (score, _))| (class, score))
        .max_by(|a, b| a.1.total_cmp(&b.1))
}

/// The least score that any class asks for.
fn lowest(floors: &[f32]) -> f32 {
    floors.iter().copied().fold(f32::INFINITY, f32::min)
}

fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

fn wrong_output(expected: impl Into<String>, outputs: &[Output<'_>]) -> HeadProblem {
    let found: Vec<String> = outputs
        .iter()
        .map(|output| format!("{:?}", output.shape))
        .collect();
    HeadProblem::Output {
        expected: expected.into(),
        found: found.join(" and "),
    }
}

#[cfg(test)]
mod testing {
    use super::*;

    pub const SQUARE_416: InputSize = InputSize {
        width: 416,
        height: 416,
    };
    pub const SQUARE_640: InputSize = InputSize {
        width: 640,
        height: 640,
    };

    /// Outputs of these shapes, filled with one value each.
    pub fn head_of(
        family: Family,
        input: InputSize,
        classes: usize,
        filled: &[(&[i64], f32)],
    ) -> Result<Box<dyn Head>, HeadProblem> {
        let values: Vec<Vec<f32>> = filled
            .iter()
            .map(|(shape, value)| vec![*value; shape.iter().product::<i64>() as usize])
            .collect();
        let outputs: Vec<Output<'_>> = filled
            .iter()
            .zip(&values)
            .map(|((shape, _), values)| Output { shape, values })
            .collect();
        let form = ModelForm::default();
        let model = ModelShape {
            input,
            classes,
            form: &form,
        };
        family.head(&model, &outputs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_that_missions_write() {
        for family in Family::all() {
            assert_eq!(
                serde_json::to_value(family).unwrap(),
                serde_json::json!(family.name())
            );
            assert_eq!(Family::from_name(family.name()), Some(family));
        }
    }
}
