//! `emberfix eval delivery`.

use crate::cli::Failure;
use crate::eval::delivery::{Options, Part, measure};
use indicatif::{ProgressBar, ProgressStyle};

/// Alarms from the aircraft's disk to the ground's, through bad weather and kills.
#[derive(Debug, clap::Args)]
pub struct DeliveryArguments {
    #[command(flatten)]
    common: super::Common,
    /// Seed of weather and kills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// A small run: a minute or two, too few kills and too short an outage for the bounds.
    #[arg(long)]
    quick: bool,
    /// Parts to measure; all when none is named.
    #[arg(long, value_enum)]
    part: Vec<Part>,
}

/// Measures and shows.
pub fn delivery(arguments: &DeliveryArguments) -> Result<(), Failure> {
    let mut options = Options {
        seed: arguments.seed,
        quick: arguments.quick,
        parts: arguments.part.clone(),
    };
    if options.parts.is_empty() {
        options.parts = Part::ALL.to_vec();
    }
    let bar = ProgressBar::new(options.steps()).with_style(
        ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {elapsed}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    let report = measure(&options, &|what| {
        bar.set_message(what.to_owned());
        bar.inc(1);
    });
    bar.finish_and_clear();
    let report = report.map_err(Failure::failed)?;
    super::show(&arguments.common, "delivery", &report)
}
