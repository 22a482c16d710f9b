//! Bytes to frames, without I/O: finds whole, checked MAVLink frames in whatever a port delivers.

use mavlink::dialects::development::MavMessage;
use mavlink::{Message, calculate_crc};
use serde::{Deserialize, Serialize};

/// System id of a sender: one vehicle or one ground station.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SystemId(pub u8);

/// Component id of a sender: one part of a system, such as its autopilot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ComponentId(pub u8);

impl ComponentId {
    /// The autopilot.
    pub const AUTOPILOT: Self = Self(1);
    /// The first companion computer.
    pub const ONBOARD_COMPUTER: Self = Self(191);
}

/// Who sent a frame, or whom a message addresses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Address {
    /// Vehicle or ground station; 0 addresses all.
    pub system: SystemId,
    /// Part of it; 0 addresses all.
    pub component: ComponentId,
}

impl Address {
    /// From the two numbers, in the order in which MAVLink people say them.
    #[must_use]
    pub const fn new(system: u8, component: u8) -> Self {
        Self {
            system: SystemId(system),
            component: ComponentId(component),
        }
    }

    /// Whether a message addressed to `self` is meant for `me` (zeros address all).
    #[must_use]
    pub fn reaches(self, me: Self) -> bool {
        let system = self.system.0 == 0 || self.system == me.system;
        system && (self.component.0 == 0 || self.component == me.component)
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.system.0, self.component.0)
    }
}

/// Framing of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum WireVersion {
    /// MAVLink 1: eight bits of message id, no extensions.
    V1,
    /// MAVLink 2.
    V2,
}

impl From<WireVersion> for mavlink::MavlinkVersion {
    fn from(version: WireVersion) -> Self {
        match version {
            WireVersion::V1 => Self::V1,
            WireVersion::V2 => Self::V2,
        }
    }
}

/// One frame as it came: the exact bytes, and what its header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawFrame {
    /// From the start marker to the checksum, or to the signature where there is one.
    pub bytes: Vec<u8>,
    /// Framing.
    pub version: WireVersion,
    /// Sender's system.
    pub system: SystemId,
    /// Sender's component.
    pub component: ComponentId,
    /// Counts up by one per frame of a sender, modulo 256.
    pub sequence: u8,
    /// Which message it carries.
    pub message_id: u32,
}

/// Whether a frame is what its sender sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameCheck {
    /// The checksum holds.
    Good,
    /// The checksum fails: damaged, or written by a program with another message definition.
    BadChecksum,
    /// Not in our dialect, so that its checksum cannot be tested.
    UnknownId,
}

impl RawFrame {
    /// The frame that starts at the first byte of `bytes`, with the verdict on its checksum; `None`
    /// where no whole frame starts there.
    #[must_use]
    pub fn at_start(bytes: &[u8]) -> Option<(Self, FrameCheck)> {
        match Header::read(bytes) {
            HeaderRead::Header(header) if bytes.len() >= header.frame_len() => {
                Some((header.frame(bytes), header.check(bytes)))
            }
            _ => None,
        }
    }

    /// Sender.
    #[must_use]
    pub fn sender(&self) -> Address {
        Address {
            system: self.system,
            component: self.component,
        }
    }

    /// The message's bytes.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        let header = self.version.header_len();
        let length = self.bytes.get(1).copied().map_or(0, usize::from);
        self.bytes.get(header..header + length).unwrap_or_default()
    }
}

const MARKER_V1: u8 = mavlink::MAV_STX;
const MARKER_V2: u8 = mavlink::MAV_STX_V2;
const CHECKSUM_LEN: usize = 2;
const SIGNATURE_LEN: usize = 13;
/// The one incompatibility flag that we understand: a signature follows the checksum.
const FLAG_SIGNED: u8 = 0x01;

impl WireVersion {
    fn of_marker(marker: u8) -> Option<Self> {
        match marker {
            MARKER_V1 => Some(Self::V1),
            MARKER_V2 => Some(Self::V2),
            _ => None,
        }
    }

    const fn header_len(self) -> usize {
        match self {
            Self::V1 => 6,
            Self::V2 => 10,
        }
    }
}

struct Header {
    version: WireVersion,
    payload_len: usize,
    signed: bool,
    sequence: u8,
    sender: Address,
    message_id: u32,
}

