//! `emberfix calibrate stereo`: both eyes and the pair, from pictures of a board.

use super::mounting::{Asked, Known, MountingArguments};
use super::pairs::{self, FilePair};
use crate::cli::Failure;
use anyhow::anyhow;
use comfy_table::Table;
use emberfix_calib::solve::{
    Board, Calibration, Demands, View, ViewResiduals, calibrate, epipolar_rms_px, find_corners,
    make_consistent, parameter_names, read_grey,
};
use emberfix_calib::{Calibrated, PageInput, RigParts, Severity, page};
use emberfix_frames::ServiceTime;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use std::path::PathBuf;

/// Both eyes and the pair, from pictures of a board.
#[derive(Debug, clap::Args)]
pub struct StereoArguments {
    /// Folders and image files; pairs are found by their names (left/right, L/R, cam0/cam1, nir/vis).
    #[arg(required = true)]
    images: Vec<PathBuf>,
    /// Inner corners of the chessboard, such as 9x6.
    #[arg(long)]
    board: String,
    /// Side of a square, millimetres: measure the print.
    #[arg(long)]
    square_mm: f64,
    /// Rig file to write; what pictures can't tell is then needed, see below.
    #[arg(long)]
    out: Option<PathBuf>,
    /// HTML page to write.
    #[arg(long)]
    report: Option<PathBuf>,
    /// Name of the rig; the rig file's if not given.
    #[arg(long)]
    name: Option<String>,
    /// Greatest reprojection error, pixels.
    #[arg(long, default_value_t = Demands::default().max_rms_px)]
    max_rms_px: f64,
    /// Use every pair, the worst too.
    #[arg(long)]
    keep_all: bool,
    /// Print figures, parameters and covariance as JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    mounting: MountingArguments,
}

/// Solves, tells, writes.
pub fn stereo(arguments: &StereoArguments) -> Result<(), Failure> {
    let board = board(arguments)?;
    let asked = match &arguments.out {
        Some(_) => Some(arguments.mounting.ask(&Known::default())?),
        None => None,
    };
    let pairs = file_pairs(&arguments.images)?;
    let looked = look(&pairs, &board)?;
    let demands = Demands {
        max_rms_px: arguments.max_rms_px,
        drop_worst: !arguments.keep_all,
    };
    let spinner = spinner("solving, and again without each fifth of the pairs");
    let calibration = calibrate(&board, looked.views.clone(), looked.size, demands);
    spinner.finish_and_clear();
    let calibration = calibration.map_err(Failure::refused)?;
    tell(arguments, &looked, &calibration)?;
    if let Some(path) = &arguments.report {
        let html = report(arguments, &pairs, &calibration)?;
        super::write(path, &html)?;
    }
    if calibration.is_refused() {
        return Err(Failure::Refused(anyhow!(
            "the calibration is refused, and no rig was written: {}",
            refusals(&calibration).join("; ")
        )));
    }
    match (&arguments.out, asked) {
        (Some(path), Some(asked)) => write_rig(arguments, path, asked, &calibration),
        _ => Ok(()),
    }
}

fn board(arguments: &StereoArguments) -> Result<Board, Failure> {
    Board::parse(&arguments.board, 1e-3 * arguments.square_mm).map_err(Failure::refused)
}

fn file_pairs(places: &[PathBuf]) -> Result<Vec<FilePair>, Failure> {
    let files =
        pairs::images(places).map_err(|error| Failure::Refused(anyhow!("images: {error}")))?;
    let pairs = pairs::pair_up(&files);
    if pairs.is_empty() {
        return Err(Failure::Refused(anyhow!(
            "no pairs among {} image files: names need left/right, L/R, cam0/cam1 or nir/vis, and what is \
             left of the name must be the same in both",
            files.len()
        )));
    }
    Ok(pairs)
}

/// What was seen in the pictures.
struct Looked {
    views: Vec<View>,
    /// Pairs without the board, and what was wrong.
    unusable: Vec<(String, String)>,
    size: (u32, u32),
}

type Eye = Result<(Vec<emberfix_calib::solve::Corner>, (u32, u32)), String>;

fn look(pairs: &[FilePair], board: &Board) -> Result<Looked, Failure> {
    let progress = bar(pairs.len() as u64, "looking for the board");
    let found: Vec<(Eye, Eye)> = pairs
        .par_iter()
        .map(|pair| {
            let eyes = (eye(&pair.left, board), eye(&pair.right, board));
            progress.inc(1);
            eyes
        })
        .collect();
    progress.finish_and_clear();
    let mut looked = Looked {
        views: Vec::new(),
        unusable: Vec::new(),
        size: (0, 0),
    };
    for (pair, eyes) in pairs.iter().zip(found) {
        match eyes {
            (Ok((left, left_size)), Ok((right, right_size))) => {
                same_size(pair, &mut looked.size, left_size, right_size)?;
                let name = pair.name.clone();
                let view = make_consistent(board, View { name, left, right });
                looked.views.push(view);
            }
            (Err(why), _) => looked
                .unusable
                .push((pair.name.clone(), format!("left: {why}"))),
            (_, Err(why)) => looked
                .unusable
                .push((pair.name.clone(), format!("right: {why}"))),
        }
    }
    Ok(looked)
}

