//! `emberfix calibrate import`.

use crate::cli::Failure;

/// A rig from a file of Kalibr, ROS, OpenCV or DepthAI.
#[derive(Debug, clap::Args)]
pub struct ImportArguments {}

/// Measures and shows.
pub fn import(_arguments: &ImportArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
