//! Points of an image by cells: those near to a place are found without looking at all of them.

use std::ops::RangeInclusive;

/// Side of a cell, pixels: as wide as what a gate holds of a well known fire.
const CELL_PX: f64 = 16.0;

/// Points by their index, cell by cell. What lies outside of the image belongs to its nearest cell.
#[derive(Debug, Clone)]
pub struct Grid {
    columns: usize,
    rows: usize,
    /// Where each cell's members begin, and where the last one's end.
    starts: Vec<usize>,
    members: Vec<usize>,
}

impl Grid {
    /// Over an image of some width and height, pixels; points are columns and rows.
    #[must_use]
    pub fn new((width, height): (u32, u32), points: &[(f64, f64)]) -> Self {
        let cells = |size: u32| (f64::from(size) / CELL_PX).ceil().max(1.0) as usize;
        let mut grid = Self {
            columns: cells(width),
            rows: cells(height),
            starts: Vec::new(),
            members: vec![0; points.len()],
        };
        let cell_of: Vec<usize> = points.iter().map(|point| grid.cell(*point)).collect();
        grid.starts = vec![0; grid.columns * grid.rows + 1];
        for cell in &cell_of {
            grid.starts[cell + 1] += 1;
        }
        for cell in 1..grid.starts.len() {
            grid.starts[cell] += grid.starts[cell - 1];
        }
        let mut next = grid.starts.clone();
        for (index, cell) in cell_of.into_iter().enumerate() {
            grid.members[next[cell]] = index;
            next[cell] += 1;
        }
        grid
    }

    /// All points within `reach` (columns, rows) of a place, and some that are not: those of the same cells.
    pub fn near(&self, at: (f64, f64), reach: (f64, f64)) -> impl Iterator<Item = usize> {
        let columns = span(at.0, reach.0, self.columns);
        span(at.1, reach.1, self.rows).flat_map(move |row| {
            let first = row * self.columns;
            let from = self.starts[first + columns.start()];
            let to = self.starts[first + columns.end() + 1];
            self.members[from..to].iter().copied()
        })
    }

    fn cell(&self, (u, v): (f64, f64)) -> usize {
        index(v, self.rows) * self.columns + index(u, self.columns)
    }
}

fn span(at: f64, reach: f64, count: usize) -> RangeInclusive<usize> {
    index(at - reach, count)..=index(at + reach, count)
}

/// Of a pixel among so many cells; a cast clamps below, and makes 0 of what is no number.
fn index(px: f64, count: usize) -> usize {
    ((px / CELL_PX) as usize).min(count - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn nothing_near_is_missed_and_nothing_comes_twice(
            points in prop::collection::vec((-900.0..2200.0_f64, -900.0..1500.0_f64), 0..80),
            at in (-900.0..2200.0_f64, -900.0..1500.0_f64),
            reach in (0.0..90.0_f64, 0.0..90.0_f64),
        ) {
            let grid = Grid::new((1280, 720), &points);
            let mut found: Vec<usize> = grid.near(at, reach).collect();
            found.sort_unstable();
            prop_assert!(found.windows(2).all(|pair| pair[0] < pair[1]));
            for (index, point) in points.iter().enumerate() {
                let is_near = (point.0 - at.0).abs() <= reach.0 && (point.1 - at.1).abs() <= reach.1;
                prop_assert!(!is_near || found.binary_search(&index).is_ok());
            }
        }
    }

    #[test]
    fn few_others_are_looked_at() {
        let points: Vec<_> = (0..10_000)
            .map(|i| (12.8 * f64::from(i % 100), 7.2 * f64::from(i / 100)))
            .collect();
        let grid = Grid::new((1280, 720), &points);
        assert!(grid.near((640.0, 360.0), (8.0, 8.0)).count() < 40);
    }
}
