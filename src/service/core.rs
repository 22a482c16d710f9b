//! The pipeline thread: events in, outputs to the recorder, the outbox and the board.

use super::camera::Slot;
use super::{Board, SharedOutbox, lock};
use crate::alarm::{Action, Alarm};
use crate::ground::Ping;
use crate::ingest::ServiceClock;
use crate::pipeline::{Chip, Event, Output, Pipeline};
use crate::pose::Pose;
use crate::record::{BodyPose, Recorder, UavFix};
use emberfix_frames::{
    Covariance, ServiceTime, SignedDuration, UnitQuaternion, Wgs84, Wgs84Parts, enu_offset,
};
use emberfix_mav::Received;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What reaches the thread.
pub enum Input {
    /// A MAVLink frame.
    Mavlink {
        /// When it arrived.
        arrived: ServiceTime,
        /// The frame and what it says.
        received: Box<Received>,
    },
    /// The slot holds a pair.
    PairReady,
    /// An operator acted; it is on disk already.
    Action(Action),
}

/// What the thread owns.
pub struct Core {
    pub pipeline: Pipeline,
    pub recorder: Option<Recorder>,
    pub outbox: SharedOutbox,
    pub board: Arc<Board>,
    pub clock: ServiceClock,
    pub uav: String,
    pub datum: Wgs84,
    /// Newest revisions that the disk did not take, by id; at most [`MAX_UNSTORED`].
    pub unstored: BTreeMap<String, Alarm>,
}

/// Alarms that wait in memory for a disk that takes nothing. Beyond it the newest are told by the
/// log alone.
const MAX_UNSTORED: usize = 1_024;

/// How long the thread sleeps when nothing comes.
const PATIENCE: Duration = Duration::from_millis(100);
/// How often health is reported.
const REPORT: Duration = Duration::from_millis(500);

/// Starts the thread. It ends, recording finished, when the service stops.
pub fn start(
    mut core: Core,
    inbox: Receiver<Input>,
    slot: Slot,
) -> std::io::Result<JoinHandle<()>> {
    std::thread::Builder::new()
        .name("pipeline".to_owned())
        .spawn(move || {
            let mut reported = Instant::now();
            while !core.board.is_stopping() {
                match inbox.recv_timeout(PATIENCE) {
                    Ok(Input::Mavlink { arrived, received }) => {
                        core.take_mavlink(arrived, received)
                    }
                    Ok(Input::PairReady) => core.take_pair(&slot),
                    Ok(Input::Action(action)) => core.take_action(action),
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => break,
                }
                if reported.elapsed() > REPORT {
                    reported = Instant::now();
                    core.report();
                }
            }
            core.end();
        })
}

impl Core {
    fn take_mavlink(&mut self, arrived: ServiceTime, received: Box<Received>) {
        let arrived = self.in_order(arrived);
        if let Some(recorder) = &self.recorder {
            recorder.write_mavlink(arrived, &received.frame.bytes);
        }
        let outputs = self.pipeline.handle(arrived, Event::Mavlink(received));
        self.hand_on(outputs);
    }

    /// An arrival after every earlier one. A recording is replayed in the order of arrivals, and it
    /// must be the order in which the pipeline took the events in; equal arrivals would not say.
    fn in_order(&self, arrived: ServiceTime) -> ServiceTime {
        arrived.max(self.pipeline.now() + SignedDuration::from_nanos(1))
    }

    fn take_pair(&mut self, slot: &Slot) {
        let Some(mut pair) = slot.take() else {
            return;
        };
        pair.value.arrived = self.in_order(pair.value.arrived);
        if let Some(recorder) = &self.recorder {
            recorder.write_pair(&pair);
        }
        let outputs = self
            .pipeline
            .handle(pair.value.arrived, Event::Pair(Box::new(pair)));
        self.hand_on(outputs);
    }

    fn take_action(&mut self, action: Action) {
        let arrived = self.in_order((self.clock)());
        if let Some(recorder) = &self.recorder {
            recorder.write_action(arrived, &action);
        }
        let outputs = self.pipeline.handle(arrived, Event::Action(action));
        self.hand_on(outputs);
    }

    fn hand_on(&mut self, outputs: Vec<Output>) {
        for output in outputs {
            match output {
                Output::Pose(pose) => self.hand_on_pose(&pose),
                Output::Detections { at, found } => {
                    if let Some(recorder) = &self.recorder {
                        recorder.write_detections(at, &found);
                    }
                }
                Output::Fix { at, feature } => {
                    if let Some(recorder) = &self.recorder {
                        recorder.write_fix_json(at, &feature);
                    }
                }
                Output::Alarm(alarm) => self.hand_on_alarm(&alarm),
                Output::Chip(chip) => self.hand_on_chip(&chip),
            }
        }
    }

