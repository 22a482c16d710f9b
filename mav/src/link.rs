//! The port itself: UDP, TCP or serial by one URL. The only part of this crate that does I/O.
//!
//! A link outlives its peer: TCP and serial ports are opened anew, with back-off, whenever they
//! close or fall silent. What is sent while nobody listens is lost, and said so
//! ([`LinkError::NotConnected`]); keeping it is the outbox's business.

use std::future::Future;
use std::net::SocketAddr;
use std::pin::Pin;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UdpSocket, lookup_host};
use tokio::time::{Instant, sleep, sleep_until, timeout, timeout_at};
use tokio_serial::SerialPortBuilderExt;

/// Where MAVLink comes from and goes to.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum LinkUrl {
    /// `udpin:HOST:PORT`: bind there, answer whoever sends frames.
    UdpIn(String),
    /// `udpout:HOST:PORT`: send there, from any port.
    UdpOut(String),
    /// `tcpin:HOST:PORT`: listen there; the newest client counts.
    TcpIn(String),
    /// `tcpout:HOST:PORT`: connect there.
    TcpOut(String),
    /// `serial:DEVICE:BAUD`.
    Serial {
        /// Path of the device.
        device: String,
        /// Bits per second.
        baud: u32,
    },
}

/// Why a text is no link URL.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LinkUrlError {
    /// None of the schemes.
    #[error(
        "MAVLink URL {url:?} has no known scheme: allowed are udpin:HOST:PORT, udpout:HOST:PORT, \
         tcpin:HOST:PORT, tcpout:HOST:PORT, serial:DEVICE:BAUD"
    )]
    Scheme {
        /// What was given.
        url: String,
    },
    /// No `HOST:PORT` behind the scheme.
    #[error("MAVLink URL {url:?} needs HOST:PORT with a port of 1 to 65535 behind {scheme}:")]
    HostPort {
        /// What was given.
        url: String,
        /// Its scheme.
        scheme: &'static str,
    },
    /// No `DEVICE:BAUD` behind the scheme.
    #[error(
        "MAVLink URL {url:?} needs DEVICE:BAUD behind serial:, such as serial:/dev/ttyAMA0:921600"
    )]
    Serial {
        /// What was given.
        url: String,
    },
}

impl FromStr for LinkUrl {
    type Err = LinkUrlError;

    fn from_str(url: &str) -> Result<Self, LinkUrlError> {
        let unknown = || LinkUrlError::Scheme {
            url: url.to_owned(),
        };
        let (scheme, place) = url.split_once(':').ok_or_else(unknown)?;
        match scheme {
            "udpin" => Ok(Self::UdpIn(host_port(url, "udpin", place)?)),
            "udpout" => Ok(Self::UdpOut(host_port(url, "udpout", place)?)),
            "tcpin" => Ok(Self::TcpIn(host_port(url, "tcpin", place)?)),
            "tcpout" => Ok(Self::TcpOut(host_port(url, "tcpout", place)?)),
            "serial" => serial(url, place),
            _ => Err(unknown()),
        }
    }
}

fn host_port(url: &str, scheme: &'static str, place: &str) -> Result<String, LinkUrlError> {
    let refused = || LinkUrlError::HostPort {
        url: url.to_owned(),
        scheme,
    };
    let (host, port) = place.rsplit_once(':').ok_or_else(refused)?;
    match port.parse::<u16>() {
        Ok(1..) if !host.is_empty() && !host.contains('/') => Ok(place.to_owned()),
        _ => Err(refused()),
    }
}

fn serial(url: &str, place: &str) -> Result<LinkUrl, LinkUrlError> {
    let refused = || LinkUrlError::Serial {
        url: url.to_owned(),
    };
    let (device, baud) = place.rsplit_once(':').ok_or_else(refused)?;
    let baud = baud
        .parse()
        .ok()
        .filter(|baud| *baud > 0)
        .ok_or_else(refused)?;
    if device.is_empty() {
        return Err(refused());
    }
    Ok(LinkUrl::Serial {
        device: device.to_owned(),
        baud,
    })
}

impl std::fmt::Display for LinkUrl {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::UdpIn(place) => write!(f, "udpin:{place}"),
            Self::UdpOut(place) => write!(f, "udpout:{place}"),
            Self::TcpIn(place) => write!(f, "tcpin:{place}"),
            Self::TcpOut(place) => write!(f, "tcpout:{place}"),
            Self::Serial { device, baud } => write!(f, "serial:{device}:{baud}"),
        }
    }
}

