//! The MAVLink task: the one owner of the port. Announces us, asks for messages and checks that
//! they come, keeps time, hands frames to the pipeline, sends alarms.

use super::core::Input;
use super::{Board, SharedOutbox, lock};
use crate::deliver::mavlink::{MavlinkDelivery, MavlinkSettings};
use crate::ingest::ServiceClock;
use crate::mission::Mission;
use emberfix_frames::{ServiceTime, SignedDuration};
use emberfix_mav::outgoing::{
    companion_heartbeat, set_message_interval, status_text, timesync_request,
};
use emberfix_mav::telemetry::{Severity, StatusText};
use emberfix_mav::{
    Address, Chunk, ComponentId, Encoder, FrameReader, Link, MavMessage, Peer, Received, SystemId,
    Telemetry, message_name,
};
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;
use std::sync::mpsc::SyncSender;
use std::time::Duration;

/// What we ask the autopilot for: message id, rate in Hz.
pub(crate) const WANTED: [(u32, f64); 5] = [
    (31, 50.0), // ATTITUDE_QUATERNION
    (33, 50.0), // GLOBAL_POSITION_INT
    (24, 5.0),  // GPS_RAW_INT
    (2, 1.0),   // SYSTEM_TIME
    (230, 1.0), // ESTIMATOR_STATUS
];
/// A message that comes at less than this share of its rate is asked for again.
const TOO_SLOW: f64 = 0.5;
/// How often rates are checked.
const RATE_CHECK: SignedDuration = SignedDuration::from_secs(5);
const HEARTBEAT: SignedDuration = SignedDuration::from_secs(1);
const TIMESYNC: SignedDuration = SignedDuration::from_millis(100);
/// How often the outbox is looked at.
const OUTBOX_LOOK: SignedDuration = SignedDuration::from_millis(100);
/// How often due work is looked for.
const LOOK: Duration = Duration::from_millis(20);
/// TIMESYNC requests that may still be answered.
const OPEN_REQUESTS: usize = 64;
/// Senders whose broken frames are kept apart; beyond that all start anew.
const MAX_PEERS: usize = 32;

/// The task's state.
pub struct Talk {
    link: Link,
    readers: HashMap<Peer, FrameReader>,
    encoder: Option<Encoder>,
    configured: Option<SystemId>,
    agent: Address,
    delivery: Option<MavlinkDelivery>,
    outbox: SharedOutbox,
    board: Arc<Board>,
    clock: ServiceClock,
    asked: VecDeque<i64>,
    counted: BTreeMap<u32, u32>,
    shed: u64,
    heartbeat_due: ServiceTime,
    timesync_due: ServiceTime,
    rates_due: ServiceTime,
    outbox_due: ServiceTime,
    /// Alarms that can't be told this way, so that each is complained of once.
    refused: BTreeMap<String, u32>,
    /// What the operator was told last.
    warned: Vec<&'static str>,
}

impl Talk {
    pub fn new(
        link: Link,
        mission: &Mission,
        outbox: SharedOutbox,
        board: Arc<Board>,
        clock: ServiceClock,
    ) -> Self {
        let now = clock();
        let (system, component) = mission.ground.agent;
        Self {
            link,
            readers: HashMap::new(),
            encoder: None,
            configured: (mission.system_id != 0).then_some(SystemId(mission.system_id)),
            agent: Address::new(system, component),
            delivery: None,
            outbox,
            board,
            clock,
            asked: VecDeque::new(),
            counted: BTreeMap::new(),
            shed: 0,
            heartbeat_due: now,
            timesync_due: now,
            rates_due: now,
            outbox_due: now,
            refused: BTreeMap::new(),
            warned: Vec::new(),
        }
    }