enum HeaderRead {
    /// No frame can start here.
    Impossible,
    /// More bytes are needed to tell.
    Incomplete,
    Header(Header),
}

impl Header {
    fn read(bytes: &[u8]) -> HeaderRead {
        let Some(version) = bytes.first().copied().and_then(WireVersion::of_marker) else {
            return if bytes.is_empty() {
                HeaderRead::Incomplete
            } else {
                HeaderRead::Impossible
            };
        };
        let flags = if version == WireVersion::V2 {
            bytes.get(2).copied()
        } else {
            Some(0)
        };
        if flags.is_some_and(|flags| flags & !FLAG_SIGNED != 0) {
            return HeaderRead::Impossible;
        }
        match *bytes {
            [MARKER_V1, length, sequence, system, component, id, ..] => HeaderRead::Header(Self {
                version,
                payload_len: length.into(),
                signed: false,
                sequence,
                sender: Address::new(system, component),
                message_id: id.into(),
            }),
            [
                MARKER_V2,
                length,
                flags,
                _,
                sequence,
                system,
                component,
                low,
                middle,
                high,
                ..,
            ] => HeaderRead::Header(Self {
                version,
                payload_len: length.into(),
                signed: flags & FLAG_SIGNED != 0,
                sequence,
                sender: Address::new(system, component),
                message_id: u32::from_le_bytes([low, middle, high, 0]),
            }),
            _ => HeaderRead::Incomplete,
        }
    }

    fn checksum_at(&self) -> usize {
        self.version.header_len() + self.payload_len
    }

    fn frame_len(&self) -> usize {
        let signature = if self.signed { SIGNATURE_LEN } else { 0 };
        self.checksum_at() + CHECKSUM_LEN + signature
    }

    fn is_known(&self) -> bool {
        MavMessage::extra_crc(self.message_id) != 0
            || MavMessage::default_message_from_id(self.message_id).is_some()
    }

    /// `bytes` hold the whole frame.
    fn check(&self, bytes: &[u8]) -> FrameCheck {
        if !self.is_known() {
            return FrameCheck::UnknownId;
        }
        let at = self.checksum_at();
        let found = u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        if calculate_crc(&bytes[1..at], MavMessage::extra_crc(self.message_id)) == found {
            FrameCheck::Good
        } else {
            FrameCheck::BadChecksum
        }
    }

    /// `bytes` hold the whole frame.
    fn frame(&self, bytes: &[u8]) -> RawFrame {
        RawFrame {
            bytes: bytes[..self.frame_len()].to_vec(),
            version: self.version,
            system: self.sender.system,
            component: self.sender.component,
            sequence: self.sequence,
            message_id: self.message_id,
        }
    }
}

/// What came over a port, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct WireCounters {
    /// Whole frames with a good checksum.
    pub frames: u64,
    /// Bytes that belong to no frame.
    pub garbage_bytes: u64,
    /// Bytes that were thrown away unread because nobody took frames out.
    pub shed_bytes: u64,
    /// Candidates whose checksum failed.
    pub crc: u64,
    /// Frames, right behind another frame, whose message is not in our dialect.
    pub unknown_id: u64,
    /// Good frames whose content our dialect cannot express, such as a new enum value.
    pub undecodable: u64,
}

impl WireCounters {
    /// Both together.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            frames: self.frames + other.frames,
            garbage_bytes: self.garbage_bytes + other.garbage_bytes,
            shed_bytes: self.shed_bytes + other.shed_bytes,
            crc: self.crc + other.crc,
            unknown_id: self.unknown_id + other.unknown_id,
            undecodable: self.undecodable + other.undecodable,
        }
    }
}

/// Finds frames in a byte stream; sans-IO.
///
/// A candidate that fails is searched again from its second byte, so that a damaged or truncated
/// frame never swallows the intact one behind it. The price: a truncated frame holds the reader
/// back until as many bytes as it claims (at most 280) have come.
///
/// **Bound:** [`FrameReader::CAPACITY`] bytes wait at most. **Loss rule:** the oldest bytes go
/// first and are counted as shed.
#[derive(Debug, Clone)]
pub struct FrameReader {
    waiting: Vec<u8>,
    start: usize,
    /// Whether the last byte taken ended a frame, so that the next one should start here.
    in_step: bool,
    /// Bytes ahead that an unknown message claims: skipping them is not garbage.
    claimed_by_unknown: usize,
    counters: WireCounters,
}

