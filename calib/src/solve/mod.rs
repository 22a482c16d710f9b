//! From pictures of a board to both cameras, the pair, and how well each number is known.
//!
//! **Purpose.** Zhang's method (Z. Zhang, "A flexible new technique for camera calibration", PAMI
//! 2000) by OpenCV for each eye, then one least-squares problem over both eyes, every board pose, the
//! board's own unevenness and its steps between the eyes, whose Jacobian at the solution gives the
//! covariance. **In:** grey images, or corners in raw pixels; a [`Board`] in metres; a [`Model`].
//! **Out:** [`StereoSolution`]. No I/O, no clock, no randomness.
//!
//! **Assumptions.** Corner errors are independent of each other, with one sigma an eye, which the
//! residuals tell. Boards are printed on paper that is not quite flat, the same in every view; hands move
//! them between two eyes that are not quite in step, mostly little, now and then much. What of this there
//! is the pictures tell; a flat board before eyes in step costs nothing. Where whole views disagree all the
//! same, a jackknife over views widens [`StereoSolution::covariance`], each parameter by its own factor.
//! **Known limits.** A board that bends from one view to the next; rolling shutters.

mod aruco;
mod board;
mod calibration;
mod charuco;
mod dictionary;
mod equations;
mod find;
mod joint;
mod leftover;
mod predict;
mod prior;
mod project;
mod start;
mod state;
mod trust;
mod wanted;
mod weights;

pub use board::{Board, BoardError, Markers};
pub use calibration::{
    COVERAGE_CELLS, Calibration, Demands, TOLD_DEPTHS_M, calibrate, cell, epipolar_rms_px,
    rectification,
};
pub use dictionary::Dictionary;
pub use find::{find_corners, make_consistent, read_grey};
pub use predict::{RangeError, disparity_sigma_px, range_errors};
pub use state::{BoardPose, GLOBALS, GlobalMatrix, GlobalVector, Step, parameter_names};
pub use trust::{Dropped, HeldOut, cross_validate, drop_worst};
pub use wanted::{Hold, Look, USUAL_VIEWS, Wanted};

use crate::{Camera, RawPixel};
use emberfix_frames::{Matrix3, Vector3};

/// One corner of the board in one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Which: [`Board::point_m`] says where it is on the board.
    pub id: usize,
    /// Where it is in the raw image.
    pub pixel: RawPixel,
}

/// The board in both eyes at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Name for people: what the pair's files have in common.
    pub name: String,
    /// Corners in the left image.
    pub left: Vec<Corner>,
    /// Corners in the right image.
    pub right: Vec<Corner>,
}

/// How far from its own projection a corner was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// Where it was found.
    pub at: RawPixel,
    /// Found minus projected, columns and rows, pixels.
    pub off_px: (f64, f64),
}

/// What the solution leaves of one view.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewResiduals {
    /// The view's name.
    pub name: String,
    /// Left eye.
    pub left: Vec<Residual>,
    /// Right eye.
    pub right: Vec<Residual>,
}

impl ViewResiduals {
    /// Root mean square of the corners' errors in both eyes, pixels.
    #[must_use]
    pub fn rms_px(&self) -> f64 {
        rms_px(self.left.iter().chain(&self.right))
    }
}

/// Root mean square length of residuals, pixels; 0 of none.
#[must_use]
pub fn rms_px<'a>(residuals: impl Iterator<Item = &'a Residual>) -> f64 {
    let (count, squares) = residuals.fold((0_usize, 0.0), |(count, squares), residual| {
        let (u, v) = residual.off_px;
        (count + 1, squares + u * u + v * v)
    });
    (squares / count.max(1) as f64).sqrt()
}

/// What is assumed of boards and lenses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Model {
    /// The board's corners are found, not taken from the print: paper bends and is rough.
    pub uneven_board: bool,
    /// The board may move between the eyes' exposures.
    pub moving_board: bool,
    /// Pixels are square, lenses nearly centred, and third radial terms small.
    pub lens_priors: bool,
}

impl Model {
    /// All of it.
    pub const FULL: Self = Self {
        uneven_board: true,
        moving_board: true,
        lens_priors: true,
    };
    /// None of it: a perfect board, held perfectly still, and any lens, as OpenCV's `stereoCalibrate`
    /// assumes.
    pub const OPENCV: Self = Self {
        uneven_board: false,
        moving_board: false,
        lens_priors: false,
    };
}

impl Default for Model {
    fn default() -> Self {
        Self::FULL
    }
}

