//! Markers on the map of a stock ground station program (QGroundControl, Mission Planner, MAVProxy):
//! each open incident as something that stands still in an `ADSB_VEHICLE`, once a second.
//!
//! **Never towards the vehicle.** An autopilot takes these for traffic and may turn back or land. So
//! the configuration refuses the vehicle's port ([`super::config`]), and this ends for good, loudly,
//! as soon as an autopilot is heard behind the endpoint: a router may lead further than it seems.

use super::Incidents;
use super::config::AdsbConfig;
use super::view;
use crate::ground::incident::Incident;
use emberfix_frames::MslAltitude;
use emberfix_mav::outgoing::companion_heartbeat;
use emberfix_mav::telemetry::Heartbeat;
use emberfix_mav::traffic::{TrafficMarker, traffic_marker};
use emberfix_mav::{Address, Chunk, Encoder, Inbox, Link, LinkError, MavMessage, Telemetry};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::sync::watch;

/// Programs take a marker away after 5 to 120 s.
const EVERY: Duration = Duration::from_secs(1);
/// Markers at once; the radio of a ground station program is not involved, but its map is.
const MAX_MARKERS: usize = 50;
/// Between two markers, so that no receiver's buffer overflows.
const GAP: Duration = Duration::from_millis(5);
/// `MAV_COMP_ID_ONBOARD_COMPUTER`.
const COMPONENT: u8 = 191;
/// Programs look only at addresses that some country could have; MAVProxy from 0x004000 to 0x9fffff.
const ICAO_BASE: u32 = 0x50_0000;
/// `MAV_AUTOPILOT_INVALID`: who says so is no autopilot.
const NO_AUTOPILOT: u8 = 8;

/// How it fares; for the metrics.
#[derive(Debug, Default)]
pub(super) struct Health {
    pub sent: AtomicU64,
    /// Autopilots heard where none may be: 1 and it has ended.
    pub refused: AtomicU64,
}

/// Sends until `incidents` ends, or an autopilot is heard.
pub(super) async fn run(
    config: AdsbConfig,
    link: Link,
    incidents: watch::Receiver<Incidents>,
    health: Arc<Health>,
) {
    let sender = Address::new(config.system_id, COMPONENT);
    let agent = Agent {
        link,
        inbox: Inbox::new(),
        encoder: Encoder::new(sender),
        incidents,
        health,
    };
    agent.run().await;
}

struct Agent {
    link: Link,
    inbox: Inbox,
    encoder: Encoder,
    incidents: watch::Receiver<Incidents>,
    health: Arc<Health>,
}

impl Agent {
    async fn run(mut self) {
        let mut tick = tokio::time::interval(EVERY);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                _ = tick.tick() => self.show().await,
                chunk = self.link.recv() => if self.hears_an_autopilot(&chunk) {
                    self.health.refused.fetch_add(1, Ordering::Relaxed);
                    tracing::error!(url = %self.link.url(), "an autopilot answers on adsb.url: \
                        no marker is sent there any more; give it a port of a ground station program");
                    return;
                },
            }
            if self.incidents.has_changed().is_err() {
                return;
            }
        }
    }

    async fn show(&mut self) {
        self.send(&companion_heartbeat(true)).await;
        let incidents = Arc::clone(&self.incidents.borrow());
        for incident in incidents
            .iter()
            .filter(|incident| view::is_open(incident))
            .take(MAX_MARKERS)
        {
            self.send(&traffic_marker(&marker(incident))).await;
            self.health.sent.fetch_add(1, Ordering::Relaxed);
            tokio::time::sleep(GAP).await;
        }
    }

    async fn send(&mut self, message: &MavMessage) {
        let frame = self.encoder.encode(message);
        match self.link.send(&frame).await {
            Ok(()) | Err(LinkError::NotConnected { .. }) => {}
            Err(error) => tracing::debug!(%error, "a marker was not sent"),
        }
    }

    fn hears_an_autopilot(&mut self, chunk: &Chunk) -> bool {
        self.inbox.take(chunk).into_iter().any(|received| {
            matches!(received.telemetry, Ok(Telemetry::Heartbeat(heartbeat)) if is_autopilot(&heartbeat))
        })
    }
}

fn is_autopilot(heartbeat: &Heartbeat) -> bool {
    heartbeat.autopilot != NO_AUTOPILOT
}

fn marker(incident: &Incident) -> TrafficMarker {
    let [longitude_deg, latitude_deg, _] = incident.coordinates();
    TrafficMarker {
        icao_address: ICAO_BASE | number(&incident.id),
        callsign: format!("FIRE{:04}", number(&incident.id) % 10_000),
        latitude_deg,
        longitude_deg,
        altitude: MslAltitude::from_m(incident.altitude_msl_m),
    }
}

/// The number at the end of an id, `uav-1-7` is 7, or else a hash of it; below 2^20.
fn number(id: &str) -> u32 {
    let digits = id
        .rsplit(|c: char| !c.is_ascii_digit())
        .next()
        .unwrap_or_default();
    let hash = || {
        id.bytes().fold(2_166_136_261_u32, |hash, byte| {
            (hash ^ u32::from(byte)).wrapping_mul(16_777_619)
        })
    };
    digits.parse().unwrap_or_else(|_| hash()) & 0xf_ffff
}
