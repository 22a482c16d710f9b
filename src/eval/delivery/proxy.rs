//! Bad weather between two processes: one port, UDP and TCP, on loopback.

use super::{DeliveryError, io};
use rand::{Rng as _, SeedableRng as _};
use std::collections::{BTreeMap, HashMap};
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What befalls a datagram.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Weather {
    /// Probability of being lost.
    pub loss: f64,
    /// One way.
    pub delay: Duration,
    /// More delay, up to this, evenly: what is sent later may come earlier.
    pub jitter: Duration,
    /// Probability of coming twice.
    pub twice: f64,
    /// Nothing passes.
    pub cut: bool,
}

impl Weather {
    /// Nothing happens but the way itself.
    pub fn good() -> Self {
        Self {
            loss: 0.0,
            delay: Duration::from_millis(5),
            jitter: Duration::ZERO,
            twice: 0.0,
            cut: false,
        }
    }

    /// 30 % are lost, 40 ms each way.
    pub fn lossy() -> Self {
        Self {
            loss: 0.3,
            delay: Duration::from_millis(40),
            ..Self::good()
        }
    }

    /// Likewise, out of order, and some twice.
    pub fn wild() -> Self {
        Self {
            jitter: Duration::from_millis(60),
            twice: 0.1,
            ..Self::lossy()
        }
    }
}

/// How long the proxy sleeps when nothing is due.
const NAP: Duration = Duration::from_micros(500);
/// Linux's least retransmission timeout.
const LEAST_TIMEOUT: Duration = Duration::from_millis(200);
/// Bytes of one TCP segment.
const SEGMENT: usize = 1_448;

/// A running proxy; it ends when this is dropped.
pub(super) struct Proxy {
    pub address: SocketAddr,
    shared: Arc<Shared>,
}

struct Shared {
    weather: Mutex<Weather>,
    ground: SocketAddr,
    ended: AtomicBool,
    seed: u64,
}

impl Shared {
    fn weather(&self) -> Weather {
        *lock(&self.weather)
    }

    fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Relaxed)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Proxy {
    /// Begins to pass on to `ground`.
    pub fn start(ground: SocketAddr, weather: Weather, seed: u64) -> Result<Self, DeliveryError> {
        let (tcp, udp) = one_port()?;
        let address = tcp.local_addr().map_err(io("look at the proxy's port"))?;
        let shared = Arc::new(Shared {
            weather: Mutex::new(weather),
            ground,
            ended: AtomicBool::new(false),
            seed,
        });
        let theirs = Arc::clone(&shared);
        std::thread::spawn(move || Datagrams::new(udp, theirs).run());
        let theirs = Arc::clone(&shared);
        std::thread::spawn(move || accept(&tcp, &theirs));
        Ok(Self { address, shared })
    }

    /// From now on.
    pub fn set(&self, weather: Weather) {
        *lock(&self.shared.weather) = weather;
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        // Wakes the thread that accepts.
        let _woken = TcpStream::connect(self.address);
    }
}

/// Ports that the system gives to nobody unasked (Linux hands out 32768 and up): a ground that is killed
/// finds its port free again.
const PORTS: std::ops::Range<u16> = 20_000..32_000;

/// TCP and UDP on one free port.
pub(super) fn one_port() -> Result<(TcpListener, UdpSocket), DeliveryError> {
    let mut last = None;
    for _ in 0..32 {
        let address = SocketAddr::from(([127, 0, 0, 1], rand::rng().random_range(PORTS)));
        match TcpListener::bind(address).and_then(|tcp| Ok((tcp, UdpSocket::bind(address)?))) {
            Ok(both) => return Ok(both),
            Err(error) => last = Some(error),
        }
    }
    let source = last.unwrap_or_else(|| std::io::Error::other("none is free"));
    Err(io("find a free port")(source))
}

struct Datagrams {
    socket: UdpSocket,
    shared: Arc<Shared>,
    /// One socket towards the ground per aircraft.
    upstream: HashMap<SocketAddr, UdpSocket>,
    due: BTreeMap<(Instant, u64), (Way, Vec<u8>)>,
    numbered: u64,
    random: rand_chacha::ChaCha8Rng,
}

#[derive(Clone, Copy)]
enum Way {
    Up(SocketAddr),
    Down(SocketAddr),
}

impl Datagrams {
    fn new(socket: UdpSocket, shared: Arc<Shared>) -> Self {
        Self {
            random: rand_chacha::ChaCha8Rng::seed_from_u64(shared.seed),
            socket,
            shared,
            upstream: HashMap::new(),
            due: BTreeMap::new(),
            numbered: 0,
        }
    }

