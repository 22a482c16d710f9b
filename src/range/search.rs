//! Normalised correlation of a target with every place that it may be seen at in the other eye.

use super::patch::{Area, Gray};
use super::scene::Run;

/// Correlation by offset, whole pixels; not a number where too little overlaps or nothing varies.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Curve {
    pub least: i32,
    pub values: Vec<f64>,
}

/// A local maximum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Peak {
    pub at: i32,
    /// Normalised correlation there, -1..1.
    pub correlation: f64,
}

/// Pixels that are compared, about, at most: more of them change the whole pixel no longer.
const MOST_PIXELS: usize = 900;

/// Which rows of a target are compared: all, every second one, and so on.
pub(super) fn rows_apart(runs: &[Run]) -> i32 {
    let pixels: usize = runs.iter().map(|run| (run.to - run.from) as usize).sum();
    pixels.div_ceil(MOST_PIXELS).max(1) as i32
}

/// Correlates the runs' pixels of `one`, in rows `every` apart, with those of `other` that lie `offset`
/// columns further on.
pub(super) fn correlate(
    one: &Gray,
    other: &Gray,
    runs: &[Run],
    every: i32,
    offsets: impl Iterator<Item = i32>,
) -> Curve {
    let runs: Vec<Run> = runs
        .iter()
        .filter(|run| run.row % every == 0)
        .copied()
        .collect();
    let own = Own::of(one, &runs);
    let rows = Rows::of(other, &runs);
    let mut offsets = offsets.peekable();
    Curve {
        least: offsets.peek().copied().unwrap_or_default(),
        values: offsets
            .map(|offset| {
                if own.is_whole_at(other, offset) {
                    own.with(&rows, &runs, offset).correlation(own.sums.n)
                } else {
                    at_edge(one, other, &runs, offset, own.sums.n)
                }
            })
            .collect(),
    }
}

/// What is the same at every offset that cuts nothing off.
struct Own {
    sums: Sums,
    columns: (i32, i32),
    /// The runs' grey levels about the middle one, one after the other.
    levels: Vec<f32>,
}

impl Own {
    fn of(one: &Gray, runs: &[Run]) -> Self {
        let mut sums = Sums::default();
        let mut columns = (i32::MAX, i32::MIN);
        let mut levels = Vec::new();
        for run in runs {
            columns = (columns.0.min(run.from), columns.1.max(run.to));
            let pixels = cut(one, run, 0);
            sums.take(pixels, pixels);
            levels.extend(pixels.iter().map(|level| level - MIDDLE));
        }
        Self {
            sums,
            columns,
            levels,
        }
    }

    fn is_whole_at(&self, other: &Gray, offset: i32) -> bool {
        self.columns.0 + offset >= other.seen.0 && self.columns.1 + offset <= other.seen.1
    }

    fn with(&self, rows: &Rows, runs: &[Run], offset: i32) -> Sums {
        let (mut y, mut yy, mut xy) = (0.0, 0.0, 0.0);
        let mut own = &self.levels[..];
        for run in runs {
            let (here, rest) = own.split_at((run.to - run.from) as usize);
            own = rest;
            let first = rows.place(run.row, run.from + offset);
            let last = first + here.len();
            y += rows.sums[last].0 - rows.sums[first].0;
            yy += rows.sums[last].1 - rows.sums[first].1;
            xy += product(here, &rows.levels[first..last]);
        }
        Sums {
            y,
            yy,
            xy,
            ..self.sums
        }
    }
}

/// The other eye's rows that are compared: grey levels about the middle one, and their running sums, so that
/// mean and variance of any run cost two look-ups.
struct Rows {
    area: Area,
    levels: Vec<f32>,
    /// Of the levels and of their squares before each place; a row has one place more than columns.
    sums: Vec<(f64, f64)>,
}

impl Rows {
    fn of(gray: &Gray, runs: &[Run]) -> Self {
        let area = gray.area;
        let wide = area.width() + 1;
        let mut rows = Self {
            area,
            levels: vec![0.0; wide * area.height()],
            sums: vec![(0.0, 0.0); wide * area.height()],
        };
        let mut done = None;
        for run in runs
            .iter()
            .filter(|run| (area.top..area.bottom).contains(&run.row))
        {
            if done.replace(run.row) == Some(run.row) {
                continue;
            }
            let first = rows.place(run.row, area.left);
            let (mut sum, mut squares) = (0.0, 0.0);
            for (k, level) in gray.row(run.row).iter().enumerate() {
                let level = level - MIDDLE;
                rows.levels[first + k] = level;
                sum += f64::from(level);
                squares += f64::from(level * level);
                rows.sums[first + k + 1] = (sum, squares);
            }
        }
        rows
    }

    fn place(&self, row: i32, column: i32) -> usize {
        (row - self.area.top) as usize * (self.area.width() + 1)
            + (column - self.area.left) as usize
    }
}

/// A run's pixels, `offset` columns further on.
fn cut<'a>(gray: &'a Gray, run: &Run, offset: i32) -> &'a [f32] {
    let first = (run.from + offset - gray.area.left) as usize;
    &gray.row(run.row)[first..first + (run.to - run.from) as usize]
}

