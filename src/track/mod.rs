//! Fixes to fires: predict, gate, associate, update, initiate, delete.
//!
//! **In:** the sightings of one frame, the [`View`] that saw them, the terrain. **Out:** [`Fire`]s in
//! the plane at the mission datum, each with the covariance of all of its error; the shared errors
//! as far as they are known ([`SharedErrors`]). Pure: no I/O, no clock.
//!
//! **Estimation.** Bearing, disparity and terrain are fused always and switched never. GNSS offset,
//! heading, tilt and boresight, lever arm, disparity offset and clock offset are states that are
//! estimated with each fire ([`Joint`]): what the sightings say about them is learned, what they can't
//! say (a GNSS offset without a landmark, a clock error on a steady orbit) stays in every ellipse, and
//! nothing averages out as if it were noise. The latest looks at each fire are kept and solved again
//! (`window`), all of them linearised where the fire is believed to be now. The terrain's own error
//! is a number of each fire, so that looking twice at the same ground does not make it better known.
//!
//! **What fires share.** A fire begins with what the best known fire had learned of the shared errors up
//! to that moment ([`Known`]), and learns on by its own sightings alone. So nothing is counted twice:
//! fires that are seen in the same frames see through the same errors, and a hundred of them
//! are no hundred witnesses. What they would teach each other while both are seen is given up for
//! that; in return each ellipse is exact for its own sightings, and the cost is linear in the fires.
//!
//! **Association.** Sightings and fires are matched in the image, all at once at the least total cost
//! ([`assign`]); each fire knows the errors of the moment, so what both were seen through does not
//! blur two fires side by side. A sighting that strays from a fire which is not seen otherwise is
//! given to it with as much more noise as it strays.
//!
//! **Known limits.** A fire is a point with a size; its area is [`crate::assess`]'s.
//! **Bound.** [`MAX_FIRES`] are kept; beyond, the suspected one with the least evidence goes.

mod advice;
mod assign;
mod boxes;
mod chart;
mod estimate;
pub mod event;
mod glimpse;
mod grid;
mod ground;
mod joint;
mod life;
mod look;
mod odometer;
mod pairs;
mod shared_errors;
mod window;

pub use advice::{ADVISED, LookQuality, Outlook, advise};
pub use assign::{Candidate, assign};
pub use chart::Chart;
pub use estimate::Estimate;
pub use joint::{JOINT, Joint, Known, LASTING, Pace, Scatter};
pub use life::Evidence;
pub use shared_errors::{Estimated, SharedErrors};

use crate::alarm::{AlarmClass, FireId, FireState, Method, SizeM};
use crate::assess::patch::Patch;
use crate::locate::{Shared, Sighting, Terrain, View, fix};
use boxes::{Crowd, contains, is_near_box};
use emberfix_calib::RectifiedPixel;
use emberfix_frames::{Coordinate, Covariance, Metres, MissionEnu, ServiceTime, Vector3};
use estimate::Frame;
use glimpse::Glimpse;
use odometer::{Odometer, Reading};
use pairs::Pairs;
use std::sync::Arc;

/// A sighting and what it is said to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Classified {
    /// Where in the image.
    pub sighting: Sighting,
    /// What.
    pub class: AlarmClass,
    /// Detector score, 0..1.
    pub score: f64,
    /// Log-odds by a second look at it, where there was one.
    pub second_look: Option<f64>,
    /// What it looks like, where its picture is at hand.
    pub patch: Option<Patch>,
}

/// Settings of the tracker, from the mission.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackConfig {
    /// Sightings before a fire is confirmed.
    pub confirm_sightings: u32,
    /// Seconds that those sightings span at least.
    pub confirm_span_s: f64,
    /// Seconds without a sighting after which a suspected fire is forgotten.
    pub forget_suspected_s: f64,
}

