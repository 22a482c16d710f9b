//! `emberfix calibrate range`.

mod flight;

use crate::cli::Failure;
use anyhow::{Context, bail};
use emberfix_calib::{InverseDepth, Reading, Rig};
use flight::FlightArguments;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Scale and offset of inverse depth, from known distances or from a flight past a fire.
#[derive(Debug, clap::Args)]
pub struct RangeArguments {
    /// Tables with a header: true_m (along the boresight) and measured_m or disparity_px; last the rig file
    /// that the readings were made with, into which the correction is written.
    #[arg(
        value_name = "TABLE... RIG",
        required_unless_present = "flight",
        conflicts_with = "flight",
        num_args = 2..
    )]
    files: Vec<PathBuf>,
    #[command(flatten)]
    flight: FlightArguments,
    /// Only show the correction; write nothing.
    #[arg(long)]
    dry_run: bool,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
}

/// What was measured at which distance, what that makes of the rig, and the rig's file.
struct Fitted {
    readings: Vec<Reading>,
    correction: InverseDepth,
    rig: PathBuf,
}

/// Fits, shows, writes.
pub fn range(arguments: &RangeArguments) -> Result<(), Failure> {
    let fitted = match (&arguments.flight.flight, arguments.files.split_last()) {
        (Some(recording), _) => flight::fit(recording, &arguments.flight)?,
        (None, Some((rig, tables))) => fit_tables(tables, rig)?,
        (None, None) => return Err(Failure::Refused(anyhow::anyhow!("no tables, no flight"))),
    };
    if arguments.json {
        println!("{:#}", as_json(&fitted));
    } else {
        show(&fitted.readings, &fitted.correction);
    }
    if !arguments.dry_run {
        write(&fitted.rig, &fitted.correction).map_err(Failure::Failed)?;
        eprintln!("written to {}", fitted.rig.display());
    }
    Ok(())
}

fn fit_tables(tables: &[PathBuf], path: &Path) -> Result<Fitted, Failure> {
    let rig = Rig::load(path).map_err(Failure::refused)?;
    let readings = tables
        .iter()
        .map(|table| readings(table, &rig))
        .collect::<anyhow::Result<Vec<_>>>()
        .map_err(Failure::Refused)?
        .concat();
    let correction = InverseDepth::fit(&readings).map_err(Failure::refused)?;
    Ok(Fitted {
        readings,
        correction,
        rig: path.to_owned(),
    })
}

fn as_json(fitted: &Fitted) -> serde_json::Value {
    let reading = |reading: &Reading| {
        json!({
            "true_m": reading.true_m,
            "measured_m": reading.measured_m,
            "corrected_m": 1.0 / fitted.correction.corrected_per_m(1.0 / reading.measured_m),
        })
    };
    json!({
        "scale": fitted.correction.scale,
        "offset_per_m": fitted.correction.offset_per_m,
        "covariance": fitted.correction.covariance,
        "readings": fitted.readings.iter().map(reading).collect::<Vec<_>>(),
    })
}

/// All readings of a table, as they would be without the correction that the rig file may have already.
fn readings(path: &Path, rig: &Rig) -> anyhow::Result<Vec<Reading>> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let mut rows = text
        .lines()
        .zip(1..)
        .filter(|(line, _)| !line.trim().is_empty() && !line.starts_with('#'));
    let Some((header, _)) = rows.next() else {
        bail!("{}: empty, needed is a header and readings", path.display());
    };
    let columns = Columns::of(header).with_context(|| path.display().to_string())?;
    rows.map(|(line, number)| {
        columns
            .reading(line, rig)
            .with_context(|| format!("{}, line {number}", path.display()))
    })
    .collect()
}

/// Where a table has what.
struct Columns {
    true_m: usize,
    measured: Measured,
}

/// What was measured, and its column.
enum Measured {
    Metres(usize),
    Disparity(usize),
}

impl Columns {
    fn of(header: &str) -> anyhow::Result<Self> {
        let find = |name: &str| header.split(',').position(|column| column.trim() == name);
        let measured = find("measured_m")
            .map(Measured::Metres)
            .or_else(|| find("disparity_px").map(Measured::Disparity));
        let (Some(true_m), Some(measured)) = (find("true_m"), measured) else {
            bail!("header is {header:?}, needed are true_m and measured_m or disparity_px");
        };
        Ok(Self { true_m, measured })
    }

    fn reading(&self, line: &str, rig: &Rig) -> anyhow::Result<Reading> {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let number = |column: usize| -> anyhow::Result<f64> {
            let cell = cells.get(column).copied().unwrap_or_default();
            let value: f64 = cell
                .parse()
                .with_context(|| format!("{cell:?} is no number"))?;
            Ok(value)
        };
        let measured_m = match self.measured {
            Measured::Metres(column) => number(column)?,
            Measured::Disparity(column) => {
                let disparity_px = number(column)?;
                rig.depth_m(disparity_px).with_context(|| {
                    format!("disparity {disparity_px} px lies at or beyond infinity for this rig")
                })?
            }
        };
        let uncorrected_per_m = rig.inverse_depth().measured_per_m(1.0 / measured_m);
        Ok(Reading {
            true_m: number(self.true_m)?,
            measured_m: 1.0 / uncorrected_per_m,
        })
    }
}

fn show(readings: &[Reading], correction: &InverseDepth) {
    let [scale, _, offset] = correction.covariance.map(|term| term.max(0.0).sqrt());
    println!(
        "1/measured = {:.5} ± {scale:.5} / true {:+.6} ± {offset:.6} 1/m",
        correction.scale, correction.offset_per_m
    );
    let mut table = comfy_table::Table::new();
    table.set_header(["true m", "measured m", "off %", "corrected m", "off %"]);
    for reading in readings {
        let corrected_m = 1.0 / correction.corrected_per_m(1.0 / reading.measured_m);
        let off = |found_m: f64| format!("{:+.2}", 100.0 * (found_m / reading.true_m - 1.0));
        table.add_row([
            format!("{:.3}", reading.true_m),
            format!("{:.3}", reading.measured_m),
            off(reading.measured_m),
            format!("{corrected_m:.3}"),
            off(corrected_m),
        ]);
    }
    println!("{table}");
}

/// The rig file is replaced as a whole or not at all.
fn write(rig: &Path, correction: &InverseDepth) -> anyhow::Result<()> {
    let text = std::fs::read_to_string(rig)?;
    let new = correction.written_into(&text);
    Rig::parse(&new, rig)?;
    let mut beside = rig.as_os_str().to_owned();
    beside.push(".new");
    std::fs::write(&beside, new)?;
    std::fs::rename(&beside, rig)?;
    Ok(())
}
