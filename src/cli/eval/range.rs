//! `emberfix eval range`.

use crate::cli::Failure;
use crate::eval::range::{Options, Part, SeedSet, measure, steps};

/// Every way to range a flame, on rendered flames with truth.
#[derive(Debug, clap::Args)]
pub struct RangeArguments {
    /// Which flames.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Flames at each distance.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u16).range(2..=1000))]
    repeats: u16,
    /// A few flames only: seconds instead of minutes, and coarse figures.
    #[arg(long)]
    quick: bool,
    /// Flames to tune on, or flames kept aside.
    #[arg(long, value_enum, default_value = "report")]
    set: SeedSet,
    /// Only a part: the figures of the others stay without a value.
    #[arg(long, value_enum)]
    only: Option<Part>,
    /// Add every single answer to the JSON.
    #[arg(long)]
    rounds: bool,
    #[command(flatten)]
    common: super::Common,
}

/// Measures and shows.
pub fn range(arguments: &RangeArguments) -> Result<(), Failure> {
    let repeats = if arguments.quick {
        4
    } else {
        arguments.repeats
    };
    let options = Options {
        seed: arguments.seed,
        repeats: usize::from(repeats),
        quick: arguments.quick,
        set: arguments.set,
        only: arguments.only,
        rounds: arguments.rounds,
    };
    // Hidden where standard error is no terminal.
    let bar = indicatif::ProgressBar::new(steps(&options));
    let report = measure(&options, &|done| bar.inc(done)).map_err(Failure::failed)?;
    bar.finish_and_clear();
    super::show(&arguments.common, "range", &report)
}
