//! Matching one patch as a whole: normalised correlation over its pixels, then least squares below
//! the pixel.
//!
//! Semi-global matching pulls disparities towards whole pixels; this does not, and costs a
//! thousandth. It gives one disparity for all pixels of the target.

use super::pool::Sample;
use nalgebra::{Matrix3, Vector3};

/// An 8-bit gray image, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Gray {
    pub width: i32,
    pub values: Vec<f32>,
}

/// Disparities that are tried, whole pixels, both ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Search {
    pub least: i32,
    pub greatest: i32,
}

/// The best match.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Match {
    pub disparity_px: f64,
    /// One sigma, from the residuals and the gradients that hold the match.
    pub sigma_px: f64,
    /// Normalised correlation there, -1..1.
    pub correlation: f64,
    /// Best correlation elsewhere, beyond two pixels from the peak.
    pub runner_up: f64,
}

impl Gray {
    fn at(&self, column: i32, row: i32) -> f64 {
        f64::from(self.values[(row * self.width + column) as usize])
    }

    /// Value and slope along the row between pixels (Catmull-Rom).
    fn between(&self, column: f64, row: i32) -> Option<(f64, f64)> {
        let whole = column.floor();
        let (t, column) = (column - whole, whole as i32);
        if column < 1 || column + 2 >= self.width {
            return None;
        }
        let [a, b, c, d] = [-1, 0, 1, 2].map(|k| self.at(column + k, row));
        let (k1, k2, k3) = (
            c - a,
            2.0 * a - 5.0 * b + 4.0 * c - d,
            3.0 * (b - c) + d - a,
        );
        let value = b + 0.5 * t * (k1 + t * (k2 + t * k3));
        let slope = 0.5 * (k1 + t * (2.0 * k2 + t * 3.0 * k3));
        Some((value, slope))
    }
}

/// Normalised correlation of the left pixels with the right ones `disparity` to their left; `None`
/// where one of them is flat or too few are in the image.
pub(super) fn correlation(
    left: &Gray,
    right: &Gray,
    pixels: &[(i32, i32)],
    disparity: i32,
) -> Option<f64> {
    let (mut n, mut l, mut r, mut ll, mut rr, mut lr) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for &(column, row) in pixels {
        let other = column - disparity;
        if !(0..right.width).contains(&other) {
            continue;
        }
        let (x, y) = (left.at(column, row), right.at(other, row));
        n += 1.0;
        l += x;
        r += y;
        ll += x * x;
        rr += y * y;
        lr += x * y;
    }
    let (spread_l, spread_r) = (ll - l * l / n, rr - r * r / n);
    // Below a variance of one grey level there is nothing but noise.
    let flat = spread_l < n || spread_r < n;
    (n * 2.0 > pixels.len() as f64 && !flat)
        .then(|| (lr - l * r / n) / (spread_l * spread_r).sqrt())
}

/// Matches the pixels as one: the best whole disparity, then below the pixel.
pub(super) fn correlate(
    left: &Gray,
    right: &Gray,
    pixels: &[(i32, i32)],
    search: Search,
) -> Option<Match> {
    let scores: Vec<(i32, f64)> = (search.least..=search.greatest)
        .filter_map(|d| Some((d, correlation(left, right, pixels, d)?)))
        .collect();
    let &(peak, correlation) = scores.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let elsewhere = scores.iter().filter(|(d, _)| (d - peak).abs() > 2);
    let runner_up = elsewhere.map(|(_, score)| *score).fold(-1.0, f64::max);
    let (disparity_px, sigma_px) = refine(left, right, pixels, f64::from(peak))?;
    Some(Match {
        disparity_px,
        sigma_px,
        correlation,
        runner_up,
    })
}

/// Least squares for disparity, gain and offset of the right eye against the left, from a disparity
/// that is right to a pixel; `None` when it runs away from there.
pub(super) fn refine(
    left: &Gray,
    right: &Gray,
    pixels: &[(i32, i32)],
    start_px: f64,
) -> Option<(f64, f64)> {
    let mut state = Vector3::new(start_px, 1.0, 0.0);
    let mut scale = f64::INFINITY;
    let mut sigma = f64::INFINITY;
    for _ in 0..12 {
        let (normal, pull, residuals) = equations(left, right, pixels, &state, scale)?;
        let inverse = normal.try_inverse()?;
        let step = inverse * pull;
        state += step;
        scale = robust_scale(residuals);
        sigma = scale * inverse[(0, 0)].max(0.0).sqrt();
        if (state.x - start_px).abs() > 1.5 {
            return None;
        }
        if step.x.abs() < 1e-4 && scale.is_finite() {
            break;
        }
    }
    // Neighbouring pixels share noise and outline: about one in four is its own witness.
    sigma.is_finite().then_some((state.x, 2.0 * sigma))
}

/// Normal equations of `left - gain * right(u - d) - offset`, weighted after Tukey.
fn equations(
    left: &Gray,
    right: &Gray,
    pixels: &[(i32, i32)],
    state: &Vector3<f64>,
    scale: f64,
) -> Option<(Matrix3<f64>, Vector3<f64>, Vec<f64>)> {
    let (mut normal, mut pull) = (Matrix3::zeros(), Vector3::zeros());
    let mut residuals = Vec::with_capacity(pixels.len());
    for &(column, row) in pixels {
        let Some((value, slope)) = right.between(f64::from(column) - state.x, row) else {
            continue;
        };
        let residual = left.at(column, row) - state.y * value - state.z;
        residuals.push(residual);
        let weight = tukey(residual / scale);
        // d(prediction) / d(disparity, gain, offset)
        let jacobian = Vector3::new(-state.y * slope, value, 1.0);
        normal += weight * jacobian * jacobian.transpose();
        pull += weight * residual * jacobian;
    }
    (residuals.len() * 2 > pixels.len()).then_some((normal, pull, residuals))
}

/// Weight of a residual in robust sigmas; 1 for all while the scale is not known.
fn tukey(residual: f64) -> f64 {
    const CUT: f64 = 4.685;
    let x = residual / CUT;
    if x.abs() < 1.0 {
        (1.0 - x * x).powi(2)
    } else {
        0.0
    }
}

/// Standard deviation of the bulk, from the median of absolute residuals.
fn robust_scale(mut residuals: Vec<f64>) -> f64 {
    for residual in &mut residuals {
        *residual = residual.abs();
    }
    let middle = residuals.len() / 2;
    let (_, median, _) = residuals.select_nth_unstable_by(middle, f64::total_cmp);
    // Quantisation alone leaves 0.3 grey levels.
    (*median * 1.4826).max(0.3)
}

/// Where the samples are.
pub(super) fn places(samples: &[Sample]) -> Vec<(i32, i32)> {
    samples.iter().map(|sample| sample.at).collect()
}
