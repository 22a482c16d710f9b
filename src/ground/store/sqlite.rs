//! The store that is built in: SQLite in WAL mode, synced at each commit.

use super::super::{action::Action, action::Kind, bus, database_in, lock};
use super::{
    Batch, BusCursor, BusRow, Census, Completeness, HistoryRow, Latest, Loaded, NewAction,
    NewAlarm, Rank, Row, SCHEMA_VERSION, Search, Standing, Store, StoreError, ToldAction, list,
    on_one_line, unlist,
};
use emberfix_frames::ServiceTime;
use rusqlite::{Connection, OpenFlags, Transaction, TransactionBehavior, params};
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

pub(super) const SCHEMA_1: &str = "
CREATE TABLE alarms (
    row         INTEGER PRIMARY KEY AUTOINCREMENT, -- never reused: the id of the event stream
    id          TEXT NOT NULL,
    revision    INTEGER NOT NULL,
    summary     INTEGER NOT NULL, -- 1: from a link that carries only part of an alarm
    uav         TEXT NOT NULL,
    captured_at TEXT NOT NULL,
    received_at TEXT NOT NULL,
    link        TEXT NOT NULL,
    tells       INTEGER NOT NULL, -- 1: it was the newest revision when it came
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

/// From version 1 on: what was called incidents are alarms by their newest revision; incidents are
/// what alarms of several aircraft may share. Rows are drawn from one journal for alarms and actions.
const SCHEMA_2: &str = "
ALTER TABLE incidents RENAME TO latest;
ALTER TABLE latest ADD COLUMN first_row INTEGER NOT NULL DEFAULT 0;
ALTER TABLE latest ADD COLUMN revisions INTEGER NOT NULL DEFAULT 1;
ALTER TABLE latest ADD COLUMN incident TEXT; -- null until merged
UPDATE latest SET
    first_row = (SELECT min(row) FROM alarms WHERE alarms.id = latest.id),
    revisions = (SELECT count(*) FROM alarms WHERE alarms.id = latest.id);
CREATE INDEX latest_incident ON latest (incident);
CREATE TABLE incidents (
    id            TEXT PRIMARY KEY,
    row           INTEGER NOT NULL, -- of the journal, at its last change
    into_id       TEXT,             -- the incident that has its alarms now
    latitude_deg  REAL NOT NULL,
    longitude_deg REAL NOT NULL,
    first_seen_ns INTEGER NOT NULL,
    captured_ns   INTEGER NOT NULL,
    feature       TEXT NOT NULL
) STRICT;
CREATE INDEX incidents_row ON incidents (row);
CREATE INDEX incidents_place ON incidents (latitude_deg, longitude_deg);
CREATE TABLE actions (
    number   INTEGER PRIMARY KEY,
    row      INTEGER NOT NULL,
    key      TEXT NOT NULL UNIQUE,
    kind     TEXT NOT NULL,
    incident TEXT NOT NULL,
    alarms   TEXT NOT NULL, -- JSON list
    others   TEXT NOT NULL, -- JSON list
    of       INTEGER,
    by       TEXT NOT NULL,
    at       TEXT NOT NULL,
    note     TEXT,
    undone   INTEGER NOT NULL
) STRICT;
CREATE TABLE told (
    uav    TEXT NOT NULL,
    number INTEGER NOT NULL REFERENCES actions(number),
    alarm  TEXT NOT NULL,
    PRIMARY KEY (uav, number, alarm)
) STRICT, WITHOUT ROWID;
CREATE TABLE fetched (uav TEXT PRIMARY KEY, number INTEGER NOT NULL, at TEXT NOT NULL) STRICT;
CREATE TABLE bus (
    only INTEGER PRIMARY KEY CHECK (only = 1),
    row INTEGER NOT NULL, sequence INTEGER NOT NULL, stream TEXT NOT NULL
) STRICT;
";

/// From version 2 on: the bus is asked whether its last confirmed message is still ours.
const SCHEMA_3: &str = "ALTER TABLE bus ADD COLUMN message TEXT NOT NULL DEFAULT ''";

const LATEST: &str = "SELECT latest.id, latest.row, latest.revision, latest.summary, first_row,
    revisions, incident, feature FROM latest JOIN alarms USING (row)";
const ACTION: &str = "SELECT number, row, key, kind, incident, alarms, others, of, by, at, note,
    undone FROM actions";

/// One connection that writes, one that reads beside it.
#[derive(Debug)]
pub struct Sqlite {
    writer: Mutex<Connection>,
    reader: Mutex<Connection>,
    id: String,
}

impl Sqlite {
    /// Opens or creates the store in `data_dir`; one of an older program is brought up to date.
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

    fn rows<T>(
        &self,
        query: &str,
        parameters: impl rusqlite::Params,
        read: impl FnMut(&rusqlite::Row<'_>) -> rusqlite::Result<T>,
    ) -> Result<Vec<T>, StoreError> {
        let reader = lock(&self.reader);
        let mut statement = reader.prepare_cached(query)?;
        let rows = statement.query_map(parameters, read)?;
        Ok(rows.collect::<Result<_, _>>()?)
    }

    fn one<T: rusqlite::types::FromSql>(&self, query: &str) -> Result<T, StoreError> {
        Ok(lock(&self.reader).query_row(query, [], |row| row.get(0))?)
    }
}

fn migrate(writer: &mut Connection, path: &Path) -> Result<(), StoreError> {
    let transaction = writer.transaction_with_behavior(TransactionBehavior::Immediate)?;
    let found: i64 = transaction.query_row("PRAGMA user_version", [], |row| row.get(0))?;
    if found > SCHEMA_VERSION {
        return Err(StoreError::Schema {
            place: path.display().to_string(),
            found,
        });
    }
    if found == 0 {
        transaction.execute_batch(SCHEMA_1)?;
        let id = uuid::Uuid::new_v4().to_string();
        transaction.execute("INSERT INTO station VALUES (?1)", [id])?;
    }
    if found < 2 {
        transaction.execute_batch(SCHEMA_2)?;
    }
    if found < 3 {
        transaction.execute_batch(SCHEMA_3)?;
    }
    transaction.pragma_update(None, "user_version", SCHEMA_VERSION)?;
    Ok(transaction.commit()?)
}

impl Store for Sqlite {
    fn id(&self) -> &str {
        &self.id
    }

    fn load(&self, limit: u32) -> Result<Loaded, StoreError> {
        // By incident, so that none is loaded in part.
        let newest = format!(
            "{LATEST} WHERE incident IS NULL OR incident IN (SELECT id FROM incidents
             WHERE into_id IS NULL ORDER BY row DESC LIMIT ?1)"
        );
        let latest = self.rows(&newest, [limit], read_latest)?;
        let standing: i64 = self.one("SELECT count(*) FROM incidents WHERE into_id IS NULL")?;
        let more = standing > i64::from(limit);
        let rows = "SELECT id, row FROM incidents WHERE into_id IS NULL ORDER BY row DESC LIMIT ?1";
        let gone = "SELECT id, row, into_id FROM incidents WHERE into_id IS NOT NULL
                    ORDER BY row DESC LIMIT ?1";
        Ok(Loaded {
            latest,
            more,
            rows: self
                .rows(rows, [limit], |row| Ok((row.get(0)?, row.get(1)?)))?
                .into_iter()
                .collect(),
            gone: self.rows(gone, [limit], |row| {
                Ok((row.get(0)?, row.get(1)?, row.get(2)?))
            })?,
            actions: self.rows(&format!("{ACTION} ORDER BY number"), [], read_action)?,
            fetched: self
                .rows("SELECT uav, number FROM fetched", [], |row| {
                    Ok((row.get(0)?, row.get(1)?))
                })?
                .into_iter()
                .collect(),
        })
    }

    fn commit(&self, batch: &Batch) -> Result<(), StoreError> {
        let mut writer = lock(&self.writer);
        let transaction = writer.transaction_with_behavior(TransactionBehavior::Immediate)?;
        for alarm in &batch.alarms {
            insert_alarm(&transaction, alarm)?;
        }
        for latest in batch.latest.values() {
            put_latest(&transaction, latest)?;
        }
        for standing in batch.incidents.values() {
            put_incident(&transaction, standing)?;
        }
        for action in &batch.actions {
            insert_action(&transaction, action)?;
        }
        put_rest(&transaction, batch)?;
        Ok(transaction.commit()?)
    }

    fn revision(&self, id: &str, revision: u32) -> Result<Vec<(String, bool)>, StoreError> {
        let query = "SELECT feature, summary FROM alarms WHERE id = ?1 AND revision = ?2
                     ORDER BY summary";
        self.rows(query, params![id, revision], |row| {
            Ok((row.get(0)?, !row.get::<_, bool>(1)?))
        })
    }

    fn recall(&self, id: &str) -> Result<Vec<Latest>, StoreError> {
        let query = format!(
            "{LATEST} WHERE latest.id = ?1 OR incident = (SELECT incident FROM latest WHERE id = ?1)"
        );
        self.rows(&query, [id], read_latest)
    }

    fn latest_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError> {
        let query = "SELECT row, feature FROM latest JOIN alarms USING (row) WHERE row > ?1
                     ORDER BY row LIMIT ?2";
        self.rows(query, params![after, limit], read_row)
    }

    fn told_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError> {
        let query =
            "SELECT row, feature FROM alarms WHERE row > ?1 AND tells ORDER BY row LIMIT ?2";
        self.rows(query, params![after, limit], read_row)
    }

    fn history(&self, alarms: &[String], limit: u32) -> Result<Vec<HistoryRow>, StoreError> {
        let query = "SELECT row, received_at, link, feature FROM alarms
                     WHERE id IN (SELECT value FROM json_each(?1)) ORDER BY row DESC LIMIT ?2";
        self.rows(query, params![list(alarms), limit], |row| {
            Ok(HistoryRow {
                row: row.get(0)?,
                received_at: row.get(1)?,
                link: row.get(2)?,
                feature: on_one_line(row.get(3)?),
            })
        })
    }

    fn incident(&self, id: &str) -> Result<Option<Standing>, StoreError> {
        let query = "SELECT id, row, into_id, latitude_deg, longitude_deg, first_seen_ns,
                     captured_ns, feature FROM incidents WHERE id = ?1";
        Ok(self.rows(query, [id], read_standing)?.pop())
    }

    fn search(&self, search: &Search, limit: u32) -> Result<Vec<String>, StoreError> {
        let [west, south, east, north] = search.bbox.unwrap_or([-180.0, -90.0, 180.0, 90.0]);
        let query = "SELECT feature FROM incidents WHERE into_id IS NULL
            AND latitude_deg BETWEEN ?2 AND ?4
            AND CASE WHEN ?1 <= ?3 THEN longitude_deg BETWEEN ?1 AND ?3
                     ELSE longitude_deg >= ?1 OR longitude_deg <= ?3 END
            AND captured_ns >= ?5 AND first_seen_ns <= ?6
            ORDER BY row DESC LIMIT ?7";
        let since = search.since.map_or(i64::MIN, ServiceTime::unix_ns);
        let until = search.until.map_or(i64::MAX, ServiceTime::unix_ns);
        let parameters = params![west, south, east, north, since, until, limit];
        self.rows(query, parameters, |row| row.get(0))
    }

    fn actions_for(
        &self,
        uav: &str,
        after: i64,
        limit: u32,
    ) -> Result<Vec<ToldAction>, StoreError> {
        let query = "SELECT number, alarm, kind, at, by FROM told JOIN actions USING (number)
                     WHERE uav = ?1 AND number > ?2 ORDER BY number, alarm LIMIT ?3";
        self.rows(query, params![uav, after, limit], |row| {
            Ok(ToldAction {
                number: row.get(0)?,
                alarm: row.get(1)?,
                kind: row.get(2)?,
                at: row.get(3)?,
                by: row.get(4)?,
            })
        })
    }

    fn action_by_key(&self, key: &str) -> Result<Option<Action>, StoreError> {
        let query = format!("{ACTION} WHERE key = ?1");
        Ok(self.rows(&query, [key], read_action)?.pop())
    }

    fn actions_on(&self, alarms: &[String]) -> Result<Vec<Action>, StoreError> {
        let query = format!(
            "{ACTION} WHERE number IN (SELECT number FROM told
             WHERE alarm IN (SELECT value FROM json_each(?1))) ORDER BY number"
        );
        self.rows(&query, [list(alarms)], read_action)
    }

    fn newest_row(&self) -> Result<i64, StoreError> {
        self.one(
            "SELECT max((SELECT coalesce(max(row), 0) FROM alarms),
                        (SELECT coalesce(max(row), 0) FROM actions),
                        (SELECT coalesce(max(row), 0) FROM incidents))",
        )
    }

    fn newest_action(&self) -> Result<i64, StoreError> {
        self.one("SELECT coalesce(max(number), 0) FROM actions")
    }

    fn census(&self) -> Result<Census, StoreError> {
        let query = "SELECT (SELECT count(*) FROM incidents WHERE into_id IS NULL),
                            (SELECT count(*) FROM alarms)";
        let count = |row: &rusqlite::Row<'_>| {
            Ok(Census {
                incidents: row.get(0)?,
                alarms: row.get(1)?,
            })
        };
        Ok(lock(&self.reader).query_row(query, [], count)?)
    }

    fn bus_after(&self, after: i64, limit: u32) -> Result<Vec<BusRow>, StoreError> {
        let query = "SELECT row, id, revision, summary, uav, feature FROM alarms
                     WHERE row > ?1 AND link <> ?2 ORDER BY row LIMIT ?3";
        self.rows(query, params![after, bus::LINK_NAME, limit], |row| {
            Ok(BusRow {
                row: row.get(0)?,
                id: row.get(1)?,
                revision: row.get(2)?,
                completeness: Completeness::of(row.get(3)?),
                uav: row.get(4)?,
                feature: row.get(5)?,
            })
        })
    }

    fn bus_cursor(&self) -> Result<BusCursor, StoreError> {
        let query = "SELECT row, sequence, stream, message FROM bus";
        let found = self.rows(query, [], |row| {
            Ok(BusCursor {
                row: row.get(0)?,
                sequence: row.get::<_, i64>(1)?.unsigned_abs(),
                stream: row.get(2)?,
                message: row.get(3)?,
            })
        })?;
        Ok(found.into_iter().next().unwrap_or_default())
    }
}

