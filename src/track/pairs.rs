//! Two fires or one: evidence for pairs that lie within each other's error.

use super::Fire;
use super::block::ByState;
use super::common::Common;
use super::glimpse::Glimpse;
use crate::alarm::{FireId, FireState};
use emberfix_frames::ServiceTime;
use nalgebra::SMatrix;
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
        seen: &BTreeSet<usize>,
        common: &Common,
        now: ServiceTime,
    ) -> Vec<(usize, usize)> {
        let mut ones = Vec::new();
        for (a, b) in near_pairs(fires, glimpses, seen) {
            let both = seen.contains(&a) && seen.contains(&b);
            if !both && distance(&fires[a], &fires[b], common) > GATE {
                continue;
            }
            let odds = self.note(fires[a].id, fires[b].id, both, now);
            if odds >= IS_ONE {
                ones.push((a, b));
            }
        }
        ones
    }

    /// Forgets the pairs of fires that are no more.
    pub fn keep_only(&mut self, fires: &[Fire]) {
        let ids: BTreeSet<FireId> = fires.iter().map(|fire| fire.id).collect();
        self.log_odds
            .retain(|(a, b), _| ids.contains(a) && ids.contains(b));
    }

    fn note(&mut self, a: FireId, b: FireId, both: bool, now: ServiceTime) -> f64 {
        let old = self.log_odds.get(&(a, b)).copied();
        let since_s = old.map_or(LOOK_S, |old| (now - old.last_look).as_secs_f64());
        let share = (since_s / LOOK_S).clamp(0.0, 1.0);
        let told = if both { BOTH_SEEN } else { ONE_SEEN };
        let for_one = old.map_or(0.0, |old| old.for_one) + told * share;
        let odds = Odds {
            for_one,
            last_look: now,
        };
        self.log_odds.insert((a, b), odds);
        for_one
    }
}

/// Pairs (elder, younger) close in the image of which at least one was seen: those of which one was
/// missed, and those with a young one, of which it is not settled yet whom it stands beside.
fn near_pairs(fires: &[Fire], glimpses: &[Glimpse], seen: &BTreeSet<usize>) -> Vec<(usize, usize)> {
    let open: Vec<&Glimpse> = glimpses
        .iter()
        .filter(|glimpse| fires[glimpse.slot].state != FireState::Out)
        .collect();
    let asks = |glimpse: &Glimpse| {
        !seen.contains(&glimpse.slot) || fires[glimpse.slot].evidence.hits() < SETTLED_LOOKS
    };
    let mut by_column = open.clone();
    by_column.sort_by(|a, b| a.seen.x.total_cmp(&b.seen.x));
    let mut pairs = BTreeSet::new();
    for glimpse in open.iter().filter(|glimpse| asks(glimpse)) {
        let from = by_column.partition_point(|other| other.seen.x < glimpse.seen.x - NEAR_PX);
        let near = by_column[from..]
            .iter()
            .take_while(|other| other.seen.x <= glimpse.seen.x + NEAR_PX)
            .filter(|other| (other.seen.y - glimpse.seen.y).abs() <= NEAR_PX);
        for other in near.filter(|other| other.slot != glimpse.slot) {
            let (a, b) = (glimpse.slot, other.slot);
            let one_seen = seen.contains(&a) || seen.contains(&b);
            if one_seen && fires[a].class == fires[b].class {
                pairs.insert((a.min(b), a.max(b)));
            }
        }
    }
    pairs.into_iter().collect()
}

/// Squared Mahalanobis distance, horizontal, between two fires. They have the common errors in
/// common, and their own extent: two boxes on one wide fire need not have the same base.
fn distance(a: &Fire, b: &Fire, common: &Common) -> f64 {
    let [slope_a, slope_b] = [a, b].map(|fire| {
        let estimate = &fire.estimate;
        estimate.block().chart().position_by_state(estimate.state())
    });
    let by =
        |fire: &Fire, slope: &ByState| slope.fixed_rows::<2>(0) * fire.estimate.block().by_common();
    let own = |fire: &Fire, slope: &ByState| {
        slope.fixed_rows::<2>(0)
            * fire.estimate.block().own()
            * slope.fixed_rows::<2>(0).transpose()
    };
    let apart = by(a, &slope_a) - by(b, &slope_b);
    let mut with_common = SMatrix::<f64, 2, { super::COMMON }>::zeros();
    with_common.gemm(1.0, &apart, common.covariance(), 0.0);
    let extent_m = extent_m(a).max(extent_m(b));
    let extent = nalgebra::Matrix2::identity() * (0.25 * extent_m * extent_m);
    let spread = with_common * apart.transpose() + own(a, &slope_a) + own(b, &slope_b) + extent;
    let off = (a.estimate.position_m() - b.estimate.position_m()).xy();
    spread
        .cholesky()
        .map_or(f64::INFINITY, |spread| off.dot(&spread.solve(&off)))
}

fn extent_m(fire: &Fire) -> f64 {
    fire.size_m.map_or(0.0, |size| size.width)
}
