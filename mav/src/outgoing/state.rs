//! What a vehicle says of its own state.

use super::fields::{
    boot_ms, centidegrees, degrees_e7, fix_type, millimetres, or_nan, sigma_mm, time_us,
};
use super::{MavMessage, dialect};
use crate::telemetry::{
    AttitudeSample, EstimatorStatus, GlobalPosition, GnssPlace, GpsRaw, HomePosition, SystemTime,
};

/// ATTITUDE_QUATERNION.
#[must_use]
pub fn attitude_quaternion(sample: &AttitudeSample) -> MavMessage {
    let quaternion = sample.attitude.quaternion();
    let rate = sample.rate_rad_s.map(|rate| rate as f32);
    MavMessage::ATTITUDE_QUATERNION(dialect::ATTITUDE_QUATERNION_DATA {
        time_boot_ms: boot_ms(sample.boot),
        q1: quaternion.w as f32,
        q2: quaternion.i as f32,
        q3: quaternion.j as f32,
        q4: quaternion.k as f32,
        rollspeed: rate.x,
        pitchspeed: rate.y,
        yawspeed: rate.z,
        repr_offset_q: [0.0; 4],
    })
}

/// ATTITUDE.
#[must_use]
pub fn attitude(sample: &AttitudeSample) -> MavMessage {
    let (roll, pitch, yaw) = sample.attitude.angles();
    let rate = sample.rate_rad_s.map(|rate| rate as f32);
    MavMessage::ATTITUDE(dialect::ATTITUDE_DATA {
        time_boot_ms: boot_ms(sample.boot),
        roll: roll as f32,
        pitch: pitch as f32,
        yaw: yaw as f32,
        rollspeed: rate.x,
        pitchspeed: rate.y,
        yawspeed: rate.z,
    })
}

/// GLOBAL_POSITION_INT.
#[must_use]
pub fn global_position(position: &GlobalPosition) -> MavMessage {
    let velocity_cm_s = position
        .velocity_ned_m_s
        .map(|v| (v * 100.0).round() as i16);
    MavMessage::GLOBAL_POSITION_INT(dialect::GLOBAL_POSITION_INT_DATA {
        time_boot_ms: boot_ms(position.boot),
        lat: degrees_e7(position.latitude_deg),
        lon: degrees_e7(position.longitude_deg),
        alt: millimetres(position.altitude.m()),
        relative_alt: millimetres(position.above_home_m),
        vx: velocity_cm_s.x,
        vy: velocity_cm_s.y,
        vz: velocity_cm_s.z,
        hdg: centidegrees(position.heading_rad),
    })
}

/// GPS_RAW_INT. Without a place all coordinates are 0, as PX4 sends them.
#[must_use]
pub fn gps_raw(raw: &GpsRaw) -> MavMessage {
    let place = |part: fn(&GnssPlace) -> i32| raw.place.as_ref().map_or(0, part);
    MavMessage::GPS_RAW_INT(dialect::GPS_RAW_INT_DATA {
        time_usec: time_us(raw.time),
        lat: place(|place| degrees_e7(place.latitude_deg)),
        lon: place(|place| degrees_e7(place.longitude_deg)),
        alt: place(|place| millimetres(place.altitude.m())),
        eph: u16::MAX,
        epv: u16::MAX,
        vel: raw
            .ground_speed_m_s
            .map_or(u16::MAX, |speed| (speed * 100.0).round() as u16),
        cog: centidegrees(raw.course_rad),
        fix_type: fix_type(raw.fix),
        satellites_visible: raw.satellites.unwrap_or(u8::MAX),
        alt_ellipsoid: place(|place| place.height.map_or(0, |height| millimetres(height.m()))),
        h_acc: sigma_mm(raw.horizontal_sigma_m),
        v_acc: sigma_mm(raw.vertical_sigma_m),
        vel_acc: 0,
        hdg_acc: 0,
        yaw: 0,
    })
}

/// SYSTEM_TIME; writes `utc` where known, else what was claimed.
#[must_use]
pub fn system_time(time: &SystemTime) -> MavMessage {
    let known = time
        .utc
        .and_then(|utc| u64::try_from(utc.unix_ns() / 1_000).ok());
    MavMessage::SYSTEM_TIME(dialect::SYSTEM_TIME_DATA {
        time_unix_usec: known.unwrap_or(time.claimed_utc_us),
        time_boot_ms: boot_ms(time.boot),
    })
}

/// ESTIMATOR_STATUS; the innovation ratios are written as half their limit.
#[must_use]
pub fn estimator_status(status: &EstimatorStatus) -> MavMessage {
    const UNREMARKABLE: f32 = 0.5;
    MavMessage::ESTIMATOR_STATUS(dialect::ESTIMATOR_STATUS_DATA {
        time_usec: time_us(status.time),
        vel_ratio: UNREMARKABLE,
        pos_horiz_ratio: UNREMARKABLE,
        pos_vert_ratio: UNREMARKABLE,
        mag_ratio: UNREMARKABLE,
        hagl_ratio: UNREMARKABLE,
        tas_ratio: UNREMARKABLE,
        pos_horiz_accuracy: or_nan(status.horizontal_sigma_m),
        pos_vert_accuracy: or_nan(status.vertical_sigma_m),
        flags: dialect::EstimatorStatusFlags::from_bits_retain(status.flags.0),
    })
}

/// HOME_POSITION.
#[must_use]
pub fn home_position(home: &HomePosition) -> MavMessage {
    MavMessage::HOME_POSITION(dialect::HOME_POSITION_DATA {
        latitude: degrees_e7(home.latitude_deg),
        longitude: degrees_e7(home.longitude_deg),
        altitude: millimetres(home.altitude.m()),
        q: [f32::NAN; 4],
        approach_x: f32::NAN,
        approach_y: f32::NAN,
        approach_z: f32::NAN,
        ..Default::default()
    })
}
