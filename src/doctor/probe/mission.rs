//! The mission file and the rig that it names.

use crate::mission::{Mission, MissionError};
use emberfix_calib::{Rig, RigError};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// What came of reading the files.
pub struct MissionRead {
    /// The mission, or why not.
    pub mission: Result<Mission, MissionError>,
    /// What is wrong with the rig, where the mission's own problems kept it from being read.
    pub rig: Option<RigError>,
    /// Time since the rig file was written.
    pub rig_age: Option<Duration>,
}

/// Reads them all, so that every problem comes at once.
#[must_use]
pub fn read(path: &Path) -> MissionRead {
    let mission = Mission::load(path);
    let rig_file = rig_named_by(path);
    let rig = match (&mission, &rig_file) {
        (Err(MissionError::Syntax { .. } | MissionError::Values { .. }), Some(file)) => {
            Rig::load(file).err()
        }
        _ => None,
    };
    MissionRead {
        mission,
        rig,
        rig_age: rig_file.as_deref().and_then(age),
    }
}

fn rig_named_by(path: &Path) -> Option<PathBuf> {
    let table: toml::Table = toml::from_str(&std::fs::read_to_string(path).ok()?).ok()?;
    Some(path.parent()?.join(table.get("rig")?.as_str()?))
}

fn age(file: &Path) -> Option<Duration> {
    let written = std::fs::metadata(file).ok()?.modified().ok()?;
    SystemTime::now().duration_since(written).ok()
}
