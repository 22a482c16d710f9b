//! Matching across spectra (P4: a visible and a near-infrared eye), flame by flame.
//!
//! What is bright in one eye may be dark in the other, so grey levels are not compared. The whole pixel
//! comes from the census transform (how a pixel ranks among its neighbours), what is below it from
//! gradient magnitudes (where edges are, whatever their sign).
//!
//! Measured on 64 rendered hard flames (flicker, smoke, glints, twins, branches, borders, changed shapes,
//! dirt): census right 51, refused 4, wrong 9; mutual information 51, 5, 8; gradient magnitudes 46, 8,
//! 10. On plain visible and near-infrared pairs all three find the same pixel. Census stays: together
//! with the other methods it made fewest wrong.

use super::correlate::{disparity, rival_free};
use super::error::{Factors, Matched, PLAIN, Signs};
use super::patch::Gray;
use super::refine::Refiner;
use super::scene::{Run, Scene};
use super::search::Curve;
use super::{Miss, RangeConfig, Refusal};

/// Ground beside the flame whose edges count.
const OUTLINE_PX: usize = 3;
/// Least excess of equal bits over chance: all would be 1.
const LEAST_LIKENESS: f64 = 0.25;
/// Pixels that are compared, at most.
const MOST_PIXELS: usize = 1600;
/// Least share of the target whose parts go with the whole: edges that one spectrum shows and the other does
/// not are no sign of something in front. At the quarter that alike eyes are asked for, many more looks at two
/// plain fires are refused (`tests/near_infrared.rs`).
const LEAST_ALONG_SPECTRA: f64 = 0.1;

/// How its error follows from what it saw; equal bits are few even between alike eyes.
const FACTORS: Factors = Factors {
    scatter: 0.30,
    dull: 0.62,
    unlike: 1.94,
    hidden: 1.5,
    split: 2.11,
    moved_astray: 1.70,
    ..PLAIN
};
/// Across two spectra: a flame's outlines are not quite the same in both.
const ACROSS: Factors = Factors {
    scatter: 0.97,
    unlike_dull: 0.026,
    least_px: 0.02,
    ..PLAIN
};

pub(super) fn find(scene: &Scene<'_>, config: &RangeConfig) -> Result<Matched, Miss> {
    if scene.flame.count() < config.min_support as usize {
        return Err(Refusal::TooSmall.into());
    }
    let runs = scene.compared(OUTLINE_PX).runs();
    let right = scene.right_whole()?;
    let curve = census_curve(&scene.left, &right, &runs, scene.search.offsets());
    let best = rival_free(&curve, LEAST_LIKENESS, -scene.search.greatest)?;
    let right = scene.opposite(best.at)?;
    let (left, right) = (
        gradient(&scene.left_like(&right, best.at)?),
        gradient(&right),
    );
    let weights = scene.weights(OUTLINE_PX);
    let refined = Refiner::new(&left, &right, &weights, -best.at)
        .and_then(|refiner| refiner.refine(LEAST_ALONG_SPECTRA))
        .ok_or(Refusal::Inconsistent)?;
    Ok(Matched {
        found: disparity(&scene.flame, &refined.found),
        likeness: best.correlation,
        signs: Signs {
            hidden: scene.hidden_share(),
            ..refined.signs
        },
        factors: if scene.two_spectra { &ACROSS } else { &FACTORS },
    })
}

/// Magnitude of the gradient, through Sobel's masks.
fn gradient(gray: &Gray) -> Gray {
    let (width, height) = (gray.area.width(), gray.area.height());
    let at = |column: usize, row: usize| gray.values[row * width + column];
    let mut values = vec![0.0; width * height];
    for row in 1..height.saturating_sub(1) {
        for column in 1..width.saturating_sub(1) {
            let (w, e, n, s) = (column - 1, column + 1, row - 1, row + 1);
            let across =
                at(e, n) + 2.0 * at(e, row) + at(e, s) - at(w, n) - 2.0 * at(w, row) - at(w, s);
            let down = at(w, s) + 2.0 * at(column, s) + at(e, s)
                - at(w, n)
                - 2.0 * at(column, n)
                - at(e, n);
            values[row * width + column] = across.hypot(down) / 4.0;
        }
    }
    Gray {
        area: gray.area,
        seen: (gray.seen.0 + 1, gray.seen.1 - 1),
        values,
    }
}

/// Half width and half height of the neighbourhood that census ranks a pixel in.
const CENSUS: (i32, i32) = (3, 2);
const CENSUS_BITS: f64 = 34.0;

/// The census transform of rows `every` apart (Zabih and Woodfill 1994); other rows stay empty.
fn census(gray: &Gray, every: i32) -> Vec<u64> {
    let (width, height) = (gray.area.width() as i32, gray.area.height() as i32);
    let at = |column: i32, row: i32| {
        gray.values[(row.clamp(0, height - 1) * width + column.clamp(0, width - 1)) as usize]
    };
    let code = |column: i32, row: i32| {
        let middle = at(column, row);
        let mut bits = 0;
        for dy in -CENSUS.1..=CENSUS.1 {
            for dx in -CENSUS.0..=CENSUS.0 {
                if (dx, dy) != (0, 0) {
                    bits = bits << 1 | u64::from(at(column + dx, row + dy) > middle);
                }
            }
        }
        bits
    };
    let mut codes = vec![0; gray.values.len()];
    for row in (0..height).filter(|row| (row + gray.area.top) % every == 0) {
        for column in 0..width {
            codes[(row * width + column) as usize] = code(column, row);
        }
    }
    codes
}

/// Equal bits by offset, -1 (all differ) to 1; chance is 0.
fn census_curve(
    left: &Gray,
    right: &Gray,
    runs: &[Run],
    offsets: std::ops::RangeInclusive<i32>,
) -> Curve {
    let pixels: i32 = runs.iter().map(|run| run.to - run.from).sum();
    let every = (pixels as usize).div_ceil(MOST_PIXELS).max(1) as i32;
    let runs: Vec<Run> = runs
        .iter()
        .filter(|run| run.row % every == 0)
        .copied()
        .collect();
    let codes = (census(left, every), census(right, every));
    let index = |gray: &Gray, column: i32, row: i32| {
        (row - gray.area.top) as usize * gray.area.width() + (column - gray.area.left) as usize
    };
    let value = |offset: i32| {
        let (mut wanted, mut n, mut differing) = (0.0, 0.0, 0.0);
        for run in &runs {
            wanted += f64::from(run.to - run.from);
            let from = run.from.max(right.seen.0 - offset);
            for column in from..run.to.min(right.seen.1 - offset) {
                let own = codes.0[index(left, column, run.row)];
                let other = codes.1[index(right, column + offset, run.row)];
                n += 1.0;
                differing += f64::from((own ^ other).count_ones());
            }
        }
        if n * 2.0 < wanted {
            return f64::NAN;
        }
        1.0 - 2.0 * differing / (n * CENSUS_BITS)
    };
    Curve {
        least: *offsets.start(),
        values: offsets.map(value).collect(),
    }
}
