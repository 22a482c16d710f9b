//! `emberfix eval range`.

use crate::cli::Failure;

/// Every way to range a flame, on rendered flames with truth.
#[derive(Debug, clap::Args)]
pub struct RangeArguments {
    #[command(flatten)]
    common: super::Common,
}

/// Measures and shows.
pub fn range(_arguments: &RangeArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
