//! The one loop over a closed set of events: telemetry and pairs in, fixes and alarms out.
//!
//! **In:** [`Event`]s in the order in which they reached the service, each with its arrival.
//! **Out:** [`Output`]s for the recording, the outbox and the links. The loop reads no clock and
//! does no I/O: the same events give the same outputs, live or from a recording. What a live run
//! drops (pairs that a newer one replaced) never becomes an event, so a recording of the events
//! replays to the same alarms.
//!
//! **Bound.** One pair waits for the telemetry that follows its shutter, for at most 250 ms; one that
//! comes meanwhile is not looked at, and counted.

mod chips;
mod counters;
mod feature;
mod ground;
mod light;
mod selfcheck;
pub mod spectra;
mod vision;

pub use chips::{Chip, MAX_BYTES as MAX_CHIP_BYTES};
pub use counters::Counters;
pub use selfcheck::{Fault, SelfCheck};
pub use spectra::RightEye;
pub use vision::{Seen, Vision};

use crate::alarm::{Action, Alarm, AlarmDesk, Area, FireId, Situation};
use crate::assess::extent::{Extent, Wind};
use crate::assess::watch::{Assessment, Assessor, Light};
use crate::detect::{Detection, Detector, Looked};
use crate::ingest::StereoPair;
use crate::locate::{Ground, SharedPriors, Terrain, View, fix};
use crate::mission::Mission;
use crate::pose::{Pose, PoseAnswer, PoseEstimator};
use crate::range::Ranger;
use crate::track::{Classified, Estimated, Fire, Outcome, Tracker};
use emberfix_calib::{Eye, RectifiedPixel, Rig};
use emberfix_frames::{
    Coordinate, GeoidUndulation, Metres, MissionEnu, ServiceTime, SignedDuration, Stamped,
    TimeSyncSample, Vector3, Wgs84, Wgs84Parts, ecef_from_enu, place_from_ecef, seconds,
};
use emberfix_mav::telemetry::{GpsRaw, TimeSyncMessage, WindEstimate};
use emberfix_mav::{Address, Received, SystemId, Telemetry};
use std::collections::BTreeSet;
use std::sync::Arc;

/// One thing that reached the service.
#[derive(Debug)]
pub enum Event {
    /// A MAVLink frame and what it says.
    Mavlink(Box<Received>),
    /// A stereo pair.
    Pair(Box<Stamped<StereoPair>>),
    /// What an operator did about an alarm.
    Action(Action),
}

/// One thing that the service found out.
#[derive(Debug, Clone)]
pub enum Output {
    /// Where the vehicle was at a shutter time.
    Pose(Box<Pose>),
    /// What the detector found in one pair.
    Detections {
        /// Mid-exposure.
        at: ServiceTime,
        /// What, in pixels of the raw left image.
        found: Vec<Detection>,
    },
    /// One sighting, as a GeoJSON Feature.
    Fix {
        /// Mid-exposure.
        at: ServiceTime,
        /// The Feature.
        feature: serde_json::Value,
    },
    /// An alarm to be told.
    Alarm(Box<Alarm>),
    /// A told fire's picture; comes after the alarms.
    Chip(Box<Chip>),
}

/// Whether the pipeline does its work, and why not.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Health {
    /// What is wrong, in words; empty when all is well.
    pub problems: Vec<String>,
    /// What makes positions worse, and keeps none back: in words for the operator.
    pub warnings: Vec<&'static str>,
}

impl Health {
    /// All of it, in words.
    #[must_use]
    pub fn words(&self) -> Vec<String> {
        let warnings = self.warnings.iter().map(|warning| (*warning).to_owned());
        self.problems.iter().cloned().chain(warnings).collect()
    }
}

