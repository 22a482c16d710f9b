//! The books on what each aircraft says that it sent: how many alarm revisions a relay keeps back.
//!
//! Every revision that an aircraft's outbox stores has a sequence number, and each alarm that comes
//! says for how many of them it stands ([`crate::deliver::envelope`]). The greatest number that we heard of,
//! less the sum of what came, is what did not come: on its way, waiting on board, or withheld. A
//! beat tells the greatest number even while no alarm gets through.
//!
//! Beside the alarms, in a file of its own (SQLite, synced before an alarm is acknowledged, many
//! entries to one sync). **Bound:** one small row per alarm id. **Loss:** none; entries that wait
//! for the disk wait, and so do their acknowledgements.

use crate::deliver::envelope::{Envelope, Origin};
use emberfix_frames::ServiceTime;
use rusqlite::{Connection, OptionalExtension as _, Transaction, TransactionBehavior, params};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::oneshot;

/// Why the books can't be kept.
#[derive(Debug, thiserror::Error)]
pub enum LedgerError {
    /// The file can't be opened or written.
    #[error("books {}: {source}", path.display())]
    Sql {
        /// The file.
        path: PathBuf,
        /// What SQLite said.
        source: rusqlite::Error,
    },
    /// Of a newer program.
    #[error("books {} have layout {found}, this program knows up to {LAYOUT}", path.display())]
    Newer {
        /// The file.
        path: PathBuf,
        /// Its layout.
        found: i64,
    },
    /// The thread that writes has ended.
    #[error("the books are closed")]
    Closed,
}

const LAYOUT: i64 = 1;
const CREATE: &str = "
    CREATE TABLE accounts (
        uav TEXT NOT NULL, outbox INTEGER NOT NULL, newest INTEGER NOT NULL,
        counted INTEGER NOT NULL, PRIMARY KEY (uav, outbox)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE counts (
        uav TEXT NOT NULL, outbox INTEGER NOT NULL, id TEXT NOT NULL, count INTEGER NOT NULL,
        PRIMARY KEY (uav, outbox, id)
    ) STRICT, WITHOUT ROWID;
";
/// Entries that may wait for the disk; further ones wait to wait.
const QUEUE: usize = 4_096;
/// Entries of one sync.
const BATCH: usize = 512;

/// How one aircraft's outbox stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Account {
    /// Greatest sequence that we heard of.
    pub newest: u64,
    /// For how many of them there is an alarm.
    pub counted: u64,
    /// Since when some are missing, by our clock.
    pub missing_since: Option<ServiceTime>,
    /// When it was last heard.
    pub heard: Option<ServiceTime>,
    /// How many alarms wait on board, as its last beat said.
    pub waiting: u32,
    /// Greatest operator's action that it took.
    pub actions_known: u64,
}

impl Account {
    /// Revisions that did not come.
    pub fn missing(&self) -> u64 {
        self.newest.saturating_sub(self.counted)
    }

    fn settle(&mut self, now: ServiceTime) {
        match (self.missing(), self.missing_since) {
            (0, _) => self.missing_since = None,
            (_, None) => self.missing_since = Some(now),
            _ => {}
        }
    }
}

/// The books.
#[derive(Debug)]
pub(super) struct Ledger {
    sender: SyncSender<Entry>,
    accounts: Arc<Mutex<BTreeMap<Origin, Account>>>,
}

#[derive(Debug)]
struct Entry {
    origin: Origin,
    sequence: u64,
    /// Alarm id and how many revisions it stands for.
    alarm: Option<(String, u32)>,
    at: ServiceTime,
    written: oneshot::Sender<bool>,
}

impl Ledger {
    /// Opens or creates the books in `data_dir`, and starts the thread that writes them.
    ///
    /// # Errors
    /// [`LedgerError`].
    pub fn open(data_dir: &Path) -> Result<Self, LedgerError> {
        let path = data_dir.join("books.sqlite");
        let failed = |source| LedgerError::Sql {
            path: path.clone(),
            source,
        };
        let mut database = Connection::open(&path).map_err(failed)?;
        let found = prepare(&mut database).map_err(failed)?;
        if found > LAYOUT {
            return Err(LedgerError::Newer { path, found });
        }
        let accounts = Arc::new(Mutex::new(read(&database).map_err(failed)?));
        let (sender, receiver) = sync_channel(QUEUE);
        let theirs = Arc::clone(&accounts);
        std::thread::Builder::new()
            .name("books".to_owned())
            .spawn(move || write_all(&mut database, &receiver, &theirs))
            .map_err(|_| LedgerError::Closed)?;
        Ok(Self { sender, accounts })
    }

