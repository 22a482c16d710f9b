//! The autopilot: heard as the service hears it, asked for what the service asks for.

use crate::mission::Mission;
use crate::service::{WANTED, service_clock};
use emberfix_frames::{
    EllipsoidHeight, ServiceTime, SyncQuality, TimeSync, TimeSyncSample, Wgs84, place_from_degrees,
};
use emberfix_mav::outgoing::{companion_heartbeat, set_message_interval, timesync_request};
use emberfix_mav::telemetry::{EstimatorStatus, GlobalPosition, GpsRaw, Heartbeat, SystemTime};
use emberfix_mav::wire::WireCounters;
use emberfix_mav::{
    Address, Chunk, ComponentId, Encoder, Inbox, Link, LinkUrl, LinkUrlError, MavMessage, Received,
    SystemId, Telemetry,
};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

/// What was heard on MAVLink.
#[derive(Debug, Clone, Default)]
pub struct AutopilotSeen {
    /// Why the port could not be opened.
    pub broken: Option<String>,
    /// Whether the probe did not come back.
    pub hangs: bool,
    /// What stood on the wire.
    pub wire: WireCounters,
    /// The vehicle: the mission's, or the first autopilot that was heard.
    pub vehicle: Option<SystemId>,
    /// Its latest heartbeat.
    pub heartbeat: Option<Heartbeat>,
    /// Its heartbeats.
    pub heartbeats: u32,
    /// Other autopilots, by system id.
    pub others: BTreeSet<u8>,
    /// Whether our ground agent was heard.
    pub agent_heard: bool,
    /// The vehicle's messages, by id, counted over `counted_s`.
    pub counts: BTreeMap<u32, u32>,
    /// For how long messages were counted, seconds.
    pub counted_s: f64,
    /// Messages that say what cannot be, by reason.
    pub refused: BTreeMap<&'static str, u32>,
    /// The latest of the receiver.
    pub gnss: Option<GpsRaw>,
    /// The latest of the estimator on itself.
    pub estimator: Option<EstimatorStatus>,
    /// The latest position.
    pub position: Option<GlobalPosition>,
    /// The autopilot's UTC minus ours, seconds, where it has one.
    pub utc_ahead_s: Option<f64>,
    /// How the clocks were related.
    pub sync: Option<SyncSeen>,
}

/// How autopilot clock and ours were related.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SyncSeen {
    /// By what.
    pub quality: SyncQuality,
    /// One sigma, seconds.
    pub sigma_s: Option<f64>,
    /// Requests.
    pub asked: u32,
    /// Answers.
    pub answered: u32,
}

/// What the autopilot is given to settle on the rates that it is asked for.
const SETTLING: Duration = Duration::from_millis(1500);
const HEARTBEAT: Duration = Duration::from_secs(1);
const TIMESYNC: Duration = Duration::from_millis(100);
const LOOK: Duration = Duration::from_millis(20);
/// TIMESYNC requests that may still be answered.
const OPEN_REQUESTS: usize = 64;

impl AutopilotSeen {
    /// For a probe that never came back.
    #[must_use]
    pub fn hanging() -> Self {
        Self {
            hangs: true,
            ..Self::default()
        }
    }

    /// Messages per second of an id.
    #[must_use]
    pub fn rate_hz(&self, id: u32) -> f64 {
        let count = f64::from(self.counts.get(&id).copied().unwrap_or(0));
        if self.counted_s > 0.0 {
            count / self.counted_s
        } else {
            0.0
        }
    }

    /// Where the vehicle stands: the receiver's own height where it gives one.
    #[must_use]
    pub fn place(&self) -> Option<Wgs84> {
        let place = self.gnss?.place?;
        let geoid = emberfix_frames::Geoid::new();
        let height: EllipsoidHeight = place.height.unwrap_or_else(|| {
            place.altitude + geoid.undulation(place.latitude_deg, place.longitude_deg)
        });
        place_from_degrees(place.latitude_deg, place.longitude_deg, height).ok()
    }
}

