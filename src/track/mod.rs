//! Fixes to fires: predict, gate, associate, update, initiate, delete.
//!
//! **In:** the sightings of one frame, the [`View`] that saw them, the terrain. **Out:** [`Fire`]s in
//! the plane at the mission datum, each with the covariance of all of its error. Pure: no I/O, no
//! clock.
//!
//! **Estimation.** Bearing, disparity and terrain are fused always and switched never. GNSS offset,
//! heading, tilt and boresight, disparity offset and clock offset are states that all fires share
//! ([`Joint`]): what the sightings say about them is learned, what they can't say (a GNSS
//! offset without a landmark) stays in every ellipse, and nothing averages out as if it were noise.
//! The terrain's own error is a state of each fire, so that looking twice at the same ground does
//! not make it better known.
//!
//! **Known limits.** A fire is a point with a size, not an area. The cost of a sighting is quadratic
//! in the fires that are kept, so at most [`MAX_FIRES`] are.

mod advice;
mod estimate;
mod joint;
mod life;

pub use advice::{ADVISED, Advice, LookQuality, Outlook, advise};
pub use estimate::Estimate;
pub use joint::{Joint, MAX_FIRES};
pub use life::Evidence;

use crate::alarm::{AlarmClass, FireId, FireState, Method, SizeM};
use crate::locate::{Fix, Sighting, Terrain, View, fix};
use emberfix_frames::{Coordinate, Covariance, Metres, MissionEnu, ServiceTime, Vector3};
use std::collections::BTreeSet;

/// A sighting and what it is said to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Classified {
    /// Where in the image.
    pub sighting: Sighting,
    /// What.
    pub class: AlarmClass,
    /// Detector score, 0..1.
    pub score: f64,
}

/// Settings of the tracker, from the mission.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackConfig {
    /// Sightings before a fire is confirmed.
    pub confirm_sightings: u32,
    /// Seconds that those sightings span at least.
    pub confirm_span_s: f64,
    /// Seconds after which GNSS error has become another one.
    pub gnss_correlation_s: f64,
    /// Seconds after which heading error has become another one.
    pub heading_correlation_s: f64,
    /// Seconds after which boresight, disparity and clock errors have become other ones.
    pub mount_correlation_s: f64,
    /// Seconds without a sighting after which a suspected fire is forgotten.
    pub forget_suspected_s: f64,
}

impl Default for TrackConfig {
    fn default() -> Self {
        Self {
            confirm_sightings: 8,
            confirm_span_s: 1.0,
            gnss_correlation_s: 100.0,
            heading_correlation_s: 300.0,
            mount_correlation_s: 1800.0,
            forget_suspected_s: 20.0,
        }
    }
}

/// One fire over time.
#[derive(Debug, Clone)]
pub struct Fire {
    /// Its number.
    pub id: FireId,
    /// Flame, or smoke without one.
    pub class: AlarmClass,
    /// Where in its life it is.
    pub state: FireState,
    /// Position and error.
    pub estimate: Estimate,
    /// For and against its being real.
    pub evidence: Evidence,
    /// Mid-exposure of the first sighting.
    pub first_seen: ServiceTime,
    /// Mid-exposure of the latest sighting.
    pub last_seen: ServiceTime,
    /// Straight line from the left camera at the latest sighting, metres.
    pub range_m: f64,
    /// Extent, smoothed over sightings.
    pub size_m: Option<SizeM>,
    /// How its light changes from look to look.
    pub flicker: crate::assess::Flicker,
    /// Number of the fire that this one turned out to be, if it did.
    pub merged_into: Option<FireId>,
    furthest_m: f64,
    beside: BTreeSet<FireId>,
}

impl Fire {
    /// Base of the fire in the plane at the mission datum.
    #[must_use]
    pub fn position(&self) -> Coordinate<MissionEnu> {
        Coordinate::from_metres(self.estimate.position_m())
    }

    /// All of its error.
    #[must_use]
    pub fn covariance(&self) -> Covariance<MissionEnu> {
        self.estimate.covariance()
    }

    /// True once it has been confirmed.
    #[must_use]
    pub fn is_confirmed(&self) -> bool {
        !matches!(self.state, FireState::Suspected)
    }

    /// What its position rests on, sorted.
    #[must_use]
    pub fn methods(&self) -> Vec<Method> {
        self.estimate.methods()
    }
}

/// What became of one sighting.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Index in the frame's sightings.
    pub index: usize,
    /// The fire that it was given to, if any.
    pub fire: Option<FireId>,
    /// Its own position, if it has one.
    pub fix: Option<Fix>,
}

