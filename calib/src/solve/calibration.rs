//! A whole calibration: fit, dropped views, held-out views, coverage, what it means, and whether it
//! may be used.

use super::{
    Board, Dropped, HeldOut, Model, RangeError, SolveError, StereoSolution, View, cross_validate,
    disparity_sigma_px, drop_worst, range_errors, solve,
};
use crate::{Eye, Finding, Rectification, Severity, implausible};

/// What may be asked of a calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Demands {
    /// Greatest root mean square reprojection error, pixels.
    pub max_rms_px: f64,
    /// Leave out views that stand out.
    pub drop_worst: bool,
    /// What is assumed of boards and lenses.
    pub model: Model,
}

impl Default for Demands {
    fn default() -> Self {
        Self {
            max_rms_px: 0.5,
            drop_worst: true,
            model: Model::FULL,
        }
    }
}

/// Depths at which the range error is told, metres.
pub const TOLD_DEPTHS_M: [f64; 4] = [5.0, 10.0, 30.0, 100.0];

/// Cells of the coverage grid: columns, rows.
pub const COVERAGE_CELLS: (usize, usize) = (8, 6);

/// What came of a set of views.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// The views that were used.
    pub views: Vec<View>,
    /// Their solution.
    pub solution: StereoSolution,
    /// Views that were left out.
    pub dropped: Vec<Dropped>,
    /// How it does on what it has not seen.
    pub held_out: HeldOut,
    /// Share of the image's cells that corners fell into: left eye, right eye.
    pub coverage: [f64; 2],
    /// One sigma of range at [`TOLD_DEPTHS_M`].
    pub range_errors: Vec<RangeError>,
    /// One sigma of the disparity offset, pixels.
    pub disparity_sigma_px: f64,
    /// What is wrong with it.
    pub findings: Vec<Finding>,
}

impl Calibration {
    /// Whether it may be used.
    #[must_use]
    pub fn is_refused(&self) -> bool {
        self.findings
            .iter()
            .any(|finding| finding.severity == Severity::Refusal)
    }
}

/// Solves, drops, cross-validates, judges.
///
/// # Errors
/// [`SolveError`] where nothing could be solved; what could be and is bad stands in the findings.
pub fn calibrate(
    board: &Board,
    views: Vec<View>,
    image_size_px: (u32, u32),
    demands: Demands,
) -> Result<Calibration, SolveError> {
    let solution = solve(board, &views, image_size_px, demands.model)?;
    let (views, solution, dropped) = if demands.drop_worst {
        drop_worst(board, views, solution)?
    } else {
        (views, solution, Vec::new())
    };
    let held_out = cross_validate(board, &views, &solution)?;
    let coverage = [
        coverage(views.iter().map(|view| &view.left), image_size_px),
        coverage(views.iter().map(|view| &view.right), image_size_px),
    ];
    let mut calibration = Calibration {
        range_errors: range_errors(&solution, &TOLD_DEPTHS_M)?,
        disparity_sigma_px: disparity_sigma_px(&solution)?,
        findings: Vec::new(),
        views,
        solution,
        dropped,
        held_out,
        coverage,
    };
    calibration.findings = judge(&calibration, demands)?;
    Ok(calibration)
}

fn coverage<'a>(
    corners: impl Iterator<Item = &'a Vec<super::Corner>>,
    image_size_px: (u32, u32),
) -> f64 {
    let (columns, rows) = COVERAGE_CELLS;
    let mut hit = vec![false; columns * rows];
    for corner in corners.flatten() {
        if let Some(cell) = cell(corner.pixel, image_size_px) {
            hit[cell] = true;
        }
    }
    hit.iter().filter(|hit| **hit).count() as f64 / hit.len() as f64
}

/// The cell of the coverage grid that a pixel lies in, row by row.
#[must_use]
pub fn cell(pixel: crate::RawPixel, (width, height): (u32, u32)) -> Option<usize> {
    let (columns, rows) = COVERAGE_CELLS;
    let column = ((pixel.u + 0.5) / f64::from(width) * columns as f64).floor();
    let row = ((pixel.v + 0.5) / f64::from(height) * rows as f64).floor();
    let inside = (0.0..columns as f64).contains(&column) && (0.0..rows as f64).contains(&row);
    inside.then(|| row as usize * columns + column as usize)
}

fn judge(calibration: &Calibration, demands: Demands) -> Result<Vec<Finding>, SolveError> {
    let solution = &calibration.solution;
    let mut findings: Vec<Finding> = [
        rms(calibration, demands),
        swapped(solution),
        baseline(solution),
        few_pairs(calibration),
        foretells_badly(calibration),
        views_disagree(solution),
        eyes_out_of_step(solution),
        many_dropped(calibration),
    ]
    .into_iter()
    .flatten()
    .collect();
    findings.extend(poor_coverage(calibration));
    let rectification = Rectification::new(
        &solution.left,
        &solution.right,
        &solution.right_from_left,
        &solution.translation_m,
    )?;
    findings.extend(implausible(
        &solution.left,
        &solution.right,
        &rectification,
        &solution.translation_m,
    ));
    Ok(findings)
}

fn rms(calibration: &Calibration, demands: Demands) -> Option<Finding> {
    let (found, allowed) = (calibration.solution.rms_px(), demands.max_rms_px);
    (found > allowed).then(|| {
        Finding::refusal(format!(
            "reprojection error is {found:.2} px, allowed is {allowed} px; hold the board and the rig \
             still, use a flat board, and check that --board and --square-mm are those of the print"
        ))
    })
}

