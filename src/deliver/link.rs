//! What every link is, and the courier that decides what to send over one that answers at once.

use super::envelope::Sealed;
use crate::alarm::{Alarm, AlarmProperties, Attention, FireState};
use emberfix_frames::{ServiceTime, SignedDuration};
use std::collections::BTreeMap;
use std::sync::Arc;

/// One alarm revision as it goes out: what it says, and the exact bytes that are signed. Cheap to
/// clone.
#[derive(Debug, Clone, PartialEq)]
pub struct Letter {
    /// What it says.
    pub alarm: Arc<Alarm>,
    /// Its bytes and numbers, and the signature.
    pub sealed: Arc<Sealed>,
    /// Whether people still have to be told.
    pub attention: Attention,
}

impl Letter {
    /// Alarm id.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.alarm.properties.id
    }

    /// Revision.
    #[must_use]
    pub fn revision(&self) -> u32 {
        self.alarm.properties.revision
    }

    /// Number among all revisions of its outbox.
    #[must_use]
    pub fn sequence(&self) -> u64 {
        self.sealed.envelope.sequence
    }
}

/// A link to the ground. One suite of tests (`contract`) holds all of them, and the fakes, to this.
pub trait AlarmLink {
    /// Name, also in the outbox: receipts are kept under it.
    fn name(&self) -> &'static str;

    /// Takes in what waits, most urgent first, begins what is due, and says what was settled since.
    /// Never waits for the other side. What is not among `waiting` any more is not owed any more.
    fn work(&mut self, waiting: &[Letter], now: ServiceTime) -> Vec<Settled>;
}

/// How it went with one letter, or with all.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Settled {
    /// The other side has it on its disk.
    Delivered(Receipt),
    /// The other side will not have this alarm: it waits alone.
    Refused {
        /// Alarm id.
        id: String,
        /// Revision.
        revision: u32,
        /// In the other side's words.
        reason: String,
    },
    /// Down, slow or mistaken: every alarm waits.
    Unreachable {
        /// In the link's words.
        reason: String,
    },
}

/// The other side has this revision.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Receipt {
    /// Alarm id.
    pub id: String,
    /// Revision.
    pub revision: u32,
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

/// First pause after a refusal; doubles with each further one.
pub const FIRST_RETRY: SignedDuration = SignedDuration::from_secs(1);
/// Longest pause between attempts.
pub const SLOWEST_RETRY: SignedDuration = SignedDuration::from_secs(30);
/// Pause of a link that was not reached. It does not grow: an outage ends without notice.
pub const KNOCK: SignedDuration = SignedDuration::from_millis(500);

/// Pause after the `failures`th failure in a row: 1, 2, 4, .. 30 s.
#[must_use]
pub fn pause_after(failures: u32) -> SignedDuration {
    let doublings = failures.saturating_sub(1).min(5);
    (FIRST_RETRY * 2_i32.pow(doublings)).min(SLOWEST_RETRY)
}

/// What a link of several lanes may be sent when; pure state, time is an argument.
///
/// A link that is not reached pauses for all. An alarm that the other side refuses, or that hangs
/// while others get through, waits alone, and tries again in one lane only, so that bad ones never
/// block the others. **Bound:** one entry per such alarm that is still pending.
#[derive(Debug, Default)]
pub struct Courier {
    opens_at: Option<ServiceTime>,
    reached_at: Option<ServiceTime>,
    under_way: BTreeMap<String, UnderWay>,
    poisoned: BTreeMap<String, Poisoned>,
}

#[derive(Debug, Clone, Copy)]
struct UnderWay {
    since: ServiceTime,
    poisoned: bool,
}

#[derive(Debug, Clone, Copy)]
struct Poisoned {
    revision: u32,
    times: u32,
    again_at: ServiceTime,
}

impl Courier {
    /// Lanes: what may be under way at once.
    pub const LANES: usize = 8;

