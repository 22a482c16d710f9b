//! The cells that detectors predict from: one grid a stride, row-major, finest first.

use super::InputSize;

/// One cell of one grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cell {
    /// From the left, cells.
    pub column: f32,
    /// From above, cells.
    pub row: f32,
    /// Side of a cell, input pixels.
    pub stride: f32,
}

/// All cells of these strides.
pub fn cells(input: InputSize, strides: &[usize]) -> Vec<Cell> {
    let mut cells = Vec::with_capacity(count(input, strides));
    for &stride in strides {
        let (columns, rows) = input.grid(stride);
        cells.extend((0..rows * columns).map(|index| Cell {
            column: (index % columns) as f32,
            row: (index / columns) as f32,
            stride: stride as f32,
        }));
    }
    cells
}

/// How many they are.
pub fn count(input: InputSize, strides: &[usize]) -> usize {
    let of = |stride: &usize| {
        let (columns, rows) = input.grid(*stride);
        columns * rows
    };
    strides.iter().map(of).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cell_counts_are_the_published_ones() {
        let square = |side| InputSize {
            width: side,
            height: side,
        };
        for (side, strides, published) in [
            (416, &[8, 16, 32, 64][..], 3598),
            (320, &[8, 16, 32, 64], 2125),
            (416, &[8, 16, 32], 3549),
            (640, &[8, 16, 32], 8400),
        ] {
            assert_eq!(count(square(side), strides), published);
            assert_eq!(cells(square(side), strides).len(), published);
        }
    }
}
