//! Below the pixel: least squares for the disparity (Lucas and Kanade's step, with the mean of both
//! eyes' slopes, gain, offset and robust weights), then for each part of the target by itself.
//!
//! Large targets are halved until they have a few thousand pixels: a flame is smooth on the scale of its
//! own size, what shines through it from behind is not. Both eyes pass the same filters, a binomial one and
//! a cubic B-spline, so that neither noise nor the fraction of the pixel leans the answer to one side.

use super::error::Signs;
use super::parts::pooled;
use super::patch::{Area, Gray};
use super::raster::{Weights, averaged, counted, plane, smoothed};
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
    pub signs: Signs,
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
        let along = (parts.len() * PART * PART) as f64 / self.counted();
        if along < least_along {
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
            signs: Signs {
                dullness: self.dullness(whole.state.y),
                split_px: (found.disparity_px - whole.state.x).abs() * self.pixel_px,
                rise_px: self.rise(&whole).abs() * self.pixel_px,
                astray: (1.0 - along).max(0.0),
                moved_px: whole.state.x.abs() * self.pixel_px,
                ..Signs::default()
            },
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
                normal: sums.normal(),
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

    /// By how much the right eye shows lower what the left one shows, on the raster. Eyes that are rectified and
    /// see the same moment show nothing lower: what burns rises between two moments.
    fn rise(&self, whole: &Whole) -> f64 {
        let at = Between::new(-whole.state.x);
        let [gain, offset] = [whole.state.y as f32, whole.state.z as f32];
        let cut = (1.0 / (TUKEY * whole.scale)) as f32;
        let tile = self.everything();
        let mut total = [0.0_f64; RISE_TERMS];
        for row in tile.rows.clone() {
            let mut lanes = [[0.0_f32; LANES]; RISE_TERMS];
            for first in tile.lanes(&self.counting[row]) {
                let here = row * self.width + first;
                let left = &self.left[here - 1..here + LANES + 1];
                let above = &self.left[here - self.width..here - self.width + LANES];
                let below = &self.left[here + self.width..here + self.width + LANES];
                let right = here.saturating_add_signed(at.whole);
                let right = &self.right[right..right + LANES + 3];
                let weights = &self.weight[here..here + LANES];
                for k in 0..LANES {
                    let value = dot(&at.value, &right[k..k + 4]);
                    let slope = dot(&at.slope, &right[k..k + 4]);
                    let own = (left[k] + 4.0 * left[k + 1] + left[k + 2]) / 6.0;
                    let residual = own - gain * value - offset;
                    let x = residual * cut;
                    let kept = (1.0 - x * x).max(0.0);
                    let shift = -0.5 * (gain * slope + 0.5 * (left[k + 2] - left[k]));
                    let down = 0.5 * (below[k] - above[k]);
                    let by_down = weights[k] * kept * kept * down;
                    lanes[0][k] += by_down * shift;
                    lanes[1][k] += by_down * value;
                    lanes[2][k] += by_down;
                    lanes[3][k] += by_down * down;
                    lanes[4][k] += by_down * residual;
                }
            }
            for (total, lane) in total.iter_mut().zip(&lanes) {
                *total += f64::from(lane.iter().sum::<f32>());
            }
        }
        let [shift, value, one, down, pull] = total;
        // The others have had their way: what is left of the pull is for the rise alone.
        let beside = Vector3::new(shift, value, one);
        let taken = whole
            .normal
            .try_inverse()
            .map_or(0.0, |inverse| beside.dot(&(inverse * beside)));
        let own = down - taken;
        if own > LEAST_STEEP * down {
            pull / own
        } else {
            0.0
        }
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
    /// Normal equations about it.
    normal: Matrix3<f64>,
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
/// Of down with shift, value, 1, itself, and its pull.
const RISE_TERMS: usize = 5;
/// Least share of the slopes down that nothing else explains, to tell a rise by.
const LEAST_STEEP: f64 = 0.05;
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

    /// Blots instead of slanted waves, so that right and down are told apart.
    fn lowered(down: f64) -> Gray {
        let value = |k: i32| {
            let (u, v) = (f64::from(k % 60), f64::from(k / 60) - down);
            (120.0 + 50.0 * (0.5 * u).sin() * (0.45 * v).cos() + 30.0 * (0.8 * u).cos()) as f32
        };
        Gray {
            values: (0..60 * 20).map(value).collect(),
            ..wave(0.0)
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
    fn what_the_right_eye_shows_lower_is_told_and_level_eyes_tell_nothing() {
        let rise = |down: f64| {
            let lower = lowered(down);
            let refiner = Refiner::new(&lowered(0.0), &lower, &weights(), 0).unwrap();
            refiner.refine(LEAST_ALONG).unwrap().signs.rise_px
        };
        assert!(rise(0.0) < 0.01, "{}", rise(0.0));
        // One step from where they are level: a tenth off at a third of a pixel.
        assert!((rise(0.3) - 0.3).abs() < 0.05, "{}", rise(0.3));
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
}
