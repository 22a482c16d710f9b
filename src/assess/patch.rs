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
const SCALES: [f64; 3] = [0.88, 1.0, 1.14];
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
        let edge = (SIDE - INNER) / 2;
        let mine = Window::of(|column, row| self.at(column + edge, row + edge));
        if mine.squares < LEAST_VARIANCE * (INNER * INNER) as f64 {
            return None;
        }
        let shifts = 0..=SIDE - INNER;
        let alike = SCALES
            .iter()
            .map(|scale| other.scaled(*scale))
            .flat_map(|other| {
                let rows = shifts.clone();
                let all = rows.flat_map(|down| shifts.clone().map(move |across| (across, down)));
                all.map(|(across, down)| {
                    mine.correlation(&Window::of(|column, row| {
                        other.at(column + across, row + down)
                    }))
                })
                .collect::<Vec<_>>()
            });
        Some(1.0 - alike.fold(0.0, f64::max))
    }

    fn at(&self, column: usize, row: usize) -> f64 {
        f64::from(self.0[row * SIDE + column])
    }

    /// The same picture, larger about its middle by a factor.
    fn scaled(&self, factor: f64) -> Self {
        let middle = (SIDE as f64 - 1.0) / 2.0;
        let source = |cell: usize| {
            ((cell as f64 - middle) / factor + middle).clamp(0.0, SIDE as f64 - 1.001)
        };
        let cells = std::array::from_fn(|index| {
            let (x, y) = (source(index % SIDE), source(index / SIDE));
            let (left, upper) = (x as usize, y as usize);
            let (right_share, lower_share) = (x.fract(), y.fract());
            let row = |row: usize| {
                self.at(left, row) * (1.0 - right_share) + self.at(left + 1, row) * right_share
            };
            (row(upper) * (1.0 - lower_share) + row(upper + 1) * lower_share).round() as u8
        });
        Self(cells)
    }
}

/// Part of a patch about its mean.
struct Window {
    values: [f64; INNER * INNER],
    squares: f64,
}

impl Window {
    fn of(level: impl Fn(usize, usize) -> f64) -> Self {
        let mut values: [f64; INNER * INNER] =
            std::array::from_fn(|index| level(index % INNER, index / INNER));
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        values.iter_mut().for_each(|value| *value -= mean);
        let squares = values.iter().map(|value| value * value).sum();
        Self { values, squares }
    }

    fn correlation(&self, other: &Self) -> f64 {
        let product: f64 = self
            .values
            .iter()
            .zip(&other.values)
            .map(|(a, b)| a * b)
            .sum();
        product / (self.squares * other.squares).sqrt().max(f64::MIN_POSITIVE)
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
    }

    #[test]
    fn what_took_another_shape_is_not_and_a_plain_wall_says_nothing() {
        let before = patch(blob(11.0, 12.0, 5.0));
        let after = patch(|x, y| blob(6.0, 6.0, 3.0)(x, y).max(blob(17.0, 17.0, 3.0)(x, y)));
        assert!(after.change(&before).unwrap() > 0.3);
        assert_eq!(patch(|_, _| 90.0).change(&before), None);
    }
}
