//! Pictures of fires, beside their alarms: kept until the ground has them.
//!
//! **Bound:** [`Outbox::MAX_CHIPS`], the newest of each fire. **Loss rule:** beyond it the oldest goes. None is
//! kept while alarms live on the reserve: a picture never takes an alarm's place.

use super::{Outbox, OutboxError};
use rusqlite::params;

/// A fire's picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredChip {
    /// Rises from picture to picture.
    pub number: i64,
    /// Alarm id.
    pub id: String,
    /// The alarm's revision when it was taken.
    pub revision: u32,
    /// What it is.
    pub jpeg: Vec<u8>,
}

impl Outbox {
    /// Pictures that wait at most.
    pub const MAX_CHIPS: u32 = 16;

    /// Keeps a picture in place of an older one of the same fire; false where alarms need the room.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn put_chip(&mut self, id: &str, revision: u32, jpeg: &[u8]) -> Result<bool, OutboxError> {
        if self.is_on_reserve() {
            return Ok(false);
        }
        self.commit("store a picture", |t| {
            t.execute("DELETE FROM chips WHERE id = ?1", [id])?;
            t.execute(
                "INSERT INTO chips (id, revision, jpeg) VALUES (?1, ?2, ?3)",
                params![id, revision, jpeg],
            )?;
            t.execute(
                "DELETE FROM chips WHERE number NOT IN
                    (SELECT number FROM chips ORDER BY number DESC LIMIT ?1)",
                [Self::MAX_CHIPS],
            )
        })?;
        self.changes += 1;
        Ok(true)
    }

    /// The pictures after this number, oldest first.
    ///
    /// # Errors
    /// [`OutboxError::Storage`].
    pub fn chips_after(&self, number: i64) -> Result<Vec<StoredChip>, OutboxError> {
        let read = || {
            let mut statement = self.database.prepare_cached(
                "SELECT number, id, revision, jpeg FROM chips WHERE number > ?1 ORDER BY number",
            )?;
            let rows = statement.query_map([number], |row| {
                Ok(StoredChip {
                    number: row.get(0)?,
                    id: row.get(1)?,
                    revision: row.get(2)?,
                    jpeg: row.get(3)?,
                })
            })?;
            rows.collect::<rusqlite::Result<_>>()
        };
        read().map_err(|source| OutboxError::Storage {
            doing: "read pictures",
            source,
        })
    }

    /// The ground has it.
    ///
    /// # Errors
    /// [`OutboxError::Storage`]; it will then be sent again after a restart, which is harmless.
    pub fn drop_chip(&mut self, id: &str, revision: u32) -> Result<(), OutboxError> {
        self.commit("drop a picture", |t| {
            t.execute(
                "DELETE FROM chips WHERE id = ?1 AND revision <= ?2",
                params![id, revision],
            )
        })
        .map(|_| ())
    }
}
