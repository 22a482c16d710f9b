//! Delivery over the pipeline's one MAVLink connection; sans-IO.
//!
//! Each fire is told in three ways:
//! - **STATUSTEXT** for people at any ground station: `FIRE 7 31.409422,119.112017 +-3m 91%`. When a
//!   fire is first told, at 0, 1 and 3 s unless our ground agent answered meanwhile; once when it
//!   goes out. Older news end in their age (`5min ago`). ALERT while it burns, NOTICE when it is out.
//! - **COMMAND_INT** for our ground agent ([`super::spatial`]), tried again after 1, 2, 4, .. 30 s
//!   until its COMMAND_ACK comes; all at once when the agent is heard again after a silence.
//! - **CAMERA_TRACKING_GEO_STATUS** at 1 Hz for the best fire of the last half minute: the surest,
//!   among equals the best placed.
//!
//! New fires go first, then texts, then repetitions, then the camera status. Frames are at least
//! 50 ms apart and together at most 120 B/s sustained ([`Pacing`]): a 9600 baud radio carries them
//! and still has room for telemetry. While a radio says (RADIO_STATUS) that its buffer fills, they
//! take down to a tenth of that.
//!
//! An alarm that an operator has seen to gets no more texts; one that was dismissed is nobody's
//! target, until an operator says otherwise.
//!
//! **Bound:** [`MavlinkDelivery::MAX_FIRES`] fires. **Loss rule:** delivered ones make room, the
//! least recent first; if all wait, a further one is not taken, and stays in the outbox. After a
//! restart the texts of what still waits are said once more.

use super::link::{AlarmLink, FIRST_RETRY, Letter, Settled, pause_after};
use super::spatial::{self, SpatialError, SpatialReceipt, round_sigmas_m};
use super::{Receipt, Urgency, fire_number};
use crate::alarm::{Alarm, AlarmClass, AlarmProperties, Attention, FireId, FireState};
use emberfix_frames::{MslAltitude, ServiceTime, SignedDuration, Wgs84Parts};
use emberfix_mav::outgoing::{camera_tracking_geo_status, command, command_int, status_text};
use emberfix_mav::telemetry::{
    CameraTrackingGeoStatus, CommandAck, CommandResult, Severity, StatusText, Telemetry,
};
use emberfix_mav::{Address, EncodeError, Encoder, MavMessage};
use std::collections::BTreeMap;

/// How fast frames may follow each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pacing {
    /// Least time between two frames.
    pub gap: SignedDuration,
    /// Sustained bytes per second, frame overhead included.
    pub bytes_per_s: f64,
    /// Bytes that may go at once after a pause.
    pub burst_bytes: f64,
}

impl Default for Pacing {
    fn default() -> Self {
        Self {
            gap: SignedDuration::from_millis(50),
            bytes_per_s: 120.0,
            burst_bytes: 240.0,
        }
    }
}

/// Who talks to whom, how fast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MavlinkSettings {
    /// We.
    pub own: Address,
    /// Our ground agent.
    pub ground: Address,
    /// How fast.
    pub pacing: Pacing,
    /// What signing adds to every frame, bytes.
    pub signature_bytes: usize,
}

impl MavlinkSettings {
    /// Where our ground agent is unless configured otherwise.
    pub const GROUND: Address = Address::new(254, 191);

    /// With the usual ground agent and pacing.
    #[must_use]
    pub fn new(own: Address) -> Self {
        Self {
            own,
            ground: Self::GROUND,
            pacing: Pacing::default(),
            signature_bytes: 0,
        }
    }
}

/// Why an alarm cannot be told over MAVLink.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MavlinkError {
    /// It does not fit into a command.
    #[error(transparent)]
    Spatial(#[from] SpatialError),
    /// The dialect does not have it.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// Too many fires wait.
    #[error("{limit} fires wait for delivery over MAVLink already")]
    Full {
        /// How many may.
        limit: usize,
    },
}

/// What was said so far, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct MavlinkCounters {
    /// STATUSTEXTs.
    pub texts: u64,
    /// COMMAND_INTs, first ones.
    pub commands: u64,
    /// COMMAND_INTs, repeated ones.
    pub repetitions: u64,
    /// CAMERA_TRACKING_GEO_STATUSs.
    pub camera_statuses: u64,
    /// Revisions that the ground agent acknowledged.
    pub delivered: u64,
    /// Answers of the ground agent that refused an alarm.
    pub refused: u64,
    /// Answers that belong to nothing that waits.
    pub stray_answers: u64,
    /// RADIO_STATUSs that slowed us.
    pub slowed: u64,
}

/// Tells alarms over MAVLink: what to send when, and what an answer means.
#[derive(Debug)]
pub struct MavlinkDelivery {
    settings: MavlinkSettings,
    fires: BTreeMap<FireId, Telling>,
    pace: Pace,
    camera_due: Option<ServiceTime>,
    ground_heard: Option<ServiceTime>,
    settled: Vec<Settled>,
    counters: MavlinkCounters,
}