fn eye(path: &std::path::Path, board: &Board) -> Eye {
    use opencv::prelude::MatTraitConst;
    let in_words = |error: opencv::Error| error.message.replace('\n', " ");
    let image = read_grey(path)
        .map_err(in_words)?
        .ok_or_else(|| format!("{} is no image", path.display()))?;
    let size = (image.cols().unsigned_abs(), image.rows().unsigned_abs());
    match find_corners(&image, board).map_err(in_words)? {
        Some(corners) => Ok((corners, size)),
        None => Err("the board was not found".to_owned()),
    }
}

fn same_size(
    pair: &FilePair,
    size: &mut (u32, u32),
    left: (u32, u32),
    right: (u32, u32),
) -> Result<(), Failure> {
    if *size == (0, 0) {
        *size = left;
    }
    for (path, found) in [(&pair.left, left), (&pair.right, right)] {
        if found != *size {
            return Err(Failure::Refused(anyhow!(
                "{} has {}x{} pixels, others have {}x{}; all pictures need one size",
                path.display(),
                found.0,
                found.1,
                size.0,
                size.1
            )));
        }
    }
    Ok(())
}

fn bar(length: u64, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}");
    let bar = ProgressBar::new(length).with_message(what);
    match style {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

fn spinner(what: &'static str) -> ProgressBar {
    let spinner = ProgressBar::new_spinner().with_message(what);
    spinner.enable_steady_tick(std::time::Duration::from_millis(120));
    spinner
}

fn refusals(calibration: &Calibration) -> Vec<String> {
    let refused = calibration.findings.iter();
    refused
        .filter(|finding| finding.severity == Severity::Refusal)
        .map(ToString::to_string)
        .collect()
}

fn tell(
    arguments: &StereoArguments,
    looked: &Looked,
    calibration: &Calibration,
) -> Result<(), Failure> {
    if arguments.json {
        println!("{:#}", json(looked, calibration)?);
        return Ok(());
    }
    for (name, why) in &looked.unusable {
        println!("not used: {name}: {why}");
    }
    for dropped in &calibration.dropped {
        println!(
            "dropped: {}: error {:.3} px, the others allow {:.3} px",
            dropped.name, dropped.rms_px, dropped.limit_px
        );
    }
    println!("{}", summary(calibration)?);
    println!("{}", range_table(calibration));
    for finding in &calibration.findings {
        let word = match finding.severity {
            Severity::Refusal => "REFUSED",
            Severity::Doubt => "doubt",
        };
        println!("{word}: {finding}");
    }
    Ok(())
}

fn table() -> Table {
    let mut table = Table::new();
    table.load_style(comfy_table::presets::UTF8_HORIZONTAL_ONLY);
    table
}

fn summary(calibration: &Calibration) -> Result<Table, Failure> {
    let solution = &calibration.solution;
    let (values, sigmas) = (solution.values(), solution.sigmas());
    let with = |index: usize| format!("{:.2} ± {:.2} px", values[index], sigmas[index]);
    let turn = |axis: usize| {
        format!(
            "{:.3} ± {:.3}",
            values[18 + axis].to_degrees(),
            sigmas[18 + axis].to_degrees()
        )
    };
    let [left, right] = calibration.coverage.map(|share| 100.0 * share);
    let mut table = table();
    table.set_header(["", "one sigma"]);
    table.add_row(["pairs", &calibration.views.len().to_string()]);
    let errors = format!(
        "{:.3} px fitted, {:.3} px held out",
        solution.rms_px(),
        calibration.held_out.rms_px
    );
    table.add_row(["reprojection error", &errors]);
    let rows = format!(
        "{:.3} px",
        epipolar_rms_px(calibration).map_err(Failure::failed)?
    );
    table.add_row(["row difference, rectified", &rows]);
    table.add_row(["focal length, left", &with(0)]);
    table.add_row(["focal length, right", &with(9)]);
    let baseline = format!(
        "{:.2} ± {:.2} mm",
        1e3 * solution.baseline_m(),
        1e3 * solution.baseline_sigma_m()
    );
    table.add_row(["baseline", &baseline]);
    let rotation = format!("{}, {}, {} degrees", turn(0), turn(1), turn(2));
    table.add_row(["right from left, rotation", &rotation]);
    table.add_row(["coverage", &format!("{left:.0} % left, {right:.0} % right")]);
    Ok(table)
}

fn range_table(calibration: &Calibration) -> Table {
    let mut table = table();
    table.set_header(["depth, m", "± range from calibration, m", "%"]);
    for error in &calibration.range_errors {
        table.add_row([
            format!("{}", error.depth_m),
            format!("{:.3}", error.sigma_m),
            format!("{:.2}", 100.0 * error.share()),
        ]);
    }
    table
}

fn json(looked: &Looked, calibration: &Calibration) -> Result<serde_json::Value, Failure> {
    let solution = &calibration.solution;
    let covariance: Vec<Vec<f64>> = solution
        .covariance
        .row_iter()
        .map(|row| row.iter().copied().collect())
        .collect();
    let views: Vec<_> = solution
        .residuals
        .iter()
        .map(|view| serde_json::json!({"name": view.name, "rms_px": ViewResiduals::rms_px(view)}))
        .collect();
    let figure = |name: &str, value: f64, unit: &'static str| {
        emberfix_report::Figure::told(name, Some(value), unit, calibration.views.len())
    };
    Ok(serde_json::json!({
        "figures": [
            figure("calibrate.rms_px", solution.rms_px(), "px"),
            figure("calibrate.held_out_rms_px", calibration.held_out.rms_px, "px"),
            figure("calibrate.epipolar_rms_px", epipolar_rms_px(calibration).map_err(Failure::failed)?, "px"),
            figure("calibrate.baseline", solution.baseline_m(), "m"),
            figure("calibrate.baseline_sigma", solution.baseline_sigma_m(), "m"),
            figure("calibrate.disparity_sigma", calibration.disparity_sigma_px, "px"),
        ],
        "parameters": parameter_names(),
        "values": solution.values().as_slice(),
        "sigmas": solution.sigmas().as_slice(),
        "covariance": covariance,
        "image_size_px": [looked.size.0, looked.size.1],
        "corner_sigma_px": solution.corner_sigma_px,
        "widened_by": solution.widened_by,
        "coverage": calibration.coverage,
        "range": calibration.range_errors.iter()
            .map(|error| serde_json::json!({"depth_m": error.depth_m, "sigma_m": error.sigma_m}))
            .collect::<Vec<_>>(),
        "views": views,
        "dropped": calibration.dropped.iter()
            .map(|view| serde_json::json!({"name": view.name, "rms_px": view.rms_px, "limit_px": view.limit_px}))
            .collect::<Vec<_>>(),
        "unusable": looked.unusable,
        "refused": calibration.is_refused(),
        "findings": calibration.findings.iter().map(ToString::to_string).collect::<Vec<_>>(),
    }))
}

