//! `emberfix calibrate boresight`.

use crate::boresight::{
    Gathered, Marker, Parameter, Picker, Picks, Solution, Start, gather, observability, rig_file,
    solve,
};
use crate::cli::Failure;
use crate::detect::{self, BoxFileDetector, Detector};
use crate::ingest::SourceError;
use crate::mission::Mission;
use emberfix_calib::solve::Board;
use emberfix_frames::{EllipsoidHeight, place_from_degrees};
use emberfix_report::Figure;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// How the camera sits on the airframe and how late its clock is, from a flight past a fixed point.
#[derive(Debug, clap::Args)]
pub struct BoresightArguments {
    /// Recording of the flight (MCAP).
    recording: PathBuf,
    /// Mission file, such as missions/marker.toml; its rig is where the search starts.
    mission: PathBuf,
    #[command(flatten)]
    marker: MarkerArguments,
    /// The marker's pixels, picked by hand: lines of PAIR,COLUMN,ROW.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["board", "boxes"])]
    picks: Option<PathBuf>,
    /// The marker is the middle of a board: 7x5 (inner corners) or charuco:11x8 (squares).
    #[arg(long, value_name = "BOARD", conflicts_with = "boxes")]
    board: Option<String>,
    /// The marker is a fire: boxes from a file instead of the mission's model, which finds it otherwise.
    #[arg(long, value_name = "FILE")]
    boxes: Option<PathBuf>,
    /// Write the mission's rig file, with what was found, to this file (which may be the same).
    #[arg(long, value_name = "RIG")]
    write: Option<PathBuf>,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
}

/// Where a marker is.
#[derive(Debug, clap::Args)]
pub(super) struct MarkerArguments {
    /// The marker's surveyed place: degrees, degrees, metres above the ellipsoid. Without it: any fixed
    /// point, and what remains unknown is said.
    #[arg(long, value_name = "LAT,LON,H", allow_hyphen_values = true, value_parser = place)]
    marker: Option<[f64; 3]>,
    /// One sigma of the survey, metres.
    #[arg(long, value_name = "M", default_value_t = 0.02, value_parser = survey)]
    marker_sigma: f64,
}

impl MarkerArguments {
    /// The marker, if it was surveyed.
    pub(super) fn marker(&self) -> Result<Option<Marker>, Failure> {
        let Some([latitude, longitude, height]) = self.marker else {
            return Ok(None);
        };
        let height = EllipsoidHeight::from_m(height);
        let place = place_from_degrees(latitude, longitude, height).map_err(Failure::refused)?;
        Ok(Some(Marker {
            place,
            sigma_m: self.marker_sigma,
        }))
    }
}

fn place(text: &str) -> Result<[f64; 3], String> {
    let wanted = "LAT,LON,H in degrees and metres, such as 31.4094,119.1120,11.1";
    let numbers: Vec<f64> = text
        .split(',')
        .map(|number| number.trim().parse::<f64>())
        .collect::<Result<_, _>>()
        .map_err(|_| wanted.to_owned())?;
    <[f64; 3]>::try_from(numbers).map_err(|_| wanted.to_owned())
}

fn survey(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(sigma) if (0.001..=100.0).contains(&sigma) => Ok(sigma),
        _ => Err("allowed are 0.001 to 100 metres".to_owned()),
    }
}

/// Gathers, solves, shows, writes.
pub fn boresight(arguments: &BoresightArguments) -> Result<(), Failure> {
    let mission = Mission::load(&arguments.mission).map_err(Failure::refused)?;
    let marker = arguments.marker.marker()?;
    let start = Start::of(&mission, marker);
    let gathered = read(arguments, &mission, &start)?;
    let solution = solve(&start, &gathered.sights).map_err(Failure::failed)?;
    let words = observability(&solution);
    if arguments.json {
        println!("{:#}", as_json(&solution, &gathered, &mission, &words));
    } else {
        print!("{}", as_text(&solution, &gathered, &mission, &words));
    }
    if let Some(to) = &arguments.write {
        let from = mission.rig_path.as_path();
        rig_file::write(from, to, &mission.rig, &solution).map_err(Failure::failed)?;
        eprintln!("written: {}", to.display());
    }
    Ok(())
}

fn read(
    arguments: &BoresightArguments,
    mission: &Mission,
    start: &Start,
) -> Result<Gathered, Failure> {
    let picker = picker(arguments, mission)?;
    with_spinner(|progress| gather(&arguments.recording, mission, start, picker, progress))
}

/// Gathers, and shows how many pairs there were so far.
pub(super) fn with_spinner(
    gather: impl FnOnce(&mut dyn FnMut(u64)) -> Result<Gathered, SourceError>,
) -> Result<Gathered, Failure> {
    let bar = indicatif::ProgressBar::new_spinner();
    if let Ok(style) = indicatif::ProgressStyle::with_template("{spinner} {pos} pairs, {elapsed}") {
        bar.set_style(style);
    }
    let gathered = gather(&mut |pairs| bar.set_position(pairs));
    bar.finish_and_clear();
    gathered.map_err(|error| {
        if error.is_refusal() {
            Failure::refused(error)
        } else {
            Failure::failed(error)
        }
    })
}

fn picker(arguments: &BoresightArguments, mission: &Mission) -> Result<Picker, Failure> {
    Ok(match (&arguments.picks, &arguments.board) {
        (Some(path), _) => Picker::Picks(Picks::load(path).map_err(Failure::refused)?),
        // Squares of any size have the same middle; markers fill about three quarters of theirs.
        (_, Some(board)) => {
            Picker::Board(Board::parse(board, 0.1, Some(0.075)).map_err(Failure::refused)?)
        }
        _ => Picker::Fire(detector_of(arguments.boxes.as_deref(), mission)?),
    })
}

