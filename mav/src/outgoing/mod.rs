//! What we say: SI values to messages, and messages to frames.
//!
//! Where a message has a telemetry struct, that struct is what its constructor takes, so that
//! what one side writes is what the other side reads. Values beyond a field's range saturate;
//! `None` is written the way each field spells "unknown".

mod fields;
mod orders;
mod state;
mod talk;
#[cfg(test)]
mod tests;

use crate::signing::Signer;
use crate::wire::Address;
use emberfix_frames::ServiceTime;
use mavlink::dialects::development as dialect;
use mavlink::{MAVLinkV2MessageRaw, MavHeader, Message as _};

pub use fields::degrees_e7;
pub use mavlink::dialects::development::MavMessage;
pub use orders::{command_ack, command_int, command_long, request_message, set_message_interval};
pub use state::{
    attitude, attitude_quaternion, estimator_status, global_position, gps_raw, home_position,
    system_time,
};
pub use talk::{
    autopilot_heartbeat, camera_tracking_geo_status, companion_heartbeat, heartbeat, status_text,
    timesync, timesync_reply, timesync_request,
};

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
