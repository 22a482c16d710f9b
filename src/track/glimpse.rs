//! What each fire should look like in this frame, and which sighting is which fire.

use super::assign::{Candidate, assign};
use super::estimate::Frame;
use super::{Classified, Fire};
use crate::locate::Predicted;
use emberfix_calib::Eye;
use emberfix_frames::Vector3;
use nalgebra::Matrix3;

/// A fire as it should be seen, if anything sees it.
#[derive(Debug, Clone)]
pub struct Glimpse {
    /// Index of the fire.
    pub slot: usize,
    /// Column, row, disparity of its base.
    pub seen: Vector3<f64>,
    /// Their covariance but for what is new in each frame, which all fires share.
    pub spread: Matrix3<f64>,
    /// Of what is new in each frame.
    pub new: Matrix3<f64>,
    /// Pixels per metre at its depth.
    pub px_per_m: f64,
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
/// Glimpses of all fires that may be in the image; their errors are let change up to now.
#[must_use]
pub fn all(fires: &mut [Fire], frame: &Frame<'_>) -> Vec<Glimpse> {
    let (width, height) = frame.view.rig.camera(Eye::Left).image_size_px;
    let near = |value: f64, size: u32| {
        let size = f64::from(size);
        (-MARGIN * size..(1.0 + MARGIN) * size).contains(&value)
    };
    let is_near = |seen: &Predicted| near(seen.pixel.u, width) && near(seen.pixel.v, height);
    let focal_px = frame.view.rig.rectification().focal_px();
    let mut glimpses = Vec::new();
    for (slot, fire) in fires.iter_mut().enumerate().filter(|(_, f)| f.is_open()) {
        let predicted = fire.estimate.predict(frame.lens).filter(is_near);
        let Some(predicted) = predicted else { continue };
        fire.estimate.age(frame.view.pose.at, frame.pace);
        if let Some(seen) = fire.estimate.seen(frame) {
            glimpses.push(Glimpse {
                slot,
                seen: seen.value,
                spread: seen.spread,
                new: seen.new,
                px_per_m: focal_px / predicted.depth_m,
            });
        }
    }
    glimpses
}

/// Which fire each sighting was given to.
#[derive(Debug, Clone, PartialEq)]
pub struct Matches {
    /// For each sighting the index of its fire.
    pub slots: Vec<Option<usize>>,
    /// For each sighting without one a fire that was not seen otherwise and that it may well belong to:
    /// two boxes that became one, a box cut by a branch, a moment stamped wrongly.
    pub strays: Vec<Option<usize>>,
}

/// All at once at the least total cost; then what is left over, among the fires that are left over.
#[must_use]
pub fn associate(
    glimpses: &[Glimpse],
    fires: &[Fire],
    sightings: &[Classified],
    frame: &Frame<'_>,
) -> Matches {
    let (within, near) = candidates(glimpses, fires, sightings, frame);
    let matched = assign(&within, glimpses.len(), ALONE);
    let mut is_taken = vec![false; glimpses.len()];
    matched.iter().flatten().for_each(|of| is_taken[*of] = true);
    let left_over = |(row, matched): (Vec<Candidate>, &Option<usize>)| match matched {
        Some(_) => Vec::new(),
        None => row.into_iter().filter(|c| !is_taken[c.column]).collect(),
    };
    let near: Vec<_> = near.into_iter().zip(&matched).map(left_over).collect();
    let strays = assign(&near, glimpses.len(), STRAY + 1.0);
    let slot = |of: Option<usize>| of.map(|of| glimpses[of].slot);
    Matches {
        slots: matched.into_iter().map(slot).collect(),
        strays: strays.into_iter().map(slot).collect(),
    }
}

/// For each sighting the fires within the gate at their costs, and all that are near at their squared
/// distances.
fn candidates(
    glimpses: &[Glimpse],
    fires: &[Fire],
    sightings: &[Classified],
    frame: &Frame<'_>,
) -> (Vec<Vec<Candidate>>, Vec<Vec<Candidate>>) {
    let mut within = vec![Vec::new(); sightings.len()];
    let mut near = within.clone();
    let mut by_column: Vec<usize> = (0..sightings.len()).collect();
    let column = |index: &usize| sightings[*index].sighting.base.u;
    by_column.sort_by(|a, b| column(a).total_cmp(&column(b)));
    let sigmas = sightings.iter().map(|s| s.sighting.base_sigma_px.0);
    let widest = sigmas.fold(0.0, f64::max);
    for (of, glimpse) in glimpses.iter().enumerate() {
        let variance = glimpse.spread[(0, 0)] + glimpse.new[(0, 0)] + widest * widest;
        let reach = (STRAY * variance).sqrt();
        let from = by_column.partition_point(|index| column(index) < glimpse.seen.x - reach);
        let in_reach = by_column[from..]
            .iter()
            .take_while(|index| column(index) <= glimpse.seen.x + reach);
        for index in in_reach {
            let fire = &fires[glimpse.slot];
            let Some(fit) = fit(glimpse, fire, &sightings[*index], frame) else {
                continue;
            };
            let candidate = |cost: f64| Candidate { column: of, cost };
            near[*index].push(candidate(fit.squared));
            within[*index].extend(fit.cost.map(candidate));
        }
    }
    (within, near)
}

/// How a sighting fits a fire that it is near to.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Fit {
    squared: f64,
    /// Within the gate: what the match costs, squared distance and how vague the fire is.
    cost: Option<f64>,
}

fn fit(glimpse: &Glimpse, fire: &Fire, classified: &Classified, frame: &Frame<'_>) -> Option<Fit> {
    let sighting = &classified.sighting;
    let (sigma_u, sigma_v) = sighting.base_sigma_px;
    let spread_of_all = glimpse.spread + glimpse.new;
    let row = sighting.base.v - glimpse.seen.y;
    let is_far = row * row > STRAY * (spread_of_all[(1, 1)] + sigma_v * sigma_v);
    if is_far || fire.class != classified.class {
        return None;
    }
    let (residual, has_disparity) = fire.estimate.left(sighting, frame)?;
    let gate = GATE[usize::from(has_disparity)];
    let mut spread = spread_of_all;
    let sigma_d = sighting.disparity.map_or(1.0, |d| d.sigma_px);
    let noise = Vector3::new(sigma_u * sigma_u, sigma_v * sigma_v, sigma_d * sigma_d)
        * frame.scatter.variance();
    if !has_disparity {
        spread.fixed_view_mut::<1, 3>(2, 0).fill(0.0);
        spread.fixed_view_mut::<3, 1>(0, 2).fill(0.0);
    }
    let factor = (spread + Matrix3::from_diagonal(&noise)).cholesky()?;
    let squared = residual.dot(&factor.solve(&residual));
    let widening = 2.0 * factor.l().diagonal().map(f64::ln).sum() - noise.map(f64::ln).sum();
    (squared <= STRAY).then_some(Fit {
        squared,
        cost: (squared <= gate).then_some(squared + widening.min(MOST_WIDENING)),
    })
}
