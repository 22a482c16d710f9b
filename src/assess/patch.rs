//! What a thing looks like in one look, and how much of that is another in the next.
//!
//! A roof, a tree or a car is a rigid picture: shifted and scaled onto itself it is the same again, whatever the
//! camera did meanwhile. A flame is another flame half a second later. Light and contrast do not count.

/// Cells along a side of a patch, and of the part of it that is looked for in another.
pub const SIDE: usize = 24;
const INNER: usize = 16;
/// A patch holds a box and so much about it, as a share of its longer side.
pub const MARGIN: f64 = 1.4;
/// Boxes jitter by so much in size.
const SCALES: [f32; 3] = [0.88, 1.0, 1.14];
/// Contrast below this is noise, grey levels squared.
const LEAST_VARIANCE: f64 = 16.0;

/// A box and its margin, brought to [`SIDE`] cells a side: grey levels, rows from the top.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Patch(pub [u8; SIDE * SIDE]);

impl Patch {
    /// What of this picture is not in the other one: 0 is the same, 1 has nothing in common; `None` where
    /// there is too little contrast to tell.
    #[must_use]
    pub fn change(&self, other: &Self) -> Option<f64> {
        let mine = self.scaled(1.0);
        let inner = mine.window(EDGE, EDGE);
        let (sum, squares) = Sums::of(&mine).about_mean(EDGE, EDGE);
        if squares < LEAST_VARIANCE * CELLS {
            return None;
        }
        let scales = SCALES.map(|scale| {
            let levels = other.scaled(scale);
            (Sums::of(&levels), levels)
        });
        let correlation = |place: Place| {
            let (sums, levels) = &scales[place.scale];
            let (other_sum, other_squares) = sums.about_mean(place.across, place.down);
            let product = f64::from(levels.product(&inner, place.across, place.down));
            let both = (squares * other_squares).sqrt().max(f64::MIN_POSITIVE);
            (product - sum * other_sum / CELLS) / both
        };
        let best_of = |places: Vec<Place>| {
            let correlated = places.into_iter().map(|place| (correlation(place), place));
            correlated.fold((0.0, Place::MIDDLE), |best, one| {
                if one.0 > best.0 { one } else { best }
            })
        };
        // Boxes are cut to a cell or two, and what is wider than a cell correlates with its neighbours too.
        let (coarse, near) = best_of(Place::all());
        let (fine, _) = best_of(near.beside());
        Some(1.0 - fine.max(coarse))
    }

    /// The same picture, larger about its middle by a factor.
    fn scaled(&self, factor: f32) -> Levels {
        let middle = (SIDE as f32 - 1.0) / 2.0;
        // For a column or row of the larger picture the one of this, and the share of the next.
        let sources: [(usize, f32); SIDE] = std::array::from_fn(|cell| {
            let source = (cell as f32 - middle) / factor + middle;
            let source = source.clamp(0.0, SIDE as f32 - 1.001);
            (source as usize, source.fract())
        });
        let (rows, _) = self.0.as_chunks::<SIDE>();
        let wide: [[f32; SIDE]; SIDE] = std::array::from_fn(|row| {
            sources.map(|(left, share)| {
                let [left, right] = [left, left + 1].map(|column| f32::from(rows[row][column]));
                left + (right - left) * share
            })
        });
        Levels(sources.map(|(upper, share)| {
            let (upper, lower) = (&wide[upper], &wide[upper + 1]);
            std::array::from_fn(|column| {
                (upper[column] + (lower[column] - upper[column]) * share + 0.5) as i16
            })
        }))
    }
}

/// Cells about the part that is looked for, and how many that part has.
const EDGE: usize = (SIDE - INNER) / 2;
const CELLS: f64 = (INNER * INNER) as f64;

/// Where the part may be in another patch: an index of [`SCALES`], cells across and down.
#[derive(Clone, Copy)]
struct Place {
    scale: usize,
    across: usize,
    down: usize,
}

impl Place {
    const MIDDLE: Self = Self {
        scale: 1,
        across: EDGE,
        down: EDGE,
    };

    /// Every other cell.
    fn all() -> Vec<Self> {
        let every_other = || (0..=2 * EDGE).step_by(2);
        let down = (0..SCALES.len()).flat_map(|scale| every_other().map(move |down| (scale, down)));
        down.flat_map(|(scale, down)| {
            every_other().map(move |across| Self {
                scale,
                across,
                down,
            })
        })
        .collect()
    }

