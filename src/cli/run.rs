//! `emberfix run MISSION`.

use super::{Failure, detector, runtime};
use crate::mission::Mission;
use crate::pipeline::Pipeline;
use crate::range;
use crate::service::{self, ServiceError};
use std::path::PathBuf;

/// Runs the service.
#[derive(Debug, clap::Args)]
pub struct RunArguments {
    /// Mission file, such as missions/gaochun.toml.
    mission: PathBuf,
    /// MAVLink URL instead of the mission's.
    #[arg(long)]
    mavlink: Option<String>,
    /// Camera URL instead of the mission's.
    #[arg(long)]
    camera: Option<String>,
    /// Address of the ground station instead of the mission's.
    #[arg(long)]
    ground: Option<String>,
    /// Folder for what must survive (the outbox) instead of the mission's.
    #[arg(long)]
    state: Option<PathBuf>,
    /// Boxes from a file (JSON lines or CSV) instead of the mission's model.
    #[arg(long)]
    boxes: Option<PathBuf>,
    /// Record everything that comes and everything that is found into this MCAP file.
    #[arg(long)]
    record: Option<PathBuf>,
}

/// Loads, checks, runs.
pub fn run(arguments: RunArguments) -> Result<(), Failure> {
    let mut mission = Mission::load(&arguments.mission).map_err(Failure::refused)?;
    if let Some(url) = arguments.mavlink {
        mission.mavlink_url = url;
    }
    if let Some(url) = arguments.camera {
        mission.camera_url = url;
    }
    if arguments.ground.is_some() {
        mission.ground.url = arguments.ground;
    }
    if let Some(folder) = arguments.state {
        mission.state_dir = folder;
    }
    let detector = detector(&mission, arguments.boxes.as_deref())?;
    let ranger = range::open(mission.range_method, &mission.rig, &mission.range)
        .map_err(Failure::refused)?;
    let fail = |error: ServiceError| {
        if error.is_refusal() {
            Failure::refused(error)
        } else {
            Failure::failed(error)
        }
    };
    let mut outbox = service::open_outbox(&mission).map_err(fail)?;
    let first = outbox
        .next_fire_number()
        .map_err(|error| fail(error.into()))?;
    let pipeline = Pipeline::new(&mission, detector, ranger, first)
        .with_right_eye(super::right_eye(&mission)?);
    runtime()?
        .block_on(service::run(
            mission,
            pipeline,
            outbox,
            arguments.record.as_deref(),
        ))
        .map_err(fail)
}