/// The loop's state.
pub struct Pipeline {
    rig: Arc<Rig>,
    datum: Wgs84,
    terrain: Option<Arc<dyn Terrain>>,
    shared: SharedPriors,
    vision: Vision,
    /// Whether looking needs to know how large things on the ground appear: to choose where to look first, or
    /// to find a thing of one eye in the other.
    needs_scale: bool,
    check: SelfCheck,
    poses: PoseEstimator,
    tracker: Tracker,
    assessor: Assessor,
    wind: Option<Stamped<Wind>>,
    desk: AlarmDesk,
    gallery: chips::Gallery,
    autopilot: AutopilotLock,
    waiting: Option<Box<Stamped<StereoPair>>>,
    last_pair_at: Option<ServiceTime>,
    last_look: Option<ServiceTime>,
    last_position: Option<ServiceTime>,
    /// Why the latest pair gave nothing.
    blind: Option<String>,
    now: ServiceTime,
    counters: Counters,
    degraded: Vec<&'static str>,
}

/// The vehicle whose telemetry counts: configured, or the first autopilot that is heard. Others
/// are counted and never mixed in.
#[derive(Debug, Clone, Copy)]
struct AutopilotLock {
    system: Option<SystemId>,
}

/// One sigma of a stated wind whose error is not stated, m/s.
const WIND_SIGMA_M_S: f64 = 1.0;
/// A stated wind older than this is not used.
const WIND_AGE: SignedDuration = SignedDuration::from_secs(30);
/// A pair or a position older than this makes the pipeline unhealthy.
const SILENCE: SignedDuration = SignedDuration::from_secs(3);

impl Pipeline {
    /// A loop for a mission; fires are numbered from `first_fire`.
    #[must_use]
    pub fn new(
        mission: &Mission,
        detector: Box<dyn Detector>,
        ranger: Box<dyn Ranger>,
        first_fire: FireId,
    ) -> Self {
        let system = (mission.system_id != 0).then_some(SystemId(mission.system_id));
        Self {
            rig: Arc::clone(&mission.rig),
            datum: mission.datum,
            terrain: mission.terrain.clone(),
            shared: mission.shared,
            vision: Vision::new(&mission.rig, detector, ranger),
            needs_scale: mission.detector.frame_budget_ms.is_some(),
            check: SelfCheck::new(mission.rig.sigmas().disparity_bias_px),
            poses: PoseEstimator::new(mission.pose),
            tracker: Tracker::new(mission.track, first_fire),
            assessor: Assessor::default(),
            wind: None,
            desk: AlarmDesk::new(mission.uav.clone()),
            gallery: chips::Gallery::default(),
            autopilot: AutopilotLock { system },
            waiting: None,
            last_pair_at: None,
            last_look: None,
            last_position: None,
            blind: Some("no pair has been looked at yet".to_owned()),
            now: ServiceTime::from_unix_ns(0),
            counters: Counters::default(),
            degraded: Vec::new(),
        }
    }

    /// The same loop, with a detector on a right eye that sees another spectrum.
    #[must_use]
    pub fn with_right_eye(mut self, right_eye: Option<RightEye>) -> Self {
        self.needs_scale |= right_eye.is_some();
        self.vision = self.vision.with_right_eye(right_eye);
        self
    }

    /// Takes one event in. Arrivals never run backwards: an earlier one counts as now.
    pub fn handle(&mut self, arrived: ServiceTime, event: Event) -> Vec<Output> {
        self.now = self.now.max(arrived);
        match event {
            Event::Mavlink(received) => self.take_mavlink(&received),
            Event::Pair(pair) => self.take_pair(pair),
            Event::Action(action) => {
                let ours = self.desk.note(&action);
                self.counters
                    .add("operator", if ours { "taken" } else { "not_ours" });
            }
        }
        self.work_off()
    }

    /// The vehicle that is listened to, once known.
    #[must_use]
    pub fn vehicle(&self) -> Option<SystemId> {
        self.autopilot.system
    }