impl FrameReader {
    /// Bytes that wait at most.
    pub const CAPACITY: usize = 64 * 1024;

    /// An empty reader.
    #[must_use]
    pub fn new() -> Self {
        Self {
            waiting: Vec::new(),
            start: 0,
            in_step: true,
            claimed_by_unknown: 0,
            counters: WireCounters::default(),
        }
    }

    /// Takes in what a port delivered.
    pub fn push(&mut self, bytes: &[u8]) {
        self.waiting.drain(..self.start);
        self.start = 0;
        self.waiting.extend_from_slice(bytes);
        let excess = self.waiting.len().saturating_sub(Self::CAPACITY);
        self.waiting.drain(..excess);
        self.counters.shed_bytes += excess as u64;
    }

    /// The next whole frame with a good checksum.
    pub fn next_frame(&mut self) -> Option<RawFrame> {
        loop {
            let ahead = &self.waiting[self.start..];
            let header = match Header::read(ahead) {
                HeaderRead::Incomplete => return None,
                HeaderRead::Impossible => {
                    self.skip_byte();
                    continue;
                }
                HeaderRead::Header(header) => header,
            };
            if !header.is_known() {
                self.skip_unknown(&header);
                continue;
            }
            if ahead.len() < header.frame_len() {
                return None;
            }
            match header.check(ahead) {
                FrameCheck::Good => return Some(self.take(&header)),
                FrameCheck::BadChecksum | FrameCheck::UnknownId => {
                    self.counters.crc += 1;
                    self.skip_byte();
                }
            }
        }
    }

    /// What came so far.
    #[must_use]
    pub fn counters(&self) -> WireCounters {
        self.counters
    }

    /// Counts a good frame whose content could not be decoded.
    pub fn count_undecodable(&mut self) {
        self.counters.undecodable += 1;
    }

    fn take(&mut self, header: &Header) -> RawFrame {
        let frame = header.frame(&self.waiting[self.start..]);
        self.start += header.frame_len();
        self.in_step = true;
        self.claimed_by_unknown = 0;
        self.counters.frames += 1;
        frame
    }

    /// Still byte by byte: what looks like an unknown frame may be the rest of a damaged one.
    fn skip_unknown(&mut self, header: &Header) {
        if self.in_step {
            self.counters.unknown_id += 1;
            self.claimed_by_unknown = header.frame_len();
        }
        self.skip_byte();
    }

    fn skip_byte(&mut self) {
        self.start += 1;
        if self.claimed_by_unknown > 0 {
            self.claimed_by_unknown -= 1;
            self.in_step = self.claimed_by_unknown == 0;
        } else {
            self.counters.garbage_bytes += 1;
            self.in_step = false;
        }
    }
}

impl Default for FrameReader {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outgoing::{Encoder, status_text};
    use crate::telemetry::{Severity, StatusText};
    use mavlink::{MAVLinkV1MessageRaw, MavHeader};
    use proptest::prelude::*;

    fn text_message(text: &str) -> MavMessage {
        status_text(&StatusText {
            severity: Severity::Info,
            text: text.to_owned(),
        })
    }

    fn frame(text: &str) -> Vec<u8> {
        Encoder::new(Address::new(1, 1)).encode(&text_message(text))
    }

    fn frame_v1(text: &str) -> Vec<u8> {
        let header = MavHeader {
            system_id: 1,
            component_id: 1,
            sequence: 9,
        };
        let mut raw = MAVLinkV1MessageRaw::new();
        raw.serialize_message(header, &text_message(text));
        raw.raw_bytes().to_vec()
    }

    fn read(chunks: &[&[u8]]) -> (Vec<Vec<u8>>, WireCounters) {
        let mut reader = FrameReader::new();
        let mut frames = Vec::new();
        for chunk in chunks {
            reader.push(chunk);
            while let Some(frame) = reader.next_frame() {
                frames.push(frame.bytes);
            }
        }
        (frames, reader.counters())
    }