impl Default for TrackConfig {
    fn default() -> Self {
        Self {
            confirm_sightings: 8,
            confirm_span_s: 1.0,
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
    /// For and against its being there.
    pub evidence: Evidence,
    /// Mid-exposure of the first sighting.
    pub first_seen: ServiceTime,
    /// Mid-exposure of the latest sighting.
    pub last_seen: ServiceTime,
    /// Straight line from the left camera at the latest sighting, metres.
    pub range_m: f64,
    /// What all looks together say of its being real.
    pub event: event::Event,
    /// Extent, smoothed over sightings.
    pub size_m: Option<SizeM>,
    /// How its light changes from look to look.
    pub flicker: crate::assess::Flicker,
    /// Number of the fire that this one turned out to be, if it did.
    pub merged_into: Option<FireId>,
    furthest_m: f64,
    strays: u8,
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

    /// True when its position says where it is, and not only in which direction.
    #[must_use]
    pub fn is_located(&self) -> bool {
        let (major_m, _, _) = self.covariance().horizontal_axes();
        major_m <= (MAX_RELATIVE_SIGMA * self.range_m).max(NEAR_ENOUGH_M)
    }

    fn is_open(&self) -> bool {
        self.merged_into.is_none()
    }
}

/// What became of one sighting.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outcome {
    /// Index in the frame's sightings.
    pub index: usize,
    /// The fire that it was given to, if any.
    pub fire: Option<FireId>,
}

/// All fires of a mission.
#[derive(Debug)]
pub struct Tracker {
    config: TrackConfig,
    fires: Vec<Fire>,
    next: FireId,
    known: Known,
    scatter: Scatter,
    shared: Option<SharedErrors>,
    pairs: Pairs,
    odometer: Option<Odometer>,
}

/// Fires at most.
pub const MAX_FIRES: usize = 16_384;
/// Room that is kept for the next frame's new fires.
const ROOM: usize = 256;
/// Largest horizontal sigma over range at which a fire is told.
const MAX_RELATIVE_SIGMA: f64 = 0.2;
/// Horizontal sigma that is good enough from however near, metres.
const NEAR_ENOUGH_M: f64 = 5.0;
/// A fire is told from this probability of its being one; smoke alone, which fog looks like, from this.
const LIKELY: f64 = 0.7;
const LIKELY_SMOKE: f64 = 0.95;
/// A fire counts as missed from up to this many times the range that it was seen from.
const MISS_REACH: f64 = 1.1;
/// How far the clock error's spread is looked over, in its sigmas and at most, seconds.
const CLOCK_SIGMAS: f64 = 1.75;
const LOOK_AHEAD_S: f64 = 0.6;
/// Looks that are solved again in a frame at most, but for the last fire's.
const SOLVED_LOOKS: usize = 256;
/// Every so many sightings a fire teaches what it has learned, less often where more than about [`TAUGHT`]
/// would in one frame.
const TEACHES: u32 = 4;
const TAUGHT: u32 = 32;
/// Pictures that are compared with those before in a frame, about; of more, each fire's only every so many looks.
const COMPARED: usize = 64;
/// Sightings in a row that may stray from a fire before another one begins there.
const STRAYS: u8 = 8;

impl Tracker {
    /// No fires yet; the first one gets number `first`.
    #[must_use]
    pub fn new(config: TrackConfig, first: FireId) -> Self {
        Self {
            config,
            fires: Vec::new(),
            next: first,
            known: Known::default(),
            scatter: Scatter::default(),
            shared: None,
            pairs: Pairs::default(),
            odometer: None,
        }
    }

    /// All fires, in order of their numbers.
    #[must_use]
    pub fn fires(&self) -> &[Fire] {
        &self.fires
    }

    /// What is known of the errors that all fires share; `None` before the first frame.
    #[must_use]
    pub fn shared_errors(&self) -> Option<&SharedErrors> {
        self.shared.as_ref()
    }

    /// How much more the sightings scatter than their noise was said to be.
    #[must_use]
    pub fn scatter(&self) -> Scatter {
        self.scatter
    }

    /// How far after a shutter the reported pose may have to be known, seconds: where the clock error
    /// may lie, as far as it is known.
    #[must_use]
    pub fn looks_ahead_s(&self) -> f64 {
        let ahead =
            |shared: &SharedErrors| CLOCK_SIGMAS * shared.clock_s.sigma - shared.clock_s.value;
        self.shared
            .as_ref()
            .map_or(0.0, ahead)
            .clamp(0.0, LOOK_AHEAD_S)
    }

