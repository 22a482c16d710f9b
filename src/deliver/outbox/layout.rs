//! The outbox's tables, and how older ones become these.

use rusqlite::{Connection, Transaction, TransactionBehavior};

/// What this program writes.
pub(super) const NEWEST: i64 = 3;

pub(super) const FIRST: &str = "
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

/// Sequence numbers, digests, operators' actions; HTTP became one of the ways over IP.
const SECOND: &str = "
    ALTER TABLE alarms ADD COLUMN sequence INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE alarms ADD COLUMN count INTEGER NOT NULL DEFAULT 1;
    ALTER TABLE alarms ADD COLUMN digest BLOB;
    UPDATE alarms SET sequence =
        (SELECT count(*) FROM alarms AS earlier WHERE earlier.stored <= alarms.stored);
    CREATE UNIQUE INDEX alarms_by_sequence ON alarms (sequence);
    CREATE TABLE told (id TEXT PRIMARY KEY, count INTEGER NOT NULL) STRICT, WITHOUT ROWID;
    INSERT INTO told SELECT id, 1 FROM alarms;
    CREATE TABLE actions (alarm TEXT PRIMARY KEY, number INTEGER NOT NULL, kind TEXT NOT NULL)
        STRICT, WITHOUT ROWID;
    INSERT INTO counters SELECT 'newest_sequence', count(*) FROM alarms;
    INSERT INTO counters VALUES ('newest_action', 0), ('outbox', random());
    UPDATE receipts SET link = 'ip' WHERE link = 'http';
";

/// Pictures of fires.
const THIRD: &str = "
    CREATE TABLE chips (
        number INTEGER PRIMARY KEY AUTOINCREMENT,
        id TEXT NOT NULL UNIQUE,
        revision INTEGER NOT NULL,
        jpeg BLOB NOT NULL
    ) STRICT;
";

/// Creates the tables in a new file, renews those of an old one; says which layout it has then.
pub(super) fn upgrade(database: &mut Connection) -> rusqlite::Result<i64> {
    let transaction = database.transaction_with_behavior(TransactionBehavior::Exclusive)?;
    let found: i64 = transaction.pragma_query_value(None, "user_version", |row| row.get(0))?;
    if found >= NEWEST {
        return Ok(found);
    }
    step(&transaction, found < 1, FIRST)?;
    step(&transaction, found < 2, SECOND)?;
    step(&transaction, found < 3, THIRD)?;
    transaction.pragma_update(None, "user_version", NEWEST)?;
    transaction.commit()?;
    Ok(NEWEST)
}

fn step(transaction: &Transaction<'_>, due: bool, change: &str) -> rusqlite::Result<()> {
    if due {
        transaction.execute_batch(change)?;
    }
    Ok(())
}
