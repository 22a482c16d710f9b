//! What the ground knows, on disk: every alarm revision as it came, and one incident per alarm id.
//!
//! SQLite in WAL mode with `synchronous = FULL`: when [`Store::keep`] returns, the alarm survives a
//! power cut (as far as the disk itself keeps its promises).

use super::{database_in, lock};
use crate::alarm::Alarm;
use emberfix_frames::ServiceTime;
use rusqlite::{
    Connection, OpenFlags, OptionalExtension, Transaction, TransactionBehavior, params,
};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Duration;

/// Written to the database; a newer one is refused, not guessed at.
const SCHEMA_VERSION: i64 = 1;

const SCHEMA: &str = "
CREATE TABLE alarms (
    row         INTEGER PRIMARY KEY AUTOINCREMENT, -- never reused: the id of the event stream
    id          TEXT NOT NULL,
    revision    INTEGER NOT NULL,
    summary     INTEGER NOT NULL, -- 1: from a link that carries only part of an alarm
    uav         TEXT NOT NULL,
    captured_at TEXT NOT NULL,
    received_at TEXT NOT NULL,
    link        TEXT NOT NULL,
    tells       INTEGER NOT NULL, -- 1: it became the incident when it came
    feature     TEXT NOT NULL,    -- the GeoJSON as it came
    UNIQUE (id, revision, summary)
) STRICT;
CREATE TABLE incidents (
    id       TEXT PRIMARY KEY,
    row      INTEGER NOT NULL UNIQUE REFERENCES alarms(row),
    revision INTEGER NOT NULL,
    summary  INTEGER NOT NULL
) STRICT;
CREATE TABLE station (store_id TEXT NOT NULL) STRICT;
";

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
    #[error("alarm store {path} has schema {found}, this program knows up to {known}", path = path.display())]
    Schema {
        /// The database.
        path: PathBuf,
        /// Version in the file.
        found: i64,
        /// Newest version that we read.
        known: i64,
    },
    /// SQLite failed; nothing was kept.
    #[error("alarm store: {source}")]
    Sql {
        /// What it said.
        #[from]
        source: rusqlite::Error,
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
    /// The process is stopping.
    #[error("alarm store: the ground station is stopping")]
    Stopped,
}

/// How much of an alarm a link carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Completeness {
    /// All of it.
    Full,
    /// Part of it; the rest was filled in by the receiver.
    Summary,
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

/// What became of a delivery; either way it is on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// Written.
    New {
        /// Its row.
        row: i64,
        /// Whether it is now the incident (and not history from the start).
        tells: bool,
    },
    /// It was known already.
    Again,
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
    /// Incidents.
    pub incidents: i64,
    /// Alarm revisions.
    pub alarms: i64,
}

/// The database: one connection that writes, one that reads beside it.
#[derive(Debug)]
pub struct Store {
    writer: Mutex<Connection>,
    reader: Mutex<Connection>,
    id: String,
}

impl Store {
    /// Opens or creates the store in `data_dir`.
    ///
    /// # Errors
    /// [`StoreError`] naming the path.
    pub fn open(data_dir: &Path) -> Result<Self, StoreError> {
        std::fs::create_dir_all(data_dir).map_err(|source| StoreError::Folder {
            path: data_dir.to_owned(),
            source,
        })?;
        let path = database_in(data_dir);
        let mut writer = Connection::open(&path)?;
        writer.pragma_update(None, "journal_mode", "WAL")?;
        writer.pragma_update(None, "synchronous", "FULL")?;
        writer.busy_timeout(Duration::from_secs(5))?;
        migrate(&mut writer, &path)?;
        let id = writer.query_row("SELECT store_id FROM station", [], |row| row.get(0))?;
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let reader = Connection::open_with_flags(&path, flags)?;
        reader.busy_timeout(Duration::from_secs(5))?;
        Ok(Self {
            writer: Mutex::new(writer),
            reader: Mutex::new(reader),
            id,
        })
    }