    /// Takes one frame in. Sightings come back with the fire that they were given to.
    pub fn step(
        &mut self,
        view: &View<'_>,
        sightings: &[Classified],
        terrain: Option<&dyn Terrain>,
    ) -> Vec<Outcome> {
        let now = view.pose.at;
        let pace = Pace::new(view.priors(), view.sigmas());
        let reading = self.age(view, &pace);
        let known = self.known.clone();
        let clock = Shared::Clock as usize;
        let clock_sigma = known.covariance[(clock, clock)].max(0.0).sqrt();
        let shot = Arc::new(view.shot(known.mean[clock], clock_sigma));
        let frame = Frame {
            view,
            shot: &shot,
            lens: &shot.lens(&known.all(), clock_sigma),
            known: &known,
            reading: &reading,
            pace: &pace,
            scatter: self.scatter,
            terrain,
        };
        let glimpses = glimpse::all(&mut self.fires, &frame);
        let mut matches = glimpse::associate(&glimpses, &self.fires, sightings, &frame);
        self.tolerate(&mut matches);
        let slots = matches.slots;
        for (slot, classified) in slots.iter().zip(sightings) {
            let Some(slot) = slot else { continue };
            let estimate = &mut self.fires[*slot].estimate;
            if let Some(squared) = estimate.take(&classified.sighting, &frame) {
                self.scatter.note(squared);
            }
        }
        let new = self.initiate(&slots, sightings, &frame);
        let mut seen = vec![false; self.fires.len()];
        let both = slots.iter().chain(&new).flatten();
        both.for_each(|slot| seen[*slot] = true);
        self.solve(&seen, &frame);
        self.note_sightings(&slots, &new, sightings, view);
        self.note_misses(&seen, &glimpses, view);
        self.learn(&seen);
        let outcomes = self.outcomes(&slots, &new);
        self.merge(&seen, &glimpses, view);
        self.forget(now);
        self.shared = Some(SharedErrors::read_off(&self.known, view));
        outcomes
    }

    /// Lets time pass since the last frame.
    fn age(&mut self, view: &View<'_>, pace: &Pace) -> Reading {
        let odometer = self.odometer.get_or_insert_with(|| Odometer::new(view));
        let before = odometer.reading();
        let reading = odometer.go_on(view);
        self.known.age(&before, &reading, pace);
        reading
    }

    /// Gives strays to their fires: a few in a row, and no more, lest a fire that is placed wrongly
    /// keeps the true place from being found.
    fn tolerate(&mut self, matches: &mut glimpse::Matches) {
        for slot in matches.slots.iter().flatten() {
            self.fires[*slot].strays = 0;
        }
        for (slot, stray) in matches.slots.iter_mut().zip(&matches.strays) {
            if let Some(stray) = stray {
                let fire = &mut self.fires[*stray];
                fire.strays = fire.strays.saturating_add(1);
                *slot = slot.or((fire.strays <= STRAYS).then_some(*stray));
            }
        }
    }

    /// Solves the fires that need it most, as far as there is time in a frame for it.
    fn solve(&mut self, seen: &[bool], frame: &Frame<'_>) {
        let need = |slot: usize| (self.fires[slot].estimate.need(), slot);
        let mut due: Vec<_> = (0..seen.len())
            .filter(|slot| seen[*slot])
            .map(need)
            .filter(|(need, _)| *need >= 1.0)
            .collect();
        due.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut looks = 0;
        for (_, slot) in due {
            if looks >= SOLVED_LOOKS {
                break;
            }
            let estimate = &mut self.fires[slot].estimate;
            estimate.solve(frame);
            looks += estimate.looks();
        }
    }

    /// What the best known fire has learned of the shared errors is what the next one begins with.
    /// Which is best is told by how sure it is, not by what it says, so the choice bends nothing.
    fn learn(&mut self, seen: &[bool]) {
        let all = seen.iter().filter(|is_seen| **is_seen).count() as u32;
        let every = TEACHES.max(all / TAUGHT);
        let teaches = |fire: &Fire| {
            fire.is_confirmed() && (fire.evidence.hits() + fire.id.0).is_multiple_of(every)
        };
        let taught = self.fires.iter().zip(seen);
        let taught = taught.filter(|(fire, is_seen)| **is_seen && teaches(fire));
        let taught = taught.map(|(fire, _)| fire.estimate.joint().known());
        for known in taught {
            if known.knows_more_than(&self.known) {
                self.known = known;
            }
        }
    }