#[derive(Debug)]
struct Telling {
    alarm: Alarm,
    attention: Attention,
    command: CommandState,
    text: TextState,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum CommandState {
    Never,
    Tried(Attempts),
    Delivered,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Attempts {
    times: u32,
    latest: ServiceTime,
    again_at: ServiceTime,
    /// The ground agent answered, and will not have it: it waits for its turn.
    refused: bool,
}

/// Which texts of a fire were said.
#[derive(Debug, Clone, Copy, PartialEq)]
enum TextState {
    Due {
        said: usize,
        at: Option<ServiceTime>,
    },
    Said,
}

/// Pauses before the second and the third saying of a text.
const TEXT_PAUSES: [SignedDuration; 2] =
    [SignedDuration::from_secs(1), SignedDuration::from_secs(2)];
/// From this age on a text says how old its news are.
const OLD_NEWS: SignedDuration = SignedDuration::from_secs(60);
/// How long a fire stays the camera's target after its latest sighting.
const CAMERA_MEMORY: SignedDuration = SignedDuration::from_secs(30);
/// Between two camera statuses.
const CAMERA_EVERY: SignedDuration = SignedDuration::from_secs(1);
/// A ground agent that was silent for so long was out of reach: heartbeats come at 1 Hz.
const GROUND_SILENCE: SignedDuration = SignedDuration::from_secs(5);

impl MavlinkDelivery {
    /// Fires at most.
    pub const MAX_FIRES: usize = 256;
    /// Name of this link in the outbox.
    pub const NAME: &'static str = "mavlink";

    /// Nothing to tell yet.
    #[must_use]
    pub fn new(settings: MavlinkSettings) -> Self {
        Self {
            settings,
            fires: BTreeMap::new(),
            pace: Pace::new(settings.pacing),
            camera_due: None,
            ground_heard: None,
            settled: Vec::new(),
            counters: MavlinkCounters::default(),
        }
    }

    /// Takes in an alarm that waits in the outbox; again and again does no harm. A newer revision
    /// takes the place of an older one.
    ///
    /// # Errors
    /// [`MavlinkError`]: this alarm cannot be told this way; the others are not affected.
    pub fn offer(&mut self, alarm: &Alarm) -> Result<(), MavlinkError> {
        // Encoded once to refuse here what could never be sent.
        spatial::encode(alarm, self.settings.ground, alarm.properties.captured_at)?;
        let id = &alarm.properties.id;
        let fire = fire_number(id).ok_or_else(|| SpatialError::Id { id: id.clone() })?;
        if let Some(telling) = self.fires.get_mut(&fire) {
            telling.renew(alarm);
            return Ok(());
        }
        self.make_room()?;
        self.fires.insert(fire, Telling::new(alarm));
        Ok(())
    }

    /// How much of people's attention each alarm still asks for.
    pub fn attend(&mut self, attention: impl Fn(&str) -> Attention) {
        for telling in self.fires.values_mut() {
            telling.attend(attention(&telling.alarm.properties.id));
        }
    }

    /// Takes in what came over the connection.
    pub fn observe(&mut self, from: Address, telemetry: &Telemetry, now: ServiceTime) {
        if let Telemetry::RadioStatus(status) = telemetry {
            let slowed = self.pace.heed(status.free_buffer_percent, now);
            self.counters.slowed += u64::from(slowed);
        }
        if from != self.settings.ground {
            return;
        }
        let back = self
            .ground_heard
            .is_none_or(|heard| now - heard > GROUND_SILENCE);
        self.ground_heard = Some(now);
        if back {
            self.hurry(now);
        }
        if let Telemetry::CommandAck(ack) = telemetry
            && ack.command == command::SPATIAL_USER_1
        {
            self.answered(ack, now);
        }
    }

    /// The message to send now, if any. Call it at least every 50 ms, until it gives `None`.
    pub fn poll(&mut self, now: ServiceTime) -> Option<MavMessage> {
        if !self.pace.is_open(now) {
            return None;
        }
        let (step, message) = self.next_step(now)?;
        let plain_len = Encoder::new(self.settings.own).encode(&message).len();
        let frame_len = plain_len + self.settings.signature_bytes;
        if !self.pace.spend(frame_len, now) {
            return None;
        }
        self.done(step, now);
        Some(message)
    }

    /// Fires whose newest revision the ground agent has not acknowledged.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.fires
            .values()
            .filter(|telling| !telling.is_delivered())
            .count()
    }

    /// When the ground agent was last heard.
    #[must_use]
    pub fn ground_heard(&self) -> Option<ServiceTime> {
        self.ground_heard
    }

    /// What was said so far.
    #[must_use]
    pub fn counters(&self) -> MavlinkCounters {
        self.counters
    }

    fn make_room(&mut self) -> Result<(), MavlinkError> {
        if self.fires.len() < Self::MAX_FIRES {
            return Ok(());
        }
        let delivered = self
            .fires
            .iter()
            .filter(|(_, telling)| telling.is_delivered());
        let oldest = delivered.min_by_key(|(_, telling)| telling.alarm.properties.captured_at);
        let fire = oldest.map(|(fire, _)| *fire);
        let fire = fire.ok_or(MavlinkError::Full {
            limit: Self::MAX_FIRES,
        })?;
        self.fires.remove(&fire);
        Ok(())
    }

    /// The agent is there: what it missed need not wait for its turn, unless it is still on the way.
    fn hurry(&mut self, now: ServiceTime) {
        for telling in self.fires.values_mut() {
            if let CommandState::Tried(attempts) = &mut telling.command
                && !attempts.refused
            {
                let answer_by = attempts.latest + FIRST_RETRY;
                attempts.again_at = attempts.again_at.min(answer_by.max(now));
            }
        }
    }

    fn answered(&mut self, ack: &CommandAck, now: ServiceTime) {
        let answer = SpatialReceipt::read(ack.result_param2);
        let for_us = ack.target.reaches(self.settings.own);
        let telling = self.fires.get_mut(&answer.fire).filter(|telling| {
            for_us && telling.was_tried() && answer.means(telling.alarm.properties.revision)
        });
        let Some(telling) = telling else {
            self.counters.stray_answers += 1;
            return;
        };
        let properties = &telling.alarm.properties;
        let (id, revision) = (properties.id.clone(), properties.revision);
        if ack.result != CommandResult::Accepted {
            self.counters.refused += 1;
            telling.refused(ack.result);
            self.settled.push(Settled::Refused {
                id,
                revision,
                reason: format!("{:?}", ack.result),
            });
            return;
        }
        telling.command = CommandState::Delivered;
        telling.text.heard();
        self.settled
            .push(Settled::Delivered(Receipt { id, revision }));
        self.counters.delivered += 1;
        self.hurry(now);
    }

    /// What waits no more was delivered another way, or is not owed.
    fn forget_all_but(&mut self, waiting: &[Letter]) {
        let waits = |id: &str| waiting.iter().any(|letter| letter.id() == id);
        self.fires
            .retain(|_, telling| telling.is_delivered() || waits(&telling.alarm.properties.id));
    }

    /// What comes next, if it is due; in the order of the room's doc.
    fn next_step(&self, now: ServiceTime) -> Option<(Step, MavMessage)> {
        let commands = |fresh: bool| {
            let due = self
                .fires
                .iter()
                .filter(move |(_, t)| t.command_due(fresh, now));
            due.min_by_key(|(_, t)| t.rank())
                .map(|(fire, _)| Step::Command(*fire))
        };
        let text = || {
            let due = self.fires.iter().filter(|(_, t)| t.text.is_due(now));
            due.min_by_key(|(_, t)| t.rank())
                .map(|(fire, _)| Step::Text(*fire))
        };
        let step = commands(true).or_else(text).or_else(|| commands(false));
        let step = step.or_else(|| self.camera_step(now))?;
        Some((step, self.message(step, now)?))
    }

    fn camera_step(&self, now: ServiceTime) -> Option<Step> {
        if self.camera_due.is_some_and(|due| now < due) {
            return None;
        }
        let seen = self
            .fires
            .iter()
            .filter(|(_, telling)| telling.is_in_sight(now));
        let best = seen.max_by(|(_, a), (_, b)| {
            let (a, b) = (&a.alarm.properties, &b.alarm.properties);
            let surer = a.confidence.total_cmp(&b.confidence);
            surer.then(b.ce90_m.total_cmp(&a.ce90_m))
        });
        best.map(|(fire, _)| Step::Camera(*fire))
    }

    fn message(&self, step: Step, now: ServiceTime) -> Option<MavMessage> {
        match step {
            Step::Command(fire) => {
                let order =
                    spatial::encode(&self.fires.get(&fire)?.alarm, self.settings.ground, now);
                command_int(&order.ok()?).ok()
            }
            Step::Text(fire) => {
                let properties = &self.fires.get(&fire)?.alarm;
                Some(status_text(&text(fire, properties, now)))
            }
            Step::Camera(fire) => Some(camera_tracking_geo_status(&camera_status(
                &self.fires.get(&fire)?.alarm,
            ))),
        }
    }

    fn done(&mut self, step: Step, now: ServiceTime) {
        match step {
            Step::Command(fire) => {
                let Some(telling) = self.fires.get_mut(&fire) else {
                    return;
                };
                if telling.tried(now) {
                    self.counters.commands += 1;
                } else {
                    self.counters.repetitions += 1;
                }
            }
            Step::Text(fire) => {
                self.counters.texts += 1;
                if let Some(telling) = self.fires.get_mut(&fire) {
                    telling.text.said(now);
                }
            }
            Step::Camera(_) => {
                self.counters.camera_statuses += 1;
                self.camera_due = Some(now + CAMERA_EVERY);
            }
        }
    }
}

impl AlarmLink for MavlinkDelivery {
    fn name(&self) -> &'static str {
        Self::NAME
    }