/// All fires of a mission.
#[derive(Debug)]
pub struct Tracker {
    config: TrackConfig,
    fires: Vec<Fire>,
    next: FireId,
    joint: Joint,
    last_step: Option<ServiceTime>,
}

/// Chi-square 99.9 % for three degrees of freedom: bearing and disparity. A fire is sighted
/// hundreds of times; at 99 % each orbit would throw some of its own sightings away.
const GATE: f64 = 16.27;
/// Chi-square 99 % for two: below it, two fires that were never seen side by side are one.
const MERGE_GATE: f64 = 9.21;
/// Room that is kept for the next frame's new fires.
const ROOM: usize = 32;
/// A fire counts as missed from up to this many times the range that it was seen from.
const MISS_REACH: f64 = 1.1;
/// Smoke this close to a fire's pixel, in its own sizes, is that fire's smoke.
const SMOKE_REACH: f64 = 0.6;

impl Tracker {
    /// No fires yet; the first one gets number `first`.
    #[must_use]
    pub fn new(config: TrackConfig, first: FireId) -> Self {
        Self {
            config,
            fires: Vec::new(),
            next: first,
            joint: Joint::default(),
            last_step: None,
        }
    }

    /// All fires, in order of their numbers.
    #[must_use]
    pub fn fires(&self) -> &[Fire] {
        &self.fires
    }

    /// Everything that is estimated: shared errors and fires, in the order of [`Tracker::fires`].
    #[must_use]
    pub fn joint(&self) -> &Joint {
        &self.joint
    }

    /// Takes one frame in. Sightings come back with the fire that they were given to.
    pub fn step(
        &mut self,
        view: &View<'_>,
        sightings: &[Classified],
        terrain: Option<&dyn Terrain>,
    ) -> Vec<Outcome> {
        self.age(view.pose.at);
        let assigned = self.associate(view, sightings);
        let mut outcomes = Vec::with_capacity(sightings.len());
        for (index, classified) in sightings.iter().enumerate() {
            let own = fix(&classified.sighting, view, terrain);
            let fire = match assigned[index] {
                Some(slot) => Some(self.update(slot, classified, view, terrain)),
                None if self.explained(view, sightings, index, &assigned) => None,
                None => own
                    .as_ref()
                    .and_then(|own| self.initiate(classified, own, view, terrain)),
            };
            outcomes.push(Outcome {
                index,
                fire,
                fix: own,
            });
        }
        self.read_off();
        self.note_side_by_side(&outcomes);
        self.note_misses(view, &outcomes);
        self.merge();
        self.forget(view.pose.at);
        outcomes
    }

    /// Lets time pass since the last frame.
    fn age(&mut self, now: ServiceTime) {
        let dt_s = self
            .last_step
            .map_or(0.0, |last| (now - last).as_secs_f64());
        self.last_step = Some(now);
        self.joint.age(dt_s, &self.config);
        self.read_off();
    }

    /// Every fire follows what was learned of the shared errors.
    fn read_off(&mut self) {
        for (slot, fire) in self.fires.iter_mut().enumerate() {
            fire.estimate.read_off(&self.joint, slot);
        }
    }

