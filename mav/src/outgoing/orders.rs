//! Commands, and their answers.

use super::fields::{from_number, result_number};
use super::{EncodeError, MavMessage, dialect};
use crate::telemetry::{CommandAck, CommandInt, CommandLong};
use crate::wire::Address;

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
