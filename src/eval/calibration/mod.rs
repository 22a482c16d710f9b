//! Calibration against truth: simulated rigs whose numbers are known, and a real rig's pictures.
//!
//! **In:** a seed, how many rigs; the folder of `chess_a`, if it is there. **Out:** a [`Report`] with the
//! figures `calibration.*`. **Assumptions.** Simulated boards are *rendered* through each eye's own lens
//! and found by the same finder as real ones: blur, noise, near-infrared contrast and all. The paper is bent
//! and wavy. Each rig is calibrated twice: from pairs of eyes that are triggered together and a board held
//! still, and from snapshots of a board in a moving hand by eyes that are not quite in step.
//! **Known limits.** Global shutters; a lens of the model that is solved for.

mod boards;
mod chess;
mod rigs;

use super::{Report, Table};
use emberfix_calib::solve::SolveError;
use emberfix_report::{Axis, Bound, Chart, Figure, Mark, Series, Sheet};
use rayon::prelude::*;
use rigs::{Outcome, Taken};
use std::path::PathBuf;

/// What to measure.
#[derive(Debug, Clone)]
pub struct Options {
    /// Seed of everything random.
    pub seed: u64,
    /// Simulated rigs, each calibrated twice (in step and from snapshots); every second one has P4's
    /// near-infrared eye.
    pub rigs: usize,
    /// Pairs of pictures in step, a rig.
    pub pairs: usize,
    /// Snapshots a rig: hardly anyone has the patience for more.
    pub snapshots: usize,
    /// Folder of the real pictures; none are measured without.
    pub chess_a: Option<PathBuf>,
}

impl Options {
    fn pairs(&self, taken: Taken) -> usize {
        match taken {
            Taken::InStep => self.pairs,
            Taken::Snapshots => self.snapshots,
        }
    }
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
    // Real pictures first: where they are missing, nobody waits for the rigs to hear it.
    let folder = options.chess_a.as_deref();
    let real = folder
        .map(|folder| chess::measure(folder, options.seed))
        .transpose()?;
    let outcomes: Vec<Outcome> = (0..options.rigs)
        .flat_map(|number| Taken::BOTH.map(|taken| (number, taken)))
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|(number, taken)| {
            let outcome = rigs::calibrate(options.seed, number, taken, options.pairs(taken));
            done();
            outcome
        })
        .collect::<Result<_, _>>()?;
    let mut figures = simulated_figures(&outcomes);
    let mut tables = vec![simulated_table(&outcomes)];
    if let Some(real) = &real {
        figures.extend(real.figures());
        tables.push(real.table());
    }
    figures.sort_by_key(|figure| figure.bound.is_none());
    Ok(Report {
        figures,
        details: serde_json::json!({
            "rigs": outcomes.iter().map(Outcome::details).collect::<Vec<_>>(),
            "chess_a": real.map(|real| real.details()),
        }),
        tables,
        plots: vec![("calibration-range-bias".to_owned(), plot(&outcomes))],
    })
}

fn simulated_figures(outcomes: &[Outcome]) -> Vec<Figure> {
    let pulls: Vec<f64> = outcomes.iter().flat_map(Outcome::pulls).collect();
    let within = share(pulls.iter().map(|pull| pull.abs() <= 2.0));
    let of = |taken| {
        outcomes
            .iter()
            .filter(move |outcome| outcome.taken == taken)
    };
    let rms_percent = |taken| {
        let squares = of(taken).map(|outcome| outcome.range_bias.powi(2));
        let count = of(taken).count();
        (count > 0).then(|| 100.0 * (squares.sum::<f64>() / count as f64).sqrt())
    };
    let worst_percent = |taken| {
        of(taken)
            .map(|outcome| 100.0 * outcome.range_bias.abs())
            .max_by(f64::total_cmp)
    };
    let covered = |taken| {
        share(of(taken).map(|outcome| outcome.range_bias.abs() <= 2.0 * outcome.range_sigma))
    };
    let mut figures = vec![
        Figure::bounded(
            "calibration.within_2_sigma",
            within,
            "",
            Bound::AtLeast(0.9),
            pulls.len(),
        ),
        Figure::bounded(
            "calibration.range_bias_10m",
            rms_percent(Taken::InStep),
            "%",
            Bound::AtMost(0.3),
            of(Taken::InStep).count(),
        ),
        Figure::told(
            "calibration.snapshots_range_bias_10m",
            rms_percent(Taken::Snapshots),
            "%",
            of(Taken::Snapshots).count(),
        ),
    ];
    for taken in Taken::BOTH {
        let count = of(taken).count();
        let told = |what: &str, value, unit| {
            Figure::told(
                format!("calibration.{}_{what}", taken.word()),
                value,
                unit,
                count,
            )
        };
        figures.push(told("range_bias_10m_worst", worst_percent(taken), "%"));
        figures.push(told("range_bias_within_2_sigma", covered(taken), ""));
    }
    figures
}

/// Share of those that are so; none of none.
fn share(all: impl Iterator<Item = bool>) -> Option<f64> {
    let (mut so, mut count) = (0_u32, 0_u32);
    for one in all {
        so += u32::from(one);
        count += 1;
    }
    (count > 0).then(|| f64::from(so) / f64::from(count))
}

fn simulated_table(outcomes: &[Outcome]) -> Table {
    let header = [
        "rig",
        "taken",
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
    let points = |taken: Taken, infrared: bool| {
        outcomes
            .iter()
            .filter(|outcome| outcome.taken == taken && outcome.infrared == infrared)
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
    .with(Series::new(
        "two sigma",
        Mark::Dashed,
        vec![(0.0, 0.0), (most, 2.0 * most)],
    ));
    let chart = Taken::BOTH
        .into_iter()
        .flat_map(|taken| {
            [
                (taken, false, "visible"),
                (taken, true, "near-infrared left eye"),
            ]
        })
        .fold(chart, |chart, (taken, infrared, eyes)| {
            let name = format!("{}, {eyes}", taken.word());
            chart.with(Series::new(name, Mark::Dots, points(taken, infrared)))
        });
    Sheet {
        charts: vec![chart],
        columns: 1,
    }
}
