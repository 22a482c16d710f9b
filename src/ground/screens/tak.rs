//! The ways to TAK: multicast for whoever listens, TCP or TLS to a server.
//!
//! **Queue.** None: each receiver is told the difference between how things stand and what it last
//! heard ([`Told`]). **Loss.** A datagram may get lost; everything is said again every
//! [`REPEAT_S`]. A stream that breaks is dialled anew, and then told everything that stands.

use super::Incidents;
use super::cot::{self, Profile, Telling};
use super::told::{Rhythm, Told, Word};
use crate::ground::now;
use emberfix_frames::{ServiceTime, SignedDuration};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpStream, UdpSocket};
use tokio::sync::watch;
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

/// What stands is said again this often, so that who comes later sees it too.
const REPEAT_S: i64 = 60;
/// How often a receiver is looked after; a change wakes it at once.
const TICK: Duration = Duration::from_secs(1);
/// A server that takes nothing for so long is dialled anew.
const PATIENCE: Duration = Duration::from_secs(10);
/// First and longest pause between attempts.
const BACK_OFF: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(30));
/// Hops that multicast may take: the mesh of one site.
const MULTICAST_TTL: u32 = 4;

/// One receiver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::ground) struct TakConfig {
    pub endpoint: Endpoint,
    pub profile: Profile,
    pub stale_s: i64,
}

/// Where it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::ground) enum Endpoint {
    /// Datagrams, one event each; `interface` names the one that multicast leaves by.
    Udp {
        to: SocketAddr,
        interface: Option<Ipv4Addr>,
    },
    /// A server, unguarded.
    Tcp { place: String },
    /// A server, both sides known by certificate.
    Tls { place: String, files: TlsFiles },
}

/// PEM files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::ground) struct TlsFiles {
    pub ca: PathBuf,
    pub certificate: PathBuf,
    pub key: PathBuf,
    pub server_name: String,
}

impl std::fmt::Display for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Udp { to, .. } => write!(f, "udp://{to}"),
            Self::Tcp { place } => write!(f, "tcp://{place}"),
            Self::Tls { place, .. } => write!(f, "tls://{place}"),
        }
    }
}

/// Why a receiver can never be reached as configured.
#[derive(Debug, thiserror::Error)]
pub enum TakError {
    /// A PEM file is missing or holds no such thing.
    #[error("cot: {path}: {reason}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The certificates do not make a client.
    #[error("cot: {path} with its key: {source}", path = path.display())]
    Identity {
        /// The certificate.
        path: PathBuf,
        /// What the TLS library said.
        source: tokio_rustls::rustls::Error,
    },
    /// The server's name is none.
    #[error("cot.server_name is {name:?}, allowed is a host name or an IP address")]
    Name {
        /// What was given.
        name: String,
    },
}

/// How a receiver fares; for the metrics.
#[derive(Debug, Default)]
pub(super) struct Health {
    pub connected: AtomicBool,
    pub sent: AtomicU64,
    pub failed: AtomicU64,
}

/// A receiver that is looked after until `incidents` ends.
pub(super) struct Tak {
    config: TakConfig,
    tls: Option<(TlsConnector, ServerName<'static>)>,
    incidents: watch::Receiver<Incidents>,
    health: Arc<Health>,
}

/// The station stops.
struct Ended;

impl Tak {
    /// Reads what TLS needs; nothing is dialled yet.
    pub(super) fn new(
        config: TakConfig,
        incidents: watch::Receiver<Incidents>,
        health: Arc<Health>,
    ) -> Result<Self, TakError> {
        let tls = match &config.endpoint {
            Endpoint::Tls { files, .. } => Some(connector(files)?),
            Endpoint::Udp { .. } | Endpoint::Tcp { .. } => None,
        };
        Ok(Self {
            config,
            tls,
            incidents,
            health,
        })
    }

    pub(super) async fn run(mut self) {
        let mut pause = BACK_OFF.0;
        loop {
            let attempt = self.serve().await;
            let was_connected = self.health.connected.swap(false, Ordering::Relaxed);
            let Err(error) = attempt else { return };
            self.health.failed.fetch_add(1, Ordering::Relaxed);
            tracing::warn!(%error, to = %self.config.endpoint, "a TAK receiver is not reached");
            pause = if was_connected {
                BACK_OFF.0
            } else {
                (pause * 2).min(BACK_OFF.1)
            };
            sleep(pause).await;
        }
    }

    /// `Ok` when the station stops.
    async fn serve(&mut self) -> std::io::Result<()> {
        match self.config.endpoint.clone() {
            Endpoint::Udp { to, interface } => {
                let socket = open_udp(to, interface).await?;
                self.tell_datagrams(&socket, to).await
            }
            Endpoint::Tcp { place } => {
                let stream = dial(&place).await?;
                self.tell_stream(stream).await
            }
            Endpoint::Tls { place, .. } => {
                let Some((connector, name)) = self.tls.clone() else {
                    return Ok(());
                };
                let stream = dial(&place).await?;
                let stream = in_time(connector.connect(name, stream)).await?;
                self.tell_stream(stream).await
            }
        }
    }

    async fn tell_datagrams(&mut self, socket: &UdpSocket, to: SocketAddr) -> std::io::Result<()> {
        let mut told = Told::default();
        self.health.connected.store(true, Ordering::Relaxed);
        loop {
            for word in self.due(&mut told) {
                socket.send_to(self.text(&word).as_bytes(), to).await?;
                self.note(&mut told, &word);
            }
            if self.wait().await.is_err() {
                return Ok(());
            }
        }
    }

