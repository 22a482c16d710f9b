//! `emberfix calibrate stereo`: both eyes and the pair, from pictures of a board, or from a camera.

mod live;
mod look;
mod tell;

use super::mounting::{Asked, Known, MountingArguments};
use crate::cli::Failure;
use anyhow::anyhow;
use emberfix_calib::solve::{Board, Calibration, Demands, Model, USUAL_VIEWS, calibrate};
use emberfix_calib::{Calibrated, PageInput, RigParts, page};
use indicatif::ProgressBar;
use look::Looked;
use std::path::PathBuf;

/// Both eyes and the pair, from pictures of a board, or from a camera that looks at one.
#[derive(Debug, clap::Args)]
pub struct StereoArguments {
    /// Folders and image files; pairs are found by their names (left/right, L/R, cam0/cam1, nir/vis).
    #[arg(required_unless_present = "live", conflicts_with = "live")]
    images: Vec<PathBuf>,
    /// A camera instead: any URL that a mission's [camera] takes. Pairs are taken by themselves while the
    /// board is held still, and what is missing is said, until there is enough.
    #[arg(long, value_name = "URL")]
    live: Option<String>,
    /// Pairs that are taken at least while the camera is watched; with four times as many, range is half
    /// as far off.
    #[arg(long, default_value_t = USUAL_VIEWS, requires = "live")]
    live_pairs: usize,
    /// Longest that the camera is watched, seconds.
    #[arg(long, default_value_t = 900.0, requires = "live", value_parser = seconds)]
    live_limit_s: f64,
    /// Greatest difference of the eyes' exposures that is one moment, seconds, while the camera is watched.
    #[arg(long, default_value_t = 0.02, requires = "live", value_parser = seconds)]
    live_skew_s: f64,
    /// Keep the pairs that are taken as PNG files in this folder.
    #[arg(long, value_name = "FOLDER", requires = "live")]
    keep: Option<PathBuf>,
    /// The board: 9x6 is a chessboard by its inner corners, charuco:9x6 a ChArUco board by its squares
    /// (charuco:9x6:5x5_100 with other markers than 4x4).
    #[arg(long)]
    board: String,
    /// Side of a square, millimetres: measure the print.
    #[arg(long)]
    square_mm: f64,
    /// Side of a ChArUco board's markers with their black border, millimetres.
    #[arg(long)]
    marker_mm: Option<f64>,
    /// Assume what OpenCV's stereoCalibrate does: a perfect board, held perfectly still, and any lens.
    #[arg(long)]
    like_opencv: bool,
    /// Rig file to write; what pictures can't tell is then needed, see below.
    #[arg(long)]
    out: Option<PathBuf>,
    /// HTML page to write.
    #[arg(long)]
    report: Option<PathBuf>,
    /// Every corner that was found, as JSON, for other programs.
    #[arg(long, value_name = "FILE")]
    corners: Option<PathBuf>,
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

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds < 1e5 => Ok(seconds),
        _ => Err("allowed are seconds above 0".to_owned()),
    }
}

/// Looks, solves, tells, writes.
pub fn stereo(arguments: &StereoArguments) -> Result<(), Failure> {
    let board = board(arguments)?;
    let asked = match &arguments.out {
        Some(_) => Some(arguments.mounting.ask(&Known::default())?),
        None => None,
    };
    let looked = match &arguments.live {
        Some(url) => live::watch(arguments, url, &board)?,
        None => look::look(&arguments.images, &board)?,
    };
    if let Some(path) = &arguments.corners {
        super::write(path, &format!("{:#}", tell::corners(&board, &looked)))?;
    }
    let calibration = solve(arguments, &board, &looked)?;
    tell::tell(arguments, &looked, &calibration)?;
    if let Some(path) = &arguments.report {
        let html = report(arguments, &board, &looked, &calibration)?;
        super::write(path, &html)?;
    }
    if calibration.is_refused() {
        return Err(Failure::Refused(anyhow!(
            "the calibration is refused, and no rig was written: {}",
            tell::refusals(&calibration).join("; ")
        )));
    }
    match (&arguments.out, asked) {
        (Some(path), Some(asked)) => write_rig(arguments, path, asked, &calibration),
        _ => Ok(()),
    }
}

fn board(arguments: &StereoArguments) -> Result<Board, Failure> {
    let (square_m, marker_mm) = (1e-3 * arguments.square_mm, arguments.marker_mm);
    let marker_m = marker_mm.map(|side| 1e-3 * side);
    Board::parse(&arguments.board, square_m, marker_m).map_err(Failure::refused)
}

fn solve(
    arguments: &StereoArguments,
    board: &Board,
    looked: &Looked,
) -> Result<Calibration, Failure> {
    let demands = Demands {
        max_rms_px: arguments.max_rms_px,
        drop_worst: !arguments.keep_all,
        model: if arguments.like_opencv {
            Model::OPENCV
        } else {
            Model::FULL
        },
    };
    let spinner = spinner("solving, and again without each fifth of the pairs");
    let calibration = calibrate(board, looked.views.clone(), looked.size, demands);
    spinner.finish_and_clear();
    calibration.map_err(Failure::refused)
}

fn spinner(what: &'static str) -> ProgressBar {
    let spinner = ProgressBar::new_spinner().with_message(what);
    spinner.enable_steady_tick(std::time::Duration::from_millis(120));
    spinner
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
    let now = jiff::Timestamp::now();
    now.strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

fn report(
    arguments: &StereoArguments,
    board: &Board,
    looked: &Looked,
    calibration: &Calibration,
) -> Result<String, Failure> {
    let middle = &calibration.views[calibration.views.len() / 2].name;
    let images = looked.pictures(middle).map_err(Failure::failed)?;
    let input = PageInput {
        name: &rig_name(arguments),
        at: &now(),
        board: &board.words(),
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
