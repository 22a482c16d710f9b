//! Recordings: what came in and what we made of it, as MCAP.
//!
//! **In:** pairs as they came, MAVLink frames as they came, and what the service computed. **Out:** one
//! MCAP file with the contract's topics (version 1; `README.md`, "Recording"), Foxglove schemas, lz4 or
//! no compression.
//!
//! **Times.** Images: publish time and timestamp are mid-exposure, log time is arrival. MAVLink: log
//! time is arrival. Computed topics: all times are the moment for which the value holds.
//!
//! **Durability.** A chunk ends after 1 s or 4 MiB, whichever comes first, and is then in the file;
//! after an alarm the file is synced. A power cut costs the last chunk.
//!
//! **Queue.** [`Recorder`] writes on a thread of its own. At most [`IMAGE_QUEUE`] pairs wait: further
//! ones are shed and counted. Other entries are never shed; if [`ENTRY_QUEUE`] of them wait, the disk
//! hangs, and recording stops. It stops too when the disk is full: loudly, and the service goes on.
//!
//! **Known limits.** One file per recording, no rotation. The same calls give the same bytes with
//! [`Tape`] (no clock is read); [`Recorder`] also ends a chunk when nothing comes for a second.

mod convert;
mod recorder;
mod schemas;
mod tape;
#[cfg(test)]
mod tests;

pub use recorder::{ENTRY_QUEUE, IMAGE_QUEUE, Recorder, RecorderState, RecorderStatus};
pub use tape::Tape;

use emberfix_frames::{Covariance, MissionEnu, UnitQuaternion, Vector3, Wgs84};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// How a recording is packed, and what it says about itself.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RecordOptions {
    /// Compression of the chunks.
    pub compression: ChunkCompression,
    /// Written once, as MCAP metadata `emberfix`: mission, version, whatever helps later.
    pub metadata: BTreeMap<String, String>,
}

/// Compression of a recording's chunks. JPEGs don't shrink; telemetry and raw images do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ChunkCompression {
    /// Quick, and good enough.
    #[default]
    Lz4,
    /// None: most of a torn chunk can be saved by hand.
    None,
}

/// Where we take the aircraft to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UavFix {
    /// The place; ellipsoid height.
    pub place: Wgs84,
    /// Its covariance, m² in a tangent plane.
    pub covariance: Covariance<MissionEnu>,
    /// Heading from true north, clockwise, radians.
    pub heading_rad: Option<f64>,
}

/// How the airframe stands in the mission's tangent plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyPose {
    /// Body origin, metres east, north, up of the mission datum.
    pub position_enu_m: Vector3<f64>,
    /// Takes body (forward, right, down) components to east, north, up.
    pub enu_from_body: UnitQuaternion<f64>,
}

/// Why nothing is recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file can't be created, synced or closed.
    #[error("recording {path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file can't be written on.
    #[error("recording {path}: {source}", path = path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the MCAP writer said.
        source: mcap::McapError,
    },
    /// A value that can't be encoded.
    #[error("recording {path}: a message of {topic} can't be encoded: {message}", path = path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// Its topic.
        topic: &'static str,
        /// What the encoder said.
        message: String,
    },
    /// Recording stopped earlier, for the reason that was logged then.
    #[error("recording {path} has stopped: {reason}", path = path.display())]
    Stopped {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}
