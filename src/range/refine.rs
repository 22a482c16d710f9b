//! Below the pixel: least squares for the disparity (Lucas and Kanade's step, with the mean of both
//! eyes' slopes, gain, offset and robust weights), then for each part of the target by itself.
//!
//! Large targets are halved until they have a few thousand pixels: a flame is smooth on the scale of its
//! own size, what shines through it from behind is not. Both eyes pass the same filters, a binomial one and
//! a cubic B-spline, so that neither noise nor the fraction of the pixel leans the answer to one side.
//!
//! A flame is as deep as it is wide, so near ones have no single disparity. The parts' disparities are
//! pooled as a random-effects mean: as far as the parts truly differ each counts alike, as far as they
//! only differ by noise the sharper one counts more. Their scatter is the error that the mean states.

use super::patch::{Area, Gray};
use nalgebra::{Matrix3, Vector3};
use std::ops::Range;

/// What least squares found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Refined {
    pub disparity_px: f64,
    pub sigma_px: f64,
    /// Where in the left eye it was learnt: mean column and row, weighted as the disparity is. What
    /// stands upright is nearer at its top for a camera that looks down, so a disparity belongs to a row.
    pub at: (f64, f64),
}

/// What least squares found, and how the eyes compare there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Refinement {
    pub found: Refined,
    /// By what share one eye is duller than the other, 0 to 1.
    pub dullness: f64,
}

/// How much each pixel of an area counts, 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Weights {
    pub area: Area,
    pub values: Vec<f32>,
}

/// Both eyes, smoothed alike, about one whole disparity, on a raster of `pixel_px` pixels.
pub(super) struct Refiner {
    left: Vec<f32>,
    /// Shifted by the whole disparity: the same columns as the left eye's.
    right: Vec<f32>,
    weight: Vec<f32>,
    /// Columns of each row that may count, whole lanes.
    counting: Vec<Range<usize>>,
    width: usize,
    height: usize,
    /// Column and row of the raster's first place.
    origin: (f64, f64),
    pixel_px: f64,
    start_px: i32,
}

/// Disparity beyond the whole one (on the raster), gain and offset of the right eye against the left.
type State = Vector3<f64>;

/// Places that are compared, at most, about: beyond that targets are halved.
const MOST_PLACES: usize = 4000;
/// Farthest that least squares may go from the whole pixel.
const REACH_PX: f64 = 2.0;
/// Columns and rows beyond the target that interpolation and the way of the steps may need.
const MARGIN: usize = 5;
const MARGIN_ROWS: usize = 1;
/// Columns that are summed side by side.
const LANES: usize = 8;
/// Smoothed neighbours share their noise: about one pixel in four is its own witness.
const WITNESS_FACTOR: f64 = 2.0;
const MOST_STEPS: usize = 10;
const MOST_PART_STEPS: usize = 3;
/// Steps below this are no steps.
const STILL_PX: f64 = 1e-3;

impl Refiner {
    /// `None` where nothing counts.
    pub fn new(left: &Gray, right: &Gray, weights: &Weights, start_px: i32) -> Option<Self> {
        let (target, counted) = counted(weights)?;
        let mut halvings = 0;
        while counted >> (2 * halvings) > MOST_PLACES {
            halvings += 1;
        }
        let side = 1_usize << halvings;
        // Whole lanes of whole squares, and room beside them.
        let width = target.width().div_ceil(LANES * side) * LANES + 2 * MARGIN;
        let height = target.height().div_ceil(side) + 2 * MARGIN_ROWS;
        let area = Area {
            left: target.left - (MARGIN * side) as i32,
            top: target.top - (MARGIN_ROWS * side) as i32,
            right: target.left + ((width - MARGIN) * side) as i32,
            bottom: target.top + ((height - MARGIN_ROWS) * side) as i32,
        };
        let seen = Range {
            start: (left.seen.0 + 1).max(right.seen.0 + 3 + start_px),
            end: (left.seen.1 - 1).min(right.seen.1 - 3 + start_px),
        };
        let averaged = |plane: Vec<f32>| averaged(plane, area.width(), side);
        let middle = 0.5 * (side - 1) as f64;
        let weight = averaged(weights.over(area, &seen));
        Some(Self {
            left: smoothed(&averaged(plane(left, area, 0)), width),
            right: smoothed(&averaged(plane(right, area, -start_px)), width),
            counting: weight.chunks_exact(width).map(counting).collect(),
            weight,
            width,
            height,
            origin: (f64::from(area.left) + middle, f64::from(area.top) + middle),
            pixel_px: side as f64,
            start_px,
        })
    }