fn swapped(solution: &StereoSolution) -> Option<Finding> {
    let x_mm = 1e3 * solution.translation_m.x;
    (x_mm > 0.0).then(|| {
        Finding::refusal(format!(
            "the right camera stands {x_mm:.0} mm to the LEFT of the left one: the eyes are swapped; \
             exchange left and right"
        ))
    })
}

const BASELINES_M: (f64, f64) = (0.01, 2.0);

fn baseline(solution: &StereoSolution) -> Option<Finding> {
    let found_mm = 1e3 * solution.baseline_m();
    let (least, greatest) = BASELINES_M;
    (!(least..=greatest).contains(&solution.baseline_m())).then(|| {
        Finding::refusal(format!(
            "the baseline is {found_mm:.1} mm, believable is {} to {} mm; is --square-mm right, and are \
             the pairs pictures of one moment?",
            1e3 * least,
            1e3 * greatest
        ))
    })
}

const ENOUGH_PAIRS: usize = 15;

fn few_pairs(calibration: &Calibration) -> Option<Finding> {
    let found = calibration.views.len();
    (found < ENOUGH_PAIRS).then(|| {
        Finding::doubt(format!(
            "only {found} pairs were used, {ENOUGH_PAIRS} or more are good; take more pictures"
        ))
    })
}

const LEAST_COVERAGE: f64 = 0.4;
const GOOD_COVERAGE: f64 = 0.7;

fn poor_coverage(calibration: &Calibration) -> Vec<Finding> {
    let eyes = ["left", "right"].into_iter().zip(calibration.coverage);
    eyes.filter(|(_, share)| *share < GOOD_COVERAGE)
        .map(|(eye, share)| {
            let sentence = format!(
                "corners cover {:.0} % of the {eye} image, needed are {:.0} %, good are {:.0} %; take \
                 pictures with the board in the image's corners and along its edges",
                100.0 * share,
                100.0 * LEAST_COVERAGE,
                100.0 * GOOD_COVERAGE
            );
            if share < LEAST_COVERAGE {
                Finding::refusal(sentence)
            } else {
                Finding::doubt(sentence)
            }
        })
        .collect()
}

/// Held-out errors above this multiple of the fit's own mean that the fit follows noise.
const FORETELLING_RATIO: f64 = 1.5;

fn foretells_badly(calibration: &Calibration) -> Option<Finding> {
    let HeldOut {
        rms_px,
        fitted_rms_px,
        ..
    } = calibration.held_out;
    (rms_px > FORETELLING_RATIO * fitted_rms_px).then(|| {
        Finding::doubt(format!(
            "held-out pairs are missed by {rms_px:.2} px, fitted ones by {fitted_rms_px:.2} px: the fit \
             follows noise; take more pictures"
        ))
    })
}

const WIDENED_LIMIT: f64 = 2.0;

fn views_disagree(solution: &StereoSolution) -> Option<Finding> {
    (solution.widened_by > WIDENED_LIMIT).then(|| {
        Finding::doubt(format!(
            "whole pairs disagree, so that every sigma was widened {:.1} times: is the board stiff, and is \
             it held still?",
            solution.widened_by
        ))
    })
}

/// A board that stands, before eyes in step, seems to move less than this between them, metres.
const STILL_M: f64 = 5e-5;

fn eyes_out_of_step(solution: &StereoSolution) -> Option<Finding> {
    let typical_mm = 1e3 * solution.step_sigma.1;
    let steps = solution.steps.iter().zip(&solution.residuals);
    let (most_mm, name) = steps
        .map(|(step, view)| (1e3 * step.move_m.norm(), &view.name))
        .max_by(|a, b| a.0.total_cmp(&b.0))?;
    (solution.step_sigma.1 > STILL_M).then(|| {
        Finding::doubt(format!(
            "the board moved between the eyes' exposures, by {typical_mm:.2} mm as a rule and by \
             {most_mm:.1} mm in {name}: the eyes are out of step, or the board is not stiff; put the board \
             down for each picture, and trigger both eyes at once before flying"
        ))
    })
}

fn many_dropped(calibration: &Calibration) -> Option<Finding> {
    let (dropped, used) = (calibration.dropped.len(), calibration.views.len());
    (dropped > 0 && dropped * 5 >= used).then(|| {
        Finding::doubt(format!(
            "{dropped} of {} pairs were dropped; hold the board still and take them again",
            dropped + used
        ))
    })
}

/// The rectified geometry of a solution.
///
/// # Errors
/// [`SolveError::OpenCv`].
pub fn rectification(solution: &StereoSolution) -> Result<Rectification, SolveError> {
    Ok(Rectification::new(
        &solution.left,
        &solution.right,
        &solution.right_from_left,
        &solution.translation_m,
    )?)
}

/// Root mean square difference of rows of the same corner after rectification, pixels.
///
/// # Errors
/// [`SolveError::OpenCv`].
pub fn epipolar_rms_px(calibration: &Calibration) -> Result<f64, SolveError> {
    let rectification = rectification(&calibration.solution)?;
    let (mut count, mut squares) = (0_usize, 0.0);
    for view in &calibration.views {
        for corner in &view.left {
            let Some(other) = view.right.iter().find(|other| other.id == corner.id) else {
                continue;
            };
            let left = rectification.rectify(Eye::Left, &[corner.pixel])?[0];
            let right = rectification.rectify(Eye::Right, &[other.pixel])?[0];
            count += 1;
            squares += (left.v - right.v).powi(2);
        }
    }
    Ok((squares / count.max(1) as f64).sqrt())
}