    /// Runs until it is aborted.
    pub async fn run(mut self, events: SyncSender<Input>) {
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                chunk = self.link.recv() => self.take(&chunk, &events),
                _ = look.tick() => self.work_off().await,
            }
        }
    }

    fn take(&mut self, chunk: &Chunk, events: &SyncSender<Input>) {
        let arrived = (self.clock)();
        if self.readers.len() >= MAX_PEERS && !self.readers.contains_key(&chunk.from) {
            self.readers.clear();
        }
        let reader = self.readers.entry(chunk.from).or_default();
        reader.push(&chunk.bytes);
        let mut frames = Vec::new();
        while let Some(received) = reader.next_received() {
            frames.push(received);
        }
        for received in frames {
            self.take_frame(arrived, chunk.from, received, events);
        }
    }

    fn take_frame(
        &mut self,
        arrived: ServiceTime,
        from: Peer,
        received: Received,
        events: &SyncSender<Input>,
    ) {
        let sender = received.frame.sender();
        self.note_vehicle(&received, from);
        match &received.telemetry {
            // Replies to what we never asked are no evidence of any clock.
            Ok(Telemetry::TimeSync(sync)) if !sync.is_request() && !self.was_asked(sync.ts1_ns) => {
                return;
            }
            Ok(telemetry) => self.observe(sender, telemetry, arrived),
            Err(_) => {}
        }
        if Some(sender.system) == self.vehicle() {
            *self.counted.entry(received.frame.message_id).or_default() += 1;
        }
        let input = Input::Mavlink {
            arrived,
            received: Box::new(received),
        };
        if events.try_send(input).is_err() {
            self.shed += 1;
            if self.shed.is_power_of_two() {
                tracing::warn!(
                    shed = self.shed,
                    "telemetry dropped: the pipeline does not keep up"
                );
            }
        }
    }

    /// The vehicle is the configured one, or the first autopilot that is heard; we then take its
    /// system id and speak as its companion computer.
    fn note_vehicle(&mut self, received: &Received, from: Peer) {
        let autopilot =
            matches!(&received.telemetry, Ok(Telemetry::Heartbeat(h)) if h.is_autopilot());
        let system = received.system();
        let ours = self
            .configured
            .is_none_or(|configured| configured == system);
        if self.encoder.is_none() && autopilot && ours {
            let own = Address {
                system,
                component: ComponentId::ONBOARD_COMPUTER,
            };
            self.encoder = Some(Encoder::new(own));
            self.delivery = Some(MavlinkDelivery::new(MavlinkSettings {
                ground: self.agent,
                ..MavlinkSettings::new(own)
            }));
            tracing::info!(system = system.0, "vehicle heard");
        }
        // The ground agent may have a port of its own; whoever else is there is not talked to.
        if Some(system) == self.vehicle() || received.frame.sender() == self.agent {
            self.link.accept_peer(from);
        }
    }

    fn vehicle(&self) -> Option<SystemId> {
        self.encoder.as_ref().map(|encoder| encoder.sender().system)
    }

    fn was_asked(&mut self, ts1_ns: i64) -> bool {
        let place = self.asked.iter().position(|asked| *asked == ts1_ns);
        place.and_then(|place| self.asked.remove(place)).is_some()
    }

    fn observe(&mut self, sender: Address, telemetry: &Telemetry, now: ServiceTime) {
        let delivery = self.delivery.as_mut();
        let Some(receipt) = delivery.and_then(|d| d.observe(sender, telemetry, now)) else {
            return;
        };
        let stored =
            lock(&self.outbox).acknowledge(MavlinkDelivery::NAME, &receipt.id, receipt.revision);
        if let Err(error) = stored {
            tracing::error!(%error, "receipt not stored; it will be sent again");
        }
    }

    async fn work_off(&mut self) {
        let now = (self.clock)();
        let Some(vehicle) = self.vehicle() else {
            return;
        };
        let autopilot = Address {
            system: vehicle,
            component: ComponentId::AUTOPILOT,
        };
        if now >= self.heartbeat_due {
            self.heartbeat_due = now + HEARTBEAT;
            if self.board.is_healthy() {
                self.send(&companion_heartbeat(true)).await;
            }
            self.tell_warnings().await;
        }
        if now >= self.timesync_due {
            self.timesync_due = now + TIMESYNC;
            if self.asked.len() == OPEN_REQUESTS {
                self.asked.pop_front();
            }
            let asked = (self.clock)().unix_ns();
            self.asked.push_back(asked);
            self.send(&timesync_request(autopilot, asked)).await;
        }
        if now >= self.rates_due {
            self.rates_due = now + RATE_CHECK;
            self.check_rates(autopilot).await;
        }
        self.tell_alarms(now).await;
    }

    /// Tells the operator of each warning when it comes up, once.
    async fn tell_warnings(&mut self) {
        let warnings = self.board.latest().health.warnings.clone();
        let news: Vec<_> = warnings
            .iter()
            .filter(|warning| !self.warned.contains(warning))
            .map(|warning| StatusText {
                severity: Severity::Warning,
                text: (*warning).to_owned(),
            })
            .collect();
        self.warned = warnings;
        for text in &news {
            self.send(&status_text(text)).await;
        }
    }

    async fn check_rates(&mut self, autopilot: Address) {
        let counted = std::mem::take(&mut self.counted);
        for (id, wanted_hz) in WANTED {
            let came_hz =
                f64::from(counted.get(&id).copied().unwrap_or(0)) / RATE_CHECK.as_secs_f64();
            if came_hz < TOO_SLOW * wanted_hz {
                tracing::info!(
                    message = message_name(id),
                    came_hz,
                    wanted_hz,
                    "asking for rate"
                );
                self.send(&set_message_interval(autopilot, id, wanted_hz))
                    .await;
            }
        }
    }

    async fn tell_alarms(&mut self, now: ServiceTime) {
        if now >= self.outbox_due {
            self.outbox_due = now + OUTBOX_LOOK;
            self.offer_pending();
        }
        while let Some(message) = self
            .delivery
            .as_mut()
            .and_then(|delivery| delivery.poll(now))
        {
            self.send(&message).await;
        }
    }

    fn offer_pending(&mut self) {
        let pending = lock(&self.outbox).pending(MavlinkDelivery::NAME, MavlinkDelivery::MAX_FIRES);
        let (Ok(pending), Some(delivery)) = (pending, &mut self.delivery) else {
            tracing::error!("outbox not readable");
            return;
        };
        for alarm in &pending {
            if let Err(error) = delivery.offer(alarm) {
                let (id, revision) = (alarm.properties.id.clone(), alarm.properties.revision);
                if self.refused.insert(id, revision) != Some(revision) {
                    tracing::warn!(%error, id = alarm.properties.id, "alarm not told over MAVLink");
                }
            }
        }
    }

    async fn send(&mut self, message: &MavMessage) {
        let Some(encoder) = &mut self.encoder else {
            return;
        };
        let frame = encoder.encode(message);
        if let Err(error) = self.link.send(&frame).await {
            tracing::debug!(%error, "MAVLink frame not sent");
        }
    }
}