/// Both cameras and how they stand to each other, with covariance.
#[derive(Debug, Clone)]
pub struct StereoSolution {
    /// Left camera.
    pub left: Camera,
    /// Right camera.
    pub right: Camera,
    /// Takes left-camera components to right-camera components (OpenCV's R).
    pub right_from_left: Matrix3<f64>,
    /// Left camera's origin in right-camera components, metres (OpenCV's T).
    pub translation_m: Vector3<f64>,
    /// What was assumed of boards and lenses.
    pub model: Model,
    /// How far each corner of the board lies from where it should have been printed, board axes, metres.
    pub uneven_m: Vec<Vector3<f64>>,
    /// Where the board was, in the left camera, one a view.
    pub boards: Vec<BoardPose>,
    /// How it moved between the eyes' exposures, one a view.
    pub steps: Vec<Step>,
    /// One sigma of a typical step per axis: turn in radians, move in metres.
    pub step_sigma: (f64, f64),
    /// Covariance of the [`GLOBALS`] parameters in the order of [`parameter_names`]: pixels, pure
    /// numbers, radians about right-camera axes, metres.
    pub covariance: GlobalMatrix,
    /// One sigma of a corner along one axis, pixels: left eye, right eye.
    pub corner_sigma_px: [f64; 2],
    /// The most by which a parameter's sigma was widened because whole views disagree; 1 when they don't.
    pub widened_by: f64,
    /// What is left of every view with one pose of the board for both eyes.
    pub residuals: Vec<ViewResiduals>,
}

impl StereoSolution {
    /// Root mean square of all corners' errors in both eyes, pixels (OpenCV's stereo RMS).
    #[must_use]
    pub fn rms_px(&self) -> f64 {
        let views = self.residuals.iter();
        rms_px(views.flat_map(|view| view.left.iter().chain(&view.right)))
    }

    /// Between the optical centres, metres.
    #[must_use]
    pub fn baseline_m(&self) -> f64 {
        self.translation_m.norm()
    }

    /// One sigma of [`Self::baseline_m`], metres.
    #[must_use]
    pub fn baseline_sigma_m(&self) -> f64 {
        let along = self.translation_m.normalize();
        let block = self.covariance.fixed_view::<3, 3>(21, 21);
        (along.transpose() * block * along)[0].max(0.0).sqrt()
    }

    /// Every shared parameter, in the order of [`parameter_names`]; the rotation as a vector.
    #[must_use]
    pub fn values(&self) -> GlobalVector {
        state::values(self)
    }

    /// One sigma of every parameter, in the order of [`parameter_names`].
    #[must_use]
    pub fn sigmas(&self) -> GlobalVector {
        self.covariance
            .diagonal()
            .map(|variance| variance.max(0.0).sqrt())
    }
}

/// Why there is no solution.
#[derive(Debug, thiserror::Error)]
pub enum SolveError {
    /// Too little to solve from.
    #[error(
        "{found} pairs show the whole board in both eyes, needed are {needed}; take more pictures, \
         with the board close and tilted, and in every corner of the image"
    )]
    TooFewViews {
        /// Usable pairs.
        found: usize,
        /// Least number of pairs.
        needed: usize,
    },
    /// The views don't determine the parameters.
    #[error(
        "the pictures don't determine the cameras (all boards parallel or far away?); add pictures \
         with the board tilted by 30 to 45 degrees about both axes"
    )]
    Undetermined,
    /// OpenCV failed.
    #[error("OpenCV could not calibrate an eye: {}", .0.message.replace('\n', " "))]
    OpenCv(#[from] opencv::Error),
}

/// Fewest pairs that are tried.
pub const FEWEST_VIEWS: usize = 5;

/// Solves for both cameras and the pair from all `views`, each eye by Zhang's method first.
///
/// # Errors
/// [`SolveError`].
pub fn solve(
    board: &Board,
    views: &[View],
    image_size_px: (u32, u32),
    model: Model,
) -> Result<StereoSolution, SolveError> {
    if views.len() < FEWEST_VIEWS {
        return Err(SolveError::TooFewViews {
            found: views.len(),
            needed: FEWEST_VIEWS,
        });
    }
    let start = start::start(board, views, image_size_px)?;
    joint::solve(board, views, start, model)
}

/// Solves again from some of the views of a solution, beginning there.
///
/// `chosen` are indices into the views that `from` was solved with.
///
/// # Errors
/// [`SolveError`].
pub fn solve_again(
    board: &Board,
    views: &[View],
    from: &StereoSolution,
    chosen: &[usize],
) -> Result<StereoSolution, SolveError> {
    let some: Vec<View> = chosen.iter().map(|&index| views[index].clone()).collect();
    let start = state::State::from_solution(from, chosen);
    joint::solve(board, &some, start, from.model)
}
