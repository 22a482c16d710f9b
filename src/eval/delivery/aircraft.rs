//! The aircraft's side in a process of its own: the real outbox and courier, and fires that are made
//! up. Says on standard output what it put, once the outbox has it.

use super::DeliveryError;
use super::quic::{self, Congestion};
use crate::alarm::{Alarm, AlarmClass, AlarmProperties, FireId, FireState, Method};
use crate::deliver::keys::{PublicKey, SecretKey};
use crate::deliver::{DatagramDelivery, Outbox, Owner, alarm_id};
use crate::mission::GroundLinks;
use crate::service::courier::{IpCourier, Surroundings};
use crate::service::{Board, service_clock};
use emberfix_frames::{EllipsoidHeight, ServiceTime, place_from_degrees};
use rand::{Rng as _, SeedableRng as _};
use std::io::{BufRead as _, Write as _};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// What the child is told.
#[derive(Debug, Clone, clap::Args)]
pub struct AircraftArguments {
    /// Folder of outbox and key.
    #[arg(long)]
    pub folder: PathBuf,
    /// Name of the aircraft.
    #[arg(long)]
    pub uav: String,
    /// Address of the ground.
    #[arg(long)]
    pub ground: String,
    /// The ground's public key.
    #[arg(long)]
    pub ground_key: PublicKey,
    /// Without datagrams: HTTP alone.
    #[arg(long)]
    pub http_only: bool,
    /// QUIC instead, to who has this certificate (DER).
    #[arg(long)]
    pub quic: Option<PathBuf>,
    /// How QUIC lets itself send.
    #[arg(long, default_value = "cubic")]
    pub congestion: Congestion,
    /// Between two alarms, milliseconds.
    #[arg(long)]
    pub every_ms: u64,
    /// Share of alarms that are a new revision of a fire that was told.
    #[arg(long)]
    pub revisions: f64,
    /// Seed of the fires.
    #[arg(long)]
    pub seed: u64,
}

/// Fires that a new revision may be about.
const REMEMBERED: usize = 40;

/// Puts alarms until standard input ends, then waits until all are delivered.
///
/// # Errors
/// [`DeliveryError`].
pub fn fly(arguments: &AircraftArguments) -> Result<(), DeliveryError> {
    let path = arguments.folder.join("outbox.sqlite");
    let key = SecretKey::load_or_make(&arguments.folder.join("uav.key"))?;
    let owner = Owner {
        uav: arguments.uav.clone(),
        key: Some(key.clone()),
    };
    let outbox = Outbox::open(&path, &[DatagramDelivery::NAME], owner)?;
    let board = Arc::new(Board::default());
    let outbox = Arc::new(Mutex::new(outbox));
    let thread = match &arguments.quic {
        None => start_courier(arguments, &outbox, key, &board)?,
        Some(certificate) => {
            let place = arguments.ground.trim_start_matches("http://");
            let to = place.parse().map_err(|_| DeliveryError::Thread)?;
            let (outbox, board) = (Arc::clone(&outbox), Arc::clone(&board));
            quic::carry(outbox, board, to, certificate, arguments.congestion)?
        }
    };
    say("ready");
    put_until_told(arguments, &outbox)?;
    wait_until_empty(&outbox)?;
    board.stop();
    thread.join().map_err(|_| DeliveryError::Thread)
}

/// What the service itself sends with.
fn start_courier(
    arguments: &AircraftArguments,
    outbox: &SharedOutbox,
    key: SecretKey,
    board: &Arc<Board>,
) -> Result<std::thread::JoinHandle<()>, DeliveryError> {
    let links = GroundLinks {
        url: Some(arguments.ground.clone()),
        credentials: crate::deliver::Credentials::default(),
        datagrams: !arguments.http_only,
        public_key: Some(arguments.ground_key),
        agent: (254, 191),
    };
    let origin = lock(outbox).origin();
    let courier = IpCourier::new(&links, origin, Some(key), rand::random());
    let around = Surroundings {
        outbox: Arc::clone(outbox),
        board: Arc::clone(board),
        clock: service_clock(),
        events: None,
    };
    let courier = courier.ok().flatten().ok_or(DeliveryError::Thread)?;
    courier
        .start(around)
        .map_err(super::io("start the courier"))
}

type SharedOutbox = Arc<Mutex<Outbox>>;

fn lock(outbox: &SharedOutbox) -> std::sync::MutexGuard<'_, Outbox> {
    outbox.lock().unwrap_or_else(PoisonError::into_inner)
}

