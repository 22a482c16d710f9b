//! The ground agent on the vehicle's MAVLink network: takes alarm summaries, answers when they are
//! on disk, follows the aircraft.
//!
//! **In:** COMMAND_INT `MAV_CMD_SPATIAL_USER_1` addressed to us, GLOBAL_POSITION_INT.
//! **Out:** HEARTBEAT at 1 Hz (without it no router finds us), critical while the store fails;
//! COMMAND_ACK that names fire and revision ([`spatial::receipt`]), accepted only when the alarm is
//! on disk.
//!
//! Operators' actions: COMMAND_LONG `MAV_CMD_USER_2` to the aircraft's companion ([`orders`]), in
//! order, one at a time per aircraft, again after 1, 2, 4, .. 30 s until its COMMAND_ACK comes.
//!
//! With a signing key, frames that are not signed with it are dropped and counted
//! ([`emberfix_mav::signing`]), ours are signed. An aircraft whose public key is configured is taken at
//! its word here only then: a summary carries no signature of its own.
//!
//! Nothing here asks the vehicle itself to do anything.

use super::config::{MavlinkConfig, Uav};
use super::store::{Completeness, StoreError};
use super::tracks::Source;
use super::{Ping, ReceiveError, Station, lock, now};
use crate::alarm::{Action, Alarm, FireId};
use crate::deliver::default_uav;
use crate::deliver::link::pause_after;
use crate::deliver::orders;
use crate::deliver::signing_file::{SigningFile, SigningFileError};
use crate::deliver::spatial::{self, SpatialError};
use emberfix_frames::{Geoid, ServiceTime};
use emberfix_mav::Judgement;
use emberfix_mav::outgoing::{self, command, companion_heartbeat};
use emberfix_mav::signing::{SigningCounters, USUAL_UNSIGNED};
use emberfix_mav::telemetry::{CommandAck, CommandInt, CommandLong, CommandResult, GlobalPosition};
use emberfix_mav::{
    Address, Chunk, ComponentId, Encoder, Inbox, Link, LinkError, MavMessage, SystemId, Telemetry,
};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

const HEARTBEAT_EVERY: Duration = Duration::from_secs(1);
/// Source of alarms as the store names it.
const LINK_NAME: &str = "mavlink";

/// How the MAVLink side fares, for `/health`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct LinkHealth {
    url: String,
    frames: u64,
    garbage_bytes: u64,
    bad_crc: u64,
    /// Commands that were no alarm, or could not be kept.
    refused: u64,
    /// Frames by what their signatures came to; none without a signing key.
    signing: Option<SigningCounters>,
    last_frame_at: Option<String>,
}

/// Opens what signs and judges frames, if a key is given.
pub(super) fn open_signing(
    config: &MavlinkConfig,
    data_dir: &Path,
) -> Result<Option<SigningFile>, SigningFileError> {
    let Some(key) = config.signing_key.clone() else {
        return Ok(None);
    };
    let path = data_dir.join("mavlink-signing.json");
    SigningFile::open(&path, key, USUAL_UNSIGNED.to_vec(), now()).map(Some)
}

/// Runs the agent until the station stops.
pub(super) async fn run(
    station: Arc<Station>,
    link: Link,
    signing: Option<SigningFile>,
    config: MavlinkConfig,
    uavs: Vec<Uav>,
) {
    let mut stopping = station.stopping.subscribe();
    let agent = Agent::new(station, link, signing, &config, uavs);
    tokio::select! {
        () = agent.run() => {}
        _ = stopping.wait_for(|stop| *stop) => {}
    }
}

struct Agent {
    station: Arc<Station>,
    link: Link,
    inbox: Inbox,
    encoder: Encoder,
    uavs: Vec<Uav>,
    geoid: Geoid,
    /// Whether the store took what it was last given.
    healthy: bool,
    refused: u64,
    last_frame_at: Option<ServiceTime>,
    signing: Option<SigningFile>,
    companions: BTreeMap<Address, Companion>,
}

/// An aircraft's computer that alarms come from.
#[derive(Debug, Default)]
struct Companion {
    /// Greatest number of an action that it took.
    known: u64,
    /// What it is being told, how often it was, and when it is told again.
    telling: Option<(Action, u32, ServiceTime)>,
}

impl Agent {
    fn new(
        station: Arc<Station>,
        link: Link,
        signing: Option<SigningFile>,
        config: &MavlinkConfig,
        uavs: Vec<Uav>,
    ) -> Self {
        let own = Address::new(config.system_id, config.component_id);
        let signer = signing.as_ref().map(|file| file.signer(0, now()));
        Self {
            station,
            link,
            inbox: Inbox::new(),
            encoder: Encoder::new(own).signing(signer),
            uavs,
            geoid: Geoid::new(),
            healthy: true,
            refused: 0,
            last_frame_at: None,
            signing,
            companions: BTreeMap::new(),
        }
    }

