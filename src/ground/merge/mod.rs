//! Which alarms are one fire: a pure function of their places, their errors and what operators say.
//!
//! **In:** [`Sighting`]s of one neighbourhood, each the newest revision of one alarm; [`Pins`].
//! **Out:** a partition of them. Pure: no I/O, no clock; the order of the input changes nothing.
//!
//! Two alarms of different aircraft may be one fire when the Mahalanobis distance of their places is
//! within the gate; two of one aircraft never are, since it keeps them apart itself. A group forms
//! only when every pair in it may be one fire (complete linkage: no chains), nearest pairs first.
//! - **Hysteresis:** who is together stays until the distance exceeds the wider gate, and against
//!   a rival that is nearer by less than [`LOYALTY`].
//! - **Doubt:** when two alarms of one aircraft fit about equally well, none is joined: two marks
//!   for one fire are a nuisance, one mark for two fires hides one.
//! - An operator's word overrides all of this.

pub(crate) mod fuse;
#[cfg(test)]
mod tests;

use emberfix_frames::{Matrix3, SignedDuration, enu_offset};
use fuse::{Estimate, aged};
use std::collections::BTreeMap;

/// Chi-square with 3 degrees of freedom at 0.99: farther apart, two alarms are not joined.
pub(crate) const JOIN: f64 = 11.345;
/// The same at 0.9999: farther apart, two that were joined are taken apart.
pub(crate) const LEAVE: f64 = 21.108;
/// By how much of squared distance a rival has to be nearer to break up a pair.
const LOYALTY: f64 = 9.0;
/// By how much of squared distance the best candidate has to be nearer than the next: a likelihood
/// ratio of `e`.
const CLEARLY: f64 = 2.0;
/// Farther apart in time, two sightings are two fires unless they are together already: a fire at
/// the same place the next day is a new one.
const MAX_GAP: SignedDuration = SignedDuration::from_hours(6);

/// The newest revision of one alarm, as far as merging needs it.
#[derive(Debug, Clone)]
pub(crate) struct Sighting<'a> {
    /// Alarm id.
    pub alarm: &'a str,
    /// Aircraft.
    pub uav: &'a str,
    /// Where and how sure.
    pub estimate: Estimate,
    /// Width of the fire, metres: views from two sides see two rims of it.
    pub width_m: f64,
    /// The incident that has it now.
    pub home: &'a str,
}

/// What operators said of pairs of alarms; the latest word on a pair counts.
#[derive(Debug, Clone, Default)]
pub(crate) struct Pins {
    of_pair: BTreeMap<(String, String), Vec<Pin>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Pin {
    action: i64,
    together: bool,
}

impl Pins {
    /// An operator's action says that two alarms are one fire, or two.
    pub fn set(&mut self, one: &str, other: &str, action: i64, together: bool) {
        let pins = self.of_pair.entry(pair(one, other)).or_default();
        pins.retain(|pin| pin.action != action);
        pins.push(Pin { action, together });
        pins.sort_by_key(|pin| pin.action);
    }

    /// Takes an action back.
    pub fn undo(&mut self, action: i64) {
        self.of_pair.retain(|_, pins| {
            pins.retain(|pin| pin.action != action);
            !pins.is_empty()
        });
    }

    /// What was said last: one fire, two, or nothing.
    pub fn say(&self, one: &str, other: &str) -> Option<bool> {
        let pins = self.of_pair.get(&pair(one, other))?;
        pins.last().map(|pin| pin.together)
    }

