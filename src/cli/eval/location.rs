//! `emberfix eval location`.

use crate::cli::Failure;
use crate::eval::location::flight::Kind;
use crate::eval::location::{Options, measure};
use indicatif::{ProgressBar, ProgressStyle};

/// Position and its error over simulated flights, without pictures.
#[derive(Debug, clap::Args)]
pub struct LocationArguments {
    #[command(flatten)]
    common: super::Common,
    /// Flights of the Monte Carlo.
    #[arg(long, default_value_t = 12_000)]
    flights: usize,
    /// Seed: the same seed gives the same figures, whatever the number of threads.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Ways to fly; all when none is named.
    #[arg(long, value_enum)]
    kind: Vec<Kind>,
    /// A small run: seconds, not minutes; too few flights for the bounds to mean much.
    #[arg(long)]
    quick: bool,
}

/// Measures and shows.
pub fn location(arguments: &LocationArguments) -> Result<(), Failure> {
    let options = options(arguments);
    let bar = progress(&options);
    let report = measure(&options, &bar).map_err(Failure::failed)?;
    bar.finish_and_clear();
    super::show(&arguments.common, "location", &report)
}

fn options(arguments: &LocationArguments) -> Options {
    let scale = if arguments.quick { 25 } else { 1 };
    let flights = (arguments.flights / scale).max(96);
    Options {
        flights,
        foreign_flights: flights / 10,
        p3_flights: 4000 / scale,
        mount_flights: 200 / scale,
        incident_flights: 400 / scale,
        timed_fires: if arguments.quick {
            vec![1000]
        } else {
            vec![1000, 10_000]
        },
        seed: arguments.seed,
        kinds: if arguments.kind.is_empty() {
            Kind::ALL.to_vec()
        } else {
            arguments.kind.clone()
        },
    }
}

fn progress(options: &Options) -> ProgressBar {
    let bar = ProgressBar::new(options.total());
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}") {
        bar.set_style(style);
    }
    bar
}
