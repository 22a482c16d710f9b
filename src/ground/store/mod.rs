//! What the ground knows, on disk: every alarm revision as it came, every incident as it stands,
//! every operator's action. One trait, `Store`; [`sqlite`] is built in, [`postgres`] takes its place
//! by one line of the configuration. Both pass the same tests.
//!
//! When `Store::commit` returns, its batch survives a power cut (as far as disk and server keep
//! their promises), or nothing of it was kept.

pub mod postgres;
#[cfg(test)]
mod server;
pub mod sqlite;
#[cfg(test)]
pub(crate) mod tests;
mod tls;

use super::action::Action;
use crate::alarm::Alarm;
use emberfix_frames::ServiceTime;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Written to the database; a newer one is refused, not guessed at.
pub(super) const SCHEMA_VERSION: i64 = 3;

/// Why the store did not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The data directory or the database can't be opened.
    #[error("alarm store {path}: {source}", path = path.display())]
    Folder {
        /// The data directory.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The database is of a newer program.
    #[error("alarm store {place} has schema {found}, this program knows up to {SCHEMA_VERSION}")]
    Schema {
        /// The database.
        place: String,
        /// Version in it.
        found: i64,
    },
    /// SQLite failed; nothing was kept.
    #[error("alarm store: {source}")]
    Sql {
        /// What it said.
        #[from]
        source: rusqlite::Error,
    },
    /// PostgreSQL failed; nothing was kept.
    #[error("alarm store: {}", in_words(source))]
    Postgres {
        /// What it said.
        #[from]
        source: ::postgres::Error,
    },
    /// TLS to it can't be had.
    #[error("alarm store: {0}")]
    Tls(#[from] tls::TlsError),
    /// What it confirms would not survive a power cut.
    #[error("alarm store: {what}: what it confirms would not survive a power cut")]
    Unsynced {
        /// Which setting.
        what: &'static str,
    },
    /// The batch that this was part of was not kept.
    #[error("alarm store: not kept: {reason}")]
    Batch {
        /// What the database said.
        reason: String,
    },
    /// What is on disk can't be read back.
    #[error("alarm store: {what} {id} is damaged: {reason}")]
    Damaged {
        /// Kind of record.
        what: &'static str,
        /// Which one.
        id: String,
        /// What is wrong with it.
        reason: String,
    },
    /// Another alarm is known under this id and revision. Acknowledging would lose this one.
    #[error(
        "alarm {id} revision {revision} was captured at {captured_at}, but {known_captured_at} is on \
         record under the same id and revision; the aircraft's numbering has restarted: give the \
         aircraft another name, or the ground another data directory"
    )]
    Conflict {
        /// Alarm id.
        id: String,
        /// Revision.
        revision: u32,
        /// Capture time of what came.
        captured_at: ServiceTime,
        /// Capture time of what is on record.
        known_captured_at: ServiceTime,
    },
    /// More came than the disk takes.
    #[error("alarm store: {waiting} deliveries wait already; try again")]
    Busy {
        /// Length of the queue.
        waiting: usize,
    },
    /// The process is stopping.
    #[error("alarm store: the ground station is stopping")]
    Stopped,
}

fn in_words(error: &::postgres::Error) -> String {
    if let Some(said) = error.as_db_error() {
        return said.message().to_owned();
    }
    match std::error::Error::source(error) {
        Some(cause) => format!("{error}: {cause}"),
        None => error.to_string(),
    }
}

/// How much of an alarm a link carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Completeness {
    /// All of it.
    Full,
    /// Part of it; the rest was filled in by the receiver.
    Summary,
}

impl Completeness {
    fn of(summary: bool) -> Self {
        if summary { Self::Summary } else { Self::Full }
    }
}

/// One alarm as it came.
#[derive(Debug, Clone)]
pub struct Delivery {
    /// What it says.
    pub alarm: Alarm,
    /// Its GeoJSON, untouched.
    pub raw: String,
    /// By the ground's clock.
    pub received_at: ServiceTime,
    /// Name of the link.
    pub link: &'static str,
    /// How much of the alarm the link carries.
    pub completeness: Completeness,
}

