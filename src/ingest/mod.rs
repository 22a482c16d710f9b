//! Stereo pairs from a camera, a folder, a recording or a socket.
//!
//! **Purpose.** One shape, [`StereoPair`], for every way in which images reach us.
//! **In:** a URL ([`CameraUrl`] lists the forms): an MCAP stream on a TCP or Unix socket, an MCAP file,
//! a V4L2 or GStreamer camera, a video file, a folder of images.
//! **Out:** pairs, still encoded as they came, stamped with mid-exposure on the service clock (UTC ns),
//! at the camera's rate. Nothing here decodes pixels except [`decode`] and what OpenCV's capture hands
//! over decoded.
//!
//! **Assumptions.** Each eye's exposure times rise; the rig's greatest skew is below half the time from
//! frame to frame. Stream timestamps are service time (the sender runs on this computer or keeps its
//! clock by it); [`CaptureClock`] says how good a camera's own are.
//!
//! **Queues.** Live sources keep the newest pair ([`LatestPair`], a queue of one) and count the rest.
//! Pairing waits for at most [`PairAssembler::PENDING_PER_EYE`] images of an eye, then goes on with
//! one eye. An MCAP record or chunk above [`RECORD_LIMIT_BYTES`] ends its stream.
//!
//! **Known limits.** A damaged record *between* chunks of a recording loses what follows it (counted
//! as `lost_bytes`); a damaged chunk loses that chunk only. No rolling-shutter times.

mod blocks;
pub mod camera;
pub mod decode;
pub mod folder;
mod jpeg;
mod live;
mod mcap_stream;
mod messages;
mod pairing;
pub mod recording;
pub mod socket;
#[cfg(test)]
pub(crate) mod testing;
mod url;

pub use blocks::RECORD_LIMIT_BYTES;
pub use camera::CaptureClock;
pub use decode::{DecodeError, EyeHealth, EyeWatch, ImageDecoder, stated_size_px};
pub use live::{LatestPair, PATIENCE, Taken};
pub use mcap_stream::{McapStream, StreamEvent};
pub use messages::{CalibrationMismatch, StatedCalibration};
pub use pairing::PairAssembler;
pub use recording::{Recorded, Recording};
pub use url::{CameraUrl, CameraUrlError, ServiceClock, open};

use crate::assess::spectrum::Spectrum;
use bytes::Bytes;
use emberfix_calib::{Camera, Eye, Rig};
use emberfix_frames::{ServiceTime, SignedDuration, Stamped};
use std::path::PathBuf;

/// How an image is encoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ImageEncoding {
    /// JPEG file.
    Jpeg,
    /// PNG file.
    Png,
    /// Plain pixels, as `foxglove.RawImage` names them (`bgr8`, `rgb8`, `mono8`, ..).
    Raw {
        /// Encoding by its Foxglove name.
        encoding: String,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes from one row to the next.
        step: u32,
    },
}

/// One eye's image as it came.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedImage {
    /// How to read `bytes`.
    pub encoding: ImageEncoding,
    /// The bytes, untouched.
    pub bytes: Bytes,
    /// Mid-exposure of this eye.
    pub at: ServiceTime,
}

/// Two images of one moment; either eye may be missing, never both.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StereoPair {
    /// Number in the source, from 0.
    pub sequence: u64,
    /// When it reached us.
    pub arrived: ServiceTime,
    /// Left eye; the pair's time is its time.
    pub left: EncodedImage,
    /// Right eye; absent when it is dead or out of step by more than the rig allows.
    pub right: Option<EncodedImage>,
    /// Right minus left exposure.
    pub skew: SignedDuration,
    /// Spectrometer readings that came since the pair before, in their order; at most [`SPECTRA`].
    pub spectra: Vec<Spectrum>,
}

/// Spectrometer readings that wait for a pair at most; the oldest goes first.
pub const SPECTRA: usize = 16;

/// What images are expected.
#[derive(Debug, Clone, PartialEq)]
pub struct Expected {
    /// The cameras that they should come from; none are known while they are being calibrated.
    pub cameras: Option<[Camera; 2]>,
    /// Greatest difference of the two exposures that still counts as one moment, seconds.
    pub max_skew_s: f64,
}

impl Expected {
    /// A rig's.
    #[must_use]
    pub fn of(rig: &Rig) -> Self {
        let camera = |eye| rig.camera(eye).clone();
        Self {
            cameras: Some([camera(Eye::Left), camera(Eye::Right)]),
            max_skew_s: rig.max_skew_s(),
        }
    }

    /// Columns, rows.
    fn image_size_px(&self) -> Option<(u32, u32)> {
        self.cameras.as_ref().map(|[left, _]| left.image_size_px)
    }
}

/// A source of pairs.
pub trait StereoSource: Send {
    /// The next pair; `None` when the source has ended. A live source waits at most
    /// [`PATIENCE`] and then says [`SourceError::NoFrames`].
    ///
    /// # Errors
    /// [`SourceError`]; [`SourceError::is_fatal`] says whether to go on.
    fn next_pair(&mut self) -> Result<Option<Stamped<StereoPair>>, SourceError>;

    /// What has come and what was lost so far.
    fn counters(&self) -> SourceCounters {
        SourceCounters::default()
    }

    /// What the pairs' times rest on.
    fn capture_clock(&self) -> CaptureClock {
        CaptureClock::Stated
    }
}

/// What a source has delivered and lost, since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SourceCounters {
    /// Pairs handed on.
    pub delivered: u64,
    /// Pairs that a newer one replaced before they were asked for.
    pub shed: u64,
    /// Connections of a live stream, or openings of a camera.
    pub openings: u64,
    /// Frames that a camera gave in the wrong size or not at all.
    pub bad_frames: u64,
    /// Calibrations in the stream that are not the rig's; the rig counts.
    pub calibration_mismatches: u64,
    /// What stood in the MCAP stream.
    pub stream: StreamCounters,
}