    fn work(&mut self, waiting: &[Letter], _now: ServiceTime) -> Vec<Settled> {
        self.forget_all_but(waiting);
        for letter in waiting {
            if let Err(error) = self.offer(&letter.alarm) {
                self.settled.push(Settled::Refused {
                    id: letter.id().to_owned(),
                    revision: letter.revision(),
                    reason: error.to_string(),
                });
            }
        }
        std::mem::take(&mut self.settled)
    }
}

#[derive(Debug, Clone, Copy)]
enum Step {
    Command(FireId),
    Text(FireId),
    Camera(FireId),
}

impl Telling {
    fn new(alarm: &Alarm) -> Self {
        let text = TextState::Due { said: 0, at: None };
        Self {
            alarm: alarm.clone(),
            attention: Attention::Wanted,
            command: CommandState::Never,
            text,
        }
    }

    /// A revision after a delivered one goes at once; one after an unanswered one keeps its place in
    /// the repetitions, so that a lively fire does not fill a link on which nobody listens.
    fn renew(&mut self, alarm: &Alarm) {
        let (old, new) = (&self.alarm.properties, &alarm.properties);
        if new.revision <= old.revision {
            return;
        }
        if self.command == CommandState::Delivered {
            self.command = CommandState::Never;
        }
        if new.state == FireState::Out && old.state != FireState::Out {
            self.text = TextState::Due {
                said: TEXT_PAUSES.len(),
                at: None,
            };
        }
        self.alarm = alarm.clone();
    }

