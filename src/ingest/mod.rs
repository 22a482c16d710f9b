//! Stereo pairs from a camera, a folder, a recording or a socket.
//!
//! **Out:** [`StereoPair`]s, still encoded as they came, stamped with mid-exposure on the service
//! clock. Nothing here decodes pixels except [`decode`].

use bytes::Bytes;
use emberfix_frames::{ServiceTime, SignedDuration, Stamped};

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
}

/// A source of pairs.
pub trait StereoSource: Send {
    /// The next pair; `None` when the source has ended.
    ///
    /// # Errors
    /// [`SourceError`]; [`SourceError::is_fatal`] says whether to go on.
    fn next_pair(&mut self) -> Result<Option<Stamped<StereoPair>>, SourceError>;
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
}

impl SourceError {
    /// True when no further pair can come from this source.
    #[must_use]
    pub fn is_fatal(&self) -> bool {
        match self {
            Self::Io { .. } => true,
        }
    }
}