    /// Random name of this store: tells a client when it talks to another one.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Keeps a delivery. On `Ok` it is on disk; [`Kept::Again`] when it already was.
    ///
    /// # Errors
    /// [`StoreError`]; nothing was kept then.
    pub fn keep(&self, delivery: &Delivery) -> Result<Kept, StoreError> {
        let mut writer = lock(&self.writer);
        let transaction = writer.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let kept = keep_in(&transaction, delivery)?;
        transaction.commit()?;
        Ok(kept)
    }

    /// Newest revisions of all incidents whose row is after `after`, oldest first.
    ///
    /// # Errors
    /// [`StoreError::Sql`].
    pub fn incidents_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError> {
        self.rows(
            "SELECT row, feature FROM incidents JOIN alarms USING (row) WHERE row > ?1
             ORDER BY row LIMIT ?2",
            after,
            limit,
        )
    }

    /// All alarms after row `after` that changed an incident when they came, oldest first.
    ///
    /// # Errors
    /// [`StoreError::Sql`].
    pub fn told_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError> {
        self.rows(
            "SELECT row, feature FROM alarms WHERE row > ?1 AND tells ORDER BY row LIMIT ?2",
            after,
            limit,
        )
    }

    fn rows(&self, query: &str, after: i64, limit: u32) -> Result<Vec<Row>, StoreError> {
        let reader = lock(&self.reader);
        let mut statement = reader.prepare_cached(query)?;
        let rows = statement.query_map(params![after, limit], |row| {
            Ok(Row {
                row: row.get(0)?,
                feature: on_one_line(row.get(1)?),
            })
        })?;
        Ok(rows.collect::<Result<_, _>>()?)
    }

    /// The newest row of all; 0 when there is none.
    ///
    /// # Errors
    /// [`StoreError::Sql`].
    pub fn newest_row(&self) -> Result<i64, StoreError> {
        let query = "SELECT coalesce(max(row), 0) FROM alarms";
        Ok(lock(&self.reader).query_row(query, [], |row| row.get(0))?)
    }

    /// Counts what there is.
    ///
    /// # Errors
    /// [`StoreError::Sql`].
    pub fn census(&self) -> Result<Census, StoreError> {
        let query = "SELECT (SELECT count(*) FROM incidents), (SELECT count(*) FROM alarms)";
        let count = |row: &rusqlite::Row<'_>| {
            Ok(Census {
                incidents: row.get(0)?,
                alarms: row.get(1)?,
            })
        };
        Ok(lock(&self.reader).query_row(query, [], count)?)
    }
}

fn migrate(writer: &mut Connection, path: &Path) -> Result<(), StoreError> {
    let transaction = writer.transaction_with_behavior(TransactionBehavior::Immediate)?;
    let found: i64 = transaction.query_row("PRAGMA user_version", [], |row| row.get(0))?;
    if found > SCHEMA_VERSION {
        return Err(StoreError::Schema {
            path: path.to_owned(),
            found,
            known: SCHEMA_VERSION,
        });
    }
    if found == 0 {
        transaction.execute_batch(SCHEMA)?;
        let id = uuid::Uuid::new_v4().to_string();
        transaction.execute("INSERT INTO station VALUES (?1)", [id])?;
        transaction.pragma_update(None, "user_version", SCHEMA_VERSION)?;
    }
    Ok(transaction.commit()?)
}

/// How one revision stands to another of the same id: higher wins, then the fuller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Rank {
    revision: u32,
    full: bool,
}

