//! The courier thread: takes what waits in the outbox to the ground station over IP, by datagrams and
//! HTTP, says where we are, and brings back what operators did.
//!
//! One thread owns the socket. It looks at the outbox when something in it changed, and wakes at
//! least every [`TICK`]; HTTP exchanges run on threads of their own and report to it. Fires' pictures
//! go behind everything else ([`pictures`]).

mod pictures;

use super::core::Input;
use super::{Board, SharedOutbox, lock};
use crate::alarm::Action;
use crate::deliver::datagram::News;
use crate::deliver::datagram::wire::{Ask, RECEIVE_BUFFER, ToAircraft, ToGround};
use crate::deliver::envelope::Origin;
use crate::deliver::http::{HttpError, HttpLink};
use crate::deliver::keys::SecretKey;
use crate::deliver::{
    AlarmLink, DatagramDelivery, DatagramSettings, HttpLanes, Letter, Receipt, Settled,
};
use crate::ingest::ServiceClock;
use crate::mission::GroundLinks;
use emberfix_frames::{ServiceTime, SignedDuration};
use pictures::Pictures;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::thread::JoinHandle;
use std::time::Duration;

/// How long the socket is waited for; the outbox is looked at in between.
const TICK: Duration = Duration::from_millis(5);
/// How often the ground is told where we are.
const PING: SignedDuration = SignedDuration::from_millis(500);
/// How often a host name is looked up until it has an address.
const LOOK_UP: SignedDuration = SignedDuration::from_secs(2);
/// Datagrams taken in at once before something else has its turn.
const BURST: usize = 256;
/// The outbox is looked at again after this, although nothing seems to have changed.
const LOOK_ANYWAY: SignedDuration = SignedDuration::from_secs(1);

/// What the courier needs of the service.
pub struct Surroundings {
    /// What waits.
    pub outbox: SharedOutbox,
    /// Where the position stands.
    pub board: Arc<Board>,
    /// The service clock.
    pub clock: ServiceClock,
    /// The pipeline's inbox, for operators' actions; without one they are only kept.
    pub events: Option<SyncSender<Input>>,
}

/// The aircraft's links over IP.
pub struct IpCourier {
    place: String,
    socket: Option<UdpSocket>,
    looked_up: Option<ServiceTime>,
    datagrams: Option<DatagramDelivery>,
    http: HttpLanes,
    key: Option<SecretKey>,
    origin: Origin,
    waiting: Vec<Letter>,
    seen_changes: Option<u64>,
    seen_at: Option<ServiceTime>,
    actions_known: u64,
    pinged: Option<ServiceTime>,
    asking: Arc<AtomicBool>,
    complained: bool,
    pictures: Pictures,
}

impl IpCourier {
    /// The links of a mission, if it has any over IP.
    pub fn new(
        ground: &GroundLinks,
        origin: Origin,
        key: Option<SecretKey>,
        seed: u64,
    ) -> Result<Option<Self>, HttpError> {
        let Some(url) = &ground.url else {
            return Ok(None);
        };
        let link = HttpLink::with(url, &ground.credentials)?.trusting(ground.public_key);
        let settings = DatagramSettings {
            origin: origin.clone(),
            key: key.clone(),
            ground: ground.public_key,
            seed,
        };
        Ok(Some(Self {
            place: link.place(),
            socket: None,
            looked_up: None,
            datagrams: ground.datagrams.then(|| DatagramDelivery::new(settings)),
            http: HttpLanes::new(link),
            key,
            origin,
            waiting: Vec::new(),
            seen_changes: None,
            seen_at: None,
            actions_known: 0,
            pinged: None,
            asking: Arc::default(),
            complained: false,
            pictures: Pictures::default(),
        }))
    }

    /// Starts the thread. It ends when the service stops.
    pub fn start(mut self, around: Surroundings) -> std::io::Result<JoinHandle<()>> {
        std::thread::Builder::new()
            .name("courier".to_owned())
            .spawn(move || {
                let mut buffer = vec![0; RECEIVE_BUFFER];
                while !around.board.is_stopping() {
                    self.turn(&around, &mut buffer);
                }
                tracing::info!(datagrams = ?self.datagrams.as_ref().map(DatagramDelivery::counters),
                    "courier ends");
            })
    }

    fn turn(&mut self, around: &Surroundings, buffer: &mut [u8]) {
        self.open_socket((around.clock)());
        self.take_datagrams(around, buffer);
        let now = (around.clock)();
        self.look_into_outbox(around, now);
        let settled = self.work(now);
        self.settle(around, &settled);
        self.tell_position(around, now);
        self.ask_over_http(around, now);
        self.picture_over_http(around, now);
        self.send_datagrams((around.clock)());
    }

