//! `emberfix eval calibration`.

use crate::cli::Failure;
use crate::eval::calibration::{Options, measure};
use crate::eval::{Report, boresight};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;

/// Calibration of simulated rigs with known truth.
#[derive(Debug, clap::Args)]
pub struct CalibrationArguments {
    /// Seed of rigs, poses and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Simulated rigs; every second one has a near-infrared left eye.
    #[arg(long, default_value_t = 20)]
    rigs: usize,
    /// Pairs a rig by eyes that are triggered together and a board held still.
    #[arg(long, default_value_t = 100)]
    pairs: usize,
    /// Pairs a rig by eyes that are not in step and a board in a moving hand.
    #[arg(long, default_value_t = 40)]
    snapshots: usize,
    /// Folder of the real pictures `left01.jpg` ..; that of EMBERFIX_SHARED or ../shared if not given.
    #[arg(long)]
    chess_a: Option<PathBuf>,
    /// Rendered flights past a surveyed board, to find mount and clock by; 0 for none.
    #[arg(long, default_value_t = 4)]
    flights: u32,
    /// Mission of those flights.
    #[arg(long, default_value = "missions/marker.toml")]
    flight_mission: PathBuf,
    /// A tenth of the work: 4 rigs of 25 pairs, and one flight.
    #[arg(long, conflicts_with_all = ["rigs", "pairs", "snapshots", "flights"])]
    quick: bool,
    #[command(flatten)]
    common: super::Common,
}

impl CalibrationArguments {
    fn of_work(&self, whole: usize, quick: usize) -> usize {
        if self.quick { quick } else { whole }
    }
}

/// Measures and shows.
pub fn calibration(arguments: &CalibrationArguments) -> Result<(), Failure> {
    let options = Options {
        seed: arguments.seed,
        rigs: arguments.of_work(arguments.rigs, 4),
        pairs: arguments.of_work(arguments.pairs, 25),
        snapshots: arguments.of_work(arguments.snapshots, 25),
        chess_a: chess_a(arguments),
    };
    let bar = ProgressBar::new(2 * options.rigs as u64).with_message("simulated rigs");
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}") {
        bar.set_style(style);
    }
    let report = measure(&options, || bar.inc(1)).map_err(Failure::failed)?;
    bar.finish_and_clear();
    let report = with_flights(arguments, report)?;
    super::show(&arguments.common, "calibration", &report)
}

/// The flights' figures behind the rigs'.
fn with_flights(arguments: &CalibrationArguments, report: Report) -> Result<Report, Failure> {
    if arguments.flights == 0 {
        return Ok(report);
    }
    let flights = if arguments.quick {
        1
    } else {
        arguments.flights
    };
    let bar = ProgressBar::new(flights.into()).with_message("rendered flights");
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}") {
        bar.set_style(style);
    }
    let options = boresight::Options {
        flights,
        seed: arguments.seed,
    };
    let flown = boresight::measure(&arguments.flight_mission, options, &mut |done| {
        bar.set_position(done.into());
    });
    bar.finish_and_clear();
    Ok(report.with("boresight", flown.map_err(Failure::failed)?))
}

fn chess_a(arguments: &CalibrationArguments) -> Option<PathBuf> {
    if arguments.chess_a.is_some() {
        return arguments.chess_a.clone();
    }
    let shared =
        std::env::var_os("EMBERFIX_SHARED").map_or_else(|| "../shared".into(), PathBuf::from);
    let folder = shared.join("data/stereo/chess_a");
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("not measured: {} is not there (chess_a)", folder.display());
    None
}
