//! An operator's action as one MAVLink command, and back; both sides use this file.
//!
//! `COMMAND_LONG`, command `MAV_CMD_USER_2`, from the ground agent to the companion computer:
//! `param1` fire number, `param2` what was done (1 acknowledge, 2 confirm, 3 dismiss, 4 merge,
//! 5 split, 6 undo), `param3` number of the action at the ground, `param4` its age in seconds. The answer is
//! a `COMMAND_ACK` whose `result_param2` is the action's number, given once the action is on the
//! aircraft's disk. Whole numbers stay below 2^24, which a 32-bit float holds exactly.

use super::spatial::GREATEST_NUMBER;
use super::{alarm_id, fire_number};
use crate::alarm::{Action, ActionKind, FireId};
use emberfix_frames::{ServiceTime, seconds};
use emberfix_mav::Address;
use emberfix_mav::outgoing::command;
use emberfix_mav::telemetry::CommandLong;

/// Who acted, as far as this link can say.
const BY: &str = "mavlink";

/// The command that tells `action` to `companion` at `now`; none for an action that does not fit.
#[must_use]
pub fn encode(action: &Action, companion: Address, now: ServiceTime) -> Option<CommandLong> {
    let fire = fire_number(&action.alarm).filter(|fire| (1..=GREATEST_NUMBER).contains(&fire.0))?;
    let number = u32::try_from(action.number)
        .ok()
        .filter(|number| *number <= GREATEST_NUMBER)?;
    let kind = ActionKind::ALL
        .iter()
        .position(|kind| *kind == action.kind)?;
    let age_s = (now - action.at).as_secs_f64().max(0.0);
    Some(CommandLong {
        command: command::USER_2,
        params: [
            fire.0 as f32,
            (kind + 1) as f32,
            number as f32,
            age_s as f32,
            0.0,
            0.0,
            0.0,
        ],
        confirmation: 0,
        target: companion,
    })
}

/// What a command says about an alarm of `uav`; none when it is no action.
#[must_use]
pub fn decode(order: &CommandLong, uav: &str, now: ServiceTime) -> Option<Action> {
    let [fire, kind, number, age_s, ..] = order.params;
    let age_s = f64::from(age_s);
    if order.command != command::USER_2 || !(0.0..=1e9).contains(&age_s) {
        return None;
    }
    let kind = whole(kind)?.checked_sub(1)?;
    Some(Action {
        number: whole(number)?.into(),
        alarm: alarm_id(uav, FireId(whole(fire)?)),
        kind: *ActionKind::ALL.get(usize::try_from(kind).ok()?)?,
        at: now - seconds(age_s),
        by: BY.to_owned(),
    })
}

fn whole(number: f32) -> Option<u32> {
    let fits = (1.0..=GREATEST_NUMBER as f32).contains(&number) && number.fract() == 0.0;
    fits.then_some(number as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);
    const COMPANION: Address = Address::new(1, 191);

    fn action(kind: ActionKind) -> Action {
        Action {
            number: 16_777_215,
            alarm: "uav-1-7".to_owned(),
            kind,
            at: NOW - seconds(8.0),
            by: BY.to_owned(),
        }
    }

    #[test]
    fn every_action_reads_back() {
        for kind in ActionKind::ALL {
            let order = encode(&action(kind), COMPANION, NOW).unwrap();
            assert_eq!(decode(&order, "uav-1", NOW), Some(action(kind)));
        }
    }

    #[test]
    fn what_is_no_action_is_none() {
        let good = encode(&action(ActionKind::Dismiss), COMPANION, NOW).unwrap();
        for (parameter, value) in [
            (0, 0.0),
            (0, 1.5),
            (1, 0.0),
            (1, 7.0),
            (1, f32::NAN),
            (2, -1.0),
            (2, f32::INFINITY),
            (3, f32::NAN),
        ] {
            let mut wrong = good;
            wrong.params[parameter] = value;
            assert_eq!(decode(&wrong, "uav-1", NOW), None, "{parameter} {value}");
        }
        let mut huge = action(ActionKind::Dismiss);
        huge.number = 1 << 24;
        assert_eq!(encode(&huge, COMPANION, NOW), None);
    }
}
