//! One fire: which of its texts and commands were said, and which are due.

use super::super::Urgency;
use super::super::link::pause_after;
use crate::alarm::{Alarm, Attention, FireState};
use emberfix_frames::{ServiceTime, SignedDuration};
use emberfix_mav::telemetry::CommandResult;

/// A fire, and how far it is told.
#[derive(Debug)]
pub(super) struct Telling {
    pub alarm: Alarm,
    pub attention: Attention,
    pub command: CommandState,
    pub text: TextState,
}

/// How far the command is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum CommandState {
    Never,
    Tried(Attempts),
    Delivered,
}

/// Sendings without the answer that was wanted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Attempts {
    pub times: u32,
    pub latest: ServiceTime,
    pub again_at: ServiceTime,
    /// The ground agent answered, and will not have it: it waits for its turn.
    pub refused: bool,
}

/// Which texts of a fire were said.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum TextState {
    Due {
        said: usize,
        at: Option<ServiceTime>,
    },
    Said,
}

/// Pauses before the second and the third saying of a text.
const TEXT_PAUSES: [SignedDuration; 2] =
    [SignedDuration::from_secs(1), SignedDuration::from_secs(2)];
/// How long a fire stays the camera's target after its latest sighting.
const CAMERA_MEMORY: SignedDuration = SignedDuration::from_secs(30);

impl Telling {
    pub fn new(alarm: &Alarm) -> Self {
        let text = TextState::Due { said: 0, at: None };
        Self {
            alarm: alarm.clone(),
            attention: Attention::Wanted,
            command: CommandState::Never,
            text,
        }
    }

    /// A revision after a delivered one goes at once; one after an unanswered one keeps its place in
    /// the repetitions, so that a lively fire does not fill a link on which nobody listens.
    pub fn renew(&mut self, alarm: &Alarm) {
        let (old, new) = (&self.alarm.properties, &alarm.properties);
        if new.revision <= old.revision {
            return;
        }
        if self.command == CommandState::Delivered {
            self.command = CommandState::Never;
        }
        if new.state == FireState::Out && old.state != FireState::Out {
            self.text = TextState::Due {
                said: TEXT_PAUSES.len(),
                at: None,
            };
        }
        self.alarm = alarm.clone();
    }

    /// Seen: no texts but the one that it is out. Dismissed: none at all.
    pub fn attend(&mut self, attention: Attention) {
        let burns = self.alarm.properties.state != FireState::Out;
        match attention {
            Attention::Wanted => {}
            Attention::Seen if burns || self.attention != attention => {
                self.text = TextState::Said;
            }
            Attention::Seen => {}
            Attention::Dismissed => self.text = TextState::Said,
        }
        self.attention = attention;
    }

    pub fn is_delivered(&self) -> bool {
        self.command == CommandState::Delivered
    }

    pub fn was_tried(&self) -> bool {
        self.command != CommandState::Never
    }

    pub fn command_due(&self, fresh: bool, now: ServiceTime) -> bool {
        match self.command {
            CommandState::Never => fresh,
            CommandState::Tried(attempts) => !fresh && now >= attempts.again_at,
            CommandState::Delivered => false,
        }
    }

    /// True when it was the first time.
    pub fn tried(&mut self, now: ServiceTime) -> bool {
        let before = match self.command {
            CommandState::Tried(attempts) => Some(attempts.times),
            CommandState::Never | CommandState::Delivered => None,
        };
        let times = before.unwrap_or(0).saturating_add(1);
        let again_at = now + pause_after(times);
        self.command = CommandState::Tried(Attempts {
            times,
            latest: now,
            again_at,
            refused: false,
        });
        before.is_none()
    }

    pub fn refused(&mut self, result: CommandResult) {
        tracing::warn!(
            id = self.alarm.properties.id,
            ?result,
            "the ground refused an alarm"
        );
        if let CommandState::Tried(attempts) = &mut self.command {
            attempts.refused = true;
        }
    }

    /// Least is told first: urgent ones, then what waits longest, then the newest sighting.
    pub fn rank(&self) -> (Urgency, Option<ServiceTime>, std::cmp::Reverse<ServiceTime>) {
        let waits_since = match self.command {
            CommandState::Tried(attempts) => Some(attempts.again_at),
            CommandState::Never | CommandState::Delivered => None,
        };
        let properties = &self.alarm.properties;
        (
            Urgency::of(properties),
            waits_since,
            std::cmp::Reverse(properties.captured_at),
        )
    }

    pub fn is_in_sight(&self, now: ServiceTime) -> bool {
        let properties = &self.alarm.properties;
        self.attention != Attention::Dismissed
            && properties.state != FireState::Out
            && now - properties.captured_at <= CAMERA_MEMORY
    }
}

impl TextState {
    pub fn is_due(self, now: ServiceTime) -> bool {
        match self {
            Self::Due { at, .. } => at.is_none_or(|at| now >= at),
            Self::Said => false,
        }
    }

    pub fn said(&mut self, now: ServiceTime) {
        let Self::Due { said, .. } = *self else {
            return;
        };
        *self = match TEXT_PAUSES.get(said) {
            Some(pause) => Self::Due {
                said: said + 1,
                at: Some(now + *pause),
            },
            None => Self::Said,
        };
    }

    /// The ground agent has it: no need to repeat, but it is said once in any case.
    pub fn heard(&mut self) {
        *self = match *self {
            Self::Due { at: None, .. } => Self::Due {
                said: TEXT_PAUSES.len(),
                at: None,
            },
            Self::Due { at: Some(_), .. } | Self::Said => Self::Said,
        };
    }
}
