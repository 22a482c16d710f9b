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
    /// Parts to measure; all when none is named.
    #[arg(long, value_enum)]
    part: Vec<Part>,
    /// All errors times this, told and true: at 0.1 every model is nearly linear, and what is still
    /// inconsistent is a fault, not curvature.
    #[arg(long, default_value_t = 1.0)]
    errors: f64,
    /// A small run: seconds, not minutes; too few flights for the bounds to mean much.
    #[arg(long)]
    quick: bool,
}

/// Parts of the measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Part {
    /// The Monte Carlo with errors as assumed.
    Flights,
    /// The Monte Carlo with errors as not assumed.
    Laws,
    /// P3's flight.
    P3,
    /// Bent mounts and late clocks.
    Mount,
    /// One fire, and two.
    Incidents,
    /// Milliseconds per frame.
    Times,
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
    let when = |part: Part, count: usize| {
        let wanted = arguments.part.is_empty() || arguments.part.contains(&part);
        if wanted { count } else { 0 }
    };
    let flights = (arguments.flights / scale).max(96);
    let timed = if arguments.quick {
        vec![1000]
    } else {
        vec![1000, 10_000]
    };
    Options {
        flights: when(Part::Flights, flights),
        foreign_flights: when(Part::Laws, flights / 10),
        p3_flights: when(Part::P3, 4000 / scale),
        mount_flights: when(Part::Mount, 600 / scale),
        incident_flights: when(Part::Incidents, 400 / scale),
        timed_fires: timed[..when(Part::Times, timed.len())].to_vec(),
        seed: arguments.seed,
        errors: arguments.errors,
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
