//! A recording through the same pipeline as the live service: same input, same bytes.

use crate::alarm::Alarm;
use crate::ingest::{Recorded, Recording, SourceError};
use crate::mission::Mission;
use crate::pipeline::{Event, Output, Pipeline};
use emberfix_mav::FrameReader;
use emberfix_mav::tlog::TlogSummary;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Why a replay ended early.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The recording was refused, or can no longer be read.
    #[error("recording {path}: {source}", path = path.display())]
    Source {
        /// The recording.
        path: PathBuf,
        /// Why.
        source: SourceError,
    },
    /// A telemetry log that is none.
    #[error("telemetry log {path}: {problem}", path = path.display())]
    Telemetry {
        /// The log.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The results can't be written.
    #[error("can't write {path}: {source}", path = path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

impl ReplayError {
    /// True when the input was refused, false when the work failed.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        !matches!(self, Self::Write { .. })
    }
}

/// A recording and the pipeline that it goes through.
pub struct Replay {
    path: PathBuf,
    recording: Recording,
    mission_name: String,
    pipeline: Pipeline,
}

impl Replay {
    /// Opens a recording for a mission.
    ///
    /// # Errors
    /// [`ReplayError::Source`] when it is no recording of this rig.
    pub fn open(path: &Path, mission: &Mission, pipeline: Pipeline) -> Result<Self, ReplayError> {
        let recording =
            Recording::open(path, &mission.rig).map_err(|source| ReplayError::Source {
                path: path.to_owned(),
                source,
            })?;
        let mission_name = mission.name.clone();
        Ok(Self {
            path: path.to_owned(),
            recording,
            mission_name,
            pipeline,
        })
    }

    /// Runs it through, writes `alarms.geojson`, `fixes.jsonl` and `summary.json` into `out`, and
    /// returns the summary. `progress` is told the number of pairs so far.
    ///
    /// # Errors
    /// [`ReplayError`].
    pub fn run(mut self, out: &Path, progress: &mut dyn FnMut(u64)) -> Result<Value, ReplayError> {
        let mut results = Results::create(out)?;
        let mut frames = FrameReader::new();
        let mut pairs = 0;
        loop {
            let next = self
                .recording
                .next_event()
                .map_err(|source| ReplayError::Source {
                    path: self.path.clone(),
                    source,
                })?;
            match next {
                None => break,
                Some(Recorded::Mavlink { arrived, bytes }) => {
                    frames.push(&bytes);
                    while let Some(received) = frames.next_received() {
                        let event = Event::Mavlink(Box::new(received));
                        results.take(self.pipeline.handle(arrived, event))?;
                    }
                }
                Some(Recorded::Action { arrived, action }) => {
                    results.take(self.pipeline.handle(arrived, Event::Action(action)))?;
                }
                Some(Recorded::Pair(pair)) => {
                    pairs += 1;
                    progress(pairs);
                    let arrived = pair.value.arrived;
                    results.take(self.pipeline.handle(arrived, Event::Pair(Box::new(pair))))?;
                }
                Some(Recorded::Calibration { .. }) => {}
            }
        }
        let file_name = self
            .path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned());
        results.finish(json!({
            "mission": self.mission_name,
            "recording": file_name,
            "pairs": pairs,
            "stream": self.recording.counters(),
            "counters": self.pipeline.counters(),
        }))
    }
}

/// The files of one replay.
struct Results {
    out: PathBuf,
    fixes: std::io::BufWriter<std::fs::File>,
    fix_count: u64,
    alarms: BTreeMap<String, Alarm>,
    revisions: u64,
}

impl Results {
    fn create(out: &Path) -> Result<Self, ReplayError> {
        let write = |path: &Path, source| ReplayError::Write {
            path: path.to_owned(),
            source,
        };
        std::fs::create_dir_all(out).map_err(|source| write(out, source))?;
        let path = out.join("fixes.jsonl");
        let file = std::fs::File::create(&path).map_err(|source| write(&path, source))?;
        Ok(Self {
            out: out.to_owned(),
            fixes: std::io::BufWriter::new(file),
            fix_count: 0,
            alarms: BTreeMap::new(),
            revisions: 0,
        })
    }

    fn take(&mut self, outputs: Vec<Output>) -> Result<(), ReplayError> {
        for output in outputs {
            match output {
                Output::Fix { feature, .. } => {
                    self.fix_count += 1;
                    writeln!(self.fixes, "{feature}").map_err(|source| ReplayError::Write {
                        path: self.out.join("fixes.jsonl"),
                        source,
                    })?;
                }
                Output::Alarm(alarm) => {
                    self.revisions += 1;
                    self.alarms.insert(alarm.properties.id.clone(), *alarm);
                }
                Output::Pose(_) | Output::Detections { .. } | Output::Chip(_) => {}
            }
        }
        Ok(())
    }

    fn finish(mut self, mut summary: Value) -> Result<Value, ReplayError> {
        let flushed = self.fixes.flush();
        flushed.map_err(|source| ReplayError::Write {
            path: self.out.join("fixes.jsonl"),
            source,
        })?;
        let features: Vec<Value> = self.alarms.values().map(Alarm::to_geojson).collect();
        summary["fires"] = features.len().into();
        summary["alarm_revisions"] = self.revisions.into();
        summary["fixes"] = self.fix_count.into();
        let collection = json!({"type": "FeatureCollection", "features": features});
        write_json(&self.out.join("alarms.geojson"), &collection)?;
        write_json(&self.out.join("summary.json"), &summary)?;
        Ok(summary)
    }
}

fn write_json(path: &Path, value: &Value) -> Result<(), ReplayError> {
    std::fs::write(path, format!("{value:#}\n")).map_err(|source| ReplayError::Write {
        path: path.to_owned(),
        source,
    })
}

/// A ground station's log through the real MAVLink reader: counts, rates, gaps and the track. It
/// holds no images, so it gives no alarms; the files are written all the same, empty.
///
/// # Errors
/// [`ReplayError`].
pub fn telemetry_log(path: &Path, out: &Path) -> Result<Value, ReplayError> {
    let refuse = |problem: String| ReplayError::Telemetry {
        path: path.to_owned(),
        problem,
    };
    let bytes = std::fs::read(path).map_err(|error| refuse(error.to_string()))?;
    let summary = TlogSummary::of(&bytes);
    if summary.frames == 0 {
        return Err(refuse(
            "holds no MAVLink frame behind an 8-byte time stamp".to_owned(),
        ));
    }
    let telemetry = serde_json::to_value(&summary).map_err(|error| refuse(error.to_string()))?;
    Results::create(out)?.finish(json!({
        "recording": path.file_name().map(|name| name.to_string_lossy().into_owned()),
        "telemetry": telemetry,
    }))
}
