//! `emberfix eval trend`.

use crate::cli::Failure;

/// Trend, size and spread of simulated burns.
#[derive(Debug, clap::Args)]
pub struct TrendArguments {
    #[command(flatten)]
    common: super::Common,
}

/// Measures and shows.
pub fn trend(_arguments: &TrendArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
