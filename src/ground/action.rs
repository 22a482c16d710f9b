//! What operators do with an incident, as it is recorded and as it travels back to the aircraft.

use super::incident::{Operator, OperatorState};
use emberfix_frames::ServiceTime;
use serde::Serialize;

/// What can be done.
pub use crate::alarm::ActionKind as Kind;

/// One action on record.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Action {
    /// Counts up from 1 on this ground, over restarts.
    pub number: i64,
    /// Row of the journal.
    pub row: i64,
    /// The client's own id of it: sent twice, it is done once.
    pub key: String,
    /// What.
    pub kind: Kind,
    /// To which incident, as it was called then.
    pub incident: String,
    /// The alarms that it had then and that are meant.
    pub alarms: Vec<String>,
    /// The alarms of the other incident (merge), or those that stay (split).
    pub others: Vec<String>,
    /// Number of the action that is taken back.
    pub of: Option<i64>,
    /// Who.
    pub by: String,
    /// When, by the ground's clock.
    #[serde(with = "crate::alarm::rfc3339")]
    pub at: ServiceTime,
    /// In their words.
    pub note: Option<String>,
    /// It was taken back.
    pub undone: bool,
}

impl Action {
    /// Whether it concerns an alarm.
    pub(super) fn names(&self, alarm: &str) -> bool {
        self.alarms.iter().chain(&self.others).any(|id| id == alarm)
    }

    /// Where it leaves an alarm, if it says so.
    pub(super) fn state(&self) -> Option<OperatorState> {
        match self.kind {
            Kind::Acknowledge => Some(OperatorState::Acknowledged),
            Kind::Confirm => Some(OperatorState::Confirmed),
            Kind::Dismiss => Some(OperatorState::Dismissed),
            Kind::Merge | Kind::Split | Kind::Undo => None,
        }
    }

    /// The same as an incident shows it.
    pub(super) fn operator(&self) -> Operator {
        Operator {
            state: self.state().unwrap_or_default(),
            by: Some(self.by.clone()),
            at: Some(self.at.rfc3339()),
            note: self.note.clone(),
        }
    }
}