fn keep_in(transaction: &Transaction<'_>, delivery: &Delivery) -> Result<Kept, StoreError> {
    let properties = &delivery.alarm.properties;
    let rank = Rank {
        revision: properties.revision,
        full: delivery.completeness == Completeness::Full,
    };
    if is_known(transaction, delivery, rank)? {
        return Ok(Kept::Again);
    }
    let current = incident_rank(transaction, &properties.id)?;
    let tells = current.is_none_or(|current| rank > current);
    transaction.execute(
        "INSERT INTO alarms (id, revision, summary, uav, captured_at, received_at, link, tells,
         feature) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9)",
        params![
            properties.id,
            rank.revision,
            !rank.full,
            properties.uav,
            properties.captured_at.rfc3339(),
            delivery.received_at.rfc3339(),
            delivery.link,
            tells,
            delivery.raw,
        ],
    )?;
    let row = transaction.last_insert_rowid();
    if tells {
        transaction.execute(
            "INSERT INTO incidents (id, row, revision, summary) VALUES (?1, ?2, ?3, ?4)
             ON CONFLICT (id) DO UPDATE SET row = ?2, revision = ?3, summary = ?4",
            params![properties.id, row, rank.revision, !rank.full],
        )?;
    }
    Ok(Kept::New { row, tells })
}

fn incident_rank(transaction: &Transaction<'_>, id: &str) -> Result<Option<Rank>, StoreError> {
    let query = "SELECT revision, summary FROM incidents WHERE id = ?1";
    let rank = |row: &rusqlite::Row<'_>| {
        Ok(Rank {
            revision: row.get(0)?,
            full: !row.get::<_, bool>(1)?,
        })
    };
    Ok(transaction.query_row(query, [id], rank).optional()?)
}

/// Whether this revision is on record: as it is, or, for a summary, in full.
fn is_known(
    transaction: &Transaction<'_>,
    delivery: &Delivery,
    rank: Rank,
) -> Result<bool, StoreError> {
    let properties = &delivery.alarm.properties;
    let query =
        "SELECT feature, summary FROM alarms WHERE id = ?1 AND revision = ?2 AND summary <= ?3
                 ORDER BY summary LIMIT 1";
    let known: Option<(String, bool)> = transaction
        .query_row(
            query,
            params![properties.id, rank.revision, !rank.full],
            |row| Ok((row.get(0)?, row.get(1)?)),
        )
        .optional()?;
    let Some((feature, summary)) = known else {
        return Ok(false);
    };
    let Ok(known) = Alarm::from_geojson(feature.as_bytes()) else {
        return Ok(true);
    };
    if !rank.full && !summary || same_alarm(&known, &delivery.alarm, rank.full) {
        return Ok(true);
    }
    Err(StoreError::Conflict {
        id: properties.id.clone(),
        revision: rank.revision,
        captured_at: properties.captured_at,
        known_captured_at: known.properties.captured_at,
    })
}

/// Whether two deliveries of one id and revision are one alarm. A summary has no capture time of
/// its own; its position is repeated to the last bit.
fn same_alarm(known: &Alarm, new: &Alarm, full: bool) -> bool {
    if full {
        known.properties.captured_at == new.properties.captured_at
    } else {
        known.place == new.place
    }
}

