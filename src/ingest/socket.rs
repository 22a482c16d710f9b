//! A live camera: an MCAP stream over a TCP or Unix socket; when it ends, the next one is awaited.
//!
//! The newest pair is kept, older ones are counted as shed. MAVLink frames in the stream are counted
//! and not used (telemetry comes by its own link); calibrations are held against the rig. A sender
//! should end a chunk per pair, or write no chunks: a pair is seen when its chunk is complete.

use super::live::{LiveSource, Producer};
use super::url::ServiceClock;
use super::{Expected, McapStream, SourceError, StereoSource, StreamEvent, note};
use emberfix_calib::{Camera, Eye};
use std::io::{ErrorKind, Read};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Where the stream comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SocketAddress {
    /// Wait on `HOST:PORT`.
    TcpListen(String),
    /// Connect to `HOST:PORT`.
    TcpConnect(String),
    /// Wait on a socket file, which we create.
    UnixListen(PathBuf),
    /// Connect to a socket file.
    UnixConnect(PathBuf),
}

impl std::fmt::Display for SocketAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::TcpListen(address) => write!(f, "tcp-listen:{address}"),
            Self::TcpConnect(address) => write!(f, "tcp-connect:{address}"),
            Self::UnixListen(path) => write!(f, "unix-listen:{}", path.display()),
            Self::UnixConnect(path) => write!(f, "unix-connect:{}", path.display()),
        }
    }
}

/// A stream that says nothing for this long has died without saying so: the next one is awaited.
const SILENCE_LIMIT: Duration = Duration::from_secs(10);
/// Wait for bytes, so that a stop is noticed.
const READ_TIMEOUT: Duration = Duration::from_millis(100);
/// Between two looks for a connection.
const RETRY: Duration = Duration::from_millis(200);
/// Bytes that are read at once.
const READ_BYTES: usize = 64 * 1024;

/// Opens a live stream. A listening socket is bound now, so a bad address is refused at the start;
/// a peer that is not there yet is awaited.
///
/// # Errors
/// [`SourceError::Io`] when the address can't be bound.
pub fn open(
    address: &SocketAddress,
    expected: &Expected,
    clock: ServiceClock,
) -> Result<Box<dyn StereoSource>, SourceError> {
    let doorway = Doorway::open(address).map_err(|source| SourceError::Io {
        source_name: address.to_string(),
        source,
    })?;
    let mut intake = Intake {
        stream: McapStream::new(expected.max_skew_s),
        cameras: expected.cameras.clone(),
        mismatches: 0,
        clock,
    };
    let source = LiveSource::start(address.to_string(), move |producer| {
        while !producer.is_stopped() {
            match doorway.next_connection() {
                Some(connection) => intake.run(connection, producer),
                None => drop(producer.pause(RETRY)),
            }
        }
        Ok(())
    })?;
    Ok(Box::new(source))
}

/// A connection's reading side.
trait Connection: Read {}
impl Connection for TcpStream {}
impl Connection for UnixStream {}

/// Where connections come in, or are made.
enum Doorway {
    Tcp(TcpListener),
    Unix {
        listener: UnixListener,
        path: PathBuf,
    },
    TcpPeer(String),
    UnixPeer(PathBuf),
}

impl Doorway {
    fn open(address: &SocketAddress) -> std::io::Result<Self> {
        Ok(match address {
            SocketAddress::TcpListen(address) => {
                let listener = TcpListener::bind(address)?;
                listener.set_nonblocking(true)?;
                Self::Tcp(listener)
            }
            SocketAddress::UnixListen(path) => {
                remove_stale(path)?;
                let listener = UnixListener::bind(path)?;
                listener.set_nonblocking(true)?;
                Self::Unix {
                    listener,
                    path: path.clone(),
                }
            }
            SocketAddress::TcpConnect(address) => Self::TcpPeer(address.clone()),
            SocketAddress::UnixConnect(path) => Self::UnixPeer(path.clone()),
        })
    }