    /// Ready to send.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Which of the `pending` letters, which come in the outbox's order, to send now, if a lane is
    /// free. It is under way until [`Courier::settle`].
    pub fn choose<'a>(&mut self, pending: &'a [Letter], now: ServiceTime) -> Option<&'a Letter> {
        self.poisoned
            .retain(|id, _| pending.iter().any(|letter| letter.id() == id));
        // Before the link is known to be there, one knock is enough.
        let lanes = match self.opens_at {
            Some(opens) if now < opens => 0,
            Some(_) => 1,
            None => Self::LANES,
        };
        if self.under_way.len() >= lanes {
            return None;
        }
        let sick_lane_is_free = self.under_way.values().all(|way| !way.poisoned);
        let chosen = pending.iter().find(|letter| {
            let free = !self.under_way.contains_key(letter.id());
            free && match self.is_poisoned(letter) {
                None => true,
                Some(poisoned) => sick_lane_is_free && now >= poisoned.again_at,
            }
        })?;
        let poisoned = self.is_poisoned(chosen).is_some();
        let way = UnderWay {
            since: now,
            poisoned,
        };
        self.under_way.insert(chosen.id().to_owned(), way);
        Some(chosen)
    }

    /// Takes in how it went with what was under way.
    pub fn settle(&mut self, sent: &Receipt, outcome: &Settled, now: ServiceTime) {
        let way = self.under_way.remove(&sent.id);
        match outcome {
            Settled::Delivered(receipt) => {
                self.reached(now);
                self.poisoned.remove(&receipt.id);
            }
            Settled::Refused { .. } => {
                self.reached(now);
                self.poison(sent, now);
            }
            Settled::Unreachable { .. } => {
                let others_got_through =
                    way.is_some_and(|way| self.reached_at.is_some_and(|at| at > way.since));
                if others_got_through {
                    self.poison(sent, now);
                } else {
                    self.opens_at = Some(now + KNOCK);
                }
            }
        }
    }

    /// The other side answered, if only to something else.
    pub fn reached(&mut self, now: ServiceTime) {
        self.reached_at = Some(now);
        self.opens_at = None;
    }

    /// Nothing says that the other side can't be reached.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.opens_at.is_none()
    }

    fn poison(&mut self, sent: &Receipt, now: ServiceTime) {
        let times = self.poisoned.get(&sent.id).map_or(0, |known| known.times) + 1;
        self.poisoned.insert(
            sent.id.clone(),
            Poisoned {
                revision: sent.revision,
                times,
                again_at: now + pause_after(times),
            },
        );
    }

    /// A newer revision is another alarm: what was wrong with the old one need not be with it.
    fn is_poisoned(&self, letter: &Letter) -> Option<&Poisoned> {
        self.poisoned
            .get(letter.id())
            .filter(|poisoned| poisoned.revision == letter.revision())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests_support::letter;
    use super::*;

    fn at_ms(ms: i64) -> ServiceTime {
        ServiceTime::from_unix_ns(ms * 1_000_000)
    }

    fn unreachable() -> Settled {
        Settled::Unreachable {
            reason: "down".to_owned(),
        }
    }

    fn sent(letter: &Letter) -> Receipt {
        Receipt {
            id: letter.id().to_owned(),
            revision: letter.revision(),
        }
    }

    fn chosen(courier: &mut Courier, pending: &[Letter], now: ServiceTime) -> Option<String> {
        courier
            .choose(pending, now)
            .map(|letter| letter.id().to_owned())
    }

    #[test]
    fn pauses_double_up_to_half_a_minute() {
        let pauses: Vec<i64> = (1..=7).map(|n| pause_after(n).as_secs()).collect();
        assert_eq!(pauses, [1, 2, 4, 8, 16, 30, 30]);
    }

    #[test]
    fn an_unreachable_link_is_knocked_at_with_one_letter_and_then_opens_for_all() {
        let pending = [letter(1, 1), letter(2, 1), letter(3, 1)];
        let mut courier = Courier::new();
        assert_eq!(chosen(&mut courier, &pending, at_ms(0)).unwrap(), "uav-1-1");
        courier.settle(&sent(&pending[0]), &unreachable(), at_ms(10));
        assert_eq!(chosen(&mut courier, &pending, at_ms(400)), None);
        assert_eq!(
            chosen(&mut courier, &pending, at_ms(600)).unwrap(),
            "uav-1-1"
        );
        assert_eq!(chosen(&mut courier, &pending, at_ms(601)), None);
        let delivered = Settled::Delivered(sent(&pending[0]));
        courier.settle(&sent(&pending[0]), &delivered, at_ms(700));
        let rest = &pending[1..];
        assert_eq!(chosen(&mut courier, rest, at_ms(700)).unwrap(), "uav-1-2");
        assert_eq!(chosen(&mut courier, rest, at_ms(700)).unwrap(), "uav-1-3");
        assert_eq!(chosen(&mut courier, rest, at_ms(700)), None);
    }

    #[test]
    fn a_refused_alarm_waits_alone_until_it_has_a_new_revision() {
        let (first, second) = (letter(1, 1), letter(2, 1));
        let mut courier = Courier::new();
        let pending = [first.clone(), second.clone()];
        courier.choose(&pending, at_ms(0));
        let refused = Settled::Refused {
            id: "uav-1-1".into(),
            revision: 1,
            reason: "?".into(),
        };
        courier.settle(&sent(&first), &refused, at_ms(0));
        assert_eq!(chosen(&mut courier, &pending, at_ms(0)).unwrap(), "uav-1-2");
        let newer = [letter(1, 2)];
        assert_eq!(chosen(&mut courier, &newer, at_ms(0)).unwrap(), "uav-1-1");
        let mut courier = Courier::new();
        courier.choose(&pending[..1], at_ms(0));
        courier.settle(&sent(&first), &refused, at_ms(0));
        assert_eq!(chosen(&mut courier, &pending[..1], at_ms(0)), None);
    }

    #[test]
    fn alarms_that_hang_take_one_lane_and_the_others_go_on() {
        let pending: Vec<Letter> = (1..=20).map(|number| letter(number, 1)).collect();
        let mut courier = Courier::new();
        let lanes: Vec<String> =
            std::iter::from_fn(|| chosen(&mut courier, &pending, at_ms(0))).collect();
        assert_eq!(lanes.len(), Courier::LANES);
        // The last one gets through, the others time out.
        let (through, hung) = (&pending[7], &pending[..7]);
        courier.settle(
            &sent(through),
            &Settled::Delivered(sent(through)),
            at_ms(50),
        );
        for letter in hung {
            courier.settle(&sent(letter), &unreachable(), at_ms(5_000));
        }
        let rest: Vec<Letter> = pending
            .iter()
            .filter(|l| l.id() != through.id())
            .cloned()
            .collect();
        let again: Vec<String> =
            std::iter::from_fn(|| chosen(&mut courier, &rest, at_ms(7_000))).collect();
        let sick = again
            .iter()
            .filter(|id| hung.iter().any(|l| l.id() == *id))
            .count();
        assert_eq!((again.len(), sick), (Courier::LANES, 1));
    }
}
