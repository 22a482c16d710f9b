//! A flight in real time: MAVLink over UDP, stereo pairs over a socket.
//!
//! **In:** a [`Mission`] and the service's URLs. **Out:** what was sent and heard. The flight begins
//! [`LEAD_IN_S`] after the service has opened its camera socket; until then only the autopilot talks.
//!
//! **Queues.** The first [`HEAD_START`] pairs are rendered before take-off ([`LiveFlight::prepare`]), so
//! that a short flight leaves the processor to the service, as a real camera would; then the renderer
//! works ahead by at most [`RENDER_AHEAD`] pairs and waits. A pair that would not be ready
//! [`LATE_LIMIT_S`] after its time is not rendered, one that is late or that nobody listens to is
//! dropped; both are counted: a late picture would look fresh.

use crate::autopilot::{Autopilot, AutopilotSetup, ErrorsConfig, Heard};
use crate::cameras::{Cameras, TakenPair};
use crate::flight::Flight;
use crate::mission::Mission;
use crate::stream::{StereoWriter, StreamError, live_options};
use crate::world::World;
use emberfix_frames::{ServiceTime, seconds};
use emberfix_mav::FrameReader;
use mcap::write::NoSeek;
use rayon::prelude::*;
use std::io::{BufWriter, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs, UdpSocket};
use std::ops::Range;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

/// Autopilot alone before the flight begins, seconds: clocks meet, the renderer gets ahead.
pub const LEAD_IN_S: f64 = 4.0;
/// Autopilot alone after the last pair, seconds.
const LEAD_OUT_S: f64 = 1.0;
/// Pairs that are rendered before take-off at most (0.8 MB each).
pub const HEAD_START: u32 = 240;
/// Pairs that wait for their time at most, beyond the head start.
pub const RENDER_AHEAD: usize = 32;
/// Latest that a pair is still sent, seconds after its time.
pub const LATE_LIMIT_S: f64 = 0.5;
/// Between two looks at the autopilot's queue; bounds the jitter that we add.
const TICK: Duration = Duration::from_millis(1);
/// Between two attempts to reach the service's camera port.
const RETRY: Duration = Duration::from_millis(200);
/// A service that does not read for this long is gone.
const WRITE_TIMEOUT: Duration = Duration::from_secs(2);
const CALIBRATION_INTERVAL_S: f64 = 5.0;

/// Why a live flight could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// A URL of a form that the simulator does not speak.
    #[error("{what} url {url:?}: the simulator reaches {forms}")]
    Url {
        /// Which URL.
        what: &'static str,
        /// What the mission says.
        url: String,
        /// What would have been accepted.
        forms: &'static str,
    },
    /// Nobody took the camera's connection.
    #[error("{url}: nobody took the camera's connection within {waited_s} s; is the service up?")]
    Nobody {
        /// Which URL.
        url: String,
        /// How long was waited, seconds.
        waited_s: u64,
    },
    /// The port could not be opened.
    #[error("{url}: {source}")]
    Io {
        /// Which URL.
        url: String,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Where the service is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Edges {
    /// The service's MAVLink URL.
    pub mavlink: String,
    /// The service's camera URL.
    pub camera: String,
}

/// What came of a live flight.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Flown {
    /// Pairs that were sent.
    pub pairs_sent: u32,
    /// Pairs that were not ready in time.
    pub pairs_late: u32,
    /// Pairs that nobody listened to.
    pub pairs_unheard: u32,
    /// What the autopilot heard.
    pub heard: Heard,
}

/// Flight time against the machine's clocks: UTC read once, then carried on by the monotonic clock.
#[derive(Debug, Clone, Copy)]
struct FlightClock {
    zero: Instant,
    zero_utc: ServiceTime,
}

impl FlightClock {
    fn starting_in(lead_s: f64) -> Self {
        let since_epoch = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let now_ns = since_epoch.map_or(0, |since| since.as_nanos() as i64);
        Self {
            zero: Instant::now() + Duration::from_secs_f64(lead_s),
            zero_utc: ServiceTime::from_unix_ns(now_ns) + seconds(lead_s),
        }
    }

    fn now_s(&self) -> f64 {
        let now = Instant::now();
        match now.checked_duration_since(self.zero) {
            Some(since) => since.as_secs_f64(),
            None => -self.zero.duration_since(now).as_secs_f64(),
        }
    }
}

/// Progress and stop of a live flight, shared with whoever shows it.
#[derive(Debug, Default)]
pub struct Control {
    stop: AtomicBool,
    flown_ms: AtomicU32,
    prepared: AtomicU32,
}

