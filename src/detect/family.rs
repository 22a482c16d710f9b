//! The families of models that can be decoded, one file each; the shapes decide.

use super::{nanodet, yolov8};
use serde::{Deserialize, Serialize};

/// A family of detectors: what its tensors are and mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Family {
    /// NanoDet-Plus: one output, class scores and binned distances per cell.
    NanodetPlus,
    /// YOLOv8: one output, box and class scores, channel-major.
    Yolov8,
}

impl Family {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::NanodetPlus, Self::Yolov8];

    /// As written in missions and in model metadata.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::NanodetPlus => "nanodet-plus",
            Self::Yolov8 => "yolov8",
        }
    }

    pub(super) fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|family| family.name() == name)
    }

    pub(super) fn known() -> String {
        Self::ALL.map(Self::name).join(", ")
    }

    pub(super) fn normalisation(self) -> Normalisation {
        match self {
            Self::NanodetPlus => nanodet::NORMALISATION,
            Self::Yolov8 => yolov8::NORMALISATION,
        }
    }

    /// The decoder for these tensors, or what is wrong with them.
    pub(super) fn head(
        self,
        input: InputSize,
        classes: usize,
        outputs: &[Vec<i64>],
    ) -> Result<Box<dyn Head>, ShapeProblem> {
        match self {
            Self::NanodetPlus => Ok(Box::new(nanodet::NanodetPlus::new(
                input, classes, outputs,
            )?)),
            Self::Yolov8 => Ok(Box::new(yolov8::Yolov8::new(input, classes, outputs)?)),
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

/// A box in pixels of the network's input, edges (pixel 0 spans 0 to 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InputBox {
    pub class: usize,
    pub score: f32,
    pub left: f32,
    pub top: f32,
    pub right: f32,
    pub bottom: f32,
}

/// Why a model's outputs are not the family's.
#[derive(Debug, PartialEq)]
pub(super) enum ShapeProblem {
    Output { expected: String, found: String },
    ClassCount { scored: i64 },
}

/// Turns the outputs of one run into boxes.
pub(super) trait Head: Send {
    /// Boxes whose score reaches its class's floor, in no order. `outputs` have the shapes that the
    /// head was made for and hold finite numbers.
    fn decode(&self, outputs: &[&[f32]], floors: &[f32]) -> Vec<InputBox>;
}

/// The class with the best score that reaches its floor.
pub(super) fn best_class(
    scores: impl Iterator<Item = f32>,
    floors: &[f32],
) -> Option<(usize, f32)> {
    scores
        .zip(floors)
        .enumerate()
        .filter(|(_, (score, floor))| score >= floor)
        .map(|(class, (score, _))| (class, score))
        .max_by(|a, b| a.1.total_cmp(&b.1))
}

pub(super) fn shape_text(outputs: &[Vec<i64>]) -> String {
    outputs
        .iter()
        .map(|shape| format!("{shape:?}"))
        .collect::<Vec<_>>()
        .join(" and ")
}
