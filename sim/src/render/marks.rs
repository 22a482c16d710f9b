//! Which marks lie under a patch of ground.

use crate::world::Mark;
use std::collections::HashMap;

/// Side of a cell, metres.
const CELL_M: f64 = 8.0;
/// A patch this wide is so far away that its marks are a pixel or less.
const WIDEST_M: f64 = 60.0;

/// Marks by the cells that they touch.
#[derive(Debug, Clone, Default)]
pub(super) struct MarkGrid {
    cells: HashMap<(i64, i64), Vec<Mark>>,
}

impl MarkGrid {
    pub(super) fn new(marks: &[Mark]) -> Self {
        let mut grid = Self::default();
        for mark in marks {
            // Ragged edges reach a little beyond the radius.
            let reach = 1.3 * mark.radius_m;
            let (low, high) = (
                mark.centre_m.add_scalar(-reach),
                mark.centre_m.add_scalar(reach),
            );
            for cell in cells((low.x, low.y), (high.x, high.y)) {
                grid.cells.entry(cell).or_default().push(*mark);
            }
        }
        grid
    }

    /// Visits every mark that may touch the rectangle, each once for every cell that it shares...
    pub(super) fn within(&self, low: (f64, f64), high: (f64, f64), mut visit: impl FnMut(&Mark)) {
        if self.cells.is_empty() || high.0 - low.0 > WIDEST_M || high.1 - low.1 > WIDEST_M {
            return;
        }
        for cell in cells(low, high) {
            for mark in self.cells.get(&cell).into_iter().flatten() {
                // ...but a mark over several cells counts in the first of them only.
                if first_shared(mark, low) == cell {
                    visit(mark);
                }
            }
        }
    }
}

/// The lowest cell that a mark and a rectangle beginning at `low` share.
fn first_shared(mark: &Mark, low: (f64, f64)) -> (i64, i64) {
    let reach = 1.3 * mark.radius_m;
    let (east, north) = (mark.centre_m.x - reach, mark.centre_m.y - reach);
    (
        index(east).max(index(low.0)),
        index(north).max(index(low.1)),
    )
}

fn cells(low: (f64, f64), high: (f64, f64)) -> impl Iterator<Item = (i64, i64)> {
    let norths = index(low.1)..=index(high.1);
    (index(low.0)..=index(high.0)).flat_map(move |e| norths.clone().map(move |n| (e, n)))
}

fn index(metres: f64) -> i64 {
    (metres / CELL_M).floor() as i64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::MarkKind;
    use nalgebra::Vector2;

    #[test]
    fn a_mark_over_many_cells_is_met_once() {
        let mark = Mark {
            kind: MarkKind::Shadow,
            centre_m: Vector2::new(3.0, -9.0),
            radius_m: 20.0,
        };
        let grid = MarkGrid::new(&[mark]);
        for (low, high) in [
            ((-30.0, -40.0), (29.0, 19.0)),
            ((1.0, -9.0), (2.0, -7.0)),
            ((7.0, 7.0), (9.0, 9.0)),
        ] {
            let mut met = 0;
            grid.within(low, high, |_| met += 1);
            assert_eq!(met, 1, "{low:?}");
        }
        grid.within((100.0, 0.0), (101.0, 1.0), |_| panic!("nothing is there"));
    }
}