/// What stood in MCAP streams: used, ignored, refused. Each refusal has its own counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct StreamCounters {
    /// Pairs with both eyes.
    pub pairs: u64,
    /// Left images that went on without a right one.
    pub left_alone: u64,
    /// Right images without a left one: dropped.
    pub right_alone: u64,
    /// Images whose exposure is not later than the one before, of the same eye: dropped.
    pub backwards: u64,
    /// Images exposed later than they arrived, beyond clock jitter: dropped.
    pub from_the_future: u64,
    /// Images without a timestamp: dropped.
    pub unstamped: u64,
    /// Images in a format that we don't read: dropped.
    pub unknown_format: u64,
    /// Messages that are not what their schema says: dropped.
    pub unreadable: u64,
    /// Calibrations.
    pub calibrations: u64,
    /// MAVLink frames.
    pub mavlink: u64,
    /// Operators' actions.
    pub actions: u64,
    /// Spectrometer readings.
    pub spectrometer: u64,
    /// Spectrometer readings that newer ones pushed out before a pair came: dropped.
    pub spectra_shed: u64,
    /// Messages of other topics: ignored.
    pub other: u64,
    /// Messages of channels that nothing declared: dropped.
    pub undeclared: u64,
    /// Chunks with a wrong checksum, length or compression: dropped whole.
    pub bad_chunks: u64,
    /// Bytes before the stream's beginning: skipped.
    pub garbage_bytes: u64,
    /// Bytes after a record that can't be read, or of a record that was cut off.
    pub lost_bytes: u64,
}

/// Why there is no pair.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// Could not be opened or read.
    #[error("camera source {source_name}: {source}")]
    Io {
        /// URL or path.
        source_name: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file that is no MCAP recording.
    #[error("recording {path}: no MCAP file: {bytes} bytes, and the MCAP magic stands nowhere", path = path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
    /// A recording without anything that we could replay.
    #[error(
        "recording {path}: holds no whole message of {expected} ({bad_chunks} damaged chunks, \
         {lost_bytes} bytes cut off)",
        path = path.display()
    )]
    NothingRecorded {
        /// The file.
        path: PathBuf,
        /// The topics that were looked for.
        expected: &'static str,
        /// Chunks that are damaged.
        bad_chunks: u64,
        /// Bytes of records that are not whole.
        lost_bytes: u64,
    },
    /// A live source that gave nothing for a while; it may come back.
    #[error("camera source {source_name}: no frames for {waited_s} s")]
    NoFrames {
        /// URL.
        source_name: String,
        /// How long we waited, seconds.
        waited_s: f64,
    },
    /// OpenCV can't open or read the camera.
    #[error("camera source {source_name}: {source}")]
    Capture {
        /// URL.
        source_name: String,
        /// What OpenCV said.
        source: opencv::Error,
    },
    /// OpenCV has no camera to give under this name.
    #[error("camera source {source_name}: OpenCV's {backend} capture can't open it")]
    NotOpened {
        /// URL.
        source_name: String,
        /// Part of OpenCV that was asked.
        backend: &'static str,
    },
    /// A frame that does not fit the rig.
    #[error(
        "camera source {source_name}: frame is {found_px:?} pixels, the rig's layout needs \
         {expected_px:?}"
    )]
    FrameSize {
        /// URL.
        source_name: String,
        /// Columns, rows that came.
        found_px: (i32, i32),
        /// Columns, rows that the rig asks for.
        expected_px: (i32, i32),
    },
    /// A folder in no layout that we know.
    #[error("image folder {path}: {found}; expected {expected}", path = path.display())]
    Layout {
        /// The folder.
        path: PathBuf,
        /// What stands there.
        found: String,
        /// What would have been accepted.
        expected: &'static str,
    },
    /// A file whose name says no time or number.
    #[error("image {path}: the name must be {expected}", path = path.display())]
    FileName {
        /// The image.
        path: PathBuf,
        /// What would have been accepted.
        expected: &'static str,
    },
    /// A line of `times.txt` that is no time.
    #[error("{path} line {line}: {text:?} is not {expected}", path = path.display())]
    Times {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What stands there.
        text: String,
        /// What would have been accepted.
        expected: &'static str,
    },
}

impl SourceError {
    /// True when no further pair can come from this source.
    #[must_use]
    pub fn is_fatal(&self) -> bool {
        match self {
            Self::NoFrames { .. } | Self::FrameSize { .. } => false,
            Self::Io { .. }
            | Self::NotMcap { .. }
            | Self::NothingRecorded { .. }
            | Self::Capture { .. }
            | Self::NotOpened { .. }
            | Self::Layout { .. }
            | Self::FileName { .. }
            | Self::Times { .. } => true,
        }
    }

    /// True when the input itself is refused (it is not there, or not what it should be), false when
    /// a device or a port fails.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        match self {
            Self::NotMcap { .. }
            | Self::NothingRecorded { .. }
            | Self::Layout { .. }
            | Self::FileName { .. }
            | Self::Times { .. } => true,
            Self::Io { source, .. } => source.kind() == std::io::ErrorKind::NotFound,
            Self::NoFrames { .. }
            | Self::Capture { .. }
            | Self::NotOpened { .. }
            | Self::FrameSize { .. } => false,
        }
    }
}

/// Counts one refusal; says so at the 1st, 2nd, 4th, 8th .. time, so that a flood fills no log.
pub(crate) fn note(counter: &mut u64, what: &'static str) {
    *counter += 1;
    if counter.is_power_of_two() {
        tracing::warn!(count = *counter, "{what}");
    }
}
