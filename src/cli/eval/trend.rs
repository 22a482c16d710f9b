//! `emberfix eval trend`.

use crate::cli::Failure;
use crate::eval::trend::contest::{BURNS, GROUPS};
use crate::eval::trend::{Options, Sets, measure};
use emberfix_calib::Rig;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;

/// Trend, size and spread of simulated burns.
#[derive(Debug, clap::Args)]
pub struct TrendArguments {
    #[command(flatten)]
    common: super::Common,
    /// Seed of burns and flights.
    #[arg(long, default_value_t = 8)]
    seed: u64,
    /// Noise model: the one that was tuned on, the one that was kept aside, or both.
    #[arg(long, value_enum, default_value = "both")]
    set: Set,
    /// Rendered flights for size and spread; 0 leaves them out.
    #[arg(long, default_value_t = 800)]
    flights: usize,
    /// The first noise model and 60 flights only: a minute or two.
    #[arg(long)]
    quick: bool,
    /// Rig of the rendered flights.
    #[arg(long, default_value = "calib/rigs/oakd-75mm.toml")]
    rig: PathBuf,
}

/// Flights of a quick run.
const QUICK_FLIGHTS: usize = 60;

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Set {
    First,
    Second,
    Both,
}

impl From<Set> for Sets {
    fn from(set: Set) -> Self {
        match set {
            Set::First => Self::First,
            Set::Second => Self::Second,
            Set::Both => Self::Both,
        }
    }
}

/// Measures and shows.
pub fn trend(arguments: &TrendArguments) -> Result<(), Failure> {
    let rig = Rig::load(&arguments.rig).map_err(|error| Failure::Refused(error.into()))?;
    let options = Options {
        seed: arguments.seed,
        sets: if arguments.quick {
            Sets::First
        } else {
            arguments.set.into()
        },
        flights: if arguments.quick {
            arguments.flights.min(QUICK_FLIGHTS)
        } else {
            arguments.flights
        },
    };
    let contests = if options.sets == Sets::Both { 2 } else { 1 };
    let steps = (contests * GROUPS * BURNS + options.flights) as u64;
    let bar = ProgressBar::new(steps).with_style(
        ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    bar.set_message("burns and flights");
    let report = measure(&options, &rig, &|| bar.inc(1)).map_err(Failure::failed)?;
    bar.finish_and_clear();
    super::show(&arguments.common, "trend", &report)
}
