//! An autopilot that speaks MAVLink the way PX4 does, without I/O.
//!
//! **In:** flight time in seconds, and the frames that the service sends. **Out:** frames with the
//! flight time at which they leave: HEARTBEAT, ATTITUDE_QUATERNION, GLOBAL_POSITION_INT, GPS_RAW_INT,
//! SYSTEM_TIME, ESTIMATOR_STATUS, HOME_POSITION, TIMESYNC; answers to TIMESYNC, SET_MESSAGE_INTERVAL
//! and REQUEST_MESSAGE. Its clock counts from its boot and drifts; nobody is told the offset.
//! **Known limits.** No missions, parameters or modes; its estimator never loses a sensor.
//!
//! The queue of what waits to leave is bounded by the rates and the latency (about a dozen).

mod errors;
mod sensors;

pub use errors::{ErrorsConfig, SensorErrors};

use crate::earth::Lla;
use crate::flight::Flight;
use crate::noise::stream;
use emberfix_frames::{ServiceTime, seconds};
use emberfix_mav::outgoing::{self, Encoder, MavMessage, command, message_id};
use emberfix_mav::telemetry::{
    CommandAck, CommandLong, CommandResult, StatusText, SystemTime, Telemetry, TimeSyncMessage,
    decode,
};
use emberfix_mav::wire::{Address, ComponentId, RawFrame};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use sensors::Sensors;
use serde::Deserialize;
use std::sync::Arc;

/// `[sim.autopilot]`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutopilotConfig {
    /// How long before the flight's start the autopilot booted, seconds.
    pub booted_before_s: f64,
    /// How much too fast its clock runs, parts per million.
    pub clock_drift_ppm: f64,
    /// Geoid above ellipsoid that its receiver assumes, metres; EGM96 at the datum when absent.
    pub undulation_m: Option<f64>,
}

impl Default for AutopilotConfig {
    fn default() -> Self {
        Self {
            booted_before_s: 212.4,
            clock_drift_ppm: 12.0,
            undulation_m: None,
        }
    }
}

/// A frame on its way out.
#[derive(Debug, Clone, PartialEq)]
pub struct Outgoing {
    /// Flight time at which it reaches the service's port.
    pub leaves_s: f64,
    /// The frame.
    pub bytes: Vec<u8>,
}

/// What came from the service, for the report.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Heard {
    /// Heartbeats of the companion computer (component 191).
    pub heartbeats: u64,
    /// TIMESYNC requests that were answered.
    pub timesync_requests: u64,
    /// Lines for people; the first [`Heard::MAX_TEXTS`].
    pub texts: Vec<String>,
    /// Frames that could not be decoded.
    pub undecodable: u64,
}

impl Heard {
    /// Texts kept; later ones are dropped.
    pub const MAX_TEXTS: usize = 1000;
}

/// The simulated autopilot.
#[derive(Debug)]
pub struct Autopilot {
    sensors: Sensors,
    start: ServiceTime,
    streams: Vec<Stream>,
    latency: Latency,
    waiting: Vec<Waiting>,
    encoder: Encoder,
    me: Address,
    heard: Heard,
}

#[derive(Debug)]
struct Waiting {
    leaves_s: f64,
    message: MavMessage,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StreamKind {
    Heartbeat,
    SystemTime,
    GpsRaw,
    AttitudeQuaternion,
    GlobalPosition,
    TimeSync,
    EstimatorStatus,
    HomePosition,
}

#[derive(Debug)]
struct Stream {
    kind: StreamKind,
    /// `None` while switched off.
    interval_s: Option<f64>,
    next_s: f64,
    rng: ChaCha8Rng,
}

impl StreamKind {
    /// Kind, message id, rate in Hz of PX4's "onboard" profile. The profile sends GPS_RAW_INT as the
    /// receiver delivers, here 5 Hz.
    const ALL: [(Self, u32, f64); 8] = [
        (Self::Heartbeat, message_id::HEARTBEAT, 1.0),
        (Self::SystemTime, message_id::SYSTEM_TIME, 1.0),
        (Self::GpsRaw, message_id::GPS_RAW_INT, 5.0),
        (
            Self::AttitudeQuaternion,
            message_id::ATTITUDE_QUATERNION,
            50.0,
        ),
        (Self::GlobalPosition, message_id::GLOBAL_POSITION_INT, 50.0),
        (Self::TimeSync, message_id::TIMESYNC, 10.0),
        (Self::EstimatorStatus, message_id::ESTIMATOR_STATUS, 1.0),
        (Self::HomePosition, message_id::HOME_POSITION, 0.5),
    ];

