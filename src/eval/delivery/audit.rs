//! Both databases, side by side.

use super::children::Put;
use super::{Audit, DeliveryError};
use emberfix_frames::ServiceTime;
use rusqlite::{Connection, OpenFlags};
use std::collections::BTreeMap;
use std::path::Path;

/// Capture times by id and revision.
type Alarms = BTreeMap<(String, u32), Vec<i64>>;

/// Every alarm that was on the outbox's disk is on the ground's disk exactly once, with its capture
/// time. An alarm that a newer revision replaced before it was sent is there as that newer one.
pub(super) fn compare(
    outbox: &Path,
    ground: &Path,
    uav: &str,
    puts: &[Put],
) -> Result<Audit, DeliveryError> {
    let (sent, kept) = (outbox_alarms(outbox)?, ground_alarms(ground, uav)?);
    let mut lost: usize = sent
        .iter()
        .filter(|(key, at)| kept.get(*key) != Some(at))
        .count();
    let newest = newest_revisions(&kept);
    let stored: Vec<Put> = puts.iter().filter(|put| put.stored).cloned().collect();
    let owed = newest_puts(&stored);
    for put in owed.values() {
        let there = newest
            .get(&put.id)
            .is_some_and(|revision| *revision >= put.revision);
        let dated = match kept.get(&(put.id.clone(), put.revision)) {
            Some(at) => *at == [put.captured_ns],
            // Replaced by a newer revision, which is there.
            None => there && newest.get(&put.id) != Some(&put.revision),
        };
        lost += usize::from(!there || !dated);
    }
    let known = |key: &(String, u32)| {
        let is_put = |put: &&Put| put.id == key.0 && put.revision == key.1;
        sent.contains_key(key) || puts.iter().any(|put| is_put(&put))
    };
    let twice: usize = kept.values().map(|at| at.len() - 1).sum();
    let never_put = kept.keys().filter(|key| !known(key)).count();
    Ok(Audit {
        put: owed.len().max(sent.len()),
        lost,
        duplicated: twice + never_put,
    })
}

/// The last revision of each alarm that an aircraft said it put.
fn newest_puts(puts: &[Put]) -> BTreeMap<String, Put> {
    let mut newest: BTreeMap<String, Put> = BTreeMap::new();
    for put in puts {
        let known = newest.entry(put.id.clone()).or_insert_with(|| put.clone());
        if put.revision > known.revision {
            known.clone_from(put);
        }
    }
    newest
}

fn newest_revisions(alarms: &Alarms) -> BTreeMap<String, u32> {
    let mut newest = BTreeMap::new();
    for (id, revision) in alarms.keys() {
        let known = newest.entry(id.clone()).or_insert(*revision);
        *known = (*known).max(*revision);
    }
    newest
}

fn outbox_alarms(path: &Path) -> Result<Alarms, DeliveryError> {
    read(
        path,
        "SELECT id, revision, captured_at_ns FROM alarms",
        &[],
        |row| row.get(2),
    )
}

fn ground_alarms(path: &Path, uav: &str) -> Result<Alarms, DeliveryError> {
    let query = "SELECT id, revision, captured_at FROM alarms WHERE summary = 0 AND uav = ?1";
    read(path, query, &[uav], |row| {
        let at: String = row.get(2)?;
        Ok(ServiceTime::from_rfc3339(&at).map_or(i64::MIN, ServiceTime::unix_ns))
    })
}

