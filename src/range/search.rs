//! Normalised correlation of a target with every place that it may be seen at in the other eye.

use super::patch::Gray;
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

/// Rows that are compared, at most: more of them change the whole pixel no longer.
const MOST_PIXELS: usize = 1600;

/// Correlates the runs' pixels of `one` with those of `other` that lie `offset` columns further on.
pub(super) fn correlate(
    one: &Gray,
    other: &Gray,
    runs: &[Run],
    offsets: impl Iterator<Item = i32>,
) -> Curve {
    let pixels: usize = runs.iter().map(|run| (run.to - run.from) as usize).sum();
    let every = pixels.div_ceil(MOST_PIXELS).max(1) as i32;
    let runs: Vec<Run> = runs
        .iter()
        .filter(|run| run.row % every == 0 || every == 1)
        .copied()
        .collect();
    let mut offsets = offsets.peekable();
    Curve {
        least: offsets.peek().copied().unwrap_or_default(),
        values: offsets
            .map(|offset| at_offset(one, other, &runs, offset))
            .collect(),
    }
}

fn at_offset(one: &Gray, other: &Gray, runs: &[Run], offset: i32) -> f64 {
    let (mut wanted, mut sums) = (0, Sums::default());
    for run in runs {
        wanted += run.to - run.from;
        let from = run.from.max(other.seen.0 - offset);
        let to = run.to.min(other.seen.1 - offset);
        if from < to {
            let cut = |gray: &Gray, shift: i32| {
                let first = (from + shift - gray.area.left) as usize;
                first..first + (to - from) as usize
            };
            sums.take(
                &one.row(run.row)[cut(one, 0)],
                &other.row(run.row)[cut(other, offset)],
            );
        }
    }
    sums.correlation(f64::from(wanted))
}

/// Grey level that is taken off before squaring, so that single precision is enough.
const MIDDLE: f32 = 128.0;
const LANES: usize = 8;

#[derive(Default)]
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
