//! Matching all pixels of a target as one: normalised correlation to the pixel, then least squares
//! below it (Lucas and Kanade's step with gain, offset and robust weights).
//!
//! Semi-global matching pulls disparities towards whole pixels; this does not, and costs a
//! thousandth. It gives one disparity for all pixels of the target.

use nalgebra::{Matrix3, Vector3};

/// An 8-bit gray image, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Gray {
    pub width: i32,
    pub values: Vec<f32>,
}

/// The best whole disparity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Peak {
    pub disparity_px: i32,
    /// Normalised correlation there, -1..1.
    pub correlation: f64,
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
fn correlation(left: &Gray, right: &Gray, pixels: &[(i32, i32)], disparity: i32) -> Option<f64> {
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

/// The whole disparity within two pixels of `middle` at which all pixels together match best.
pub(super) fn peak_near(
    left: &Gray,
    right: &Gray,
    pixels: &[(i32, i32)],
    middle: i32,
) -> Option<Peak> {
    (middle - 2..=middle + 2)
        .filter_map(|disparity_px| {
            let correlation = correlation(left, right, pixels, disparity_px)?;
            Some(Peak {
                disparity_px,
                correlation,
            })
        })
        .max_by(|a, b| a.correlation.total_cmp(&b.correlation))
}

/// Least squares for disparity, gain and offset of the right eye against the left, from a disparity
/// that is right to a pixel; `None` when it runs away from there.
pub(super) fn refine(
    left: &Gray,
    right: &Gray,
    pixels: &[(i32, i32)],
    start_px: i32,
) -> Option<(f64, f64)> {
    let start_px = f64::from(start_px);
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
        // Gain and offset too: the residuals are those of the state before this step.
        if step.x.abs() < 1e-4 && step.y.abs() < 1e-3 && step.z.abs() < 0.1 {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(shift: f64) -> Gray {
        let value = |k: i32| {
            let (u, v) = (f64::from(k % 60) + shift, f64::from(k / 60));
            (120.0 + 60.0 * (0.7 * u + 0.3 * v).sin() + 30.0 * (0.31 * u - v).cos()) as f32
        };
        Gray {
            width: 60,
            values: (0..60 * 20).map(value).collect(),
        }
    }

    fn pixels() -> Vec<(i32, i32)> {
        (0..20)
            .flat_map(|row| (20..50).map(move |column| (column, row)))
            .collect()
    }

    #[test]
    fn a_shift_is_found_to_a_hundredth_of_a_pixel_whatever_gain_and_offset() {
        for step in 0..8 {
            let truth = 6.0 + 0.125 * f64::from(step);
            let mut right = wave(truth);
            for value in &mut right.values {
                *value = 0.7 * *value + 20.0;
            }
            let peak = peak_near(&wave(0.0), &right, &pixels(), 7).unwrap();
            assert!(peak.correlation > 0.9 && (f64::from(peak.disparity_px) - truth).abs() < 0.6);
            let (found, sigma) = refine(&wave(0.0), &right, &pixels(), peak.disparity_px).unwrap();
            assert!((found - truth).abs() < 0.01, "{found} {truth}");
            assert!(sigma < 0.02, "{sigma}");
        }
    }

    #[test]
    fn a_flat_eye_has_no_peak() {
        let flat = Gray {
            width: 60,
            values: vec![80.0; 60 * 20],
        };
        assert_eq!(peak_near(&wave(0.0), &flat, &pixels(), 5), None);
    }
}