    /// A connection, if there is one now.
    fn next_connection(&self) -> Option<Box<dyn Connection>> {
        match self {
            Self::Tcp(listener) => tcp(listener.accept().ok()?.0),
            Self::TcpPeer(address) => tcp(TcpStream::connect(address).ok()?),
            Self::Unix { listener, .. } => unix(listener.accept().ok()?.0),
            Self::UnixPeer(path) => unix(UnixStream::connect(path).ok()?),
        }
    }
}

impl Drop for Doorway {
    fn drop(&mut self) {
        if let Self::Unix { path, .. } = self {
            // Already gone is as good.
            drop(std::fs::remove_file(path));
        }
    }
}

fn tcp(stream: TcpStream) -> Option<Box<dyn Connection>> {
    stream.set_nonblocking(false).ok()?;
    stream.set_read_timeout(Some(READ_TIMEOUT)).ok()?;
    Some(Box::new(stream))
}

fn unix(stream: UnixStream) -> Option<Box<dyn Connection>> {
    stream.set_nonblocking(false).ok()?;
    stream.set_read_timeout(Some(READ_TIMEOUT)).ok()?;
    Some(Box::new(stream))
}

/// Removes a socket file that nobody listens on; anything else stays, and binding says so.
fn remove_stale(path: &Path) -> std::io::Result<()> {
    use std::os::unix::fs::FileTypeExt;
    let is_socket = std::fs::symlink_metadata(path).is_ok_and(|meta| meta.file_type().is_socket());
    if is_socket && UnixStream::connect(path).is_err() {
        std::fs::remove_file(path)?;
    }
    Ok(())
}

/// What is done with the bytes of one connection after the other.
struct Intake {
    stream: McapStream,
    /// None yet while a rig is being calibrated.
    cameras: Option<[Camera; 2]>,
    mismatches: u64,
    clock: ServiceClock,
}

impl Intake {
    fn run(&mut self, mut connection: Box<dyn Connection>, producer: &Producer) {
        producer.slot.count(|counters| counters.openings += 1);
        tracing::info!("camera stream connected");
        let mut buffer = vec![0; READ_BYTES];
        let mut heard = Instant::now();
        while !producer.is_stopped() && !self.stream.has_ended() {
            match connection.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => {
                    heard = Instant::now();
                    self.stream.push(&buffer[..count], Some((self.clock)()));
                    self.pass_on(producer);
                }
                Err(error) if is_pause(error.kind()) && heard.elapsed() < SILENCE_LIMIT => {}
                Err(error) => {
                    tracing::warn!(%error, "camera stream broke off");
                    break;
                }
            }
        }
        self.stream.end();
        self.pass_on(producer);
        tracing::info!("camera stream ended; waiting for the next");
    }

    fn pass_on(&mut self, producer: &Producer) {
        while let Some(event) = self.stream.pop() {
            match event {
                StreamEvent::Pair(pair) => producer.slot.put(pair),
                // Counted by the stream.
                StreamEvent::Mavlink { .. } | StreamEvent::Action { .. } => {}
                StreamEvent::Calibration { eye, stated, .. } => {
                    let Some(cameras) = &self.cameras else {
                        continue;
                    };
                    let camera = &cameras[usize::from(eye == Eye::Right)];
                    if let Err(mismatch) = stated.check(camera) {
                        note(
                            &mut self.mismatches,
                            "camera's calibration is not the rig's",
                        );
                        tracing::debug!(?eye, %mismatch, "the rig's calibration counts");
                    }
                }
            }
        }
        let stream = self.stream.counters();
        let mismatches = self.mismatches;
        producer.slot.count(|counters| {
            counters.stream = stream;
            counters.calibration_mismatches = mismatches;
        });
    }
}

