//! Where the aircraft truly is.

use nalgebra::{Matrix3, Vector3};

/// True state of the airframe at one moment, in the east-north-up plane at the mission datum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyState {
    /// Seconds since the flight began.
    pub t_s: f64,
    /// Body origin (the IMU): east, north, up, metres.
    pub position_m: Vector3<f64>,
    /// Takes body (forward, right, down) components to east, north, up.
    pub enu_from_body: Matrix3<f64>,
    /// East, north, up, m/s.
    pub velocity_m_s: Vector3<f64>,
    /// About forward, right, down, rad/s.
    pub rate_rad_s: Vector3<f64>,
}