    /// Enters an alarm that is on disk; when this returns, the entry is, too.
    ///
    /// # Errors
    /// [`LedgerError::Closed`]: the disk did not take it.
    pub async fn enter(
        &self,
        envelope: &Envelope,
        alarm_id: &str,
        at: ServiceTime,
    ) -> Result<(), LedgerError> {
        let (written, done) = oneshot::channel();
        let entry = Entry {
            origin: envelope.origin.clone(),
            sequence: envelope.sequence,
            alarm: Some((alarm_id.to_owned(), envelope.count)),
            at,
            written,
        };
        self.hand_in(entry, done).await
    }

    /// Notes what a beat said; on disk when this returns, if it was news.
    ///
    /// # Errors
    /// [`LedgerError::Closed`].
    pub async fn note(
        &self,
        beat: &crate::deliver::datagram::wire::Beat,
        at: ServiceTime,
    ) -> Result<(), LedgerError> {
        {
            let mut accounts = lock(&self.accounts);
            let known = accounts.entry(beat.origin.clone()).or_default();
            known.heard = Some(at);
            known.waiting = beat.waiting;
            known.actions_known = beat.actions_known;
            if beat.newest <= known.newest {
                return Ok(());
            }
        }
        let (written, done) = oneshot::channel();
        let entry = Entry {
            origin: beat.origin.clone(),
            sequence: beat.newest,
            alarm: None,
            at,
            written,
        };
        self.hand_in(entry, done).await
    }

    /// How every outbox stands that ever was heard of.
    pub fn accounts(&self) -> BTreeMap<Origin, Account> {
        lock(&self.accounts).clone()
    }

