//! Masks as sums of prototypes (Bolya et al. 2019, YOLACT; so YOLOv8-seg): a second output
//! `[1, count, rows, columns]` over the input, and coefficients a box. A mask is where the sum is above
//! zero, which is where its sigmoid is above one half.

use super::InputSize;
use crate::detect::mask::MaskLogits;

/// How the prototypes lie in their output.
pub struct Prototypes {
    place: usize,
    count: usize,
    columns: usize,
    rows: usize,
    /// Input pixels per prototype pixel: across, down.
    stride: (f64, f64),
}

impl Prototypes {
    /// For an output of this shape; `None` when it is none.
    pub fn new(input: InputSize, shape: &[i64], place: usize) -> Option<Self> {
        let [1, count, rows, columns] = *shape else {
            return None;
        };
        let length = |length: i64| usize::try_from(length).ok().filter(|length| *length > 0);
        let (count, rows, columns) = (length(count)?, length(rows)?, length(columns)?);
        Some(Self {
            place,
            count,
            columns,
            rows,
            stride: (
                input.width as f64 / columns as f64,
                input.height as f64 / rows as f64,
            ),
        })
    }

    /// Coefficients that a box has.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Their sum, weighted.
    pub fn logits(&self, outputs: &[&[f32]], coefficients: &[f32]) -> Option<MaskLogits> {
        let pixels = self.rows * self.columns;
        let mut values = vec![0.0; pixels];
        let planes = outputs.get(self.place)?.chunks_exact(pixels);
        for (plane, coefficient) in planes.zip(coefficients) {
            for (value, prototype) in values.iter_mut().zip(plane) {
                *value += coefficient * prototype;
            }
        }
        Some(MaskLogits {
            columns: self.columns,
            rows: self.rows,
            stride: self.stride,
            values,
        })
    }
}