fn insert_alarm(transaction: &Transaction<'_>, new: &NewAlarm) -> rusqlite::Result<()> {
    let properties = &new.delivery.alarm.properties;
    let rank = new.delivery.rank();
    let mut insert = transaction.prepare_cached(
        "INSERT INTO alarms (row, id, revision, summary, uav, captured_at, received_at, link, tells,
         feature) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10)",
    )?;
    insert.execute(params![
        new.row,
        properties.id,
        rank.revision,
        !rank.full,
        properties.uav,
        properties.captured_at.rfc3339(),
        new.delivery.received_at.rfc3339(),
        new.delivery.link,
        new.tells,
        new.delivery.raw,
    ])?;
    Ok(())
}

fn put_latest(transaction: &Transaction<'_>, latest: &Latest) -> rusqlite::Result<()> {
    let mut put = transaction.prepare_cached(
        "INSERT INTO latest (id, row, revision, summary, first_row, revisions, incident)
         VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)
         ON CONFLICT (id) DO UPDATE SET row = ?2, revision = ?3, summary = ?4, first_row = ?5,
         revisions = ?6, incident = ?7",
    )?;
    put.execute(params![
        latest.id,
        latest.row,
        latest.rank.revision,
        !latest.rank.full,
        latest.first_row,
        i64::try_from(latest.revisions).unwrap_or(i64::MAX),
        latest.incident,
    ])?;
    Ok(())
}

