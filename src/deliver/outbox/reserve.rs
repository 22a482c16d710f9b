//! Room on the disk that is kept for alarms.

use std::path::{Path, PathBuf};

/// Room for some thousand alarms.
const BYTES: u64 = 4 << 20;
/// The reserve comes back when so much is free beside it.
const FREE_AGAIN: u64 = 4 * BYTES;

/// A file that holds room, and gives it up when an alarm finds none.
#[derive(Debug)]
pub(super) struct Reserve {
    path: PathBuf,
    given_up: bool,
}

impl Reserve {
    /// Beside the outbox, made if there is room for it.
    pub fn beside(outbox: &Path) -> Self {
        let mut reserve = Self {
            path: outbox.with_added_extension("reserve"),
            given_up: true,
        };
        reserve.restore();
        reserve
    }

    /// True when that gave room.
    pub fn give_up(&mut self) -> bool {
        if self.given_up {
            return false;
        }
        self.given_up = true;
        let removed = std::fs::remove_file(&self.path);
        tracing::error!("THE DISK IS FULL: alarms now use the room that was kept for them");
        removed.is_ok()
    }

    pub fn is_given_up(&self) -> bool {
        self.given_up
    }

    /// Takes the room back once the disk has plenty.
    pub fn restore(&mut self) {
        if !self.given_up {
            return;
        }
        let there = std::fs::metadata(&self.path).is_ok_and(|file| file.len() >= BYTES);
        if there || self.has_plenty() && self.fill().is_ok() {
            self.given_up = false;
        }
    }

    fn has_plenty(&self) -> bool {
        let folder = self.path.parent().filter(|f| !f.as_os_str().is_empty());
        rustix::fs::statvfs(folder.unwrap_or(Path::new(".")))
            .is_ok_and(|disk| disk.f_bavail.saturating_mul(disk.f_frsize) >= FREE_AGAIN)
    }

    fn fill(&self) -> std::io::Result<()> {
        let file = std::fs::File::create(&self.path)?;
        let whole = rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, BYTES);
        let written = whole
            .map_err(std::io::Error::from)
            .and_then(|()| file.sync_all());
        if written.is_err() {
            // What could not be held whole holds nothing.
            let _gone = std::fs::remove_file(&self.path);
        }
        written
    }
}