    fn hand_on_pose(&mut self, pose: &Pose) {
        let heading_deg = pose.attitude.angles().2.to_degrees().rem_euclid(360.0);
        let health = self.pipeline.health(self.pipeline.now()).words();
        self.board.latest().ping = Some(Ping {
            uav: self.uav.clone(),
            at: pose.at,
            latitude_deg: pose.place.latitude_deg(),
            longitude_deg: pose.place.longitude_deg(),
            height_ellipsoid_m: pose.place.height().m(),
            heading_deg: Some(heading_deg),
            health: if health.is_empty() {
                "ok".to_owned()
            } else {
                health.join("; ")
            },
        });
        if let Some(recorder) = &self.recorder {
            let (h, v) = (pose.gnss_horizontal_m, pose.gnss_vertical_m);
            let covariance = Covariance::from_sigmas_m(h, h, v);
            let heading_rad = Some(pose.attitude.angles().2);
            recorder.write_uav_fix(
                pose.at,
                &UavFix {
                    place: pose.place,
                    covariance,
                    heading_rad,
                },
            );
            let (w, i, j, k) = pose.attitude.enu_from_body().to_quaternion();
            let quaternion = nalgebra::Quaternion::new(w, i, j, k);
            recorder.write_body_pose(
                pose.at,
                &BodyPose {
                    position_enu_m: enu_offset(&self.datum, &pose.place),
                    enu_from_body: UnitQuaternion::new_normalize(quaternion),
                },
            );
        }
    }

    /// On disk first; only then do the links and the recording hear of it.
    fn hand_on_alarm(&mut self, alarm: &Alarm) {
        self.store(alarm);
        tracing::info!(
            id = alarm.properties.id,
            revision = alarm.properties.revision,
            state = ?alarm.properties.state,
            ce90_m = alarm.properties.ce90_m,
            "alarm"
        );
        if let Some(recorder) = &self.recorder {
            recorder.write_alarm(alarm.properties.captured_at, alarm);
        }
    }

    /// Encoded and stored behind the alarms of the same look, and only where those found room.
    fn hand_on_chip(&mut self, chip: &Chip) {
        if !self.unstored.is_empty() {
            return;
        }
        let Some(jpeg) = chip.jpeg() else {
            tracing::debug!(id = chip.id, "a fire's picture can't be made small enough");
            return;
        };
        let put = lock(&self.outbox).put_chip(&chip.id, chip.revision, &jpeg);
        match put {
            Ok(kept) => tracing::debug!(id = chip.id, bytes = jpeg.len(), kept, "picture"),
            Err(error) => tracing::warn!(%error, id = chip.id, "a fire's picture was not kept"),
        }
    }

    /// An alarm that the disk does not take is kept in memory, and tried again until it does.
    fn store(&mut self, alarm: &Alarm) {
        let id = &alarm.properties.id;
        let put = lock(&self.outbox).put(alarm, (self.clock)());
        match put {
            Ok(_) => {
                self.unstored.remove(id);
            }
            Err(error) => {
                tracing::error!(%error, id, "ALARM NOT STORED; it is tried again");
                if self.unstored.len() < MAX_UNSTORED || self.unstored.contains_key(id) {
                    self.unstored.insert(id.clone(), alarm.clone());
                }
            }
        }
    }

    fn store_again(&mut self) {
        for alarm in self.unstored.clone().into_values() {
            self.store(&alarm);
        }
    }

    /// What is wrong with the place where alarms are kept.
    fn storage_problems(&self) -> Vec<String> {
        let outbox = lock(&self.outbox);
        let mut problems = Vec::new();
        if !self.unstored.is_empty() {
            let count = self.unstored.len();
            problems.push(format!("{count} alarms can't be stored: see the disk"));
        }
        if outbox.is_on_reserve() {
            problems.push("the disk is full: alarms use their reserve".to_owned());
        }
        if outbox.unreadable() > 0 {
            problems.push(format!("{} stored alarms are damaged", outbox.unreadable()));
        }
        problems
    }

    fn report(&mut self) {
        self.store_again();
        let mut health = self.pipeline.health((self.clock)());
        health.problems.extend(self.storage_problems());
        let mut latest = self.board.latest();
        if health != latest.health {
            for problem in &health.problems {
                tracing::warn!(problem, "not healthy");
            }
            for warning in &health.warnings {
                tracing::warn!(warning, "positions are worse than they could be");
            }
            if health.problems.is_empty() && health.warnings.is_empty() {
                tracing::info!("healthy");
            }
        }
        latest.health = health;
        latest.reported = Some(Instant::now());
        latest.vehicle = self.pipeline.vehicle();
    }

    fn end(self) {
        tracing::info!(counters = ?self.pipeline.counters(), "pipeline ends");
        if let Some(recorder) = self.recorder {
            match recorder.finish() {
                Ok(status) => tracing::info!(?status, "recording finished"),
                Err(error) => tracing::error!(%error, "recording not finished"),
            }
        }
    }
}
