//! Two fires or one: evidence for pairs that lie within each other's error.

use super::Fire;
use super::glimpse::Glimpse;
use super::grid::Grid;
use crate::alarm::{FireId, FireState};
use crate::locate::View;
use emberfix_calib::Eye;
use emberfix_frames::{ServiceTime, seconds};
use nalgebra::Vector2;
use std::collections::{BTreeMap, BTreeSet};

/// What looks have said of pairs. Kept for pairs that were close in the image, as long as both live.
#[derive(Debug, Default)]
pub struct Pairs {
    log_odds: BTreeMap<(FireId, FireId), Odds>,
}

/// For being one fire.
#[derive(Debug, Clone, Copy)]
struct Odds {
    for_one: f64,
    last_look: ServiceTime,
}

/// A look in which both should be seen and one is: two fires that are seen in four looks of five
/// do so in one of three, one fire in four of five.
const ONE_SEEN: f64 = 0.9;
/// A look in which both are seen: one fire does so when the detector splits it, one in twenty.
const BOTH_SEEN: f64 = -3.0;
/// One look in which both were seen leaves less than this.
const IN_DOUBT: f64 = -1.0;
/// No amount of old looks outweighs a long run of new ones.
const SURELY_TWO: f64 = -20.0;
/// 95 % for one.
const IS_ONE: f64 = 3.0;
/// Looks closer together than this are one, seconds.
const LOOK_S: f64 = 0.3;
/// Chi-square 99 % for two: further apart they are two.
const GATE: f64 = 9.21;
/// Pairs are looked for this close in the image, pixels.
const NEAR_PX: f64 = 64.0;
/// A fire of which so many looks were taken has shown whom it stands beside.
const SETTLED_LOOKS: u32 = 24;

impl Pairs {
    /// Takes one frame in; returns the pairs (elder, younger) that have turned out to be one fire.
    pub fn look(
        &mut self,
        fires: &[Fire],
        glimpses: &[Glimpse],
        seen: &[bool],
        view: &View<'_>,
    ) -> Vec<(usize, usize)> {
        let now = view.pose.at;
        let image_px = view.rig.camera(Eye::Left).image_size_px;
        self.note_both_seen(fires, seen, now);
        let mut ones = Vec::new();
        for (a, b) in near_pairs(fires, glimpses, seen, image_px) {
            let ids = (fires[a.slot].id, fires[b.slot].id);
            if seen[a.slot] && seen[b.slot] {
                self.log_odds
                    .entry(ids)
                    .or_insert_with(|| Odds::unknown(now));
                continue;
            }
            let is_news =
                are_two_boxes(a, b, fires) || are_one_place(&fires[a.slot], &fires[b.slot]);
            if is_news && distance(a, b, fires) <= GATE && self.note(ids, ONE_SEEN, now) >= IS_ONE {
                ones.push((a.slot, b.slot));
            }
        }
        ones.sort_unstable();
        ones
    }

    /// The younger ones of pairs of which the elder is told and that may still be one.
    #[must_use]
    pub fn in_doubt(&self, fires: &[Fire]) -> BTreeSet<FireId> {
        let is_told = |id: &FireId| {
            let at = fires.binary_search_by(|fire| fire.id.cmp(id));
            at.is_ok_and(|at| fires[at].is_confirmed() && fires[at].state != FireState::Out)
        };
        let pairs = self.log_odds.iter();
        pairs
            .filter(|((elder, _), odds)| odds.for_one > IN_DOUBT && is_told(elder))
            .map(|((_, younger), _)| *younger)
            .collect()
    }

    /// Known pairs of which both are seen at once, unless that was settled long ago.
    fn note_both_seen(&mut self, fires: &[Fire], seen: &[bool], now: ServiceTime) {
        let ids = fires.iter().zip(seen).filter(|(_, is_seen)| **is_seen);
        // In order, as the fires are.
        let ids: Vec<FireId> = ids.map(|(fire, _)| fire.id).collect();
        let is_seen = |id: &FireId| ids.binary_search(id).is_ok();
        let both = |(a, b): &(FireId, FireId)| is_seen(a) && is_seen(b);
        let open = self.log_odds.iter_mut();
        let open = open.filter(|(_, odds)| odds.for_one > SURELY_TWO);
        for (_, odds) in open.filter(|(pair, _)| both(pair)) {
            odds.add(BOTH_SEEN, now);
        }
    }

    /// Forgets the pairs of fires that are no more.
    pub fn keep_only(&mut self, fires: &[Fire]) {
        let is_known = |id: &FireId| fires.binary_search_by(|fire| fire.id.cmp(id)).is_ok();
        self.log_odds.retain(|(a, b), _| is_known(a) && is_known(b));
    }

    fn note(&mut self, pair: (FireId, FireId), told: f64, now: ServiceTime) -> f64 {
        let odds = self.log_odds.entry(pair);
        let odds = odds.or_insert_with(|| Odds::unknown(now));
        odds.add(told, now);
        odds.for_one
    }
}