    fn default_interval_s(self) -> f64 {
        Self::ALL
            .iter()
            .find(|row| row.0 == self)
            .map_or(1.0, |row| 1.0 / row.2)
    }

    fn of_message(message_id: f32) -> Option<Self> {
        let row = Self::ALL.iter().find(|row| row.1 as f32 == message_id);
        row.map(|row| row.0)
    }
}

/// From measuring to the service's port.
#[derive(Debug)]
struct Latency {
    least_s: f64,
    jitter_s: f64,
    rng: ChaCha8Rng,
}

impl Latency {
    fn draw_s(&mut self) -> f64 {
        self.least_s + self.jitter_s * self.rng.random_range(0.0..1.0)
    }
}

/// What an autopilot is made from.
#[derive(Debug, Clone)]
pub struct AutopilotSetup<'a> {
    /// The true flight.
    pub flight: Arc<Flight>,
    /// Origin of the flight's plane.
    pub datum: Lla,
    /// MAVLink system id.
    pub system_id: u8,
    /// Clock and home.
    pub config: &'a AutopilotConfig,
    /// Sensor errors.
    pub errors: &'a ErrorsConfig,
    /// Seed of everything random.
    pub seed: u64,
    /// Flight time zero on the service's clock.
    pub start: ServiceTime,
    /// Flight time at which it begins to talk; may be before zero.
    pub from_s: f64,
}

impl Autopilot {
    /// An autopilot that begins to talk at `setup.from_s`.
    #[must_use]
    pub fn new(setup: &AutopilotSetup<'_>) -> Self {
        let seed = setup.seed;
        let stream_of = |(kind, id, rate_hz): (StreamKind, u32, f64)| Stream {
            kind,
            interval_s: Some(1.0 / rate_hz),
            // Spread over the first interval, as on a real link.
            next_s: setup.from_s + f64::from(id % 7) / 7.0 / rate_hz,
            rng: stream(seed, &format!("message {id}")),
        };
        let flight = Arc::clone(&setup.flight);
        let me = Address::new(setup.system_id, 1);
        Self {
            sensors: Sensors::new(flight, setup.datum, setup.config, setup.errors, seed),
            start: setup.start,
            streams: StreamKind::ALL.map(stream_of).into(),
            latency: Latency {
                least_s: setup.errors.message_latency_s,
                jitter_s: setup.errors.message_jitter_s,
                rng: stream(seed, "message latency"),
            },
            waiting: Vec::new(),
            encoder: Encoder::new(me),
            me,
            heard: Heard::default(),
        }
    }

    /// Everything that has left by `until_s`, in order.
    pub fn take_due(&mut self, until_s: f64) -> Vec<Outgoing> {
        for index in 0..self.streams.len() {
            while self.streams[index].next_s <= until_s {
                self.sample(index);
            }
        }
        self.waiting
            .sort_by(|a, b| a.leaves_s.total_cmp(&b.leaves_s));
        let due = self
            .waiting
            .partition_point(|waiting| waiting.leaves_s <= until_s);
        let encoder = &mut self.encoder;
        let encode = |waiting: Waiting| Outgoing {
            leaves_s: waiting.leaves_s,
            bytes: encoder.encode(&waiting.message),
        };
        self.waiting.drain(..due).map(encode).collect()
    }

    /// Takes in a frame that reached the autopilot at `at_s`; answers come out of
    /// [`Autopilot::take_due`].
    pub fn receive(&mut self, at_s: f64, frame: &RawFrame) {
        let sender = frame.sender();
        match decode(frame) {
            Ok(Telemetry::TimeSync(message)) if message.is_request() => {
                self.heard.timesync_requests += 1;
                self.answer_timesync(at_s, message.ts1_ns, sender);
            }
            Ok(Telemetry::CommandLong(command)) if command.target.reaches(self.me) => {
                self.obey(at_s, &command, sender);
            }
            Ok(Telemetry::Heartbeat(_)) if sender.component == ComponentId::ONBOARD_COMPUTER => {
                self.heard.heartbeats += 1
            }
            Ok(Telemetry::StatusText(text)) => self.note(text),
            Ok(_) => {}
            Err(_) => self.heard.undecodable += 1,
        }
    }

    /// What the service said so far.
    #[must_use]
    pub fn heard(&self) -> &Heard {
        &self.heard
    }

