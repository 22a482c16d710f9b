//! What we say: SI values to messages, and messages to frames.
//!
//! Where a message has a telemetry struct, that struct is what its constructor takes, so that
//! what one side writes is what the other side reads. Values beyond a field's range saturate;
//! `None` is written the way each field spells "unknown".

use crate::signing::Signer;
use crate::telemetry::{
    AttitudeSample, CameraTrackingGeoStatus, CommandAck, CommandInt, CommandLong, CommandResult,
    EstimatorStatus, GlobalPosition, GnssFix, GnssPlace, GpsRaw, Heartbeat, HomePosition, Severity,
    StatusText, SystemTime, TimeSyncMessage, VehicleTime,
};
use crate::wire::Address;
use emberfix_frames::{BootTime, ServiceTime};
use mavlink::dialects::development as dialect;
use mavlink::types::CharArray;
use mavlink::{MAVLinkV2MessageRaw, MavHeader, Message as _};
use num_traits::FromPrimitive;

pub use mavlink::dialects::development::MavMessage;

/// Bytes that one STATUSTEXT holds.
pub const STATUS_TEXT_BYTES: usize = 50;

/// Commands that we send or answer, as MAVLink numbers them.
pub mod command {
    /// `MAV_CMD_SET_MESSAGE_INTERVAL`: parameter 1 message id, 2 interval in microseconds.
    pub const SET_MESSAGE_INTERVAL: u32 = 511;
    /// `MAV_CMD_REQUEST_MESSAGE`: parameter 1 message id.
    pub const REQUEST_MESSAGE: u32 = 512;
    /// `MAV_CMD_SPATIAL_USER_1`: a place whose meaning its users agree on.
    pub const SPATIAL_USER_1: u32 = 31_005;
    /// `MAV_CMD_USER_2`: what its users agree on.
    pub const USER_2: u32 = 31_011;
}

/// Message ids that we ask for, as MAVLink numbers them.
pub mod message_id {
    /// HEARTBEAT.
    pub const HEARTBEAT: u32 = 0;
    /// SYSTEM_TIME.
    pub const SYSTEM_TIME: u32 = 2;
    /// GPS_RAW_INT.
    pub const GPS_RAW_INT: u32 = 24;
    /// ATTITUDE.
    pub const ATTITUDE: u32 = 30;
    /// ATTITUDE_QUATERNION.
    pub const ATTITUDE_QUATERNION: u32 = 31;
    /// GLOBAL_POSITION_INT.
    pub const GLOBAL_POSITION_INT: u32 = 33;
    /// COMMAND_INT.
    pub const COMMAND_INT: u32 = 75;
    /// COMMAND_ACK.
    pub const COMMAND_ACK: u32 = 77;
    /// TIMESYNC.
    pub const TIMESYNC: u32 = 111;
    /// ESTIMATOR_STATUS.
    pub const ESTIMATOR_STATUS: u32 = 230;
    /// HOME_POSITION.
    pub const HOME_POSITION: u32 = 242;
    /// STATUSTEXT.
    pub const STATUSTEXT: u32 = 253;
    /// CAMERA_TRACKING_GEO_STATUS.
    pub const CAMERA_TRACKING_GEO_STATUS: u32 = 276;
    /// GIMBAL_DEVICE_ATTITUDE_STATUS.
    pub const GIMBAL_DEVICE_ATTITUDE_STATUS: u32 = 285;
}

/// Why a value could not be put into a message.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum EncodeError {
    /// MAVLink has no such number.
    #[error("{field} {value} is not in the MAVLink dialect")]
    NotInDialect {
        /// Which enum.
        field: &'static str,
        /// What was given.
        value: u32,
    },
}

/// Messages to MAVLink 2 frames of one sender; counts the sequence, and signs where it has a signer.
#[derive(Debug, Clone)]
pub struct Encoder {
    sender: Address,
    sequence: u8,
    signer: Option<Signer>,
}

impl Encoder {
    /// For one sender.
    #[must_use]
    pub fn new(sender: Address) -> Self {
        Self {
            sender,
            sequence: 0,
            signer: None,
        }
    }

    /// Signs every frame from now on.
    #[must_use]
    pub fn signing(mut self, signer: Option<Signer>) -> Self {
        self.signer = signer;
        self
    }

