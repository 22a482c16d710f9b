//! `emberfix eval calibration`.

use crate::cli::Failure;

/// Calibration of simulated rigs with known truth.
#[derive(Debug, clap::Args)]
pub struct CalibrationArguments {
    #[command(flatten)]
    common: super::Common,
}

/// Measures and shows.
pub fn calibration(_arguments: &CalibrationArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
