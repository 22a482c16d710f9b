//! Attitude: how the airframe stands in north, east, down.

use crate::{BodyFrd, VehicleEnu, VehicleNed};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use sguaba::math::Rotation;

/// Why an attitude was refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AttitudeError {
    /// A component is not a finite number.
    #[error("attitude quaternion {w} {x} {y} {z} is not finite")]
    NotFinite {
        /// Scalar part.
        w: f64,
        /// First vector part.
        x: f64,
        /// Second vector part.
        y: f64,
        /// Third vector part.
        z: f64,
    },
    /// Too far from a unit quaternion to be a rotation.
    #[error("attitude quaternion has norm {norm}, not within {tolerance} of 1")]
    NotUnit {
        /// Norm that was found.
        norm: f64,
        /// What would have been accepted.
        tolerance: f64,
    },
}

/// The rotation that takes body (FRD) components to north, east, down components.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attitude {
    ned_from_body: UnitQuaternion<f64>,
}

/// Furthest from 1 that a norm may be before it is a fault and not rounding.
const NORM_TOLERANCE: f64 = 0.01;

impl Attitude {
    /// From MAVLink's `ATTITUDE_QUATERNION` (w, x, y, z; body FRD to NED).
    ///
    /// # Errors
    /// [`AttitudeError`] when not finite or not of unit length within 1 %.
    pub fn from_mavlink_quaternion([w, x, y, z]: [f64; 4]) -> Result<Self, AttitudeError> {
        let quaternion = Quaternion::new(w, x, y, z);
        let norm = quaternion.norm();
        if !norm.is_finite() {
            return Err(AttitudeError::NotFinite { w, x, y, z });
        }
        if (norm - 1.0).abs() > NORM_TOLERANCE {
            return Err(AttitudeError::NotUnit {
                norm,
                tolerance: NORM_TOLERANCE,
            });
        }
        Ok(Self {
            ned_from_body: UnitQuaternion::new_normalize(quaternion),
        })
    }

    /// From aeronautical angles in radians: heading from true north clockwise, pitch nose up, roll
    /// right wing down; applied in that order.
    #[must_use]
    pub fn from_angles(roll_rad: f64, pitch_rad: f64, heading_rad: f64) -> Self {
        Self {
            ned_from_body: UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, heading_rad),
        }
    }

    /// From a rotation that takes body (FRD) components to north, east, down components.
    #[must_use]
    pub fn from_unit_quaternion(ned_from_body: UnitQuaternion<f64>) -> Self {
        Self { ned_from_body }
    }

    /// Roll, pitch, heading in radians.
    #[must_use]
    pub fn angles(&self) -> (f64, f64, f64) {
        self.ned_from_body.euler_angles()
    }

    /// The quaternion, body to NED, for interpolation and output.
    #[must_use]
    pub fn quaternion(&self) -> UnitQuaternion<f64> {
        self.ned_from_body
    }

    /// Between `self` (share 0) and `later` (share 1), along the shortest arc.
    #[must_use]
    pub fn slerp(&self, later: &Self, share: f64) -> Self {
        let between = self
            .ned_from_body
            .try_slerp(&later.ned_from_body, share, 1e-9);
        Self {
            ned_from_body: between.unwrap_or(later.ned_from_body),
        }
    }

    /// Turned on by `rate_rad_s` (about body axes) for `dt_s`.
    #[must_use]
    pub fn rotated(&self, rate_rad_s: Vector3<f64>, dt_s: f64) -> Self {
        let turn = UnitQuaternion::from_scaled_axis(rate_rad_s * dt_s);
        Self {
            ned_from_body: self.ned_from_body * turn,
        }
    }

    /// Angle between two attitudes in radians.
    #[must_use]
    pub fn angle_to(&self, other: &Self) -> f64 {
        self.ned_from_body.angle_to(&other.ned_from_body)
    }

    /// Body to NED, typed.
    #[must_use]
    pub fn ned_from_body(&self) -> Rotation<BodyFrd, VehicleNed> {
        let q = self.ned_from_body.quaternion();
        #[expect(unsafe_code, reason = "the one place that states body to NED")]
        // SAFETY: MAVLink defines its attitude quaternion as taking FRD components to NED
        // components, which is what `from_quaternion` asks for; checked against known headings.
        unsafe {
            Rotation::from_quaternion(q.w, q.i, q.j, q.k)
        }
    }

    /// Body to ENU, typed.
    #[must_use]
    pub fn enu_from_body(&self) -> Rotation<BodyFrd, VehicleEnu> {
        #[expect(unsafe_code, reason = "the one place that states NED to ENU")]
        // SAFETY: both planes are tangent at the vehicle at the same shutter event; they differ by
        // the order and signs of their axes only, which is what the conversion changes.
        unsafe {
            self.ned_from_body().into_enu_equivalent()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Metres;
    use sguaba::Vector;
    use std::f64::consts::FRAC_PI_2;

    fn nose_in_enu(attitude: &Attitude) -> Vector3<f64> {
        let nose = Vector::<BodyFrd>::from_metres(Vector3::x());
        attitude.enu_from_body().transform(nose).metres()
    }

    #[test]
    fn a_nose_to_the_east_points_east() {
        // MAVLink quaternion of heading 90 degrees, written out by hand: half angle 45 degrees about D.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let attitude = Attitude::from_mavlink_quaternion([half, 0.0, 0.0, half]).unwrap();
        assert!((nose_in_enu(&attitude) - Vector3::x()).norm() < 1e-12);
        assert!((attitude.angles().2 - FRAC_PI_2).abs() < 1e-12);
        let nose = Vector::<BodyFrd>::from_metres(Vector3::x());
        let ned = attitude.ned_from_body().transform(nose).metres();
        assert!(
            (ned - Vector3::y()).norm() < 1e-12,
            "north, east, down: {ned}"
        );
    }

    #[test]
    fn a_nose_up_points_up_and_a_right_wing_down_points_down() {
        let up = Attitude::from_angles(0.0, FRAC_PI_2, 0.0);
        assert!((nose_in_enu(&up) - Vector3::z()).norm() < 1e-9);
        let banked = Attitude::from_angles(FRAC_PI_2, 0.0, 0.0);
        let wing = Vector::<BodyFrd>::from_metres(Vector3::y());
        let wing_enu = banked.enu_from_body().transform(wing).metres();
        assert!(
            (wing_enu + Vector3::z()).norm() < 1e-12,
            "right wing in ENU: {wing_enu}"
        );
    }

    #[test]
    fn matrices_take_from_components_to_to_components() {
        let rotation = Attitude::from_angles(0.1, -0.2, 2.0).enu_from_body();
        let body = Vector3::new(1.0, -2.0, 3.0);
        let typed = rotation
            .transform(Vector::<BodyFrd>::from_metres(body))
            .metres();
        assert!((crate::rotation_matrix(&rotation) * body - typed).norm() < 1e-12);
    }

    #[test]
    fn faults_are_refused_and_rounding_is_not() {
        assert!(Attitude::from_mavlink_quaternion([f64::NAN, 0.0, 0.0, 0.0]).is_err());
        assert!(Attitude::from_mavlink_quaternion([0.0; 4]).is_err());
        assert!(Attitude::from_mavlink_quaternion([0.995, 0.0, 0.0, 0.0]).is_ok());
    }
}
