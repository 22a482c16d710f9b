//! `emberfix calibrate stereo`.

use crate::cli::Failure;

/// Both eyes and the pair, from pictures of a board.
#[derive(Debug, clap::Args)]
pub struct StereoArguments {}

/// Measures and shows.
pub fn stereo(_arguments: &StereoArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
