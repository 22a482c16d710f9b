//! SI values as MAVLink's fields spell them.

use super::{EncodeError, dialect};
use crate::telemetry::{CommandResult, GnssFix, Severity, VehicleTime};
use emberfix_frames::BootTime;
use num_traits::FromPrimitive;

/// Degrees as MAVLink's integers of 1e-7 degrees (11 mm on the equator).
#[must_use]
pub fn degrees_e7(degrees: f64) -> i32 {
    (degrees * 1e7).round() as i32
}

pub(super) fn from_number<T: FromPrimitive>(
    field: &'static str,
    value: u32,
) -> Result<T, EncodeError> {
    T::from_u32(value).ok_or(EncodeError::NotInDialect { field, value })
}

pub(super) fn result_number(result: CommandResult) -> u8 {
    match result {
        CommandResult::Accepted => 0,
        CommandResult::TemporarilyRejected => 1,
        CommandResult::Denied => 2,
        CommandResult::Unsupported => 3,
        CommandResult::Failed => 4,
        CommandResult::InProgress => 5,
        CommandResult::Cancelled => 6,
        CommandResult::Refused(number) => number,
    }
}

pub(super) fn severity(severity: Severity) -> dialect::MavSeverity {
    use dialect::MavSeverity as Wire;
    match severity {
        Severity::Emergency => Wire::MAV_SEVERITY_EMERGENCY,
        Severity::Alert => Wire::MAV_SEVERITY_ALERT,
        Severity::Critical => Wire::MAV_SEVERITY_CRITICAL,
        Severity::Error => Wire::MAV_SEVERITY_ERROR,
        Severity::Warning => Wire::MAV_SEVERITY_WARNING,
        Severity::Notice => Wire::MAV_SEVERITY_NOTICE,
        Severity::Info => Wire::MAV_SEVERITY_INFO,
        Severity::Debug => Wire::MAV_SEVERITY_DEBUG,
    }
}

pub(super) fn fix_type(fix: GnssFix) -> dialect::GpsFixType {
    use dialect::GpsFixType as Wire;
    match fix {
        GnssFix::None => Wire::GPS_FIX_TYPE_NO_GPS,
        GnssFix::NoFix => Wire::GPS_FIX_TYPE_NO_FIX,
        GnssFix::Fix2d => Wire::GPS_FIX_TYPE_2D_FIX,
        GnssFix::Fix3d => Wire::GPS_FIX_TYPE_3D_FIX,
        GnssFix::Dgps => Wire::GPS_FIX_TYPE_DGPS,
        GnssFix::RtkFloat => Wire::GPS_FIX_TYPE_RTK_FLOAT,
        GnssFix::RtkFixed => Wire::GPS_FIX_TYPE_RTK_FIXED,
    }
}

/// Wraps after 49.7 days, as the field does.
pub(super) fn boot_ms(boot: BootTime) -> u32 {
    (boot.ns() / 1_000_000) as u32
}

pub(super) fn time_us(time: VehicleTime) -> u64 {
    let ns = match time {
        VehicleTime::Boot(boot) => boot.ns(),
        VehicleTime::Utc(utc) => utc.unix_ns(),
    };
    u64::try_from(ns / 1_000).unwrap_or(0)
}

pub(super) fn millimetres(metres: f64) -> i32 {
    (metres * 1e3).round() as i32
}

pub(super) fn centidegrees(angle_rad: Option<f64>) -> u16 {
    angle_rad.map_or(u16::MAX, |rad| {
        (rad.to_degrees().rem_euclid(360.0) * 100.0).round() as u16
    })
}

pub(super) fn sigma_mm(sigma_m: Option<f64>) -> u32 {
    sigma_m.map_or(0, |sigma| (sigma * 1e3).round() as u32)
}

pub(super) fn or_nan(metres: Option<f64>) -> f32 {
    metres.map_or(f32::NAN, |metres| metres as f32)
}
