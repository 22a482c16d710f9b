//! The receiving end of the wire: whose word counts, what is answered, what is counted.
//!
//! **Keys.** The configuration names a public key per aircraft. From an aircraft with a key only what
//! that key signed is taken. An aircraft without one is taken unsigned, as long as it stands in the
//! configuration, or no aircraft has a key: once one has, strangers are not taken, or anybody could
//! invent an aircraft. An alarm's id and its aircraft must be the signer's own.
//!
//! **Answers** are signed with the station's own key (`station.key` in the data directory, made at
//! the first start), so that nobody on the way can say "stored" for us.
//!
//! **Twice.** What comes again, by accident or on purpose, is acknowledged again and changes nothing.

use super::ledger::{Ledger, LedgerError};
use super::store::{Completeness, Kept, StoreError, ToldAction};
use super::tracks::Source;
use super::{Ping, ReceiveError, Station, now};
use crate::alarm::{Action, Alarm};
use crate::deliver::datagram::wire::{
    Ask, Beat, ChipPart, MAX_DATAGRAM, Signed, ToAircraft, ToGround, Verdict,
};
use crate::deliver::envelope::{EnvelopeError, Origin, Sealed};
use crate::deliver::keys::{KeyError, PublicKey, SIGNATURE_LEN, SecretKey};
use emberfix_frames::ServiceTime;
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// The station's own key, in the data directory.
const KEY_FILE: &str = "station.key";
/// Pictures that are half there, at most; the one begun first gives way.
const HALF_CHIPS: usize = 64;
/// Largest picture.
const LARGEST_CHIP: usize = 32 * 1024;
/// Head of the datagram with actions, generously.
const ACTIONS_HEAD: usize = 5 + SIGNATURE_LEN + 64;

/// Why somebody's word does not count.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TrustError {
    /// No signature, or another key's.
    #[error("{uav} did not sign this: its public key is in the ground configuration")]
    Forged {
        /// Whose it should be.
        uav: String,
    },
    /// Not configured, while others are.
    #[error(
        "{uav} is not in the ground configuration: add [[uav]] name = {uav:?} with its public_key"
    )]
    Stranger {
        /// Who it says it is.
        uav: String,
    },
    /// One aircraft in the name of another.
    #[error("{uav} sent an alarm {id:?} of {alarm_uav:?}")]
    NotTheirs {
        /// Whose it is signed as.
        uav: String,
        /// The alarm's id.
        id: String,
        /// The alarm's aircraft.
        alarm_uav: String,
    },
}

/// Which aircraft there are, and their keys.
#[derive(Debug, Clone, Default)]
pub struct Keyring {
    known: BTreeMap<String, Option<PublicKey>>,
}

impl Keyring {
    /// From the configuration.
    #[must_use]
    pub fn new(known: impl IntoIterator<Item = (String, Option<PublicKey>)>) -> Self {
        Self {
            known: known.into_iter().collect(),
        }
    }

    /// Whether any aircraft has a key.
    #[must_use]
    pub fn has_keys(&self) -> bool {
        self.known.values().any(Option::is_some)
    }

    /// Whether something that says it comes from `uav` does; `signed_by` tries a key.
    ///
    /// # Errors
    /// [`TrustError`].
    pub fn check(
        &self,
        uav: &str,
        signed_by: impl Fn(&PublicKey) -> bool,
    ) -> Result<(), TrustError> {
        let uav = || uav.to_owned();
        match self.known.get(&uav()) {
            Some(Some(key)) if signed_by(key) => Ok(()),
            Some(Some(_)) => Err(TrustError::Forged { uav: uav() }),
            None if self.has_keys() => Err(TrustError::Stranger { uav: uav() }),
            Some(None) | None => Ok(()),
        }
    }