/// What can go wrong on a port. Only [`LinkError::Open`] is fatal; the others pass.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The port cannot be opened at all.
    #[error("cannot open {url}: {source}")]
    Open {
        /// Which port.
        url: LinkUrl,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nobody is there yet, or any more.
    #[error("nobody is connected to {url}")]
    NotConnected {
        /// Which port.
        url: LinkUrl,
    },
    /// Writing failed; a stream is opened anew.
    #[error("cannot send on {url}: {source}")]
    Send {
        /// Which port.
        url: LinkUrl,
        /// What the system said.
        source: std::io::Error,
    },
}

/// At the other end of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Peer {
    /// Who sent a datagram.
    Udp(SocketAddr),
    /// The nth connection of a TCP or serial port.
    Connection(u64),
}

/// What a port delivered at once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chunk {
    /// From whom.
    pub from: Peer,
    /// The bytes as they came.
    pub bytes: Vec<u8>,
}

/// An open link.
pub struct Link {
    url: LinkUrl,
    port: Port,
    buffer: Vec<u8>,
}

enum Port {
    Udp(UdpPort),
    Stream(StreamPort),
}

/// Larger than any datagram.
const BUFFER_LEN: usize = 64 * 1024;
/// A peer that says nothing for so long is replaced, or dialled anew; heartbeats come at 1 Hz.
const SILENCE: Duration = Duration::from_secs(15);
/// A stream that takes nothing for so long is closed: waiting longer would hold up the service.
const SEND_PATIENCE: Duration = Duration::from_secs(1);
/// A dialled peer that does not answer for so long is dialled anew.
const DIAL_PATIENCE: Duration = Duration::from_secs(5);
/// First and longest pause between attempts to open a stream.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(250), Duration::from_secs(5));
/// Pause after a socket error, so that a broken interface does not spin the processor.
const ERROR_PAUSE: Duration = Duration::from_millis(100);

impl Link {
    /// Opens a link. UDP and listening TCP ports are bound at once; a TCP peer or serial device
    /// that is not there yet is waited for in [`Link::recv`].
    ///
    /// # Errors
    /// [`LinkError::Open`] when the port can never work: an address in use, a host unknown.
    pub async fn open(url: &LinkUrl) -> Result<Self, LinkError> {
        let opened = match url {
            LinkUrl::UdpIn(place) => UdpPort::listening(place).await.map(Port::Udp),
            LinkUrl::UdpOut(place) => UdpPort::sending(place).await.map(Port::Udp),
            LinkUrl::TcpIn(place) => TcpListener::bind(place)
                .await
                .map(|l| Port::Stream(StreamPort::new(Opener::Accept(Arc::new(l))))),
            LinkUrl::TcpOut(place) => {
                Ok(Port::Stream(StreamPort::new(Opener::Dial(place.clone()))))
            }
            LinkUrl::Serial { device, baud } => {
                let opener = Opener::Serial {
                    device: device.clone(),
                    baud: *baud,
                };
                Ok(Port::Stream(StreamPort::new(opener)))
            }
        };
        let port = opened.map_err(|source| LinkError::Open {
            url: url.clone(),
            source,
        })?;
        Ok(Self {
            url: url.clone(),
            port,
            buffer: vec![0; BUFFER_LEN],
        })
    }

    /// The next bytes, from whomever. Waits as long as it takes, opening streams anew as needed.
    /// Cancel safe: what was not returned is still there.
    pub async fn recv(&mut self) -> Chunk {
        match &mut self.port {
            Port::Udp(port) => port.recv(&mut self.buffer).await,
            Port::Stream(port) => port.recv(&self.url, &mut self.buffer).await,
        }
    }

    /// Sends one frame to every accepted peer.
    ///
    /// # Errors
    /// [`LinkError::NotConnected`] or [`LinkError::Send`]; the frame is lost.
    pub async fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let sent = match &mut self.port {
            Port::Udp(port) => port.send(frame).await,
            Port::Stream(port) => port.send(frame).await,
        };
        match sent {
            Ok(true) => Ok(()),
            Ok(false) => Err(LinkError::NotConnected {
                url: self.url.clone(),
            }),
            Err(source) => Err(LinkError::Send {
                url: self.url.clone(),
                source,
            }),
        }
    }

    /// Says that this peer sent a valid frame of a system that we talk to: from now on it is sent
    /// what we say. Peers of `udpin` that stay silent are forgotten once another one speaks.
    pub fn accept_peer(&mut self, peer: Peer) {
        if let (Port::Udp(port), Peer::Udp(address)) = (&mut self.port, peer) {
            port.accept(address);
        }
    }

    /// Where it leads.
    #[must_use]
    pub fn url(&self) -> &LinkUrl {
        &self.url
    }
}

