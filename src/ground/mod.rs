//! The ground station's side: receive, merge, store, show, pass on.
//!
//! **Purpose.** `emberfix ground CONFIG` takes alarms from aircraft over HTTP and over MAVLink, keeps
//! each one on disk before it acknowledges it, and shows what it has to people and programs.
//!
//! **In.** `POST /alarms`: one GeoJSON Feature ([`crate::alarm`]). `POST /alarms/test`: likewise, checked
//! and shown as a test, and kept nowhere. `POST /track`: where an aircraft is ([`Ping`]). MAVLink: `COMMAND_INT` `MAV_CMD_SPATIAL_USER_1` (an alarm's summary) and
//! `GLOBAL_POSITION_INT`.
//!
//! **Out.** `GET /alarms.geojson` (FeatureCollection: the newest revision of every incident),
//! `GET /events` (server-sent events, resumable), `GET /track.geojson`, `GET /health`, and `GET /`,
//! one page that needs nothing from elsewhere. Places are WGS84 degrees and ellipsoid height.
//!
//! **Promises.** An acknowledged alarm is on disk (SQLite, synced). Delivered again it is
//! acknowledged again and changes nothing; an older revision never replaces a newer one; a summary
//! that came over MAVLink never replaces the whole alarm of the same revision.
//!
//! **Doors.** A loopback address serves everyone on the machine. Any other needs TLS and tokens or client
//! certificates (`access`: aircraft post, screens read, operators act). What is refused is counted in
//! `/health`.
//!
//! **Ways inside.** What comes goes through one queue to one `writer`, which keeps the book
//! (`book`: who is one fire with whom), commits a batch with one sync, and only then answers and
//! shows it on the `board`.
//!
//! **Known limits.** Aircraft tracks live in memory ([`tracks::MAX_POINTS`] points each) and start anew with the process.

mod access;
pub mod action;
#[cfg(test)]
mod attackers;
mod board;
mod book;
mod bus;
#[cfg(test)]
mod bus_tests;
pub mod chips;
pub mod config;
mod datagram;
mod doors;
mod events;
#[cfg(test)]
mod faults;
mod http;
pub mod incident;
mod ledger;
mod mavlink;
mod merge;
mod page;
pub mod receive;
mod screens;
mod server;
mod session;
pub mod store;
#[cfg(test)]
mod tests;
pub mod tracks;
mod writer;

pub use bus::nats_server;
pub use chips::ChipError;
pub use config::{ConfigError, GroundConfig, Overrides};
pub use incident::{Incident, News};
pub use screens::{CapError, TakError};
pub use store::StoreError;
pub use tracks::{Ping, PingError};
pub use writer::{Done, Order, OrderError};

use crate::alarm::{Alarm, AlarmError};
use access::Doorkeeper;
use board::Board;
use bus::BusHealth;
use chips::Chips;
use emberfix_frames::{CovarianceError, ServiceTime};
use emberfix_mav::{Link, LinkError};
use screens::Screens;
use server::{Door, Turned};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLockReadGuard};
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use store::postgres::Postgres;
use store::sqlite::Sqlite;
use store::{Completeness, Delivery, Kept, Store};
use tokio::sync::{broadcast, watch};
use tokio::task::JoinHandle;
use tracks::{Source, Tracks};
use writer::{Published, Writer};

/// Notices that a slow event stream may lag behind; the oldest are then skipped, for it.
const NOTICES_QUEUED: usize = 64;
/// Longest reason of a refusal that is shown, characters: it may quote what came.
const MAX_REASON: usize = 300;
/// How long open requests may go on after a stop was asked for.
const GRACE: Duration = Duration::from_secs(3);

