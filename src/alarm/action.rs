//! What a person on the ground did about an alarm, as it travels back to the aircraft.

use emberfix_frames::ServiceTime;
use serde::{Deserialize, Serialize};

/// What was done, on the ground and as the aircraft hears of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionKind {
    /// Seen: somebody is on it.
    Acknowledge,
    /// It is a fire.
    Confirm,
    /// It is none.
    Dismiss,
    /// It is the same fire as another incident.
    Merge,
    /// One of the incident's alarms is another fire.
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

    /// As it is written.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Acknowledge => "acknowledge",
            Self::Confirm => "confirm",
            Self::Dismiss => "dismiss",
            Self::Merge => "merge",
            Self::Split => "split",
            Self::Undo => "undo",
        }
    }

    /// What is written so.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kind_is_written_the_same_way_everywhere() {
        for kind in ActionKind::ALL {
            assert_eq!(serde_json::json!(kind), kind.name());
            assert_eq!(ActionKind::named(kind.name()), Some(kind));
        }
        assert_eq!(ActionKind::named("Undo"), None);
    }
}
