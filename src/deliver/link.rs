//! Links that answer at once, and the courier that decides what to send over them when.

use crate::alarm::{Alarm, AlarmProperties, FireState};
use emberfix_frames::{ServiceTime, SignedDuration};
use std::collections::BTreeMap;

/// A link that takes one alarm and says whether the other side has it.
pub trait AlarmLink {
    /// Name, also in the outbox: receipts are kept under it.
    fn name(&self) -> &'static str;

    /// Sends one revision; `Ok` only when the other side has it on its disk.
    ///
    /// # Errors
    /// [`LinkError`]; the alarm stays in the outbox.
    fn send(&mut self, alarm: &Alarm) -> Result<Receipt, LinkError>;
}

/// The other side has this revision.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Receipt {
    /// Alarm id.
    pub id: String,
    /// Revision.
    pub revision: u32,
}

/// Why an alarm did not arrive, as far as we know.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LinkError {
    /// Down, slow or mistaken: every alarm waits.
    #[error("{link} does not deliver: {reason}")]
    Unreachable {
        /// Which link.
        link: &'static str,
        /// In the link's words.
        reason: String,
    },
    /// The other side will not have this alarm: it waits alone.
    #[error("{link} refused {id} revision {revision}: {reason}")]
    Refused {
        /// Which link.
        link: &'static str,
        /// Alarm id.
        id: String,
        /// Revision.
        revision: u32,
        /// In the other side's words.
        reason: String,
    },
}

/// How much an alarm may not wait; the least is the most urgent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Urgency(pub u8);

impl Urgency {
    /// A burning fire before a dying one before one that is out.
    #[must_use]
    pub fn of(properties: &AlarmProperties) -> Self {
        Self(match properties.state {
            FireState::Confirmed | FireState::Growing => 0,
            FireState::Steady => 1,
            FireState::Suspected | FireState::Dying => 2,
            FireState::Out => 3,
        })
    }
}

/// First pause after a failure; doubles with each further one.
pub const FIRST_RETRY: SignedDuration = SignedDuration::from_secs(1);
/// Longest pause between attempts.
pub const SLOWEST_RETRY: SignedDuration = SignedDuration::from_secs(30);

/// Pause after the `failures`th failure in a row: 1, 2, 4, .. 30 s.
#[must_use]
pub fn pause_after(failures: u32) -> SignedDuration {
    let doublings = failures.saturating_sub(1).min(5);
    (FIRST_RETRY * 2_i32.pow(doublings)).min(SLOWEST_RETRY)
}

/// What one link may be sent when; pure state, time is an argument.
///
/// An unreachable link pauses for all; a refused alarm waits alone, so that a bad one never blocks
/// the others. **Bound:** one entry per refused alarm that is still pending.
#[derive(Debug, Default)]
pub struct Courier {
    failures: u32,
    link_opens_at: Option<ServiceTime>,
    refused: BTreeMap<String, Refusal>,
}

#[derive(Debug, Clone, Copy)]
struct Refusal {
    revision: u32,
    times: u32,
    again_at: ServiceTime,
}

impl Courier {
    /// Ready to send.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Which of the `pending` alarms, which come in the outbox's order, to send now.
    pub fn choose<'a>(&mut self, pending: &'a [Alarm], now: ServiceTime) -> Option<&'a Alarm> {
        let is_pending = |id: &String| pending.iter().any(|alarm| alarm.properties.id == *id);
        self.refused.retain(|id, _| is_pending(id));
        if self.link_opens_at.is_some_and(|opens| now < opens) {
            return None;
        }
        pending
            .iter()
            .find(|alarm| !self.waits_alone(&alarm.properties, now))
    }

    /// Takes in how it went.
    pub fn settle(&mut self, outcome: &Result<Receipt, LinkError>, now: ServiceTime) {
        match outcome {
            Err(LinkError::Unreachable { .. }) => {
                self.failures = self.failures.saturating_add(1);
                self.link_opens_at = Some(now + pause_after(self.failures));
            }
            Ok(receipt) => {
                self.reached();
                self.refused.remove(&receipt.id);
            }
            Err(LinkError::Refused { id, revision, .. }) => {
                self.reached();
                let times = self.refused.get(id).map_or(0, |refusal| refusal.times) + 1;
                let again_at = now + pause_after(times);
                self.refused.insert(
                    id.clone(),
                    Refusal {
                        revision: *revision,
                        times,
                        again_at,
                    },
                );
            }
        }
    }

    fn reached(&mut self) {
        self.failures = 0;
        self.link_opens_at = None;
    }

    /// A newer revision is another alarm: what was wrong with the old one need not be with it.
    fn waits_alone(&self, properties: &AlarmProperties, now: ServiceTime) -> bool {
        self.refused.get(&properties.id).is_some_and(|refusal| {
            refusal.revision == properties.revision && now < refusal.again_at
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests_support::alarm;
    use super::*;

    fn at(second: i64) -> ServiceTime {
        ServiceTime::from_unix_ns(second * 1_000_000_000)
    }

    fn unreachable() -> Result<Receipt, LinkError> {
        Err(LinkError::Unreachable {
            link: "test",
            reason: "down".to_owned(),
        })
    }

    fn chosen(courier: &mut Courier, pending: &[Alarm], now: ServiceTime) -> Option<String> {
        courier
            .choose(pending, now)
            .map(|alarm| alarm.properties.id.clone())
    }

    #[test]
    fn pauses_double_up_to_half_a_minute() {
        let pauses: Vec<i64> = (1..=7).map(|n| pause_after(n).as_secs()).collect();
        assert_eq!(pauses, [1, 2, 4, 8, 16, 30, 30]);
    }

    #[test]
    fn an_unreachable_link_pauses_and_then_begins_with_the_first() {
        let pending = [alarm(1, 1), alarm(2, 1)];
        let mut courier = Courier::new();
        assert_eq!(chosen(&mut courier, &pending, at(0)).unwrap(), "uav-1-1");
        courier.settle(&unreachable(), at(0));
        assert_eq!(chosen(&mut courier, &pending, at(0)), None);
        assert_eq!(chosen(&mut courier, &pending, at(1)).unwrap(), "uav-1-1");
        courier.settle(&unreachable(), at(1));
        assert_eq!(chosen(&mut courier, &pending, at(2)), None);
        assert_eq!(chosen(&mut courier, &pending, at(3)).unwrap(), "uav-1-1");
    }

    #[test]
    fn a_refused_alarm_waits_alone_until_it_has_a_new_revision() {
        let mut courier = Courier::new();
        let refused = LinkError::Refused {
            link: "test",
            id: "uav-1-1".into(),
            revision: 1,
            reason: "?".into(),
        };
        courier.settle(&Err(refused), at(0));
        assert_eq!(
            chosen(&mut courier, &[alarm(1, 1), alarm(2, 1)], at(0)).unwrap(),
            "uav-1-2"
        );
        assert_eq!(
            chosen(&mut courier, &[alarm(1, 2)], at(0)).unwrap(),
            "uav-1-1"
        );
        assert_eq!(chosen(&mut courier, &[alarm(1, 1)], at(0)), None);
    }
}