    #[test]
    fn both_versions_come_out_as_they_went_in() {
        let mut reader = FrameReader::new();
        reader.push(&[frame("two"), frame_v1("one")].concat());
        let two = reader.next_frame().unwrap();
        assert_eq!(
            (two.version, two.sequence, &two.bytes),
            (WireVersion::V2, 0, &frame("two"))
        );
        let one = reader.next_frame().unwrap();
        assert_eq!(
            (one.version, one.sequence, &one.bytes),
            (WireVersion::V1, 9, &frame_v1("one"))
        );
        assert_eq!(one.message_id, 253);
        assert_eq!(reader.next_frame(), None);
    }

    #[test]
    fn a_frame_behind_a_truncated_one_is_not_lost() {
        let cut = &frame("this one lost its tail")[..20];
        let (frames, counters) = read(&[cut, &frame("whole"), &frame("next"), &frame("last")]);
        assert!(frames.contains(&frame("whole")) && frames.contains(&frame("last")));
        assert_eq!((frames.len(), counters.frames, counters.crc), (3, 3, 1));
        assert_eq!(counters.garbage_bytes, 20);
    }

    #[test]
    fn a_bad_checksum_costs_one_frame_and_is_counted() {
        let mut damaged = frame("damaged");
        damaged[12] ^= 0x40;
        let (frames, counters) = read(&[&damaged, &frame("intact")]);
        assert_eq!((frames, counters.crc), (vec![frame("intact")], 1));
    }

    #[test]
    fn a_start_marker_in_the_payload_is_payload() {
        let tricky = frame("\u{fd}\u{fe}\u{fd} looks like a start");
        let (frames, counters) = read(&[&tricky, &frame("next")]);
        assert_eq!((frames.len(), counters.garbage_bytes), (2, 0));
    }

    #[test]
    fn an_unknown_message_is_counted_once_and_is_no_garbage() {
        let mut unknown = frame("from another dialect");
        unknown[7..10].copy_from_slice(&[0x34, 0x12, 0x7f]);
        let (frames, counters) = read(&[&unknown, &frame("ours")]);
        assert_eq!(frames, vec![frame("ours")]);
        assert_eq!((counters.unknown_id, counters.garbage_bytes), (1, 0));
    }

    #[test]
    fn an_unknown_incompatibility_flag_is_refused() {
        let mut flagged = frame("flagged");
        flagged[2] = 0x80;
        assert_eq!(read(&[&flagged, &frame("plain")]).0, vec![frame("plain")]);
    }

    #[test]
    fn a_megabyte_of_noise_is_bounded_and_loses_no_frame_that_comes_in_chunks() {
        let mut reader = FrameReader::new();
        let mut state = 0x2545_f491_4f6c_dd1d_u64;
        let noise: Vec<u8> = std::iter::repeat_with(|| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 32) as u8
        })
        .take(1 << 20)
        .collect();
        let mut intact = 0;
        for chunk in noise.chunks(1000) {
            reader.push(chunk);
            reader.push(&frame("intact"));
            reader.push(&[0; 300]);
            while let Some(found) = reader.next_frame() {
                intact += usize::from(found.bytes == frame("intact"));
            }
        }
        assert_eq!(intact, noise.chunks(1000).count());
    }

    #[test]
    fn a_port_that_nobody_reads_keeps_the_newest_bytes() {
        let mut reader = FrameReader::new();
        for _ in 0..100 {
            reader.push(&[0; 1 << 10]);
        }
        reader.push(&frame("newest"));
        assert_eq!(reader.waiting.len(), FrameReader::CAPACITY);
        assert!(reader.counters().shed_bytes > 30_000);
        assert_eq!(reader.next_frame().unwrap().bytes, frame("newest"));
    }

    proptest! {
        #[test]
        fn how_the_bytes_are_cut_does_not_matter(
            noise in proptest::collection::vec(any::<u8>(), 0..400),
            cut in 1_usize..60,
        ) {
            let stream = [noise, frame("one"), frame_v1("two"), vec![0; 300]].concat();
            let pieces: Vec<&[u8]> = stream.chunks(cut).collect();
            let (at_once, in_pieces) = (read(&[&stream]), read(&pieces));
            prop_assert_eq!(&at_once, &in_pieces);
            prop_assert!(at_once.0.ends_with(&[frame("one"), frame_v1("two")]));
        }
    }
}