    /// A name that can't be looked up yet is looked up again.
    fn open_socket(&mut self, now: ServiceTime) {
        let due = self.looked_up.is_none_or(|at| now - at >= LOOK_UP);
        if self.socket.is_some() || self.datagrams.is_none() || !due {
            return;
        }
        self.looked_up = Some(now);
        self.socket = connect(&self.place, TICK)
            .inspect_err(|error| tracing::debug!(%error, place = self.place, "no datagram socket"))
            .ok();
    }

    fn take_datagrams(&mut self, around: &Surroundings, buffer: &mut [u8]) {
        let (Some(socket), Some(link)) = (&self.socket, &mut self.datagrams) else {
            std::thread::sleep(TICK);
            return;
        };
        let mut news = Vec::new();
        for taken in 0..BURST {
            // Waits for the first one only.
            let waits = if taken == 0 { Some(TICK) } else { None };
            let received = receive(socket, waits, buffer);
            let Some(length) = received else {
                break;
            };
            news.extend(link.take(&buffer[..length], (around.clock)()));
        }
        for news in news {
            match news {
                News::Actions(json) => self.take_actions(around, &json),
                News::Chip { id, revision } => self.picture_arrived(around, &id, revision),
            }
        }
    }

    fn look_into_outbox(&mut self, around: &Surroundings, now: ServiceTime) {
        let mut outbox = lock(&around.outbox);
        let late = self.seen_at.is_none_or(|at| now - at > LOOK_ANYWAY);
        if self.seen_changes == Some(outbox.changes()) && !late {
            return;
        }
        self.seen_changes = Some(outbox.changes());
        self.seen_at = Some(now);
        let pending = outbox.pending(DatagramDelivery::NAME, DatagramDelivery::WINDOW);
        let counts = outbox
            .waiting(DatagramDelivery::NAME)
            .and_then(|waiting| Ok((outbox.newest_sequence()?, waiting, outbox.newest_action()?)));
        let pictures = outbox.chips_after(self.pictures.seen());
        drop(outbox);
        match pictures {
            Ok(pictures) => self.offer_pictures(pictures),
            Err(error) => tracing::warn!(%error, "pictures not readable"),
        }
        match (pending, counts) {
            (Ok(pending), Ok((sequence, waiting, action))) => {
                self.waiting = pending;
                self.actions_known = action;
                if let Some(link) = &mut self.datagrams {
                    link.note_outbox(sequence, waiting, action);
                }
            }
            (Err(error), _) | (_, Err(error)) => tracing::error!(%error, "outbox not readable"),
        }
    }

    /// Datagrams carry what they can; HTTP the rest, and everything while no datagram is answered.
    fn work(&mut self, now: ServiceTime) -> Vec<Settled> {
        let Some(link) = &mut self.datagrams else {
            return self.http.work(&self.waiting, now);
        };
        let mut settled = link.work(&self.waiting, now);
        if link.is_up() {
            self.http.reached(now);
            settled.extend(self.http.work(&link.too_large(&self.waiting), now));
        } else {
            settled.extend(self.http.work(&self.waiting, now));
        }
        settled
    }

    fn settle(&mut self, around: &Surroundings, settled: &[Settled]) {
        let mut receipts: Vec<Receipt> = Vec::new();
        for settled in settled {
            match settled {
                Settled::Delivered(receipt) => {
                    self.complained = false;
                    receipts.push(receipt.clone());
                }
                Settled::Refused { id, reason, .. } => {
                    tracing::warn!(id, reason, "the ground refuses an alarm; it waits");
                }
                Settled::Unreachable { reason } => self.complain(reason),
            }
        }
        if receipts.is_empty() {
            return;
        }
        let has = |letter: &Letter| {
            receipts
                .iter()
                .any(|r| r.id == letter.id() && r.revision >= letter.revision())
        };
        self.waiting.retain(|letter| !has(letter));
        let stored = lock(&around.outbox).acknowledge_all(DatagramDelivery::NAME, &receipts);
        if let Err(error) = stored {
            tracing::error!(%error, "receipts not stored; these alarms will be sent again");
        }
    }

    fn tell_position(&mut self, around: &Surroundings, now: ServiceTime) {
        if self.pinged.is_some_and(|pinged| now - pinged < PING) {
            return;
        }
        self.pinged = Some(now);
        let Some(ping) = around.board.latest().ping.take() else {
            return;
        };
        match &mut self.datagrams {
            Some(link) if link.is_up() => {
                link.note_position(serde_json::json!(ping).to_string().into_bytes());
            }
            _ => self.apart(move |link| {
                if let Err(error) = link.send_track(&ping) {
                    tracing::debug!(%error, "position not told");
                }
            }),
        }
    }

