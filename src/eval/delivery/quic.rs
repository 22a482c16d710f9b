//! QUIC, measured beside what we ship; it is no link of ours.
//!
//! Each alarm goes on a stream of its own over one connection, so that none waits for another one's lost
//! packets; its receipt comes back on the same stream. The aircraft's end (`carry`) empties the real
//! outbox; the ground's end (`Relay`) hands each alarm to the real station over HTTP on this computer, and
//! answers when that has its receipt. That hop costs about a millisecond.
//!
//! **Chosen for it:** a first guess of 100 ms for the way there and back (the library's is 333 ms), a
//! connection that is kept alive, quinn's loss recovery otherwise. Congestion control is CUBIC, the
//! library's default, or its BBR.

use super::{DeliveryError, io};
use crate::alarm::{Alarm, Attention};
use crate::deliver::envelope::Sealed;
use crate::deliver::http::HttpLink;
use crate::deliver::{DatagramDelivery, Letter, Receipt};
use crate::service::{Board, SharedOutbox, lock};
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{Connection, Endpoint, RecvStream, SendStream, TransportConfig};
use std::collections::BTreeSet;
use std::error::Error;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::runtime::{Builder, Runtime};
use tokio_rustls::rustls::crypto::ring::default_provider;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use tokio_rustls::rustls::version::TLS13;
use tokio_rustls::rustls::{ClientConfig, RootCertStore, ServerConfig};

/// How fast QUIC lets itself send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Congestion {
    /// CUBIC: takes loss for a full way.
    Cubic,
    /// BBR: looks at rate and round trip.
    Bbr,
}

impl Congestion {
    /// As the aircraft's arguments name it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Cubic => "cubic",
            Self::Bbr => "bbr",
        }
    }
}

type Failed = Box<dyn Error + Send + Sync>;

/// The one name in the certificate.
const NAME: &str = "localhost";
/// Largest alarm with its header.
const MAX_BYTES: usize = 64 * 1024;
/// Between two looks at the outbox, and after a connection that failed.
const LOOK: Duration = Duration::from_millis(5);
const AGAIN: Duration = Duration::from_millis(250);
/// What the ground answers when it has its receipt.
const STORED: [u8; 1] = [1];

fn failed(doing: &'static str) -> impl Fn(Failed) -> DeliveryError {
    move |source| io(doing)(std::io::Error::other(source))
}

fn transport(congestion: Congestion) -> TransportConfig {
    let mut transport = TransportConfig::default();
    transport
        .initial_rtt(Duration::from_millis(100))
        .keep_alive_interval(Some(Duration::from_secs(1)))
        .max_concurrent_bidi_streams(256_u32.into());
    if congestion == Congestion::Bbr {
        transport.congestion_controller_factory(Arc::new(quinn::congestion::BbrConfig::default()));
    }
    transport
}

/// The ground's end; it ends when this is dropped.
pub(super) struct Relay {
    pub address: SocketAddr,
    /// File of its certificate, DER.
    pub certificate: PathBuf,
    _runtime: Runtime,
}

impl Relay {
    /// Takes alarms for the station at `ground`.
    pub fn start(ground: SocketAddr, folder: &Path) -> Result<Self, DeliveryError> {
        let doing = "start QUIC";
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(io(doing))?;
        let (config, certificate) = server_config().map_err(failed(doing))?;
        let path = folder.join("quic.der");
        std::fs::write(&path, certificate).map_err(io("write a certificate"))?;
        let link = HttpLink::new(&format!("http://{ground}"))
            .map_err(|error| failed(doing)(error.into()))?;
        let here = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let inside = runtime.enter();
        let endpoint = Endpoint::server(config, here).map_err(io(doing))?;
        let address = endpoint.local_addr().map_err(io(doing))?;
        runtime.spawn(accept(endpoint, link));
        drop(inside);
        Ok(Self {
            address,
            certificate: path,
            _runtime: runtime,
        })
    }
}

fn server_config() -> Result<(quinn::ServerConfig, CertificateDer<'static>), Failed> {
    let rcgen::CertifiedKey { cert, signing_key } =
        rcgen::generate_simple_self_signed([NAME.to_owned()])?;
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(signing_key.serialize_der()));
    let crypto = ServerConfig::builder_with_provider(Arc::new(default_provider()))
        .with_protocol_versions(&[&TLS13])?
        .with_no_client_auth()
        .with_single_cert(vec![cert.der().clone()], key)?;
    let mut config =
        quinn::ServerConfig::with_crypto(Arc::new(QuicServerConfig::try_from(crypto)?));
    config.transport_config(Arc::new(transport(Congestion::Cubic)));
    Ok((config, cert.der().clone()))
}

async fn accept(endpoint: Endpoint, link: HttpLink) {
    while let Some(incoming) = endpoint.accept().await {
        let link = link.clone();
        tokio::spawn(async move {
            let Ok(connection) = incoming.await else {
                return;
            };
            while let Ok((answer, alarm)) = connection.accept_bi().await {
                tokio::spawn(take(answer, alarm, link.clone()));
            }
        });
    }
}

