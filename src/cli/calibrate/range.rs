//! `emberfix calibrate range`.

use crate::cli::Failure;

/// Scale and offset of inverse depth, from known distances.
#[derive(Debug, clap::Args)]
pub struct RangeArguments {}

/// Measures and shows.
pub fn range(_arguments: &RangeArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