struct UdpPort {
    socket: UdpSocket,
    peers: UdpPeers,
}

enum UdpPeers {
    Fixed(SocketAddr),
    Learned(Vec<(SocketAddr, Instant)>),
}

/// Learned peers at most; the one silent longest gives way.
const MAX_PEERS: usize = 8;

impl UdpPort {
    async fn listening(place: &str) -> std::io::Result<Self> {
        let socket = UdpSocket::bind(place).await?;
        Ok(Self {
            socket,
            peers: UdpPeers::Learned(Vec::new()),
        })
    }

    async fn sending(place: &str) -> std::io::Result<Self> {
        let unknown = || std::io::Error::new(std::io::ErrorKind::NotFound, "host has no address");
        let target = lookup_host(place).await?.next().ok_or_else(unknown)?;
        let local = if target.is_ipv4() {
            "0.0.0.0:0"
        } else {
            "[::]:0"
        };
        let socket = UdpSocket::bind(local).await?;
        Ok(Self {
            socket,
            peers: UdpPeers::Fixed(target),
        })
    }

    async fn recv(&mut self, buffer: &mut [u8]) -> Chunk {
        loop {
            match self.socket.recv_from(buffer).await {
                Ok((length, from)) => {
                    return Chunk {
                        from: Peer::Udp(from),
                        bytes: buffer[..length].to_vec(),
                    };
                }
                Err(error) => {
                    tracing::debug!(%error, "receiving a datagram failed");
                    sleep(ERROR_PAUSE).await;
                }
            }
        }
    }

    /// False when there is nobody to send to; an error only when nobody could be sent to.
    async fn send(&mut self, frame: &[u8]) -> std::io::Result<bool> {
        let targets: Vec<SocketAddr> = match &self.peers {
            UdpPeers::Fixed(target) => vec![*target],
            UdpPeers::Learned(peers) => peers.iter().map(|(address, _)| *address).collect(),
        };
        let mut outcome = Ok(false);
        for target in targets {
            match self.socket.send_to(frame, target).await {
                Ok(_) => outcome = Ok(true),
                Err(error) if !matches!(outcome, Ok(true)) => outcome = Err(error),
                Err(_) => {}
            }
        }
        outcome
    }

    fn accept(&mut self, address: SocketAddr) {
        let UdpPeers::Learned(peers) = &mut self.peers else {
            return;
        };
        let now = Instant::now();
        peers.retain(|(known, heard)| *known != address && now - *heard < SILENCE);
        if peers.len() == MAX_PEERS {
            peers.remove(0);
        }
        peers.push((address, now));
    }
}

trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Stream for T {}
type BoxedStream = Box<dyn Stream>;

struct StreamPort {
    opener: Opener,
    open: Option<BoxedStream>,
    /// An attempt under way: kept here so that a cancelled `recv` does not start it over.
    opening: Option<Opening>,
    connections: u64,
    heard: Instant,
    next_attempt: Instant,
    back_off: Duration,
}

enum Opener {
    Accept(Arc<TcpListener>),
    Dial(String),
    Serial { device: String, baud: u32 },
}

type Opening = Pin<Box<dyn Future<Output = std::io::Result<BoxedStream>> + Send>>;

impl Opener {
    fn open(&self) -> Opening {
        match self {
            Self::Accept(listener) => {
                let listener = Arc::clone(listener);
                Box::pin(async move {
                    listener
                        .accept()
                        .await
                        .and_then(|(stream, _)| boxed(stream))
                })
            }
            Self::Dial(place) => {
                let place = place.clone();
                Box::pin(async move {
                    timeout(DIAL_PATIENCE, TcpStream::connect(place))
                        .await?
                        .and_then(boxed)
                })
            }
            Self::Serial { device, baud } => {
                let port = tokio_serial::new(device, *baud).open_native_async();
                let port = port.map(|port| Box::new(port) as BoxedStream);
                Box::pin(std::future::ready(port.map_err(std::io::Error::from)))
            }
        }
    }

