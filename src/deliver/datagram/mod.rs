//! Delivery over datagrams; sans-IO.
//!
//! Each alarm is one signed datagram, answered by a signed receipt once it is on the ground's disk,
//! and sent again after a fixed interval until then: no alarm waits for another one's retry, as it
//! would in a stream. The interval is 100 ms, or what the way there and back takes where that is
//! longer; it does not double, so a bad second costs no more than a second. While letters are being
//! lost, one that is sent for the first time goes twice, 20 ms apart.
//!
//! **Liveness.** A beat goes every half second, four times a second while nobody answers. Its answer
//! is random-stamped, so that the first one after an outage proves that the ground is there, and
//! everything that waits goes at once, urgent first. While nobody answers only the most urgent
//! letter is tried.
//!
//! **Pace.** 250 kB/s at most. Loss does not slow it (radios lose without being full), a growing way
//! there and back does: then something queues.
//!
//! **Pictures.** A fire's picture goes in parts, 500 B/s, one part at a time, and only while no
//! letter waits for its answer.
//!
//! **Bounds.** Letters: what [`DatagramDelivery::work`] is given, at most [`DatagramDelivery::WINDOW`]
//! at once. Pictures: [`DatagramDelivery::CHIPS`], the newest; the oldest gives way.

pub(crate) mod chips;
mod pace;
pub mod wire;

use super::envelope::Origin;
use super::keys::{PublicKey, SecretKey};
use super::link::{AlarmLink, Letter, Settled, pause_after};
use super::{Receipt, Urgency};
use chips::Chips;
use emberfix_frames::{ServiceTime, SignedDuration};
use pace::{Pace, RoundTrip};
use rand::{RngCore as _, SeedableRng as _};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use wire::{Ask, Beat, PackedLetter, ToAircraft, ToGround, Verdict};

/// Between two sendings of a letter, at least.
pub const RETRY: SignedDuration = SignedDuration::from_millis(100);
/// Between two sendings of a letter, at most.
const SLOWEST_RETRY: SignedDuration = SignedDuration::from_secs(2);
/// Before the second copy of a first sending, while letters are being lost.
const COPY_AFTER: SignedDuration = SignedDuration::from_millis(20);
/// Share of sendings without an answer from which on first sendings go twice.
const LOSSY: f64 = 0.05;
/// Between beats while the ground answers.
const BEAT: SignedDuration = SignedDuration::from_millis(500);
/// Between beats, and between tries of the most urgent letter, while it does not.
const KNOCK: SignedDuration = SignedDuration::from_millis(250);
/// Unanswered for so long, the ground is out of reach.
const SILENCE: SignedDuration = SignedDuration::from_secs(2);
/// Beats and askings whose answers are still taken.
const OPEN_STAMPS: usize = 32;
/// Sendings whose answers still tell the way there and back.
const OPEN_SENDINGS: usize = 8;

/// Who sends, and how it knows the ground.
#[derive(Debug, Clone)]
pub struct DatagramSettings {
    /// We.
    pub origin: Origin,
    /// To sign with.
    pub key: Option<SecretKey>,
    /// The ground's; without one its answers are believed unsigned.
    pub ground: Option<PublicKey>,
    /// Seed of the stamps: another one at each start.
    pub seed: u64,
}

/// What came back, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct DatagramCounters {
    /// Letters sent, each sending counted.
    pub sendings: u64,
    /// Letters that the ground has.
    pub delivered: u64,
    /// Letters that it will not have.
    pub refused: u64,
    /// Answers to another aircraft, to an earlier start, or to nothing.
    pub stray: u64,
    /// Answers without the ground's signature.
    pub forged: u64,
    /// Datagrams that can't be read.
    pub unreadable: u64,
}

/// What the ground said beside receipts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum News {
    /// Operators' actions, a JSON list.
    Actions(Vec<u8>),
    /// The ground has a fire's picture.
    Chip {
        /// Alarm id.
        id: String,
        /// Revision with which it was offered.
        revision: u32,
    },
}

/// Tells alarms over datagrams: what to send when, and what an answer means.
#[derive(Debug)]
pub struct DatagramDelivery {
    settings: DatagramSettings,
    stamps: rand_chacha::ChaCha8Rng,
    letters: BTreeMap<u64, Flight>,
    too_large: BTreeSet<u64>,
    settled: Vec<Settled>,
    chips: Chips,
    pace: Pace,
    round_trip: RoundTrip,
    link: LinkState,
    beat_due: Option<ServiceTime>,
    ask_due: Option<ServiceTime>,
    open: VecDeque<u64>,
    newest_sequence: u64,
    waiting: u32,
    ping: Option<Vec<u8>>,
    actions_known: u64,
    actions_there: u64,
    counters: DatagramCounters,
}