    /// Alarms that an operator put together with this one.
    pub fn partners<'a>(&'a self, alarm: &'a str) -> impl Iterator<Item = &'a str> {
        self.of_pair.iter().filter_map(move |((one, other), pins)| {
            let partner = match alarm {
                _ if alarm == one => other,
                _ if alarm == other => one,
                _ => return None,
            };
            pins.last()?.together.then_some(partner.as_str())
        })
    }
}

fn pair(one: &str, other: &str) -> (String, String) {
    let (first, second) = if one <= other {
        (one, other)
    } else {
        (other, one)
    };
    (first.to_owned(), second.to_owned())
}

/// Squared Mahalanobis distance of two places. Their errors are taken as independent: what they
/// share only makes the true distance smaller.
pub(crate) fn distance2(one: &Sighting<'_>, other: &Sighting<'_>) -> f64 {
    let newest = one.estimate.at.max(other.estimate.at);
    let offset = enu_offset(&one.estimate.place, &other.estimate.place);
    let doubt = aged(&one.estimate, newest) + aged(&other.estimate, newest) + rims(one, other);
    doubt
        .try_inverse()
        .map_or(f64::INFINITY, |inverse| offset.dot(&(inverse * offset)))
}

/// Whether two places are near enough that their gate is worth a look: no axis of an error is longer
/// than all of them together. Cheap, and never wrong in saying no.
pub(crate) fn may_reach(one: &Sighting<'_>, other: &Sighting<'_>, apart_m: f64) -> bool {
    let newest = one.estimate.at.max(other.estimate.at);
    let doubt = aged(&one.estimate, newest) + aged(&other.estimate, newest) + rims(one, other);
    apart_m * apart_m <= LEAVE * doubt.trace()
}

/// Variance of which rim of a wide fire was seen: uniform over each width, in the plane.
fn rims(one: &Sighting<'_>, other: &Sighting<'_>) -> Matrix3<f64> {
    let variance = (one.width_m * one.width_m + other.width_m * other.width_m) / 12.0;
    Matrix3::from_diagonal(&emberfix_frames::Vector3::new(variance, variance, 0.0))
}

/// Two alarms that may be one fire.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    one: usize,
    other: usize,
    /// Squared distance, less the loyalty of those who are together.
    cost: f64,
    together: bool,
}

/// Which of the sightings are one fire: groups of their indices, each in the order of alarm ids.
pub(crate) fn partition(sightings: &[Sighting<'_>], pins: &Pins) -> Vec<Vec<usize>> {
    let mut order: Vec<usize> = (0..sightings.len()).collect();
    order.sort_by_key(|index| sightings[*index].alarm);
    let sorted: Vec<&Sighting<'_>> = order.iter().map(|index| &sightings[*index]).collect();
    let mut grouping = Grouping::new(&sorted, pins);
    grouping.obey_operators();
    while grouping.join_next() {}
    grouping
        .groups()
        .into_iter()
        .map(|group| group.into_iter().map(|member| order[member]).collect())
        .collect()
}

struct Grouping<'a> {
    sightings: &'a [&'a Sighting<'a>],
    pins: &'a Pins,
    /// May this pair be one fire, and at what cost; row-major.
    cost: Vec<Option<f64>>,
    candidates: Vec<Candidate>,
    /// Group of each sighting.
    group: Vec<usize>,
}

impl<'a> Grouping<'a> {
    fn new(sightings: &'a [&'a Sighting<'a>], pins: &'a Pins) -> Self {
        let count = sightings.len();
        let mut cost = vec![None; count * count];
        let mut candidates = Vec::new();
        for one in 0..count {
            for other in one + 1..count {
                let Some(found) = cost_of(sightings[one], sightings[other], pins) else {
                    continue;
                };
                cost[one * count + other] = Some(found);
                cost[other * count + one] = Some(found);
                let together = sightings[one].home == sightings[other].home;
                candidates.push(Candidate {
                    one,
                    other,
                    cost: found,
                    together,
                });
            }
        }
        candidates.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        Self {
            sightings,
            pins,
            cost,
            candidates,
            group: (0..count).collect(),
        }
    }

    fn obey_operators(&mut self) {
        for one in 0..self.sightings.len() {
            for other in one + 1..self.sightings.len() {
                if self.said(one, other) == Some(true) {
                    self.join(one, other);
                }
            }
        }
    }