    /// The disparity of all pixels as one, then of its parts; `None` when it runs away, or when less than a
    /// share of the target goes with it.
    pub fn refine(&self, least_along: f64) -> Option<Refinement> {
        let whole = self.together()?;
        let parts = self.parts(&whole);
        if ((parts.len() * PART * PART) as f64) < least_along * self.counted() {
            return None;
        }
        let found = pooled(&parts).unwrap_or(Refined {
            disparity_px: whole.state.x,
            sigma_px: whole.sigma,
            at: whole.at,
        });
        Some(Refinement {
            found: Refined {
                disparity_px: found.disparity_px * self.pixel_px + f64::from(self.start_px),
                sigma_px: found.sigma_px * self.pixel_px,
                at: (
                    self.origin.0 + found.at.0 * self.pixel_px,
                    self.origin.1 + found.at.1 * self.pixel_px,
                ),
            },
            dullness: self.dullness(whole.state.y),
        })
    }

    /// Places of the raster that count, each by its weight's being there at all.
    fn counted(&self) -> f64 {
        self.weight.iter().filter(|weight| **weight > 0.0).count() as f64
    }

    /// By what share one eye is duller than the other: the squares of their slopes, at equal contrast. The
    /// whole pixel is near enough for that.
    fn dullness(&self, gain: f64) -> f64 {
        let steep = |plane: &[f32]| -> f64 {
            let slopes = plane.windows(3).zip(&self.weight[1..]);
            let squares = slopes.map(|(w, weight)| weight * (w[2] - w[0]).powi(2));
            f64::from(squares.sum::<f32>())
        };
        let (left, right) = (steep(&self.left), gain.powi(2) * steep(&self.right));
        1.0 - left.min(right) / left.max(right).max(f64::MIN_POSITIVE)
    }

    /// All that counts.
    fn everything(&self) -> Tile {
        Tile {
            columns: MARGIN..self.width - MARGIN,
            rows: MARGIN_ROWS..self.height - MARGIN_ROWS,
        }
    }

    fn together(&self) -> Option<Whole> {
        let tile = self.everything();
        let mut state = State::new(0.0, 1.0, 0.0);
        let (mut scale, mut whole) = (f64::INFINITY, None);
        for step_number in 0..MOST_STEPS {
            let sums = self.sums(&tile, &state, scale);
            let inverse = sums.normal().try_inverse()?;
            let step = inverse * sums.pull();
            state += step;
            if state.x.abs() * self.pixel_px > REACH_PX.max(self.pixel_px) || !state.x.is_finite() {
                return None;
            }
            if step_number < SETTLED {
                scale = robust_scale(self.residuals(&tile, &state))?;
            }
            whole = Some(Whole {
                state,
                scale,
                sigma: scale * WITNESS_FACTOR * inverse[(0, 0)].max(0.0).sqrt(),
                at: sums.at(),
            });
            if step_number >= SETTLED && step.x.abs() < STILL_PX {
                break;
            }
        }
        whole
    }

