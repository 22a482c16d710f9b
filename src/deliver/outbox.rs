//! The durable outbox: an alarm is on disk before it is first sent, and stays until every link
//! delivered it.

use super::{Urgency, fire_number};
use crate::alarm::{Alarm, AlarmError, FireId};
use emberfix_frames::ServiceTime;
use rusqlite::{Connection, OptionalExtension, Transaction, TransactionBehavior, params};
use std::path::{Path, PathBuf};
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

/// Alarms on disk, the newest revision of each, and which link delivered what.
///
/// A newer revision replaces an older one whether or not that was sent: links owe the newest state,
/// not its history. Everything is committed and synced before a call returns (write-ahead log,
/// `synchronous = FULL`), so that a kill at any instant loses nothing that was put. One process
/// holds the file at a time.
///
/// **Bound:** [`Outbox::MAX_WAITING`] undelivered alarms; beyond it a new alarm is refused with
/// [`OutboxError::Full`], never an old one dropped. **Loss rule:** of delivered alarms the newest
/// [`Outbox::KEEP_DELIVERED`] stay.
#[derive(Debug)]
pub struct Outbox {
    database: Connection,
    links: Vec<String>,
    unreadable: u64,
}

/// An id, and what stands under it.
type Row = (String, Result<Alarm, AlarmError>);

const LAYOUT: i64 = 1;
/// How long a predecessor may take to let go of the file.
const PATIENCE: Duration = Duration::from_millis(500);

const CREATE: &str = "
    CREATE TABLE counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL) STRICT;
    INSERT INTO counters VALUES ('greatest_fire', 0);
    CREATE TABLE alarms (
        stored INTEGER PRIMARY KEY AUTOINCREMENT,
        id TEXT NOT NULL UNIQUE,
        revision INTEGER NOT NULL,
        urgency INTEGER NOT NULL,
        json TEXT NOT NULL,
        captured_at_ns INTEGER NOT NULL,
        stored_at_ns INTEGER NOT NULL,
        readable INTEGER NOT NULL DEFAULT 1
    ) STRICT;
    CREATE TABLE receipts (
        link TEXT NOT NULL,
        id TEXT NOT NULL REFERENCES alarms(id) ON DELETE CASCADE,
        revision INTEGER NOT NULL,
        PRIMARY KEY (link, id)
    ) STRICT;