/// Boxes from a file, or the mission's model.
pub(super) fn detector_of(
    boxes: Option<&Path>,
    mission: &Mission,
) -> Result<Box<dyn Detector>, Failure> {
    match boxes {
        Some(path) => Ok(Box::new(
            BoxFileDetector::load(path).map_err(Failure::refused)?,
        )),
        None => detect::open(&mission.detector).map_err(Failure::refused),
    }
}

/// A row: what it is, by the rig file, found, one sigma; a number of the parameter vector.
struct Row {
    name: &'static str,
    was: f64,
    found: f64,
    sigma: f64,
    unit: &'static str,
}

fn rows(solution: &Solution, mission: &Mission) -> Vec<Row> {
    let (rig, degrees) = (&mission.rig, f64::to_degrees);
    let (was, mount) = (rig.mount(), solution.mount);
    let arm = rig.lever_arm();
    let arm = emberfix_frames::Metres::metres(&arm);
    let angle = |name, was: f64, found: f64, parameter: Parameter| Row {
        name,
        was: degrees(was),
        found: degrees(found),
        sigma: degrees(solution.sigma(parameter as usize)),
        unit: "deg",
    };
    let mut rows = vec![
        angle("mount yaw", was.yaw_rad, mount.yaw_rad, Parameter::MountYaw),
        angle(
            "mount depression",
            was.depression_rad,
            mount.depression_rad,
            Parameter::MountPitch,
        ),
        angle(
            "mount roll",
            was.roll_rad,
            mount.roll_rad,
            Parameter::MountRoll,
        ),
        Row {
            name: "camera offset",
            was: rig.time_offset_s() * 1e3,
            found: (rig.time_offset_s() + solution.clock_s()) * 1e3,
            sigma: solution.sigma(Parameter::Clock as usize) * 1e3,
            unit: "ms",
        },
    ];
    for (axis, name) in ["arm forward", "arm right", "arm down"]
        .into_iter()
        .enumerate()
    {
        rows.push(Row {
            name,
            was: arm[axis],
            found: solution.arm_m[axis],
            sigma: solution.sigma(Parameter::Arm as usize + axis),
            unit: "m",
        });
    }
    let heading = solution.value(Parameter::Heading);
    rows.push(angle("heading error", 0.0, heading, Parameter::Heading));
    for (axis, name) in ["GNSS east", "GNSS north", "GNSS up"]
        .into_iter()
        .enumerate()
    {
        let index = Parameter::Gnss as usize + axis;
        rows.push(Row {
            name,
            was: 0.0,
            found: solution.parameters[index],
            sigma: solution.sigma(index),
            unit: "m",
        });
    }
    rows
}

fn as_text(
    solution: &Solution,
    gathered: &Gathered,
    mission: &Mission,
    words: &[String],
) -> String {
    use std::fmt::Write;
    let mut text = format!(
        "{}: marker in {} of {} pairs, {} used, {} set aside; {:.2} px left over\n\n",
        mission.rig.name(),
        gathered.seen,
        gathered.pairs,
        solution.used,
        solution.outliers,
        solution.rms_px,
    );
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::UTF8_HORIZONTAL_ONLY);
    table.set_header(["", "rig file", "found", "one sigma", "unit"]);
    for row in rows(solution, mission) {
        table.add_row([
            row.name.to_owned(),
            format!("{:.3}", row.was),
            format!("{:.3}", row.found),
            format!("{:.3}", row.sigma),
            row.unit.to_owned(),
        ]);
    }
    let _ = writeln!(text, "{table}");
    if words.is_empty() {
        let _ = writeln!(text, "\nAll of it was seen well enough.");
    } else {
        let _ = writeln!(text, "\nWhat this flight does not show:");
        words.iter().for_each(|sentence| {
            let _ = writeln!(text, "- {sentence}");
        });
    }
    text
}

fn as_json(solution: &Solution, gathered: &Gathered, mission: &Mission, words: &[String]) -> Value {
    let told = |name, value, unit| Figure::told(name, Some(value), unit, solution.used);
    let boresight_deg = solution.boresight_sigma().to_degrees();
    let clock_ms = solution.sigma(Parameter::Clock as usize) * 1e3;
    let figures = [
        told("calibration.boresight_sigma_deg", boresight_deg, "deg"),
        told("calibration.clock_sigma_ms", clock_ms, "ms"),
        told("calibration.boresight_rms_px", solution.rms_px, "px"),
    ];
    let rows: Vec<Value> = rows(solution, mission)
        .iter()
        .map(|row| {
            json!({
                "name": row.name, "rig_file": row.was, "found": row.found,
                "sigma": row.sigma, "unit": row.unit,
            })
        })
        .collect();
    let covariance: Vec<Vec<f64>> = solution
        .covariance
        .row_iter()
        .map(|row| row.iter().copied().collect())
        .collect();
    json!({
        "rig": mission.rig.name(),
        "surveyed": solution.surveyed,
        "pairs": gathered.pairs,
        "seen": gathered.seen,
        "without_way": gathered.without_way,
        "used": solution.used,
        "set_aside": solution.outliers,
        "widened_by": solution.widened,
        "found": rows,
        "covariance": covariance,
        "not_seen": words,
        "figures": figures,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_three_numbers() {
        assert_eq!(place("-31.4, 119.1,11").unwrap(), [-31.4, 119.1, 11.0]);
        assert!(place("31.4,119.1").unwrap_err().contains("LAT,LON,H"));
        assert!(survey("nan").is_err());
    }
}
