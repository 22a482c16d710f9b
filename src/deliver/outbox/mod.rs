//! The durable outbox: an alarm is on disk before it is first sent, and stays until every link
//! delivered it.

mod chips;
mod layout;
mod reserve;
#[cfg(test)]
mod tests;

pub use chips::StoredChip;

use super::envelope::{Envelope, Origin, Sealed};
use super::keys::SecretKey;
use super::link::Letter;
use super::{Urgency, fire_number};
use crate::alarm::{Action, ActionKind, Alarm, Attention, FireId};
use emberfix_frames::ServiceTime;
use reserve::Reserve;
use rusqlite::{
    Connection, ErrorCode, OptionalExtension, Transaction, TransactionBehavior, params,
};
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Why the outbox cannot be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum OutboxError {
    /// The file cannot be opened, or another process holds it.
    #[error("outbox {}: cannot open: {source}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What SQLite said.
        source: rusqlite::Error,
    },
    /// Written by a later emberfix; not touched.
    #[error("outbox {} has layout {found}, this program knows up to {known}", path.display())]
    Newer {
        /// The file.
        path: PathBuf,
        /// Its layout.
        found: i64,
        /// Ours.
        known: i64,
    },
    /// Reading or writing failed.
    #[error("outbox: cannot {doing}: {source}")]
    Storage {
        /// What was tried.
        doing: &'static str,
        /// What SQLite said.
        source: rusqlite::Error,
    },
    /// Undelivered alarms reached the bound.
    #[error("outbox: {waiting} alarms wait for delivery, limit {limit}")]
    Full {
        /// How many wait.
        waiting: u32,
        /// How many may.
        limit: u32,
    },
}

/// What became of an alarm that was put.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Put {
    /// On disk.
    Stored,
    /// The same revision or a newer one was there; nothing changed.
    Superseded,
}

/// Whose alarms they are.
#[derive(Debug, Clone, Default)]
pub struct Owner {
    /// Name of the aircraft.
    pub uav: String,
    /// What its alarms are signed with.
    pub key: Option<SecretKey>,
}

/// Alarms on disk, the newest revision of each, and which link delivered what.
///
/// A newer revision replaces an older one whether or not that was sent: links owe the newest state,
/// not its history. Each stored revision gets the outbox's next sequence number, and says how many
/// numbers its alarm took so far, so that the ground notices what a relay keeps back. Everything is
/// committed and synced before a call returns (write-ahead log, `synchronous = FULL`), so that a
/// kill at any instant loses nothing that was put. One process holds the file at a time.
///
/// **Bound:** [`Outbox::MAX_WAITING`] undelivered alarms; beyond it a new alarm is refused with
/// [`OutboxError::Full`], never an old one dropped. **Loss rule:** of delivered alarms the newest
/// [`Outbox::KEEP_DELIVERED`] stay. **Full disk:** a reserve beside the file is given up for alarms
/// ([`Outbox::is_on_reserve`]); when that is used up, too, a put is refused.
///
/// **Damage.** An alarm whose bytes are not those that were put is set aside, counted and never
/// sent; the others are not affected.
#[derive(Debug)]
pub struct Outbox {
    database: Connection,
    owner: Owner,
    id: u64,
    links: Vec<String>,
    reserve: Reserve,
    /// Letters that were read, by sequence: reading and signing one is done once.
    read: BTreeMap<u64, Letter>,
    attention: BTreeMap<String, Attention>,
    changes: u64,
    unreadable: u64,
}

/// How long a predecessor may take to let go of the file.
const PATIENCE: Duration = Duration::from_millis(500);
/// Bytes of a digest that are kept.
const DIGEST_LEN: usize = 16;

/// Alarms that `?1` has not delivered.
const WAITING_FOR: &str = "
    FROM alarms LEFT JOIN receipts ON receipts.id = alarms.id AND receipts.link = ?1
    WHERE readable AND (receipts.revision IS NULL OR receipts.revision < alarms.revision)
";

impl Outbox {
    /// Undelivered alarms at most.
    pub const MAX_WAITING: u32 = 100_000;
    /// Delivered alarms that are kept.
    pub const KEEP_DELIVERED: u32 = 1_000;

