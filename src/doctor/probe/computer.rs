//! The companion computer: disk, outbox.

use crate::deliver::{Outbox, Owner};
use crate::service::LINKS;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

/// What the disk and the outbox showed.
#[derive(Debug, Clone, Default)]
pub struct ComputerSeen {
    /// The folder that was looked at.
    pub folder: String,
    /// Free space, bytes; or what went wrong.
    pub free_bytes: Option<u64>,
    /// What a write came to.
    pub written: Option<Result<DiskSpeed, String>>,
    /// Alarms that still wait, per link; `None` where there is no outbox yet.
    pub waiting: Option<Result<Vec<(&'static str, u32)>, String>>,
}

/// How quickly the disk takes what it is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DiskSpeed {
    /// Bytes per second, synced.
    pub bytes_per_s: f64,
    /// A small file, synced: what an alarm waits for before it is sent.
    pub sync: Duration,
}

/// Written to measure: 8 MiB, some seconds of pictures.
const SAMPLE_BYTES: usize = 8 << 20;
/// About an alarm's size.
const SMALL_BYTES: usize = 4096;

/// Looks at the state folder, which is made if it is not there, as the service would.
#[must_use]
pub fn look(folder: &Path) -> ComputerSeen {
    let written = std::fs::create_dir_all(folder).and_then(|()| speed(folder));
    let free_bytes = rustix::fs::statvfs(folder)
        .ok()
        .map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize));
    ComputerSeen {
        folder: folder.display().to_string(),
        free_bytes,
        written: Some(written.map_err(|error| error.to_string())),
        waiting: waiting(folder),
    }
}

fn speed(folder: &Path) -> std::io::Result<DiskSpeed> {
    let path = folder.join(format!(".doctor-{}", std::process::id()));
    let measured = write_synced(&path, SMALL_BYTES).and_then(|sync| {
        let large = write_synced(&path, SAMPLE_BYTES)?;
        Ok(DiskSpeed {
            bytes_per_s: SAMPLE_BYTES as f64 / large.as_secs_f64().max(1e-6),
            sync,
        })
    });
    let removed = std::fs::remove_file(&path);
    let speed = measured?;
    removed.map(|()| speed)
}

fn write_synced(path: &Path, bytes: usize) -> std::io::Result<Duration> {
    let content = vec![0xA5_u8; bytes];
    let begun = Instant::now();
    let mut file = std::fs::File::create(path)?;
    file.write_all(&content)?;
    file.sync_all()?;
    Ok(begun.elapsed())
}

fn waiting(folder: &Path) -> Option<Result<Vec<(&'static str, u32)>, String>> {
    let path = folder.join("outbox.sqlite");
    if !path.exists() {
        return None;
    }
    let counted = Outbox::open(&path, &LINKS, Owner::default()).and_then(|outbox| {
        let each = LINKS.iter().map(|link| Ok((*link, outbox.waiting(link)?)));
        each.collect()
    });
    Some(counted.map_err(|error| error.to_string()))
}