    /// Likewise for an alarm, which must be that aircraft's own.
    fn check_alarm(
        &self,
        uav: &str,
        alarm: &Alarm,
        signed_by: impl Fn(&PublicKey) -> bool,
    ) -> Result<(), TrustError> {
        self.check(uav, signed_by)?;
        let properties = &alarm.properties;
        let number = properties
            .id
            .strip_prefix(uav)
            .and_then(|rest| rest.strip_prefix('-'));
        // While nobody has a key, ids are free, as they always were.
        let own_id = !self.has_keys() || number.is_some_and(|n| n.parse::<u32>().is_ok());
        if properties.uav == uav && own_id {
            return Ok(());
        }
        Err(TrustError::NotTheirs {
            uav: uav.to_owned(),
            id: properties.id.clone(),
            alarm_uav: properties.uav.clone(),
        })
    }
}

/// What came over the wire, counted.
#[derive(Debug, Default)]
struct Counters {
    letters: AtomicU64,
    again: AtomicU64,
    forged: AtomicU64,
    strangers: AtomicU64,
    unreadable: AtomicU64,
    beats: AtomicU64,
    chips: AtomicU64,
    shed: AtomicU64,
}

/// How the wire fares, for `/health`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct WireHealth {
    public_key: String,
    letters: u64,
    again: u64,
    forged: u64,
    strangers: u64,
    unreadable: u64,
    beats: u64,
    chips: u64,
    shed: u64,
    outboxes: Vec<OutboxHealth>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct OutboxHealth {
    uav: String,
    outbox: String,
    newest_sequence: u64,
    missing: u64,
    missing_since: Option<String>,
    waiting: u32,
    actions_known: u64,
    heard_at: Option<String>,
}

/// Everything that the wire's two doors, datagrams and HTTP, share.
#[derive(Debug)]
pub(super) struct Reception {
    keyring: Keyring,
    key: SecretKey,
    ledger: Ledger,
    counters: Counters,
    half_chips: Mutex<VecDeque<HalfChip>>,
    /// By aircraft; one entry per aircraft whose word counts.
    newest_actions: Mutex<BTreeMap<String, u64>>,
}

#[derive(Debug)]
struct HalfChip {
    origin: Origin,
    id: String,
    revision: u32,
    whole: u32,
    bytes: Vec<u8>,
}

/// Why the receiving end can't be opened.
#[derive(Debug, thiserror::Error)]
pub enum ReceptionError {
    /// The station's key.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// The books.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
}

impl Reception {
    pub fn open(data_dir: &Path, keyring: Keyring) -> Result<Self, ReceptionError> {
        Ok(Self {
            keyring,
            key: SecretKey::load_or_make(&data_dir.join(KEY_FILE))?,
            ledger: Ledger::open(data_dir)?,
            counters: Counters::default(),
            half_chips: Mutex::default(),
            newest_actions: Mutex::default(),
        })
    }

    /// What aircraft need to check our answers.
    pub fn public_key(&self) -> PublicKey {
        self.key.public()
    }

    /// Whether an aircraft's word needs no signature of its own; for links that carry none.
    pub fn takes_unsigned(&self, uav: &str) -> Result<(), TrustError> {
        self.keyring.check(uav, |_| false)
    }

    /// An alarm that came over HTTP: with the envelope's header, or bare.
    ///
    /// # Errors
    /// [`ReceiveError`].
    pub async fn http(
        &self,
        station: &Station,
        header: Option<&str>,
        body: &[u8],
        link: &'static str,
    ) -> Result<(Alarm, Kept, Option<String>), ReceiveError> {
        use base64::Engine as _;
        let Some(header) = header else {
            self.check_bare(station, body, link)?;
            let (alarm, kept) = station.receive(body, link, Completeness::Full).await?;
            return Ok((alarm, kept, None));
        };
        let sealed = self.counted(Sealed::from_http(header, body));
        let sealed = sealed.inspect_err(|error| station.refuse(error, link))?;
        let (alarm, kept) = self.keep(station, &sealed, link).await?;
        let receipt = self.receipt(&sealed, 0, Verdict::Stored);
        let receipt = base64::engine::general_purpose::STANDARD.encode(receipt);
        Ok((alarm, kept, Some(receipt)))
    }

    /// Whether an alarm without an envelope may come in; what is no alarm is refused further on.
    fn check_bare(
        &self,
        station: &Station,
        body: &[u8],
        link: &'static str,
    ) -> Result<(), TrustError> {
        let Ok(alarm) = Alarm::from_geojson(body) else {
            return Ok(());
        };
        let uav = &alarm.properties.uav;
        self.counted(self.keyring.check_alarm(uav, &alarm, |_| false))
            .inspect_err(|error| station.refuse(error, link))
    }

