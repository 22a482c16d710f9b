//! What each fire should look like in this frame, and which sighting is which fire.

use super::assign::{Candidate, assign};
use super::block::MEASURED;
use super::common::{COMMON, Common};
use super::measure::Look;
use super::{Classified, Fire};
use crate::locate::{Lens, SHARED, View};
use emberfix_calib::{Eye, Rig};
use emberfix_frames::Vector3;
use nalgebra::{DMatrix, Matrix3, SMatrix};

/// A fire as it should be seen, if anything sees it.
#[derive(Debug, Clone)]
pub struct Glimpse {
    /// Index of the fire.
    pub slot: usize,
    /// Column, row, disparity of its base.
    pub seen: Vector3<f64>,
    /// Their covariance, all errors but the sighting's own.
    pub spread: Matrix3<f64>,
}

/// Chi-square 99.9 % for two and three numbers: bearing, and disparity. A fire is sighted hundreds
/// of times; at 99 % each orbit would throw some of its own sightings away.
const GATE: [f64; 2] = [13.82, 16.27];
/// Squared distance up to which a sighting is no new fire while the fire there is not seen.
const STRAY: f64 = 64.0;
/// What a sighting costs that is given to no fire: the squared distance at which a new fire is as
/// likely, given that one in a hundred looks shows a new one somewhere in a million pixels.
const ALONE: f64 = 26.0;
/// A fire whose position is this vague is matched as gladly as one twice as vague.
const MOST_WIDENING: f64 = 9.0;
/// Fires are looked for up to this share of the image beyond its edges.
const MARGIN: f64 = 0.25;
/// Fires of which the spread is worked out at once.
const BATCH: usize = 512;

/// Glimpses of all fires that may be in the image.
#[must_use]
pub fn all(fires: &[Fire], common: &Common, lens: &Lens, rig: &Rig) -> Vec<Glimpse> {
    let (width, height) = rig.camera(Eye::Left).image_size_px;
    let near = |value: f64, size: u32| {
        let size = f64::from(size);
        (-MARGIN * size..(1.0 + MARGIN) * size).contains(&value)
    };
    let mut glimpses = Vec::new();
    let mut all_rows = Vec::new();
    for (slot, fire) in fires.iter().enumerate().filter(|(_, fire)| fire.is_open()) {
        let block = fire.estimate.block();
        let state = block.state(common);
        let (point, _, _) = block.chart().distant(&state);
        let is_near = |seen: &crate::locate::Predicted| {
            near(seen.pixel.u, width) && near(seen.pixel.v, height)
        };
        if !lens.predict(&point).as_ref().is_some_and(is_near) {
            continue;
        }
        let Some(linear) = lens.linear(&point) else {
            continue;
        };
        let by_state = block.chart().slopes(&linear, &state, lens.centre(), 1.0);
        let mut by_common = by_state * block.by_common();
        let mut now = by_common.fixed_columns_mut::<SHARED>(0);
        now += linear.by_shared;
        glimpses.push(Glimpse {
            slot,
            seen: linear.value,
            spread: by_state * block.own() * by_state.transpose(),
        });
        all_rows.push(by_common);
    }
    for (glimpses, rows) in glimpses.chunks_mut(BATCH).zip(all_rows.chunks(BATCH)) {
        add_common_spread(glimpses, rows, common);
    }
    glimpses
}

/// Adds what the common errors do, for many at once.
fn add_common_spread(glimpses: &mut [Glimpse], rows: &[SMatrix<f64, 3, COMMON>], common: &Common) {
    let mut stacked = DMatrix::zeros(3 * rows.len(), COMMON);
    for (index, row) in rows.iter().enumerate() {
        stacked.fixed_rows_mut::<3>(3 * index).copy_from(row);
    }
    let with_common = stacked * common.covariance();
    for (index, (glimpse, row)) in glimpses.iter_mut().zip(rows).enumerate() {
        glimpse.spread += with_common.fixed_rows::<3>(3 * index) * row.transpose();
    }
}

/// Which fire each sighting was given to.
#[derive(Debug, Clone, PartialEq)]
pub struct Matches {
    /// For each sighting the index of its fire.
    pub slots: Vec<Option<usize>>,
    /// For each sighting without one a fire that was not seen otherwise and that it may well belong to:
    /// two boxes that became one, a box cut by a branch.
    pub strays: Vec<Option<usize>>,
}

