//! `emberfix replay MISSION RECORDING --out DIR`.

use super::{Failure, detector};
use crate::alarm::FireId;
use crate::mission::Mission;
use crate::pipeline::Pipeline;
use crate::range;
use crate::replay::{Replay, ReplayError, telemetry_log};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// Runs a recording through the service.
#[derive(Debug, clap::Args)]
pub struct ReplayArguments {
    /// Mission file.
    mission: PathBuf,
    /// MCAP recording, or a ground station's .tlog (telemetry only).
    recording: PathBuf,
    /// Folder for alarms.geojson, fixes.jsonl and summary.json.
    #[arg(long)]
    out: PathBuf,
    /// Boxes from a file (JSON lines or CSV) instead of the mission's model.
    #[arg(long)]
    boxes: Option<PathBuf>,
    /// Print the summary as JSON on standard output.
    #[arg(long)]
    json: bool,
}

/// Replays, writes, prints.
pub fn replay(arguments: &ReplayArguments) -> Result<(), Failure> {
    let mission = Mission::load(&arguments.mission).map_err(Failure::refused)?;
    let summary = if arguments
        .recording
        .extension()
        .is_some_and(|ending| ending == "tlog")
    {
        telemetry_log(&arguments.recording, &arguments.out)
    } else {
        images_and_telemetry(&mission, arguments)?
    };
    let summary = summary.map_err(|error| {
        if error.is_refusal() {
            Failure::refused(error)
        } else {
            Failure::failed(error)
        }
    })?;
    if arguments.json {
        println!("{:#}", summary);
    } else {
        print_summary(&summary, &arguments.out);
    }
    Ok(())
}

fn images_and_telemetry(
    mission: &Mission,
    arguments: &ReplayArguments,
) -> Result<Result<serde_json::Value, ReplayError>, Failure> {
    let detector = detector(mission, arguments.boxes.as_deref())?;
    let ranger = range::open(mission.range_method, &mission.rig, &mission.range)
        .map_err(Failure::refused)?;
    let pipeline = Pipeline::new(mission, detector, ranger, FireId(1))
        .with_right_eye(super::right_eye(mission)?);
    let replay = Replay::open(&arguments.recording, mission, pipeline);
    let bar = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{spinner} replay: {msg}, {elapsed}") {
        bar.set_style(style);
    }
    let done = replay.and_then(|replay| {
        replay.run(&arguments.out, &mut |pairs| {
            bar.set_message(format!("{pairs} pairs"));
            bar.tick();
        })
    });
    bar.finish_and_clear();
    Ok(done)
}

fn print_summary(summary: &serde_json::Value, out: &Path) {
    if let Some(object) = summary.as_object() {
        for (key, value) in object {
            println!("{key}: {value}");
        }
    }
    println!("written to {}", out.display());
}