    /// Seen: no texts but the one that it is out. Dismissed: none at all.
    fn attend(&mut self, attention: Attention) {
        let burns = self.alarm.properties.state != FireState::Out;
        match attention {
            Attention::Wanted => {}
            Attention::Seen if burns || self.attention != attention => {
                self.text = TextState::Said;
            }
            Attention::Seen => {}
            Attention::Dismissed => self.text = TextState::Said,
        }
        self.attention = attention;
    }

    fn is_delivered(&self) -> bool {
        self.command == CommandState::Delivered
    }

    fn was_tried(&self) -> bool {
        self.command != CommandState::Never
    }

    fn command_due(&self, fresh: bool, now: ServiceTime) -> bool {
        match self.command {
            CommandState::Never => fresh,
            CommandState::Tried(attempts) => !fresh && now >= attempts.again_at,
            CommandState::Delivered => false,
        }
    }

    /// True when it was the first time.
    fn tried(&mut self, now: ServiceTime) -> bool {
        let before = match self.command {
            CommandState::Tried(attempts) => Some(attempts.times),
            CommandState::Never | CommandState::Delivered => None,
        };
        let times = before.unwrap_or(0).saturating_add(1);
        let again_at = now + pause_after(times);
        self.command = CommandState::Tried(Attempts {
            times,
            latest: now,
            again_at,
            refused: false,
        });
        before.is_none()
    }

    fn refused(&mut self, result: CommandResult) {
        tracing::warn!(
            id = self.alarm.properties.id,
            ?result,
            "the ground refused an alarm"
        );
        if let CommandState::Tried(attempts) = &mut self.command {
            attempts.refused = true;
        }
    }

    /// Least is told first: urgent ones, then what waits longest, then the newest sighting.
    fn rank(&self) -> (Urgency, Option<ServiceTime>, std::cmp::Reverse<ServiceTime>) {
        let waits_since = match self.command {
            CommandState::Tried(attempts) => Some(attempts.again_at),
            CommandState::Never | CommandState::Delivered => None,
        };
        let properties = &self.alarm.properties;
        (
            Urgency::of(properties),
            waits_since,
            std::cmp::Reverse(properties.captured_at),
        )
    }

    fn is_in_sight(&self, now: ServiceTime) -> bool {
        let properties = &self.alarm.properties;
        self.attention != Attention::Dismissed
            && properties.state != FireState::Out
            && now - properties.captured_at <= CAMERA_MEMORY
    }
}

impl TextState {
    fn is_due(self, now: ServiceTime) -> bool {
        match self {
            Self::Due { at, .. } => at.is_none_or(|at| now >= at),
            Self::Said => false,
        }
    }

    fn said(&mut self, now: ServiceTime) {
        let Self::Due { said, .. } = *self else {
            return;
        };
        *self = match TEXT_PAUSES.get(said) {
            Some(pause) => Self::Due {
                said: said + 1,
                at: Some(now + *pause),
            },
            None => Self::Said,
        };
    }

    /// The ground agent has it: no need to repeat, but it is said once in any case.
    fn heard(&mut self) {
        *self = match *self {
            Self::Due { at: None, .. } => Self::Due {
                said: TEXT_PAUSES.len(),
                at: None,
            },
            Self::Due { at: Some(_), .. } | Self::Said => Self::Said,
        };
    }
}

/// A token bucket and a least gap.
#[derive(Debug)]
struct Pace {
    pacing: Pacing,
    /// Of the sustained rate, in 0..1: what a radio's buffer leaves to us.
    share: f64,
    heeded: Option<ServiceTime>,
    tokens: f64,
    filled_at: Option<ServiceTime>,
    last_frame: Option<ServiceTime>,
}

