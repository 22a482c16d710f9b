//! Centroids of the flame's pixels in both eyes (P1: `x = sum(x M) / sum(M)`, `d = x_left - x_right`).
//!
//! P1 ranges the largest mask of the image and finds its partner because there is only one. Here every
//! target is ranged: its bright pixels are looked for along the epipolar strip, and the centroids are
//! taken where they are found. The edge of the bright pixels is soft, so that a centroid moves evenly
//! with the flame and not by whole pixels.

use super::correlate::{disparity, rival_free};
use super::patch::{Area, Gray};
use super::refine::Refined;
use super::scene::{Mask, Run, Scene};
use super::search::{correlate, rows_apart};
use super::{Disparity, RangeConfig, Refusal};

/// Grey levels between which a pixel comes to count.
#[derive(Debug, Clone, Copy)]
struct Levels {
    low: f32,
    high: f32,
}

/// One pixel in so many tells the levels; no divisor of usual widths, so that it does not walk a column.
const SAMPLED: usize = 7;
/// Less contrast than this between flame and background is none, grey levels.
const LEAST_CONTRAST: f32 = 16.0;
/// Half the width of the soft edge, as a share of the contrast.
const SOFT: f32 = 0.2;
/// Ground beside the bright pixels that is compared with them: without it any brightness would fit.
const RIM_PX: usize = 3;
/// Least likeness of the two masks.
const LEAST_LIKENESS: f64 = 0.7;
/// Bands of rows whose scatter is the error.
const BANDS: usize = 8;
/// Least mass of a band against the mean one.
const LEAST_MASS: f64 = 0.2;

pub(super) fn find(scene: &Scene<'_>, config: &RangeConfig) -> Result<Disparity, Refusal> {
    let pixels = scene.flame.count();
    if pixels < config.min_support as usize {
        return Err(Refusal::TooSmall);
    }
    let left = covered(&scene.left.gray, pixels).ok_or(Refusal::Flat)?;
    let left = within(left, &scene.target);
    let right = covered(&scene.right, pixels).ok_or(Refusal::Flat)?;
    let bright = Mask {
        area: left.area,
        kept: left.values.iter().map(|cover| *cover > 127.0).collect(),
    };
    if bright.count() < config.min_support as usize {
        return Err(Refusal::TooSmall);
    }
    let offsets = (-scene.search.greatest)..=(-scene.search.least);
    let rimmed = bright.grown(RIM_PX).runs();
    let curve = correlate(&left, &right, &rimmed, rows_apart(&rimmed), offsets);
    let best = rival_free(&curve, LEAST_LIKENESS, -scene.search.greatest)?;
    let bands = bands(&left, &right, &rimmed, best.at);
    let (px, sigma_px) = scatter(&bands).ok_or(Refusal::TooSmall)?;
    let refined = Refined {
        disparity_px: px,
        sigma_px,
        at: bright.centroid(),
    };
    Ok(disparity(&bright, &refined, 1.0))
}

/// How much each pixel belongs to what is as bright as the `pixels` brightest, 0 to 255.
fn covered(gray: &Gray, pixels: usize) -> Option<Gray> {
    let levels = levels(gray, pixels)?;
    let cover =
        |value: &f32| 255.0 * ((value - levels.low) / (levels.high - levels.low)).clamp(0.0, 1.0);
    Some(Gray {
        area: gray.area,
        seen: gray.seen,
        values: gray.values.iter().map(cover).collect(),
    })
}

/// About the middle between the background's median and that of the brightest `pixels`.
fn levels(gray: &Gray, pixels: usize) -> Option<Levels> {
    let mut sorted: Vec<f32> = gray.values.iter().step_by(SAMPLED).copied().collect();
    let (count, pixels) = (sorted.len(), pixels / SAMPLED);
    let rank = count.checked_sub(pixels / 2 + 1)?;
    let bright = *sorted.select_nth_unstable_by(rank, f32::total_cmp).1;
    let rest = count.saturating_sub(pixels) / 2;
    let dark = *sorted.select_nth_unstable_by(rest, f32::total_cmp).1;
    let contrast = bright - dark;
    let middle = (bright + dark) / 2.0;
    (contrast > LEAST_CONTRAST).then_some(Levels {
        low: middle - SOFT * contrast,
        high: middle + SOFT * contrast,
    })
}

/// Nothing outside of an area.
fn within(mut gray: Gray, inside: &Area) -> Gray {
    let width = gray.area.width();
    let area = gray.area;
    for (row, values) in (area.top..).zip(gray.values.chunks_mut(width)) {
        for (column, value) in (area.left..).zip(values) {
            if !inside.holds(column, row) {
                *value = 0.0;
            }
        }
    }
    gray
}

/// Mass of a band of rows and the disparity of its centroids.
#[derive(Debug, Clone, Copy)]
struct Band {
    mass: f64,
    disparity_px: f64,
}

fn bands(left: &Gray, right: &Gray, runs: &[Run], offset: i32) -> Vec<Band> {
    let (Some(first), Some(last)) = (runs.first(), runs.last()) else {
        return Vec::new();
    };
    let rows = (last.row - first.row + 1) as usize;
    let count = (rows / 2).clamp(1, BANDS);
    let mut sums = vec![[0.0_f64; 4]; count];
    for run in runs {
        let from = run.from.max(right.seen.0 - offset).max(left.seen.0);
        let to = run.to.min(right.seen.1 - offset).min(left.seen.1);
        let band = (run.row - first.row) as usize * count / rows;
        for column in from..to {
            let own = f64::from(left.at(column, run.row));
            let other = f64::from(right.at(column + offset, run.row));
            let [mass, moment, other_mass, other_moment] = &mut sums[band];
            *mass += own;
            *moment += own * f64::from(column);
            *other_mass += other;
            *other_moment += other * f64::from(column + offset);
        }
    }
    let mean = sums.iter().map(|sum| sum[0]).sum::<f64>() / count as f64;
    sums.into_iter()
        .filter(|[mass, _, other, _]| *mass > LEAST_MASS * mean && *other > LEAST_MASS * mean)
        .map(|[mass, moment, other_mass, other_moment]| Band {
            mass,
            disparity_px: moment / mass - other_moment / other_mass,
        })
        .collect()
}

/// Mean disparity by mass, and its standard error from the bands' scatter.
fn scatter(bands: &[Band]) -> Option<(f64, f64)> {
    let mass: f64 = bands.iter().map(|band| band.mass).sum();
    let mean = bands.iter().map(|b| b.mass * b.disparity_px).sum::<f64>() / mass;
    let squares: f64 = bands
        .iter()
        .map(|b| (b.mass * (b.disparity_px - mean)).powi(2))
        .sum();
    let n = bands.len() as f64;
    (bands.len() > 1 && mass > 0.0).then(|| (mean, (squares * n / (n - 1.0)).sqrt() / mass))
}