/// Inside JSON, line ends are only ever white space; an event stream must not carry them raw.
fn on_one_line(text: String) -> String {
    if text.contains(['\r', '\n']) {
        text.replace(['\r', '\n'], " ")
    } else {
        text
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub fn feature(id: &str, revision: u32, captured_at: &str) -> String {
        format!(
            r#"{{"type":"Feature","geometry":{{"type":"Point","coordinates":[119.112017,31.409422,18.5]}},
            "properties":{{"id":"{id}","revision":{revision},"uav":"gaochun","class":"fire",
            "state":"confirmed","confidence":0.93,"first_seen_at":"2026-03-01T12:00:00Z",
            "captured_at":"{captured_at}","altitude_msl_m":10.1,"height_above_ground_m":null,
            "ce90_m":2.6,"le90_m":2.1,"covariance_enu_m2":[1.6,0.3,0,0.3,1.3,0,0,0,1.6],
            "methods":["stereo"],"sightings":5,"range_m":22.4,"size_m":null,"trend":null,
            "degraded":[]}}}}"#
        )
    }

    fn delivery(revision: u32, completeness: Completeness) -> Delivery {
        delivery_at(
            revision,
            completeness,
            &format!("2026-03-01T12:00:{revision:02}Z"),
        )
    }

    fn delivery_at(revision: u32, completeness: Completeness, captured_at: &str) -> Delivery {
        let raw = feature("gaochun-1", revision, captured_at);
        Delivery {
            alarm: Alarm::from_geojson(raw.as_bytes()).unwrap(),
            raw,
            received_at: ServiceTime::from_unix_ns(0),
            link: "test",
            completeness,
        }
    }

    fn shown(store: &Store) -> Vec<u32> {
        let revision = |row: Row| {
            Alarm::from_geojson(row.feature.as_bytes())
                .unwrap()
                .properties
                .revision
        };
        store
            .incidents_after(0, 10)
            .unwrap()
            .into_iter()
            .map(revision)
            .collect()
    }

    #[test]
    fn a_repeated_delivery_is_acknowledged_and_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let first = store.keep(&delivery(1, Completeness::Full)).unwrap();
        assert_eq!(
            first,
            Kept::New {
                row: 1,
                tells: true
            }
        );
        assert_eq!(
            store.keep(&delivery(1, Completeness::Full)).unwrap(),
            Kept::Again
        );
        assert_eq!(
            store.census().unwrap(),
            Census {
                incidents: 1,
                alarms: 1
            }
        );
    }

    #[test]
    fn an_older_revision_is_kept_as_history_and_never_shown() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        store.keep(&delivery(3, Completeness::Full)).unwrap();
        let late = store.keep(&delivery(2, Completeness::Full)).unwrap();
        assert_eq!(
            late,
            Kept::New {
                row: 2,
                tells: false
            }
        );
        assert_eq!(shown(&store), [3]);
        assert_eq!(store.told_after(0, 10).unwrap().len(), 1);
        assert_eq!(store.census().unwrap().alarms, 2);
    }

    #[test]
    fn a_summary_never_replaces_the_whole_alarm_but_a_newer_one_shows() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        store.keep(&delivery(1, Completeness::Summary)).unwrap();
        let fuller = store.keep(&delivery(1, Completeness::Full)).unwrap();
        assert_eq!(
            fuller,
            Kept::New {
                row: 2,
                tells: true
            }
        );
        assert_eq!(
            store.keep(&delivery(1, Completeness::Summary)).unwrap(),
            Kept::Again
        );
        assert_eq!(store.incidents_after(0, 10).unwrap()[0].row, 2);
        store.keep(&delivery(2, Completeness::Summary)).unwrap();
        assert_eq!(shown(&store), [2]);
    }

    #[test]
    fn an_aircraft_that_restarts_its_numbering_is_refused_not_swallowed() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        store.keep(&delivery(1, Completeness::Full)).unwrap();
        let another = delivery_at(1, Completeness::Full, "2026-03-02T08:00:00Z");
        let refused = store.keep(&another).unwrap_err();
        assert!(
            matches!(refused, StoreError::Conflict { revision: 1, .. }),
            "{refused}"
        );
        assert!(refused.to_string().contains("another name"));
    }

    #[test]
    fn a_restart_keeps_incidents_and_goes_on_counting_rows() {
        let folder = tempfile::tempdir().unwrap();
        let id = {
            let store = Store::open(folder.path()).unwrap();
            store.keep(&delivery(1, Completeness::Full)).unwrap();
            store.id().to_owned()
        };
        let store = Store::open(folder.path()).unwrap();
        assert_eq!((shown(&store), store.id()), (vec![1], id.as_str()));
        let next = store.keep(&delivery(2, Completeness::Full)).unwrap();
        assert_eq!(
            next,
            Kept::New {
                row: 2,
                tells: true
            }
        );
    }

    #[test]
    fn a_store_of_a_newer_program_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        drop(Store::open(folder.path()).unwrap());
        let database = Connection::open(database_in(folder.path())).unwrap();
        database.pragma_update(None, "user_version", 99).unwrap();
        assert!(matches!(
            Store::open(folder.path()),
            Err(StoreError::Schema { found: 99, .. })
        ));
    }
}
