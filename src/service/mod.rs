//! The live service: one thread for the pipeline, one task for MAVLink, one thread for the camera,
//! one for the links to the ground over IP.
//!
//! ```text
//! MAVLink task ──telemetry──> pipeline thread ──alarms──> outbox (disk) ──> MAVLink task, courier thread
//! camera thread ──newest pair──^        └──> recorder
//! ```
//!
//! **Queues.** Telemetry: [`TELEMETRY_QUEUE`] messages; beyond that the newest are dropped and
//! counted. Pairs: one; a newer pair replaces it, counted by the source. Alarms: on disk before any
//! link hears of them.
//!
//! **Health.** The heartbeat is sent only while the pipeline thread takes events in and its own
//! health report is clean.

mod camera;
mod core;
pub(crate) mod courier;
mod telemetry;

pub(crate) use telemetry::WANTED;

use crate::deliver::keys::{KeyError, SecretKey};
use crate::deliver::mavlink::MavlinkDelivery;
use crate::deliver::signing_file::{SigningFile, SigningFileError};
use crate::deliver::{DatagramDelivery, Outbox, OutboxError, Owner};
use crate::ground::Ping;
use crate::ingest::{CameraUrl, CameraUrlError, Expected, ServiceClock, SourceError};
use crate::mission::Mission;
use crate::pipeline::{Health, Pipeline};
use crate::record::{RecordError, RecordOptions, Recorder};
use emberfix_frames::ServiceTime;
use emberfix_mav::{Link, LinkError, LinkUrl, LinkUrlError, SystemId};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Messages that may wait for the pipeline: about a minute of a PX4 onboard link.
pub const TELEMETRY_QUEUE: usize = 16_384;
/// The links of the outbox.
pub const LINKS: [&str; 2] = [MavlinkDelivery::NAME, DatagramDelivery::NAME];