/// `Up` after an answer, `Down` when nothing was answered for [`SILENCE`].
#[derive(Debug, Clone, Copy, PartialEq)]
enum LinkState {
    Down,
    Up {
        unanswered_since: Option<ServiceTime>,
    },
}

#[derive(Debug)]
struct Flight {
    id: String,
    revision: u32,
    urgency: Urgency,
    packed: PackedLetter,
    attempt: u32,
    sendings: VecDeque<(u32, ServiceTime)>,
    due: Option<ServiceTime>,
    copy_due: Option<ServiceTime>,
    refusals: u32,
}

impl DatagramDelivery {
    /// Letters on their way at most.
    pub const WINDOW: usize = 256;
    /// Pictures that wait at most.
    pub const CHIPS: usize = 16;
    /// Name of the link to the ground station over IP, in the outbox.
    pub const NAME: &'static str = "ip";

    /// Nothing to tell yet; whether the ground is there is not known.
    #[must_use]
    pub fn new(settings: DatagramSettings) -> Self {
        Self {
            stamps: rand_chacha::ChaCha8Rng::seed_from_u64(settings.seed),
            settings,
            letters: BTreeMap::new(),
            too_large: BTreeSet::new(),
            settled: Vec::new(),
            chips: Chips::default(),
            pace: Pace::default(),
            round_trip: RoundTrip::default(),
            link: LinkState::Down,
            beat_due: None,
            ask_due: None,
            open: VecDeque::new(),
            newest_sequence: 0,
            waiting: 0,
            ping: None,
            actions_known: 0,
            actions_there: 0,
            counters: DatagramCounters::default(),
        }
    }

    /// Those that fit into no datagram, as far as they were taken in.
    #[must_use]
    pub fn too_large(&self, waiting: &[Letter]) -> Vec<Letter> {
        let large = |letter: &&Letter| self.too_large.contains(&letter.sequence());
        waiting.iter().filter(large).cloned().collect()
    }

    /// Whether the ground answers.
    #[must_use]
    pub fn is_up(&self) -> bool {
        self.link != LinkState::Down
    }

    /// What the outbox says of itself, for the beats.
    pub fn note_outbox(&mut self, newest_sequence: u64, waiting: u32, actions_known: u64) {
        self.newest_sequence = newest_sequence;
        self.waiting = waiting;
        self.actions_known = actions_known;
    }

    /// Where the aircraft is, as JSON; goes with the next beat.
    pub fn note_position(&mut self, json: Vec<u8>) {
        self.ping = Some(json);
    }

    /// Offers a fire's picture; it goes when nothing more urgent does, or not at all.
    pub fn offer_chip(&mut self, id: String, revision: u32, jpeg: Vec<u8>) {
        self.chips.offer(id, revision, jpeg);
    }

    /// It got to the ground another way.
    pub fn forget_chip(&mut self, id: &str, revision: u32) {
        self.chips.forget(id, revision);
    }

    /// What was sent and answered so far.
    #[must_use]
    pub fn counters(&self) -> DatagramCounters {
        self.counters
    }

    /// The way there and back, smoothed; none before the first answer.
    #[must_use]
    pub fn round_trip(&self) -> Option<SignedDuration> {
        self.round_trip.smoothed()
    }

    /// Takes in a datagram that came.
    pub fn take(&mut self, datagram: &[u8], now: ServiceTime) -> Option<News> {
        let Ok((said, signed)) = ToAircraft::read(datagram) else {
            self.counters.unreadable += 1;
            return None;
        };
        if *said.origin() != self.settings.origin {
            self.counters.stray += 1;
            return None;
        }
        if self.settings.ground.is_some_and(|key| !signed.is_by(&key)) {
            self.counters.forged += 1;
            return None;
        }
        self.believe(said, now)
    }

    /// The datagram to send now, if any. Call it until it gives `None`, at least every 10 ms.
    pub fn poll(&mut self, now: ServiceTime) -> Option<Vec<u8>> {
        self.notice_silence(now);
        if !self.pace.is_open(now) {
            return None;
        }
        let datagram = self
            .letter_due(now)
            .or_else(|| self.beat(now))
            .or_else(|| self.ask(now))
            .or_else(|| self.chip(now))?;
        self.pace.spend(datagram.len(), now);
        Some(datagram)
    }