    /// Normal equations of `left - gain * right(u - d) - offset` over a tile, weighted after Tukey.
    fn sums(&self, tile: &Tile, state: &State, scale: f64) -> Sums {
        let at = Between::new(-state.x);
        let [gain, offset] = [state.y as f32, state.z as f32];
        let cut = (1.0 / (TUKEY * scale)) as f32;
        let mut total = Sums::default();
        for row in tile.rows.clone() {
            let mut lanes = [[0.0_f32; LANES]; TERMS];
            let mut moments = [0.0_f32; LANES];
            for first in tile.lanes(&self.counting[row]) {
                let here = row * self.width + first;
                let left = &self.left[here - 1..here + LANES + 1];
                let right = here.saturating_add_signed(at.whole);
                let right = &self.right[right..right + LANES + 3];
                let weights = &self.weight[here..here + LANES];
                let mut information = [0.0_f32; LANES];
                for k in 0..LANES {
                    let value = dot(&at.value, &right[k..k + 4]);
                    let slope = dot(&at.slope, &right[k..k + 4]);
                    let own = (left[k] + 4.0 * left[k + 1] + left[k + 2]) / 6.0;
                    let own_slope = 0.5 * (left[k + 2] - left[k]);
                    let residual = own - gain * value - offset;
                    let x = residual * cut;
                    let kept = (1.0 - x * x).max(0.0);
                    let weight = weights[k] * kept * kept;
                    // d(prediction) / d(disparity); the mean slope makes the step symmetric. By gain it is
                    // the value, by offset 1.
                    let shift = -0.5 * (gain * slope + own_slope);
                    let value = value - MIDDLE;
                    let (by_shift, by_value) = (weight * shift, weight * value);
                    information[k] = by_shift * shift;
                    lanes[0][k] += information[k];
                    lanes[1][k] += by_shift * value;
                    lanes[2][k] += by_shift;
                    lanes[3][k] += by_value * value;
                    lanes[4][k] += by_value;
                    lanes[5][k] += weight;
                    lanes[6][k] += by_shift * residual;
                    lanes[7][k] += by_value * residual;
                    lanes[8][k] += weight * residual;
                }
                for (k, (moment, information)) in moments.iter_mut().zip(information).enumerate() {
                    *moment += information * (first + k) as f32;
                }
            }
            total.take(&lanes, &moments, row);
        }
        total
    }

    /// Residuals of what counts, one place in two.
    fn residuals(&self, tile: &Tile, state: &State) -> Vec<f32> {
        let at = Between::new(-state.x);
        let [gain, offset] = [state.y as f32, state.z as f32];
        let mut residuals = Vec::with_capacity(MOST_PLACES);
        for row in tile.rows.clone() {
            let line = row * self.width;
            for here in (line + tile.columns.start..line + tile.columns.end)
                .skip(row % 2)
                .step_by(2)
            {
                if self.weight[here] > 0.25 {
                    let right = here.saturating_add_signed(at.whole);
                    let left = &self.left[here - 1..here + 2];
                    let own = (left[0] + 4.0 * left[1] + left[2]) / 6.0;
                    let value = dot(&at.value, &self.right[right..right + 4]);
                    residuals.push(own - gain * value - offset);
                }
            }
        }
        residuals
    }

    /// Disparities of the tiles of the target.
    fn parts(&self, whole: &Whole) -> Vec<Refined> {
        let all = self.everything();
        let mut parts = Vec::with_capacity(MOST_PLACES / (PART * PART));
        for top in all.rows.clone().step_by(PART) {
            for left in all.columns.clone().step_by(PART) {
                let tile = Tile {
                    columns: left..left + PART,
                    rows: top..(top + PART).min(all.rows.end),
                };
                parts.extend(self.part(&tile, whole));
            }
        }
        parts
    }

    fn part(&self, tile: &Tile, whole: &Whole) -> Option<Refined> {
        let mut state = whole.state;
        let mut part = None;
        for _ in 0..MOST_PART_STEPS {
            let sums = self.sums(tile, &state, 1.5 * whole.scale);
            let [information, .., weight, pull, _, _] = sums.terms;
            let places = (tile.columns.len() * tile.rows.len()) as f64;
            if weight < LEAST_FILLED * places {
                return None;
            }
            let step = pull / information;
            state.x += step;
            if !state.x.is_finite() || (state.x - whole.state.x).abs() > PART_REACH {
                return None;
            }
            part = Some(Refined {
                disparity_px: state.x,
                sigma_px: WITNESS_FACTOR * whole.scale / information.sqrt(),
                at: sums.at(),
            });
            if step.abs() < 0.01 {
                break;
            }
        }
        part.filter(|part| part.sigma_px < WORST_PART)
    }
}