    /// Where no datagram is answered, operators' actions are asked for over HTTP.
    fn ask_over_http(&mut self, around: &Surroundings, now: ServiceTime) {
        let up = self.datagrams.as_ref().is_some_and(DatagramDelivery::is_up);
        if up || self.http.newest_action() <= self.actions_known {
            return;
        }
        let ask = ToGround::Ask(Ask {
            origin: self.origin.clone(),
            stamp: now.unix_ns().cast_unsigned(),
            after: self.actions_known,
        });
        let (key, outbox, events) = (
            self.key.clone(),
            Arc::clone(&around.outbox),
            around.events.clone(),
        );
        self.apart(move |link| match link.exchange(&ask, key.as_ref()) {
            Ok(ToAircraft::Actions { json, .. }) => keep_actions(&outbox, events.as_ref(), &json),
            Ok(_) => tracing::debug!("not what was asked for"),
            Err(error) => tracing::debug!(%error, "actions not heard"),
        });
    }

    fn is_asking(&self) -> bool {
        self.asking.load(Ordering::Acquire)
    }

    /// One thing at a time beside the alarms; what comes meanwhile is left out.
    fn apart(&self, work: impl FnOnce(&HttpLink) + Send + 'static) {
        if self.asking.swap(true, Ordering::AcqRel) {
            return;
        }
        let (asking, link) = (Arc::clone(&self.asking), self.http.link().clone());
        let thread = std::thread::Builder::new().name("http".to_owned());
        let begun = thread.spawn(move || {
            work(&link);
            asking.store(false, Ordering::Release);
        });
        if begun.is_err() {
            self.asking.store(false, Ordering::Release);
        }
    }

    fn take_actions(&mut self, around: &Surroundings, json: &[u8]) {
        keep_actions(&around.outbox, around.events.as_ref(), json);
        // The next asking goes on from there.
        self.seen_changes = None;
    }

    fn send_datagrams(&mut self, now: ServiceTime) {
        let (Some(socket), Some(link)) = (&self.socket, &mut self.datagrams) else {
            return;
        };
        while let Some(datagram) = link.poll(now) {
            // What is not sent is sent again, as if it were lost on the way.
            if let Err(error) = socket.send(&datagram) {
                tracing::trace!(%error, "a datagram was not sent");
            }
        }
    }

    /// Once per outage.
    fn complain(&mut self, reason: &str) {
        if !std::mem::replace(&mut self.complained, true) {
            tracing::warn!(
                reason,
                "ground station not reached; alarms wait in the outbox"
            );
        }
    }
}

/// On disk first; only then does the pipeline hear of it.
pub(super) fn keep_action(
    outbox: &SharedOutbox,
    events: Option<&SyncSender<Input>>,
    action: Action,
) -> bool {
    match lock(outbox).take_action(&action) {
        Ok(true) => {
            tracing::info!(?action, "an operator acted");
            if let Some(events) = events
                && events.try_send(Input::Action(action)).is_err()
            {
                tracing::error!("the pipeline did not hear of an operator's action");
            }
            true
        }
        Ok(false) => true,
        Err(error) => {
            tracing::error!(%error, "an operator's action was not kept; it will be asked for again");
            false
        }
    }
}

fn keep_actions(outbox: &SharedOutbox, events: Option<&SyncSender<Input>>, json: &[u8]) {
    let actions: Vec<Action> = match serde_json::from_slice(json) {
        Ok(actions) => actions,
        Err(error) => {
            tracing::warn!(%error, "operators' actions that can't be read");
            return;
        }
    };
    for action in actions {
        if !keep_action(outbox, events, action) {
            return;
        }
    }
}

/// A socket for datagrams to one host and port, read with this patience.
pub(crate) fn connect(place: &str, patience: Duration) -> std::io::Result<UdpSocket> {
    let unknown = || std::io::Error::new(std::io::ErrorKind::NotFound, "host has no address");
    let target: SocketAddr = place.to_socket_addrs()?.next().ok_or_else(unknown)?;
    let local = if target.is_ipv4() {
        "0.0.0.0:0"
    } else {
        "[::]:0"
    };
    let socket = UdpSocket::bind(local)?;
    socket.connect(target)?;
    socket.set_read_timeout(Some(patience))?;
    Ok(socket)
}

/// The next datagram's length. A port that nobody listens on is reported as an error: as good as
/// nothing.
fn receive(socket: &UdpSocket, waits: Option<Duration>, buffer: &mut [u8]) -> Option<usize> {
    if waits.is_none() {
        socket.set_nonblocking(true).ok()?;
    }
    let received = socket.recv(buffer);
    if waits.is_none() {
        socket.set_nonblocking(false).ok()?;
    } else if received
        .as_ref()
        .is_err_and(|error| error.kind() == std::io::ErrorKind::ConnectionRefused)
    {
        std::thread::sleep(TICK);
    }
    received.ok()
}
