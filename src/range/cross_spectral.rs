//! Matching across spectra (P4: a visible and a near-infrared eye), flame by flame.
//!
//! What is bright in one eye may be dark in the other, so grey levels are not compared but what
//! survives: where edges are ([`Cost::Gradient`]), how a pixel ranks among its neighbours
//! ([`Cost::Census`]), how well one eye's levels predict the other's ([`Cost::MutualInformation`]).

use super::correlate::{disparity, rival_free};
use super::patch::Gray;
use super::refine::Refiner;
use super::scene::{Run, Scene};
use super::search::{self, Curve};
use super::{Disparity, RangeConfig, Refusal};

/// What is compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cost {
    /// Normalised correlation of gradient magnitudes.
    Gradient,
    /// Share of equal bits of the census transform (Zabih and Woodfill 1994).
    Census,
    /// Normalised mutual information of grey levels.
    MutualInformation,
}

/// Ground beside the flame whose edges count.
const OUTLINE_PX: usize = 3;

pub(super) fn find(
    scene: &Scene<'_>,
    cost: Cost,
    config: &RangeConfig,
) -> Result<Disparity, Refusal> {
    if scene.flame.count() < config.min_support as usize {
        return Err(Refusal::TooSmall);
    }
    let runs = scene.flame.grown(OUTLINE_PX).runs();
    let (left, right) = (gradient(&scene.left.gray), gradient(&scene.right));
    let offsets = (-scene.search.greatest)..=(-scene.search.least);
    let curve = match cost {
        Cost::Gradient => search::correlate(&left, &right, &runs, offsets),
        Cost::Census => census_curve(&scene.left.gray, &scene.right, &runs, offsets),
        Cost::MutualInformation => {
            information_curve(&scene.left.gray, &scene.right, &runs, offsets)
        }
    };
    let best = rival_free(&curve, least_likeness(cost), -scene.search.greatest)?;
    let refined = Refiner::new(&left, &right, &runs, -best.at)
        .and_then(|refiner| refiner.refine())
        .ok_or(Refusal::Inconsistent)?;
    Ok(disparity(
        &scene.flame,
        refined.disparity_px,
        refined.sigma_px,
    ))
}

fn least_likeness(cost: Cost) -> f64 {
    match cost {
        Cost::Gradient => 0.45,
        Cost::Census => 0.25,
        Cost::MutualInformation => 0.12,
    }
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

fn census(gray: &Gray) -> Vec<u64> {
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
    (0..height)
        .flat_map(|row| (0..width).map(move |column| (column, row)))
        .map(|(column, row)| code(column, row))
        .collect()
}

/// Equal bits, -1 (all differ) to 1; chance is 0.
fn census_curve(
    left: &Gray,
    right: &Gray,
    runs: &[Run],
    offsets: std::ops::RangeInclusive<i32>,
) -> Curve {
    let codes = (census(left), census(right));
    let value = |offset: i32| {
        let (mut wanted, mut n, mut differing) = (0.0, 0.0, 0.0);
        each_pair(left, right, runs, offset, |pair| {
            wanted += 1.0;
            if let Some((own, other)) = pair {
                n += 1.0;
                differing += f64::from((codes.0[own] ^ codes.1[other]).count_ones());
            }
        });
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

const BINS: usize = 12;

/// Mutual information over the smaller entropy, 0 to 1.
fn information_curve(
    left: &Gray,
    right: &Gray,
    runs: &[Run],
    offsets: std::ops::RangeInclusive<i32>,
) -> Curve {
    let bin = |value: f32| ((value / 256.0 * BINS as f32) as usize).min(BINS - 1);
    let value = |offset: i32| {
        let (mut wanted, mut n) = (0.0, 0.0);
        let mut joint = [[0.0_f64; BINS]; BINS];
        each_pair(left, right, runs, offset, |pair| {
            wanted += 1.0;
            if let Some((own, other)) = pair {
                n += 1.0;
                joint[bin(left.values[own])][bin(right.values[other])] += 1.0;
            }
        });
        if n * 2.0 < wanted {
            return f64::NAN;
        }
        let entropy = |counts: &mut dyn Iterator<Item = f64>| -> f64 {
            counts
                .filter(|count| *count > 0.0)
                .map(|count| -count / n * (count / n).ln())
                .sum()
        };
        let own = entropy(&mut joint.iter().map(|row| row.iter().sum()));
        let other = entropy(&mut (0..BINS).map(|k| joint.iter().map(|row| row[k]).sum()));
        let both = entropy(&mut joint.iter().flatten().copied());
        if own.min(other) < 0.1 {
            return f64::NAN;
        }
        (own + other - both) / own.min(other)
    };
    Curve {
        least: *offsets.start(),
        values: offsets.map(value).collect(),
    }
}

/// Visits the runs' pixels with their partners' indices, `None` where there is no partner.
fn each_pair(
    left: &Gray,
    right: &Gray,
    runs: &[Run],
    offset: i32,
    mut visit: impl FnMut(Option<(usize, usize)>),
) {
    let index = |gray: &Gray, column: i32, row: i32| {
        (row - gray.area.top) as usize * gray.area.width() + (column - gray.area.left) as usize
    };
    for run in runs {
        for column in run.from..run.to {
            let other = column + offset;
            let there = (right.seen.0..right.seen.1).contains(&other);
            visit(there.then(|| (index(left, column, run.row), index(right, other, run.row))));
        }
    }
}