    async fn run(mut self) {
        let mut heartbeat = tokio::time::interval(HEARTBEAT_EVERY);
        heartbeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                _ = heartbeat.tick() => {
                    self.keep_time();
                    self.send(&companion_heartbeat(self.healthy)).await;
                    self.tell_actions().await;
                    self.publish_health();
                }
                chunk = self.link.recv() => self.take(&chunk).await,
            }
        }
    }

    async fn take(&mut self, chunk: &Chunk) {
        for received in self.inbox.take(chunk) {
            let sender = received.frame.sender();
            if sender.system == self.encoder.sender().system {
                continue; // our own voice, sent back by a router
            }
            let judgement = self
                .signing
                .as_mut()
                .map(|file| file.judge(&received.frame));
            if matches!(judgement, Some(Judgement::Refused(_))) {
                continue;
            }
            self.link.accept_peer(chunk.from);
            self.last_frame_at = Some(now());
            let proven = judgement == Some(Judgement::Signed);
            match received.telemetry {
                Ok(Telemetry::CommandInt(order)) => self.obey(&order, sender, proven).await,
                Ok(Telemetry::CommandAck(ack)) => self.answered(&ack, sender),
                Ok(Telemetry::SystemTime(time)) if proven => self.note_time(time.utc),
                Ok(Telemetry::GlobalPosition(position)) => self.follow(&position, sender.system),
                // The rest is not for us; what cannot be decoded the inbox has counted.
                Ok(_) | Err(_) => {}
            }
        }
    }

    /// Time goes on for signatures, and what must outlive us is written.
    fn keep_time(&mut self) {
        let now = now();
        self.encoder.advance(now);
        if let Some(file) = &mut self.signing {
            file.note_time(now);
            file.keep(now);
        }
    }

    fn note_time(&mut self, utc: Option<ServiceTime>) {
        if let (Some(file), Some(utc)) = (&mut self.signing, utc) {
            file.note_time(utc);
            self.encoder.advance(utc);
        }
    }

    /// Tells each aircraft that alarms came from what operators did, in order.
    async fn tell_actions(&mut self) {
        let companions: Vec<Address> = self.companions.keys().copied().collect();
        for address in companions {
            if let Some(order) = self.action_due(address).await {
                match outgoing::command_long(&order) {
                    Ok(message) => self.send(&message).await,
                    Err(error) => tracing::error!(%error, "an action could not be written"),
                }
            }
        }
    }

    async fn action_due(&mut self, address: Address) -> Option<CommandLong> {
        let uav = self.name(address.system);
        let companion = self.companions.get(&address)?;
        let (action, times) = match &companion.telling {
            Some((_, _, again_at)) if now() < *again_at => return None,
            Some((action, times, _)) => (action.clone(), *times),
            None => {
                let known = companion.known;
                let known = known.max(self.station.reception.actions_known(&uav));
                let next = self.station.actions_after(&uav, known).await;
                (next.into_iter().next()?, 0)
            }
        };
        let order = orders::encode(&action, address, now());
        let companion = self.companions.get_mut(&address)?;
        if order.is_none() {
            // What does not fit is not told this way, and holds up nothing.
            companion.known = action.number;
            return None;
        }
        let again_at = now() + pause_after(times + 1);
        companion.telling = Some((action, times + 1, again_at));
        order
    }

    /// An aircraft has an action on its disk.
    fn answered(&mut self, ack: &CommandAck, sender: Address) {
        let ours = ack.command == command::USER_2 && ack.target.reaches(self.encoder.sender());
        let Some(companion) = self.companions.get_mut(&sender).filter(|_| ours) else {
            return;
        };
        let Some((action, ..)) = &companion.telling else {
            return;
        };
        let accepted = ack.result == CommandResult::Accepted;
        if accepted && i64::try_from(action.number) == Ok(i64::from(ack.result_param2)) {
            companion.known = action.number;
            companion.telling = None;
            let uav = self.name(sender.system);
            let known = self.companions.get(&sender).map_or(0, |c| c.known);
            self.station
                .fetched(uav, i64::try_from(known).unwrap_or(i64::MAX));
        }
    }

    /// **Bound:** one entry per address that sent an alarm.
    fn note_companion(&mut self, sender: Address) {
        if sender.component != ComponentId::AUTOPILOT {
            self.companions.entry(sender).or_default();
        }
    }

    async fn obey(&mut self, order: &CommandInt, sender: Address, proven: bool) {
        let ours =
            order.command == command::SPATIAL_USER_1 && order.target == self.encoder.sender();
        if !ours {
            return;
        }
        let (receipt, result) = self.keep(order, sender.system, proven).await;
        if result == CommandResult::Accepted {
            self.note_companion(sender);
        }
        if result != CommandResult::Accepted {
            self.refused += 1;
        }
        let ack = CommandAck {
            command: order.command,
            result,
            result_param2: receipt,
            target: sender,
        };
        match outgoing::command_ack(&ack) {
            Ok(message) => self.send(&message).await,
            Err(error) => tracing::error!(%error, "an acknowledgement could not be written"),
        }
    }

    /// Keeps one summary: the receipt's number and what to answer.
    async fn keep(
        &mut self,
        order: &CommandInt,
        system: SystemId,
        proven: bool,
    ) -> (i32, CommandResult) {
        let trusted = self.station.reception.takes_unsigned(&self.name(system));
        if let (Err(error), false) = (trusted, proven) {
            self.station.refuse(&error, LINK_NAME);
            return (0, CommandResult::Denied);
        }
        let (fire, alarm) = match self.read(order, system) {
            Ok(read) => read,
            Err(error) => {
                self.station.refuse(&error, LINK_NAME);
                return (0, CommandResult::Denied);
            }
        };
        let raw = alarm.to_geojson().to_string();
        let kept = self
            .station
            .receive(raw.as_bytes(), LINK_NAME, Completeness::Summary)
            .await;
        let result = match kept {
            Ok(_) => CommandResult::Accepted,
            Err(error) => refusal(&error),
        };
        self.healthy = result != CommandResult::TemporarilyRejected;
        (spatial::receipt(fire, alarm.properties.revision), result)
    }

    fn read(
        &mut self,
        order: &CommandInt,
        system: SystemId,
    ) -> Result<(FireId, Alarm), SpatialError> {
        let summary = spatial::decode(order)?;
        let undulation = self
            .geoid
            .undulation(summary.latitude_deg, summary.longitude_deg);
        let alarm = summary.into_alarm(&self.name(system), now(), undulation)?;
        Ok((summary.fire, alarm))
    }

    fn follow(&mut self, position: &GlobalPosition, system: SystemId) {
        let undulation = self
            .geoid
            .undulation(position.latitude_deg, position.longitude_deg);
        let ping = Ping {
            uav: self.name(system),
            at: now(),
            latitude_deg: position.latitude_deg,
            longitude_deg: position.longitude_deg,
            height_ellipsoid_m: (position.altitude + undulation).m(),
            heading_deg: position
                .heading_rad
                .map(|heading| heading.to_degrees().rem_euclid(360.0)),
            health: "heard over MAVLink only".to_owned(),
        };
        if let Err(error) = self.station.moved(ping, Source::Autopilot) {
            tracing::debug!(%error, "a MAVLink position was refused");
        }
    }

    fn name(&self, system: SystemId) -> String {
        let known = self.uavs.iter().find(|uav| uav.system_id == system.0);
        known.map_or_else(|| default_uav(system), |uav| uav.name.clone())
    }

    async fn send(&mut self, message: &MavMessage) {
        let frame = self.encoder.encode(message);
        match self.link.send(&frame).await {
            Ok(()) | Err(LinkError::NotConnected { .. }) => {}
            Err(error) => tracing::warn!(%error, "a MAVLink frame was not sent"),
        }
    }

    fn publish_health(&self) {
        let counters = self.inbox.counters();
        *lock(&self.station.mavlink) = Some(LinkHealth {
            url: self.link.url().to_string(),
            frames: counters.frames,
            garbage_bytes: counters.garbage_bytes,
            bad_crc: counters.crc,
            refused: self.refused,
            signing: self.signing.as_ref().map(SigningFile::counters),
            last_frame_at: self.last_frame_at.map(ServiceTime::rfc3339),
        });
    }
}

/// A full disk may be emptied, so the aircraft should ask again; a wrong alarm stays wrong.
fn refusal(error: &ReceiveError) -> CommandResult {
    match error {
        ReceiveError::Alarm(_)
        | ReceiveError::Covariance { .. }
        | ReceiveError::Trust(_)
        | ReceiveError::Envelope(_) => CommandResult::Denied,
        ReceiveError::Store(StoreError::Conflict { .. }) => CommandResult::Denied,
        ReceiveError::Store(_) | ReceiveError::Ledger(_) => CommandResult::TemporarilyRejected,
    }
}