/// Listens for `listen` from the first heartbeat, which is waited for as long as `patience` beyond that.
#[must_use]
pub fn hear(mission: &Mission, listen: Duration, patience: Duration) -> AutopilotSeen {
    let broken = |reason: String| AutopilotSeen {
        broken: Some(reason),
        ..AutopilotSeen::default()
    };
    let url: LinkUrl = match mission.mavlink_url.parse() {
        Ok(url) => url,
        Err(error) => return broken(LinkUrlError::to_string(&error)),
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    match runtime {
        Ok(runtime) => runtime.block_on(async {
            match Link::open(&url).await {
                Ok(link) => Ear::new(link, mission).listen(listen, patience).await,
                Err(error) => broken(error.to_string()),
            }
        }),
        Err(error) => broken(error.to_string()),
    }
}

struct Ear {
    link: Link,
    inbox: Inbox,
    configured: Option<SystemId>,
    agent: Address,
    encoder: Option<Encoder>,
    clock: crate::ingest::ServiceClock,
    sync: TimeSync,
    asked: VecDeque<i64>,
    asked_count: u32,
    answered: u32,
    first_heard: Option<Instant>,
    seen: AutopilotSeen,
}

impl Ear {
    fn new(link: Link, mission: &Mission) -> Self {
        let (system, component) = mission.ground.agent;
        Self {
            link,
            inbox: Inbox::new(),
            configured: (mission.system_id != 0).then_some(SystemId(mission.system_id)),
            agent: Address::new(system, component),
            encoder: None,
            clock: service_clock(),
            sync: TimeSync::new(),
            asked: VecDeque::new(),
            asked_count: 0,
            answered: 0,
            first_heard: None,
            seen: AutopilotSeen::default(),
        }
    }

    async fn listen(mut self, listen: Duration, patience: Duration) -> AutopilotSeen {
        let begun = Instant::now();
        let (mut heartbeat_due, mut timesync_due) = (begun, begun);
        let mut rates_asked = false;
        let mut look = tokio::time::interval(LOOK);
        loop {
            tokio::select! {
                chunk = self.link.recv() => self.take(&chunk),
                _ = look.tick() => {}
            }
            let now = Instant::now();
            let end = self
                .first_heard
                .map_or(begun + patience + listen, |heard| heard + SETTLING + listen);
            if now >= end {
                break;
            }
            if let Some(vehicle) = self.seen.vehicle {
                let autopilot = Address {
                    system: vehicle,
                    component: ComponentId::AUTOPILOT,
                };
                if now >= heartbeat_due {
                    heartbeat_due = now + HEARTBEAT;
                    self.send(&companion_heartbeat(true)).await;
                }
                if now >= timesync_due {
                    timesync_due = now + TIMESYNC;
                    self.ask_time(autopilot).await;
                }
                if !std::mem::replace(&mut rates_asked, true) {
                    for (id, wanted_hz) in WANTED {
                        self.send(&set_message_interval(autopilot, id, wanted_hz))
                            .await;
                    }
                }
            }
        }
        self.finish()
    }

    fn finish(mut self) -> AutopilotSeen {
        self.seen.wire = self.inbox.counters();
        self.seen.counted_s = self.first_heard.map_or(0.0, |heard| {
            heard.elapsed().saturating_sub(SETTLING).as_secs_f64()
        });
        self.seen.sync = self.first_heard.map(|_| SyncSeen {
            quality: self.sync.quality(),
            sigma_s: self.sync.sigma_s(),
            asked: self.asked_count,
            answered: self.answered,
        });
        self.seen
    }

    fn take(&mut self, chunk: &Chunk) {
        let arrived = (self.clock)();
        for received in self.inbox.take(chunk) {
            self.note_vehicle(&received);
            let sender = received.frame.sender();
            self.seen.agent_heard |= sender == self.agent;
            let of_vehicle = Some(sender.system) == self.seen.vehicle;
            if of_vehicle || sender == self.agent {
                self.link.accept_peer(chunk.from);
            }
            if of_vehicle && sender.component == ComponentId::AUTOPILOT {
                self.take_message(&received, arrived);
            }
        }
    }

    fn note_vehicle(&mut self, received: &Received) {
        let Ok(Telemetry::Heartbeat(heartbeat)) = &received.telemetry else {
            return;
        };
        if !heartbeat.is_autopilot() {
            return;
        }
        let system = received.system();
        let ours = self.configured.is_none_or(|wanted| wanted == system);
        if self.seen.vehicle.is_none() && ours {
            self.seen.vehicle = Some(system);
            self.first_heard = Some(Instant::now());
            self.encoder = Some(Encoder::new(Address {
                system,
                component: ComponentId::ONBOARD_COMPUTER,
            }));
        } else if self.seen.vehicle != Some(system) {
            self.seen.others.insert(system.0);
        }
    }

    fn take_message(&mut self, received: &Received, arrived: ServiceTime) {
        let settled = self
            .first_heard
            .is_some_and(|heard| heard.elapsed() >= SETTLING);
        if settled {
            *self
                .seen
                .counts
                .entry(received.frame.message_id)
                .or_default() += 1;
        }
        match &received.telemetry {
            Ok(telemetry) => self.take_telemetry(telemetry, arrived),
            Err(error) => *self.seen.refused.entry(error.name()).or_default() += 1,
        }
    }

    fn take_telemetry(&mut self, telemetry: &Telemetry, arrived: ServiceTime) {
        match telemetry {
            Telemetry::Heartbeat(heartbeat) => {
                self.seen.heartbeat = Some(*heartbeat);
                self.seen.heartbeats += 1;
            }
            Telemetry::Attitude(sample) => self.sync.add_arrival(sample.boot, arrived),
            Telemetry::GlobalPosition(position) => self.seen.position = Some(*position),
            Telemetry::GpsRaw(raw) => self.seen.gnss = Some(*raw),
            Telemetry::EstimatorStatus(status) => self.seen.estimator = Some(*status),
            Telemetry::SystemTime(time) => self.take_utc(time, arrived),
            Telemetry::TimeSync(sync) if !sync.is_request() => {
                let Some(open) = self.asked.iter().position(|asked| *asked == sync.ts1_ns) else {
                    return;
                };
                self.asked.remove(open);
                self.answered += 1;
                self.sync.add(TimeSyncSample {
                    asked: ServiceTime::from_unix_ns(sync.ts1_ns),
                    remote: emberfix_frames::BootTime::from_ns(sync.tc1_ns),
                    answered: arrived,
                });
            }
            _ => {}
        }
    }

    fn take_utc(&mut self, time: &SystemTime, arrived: ServiceTime) {
        if let Some(utc) = time.utc {
            self.seen.utc_ahead_s = Some((utc - arrived).as_secs_f64());
        }
    }

    async fn ask_time(&mut self, autopilot: Address) {
        if self.asked.len() == OPEN_REQUESTS {
            self.asked.pop_front();
        }
        let asked = (self.clock)().unix_ns();
        self.asked.push_back(asked);
        self.asked_count += 1;
        self.send(&timesync_request(autopilot, asked)).await;
    }

    async fn send(&mut self, message: &MavMessage) {
        let Some(encoder) = &mut self.encoder else {
            return;
        };
        let frame = encoder.encode(message);
        // Who cannot be reached does not answer, and that is what is judged.
        let _sent = self.link.send(&frame).await;
    }
}
