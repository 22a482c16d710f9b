//! Position covariance in a named frame, and the figures that people read from it.

use nalgebra::Matrix3;
use sguaba::math::Rotation;
use std::f64::consts::{PI, TAU};
use std::marker::PhantomData;
use std::ops::Add;

/// Why a matrix is no covariance.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum CovarianceError {
    /// A component is not a finite number.
    #[error("covariance has a component that is not finite")]
    NotFinite,
    /// Not symmetric.
    #[error("covariance is asymmetric by {asymmetry:.3e} m2, limit {limit:.3e} m2")]
    Asymmetric {
        /// Largest difference between mirrored components, m².
        asymmetry: f64,
        /// What rounding may cause at this scale, m².
        limit: f64,
    },
    /// A direction with negative variance.
    #[error("covariance has the negative variance {variance:.3e} m2")]
    Negative {
        /// Least eigenvalue, m².
        variance: f64,
    },
}

/// A symmetric, non-negative 3x3 matrix in m², in the axes of `In`.
#[derive(Debug)]
pub struct Covariance<In> {
    m2: Matrix3<f64>,
    frame: PhantomData<In>,
}

impl<In> Clone for Covariance<In> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<In> Copy for Covariance<In> {}
impl<In> PartialEq for Covariance<In> {
    fn eq(&self, other: &Self) -> bool {
        self.m2 == other.m2
    }
}

/// Probability that CE90 and LE90 hold.
const NINETY: f64 = 0.9;
/// Half-width, in sigma, of the central 90 % of a normal distribution.
const LE90_PER_SIGMA: f64 = 1.644_853_626_951_472_6;
/// Steps around the circle; the integrand is periodic and smooth, so the sum converges at once.
const CE90_STEPS: u32 = 256;

impl<In> Covariance<In> {
    /// A checked covariance. Rounding is symmetrised, never a real asymmetry.
    ///
    /// # Errors
    /// [`CovarianceError`] when not finite, asymmetric beyond rounding, or negative.
    pub fn new(m2: Matrix3<f64>) -> Result<Self, CovarianceError> {
        if !m2.iter().all(|component| component.is_finite()) {
            return Err(CovarianceError::NotFinite);
        }
        let scale = m2.amax();
        let limit = 1e-9 * scale + f64::MIN_POSITIVE;
        let asymmetry = (m2 - m2.transpose()).amax();
        if asymmetry > limit {
            return Err(CovarianceError::Asymmetric { asymmetry, limit });
        }
        let symmetric = (m2 + m2.transpose()) * 0.5;
        let variance = symmetric.symmetric_eigenvalues().min();
        if variance < -limit {
            return Err(CovarianceError::Negative { variance });
        }
        Ok(Self {
            m2: symmetric,
            frame: PhantomData,
        })
    }

    /// The covariance `J S J'`, which is one by construction.
    ///
    /// `sigmas` are the standard deviations of independent error sources; column `i` of `jacobian`
    /// says by how many metres one unit of source `i` moves the position.
    #[must_use]
    pub fn from_sources<const N: usize>(
        jacobian: &nalgebra::SMatrix<f64, 3, N>,
        sigmas: &nalgebra::SVector<f64, N>,
    ) -> Self {
        let scaled = jacobian * nalgebra::SMatrix::<f64, N, N>::from_diagonal(sigmas);
        Self {
            m2: scaled * scaled.transpose(),
            frame: PhantomData,
        }
    }

    /// No error at all.
    #[must_use]
    pub fn zero() -> Self {
        Self {
            m2: Matrix3::zeros(),
            frame: PhantomData,
        }
    }

    /// Independent errors along the axes, from their sigmas in metres.
    #[must_use]
    pub fn from_sigmas_m(x: f64, y: f64, z: f64) -> Self {
        let variances = nalgebra::Vector3::new(x * x, y * y, z * z);
        Self {
            m2: Matrix3::from_diagonal(&variances),
            frame: PhantomData,
        }
    }

    /// The matrix in m².
    #[must_use]
    pub fn m2(&self) -> &Matrix3<f64> {
        &self.m2
    }

    /// Row-major, as the alarm carries it, m².
    #[must_use]
    pub fn row_major(&self) -> [f64; 9] {
        let transposed = self.m2.transpose();
        std::array::from_fn(|i| transposed[i])
    }

    /// The same error seen in the axes of `To`.
    #[must_use]
    pub fn rotated<To>(&self, rotation: &Rotation<In, To>) -> Covariance<To> {
        let r = crate::rotation_matrix(rotation);
        let turned = r * self.m2 * r.transpose();
        Covariance {
            m2: (turned + turned.transpose()) * 0.5,
            frame: PhantomData,
        }
    }

    /// The same matrix in another frame whose axes are parallel to this one's to within what the
    /// caller may neglect (two tangent planes a flight apart: 1e-4 rad in 600 m).
    #[must_use]
    pub fn in_parallel_axes<To>(&self) -> Covariance<To> {
        Covariance {
            m2: self.m2,
            frame: PhantomData,
        }
    }