impl Control {
    /// Ends the flight early.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Whether the flight is to end.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Seconds of flight so far.
    #[must_use]
    pub fn flown_s(&self) -> f64 {
        f64::from(self.flown_ms.load(Ordering::Relaxed)) * 1e-3
    }

    /// Pairs rendered before take-off so far.
    #[must_use]
    pub fn prepared(&self) -> u32 {
        self.prepared.load(Ordering::Relaxed)
    }

    fn set_flown(&self, flown_s: f64) {
        self.flown_ms
            .store((flown_s.max(0.0) * 1e3) as u32, Ordering::Relaxed);
    }
}

/// What a live flight is made from.
pub struct LiveFlight<'a> {
    /// The mission.
    pub mission: &'a Mission,
    /// Its world.
    pub world: Arc<World>,
    /// Its flight.
    pub flight: Arc<Flight>,
    /// Sensor errors, as the mission or the command line wants them.
    pub errors: &'a ErrorsConfig,
    /// Where the service is.
    pub edges: Edges,
    /// How long the service may take to open its camera socket.
    pub service_limit: Duration,
}

/// Pairs that wait for take-off.
#[derive(Debug, Default)]
pub struct HeadStart(Vec<TakenPair>);

impl LiveFlight<'_> {
    /// Renders the head start on all processors, or as much as there is before `control` stops it.
    #[must_use]
    pub fn prepare(&self, control: &Control) -> HeadStart {
        let cameras = self.cameras();
        let last = cameras.count().min(HEAD_START);
        let take = |index| {
            let pair = (!control.is_stopped()).then(|| cameras.take(index));
            control.prepared.fetch_add(1, Ordering::Relaxed);
            pair
        };
        HeadStart((0..last).into_par_iter().map(take).while_some().collect())
    }

    fn cameras(&self) -> Cameras {
        let (world, flight) = (Arc::clone(&self.world), Arc::clone(&self.flight));
        Cameras::new(self.mission, world, flight, self.errors)
    }

    /// Flies, in real time, to the end or until `control` stops it.
    ///
    /// # Errors
    /// [`LiveError`] when a URL can't be used, a port can't be opened, or the service never opens
    /// its camera socket.
    pub fn fly(&self, head_start: HeadStart, control: &Control) -> Result<Flown, LiveError> {
        let port = MavlinkPort::open(&self.edges.mavlink)?;
        let mut doorway = CameraDoorway::open(&self.edges.camera)?;
        let socket = self.await_service(&mut doorway, control)?;
        let clock = FlightClock::starting_in(LEAD_IN_S);
        let cameras = self.cameras();
        let first = head_start.0.len() as u32;
        let pictures_over = AtomicBool::new(false);
        let heard = Mutex::new(Heard::default());
        let (sender, receiver) = sync_channel(RENDER_AHEAD);
        let mut flown = Flown::default();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let end = || pictures_over.load(Ordering::Relaxed);
                let said = self.talk(&port, &clock, control, end);
                if let Ok(mut heard) = heard.lock() {
                    *heard = said;
                }
            });
            scope.spawn(|| render_ahead(first..cameras.count(), &cameras, &clock, control, sender));
            let pairs = head_start
                .0
                .into_iter()
                .map(Rendered::Pair)
                .chain(receiver.iter());
            self.show(socket, &mut doorway, &clock, control, pairs, &mut flown);
            // The renderer may wait for room: without a receiver it ends.
            drop(receiver);
            pictures_over.store(true, Ordering::Relaxed);
        });
        flown.heard = heard.into_inner().unwrap_or_default();
        Ok(flown)
    }

    /// The service's camera socket; `None` when the flight was stopped before it opened.
    fn await_service(
        &self,
        doorway: &mut CameraDoorway,
        control: &Control,
    ) -> Result<Option<Box<dyn Write>>, LiveError> {
        let since = Instant::now();
        while !control.is_stopped() && since.elapsed() < self.service_limit {
            if let Some(socket) = doorway.connect() {
                return Ok(Some(socket));
            }
            std::thread::sleep(RETRY);
        }
        if control.is_stopped() {
            return Ok(None);
        }
        let waited_s = self.service_limit.as_secs();
        Err(LiveError::Nobody {
            url: self.edges.camera.clone(),
            waited_s,
        })
    }

    /// The autopilot's loop.
    fn talk(
        &self,
        port: &MavlinkPort,
        clock: &FlightClock,
        control: &Control,
        pictures_over: impl Fn() -> bool,
    ) -> Heard {
        let mut autopilot = Autopilot::new(&AutopilotSetup {
            flight: Arc::clone(&self.flight),
            datum: self.mission.datum,
            system_id: self.mission.system_id,
            config: &self.mission.sim.autopilot,
            errors: self.errors,
            seed: self.mission.sim.seed,
            start: clock.zero_utc,
            from_s: clock.now_s(),
        });
        let end_s = self.flight.duration_s() + LEAD_OUT_S;
        let mut reader = FrameReader::new();
        while !control.is_stopped() && (!pictures_over() || clock.now_s() <= end_s) {
            port.receive(&mut reader);
            while let Some(frame) = reader.next_frame() {
                autopilot.receive(clock.now_s(), &frame);
            }
            for outgoing in autopilot.take_due(clock.now_s()) {
                port.send(&outgoing.bytes);
            }
            control.set_flown(clock.now_s().min(self.flight.duration_s()));
        }
        autopilot.heard().clone()
    }

    /// The camera's loop: every pair at its time.
    fn show(
        &self,
        socket: Option<Box<dyn Write>>,
        doorway: &mut CameraDoorway,
        clock: &FlightClock,
        control: &Control,
        pairs: impl Iterator<Item = Rendered>,
        flown: &mut Flown,
    ) {
        let mut listener = socket.and_then(|socket| Listener::greet(socket, self, clock));
        for rendered in pairs {
            let Rendered::Pair(pair) = rendered else {
                flown.pairs_late += 1;
                continue;
            };
            wait_until(clock, pair.arrives_s, control);
            if control.is_stopped() {
                return;
            }
            if listener.is_none() {
                let socket = doorway.connect();
                listener = socket.and_then(|socket| Listener::greet(socket, self, clock));
            }
            self.deliver(pair, clock, &mut listener, flown);
        }
    }

    fn deliver(
        &self,
        pair: TakenPair,
        clock: &FlightClock,
        listener: &mut Option<Listener>,
        flown: &mut Flown,
    ) {
        if clock.now_s() - pair.arrives_s > LATE_LIMIT_S {
            flown.pairs_late += 1;
            return;
        }
        let sent = listener
            .as_mut()
            .is_some_and(|to| to.send(pair, self, clock).is_ok());
        if sent {
            flown.pairs_sent += 1;
        } else {
            flown.pairs_unheard += 1;
            *listener = None;
        }
    }
}