impl Pace {
    fn new(pacing: Pacing) -> Self {
        Self {
            pacing,
            share: 1.0,
            heeded: None,
            tokens: pacing.burst_bytes,
            filled_at: None,
            last_frame: None,
        }
    }

    fn is_open(&self, now: ServiceTime) -> bool {
        self.last_frame
            .is_none_or(|last| now - last >= self.pacing.gap)
    }

    /// A radio told how much of its buffer is free; true when that slows us.
    fn heed(&mut self, free_percent: u8, now: ServiceTime) -> bool {
        let step = match free_percent {
            0..20 => 0.5,
            20..50 => 0.8,
            50..90 => 1.0,
            _ => 1.25,
        };
        self.heeded = Some(now);
        self.share = (self.share * step).clamp(LEAST_SHARE, 1.0);
        step < 1.0
    }

    /// A radio that says nothing any more holds nothing up.
    fn share(&self, now: ServiceTime) -> f64 {
        let fresh = self
            .heeded
            .is_some_and(|heeded| now - heeded < RADIO_SILENCE);
        if fresh { self.share } else { 1.0 }
    }

    /// False, and nothing spent, when there is no room for a frame of this length yet.
    fn spend(&mut self, frame_len: usize, now: ServiceTime) -> bool {
        let since_s = self
            .filled_at
            .map_or(0.0, |filled| (now - filled).as_secs_f64());
        let gained = since_s.max(0.0) * self.pacing.bytes_per_s * self.share(now);
        self.tokens = (self.tokens + gained).min(self.pacing.burst_bytes);
        self.filled_at = Some(now);
        let needed = frame_len as f64;
        if self.tokens < needed {
            return false;
        }
        self.tokens -= needed;
        self.last_frame = Some(now);
        true
    }
}

/// Least share of the sustained rate: one alarm in five seconds still goes, whatever a radio says.
const LEAST_SHARE: f64 = 0.1;
/// Radios tell their state at 1 Hz.
const RADIO_SILENCE: SignedDuration = SignedDuration::from_secs(10);

fn text(fire: FireId, alarm: &Alarm, now: ServiceTime) -> StatusText {
    let properties = &alarm.properties;
    let what = match properties.class {
        AlarmClass::Fire => "FIRE",
        AlarmClass::Smoke => "SMOKE",
    };
    let out = if properties.state == FireState::Out {
        " OUT"
    } else {
        ""
    };
    let (latitude, longitude) = (alarm.place.latitude_deg(), alarm.place.longitude_deg());
    let ce90_m = properties.ce90_m.ceil().max(1.0);
    let percent = (properties.confidence * 100.0).round();
    let age = age(properties, now);
    StatusText {
        severity: severity(properties.state),
        text: format!(
            "{what} {}{out} {latitude:.6},{longitude:.6} +-{ce90_m}m {percent}%{age}",
            fire.0
        ),
    }
}

fn age(properties: &AlarmProperties, now: ServiceTime) -> String {
    let age = now - properties.captured_at;
    if age < OLD_NEWS {
        String::new()
    } else {
        format!(" {}min", age.as_mins())
    }
}

fn severity(state: FireState) -> Severity {
    match state {
        FireState::Suspected => Severity::Warning,
        FireState::Out => Severity::Notice,
        FireState::Confirmed | FireState::Growing | FireState::Steady | FireState::Dying => {
            Severity::Alert
        }
    }
}

