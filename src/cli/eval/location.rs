//! `emberfix eval location`.

use crate::cli::Failure;

/// Position and its error over simulated flights, without pictures.
#[derive(Debug, clap::Args)]
pub struct LocationArguments {
    #[command(flatten)]
    common: super::Common,
}

/// Measures and shows.
pub fn location(_arguments: &LocationArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