    /// Opens or creates the outbox of these links. A link that is not named any more counts as
    /// having delivered everything.
    ///
    /// # Errors
    /// [`OutboxError::Open`] or [`OutboxError::Newer`].
    pub fn open(path: &Path, links: &[&str], owner: Owner) -> Result<Self, OutboxError> {
        let failed = |source| OutboxError::Open {
            path: path.to_owned(),
            source,
        };
        let mut database = Connection::open(path).map_err(failed)?;
        prepare(&database).map_err(failed)?;
        let found = layout::upgrade(&mut database).map_err(failed)?;
        if found > layout::NEWEST {
            return Err(OutboxError::Newer {
                path: path.to_owned(),
                found,
                known: layout::NEWEST,
            });
        }
        let id = counter(&database, "outbox").map_err(failed)?;
        let attention = attention(&database).map_err(failed)?;
        Ok(Self {
            database,
            owner,
            id: id.cast_unsigned(),
            links: links.iter().map(|link| (*link).to_owned()).collect(),
            reserve: Reserve::beside(path),
            read: BTreeMap::new(),
            attention,
            changes: 0,
            unreadable: 0,
        })
    }

    /// Stores an alarm; it is on disk when this returns.
    ///
    /// # Errors
    /// [`OutboxError::Storage`]: do not send it as if it were stored. [`OutboxError::Full`].
    pub fn put(&mut self, alarm: &Alarm, now: ServiceTime) -> Result<Put, OutboxError> {
        let waiting = self.waiting_for_any()?;
        if waiting >= Self::MAX_WAITING {
            return Err(OutboxError::Full {
                waiting,
                limit: Self::MAX_WAITING,
            });
        }
        let put = self.commit("store an alarm", |t| store(t, alarm, now));
        let put = match put {
            Err(error) if error.is_full_disk() && self.reserve.give_up() => {
                self.commit("store an alarm", |t| store(t, alarm, now))?
            }
            put => put?,
        };
        self.changes += 1;
        Ok(put)
    }

