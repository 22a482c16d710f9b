//! The MAVLink task: the one owner of the port. Announces us, asks for messages and checks that
//! they come, keeps time, hands frames to the pipeline, sends alarms.

use super::core::Input;
use super::courier::keep_action;
use super::{Board, SharedOutbox, lock};
use crate::deliver::mavlink::{MavlinkDelivery, MavlinkSettings};
use crate::deliver::signing_file::SigningFile;
use crate::deliver::{AlarmLink, Receipt, Settled, orders};
use crate::ingest::ServiceClock;
use crate::mission::Mission;
use emberfix_frames::{ServiceTime, SignedDuration};
use emberfix_mav::outgoing::{
    command, command_ack, companion_heartbeat, set_message_interval, status_text, timesync_request,
};
use emberfix_mav::signing::SIGNATURE_LEN;
use emberfix_mav::telemetry::{CommandAck, CommandResult, Severity, StatusText};
use emberfix_mav::{
    Address, Chunk, ComponentId, Encoder, FrameReader, Judgement, Link, MavMessage, Peer, Received,
    SystemId, Telemetry, message_name,
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
    signing: Option<SigningFile>,
    uav: String,
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
        signing: Option<SigningFile>,
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
            signing,
            uav: mission.uav.clone(),
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
                chunk = self.link.recv() => self.take(&chunk, &events).await,
                _ = look.tick() => self.work_off().await,
            }
        }
    }

    async fn take(&mut self, chunk: &Chunk, events: &SyncSender<Input>) {
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
            let judgement = self
                .signing
                .as_mut()
                .map(|file| file.judge(&received.frame));
            if matches!(judgement, Some(Judgement::Refused(_))) {
                continue;
            }
            if let Some(answer) = self.obey(&received, arrived, events) {
                self.send(&answer).await;
            }
            if judgement == Some(Judgement::Signed) {
                self.note_time(&received);
            }
            self.take_frame(arrived, chunk.from, received, events);
        }
    }

    /// An operator's action from our ground agent: kept, then answered.
    fn obey(
        &mut self,
        received: &Received,
        now: ServiceTime,
        events: &SyncSender<Input>,
    ) -> Option<MavMessage> {
        let own = self.encoder.as_ref()?.sender();
        let sender = received.frame.sender();
        let order = match &received.telemetry {
            Ok(Telemetry::CommandLong(order)) => order,
            _ => return None,
        };
        if order.command != command::USER_2 || sender != self.agent || order.target != own {
            return None;
        }
        let action = orders::decode(order, &self.uav, now);
        let number = action.as_ref().map_or(0, |action| action.number);
        let kept = action.map(|action| keep_action(&self.outbox, Some(events), action));
        let result = match kept {
            Some(true) => CommandResult::Accepted,
            Some(false) => CommandResult::TemporarilyRejected,
            None => CommandResult::Denied,
        };
        command_ack(&CommandAck {
            command: order.command,
            result,
            result_param2: i32::try_from(number).unwrap_or(0),
            target: sender,
        })
        .ok()
    }

    /// The UTC of a signed autopilot counts for signatures.
    fn note_time(&mut self, received: &Received) {
        let utc = match &received.telemetry {
            Ok(Telemetry::SystemTime(time)) => time.utc,
            _ => None,
        };
        if let (Some(utc), Some(file)) = (utc, &mut self.signing) {
            file.note_time(utc);
            if let Some(encoder) = &mut self.encoder {
                encoder.advance(utc);
            }
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
            let signer = self
                .signing
                .as_ref()
                .map(|file| file.signer(0, (self.clock)()));
            let signature_bytes = if signer.is_some() { SIGNATURE_LEN } else { 0 };
            self.encoder = Some(Encoder::new(own).signing(signer));
            self.delivery = Some(MavlinkDelivery::new(MavlinkSettings {
                ground: self.agent,
                signature_bytes,
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
        if let Some(delivery) = &mut self.delivery {
            delivery.observe(sender, telemetry, now);
        }
    }

    /// Signatures go on with the clock, and what must outlive us is written.
    fn keep_time(&mut self, now: ServiceTime) {
        if let Some(file) = &mut self.signing {
            file.note_time(now);
            file.keep(now);
        }
        if let Some(encoder) = &mut self.encoder {
            encoder.advance(now);
        }
    }

    async fn work_off(&mut self) {
        let now = (self.clock)();
        self.keep_time(now);
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
            self.offer_pending(now);
        }
        while let Some(message) = self
            .delivery
            .as_mut()
            .and_then(|delivery| delivery.poll(now))
        {
            self.send(&message).await;
        }
    }

    fn offer_pending(&mut self, now: ServiceTime) {
        let Some(delivery) = &mut self.delivery else {
            return;
        };
        let mut outbox = lock(&self.outbox);
        let pending = match outbox.pending(MavlinkDelivery::NAME, MavlinkDelivery::MAX_FIRES) {
            Ok(pending) => pending,
            Err(error) => {
                tracing::error!(%error, "outbox not readable");
                return;
            }
        };
        let settled = delivery.work(&pending, now);
        delivery.attend(|id| outbox.attention(id));
        let receipts: Vec<Receipt> = settled.iter().filter_map(delivered).collect();
        if !receipts.is_empty()
            && let Err(error) = outbox.acknowledge_all(MavlinkDelivery::NAME, &receipts)
        {
            tracing::error!(%error, "receipts not stored; these alarms will be sent again");
        }
        drop(outbox);
        self.complain(&settled);
    }

    /// Once per revision.
    fn complain(&mut self, settled: &[Settled]) {
        for settled in settled {
            if let Settled::Refused {
                id,
                revision,
                reason,
            } = settled
                && self.refused.insert(id.clone(), *revision) != Some(*revision)
            {
                tracing::warn!(id, reason, "alarm not told over MAVLink");
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

fn delivered(settled: &Settled) -> Option<Receipt> {
    match settled {
        Settled::Delivered(receipt) => Some(receipt.clone()),
        Settled::Refused { .. } | Settled::Unreachable { .. } => None,
    }
}
