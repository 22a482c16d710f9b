//! The coordinate systems of the project, as types.

use sguaba::system;

system! {
    /// Rectified left camera: +X right, +Y down, +Z along the boresight; origin at its optical centre.
    pub struct CamLeft using right-handed XYZ
}
system! {
    /// Left camera as it was built, before rectification: same origin and axes as [`CamLeft`] up to
    /// the rectifying rotation.
    pub struct CamLeftRaw using right-handed XYZ
}
system! {
    /// Airframe: +X forward, +Y right, +Z down; origin at the autopilot's IMU.
    pub struct BodyFrd using FRD
}
system! {
    /// North, east, down at the vehicle at ONE shutter event; what MAVLink attitude refers to.
    pub struct VehicleNed using NED
}
system! {
    /// East, north, up at the vehicle at ONE shutter event.
    pub struct VehicleEnu using ENU
}
system! {
    /// East, north, up in the tangent plane at the mission datum.
    pub struct MissionEnu using ENU
}