    fn believe(&mut self, said: ToAircraft, now: ServiceTime) -> Option<News> {
        match said {
            ToAircraft::Receipt {
                sequence,
                attempt,
                verdict,
                newest_action,
                ..
            } => {
                let known = self.letters.contains_key(&sequence);
                if known {
                    self.answered(sequence, attempt, verdict, now);
                    self.heard(newest_action, now);
                } else {
                    self.counters.stray += 1;
                }
            }
            ToAircraft::Answer {
                stamp,
                newest_action,
                ..
            } => {
                if self.was_open(stamp) {
                    self.heard(newest_action, now);
                }
            }
            ToAircraft::Actions { stamp, json, .. } => {
                if self.was_open(stamp) {
                    self.heard(0, now);
                    self.ask_due = None;
                    return Some(News::Actions(json));
                }
            }
            ToAircraft::ChipHeld {
                id, revision, held, ..
            } => {
                if self.chips.held(&id, revision, held) {
                    return Some(News::Chip { id, revision });
                }
            }
        }
        None
    }

    fn was_open(&mut self, stamp: u64) -> bool {
        let at = self.open.iter().position(|open| *open == stamp);
        let was = at.and_then(|at| self.open.remove(at)).is_some();
        self.counters.stray += u64::from(!was);
        was
    }

    fn open_stamp(&mut self) -> u64 {
        if self.open.len() == OPEN_STAMPS {
            self.open.pop_front();
        }
        let stamp = self.stamps.next_u64();
        self.open.push_back(stamp);
        stamp
    }

    /// The ground is there: after a silence everything that waits goes at once.
    fn heard(&mut self, newest_action: u64, now: ServiceTime) {
        if self.link == LinkState::Down {
            for flight in self.letters.values_mut() {
                if flight.refusals == 0 {
                    flight.due = flight.due.map(|due| due.min(now));
                }
            }
        }
        self.link = LinkState::Up {
            unanswered_since: None,
        };
        self.actions_there = self.actions_there.max(newest_action);
    }

    fn notice_silence(&mut self, now: ServiceTime) {
        if let LinkState::Up {
            unanswered_since: Some(since),
        } = self.link
            && now - since > SILENCE
        {
            self.link = LinkState::Down;
            self.chips.unreached();
        }
    }

    fn expect_answer(&mut self, now: ServiceTime) {
        if let LinkState::Up { unanswered_since } = &mut self.link {
            unanswered_since.get_or_insert(now);
        }
    }

    fn answered(&mut self, sequence: u64, attempt: u32, verdict: Verdict, now: ServiceTime) {
        let Some(flight) = self.letters.get_mut(&sequence) else {
            return;
        };
        let sent = flight.sendings.iter().find(|(sent, _)| *sent == attempt);
        if let Some((_, sent)) = sent {
            self.round_trip.note(now - *sent);
            self.pace.note(&self.round_trip, now);
        }
        self.round_trip.note_answer(attempt);
        let (id, revision) = (flight.id.clone(), flight.revision);
        match verdict {
            Verdict::Stored => {
                self.letters.remove(&sequence);
                self.counters.delivered += 1;
                self.settled
                    .push(Settled::Delivered(Receipt { id, revision }));
            }
            Verdict::Refused(reason) => {
                flight.wait_alone(now);
                self.counters.refused += 1;
                self.settled.push(Settled::Refused {
                    id,
                    revision,
                    reason,
                });
            }
            Verdict::Later(reason) => {
                flight.wait_alone(now);
                self.settled.push(Settled::Unreachable { reason });
            }
        }
    }

    /// The most urgent letter that is due, and among equals the first that was told.
    fn letter_due(&mut self, now: ServiceTime) -> Option<Vec<u8>> {
        let up = self.is_up();
        let most_urgent = self
            .letters
            .iter()
            .filter(|(_, flight)| up || flight.refusals == 0)
            .min_by_key(|(sequence, flight)| (flight.urgency, **sequence))
            .map(|(sequence, _)| *sequence);
        let interval = if up { self.retry() } else { KNOCK };
        let (sequence, _) = self
            .letters
            .iter()
            .filter(|(sequence, flight)| {
                flight.is_due(now) && (up || Some(**sequence) == most_urgent)
            })
            .min_by_key(|(sequence, flight)| (flight.urgency, flight.attempt > 0, **sequence))?;
        let sequence = *sequence;
        let twice = self.round_trip.loss() > LOSSY;
        let flight = self.letters.get_mut(&sequence)?;
        let datagram = flight.send(now, interval, twice);
        self.counters.sendings += 1;
        self.expect_answer(now);
        Some(datagram)
    }

    fn retry(&self) -> SignedDuration {
        self.round_trip
            .timeout()
            .unwrap_or(RETRY)
            .clamp(RETRY, SLOWEST_RETRY)
    }