    /// Answers a TIMESYNC request that carried `ts1_ns` and came at `at_s`.
    pub fn answer_timesync(&mut self, at_s: f64, ts1_ns: i64, target: Address) {
        let tc1_ns = self.sensors.clock.at(at_s).ns();
        self.send(
            at_s,
            outgoing::timesync(&TimeSyncMessage {
                tc1_ns,
                ts1_ns,
                target,
            }),
        );
    }

    fn note(&mut self, text: StatusText) {
        if self.heard.texts.len() < Heard::MAX_TEXTS {
            self.heard.texts.push(text.text);
        }
    }

    fn sample(&mut self, index: usize) {
        let at_s = self.streams[index].next_s;
        let message = self.measure(index, at_s);
        let stream = &mut self.streams[index];
        stream.next_s = stream
            .interval_s
            .map_or(f64::INFINITY, |interval| at_s + interval);
        self.send(at_s, message);
    }

    fn send(&mut self, at_s: f64, message: MavMessage) {
        let leaves_s = at_s + self.latency.draw_s();
        self.waiting.push(Waiting { leaves_s, message });
    }

    fn measure(&mut self, index: usize, at_s: f64) -> MavMessage {
        let sensors = &self.sensors;
        let Stream { kind, rng, .. } = &mut self.streams[index];
        match kind {
            StreamKind::Heartbeat => outgoing::autopilot_heartbeat(true),
            StreamKind::SystemTime => outgoing::system_time(&self.system_time(at_s)),
            StreamKind::GpsRaw => outgoing::gps_raw(&sensors.gps_raw(at_s, rng)),
            StreamKind::AttitudeQuaternion => {
                outgoing::attitude_quaternion(&sensors.attitude(at_s))
            }
            StreamKind::GlobalPosition => {
                outgoing::global_position(&sensors.global_position(at_s, rng))
            }
            StreamKind::TimeSync => {
                let now_ns = sensors.clock.at(at_s).ns();
                outgoing::timesync_request(Address::new(0, 0), now_ns)
            }
            StreamKind::EstimatorStatus => {
                outgoing::estimator_status(&sensors.estimator_status(at_s))
            }
            StreamKind::HomePosition => outgoing::home_position(&sensors.home()),
        }
    }

    fn system_time(&self, at_s: f64) -> SystemTime {
        let utc = self.start + seconds(at_s);
        SystemTime {
            boot: self.sensors.clock.at(at_s),
            utc: Some(utc),
            claimed_utc_us: utc.unix_ns_u64() / 1000,
        }
    }

    fn obey(&mut self, at_s: f64, order: &CommandLong, sender: Address) {
        let result = match order.command {
            command::SET_MESSAGE_INTERVAL => self.set_interval(at_s, order),
            command::REQUEST_MESSAGE => self.send_once(at_s, order),
            _ => CommandResult::Unsupported,
        };
        let ack = CommandAck {
            command: order.command,
            result,
            result_param2: 0,
            target: sender,
        };
        // A command came decoded, so it is in the dialect that encodes its answer.
        if let Ok(message) = outgoing::command_ack(&ack) {
            self.send(at_s, message);
        }
    }

    fn set_interval(&mut self, at_s: f64, order: &CommandLong) -> CommandResult {
        let [id, interval_us, ..] = order.params;
        let Some(index) = self.stream_of_message(id) else {
            return CommandResult::Unsupported;
        };
        let stream = &mut self.streams[index];
        stream.interval_s = match interval_us {
            us if us < 0.0 => None,
            us if us > 0.0 => Some((f64::from(us) * 1e-6).max(SHORTEST_INTERVAL_S)),
            _ => Some(stream.kind.default_interval_s()),
        };
        stream.next_s = stream
            .interval_s
            .map_or(f64::INFINITY, |interval| at_s + interval);
        CommandResult::Accepted
    }

    fn send_once(&mut self, at_s: f64, order: &CommandLong) -> CommandResult {
        let Some(index) = self.stream_of_message(order.params[0]) else {
            return CommandResult::Unsupported;
        };
        let message = self.measure(index, at_s);
        self.send(at_s, message);
        CommandResult::Accepted
    }

    fn stream_of_message(&self, id: f32) -> Option<usize> {
        let kind = StreamKind::of_message(id)?;
        self.streams.iter().position(|stream| stream.kind == kind)
    }
}

/// PX4's loops do not run a stream faster than about this.
const SHORTEST_INTERVAL_S: f64 = 0.004;

#[cfg(test)]
mod tests;
