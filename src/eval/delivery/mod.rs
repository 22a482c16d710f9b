//! Delivery from the aircraft's disk to the ground's, through bad weather.
//!
//! **In:** options and a seed. **Out:** what was lost, what came twice, how long it took. The real
//! outbox and courier run in one child process ([`aircraft`]), the real `emberfix ground` in another; a
//! proxy between them (`proxy`) loses, delays, reorders, repeats and cuts. Nothing here asks the two
//! sides how they think they fare: the audit (`audit`) reads both databases.
//!
//! **Latency** is from the decision (before the alarm is put into the outbox) to the moment at which
//! another process can read the alarm from the ground's database: committed, synced, and up to two
//! milliseconds later than that.
//!
//! **TCP.** A proxy can't lose segments of a TCP connection, so their loss is modelled: a lost segment
//! holds up what is behind it for a retransmission timeout of 200 ms (Linux's least), which doubles
//! with each further loss (RFC 6298); acknowledgements are never lost, and nothing else slows it. That
//! flatters TCP. Datagrams and QUIC (`quic`) lose the real thing.

pub mod aircraft;
mod audit;
mod children;
mod disk;
mod latency;
mod outage;
mod proxy;
pub mod quic;
mod slaughter;

use crate::eval::ground::{self, LoadError};
use crate::eval::{Report, Table};
use emberfix_report::{Bound, Figure};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What is measured.
#[derive(Debug, Clone)]
pub struct Options {
    /// Seed of weather and kills.
    pub seed: u64,
    /// A small run.
    pub quick: bool,
    /// Parts to measure.
    pub parts: Vec<Part>,
}

impl Options {
    /// How often somebody is told that it goes on.
    #[must_use]
    pub fn steps(&self) -> u64 {
        let steps = |part: &Part| match part {
            Part::Latency => latency::CASES,
            Part::Kills if self.quick => slaughter::KILLS.1,
            Part::Kills => slaughter::KILLS.0,
            Part::Disk => 3,
            Part::Load | Part::Nats => 1,
        };
        self.parts.iter().map(steps).sum::<usize>() as u64
    }
}

/// Parts of the measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Part {
    /// Milliseconds from decision to the ground's disk.
    Latency,
    /// Random SIGKILLs of either side, and beside it the long outage.
    Kills,
    /// A full disk, torn writes, flipped bits.
    Disk,
    /// Alarms a second that one ground process keeps.
    Load,
    /// The same through NATS JetStream, whose server is killed in between.
    Nats,
}

impl Part {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Latency,
        Self::Kills,
        Self::Disk,
        Self::Load,
        Self::Nats,
    ];
}

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
pub enum DeliveryError {
    /// A file, a socket, a process.
    #[error("{doing}: {source}")]
    Io {
        /// What was tried.
        doing: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
    /// A child that does not come up.
    #[error("{child} did not start within {limit_s} s; it said: {said}")]
    NotReady {
        /// Which.
        child: &'static str,
        /// How long it had.
        limit_s: u64,
        /// Its last words.
        said: String,
    },
    /// A database that can't be read.
    #[error("{path}: {source}", path = path.display())]
    Database {
        /// Which.
        path: PathBuf,
        /// What SQLite said.
        source: rusqlite::Error,
    },
    /// The load on the ground could not be made.
    #[error(transparent)]
    Load(#[from] LoadError),
    /// The outbox failed where it should not.
    #[error(transparent)]
    Outbox(#[from] crate::deliver::OutboxError),
    /// A place that is none.
    #[error(transparent)]
    Place(#[from] emberfix_frames::PlaceError),
    /// A key.
    #[error(transparent)]
    Key(#[from] crate::deliver::keys::KeyError),
    /// A thread of the measurement ended early.
    #[error("a thread of the measurement ended early")]
    Thread,
}

/// Wraps what the system said.
fn io(doing: &'static str) -> impl Fn(std::io::Error) -> DeliveryError {
    move |source| DeliveryError::Io { doing, source }
}

/// Alarms that were compared, over all parts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Audit {
    /// Put into an outbox.
    pub put: usize,
    /// Not on the ground, or not with their capture time.
    pub lost: usize,
    /// On the ground more than once, or never put.
    pub duplicated: usize,
}

impl Audit {
    /// Both together.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            put: self.put + other.put,
            lost: self.lost + other.lost,
            duplicated: self.duplicated + other.duplicated,
        }
    }
}

/// What one part came to.
#[derive(Debug, Default)]
struct Found {
    audit: Audit,
    figures: Vec<Figure>,
    tables: Vec<Table>,
    details: serde_json::Map<String, serde_json::Value>,
}

/// Whom to tell how far it is: a step of how many, and what is going on.
pub type Told<'a> = &'a (dyn Fn(&str) + Sync);

/// Measures.
///
/// # Errors
/// [`DeliveryError`] when a child can't be run.
pub fn measure(options: &Options, told: Told<'_>) -> Result<Report, DeliveryError> {
    if options.parts.contains(&Part::Nats) && crate::ground::nats_server().is_none() {
        // Said before hours have gone, not after.
        return Err(LoadError::NoServer.into());
    }
    let scratch = Scratch::new()?;
    let mut found = Found::default();
    for part in &options.parts {
        let more = match part {
            Part::Latency => latency::measure(options, scratch.path(), told)?,
            Part::Kills => slaughter::measure(options, scratch.path(), told)?,
            Part::Disk => disk::measure(options, scratch.path(), told)?,
            Part::Load => loaded("load", told, || ground::measure(options.quick))?,
            Part::Nats => loaded("nats", told, || ground::nats::measure(options.quick))?,
        };
        found.audit = found.audit.plus(more.audit);
        found.figures.extend(more.figures);
        found.tables.extend(more.tables);
        found.details.extend(more.details);
    }
    Ok(report(options, found))
}

/// A measurement of [`ground`] as a part of this.
fn loaded(
    name: &str,
    told: Told<'_>,
    measure: impl FnOnce() -> Result<Report, LoadError>,
) -> Result<Found, DeliveryError> {
    told(name);
    let report = measure()?;
    let mut details = serde_json::Map::new();
    details.insert(name.to_owned(), report.details);
    Ok(Found {
        figures: report.figures,
        tables: report.tables,
        details,
        ..Found::default()
    })
}

fn report(options: &Options, found: Found) -> Report {
    let Audit {
        put,
        lost,
        duplicated,
    } = found.audit;
    let none = |name, count: usize| {
        Figure::bounded(name, Some(count as f64), "alarms", Bound::Equals(0.0), put)
    };
    let mut figures = vec![
        none("delivery.lost", lost),
        none("delivery.duplicated", duplicated),
    ];
    figures.extend(found.figures);
    let mut details = found.details;
    details.insert("audit".to_owned(), serde_json::json!(found.audit));
    details.insert("seed".to_owned(), options.seed.into());
    details.insert("quick".to_owned(), options.quick.into());
    Report {
        figures,
        details: details.into(),
        tables: found.tables,
        plots: Vec::new(),
    }
}

/// A folder that is gone afterwards.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Result<Self, DeliveryError> {
        let name = format!("emberfix-delivery-{}", uuid::Uuid::new_v4());
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).map_err(io("make a scratch folder"))?;
        Ok(Self(path))
    }

    fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // What stays behind is in the temporary folder.
        let _gone = std::fs::remove_dir_all(&self.0);
    }
}