    /// What `link` has to deliver, most urgent first, then in the order in which the fires were
    /// first told. Alarms that cannot be read back are set aside and counted.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn pending(&mut self, link: &str, limit: usize) -> Result<Vec<Letter>, OutboxError> {
        let sequences = self.pending_sequences(link, limit)?;
        let mut letters = Vec::with_capacity(sequences.len());
        for sequence in sequences {
            match self.letter(sequence)? {
                Some(letter) => letters.push(letter),
                None => self.set_aside(sequence)?,
            }
        }
        Ok(letters)
    }

    /// Says that `link` delivered this revision; it is on disk when this returns.
    ///
    /// # Errors
    /// [`OutboxError::Storage`]; the alarm will then be delivered again, which is harmless.
    pub fn acknowledge(&mut self, link: &str, id: &str, revision: u32) -> Result<(), OutboxError> {
        let receipt = super::Receipt {
            id: id.to_owned(),
            revision,
        };
        self.acknowledge_all(link, &[receipt])
    }

    /// Likewise, of many at once: one sync for all.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn acknowledge_all(
        &mut self,
        link: &str,
        receipts: &[super::Receipt],
    ) -> Result<(), OutboxError> {
        let links = self.links.clone();
        self.changes += 1;
        self.commit("store a receipt", |t| {
            for receipt in receipts {
                t.execute(
                    "INSERT INTO receipts SELECT ?1, id, ?3 FROM alarms WHERE id = ?2
                     ON CONFLICT DO UPDATE SET revision = max(revision, excluded.revision)",
                    params![link, receipt.id, receipt.revision],
                )?;
            }
            prune(t, &links)
        })?;
        self.reserve.restore();
        Ok(())
    }

    /// A fire number that was never given out before, on this aircraft, over all restarts. Numbers
    /// of alarms that were put count as given out.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn next_fire_number(&mut self) -> Result<FireId, OutboxError> {
        self.commit("count fires", |t| {
            t.query_row(
                "UPDATE counters SET value = value + 1 WHERE name = 'greatest_fire' RETURNING value",
                [],
                |row| row.get(0).map(FireId),
            )
        })
    }

    /// Keeps an operator's action; false when it was known, or a later one was. On disk when this
    /// returns.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn take_action(&mut self, action: &Action) -> Result<bool, OutboxError> {
        let number = i64::try_from(action.number).unwrap_or(i64::MAX);
        let new = self.commit("store an operator's action", |t| {
            let newer = t.execute(
                "UPDATE counters SET value = ?1 WHERE name = 'newest_action' AND value < ?1",
                [number],
            )?;
            if newer == 1 && action.kind.attention().is_some() {
                t.execute(
                    "INSERT INTO actions (alarm, number, kind) VALUES (?1, ?2, ?3)
                     ON CONFLICT (alarm) DO UPDATE SET number = ?2, kind = ?3",
                    params![action.alarm, number, action.kind.name()],
                )?;
            }
            Ok(newer == 1)
        })?;
        if let (true, Some(attention)) = (new, action.kind.attention()) {
            self.attention.insert(action.alarm.clone(), attention);
            self.read.clear();
        }
        self.changes += u64::from(new);
        Ok(new)
    }

    /// Number of the newest action that was kept.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn newest_action(&self) -> Result<u64, OutboxError> {
        self.counter("newest_action")
    }

    /// Greatest sequence number that was given out.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn newest_sequence(&self) -> Result<u64, OutboxError> {
        self.counter("newest_sequence")
    }

    /// How many alarms `link` has to deliver.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn waiting(&self, link: &str) -> Result<u32, OutboxError> {
        let count = format!("SELECT count(*) {WAITING_FOR}");
        self.database
            .query_row(&count, [link], |row| row.get(0))
            .map_err(|source| OutboxError::Storage {
                doing: "count alarms",
                source,
            })
    }

    /// How much of people's attention an alarm still asks for.
    #[must_use]
    pub fn attention(&self, id: &str) -> Attention {
        self.attention.get(id).copied().unwrap_or_default()
    }

    /// Whose it is, and which outbox of theirs.
    #[must_use]
    pub fn origin(&self) -> Origin {
        Origin {
            uav: self.owner.uav.clone(),
            outbox: self.id,
        }
    }

    /// What its alarms are signed with.
    #[must_use]
    pub fn key(&self) -> Option<&SecretKey> {
        self.owner.key.as_ref()
    }

    /// Rises with everything that changes what waits: a cheap way to see that nothing did.
    #[must_use]
    pub fn changes(&self) -> u64 {
        self.changes
    }

    /// Alarms that could not be read back since the start.
    #[must_use]
    pub fn unreadable(&self) -> u64 {
        self.unreadable
    }

    /// The disk is full, and alarms use what was kept free for them.
    #[must_use]
    pub fn is_on_reserve(&self) -> bool {
        self.reserve.is_given_up()
    }

    fn counter(&self, name: &'static str) -> Result<u64, OutboxError> {
        counter(&self.database, name)
            .map(i64::cast_unsigned)
            .map_err(|source| OutboxError::Storage {
                doing: "read a counter",
                source,
            })
    }

    fn waiting_for_any(&self) -> Result<u32, OutboxError> {
        let counts = self.links.iter().map(|link| self.waiting(link));
        counts
            .collect::<Result<Vec<u32>, _>>()
            .map(|c| c.into_iter().max().unwrap_or(0))
    }

    fn pending_sequences(&self, link: &str, limit: usize) -> Result<Vec<i64>, OutboxError> {
        let select =
            format!("SELECT alarms.sequence {WAITING_FOR} ORDER BY urgency, stored LIMIT ?2");
        let limit = i64::try_from(limit).unwrap_or(i64::MAX);
        let read = || {
            let mut statement = self.database.prepare_cached(&select)?;
            let rows = statement.query_map(params![link, limit], |row| row.get(0))?;
            rows.collect::<rusqlite::Result<_>>()
        };
        read().map_err(|source| OutboxError::Storage {
            doing: "read alarms",
            source,
        })
    }

    /// The letter with this sequence; none when its bytes are not those that were put.
    fn letter(&mut self, sequence: i64) -> Result<Option<Letter>, OutboxError> {
        let number = sequence.cast_unsigned();
        if let Some(letter) = self.read.get(&number) {
            return Ok(Some(letter.clone()));
        }
        let row = self.row(sequence)?;
        let Some(letter) = row.and_then(|row| self.read_row(number, row)) else {
            return Ok(None);
        };
        if self.read.len() >= READ_AT_MOST {
            self.read.clear();
        }
        self.read.insert(number, letter.clone());
        Ok(Some(letter))
    }

    fn row(&self, sequence: i64) -> Result<Option<Row>, OutboxError> {
        let read = || {
            let mut statement = self
                .database
                .prepare_cached("SELECT json, digest, count FROM alarms WHERE sequence = ?1")?;
            statement
                .query_row([sequence], |row| {
                    Ok(Row {
                        // As bytes: a flipped bit may leave no text.
                        json: row.get_ref(0)?.as_bytes().unwrap_or_default().to_vec(),
                        digest: row.get(1)?,
                        count: row.get(2)?,
                    })
                })
                .optional()
        };
        read().map_err(|source| OutboxError::Storage {
            doing: "read an alarm",
            source,
        })
    }

    fn read_row(&self, sequence: u64, row: Row) -> Option<Letter> {
        let whole = row
            .digest
            .is_none_or(|digest| digest == self::digest(&row.json));
        let alarm = whole
            .then(|| Alarm::from_geojson(&row.json).ok())
            .flatten()?;
        let envelope = Envelope {
            origin: self.origin(),
            sequence,
            count: row.count,
            alarm: row.json,
        };
        let signature = self.owner.key.as_ref().map(|key| envelope.sign(key));
        Some(Letter {
            attention: self.attention(&alarm.properties.id),
            alarm: Arc::new(alarm),
            sealed: Arc::new(Sealed {
                envelope,
                signature,
            }),
        })
    }

    fn set_aside(&mut self, sequence: i64) -> Result<(), OutboxError> {
        tracing::error!(
            sequence,
            "AN ALARM IN THE OUTBOX IS DAMAGED and is not sent"
        );
        self.unreadable += 1;
        self.commit("set an alarm aside", |t| {
            t.execute(
                "UPDATE alarms SET readable = 0 WHERE sequence = ?1",
                [sequence],
            )
            .map(|_| ())
        })
    }

    fn commit<T>(
        &mut self,
        doing: &'static str,
        change: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
    ) -> Result<T, OutboxError> {
        let committed = || {
            let behavior = TransactionBehavior::Immediate;
            let transaction = self.database.transaction_with_behavior(behavior)?;
            let value = change(&transaction)?;
            transaction.commit()?;
            Ok(value)
        };
        committed().map_err(|source| OutboxError::Storage { doing, source })
    }
}