    /// A client that comes while another one is connected: after a half-open connection the same
    /// client comes again, so the newest one is the living one.
    async fn newcomer(&self) -> std::io::Result<BoxedStream> {
        match self {
            Self::Accept(listener) => listener
                .accept()
                .await
                .and_then(|(stream, _)| boxed(stream)),
            Self::Dial(_) | Self::Serial { .. } => std::future::pending().await,
        }
    }
}

fn boxed(stream: TcpStream) -> std::io::Result<BoxedStream> {
    // Frames are small and urgent: do not gather them.
    stream.set_nodelay(true)?;
    Ok(Box::new(stream))
}

impl StreamPort {
    fn new(opener: Opener) -> Self {
        let now = Instant::now();
        let (back_off, _) = BACK_OFF;
        Self {
            opener,
            open: None,
            opening: None,
            connections: 0,
            heard: now,
            next_attempt: now,
            back_off,
        }
    }

    async fn recv(&mut self, url: &LinkUrl, buffer: &mut [u8]) -> Chunk {
        loop {
            let Some(stream) = &mut self.open else {
                self.reopen(url).await;
                continue;
            };
            tokio::select! {
                read = timeout_at(self.heard + SILENCE, stream.read(buffer)) => match read {
                    Ok(Ok(length @ 1..)) => {
                        self.heard = Instant::now();
                        let (from, bytes) = (Peer::Connection(self.connections), &buffer[..length]);
                        return Chunk { from, bytes: bytes.to_vec() };
                    }
                    Ok(Ok(_)) => self.close(url, "closed by the peer"),
                    Ok(Err(error)) => self.close(url, &error.to_string()),
                    Err(_) => self.close(url, "silent"),
                },
                newcomer = self.opener.newcomer() => {
                    if let Ok(stream) = newcomer {
                        self.connected(url, stream);
                    }
                }
            }
        }
    }

    async fn reopen(&mut self, url: &LinkUrl) {
        sleep_until(self.next_attempt).await;
        let opened = self.opening.get_or_insert_with(|| self.opener.open()).await;
        self.opening = None;
        match opened {
            Ok(stream) => self.connected(url, stream),
            Err(error) => {
                tracing::warn!(%url, %error, retry_in_s = self.back_off.as_secs_f64(), "not connected");
                self.next_attempt = Instant::now() + self.back_off;
                self.back_off = (self.back_off * 2).min(BACK_OFF.1);
            }
        }
    }

    fn connected(&mut self, url: &LinkUrl, stream: BoxedStream) {
        tracing::info!(%url, "connected");
        self.open = Some(stream);
        self.connections += 1;
        self.heard = Instant::now();
        self.back_off = BACK_OFF.0;
    }

    fn close(&mut self, url: &LinkUrl, why: &str) {
        tracing::warn!(%url, why, "connection lost");
        self.open = None;
        self.next_attempt = Instant::now() + self.back_off;
    }

