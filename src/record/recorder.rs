//! The recording thread, and the service's side of it.

use super::{BodyPose, RecordError, RecordOptions, Tape, UavFix};
use crate::alarm::{Action, Alarm};
use crate::detect::Detection;
use crate::ingest::StereoPair;
use bytes::Bytes;
use emberfix_calib::Rig;
use emberfix_frames::{ServiceTime, Stamped};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// Pairs that may wait for the disk; further ones are shed.
pub const IMAGE_QUEUE: usize = 8;
/// Entries of all kinds that may wait for the disk: a minute of telemetry at 1 kHz. Beyond it the disk
/// hangs, and recording stops.
pub const ENTRY_QUEUE: usize = 65_536;
/// A chunk is ended when nothing has come for this long.
const IDLE_FLUSH: Duration = Duration::from_secs(1);

/// One thing to write.
enum Entry {
    Pair(Box<Stamped<StereoPair>>),
    Mavlink {
        arrived: ServiceTime,
        frame: Bytes,
    },
    UavFix {
        at: ServiceTime,
        fix: UavFix,
    },
    BodyPose {
        at: ServiceTime,
        pose: BodyPose,
    },
    Detections {
        at: ServiceTime,
        detections: Vec<Detection>,
    },
    FixJson {
        at: ServiceTime,
        fix: serde_json::Value,
    },
    Alarm {
        at: ServiceTime,
        alarm: Box<Alarm>,
    },
    Action {
        at: ServiceTime,
        action: Action,
    },
    Flush,
}

/// Whether a recorder records.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RecorderState {
    /// It does.
    Recording,
    /// It has stopped for good; the service goes on.
    Stopped {
        /// Why.
        reason: String,
    },
}

/// What a recorder has done so far.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecorderStatus {
    /// Whether it records.
    pub state: RecorderState,
    /// Entries in the file.
    pub written: u64,
    /// Pairs that were shed because the disk is slower than the camera.
    pub shed_pairs: u64,
    /// Entries that came after recording had stopped.
    pub lost: u64,
}

#[derive(Default)]
struct Shared {
    waiting_pairs: AtomicUsize,
    written: AtomicU64,
    shed_pairs: AtomicU64,
    lost: AtomicU64,
    stopped: Mutex<Option<String>>,
}

impl Shared {
    fn stop_reason(&self) -> Option<String> {
        self.stopped
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Stops for good; the first reason counts, and is said once, loudly.
    fn stop(&self, reason: String) {
        let mut stopped = self.stopped.lock().unwrap_or_else(PoisonError::into_inner);
        if stopped.is_none() {
            tracing::error!(%reason, "RECORDING HAS STOPPED; the service goes on without it");
            *stopped = Some(reason);
        }
    }
}

/// Records on a thread of its own. No method waits for the disk, but [`Recorder::finish`].
pub struct Recorder {
    path: PathBuf,
    sender: Option<SyncSender<Entry>>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<Result<(), RecordError>>>,
}

impl Recorder {
    /// Creates the file and starts the thread.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file is there already or can't be created.
    pub fn create(path: &Path, rig: &Rig, options: &RecordOptions) -> Result<Self, RecordError> {
        Self::start(Tape::create(path, rig, options)?, path)
    }

    /// Starts the thread that writes on a tape.
    pub(super) fn start(tape: Tape, path: &Path) -> Result<Self, RecordError> {
        let (sender, receiver) = sync_channel(ENTRY_QUEUE);
        let shared = Arc::<Shared>::default();
        let theirs = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || write_all(tape, &receiver, &theirs))
            .map_err(|source| RecordError::Io {
                path: path.to_owned(),
                source,
            })?;
        Ok(Self {
            path: path.to_owned(),
            sender: Some(sender),
            shared,
            thread: Some(thread),
        })
    }

    /// A pair as it came. Shed when the disk is too slow.
    pub fn write_pair(&self, pair: &Stamped<StereoPair>) {
        if self.shared.waiting_pairs.load(Ordering::Acquire) >= IMAGE_QUEUE {
            let mut shed = self.shared.shed_pairs.fetch_add(1, Ordering::Relaxed);
            crate::ingest::note(&mut shed, "the disk is too slow: pair not recorded");
            return;
        }
        self.shared.waiting_pairs.fetch_add(1, Ordering::AcqRel);
        if !self.send(Entry::Pair(Box::new(pair.clone()))) {
            self.shared.waiting_pairs.fetch_sub(1, Ordering::AcqRel);
        }
    }

    /// One MAVLink frame, the bytes as they came.
    pub fn write_mavlink(&self, arrived: ServiceTime, frame: &[u8]) {
        self.send(Entry::Mavlink {
            arrived,
            frame: Bytes::copy_from_slice(frame),
        });
    }

    /// Where we took the aircraft to be.
    pub fn write_uav_fix(&self, at: ServiceTime, fix: &UavFix) {
        self.send(Entry::UavFix { at, fix: *fix });
    }

