//! What each fire should look like in this frame, and which sighting is which fire.

use super::assign::{Candidate, assign};
use super::estimate::Frame;
use super::grid::Grid;
use super::look::flame_above;
use super::{Classified, Fire};
use crate::locate::{Distant, Predicted, Sighting};
use emberfix_calib::Eye;
use emberfix_frames::Vector3;
use nalgebra::{Matrix2, Matrix3};

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
    /// Its base by the frame's lens alone, and the disparity that the fire's own errors add to what that says.
    pub base: Distant,
    pub disparity_apart_px: f64,
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
        fire.estimate.age(frame);
        if let Some(seen) = fire.estimate.seen(frame) {
            glimpses.push(Glimpse {
                slot,
                seen: seen.value,
                spread: seen.spread,
                new: seen.new,
                base: seen.base,
                disparity_apart_px: seen.disparity_apart_px,
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
    let places: Vec<_> = sightings
        .iter()
        .map(|s| (s.sighting.base.u, s.sighting.base.v))
        .collect();
    let mut scene = Scene {
        glimpses,
        fires,
        sightings,
        frame,
        grid: Grid::new(frame.view.rig.camera(Eye::Left).image_size_px, &places),
        is_open: (vec![true; glimpses.len()], vec![true; sightings.len()]),
    };
    let within = scene.candidates(GATE[1], |fit| fit.cost);
    let matched = assign(&within, glimpses.len(), ALONE);
    for (index, of) in matched.iter().enumerate() {
        if let Some(of) = of {
            (scene.is_open.0[*of], scene.is_open.1[index]) = (false, false);
        }
    }
    let near = scene.candidates(STRAY, |fit| Some(fit.squared));
    let strays = assign(&near, glimpses.len(), STRAY + 1.0);
    let slot = |of: Option<usize>| of.map(|of| glimpses[of].slot);
    Matches {
        slots: matched.into_iter().map(slot).collect(),
        strays: strays.into_iter().map(slot).collect(),
    }
}

/// What is matched in one frame.
struct Scene<'a> {
    glimpses: &'a [Glimpse],
    fires: &'a [Fire],
    sightings: &'a [Classified],
    frame: &'a Frame<'a>,
    /// Of the sightings.
    grid: Grid,
    /// Glimpses, and sightings, that are not matched yet.
    is_open: (Vec<bool>, Vec<bool>),
}

impl Scene<'_> {
    /// For each open sighting the open glimpses within a squared distance that have a cost.
    fn candidates(&self, gate: f64, cost: impl Fn(&Fit) -> Option<f64>) -> Vec<Vec<Candidate>> {
        let widest = self.widest_px();
        let mut candidates = vec![Vec::new(); self.sightings.len()];
        let glimpses = self.glimpses.iter().enumerate();
        for (of, glimpse) in glimpses.filter(|(of, _)| self.is_open.0[*of]) {
            let spread = glimpse.spread + glimpse.new;
            let reach = |axis: usize, px: f64| (gate * (spread[(axis, axis)] + px * px)).sqrt();
            let at = (glimpse.seen.x, glimpse.seen.y);
            let near = self.grid.near(at, (reach(0, widest.0), reach(1, widest.1)));
            for index in near.filter(|index| self.is_open.1[*index]) {
                let fire = &self.fires[glimpse.slot];
                let fit = fit(glimpse, fire, &self.sightings[index], gate, self.frame);
                let cost = fit.and_then(|fit| cost(&fit));
                candidates[index].extend(cost.map(|cost| Candidate { column: of, cost }));
            }
        }
        candidates
    }

    /// Largest sigma of a box along columns and along rows, as it is believed, pixels.
    fn widest_px(&self) -> (f64, f64) {
        let sigmas = self.sightings.iter().map(|s| s.sighting.base_sigma_px);
        let (u, v) = sigmas.fold((0.0, 0.0), |(u, v): (f64, f64), sigma| {
            (u.max(sigma.0), v.max(sigma.1))
        });
        let scatter = self.frame.scatter.variance().sqrt();
        (u * scatter, v * scatter)
    }
}

/// How a sighting fits a fire that it is near to.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Fit {
    squared: f64,
    /// Within the gate: what the match costs, squared distance and how vague the fire is.
    cost: Option<f64>,
}

/// How a sighting fits a fire; `None` when it lies beyond a squared distance.
///
/// The fire's errors are taken as linear about the base as it was glimpsed: a flame's disparity is that of its
/// own height, and what the errors add to it that of the base. Thousands of pairs are looked at in a frame,
/// and those that are matched are measured exactly ([`Estimate::take`](super::Estimate::take)).
fn fit(
    glimpse: &Glimpse,
    fire: &Fire,
    classified: &Classified,
    gate: f64,
    frame: &Frame<'_>,
) -> Option<Fit> {
    let sighting = &classified.sighting;
    let (sigma_u, sigma_v) = sighting.base_sigma_px;
    let sigma_d = sighting.disparity.map_or(1.0, |d| d.sigma_px);
    let noise = Vector3::new(sigma_u * sigma_u, sigma_v * sigma_v, sigma_d * sigma_d)
        * frame.scatter.variance();
    let mut spread = glimpse.spread + glimpse.new + Matrix3::from_diagonal(&noise);
    let mut residual = Vector3::new(
        sighting.base.u - glimpse.seen.x,
        sighting.base.v - glimpse.seen.y,
        0.0,
    );
    let is_far = |axis: usize| residual[axis] * residual[axis] > gate * spread[(axis, axis)];
    if is_far(0) || is_far(1) || fire.class != classified.class {
        return None;
    }
    if bearing_distance(&residual, &spread)? > gate {
        return None;
    }
    let expected = disparity_px(&glimpse.base, sighting, frame);
    if let Some((measured, expected)) = sighting.disparity.zip(expected) {
        residual.z = measured.px - expected - glimpse.disparity_apart_px;
    } else {
        spread.fixed_view_mut::<1, 3>(2, 0).fill(0.0);
        spread.fixed_view_mut::<3, 1>(0, 2).fill(0.0);
        spread[(2, 2)] = noise.z;
    }
    let factor = spread.cholesky()?;
    let squared = residual.dot(&factor.solve(&residual));
    let widening = 2.0 * factor.l().diagonal().map(f64::ln).sum() - noise.map(f64::ln).sum();
    (squared <= gate).then_some(Fit {
        squared,
        cost: (squared <= GATE[usize::from(expected.is_some())])
            .then_some(squared + widening.min(MOST_WIDENING)),
    })
}

/// Disparity that a sighting should have at its own centroid above a base, if the camera is what all fires
/// together know; `None` where it has none, or none that a flame above this base could have.
fn disparity_px(base: &Distant, sighting: &Sighting, frame: &Frame<'_>) -> Option<f64> {
    let pixel = sighting.disparity?.centroid;
    let flame = flame_above(base, pixel, frame.lens, frame.view.up())?;
    Some(frame.lens.predict(&flame)?.disparity_px)
}

/// Squared distance by column and row alone: with the disparity it can only grow.
fn bearing_distance(residual: &Vector3<f64>, spread: &Matrix3<f64>) -> Option<f64> {
    let off = residual.xy();
    let spread: Matrix2<f64> = spread.fixed_view::<2, 2>(0, 0).into_owned();
    Some(off.dot(&spread.cholesky()?.solve(&off)))
}
