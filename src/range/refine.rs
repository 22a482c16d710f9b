//! Below the pixel: least squares for the disparity (Lucas and Kanade's step, with the mean of both
//! eyes' slopes, gain, offset and robust weights), then for each part of the target by itself.
//!
//! A flame is as deep as it is wide, so near ones have no single disparity. The parts' disparities are
//! pooled as a random-effects mean: as far as the parts truly differ each counts alike, as far as they
//! only differ by noise the sharper one counts more. Their scatter is the error that the mean states.

use super::patch::{Area, Gray};
use super::scene::Run;
use nalgebra::{Matrix3, Vector3};

/// What least squares found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Refined {
    pub disparity_px: f64,
    pub sigma_px: f64,
}

/// Both eyes, smoothed alike, about one whole disparity.
pub(super) struct Refiner {
    left: Gray,
    /// Shifted by the whole disparity: the same columns as the left eye's.
    right: Gray,
    start_px: i32,
    runs: Vec<Run>,
}

/// Disparity beyond the whole one, gain and offset of the right eye against the left.
type State = Vector3<f64>;

/// Pixels that are compared, at most: more of them no longer lower the error.
const MOST_PIXELS: usize = 2500;
/// Farthest that least squares may go from the whole pixel.
const REACH_PX: f64 = 2.0;
/// Columns beyond the target that interpolation and the way of the steps may need.
const MARGIN_PX: i32 = 5;
/// Smoothed neighbours share their noise: about one pixel in four is its own witness.
const WITNESS_FACTOR: f64 = 2.0;
const MOST_STEPS: usize = 12;
const MOST_PART_STEPS: usize = 5;
/// Steps below this are no steps.
const STILL_PX: f64 = 1e-3;

impl Refiner {
    pub fn new(left: &Gray, right: &Gray, runs: &[Run], start_px: i32) -> Option<Self> {
        let count: usize = runs.iter().map(|run| (run.to - run.from) as usize).sum();
        let every = count.div_ceil(MOST_PIXELS).max(1) as i32;
        let area = around(runs)?.grown(MARGIN_PX, MARGIN_PX, 1);
        let left = smoothed(left, area, 0);
        let right = smoothed(right, area, -start_px);
        let inside = |run: &Run| {
            let from = run.from.max(left.seen.0 + 1).max(right.seen.0 + 3);
            let to = run.to.min(left.seen.1 - 1).min(right.seen.1 - 3);
            (run.row % every == 0 && from < to).then_some(Run { from, to, ..*run })
        };
        Some(Self {
            runs: runs.iter().filter_map(inside).collect(),
            left,
            right,
            start_px,
        })
    }

    /// The disparity of all pixels as one, then of its parts; `None` when it runs away.
    pub fn refine(&self) -> Option<Refined> {
        let whole = self.together()?;
        let pooled = pooled(&self.parts(&whole)).unwrap_or(Refined {
            disparity_px: whole.state.x,
            sigma_px: whole.sigma_px,
        });
        Some(Refined {
            disparity_px: pooled.disparity_px + f64::from(self.start_px),
            ..pooled
        })
    }

    fn together(&self) -> Option<Whole> {
        let mut state = State::new(0.0, 1.0, 0.0);
        let (mut scale, mut sigma_px) = (f64::INFINITY, f64::INFINITY);
        for _ in 0..MOST_STEPS {
            let (normal, pull, residuals) = self.equations(&self.runs, &state, scale);
            let inverse = normal.try_inverse()?;
            let step = inverse * pull;
            state += step;
            scale = robust_scale(residuals)?;
            sigma_px = scale * WITNESS_FACTOR * inverse[(0, 0)].max(0.0).sqrt();
            if state.x.abs() > REACH_PX || !state.x.is_finite() {
                return None;
            }
            // Gain and offset too: the residuals are those of the state before this step.
            if step.x.abs() < STILL_PX && step.y.abs() < 1e-3 && step.z.abs() < 0.1 {
                break;
            }
        }
        Some(Whole {
            state,
            scale,
            sigma_px,
        })
    }

