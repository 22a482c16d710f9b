//! Images of fires, one per alarm, on disk beside the store.
//!
//! Bounds: [`MAX_CHIP`] bytes each, [`MAX_CHIPS`] of them. Loss: a newer revision replaces an older
//! one, and beyond the bound the chip that came first goes. A chip is never needed for an alarm.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Largest chip, bytes.
pub const MAX_CHIP: usize = 64 * 1024;
/// Chips kept.
pub const MAX_CHIPS: usize = 4_096;
/// How a JPEG begins.
const JPEG: [u8; 3] = [0xff, 0xd8, 0xff];

/// Why a chip was not kept.
#[derive(Debug, thiserror::Error)]
pub enum ChipError {
    /// Not an image of the one kind that we show.
    #[error("the chip of alarm {alarm} is no JPEG")]
    Kind {
        /// Alarm id.
        alarm: String,
    },
    /// Too large.
    #[error("the chip of alarm {alarm} has {bytes} bytes, allowed are {MAX_CHIP}")]
    Large {
        /// Alarm id.
        alarm: String,
        /// Its size.
        bytes: usize,
    },
    /// No alarm has such an id.
    #[error("a chip for alarm {alarm:?}: allowed are ids of 1 to 64 bytes")]
    Id {
        /// What was given.
        alarm: String,
    },
    /// The disk failed.
    #[error("chip {path}: {source}", path = path.display())]
    Disk {
        /// File or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// The chips in one folder.
#[derive(Debug)]
pub(super) struct Chips {
    folder: PathBuf,
    /// Alarm id to revision and the order in which they came.
    known: BTreeMap<String, (u32, u64)>,
    next: u64,
}

impl Chips {
    /// Opens or makes the folder and sees what is there.
    ///
    /// # Errors
    /// [`ChipError::Disk`].
    pub fn open(folder: PathBuf) -> Result<Self, ChipError> {
        let failed = |source| disk(&folder, source);
        std::fs::create_dir_all(&folder).map_err(failed)?;
        let mut found: Vec<(SystemTime, String, u32)> = Vec::new();
        for entry in std::fs::read_dir(&folder).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let written = entry.metadata().and_then(|about| about.modified());
            if let Some((alarm, revision)) = named(&entry.path()) {
                found.push((written.unwrap_or(SystemTime::UNIX_EPOCH), alarm, revision));
            }
        }
        found.sort();
        let mut chips = Self {
            folder,
            known: BTreeMap::new(),
            next: 0,
        };
        for (_, alarm, revision) in found {
            chips.note(alarm, revision);
        }
        Ok(chips)
    }

    /// Keeps a chip unless a newer one is there; true when it was kept.
    ///
    /// # Errors
    /// [`ChipError`].
    pub fn keep(&mut self, alarm: &str, revision: u32, jpeg: &[u8]) -> Result<bool, ChipError> {
        check(alarm, jpeg)?;
        let before = self.known.get(alarm).map(|(revision, _)| *revision);
        if before.is_some_and(|before| before >= revision) {
            return Ok(false);
        }
        self.write(alarm, revision, jpeg)?;
        if let Some(before) = before {
            let _ = std::fs::remove_file(self.path(alarm, before));
        }
        self.note(alarm.to_owned(), revision);
        self.make_room();
        Ok(true)
    }

    /// Where the chip of an alarm lies.
    pub fn find(&self, alarm: &str) -> Option<PathBuf> {
        let (revision, _) = self.known.get(alarm)?;
        Some(self.path(alarm, *revision))
    }

    /// Whether there is a chip of an alarm.
    pub fn has(&self, alarm: &str) -> bool {
        self.known.contains_key(alarm)
    }

    /// A whole file or none: written beside its place, synced, then moved there.
    fn write(&self, alarm: &str, revision: u32, jpeg: &[u8]) -> Result<(), ChipError> {
        let path = self.path(alarm, revision);
        let draft = path.with_extension("part");
        let write = || {
            let mut file = std::fs::File::create(&draft)?;
            file.write_all(jpeg)?;
            file.sync_data()?;
            std::fs::rename(&draft, &path)
        };
        write().map_err(|source| disk(&path, source))
    }

    fn note(&mut self, alarm: String, revision: u32) {
        self.next += 1;
        self.known.insert(alarm, (revision, self.next));
    }

    fn make_room(&mut self) {
        while self.known.len() > MAX_CHIPS {
            let first = self.known.iter().min_by_key(|(_, (_, order))| *order);
            let Some(alarm) = first.map(|(alarm, _)| alarm.clone()) else {
                return;
            };
            if let Some((revision, _)) = self.known.remove(&alarm) {
                let _ = std::fs::remove_file(self.path(&alarm, revision));
            }
        }
    }

    /// The id goes into the name as hexadecimal digits: it comes from outside and may be anything.
    fn path(&self, alarm: &str, revision: u32) -> PathBuf {
        let digits: String = alarm.bytes().map(|byte| format!("{byte:02x}")).collect();
        self.folder.join(format!("{digits}-{revision}.jpg"))
    }
}

fn check(alarm: &str, jpeg: &[u8]) -> Result<(), ChipError> {
    let alarm = || alarm.to_owned();
    if alarm().is_empty() || alarm().len() > 64 {
        return Err(ChipError::Id { alarm: alarm() });
    }
    if jpeg.len() > MAX_CHIP {
        return Err(ChipError::Large {
            alarm: alarm(),
            bytes: jpeg.len(),
        });
    }
    if !jpeg.starts_with(&JPEG) {
        return Err(ChipError::Kind { alarm: alarm() });
    }
    Ok(())
}

fn disk(path: &Path, source: std::io::Error) -> ChipError {
    ChipError::Disk {
        path: path.to_owned(),
        source,
    }
}

/// Alarm id and revision of a chip's file; `None` of any other file.
fn named(path: &Path) -> Option<(String, u32)> {
    if path.extension()? != "jpg" {
        return None;
    }
    let (digits, revision) = path.file_stem()?.to_str()?.rsplit_once('-')?;
    let bytes = digits.as_bytes().chunks(2).map(|pair| {
        let pair = std::str::from_utf8(pair).ok()?;
        u8::from_str_radix(pair, 16).ok()
    });
    let alarm = String::from_utf8(bytes.collect::<Option<_>>()?).ok()?;
    Some((alarm, revision.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jpeg(text: &str) -> Vec<u8> {
        [&JPEG, text.as_bytes()].concat()
    }

    #[test]
    fn the_newest_chip_of_an_alarm_is_kept_and_outlives_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let mut chips = Chips::open(folder.path().join("chips")).unwrap();
        assert!(chips.keep("../a-1", 2, &jpeg("two")).unwrap());
        assert!(!chips.keep("../a-1", 1, &jpeg("late")).unwrap());
        assert!(chips.keep("../a-1", 3, &jpeg("three")).unwrap());
        let chips = Chips::open(folder.path().join("chips")).unwrap();
        let found = chips.find("../a-1").unwrap();
        assert_eq!(std::fs::read(found).unwrap(), jpeg("three"));
        let files = std::fs::read_dir(folder.path().join("chips")).unwrap();
        assert_eq!(files.count(), 1, "nothing else, and nothing elsewhere");
    }

    #[test]
    fn what_is_no_chip_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut chips = Chips::open(folder.path().to_owned()).unwrap();
        let refused = chips.keep("a-1", 1, b"<svg onload=alert(1)>").unwrap_err();
        assert!(matches!(refused, ChipError::Kind { .. }));
        let large = jpeg(&" ".repeat(MAX_CHIP));
        let refused = chips.keep("a-1", 1, &large).unwrap_err();
        assert!(matches!(refused, ChipError::Large { .. }));
        let refused = chips.keep("", 1, &jpeg("x")).unwrap_err();
        assert!(matches!(refused, ChipError::Id { .. }));
    }
}
