//! Two ways in which models say where a box is.

/// Left, top, right, bottom.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corners(pub [f32; 4]);

impl Corners {
    /// From middle (column, row) and size (width, height).
    pub fn about(middle: [f32; 2], size: [f32; 2]) -> Self {
        let [half_width, half_height] = size.map(|length| length / 2.0);
        Self([
            middle[0] - half_width,
            middle[1] - half_height,
            middle[0] + half_width,
            middle[1] + half_height,
        ])
    }

    /// As a found box.
    pub fn found(self, (class, score): (usize, f32), row: usize) -> super::InputBox {
        let [left, top, right, bottom] = self.0;
        super::InputBox {
            class,
            score,
            left,
            top,
            right,
            bottom,
            row,
        }
    }
}