    /// How airframe and left camera stood.
    pub fn write_body_pose(&self, at: ServiceTime, pose: &BodyPose) {
        self.send(Entry::BodyPose { at, pose: *pose });
    }

    /// What was detected in the left image of `at`.
    pub fn write_detections(&self, at: ServiceTime, detections: &[Detection]) {
        self.send(Entry::Detections {
            at,
            detections: detections.to_vec(),
        });
    }

    /// One sighting's fix, a GeoJSON Feature.
    pub fn write_fix_json(&self, at: ServiceTime, fix: &serde_json::Value) {
        self.send(Entry::FixJson {
            at,
            fix: fix.clone(),
        });
    }

    /// An alarm; the file is synced after it.
    pub fn write_alarm(&self, at: ServiceTime, alarm: &Alarm) {
        self.send(Entry::Alarm {
            at,
            alarm: Box::new(alarm.clone()),
        });
    }

    /// What an operator did; it is an input of the replay.
    pub fn write_action(&self, at: ServiceTime, action: &Action) {
        self.send(Entry::Action {
            at,
            action: action.clone(),
        });
    }

    /// Ends the chunk soon.
    pub fn flush(&self) {
        self.send(Entry::Flush);
    }

    /// What has been done so far.
    #[must_use]
    pub fn status(&self) -> RecorderStatus {
        let state = match self.shared.stop_reason() {
            Some(reason) => RecorderState::Stopped { reason },
            None => RecorderState::Recording,
        };
        RecorderStatus {
            state,
            written: self.shared.written.load(Ordering::Relaxed),
            shed_pairs: self.shared.shed_pairs.load(Ordering::Relaxed),
            lost: self.shared.lost.load(Ordering::Relaxed),
        }
    }

    /// Writes what waits, index and summary; waits for the disk.
    ///
    /// # Errors
    /// [`RecordError`], also when recording had stopped before.
    pub fn finish(mut self) -> Result<RecorderStatus, RecordError> {
        self.sender = None;
        if let Some(Ok(written)) = self.thread.take().map(JoinHandle::join) {
            written?;
        }
        match self.shared.stop_reason() {
            Some(reason) => Err(RecordError::Stopped {
                path: self.path.clone(),
                reason,
            }),
            None => Ok(self.status()),
        }
    }

    fn send(&self, entry: Entry) -> bool {
        let Some(sender) = &self.sender else {
            return false;
        };
        match sender.try_send(entry) {
            Ok(()) => true,
            Err(TrySendError::Full(_)) => {
                self.shared
                    .stop(format!("the disk hangs: {ENTRY_QUEUE} entries wait for it"));
                self.shared.lost.fetch_add(1, Ordering::Relaxed);
                false
            }
            Err(TrySendError::Disconnected(_)) => {
                self.shared.lost.fetch_add(1, Ordering::Relaxed);
                false
            }
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.sender = None;
        if let Some(thread) = self.thread.take() {
            // The reason for a failure has been logged by the thread.
            drop(thread.join());
        }
    }
}

/// The thread: writes until the service has gone. After a failure it only empties the queue.
fn write_all(
    mut tape: Tape,
    receiver: &Receiver<Entry>,
    shared: &Shared,
) -> Result<(), RecordError> {
    loop {
        let entry = match receiver.recv_timeout(IDLE_FLUSH) {
            Ok(entry) => entry,
            Err(RecvTimeoutError::Timeout) => Entry::Flush,
            Err(RecvTimeoutError::Disconnected) => break,
        };
        let is_pair = matches!(entry, Entry::Pair(_));
        if shared.stop_reason().is_some() {
            shared.lost.fetch_add(1, Ordering::Relaxed);
        } else if let Err(error) = write_entry(&mut tape, entry) {
            shared.stop(with_causes(&error));
        } else {
            shared.written.fetch_add(1, Ordering::Relaxed);
        }
        if is_pair {
            shared.waiting_pairs.fetch_sub(1, Ordering::AcqRel);
        }
    }
    if shared.stop_reason().is_some() {
        return Ok(());
    }
    tape.finish()
        .inspect_err(|error| shared.stop(error.to_string()))
}

/// An error and what caused it: `No space left on device` stands at the bottom.
fn with_causes(error: &RecordError) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error).and_then(std::error::Error::source);
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text
}

fn write_entry(tape: &mut Tape, entry: Entry) -> Result<(), RecordError> {
    match entry {
        Entry::Pair(pair) => tape.write_pair(&pair),
        Entry::Mavlink { arrived, frame } => tape.write_mavlink(arrived, &frame),
        Entry::UavFix { at, fix } => tape.write_uav_fix(at, &fix),
        Entry::BodyPose { at, pose } => tape.write_body_pose(at, &pose),
        Entry::Detections { at, detections } => tape.write_detections(at, &detections),
        Entry::FixJson { at, fix } => tape.write_fix_json(at, &fix),
        Entry::Alarm { at, alarm } => tape.write_alarm(at, &alarm),
        Entry::Action { at, action } => tape.write_action(at, &action),
        Entry::Flush => tape.flush(),
    }
}