    /// Nearest fire in the Mahalanobis sense for each sighting, each fire at most once.
    fn associate(&self, view: &View<'_>, sightings: &[Classified]) -> Vec<Option<usize>> {
        let mut pairs = Vec::new();
        for (index, classified) in sightings.iter().enumerate() {
            for (slot, fire) in self.fires.iter().enumerate() {
                if fire.class != classified.class || fire.merged_into.is_some() {
                    continue;
                }
                if let Some(distance) =
                    fire.estimate
                        .distance(&classified.sighting, view, &self.joint, slot)
                    && distance < GATE
                {
                    pairs.push((distance, index, slot));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut assigned = vec![None; sightings.len()];
        let mut taken = BTreeSet::new();
        for (_, index, slot) in pairs {
            if assigned[index].is_none() && taken.insert(slot) {
                assigned[index] = Some(slot);
            }
        }
        assigned
    }

    /// A sighting that another one of the frame, or a fire, already explains.
    fn explained(
        &self,
        view: &View<'_>,
        sightings: &[Classified],
        index: usize,
        assigned: &[Option<usize>],
    ) -> bool {
        let this = &sightings[index];
        let nested = |other: usize| {
            other != index
                && sightings[other].class == this.class
                && (assigned[other].is_some() || other < index)
                && contains(&sightings[other].sighting, &this.sighting)
        };
        (0..sightings.len()).any(nested)
            || (this.class == AlarmClass::Smoke && self.is_smoke_of_a_fire(view, sightings, this))
    }

    fn is_smoke_of_a_fire(
        &self,
        view: &View<'_>,
        sightings: &[Classified],
        smoke: &Classified,
    ) -> bool {
        let seen = sightings
            .iter()
            .filter(|other| other.class == AlarmClass::Fire)
            .map(|other| (other.sighting.base.u, other.sighting.base.v));
        let known = self
            .fires
            .iter()
            .filter(|fire| fire.class == AlarmClass::Fire && fire.state != FireState::Out)
            .filter_map(|fire| view.predict(&fire.estimate.position_m()))
            .map(|predicted| (predicted.pixel.u, predicted.pixel.v));
        seen.chain(known)
            .any(|(u, v)| is_near_box(&smoke.sighting, u, v))
    }

    fn update(
        &mut self,
        slot: usize,
        classified: &Classified,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
    ) -> FireId {
        let fire = &mut self.fires[slot];
        fire.estimate.read_off(&self.joint, slot);
        fire.estimate
            .update(&classified.sighting, view, terrain, &mut self.joint, slot);
        fire.evidence.hit(classified.score);
        fire.last_seen = classified.sighting.at;
        note_extent(fire, &classified.sighting, view);
        let span_s = (fire.last_seen - fire.first_seen).as_secs_f64();
        let enough = fire.evidence.hits() >= self.config.confirm_sightings
            && span_s >= self.config.confirm_span_s;
        match fire.state {
            FireState::Suspected
                if enough
                    && fire.evidence.is_convincing()
                    && !fire.flicker.may_be_lamp(fire.size_m, fire.evidence.hits()) =>
            {
                fire.state = FireState::Confirmed;
            }
            FireState::Out if fire.evidence.is_convincing() => fire.state = FireState::Confirmed,
            _ => {}
        }
        fire.id
    }

    fn initiate(
        &mut self,
        classified: &Classified,
        own: &Fix,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
    ) -> Option<FireId> {
        if self.fires.len() >= MAX_FIRES {
            return None;
        }
        let (joint, slot) = (&mut self.joint, self.fires.len());
        let sighting = &classified.sighting;
        let mut estimate = Estimate::start(sighting, own, view, terrain, joint, slot)?;
        estimate.refine(sighting, view, terrain, joint, slot);
        let id = self.next;
        self.next = FireId(id.0.saturating_add(1));
        let mut fire = Fire {
            id,
            class: classified.class,
            state: FireState::Suspected,
            estimate,
            evidence: Evidence::default(),
            first_seen: classified.sighting.at,
            last_seen: classified.sighting.at,
            range_m: own.range_m,
            size_m: None,
            flicker: crate::assess::Flicker::default(),
            merged_into: None,
            furthest_m: own.range_m,
            beside: BTreeSet::new(),
        };
        fire.evidence.hit(classified.score);
        note_extent(&mut fire, &classified.sighting, view);
        self.fires.push(fire);
        Some(id)
    }

    fn note_side_by_side(&mut self, outcomes: &[Outcome]) {
        let seen: BTreeSet<FireId> = outcomes.iter().filter_map(|outcome| outcome.fire).collect();
        if seen.len() < 2 {
            return;
        }
        for fire in self.fires.iter_mut().filter(|fire| seen.contains(&fire.id)) {
            fire.beside.extend(seen.iter().filter(|id| **id != fire.id));
        }
    }

    fn note_misses(&mut self, view: &View<'_>, outcomes: &[Outcome]) {
        let seen: BTreeSet<FireId> = outcomes.iter().filter_map(|outcome| outcome.fire).collect();
        for fire in self
            .fires
            .iter_mut()
            .filter(|fire| !seen.contains(&fire.id))
        {
            if should_be_seen(fire, view) {
                fire.evidence.miss();
                if fire.is_confirmed() && fire.evidence.is_refuted() {
                    fire.state = FireState::Out;
                }
            }
        }
    }

    /// Joins fires that were never seen side by side and whose difference is within its own error.
    fn merge(&mut self) {
        for younger in (1..self.fires.len()).rev() {
            let elder = (0..younger).find(|elder| self.are_one(*elder, younger));
            if let Some(elder) = elder {
                let into = self.fires[elder].id;
                self.fires[younger].merged_into = Some(into);
                self.fires[younger].state = FireState::Out;
            }
        }
    }

    fn are_one(&self, elder: usize, younger: usize) -> bool {
        let (a, b) = (&self.fires[elder], &self.fires[younger]);
        let open = |fire: &Fire| fire.merged_into.is_none() && fire.state != FireState::Out;
        a.class == b.class
            && open(a)
            && open(b)
            && !a.beside.contains(&b.id)
            && self.distance_between(elder, younger) < MERGE_GATE
    }

    /// Squared Mahalanobis distance, horizontal, between two fires. They have the shared errors in
    /// common, and their own extent: two boxes on one wide fire need not have the same base.
    fn distance_between(&self, a: usize, b: usize) -> f64 {
        let joint = &self.joint;
        let common = joint.between(a, b);
        let spread = joint.between(a, a) + joint.between(b, b) - common - common.transpose();
        let extent_m = extent_m(&self.fires[a]).max(extent_m(&self.fires[b]));
        let extent = nalgebra::Matrix2::identity() * (0.25 * extent_m * extent_m);
        let spread = spread.fixed_view::<2, 2>(0, 0) + extent;
        let apart = (joint.fire(a) - joint.fire(b))
            .fixed_rows::<2>(0)
            .into_owned();
        spread
            .cholesky()
            .map_or(f64::INFINITY, |spread| apart.dot(&spread.solve(&apart)))
    }

    fn forget(&mut self, now: ServiceTime) {
        let limit_s = self.config.forget_suspected_s;
        let merged_early =
            |fire: &Fire| fire.merged_into.is_some() && !fire.evidence.was_convincing();
        let over = |fire: &Fire| {
            let age_s = (now - fire.last_seen).as_secs_f64();
            fire.state == FireState::Suspected && (age_s > limit_s || fire.evidence.is_refuted())
        };
        for slot in (0..self.fires.len()).rev() {
            let fire = &self.fires[slot];
            if over(fire) || merged_early(fire) {
                self.remove(slot);
            }
        }
        while self.fires.len() > MAX_FIRES - ROOM && self.forget_weakest().is_some() {}
    }

    /// Makes room: the suspected fire with the least evidence goes. `None` when all are confirmed.
    fn forget_weakest(&mut self) -> Option<()> {
        let suspected = self
            .fires
            .iter()
            .enumerate()
            .filter(|(_, fire)| !fire.is_confirmed());
        let probability = |fire: &Fire| fire.evidence.probability();
        let weakest = suspected.min_by(|a, b| probability(a.1).total_cmp(&probability(b.1)));
        let slot = weakest.map(|(slot, _)| slot)?;
        self.remove(slot);
        Some(())
    }

    fn remove(&mut self, slot: usize) {
        self.fires.remove(slot);
        self.joint.remove(slot);
    }
}

fn extent_m(fire: &Fire) -> f64 {
    fire.size_m.map_or(0.0, |size| size.width)
}

fn note_extent(fire: &mut Fire, sighting: &Sighting, view: &View<'_>) {
    let position: Vector3<f64> = fire.estimate.position_m();
    fire.range_m = (position - view.camera_enu).norm();
    fire.furthest_m = fire.furthest_m.max(fire.range_m);
    if let Some(glow) = sighting.glow {
        fire.flicker.add(sighting.at, glow, fire.range_m);
    }
    if let Some(now) = crate::assess::size(sighting, view, &position) {
        fire.size_m = Some(crate::assess::smoothed_size(fire.size_m, now));
    }
}

/// In the image with a margin, and hardly further than it has been seen from.
fn should_be_seen(fire: &Fire, view: &View<'_>) -> bool {
    let position = fire.estimate.position_m();
    let Some(predicted) = view.predict(&position) else {
        return false;
    };
    let (width, height) = view.rig.camera(emberfix_calib::Eye::Left).image_size_px;
    let inside = |value: f64, size: u32| {
        let margin = 0.08 * f64::from(size);
        (margin..f64::from(size) - margin).contains(&value)
    };
    inside(predicted.pixel.u, width)
        && inside(predicted.pixel.v, height)
        && (position - view.camera_enu).norm() <= MISS_REACH * fire.furthest_m
}

/// True when `outer` holds most of `inner`.
fn contains(outer: &Sighting, inner: &Sighting) -> bool {
    let overlap = |a: f64, a_len: f64, b: f64, b_len: f64| {
        ((a + a_len / 2.0).min(b + b_len / 2.0) - (a - a_len / 2.0).max(b - b_len / 2.0)).max(0.0)
    };
    let middle = |s: &Sighting| s.base.v - s.size_px.1 / 2.0;
    let shared = overlap(outer.base.u, outer.size_px.0, inner.base.u, inner.size_px.0)
        * overlap(
            middle(outer),
            outer.size_px.1,
            middle(inner),
            inner.size_px.1,
        );
    shared > 0.5 * inner.size_px.0 * inner.size_px.1
}

fn is_near_box(sighting: &Sighting, u: f64, v: f64) -> bool {
    let (width, height) = sighting.size_px;
    let middle = sighting.base.v - height / 2.0;
    (u - sighting.base.u).abs() < (0.5 + SMOKE_REACH) * width + 20.0
        && (v - middle).abs() < (0.5 + SMOKE_REACH) * height + 20.0
}

#[cfg(test)]
mod tests;