impl Odds {
    fn unknown(now: ServiceTime) -> Self {
        Self {
            for_one: 0.0,
            last_look: now - seconds(LOOK_S),
        }
    }

    fn add(&mut self, told: f64, now: ServiceTime) {
        let since_s = (now - self.last_look).as_secs_f64();
        self.for_one += told * (since_s / LOOK_S).clamp(0.0, 1.0);
        self.for_one = self.for_one.max(SURELY_TWO);
        self.last_look = now;
    }
}

/// Whether a detector would show two boxes, if these were two fires: those that hide each other say
/// nothing when one box is seen.
fn are_two_boxes(a: &Glimpse, b: &Glimpse, fires: &[Fire]) -> bool {
    let width_px = extent_px(a, fires).max(extent_px(b, fires));
    let off = (a.seen - b.seen).fixed_rows::<2>(0).amax();
    off > 0.5 * width_px
}

/// Two that stand within each other's flames are one, whoever sees them from where.
fn are_one_place(a: &Fire, b: &Fire) -> bool {
    let apart_m = (a.estimate.position_m() - b.estimate.position_m()).norm();
    apart_m < 0.5 * extent_m(a).min(extent_m(b))
}

/// Pairs (elder, younger) close in the image of which at least one was seen: those of which one was
/// missed, and those with a young one, of which it is not settled yet whom it stands beside.
fn near_pairs<'a>(
    fires: &[Fire],
    glimpses: &'a [Glimpse],
    seen: &[bool],
    image_px: (u32, u32),
) -> Vec<(&'a Glimpse, &'a Glimpse)> {
    let open: Vec<&'a Glimpse> = glimpses
        .iter()
        .filter(|glimpse| fires[glimpse.slot].state != FireState::Out)
        .collect();
    let asks = |glimpse: &Glimpse| {
        !seen[glimpse.slot] || fires[glimpse.slot].evidence.hits() < SETTLED_LOOKS
    };
    let places: Vec<_> = open.iter().map(|g| (g.seen.x, g.seen.y)).collect();
    let grid = Grid::new(image_px, &places);
    let reaches: Vec<_> = open.iter().map(|g| reach_px(g, fires)).collect();
    let widest = reaches
        .iter()
        .fold(Vector2::zeros(), |most, r| r.sup(&most));
    let mut pairs = Vec::new();
    for (index, glimpse) in open.iter().enumerate().filter(|(_, g)| asks(g)) {
        let own = reaches[index];
        let reach = (own + widest).map(|reach| reach.min(NEAR_PX));
        let near = grid.near(places[index], (reach.x, reach.y));
        let near = near.filter(|other| {
            let (off, both) = (open[*other].seen - glimpse.seen, own + reaches[*other]);
            off.x.abs() <= both.x.min(NEAR_PX) && off.y.abs() <= both.y.min(NEAR_PX)
        });
        // Two that both ask meet once.
        let near = near.filter(|other| *other > index || !asks(open[*other]));
        for other in near
            .filter(|other| *other != index)
            .map(|other| open[other])
        {
            let (elder, younger) = if glimpse.slot < other.slot {
                (*glimpse, other)
            } else {
                (other, *glimpse)
            };
            let one_seen = seen[elder.slot] || seen[younger.slot];
            if one_seen && fires[elder.slot].class == fires[younger.slot].class {
                pairs.push((elder, younger));
            }
        }
    }
    pairs
}

/// Squared Mahalanobis distance between where two fires should be seen: what both were seen through
/// cancels there. Two boxes on one wide fire need not have the same base.
fn distance(a: &Glimpse, b: &Glimpse, fires: &[Fire]) -> f64 {
    let extent_px = extent_px(a, fires).max(extent_px(b, fires));
    let mut spread = a.spread + b.spread;
    for axis in 0..2 {
        spread[(axis, axis)] += 0.25 * extent_px * extent_px;
    }
    let off = a.seen - b.seen;
    spread
        .cholesky()
        .map_or(f64::INFINITY, |spread| off.dot(&spread.solve(&off)))
}

/// Beyond the reaches of both, two are further apart than [`GATE`] allows: columns, rows.
fn reach_px(glimpse: &Glimpse, fires: &[Fire]) -> Vector2<f64> {
    let extent_px = 0.5 * extent_px(glimpse, fires);
    let variances = Vector2::new(glimpse.spread[(0, 0)], glimpse.spread[(1, 1)]);
    variances.map(|variance| (GATE * (variance + extent_px * extent_px)).sqrt())
}

fn extent_px(glimpse: &Glimpse, fires: &[Fire]) -> f64 {
    glimpse.px_per_m * extent_m(&fires[glimpse.slot])
}

fn extent_m(fire: &Fire) -> f64 {
    fire.size_m.map_or(0.0, |size| size.width)
}
