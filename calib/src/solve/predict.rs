//! What the calibration's covariance means for ranges.

use super::state::{GLOBALS, GlobalVector, State};
use super::{SolveError, StereoSolution};
use crate::{Camera, Eye, RawPixel, Rectification};
use emberfix_frames::Vector3;
use nalgebra::DVector;

/// One sigma of a range that comes from the calibration alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RangeError {
    /// Depth along the boresight, metres.
    pub depth_m: f64,
    /// One sigma of that depth, metres; root mean square over the image's middle half. Linear in
    /// inverse depth: a sigma as large as the depth means that the far end is open.
    pub sigma_m: f64,
}

impl RangeError {
    /// The sigma as a share of the depth.
    #[must_use]
    pub fn share(&self) -> f64 {
        self.sigma_m / self.depth_m
    }
}

/// Where in the image depths are probed: shares of its width and height.
const PROBES: [f64; 3] = [0.25, 0.5, 0.75];

/// One sigma of depths, through the rectification that flies.
///
/// # Errors
/// [`SolveError::OpenCv`] when the pair can't be rectified.
pub fn range_errors(
    solution: &StereoSolution,
    depths_m: &[f64],
) -> Result<Vec<RangeError>, SolveError> {
    let gradients = inverse_depth_gradients(solution, depths_m)?;
    Ok(depths_m
        .iter()
        .zip(gradients)
        .map(|(&depth_m, probes)| RangeError {
            depth_m,
            sigma_m: rms_sigma(solution, &probes) * depth_m * depth_m,
        })
        .collect())
}

/// One sigma of the disparity offset that the calibration leaves, pixels: that of far depths.
///
/// # Errors
/// [`SolveError::OpenCv`] when the pair can't be rectified.
pub fn disparity_sigma_px(solution: &StereoSolution) -> Result<f64, SolveError> {
    // So far away that an error of scale does not count.
    let far_m = 1000.0 * solution.baseline_m();
    let inverse_m = range_errors(solution, &[far_m])?[0].sigma_m / (far_m * far_m);
    Ok(inverse_m * solution.left.focal_px.0 * solution.baseline_m())
}

fn rms_sigma(solution: &StereoSolution, gradients: &[GlobalVector]) -> f64 {
    let variances = gradients
        .iter()
        .map(|gradient| (gradient.transpose() * solution.covariance * gradient)[0].max(0.0));
    (variances.sum::<f64>() / gradients.len().max(1) as f64).sqrt()
}

/// For every depth, for every probe: how one over the found depth moves with each shared parameter.
fn inverse_depth_gradients(
    solution: &StereoSolution,
    depths_m: &[f64],
) -> Result<Vec<Vec<GlobalVector>>, SolveError> {
    let here = State::from_solution(solution, &[]);
    let probes: Vec<Vec<(RawPixel, RawPixel)>> = depths_m
        .iter()
        .map(|&depth| probe_pixels(&here, depth))
        .collect();
    let mut gradients = vec![vec![GlobalVector::zeros(); PROBES.len().pow(2)]; depths_m.len()];
    let sigmas = solution.sigmas();
    for index in 0..GLOBALS {
        let size = sigmas[index].max(1e-12) * 0.5;
        let mut step = DVector::zeros(GLOBALS);
        step[index] = size;
        let (plus, minus) = (here.moved(step.as_view()), here.moved((-&step).as_view()));
        let (plus, minus) = (
            inverse_depths(&plus, &probes)?,
            inverse_depths(&minus, &probes)?,
        );
        for (depth, probes) in gradients.iter_mut().enumerate() {
            for (probe, gradient) in probes.iter_mut().enumerate() {
                gradient[index] = (plus[depth][probe] - minus[depth][probe]) / (2.0 * size);
            }
        }
    }
    Ok(gradients)
}

/// Raw pixels of both eyes of points at a depth.
fn probe_pixels(state: &State, depth_m: f64) -> Vec<(RawPixel, RawPixel)> {
    let (width, height) = state.left.image_size_px;
    let mut pixels = Vec::new();
    for across in PROBES {
        for down in PROBES {
            let point = Vector3::new(
                (across * f64::from(width) - state.left.principal_point_px.0)
                    / state.left.focal_px.0,
                (down * f64::from(height) - state.left.principal_point_px.1)
                    / state.left.focal_px.1,
                1.0,
            ) * depth_m;
            let in_right = state.right_from_left * point + state.translation_m;
            pixels.push((state.left.project(&point), state.right.project(&in_right)));
        }
    }
    pixels
}

/// One over the depths that a calibration finds for pairs of raw pixels.
fn inverse_depths(
    state: &State,
    probes: &[Vec<(RawPixel, RawPixel)>],
) -> Result<Vec<Vec<f64>>, SolveError> {
    let (left, right): (&Camera, &Camera) = (&state.left, &state.right);
    let rectification =
        Rectification::new(left, right, &state.right_from_left, &state.translation_m)?;
    let focal_baseline = rectification.focal_px() * state.translation_m.norm();
    let mut all = Vec::with_capacity(probes.len());
    for pixels in probes {
        let (left, right): (Vec<_>, Vec<_>) = pixels.iter().copied().unzip();
        let left = rectification.rectify(Eye::Left, &left)?;
        let right = rectification.rectify(Eye::Right, &right)?;
        let infinity = rectification.infinity_disparity_px();
        all.push(
            left.iter()
                .zip(&right)
                .map(|(l, r)| (l.u - r.u - infinity) / focal_baseline)
                .collect(),
        );
    }
    Ok(all)
}