impl Delivery {
    pub(super) fn rank(&self) -> Rank {
        Rank {
            revision: self.alarm.properties.revision,
            full: self.completeness == Completeness::Full,
        }
    }
}

/// What became of a delivery; either way it is on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// Written.
    New {
        /// Its row.
        row: i64,
        /// Whether it is now the alarm (and not history from the start).
        tells: bool,
    },
    /// It was known already.
    Again,
}

/// How one revision stands to another of the same id: higher wins, then the fuller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Rank {
    pub revision: u32,
    pub full: bool,
}

/// One stored alarm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Row {
    /// Its number, rising with time of receipt.
    pub row: i64,
    /// GeoJSON Feature on one line.
    pub feature: String,
}

/// What is in the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Census {
    /// Incidents that stand.
    pub incidents: i64,
    /// Alarm revisions.
    pub alarms: i64,
}

/// The newest revision of one alarm, and where it belongs.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Latest {
    pub id: String,
    pub row: i64,
    pub rank: Rank,
    pub first_row: i64,
    pub revisions: u64,
    /// Absent in a database of an older program until it was merged.
    pub incident: Option<String>,
    /// The feature; read, never written with it (it stands in the journal).
    pub feature: String,
}

/// An incident as screens ask for it by area and time.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Standing {
    pub id: String,
    pub row: i64,
    /// The incident that has its alarms now.
    pub into: Option<String>,
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    pub first_seen_at: ServiceTime,
    pub captured_at: ServiceTime,
    pub feature: String,
}

/// A line of an incident's history.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HistoryRow {
    /// Row of the journal.
    pub row: i64,
    /// By the ground's clock, RFC 3339.
    pub received_at: String,
    /// Link that it came by.
    pub link: String,
    /// GeoJSON Feature on one line.
    pub feature: String,
}

/// Which incidents somebody wants. Bounds are inclusive; nothing said is all.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Search {
    /// West, south, east, north, degrees; west beyond east crosses the antimeridian.
    pub bbox: Option<[f64; 4]>,
    /// Still seen at or after.
    pub since: Option<ServiceTime>,
    /// First seen at or before.
    pub until: Option<ServiceTime>,
}

/// An action as an aircraft learns of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ToldAction {
    /// The action's number.
    pub number: i64,
    /// The aircraft's alarm that is meant.
    pub alarm: String,
    /// Kind, as written.
    pub kind: String,
    /// RFC 3339.
    pub at: String,
    /// Who.
    pub by: String,
}

/// An alarm for the bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct BusRow {
    pub row: i64,
    pub id: String,
    pub revision: u32,
    pub completeness: Completeness,
    pub uav: String,
    pub feature: String,
}

/// Up to where this station has told the bus.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct BusCursor {
    /// Row of the journal.
    pub row: i64,
    /// The greatest sequence number that the bus has confirmed to us.
    pub sequence: u64,
    /// Id of the message that has this number.
    pub message: String,
    /// The bus's name of the stream and when it was made.
    pub stream: String,
}

/// What is written at once, or not at all.
#[derive(Debug, Default)]
pub(super) struct Batch {
    pub alarms: Vec<NewAlarm>,
    pub latest: BTreeMap<String, Latest>,
    pub incidents: BTreeMap<String, Standing>,
    pub actions: Vec<NewAction>,
    pub undone: Vec<i64>,
    pub fetched: BTreeMap<String, (i64, ServiceTime)>,
    pub bus: Option<BusCursor>,
}

/// One line of the journal.
#[derive(Debug)]
pub(super) struct NewAlarm {
    pub row: i64,
    pub delivery: Delivery,
    pub tells: bool,
}

/// An action and the aircraft that should learn of it.
#[derive(Debug, Clone)]
pub(super) struct NewAction {
    pub action: Action,
    /// Alarm and aircraft.
    pub tell: Vec<(String, String)>,
}