/// Columns and rows of the raster; columns are whole lanes.
struct Tile {
    columns: Range<usize>,
    rows: Range<usize>,
}

impl Tile {
    /// First columns of its lanes that may count in a row.
    fn lanes(&self, counting: &Range<usize>) -> impl Iterator<Item = usize> + use<> {
        let from = self.columns.start.max(counting.start);
        (from..self.columns.end.min(counting.end)).step_by(LANES)
    }
}

/// Columns of a row of weights from the first to the last that counts, whole lanes from the margin on.
fn counting(weights: &[f32]) -> Range<usize> {
    let lane = |column: usize| column.saturating_sub(MARGIN) / LANES;
    let first = weights.iter().position(|weight| *weight > 0.0);
    let last = weights.iter().rposition(|weight| *weight > 0.0);
    match first.zip(last) {
        Some((first, last)) => MARGIN + lane(first) * LANES..MARGIN + (lane(last) + 1) * LANES,
        None => MARGIN..MARGIN,
    }
}

/// What all pixels together say, on the raster.
struct Whole {
    state: State,
    /// Robust standard deviation of the residuals, grey levels.
    scale: f64,
    sigma: f64,
    at: (f64, f64),
}

/// Steps after which the size of the residuals is known.
const SETTLED: usize = 3;
/// Residuals beyond this many robust sigmas do not count.
const TUKEY: f64 = 4.685;
/// Terms of the normal equations and of their right side.
const TERMS: usize = 9;
/// Grey level that is taken off before squaring, so that single precision is enough.
const MIDDLE: f32 = 128.0;

#[derive(Debug, Clone, Default)]
struct Sums {
    /// By shift and shift, shift and value, shift, value and value, value, 1; then the pulls.
    terms: [f64; TERMS],
    /// Information times column, and times row.
    moment: (f64, f64),
}

impl Sums {
    fn take(&mut self, lanes: &[[f32; LANES]; TERMS], moments: &[f32; LANES], row: usize) {
        let sum = |lane: &[f32; LANES]| f64::from(lane.iter().sum::<f32>());
        for (term, lane) in self.terms.iter_mut().zip(lanes) {
            *term += sum(lane);
        }
        self.moment.0 += sum(moments);
        self.moment.1 += sum(&lanes[0]) * row as f64;
    }

    fn normal(&self) -> Matrix3<f64> {
        let [ss, sv, s, vv, v, one, ..] = self.terms;
        // Values were summed about the middle grey.
        let m = f64::from(MIDDLE);
        let (sv, vv, v) = (sv + m * s, vv + 2.0 * m * v + m * m * one, v + m * one);
        Matrix3::new(ss, sv, s, sv, vv, v, s, v, one)
    }

    fn pull(&self) -> Vector3<f64> {
        let [.., s, v, one] = self.terms;
        Vector3::new(s, v + f64::from(MIDDLE) * one, one)
    }

    /// Mean column and row by information on the disparity.
    fn at(&self) -> (f64, f64) {
        let information = self.terms[0];
        (self.moment.0 / information, self.moment.1 / information)
    }
}

#[inline]
fn dot(weights: &[f32; 4], pixels: &[f32]) -> f32 {
    weights[0] * pixels[0]
        + weights[1] * pixels[1]
        + weights[2] * pixels[2]
        + weights[3] * pixels[3]
}