fn put_incident(transaction: &Transaction<'_>, standing: &Standing) -> rusqlite::Result<()> {
    let mut put = transaction.prepare_cached(
        "INSERT INTO incidents (id, row, into_id, latitude_deg, longitude_deg, first_seen_ns,
         captured_ns, feature) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)
         ON CONFLICT (id) DO UPDATE SET row = ?2, into_id = ?3, latitude_deg = ?4,
         longitude_deg = ?5, first_seen_ns = ?6, captured_ns = ?7, feature = ?8",
    )?;
    put.execute(params![
        standing.id,
        standing.row,
        standing.into,
        standing.latitude_deg,
        standing.longitude_deg,
        standing.first_seen_at.unix_ns(),
        standing.captured_at.unix_ns(),
        standing.feature,
    ])?;
    Ok(())
}

fn insert_action(transaction: &Transaction<'_>, new: &NewAction) -> rusqlite::Result<()> {
    let action = &new.action;
    transaction.execute(
        "INSERT INTO actions (number, row, key, kind, incident, alarms, others, of, by, at, note,
         undone) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12)",
        params![
            action.number,
            action.row,
            action.key,
            action.kind.name(),
            action.incident,
            list(&action.alarms),
            list(&action.others),
            action.of,
            action.by,
            action.at.rfc3339(),
            action.note,
            action.undone,
        ],
    )?;
    for (alarm, uav) in &new.tell {
        transaction.execute(
            "INSERT INTO told (uav, number, alarm) VALUES (?1, ?2, ?3)",
            params![uav, action.number, alarm],
        )?;
    }
    Ok(())
}

