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

mod pace;
mod telling;
mod words;

pub use pace::Pacing;

use super::link::{AlarmLink, FIRST_RETRY, Letter, Settled};
use super::spatial::{self, SpatialError, SpatialReceipt};
use super::{Receipt, fire_number};
use crate::alarm::{Alarm, Attention, FireId};
use emberfix_frames::{ServiceTime, SignedDuration};
use emberfix_mav::outgoing::{camera_tracking_geo_status, command, command_int, status_text};
use emberfix_mav::telemetry::{CommandAck, CommandResult, Telemetry};
use emberfix_mav::{Address, EncodeError, Encoder, MavMessage};
use pace::Pace;
use std::collections::BTreeMap;
use telling::{CommandState, Telling};
use words::{camera_status, text};

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

#[cfg(test)]
mod tests;
