//! Centroids of the flame's pixels in both eyes (P1: `x = sum(x M) / sum(M)`, `d = x_left - x_right`).
//!
//! P1 ranges the largest mask of the image and finds its partner because there is only one. Here every
//! target is ranged: its bright pixels are looked for along the epipolar strip, and the centroids are
//! taken where they are found. The edge of the bright pixels is soft, so that a centroid moves evenly
//! with the flame and not by whole pixels.

use super::correlate::{disparity, rival_free, there_and_back};
use super::error::{Factors, Matched, PLAIN, Signs};
use super::patch::{Area, Gray};
use super::refine::Refined;
use super::scene::{Mask, Run, Scene};
use super::search::correlate;
use super::{Miss, RangeConfig, Refusal};

/// Grey levels between which a pixel comes to count.
#[derive(Debug, Clone, Copy)]
struct Levels {
    low: f32,
    high: f32,
}

/// About one pixel in so many tells the levels.
const SAMPLED: usize = 7;
/// Less contrast than this between flame and background is none, grey levels.
const LEAST_CONTRAST: f32 = 16.0;
/// Half the width of the soft edge, as a share of the contrast.
const SOFT: f32 = 0.2;
/// Ground beside the bright pixels that is compared with them: without it any brightness would fit.
const RIM_PX: usize = 3;
/// Least likeness of the two masks.
const LEAST_LIKENESS: f64 = 0.7;
/// From this likeness on no other place is looked at to be sure.
const SURE: f64 = 0.9;
/// How its error follows from what it saw: the eyes draw the edge of brightness at other levels.
const FACTORS: Factors = Factors {
    scatter: 1.05,
    dull: 3.17,
    dull_px: 2.02,
    unlike_width: 0.044,
    least_px: 0.025,
    ..PLAIN
};
/// Bands of rows whose scatter is the error.
const BANDS: usize = 8;
/// Least mass of a band against the mean one.
const LEAST_MASS: f64 = 0.2;

pub(super) fn find(scene: &Scene<'_>, config: &RangeConfig) -> Result<Matched, Miss> {
    let pixels = scene.flame.count();
    if pixels < config.min_support as usize {
        return Err(Refusal::TooSmall.into());
    }
    let left = levels(&scene.left, 1, pixels).ok_or(Refusal::Flat)?;
    let left = left.cover(&scene.left);
    let levels = levels(&scene.right, scene.every, pixels).ok_or(Refusal::Flat)?;
    let right = levels.cover(&scene.right);
    let bright = bright(&left, &scene.target);
    if bright.count() < config.min_support as usize {
        return Err(Refusal::TooSmall.into());
    }
    let rimmed = bright.grown(RIM_PX).runs();
    let curve = correlate(&left, &right, &rimmed, scene.every, scene.search.offsets());
    let best = rival_free(&curve, LEAST_LIKENESS, -scene.search.greatest)?;
    if best.correlation < SURE {
        there_and_back(scene, &rimmed, &best)?;
    }
    let right = levels.cover(&*scene.opposite(best.at)?);
    let bands = bands(&left, &right, &rimmed, best.at);
    let (px, sigma_px) = scatter(&bands).ok_or(Refusal::TooSmall)?;
    let refined = Refined {
        disparity_px: px,
        sigma_px,
        at: bright.centroid(),
    };
    let signs = Signs {
        dullness: dullness(&left, &right, &rimmed, best.at),
        ..Signs::default()
    };
    Ok(Matched {
        found: disparity(&bright, &refined),
        likeness: best.correlation,
        signs,
        factors: &FACTORS,
    })
}

impl Levels {
    /// How much each pixel belongs to what is bright, 0 to 255.
    fn cover(&self, gray: &Gray) -> Gray {
        let cover =
            |value: &f32| 255.0 * ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0);
        Gray {
            area: gray.area,
            seen: gray.seen,
            values: gray.values.iter().map(cover).collect(),
        }
    }
}

/// About the middle between the background's median and that of the brightest `pixels`; only rows `every`
/// apart are filled.
fn levels(gray: &Gray, every: i32, pixels: usize) -> Option<Levels> {
    let filled = (gray.area.top..gray.area.bottom).filter(|row| row % every == 0);
    let step = SAMPLED.div_ceil(every as usize);
    let mut sorted: Vec<f32> = filled
        .flat_map(|row| gray.row(row).iter().skip(row as usize % step).step_by(step))
        .copied()
        .collect();
    let all = gray.area.width() * gray.area.height();
    let (count, pixels) = (sorted.len(), pixels * sorted.len() / all.max(1));
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

/// What belongs to the bright pixels of an area. Only where they are looked for is the box's: what its
/// edge cuts off counts in both eyes, or the left centroid would move away from that edge.
fn bright(left: &Gray, inside: &Area) -> Mask {
    let area = left.area;
    let rows = (area.top..).zip(left.values.chunks_exact(area.width().max(1)));
    let kept = rows.flat_map(|(row, line)| {
        let columns = (area.left..).zip(line);
        columns.map(move |(column, cover)| *cover > 127.0 && inside.holds(column, row))
    });
    Mask {
        area,
        kept: kept.collect(),
    }
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

/// By what share one eye draws the edge of brightness softer than the other: the squares of their slopes.
fn dullness(left: &Gray, right: &Gray, runs: &[Run], offset: i32) -> f64 {
    let (mut own, mut other) = (0.0_f32, 0.0_f32);
    for run in runs {
        let from = run.from.max(right.seen.0 - offset).max(left.seen.0) + 1;
        let to = run.to.min(right.seen.1 - offset).min(left.seen.1) - 1;
        if from >= to {
            continue;
        }
        let steep = |gray: &Gray, offset: i32| -> f32 {
            let first = (from - 1 + offset - gray.area.left) as usize;
            let line = &gray.row(run.row)[first..first + (to - from + 2) as usize];
            line.windows(3).map(|w| (w[2] - w[0]).powi(2)).sum()
        };
        own += steep(left, 0);
        other += steep(right, offset);
    }
    f64::from(1.0 - own.min(other) / own.max(other).max(f32::MIN_POSITIVE))
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