    /// Everything that was counted: used, refused and lost, by name.
    #[must_use]
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// All fires.
    #[must_use]
    pub fn fires(&self) -> &[Fire] {
        self.tracker.fires()
    }

    /// Latest arrival that was taken in.
    #[must_use]
    pub fn now(&self) -> ServiceTime {
        self.now
    }

    /// What is wrong at the moment `now`.
    #[must_use]
    pub fn health(&self, now: ServiceTime) -> Health {
        let silent = |last: Option<ServiceTime>| last.is_none_or(|last| now - last > SILENCE);
        let mut problems = Vec::new();
        if silent(self.last_position) {
            problems.push("no position from the autopilot".to_owned());
        }
        if silent(self.last_look) {
            problems.push("no stereo pairs".to_owned());
        }
        problems.extend(self.blind.clone());
        let faults = self.check.faults().iter();
        let mut warnings: Vec<&'static str> = faults.map(|fault| fault.words()).collect();
        warnings.extend(self.assessor.warnings());
        Health { problems, warnings }
    }

    fn take_mavlink(&mut self, received: &Received) {
        let telemetry = match &received.telemetry {
            Ok(telemetry) => telemetry,
            Err(error) => {
                self.counters.add("mavlink_refused", error.name());
                return;
            }
        };
        if let Telemetry::TimeSync(sync) = telemetry {
            self.take_timesync(received.frame.sender(), sync);
            return;
        }
        if let Telemetry::Heartbeat(heartbeat) = telemetry
            && heartbeat.is_autopilot()
            && self.autopilot.system.is_none()
        {
            self.autopilot.system = Some(received.system());
        }
        if let Telemetry::GimbalDeviceAttitude(said) = telemetry
            && self.autopilot.system == Some(received.system())
        {
            let taken = self.poses.add_gimbal(received.component(), self.now, said);
            self.counters
                .add("gimbal", if taken { "taken" } else { "refused" });
            return;
        }
        if !self.autopilot.is(received.frame.sender()) {
            self.counters.add("mavlink", "other_sender");
            return;
        }
        self.take_telemetry(telemetry);
    }

    fn take_telemetry(&mut self, telemetry: &Telemetry) {
        match telemetry {
            Telemetry::Attitude(sample) => {
                self.poses
                    .add_attitude(sample.boot, self.now, sample.attitude, sample.rate_rad_s);
                self.counters.add("telemetry", "attitude");
            }
            Telemetry::GlobalPosition(position) => {
                let degrees = (position.latitude_deg, position.longitude_deg);
                let velocity = position.velocity_ned_m_s;
                self.poses.add_position(
                    position.boot,
                    self.now,
                    degrees,
                    position.altitude,
                    velocity,
                );
                self.last_position = Some(self.now);
                self.counters.add("telemetry", "position");
            }
            Telemetry::GpsRaw(raw) => self.take_gnss(raw),
            Telemetry::Gps2Raw(raw) => {
                if let Some(separation) = separation(raw) {
                    self.poses.add_second_separation(separation);
                }
                self.counters.add("telemetry", "second_gnss");
            }
            Telemetry::EstimatorStatus(status) => {
                self.poses
                    .add_vertical_validity(status.flags.vertical_position());
                self.counters.add("telemetry", "estimator_status");
            }
            Telemetry::Wind(wind) => self.take_wind(wind),
            Telemetry::SystemTime(time) if time.utc_is_absurd() => {
                self.counters.add("mavlink_refused", "absurd_utc");
            }
            _ => {}
        }
    }

    fn take_gnss(&mut self, raw: &GpsRaw) {
        let sigmas = (raw.horizontal_sigma_m, raw.vertical_sigma_m);
        self.poses
            .add_gnss(self.now, raw.fix.is_3d(), sigmas, separation(raw));
        if let Some(place) = raw.place {
            self.poses.add_gnss_altitude(self.now, place.altitude);
        }
        self.counters.add(
            "telemetry",
            if raw.fix.is_3d() {
                "gnss_3d"
            } else {
                "gnss_no_3d"
            },
        );
    }