fn camera_status(alarm: &Alarm) -> CameraTrackingGeoStatus {
    let (horizontal_m, vertical_m) = round_sigmas_m(&alarm.properties);
    CameraTrackingGeoStatus {
        tracking: true,
        latitude_deg: alarm.place.latitude_deg(),
        longitude_deg: alarm.place.longitude_deg(),
        altitude: MslAltitude::from_m(alarm.properties.altitude_msl_m),
        horizontal_sigma_m: Some(horizontal_m),
        vertical_sigma_m: Some(vertical_m),
        range_m: Some(alarm.properties.range_m),
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests_support::alarm;
    use super::*;
    use emberfix_frames::seconds;
    use emberfix_mav::{RawFrame, decode};

    const OWN: Address = Address::new(1, 191);
    const GROUND: Address = MavlinkSettings::GROUND;

    fn start() -> ServiceTime {
        alarm(1, 1).properties.captured_at
    }

    fn after_s(s: f64) -> ServiceTime {
        start() + seconds(s)
    }

    fn delivery() -> MavlinkDelivery {
        MavlinkDelivery::new(MavlinkSettings::new(OWN))
    }

    /// The receipt that comes of it.
    fn observe(
        delivery: &mut MavlinkDelivery,
        from: Address,
        telemetry: &Telemetry,
        now: ServiceTime,
    ) -> Option<Receipt> {
        delivery.observe(from, telemetry, now);
        let settled = std::mem::take(&mut delivery.settled);
        settled.into_iter().find_map(|settled| match settled {
            Settled::Delivered(receipt) => Some(receipt),
            _ => None,
        })
    }

    struct Sent {
        at_s: f64,
        bytes: usize,
        says: Telemetry,
    }

    /// Runs from one time to another in steps of 10 ms, and reads what was sent as a receiver would.
    fn run(delivery: &mut MavlinkDelivery, from_s: f64, to_s: f64) -> Vec<Sent> {
        let mut encoder = Encoder::new(OWN);
        let steps = ((to_s - from_s) * 100.0).round() as u32;
        let mut sent = Vec::new();
        for step in 0..steps {
            let at_s = from_s + f64::from(step) * 0.01;
            while let Some(message) = delivery.poll(after_s(at_s)) {
                let bytes = encoder.encode(&message);
                let says = decode(&RawFrame::at_start(&bytes).unwrap().0).unwrap();
                sent.push(Sent {
                    at_s,
                    bytes: bytes.len(),
                    says,
                });
            }
        }
        sent
    }

    fn texts(sent: &[Sent]) -> Vec<(f64, String)> {
        let text = |s: &Sent| match &s.says {
            Telemetry::StatusText(status) => {
                Some(((s.at_s * 10.0).round() / 10.0, status.text.clone()))
            }
            _ => None,
        };
        sent.iter().filter_map(text).collect()
    }

    fn commands(sent: &[Sent]) -> Vec<(f64, FireId, u32)> {
        let order = |s: &Sent| match &s.says {
            Telemetry::CommandInt(order) => {
                let told = spatial::decode(order).unwrap();
                assert_eq!(order.target, GROUND);
                Some((s.at_s.round(), told.fire, told.revision))
            }
            _ => None,
        };
        sent.iter().filter_map(order).collect()
    }

    fn ack(number: u32, revision: u32, result: CommandResult) -> Telemetry {
        Telemetry::CommandAck(CommandAck {
            command: command::SPATIAL_USER_1,
            result,
            result_param2: spatial::receipt(FireId(number), revision),
            target: OWN,
        })
    }

    #[test]
    fn a_text_says_the_place_three_times_to_whoever_listens() {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        let said = texts(&run(&mut delivery, 0.0, 20.0));
        let times: Vec<f64> = said.iter().map(|(at_s, _)| *at_s).collect();
        assert_eq!(times.len(), 3);
        for (at_s, due_s) in times.iter().zip([0.0, 1.0, 3.0]) {
            assert!((at_s - due_s).abs() < 0.35, "{times:?}");
        }
        assert!(
            said.iter()
                .all(|(_, text)| text == "FIRE 7 31.409422,119.112017 +-3m 91%")
        );
    }

    #[test]
    fn a_command_is_repeated_ever_slower_until_it_is_acknowledged() {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        let times: Vec<f64> = commands(&run(&mut delivery, 0.0, 100.0))
            .iter()
            .map(|(at_s, ..)| *at_s)
            .collect();
        assert_eq!(times, [0.0, 1.0, 3.0, 7.0, 15.0, 31.0, 61.0, 91.0]);
        let receipt = observe(
            &mut delivery,
            GROUND,
            &ack(7, 1, CommandResult::Accepted),
            after_s(100.0),
        );
        assert_eq!(
            receipt,
            Some(Receipt {
                id: "uav-1-7".to_owned(),
                revision: 1
            })
        );
        assert_eq!(commands(&run(&mut delivery, 100.0, 200.0)), []);
        assert_eq!((delivery.waiting(), delivery.counters().delivered), (0, 1));
    }

    #[test]
    fn an_answer_ends_the_texts_but_one_is_said_in_any_case() {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        run(&mut delivery, 0.0, 0.01);
        observe(
            &mut delivery,
            GROUND,
            &ack(7, 1, CommandResult::Accepted),
            after_s(0.02),
        );
        assert_eq!(texts(&run(&mut delivery, 0.02, 10.0)).len(), 1);
    }

    #[test]
    fn frames_keep_their_distance_and_their_share_of_the_link() {
        let mut delivery = delivery();
        for number in 1..=30 {
            delivery.offer(&alarm(number, 1)).unwrap();
        }
        let sent = run(&mut delivery, 0.0, 120.0);
        for pair in sent.windows(2) {
            assert!(pair[1].at_s - pair[0].at_s > 0.049);
        }
        for window_s in [10.0, 30.0, 119.0] {
            let bytes: usize = sent
                .iter()
                .filter(|s| s.at_s < window_s)
                .map(|s| s.bytes)
                .sum();
            assert!(
                bytes as f64 <= 240.0 + 120.0 * window_s,
                "{bytes} B in {window_s} s"
            );
        }
        let told: std::collections::BTreeSet<FireId> = commands(&sent)
            .into_iter()
            .map(|(_, fire, _)| fire)
            .collect();
        assert_eq!(told.len(), 30, "a busy link starves nobody");
    }

    #[test]
    fn a_new_fire_overtakes_repetitions_and_texts() {
        let mut delivery = delivery();
        for number in 1..=30 {
            delivery.offer(&alarm(number, 1)).unwrap();
        }
        run(&mut delivery, 0.0, 20.0);
        delivery.offer(&alarm(99, 1)).unwrap();
        let first = commands(&run(&mut delivery, 20.0, 22.0));
        assert_eq!(first[0].1, FireId(99));
    }

    #[test]
    fn a_refused_alarm_blocks_no_other() {
        let mut delivery = delivery();
        delivery.offer(&alarm(1, 1)).unwrap();
        delivery.offer(&alarm(2, 1)).unwrap();
        run(&mut delivery, 0.0, 0.6);
        assert_eq!(
            observe(
                &mut delivery,
                GROUND,
                &ack(1, 1, CommandResult::Denied),
                after_s(0.7)
            ),
            None
        );
        assert!(
            observe(
                &mut delivery,
                GROUND,
                &ack(2, 1, CommandResult::Accepted),
                after_s(0.7)
            )
            .is_some()
        );
        assert_eq!((delivery.waiting(), delivery.counters().refused), (1, 1));
        let again = commands(&run(&mut delivery, 0.7, 100.0));
        assert!(again.len() >= 5 && again.iter().all(|(_, fire, _)| *fire == FireId(1)));
    }

    #[test]
    fn answers_that_take_their_time_cost_no_storm_of_repetitions() {
        let mut delivery = delivery();
        for number in 1..=20 {
            delivery.offer(&alarm(number, 1)).unwrap();
        }
        let mut on_the_way: Vec<(f64, FireId)> = Vec::new();
        for step in 0..6_000 {
            let now_s = f64::from(step) * 0.01;
            let sent = commands(&run(&mut delivery, now_s, now_s + 0.01));
            on_the_way.extend(sent.into_iter().map(|(_, fire, _)| (now_s + 0.8, fire)));
            let (come, wait) = on_the_way.into_iter().partition(|(at_s, _)| *at_s <= now_s);
            on_the_way = wait;
            for (_, fire) in come {
                let accepted = ack(fire.0, 1, CommandResult::Accepted);
                observe(&mut delivery, GROUND, &accepted, after_s(now_s));
            }
        }
        assert_eq!(
            (delivery.waiting(), delivery.counters().repetitions),
            (0, 0)
        );
    }

    #[test]
    fn an_alarm_that_cannot_be_told_is_refused_and_blocks_no_other() {
        let mut delivery = delivery();
        let mut nameless = alarm(1, 1);
        nameless.properties.id = "nameless".to_owned();
        assert!(matches!(
            delivery.offer(&nameless),
            Err(MavlinkError::Spatial(_))
        ));
        delivery.offer(&alarm(2, 1)).unwrap();
        assert_eq!(commands(&run(&mut delivery, 0.0, 0.5)).len(), 1);
    }

    #[test]
    fn an_answer_to_an_old_revision_does_not_deliver_the_new_one() {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        run(&mut delivery, 0.0, 0.5);
        delivery.offer(&alarm(7, 2)).unwrap();
        let late = observe(
            &mut delivery,
            GROUND,
            &ack(7, 1, CommandResult::Accepted),
            after_s(0.6),
        );
        assert_eq!((late, delivery.counters().stray_answers), (None, 1));
        assert_eq!(
            commands(&run(&mut delivery, 0.6, 2.0)),
            [(1.0, FireId(7), 2)]
        );
        let receipt = observe(
            &mut delivery,
            GROUND,
            &ack(7, 2, CommandResult::Accepted),
            after_s(2.0),
        );
        assert_eq!(receipt.map(|receipt| receipt.revision), Some(2));
    }

    #[test]
    fn strangers_cannot_acknowledge() {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        run(&mut delivery, 0.0, 0.5);
        let accepted = ack(7, 1, CommandResult::Accepted);
        let stranger = observe(
            &mut delivery,
            Address::new(255, 190),
            &accepted,
            after_s(0.6),
        );
        assert_eq!((stranger, delivery.waiting()), (None, 1));
    }

    #[test]
    fn what_waited_goes_within_two_seconds_of_the_grounds_return() {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        run(&mut delivery, 0.0, 70.0);
        let heartbeat = emberfix_mav::outgoing::companion_heartbeat(true);
        let bytes = Encoder::new(GROUND).encode(&heartbeat);
        let heartbeat = decode(&RawFrame::at_start(&bytes).unwrap().0).unwrap();
        observe(&mut delivery, GROUND, &heartbeat, after_s(70.0));
        assert_eq!(commands(&run(&mut delivery, 70.0, 72.0)).len(), 1);
    }

    #[test]
    fn the_surest_fire_in_sight_is_the_cameras_target_once_a_second() {
        let mut delivery = delivery();
        let mut doubtful = alarm(1, 1);
        doubtful.properties.confidence = 0.6;
        delivery.offer(&doubtful).unwrap();
        delivery.offer(&alarm(2, 1)).unwrap();
        for number in [1, 2] {
            run(&mut delivery, f64::from(number), f64::from(number) + 1.0);
            observe(
                &mut delivery,
                GROUND,
                &ack(number, 1, CommandResult::Accepted),
                after_s(f64::from(number) + 1.0),
            );
        }
        let statuses: Vec<CameraTrackingGeoStatus> = run(&mut delivery, 10.0, 20.0)
            .into_iter()
            .filter_map(|s| match s.says {
                Telemetry::CameraTrackingGeoStatus(status) => Some(status),
                _ => None,
            })
            .collect();
        assert_eq!(statuses.len(), 10);
        assert!((statuses[0].horizontal_sigma_m.unwrap() - 2.5 / 2.146).abs() < 1e-3);
        assert_eq!(statuses[0].altitude.m(), 10.25);
        assert!(run(&mut delivery, 31.0, 60.0).is_empty(), "out of sight");
    }

    #[test]
    fn a_fire_that_is_out_is_said_once_more_and_old_news_say_their_age() {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        run(&mut delivery, 0.0, 10.0);
        observe(
            &mut delivery,
            GROUND,
            &ack(7, 1, CommandResult::Accepted),
            after_s(10.0),
        );
        let mut out = alarm(7, 2);
        out.properties.state = FireState::Out;
        delivery.offer(&out).unwrap();
        let said = texts(&run(&mut delivery, 300.0, 320.0));
        assert_eq!(said.len(), 1);
        assert_eq!(said[0].1, "FIRE 7 OUT 31.409422,119.112017 +-3m 91% 5min");
    }

    #[test]
    fn the_longest_text_keeps_its_coordinates() {
        let mut far = alarm(16_777_215, 1);
        far.properties.ce90_m = 12_345.6;
        far.properties.class = AlarmClass::Smoke;
        far.place = emberfix_frames::place_from_degrees(
            -31.409_422,
            -119.112_017,
            emberfix_frames::EllipsoidHeight::from_m(0.0),
        )
        .unwrap();
        let mut delivery = delivery();
        delivery.offer(&far).unwrap();
        let said = texts(&run(&mut delivery, 0.0, 2.0));
        assert!(
            said[0]
                .1
                .starts_with("SMOKE 16777215 -31.409422,-119.112017 +-12346m")
        );
        assert!(said[0].1.len() <= 50);
    }

    #[test]
    fn more_fires_than_room_wait_in_the_outbox_until_some_are_delivered() {
        let mut delivery = delivery();
        let limit = u32::try_from(MavlinkDelivery::MAX_FIRES).unwrap();
        for number in 1..=limit {
            delivery.offer(&alarm(number, 1)).unwrap();
        }
        let refused = delivery.offer(&alarm(limit + 1, 1));
        assert_eq!(
            refused,
            Err(MavlinkError::Full {
                limit: MavlinkDelivery::MAX_FIRES
            })
        );
        let first = commands(&run(&mut delivery, 0.0, 0.5))[0].1;
        observe(
            &mut delivery,
            GROUND,
            &ack(first.0, 1, CommandResult::Accepted),
            after_s(0.6),
        );
        assert_eq!(delivery.offer(&alarm(limit + 1, 1)), Ok(()));
    }

    fn radio(free_buffer_percent: u8) -> Telemetry {
        Telemetry::RadioStatus(emberfix_mav::telemetry::RadioStatus {
            rssi: None,
            remote_rssi: None,
            free_buffer_percent,
            receive_errors: 0,
        })
    }

    #[test]
    fn a_radio_whose_buffer_fills_slows_us_and_an_empty_one_lets_us_go_on() {
        const RADIO: Address = Address::new(51, 68);
        let sent_in_a_minute = |free: Option<u8>| {
            let mut delivery = delivery();
            for number in 1..=100 {
                delivery.offer(&alarm(number, 1)).unwrap();
            }
            run(&mut delivery, 0.0, 10.0);
            let mut bytes = 0;
            for second in 10..70 {
                let from_s = f64::from(second);
                if let Some(free) = free {
                    observe(&mut delivery, RADIO, &radio(free), after_s(from_s));
                }
                let sent = run(&mut delivery, from_s, from_s + 1.0);
                bytes += sent.iter().map(|sent| sent.bytes).sum::<usize>();
            }
            bytes
        };
        let (free, full) = (sent_in_a_minute(Some(100)), sent_in_a_minute(Some(10)));
        assert_eq!(free, sent_in_a_minute(None));
        assert!(full < free / 5 && full > 400, "{full} of {free} bytes");
    }

    #[test]
    fn what_an_operator_has_seen_is_not_repeated_and_what_was_dismissed_not_shown() {
        let said = |attention| {
            let mut delivery = delivery();
            delivery.offer(&alarm(7, 1)).unwrap();
            let mut sent = run(&mut delivery, 0.0, 0.5);
            delivery.attend(|_| attention);
            sent.extend(run(&mut delivery, 0.5, 20.0));
            let camera = |sent: &&Sent| matches!(sent.says, Telemetry::CameraTrackingGeoStatus(_));
            (texts(&sent).len(), sent.iter().filter(camera).count() > 3)
        };
        assert_eq!(said(Attention::Wanted), (3, true));
        assert_eq!(said(Attention::Seen), (1, true));
        assert_eq!(said(Attention::Dismissed), (1, false));
    }
}