fn put_rest(transaction: &Transaction<'_>, batch: &Batch) -> rusqlite::Result<()> {
    for number in &batch.undone {
        transaction.execute("UPDATE actions SET undone = 1 WHERE number = ?1", [number])?;
    }
    for (uav, (number, at)) in &batch.fetched {
        transaction.execute(
            "INSERT INTO fetched VALUES (?1, ?2, ?3)
             ON CONFLICT (uav) DO UPDATE SET number = ?2, at = ?3",
            params![uav, number, at.rfc3339()],
        )?;
    }
    if let Some(bus) = &batch.bus {
        transaction.execute(
            "INSERT INTO bus (only, row, sequence, stream, message) VALUES (1, ?1, ?2, ?3, ?4)
             ON CONFLICT (only) DO UPDATE SET row = ?1, sequence = ?2, stream = ?3, message = ?4",
            params![
                bus.row,
                i64::try_from(bus.sequence).unwrap_or(i64::MAX),
                bus.stream,
                bus.message
            ],
        )?;
    }
    Ok(())
}

fn read_row(row: &rusqlite::Row<'_>) -> rusqlite::Result<Row> {
    Ok(Row {
        row: row.get(0)?,
        feature: on_one_line(row.get(1)?),
    })
}

fn read_latest(row: &rusqlite::Row<'_>) -> rusqlite::Result<Latest> {
    Ok(Latest {
        id: row.get(0)?,
        row: row.get(1)?,
        rank: Rank {
            revision: row.get(2)?,
            full: !row.get::<_, bool>(3)?,
        },
        first_row: row.get(4)?,
        revisions: row.get::<_, i64>(5)?.unsigned_abs(),
        incident: row.get(6)?,
        feature: row.get(7)?,
    })
}

