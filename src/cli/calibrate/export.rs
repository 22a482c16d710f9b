//! `emberfix calibrate export`.

use crate::cli::Failure;

/// A rig as a file for ROS or OpenCV.
#[derive(Debug, clap::Args)]
pub struct ExportArguments {}

/// Measures and shows.
pub fn export(_arguments: &ExportArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