    /// Replies carry our own clock in `ts1`; a live service filters those that it never asked for
    /// before they become events, a replay takes them all.
    fn take_timesync(&mut self, sender: Address, sync: &TimeSyncMessage) {
        if sync.is_request() || !self.autopilot.is(sender) {
            return;
        }
        let taken = self.poses.add_timesync(TimeSyncSample {
            asked: ServiceTime::from_unix_ns(sync.ts1_ns),
            remote: emberfix_frames::BootTime::from_ns(sync.tc1_ns),
            answered: self.now,
        });
        self.counters
            .add("timesync", if taken { "taken" } else { "refused" });
    }

    fn take_pair(&mut self, pair: Box<Stamped<StereoPair>>) {
        if self.last_pair_at.is_some_and(|last| pair.at <= last) {
            self.counters.add("pairs", "not_later");
            return;
        }
        self.last_pair_at = Some(pair.at);
        self.last_look = Some(self.now);
        // The older one stays: if newer ones took its place, a camera that is quicker than the wait
        // for telemetry would never be looked through, and a stale pose would never be named.
        if self.waiting.is_some() {
            self.counters.add("pairs", "came_while_waiting");
        } else {
            self.waiting = Some(pair);
        }
    }

    fn work_off(&mut self) -> Vec<Output> {
        let Some(pair) = self.waiting.take() else {
            return Vec::new();
        };
        let moment = pair.at + seconds(self.rig.time_offset_s());
        let last_needed = moment + seconds(self.tracker.looks_ahead_s());
        if self.poses.at(last_needed, self.now) == PoseAnswer::NotYet {
            self.waiting = Some(pair);
            return Vec::new();
        }
        match self.poses.at(moment, self.now) {
            PoseAnswer::NotYet => {
                self.waiting = Some(pair);
                Vec::new()
            }
            PoseAnswer::Fresh(pose) => {
                self.blind = None;
                self.look(&pair, &pose)
            }
            PoseAnswer::NeverSeen { what } => self.without_pose("pose_never_seen", || {
                format!("no {what} has come from the autopilot")
            }),
            PoseAnswer::Stale {
                what,
                nearest,
                limit,
            } => self.without_pose("pose_stale", || {
                format!("{what} is {nearest:#} away from the shutter, limit {limit:#}")
            }),
            PoseAnswer::Conflict {
                what,
                apart_deg,
                limit_deg,
            } => self.without_pose("pose_conflict", || {
                format!("{what} are {apart_deg:.0} degrees apart, limit {limit_deg:.0}")
            }),
            PoseAnswer::TooFast {
                turned_deg,
                limit_deg,
            } => self.without_pose("too_fast_for_shutter", || {
                format!(
                    "the camera turned {turned_deg:.1} degrees within one readout, limit {limit_deg:.1}"
                )
            }),
            PoseAnswer::NoGnssFix => self.without_pose("no_gnss_fix", || {
                "GNSS has no 3D fix: no positions".to_owned()
            }),
        }
    }

    fn without_pose(&mut self, why: &'static str, words: impl FnOnce() -> String) -> Vec<Output> {
        self.counters.add("pairs_without_pose", why);
        self.blind = Some(words());
        Vec::new()
    }

