//! A whole flight into one finished recording, as fast as it can be rendered.
//!
//! The bytes depend on the mission and its seed alone. TIMESYNC replies carry the service's clock as
//! if the service had asked ten times a second, so that a replay can keep time.

use crate::autopilot::{Autopilot, AutopilotSetup, ErrorsConfig, Outgoing};
use crate::cameras::{Cameras, TakenPair};
use crate::flight::Flight;
use crate::mission::Mission;
use crate::noise::stream;
use crate::stream::{StereoWriter, StreamError, recording_options};
use crate::world::World;
use emberfix_frames::{ServiceTime, seconds};
use emberfix_mav::{Address, ComponentId, SystemId};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::io::{Seek, Write};
use std::sync::Arc;

/// What was recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Recorded {
    /// Stereo pairs.
    pub pairs: u32,
    /// MAVLink frames.
    pub mavlink_frames: u64,
}

/// Telemetry before the first pair, so that clocks and poses are known when it comes.
const LEAD_IN_S: f64 = 3.0;
/// And after the last one, so that its pose has a later neighbour.
const LEAD_OUT_S: f64 = 1.0;
const TIMESYNC_INTERVAL_S: f64 = 0.1;
/// Calibrations are repeated, so that a reader that joins late has them.
const CALIBRATION_INTERVAL_S: f64 = 5.0;
/// Pairs that are rendered at a time; bounds memory.
const BATCH: u32 = 8;

/// Flies `mission` offline into `destination`; `on_pair` hears how many pairs are done.
///
/// # Errors
/// [`StreamError`] when the destination refuses bytes.
pub fn record<W: Write + Seek>(
    mission: &Mission,
    world: &Arc<World>,
    flight: &Arc<Flight>,
    errors: &ErrorsConfig,
    destination: W,
    mut on_pair: impl FnMut(u32),
) -> Result<Recorded, StreamError> {
    let cameras = Cameras::new(mission, Arc::clone(world), Arc::clone(flight), errors);
    let mut tape = Tape::new(mission, flight, errors, destination)?;
    for first in (0..cameras.count()).step_by(BATCH as usize) {
        let batch = first..(first + BATCH).min(cameras.count());
        let pairs: Vec<_> = batch
            .into_par_iter()
            .map(|index| cameras.take(index))
            .collect();
        for pair in pairs {
            tape.add_pair(mission, pair)?;
            on_pair(tape.recorded.pairs);
        }
    }
    tape.finish(flight.duration_s() + LEAD_OUT_S)
}

/// The recording, in the order of arrival.
struct Tape<W: Write + Seek> {
    writer: StereoWriter<W>,
    autopilot: Autopilot,
    start: ServiceTime,
    sync: SyncRequests,
    calibrated_s: f64,
    recorded: Recorded,
}

impl<W: Write + Seek> Tape<W> {
    fn new(
        mission: &Mission,
        flight: &Arc<Flight>,
        errors: &ErrorsConfig,
        destination: W,
    ) -> Result<Self, StreamError> {
        let start = mission.start();
        let autopilot = Autopilot::new(&AutopilotSetup {
            flight: Arc::clone(flight),
            datum: mission.datum,
            system_id: mission.system_id,
            config: &mission.sim.autopilot,
            errors,
            seed: mission.sim.seed,
            start,
            from_s: -LEAD_IN_S,
        });
        let mut writer = StereoWriter::new(destination, recording_options(), true)?;
        writer.write_calibrations(&mission.rig, start - seconds(LEAD_IN_S))?;
        Ok(Self {
            writer,
            autopilot,
            start,
            sync: SyncRequests::new(mission),
            calibrated_s: -LEAD_IN_S,
            recorded: Recorded {
                pairs: 0,
                mavlink_frames: 0,
            },
        })
    }

    fn add_pair(&mut self, mission: &Mission, pair: TakenPair) -> Result<(), StreamError> {
        let arrives_s = pair.arrives_s;
        self.advance(arrives_s)?;
        if arrives_s - self.calibrated_s >= CALIBRATION_INTERVAL_S {
            self.writer
                .write_calibrations(&mission.rig, self.start + seconds(arrives_s))?;
            self.calibrated_s = arrives_s;
        }
        self.writer.write_pair(pair.at(self.start))?;
        self.recorded.pairs += 1;
        Ok(())
    }

    /// Writes every frame that arrives up to `until_s`. Requests go in one by one, in order, so that
    /// no answer can be due before frames that were taken out already.
    fn advance(&mut self, until_s: f64) -> Result<(), StreamError> {
        while let Some(request) = self.sync.next_before(until_s) {
            let due = self.autopilot.take_due(request.reaches_s);
            self.write(due)?;
            let asked = self.start + seconds(request.asked_s);
            self.autopilot
                .answer_timesync(request.reaches_s, asked.unix_ns(), self.sync.asker);
        }
        let due = self.autopilot.take_due(until_s);
        self.write(due)
    }

