//! `emberfix doctor MISSION`.

use crate::cli::Failure;

/// Checks a mission before take-off.
#[derive(Debug, clap::Args)]
pub struct DoctorArguments {
    /// Mission file.
    mission: std::path::PathBuf,
}

/// Measures and shows.
pub fn doctor(_arguments: &DoctorArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
