//! The door: so many connections and no more, none that does nothing, none that takes for ever, and
//! TLS where it is configured.
//!
//! Every connection is a task of its own from the first byte on: a handshake that dawdles holds up
//! nobody else. What is turned away is counted ([`Turned`]).

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tokio::time::{Instant, Sleep, sleep, timeout};
use tokio_rustls::TlsAcceptor;

use super::lock;

/// What the door allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Limits {
    /// Connections at once; a further one is told so and closed.
    pub connections: usize,
    /// Connections at once from one address that is not this machine.
    pub per_address: usize,
    /// A connection on which no byte has moved for this long is closed: a client that stopped
    /// reading, one that went away without a word.
    pub still: Duration,
    /// The head of a request has to be there within this time, however it trickles; also how long
    /// an idle connection is kept.
    pub head: Duration,
    /// A TLS handshake has to be done within this time.
    pub handshake: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            connections: 2_048,
            per_address: 64,
            still: Duration::from_secs(30),
            head: Duration::from_secs(20),
            handshake: Duration::from_secs(5),
        }
    }
}

/// Largest head of a request, bytes.
const MAX_HEAD: usize = 16 * 1024;
/// Most header lines.
const MAX_HEADERS: usize = 64;
/// Pause after a failed accept (out of file descriptors, mostly), so that it does not spin.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);
/// What a connection too many is told.
const FULL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\nretry-after: 5\r\n\
    content-type: application/json\r\ncontent-length: 37\r\n\r\n{\"error\": \"too many connections here\"}";

/// Connections that were turned away, for `/health`.
#[derive(Debug, Default, Serialize)]
pub(super) struct Turned {
    /// One too many.
    pub full: AtomicU64,
    /// No TLS, not our TLS, or too slow about it.
    pub tls: AtomicU64,
    /// The head did not come in time, or nothing moved any more.
    pub slow: AtomicU64,
    /// No HTTP.
    pub malformed: AtomicU64,
    /// A head that is too large (431).
    pub large: AtomicU64,
}

/// Who is on the other end, as far as the connection says.
#[derive(Debug, Clone)]
pub(super) struct Peer {
    pub address: IpAddr,
    /// SHA-256 of the client's certificate, which a configured authority has signed.
    pub certificate: Option<[u8; 32]>,
}

/// What a door is made of.
#[derive(Clone)]
pub(super) struct Door {
    pub limits: Limits,
    pub tls: Option<TlsAcceptor>,
    pub turned: Arc<Turned>,
}

/// Serves until `stopping` says so, and then until the last connection is done.
pub(super) async fn serve(
    socket: TcpListener,
    app: Router,
    door: Door,
    mut stopping: watch::Receiver<bool>,
) -> io::Result<()> {
    let hall = Hall::new(&door.limits);
    // Closed when the last connection has dropped its sender.
    let (alive, mut ended) = mpsc::channel::<()>(1);
    loop {
        let accepted = tokio::select! {
            _ = stopping.wait_for(|stop| *stop) => break,
            accepted = socket.accept() => accepted,
        };
        let (stream, address) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "a connection could not be accepted");
                sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let Some(place) = hall.enter(address) else {
            door.turned.full.fetch_add(1, Ordering::Relaxed);
            let _ = stream.try_write(FULL);
            continue;
        };
        let guest = Guest {
            app: app.clone(),
            door: door.clone(),
            stopping: stopping.clone(),
            _place: place,
            _alive: alive.clone(),
        };
        tokio::spawn(guest.stay(stream, address));
    }
    drop((socket, alive));
    let _ = ended.recv().await;
    Ok(())
}

/// Who is inside.
struct Hall {
    places: Arc<Semaphore>,
    by_address: Arc<Mutex<HashMap<IpAddr, usize>>>,
    per_address: usize,
}

/// A place inside; given back when dropped.
struct Place {
    _place: OwnedSemaphorePermit,
    address: IpAddr,
    by_address: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

impl Hall {
    fn new(limits: &Limits) -> Self {
        Self {
            places: Arc::new(Semaphore::new(limits.connections)),
            by_address: Arc::default(),
            per_address: limits.per_address,
        }
    }