    async fn hand_in(
        &self,
        entry: Entry,
        done: oneshot::Receiver<bool>,
    ) -> Result<(), LedgerError> {
        let sender = self.sender.clone();
        // A full queue blocks, and must not block the runtime.
        let handed = match sender.try_send(entry) {
            Ok(()) => true,
            Err(std::sync::mpsc::TrySendError::Full(entry)) => {
                let sent = tokio::task::spawn_blocking(move || sender.send(entry).is_ok());
                sent.await.unwrap_or(false)
            }
            Err(std::sync::mpsc::TrySendError::Disconnected(_)) => false,
        };
        if handed && done.await.unwrap_or(false) {
            Ok(())
        } else {
            Err(LedgerError::Closed)
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn prepare(database: &mut Connection) -> rusqlite::Result<i64> {
    database.pragma_update(None, "journal_mode", "WAL")?;
    database.pragma_update(None, "synchronous", "FULL")?;
    let transaction = database.transaction_with_behavior(TransactionBehavior::Immediate)?;
    let found: i64 = transaction.pragma_query_value(None, "user_version", |row| row.get(0))?;
    if found > 0 {
        return Ok(found);
    }
    transaction.execute_batch(CREATE)?;
    transaction.pragma_update(None, "user_version", LAYOUT)?;
    transaction.commit()?;
    Ok(LAYOUT)
}

fn read(database: &Connection) -> rusqlite::Result<BTreeMap<Origin, Account>> {
    let mut statement = database.prepare("SELECT uav, outbox, newest, counted FROM accounts")?;
    let rows = statement.query_map([], |row| {
        let origin = Origin {
            uav: row.get(0)?,
            outbox: row.get::<_, i64>(1)?.cast_unsigned(),
        };
        let account = Account {
            newest: row.get::<_, i64>(2)?.cast_unsigned(),
            counted: row.get::<_, i64>(3)?.cast_unsigned(),
            ..Account::default()
        };
        Ok((origin, account))
    })?;
    rows.collect()
}

/// One sync for whatever has come meanwhile.
fn write_all(
    database: &mut Connection,
    entries: &Receiver<Entry>,
    accounts: &Mutex<BTreeMap<Origin, Account>>,
) {
    while let Ok(first) = entries.recv() {
        let mut batch = vec![first];
        batch.extend(entries.try_iter().take(BATCH - 1));
        let written = write(database, &batch);
        let done = written.is_ok();
        match written {
            Ok(renewed) => {
                let mut accounts = lock(accounts);
                for (origin, newest, counted, at) in renewed {
                    let account = accounts.entry(origin).or_default();
                    account.newest = newest;
                    account.counted = counted;
                    account.heard = Some(at);
                    account.settle(at);
                }
            }
            Err(error) => tracing::error!(%error, "the books could not be written"),
        }
        for entry in batch {
            // Who asked may have gone.
            let _gone = entry.written.send(done);
        }
    }
}

type Renewed = (Origin, u64, u64, ServiceTime);

fn write(database: &mut Connection, batch: &[Entry]) -> rusqlite::Result<Vec<Renewed>> {
    let transaction = database.transaction_with_behavior(TransactionBehavior::Immediate)?;
    let renewed = batch
        .iter()
        .map(|entry| enter(&transaction, entry))
        .collect::<rusqlite::Result<_>>()?;
    transaction.commit()?;
    Ok(renewed)
}

fn enter(transaction: &Transaction<'_>, entry: &Entry) -> rusqlite::Result<Renewed> {
    let (uav, outbox) = (&entry.origin.uav, entry.origin.outbox.cast_signed());
    let mut counted = 0;
    if let Some((id, count)) = &entry.alarm {
        let known: Option<u32> = transaction
            .prepare_cached("SELECT count FROM counts WHERE uav = ?1 AND outbox = ?2 AND id = ?3")?
            .query_row(params![uav, outbox, id], |row| row.get(0))
            .optional()?;
        counted = i64::from(count.saturating_sub(known.unwrap_or(0)));
        transaction
            .prepare_cached(
                "INSERT INTO counts VALUES (?1, ?2, ?3, ?4)
                 ON CONFLICT DO UPDATE SET count = max(count, excluded.count)",
            )?
            .execute(params![uav, outbox, id, count])?;
    }
    let mut statement = transaction.prepare_cached(
        "INSERT INTO accounts VALUES (?1, ?2, ?3, ?4)
         ON CONFLICT DO UPDATE SET newest = max(newest, excluded.newest),
            counted = counted + excluded.counted
         RETURNING newest, counted",
    )?;
    let sequence = entry.sequence.cast_signed();
    statement.query_row(params![uav, outbox, sequence, counted], |row| {
        let newest: i64 = row.get(0)?;
        let counted: i64 = row.get(1)?;
        Ok((
            entry.origin.clone(),
            newest.cast_unsigned(),
            counted.cast_unsigned(),
            entry.at,
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::deliver::datagram::wire::Beat;

    const NOW: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);

    fn origin() -> Origin {
        Origin {
            uav: "uav-1".to_owned(),
            outbox: u64::MAX,
        }
    }

    fn envelope(sequence: u64, count: u32) -> Envelope {
        Envelope {
            origin: origin(),
            sequence,
            count,
            alarm: b"{}".to_vec(),
        }
    }

    fn beat(newest: u64) -> Beat {
        Beat {
            origin: origin(),
            newest,
            waiting: 0,
            actions_known: 0,
            stamp: 0,
            ping: Vec::new(),
        }
    }

    #[tokio::test]
    async fn what_a_relay_keeps_back_is_missed_until_something_that_stands_for_it_comes() {
        let folder = tempfile::tempdir().unwrap();
        let ledger = Ledger::open(folder.path()).unwrap();
        let missing = || ledger.accounts()[&origin()].missing();
        // Fire 1 is told three times (1, 2, 4), fire 2 once (3).
        ledger.enter(&envelope(1, 1), "uav-1-1", NOW).await.unwrap();
        assert_eq!(missing(), 0);
        ledger.note(&beat(4), NOW).await.unwrap();
        assert_eq!(missing(), 3);
        assert!(ledger.accounts()[&origin()].missing_since.is_some());
        ledger.enter(&envelope(4, 3), "uav-1-1", NOW).await.unwrap();
        ledger.enter(&envelope(4, 3), "uav-1-1", NOW).await.unwrap();
        assert_eq!(missing(), 1);
        ledger.enter(&envelope(3, 1), "uav-1-2", NOW).await.unwrap();
        assert_eq!(
            (missing(), ledger.accounts()[&origin()].missing_since),
            (0, None)
        );
    }

    #[tokio::test]
    async fn a_restart_forgets_nothing_and_other_outboxes_are_others() {
        let folder = tempfile::tempdir().unwrap();
        {
            let ledger = Ledger::open(folder.path()).unwrap();
            ledger.enter(&envelope(5, 2), "uav-1-1", NOW).await.unwrap();
        }
        let ledger = Ledger::open(folder.path()).unwrap();
        let account = ledger.accounts()[&origin()];
        assert_eq!((account.newest, account.counted), (5, 2));
        let mut fresh = envelope(1, 1);
        fresh.origin.outbox = 3;
        ledger.enter(&fresh, "uav-1-1", NOW).await.unwrap();
        assert_eq!(ledger.accounts().len(), 2);
        assert_eq!(ledger.accounts()[&fresh.origin].missing(), 0);
    }
}