    /// Larger, smaller standard deviation of the first two axes in metres, and the direction of
    /// the larger in radians from the first axis towards the second.
    #[must_use]
    pub fn horizontal_axes(&self) -> (f64, f64, f64) {
        let (a, b, c) = (self.m2[(0, 0)], self.m2[(0, 1)], self.m2[(1, 1)]);
        let (mean, half) = ((a + c) / 2.0, ((a - c) / 2.0).hypot(b));
        let direction = 0.5 * (2.0 * b).atan2(a - c);
        (
            (mean + half).max(0.0).sqrt(),
            (mean - half).max(0.0).sqrt(),
            direction,
        )
    }

    /// Radius in metres of the horizontal circle that holds 90 %, exactly (no fitted factor).
    ///
    /// With principal sigmas a and b, the share within R is
    /// `1 - mean over phi of exp(-R^2 / (2 (a^2 cos^2 phi + b^2 sin^2 phi)))`.
    #[must_use]
    pub fn ce90_m(&self) -> f64 {
        let (a, b, _) = self.horizontal_axes();
        if a <= 0.0 {
            return 0.0;
        }
        let share = |radius: f64| {
            let outside = |step: u32| {
                let (sin, cos) = (TAU * f64::from(step) / f64::from(CE90_STEPS)).sin_cos();
                let variance = (a * cos).powi(2) + (b * sin).powi(2);
                (-radius * radius / (2.0 * variance.max(1e-12 * a * a))).exp()
            };
            1.0 - (0..CE90_STEPS).map(outside).sum::<f64>() / f64::from(CE90_STEPS)
        };
        // 90 % lies between 1.64 a (b = 0) and 2.15 a (b = a).
        let (mut low, mut high) = (1.6 * a, 2.2 * a);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if share(middle) < NINETY {
                low = middle
            } else {
                high = middle
            }
        }
        0.5 * (low + high)
    }

    /// Half-height in metres that holds 90 % along the third axis.
    #[must_use]
    pub fn le90_m(&self) -> f64 {
        LE90_PER_SIGMA * self.m2[(2, 2)].max(0.0).sqrt()
    }

    /// Points of the horizontal 90 % ellipse (chi-square 2 degrees of freedom: 4.605), in metres
    /// from its centre; for drawing.
    #[must_use]
    pub fn ellipse90_m(&self, points: u32) -> Vec<(f64, f64)> {
        let (a, b, direction) = self.horizontal_axes();
        let scale = (-2.0 * (1.0 - NINETY).ln()).sqrt();
        let (sin, cos) = direction.sin_cos();
        let point = |i: u32| {
            let angle = 2.0 * PI * f64::from(i) / f64::from(points.max(1));
            let (x, y) = (scale * a * angle.cos(), scale * b * angle.sin());
            (x * cos - y * sin, x * sin + y * cos)
        };
        (0..points).map(point).collect()
    }
}

impl<In> Add for Covariance<In> {
    type Output = Self;
    /// The covariance of the sum of two independent errors.
    fn add(self, other: Self) -> Self {
        Self {
            m2: self.m2 + other.m2,
            frame: PhantomData,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BodyFrd, MissionEnu};

    type Enu = Covariance<MissionEnu>;

    /// Closed forms: sqrt(-2 ln 0.1) for a circle, the normal quantile for a line.
    #[test]
    fn ce90_meets_its_closed_forms() {
        let circle = Enu::from_sigmas_m(1.0, 1.0, 1.0).ce90_m();
        assert!((circle - 2.145_966).abs() < 1e-5, "{circle}");
        let line = Enu::from_sigmas_m(1.0, 1e-3, 1.0).ce90_m();
        assert!((line - 1.644_854).abs() < 2e-3, "{line}");
        assert!((Enu::from_sigmas_m(0.0, 0.0, 2.0).le90_m() - 3.289_707).abs() < 1e-5);
    }

    #[test]
    fn asymmetric_negative_and_nan_are_refused() {
        let asymmetric = Matrix3::new(1.0, 0.5, 0.0, 0.4, 1.0, 0.0, 0.0, 0.0, 1.0);
        assert!(matches!(
            Enu::new(asymmetric),
            Err(CovarianceError::Asymmetric { .. })
        ));
        let negative = Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, -0.1, 1.0));
        assert!(matches!(
            Enu::new(negative),
            Err(CovarianceError::Negative { .. })
        ));
        assert!(matches!(
            Enu::new(Matrix3::from_element(f64::NAN)),
            Err(CovarianceError::NotFinite)
        ));
    }

    #[test]
    fn a_forward_error_with_the_nose_east_is_an_east_error() {
        let forward = Covariance::<BodyFrd>::from_sigmas_m(3.0, 1.0, 1.0);
        let east = crate::Attitude::from_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        let enu = forward.rotated(&east.enu_from_body());
        assert!((enu.m2()[(0, 0)] - 9.0).abs() < 1e-9);
        assert!((enu.m2()[(1, 1)] - 1.0).abs() < 1e-9);
    }
}