    /// The time of signatures is at least this.
    pub fn advance(&mut self, now: ServiceTime) {
        if let Some(signer) = &mut self.signer {
            signer.advance(now);
        }
    }

    /// Whom the frames name as their sender.
    #[must_use]
    pub fn sender(&self) -> Address {
        self.sender
    }

    /// The message as one frame.
    pub fn encode(&mut self, message: &MavMessage) -> Vec<u8> {
        let header = MavHeader {
            system_id: self.sender.system.0.into(),
            component_id: self.sender.component.0,
            sequence: self.sequence,
        };
        self.sequence = self.sequence.wrapping_add(1);
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message(header, message);
        let frame = raw.raw_bytes();
        match &mut self.signer {
            Some(signer) => signer.sign(frame, MavMessage::extra_crc(message.message_id())),
            None => frame.to_vec(),
        }
    }
}

/// HEARTBEAT of a companion computer: `active` when all is well, critical when not.
#[must_use]
pub fn companion_heartbeat(healthy: bool) -> MavMessage {
    use dialect::MavState;
    MavMessage::HEARTBEAT(dialect::HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: dialect::MavType::MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot: dialect::MavAutopilot::MAV_AUTOPILOT_INVALID,
        base_mode: dialect::MavModeFlag::empty(),
        system_status: if healthy {
            MavState::MAV_STATE_ACTIVE
        } else {
            MavState::MAV_STATE_CRITICAL
        },
        mavlink_version: 3,
    })
}

/// HEARTBEAT of a PX4 quadrotor.
#[must_use]
pub fn autopilot_heartbeat(armed: bool) -> MavMessage {
    use dialect::MavModeFlag as Mode;
    let armed_flag = if armed {
        Mode::MAV_MODE_FLAG_SAFETY_ARMED
    } else {
        Mode::empty()
    };
    MavMessage::HEARTBEAT(dialect::HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: dialect::MavType::MAV_TYPE_QUADROTOR,
        autopilot: dialect::MavAutopilot::MAV_AUTOPILOT_PX4,
        base_mode: Mode::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed_flag,
        system_status: dialect::MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    })
}

/// HEARTBEAT of any kind.
///
/// # Errors
/// When a number is not in the dialect.
pub fn heartbeat(heartbeat: &Heartbeat) -> Result<MavMessage, EncodeError> {
    let armed = dialect::MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED;
    Ok(MavMessage::HEARTBEAT(dialect::HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: from_number("MAV_TYPE", heartbeat.vehicle_type.into())?,
        autopilot: from_number("MAV_AUTOPILOT", heartbeat.autopilot.into())?,
        base_mode: if heartbeat.armed {
            armed
        } else {
            dialect::MavModeFlag::empty()
        },
        system_status: from_number("MAV_STATE", heartbeat.state.into())?,
        mavlink_version: 3,
    }))
}

/// TIMESYNC, request or reply.
#[must_use]
pub fn timesync(sync: &TimeSyncMessage) -> MavMessage {
    MavMessage::TIMESYNC(dialect::TIMESYNC_DATA {
        tc1: sync.tc1_ns,
        ts1: sync.ts1_ns,
        target_system: sync.target.system.0,
        target_component: sync.target.component.0,
    })
}

/// TIMESYNC request: "my clock stands at `now_ns`, where does yours?".
#[must_use]
pub fn timesync_request(target: Address, now_ns: i64) -> MavMessage {
    timesync(&TimeSyncMessage {
        tc1_ns: 0,
        ts1_ns: now_ns,
        target,
    })
}

/// TIMESYNC reply of `asker`'s request, by our clock.
#[must_use]
pub fn timesync_reply(request: &TimeSyncMessage, asker: Address, now_ns: i64) -> MavMessage {
    timesync(&TimeSyncMessage {
        tc1_ns: now_ns,
        ts1_ns: request.ts1_ns,
        target: asker,
    })
}

/// Asks `target` to send a message at `rate_hz`; 0 stops it.
#[must_use]
pub fn set_message_interval(target: Address, message_id: u32, rate_hz: f64) -> MavMessage {
    let interval_us = if rate_hz > 0.0 { 1e6 / rate_hz } else { -1.0 };
    let params = [
        message_id as f32,
        interval_us as f32,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    ];
    command_to(
        target,
        dialect::MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        params,
    )
}