/// All at once at the least total cost.
#[must_use]
pub fn associate(
    glimpses: &[Glimpse],
    fires: &[Fire],
    sightings: &[Classified],
    lens: &Lens,
    view: &View<'_>,
) -> Matches {
    let mut rows = vec![Vec::new(); sightings.len()];
    let mut near_misses = Vec::new();
    let mut by_column: Vec<usize> = (0..sightings.len()).collect();
    let column = |index: &usize| sightings[*index].sighting.base.u;
    by_column.sort_by(|a, b| column(a).total_cmp(&column(b)));
    let coarsest = |of: fn(&Classified) -> f64| sightings.iter().map(of).fold(0.0, f64::max);
    let widest = coarsest(|classified| classified.sighting.base_sigma_px.0);
    for (of, glimpse) in glimpses.iter().enumerate() {
        let reach = (STRAY * (glimpse.spread[(0, 0)] + widest * widest)).sqrt();
        let from = by_column.partition_point(|index| column(index) < glimpse.seen.x - reach);
        let near = by_column[from..]
            .iter()
            .take_while(|index| column(index) <= glimpse.seen.x + reach);
        for index in near {
            let fire = &fires[glimpse.slot];
            match fit(glimpse, fire, &sightings[*index], lens, view) {
                Fit::Within { cost } => rows[*index].push(Candidate { column: of, cost }),
                Fit::Stray => near_misses.push((*index, of)),
                Fit::Not => {}
            }
        }
    }
    let matched = assign(&rows, glimpses.len(), ALONE);
    let mut is_taken = vec![false; glimpses.len()];
    matched.iter().flatten().for_each(|of| is_taken[*of] = true);
    let mut strays = vec![None; sightings.len()];
    let within = rows.iter().enumerate();
    let within = within.flat_map(|(index, row)| row.iter().map(move |c| (index, c.column)));
    for (index, of) in within.chain(near_misses) {
        if !is_taken[of] {
            strays[index] = Some(glimpses[of].slot);
        }
    }
    let slot = |of: Option<usize>| of.map(|of| glimpses[of].slot);
    Matches {
        slots: matched.into_iter().map(slot).collect(),
        strays,
    }
}

/// How a sighting fits a fire.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fit {
    /// Within the gate, at a cost.
    Within {
        /// Squared distance, and how vague the fire is.
        cost: f64,
    },
    /// Beyond the gate, but too near for another fire to begin there while this one is not seen.
    Stray,
    /// Elsewhere.
    Not,
}

fn fit(
    glimpse: &Glimpse,
    fire: &Fire,
    classified: &Classified,
    lens: &Lens,
    view: &View<'_>,
) -> Fit {
    let sighting = &classified.sighting;
    let (sigma_u, sigma_v) = sighting.base_sigma_px;
    let row = sighting.base.v - glimpse.seen.y;
    let is_far = row * row > STRAY * (glimpse.spread[(1, 1)] + sigma_v * sigma_v);
    if is_far || fire.class != classified.class {
        return Fit::Not;
    }
    let look = Look {
        sighting,
        lens,
        up: *view.up(),
        ground: None,
        flown_share: 1.0,
    };
    let estimate = &fire.estimate;
    let Some(m) = look.linearise(estimate.block().chart(), estimate.state()) else {
        return Fit::Not;
    };
    let has_disparity = m.says(MEASURED - 2);
    let gate = GATE[usize::from(has_disparity)];
    let mut spread = glimpse.spread;
    let noise = Vector3::new(sigma_u * sigma_u, sigma_v * sigma_v, m.noise[2]);
    if !has_disparity {
        spread.fixed_view_mut::<1, 3>(2, 0).fill(0.0);
        spread.fixed_view_mut::<3, 1>(0, 2).fill(0.0);
    }
    let Some(factor) = (spread + Matrix3::from_diagonal(&noise)).cholesky() else {
        return Fit::Not;
    };
    let residual = m.residual.fixed_rows::<3>(0).into_owned();
    let squared = residual.dot(&factor.solve(&residual));
    if squared > STRAY {
        return Fit::Not;
    }
    if squared > gate {
        return Fit::Stray;
    }
    let widening = 2.0 * factor.l().diagonal().map(f64::ln).sum() - noise.map(f64::ln).sum();
    Fit::Within {
        cost: squared + widening.min(MOST_WIDENING),
    }
}