    fn run(mut self) {
        if self.socket.set_nonblocking(true).is_err() {
            return;
        }
        let mut buffer = vec![0; 65_536];
        while !self.shared.has_ended() {
            self.take_in(&mut buffer);
            self.pass_on();
            std::thread::sleep(NAP);
        }
    }

    fn take_in(&mut self, buffer: &mut [u8]) {
        while let Ok((length, from)) = self.socket.recv_from(buffer) {
            self.befall(Way::Up(from), &buffer[..length]);
        }
        let mut came = Vec::new();
        for (aircraft, socket) in &self.upstream {
            // Errors tell that the ground is down just now.
            while let Ok(length) = socket.recv(buffer) {
                came.push((*aircraft, buffer[..length].to_vec()));
            }
        }
        for (aircraft, bytes) in came {
            self.befall(Way::Down(aircraft), &bytes);
        }
    }

    fn befall(&mut self, way: Way, bytes: &[u8]) {
        let weather = self.shared.weather();
        let copies = 1 + u32::from(self.random.random_bool(weather.twice));
        for _ in 0..copies {
            if weather.cut || self.random.random_bool(weather.loss) {
                continue;
            }
            let jitter = weather.jitter.mul_f64(self.random.random());
            self.numbered += 1;
            let at = (Instant::now() + weather.delay + jitter, self.numbered);
            self.due.insert(at, (way, bytes.to_vec()));
        }
    }

    fn pass_on(&mut self) {
        while let Some(first) = self.due.first_entry()
            && first.key().0 <= Instant::now()
        {
            let (way, bytes) = first.remove();
            // What can't be sent is lost, like other things here.
            let _sent = match way {
                Way::Up(aircraft) => self.up(aircraft, &bytes),
                Way::Down(aircraft) => self.socket.send_to(&bytes, aircraft),
            };
        }
    }

    fn up(&mut self, aircraft: SocketAddr, bytes: &[u8]) -> std::io::Result<usize> {
        if !self.upstream.contains_key(&aircraft) {
            let socket = UdpSocket::bind("127.0.0.1:0")?;
            socket.connect(self.shared.ground)?;
            socket.set_nonblocking(true)?;
            self.upstream.insert(aircraft, socket);
        }
        match self.upstream.get(&aircraft) {
            Some(socket) => socket.send(bytes),
            None => Ok(0),
        }
    }
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    for (client, number) in listener.incoming().zip(0..) {
        if shared.has_ended() {
            return;
        }
        let shared = Arc::clone(shared);
        if let Ok(client) = client {
            std::thread::spawn(move || connect(client, &shared, number));
        }
    }
}

/// The handshake takes a way there and back, and may lose its segments, too.
fn connect(client: TcpStream, shared: &Arc<Shared>, number: u64) -> Option<()> {
    let mut segments = Segments::new(shared, 2 * number);
    std::thread::sleep(segments.hold_up()? + segments.hold_up()?);
    let ground = TcpStream::connect(shared.ground).ok()?;
    client.set_nodelay(true).ok()?;
    ground.set_nodelay(true).ok()?;
    let (up_from, up_to) = (client.try_clone().ok()?, ground.try_clone().ok()?);
    let back = Segments::new(shared, 2 * number + 1);
    std::thread::spawn(move || pump(&ground, &client, back));
    pump(&up_from, &up_to, segments)
}

/// Reads at once, so that time goes by on the way and not in the reading; one end closes the other.
fn pump(mut from: &TcpStream, mut to: &TcpStream, mut segments: Segments) -> Option<()> {
    let mut buffer = [0; SEGMENT];
    loop {
        let length = from.read(&mut buffer).unwrap_or(0);
        let hold_up = segments.hold_up();
        if length == 0 || hold_up.is_none() {
            // Each may be closed already.
            let _closed = to.shutdown(std::net::Shutdown::Both);
            let _closed = from.shutdown(std::net::Shutdown::Both);
            return None;
        }
        std::thread::sleep(hold_up?);
        to.write_all(&buffer[..length]).ok()?;
    }
}

/// What befalls TCP segments, as a model: see the room's doc.
struct Segments {
    shared: Arc<Shared>,
    random: rand_chacha::ChaCha8Rng,
}

impl Segments {
    fn new(shared: &Arc<Shared>, stream: u64) -> Self {
        let seed = shared.seed.wrapping_add(1 + stream);
        Self {
            shared: Arc::clone(shared),
            random: rand_chacha::ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// How long the next segment takes; none when the proxy ends. While the way is cut it waits.
    fn hold_up(&mut self) -> Option<Duration> {
        while self.shared.weather().cut {
            if self.shared.has_ended() {
                return None;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let weather = self.shared.weather();
        let (mut timeout, mut takes) = (LEAST_TIMEOUT, weather.delay);
        while self.random.random_bool(weather.loss) {
            takes += timeout;
            timeout *= 2;
        }
        Some(takes)
    }
}