    /// What to answer to a datagram; nothing to what is not understood or not believed.
    pub async fn datagram(&self, station: &Arc<Station>, datagram: &[u8]) -> Option<Vec<u8>> {
        let read = ToGround::read(datagram);
        let Ok((said, signed)) = read else {
            self.counters.unreadable.fetch_add(1, Ordering::Relaxed);
            return None;
        };
        match said {
            ToGround::Letter { attempt, sealed } => self.letter(station, attempt, &sealed).await,
            ToGround::Beat(beat) => self.beat(station, &beat, &signed).await,
            ToGround::Ask(ask) => self.ask(station, &ask, &signed).await,
            ToGround::Chip(part) => self.chip(station, part, &signed).await,
        }
    }

    /// Which aircraft a datagram says it comes from; none when it can't be read.
    pub fn speaker(datagram: &[u8]) -> Option<String> {
        let (said, _) = ToGround::read(datagram).ok()?;
        let origin = match said {
            ToGround::Letter { sealed, .. } => sealed.envelope.origin,
            ToGround::Beat(beat) => beat.origin,
            ToGround::Ask(ask) => ask.origin,
            ToGround::Chip(part) => part.origin,
        };
        Some(origin.uav)
    }

    /// Greatest action that an aircraft said it took.
    pub fn actions_known(&self, uav: &str) -> u64 {
        let accounts = self.ledger.accounts();
        let of = accounts.iter().filter(|(origin, _)| origin.uav == uav);
        of.map(|(_, account)| account.actions_known)
            .max()
            .unwrap_or(0)
    }

    /// A datagram was dropped unread: too many were under way.
    pub fn shed(&self) {
        self.counters.shed.fetch_add(1, Ordering::Relaxed);
    }

    pub fn health(&self) -> WireHealth {
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let outbox = |(origin, account): (Origin, super::ledger::Account)| OutboxHealth {
            uav: origin.uav,
            outbox: format!("{:016x}", origin.outbox),
            newest_sequence: account.newest,
            missing: account.missing(),
            missing_since: account.missing_since.map(|at| at.rfc3339()),
            waiting: account.waiting,
            actions_known: account.actions_known,
            heard_at: account.heard.map(|at| at.rfc3339()),
        };
        WireHealth {
            public_key: self.public_key().to_string(),
            letters: count(&self.counters.letters),
            again: count(&self.counters.again),
            forged: count(&self.counters.forged),
            strangers: count(&self.counters.strangers),
            unreadable: count(&self.counters.unreadable),
            beats: count(&self.counters.beats),
            chips: count(&self.counters.chips),
            shed: count(&self.counters.shed),
            outboxes: self.ledger.accounts().into_iter().map(outbox).collect(),
        }
    }

    async fn letter(&self, station: &Station, attempt: u32, sealed: &Sealed) -> Option<Vec<u8>> {
        let verdict = match self.keep(station, sealed, "datagram").await {
            Ok(_) => Verdict::Stored,
            // Who can't prove who he is gets no answer.
            Err(ReceiveError::Trust(_)) => return None,
            Err(ReceiveError::Store(StoreError::Conflict { .. }))
            | Err(ReceiveError::Alarm(_) | ReceiveError::Covariance { .. }) => {
                Verdict::Refused("it is no alarm that this station can keep".to_owned())
            }
            Err(error) => Verdict::Later(error.to_string()),
        };
        Some(self.receipt(sealed, attempt, verdict))
    }