    fn look(&mut self, pair: &Stamped<StereoPair>, pose: &Pose) -> Vec<Output> {
        let rig = Arc::clone(&self.rig);
        let view = View::new(&rig, pose, &self.shared, &self.datum);
        let ground = self
            .needs_scale
            .then(|| ground::scale(&view, self.terrain.as_deref()));
        let looked = self.vision.look(pair, ground.flatten(), &mut self.counters);
        let Some(seen) = looked else {
            self.blind = Some("the latest pair could not be looked at".to_owned());
            return Vec::new();
        };
        self.degraded = pose.degraded.iter().map(|reason| reason.name()).collect();
        if seen.mono {
            self.degraded.push(crate::pose::Degraded::Mono.name());
        }
        self.compare_eyes(&seen, &view);
        let faults = self.check.faults().iter();
        self.degraded.extend(faults.map(|fault| fault.name()));
        let sightings: Vec<_> = seen
            .sightings
            .iter()
            .map(|(_, sighting)| self.widened(*sighting))
            .collect();
        let outcomes = self.track(&view, &sightings, &seen.looked);
        if self.tracker.scatter().is_large() {
            self.degraded.push("sightings_scatter");
        }
        self.note_estimate();
        self.assess(pair, &seen, &outcomes, &view);
        let mut outputs = vec![Output::Pose(Box::new(pose.clone()))];
        for outcome in &outcomes {
            outputs.push(self.fix_output(&seen, outcome, &view));
        }
        outputs.push(Output::Detections {
            at: pair.at,
            found: seen.found.clone(),
        });
        outputs.extend(self.alarms(&view));
        outputs.extend(self.pictures(&seen, &outcomes, pair.at));
        outputs
    }

    /// Pictures of the told fires that this look shows, where they are worth it.
    fn pictures(&mut self, seen: &Seen, outcomes: &[Outcome], at: ServiceTime) -> Vec<Output> {
        let mut pictures = Vec::new();
        for outcome in outcomes {
            let box_px = seen.found[seen.sightings[outcome.index].0].box_px;
            let told = outcome
                .fire
                .and_then(|fire| Some((fire, self.desk.told(fire)?)));
            let Some((fire, told)) = told else {
                continue;
            };
            let offer = chips::Offer {
                fire,
                told,
                box_px,
                at,
            };
            if !self.gallery.takes(&offer) {
                continue;
            }
            match chips::cut(&seen.left_bgr, &box_px, (self.desk.id(fire), told.0), at) {
                Ok(chip) => pictures.push(Output::Chip(Box::new(chip))),
                Err(error) => {
                    self.counters.add("pictures", "failed");
                    tracing::debug!(%error, "a fire's picture was not cut out");
                }
            }
        }
        let there: BTreeSet<FireId> = self.tracker.fires().iter().map(|fire| fire.id).collect();
        self.gallery.keep(|id| there.contains(&id));
        pictures
    }

    /// Both eyes against each other and against the terrain, where this pair was compared.
    fn compare_eyes(&mut self, seen: &Seen, view: &View<'_>) {
        let Some(compared) = &seen.eyes else {
            return;
        };
        self.counters.add("self_check", "compared");
        let terrain = self.terrain.as_deref();
        self.check
            .note(compared, |pixel| ground::disparity_px(pixel, view, terrain));
    }

    /// A disparity of a rig that is not what its file says tells less.
    fn widened(&self, mut classified: Classified) -> Classified {
        if let Some(disparity) = &mut classified.sighting.disparity {
            disparity.sigma_px = self.check.widened(disparity.sigma_px);
        }
        classified
    }

    /// The disparity offset that flying past fires has shown, once it has.
    fn note_estimate(&mut self) {
        let told = self
            .tracker
            .shared_errors()
            .map(|shared| shared.disparity_px);
        let found = told.filter(Estimated::is_found);
        self.check
            .note_estimate(found.map(|found| (found.value, found.sigma)));
    }

    /// The tracker may ask where the vehicle was at other moments: the clock error is one of its states.
    fn track(
        &mut self,
        view: &View<'_>,
        sightings: &[Classified],
        looked: &Looked,
    ) -> Vec<Outcome> {
        let (now, poses) = (self.now, &self.poses);
        let motion = |later_s: f64| match poses.at(view.pose.at + seconds(later_s), now) {
            PoseAnswer::Fresh(pose) => Some(*pose),
            _ => None,
        };
        let rectification = self.rig.rectification();
        let would_show = |pixel: RectifiedPixel, size_px: f64| {
            let raw = rectification.unrectify(Eye::Left, pixel);
            looked.would_show((raw.u, raw.v), size_px)
        };
        let view = view.clone().with_motion(&motion).with_scrutiny(&would_show);
        self.tracker.step(&view, sightings, self.terrain.as_deref())
    }

