//! MAVLink bytes to SI telemetry, and messages back. Has never heard of fire.
//!
//! **Purpose.** Between a port and the rest: [`wire`] finds checked frames in bytes, [`telemetry`]
//! says what they mean, [`outgoing`] writes messages, [`link`] is the port itself, [`inbox`] keeps its
//! peers apart, [`signing`] signs and judges, [`tlog`] reads
//! ground stations' logs. All but `link` are sans-IO: bytes and times are arguments.
//!
//! **In.** MAVLink 1 and 2, signed frames too ([`signing`] judges them where a key is given), dialect
//! `development`, which includes `common`. **Out.** [`Telemetry`] in SI units: degrees only in
//! names that end in `_deg`, altitudes as [`emberfix_frames::MslAltitude`] or
//! [`emberfix_frames::EllipsoidHeight`], times as the autopilot's boot time; attitude is body
//! (FRD) to NED. At the rate at which the messages come.
//!
//! **Assumptions.** A port's bytes may be anything. "Unknown" is `None`; a position, attitude or
//! time that cannot be one is a [`DecodeError`] with the value, to be counted by its name.
//!
//! **Known limits.** A frame with an enum value that is newer than the dialect cannot be decoded,
//! HEARTBEAT included; it is counted, not guessed at. System ids beyond 255 are refused. A
//! truncated frame delays its successor until as many bytes came as it claimed (at most 280).

pub mod inbox;
pub mod link;
pub mod outgoing;
pub mod signing;
pub mod telemetry;
pub mod tlog;
pub mod traffic;
pub mod wire;

pub use inbox::Inbox;
pub use link::{Chunk, Link, LinkError, LinkUrl, LinkUrlError, Peer};
pub use outgoing::{EncodeError, Encoder, MavMessage};
pub use signing::{Guard, Judgement, Signer, SigningKey, SigningState};
pub use telemetry::{DecodeError, Received, Telemetry, decode, message_name};
pub use wire::{
    Address, ComponentId, FrameCheck, FrameReader, RawFrame, SystemId, WireCounters, WireVersion,
};