    async fn send(&mut self, frame: &[u8]) -> std::io::Result<bool> {
        let Some(stream) = &mut self.open else {
            return Ok(false);
        };
        let sent = match timeout(SEND_PATIENCE, stream.write_all(frame)).await {
            Ok(sent) => sent,
            Err(stalled) => Err(stalled.into()),
        };
        if sent.is_err() {
            // Half a frame may be out: the stream is of no more use.
            self.open = None;
            self.next_attempt = Instant::now() + self.back_off;
        }
        sent.map(|()| true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(url: &str) -> Result<LinkUrl, LinkUrlError> {
        url.parse()
    }

    #[test]
    fn every_form_reads_back_as_it_was_written() {
        for url in [
            "udpin:0.0.0.0:14540",
            "udpout:127.0.0.1:14550",
            "tcpin:[::1]:5760",
            "tcpout:sitl.local:5760",
            "serial:/dev/ttyAMA0:921600",
        ] {
            assert_eq!(parsed(url).unwrap().to_string(), url);
        }
    }

    #[test]
    fn a_wrong_url_says_what_is_allowed() {
        let scheme = parsed("udp:127.0.0.1:14550").unwrap_err().to_string();
        assert!(scheme.contains("udpin:HOST:PORT") && scheme.contains("serial:DEVICE:BAUD"));
        assert!(matches!(
            parsed("udpin://0.0.0.0:1"),
            Err(LinkUrlError::HostPort { .. })
        ));
        assert!(matches!(
            parsed("udpin:14540"),
            Err(LinkUrlError::HostPort { .. })
        ));
        assert!(matches!(
            parsed("tcpin:host:0"),
            Err(LinkUrlError::HostPort { .. })
        ));
        assert!(matches!(
            parsed("tcpin:host:99999"),
            Err(LinkUrlError::HostPort { .. })
        ));
        assert!(matches!(
            parsed("serial:/dev/ttyUSB0"),
            Err(LinkUrlError::Serial { .. })
        ));
        assert!(matches!(
            parsed("serial:/dev/ttyUSB0:fast"),
            Err(LinkUrlError::Serial { .. })
        ));
        assert!(matches!(parsed(""), Err(LinkUrlError::Scheme { .. })));
    }

    async fn free_udp() -> (Link, SocketAddr) {
        let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let place = socket.local_addr().unwrap();
        drop(socket);
        (
            Link::open(&LinkUrl::UdpIn(place.to_string()))
                .await
                .unwrap(),
            place,
        )
    }

    #[tokio::test]
    async fn a_listening_udp_port_answers_whom_it_accepted_and_nobody_else() {
        let (mut link, place) = free_udp().await;
        let mut vehicle = Link::open(&LinkUrl::UdpOut(place.to_string()))
            .await
            .unwrap();
        vehicle.send(b"hello").await.unwrap();
        let chunk = link.recv().await;
        assert_eq!(chunk.bytes, b"hello");
        assert!(matches!(
            link.send(b"too early").await,
            Err(LinkError::NotConnected { .. })
        ));
        link.accept_peer(chunk.from);
        link.send(b"answer").await.unwrap();
        assert_eq!(vehicle.recv().await.bytes, b"answer");
    }

    #[tokio::test]
    async fn an_address_in_use_is_refused_at_once() {
        let (_link, place) = free_udp().await;
        let second = Link::open(&LinkUrl::UdpIn(place.to_string())).await;
        assert!(matches!(second, Err(LinkError::Open { .. })));
    }

    #[tokio::test]
    async fn a_tcp_link_comes_back_after_its_peer_did() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = LinkUrl::TcpOut(listener.local_addr().unwrap().to_string());
        let mut link = Link::open(&url).await.unwrap();
        assert!(matches!(
            link.send(b"nobody").await,
            Err(LinkError::NotConnected { .. })
        ));
        let peer = async {
            for word in [b"first", b"again"] {
                let (mut stream, _) = listener.accept().await.unwrap();
                stream.write_all(word).await.unwrap();
            }
        };
        let ours = async { [link.recv().await, link.recv().await] };
        let (_, [first, again]) = tokio::join!(peer, ours);
        assert_eq!(
            (first.bytes, again.bytes),
            (b"first".to_vec(), b"again".to_vec())
        );
        assert_ne!(first.from, again.from);
    }

    #[tokio::test]
    async fn the_newest_client_of_a_listening_tcp_port_counts() {
        let place = {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            listener.local_addr().unwrap()
        };
        let mut link = Link::open(&LinkUrl::TcpIn(place.to_string()))
            .await
            .unwrap();
        let mut dead = TcpStream::connect(place).await.unwrap();
        dead.write_all(b"old").await.unwrap();
        assert_eq!(link.recv().await.bytes, b"old");
        let mut alive = TcpStream::connect(place).await.unwrap();
        alive.write_all(b"new").await.unwrap();
        assert_eq!(link.recv().await.bytes, b"new");
        link.send(b"reply").await.unwrap();
        let mut reply = [0; 5];
        alive.read_exact(&mut reply).await.unwrap();
        assert_eq!(&reply, b"reply");
    }

    #[tokio::test]
    async fn a_serial_device_that_is_not_there_is_waited_for() {
        let url = LinkUrl::Serial {
            device: "/dev/emberfix-none".to_owned(),
            baud: 57_600,
        };
        let mut link = Link::open(&url).await.unwrap();
        assert!(
            timeout(Duration::from_millis(50), link.recv())
                .await
                .is_err()
        );
        assert!(matches!(
            link.send(b"x").await,
            Err(LinkError::NotConnected { .. })
        ));
    }
}
