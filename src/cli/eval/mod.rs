//! `emberfix eval NAME`: measures, prints a table or JSON, draws.

mod calibration;
mod delivery;
mod detector;
mod ground;
mod location;
mod range;
mod trend;

use super::Failure;
use crate::eval::Report;
use comfy_table::Table;
use std::path::PathBuf;

/// What every measurement takes.
#[derive(Debug, Clone, clap::Args)]
pub struct Common {
    /// Print figures and details as JSON on standard output.
    #[arg(long)]
    json: bool,
    /// Folder for the plots (SVG and PNG) and the JSON.
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Prints, draws; fails when a figure breaks its bound.
pub fn show(common: &Common, name: &str, report: &Report) -> Result<(), Failure> {
    if common.json {
        println!("{:#}", serde_json::json!(report));
    } else {
        for table in &report.tables {
            println!("{}\n{}\n", table.title, drawn(table));
        }
        println!("{}", emberfix_report::text_lines(&report.figures));
    }
    if let Some(folder) = &common.out {
        for path in report.save(folder, name).map_err(Failure::failed)? {
            eprintln!("written: {}", path.display());
        }
    }
    if report.holds() {
        Ok(())
    } else {
        Err(Failure::Failed(anyhow::anyhow!(
            "{name}: a figure does not hold its bound, see above"
        )))
    }
}

fn drawn(table: &crate::eval::Table) -> Table {
    let mut drawn = Table::new();
    drawn.load_style(comfy_table::presets::UTF8_HORIZONTAL_ONLY);
    drawn.set_header(&table.header);
    drawn.add_rows(&table.rows);
    drawn
}

/// What can be measured.
#[derive(Debug, clap::Subcommand)]
pub enum Eval {
    /// How well a detector finds fire in labelled pictures.
    Detector(detector::DetectorArguments),
    /// Position and its error over simulated flights, without pictures.
    Location(location::LocationArguments),
    /// Every way to range a flame, on rendered flames with truth.
    Range(range::RangeArguments),
    /// Trend, size and spread of simulated burns.
    Trend(trend::TrendArguments),
    /// Calibration of simulated rigs with known truth.
    Calibration(calibration::CalibrationArguments),
    /// Alarms a second that one ground process keeps, with everyone connected.
    Ground(ground::GroundArguments),
    /// Alarms from the aircraft's disk to the ground's, through bad weather and kills.
    Delivery(delivery::DeliveryArguments),
    /// The aircraft of `delivery`, in a process of its own.
    #[command(hide = true)]
    DeliveryAircraft(Box<crate::eval::delivery::aircraft::AircraftArguments>),
}

/// Measures one of them.
pub fn eval(what: &Eval) -> Result<(), Failure> {
    match what {
        Eval::Detector(arguments) => detector::detector(arguments),
        Eval::Location(arguments) => location::location(arguments),
        Eval::Range(arguments) => range::range(arguments),
        Eval::Trend(arguments) => trend::trend(arguments),
        Eval::Calibration(arguments) => calibration::calibration(arguments),
        Eval::Ground(arguments) => ground::ground(arguments),
        Eval::Delivery(arguments) => delivery::delivery(arguments),
        Eval::DeliveryAircraft(arguments) => {
            crate::eval::delivery::aircraft::fly(arguments).map_err(Failure::failed)
        }
    }
}
