//! How many alarms a second one ground process keeps that come through NATS JetStream, while the
//! server of the bus is killed and started again.
//!
//! **In:** nothing but this program and a `nats-server`. **Out:** `ground.nats_alarms_per_s` and what was
//! lost or came twice.
//!
//! Each simulated aircraft has a connection of its own to the bus and publishes its next alarm as soon as
//! the stream has confirmed the last; what is not confirmed is published again under its message id. The
//! ground is a process of its own with the event streams of [`super`] open. Half-way through the measured
//! time the server gets SIGKILL, and is back a second later with what was on its disk; that time counts. The
//! rate is of alarms that the ground's disk gained, not of what was published. In the end the ground's
//! database is read: every alarm that the stream has confirmed has to be there, once, with its capture time.

use super::{
    AIRCRAFT, BROWSERS, Counters, Ground, LEAST, LoadError, alarm, browse, io, rss_kib, unreadable,
};
use crate::eval::{Report, Table};
use crate::ground::nats_server;
use async_nats::jetstream::{self, message::PublishMessage};
use emberfix_report::{Bound, Figure};
use rand::Rng as _;
use rusqlite::Connection;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// How long it is measured, after a third of that to warm up; and in a small run.
const SECONDS: (u64, u64) = (40, 8);
/// How long the server stays away.
const AWAY: Duration = Duration::from_secs(1);
/// An alarm that is not confirmed for so long is published again.
const PATIENCE: Duration = Duration::from_secs(2);
/// How long the ground may take for what is still on the bus in the end.
const DRAIN: Duration = Duration::from_secs(120);
/// How long the server may take to open its port.
const READY: Duration = Duration::from_secs(20);
/// Ports that the system gives to nobody unasked: who is killed finds its port free again.
const PORTS: std::ops::Range<u16> = 20_000..32_000;
/// The server's example configuration, which is what is measured.
const HUB: &str = include_str!("../../../missions/nats/hub.conf");

/// What one aircraft has done, by turn: each turn is one alarm.
#[derive(Debug, Default)]
struct Flown {
    /// Turns that were begun.
    begun: AtomicU32,
    /// Turns that the stream has confirmed.
    confirmed: AtomicU32,
}

#[derive(Debug, Default)]
struct Flights {
    each: Vec<Flown>,
    /// Times that an alarm had to be published again.
    again: AtomicU64,
    stop: AtomicBool,
}

impl Flights {
    fn confirmed(&self) -> u64 {
        let turns = |flown: &Flown| u64::from(flown.confirmed.load(Ordering::Relaxed));
        self.each.iter().map(turns).sum()
    }
}

/// What was seen.
#[derive(Debug, Clone, Copy, Default, serde::Serialize)]
struct Seen {
    /// On the ground's disk, over the whole time with the server's absence in it.
    alarms_per_s: f64,
    /// The same up to the kill.
    undisturbed_per_s: f64,
    confirmed: u64,
    published_again: u64,
    /// From the last confirmation to the ground's disk.
    drain_s: f64,
    rss_before_kib: u64,
    rss_after_kib: u64,
    server_rss_kib: u64,
    event_bytes: u64,
}

/// Measures; a small run when `quick`.
///
/// # Errors
/// [`LoadError`] when the server or the ground can't be run.
pub fn measure(quick: bool) -> Result<Report, LoadError> {
    let mut server = Server::start(nats_server().ok_or(LoadError::NoServer)?)?;
    let more = format!(
        "[bus]\nurl = \"{}\"\nstation = \"load\"\ndomain = \"hub\"\n",
        server.url()
    );
    let ground = Ground::start(&more)?;
    let seconds = if quick { SECONDS.1 } else { SECONDS.0 };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(io("start the load"))?;
    let flights = Arc::new(Flights {
        each: (0..AIRCRAFT).map(|_| Flown::default()).collect(),
        ..Flights::default()
    });
    let seen = runtime.block_on(run(&mut server, &ground, &flights, seconds))?;
    let audit = audit(&crate::ground::database_in(&ground.folder), &flights)?;
    Ok(report(seen, audit))
}

// --- the server ----------------------------------------------------------------------------------

/// A server of the bus in a folder of its own; both are gone afterwards.
struct Server {
    program: PathBuf,
    folder: PathBuf,
    address: SocketAddr,
    child: Option<Child>,
}