fn at_edge(one: &Gray, other: &Gray, runs: &[Run], offset: i32, wanted: f64) -> f64 {
    let mut sums = Sums::default();
    for run in runs {
        let seen = Run {
            row: run.row,
            from: run.from.max(other.seen.0 - offset),
            to: run.to.min(other.seen.1 - offset),
        };
        if seen.from < seen.to {
            sums.take(cut(one, &seen, 0), cut(other, &seen, offset));
        }
    }
    sums.correlation(wanted)
}

/// Grey level that is taken off before squaring, so that single precision is enough.
const MIDDLE: f32 = 128.0;
const LANES: usize = 8;

#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    n: f64,
    x: f64,
    y: f64,
    xx: f64,
    yy: f64,
    xy: f64,
}

impl Sums {
    fn take(&mut self, xs: &[f32], ys: &[f32]) {
        // Lanes side by side, because a sum of floats may not be reordered by the compiler.
        let mut lanes = [[0.0_f32; LANES]; 5];
        let (whole, rest) = (xs.len() / LANES * LANES, xs.len() % LANES);
        for (x, y) in xs.chunks_exact(LANES).zip(ys.chunks_exact(LANES)) {
            for k in 0..LANES {
                add(&mut lanes, k, x[k], y[k]);
            }
        }
        for k in 0..rest {
            add(&mut lanes, k, xs[whole + k], ys[whole + k]);
        }
        let [x, y, xx, yy, xy] = lanes.map(|lane| f64::from(lane.iter().sum::<f32>()));
        self.n += xs.len() as f64;
        self.x += x;
        self.y += y;
        self.xx += xx;
        self.yy += yy;
        self.xy += xy;
    }

    fn correlation(&self, wanted: f64) -> f64 {
        let n = self.n;
        let (spread_x, spread_y) = (self.xx - self.x * self.x / n, self.yy - self.y * self.y / n);
        // Below a variance of one grey level there is nothing but noise.
        if n * 2.0 < wanted || n < 4.0 || spread_x < n || spread_y < n {
            return f64::NAN;
        }
        (self.xy - self.x * self.y / n) / (spread_x * spread_y).sqrt()
    }
}

#[inline]
fn add(lanes: &mut [[f32; LANES]; 5], k: usize, x: f32, y: f32) {
    let (x, y) = (x - MIDDLE, y - MIDDLE);
    lanes[0][k] += x;
    lanes[1][k] += y;
    lanes[2][k] += x * x;
    lanes[3][k] += y * y;
    lanes[4][k] += x * y;
}

/// Sum of products, lanes side by side.
fn product(xs: &[f32], ys: &[f32]) -> f64 {
    let (x_chunks, y_chunks) = (xs.chunks_exact(LANES), ys.chunks_exact(LANES));
    let rest = x_chunks.remainder().iter().zip(y_chunks.remainder());
    let rest: f32 = rest.map(|(x, y)| x * y).sum();
    let mut lanes = [0.0_f32; LANES];
    for (x, y) in x_chunks.zip(y_chunks) {
        for k in 0..LANES {
            lanes[k] += x[k] * y[k];
        }
    }
    f64::from(rest + lanes.iter().sum::<f32>())
}

impl Curve {
    /// All local maxima, best first.
    pub fn peaks(&self) -> Vec<Peak> {
        let value = |k: usize| self.values.get(k).copied().filter(|v| v.is_finite());
        let mut peaks: Vec<Peak> = (0..self.values.len())
            .filter_map(|k| {
                let here = value(k)?;
                let beside = [k.checked_sub(1).and_then(value), value(k + 1)];
                let highest = beside.into_iter().flatten().all(|other| here >= other);
                highest.then_some(Peak {
                    at: self.least + k as i32,
                    correlation: here,
                })
            })
            .collect();
        peaks.sort_by(|a, b| b.correlation.total_cmp(&a.correlation));
        peaks
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(values: Vec<f32>) -> Gray {
        Gray {
            area: Area {
                left: 100,
                top: 7,
                right: 180,
                bottom: 8,
            },
            seen: (100, 180),
            values,
        }
    }

    const RUN: [Run; 1] = [Run {
        row: 7,
        from: 140,
        to: 160,
    }];

    fn texture(shift: i32, gain: f32) -> Gray {
        let value = |k: i32| {
            let k = k + shift;
            128.0 + gain * ((k * k * 37 % 101) - 50) as f32
        };
        gray((0..80).map(value).collect())
    }

    #[test]
    fn the_best_peak_is_where_the_same_stands_whatever_the_gain() {
        let curve = correlate(&texture(0, 1.0), &texture(9, 0.4), &RUN, 1, -20..=3);
        let best = curve.peaks()[0];
        assert_eq!(best.at, -9);
        assert!(best.correlation > 0.999, "{best:?}");
    }

    #[test]
    fn nothing_flat_and_nothing_outside_of_the_image_correlates() {
        let flat = gray(vec![90.0; 80]);
        let curve = correlate(&texture(0, 1.0), &flat, &RUN, 1, -20..=3);
        assert!(curve.values.iter().all(|value| value.is_nan()));
        let curve = correlate(&texture(0, 1.0), &texture(0, 1.0), &RUN, 1, -70..=-60);
        assert!(curve.peaks().is_empty());
    }
}