    /// Normal equations of `left - gain * right(u - d) - offset`, weighted after Tukey.
    fn equations(
        &self,
        runs: &[Run],
        state: &State,
        scale: f64,
    ) -> (Matrix3<f64>, Vector3<f64>, Vec<f64>) {
        let mut n = [0.0_f64; 6];
        let mut pull = Vector3::zeros();
        let mut residuals = Vec::with_capacity(MOST_PIXELS);
        let at = Between::new(-state.x);
        for run in runs {
            let (left, right) = (self.left.row(run.row), self.right.row(run.row));
            for column in run.from..run.to {
                let k = (column - self.left.area.left) as usize;
                let (value, slope) = at.value_and_slope(right, k);
                let own_slope = f64::from(left[k + 1] - left[k - 1]) / 2.0;
                let residual = f64::from(left[k]) - state.y * value - state.z;
                residuals.push(residual);
                let weight = tukey(residual / scale);
                // d(prediction) / d(disparity); the mean slope makes the step symmetric. By gain it is
                // the value, by offset 1.
                let shift = -0.5 * (state.y * slope + own_slope);
                n[0] += weight * shift * shift;
                n[1] += weight * shift * value;
                n[2] += weight * shift;
                n[3] += weight * value * value;
                n[4] += weight * value;
                n[5] += weight;
                pull += weight * residual * Vector3::new(shift, value, 1.0);
            }
        }
        let normal = Matrix3::new(n[0], n[1], n[2], n[1], n[3], n[4], n[2], n[4], n[5]);
        (normal, pull, residuals)
    }

    /// Disparities of the cells of a raster over the target.
    fn parts(&self, whole: &Whole) -> Vec<Refined> {
        let pixels: i32 = self.runs.iter().map(|run| run.to - run.from).sum();
        let side = (f64::from(pixels) / MOST_PARTS).sqrt().max(LEAST_PART_PX) as i32;
        let Some(area) = around(&self.runs) else {
            return Vec::new();
        };
        let mut parts = Vec::new();
        for top in (area.top..area.bottom).step_by(side as usize) {
            for left in (area.left..area.right).step_by(side as usize) {
                let cell = Area {
                    left,
                    top,
                    right: left + side,
                    bottom: top + side,
                };
                parts.extend(self.part(&cell, whole));
            }
        }
        parts
    }

    fn part(&self, cell: &Area, whole: &Whole) -> Option<Refined> {
        let runs: Vec<Run> = self
            .runs
            .iter()
            .filter(|run| (cell.top..cell.bottom).contains(&run.row))
            .map(|run| Run {
                from: run.from.max(cell.left),
                to: run.to.min(cell.right),
                ..*run
            })
            .filter(|run| run.from < run.to)
            .collect();
        let pixels: i32 = runs.iter().map(|run| run.to - run.from).sum();
        if f64::from(pixels) < LEAST_FILLED * (cell.width() * cell.height()) as f64 {
            return None;
        }
        let mut state = whole.state;
        let mut sigma_px = f64::INFINITY;
        for _ in 0..MOST_PART_STEPS {
            let (normal, pull, residuals) = self.equations(&runs, &state, 1.5 * whole.scale);
            let slope2 = normal[(0, 0)];
            let step = pull.x / slope2;
            state.x += step;
            sigma_px = WITNESS_FACTOR * robust_scale(residuals)? / slope2.sqrt();
            if !state.x.is_finite() || (state.x - whole.state.x).abs() > REACH_PX {
                return None;
            }
            if step.abs() < 0.01 {
                break;
            }
        }
        (sigma_px < WORST_PART_PX).then_some(Refined {
            disparity_px: state.x,
            sigma_px,
        })
    }
}

/// What all pixels together say.
struct Whole {
    state: State,
    /// Robust standard deviation of the residuals, grey levels.
    scale: f64,
    sigma_px: f64,
}

const MOST_PARTS: f64 = 36.0;
const LEAST_PART_PX: f64 = 8.0;
/// Share of a part that must be target.
const LEAST_FILLED: f64 = 0.4;
/// Parts that know no more than this count for nothing.
const WORST_PART_PX: f64 = 1.0;
/// Fewer parts than this have no scatter to speak of.
const FEWEST_PARTS: usize = 4;

/// Parts farther than this many sigmas from the rest are not flame but what is behind or before it.
const OUTLIER_SIGMAS: f64 = 3.0;