/// Why the service did not start, or stopped.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// The MAVLink URL is none.
    #[error("mavlink.url: {0}")]
    MavlinkUrl(#[from] LinkUrlError),
    /// The camera URL is none.
    #[error("camera.url: {0}")]
    CameraUrl(#[from] CameraUrlError),
    /// The MAVLink port can't be opened.
    #[error(transparent)]
    Mavlink(#[from] LinkError),
    /// The camera can't be opened.
    #[error(transparent)]
    Camera(#[from] SourceError),
    /// The outbox can't be opened or written.
    #[error(transparent)]
    Outbox(#[from] OutboxError),
    /// The key that alarms are signed with can't be had.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// MAVLink signing has no state to go on from.
    #[error(transparent)]
    Signing(#[from] SigningFileError),
    /// The recording can't be written.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The ground's address is none.
    #[error("{}", .0.in_one_line())]
    GroundUrl(crate::deliver::http::HttpError),
    /// A folder can't be made.
    #[error("can't make folder {path}: {source}", path = path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A thread can't be started.
    #[error("can't start a thread: {source}")]
    Thread {
        /// What the system said.
        source: std::io::Error,
    },
}

impl ServiceError {
    /// True when the configuration was refused, false when the work failed.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        match self {
            Self::MavlinkUrl(_) | Self::CameraUrl(_) | Self::GroundUrl(_) => true,
            Self::Camera(error) => error.is_refusal(),
            Self::Mavlink(_)
            | Self::Key(_)
            | Self::Signing(_)
            | Self::Outbox(_)
            | Self::Record(_)
            | Self::Folder { .. }
            | Self::Thread { .. } => false,
        }
    }
}

/// What the threads know of each other: the latest word only, no queue.
#[derive(Default)]
pub(crate) struct Board {
    latest: Mutex<Latest>,
    stopping: AtomicBool,
}

#[derive(Default, Clone)]
pub(crate) struct Latest {
    pub health: Health,
    pub reported: Option<Instant>,
    pub vehicle: Option<SystemId>,
    pub ping: Option<Ping>,
}

/// A pipeline that has not reported for this long hangs.
const PIPELINE_SILENCE: Duration = Duration::from_secs(3);

impl Board {
    pub fn latest(&self) -> MutexGuard<'_, Latest> {
        self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the heartbeat may say that we live.
    pub fn is_healthy(&self) -> bool {
        let latest = self.latest();
        latest.health.problems.is_empty()
            && latest
                .reported
                .is_some_and(|at| at.elapsed() < PIPELINE_SILENCE)
    }

    pub fn stop(&self) {
        self.stopping.store(true, Ordering::Relaxed);
    }

    pub fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }
}

/// The outbox, shared by the pipeline (which fills it) and the links (which empty it).
pub(crate) type SharedOutbox = Arc<Mutex<Outbox>>;

pub(crate) fn lock(outbox: &SharedOutbox) -> MutexGuard<'_, Outbox> {
    outbox.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The service clock: UTC read once, then carried on by the monotonic clock.
#[must_use]
pub fn service_clock() -> ServiceClock {
    let begun = Instant::now();
    let since_1970 = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    Arc::new(move || {
        let now = since_1970 + begun.elapsed();
        ServiceTime::from_unix_ns(i64::try_from(now.as_nanos()).unwrap_or(i64::MAX))
    })
}

/// Opens the outbox of a mission.
///
/// # Errors
/// [`ServiceError::Folder`] or [`ServiceError::Outbox`].
pub fn open_outbox(mission: &Mission) -> Result<Outbox, ServiceError> {
    let folder = &mission.state_dir;
    std::fs::create_dir_all(folder).map_err(|source| ServiceError::Folder {
        path: folder.clone(),
        source,
    })?;
    let key = SecretKey::load_or_make(&mission.key_file())?;
    let owner = Owner {
        uav: mission.uav.clone(),
        key: Some(key),
    };
    Ok(Outbox::open(&folder.join("outbox.sqlite"), &LINKS, owner)?)
}

/// What the ground has to know, said where whoever sets it up looks, once nothing can be refused any more.
fn tell_public_key(mission: &Mission, outbox: &Outbox) {
    if let Some(key) = outbox.key() {
        eprintln!(
            "emberfix: this aircraft's public key, for the ground: [[uav]] name = \"{}\" public_key = \"{}\"",
            mission.uav,
            key.public()
        );
    }
}

/// Runs until Ctrl-C or SIGTERM.
///
/// # Errors
/// [`ServiceError`]; [`ServiceError::is_refusal`] says which exit code it deserves.
pub async fn run(
    mission: Mission,
    pipeline: Pipeline,
    outbox: Outbox,
    record: Option<&Path>,
) -> Result<(), ServiceError> {
    let clock = service_clock();
    let mavlink_url: LinkUrl = mission.mavlink_url.parse()?;
    let camera_url: CameraUrl = mission.camera_url.parse()?;
    let link = Link::open(&mavlink_url).await?;
    let source = crate::ingest::open(&camera_url, &Expected::of(&mission.rig), Arc::clone(&clock))?;
    let courier = courier::IpCourier::new(
        &mission.ground,
        outbox.origin(),
        outbox.key().cloned(),
        rand::random(),
    );
    let courier = courier.map_err(ServiceError::GroundUrl)?;
    let signing = open_signing(&mission, &clock)?;
    let recorder = record
        .map(|path| Recorder::create(path, &mission.rig, &RecordOptions::default()))
        .transpose()?;
    tell_public_key(&mission, &outbox);

    let board = Arc::new(Board::default());
    let outbox: SharedOutbox = Arc::new(Mutex::new(outbox));
    let (events, inbox) = sync_channel(TELEMETRY_QUEUE);
    let slot = camera::Slot::default();
    let thread_failed = |source| ServiceError::Thread { source };
    let looking = camera::start(source, slot.clone(), events.clone(), Arc::clone(&board));
    let looking = looking.map_err(thread_failed)?;
    let worker = core::Core {
        pipeline,
        recorder,
        outbox: Arc::clone(&outbox),
        board: Arc::clone(&board),
        clock: Arc::clone(&clock),
        uav: mission.uav.clone(),
        datum: mission.datum,
        unstored: std::collections::BTreeMap::new(),
    };
    let working = core::start(worker, inbox, slot).map_err(thread_failed)?;
    let around = courier::Surroundings {
        outbox: Arc::clone(&outbox),
        board: Arc::clone(&board),
        clock: Arc::clone(&clock),
        events: Some(events.clone()),
    };
    let telling = courier
        .map(|courier| courier.start(around))
        .transpose()
        .map_err(thread_failed)?;
    let talk = telemetry::Talk::new(
        link,
        signing,
        &mission,
        Arc::clone(&outbox),
        Arc::clone(&board),
        clock,
    );
    eprintln!(
        "emberfix: ready, mission {}, MAVLink {}, camera {}",
        mission.name, mission.mavlink_url, mission.camera_url
    );
    let mut talking = tokio::spawn(talk.run(events));
    tokio::select! {
        () = until_told_to_stop() => {}
        _ = &mut talking => {}
    }
    board.stop();
    talking.abort();
    for thread in [Some(working), Some(looking), telling]
        .into_iter()
        .flatten()
    {
        // A thread that panicked has said so on standard error already.
        let _ended = tokio::task::spawn_blocking(move || thread.join()).await;
    }
    Ok(())
}

fn open_signing(
    mission: &Mission,
    clock: &ServiceClock,
) -> Result<Option<SigningFile>, SigningFileError> {
    let Some(signing) = &mission.mavlink_signing else {
        return Ok(None);
    };
    let path = mission.state_dir.join("mavlink-signing.json");
    let (key, ids) = (signing.key.clone(), signing.unsigned_ids.clone());
    SigningFile::open(&path, key, ids, clock()).map(Some)
}

async fn until_told_to_stop() {
    let terminated = async {
        match tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate()) {
            Ok(mut signal) => {
                signal.recv().await;
            }
            Err(_) => std::future::pending().await,
        }
    };
    tokio::select! {
        _ = tokio::signal::ctrl_c() => {}
        () = terminated => {}
    }
}