fn put_until_told(
    arguments: &AircraftArguments,
    outbox: &SharedOutbox,
) -> Result<(), DeliveryError> {
    let ended = Arc::new(AtomicBool::new(false));
    let theirs = Arc::clone(&ended);
    std::thread::spawn(move || {
        // Ends with standard input.
        let _lines = std::io::stdin().lock().lines().count();
        theirs.store(true, Ordering::Relaxed);
    });
    let mut fires = Fires::of(&arguments.uav, arguments.revisions, arguments.seed);
    let clock = service_clock();
    let mut next = Instant::now();
    while !ended.load(Ordering::Relaxed) {
        if Instant::now() < next {
            std::thread::sleep(Duration::from_millis(1));
            continue;
        }
        next += Duration::from_millis(arguments.every_ms);
        let decided = clock();
        let alarm = fires.next(&mut lock(outbox), decided)?;
        // Said beforehand, too: a kill may come between the outbox's disk and the saying.
        tell("putting", &alarm, decided);
        let put = lock(outbox).put(&alarm, decided);
        tell(if put.is_ok() { "put" } else { "refused" }, &alarm, decided);
    }
    Ok(())
}

/// What, id, revision, capture time, time of decision.
fn tell(what: &str, alarm: &Alarm, decided: ServiceTime) {
    let properties = &alarm.properties;
    say(&format!(
        "{what} {} {} {} {}",
        properties.id,
        properties.revision,
        properties.captured_at.unix_ns(),
        decided.unix_ns()
    ));
}

fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    // Who listens may have been killed.
    let _told = writeln!(out, "{line}").and_then(|()| out.flush());
}

fn wait_until_empty(outbox: &SharedOutbox) -> Result<(), DeliveryError> {
    while lock(outbox).waiting(DatagramDelivery::NAME)? > 0 {
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

struct Fires {
    uav: String,
    revisions: f64,
    random: rand_chacha::ChaCha8Rng,
    told: Vec<Alarm>,
}

impl Fires {
    fn of(uav: &str, revisions: f64, seed: u64) -> Self {
        Self {
            uav: uav.to_owned(),
            revisions,
            random: rand_chacha::ChaCha8Rng::seed_from_u64(seed),
            told: Vec::new(),
        }
    }

    fn next(&mut self, outbox: &mut Outbox, now: ServiceTime) -> Result<Alarm, DeliveryError> {
        let again = !self.told.is_empty() && self.random.random_bool(self.revisions);
        let alarm = if again {
            let which = self.random.random_range(0..self.told.len());
            let mut alarm = self.told.remove(which);
            alarm.properties.revision += 1;
            alarm.properties.captured_at = now;
            alarm
        } else {
            self.new_fire(outbox.next_fire_number()?, now)?
        };
        self.told.push(alarm.clone());
        if self.told.len() > REMEMBERED {
            self.told.remove(0);
        }
        Ok(alarm)
    }

    fn new_fire(&mut self, number: FireId, now: ServiceTime) -> Result<Alarm, DeliveryError> {
        let mut about = |middle: f64, width: f64| middle + self.random.random_range(-width..width);
        let (latitude, longitude) = (about(31.4, 0.02), about(119.1, 0.02));
        let height = EllipsoidHeight::from_m(about(20.0, 10.0));
        let (e, n, u) = (about(1.5, 0.5), about(1.5, 0.5), about(4.0, 1.0));
        let (ce90_m, le90_m) = (about(3.0, 1.0), about(3.5, 1.0));
        Ok(Alarm {
            place: place_from_degrees(latitude, longitude, height)?,
            properties: AlarmProperties {
                id: alarm_id(&self.uav, number),
                revision: 1,
                uav: self.uav.clone(),
                class: AlarmClass::Fire,
                state: FireState::Confirmed,
                confidence: about(0.9, 0.09),
                first_seen_at: now,
                captured_at: now,
                altitude_msl_m: about(10.0, 5.0),
                height_above_ground_m: None,
                ce90_m,
                le90_m,
                covariance_enu_m2: [e, 0.1, 0.0, 0.1, n, 0.0, 0.0, 0.0, u],
                methods: vec![Method::Stereo, Method::Parallax],
                sightings: 8,
                range_m: about(80.0, 40.0),
                size_m: None,
                trend: None,
                advice: None,
                burning: crate::alarm::Burning::default(),
                degraded: Vec::new(),
            },
        })
    }
}

/// A fire of `uav` with this number.
pub(super) fn a_fire(uav: &str, number: u32, now: ServiceTime) -> Result<Alarm, DeliveryError> {
    Fires::of(uav, 0.0, number.into()).new_fire(FireId(number), now)
}