impl Batch {
    pub fn is_empty(&self) -> bool {
        self.alarms.is_empty()
            && self.latest.is_empty()
            && self.incidents.is_empty()
            && self.actions.is_empty()
            && self.fetched.is_empty()
            && self.bus.is_none()
    }
}

/// What the book is made from at the start.
#[derive(Debug, Default)]
pub(super) struct Loaded {
    /// The alarms of the incidents that changed last, each incident whole.
    pub latest: Vec<Latest>,
    /// Whether there are more.
    pub more: bool,
    /// Rows of incidents.
    pub rows: BTreeMap<String, i64>,
    /// Incidents that went into others, with row.
    pub gone: Vec<(String, i64, String)>,
    /// In order.
    pub actions: Vec<Action>,
    pub fetched: BTreeMap<String, i64>,
}

/// Keeps the journal and what follows from it. Calls block.
pub(super) trait Store: Send + Sync + std::fmt::Debug {
    /// Random name of this store: tells a client when it talks to another one.
    fn id(&self) -> &str;
    /// Everything that the book needs of at most `limit` incidents.
    fn load(&self, limit: u32) -> Result<Loaded, StoreError>;
    /// Writes all of it, synced, or nothing.
    fn commit(&self, batch: &Batch) -> Result<(), StoreError>;
    /// What is on record of one revision: each feature, and whether it is the whole alarm.
    fn revision(&self, id: &str, revision: u32) -> Result<Vec<(String, bool)>, StoreError>;
    /// All alarms of the incident that has this alarm, for a book that has forgotten them.
    fn recall(&self, id: &str) -> Result<Vec<Latest>, StoreError>;
    /// Newest revisions of all alarms whose row is after `after`, oldest first.
    fn latest_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError>;
    /// All alarms after row `after` that told something new when they came, oldest first.
    fn told_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError>;
    /// The journal of these alarms, newest first.
    fn history(&self, alarms: &[String], limit: u32) -> Result<Vec<HistoryRow>, StoreError>;
    /// An incident as it was last written, or the id of the one it went into.
    fn incident(&self, id: &str) -> Result<Option<Standing>, StoreError>;
    /// Incidents in an area and a time, newest change first.
    fn search(&self, search: &Search, limit: u32) -> Result<Vec<String>, StoreError>;
    /// What an aircraft has to learn after a number, oldest first.
    fn actions_for(&self, uav: &str, after: i64, limit: u32)
    -> Result<Vec<ToldAction>, StoreError>;
    /// The action that a client has sent under this key.
    fn action_by_key(&self, key: &str) -> Result<Option<Action>, StoreError>;
    /// All actions that name one of these alarms, oldest first.
    fn actions_on(&self, alarms: &[String]) -> Result<Vec<Action>, StoreError>;
    /// The newest row of all; 0 when there is none.
    fn newest_row(&self) -> Result<i64, StoreError>;
    /// Number of the last action; 0 when there is none.
    fn newest_action(&self) -> Result<i64, StoreError>;
    /// Counts what there is.
    fn census(&self) -> Result<Census, StoreError>;
    /// Alarms after a row that did not come from the bus, oldest first.
    fn bus_after(&self, after: i64, limit: u32) -> Result<Vec<BusRow>, StoreError>;
    /// Where the bus is.
    fn bus_cursor(&self) -> Result<BusCursor, StoreError>;
}

/// Inside JSON, line ends are only ever white space; an event stream must not carry them raw.
pub(super) fn on_one_line(text: String) -> String {
    if text.contains(['\r', '\n']) {
        text.replace(['\r', '\n'], " ")
    } else {
        text
    }
}

/// A list of ids as the databases keep it.
pub(super) fn list(ids: &[String]) -> String {
    serde_json::json!(ids).to_string()
}

/// The same read back; what is damaged is empty.
pub(super) fn unlist(text: &str) -> Vec<String> {
    serde_json::from_str(text).unwrap_or_default()
}