fn is_pause(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::testing::{at, pair, rig};
    use crate::record::{RecordOptions, Tape};
    use std::io::Write;
    use std::sync::Arc;

    fn clock() -> ServiceClock {
        Arc::new(|| at(60_000))
    }

    /// A recording of so many pairs, as its bytes.
    fn recording(first: i64, pairs: i64) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        let mut tape = Tape::create(&path, &rig(), &RecordOptions::default()).unwrap();
        for n in first..first + pairs {
            tape.write_pair(&pair(n)).unwrap();
        }
        tape.finish().unwrap();
        std::fs::read(path).unwrap()
    }

    /// Waits until the source has taken so many pairs in.
    fn wait_for(source: &dyn StereoSource, pairs: u64) {
        let begin = Instant::now();
        while source.counters().stream.pairs < pairs {
            assert!(
                begin.elapsed() < Duration::from_secs(20),
                "{:?}",
                source.counters()
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn take(source: &mut dyn StereoSource) -> i64 {
        let pair = source.next_pair().unwrap().unwrap();
        assert_eq!(pair.value.arrived, at(60_000), "arrival is by our clock");
        (pair.at - at(0)).as_millis() as i64
    }

    #[test]
    fn the_newest_pair_is_kept_and_the_next_stream_is_awaited() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.sock");
        let address = SocketAddress::UnixListen(path.clone());
        let mut source = open(&address, &Expected::of(&rig()), clock()).unwrap();
        UnixStream::connect(&path)
            .unwrap()
            .write_all(&recording(0, 5))
            .unwrap();
        wait_for(&*source, 5);
        assert_eq!(take(&mut *source), 400);
        // The second camera breaks off within its stream and starts at an earlier time.
        let torn = recording(0, 3);
        UnixStream::connect(&path)
            .unwrap()
            .write_all(&torn[..torn.len() - 100])
            .unwrap();
        wait_for(&*source, 8);
        assert_eq!(take(&mut *source), 200);
        let counters = source.counters();
        assert_eq!(
            (counters.shed, counters.delivered, counters.openings),
            (6, 2, 2)
        );
        assert_eq!(
            (
                counters.calibration_mismatches,
                counters.stream.calibrations
            ),
            (0, 4)
        );
        drop(source);
        assert!(!path.exists(), "the socket file goes with its source");
    }

    #[test]
    fn we_connect_as_soon_as_a_camera_listens_and_again_when_it_comes_back() {
        let probe = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = probe.local_addr().unwrap();
        drop(probe);
        let address = SocketAddress::TcpConnect(port.to_string());
        let mut source = open(&address, &Expected::of(&rig()), clock()).unwrap();
        let listener = TcpListener::bind(port).unwrap();
        for round in 0..2 {
            let (mut connection, _) = listener.accept().unwrap();
            connection.write_all(&recording(3 * round, 3)).unwrap();
            drop(connection);
            wait_for(&*source, 3 * (round as u64 + 1));
            assert_eq!(take(&mut *source), 300 * round + 200);
        }
    }

    #[test]
    fn a_camera_that_sends_garbage_or_nothing_is_reported_and_survived() {
        let address = SocketAddress::TcpListen("127.0.0.1:0".to_owned());
        assert!(open(&address, &Expected::of(&rig()), clock()).is_ok());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.sock");
        let mut source = open(
            &SocketAddress::UnixListen(path.clone()),
            &Expected::of(&rig()),
            clock(),
        )
        .unwrap();
        UnixStream::connect(&path)
            .unwrap()
            .write_all(&[0x5A; 100_000])
            .unwrap();
        let error = source.next_pair().unwrap_err();
        assert!(matches!(error, SourceError::NoFrames { .. }) && !error.is_fatal());
        assert_eq!(source.counters().stream.garbage_bytes, 100_000);
        UnixStream::connect(&path)
            .unwrap()
            .write_all(&recording(0, 1))
            .unwrap();
        assert_eq!(take(&mut *source), 0);
    }

    #[test]
    fn an_address_that_is_taken_is_refused_at_once() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = SocketAddress::TcpListen(taken.local_addr().unwrap().to_string());
        let error = open(&address, &Expected::of(&rig()), clock())
            .map(drop)
            .unwrap_err();
        assert!(
            error.is_fatal() && error.to_string().contains("tcp-listen:127.0.0.1"),
            "{error}"
        );
    }
}