    fn take_wind(&mut self, wind: &WindEstimate) {
        self.counters.add("telemetry", "wind");
        self.wind = Some(Stamped {
            at: self.now,
            value: Wind {
                towards_m_s: wind.towards_enu_m_s.xy(),
                sigma_m_s: wind.horizontal_sigma_m_s.unwrap_or(WIND_SIGMA_M_S),
            },
        });
    }

    /// What the frame says of how each fire burns.
    fn assess(
        &mut self,
        pair: &Stamped<StereoPair>,
        seen: &Seen,
        outcomes: &[Outcome],
        view: &View<'_>,
    ) {
        let spectral = self.spectral(pair, seen, outcomes);
        let fresh = self
            .wind
            .as_ref()
            .filter(|wind| self.now - wind.at < WIND_AGE);
        let wind = fresh.map(|wind| wind.value);
        let fires = self.tracker.fires();
        for (outcome, spectral) in outcomes.iter().zip(spectral) {
            let Some(fire) = fires.iter().find(|fire| Some(fire.id) == outcome.fire) else {
                continue;
            };
            let light = Light {
                visible: seen.flames.get(outcome.index).copied().flatten(),
                spectral,
            };
            let sighting = &seen.sightings[outcome.index].1.sighting;
            self.assessor
                .note(fire, sighting, view, light, wind.as_ref());
        }
        self.assessor
            .keep(|id| fires.iter().any(|fire| fire.id == id));
    }

    /// The spectral light of each outcome. A near-infrared eye shows each fire by itself; a spectrometer
    /// speaks of one fire alone. A rig with such an eye uses it always: the two have different units.
    fn spectral(
        &mut self,
        pair: &Stamped<StereoPair>,
        seen: &Seen,
        outcomes: &[Outcome],
    ) -> Vec<Option<f64>> {
        if !self.rig.right_near_infrared() {
            return vec![self.of_spectrometer(pair, outcomes); outcomes.len()];
        }
        if !pair.value.spectra.is_empty() {
            self.counters
                .add("spectrometer", "near_infrared_eye_instead");
        }
        let of = |outcome: &Outcome| seen.near_infrared.get(outcome.index).copied().flatten();
        outcomes.iter().map(of).collect()
    }

    /// Mean light of the lines since the pair before. The instrument sees the whole scene, so it
    /// speaks of a fire only when one alone is seen.
    fn of_spectrometer(&mut self, pair: &Stamped<StereoPair>, outcomes: &[Outcome]) -> Option<f64> {
        let mut lights = Vec::new();
        for spectrum in &pair.value.spectra {
            let light = spectrum.line_light();
            let name = if light.is_some() {
                "read"
            } else {
                "no_line_or_full"
            };
            self.counters.add("spectrometer", name);
            lights.extend(light);
        }
        let seen = outcomes
            .iter()
            .filter(|outcome| outcome.fire.is_some())
            .count();
        if seen != 1 && !lights.is_empty() {
            self.counters.add("spectrometer", "not_one_fire_alone");
        }
        let usable = seen == 1 && !lights.is_empty();
        usable.then(|| lights.iter().sum::<f64>() / lights.len() as f64)
    }