/// Why the ground station did not start, or stopped.
#[derive(Debug, thiserror::Error)]
pub enum GroundError {
    /// The configuration was refused.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The store can't be opened or used.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The address can't be listened on.
    #[error("can't listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// The folder of images can't be opened.
    #[error(transparent)]
    Chips(#[from] ChipError),
    /// CAP messages can't be kept.
    #[error(transparent)]
    Cap(#[from] CapError),
    /// A TAK server can't be reached as configured.
    #[error(transparent)]
    Tak(#[from] TakError),
    /// The Foxglove live view can't listen.
    #[error("foxglove.listen: {source}")]
    Foxglove {
        /// What it said.
        #[from]
        source: foxglove::FoxgloveError,
    },
    /// Certificate or key can't be read any more.
    #[error("{reason}")]
    Tls {
        /// Which, and why.
        reason: String,
    },
    /// The receiving end can't be opened.
    #[error(transparent)]
    Reception(#[from] receive::ReceptionError),
    /// MAVLink signing has no state to go on from.
    #[error(transparent)]
    Signing(#[from] crate::deliver::signing_file::SigningFileError),
    /// The MAVLink port can't be opened.
    #[error(transparent)]
    Mavlink(#[from] LinkError),
    /// The HTTP server ended.
    #[error("the HTTP server ended: {source}")]
    Serve {
        /// What the system said.
        source: std::io::Error,
    },
}

impl GroundError {
    /// True when the configuration is to blame (exit code 2), not the run (exit code 1).
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        matches!(self, Self::Config(_))
    }
}

/// Why an alarm was not taken.
#[derive(Debug, thiserror::Error)]
pub enum ReceiveError {
    /// It is no alarm.
    #[error(transparent)]
    Alarm(#[from] AlarmError),
    /// Its covariance is none.
    #[error("alarm property covariance_enu_m2: {source}")]
    Covariance {
        /// What is wrong with the matrix.
        #[from]
        source: CovarianceError,
    },
    /// It could not be kept.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// It is not who it says it is.
    #[error(transparent)]
    Trust(#[from] receive::TrustError),
    /// Its signed head can't be read.
    #[error(transparent)]
    Envelope(#[from] crate::deliver::envelope::EnvelopeError),
    /// It could not be entered into the books.
    #[error(transparent)]
    Ledger(#[from] ledger::LedgerError),
}

/// Runs the ground station until SIGINT or SIGTERM.
///
/// # Errors
/// [`GroundError`]; see [`GroundError::is_refusal`] for the exit code.
pub async fn run(config: &Path, overrides: Overrides) -> Result<(), GroundError> {
    let config = GroundConfig::load(config, overrides)?;
    let data_dir = config.data_dir.clone();
    let scheme = scheme(&config);
    let ground = Ground::start(config).await?;
    // The line that people and programs wait for; with port 0 only it knows the port.
    eprintln!(
        "emberfix ground: this station's public key, for missions: [ground] public_key = \"{}\"",
        ground.station.reception.public_key()
    );
    eprintln!(
        "emberfix ground: {scheme}://{} keeps alarms in {}",
        ground.address(),
        data_dir.display()
    );
    ground.run_until(stop_signal()).await
}

fn scheme(config: &GroundConfig) -> &'static str {
    if config.doors.tls.is_some() {
        "https"
    } else {
        "http"
    }
}

async fn stop_signal() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else {
        return std::future::pending().await;
    };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = tokio::signal::ctrl_c() => {}
    }
}

/// A running ground station.
#[derive(Debug)]
pub struct Ground {
    address: SocketAddr,
    station: Arc<Station>,
    server: JoinHandle<std::io::Result<()>>,
}

impl Ground {
    /// Opens the store, listens, and starts to serve.
    ///
    /// # Errors
    /// [`GroundError`] when the store or the address can't be opened.
    pub async fn start(config: GroundConfig) -> Result<Self, GroundError> {
        let door = door(&config)?;
        let signed = config.keyring().has_keys();
        let station = Arc::new(Station::open(&config, Arc::clone(&door.turned)).await?);
        if let Some(bus) = config.doors.bus.clone() {
            tokio::spawn(bus::run(Arc::clone(&station), bus));
        }
        if let Some(mavlink) = config.mavlink {
            let link = Link::open(&mavlink.url).await?;
            let signing = mavlink::open_signing(&mavlink, &config.data_dir)?;
            tokio::spawn(mavlink::run(
                Arc::clone(&station),
                link,
                signing,
                mavlink,
                config.uavs,
            ));
        }
        let in_use = |source| GroundError::Listen {
            address: config.listen,
            source,
        };
        screens::start(&station, config.screens).await?;
        let socket = tokio::net::TcpListener::bind(config.listen)
            .await
            .map_err(in_use)?;
        let address = socket.local_addr().map_err(in_use)?;
        // Beyond this machine, only signed datagrams: nothing else says who sends.
        if config.datagrams && (address.ip().is_loopback() || signed) {
            let socket = tokio::net::UdpSocket::bind(address).await.map_err(in_use)?;
            tokio::spawn(datagram::run(Arc::clone(&station), socket));
        } else if config.datagrams {
            eprintln!(
                "emberfix: no datagrams: beyond this machine they have to be signed, and no [[uav]] has a \
                 public_key (emberfix keys MISSION prints it on the aircraft); alarms come by HTTP alone; \
                 datagrams = false says that this is meant"
            );
        }
        let names = Arc::from(config.host_names.as_slice());
        let keeper = Doorkeeper::new(config.doors.accesses, door.tls.is_some());
        let app = http::router(Arc::clone(&station), names, keeper);
        let server = server::serve(socket, app, door, station.stopping.subscribe());
        let server = tokio::spawn(server);
        Ok(Self {
            address,
            station,
            server,
        })
    }

    /// The address that it listens on.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Stops: open event streams end, open requests get three seconds to finish.
    ///
    /// # Errors
    /// [`GroundError::Serve`] when the server had already failed.
    pub async fn stop(self) -> Result<(), GroundError> {
        self.run_until(std::future::ready(())).await
    }

    async fn run_until(mut self, stop: impl Future<Output = ()>) -> Result<(), GroundError> {
        tokio::select! {
            ended = &mut self.server => return served(ended),
            () = stop => {}
        }
        self.station.stopping.send_replace(true);
        match tokio::time::timeout(GRACE, &mut self.server).await {
            Ok(ended) => served(ended),
            Err(_) => {
                self.server.abort();
                Ok(())
            }
        }
    }
}

fn door(config: &GroundConfig) -> Result<Door, GroundError> {
    let acceptor = config.doors.tls.as_ref().map(doors::TlsFiles::acceptor);
    Ok(Door {
        limits: config.doors.limits,
        tls: acceptor
            .transpose()
            .map_err(|reason| GroundError::Tls { reason })?,
        turned: Arc::default(),
    })
}

fn served(ended: Result<std::io::Result<()>, tokio::task::JoinError>) -> Result<(), GroundError> {
    let source = match ended {
        Ok(Ok(())) => return Ok(()),
        Ok(Err(source)) => source,
        Err(source) => std::io::Error::other(source),
    };
    Err(GroundError::Serve { source })
}

/// Something that open event streams tell, and that is not repeated to later ones.
#[derive(Debug, Clone)]
struct Notice {
    /// Name of the event.
    kind: &'static str,
    /// JSON on one line.
    data: Arc<str>,
}

/// What every edge of the ground station shares.
#[derive(Debug)]
pub(crate) struct Station {
    store: Arc<dyn Store>,
    writer: Writer,
    /// What stands, and the newest row of the journal; only ever what is on disk.
    published: Arc<Published>,
    chips: Arc<Mutex<Chips>>,
    screens: Screens,
    tracks: Mutex<Tracks>,
    /// What is told once. Bound: [`NOTICES_QUEUED`]; loss: oldest first, per stream.
    notices: broadcast::Sender<Notice>,
    stopping: watch::Sender<bool>,
    counters: Counters,
    mavlink: Mutex<Option<mavlink::LinkHealth>>,
    bus: BusHealth,
    /// Connections that were turned away.
    turned: Arc<Turned>,
    /// Requests that were refused, by HTTP status.
    refusals: Mutex<BTreeMap<u16, u64>>,
    reception: receive::Reception,
    /// `http` or `https`, as this program serves.
    scheme: &'static str,
    /// How others reach the station, where it is not what they ask for.
    public_url: Option<String>,
}

#[derive(Debug, Default)]
struct Counters {
    stored: AtomicU64,
    repeated: AtomicU64,
    refused: AtomicU64,
    streams: AtomicU64,
}

impl Station {
    async fn open(config: &GroundConfig, turned: Arc<Turned>) -> Result<Self, GroundError> {
        let config = config.clone();
        tokio::task::spawn_blocking(move || Self::open_here(&config, turned))
            .await
            .unwrap_or(Err(StoreError::Stopped.into()))
    }

    /// Blocks.
    fn open_here(config: &GroundConfig, turned: Arc<Turned>) -> Result<Self, GroundError> {
        let store: Arc<dyn Store> = match &config.doors.postgres {
            Some(server) => Arc::new(Postgres::open(&server.url, server.authority.as_deref())?),
            None => Arc::new(Sqlite::open(&config.data_dir)?),
        };
        let chips = Arc::new(Mutex::new(Chips::open(config.data_dir.join("chips"))?));
        let seen = Arc::clone(&chips);
        let has_chip = Box::new(move |alarm: &str| lock(&seen).has(alarm));
        let (writer, published) = Writer::start(Arc::clone(&store), config.exercise, has_chip)?;
        Ok(Self {
            store,
            writer,
            published,
            chips,
            screens: Screens::open(&config.screens, &config.data_dir)?,
            tracks: Mutex::default(),
            notices: broadcast::Sender::new(NOTICES_QUEUED),
            stopping: watch::Sender::new(false),
            counters: Counters::default(),
            mavlink: Mutex::default(),
            bus: BusHealth::default(),
            turned,
            refusals: Mutex::default(),
            reception: receive::Reception::open(&config.data_dir, config.keyring())?,
            scheme: scheme(config),
            public_url: config.public_url.clone(),
        })
    }

    /// Checks and keeps one alarm; when this returns `Ok`, it is on disk.
    async fn receive(
        &self,
        raw: &[u8],
        link: &'static str,
        completeness: Completeness,
    ) -> Result<(Alarm, Kept), ReceiveError> {
        let kept = self.check_and_keep(raw, link, completeness).await;
        match &kept {
            Ok((_, Kept::New { .. })) => self.counters.stored.fetch_add(1, Ordering::Relaxed),
            Ok((_, Kept::Again)) => self.counters.repeated.fetch_add(1, Ordering::Relaxed),
            Err(error) => {
                self.refuse(error, link);
                return kept;
            }
        };
        kept
    }

    async fn check_and_keep(
        &self,
        raw: &[u8],
        link: &'static str,
        completeness: Completeness,
    ) -> Result<(Alarm, Kept), ReceiveError> {
        let alarm = Alarm::from_geojson(raw)?;
        alarm.covariance()?;
        let delivery = Delivery {
            alarm: alarm.clone(),
            raw: String::from_utf8_lossy(raw).into_owned(),
            received_at: now(),
            link,
            completeness,
        };
        let kept = self.writer.keep(delivery).await?;
        Ok((alarm, kept))
    }

    /// All incidents that stand in memory, by id. Older ones are on disk ([`store::Search`]).
    pub(crate) fn incidents(&self) -> Vec<Arc<Incident>> {
        self.board().all().cloned().collect()
    }

    /// An incident by its id; of one that went into another, that other.
    pub(crate) fn incident(&self, id: &str) -> Option<Arc<Incident>> {
        self.board().get(id).cloned()
    }

    /// At most `limit` incidents that changed after a row of the journal, each once and as it is
    /// now, oldest change first. Go on from the last one's row, and wait with [`Self::rows`].
    pub(crate) fn incidents_since(&self, row: i64, limit: usize) -> Vec<News> {
        self.board().since(row, limit)
    }

    /// The newest row of the journal, whenever it rises.
    pub(crate) fn rows(&self) -> watch::Receiver<i64> {
        self.published.newest_row.subscribe()
    }

    /// Carries out and records what an operator orders.
    pub(crate) async fn act(&self, order: Order) -> Result<Done, OrderError> {
        self.writer.act(order).await
    }

    /// An aircraft says up to where it has learnt what operators did. Written down behind its back;
    /// lost in a crash, it is said again with the next question.
    fn fetched(self: &Arc<Self>, uav: String, number: i64) {
        if number <= 0 || uav.len() > 64 {
            return;
        }
        let writer = self.writer.clone();
        tokio::spawn(async move { drop(writer.fetched(uav, number, now()).await) });
    }

    /// Keeps the image of an alarm unless a newer one is there; true when it was kept.
    pub(crate) async fn keep_chip(
        &self,
        alarm: &str,
        revision: u32,
        jpeg: Vec<u8>,
    ) -> Result<bool, ChipError> {
        let (chips, id) = (Arc::clone(&self.chips), alarm.to_owned());
        let kept = tokio::task::spawn_blocking(move || lock(&chips).keep(&id, revision, &jpeg));
        let kept = kept.await.unwrap_or(Ok(false))?;
        if kept {
            self.writer.chip(alarm.to_owned());
        }
        Ok(kept)
    }

    /// Where the image of an incident lies: that of the alarm that was seen last.
    pub(crate) fn chip_of(&self, incident: &Incident) -> Option<PathBuf> {
        let chips = lock(&self.chips);
        let with = incident
            .alarms
            .iter()
            .filter(|member| chips.has(&member.alarm));
        chips.find(&with.max_by_key(|member| member.captured_at)?.alarm)
    }

    fn board(&self) -> RwLockReadGuard<'_, Board> {
        self.published
            .board
            .read()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Checks a test alarm as if it were one, and shows that a test came. Nothing is kept.
    fn test(&self, raw: &[u8], link: &'static str) -> Result<Alarm, ReceiveError> {
        let alarm = Alarm::from_geojson(raw)?;
        alarm.covariance()?;
        let uav: String = alarm.properties.uav.chars().take(MAX_REASON).collect();
        let data = serde_json::json!({ "at": now().rfc3339(), "link": link, "uav": uav });
        self.tell(Notice {
            kind: "test",
            data: data.to_string().into(),
        });
        Ok(alarm)
    }

    /// Runs work on the store where it may block.
    async fn with_store<T: Send + 'static>(
        &self,
        work: impl FnOnce(&dyn Store) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, StoreError> {
        let store = Arc::clone(&self.store);
        tokio::task::spawn_blocking(move || work(store.as_ref()))
            .await
            .unwrap_or(Err(StoreError::Stopped))
    }

    /// Takes a position and passes it on to the open streams.
    fn moved(&self, ping: Ping, source: Source) -> Result<(), PingError> {
        if let Some(told) = self.tracks().take(ping, source)? {
            self.tell(Notice {
                kind: "track",
                data: told.into(),
            });
        }
        Ok(())
    }

    /// Counts a refusal and shows it: an alarm that did not get in is news, too.
    fn refuse(&self, error: &dyn std::error::Error, link: &'static str) {
        self.counters.refused.fetch_add(1, Ordering::Relaxed);
        tracing::warn!(%error, link, "an alarm was refused");
        let reason: String = error.to_string().chars().take(MAX_REASON).collect();
        let data = serde_json::json!({ "at": now().rfc3339(), "link": link, "reason": reason });
        self.tell(Notice {
            kind: "refused",
            data: data.to_string().into(),
        });
    }

    fn tell(&self, notice: Notice) {
        // No receiver only means that nobody watches.
        let _ = self.notices.send(notice);
    }

    fn tracks(&self) -> MutexGuard<'_, Tracks> {
        lock(&self.tracks)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// UTC by the ground's own clock.
fn now() -> ServiceTime {
    let since = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    ServiceTime::from_unix_ns(i64::try_from(since.as_nanos()).unwrap_or(i64::MAX))
}

/// The database file in a data directory.
#[must_use]
pub fn database_in(data_dir: &Path) -> PathBuf {
    data_dir.join("ground.sqlite")
}
