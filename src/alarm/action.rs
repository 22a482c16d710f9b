//! What a person on the ground did about an alarm, as it travels back to the aircraft.

use emberfix_frames::ServiceTime;
use serde::{Deserialize, Serialize};

/// What was done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionKind {
    /// Seen.
    Acknowledge,
    /// It is a fire.
    Confirm,
    /// It is none.
    Dismiss,
    /// It belongs to another incident.
    Merge,
    /// It belongs to no other incident.
    Split,
    /// An earlier deed is taken back.
    Undo,
}

/// One deed of an operator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Action {
    /// Number at the ground station, rising.
    pub number: u64,
    /// Alarm id.
    pub alarm: String,
    /// What was done.
    pub kind: ActionKind,
    /// When, by the ground's clock.
    #[serde(with = "super::rfc3339")]
    pub at: ServiceTime,
    /// Who did it, as far as the ground knows.
    #[serde(default)]
    pub by: String,
}

/// How much of people's attention an alarm still asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Attention {
    /// Nobody has seen to it.
    #[default]
    Wanted,
    /// Somebody has: no repeats.
    Seen,
    /// Somebody says that it is none: nothing is said until somebody says otherwise.
    Dismissed,
}

impl ActionKind {
    /// All, in the order of their numbers on MAVLink, from 1.
    pub const ALL: [Self; 6] = [
        Self::Acknowledge,
        Self::Confirm,
        Self::Dismiss,
        Self::Merge,
        Self::Split,
        Self::Undo,
    ];

    /// What attention the alarm asks for after it; merging and splitting change nothing on board.
    #[must_use]
    pub fn attention(self) -> Option<Attention> {
        match self {
            Self::Acknowledge | Self::Confirm => Some(Attention::Seen),
            Self::Dismiss => Some(Attention::Dismissed),
            Self::Undo => Some(Attention::Wanted),
            Self::Merge | Self::Split => None,
        }
    }
}