    fn enter(&self, address: SocketAddr) -> Option<Place> {
        let place = Arc::clone(&self.places).try_acquire_owned().ok()?;
        let address = address.ip();
        let mut by_address = lock(&self.by_address);
        let inside = by_address.entry(address).or_default();
        if *inside >= self.per_address && !address.is_loopback() {
            return None;
        }
        *inside += 1;
        let by_address = Arc::clone(&self.by_address);
        Some(Place {
            _place: place,
            address,
            by_address,
        })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut by_address = lock(&self.by_address);
        if let Some(inside) = by_address.get_mut(&self.address) {
            *inside -= 1;
            if *inside == 0 {
                by_address.remove(&self.address);
            }
        }
    }
}

struct Guest {
    app: Router,
    door: Door,
    stopping: watch::Receiver<bool>,
    _place: Place,
    _alive: mpsc::Sender<()>,
}

impl Guest {
    async fn stay(self, stream: TcpStream, address: SocketAddr) {
        // Small messages that someone waits for; without it they may sit for 40 ms.
        let _ = stream.set_nodelay(true);
        let address = address.ip();
        let stream = Moving::new(stream, self.door.limits.still);
        let Some(tls) = self.door.tls.clone() else {
            let peer = Peer {
                address,
                certificate: None,
            };
            return self.serve(stream, peer).await;
        };
        match timeout(self.door.limits.handshake, tls.accept(stream)).await {
            Ok(Ok(stream)) => {
                let certificates = stream.get_ref().1.peer_certificates();
                let first = certificates.and_then(|chain| chain.first());
                let certificate = first.map(|first| Sha256::digest(first).into());
                self.serve(
                    stream,
                    Peer {
                        address,
                        certificate,
                    },
                )
                .await;
            }
            Ok(Err(_)) | Err(_) => {
                self.door.turned.tls.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    async fn serve(mut self, stream: impl AsyncRead + AsyncWrite + Unpin + 'static, peer: Peer) {
        let app = TowerToHyperService::new(self.app.layer(Extension(peer)));
        let mut builder = http1::Builder::new();
        builder
            .timer(TokioTimer::new())
            .header_read_timeout(self.door.limits.head)
            .max_buf_size(MAX_HEAD)
            .max_headers(MAX_HEADERS);
        let mut connection = std::pin::pin!(builder.serve_connection(TokioIo::new(stream), app));
        let stopped = async { drop(self.stopping.wait_for(|stop| *stop).await) };
        let ended = tokio::select! {
            ended = connection.as_mut() => ended,
            () = stopped => {
                connection.as_mut().graceful_shutdown();
                connection.await
            }
        };
        if let Err(error) = ended {
            self.door.turned.count(&error);
        }
    }
}

impl Turned {
    fn count(&self, error: &hyper::Error) {
        let counter = if error.is_timeout() || is_still(error) {
            &self.slow
        } else if error.is_parse_too_large() {
            &self.large
        } else if error.is_parse() {
            &self.malformed
        } else {
            return; // somebody hung up
        };
        counter.fetch_add(1, Ordering::Relaxed);
    }
}

fn is_still(error: &hyper::Error) -> bool {
    let cause = std::error::Error::source(error);
    let cause = cause.and_then(|cause| cause.downcast_ref::<io::Error>());
    cause.is_some_and(|cause| cause.kind() == io::ErrorKind::TimedOut)
}

/// A stream that fails when no byte has moved for too long.
#[derive(Debug)]
struct Moving {
    stream: TcpStream,
    max_still: Duration,
    still: Pin<Box<Sleep>>,
}

impl Moving {
    fn new(stream: TcpStream, max_still: Duration) -> Self {
        Self {
            stream,
            max_still,
            still: Box::pin(sleep(max_still)),
        }
    }

    fn watch<T>(
        &mut self,
        context: &mut Context<'_>,
        outcome: Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        if outcome.is_ready() {
            let until = Instant::now() + self.max_still;
            self.still.as_mut().reset(until);
            return outcome;
        }
        match self.still.as_mut().poll(context) {
            Poll::Ready(()) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl AsyncRead for Moving {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let outcome = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.watch(context, outcome)
    }
}

impl AsyncWrite for Moving {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let outcome = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.watch(context, outcome)
    }
    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let outcome = Pin::new(&mut self.stream).poll_write_vectored(context, slices);
        self.watch(context, outcome)
    }
    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
