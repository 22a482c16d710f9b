//! Masks: which pixels of the raw image one detection covers.

use super::BoxPx;

/// Pixels of the raw left image that a detection covers, within its box.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    left: u32,
    top: u32,
    width: u32,
    covered: Vec<bool>,
}

impl Mask {
    /// The pixels of a box whose centres `covers` says to be covered; arguments are column and row.
    /// The box lies within the image.
    #[must_use]
    pub fn within(box_px: &BoxPx, covers: impl Fn(f64, f64) -> bool) -> Self {
        let first = |edge: f64| edge.ceil().max(0.0) as u32;
        let behind = |edge: f64| edge.floor().max(-1.0) as i64 + 1;
        let (left, top) = (first(box_px.x), first(box_px.y));
        let right = behind(box_px.x + box_px.width).max(i64::from(left)) as u32;
        let bottom = behind(box_px.y + box_px.height).max(i64::from(top)) as u32;
        let pixels = (top..bottom).flat_map(|row| (left..right).map(move |column| (column, row)));
        Self {
            left,
            top,
            width: right - left,
            covered: pixels
                .map(|(column, row)| covers(f64::from(column), f64::from(row)))
                .collect(),
        }
    }

    /// Whether the pixel of this column and row is covered.
    #[must_use]
    pub fn covers(&self, column: u32, row: u32) -> bool {
        let (Some(across), Some(down)) = (column.checked_sub(self.left), row.checked_sub(self.top))
        else {
            return false;
        };
        let index = down as usize * self.width as usize + across as usize;
        across < self.width && self.covered.get(index).copied().unwrap_or(false)
    }

    /// All covered pixels: column, row.
    pub fn pixels(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let width = self.width.max(1) as usize;
        let covered = self.covered.iter().enumerate();
        covered
            .filter(|(_, covered)| **covered)
            .map(move |(index, _)| {
                let (across, down) = ((index % width) as u32, (index / width) as u32);
                (self.left + across, self.top + down)
            })
    }

    /// How many pixels are covered.
    #[must_use]
    pub fn area_px(&self) -> usize {
        self.covered.iter().filter(|covered| **covered).count()
    }

    /// Pixels of both over pixels of either, 0..1.
    #[must_use]
    pub fn iou(&self, other: &Self) -> f64 {
        let both = self.pixels().filter(|&(x, y)| other.covers(x, y)).count();
        let either = self.area_px() + other.area_px() - both;
        if either > 0 {
            both as f64 / either as f64
        } else {
            0.0
        }
    }

    /// What either covers; `box_px` holds both.
    pub(super) fn united(&self, other: &Self, box_px: &BoxPx) -> Self {
        Self::within(box_px, |column, row| {
            let (column, row) = (column as u32, row as u32);
            self.covers(column, row) || other.covers(column, row)
        })
    }
}

/// A mask as the network gives it: a grid of logits over its input.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MaskLogits {
    pub columns: usize,
    pub rows: usize,
    /// Input pixels per grid pixel: across, down.
    pub stride: (f64, f64),
    /// Row-major.
    pub values: Vec<f32>,
}

impl MaskLogits {
    /// Whether the mask covers a place of the input (edges: pixel 0 spans 0 to 1): the sign of the
    /// logits, interpolated between the four nearest grid pixels and level beyond the outermost.
    pub fn covers(&self, across: f64, down: f64) -> bool {
        let (column, right) = between(across / self.stride.0 - 0.5, self.columns);
        let (row, lower) = between(down / self.stride.1 - 0.5, self.rows);
        let at = |row: usize, column: usize| f64::from(self.values[row * self.columns + column]);
        let mixed = |a: f64, b: f64, share: f64| a + (b - a) * share;
        let next = (column + 1).min(self.columns - 1);
        let below = (row + 1).min(self.rows - 1);
        let upper = mixed(at(row, column), at(row, next), right);
        mixed(
            upper,
            mixed(at(below, column), at(below, next), right),
            lower,
        ) > 0.0
    }
}

/// The grid pixel before a place, and how far behind it the place is, 0..1.
fn between(place: f64, length: usize) -> (usize, f64) {
    let place = place.clamp(0.0, (length - 1) as f64);
    (place as usize, place.fract())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64, y: f64, side: f64) -> Mask {
        let box_px = BoxPx {
            x,
            y,
            width: side,
            height: side,
        };
        Mask::within(&box_px, |_, _| true)
    }

    #[test]
    fn pixels_whose_centres_the_box_holds_are_in_it() {
        assert_eq!(square(1.5, 0.0, 2.0).pixels().count(), 2 * 3);
        assert_eq!(square(1.2, 1.2, 0.5).area_px(), 0);
        let mask = square(3.0, 4.0, 1.0);
        assert!(mask.covers(3, 4) && mask.covers(4, 5));
        for (column, row) in [(2, 4), (5, 4), (3, 3), (3, 6)] {
            assert!(!mask.covers(column, row), "{column} {row}");
        }
    }

    #[test]
    fn overlap_is_counted_in_pixels() {
        let (a, b) = (square(0.0, 0.0, 3.0), square(2.0, 2.0, 3.0));
        // 4 x 4 each, 2 x 2 in common.
        assert_eq!(a.iou(&b), 4.0 / 28.0);
        assert_eq!(square(0.2, 0.2, 0.1).iou(&square(0.2, 0.2, 0.1)), 0.0);
    }

    #[test]
    fn the_edge_lies_where_the_logits_change_sign() {
        let logits = MaskLogits {
            columns: 2,
            rows: 1,
            stride: (4.0, 4.0),
            values: vec![-1.0, 3.0],
        };
        // Grid centres at 2 and 6: zero at a quarter of the way.
        assert!(!logits.covers(2.99, 0.0) && logits.covers(3.01, 9.0));
        assert!(!logits.covers(-5.0, 0.0) && logits.covers(50.0, 0.0));
    }
}
