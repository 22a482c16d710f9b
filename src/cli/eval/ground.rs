//! `emberfix eval ground`.

use crate::cli::Failure;

/// How many alarms a second one ground process keeps, from 1,000 aircraft with 100 streams open.
#[derive(Debug, clap::Args)]
pub struct GroundArguments {
    #[command(flatten)]
    common: super::Common,
    /// A small run.
    #[arg(long)]
    quick: bool,
}

/// Measures and shows.
pub fn ground(arguments: &GroundArguments) -> Result<(), Failure> {
    let report = crate::eval::ground::measure(arguments.quick).map_err(Failure::failed)?;
    super::show(&arguments.common, "ground", &report)
}