/// Letters that are kept read.
const READ_AT_MOST: usize = 1_024;

/// One stored alarm.
struct Row {
    json: Vec<u8>,
    digest: Option<Vec<u8>>,
    count: u32,
}

impl OutboxError {
    /// No room on the disk, as far as SQLite can tell.
    fn is_full_disk(&self) -> bool {
        let Self::Storage { source, .. } = self else {
            return false;
        };
        matches!(
            source.sqlite_error_code(),
            Some(ErrorCode::DiskFull | ErrorCode::SystemIoFailure)
        )
    }
}

fn prepare(database: &Connection) -> rusqlite::Result<()> {
    database.busy_timeout(PATIENCE)?;
    // Exclusive before the first read: two services must not deliver from one outbox.
    database.pragma_update(None, "locking_mode", "EXCLUSIVE")?;
    database.pragma_update(None, "journal_mode", "WAL")?;
    database.pragma_update(None, "synchronous", "FULL")?;
    database.pragma_update(None, "foreign_keys", true)
}

fn counter(database: &Connection, name: &str) -> rusqlite::Result<i64> {
    database.query_row(
        "SELECT value FROM counters WHERE name = ?1",
        [name],
        |row| row.get(0),
    )
}

fn attention(database: &Connection) -> rusqlite::Result<BTreeMap<String, Attention>> {
    let mut statement = database.prepare("SELECT alarm, kind FROM actions")?;
    let rows = statement.query_map([], |row| Ok((row.get(0)?, row.get::<_, String>(1)?)))?;
    let mut attention = BTreeMap::new();
    for row in rows {
        let (alarm, kind) = row?;
        if let Some(wanted) = ActionKind::named(&kind).and_then(ActionKind::attention) {
            attention.insert(alarm, wanted);
        }
    }
    Ok(attention)
}