    /// Sightings that no fire and no other sighting explains begin a fire each.
    fn initiate(
        &mut self,
        slots: &[Option<usize>],
        sightings: &[Classified],
        frame: &Frame<'_>,
    ) -> Vec<Option<usize>> {
        let mut new = vec![None; sightings.len()];
        if slots.iter().all(Option::is_some) {
            return new;
        }
        let crowd = Crowd::of(sightings, frame.view);
        for (index, classified) in sightings.iter().enumerate() {
            let is_free = slots[index].is_none()
                && self.fires.len() < MAX_FIRES
                && !self.is_explained(frame, &crowd, index, slots);
            if let Some(fire) = is_free.then(|| self.begin(classified, frame)).flatten() {
                new[index] = Some(self.fires.len());
                self.fires.push(fire);
            }
        }
        new
    }

    fn begin(&mut self, classified: &Classified, frame: &Frame<'_>) -> Option<Fire> {
        let sighting = &classified.sighting;
        let fix = fix(sighting, frame.view, frame.terrain);
        let estimate = Estimate::begin(sighting, frame, fix.as_ref())?;
        let id = self.next;
        self.next = FireId(id.0.saturating_add(1));
        Some(Fire {
            id,
            class: classified.class,
            state: FireState::Suspected,
            estimate,
            evidence: Evidence::default(),
            event: event::Event::default(),
            first_seen: sighting.at,
            last_seen: sighting.at,
            range_m: 0.0,
            size_m: None,
            flicker: crate::assess::Flicker::default(),
            merged_into: None,
            furthest_m: 0.0,
            strays: 0,
        })
    }

    /// A sighting that another one of the frame, or a fire, already explains.
    fn is_explained(
        &self,
        frame: &Frame<'_>,
        crowd: &Crowd<'_>,
        index: usize,
        slots: &[Option<usize>],
    ) -> bool {
        let sightings = crowd.sightings;
        let this = &sightings[index];
        let nested = |other: usize| {
            other != index
                && sightings[other].class == this.class
                && (slots[other].is_some() || other < index)
                && contains(&sightings[other].sighting, &this.sighting)
        };
        crowd.about(&this.sighting).any(nested)
            || (this.class == AlarmClass::Smoke && self.is_smoke_of_a_fire(frame, sightings, this))
    }

    fn is_smoke_of_a_fire(
        &self,
        frame: &Frame<'_>,
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
            .filter_map(|fire| fire.estimate.predict(frame.lens))
            .map(|predicted| (predicted.pixel.u, predicted.pixel.v));
        seen.chain(known)
            .any(|(u, v)| is_near_box(&smoke.sighting, u, v))
    }

    fn note_sightings(
        &mut self,
        slots: &[Option<usize>],
        new: &[Option<usize>],
        sightings: &[Classified],
        view: &View<'_>,
    ) {
        let in_doubt = self.pairs.in_doubt(&self.fires);
        let pictured = sightings.iter().filter(|one| one.patch.is_some()).count();
        for (index, classified) in sightings.iter().enumerate() {
            if let Some(slot) = slots[index].or(new[index]) {
                let fire = &mut self.fires[slot];
                let azimuth = azimuth(&fire.estimate.position_m(), view);
                let sighting = &classified.sighting;
                fire.evidence.hit(sighting.at, azimuth, classified.score);
                fire.last_seen = sighting.at;
                note_extent(fire, sighting, view);
                fire.event.saw(&event::Look {
                    at: sighting.at,
                    score: classified.score,
                    second_look: classified.second_look,
                    is_smoke: classified.class == AlarmClass::Smoke,
                    patch: classified.patch.as_ref(),
                    is_compared: is_compared(fire.evidence.hits(), fire.id, pictured),
                    glow: sighting.glow,
                    range_m: fire.range_m,
                    area_px2: sighting.size_px.0 * sighting.size_px.1,
                });
                let is_another = !in_doubt.contains(&fire.id);
                advance(fire, &self.config, is_another);
            }
        }
    }

    fn note_misses(&mut self, seen: &[bool], glimpses: &[Glimpse], view: &View<'_>) {
        for glimpse in glimpses.iter().filter(|glimpse| !seen[glimpse.slot]) {
            let fire = &mut self.fires[glimpse.slot];
            if should_be_seen(fire, glimpse, view) {
                let azimuth = azimuth(&fire.estimate.position_m(), view);
                let share = fire.evidence.miss(view.pose.at, azimuth);
                fire.event.missed(share);
                if fire.is_confirmed() && fire.evidence.is_refuted() {
                    fire.state = FireState::Out;
                }
            }
        }
    }

