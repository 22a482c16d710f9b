//! `chess_a`: 29 pairs of a real rig, hand-held board, 9x6 corners, 24.23 mm squares.

use super::CalibrationEvalError;
use crate::eval::Table;
use emberfix_calib::solve::{
    Board, HeldOut, Model, StereoSolution, View, cross_validate, find_corners, make_consistent,
    read_grey, solve, solve_again,
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
    halves: Halves,
    /// With a flat board that is held still, as OpenCV assumes.
    like_opencv: Halves,
}

/// Baselines of random halves of the pairs, millimetres.
struct Halves {
    /// Their standard deviation: the figure.
    spread_mm: f64,
    /// The farthest from that of all pairs.
    widest_mm: f64,
    /// What their own covariances foretell, root mean square.
    foretold_mm: f64,
}

pub(super) fn measure(folder: &Path, seed: u64) -> Result<ChessA, CalibrationEvalError> {
    let board = Board::chess(9, 6, SQUARE_M);
    let views = views(folder, &board)?;
    let of_model = |model| {
        let solution = solve(&board, &views, SIZE_PX, model)?;
        let halves = halves(&board, &views, &solution, seed)?;
        Ok::<_, CalibrationEvalError>((solution, halves))
    };
    let (solution, halves) = of_model(Model::FULL)?;
    let (_, like_opencv) = of_model(Model::OPENCV)?;
    Ok(ChessA {
        held_out: cross_validate(&board, &views, &solution)?,
        pairs: views.len(),
        halves,
        like_opencv,
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

fn halves(
    board: &Board,
    views: &[View],
    solution: &StereoSolution,
    seed: u64,
) -> Result<Halves, CalibrationEvalError> {
    let splits: Vec<Vec<usize>> = (0..SPLITS)
        .map(|split| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(split as u64);
            let mut order: Vec<usize> = (0..views.len()).collect();
            order.shuffle(&mut random);
            order
        })
        .collect();
    let found = splits.par_iter().flat_map(|order| {
        let (one, other) = order.split_at(order.len() / 2);
        [one, other].map(|half| {
            let half = solve_again(board, views, solution, half)?;
            Ok::<_, CalibrationEvalError>((1e3 * half.baseline_m(), 1e3 * half.baseline_sigma_m()))
        })
    });
    let found: Vec<(f64, f64)> = found.collect::<Result<_, _>>()?;
    let count = found.len() as f64;
    let mean = found.iter().map(|(mm, _)| mm).sum::<f64>() / count;
    let squares: f64 = found.iter().map(|(mm, _)| (mm - mean).powi(2)).sum();
    let foretold: f64 = found.iter().map(|(_, sigma)| sigma.powi(2)).sum();
    let full_mm = 1e3 * solution.baseline_m();
    Ok(Halves {
        spread_mm: (squares / (count - 1.0)).sqrt(),
        widest_mm: found
            .iter()
            .map(|(mm, _)| (mm - full_mm).abs())
            .fold(0.0, f64::max),
        foretold_mm: (foretold / count).sqrt(),
    })
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
                Some(self.halves.spread_mm),
                "mm",
                Bound::AtMost(0.2),
                2 * SPLITS,
            ),
            Figure::told(
                "calibration.baseline_spread_foretold_mm",
                Some(self.halves.foretold_mm),
                "mm",
                2 * SPLITS,
            ),
            Figure::told(
                "calibration.baseline_spread_like_opencv_mm",
                Some(self.like_opencv.spread_mm),
                "mm",
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
                    "baseline of random halves, standard deviation, mm",
                    format!("{:.3}", self.halves.spread_mm),
                ),
                row(
                    "the same as the halves' own covariances foretell it, mm",
                    format!("{:.3}", self.halves.foretold_mm),
                ),
                row(
                    "the same with a flat, still board (as OpenCV has it), mm",
                    format!("{:.3}", self.like_opencv.spread_mm),
                ),
                row(
                    "the half that is farthest off, mm",
                    format!("{:.3}", self.halves.widest_mm),
                ),
                row(
                    "board from eye to eye, mm and degrees per axis",
                    format!(
                        "± {:.2}, ± {:.2}",
                        1e3 * self.solution.step_sigma.1,
                        self.solution.step_sigma.0.to_degrees()
                    ),
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
            "spread_mm": self.halves.spread_mm,
            "widest_mm": self.halves.widest_mm,
            "spread_foretold_mm": self.halves.foretold_mm,
            "spread_like_opencv_mm": self.like_opencv.spread_mm,
        })
    }
}