    /// Joins the nearest pair that may be and is beyond doubt; false when there is none.
    fn join_next(&mut self) -> bool {
        let next = self.candidates.iter().find(|candidate| {
            self.group[candidate.one] != self.group[candidate.other]
                && self.may_join(candidate.one, candidate.other)
                && (candidate.together || !self.is_doubtful(candidate))
        });
        let Some(&Candidate { one, other, .. }) = next else {
            return false;
        };
        self.join(one, other);
        true
    }

    fn join(&mut self, one: usize, other: usize) {
        let (stays, goes) = (self.group[one], self.group[other]);
        for group in &mut self.group {
            if *group == goes {
                *group = stays;
            }
        }
    }

    /// Every pair across the two groups may be one fire.
    fn may_join(&self, one: usize, other: usize) -> bool {
        let of = |member: usize| {
            let group = self.group[member];
            (0..self.group.len()).filter(move |index| self.group[*index] == group)
        };
        of(one).all(|a| of(other).all(|b| self.cost_of(a, b).is_some()))
    }

    /// Another alarm of the same aircraft fits one of the two about as well.
    fn is_doubtful(&self, candidate: &Candidate) -> bool {
        let rivals = |of: usize, to: usize| {
            (0..self.sightings.len()).any(|rival| self.is_rival(candidate.cost, of, to, rival))
        };
        rivals(candidate.one, candidate.other) || rivals(candidate.other, candidate.one)
    }

    /// Whether `of` could as well be one fire with `rival`, of the same aircraft as `to`.
    fn is_rival(&self, cost: f64, of: usize, to: usize, rival: usize) -> bool {
        rival != to
            && self.sightings[rival].uav == self.sightings[to].uav
            && self.group[rival] != self.group[of]
            && self.cost_of(of, rival).is_some_and(|other| {
                other < cost + CLEARLY
                    && !self.is_better_placed(cost + CLEARLY - other, to, of, rival)
            })
            && self.may_join(of, rival)
    }

    /// Whether the rival has another alarm to go with, so that both pairs together are clearly
    /// better than the two pairs crossed: better by more than what the rival is ahead.
    fn is_better_placed(&self, ahead: f64, to: usize, of: usize, rival: usize) -> bool {
        (0..self.sightings.len()).any(|partner| {
            partner != of
                && self.sightings[partner].uav == self.sightings[of].uav
                && self.cost_of(rival, partner).is_some_and(|straight| {
                    straight + ahead <= self.cost_of(to, partner).unwrap_or(JOIN)
                })
        })
    }

    fn cost_of(&self, one: usize, other: usize) -> Option<f64> {
        self.cost[one * self.sightings.len() + other]
    }

    fn said(&self, one: usize, other: usize) -> Option<bool> {
        let (one, other) = (self.sightings[one].alarm, self.sightings[other].alarm);
        self.pins.say(one, other)
    }

    fn groups(&self) -> Vec<Vec<usize>> {
        let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (member, group) in self.group.iter().enumerate() {
            groups.entry(*group).or_default().push(member);
        }
        groups.into_values().collect()
    }
}

/// What it costs to call two alarms one fire; `None` when they can't be.
fn cost_of(one: &Sighting<'_>, other: &Sighting<'_>, pins: &Pins) -> Option<f64> {
    match pins.say(one.alarm, other.alarm) {
        Some(true) => return Some(-LOYALTY),
        Some(false) => return None,
        None if one.uav == other.uav => return None,
        None => {}
    }
    let together = one.home == other.home;
    let gap = (one.estimate.at - other.estimate.at).abs();
    if !together && gap > MAX_GAP {
        return None;
    }
    let (limit, loyalty) = if together {
        (LEAVE, LOYALTY)
    } else {
        (JOIN, 0.0)
    };
    let distance2 = distance2(one, other);
    (distance2 <= limit).then_some(distance2 - loyalty)
}