enum Rendered {
    Pair(TakenPair),
    /// It would not have been ready in time.
    Late,
}

fn render_ahead(
    indices: Range<u32>,
    cameras: &Cameras,
    clock: &FlightClock,
    control: &Control,
    pairs: SyncSender<Rendered>,
) {
    let mut rendering_s = 0.0;
    for index in indices {
        if control.is_stopped() {
            return;
        }
        let begun_s = clock.now_s();
        let late = begun_s + rendering_s > cameras.arrives_s(index) + LATE_LIMIT_S;
        let rendered = if late {
            Rendered::Late
        } else {
            let pair = cameras.take(index);
            rendering_s = clock.now_s() - begun_s;
            Rendered::Pair(pair)
        };
        if pairs.send(rendered).is_err() {
            return;
        }
    }
}

fn wait_until(clock: &FlightClock, t_s: f64, control: &Control) {
    while !control.is_stopped() {
        let left_s = t_s - clock.now_s();
        if left_s <= 0.0 {
            return;
        }
        std::thread::sleep(Duration::from_secs_f64(left_s.min(0.05)));
    }
}

/// The autopilot's end of the MAVLink link.
#[derive(Debug)]
struct MavlinkPort {
    socket: UdpSocket,
    /// Fixed when the service listens; else whoever spoke last.
    peer: Mutex<Option<SocketAddr>>,
    peer_is_fixed: bool,
}

impl MavlinkPort {
    fn open(url: &str) -> Result<Self, LiveError> {
        let io = |source| LiveError::Io {
            url: url.to_owned(),
            source,
        };
        let (scheme, address) = url.split_once(':').unwrap_or((url, ""));
        let (local, peer) = match scheme {
            "udpin" => (
                "0.0.0.0:0".to_owned(),
                Some(reachable(address).map_err(io)?),
            ),
            "udpout" => (address.to_owned(), None),
            _ => {
                let forms = "udpin:HOST:PORT and udpout:HOST:PORT";
                return Err(LiveError::Url {
                    what: "mavlink",
                    url: url.to_owned(),
                    forms,
                });
            }
        };
        let socket = UdpSocket::bind(local).map_err(io)?;
        socket.set_read_timeout(Some(TICK)).map_err(io)?;
        Ok(Self {
            socket,
            peer_is_fixed: peer.is_some(),
            peer: Mutex::new(peer),
        })
    }

