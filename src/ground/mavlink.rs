//! The ground agent on the vehicle's MAVLink network: takes alarm summaries, answers when they are
//! on disk, follows the aircraft.
//!
//! **In:** COMMAND_INT `MAV_CMD_SPATIAL_USER_1` addressed to us, GLOBAL_POSITION_INT.
//! **Out:** HEARTBEAT at 1 Hz (without it no router finds us), critical while the store fails;
//! COMMAND_ACK that names fire and revision ([`spatial::receipt`]), accepted only when the alarm is
//! on disk.
//!
//! Nothing here asks the vehicle to do anything.

use super::config::{MavlinkConfig, Uav};
use super::store::{Completeness, StoreError};
use super::tracks::Source;
use super::{Ping, ReceiveError, Station, lock, now};
use crate::alarm::{Alarm, FireId};
use crate::deliver::default_uav;
use crate::deliver::spatial::{self, SpatialError};
use emberfix_frames::{Geoid, ServiceTime};
use emberfix_mav::outgoing::{self, command, companion_heartbeat};
use emberfix_mav::telemetry::{CommandAck, CommandInt, CommandResult, GlobalPosition};
use emberfix_mav::{
    Address, Chunk, Encoder, Inbox, Link, LinkError, MavMessage, SystemId, Telemetry,
};
use serde::Serialize;
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
    last_frame_at: Option<String>,
}

/// Runs the agent until the station stops.
pub(super) async fn run(station: Arc<Station>, link: Link, config: MavlinkConfig, uavs: Vec<Uav>) {
    let mut stopping = station.stopping.subscribe();
    let agent = Agent::new(station, link, &config, uavs);
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
}

impl Agent {
    fn new(station: Arc<Station>, link: Link, config: &MavlinkConfig, uavs: Vec<Uav>) -> Self {
        Self {
            station,
            link,
            inbox: Inbox::new(),
            encoder: Encoder::new(Address::new(config.system_id, config.component_id)),
            uavs,
            geoid: Geoid::new(),
            healthy: true,
            refused: 0,
            last_frame_at: None,
        }
    }

    async fn run(mut self) {
        let mut heartbeat = tokio::time::interval(HEARTBEAT_EVERY);
        heartbeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                _ = heartbeat.tick() => {
                    self.send(&companion_heartbeat(self.healthy)).await;
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
            self.link.accept_peer(chunk.from);
            self.last_frame_at = Some(now());
            match received.telemetry {
                Ok(Telemetry::CommandInt(order)) => self.obey(&order, sender).await,
                Ok(Telemetry::GlobalPosition(position)) => self.follow(&position, sender.system),
                // The rest is not for us; what cannot be decoded the inbox has counted.
                Ok(_) | Err(_) => {}
            }
        }
    }

    async fn obey(&mut self, order: &CommandInt, sender: Address) {
        let ours =
            order.command == command::SPATIAL_USER_1 && order.target == self.encoder.sender();
        if !ours {
            return;
        }
        let (receipt, result) = self.keep(order, sender.system).await;
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
    async fn keep(&mut self, order: &CommandInt, system: SystemId) -> (i32, CommandResult) {
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
            last_frame_at: self.last_frame_at.map(ServiceTime::rfc3339),
        });
    }
}

/// A full disk may be emptied, so the aircraft should ask again; a wrong alarm stays wrong.
fn refusal(error: &ReceiveError) -> CommandResult {
    match error {
        ReceiveError::Alarm(_) | ReceiveError::Covariance { .. } => CommandResult::Denied,
        ReceiveError::Store(StoreError::Conflict { .. }) => CommandResult::Denied,
        ReceiveError::Store(_) => CommandResult::TemporarilyRejected,
    }
}
