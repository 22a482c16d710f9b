//! `chess_a`: 29 pairs of a real rig, hand-held board, 9x6 corners, 24.23 mm squares.

use super::CalibrationEvalError;
use crate::eval::Table;
use emberfix_calib::solve::{
    Board, HeldOut, StereoSolution, View, cross_validate, find_corners, make_consistent, read_grey,
    solve, solve_again,
};
use emberfix_report::{Bound, Figure};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::path::Path;

const PAIRS: usize = 29;
const SIZE_PX: (u32, u32) = (640, 360);
const SQUARE_M: f64 = 0.02423;
/// Times that the pairs are split into random halves.
const SPLITS: usize = 50;

/// What came of it.
pub(super) struct ChessA {
    solution: StereoSolution,
    held_out: HeldOut,
    pairs: usize,
    spread_mm: f64,
    widest_mm: f64,
}

pub(super) fn measure(folder: &Path, seed: u64) -> Result<ChessA, CalibrationEvalError> {
    let board = Board::parse("9x6", SQUARE_M).map_err(|_| CalibrationEvalError::NoImage {
        path: folder.to_owned(),
    })?;
    let views = views(folder, &board)?;
    let solution = solve(&board, &views, SIZE_PX)?;
    let baselines_mm = halves(&board, &views, &solution, seed)?;
    let mean = baselines_mm.iter().sum::<f64>() / baselines_mm.len() as f64;
    let squares: f64 = baselines_mm.iter().map(|mm| (mm - mean).powi(2)).sum();
    let full_mm = 1e3 * solution.baseline_m();
    Ok(ChessA {
        held_out: cross_validate(&board, &views, &solution)?,
        pairs: views.len(),
        spread_mm: (squares / (baselines_mm.len() - 1) as f64).sqrt(),
        widest_mm: baselines_mm
            .iter()
            .map(|mm| (mm - full_mm).abs())
            .fold(0.0, f64::max),
        solution,
    })
}

fn views(folder: &Path, board: &Board) -> Result<Vec<View>, CalibrationEvalError> {
    let corners = |name: String| {
        let path = folder.join(name);
        let image = read_grey(&path)?.ok_or(CalibrationEvalError::NoImage { path })?;
        Ok::<_, CalibrationEvalError>(find_corners(&image, board)?)
    };
    let found = (1..=PAIRS).into_par_iter().map(|number| {
        let left = corners(format!("left{number:02}.jpg"))?;
        let right = corners(format!("right{number:02}.jpg"))?;
        let name = format!("{number:02}");
        Ok(left
            .zip(right)
            .map(|(left, right)| make_consistent(board, View { name, left, right })))
    });
    let found: Vec<Option<View>> = found.collect::<Result<_, CalibrationEvalError>>()?;
    Ok(found.into_iter().flatten().collect())
}

/// Baselines of random halves, millimetres.
fn halves(
    board: &Board,
    views: &[View],
    solution: &StereoSolution,
    seed: u64,
) -> Result<Vec<f64>, CalibrationEvalError> {
    let splits: Vec<Vec<usize>> = (0..SPLITS)
        .map(|split| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(split as u64);
            let mut order: Vec<usize> = (0..views.len()).collect();
            order.shuffle(&mut random);
            order
        })
        .collect();
    let baselines = splits.par_iter().flat_map(|order| {
        let (one, other) = order.split_at(order.len() / 2);
        [one, other]
            .map(|half| solve_again(board, views, solution, half).map(|s| 1e3 * s.baseline_m()))
    });
    Ok(baselines.collect::<Result<_, _>>()?)
}

impl ChessA {
    pub(super) fn figures(&self) -> Vec<Figure> {
        vec![
            Figure::bounded(
                "calibration.chess_a_rms_px",
                Some(self.solution.rms_px()),
                "px",
                Bound::AtMost(0.26),
                self.pairs,
            ),
            Figure::bounded(
                "calibration.baseline_spread_mm",
                Some(self.spread_mm),
                "mm",
                Bound::AtMost(0.2),
                2 * SPLITS,
            ),
            Figure::told(
                "calibration.chess_a_held_out_px",
                Some(self.held_out.rms_px),
                "px",
                self.pairs,
            ),
        ]
    }

    pub(super) fn table(&self) -> Table {
        let row = |what: &str, value: String| vec![what.to_owned(), value];
        let sigmas = self.solution.sigmas();
        Table {
            title: "chess_a (a real rig's pictures)".to_owned(),
            header: vec![String::new(), "one sigma".to_owned()],
            rows: vec![
                row("pairs", self.pairs.to_string()),
                row("stereo RMS, px", format!("{:.4}", self.solution.rms_px())),
                row("held out, px", format!("{:.4}", self.held_out.rms_px)),
                row(
                    "baseline, mm",
                    format!(
                        "{:.3} ± {:.3}",
                        1e3 * self.solution.baseline_m(),
                        1e3 * self.solution.baseline_sigma_m()
                    ),
                ),
                row(
                    "baseline of random halves, spread, mm",
                    format!("{:.3}", self.spread_mm),
                ),
                row(
                    "the same over root two, to hold against the sigma, mm",
                    format!("{:.3}", self.spread_mm / std::f64::consts::SQRT_2),
                ),
                row(
                    "the half that is farthest off, mm",
                    format!("{:.3}", self.widest_mm),
                ),
                row(
                    "focal length, left, px",
                    format!("{:.2} ± {:.2}", self.solution.left.focal_px.0, sigmas[0]),
                ),
                row(
                    "sigmas widened by",
                    format!("{:.2}", self.solution.widened_by),
                ),
            ],
        }
    }

    pub(super) fn details(&self) -> serde_json::Value {
        serde_json::json!({
            "pairs": self.pairs,
            "rms_px": self.solution.rms_px(),
            "held_out_rms_px": self.held_out.rms_px,
            "baseline_m": self.solution.baseline_m(),
            "baseline_sigma_m": self.solution.baseline_sigma_m(),
            "spread_mm": self.spread_mm,
            "widest_mm": self.widest_mm,
        })
    }
}