fn read(
    path: &Path,
    query: &str,
    parameters: &[&str],
    captured_ns: impl Fn(&rusqlite::Row<'_>) -> rusqlite::Result<i64>,
) -> Result<Alarms, DeliveryError> {
    let read = || {
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE;
        let database = Connection::open_with_flags(path, flags)?;
        let mut statement = database.prepare(query)?;
        let rows = statement.query_map(rusqlite::params_from_iter(parameters), |row| {
            Ok(((row.get(0)?, row.get(1)?), captured_ns(row)?))
        })?;
        let mut alarms = Alarms::new();
        for row in rows {
            let (key, at) = row?;
            alarms.entry(key).or_default().push(at);
        }
        Ok(alarms)
    };
    read().map_err(|source| DeliveryError::Database {
        path: path.to_owned(),
        source,
    })
}

/// Watches a ground's database, as another process would read it.
pub(super) struct Watch {
    database: Connection,
    row: i64,
}

impl Watch {
    pub fn open(path: &Path) -> Result<Self, DeliveryError> {
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE;
        let opened = Connection::open_with_flags(path, flags);
        let database = opened.map_err(|source| DeliveryError::Database {
            path: path.to_owned(),
            source,
        })?;
        Ok(Self { database, row: 0 })
    }

    /// Ids and revisions that have come since the last look.
    pub fn look(&mut self) -> Vec<(String, u32)> {
        let look = || {
            let mut statement = self.database.prepare_cached(
                "SELECT row, id, revision FROM alarms WHERE row > ?1 ORDER BY row",
            )?;
            let rows = statement.query_map([self.row], |row| {
                Ok((row.get(0)?, (row.get(1)?, row.get(2)?)))
            })?;
            rows.collect::<rusqlite::Result<Vec<(i64, (String, u32))>>>()
        };
        // A busy database is looked at again.
        let rows = look().unwrap_or_default();
        self.row = rows.last().map_or(self.row, |(row, _)| *row);
        rows.into_iter().map(|(_, alarm)| alarm).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn put(id: &str, revision: u32) -> Put {
        Put {
            stored: true,
            id: id.to_owned(),
            revision,
            captured_ns: 1_000_000_000 * i64::from(revision),
            decided_ns: 0,
        }
    }

    /// An outbox and a ground with what is told; the ground's first entry is dated a second late if so
    /// said.
    fn audit(outbox: &[Put], ground: &[Put], puts: &[Put], misdated: bool) -> Audit {
        let folder = tempfile::tempdir().unwrap();
        let (a, g) = (folder.path().join("a"), folder.path().join("g"));
        let database = Connection::open(&a).unwrap();
        database
            .execute_batch(
                "CREATE TABLE alarms (id TEXT, revision INTEGER, captured_at_ns INTEGER)",
            )
            .unwrap();
        for put in outbox {
            let row = (&put.id, put.revision, put.captured_ns);
            database
                .execute("INSERT INTO alarms VALUES (?1, ?2, ?3)", row)
                .unwrap();
        }
        let database = Connection::open(&g).unwrap();
        database
            .execute_batch(
                "CREATE TABLE alarms
                 (id TEXT, revision INTEGER, captured_at TEXT, summary INTEGER, uav TEXT)",
            )
            .unwrap();
        for (put, late) in ground
            .iter()
            .zip([misdated].into_iter().chain(std::iter::repeat(false)))
        {
            let late_ns = if late { 1_000_000_000 } else { 0 };
            let at = ServiceTime::from_unix_ns(put.captured_ns + late_ns).rfc3339();
            database
                .execute(
                    "INSERT INTO alarms VALUES (?1, ?2, ?3, 0, 'u')",
                    (&put.id, put.revision, at),
                )
                .unwrap();
        }
        compare(&a, &g, "u", puts).unwrap()
    }

    #[test]
    fn what_is_missing_twice_misdated_or_made_up_is_found() {
        let whole = [put("u-1", 2), put("u-2", 1)];
        let found = |ground: &[Put], misdated| {
            let audit = audit(
                &whole,
                ground,
                &[put("u-1", 1), put("u-1", 2), put("u-2", 1)],
                misdated,
            );
            (audit.lost > 0, audit.duplicated)
        };
        assert_eq!(found(&whole, false), (false, 0));
        assert_eq!(
            found(&[put("u-1", 1), put("u-1", 2), put("u-2", 1)], false),
            (false, 0)
        );
        assert_eq!(found(&[put("u-1", 1), put("u-2", 1)], false), (true, 0));
        assert_eq!(found(&whole, true), (true, 0));
        assert_eq!(
            found(&[put("u-1", 2), put("u-1", 2), put("u-2", 1)], false).1,
            1
        );
        assert_eq!(
            found(&[put("u-1", 2), put("u-2", 1), put("u-3", 1)], false).1,
            1
        );
        // Pruned from the outbox, and still owed.
        assert!(audit(&[], &[put("u-1", 1)], &whole, false).lost > 0);
    }
}