    async fn tell_stream(
        &mut self,
        stream: impl AsyncRead + AsyncWrite + Send,
    ) -> std::io::Result<()> {
        let (mut reader, mut writer) = tokio::io::split(stream);
        self.health.connected.store(true, Ordering::Relaxed);
        let mut told = Told::default();
        // What a server sends us (other people's markers) is read, so that it never blocks, and let go.
        let mut ears = std::pin::pin!(listen(&mut reader));
        loop {
            for word in self.due(&mut told) {
                let text = self.text(&word);
                tokio::select! {
                    sent = in_time(writer.write_all(text.as_bytes())) => sent?,
                    closed = &mut ears => return closed,
                }
                self.note(&mut told, &word);
            }
            in_time(writer.flush()).await?;
            tokio::select! {
                waited = self.wait() => if waited.is_err() { return Ok(()) },
                closed = &mut ears => return closed,
            }
        }
    }

    fn due(&self, told: &mut Told) -> Vec<Word> {
        let incidents = Arc::clone(&self.incidents.borrow());
        told.forget(&incidents, self.rhythm());
        told.due(&incidents, now(), self.rhythm())
    }

    fn text(&self, word: &Word) -> String {
        let telling = self.telling(now());
        match word {
            Word::Stands(incident) => cot::event(incident, &telling),
            Word::Gone(id) => cot::deletion(id, &telling),
        }
    }

    fn note(&self, told: &mut Told, word: &Word) {
        told.said(word, now());
        self.health.sent.fetch_add(1, Ordering::Relaxed);
    }

    fn telling(&self, now: ServiceTime) -> Telling {
        Telling {
            profile: self.config.profile,
            now,
            stale: SignedDuration::from_secs(self.config.stale_s),
        }
    }

    fn rhythm(&self) -> Rhythm {
        Rhythm {
            repeat: SignedDuration::from_secs(REPEAT_S.min(self.config.stale_s / 2)),
            farewells: match self.config.endpoint {
                Endpoint::Udp { .. } => 3,
                Endpoint::Tcp { .. } | Endpoint::Tls { .. } => 1,
            },
            forget: SignedDuration::from_secs(self.config.stale_s),
        }
    }

    /// Until something changed, or a tick has passed.
    async fn wait(&mut self) -> Result<(), Ended> {
        match timeout(TICK, self.incidents.changed()).await {
            Ok(Err(_)) => Err(Ended),
            Ok(Ok(())) | Err(_) => Ok(()),
        }
    }
}

async fn in_time<T>(work: impl Future<Output = std::io::Result<T>>) -> std::io::Result<T> {
    timeout(PATIENCE, work)
        .await
        .unwrap_or_else(|_| Err(std::io::ErrorKind::TimedOut.into()))
}

async fn dial(place: &str) -> std::io::Result<TcpStream> {
    let stream = in_time(TcpStream::connect(place)).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Reads and lets go; returns when the other side is no more.
async fn listen(reader: &mut (impl AsyncRead + Unpin)) -> std::io::Result<()> {
    let mut buffer = [0; 4096];
    loop {
        if reader.read(&mut buffer).await? == 0 {
            return Err(std::io::ErrorKind::UnexpectedEof.into());
        }
    }
}

async fn open_udp(to: SocketAddr, interface: Option<Ipv4Addr>) -> std::io::Result<UdpSocket> {
    let any: SocketAddr = match (to, interface) {
        (SocketAddr::V4(_), Some(interface)) => (interface, 0).into(),
        (SocketAddr::V4(_), None) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        (SocketAddr::V6(_), _) => (std::net::Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any).await?;
    if to.ip().is_multicast() {
        // A client on this very machine should see it too.
        socket.set_multicast_loop_v4(true)?;
        socket.set_multicast_ttl_v4(MULTICAST_TTL)?;
    }
    Ok(socket)
}

fn connector(files: &TlsFiles) -> Result<(TlsConnector, ServerName<'static>), TakError> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(&files.ca)? {
        roots
            .add(certificate)
            .map_err(|error| bad(&files.ca, error))?;
    }
    let key = PrivateKeyDer::from_pem_file(&files.key).map_err(|error| bad(&files.key, error))?;
    let provider = Arc::new(tokio_rustls::rustls::crypto::ring::default_provider());
    let identity = |source| TakError::Identity {
        path: files.certificate.clone(),
        source,
    };
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(identity)?
        .with_root_certificates(roots)
        .with_client_auth_cert(certificates(&files.certificate)?, key)
        .map_err(identity)?;
    let name = ServerName::try_from(files.server_name.clone()).map_err(|_| TakError::Name {
        name: files.server_name.clone(),
    })?;
    Ok((TlsConnector::from(Arc::new(config)), name))
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, TakError> {
    let read: Vec<_> = CertificateDer::pem_file_iter(path)
        .and_then(Iterator::collect)
        .map_err(|error| bad(path, error))?;
    if read.is_empty() {
        return Err(bad(path, "no certificate in it"));
    }
    Ok(read)
}

fn bad(path: &Path, reason: impl std::fmt::Display) -> TakError {
    TakError::File {
        path: path.to_owned(),
        reason: reason.to_string(),
    }
}