/// Side of a part, on the raster.
const PART: usize = LANES;
/// Least weight of a part against that of one that is all target.
const LEAST_FILLED: f64 = 0.2;
/// Farthest that a part may be from the whole, on the raster.
const PART_REACH: f64 = 1.0;
/// Least share of the target whose parts go with the whole: where fewer do, what was matched is in front of
/// the target, or not in both eyes.
pub(super) const LEAST_ALONG: f64 = 0.25;
/// Parts that know no more than this count for nothing.
const WORST_PART: f64 = 1.0;
/// Fewer parts than this have no scatter to speak of.
const FEWEST_PARTS: usize = 4;
/// Parts farther than this many sigmas from the rest are not flame but what is behind or before it.
const OUTLIER_SIGMAS: f64 = 3.0;
/// How much a disparity may change from row to row, one sigma: what stands upright before a camera that
/// looks down.
const TILT: f64 = 0.006;

/// Random-effects mean of the parts, less their common slope over rows: between-part scatter as the
/// median of absolute deviations, which what is behind the flame does not widen.
fn pooled(parts: &[Refined]) -> Option<Refined> {
    if parts.len() < FEWEST_PARTS {
        return None;
    }
    let middle = |value: fn(&Refined) -> f64| median(parts.iter().map(value).collect());
    let noise = middle(|found| found.sigma_px)?;
    let mut line = Line {
        mean: middle(|found| found.disparity_px)?,
        slope: 0.0,
        row: middle(|found| found.at.1)?,
    };
    let mut found = None;
    for _ in 0..5 {
        let off = parts.iter().map(|part| line.off(part).abs());
        let spread = 1.4826 * median(off.collect())?;
        let between = (spread.powi(2) - noise.powi(2)).max(0.0);
        found = line.through(parts, between);
    }
    found
}

/// A disparity at a row and its change from row to row.
struct Line {
    mean: f64,
    slope: f64,
    row: f64,
}

impl Line {
    fn off(&self, part: &Refined) -> f64 {
        part.disparity_px - self.mean - self.slope * (part.at.1 - self.row)
    }

