//! Who is there, what time it is, and what people are told.

use super::fields::{degrees_e7, from_number, or_nan, severity};
use super::{EncodeError, MavMessage, STATUS_TEXT_BYTES, dialect};
use crate::telemetry::{CameraTrackingGeoStatus, Heartbeat, StatusText, TimeSyncMessage};
use crate::wire::Address;
use mavlink::types::CharArray;

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