    fn fix_output(&mut self, seen: &Seen, outcome: &Outcome, view: &View<'_>) -> Output {
        let (found, classified) = &seen.sightings[outcome.index];
        let at = classified.sighting.at;
        let fix = fix(&classified.sighting, view, self.terrain.as_deref());
        let situation = fix.as_ref().map(|fix| {
            let mut situation = situate(&fix.place, &self.poses, self.terrain.as_deref());
            let reasons = self.degraded.iter().map(|reason| (*reason).to_owned());
            situation.degraded.extend(reasons);
            situation
        });
        let box_px = seen.found[*found].box_px;
        let placed = fix.as_ref().zip(situation.as_ref());
        let feature = feature::sighting(classified, box_px, placed, view);
        Output::Fix {
            at,
            feature: self.desk.signed(outcome.fire, feature),
        }
    }

    fn alarms(&mut self, view: &View<'_>) -> Vec<Output> {
        let (datum, terrain) = (self.datum, self.terrain.clone());
        let (poses, degraded, tracker) = (&self.poses, &self.degraded, &self.tracker);
        let assessor = &self.assessor;
        let due = self.desk.due(tracker.fires(), |fire| {
            let place = place_from_ecef(&ecef_from_enu(&datum).transform(fire.position()))?;
            let mut situation = situate(&place, poses, terrain.as_deref());
            situation.advice = tracker.advise(fire, view);
            let reasons = degraded.iter().map(|reason| (*reason).to_owned());
            situation.degraded.extend(reasons);
            situation.degraded.extend(
                fire.merged_into
                    .map(|into| format!("merged_into_{}", into.0)),
            );
            if let Some(assessment) = assessor.of(fire.id) {
                let channels = assessment.reasons.iter().map(|reason| (*reason).to_owned());
                situation.degraded.extend(channels);
                situation.area = assessment
                    .extent
                    .as_ref()
                    .and_then(|extent| area(extent, &datum));
                situation.assessment = assessment.clone();
            }
            Some(situation)
        });
        due.into_iter()
            .map(|alarm| Output::Alarm(Box::new(alarm)))
            .collect()
    }
}

impl AutopilotLock {
    fn is(self, sender: Address) -> bool {
        self.system == Some(sender.system)
            && sender.component == emberfix_mav::ComponentId::AUTOPILOT
    }
}

/// Ellipsoid height minus altitude, where a receiver gives both.
fn separation(raw: &GpsRaw) -> Option<GeoidUndulation> {
    raw.place
        .and_then(|place| place.height.map(|height| height - place.altitude))
}

/// Altitude and height above ground of a place.
fn situate(place: &Wgs84, poses: &PoseEstimator, terrain: Option<&dyn Terrain>) -> Situation {
    let (ground, degraded) = match terrain.map(|terrain| terrain.ground_at(place)) {
        None => (None, None),
        Some(Ground::Known { height, .. }) => (Some(height), None),
        Some(Ground::Void) => (None, Some("terrain_void")),
        Some(Ground::OffTiles) => (None, Some("terrain_off_tiles")),
    };
    Situation {
        place: *place,
        advice: None,
        altitude: place.height() - poses.undulation(place),
        above_ground: ground.map(|ground| place.height() - ground),
        assessment: Assessment::default(),
        area: None,
        degraded: degraded.into_iter().map(str::to_owned).collect(),
    }
}

/// The burning ground on the Earth.
fn area(extent: &Extent, datum: &Wgs84) -> Option<Area> {
    let ecef_from_mission = ecef_from_enu::<MissionEnu>(datum);
    let on_earth = |corner: &nalgebra::Vector2<f64>| -> Option<[f64; 2]> {
        let point = Vector3::new(corner.x, corner.y, extent.level_m);
        let place = place_from_ecef(&ecef_from_mission.transform(Coordinate::from_metres(point)))?;
        Some([place.longitude_deg(), place.latitude_deg()])
    };
    Some(Area {
        polygon: extent
            .polygon_m
            .iter()
            .map(on_earth)
            .collect::<Option<_>>()?,
        edge_sigma_m: extent.edge_sigma_m,
        square_metres: extent.area_m2,
        front: extent.front.iter().map(on_earth).collect::<Option<_>>()?,
    })
}