fn digest(json: &[u8]) -> Vec<u8> {
    Sha256::digest(json)[..DIGEST_LEN].to_vec()
}

fn store(t: &Transaction<'_>, alarm: &Alarm, now: ServiceTime) -> rusqlite::Result<Put> {
    let properties = &alarm.properties;
    let known: Option<u32> = t
        .query_row(
            "SELECT revision FROM alarms WHERE id = ?1",
            [&properties.id],
            |row| row.get(0),
        )
        .optional()?;
    if known.is_some_and(|revision| revision >= properties.revision) {
        return Ok(Put::Superseded);
    }
    let (sequence, count) = next_numbers(t, &properties.id)?;
    let json = alarm.to_geojson().to_string();
    t.prepare_cached(
        "INSERT INTO alarms (id, revision, urgency, json, captured_at_ns, stored_at_ns, sequence,
            count, digest)
         VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9)
         ON CONFLICT (id) DO UPDATE SET revision = excluded.revision, urgency = excluded.urgency,
            json = excluded.json, captured_at_ns = excluded.captured_at_ns,
            stored_at_ns = excluded.stored_at_ns, sequence = excluded.sequence,
            count = excluded.count, digest = excluded.digest, readable = 1",
    )?
    .execute(params![
        properties.id,
        properties.revision,
        Urgency::of(properties).0,
        json,
        properties.captured_at.unix_ns(),
        now.unix_ns(),
        sequence,
        count,
        digest(json.as_bytes()),
    ])?;
    if let Some(FireId(number)) = fire_number(&properties.id) {
        t.execute(
            "UPDATE counters SET value = max(value, ?1) WHERE name = 'greatest_fire'",
            [number],
        )?;
    }
    Ok(Put::Stored)
}

/// The next sequence number, and how many this alarm has then had.
fn next_numbers(t: &Transaction<'_>, id: &str) -> rusqlite::Result<(i64, u32)> {
    let sequence = t.query_row(
        "UPDATE counters SET value = value + 1 WHERE name = 'newest_sequence' RETURNING value",
        [],
        |row| row.get(0),
    )?;
    let count = t.query_row(
        "INSERT INTO told (id, count) VALUES (?1, 1)
         ON CONFLICT (id) DO UPDATE SET count = count + 1 RETURNING count",
        [id],
        |row| row.get(0),
    )?;
    Ok((sequence, count))
}

/// Drops the oldest alarms that every link delivered, and what was done about them.
fn prune(t: &Transaction<'_>, links: &[String]) -> rusqlite::Result<()> {
    let kept: u32 = t.query_row("SELECT count(*) FROM alarms", [], |row| row.get(0))?;
    if kept <= Outbox::KEEP_DELIVERED {
        return Ok(());
    }
    let links = serde_json::json!(links).to_string();
    let dropped = t.execute(
        "DELETE FROM alarms WHERE stored IN (
            SELECT stored FROM alarms WHERE NOT EXISTS (
                SELECT 1 FROM json_each(?1) AS link WHERE NOT EXISTS (
                    SELECT 1 FROM receipts WHERE receipts.link = link.value
                        AND receipts.id = alarms.id AND receipts.revision >= alarms.revision))
            ORDER BY captured_at_ns DESC LIMIT -1 OFFSET ?2)",
        params![links, Outbox::KEEP_DELIVERED],
    )?;
    if dropped > 0 {
        t.execute(
            "DELETE FROM actions WHERE number <= (SELECT max(number) - 10000 FROM actions)",
            [],
        )?;
    }
    Ok(())
}