    /// Takes in what has come; waits a tick when nothing has.
    fn receive(&self, reader: &mut FrameReader) {
        let mut datagram = [0; 2048];
        // A refused datagram (nobody listens yet) reads as an error: to be tried again.
        let Ok((length, sender)) = self.socket.recv_from(&mut datagram) else {
            return;
        };
        reader.push(&datagram[..length]);
        if !self.peer_is_fixed
            && let Ok(mut peer) = self.peer.lock()
        {
            *peer = Some(sender);
        }
    }

    fn send(&self, frame: &[u8]) {
        let peer = self.peer.lock().ok().and_then(|peer| *peer);
        if let Some(peer) = peer {
            // A lost datagram is what MAVLink over UDP is made for.
            let _ = self.socket.send_to(frame, peer);
        }
    }
}

/// A listening address as a peer: "any" means this machine.
fn reachable(address: &str) -> std::io::Result<SocketAddr> {
    let mut found = address
        .to_socket_addrs()?
        .next()
        .ok_or(std::io::ErrorKind::AddrNotAvailable)?;
    if found.ip().is_unspecified() {
        found.set_ip(std::net::Ipv4Addr::LOCALHOST.into());
    }
    Ok(found)
}

/// The way to the service's camera port.
#[derive(Debug)]
enum CameraDoorway {
    ToTcp(String),
    ToUnix(PathBuf),
    FromTcp(TcpListener),
    FromUnix(UnixListener),
}

impl CameraDoorway {
    fn open(url: &str) -> Result<Self, LiveError> {
        let io = |source| LiveError::Io {
            url: url.to_owned(),
            source,
        };
        let (scheme, rest) = url.split_once(':').unwrap_or((url, ""));
        Ok(match scheme {
            "tcp-listen" => Self::ToTcp(reachable(rest).map_err(io)?.to_string()),
            "unix-listen" => Self::ToUnix(rest.into()),
            "tcp-connect" => {
                let listener = TcpListener::bind(rest).map_err(io)?;
                listener.set_nonblocking(true).map_err(io)?;
                Self::FromTcp(listener)
            }
            "unix-connect" => {
                let listener = UnixListener::bind(rest).map_err(io)?;
                listener.set_nonblocking(true).map_err(io)?;
                Self::FromUnix(listener)
            }
            _ => {
                let forms = "tcp-listen:, tcp-connect:, unix-listen: and unix-connect:";
                return Err(LiveError::Url {
                    what: "camera",
                    url: url.to_owned(),
                    forms,
                });
            }
        })
    }

    /// A socket to the service, if it is there.
    fn connect(&mut self) -> Option<Box<dyn Write>> {
        match self {
            Self::ToTcp(address) => tcp(TcpStream::connect(address.as_str()).ok()?),
            Self::ToUnix(path) => unix(UnixStream::connect(path).ok()?),
            Self::FromTcp(listener) => tcp(listener.accept().ok()?.0),
            Self::FromUnix(listener) => unix(listener.accept().ok()?.0),
        }
    }
}

fn tcp(socket: TcpStream) -> Option<Box<dyn Write>> {
    socket.set_nonblocking(false).ok()?;
    socket.set_write_timeout(Some(WRITE_TIMEOUT)).ok()?;
    socket.set_nodelay(true).ok()?;
    Some(Box::new(socket))
}

fn unix(socket: UnixStream) -> Option<Box<dyn Write>> {
    socket.set_nonblocking(false).ok()?;
    socket.set_write_timeout(Some(WRITE_TIMEOUT)).ok()?;
    Some(Box::new(socket))
}

/// A service that listens to the camera.
struct Listener {
    stream: StereoWriter<NoSeek<BufWriter<Box<dyn Write>>>>,
    calibrated_s: f64,
}

impl Listener {
    /// Begins a stream with the calibrations.
    fn greet(socket: Box<dyn Write>, live: &LiveFlight<'_>, clock: &FlightClock) -> Option<Self> {
        let destination = NoSeek::new(BufWriter::new(socket));
        let mut stream = StereoWriter::new(destination, live_options(), false).ok()?;
        let now_s = clock.now_s();
        stream
            .write_calibrations(&live.mission.rig, clock.zero_utc + seconds(now_s))
            .ok()?;
        stream.flush().ok()?;
        Some(Self {
            stream,
            calibrated_s: now_s,
        })
    }

    fn send(
        &mut self,
        pair: TakenPair,
        live: &LiveFlight<'_>,
        clock: &FlightClock,
    ) -> Result<(), StreamError> {
        let now_s = clock.now_s();
        if now_s - self.calibrated_s >= CALIBRATION_INTERVAL_S {
            let now = clock.zero_utc + seconds(now_s);
            self.stream.write_calibrations(&live.mission.rig, now)?;
            self.calibrated_s = now_s;
        }
        self.stream.write_pair(pair.at(clock.zero_utc))?;
        self.stream.flush()
    }
}
