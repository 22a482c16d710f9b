//! Areas of both eyes on one raster, smoothed alike.

use super::patch::{Area, Gray};
use std::ops::Range;

/// How much each pixel of an area counts, 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Weights {
    pub area: Area,
    pub values: Vec<f32>,
}

/// The least area with all that counts, and how many pixels count.
pub(super) fn counted(weights: &Weights) -> Option<(Area, usize)> {
    let area = &weights.area;
    let (mut least, mut most) = ((i32::MAX, i32::MAX), (i32::MIN, i32::MIN));
    let mut counted = 0;
    for (row, line) in (area.top..).zip(weights.values.chunks_exact(area.width().max(1))) {
        let first = line.iter().position(|weight| *weight > 0.0);
        let last = line.iter().rposition(|weight| *weight > 0.0);
        if let (Some(first), Some(last)) = (first, last) {
            counted += line.iter().filter(|weight| **weight > 0.0).count();
            least = (least.0.min(area.left + first as i32), least.1.min(row));
            most = (most.0.max(area.left + last as i32), row);
        }
    }
    (counted > 0).then_some((
        Area {
            left: least.0,
            top: least.1,
            right: most.0 + 1,
            bottom: most.1 + 1,
        },
        counted,
    ))
}

impl Weights {
    /// Over another area; nothing counts outside of the columns that are seen.
    pub fn over(&self, area: Area, seen: &Range<i32>) -> Vec<f32> {
        let mut values = vec![0.0; area.width() * area.height()];
        let from = area.left.max(self.area.left).max(seen.start);
        let to = area.right.min(self.area.right).min(seen.end);
        for row in area.top.max(self.area.top)..area.bottom.min(self.area.bottom) {
            if from < to {
                let there = (row - self.area.top) as usize * self.area.width();
                let there = there + (from - self.area.left) as usize;
                let here = (row - area.top) as usize * area.width();
                let here = here + (from - area.left) as usize;
                let count = (to - from) as usize;
                values[here..here + count].copy_from_slice(&self.values[there..there + count]);
            }
        }
        values
    }
}

/// An area of an image, read `shift` columns further on; its edges repeat.
pub(super) fn plane(image: &Gray, area: Area, shift: i32) -> Vec<f32> {
    let (first, last) = (image.area.left - shift, image.area.right - 1 - shift);
    let mut values = Vec::with_capacity(area.width() * area.height());
    for row in area.top..area.bottom {
        let line = image.row(row.clamp(image.area.top, image.area.bottom - 1));
        let inside = area.left.max(first)..area.right.min(last + 1);
        if inside.is_empty() {
            let edge = if area.left > last { line.len() - 1 } else { 0 };
            values.resize(values.len() + area.width(), line[edge]);
            continue;
        }
        values.resize(values.len() + (inside.start - area.left) as usize, line[0]);
        values.extend_from_slice(
            &line[(inside.start - first) as usize..(inside.end - first) as usize],
        );
        values.resize(
            values.len() + (area.right - inside.end) as usize,
            line[line.len() - 1],
        );
    }
    values
}

/// Means of squares of `side` pixels.
pub(super) fn averaged(plane: Vec<f32>, width: usize, side: usize) -> Vec<f32> {
    if side == 1 {
        return plane;
    }
    let wide = width / side;
    let share = 1.0 / (side * side) as f32;
    let mut means = vec![0.0; plane.len() / (side * side)];
    for (row, line) in plane.chunks_exact(width).enumerate() {
        let means = &mut means[row / side * wide..][..wide];
        for (mean, square) in means.iter_mut().zip(line.chunks_exact(side)) {
            *mean += share * square.iter().sum::<f32>();
        }
    }
    means
}

/// Through the binomial filter 1 2 1 in both directions, edges repeated: what an interpolation gets wrong
/// lies above its cut-off, and so does much noise.
pub(super) fn smoothed(plane: &[f32], width: usize) -> Vec<f32> {
    let height = plane.len() / width;
    let mut across = Vec::with_capacity(plane.len());
    for line in plane.chunks_exact(width) {
        across.push(0.25 * (3.0 * line[0] + line[1]));
        across.extend(line.windows(3).map(|w| 0.25 * (w[0] + 2.0 * w[1] + w[2])));
        across.push(0.25 * (line[width - 2] + 3.0 * line[width - 1]));
    }
    let mut both = Vec::with_capacity(plane.len());
    for row in 0..height {
        let line = |row: usize| &across[row * width..(row + 1) * width];
        let (above, here, below) = (
            line(row.saturating_sub(1)),
            line(row),
            line((row + 1).min(height - 1)),
        );
        let mixed = above.iter().zip(here).zip(below);
        both.extend(mixed.map(|((a, h), b)| 0.25 * (a + 2.0 * h + b)));
    }
    both
}