    /// The line that fits the parts near this one, and what it says of their middle.
    fn through(&mut self, parts: &[Refined], between: f64) -> Option<Refined> {
        let weighed: Vec<(f64, &Refined)> = parts
            .iter()
            .map(|part| (part.sigma_px.powi(2) + between, part))
            .filter(|(variance, part)| self.off(part).powi(2) < OUTLIER_SIGMAS.powi(2) * variance)
            .map(|(variance, part)| (1.0 / variance, part))
            .collect();
        let sum = |value: &dyn Fn(&Refined) -> f64| -> f64 {
            let weighted = |(weight, part): &(f64, &Refined)| weight * value(part);
            weighed.iter().map(weighted).sum()
        };
        let w = sum(&|_| 1.0);
        let (column, row) = (sum(&|part| part.at.0) / w, sum(&|part| part.at.1) / w);
        let mean = sum(&|part| part.disparity_px) / w;
        let rows = sum(&|part| (part.at.1 - row).powi(2)) + TILT.powi(-2);
        let slope = sum(&|part| (part.at.1 - row) * (part.disparity_px - mean)) / rows;
        *self = Self { mean, slope, row };
        let squares: f64 = weighed
            .iter()
            .map(|(weight, part)| (weight * self.off(part)).powi(2))
            .sum();
        let n = weighed.len() as f64;
        let scattered = (squares * n / (n - 1.0)).max(w).sqrt() / w;
        (weighed.len() > 1 && scattered.is_finite()).then_some(Refined {
            disparity_px: mean,
            sigma_px: scattered,
            at: (column, row),
        })
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// The cubic B-spline's value and slope at a fixed shift; whole and fraction are the same for all pixels.
struct Between {
    whole: isize,
    value: [f32; 4],
    slope: [f32; 4],
}

impl Between {
    fn new(shift: f64) -> Self {
        let t = shift - shift.floor();
        let s = 1.0 - t;
        let value = [
            s * s * s / 6.0,
            (4.0 - 3.0 * t * t * (2.0 - t)) / 6.0,
            (4.0 - 3.0 * s * s * (2.0 - s)) / 6.0,
            t * t * t / 6.0,
        ];
        let slope = [
            -0.5 * s * s,
            0.5 * t * (3.0 * t - 4.0),
            -0.5 * s * (3.0 * s - 4.0),
            0.5 * t * t,
        ];
        Self {
            whole: shift.floor() as isize - 1,
            value: value.map(|weight| weight as f32),
            slope: slope.map(|weight| weight as f32),
        }
    }
}

/// The least area with all that counts, and how many pixels count.
fn counted(weights: &Weights) -> Option<(Area, usize)> {
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
    fn over(&self, area: Area, seen: &Range<i32>) -> Vec<f32> {
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
fn plane(image: &Gray, area: Area, shift: i32) -> Vec<f32> {
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
fn averaged(plane: Vec<f32>, width: usize, side: usize) -> Vec<f32> {
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
fn smoothed(plane: &[f32], width: usize) -> Vec<f32> {
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

/// Standard deviation of the bulk, from the median of absolute residuals.
fn robust_scale(mut residuals: Vec<f32>) -> Option<f64> {
    for residual in &mut residuals {
        *residual = residual.abs();
    }
    if residuals.len() < 6 {
        return None;
    }
    let middle = residuals.len() / 2;
    let (_, median, _) = residuals.select_nth_unstable_by(middle, f32::total_cmp);
    // Quantisation alone leaves 0.3 grey levels.
    Some((f64::from(*median) * 1.4826).max(0.3))
}

#[cfg(test)]
mod tests {
    use super::*;

    const AREA: Area = Area {
        left: 0,
        top: 0,
        right: 60,
        bottom: 20,
    };

    fn wave(shift: f64) -> Gray {
        let value = |k: i32| {
            let (u, v) = (f64::from(k % 60) + shift, f64::from(k / 60));
            (120.0 + 60.0 * (0.7 * u + 0.3 * v).sin() + 30.0 * (0.31 * u - v).cos()) as f32
        };
        Gray {
            area: AREA,
            seen: (0, 60),
            values: (0..60 * 20).map(value).collect(),
        }
    }

    fn weights() -> Weights {
        let inside = |k: usize| (20..50).contains(&(k % 60));
        Weights {
            area: AREA,
            values: (0..60 * 20)
                .map(|k| f32::from(u8::from(inside(k))))
                .collect(),
        }
    }

    #[test]
    fn a_shift_is_found_to_a_hundredth_of_a_pixel_whatever_gain_and_offset() {
        for step in 0..8 {
            let truth = 6.0 + 0.125 * f64::from(step);
            let mut right = wave(truth);
            for value in &mut right.values {
                *value = 0.7 * *value + 20.0;
            }
            let refiner = Refiner::new(&wave(0.0), &right, &weights(), 6).unwrap();
            let found = refiner.refine(LEAST_ALONG).unwrap().found;
            assert!(
                (found.disparity_px - truth).abs() < 0.01,
                "{found:?} {truth}"
            );
            assert!(found.sigma_px < 0.02, "{found:?}");
        }
    }

    #[test]
    fn a_flat_eye_has_no_disparity() {
        let flat = Gray {
            values: vec![80.0; 60 * 20],
            ..wave(0.0)
        };
        let refiner = Refiner::new(&flat, &flat, &weights(), 5).unwrap();
        assert_eq!(refiner.refine(LEAST_ALONG), None);
    }

    #[test]
    fn parts_behind_the_flame_do_not_count_and_scatter_is_stated() {
        let part = |disparity_px| Refined {
            disparity_px,
            sigma_px: 0.02,
            at: (1.0, 2.0),
        };
        let mut parts: Vec<Refined> = (0..9)
            .map(|k| part(5.0 + 0.01 * f64::from(k % 3)))
            .collect();
        let tight = pooled(&parts).unwrap();
        parts.extend([part(3.0), part(3.1)]);
        let found = pooled(&parts).unwrap();
        assert!((found.disparity_px - 5.01).abs() < 0.01, "{found:?}");
        let wide: Vec<Refined> = (0..9).map(|k| part(5.0 + 0.3 * f64::from(k % 3))).collect();
        assert!(pooled(&wide).unwrap().sigma_px > 5.0 * tight.sigma_px);
    }
}