/// One alarm; without an answer the aircraft sends it again.
async fn take(mut answer: SendStream, mut alarm: RecvStream, link: HttpLink) -> Result<(), Failed> {
    let bytes = alarm.read_to_end(MAX_BYTES).await?;
    let letter = unpacked(&bytes).ok_or("no alarm")?;
    tokio::task::spawn_blocking(move || link.send_letter(&letter)).await??;
    answer.write_all(&STORED).await?;
    answer.finish()?;
    Ok(())
}

/// The signed header's length in two bytes, the header, the alarm.
fn packed(letter: &Letter) -> Option<Vec<u8>> {
    let sealed = &letter.sealed;
    let header = sealed.envelope.http_header(sealed.signature.as_ref());
    let length = u16::try_from(header.len()).ok()?.to_be_bytes();
    Some([&length[..], header.as_bytes(), &sealed.envelope.alarm].concat())
}

fn unpacked(bytes: &[u8]) -> Option<Letter> {
    let (length, rest) = bytes.split_first_chunk()?;
    let (header, alarm) = rest.split_at_checked(u16::from_be_bytes(*length).into())?;
    let sealed = Sealed::from_http(std::str::from_utf8(header).ok()?, alarm).ok()?;
    Some(Letter {
        alarm: Arc::new(Alarm::from_geojson(alarm).ok()?),
        sealed: Arc::new(sealed),
        attention: Attention::Wanted,
    })
}

/// The aircraft's end: a thread that empties the outbox until the board says stop.
pub(super) fn carry(
    outbox: SharedOutbox,
    board: Arc<Board>,
    to: SocketAddr,
    certificate: &Path,
    congestion: Congestion,
) -> Result<JoinHandle<()>, DeliveryError> {
    let certificate = std::fs::read(certificate).map_err(io("read a certificate"))?;
    let config = client_config(certificate.into(), congestion).map_err(failed("start QUIC"))?;
    let runtime = Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(io("start QUIC"))?;
    let fly = async move {
        while !board.is_stopping() {
            // A connection that breaks is made anew; what had no receipt is still in the outbox.
            let _broken = connect_and_empty(&outbox, &board, to, &config).await;
            tokio::time::sleep(AGAIN).await;
        }
    };
    let thread = std::thread::Builder::new().name("quic".to_owned());
    thread
        .spawn(move || runtime.block_on(fly))
        .map_err(io("start a thread"))
}

fn client_config(
    certificate: CertificateDer<'static>,
    congestion: Congestion,
) -> Result<quinn::ClientConfig, Failed> {
    let mut roots = RootCertStore::empty();
    roots.add(certificate)?;
    let crypto = ClientConfig::builder_with_provider(Arc::new(default_provider()))
        .with_protocol_versions(&[&TLS13])?
        .with_root_certificates(roots)
        .with_no_client_auth();
    let mut config = quinn::ClientConfig::new(Arc::new(QuicClientConfig::try_from(crypto)?));
    config.transport_config(Arc::new(transport(congestion)));
    Ok(config)
}

async fn connect_and_empty(
    outbox: &SharedOutbox,
    board: &Board,
    to: SocketAddr,
    config: &quinn::ClientConfig,
) -> Result<(), Failed> {
    let mut endpoint = Endpoint::client((Ipv4Addr::LOCALHOST, 0).into())?;
    endpoint.set_default_client_config(config.clone());
    let connection = endpoint.connect(to, NAME)?.await?;
    let (done, settled) = mpsc::channel();
    let mut under_way = BTreeSet::new();
    while !board.is_stopping() && connection.close_reason().is_none() {
        let letters = lock(outbox).pending(DatagramDelivery::NAME, DatagramDelivery::WINDOW)?;
        for letter in letters {
            if under_way.insert(letter.sequence()) {
                let (connection, done) = (connection.clone(), done.clone());
                tokio::spawn(async move {
                    let stored = tell(&connection, &letter).await.is_ok();
                    // Nobody listens any more when the connection is given up.
                    let _given_up = done.send((letter, stored));
                });
            }
        }
        tokio::time::sleep(LOOK).await;
        let mut receipts = Vec::new();
        for (letter, stored) in settled.try_iter() {
            if stored {
                receipts.push(Receipt {
                    id: letter.id().to_owned(),
                    revision: letter.revision(),
                });
            } else {
                under_way.remove(&letter.sequence());
            }
        }
        if !receipts.is_empty() {
            lock(outbox).acknowledge_all(DatagramDelivery::NAME, &receipts)?;
        }
    }
    Ok(())
}

async fn tell(connection: &Connection, letter: &Letter) -> Result<(), Failed> {
    let bytes = packed(letter).ok_or("too long a header")?;
    let (mut alarm, mut answer) = connection.open_bi().await?;
    alarm.write_all(&bytes).await?;
    alarm.finish()?;
    match answer.read_to_end(STORED.len()).await? == STORED {
        true => Ok(()),
        false => Err("not stored".into()),
    }
}