    fn beat(&mut self, now: ServiceTime) -> Option<Vec<u8>> {
        if self.beat_due.is_some_and(|due| now < due) {
            return None;
        }
        self.beat_due = Some(now + if self.is_up() { BEAT } else { KNOCK });
        let beat = Beat {
            origin: self.settings.origin.clone(),
            newest: self.newest_sequence,
            waiting: self.waiting,
            actions_known: self.actions_known,
            stamp: self.open_stamp(),
            ping: self.ping.take().unwrap_or_default(),
        };
        self.expect_answer(now);
        Some(ToGround::Beat(beat).datagram(self.settings.key.as_ref()))
    }

    fn ask(&mut self, now: ServiceTime) -> Option<Vec<u8>> {
        let news = self.actions_there > self.actions_known && self.is_up();
        if !news || self.ask_due.is_some_and(|due| now < due) {
            return None;
        }
        self.ask_due = Some(now + self.retry());
        let ask = Ask {
            origin: self.settings.origin.clone(),
            stamp: self.open_stamp(),
            after: self.actions_known,
        };
        Some(ToGround::Ask(ask).datagram(self.settings.key.as_ref()))
    }

    /// Never while a letter waits for its answer, and never so much that the next one would wait.
    fn chip(&mut self, now: ServiceTime) -> Option<Vec<u8>> {
        let busy = self.letters.values().any(|flight| flight.refusals == 0);
        if busy || !self.is_up() {
            return None;
        }
        let part = self.chips.next_part(&self.settings.origin, now)?;
        let datagram = ToGround::Chip(part).datagram(self.settings.key.as_ref());
        if !self.pace.affords(datagram.len()) {
            return None;
        }
        self.chips.spend(datagram.len(), now);
        Some(datagram)
    }

    /// Takes in what waits; what does not wait any more was delivered another way, or replaced.
    fn offer(&mut self, wanted: Vec<&Letter>) {
        let sequences: BTreeSet<u64> = wanted.iter().map(|letter| letter.sequence()).collect();
        self.letters
            .retain(|sequence, _| sequences.contains(sequence));
        self.too_large
            .retain(|sequence| sequences.contains(sequence));
        for letter in wanted {
            let sequence = letter.sequence();
            if self.letters.contains_key(&sequence) || self.too_large.contains(&sequence) {
                continue;
            }
            match PackedLetter::pack(&letter.sealed) {
                Ok(packed) => {
                    self.letters.insert(sequence, Flight::new(letter, packed));
                }
                Err(_) => {
                    self.too_large.insert(sequence);
                }
            }
        }
    }
}

impl AlarmLink for DatagramDelivery {
    fn name(&self) -> &'static str {
        Self::NAME
    }

    fn work(&mut self, waiting: &[Letter], _now: ServiceTime) -> Vec<Settled> {
        let settled = std::mem::take(&mut self.settled);
        let delivered = |letter: &&Letter| {
            settled.iter().any(|settled| {
                matches!(settled, Settled::Delivered(receipt)
                    if receipt.id == letter.id() && receipt.revision >= letter.revision())
            })
        };
        let owed = waiting.iter().filter(|letter| !delivered(letter));
        self.offer(owed.take(Self::WINDOW).collect());
        settled
    }
}

impl Flight {
    fn new(letter: &Letter, packed: PackedLetter) -> Self {
        let properties = &letter.alarm.properties;
        Self {
            id: properties.id.clone(),
            revision: properties.revision,
            urgency: Urgency::of(properties),
            packed,
            attempt: 0,
            sendings: VecDeque::new(),
            due: None,
            copy_due: None,
            refusals: 0,
        }
    }

    fn is_due(&self, now: ServiceTime) -> bool {
        let past = |due: Option<ServiceTime>| due.is_none_or(|due| now >= due);
        past(self.due) || self.copy_due.is_some_and(|due| now >= due)
    }

    fn send(&mut self, now: ServiceTime, interval: SignedDuration, twice: bool) -> Vec<u8> {
        let first = self.attempt == 0;
        let is_copy = self.copy_due.take().is_some() && self.due.is_some_and(|due| now < due);
        self.attempt += 1;
        if self.sendings.len() == OPEN_SENDINGS {
            self.sendings.pop_front();
        }
        self.sendings.push_back((self.attempt, now));
        if !is_copy {
            self.due = Some(now + interval);
        }
        self.copy_due = (first && twice).then(|| now + COPY_AFTER);
        self.packed.datagram(self.attempt)
    }

    fn wait_alone(&mut self, now: ServiceTime) {
        self.refusals += 1;
        self.copy_due = None;
        self.due = Some(now + pause_after(self.refusals));
    }
}

#[cfg(test)]
mod tests;