fn rig_name(arguments: &StereoArguments) -> String {
    let from_file = || {
        let stem = arguments.out.as_ref()?.file_stem()?;
        Some(stem.to_string_lossy().into_owned())
    };
    arguments
        .name
        .clone()
        .or_else(from_file)
        .unwrap_or_else(|| "stereo pair".to_owned())
}

/// UTC, whole seconds.
fn now() -> String {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let seconds = since.map_or(0, |since| since.as_secs() as i64);
    ServiceTime::from_unix_ns(seconds * 1_000_000_000).rfc3339()
}

fn report(
    arguments: &StereoArguments,
    pairs: &[FilePair],
    calibration: &Calibration,
) -> Result<String, Failure> {
    let middle = &calibration.views[calibration.views.len() / 2].name;
    let shown = pairs.iter().find(|pair| &pair.name == middle);
    let images = match shown {
        Some(pair) => {
            let left = read_grey(&pair.left).map_err(Failure::failed)?;
            let right = read_grey(&pair.right).map_err(Failure::failed)?;
            left.zip(right)
        }
        None => None,
    };
    let input = PageInput {
        name: &rig_name(arguments),
        at: &now(),
        board: &format!("{}, {} mm squares", arguments.board, arguments.square_mm),
        calibration,
        pair: images
            .as_ref()
            .map(|(left, right)| (middle.as_str(), left, right)),
    };
    page(&input).map_err(Failure::failed)
}

/// A fresh calibration still drifts with warmth and knocks; nobody has measured less.
const LEAST_DISPARITY_BIAS_PX: f64 = 0.02;

fn write_rig(
    arguments: &StereoArguments,
    path: &std::path::Path,
    asked: Asked,
    calibration: &Calibration,
) -> Result<(), Failure> {
    let solution = &calibration.solution;
    let at_10m = calibration
        .range_errors
        .iter()
        .find(|error| error.depth_m == 10.0);
    let parts = RigParts {
        name: rig_name(arguments),
        left: solution.left.clone(),
        right: solution.right.clone(),
        right_from_left: solution.right_from_left,
        translation_m: solution.translation_m,
        max_skew_s: asked.max_skew_s,
        disparity_bias_px: calibration.disparity_sigma_px.max(LEAST_DISPARITY_BIAS_PX),
        mounting: asked.mounting,
        calibrated: Some(Calibrated {
            at: now(),
            pairs: calibration.views.len(),
            rms_px: solution.rms_px(),
            held_out_rms_px: calibration.held_out.rms_px,
            range_sigma_at_10m_percent: at_10m.map_or(0.0, |error| 100.0 * error.share()),
        }),
    };
    parts.check(path).map_err(Failure::refused)?;
    super::write(path, &parts.to_toml())
}