    fn outcomes(&self, slots: &[Option<usize>], new: &[Option<usize>]) -> Vec<Outcome> {
        let id = |slot: usize| self.fires.get(slot).map(|fire| fire.id);
        slots
            .iter()
            .zip(new)
            .enumerate()
            .map(|(index, (slot, new))| Outcome {
                index,
                fire: slot.or(*new).and_then(id),
            })
            .collect()
    }

    /// Joins what looks have shown to be one fire (see [`Pairs`]).
    fn merge(&mut self, seen: &[bool], glimpses: &[Glimpse], view: &View<'_>) {
        let ones = self.pairs.look(&self.fires, glimpses, seen, view);
        for (elder, younger) in ones {
            let into = self.fires[elder].id;
            self.fires[younger].merged_into = Some(into);
            self.fires[younger].state = FireState::Out;
        }
    }

    fn forget(&mut self, now: ServiceTime) {
        let limit_s = self.config.forget_suspected_s;
        let goes = |fire: &Fire| {
            let age_s = (now - fire.last_seen).as_secs_f64();
            let merged_early = !fire.is_open() && !fire.evidence.was_convincing();
            let over = fire.state == FireState::Suspected
                && (age_s > limit_s || fire.evidence.is_refuted());
            merged_early || over
        };
        if self.fires.iter().any(goes) {
            self.fires.retain(|fire| !goes(fire));
            self.pairs.keep_only(&self.fires);
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
        self.fires.remove(slot);
        Some(())
    }
}

/// Suspected to confirmed, and back from out, by what was seen. One that may be another fire, which is
/// told already, waits until both were seen at once, or turn out to be one.
fn advance(fire: &mut Fire, config: &TrackConfig, is_another: bool) {
    let span_s = (fire.last_seen - fire.first_seen).as_secs_f64();
    let enough =
        fire.evidence.hits() >= config.confirm_sightings && span_s >= config.confirm_span_s;
    match fire.state {
        FireState::Suspected
            if enough
                && is_another
                && fire.evidence.is_convincing()
                && fire.is_located()
                && fire.event.probability() >= likely(fire.class)
                && !fire.flicker.may_be_lamp(fire.size_m, fire.evidence.hits()) =>
        {
            fire.state = FireState::Confirmed;
        }
        FireState::Out if fire.evidence.is_convincing() => fire.state = FireState::Confirmed,
        _ => {}
    }
}

/// From which probability it is told.
fn likely(class: AlarmClass) -> f64 {
    match class {
        AlarmClass::Smoke => LIKELY_SMOKE,
        _ => LIKELY,
    }
}

/// Whether a fire's picture is compared in this look, when there are so many pictures.
fn is_compared(looks: u32, fire: FireId, pictured: usize) -> bool {
    let every = pictured.div_ceil(COMPARED).max(1) as u32;
    looks.wrapping_add(fire.0).is_multiple_of(every)
}

/// Azimuth of a point from the camera, radians clockwise from north.
fn azimuth(point: &Vector3<f64>, view: &View<'_>) -> f64 {
    let sight = point - view.camera_enu;
    sight.x.atan2(sight.y)
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

/// In a part of the image that was looked at, with a margin, and hardly further than it has been seen from.
fn should_be_seen(fire: &Fire, glimpse: &Glimpse, view: &View<'_>) -> bool {
    let (width, height) = view.rig.camera(emberfix_calib::Eye::Left).image_size_px;
    let inside = |value: f64, size: u32| {
        let margin = 0.08 * f64::from(size);
        (margin..f64::from(size) - margin).contains(&value)
    };
    let pixel = RectifiedPixel {
        u: glimpse.seen.x,
        v: glimpse.seen.y,
    };
    let side_m = fire.size_m.map_or(0.0, |size| size.width.max(size.height));
    view.would_show(pixel, side_m * glimpse.px_per_m)
        && inside(glimpse.seen.x, width)
        && inside(glimpse.seen.y, height)
        && (fire.estimate.position_m() - view.camera_enu).norm() <= MISS_REACH * fire.furthest_m
}

#[cfg(test)]
mod tests;