    fn write(&mut self, frames: Vec<Outgoing>) -> Result<(), StreamError> {
        for Outgoing { leaves_s, bytes } in frames {
            self.writer
                .write_mavlink(self.start + seconds(leaves_s), &bytes)?;
            self.recorded.mavlink_frames += 1;
        }
        Ok(())
    }

    fn finish(mut self, end_s: f64) -> Result<Recorded, StreamError> {
        self.advance(end_s)?;
        self.writer.finish()?;
        Ok(self.recorded)
    }
}

/// The TIMESYNC requests that the service would have sent.
struct SyncRequests {
    asker: Address,
    next: SyncRequest,
    least_s: f64,
    jitter_s: f64,
    rng: ChaCha8Rng,
}

#[derive(Debug, Clone, Copy)]
struct SyncRequest {
    asked_s: f64,
    reaches_s: f64,
}

impl SyncRequests {
    fn new(mission: &Mission) -> Self {
        let errors = &mission.sim.errors;
        Self {
            asker: Address {
                system: SystemId(mission.system_id),
                component: ComponentId::ONBOARD_COMPUTER,
            },
            next: SyncRequest {
                asked_s: -LEAD_IN_S,
                reaches_s: -LEAD_IN_S,
            },
            least_s: errors.message_latency_s,
            jitter_s: errors.message_jitter_s,
            rng: stream(mission.sim.seed, "timesync requests"),
        }
    }

    fn next_before(&mut self, until_s: f64) -> Option<SyncRequest> {
        let request = self.next;
        if request.reaches_s > until_s {
            return None;
        }
        let asked_s = request.asked_s + TIMESYNC_INTERVAL_S;
        let travel_s = self.least_s + self.jitter_s * self.rng.random_range(0.0..1.0);
        self.next = SyncRequest {
            asked_s,
            reaches_s: asked_s + travel_s,
        };
        Some(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_mav::{FrameReader, Telemetry};
    use std::io::Cursor;

    fn short_mission() -> Mission {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../missions/gaochun.toml");
        let mut mission = Mission::load(path).unwrap();
        mission.sim.flight.duration_s = 1.5;
        mission
    }

    fn recording(mission: &Mission) -> Vec<u8> {
        let (world, flight) = crate::setup(mission).unwrap();
        let mut bytes = Cursor::new(Vec::new());
        let errors = &mission.sim.errors;
        record(mission, &world, &flight, errors, &mut bytes, |_| {}).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn a_recording_of_one_seed_is_the_same_to_the_byte() {
        let mission = short_mission();
        let first = recording(&mission);
        assert!(
            first == recording(&mission),
            "two recordings of one seed differ"
        );
        let mut other = mission.clone();
        other.sim.seed += 1;
        assert!(first != recording(&other), "the seed changes nothing");
    }

    #[test]
    fn a_recording_holds_pairs_in_service_time_and_readable_mavlink_in_order_of_arrival() {
        let mission = short_mission();
        let bytes = recording(&mission);
        let mut last_ns = 0;
        let (mut pairs, mut attitudes, mut replies) = (0, 0, 0);
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            assert!(
                message.log_time >= last_ns,
                "{} goes back",
                message.channel.topic
            );
            last_ns = message.log_time;
            match message.channel.topic.as_str() {
                "/stereo/left/image" => {
                    pairs += 1;
                    let delay_ns = message.log_time - message.publish_time;
                    // 35 ms of transport, 0.5 ms sigma of the stamp.
                    assert!(
                        (30_000_000..40_000_000).contains(&delay_ns),
                        "{delay_ns} ns"
                    );
                }
                "/mavlink/raw" => {
                    let mut reader = FrameReader::new();
                    reader.push(&message.data);
                    match reader.next_received().unwrap().telemetry.unwrap() {
                        Telemetry::Attitude(_) => attitudes += 1,
                        Telemetry::TimeSync(sync) if !sync.is_request() => {
                            replies += 1;
                            let trip_ns = message.log_time as i64 - sync.ts1_ns;
                            assert!((2_000_000..=10_000_000).contains(&trip_ns), "{trip_ns} ns");
                        }
                        _ => {}
                    }
                }
                _ => {}
            }
        }
        assert_eq!(pairs, 4, "1.5 s at 3 Hz");
        // 3 s before, 1.5 s of flight, 1 s after; one more or less at each end.
        assert!((272..=277).contains(&attitudes), "{attitudes} attitudes");
        assert!((53..=56).contains(&replies), "{replies} replies");
    }
}