/// Random-effects mean of the parts about their median: between-part scatter as the median of
/// absolute deviations, which what is behind the flame does not widen.
fn pooled(parts: &[Refined]) -> Option<Refined> {
    if parts.len() < FEWEST_PARTS {
        return None;
    }
    let mut mean = median(parts.iter().map(|part| part.disparity_px).collect())?;
    let spread = 1.4826
        * median(
            parts
                .iter()
                .map(|p| (p.disparity_px - mean).abs())
                .collect(),
        )?;
    let noise = median(parts.iter().map(|part| part.sigma_px).collect())?;
    let between = (spread.powi(2) - noise.powi(2)).max(0.0);
    let mut sigma_px = f64::NAN;
    for _ in 0..5 {
        let (mut w, mut wd, mut wr) = (0.0, 0.0, 0.0);
        for part in parts {
            let variance = part.sigma_px.powi(2) + between;
            let apart = part.disparity_px - mean;
            if apart.powi(2) < OUTLIER_SIGMAS.powi(2) * variance {
                w += 1.0 / variance;
                wd += part.disparity_px / variance;
                wr += (apart / variance).powi(2);
            }
        }
        mean = wd / w;
        sigma_px = wr.sqrt().max(w.sqrt()) / w;
    }
    sigma_px.is_finite().then_some(Refined {
        disparity_px: mean,
        sigma_px,
    })
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Catmull and Rom's value and slope at a fixed shift; whole and fraction are the same for all pixels.
struct Between {
    whole: isize,
    value: [f64; 4],
    slope: [f64; 4],
}

impl Between {
    fn new(shift: f64) -> Self {
        let t = shift - shift.floor();
        Self {
            whole: shift.floor() as isize - 1,
            value: [
                0.5 * t * (-1.0 + t * (2.0 - t)),
                1.0 + 0.5 * t * t * (-5.0 + 3.0 * t),
                0.5 * t * (1.0 + t * (4.0 - 3.0 * t)),
                0.5 * t * t * (t - 1.0),
            ],
            slope: [
                0.5 * (-1.0 + t * (4.0 - 3.0 * t)),
                0.5 * t * (-10.0 + 9.0 * t),
                0.5 * (1.0 + t * (8.0 - 9.0 * t)),
                0.5 * t * (3.0 * t - 2.0),
            ],
        }
    }

    fn value_and_slope(&self, row: &[f32], k: usize) -> (f64, f64) {
        let first = k.saturating_add_signed(self.whole);
        let (mut value, mut slope) = (0.0, 0.0);
        for (j, pixel) in row[first..first + 4].iter().enumerate() {
            value += self.value[j] * f64::from(*pixel);
            slope += self.slope[j] * f64::from(*pixel);
        }
        (value, slope)
    }
}

fn around(runs: &[Run]) -> Option<Area> {
    Some(Area {
        left: runs.iter().map(|run| run.from).min()?,
        right: runs.iter().map(|run| run.to).max()?,
        top: runs.iter().map(|run| run.row).min()?,
        bottom: runs.iter().map(|run| run.row).max()? + 1,
    })
}

/// An area of an image, read `shift` columns further on, through the binomial filter 1 2 1 in both
/// directions: what an interpolation gets wrong lies above its cut-off, and so does much noise.
fn smoothed(image: &Gray, area: Area, shift: i32) -> Gray {
    let last = image.area.width() as i32 - 1;
    let rows = (image.area.top, image.area.bottom - 1);
    let across = |row: i32| -> Vec<f32> {
        let line = image.row(row.clamp(rows.0, rows.1));
        let at = |column: i32| line[(column - image.area.left).clamp(0, last) as usize];
        (area.left + shift..area.right + shift)
            .map(|u| 0.25 * (at(u - 1) + 2.0 * at(u) + at(u + 1)))
            .collect()
    };
    let mut values = Vec::with_capacity(area.width() * area.height());
    let (mut above, mut here) = (across(area.top - 1), across(area.top));
    for row in area.top..area.bottom {
        let below = across(row + 1);
        for ((a, h), b) in above.iter().zip(&here).zip(&below) {
            values.push(0.25 * (a + 2.0 * h + b));
        }
        (above, here) = (here, below);
    }
    Gray {
        area,
        seen: (
            (image.seen.0 - shift).max(area.left),
            (image.seen.1 - shift).min(area.right),
        ),
        values,
    }
}

/// Weight of a residual in robust sigmas; 1 for all while the scale is not known.
fn tukey(residual: f64) -> f64 {
    const CUT: f64 = 4.685;
    let x = residual / CUT;
    if x.abs() < 1.0 {
        (1.0 - x * x).powi(2)
    } else {
        0.0
    }
}

/// Standard deviation of the bulk, from the median of absolute residuals.
fn robust_scale(mut residuals: Vec<f64>) -> Option<f64> {
    for residual in &mut residuals {
        *residual = residual.abs();
    }
    if residuals.len() < 8 {
        return None;
    }
    let middle = residuals.len() / 2;
    let (_, median, _) = residuals.select_nth_unstable_by(middle, f64::total_cmp);
    // Quantisation alone leaves 0.3 grey levels.
    Some((*median * 1.4826).max(0.3))
}