    /// On disk, alarm and books, when this returns.
    async fn keep(
        &self,
        station: &Station,
        sealed: &Sealed,
        link: &'static str,
    ) -> Result<(Alarm, Kept), ReceiveError> {
        let envelope = &sealed.envelope;
        let uav = &envelope.origin.uav;
        let trusted = self.keyring.check(uav, |key| sealed.is_signed_by(key));
        if let Err(error) = self.counted(trusted) {
            station.refuse(&error, link);
            return Err(error.into());
        }
        let alarm = Alarm::from_geojson(&envelope.alarm)?;
        let theirs = self.keyring.check_alarm(uav, &alarm, |_| true);
        if let Err(error) = self.counted(theirs) {
            station.refuse(&error, link);
            return Err(error.into());
        }
        let (alarm, kept) = station
            .receive(&envelope.alarm, link, Completeness::Full)
            .await?;
        self.ledger
            .enter(envelope, &alarm.properties.id, now())
            .await?;
        let counter = match kept {
            Kept::New { .. } => &self.counters.letters,
            Kept::Again => &self.counters.again,
        };
        counter.fetch_add(1, Ordering::Relaxed);
        Ok((alarm, kept))
    }

    /// Greatest action for an aircraft, as far as its last beat made us look.
    fn newest_action(&self, uav: &str) -> u64 {
        let newest = self
            .newest_actions
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        newest.get(uav).copied().unwrap_or(0)
    }

    /// What an aircraft has not heard of yet; it also says what it has.
    async fn look_for_actions(&self, station: &Arc<Station>, beat: &Beat) -> u64 {
        let uav = &beat.origin.uav;
        let known = beat.actions_known;
        if let Ok(number) = i64::try_from(known) {
            station.fetched(uav.clone(), number);
        }
        let news = station.actions_after(uav, known).await;
        let newest = news.last().map_or(known, |action| action.number);
        let mut all = self
            .newest_actions
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        all.insert(uav.clone(), newest);
        newest
    }

    fn receipt(&self, sealed: &Sealed, attempt: u32, verdict: Verdict) -> Vec<u8> {
        let envelope = &sealed.envelope;
        let receipt = ToAircraft::Receipt {
            origin: envelope.origin.clone(),
            sequence: envelope.sequence,
            attempt,
            verdict,
            newest_action: self.newest_action(&envelope.origin.uav),
        };
        receipt.datagram(Some(&self.key))
    }

    async fn beat(&self, station: &Arc<Station>, beat: &Beat, signed: &Signed) -> Option<Vec<u8>> {
        self.believe(&beat.origin, signed)?;
        self.counters.beats.fetch_add(1, Ordering::Relaxed);
        if let Err(error) = self.ledger.note(beat, now()).await {
            tracing::warn!(%error, "a beat was not entered");
        }
        self.follow(station, beat);
        let answer = ToAircraft::Answer {
            origin: beat.origin.clone(),
            stamp: beat.stamp,
            newest_action: self.look_for_actions(station, beat).await,
        };
        Some(answer.datagram(Some(&self.key)))
    }

    fn follow(&self, station: &Station, beat: &Beat) {
        if beat.ping.is_empty() {
            return;
        }
        let ping = Ping::from_json(&beat.ping).ok();
        let Some(ping) = ping.filter(|ping| ping.uav == beat.origin.uav) else {
            self.counters.unreadable.fetch_add(1, Ordering::Relaxed);
            return;
        };
        if let Err(error) = station.moved(ping, Source::Service) {
            tracing::debug!(%error, "a position was refused");
        }
    }

    async fn ask(&self, station: &Station, ask: &Ask, signed: &Signed) -> Option<Vec<u8>> {
        self.believe(&ask.origin, signed)?;
        let actions = station.actions_after(&ask.origin.uav, ask.after).await;
        let answer = ToAircraft::Actions {
            origin: ask.origin.clone(),
            stamp: ask.stamp,
            json: fitting(actions, MAX_DATAGRAM - ACTIONS_HEAD),
        };
        Some(answer.datagram(Some(&self.key)))
    }

    async fn chip(&self, station: &Station, part: ChipPart, signed: &Signed) -> Option<Vec<u8>> {
        self.believe(&part.origin, signed)?;
        let (origin, id, revision) = (part.origin.clone(), part.id.clone(), part.revision);
        let (held, whole) = self.add_chip(part)?;
        if let Some(jpeg) = whole {
            match station.keep_chip(&id, revision, jpeg).await {
                Ok(_) => self.counters.chips.fetch_add(1, Ordering::Relaxed),
                Err(error) => {
                    tracing::warn!(%error, id, "a picture was not kept");
                    return None;
                }
            };
        }
        let answer = ToAircraft::ChipHeld {
            origin,
            id,
            revision,
            held,
        };
        Some(answer.datagram(Some(&self.key)))
    }