impl Server {
    fn start(program: PathBuf) -> Result<Self, LoadError> {
        let folder = std::env::temp_dir().join(format!("emberfix-bus-{}", uuid::Uuid::new_v4()));
        std::fs::create_dir_all(&folder).map_err(io("make a folder"))?;
        let (address, leaves) = (free_port()?, free_port()?);
        let config = HUB
            .replace("127.0.0.1:4222", &address.to_string())
            .replace("127.0.0.1:7422", &leaves.to_string())
            .replace("/var/lib/emberfix/nats", &folder.display().to_string());
        let mut server = Self {
            program,
            folder,
            address,
            child: None,
        };
        std::fs::write(server.config(), config).map_err(io("write a configuration"))?;
        server.restart()?;
        Ok(server)
    }

    fn config(&self) -> PathBuf {
        self.folder.join("hub.conf")
    }

    fn url(&self) -> String {
        format!("nats://{}", self.address)
    }

    /// Kills it if it runs, and starts it again.
    fn restart(&mut self) -> Result<(), LoadError> {
        self.kill();
        let mut command = Command::new(&self.program);
        command
            .arg("-c")
            .arg(self.config())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        self.child = Some(command.spawn().map_err(io("start nats-server"))?);
        let begun = Instant::now();
        while std::net::TcpStream::connect(self.address).is_err() {
            if begun.elapsed() > READY {
                let source = std::io::Error::from(std::io::ErrorKind::TimedOut);
                return Err(io("reach nats-server")(source));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(())
    }

    /// SIGKILL.
    fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }

    fn rss_kib(&self) -> u64 {
        self.child.as_ref().map_or(0, |child| rss_kib(child.id()))
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.kill();
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

fn free_port() -> Result<SocketAddr, LoadError> {
    let ports = std::iter::repeat_with(|| rand::rng().random_range(PORTS)).take(32);
    ports
        .map(|port| SocketAddr::from(([127, 0, 0, 1], port)))
        .find(|address| TcpListener::bind(address).is_ok())
        .ok_or_else(|| io("find a free port")(std::io::ErrorKind::AddrInUse.into()))
}

// --- the load ------------------------------------------------------------------------------------

async fn run(
    server: &mut Server,
    ground: &Ground,
    flights: &Arc<Flights>,
    seconds: u64,
) -> Result<Seen, LoadError> {
    let database = crate::ground::database_in(&ground.folder);
    let streams = Arc::new(Counters::default());
    for _ in 0..BROWSERS {
        tokio::spawn(browse(ground.address, Arc::clone(&streams)));
    }
    // All are connected before the first begins, or the last would wait for minutes.
    let mut lines = Vec::new();
    for _ in 0..AIRCRAFT {
        lines.push(connect(&server.url()).await?);
    }
    let mut aircraft = Vec::new();
    for (number, line) in lines.into_iter().enumerate() {
        aircraft.push(tokio::spawn(fly(line, number, Arc::clone(flights))));
    }
    tokio::time::sleep(Duration::from_secs(seconds / 3 + 1)).await;
    let mut seen = Seen {
        rss_before_kib: rss_kib(ground.child.id()),
        ..Seen::default()
    };
    let (begun, before) = (Instant::now(), kept(&database)?);
    let rate = |kept: u64| (kept - before) as f64 / begun.elapsed().as_secs_f64();
    tokio::time::sleep(Duration::from_secs(seconds / 2)).await;
    seen.undisturbed_per_s = rate(kept(&database)?);
    server.kill();
    tokio::time::sleep(AWAY).await;
    server.restart()?;
    let rest = Duration::from_secs(seconds).saturating_sub(begun.elapsed());
    tokio::time::sleep(rest).await;
    seen.alarms_per_s = rate(kept(&database)?);
    seen.rss_after_kib = rss_kib(ground.child.id());
    seen.server_rss_kib = server.rss_kib();
    flights.stop.store(true, Ordering::Relaxed);
    for one in aircraft {
        let _ = tokio::time::timeout(2 * PATIENCE, one).await;
    }
    let landed = Instant::now();
    while kept(&database)? < flights.confirmed() && landed.elapsed() < DRAIN {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    seen.drain_s = landed.elapsed().as_secs_f64();
    seen.confirmed = flights.confirmed();
    seen.published_again = flights.again.load(Ordering::Relaxed);
    seen.event_bytes = streams.events.load(Ordering::Relaxed);
    Ok(seen)
}

async fn connect(url: &str) -> Result<jetstream::Context, LoadError> {
    let client = async_nats::ConnectOptions::new()
        // Its first attempt waits as well.
        .reconnect_delay_callback(|attempts| match attempts {
            0 | 1 => Duration::ZERO,
            _ => Duration::from_millis(200),
        })
        .connect(url)
        .await
        .map_err(|source| LoadError::Bus {
            doing: "can't be reached",
            source: source.into(),
        })?;
    let mut context = jetstream::with_domain(client, "hub");
    context.set_timeout(PATIENCE);
    Ok(context)
}

/// One aircraft: one alarm after the other, a new fire after every hundred revisions.
async fn fly(context: jetstream::Context, number: usize, flights: Arc<Flights>) {
    let Some(flown) = flights.each.get(number) else {
        return;
    };
    for turn in 0u32.. {
        if flights.stop.load(Ordering::Relaxed) {
            return;
        }
        flown.begun.store(turn + 1, Ordering::Relaxed);
        while !is_confirmed(&context, number, turn).await {
            if flights.stop.load(Ordering::Relaxed) {
                return;
            }
            flights.again.fetch_add(1, Ordering::Relaxed);
        }
        flown.confirmed.store(turn + 1, Ordering::Relaxed);
    }
}

/// Publishes one alarm as a station does, and waits for the stream's word.
async fn is_confirmed(context: &jetstream::Context, number: usize, turn: u32) -> bool {
    let (fire, revision) = (turn / 100 + 1, turn % 100 + 1);
    let message = PublishMessage::build()
        .message_id(format!("load-{number}-{fire}/{revision}/full"))
        .payload(alarm(number, fire, revision).into());
    let subject = format!("fire.alarm.load-{number}");
    match context.send_publish(subject, message).await {
        Ok(confirmation) => confirmation.await.is_ok(),
        Err(_) => {
            tokio::time::sleep(PATIENCE / 10).await;
            false
        }
    }
}

// --- the audit -----------------------------------------------------------------------------------

/// Alarms on the ground's disk.
fn kept(database: &Path) -> Result<u64, LoadError> {
    let failed = unreadable(database);
    let connection = Connection::open(database).map_err(&failed)?;
    let found: Option<i64> = connection
        .query_row("SELECT max(row) FROM alarms", [], |row| row.get(0))
        .map_err(&failed)?;
    Ok(found.unwrap_or_default().unsigned_abs())
}

/// What the ground's disk has against what was published.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
struct Audit {
    on_disk: u64,
    /// Confirmed by the stream, and not on the disk with its capture time.
    lost: u64,
    /// On the disk a second time, or never published.
    duplicated: u64,
}

fn audit(database: &Path, flights: &Flights) -> Result<Audit, LoadError> {
    let failed = unreadable(database);
    let connection = Connection::open(database).map_err(&failed)?;
    let mut query = connection
        .prepare("SELECT id, revision, captured_at FROM alarms")
        .map_err(&failed)?;
    let rows = query
        .query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))
        .map_err(&failed)?;
    let rows: Vec<(String, u32, String)> = rows.collect::<Result<_, _>>().map_err(&failed)?;
    Ok(compare(&rows, flights))
}

fn compare(rows: &[(String, u32, String)], flights: &Flights) -> Audit {
    let begun = |flown: &Flown| vec![false; flown.begun.load(Ordering::Relaxed) as usize];
    let mut found: Vec<Vec<bool>> = flights.each.iter().map(begun).collect();
    let mut audit = Audit {
        on_disk: rows.len() as u64,
        ..Audit::default()
    };
    for (id, revision, captured_at) in rows {
        let turn = turn_of(id, *revision, captured_at);
        let place = turn.and_then(|(number, turn)| found.get_mut(number)?.get_mut(turn));
        match place {
            Some(place) if !*place => *place = true,
            _ => audit.duplicated += 1,
        }
    }
    for (flown, found) in flights.each.iter().zip(&found) {
        let confirmed = flown.confirmed.load(Ordering::Relaxed) as usize;
        audit.lost += found.iter().take(confirmed).filter(|here| !**here).count() as u64;
    }
    audit
}

/// Aircraft and turn of a row; none when it is no alarm of ours as it was told.
fn turn_of(id: &str, revision: u32, captured_at: &str) -> Option<(usize, usize)> {
    let (number, fire) = id.strip_prefix("load-")?.split_once('-')?;
    let (number, fire): (usize, u32) = (number.parse().ok()?, fire.parse().ok()?);
    let second = format!("2026-03-01T12:{:02}:{:02}", revision / 60, revision % 60);
    if !captured_at.starts_with(&second) || !(1..=100).contains(&revision) {
        return None;
    }
    let turn = fire.checked_sub(1)?.checked_mul(100)? + revision - 1;
    Some((number, turn as usize))
}

// --- the report ----------------------------------------------------------------------------------

fn report(seen: Seen, audit: Audit) -> Report {
    let n = usize::try_from(seen.confirmed).unwrap_or(usize::MAX);
    let none = |name, count: u64| {
        Figure::bounded(name, Some(count as f64), "alarms", Bound::Equals(0.0), n)
    };
    let growth = seen.rss_after_kib as f64 / seen.rss_before_kib.max(1) as f64;
    let figures = vec![
        Figure::bounded(
            "ground.nats_alarms_per_s",
            Some(seen.alarms_per_s),
            "1/s",
            Bound::AtLeast(LEAST),
            n,
        ),
        none("ground.nats_lost", audit.lost),
        none("ground.nats_duplicated", audit.duplicated),
        Figure::bounded(
            "ground.nats_rss_growth",
            Some(growth),
            "ratio",
            Bound::AtMost(1.2),
            n,
        ),
    ];
    Report {
        figures,
        tables: vec![table(&seen, &audit)],
        details: serde_json::json!({ "nats": seen, "audit": audit }),
        plots: Vec::new(),
    }
}

fn table(seen: &Seen, audit: &Audit) -> Table {
    let mib = |kib: u64| format!("{:.1}", kib as f64 / 1024.0);
    let columns = [
        ("alarms/s", format!("{:.0}", seen.alarms_per_s)),
        ("before the kill", format!("{:.0}", seen.undisturbed_per_s)),
        ("confirmed", seen.confirmed.to_string()),
        ("on disk", audit.on_disk.to_string()),
        ("published again", seen.published_again.to_string()),
        ("drained s", format!("{:.1}", seen.drain_s)),
        (
            "streams MB",
            format!("{:.0}", seen.event_bytes as f64 / 1e6),
        ),
        ("RSS before MiB", mib(seen.rss_before_kib)),
        ("after MiB", mib(seen.rss_after_kib)),
        ("nats-server MiB", mib(seen.server_rss_kib)),
    ];
    let (header, cells) = columns.into_iter().map(|(h, c)| (h.to_owned(), c)).unzip();
    Table {
        title: format!(
            "Through NATS JetStream, its server killed and {} s away: {AIRCRAFT} aircraft, {BROWSERS} event streams",
            AWAY.as_secs()
        ),
        header,
        rows: vec![cells],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flights(begun: u32, confirmed: u32) -> Flights {
        let flown = Flown {
            begun: begun.into(),
            confirmed: confirmed.into(),
        };
        Flights {
            each: vec![flown],
            ..Flights::default()
        }
    }

    fn row(fire: u32, revision: u32) -> (String, u32, String) {
        let at = format!("2026-03-01T12:00:{revision:02}.000000000Z");
        (format!("load-0-{fire}"), revision, at)
    }

    #[test]
    fn the_audit_sees_what_is_missing_what_is_twice_and_what_nobody_sent() {
        let whole = [row(1, 1), row(1, 2), row(1, 3)];
        let audit = |rows: &[_], begun, confirmed| compare(rows, &flights(begun, confirmed));
        let found = audit(&whole, 3, 3);
        assert_eq!((found.lost, found.duplicated), (0, 0));
        // What was begun and not confirmed may be there or not.
        assert_eq!(audit(&whole[..2], 3, 2).lost, 0);
        assert_eq!(audit(&whole[..2], 3, 3).lost, 1);
        let twice = [&whole[..], &whole[1..2]].concat();
        assert_eq!(audit(&twice, 3, 3).duplicated, 1);
        assert_eq!(audit(&whole, 2, 2).duplicated, 1, "never published");
        let mut late = whole;
        late[0].2 = "2026-03-01T12:00:59.000000000Z".to_owned();
        let found = audit(&late, 3, 3);
        assert_eq!(
            (found.lost, found.duplicated),
            (1, 1),
            "another capture time"
        );
    }
}
