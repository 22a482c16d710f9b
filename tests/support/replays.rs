//! The real program over recordings.

use crate::support::{Said, Scratch, emberfix};
use std::path::Path;

/// `emberfix replay` of a file by the scratch folder's mission, with `more` arguments; results in
/// the folder's `out`.
pub fn replay(scratch: &Scratch, recording: &Path, out: &str, more: &[&str]) -> Said {
    let mut command = emberfix();
    command
        .arg("replay")
        .arg(scratch.path("mission.toml"))
        .arg(recording);
    command
        .arg("--out")
        .arg(scratch.path(out))
        .arg("--json")
        .args(more);
    Said::of(&command.output().unwrap())
}