";

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
    pub fn open(path: &Path, links: &[&str]) -> Result<Self, OutboxError> {
        let failed = |source| OutboxError::Open {
            path: path.to_owned(),
            source,
        };
        let mut database = Connection::open(path).map_err(failed)?;
        prepare(&database).map_err(failed)?;
        let found = upgrade(&mut database).map_err(failed)?;
        if found > LAYOUT {
            return Err(OutboxError::Newer {
                path: path.to_owned(),
                found,
                known: LAYOUT,
            });
        }
        let links = links.iter().map(|link| (*link).to_owned()).collect();
        Ok(Self {
            database,
            links,
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
        self.commit("store an alarm", |t| store(t, alarm, now))
    }

    /// What `link` has to deliver, most urgent first, then in the order in which the fires were
    /// first told. Alarms that cannot be read back are set aside and counted.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn pending(&mut self, link: &str, limit: usize) -> Result<Vec<Alarm>, OutboxError> {
        let mut alarms = Vec::new();
        for (id, read) in self.read_pending(link, limit)? {
            match read {
                Ok(alarm) => alarms.push(alarm),
                Err(error) => self.set_aside(&id, &error)?,
            }
        }
        Ok(alarms)
    }

    /// Says that `link` delivered this revision; it is on disk when this returns.
    ///
    /// # Errors
    /// [`OutboxError::Storage`]; the alarm will then be delivered again, which is harmless.
    pub fn acknowledge(&mut self, link: &str, id: &str, revision: u32) -> Result<(), OutboxError> {
        let links = self.links.clone();
        self.commit("store a receipt", |t| {
            t.execute(
                "INSERT INTO receipts SELECT ?1, id, ?3 FROM alarms WHERE id = ?2
                 ON CONFLICT DO UPDATE SET revision = max(revision, excluded.revision)",
                params![link, id, revision],
            )?;
            prune(t, &links)
        })
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

    /// Alarms that could not be read back since the start.
    #[must_use]
    pub fn unreadable(&self) -> u64 {
        self.unreadable
    }

    fn waiting_for_any(&self) -> Result<u32, OutboxError> {
        let counts = self.links.iter().map(|link| self.waiting(link));
        counts
            .collect::<Result<Vec<u32>, _>>()
            .map(|c| c.into_iter().max().unwrap_or(0))
    }

    fn read_pending(&self, link: &str, limit: usize) -> Result<Vec<Row>, OutboxError> {
        let select = format!(
            "SELECT alarms.id, alarms.json {WAITING_FOR} ORDER BY urgency, stored LIMIT ?2"
        );
        let limit = i64::try_from(limit).unwrap_or(i64::MAX);
        let read = || {
            let mut statement = self.database.prepare_cached(&select)?;
            let rows = statement.query_map(params![link, limit], |row| {
                let json: String = row.get(1)?;
                Ok((row.get(0)?, Alarm::from_geojson(json.as_bytes())))
            })?;
            rows.collect::<rusqlite::Result<_>>()
        };
        read().map_err(|source| OutboxError::Storage {
            doing: "read alarms",
            source,
        })
    }

    fn set_aside(&mut self, id: &str, error: &AlarmError) -> Result<(), OutboxError> {
        tracing::error!(id, %error, "an alarm in the outbox cannot be read");
        self.unreadable += 1;
        self.commit("set an alarm aside", |t| {
            t.execute("UPDATE alarms SET readable = 0 WHERE id = ?1", [id])
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

fn prepare(database: &Connection) -> rusqlite::Result<()> {
    database.busy_timeout(PATIENCE)?;
    // Exclusive before the first read: two services must not deliver from one outbox.
    database.pragma_update(None, "locking_mode", "EXCLUSIVE")?;
    database.pragma_update(None, "journal_mode", "WAL")?;
    database.pragma_update(None, "synchronous", "FULL")?;
    database.pragma_update(None, "foreign_keys", true)
}

/// Creates the tables in a new file; says which layout an old one has.
fn upgrade(database: &mut Connection) -> rusqlite::Result<i64> {
    let transaction = database.transaction_with_behavior(TransactionBehavior::Exclusive)?;
    let found: i64 = transaction.pragma_query_value(None, "user_version", |row| row.get(0))?;
    if found > 0 {
        return Ok(found);
    }
    transaction.execute_batch(CREATE)?;
    transaction.pragma_update(None, "user_version", LAYOUT)?;
    transaction.commit()?;
    Ok(LAYOUT)
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
    t.execute(
        "INSERT INTO alarms (id, revision, urgency, json, captured_at_ns, stored_at_ns)
         VALUES (?1, ?2, ?3, ?4, ?5, ?6)
         ON CONFLICT (id) DO UPDATE SET revision = excluded.revision, urgency = excluded.urgency,
            json = excluded.json, captured_at_ns = excluded.captured_at_ns,
            stored_at_ns = excluded.stored_at_ns, readable = 1",
        params![
            properties.id,
            properties.revision,
            Urgency::of(properties).0,
            alarm.to_geojson().to_string(),
            properties.captured_at.unix_ns(),
            now.unix_ns(),
        ],
    )?;
    if let Some(FireId(number)) = fire_number(&properties.id) {
        t.execute(
            "UPDATE counters SET value = max(value, ?1) WHERE name = 'greatest_fire'",
            [number],
        )?;
    }
    Ok(Put::Stored)
}

/// Drops the oldest alarms that every link delivered.
fn prune(t: &Transaction<'_>, links: &[String]) -> rusqlite::Result<()> {
    let links = serde_json::json!(links).to_string();
    t.execute(
        "DELETE FROM alarms WHERE stored IN (
            SELECT stored FROM alarms WHERE NOT EXISTS (
                SELECT 1 FROM json_each(?1) AS link WHERE NOT EXISTS (
                    SELECT 1 FROM receipts WHERE receipts.link = link.value
                        AND receipts.id = alarms.id AND receipts.revision >= alarms.revision))
            ORDER BY captured_at_ns DESC LIMIT -1 OFFSET ?2)",
        params![links, Outbox::KEEP_DELIVERED],
    )
    .map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::super::tests_support::alarm;
    use super::*;
    use crate::alarm::FireState;

    const NOW: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);
    const LINKS: [&str; 2] = ["mavlink", "http"];

    struct Place(tempfile::TempDir);

    impl Place {
        fn new() -> Self {
            Self(tempfile::tempdir().unwrap())
        }
        fn path(&self) -> PathBuf {
            self.0.path().join("outbox.sqlite")
        }
        fn open(&self) -> Outbox {
            Outbox::open(&self.path(), &LINKS).unwrap()
        }
    }

    fn ids(outbox: &mut Outbox, link: &str) -> Vec<(String, u32)> {
        let pending = outbox.pending(link, 100).unwrap().into_iter();
        pending
            .map(|alarm| (alarm.properties.id, alarm.properties.revision))
            .collect()
    }

    #[test]
    fn what_was_put_survives_a_restart_as_it_was() {
        let place = Place::new();
        place.open().put(&alarm(1, 1), NOW).unwrap();
        let back = place.open().pending("mavlink", 10).unwrap();
        assert_eq!(back.len(), 1);
        assert_eq!(back[0].properties, alarm(1, 1).properties);
    }

    #[test]
    fn a_receipt_is_per_link_and_survives_a_restart() {
        let place = Place::new();
        let mut outbox = place.open();
        outbox.put(&alarm(1, 1), NOW).unwrap();
        outbox.acknowledge("http", "uav-1-1", 1).unwrap();
        drop(outbox);
        let mut outbox = place.open();
        assert_eq!(ids(&mut outbox, "http"), []);
        assert_eq!(ids(&mut outbox, "mavlink"), [("uav-1-1".to_owned(), 1)]);
    }

    #[test]
    fn a_newer_revision_replaces_and_an_older_one_does_not() {
        let mut outbox = Place::new().open();
        assert_eq!(outbox.put(&alarm(1, 2), NOW).unwrap(), Put::Stored);
        assert_eq!(outbox.put(&alarm(1, 1), NOW).unwrap(), Put::Superseded);
        assert_eq!(outbox.put(&alarm(1, 3), NOW).unwrap(), Put::Stored);
        assert_eq!(ids(&mut outbox, "http"), [("uav-1-1".to_owned(), 3)]);
    }

    #[test]
    fn a_late_receipt_of_an_old_revision_does_not_settle_the_new_one() {
        let mut outbox = Place::new().open();
        outbox.put(&alarm(1, 1), NOW).unwrap();
        outbox.put(&alarm(1, 2), NOW).unwrap();
        outbox.acknowledge("http", "uav-1-1", 1).unwrap();
        assert_eq!(outbox.waiting("http").unwrap(), 1);
        outbox.acknowledge("http", "uav-1-1", 2).unwrap();
        outbox.acknowledge("http", "uav-1-1", 1).unwrap();
        assert_eq!(outbox.waiting("http").unwrap(), 0);
    }

    #[test]
    fn a_burning_fire_goes_before_one_that_is_out() {
        let mut outbox = Place::new().open();
        let mut out = alarm(1, 4);
        out.properties.state = FireState::Out;
        outbox.put(&out, NOW).unwrap();
        outbox.put(&alarm(2, 1), NOW).unwrap();
        outbox.put(&alarm(3, 1), NOW).unwrap();
        let order: Vec<String> = ids(&mut outbox, "http")
            .into_iter()
            .map(|(id, _)| id)
            .collect();
        assert_eq!(order, ["uav-1-2", "uav-1-3", "uav-1-1"]);
    }

    #[test]
    fn fire_numbers_never_come_twice() {
        let place = Place::new();
        assert_eq!(place.open().next_fire_number().unwrap(), FireId(1));
        assert_eq!(place.open().next_fire_number().unwrap(), FireId(2));
        place.open().put(&alarm(9, 1), NOW).unwrap();
        assert_eq!(place.open().next_fire_number().unwrap(), FireId(10));
    }

    #[test]
    fn one_unreadable_alarm_does_not_block_the_others() {
        let mut outbox = Place::new().open();
        outbox.put(&alarm(1, 1), NOW).unwrap();
        outbox.put(&alarm(2, 1), NOW).unwrap();
        outbox
            .database
            .execute("UPDATE alarms SET json = '{' WHERE id = 'uav-1-1'", [])
            .unwrap();
        assert_eq!(ids(&mut outbox, "http"), [("uav-1-2".to_owned(), 1)]);
        assert_eq!(
            (outbox.unreadable(), outbox.waiting("http").unwrap()),
            (1, 1)
        );
    }

    #[test]
    fn an_outbox_of_a_later_program_is_refused_and_left_alone() {
        let place = Place::new();
        place
            .open()
            .database
            .pragma_update(None, "user_version", LAYOUT + 1)
            .unwrap();
        let refused = Outbox::open(&place.path(), &LINKS).unwrap_err();
        assert!(matches!(
            refused,
            OutboxError::Newer {
                found: 2,
                known: 1,
                ..
            }
        ));
    }

    #[test]
    fn two_services_cannot_hold_one_outbox() {
        let place = Place::new();
        let _first = place.open();
        assert!(matches!(
            Outbox::open(&place.path(), &LINKS),
            Err(OutboxError::Open { .. })
        ));
    }

    #[test]
    fn delivered_alarms_are_pruned_and_waiting_ones_are_not() {
        let mut outbox = Place::new().open();
        let delivered = Outbox::KEEP_DELIVERED + 5;
        outbox
            .database
            .pragma_update(None, "synchronous", "OFF")
            .unwrap();
        outbox.put(&alarm(1, 1), NOW).unwrap();
        for number in 2..2 + delivered {
            let mut later = alarm(number, 1);
            later.properties.captured_at =
                later.properties.captured_at + emberfix_frames::seconds(f64::from(number));
            outbox.put(&later, NOW).unwrap();
            for link in LINKS {
                outbox
                    .acknowledge(link, &format!("uav-1-{number}"), 1)
                    .unwrap();
            }
        }
        let count = |sql| {
            outbox
                .database
                .query_row(sql, [], |row| row.get::<_, u32>(0))
                .unwrap()
        };
        assert_eq!(
            count("SELECT count(*) FROM alarms"),
            Outbox::KEEP_DELIVERED + 1
        );
        assert_eq!(count("SELECT count(*) FROM alarms WHERE id = 'uav-1-1'"), 1);
        assert_eq!(
            count("SELECT count(*) FROM receipts"),
            2 * Outbox::KEEP_DELIVERED
        );
    }

    /// The environment variable makes this very test binary the process that is killed.
    #[test]
    fn a_kill_right_after_put_loses_nothing() {
        const VICTIM: &str = "EMBERFIX_TEST_OUTBOX_VICTIM";
        if let Some(path) = std::env::var_os(VICTIM) {
            let mut outbox = Outbox::open(Path::new(&path), &LINKS).unwrap();
            outbox.put(&alarm(1, 1), NOW).unwrap();
            std::process::abort();
        }
        let place = Place::new();
        let name = "deliver::outbox::tests::a_kill_right_after_put_loses_nothing";
        let status = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", name])
            .env(VICTIM, place.path())
            .output()
            .unwrap()
            .status;
        assert!(!status.success());
        assert_eq!(
            ids(&mut place.open(), "mavlink"),
            [("uav-1-1".to_owned(), 1)]
        );
    }
}
