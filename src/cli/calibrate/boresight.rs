//! `emberfix calibrate boresight`.

use crate::cli::Failure;

/// How the camera sits on the airframe and how late its clock is, from a flight.
#[derive(Debug, clap::Args)]
pub struct BoresightArguments {}

/// Measures and shows.
pub fn boresight(_arguments: &BoresightArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