fn read_standing(row: &rusqlite::Row<'_>) -> rusqlite::Result<Standing> {
    Ok(Standing {
        id: row.get(0)?,
        row: row.get(1)?,
        into: row.get(2)?,
        latitude_deg: row.get(3)?,
        longitude_deg: row.get(4)?,
        first_seen_at: ServiceTime::from_unix_ns(row.get(5)?),
        captured_at: ServiceTime::from_unix_ns(row.get(6)?),
        feature: row.get(7)?,
    })
}

fn read_action(row: &rusqlite::Row<'_>) -> rusqlite::Result<Action> {
    let damaged = |column| {
        rusqlite::Error::InvalidColumnType(
            column,
            "actions".to_owned(),
            rusqlite::types::Type::Text,
        )
    };
    let (kind, at): (String, String) = (row.get(3)?, row.get(9)?);
    Ok(Action {
        number: row.get(0)?,
        row: row.get(1)?,
        key: row.get(2)?,
        kind: Kind::named(&kind).ok_or_else(|| damaged(3))?,
        incident: row.get(4)?,
        alarms: unlist(&row.get::<_, String>(5)?),
        others: unlist(&row.get::<_, String>(6)?),
        of: row.get(7)?,
        by: row.get(8)?,
        at: ServiceTime::from_rfc3339(&at).ok_or_else(|| damaged(9))?,
        note: row.get(10)?,
        undone: row.get(11)?,
    })
}