/// Asks `target` to send a message once.
#[must_use]
pub fn request_message(target: Address, message_id: u32) -> MavMessage {
    let params = [message_id as f32, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    command_to(target, dialect::MavCmd::MAV_CMD_REQUEST_MESSAGE, params)
}

fn command_to(target: Address, command: dialect::MavCmd, params: [f32; 7]) -> MavMessage {
    let [param1, param2, param3, param4, param5, param6, param7] = params;
    MavMessage::COMMAND_LONG(dialect::COMMAND_LONG_DATA {
        param1,
        param2,
        param3,
        param4,
        param5,
        param6,
        param7,
        command,
        target_system: target.system.0,
        target_component: target.component.0,
        confirmation: 0,
    })
}

/// COMMAND_LONG.
///
/// # Errors
/// When the command is not in the dialect.
pub fn command_long(order: &CommandLong) -> Result<MavMessage, EncodeError> {
    let command = from_number("MAV_CMD", order.command)?;
    Ok(command_to(order.target, command, order.params))
}

/// COMMAND_INT.
///
/// # Errors
/// When the command or the frame is not in the dialect.
pub fn command_int(order: &CommandInt) -> Result<MavMessage, EncodeError> {
    let [param1, param2, param3, param4] = order.params;
    Ok(MavMessage::COMMAND_INT(dialect::COMMAND_INT_DATA {
        param1,
        param2,
        param3,
        param4,
        x: order.x,
        y: order.y,
        z: order.z,
        command: from_number("MAV_CMD", order.command)?,
        target_system: order.target.system.0,
        target_component: order.target.component.0,
        frame: from_number("MAV_FRAME", order.frame.into())?,
        current: 0,
        autocontinue: 0,
    }))
}

/// COMMAND_ACK.
///
/// # Errors
/// When the command or the result is not in the dialect.
pub fn command_ack(ack: &CommandAck) -> Result<MavMessage, EncodeError> {
    Ok(MavMessage::COMMAND_ACK(dialect::COMMAND_ACK_DATA {
        command: from_number("MAV_CMD", ack.command)?,
        result: from_number("MAV_RESULT", result_number(ack.result).into())?,
        progress: 0,
        result_param2: ack.result_param2,
        target_system: ack.target.system.0,
        target_component: ack.target.component.0,
    }))
}

/// STATUSTEXT, cut to [`STATUS_TEXT_BYTES`] at a character's edge. Never chunked: Mission Planner
/// does not join chunks.
#[must_use]
pub fn status_text(status: &StatusText) -> MavMessage {
    MavMessage::STATUSTEXT(dialect::STATUSTEXT_DATA {
        severity: severity(status.severity),
        text: CharArray::from(fitting(&status.text)),
        id: 0,
        chunk_seq: 0,
    })
}

fn fitting(text: &str) -> &str {
    let end = (0..=STATUS_TEXT_BYTES)
        .rev()
        .find(|end| text.is_char_boundary(*end));
    if text.len() <= STATUS_TEXT_BYTES {
        text
    } else {
        &text[..end.unwrap_or(0)]
    }
}

/// CAMERA_TRACKING_GEO_STATUS.
#[must_use]
pub fn camera_tracking_geo_status(status: &CameraTrackingGeoStatus) -> MavMessage {
    use dialect::CameraTrackingStatusFlags as Flags;
    let active = Flags::CAMERA_TRACKING_STATUS_FLAGS_ACTIVE;
    MavMessage::CAMERA_TRACKING_GEO_STATUS(dialect::CAMERA_TRACKING_GEO_STATUS_DATA {
        lat: degrees_e7(status.latitude_deg),
        lon: degrees_e7(status.longitude_deg),
        alt: status.altitude.m() as f32,
        h_acc: or_nan(status.horizontal_sigma_m),
        v_acc: or_nan(status.vertical_sigma_m),
        vel_n: f32::NAN,
        vel_e: f32::NAN,
        vel_d: f32::NAN,
        vel_acc: f32::NAN,
        dist: or_nan(status.range_m),
        hdg: f32::NAN,
        hdg_acc: f32::NAN,
        tracking_status: if status.tracking {
            active
        } else {
            Flags::empty()
        },
        camera_device_id: 0,
    })
}

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

/// Degrees as MAVLink's integers of 1e-7 degrees (11 mm on the equator).
#[must_use]
pub fn degrees_e7(degrees: f64) -> i32 {
    (degrees * 1e7).round() as i32
}

fn from_number<T: FromPrimitive>(field: &'static str, value: u32) -> Result<T, EncodeError> {
    T::from_u32(value).ok_or(EncodeError::NotInDialect { field, value })
}

fn result_number(result: CommandResult) -> u8 {
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

fn severity(severity: Severity) -> dialect::MavSeverity {
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

fn fix_type(fix: GnssFix) -> dialect::GpsFixType {
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
fn boot_ms(boot: BootTime) -> u32 {
    (boot.ns() / 1_000_000) as u32
}

fn time_us(time: VehicleTime) -> u64 {
    let ns = match time {
        VehicleTime::Boot(boot) => boot.ns(),
        VehicleTime::Utc(utc) => utc.unix_ns(),
    };
    u64::try_from(ns / 1_000).unwrap_or(0)
}

fn millimetres(metres: f64) -> i32 {
    (metres * 1e3).round() as i32
}

fn centidegrees(angle_rad: Option<f64>) -> u16 {
    angle_rad.map_or(u16::MAX, |rad| {
        (rad.to_degrees().rem_euclid(360.0) * 100.0).round() as u16
    })
}

fn sigma_mm(sigma_m: Option<f64>) -> u32 {
    sigma_m.map_or(0, |sigma| (sigma * 1e3).round() as u32)
}

fn or_nan(metres: Option<f64>) -> f32 {
    metres.map_or(f32::NAN, |metres| metres as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::{AttitudeSource, DecodeError, EstimatorFlags, Telemetry, decode};
    use crate::wire::RawFrame;
    use emberfix_frames::{
        Attitude, EllipsoidHeight, MslAltitude, ServiceTime, UnitQuaternion, Vector3,
    };

    fn through_the_wire(message: &MavMessage) -> Result<Telemetry, DecodeError> {
        let bytes = Encoder::new(Address::new(1, 1)).encode(message);
        let (frame, _) = RawFrame::at_start(&bytes).unwrap();
        assert_eq!(frame.bytes, bytes);
        decode(&frame)
    }

    fn position() -> GlobalPosition {
        GlobalPosition {
            boot: BootTime::from_ms(12_345),
            latitude_deg: 31.409_422_2,
            longitude_deg: 119.112_016_7,
            altitude: MslAltitude::from_m(22.25),
            above_home_m: 12.0,
            velocity_ned_m_s: Vector3::new(5.25, -1.5, 0.25),
            heading_rad: Some(std::f64::consts::FRAC_PI_2),
        }
    }

    fn fix() -> GpsRaw {
        GpsRaw {
            time: VehicleTime::Boot(BootTime::from_ms(12_300)),
            fix: GnssFix::Fix3d,
            place: Some(GnssPlace {
                latitude_deg: -35.5,
                longitude_deg: 149.25,
                altitude: MslAltitude::from_m(584.5),
                height: Some(EllipsoidHeight::from_m(603.75)),
            }),
            horizontal_sigma_m: Some(1.5),
            vertical_sigma_m: Some(2.5),
            ground_speed_m_s: Some(5.5),
            course_rad: Some(0.0),
            satellites: Some(17),
        }
    }

    #[test]
    fn a_position_comes_back_in_si() {
        let Telemetry::GlobalPosition(back) =
            through_the_wire(&global_position(&position())).unwrap()
        else {
            panic!("not a position");
        };
        // Wire resolutions: 1e-7 degrees, 1 mm, 1 cm/s, 0.01 degrees.
        assert!((back.latitude_deg - position().latitude_deg).abs() < 0.6e-7);
        assert!((back.longitude_deg - position().longitude_deg).abs() < 0.6e-7);
        assert_eq!(back.altitude, position().altitude);
        assert!((back.velocity_ned_m_s - position().velocity_ned_m_s).norm() < 1e-9);
        assert!((back.heading_rad.unwrap() - std::f64::consts::FRAC_PI_2).abs() < 1e-4);
        assert_eq!(back.boot, position().boot);
    }

    #[test]
    fn a_gnss_fix_comes_back_with_both_heights() {
        assert_eq!(
            through_the_wire(&gps_raw(&fix())).unwrap(),
            Telemetry::GpsRaw(fix())
        );
    }

    #[test]
    fn what_the_receiver_does_not_know_stays_unknown() {
        let unknown = GpsRaw {
            place: fix().place.map(|place| GnssPlace {
                height: None,
                ..place
            }),
            horizontal_sigma_m: None,
            vertical_sigma_m: None,
            ground_speed_m_s: None,
            course_rad: None,
            satellites: None,
            ..fix()
        };
        assert_eq!(
            through_the_wire(&gps_raw(&unknown)).unwrap(),
            Telemetry::GpsRaw(unknown)
        );
    }

    #[test]
    fn without_a_3d_fix_there_is_no_place_even_if_the_wire_has_one() {
        let two_d = GpsRaw {
            fix: GnssFix::Fix2d,
            ..fix()
        };
        let back = through_the_wire(&gps_raw(&two_d)).unwrap();
        assert_eq!(
            back,
            Telemetry::GpsRaw(GpsRaw {
                place: None,
                ..two_d
            })
        );
    }

    #[test]
    fn impossible_positions_are_refused_by_name() {
        let refused = |change: fn(&mut GlobalPosition)| {
            let mut bad = position();
            change(&mut bad);
            through_the_wire(&global_position(&bad)).unwrap_err().name()
        };
        assert_eq!(
            refused(|p| (p.latitude_deg, p.longitude_deg) = (0.0, 0.0)),
            "null_position"
        );
        assert_eq!(refused(|p| p.latitude_deg = 90.5), "latitude");
        assert_eq!(refused(|p| p.latitude_deg = f64::MAX), "latitude");
        assert_eq!(refused(|p| p.longitude_deg = f64::MIN), "longitude");
        assert_eq!(
            refused(|p| p.altitude = MslAltitude::from_m(-1000.0)),
            "altitude"
        );
        assert_eq!(
            refused(|p| p.altitude = MslAltitude::from_m(f64::MAX)),
            "altitude"
        );
    }

    #[test]
    fn an_attitude_keeps_its_nose_in_both_messages() {
        let sample = AttitudeSample {
            boot: BootTime::from_ms(77),
            attitude: Attitude::from_angles(0.1, -0.2, 2.5),
            rate_rad_s: Vector3::new(0.5, -0.25, 0.125),
            source: AttitudeSource::Quaternion,
        };
        for (message, source) in [
            (attitude_quaternion(&sample), AttitudeSource::Quaternion),
            (attitude(&sample), AttitudeSource::Angles),
        ] {
            let Telemetry::Attitude(back) = through_the_wire(&message).unwrap() else {
                panic!("not an attitude");
            };
            // Components travel as f32: 6e-8 relative.
            assert!(back.attitude.angle_to(&sample.attitude) < 1e-6);
            assert_eq!((back.rate_rad_s, back.source), (sample.rate_rad_s, source));
        }
    }

    #[test]
    fn attitudes_that_are_none_are_refused() {
        let nan = dialect::ATTITUDE_DATA {
            roll: f32::NAN,
            ..Default::default()
        };
        assert_eq!(
            through_the_wire(&MavMessage::ATTITUDE(nan))
                .unwrap_err()
                .name(),
            "not_finite"
        );
        let zero = dialect::ATTITUDE_QUATERNION_DATA::default();
        let zero = MavMessage::ATTITUDE_QUATERNION(zero);
        assert_eq!(through_the_wire(&zero).unwrap_err().name(), "attitude");
    }

    #[test]
    fn a_utc_of_the_year_2908_is_refused_and_said() {
        let claimed = SystemTime {
            boot: BootTime::from_ms(5),
            utc: None,
            claimed_utc_us: 29_600_000_000_000_000,
        };
        let Telemetry::SystemTime(back) = through_the_wire(&system_time(&claimed)).unwrap() else {
            panic!("not a time");
        };
        assert_eq!((back.utc, back.utc_is_absurd()), (None, true));
        let utc = ServiceTime::from_unix_ns(1_772_366_400_000_001_000);
        let good = SystemTime {
            utc: Some(utc),
            claimed_utc_us: 1_772_366_400_000_001,
            ..claimed
        };
        assert_eq!(
            through_the_wire(&system_time(&good)).unwrap(),
            Telemetry::SystemTime(good)
        );
    }

    #[test]
    fn a_new_enum_value_is_an_error_and_not_silence() {
        let mut bytes = Encoder::new(Address::new(1, 1)).encode(&autopilot_heartbeat(true));
        bytes[14] = 250; // the vehicle type
        let (frame, _) = RawFrame::at_start(&bytes).unwrap();
        assert_eq!(decode(&frame).unwrap_err().name(), "undecodable");
    }

    #[test]
    fn heartbeats_say_who_flies() {
        let flies = |message: &MavMessage| match through_the_wire(message).unwrap() {
            Telemetry::Heartbeat(heartbeat) => (heartbeat.is_autopilot(), heartbeat.armed),
            other => panic!("{other:?}"),
        };
        assert_eq!(flies(&autopilot_heartbeat(true)), (true, true));
        assert_eq!(flies(&companion_heartbeat(true)), (false, false));
    }

    #[test]
    fn a_long_text_is_cut_at_a_characters_edge() {
        let text = format!("{}é and more", "x".repeat(STATUS_TEXT_BYTES - 1));
        let status = StatusText {
            severity: Severity::Alert,
            text,
        };
        let Telemetry::StatusText(back) = through_the_wire(&status_text(&status)).unwrap() else {
            panic!("not a text");
        };
        assert_eq!(back.text, "x".repeat(STATUS_TEXT_BYTES - 1));
        assert_eq!(back.severity, Severity::Alert);
    }

    #[test]
    fn commands_and_their_answers_come_back() {
        let order = CommandInt {
            command: command::SPATIAL_USER_1,
            frame: 0,
            params: [7.0, 2.5, -1.0, 0.0],
            x: 314_094_222,
            y: -1_191_120_167,
            z: 12.5,
            target: Address::new(254, 191),
        };
        assert_eq!(
            through_the_wire(&command_int(&order).unwrap()).unwrap(),
            Telemetry::CommandInt(order)
        );
        let ack = CommandAck {
            command: command::SPATIAL_USER_1,
            result: CommandResult::Accepted,
            result_param2: 7,
            target: Address::new(1, 191),
        };
        assert_eq!(
            through_the_wire(&command_ack(&ack).unwrap()).unwrap(),
            Telemetry::CommandAck(ack)
        );
        assert!(
            command_ack(&CommandAck {
                command: 999_999,
                ..ack
            })
            .is_err()
        );
        let Telemetry::CommandLong(interval) =
            through_the_wire(&set_message_interval(Address::new(1, 1), 33, 50.0)).unwrap()
        else {
            panic!("not a command");
        };
        assert_eq!(
            (interval.command, interval.params[0], interval.params[1]),
            (511, 33.0, 20_000.0)
        );
    }

    #[test]
    fn the_rest_comes_back_too() {
        let home = HomePosition {
            latitude_deg: 31.5,
            longitude_deg: -119.25,
            altitude: MslAltitude::from_m(10.5),
        };
        assert_eq!(
            through_the_wire(&home_position(&home)).unwrap(),
            Telemetry::HomePosition(home)
        );
        let status = EstimatorStatus {
            time: VehicleTime::Boot(BootTime::from_ms(5)),
            horizontal_sigma_m: Some(0.5),
            vertical_sigma_m: None,
            flags: EstimatorFlags::HEALTHY,
        };
        assert_eq!(
            through_the_wire(&estimator_status(&status)).unwrap(),
            Telemetry::EstimatorStatus(status)
        );
        let tracked = CameraTrackingGeoStatus {
            tracking: true,
            latitude_deg: 31.5,
            longitude_deg: 119.25,
            altitude: MslAltitude::from_m(10.5),
            horizontal_sigma_m: Some(1.5),
            vertical_sigma_m: Some(2.0),
            range_m: None,
        };
        assert_eq!(
            through_the_wire(&camera_tracking_geo_status(&tracked)).unwrap(),
            Telemetry::CameraTrackingGeoStatus(tracked)
        );
        let request = TimeSyncMessage {
            tc1_ns: 0,
            ts1_ns: 5,
            target: Address::new(1, 1),
        };
        let reply = through_the_wire(&timesync_reply(&request, Address::new(1, 191), 99)).unwrap();
        let expected = TimeSyncMessage {
            tc1_ns: 99,
            ts1_ns: 5,
            target: Address::new(1, 191),
        };
        assert_eq!(reply, Telemetry::TimeSync(expected));
    }

    #[test]
    fn a_gimbal_without_yaw_flags_says_its_frame_by_its_lock() {
        use dialect::GimbalDeviceFlags as Flags;
        let yaw = |flags| {
            let message = dialect::GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
                q: [1.0, 0.0, 0.0, 0.0],
                angular_velocity_x: f32::NAN,
                flags,
                ..Default::default()
            };
            match through_the_wire(&MavMessage::GIMBAL_DEVICE_ATTITUDE_STATUS(message)).unwrap() {
                Telemetry::GimbalDeviceAttitude(gimbal) => {
                    assert_eq!(gimbal.quaternion, UnitQuaternion::identity());
                    assert_eq!(gimbal.rate_rad_s, None);
                    gimbal.yaw
                }
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(yaw(Flags::empty()), crate::telemetry::GimbalYaw::FromNose);
        assert_eq!(
            yaw(Flags::GIMBAL_DEVICE_FLAGS_YAW_LOCK),
            crate::telemetry::GimbalYaw::FromNorth
        );
        assert_eq!(
            yaw(Flags::GIMBAL_DEVICE_FLAGS_YAW_LOCK
                | Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME),
            crate::telemetry::GimbalYaw::FromNose
        );
    }
    #[test]
    fn a_gimbal_with_both_yaw_frames_is_refused_and_its_locks_do_not_turn_its_frame() {
        use dialect::GimbalDeviceErrorFlags as Faults;
        use dialect::GimbalDeviceFlags as Flags;
        let says = |flags, failure_flags, delta_yaw| {
            let message = dialect::GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
                q: [1.0, 0.0, 0.0, 0.0],
                flags,
                failure_flags,
                delta_yaw,
                gimbal_device_id: 2,
                ..Default::default()
            };
            match through_the_wire(&MavMessage::GIMBAL_DEVICE_ATTITUDE_STATUS(message)) {
                Ok(Telemetry::GimbalDeviceAttitude(gimbal)) => Ok(gimbal),
                Ok(other) => panic!("{other:?}"),
                Err(error) => Err(error.name()),
            }
        };
        let vehicle = Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME;
        let earth = Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME;
        let locks = Flags::GIMBAL_DEVICE_FLAGS_ROLL_LOCK | Flags::GIMBAL_DEVICE_FLAGS_PITCH_LOCK;
        let fine = Faults::empty();
        assert_eq!(says(vehicle | earth, fine, 0.5), Err("two_yaw_frames"));
        for flags in [vehicle, vehicle | locks] {
            let gimbal = says(flags, fine, 0.5).unwrap();
            assert_eq!(gimbal.yaw, crate::telemetry::GimbalYaw::FromNose);
            assert_eq!((gimbal.nose_rad, gimbal.device), (Some(0.5), 2));
        }
        // Without a frame flag the field is not to be read; not-a-number is unknown.
        assert_eq!(says(locks, fine, 0.5).unwrap().nose_rad, None);
        assert_eq!(says(earth, fine, f32::NAN).unwrap().nose_rad, None);
        let limit = Faults::GIMBAL_DEVICE_ERROR_FLAGS_AT_PITCH_LIMIT;
        assert!(!says(earth, limit, 0.5).unwrap().is_faulty);
        let encoder = Faults::GIMBAL_DEVICE_ERROR_FLAGS_ENCODER_ERROR;
        assert!(says(earth, encoder, 0.5).unwrap().is_faulty);
    }

    #[test]
    fn a_second_receiver_is_read_like_the_first() {
        let message = dialect::GPS2_RAW_DATA {
            fix_type: dialect::GpsFixType::GPS_FIX_TYPE_3D_FIX,
            lat: 313_000_000,
            lon: 1_190_000_000,
            alt: 20_000,
            alt_ellipsoid: 31_000,
            h_acc: 900,
            ..Default::default()
        };
        let Ok(Telemetry::Gps2Raw(gps)) = through_the_wire(&MavMessage::GPS2_RAW(message)) else {
            panic!("not a second receiver");
        };
        let place = gps.place.unwrap();
        assert_eq!(
            place.height.unwrap() - place.altitude,
            emberfix_frames::GeoidUndulation::from_m(11.0)
        );
        assert_eq!(gps.horizontal_sigma_m, Some(0.9));
    }
}