    /// The cells about this one.
    fn beside(self) -> Vec<Self> {
        let about = |cell: usize| cell.saturating_sub(1)..=(cell + 1).min(2 * EDGE);
        let down = about(self.down);
        down.flat_map(|down| {
            about(self.across).map(move |across| Self {
                across,
                down,
                ..self
            })
        })
        .collect()
    }
}

/// Grey levels, in a type of which processors multiply many at once.
struct Levels([[i16; SIDE]; SIDE]);
/// Those of a part.
type Window = [[i16; INNER]; INNER];

impl Levels {
    fn row(&self, across: usize, down: usize) -> &[i16; INNER] {
        let row = self.0[down][across..].first_chunk();
        row.unwrap_or(&[0; INNER])
    }

    fn window(&self, across: usize, down: usize) -> Window {
        std::array::from_fn(|row| *self.row(across, row + down))
    }

    /// Of a part with a window; 256 products of two grey levels fit.
    fn product(&self, window: &Window, across: usize, down: usize) -> i32 {
        let mut sum = 0;
        for (row, levels) in window.iter().enumerate() {
            let row = self.row(across, row + down);
            for column in 0..INNER {
                sum += i32::from(levels[column]) * i32::from(row[column]);
            }
        }
        sum
    }
}

/// Sums of the grey levels, and of their squares, above and left of each corner (Crow, "Summed-area tables",
/// 1984).
struct Sums([[(i32, i32); SIDE + 1]; SIDE + 1]);

impl Sums {
    fn of(levels: &Levels) -> Self {
        let mut table = [[(0, 0); SIDE + 1]; SIDE + 1];
        for (row, levels) in levels.0.iter().enumerate() {
            let (mut sum, mut squares) = (0, 0);
            for (column, level) in levels.iter().enumerate() {
                let level = i32::from(*level);
                sum += level;
                squares += level * level;
                let above = table[row][column + 1];
                table[row + 1][column + 1] = (above.0 + sum, above.1 + squares);
            }
        }
        Self(table)
    }

    /// Sum over a part, and sum of the squares about its mean.
    fn about_mean(&self, across: usize, down: usize) -> (f64, f64) {
        let corner = |right: usize, lower: usize| self.0[down + lower][across + right];
        let corners = [
            corner(INNER, INNER),
            corner(0, 0),
            corner(INNER, 0),
            corner(0, INNER),
        ];
        let of = |[a, b, c, d]: [i32; 4]| f64::from(a + b - c - d);
        let (sum, squares) = (of(corners.map(|c| c.0)), of(corners.map(|c| c.1)));
        (sum, squares - sum * sum / CELLS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn patch(level: impl Fn(f64, f64) -> f64) -> Patch {
        let at = |index: usize| level((index % SIDE) as f64, (index / SIDE) as f64);
        Patch(std::array::from_fn(|index| {
            at(index).clamp(0.0, 255.0) as u8
        }))
    }

    fn blob(x: f64, y: f64, radius: f64) -> impl Fn(f64, f64) -> f64 {
        move |column, row| {
            let squared = ((column - x).powi(2) + (row - y).powi(2)) / (radius * radius);
            40.0 + 160.0 * (-squared).exp()
        }
    }

    #[test]
    fn what_moved_and_came_nearer_in_other_light_is_the_same() {
        let before = patch(blob(11.0, 12.0, 5.0));
        let after = patch(|x, y| 0.7 * blob(13.0, 10.0, 5.5)(x, y) + 20.0);
        assert!(after.change(&before).unwrap() < 0.03);
        let after = patch(|x, y| 0.7 * blob(8.0, 15.0, 4.5)(x, y) + 20.0);
        assert!(after.change(&before).unwrap() < 0.03, "an odd shift");
    }

    #[test]
    fn what_took_another_shape_is_not_and_a_plain_wall_says_nothing() {
        let before = patch(blob(11.0, 12.0, 5.0));
        let after = patch(|x, y| blob(6.0, 6.0, 3.0)(x, y).max(blob(17.0, 17.0, 3.0)(x, y)));
        assert!(after.change(&before).unwrap() > 0.3);
        assert_eq!(patch(|_, _| 90.0).change(&before), None);
    }
}
