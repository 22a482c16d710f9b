//! Calibration against truth: simulated rigs whose numbers are known, and a real rig's pictures.
//!
//! **In:** a seed, how many rigs; the folder of `chess_a`, if it is there. **Out:** a [`Report`] with the
//! figures `calibration.*`. **Assumptions.** Simulated boards are *rendered* through each eye's own lens
//! and found by the same finder as real ones: blur, noise, near-infrared contrast and all. The paper is bent
//! and wavy, and hands move it between eyes that are not quite in step, in a quarter of the pairs by much.
//! **Known limits.** Global shutters; a lens of the model that is solved for.

mod boards;
mod chess;
mod rigs;

use super::{Report, Table};
use emberfix_calib::solve::SolveError;
use emberfix_report::{Axis, Bound, Chart, Figure, Mark, Series, Sheet};
use rayon::prelude::*;
use rigs::Outcome;
use std::path::PathBuf;

/// What to measure.
#[derive(Debug, Clone)]
pub struct Options {
    /// Seed of everything random.
    pub seed: u64,
    /// Simulated rigs; every second one has P4's near-infrared eye.
    pub rigs: usize,
    /// Pairs of pictures a rig.
    pub pairs: usize,
    /// Folder of the real pictures; none are measured without.
    pub chess_a: Option<PathBuf>,
}

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationEvalError {
    /// The solver refused.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// OpenCV failed at an image.
    #[error("OpenCV: {}", .0.message.replace('\n', " "))]
    OpenCv(#[from] opencv::Error),
    /// A simulated rig that the gate refuses.
    #[error(transparent)]
    Rig(#[from] emberfix_calib::RigError),
    /// A picture that is not there.
    #[error("{}: no image", path.display())]
    NoImage {
        /// The file.
        path: PathBuf,
    },
}

/// Measures all; `done` is called once for every simulated rig.
///
/// # Errors
/// [`CalibrationEvalError`].
pub fn measure(options: &Options, done: impl Fn() + Sync) -> Result<Report, CalibrationEvalError> {
    let outcomes: Vec<Outcome> = (0..options.rigs)
        .into_par_iter()
        .map(|number| {
            let outcome = rigs::calibrate(options.seed, number, options.pairs);
            done();
            outcome
        })
        .collect::<Result<_, _>>()?;
    let mut figures = simulated_figures(&outcomes);
    let mut tables = vec![simulated_table(&outcomes)];
    let mut real = None;
    if let Some(folder) = &options.chess_a {
        let found = chess::measure(folder, options.seed)?;
        figures.extend(found.figures());
        tables.push(found.table());
        real = Some(found.details());
    }
    figures.sort_by_key(|figure| figure.bound.is_none());
    Ok(Report {
        figures,
        details: serde_json::json!({
            "rigs": outcomes.iter().map(Outcome::details).collect::<Vec<_>>(),
            "chess_a": real,
        }),
        tables,
        plots: vec![("calibration-range-bias".to_owned(), plot(&outcomes))],
    })
}

fn simulated_figures(outcomes: &[Outcome]) -> Vec<Figure> {
    let pulls: Vec<f64> = outcomes.iter().flat_map(Outcome::pulls).collect();
    let within = pulls.iter().filter(|pull| pull.abs() <= 2.0).count() as f64 / pulls.len() as f64;
    let squares: f64 = outcomes
        .iter()
        .map(|outcome| outcome.range_bias.powi(2))
        .sum();
    let rms = 100.0 * (squares / outcomes.len() as f64).sqrt();
    let worst = outcomes
        .iter()
        .map(|outcome| 100.0 * outcome.range_bias.abs())
        .fold(0.0, f64::max);
    let covered = outcomes
        .iter()
        .filter(|outcome| outcome.range_bias.abs() <= 2.0 * outcome.range_sigma)
        .count() as f64
        / outcomes.len() as f64;
    let count = outcomes.len();
    let some = (!outcomes.is_empty()).then_some(());
    vec![
        Figure::bounded(
            "calibration.within_2_sigma",
            some.map(|()| within),
            "",
            Bound::AtLeast(0.9),
            pulls.len(),
        ),
        Figure::bounded(
            "calibration.range_bias_10m",
            some.map(|()| rms),
            "%",
            Bound::AtMost(0.3),
            count,
        ),
        Figure::told(
            "calibration.range_bias_10m_worst",
            some.map(|()| worst),
            "%",
            count,
        ),
        Figure::told(
            "calibration.range_bias_within_2_sigma",
            some.map(|()| covered),
            "",
            count,
        ),
    ]
}

fn simulated_table(outcomes: &[Outcome]) -> Table {
    let header = [
        "rig",
        "pairs",
        "rms, px",
        "focal, pull",
        "baseline, mm",
        "pull",
        "rotation y, deg",
        "pull",
        "range bias at 10 m, %",
        "predicted sigma, %",
    ];
    Table {
        title: "Simulated rigs (rendered boards, found by OpenCV)".to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows: outcomes.iter().map(Outcome::row).collect(),
    }
}

fn plot(outcomes: &[Outcome]) -> Sheet {
    let points = |infrared: bool| {
        outcomes
            .iter()
            .filter(|outcome| outcome.infrared == infrared)
            .map(|outcome| {
                (
                    100.0 * outcome.range_sigma,
                    100.0 * outcome.range_bias.abs(),
                )
            })
            .collect::<Vec<_>>()
    };
    let most = outcomes
        .iter()
        .map(|outcome| 100.0 * outcome.range_sigma)
        .fold(0.01, f64::max);
    let axis = |label| Axis::linear(label);
    let chart = Chart::new(
        "Range bias at 10 m from calibration",
        axis("predicted sigma, %"),
        axis("found, absolute, %"),
    )
    .with(Series::new("both visible", Mark::Dots, points(false)))
    .with(Series::new(
        "near-infrared left eye",
        Mark::Dots,
        points(true),
    ))
    .with(Series::new(
        "two sigma",
        Mark::Dashed,
        vec![(0.0, 0.0), (most, 2.0 * most)],
    ));
    Sheet {
        charts: vec![chart],
        columns: 1,
    }
}