    /// How much is there from the start, and the picture when it is whole.
    fn add_chip(&self, part: ChipPart) -> Option<(u32, Option<Vec<u8>>)> {
        let own = part.id.strip_prefix(&part.origin.uav)?.starts_with('-');
        if !own || part.whole == 0 || part.whole as usize > LARGEST_CHIP {
            return None;
        }
        let mut half_chips = self
            .half_chips
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let same = |half: &HalfChip| {
            half.origin == part.origin
                && half.id == part.id
                && half.revision == part.revision
                && half.whole == part.whole
        };
        let at = half_chips.iter().position(same);
        let at = at.unwrap_or_else(|| {
            if half_chips.len() == HALF_CHIPS {
                half_chips.pop_front();
            }
            half_chips.push_back(HalfChip {
                origin: part.origin.clone(),
                id: part.id.clone(),
                revision: part.revision,
                whole: part.whole,
                bytes: Vec::new(),
            });
            half_chips.len() - 1
        });
        let half = half_chips.get_mut(at)?;
        if half.bytes.len() == part.from as usize {
            let room = half.whole as usize - half.bytes.len();
            half.bytes.extend(part.bytes.iter().take(room));
        }
        let held = u32::try_from(half.bytes.len()).ok()?;
        if held < half.whole {
            return Some((held, None));
        }
        let whole = half_chips.remove(at)?;
        Some((held, Some(whole.bytes)))
    }

    /// Nothing when it is not theirs.
    fn believe(&self, origin: &Origin, signed: &Signed) -> Option<()> {
        let theirs = self.keyring.check(&origin.uav, |key| signed.is_by(key));
        self.counted(theirs).ok()
    }

    fn counted<T, E: Refused>(&self, outcome: Result<T, E>) -> Result<T, E> {
        if let Err(error) = &outcome {
            error
                .counter(&self.counters)
                .fetch_add(1, Ordering::Relaxed);
        }
        outcome
    }
}

/// Which counter a refusal belongs to.
trait Refused {
    fn counter<'a>(&self, counters: &'a Counters) -> &'a AtomicU64;
}

impl Refused for TrustError {
    fn counter<'a>(&self, counters: &'a Counters) -> &'a AtomicU64 {
        match self {
            Self::Forged { .. } | Self::NotTheirs { .. } => &counters.forged,
            Self::Stranger { .. } => &counters.strangers,
        }
    }
}

impl Refused for EnvelopeError {
    fn counter<'a>(&self, counters: &'a Counters) -> &'a AtomicU64 {
        &counters.unreadable
    }
}

/// As many actions, oldest first, as fit into so many bytes.
fn fitting(actions: Vec<Action>, room: usize) -> Vec<u8> {
    let mut json = b"[]".to_vec();
    for count in 1..=actions.len() {
        let longer = serde_json::json!(&actions[..count])
            .to_string()
            .into_bytes();
        if longer.len() > room {
            break;
        }
        json = longer;
    }
    json
}

/// Actions that are read at once.
const ACTIONS: u32 = 64;

impl Station {
    /// Operators' actions that concern an aircraft, after a number, oldest first.
    pub(super) async fn actions_after(&self, uav: &str, after: u64) -> Vec<Action> {
        let (asked, after) = (uav.to_owned(), i64::try_from(after).unwrap_or(i64::MAX));
        let told = self
            .with_store(move |store| store.actions_for(&asked, after, ACTIONS))
            .await;
        match told {
            Ok(told) => told.into_iter().filter_map(as_told).collect(),
            Err(error) => {
                tracing::warn!(%error, "operators' actions could not be read");
                Vec::new()
            }
        }
    }
}

/// In the aircraft's words.
fn as_told(told: ToldAction) -> Option<Action> {
    Some(Action {
        number: u64::try_from(told.number).ok()?,
        alarm: told.alarm,
        kind: serde_json::from_value(told.kind.into()).ok()?,
        at: ServiceTime::from_rfc3339(&told.at)?,
        by: told.by,
    })
}
