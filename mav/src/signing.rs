//! MAVLink 2 signing: signs what goes out, and judges what comes in; sans-IO.
//!
//! A signature is 13 bytes behind the checksum: link id, 48 bits of time (10 µs since 1 January
//! 2015), and the first 48 bits of SHA-256 over key, frame, link id and time
//! (<https://mavlink.io/en/guide/message_signing.html>). It proves who sent, and hides nothing.
//!
//! **Time.** Timestamps only ever rise, per system, component and link. What was accepted is kept
//! ([`SigningState`], to be written to disk by the caller) a little ahead of itself, so that nothing
//! that was recorded before a restart is accepted after it, whatever the clock says then. Our own
//! time is the greatest of what was kept, the system's clock, and the UTC that a signed autopilot
//! tells. A clock that stands before what was kept is not believed.
//!
//! **Quarantine.** A stream whose time is far ahead of a clock that is believed belongs to a peer
//! with a wrong clock: it alone is refused, and named; it never moves our time.
//!
//! **Bound:** [`Guard::STREAMS`] streams; the one heard longest ago gives way, and may then come in
//! again only with a time that is not behind ours.

use crate::wire::{Address, RawFrame, WireVersion};
use emberfix_frames::ServiceTime;
use mavlink::calculate_crc;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;

/// Bytes behind the checksum of a signed frame.
pub const SIGNATURE_LEN: usize = 13;
/// Of these, the ones that prove something.
const PROOF_LEN: usize = 6;
/// Incompatibility flag of a signed frame.
const FLAG_SIGNED: u8 = 0x01;
/// 1 January 2015, UTC, nanoseconds since 1970.
const EPOCH_NS: i64 = 1_420_070_400_000_000_000;
/// Nanoseconds of one step of a timestamp.
const STEP_NS: i64 = 10_000;
/// A new stream may be this much behind our time, and any stream this much ahead of a clock that is
/// believed: one minute, in steps.
const MINUTE: u64 = 6_000_000;
/// What is kept is ahead of what was accepted by this: two seconds, in steps.
const AHEAD: u64 = 200_000;

/// Messages that are taken unsigned, as PX4 does: HEARTBEAT, RADIO_STATUS, ADSB_VEHICLE, COLLISION.
pub const USUAL_UNSIGNED: [u32; 4] = [0, 109, 246, 247];

/// The secret that all parts of one vehicle's network share.
#[derive(Clone, PartialEq, Eq)]
pub struct SigningKey([u8; 32]);

impl SigningKey {
    /// From its bytes.
    #[must_use]
    pub const fn new(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// From 64 hexadecimal digits, white space around them aside.
    #[must_use]
    pub fn from_hex(text: &str) -> Option<Self> {
        let digits = text.trim();
        if digits.len() != 64 || !digits.is_ascii() {
            return None;
        }
        let mut bytes = [0; 32];
        for (at, byte) in bytes.iter_mut().enumerate() {
            *byte = u8::from_str_radix(&digits[2 * at..2 * at + 2], 16).ok()?;
        }
        Some(Self(bytes))
    }

    /// `signed` is the frame up to its checksum, then link id and timestamp.
    fn proof(&self, signed: &[u8]) -> [u8; PROOF_LEN] {
        let hash = Sha256::new().chain_update(self.0).chain_update(signed);
        let hash: [u8; 32] = hash.finalize().into();
        let [a, b, c, d, e, f, ..] = hash;
        [a, b, c, d, e, f]
    }
}

/// Never shows the secret.
impl std::fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("SigningKey(..)")
    }
}

/// A time as signatures carry it; 0 before 2015.
fn timestamp(at: ServiceTime) -> u64 {
    u64::try_from((at.unix_ns() - EPOCH_NS) / STEP_NS).unwrap_or(0)
}

/// Signs what one sender sends.
#[derive(Debug, Clone)]
pub struct Signer {
    key: SigningKey,
    link: u8,
    timestamp: u64,
}

impl Signer {
    /// Goes on from what was kept; `link` tells our links apart.
    #[must_use]
    pub fn new(key: SigningKey, link: u8, state: &SigningState) -> Self {
        Self {
            key,
            link,
            timestamp: state.ours,
        }
    }

    /// The time is at least this.
    pub fn advance(&mut self, now: ServiceTime) {
        self.timestamp = self.timestamp.max(timestamp(now));
    }

    /// The unsigned MAVLink 2 frame, signed.
    pub fn sign(&mut self, frame: &[u8], extra_crc: u8) -> Vec<u8> {
        self.timestamp += 1;
        let mut signed = frame.to_vec();
        signed[2] |= FLAG_SIGNED;
        let checksum_at = signed.len() - 2;
        let checksum = calculate_crc(&signed[1..checksum_at], extra_crc).to_le_bytes();
        signed[checksum_at..].copy_from_slice(&checksum);
        signed.push(self.link);
        signed.extend(&self.timestamp.to_le_bytes()[..6]);
        let proof = self.key.proof(&signed);
        signed.extend(proof);
        signed
    }
}

/// Who sends, over which of its links.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Stream {
    /// Sender.
    pub sender: Address,
    /// Its link id.
    pub link: u8,
}

/// What must outlive the process.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SigningState {
    /// Our own time.
    pub ours: u64,
    /// Each stream's latest time, ahead of itself.
    pub streams: Vec<(Stream, u64)>,
}

/// What to do with a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Judgement {
    /// Take it: it is signed with our key and new.
    Signed,
    /// Take it: its message is one that needs no signature.
    AllowedUnsigned,
    /// Drop it.
    Refused(Refusal),
}

/// Why a frame is dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It is not signed and has to be.
    Unsigned,
    /// Not with our key, or changed on its way.
    WrongSignature,
    /// Not later than what came before on its stream.
    Replayed,
    /// A new stream that is more than a minute behind our time.
    Old,
    /// More than a minute ahead of a clock that is believed.
    Future,
}

/// Refused frames, by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct SigningCounters {
    /// Signed and taken.
    pub signed: u64,
    /// Unsigned and taken.
    pub allowed_unsigned: u64,
    /// See [`Refusal::Unsigned`].
    pub unsigned: u64,
    /// See [`Refusal::WrongSignature`].
    pub wrong_signature: u64,
    /// See [`Refusal::Replayed`].
    pub replayed: u64,
    /// See [`Refusal::Old`].
    pub old: u64,
    /// See [`Refusal::Future`].
    pub future: u64,
}

impl SigningCounters {
    /// All that was refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.unsigned + self.wrong_signature + self.replayed + self.old + self.future
    }

    fn count(&mut self, judgement: Judgement) {
        let counter = match judgement {
            Judgement::Signed => &mut self.signed,
            Judgement::AllowedUnsigned => &mut self.allowed_unsigned,
            Judgement::Refused(Refusal::Unsigned) => &mut self.unsigned,
            Judgement::Refused(Refusal::WrongSignature) => &mut self.wrong_signature,
            Judgement::Refused(Refusal::Replayed) => &mut self.replayed,
            Judgement::Refused(Refusal::Old) => &mut self.old,
            Judgement::Refused(Refusal::Future) => &mut self.future,
        };
        *counter += 1;
    }
}

/// Judges what comes in on one port.
#[derive(Debug, Clone)]
pub struct Guard {
    key: SigningKey,
    allowed_unsigned: Vec<u32>,
    streams: BTreeMap<Stream, u64>,
    /// Greatest time that we know of: kept, clock, GNSS, accepted frames.
    time: u64,
    /// What was kept at the start: a clock before it is not set.
    kept: u64,
    clock_is_believed: bool,
    counters: SigningCounters,
}

impl Guard {
    /// Streams that are kept apart at most.
    pub const STREAMS: usize = 64;

    /// Goes on from what was kept.
    #[must_use]
    pub fn new(key: SigningKey, allowed_unsigned: Vec<u32>, state: &SigningState) -> Self {
        Self {
            key,
            allowed_unsigned,
            streams: state.streams.iter().copied().collect(),
            time: state.ours,
            kept: state.ours,
            clock_is_believed: false,
            counters: SigningCounters::default(),
        }
    }

    /// What the system's clock, or a signed autopilot's UTC, says. Before what was kept, it is not set.
    pub fn note_time(&mut self, now: ServiceTime) {
        let now = timestamp(now);
        if now > 0 && now >= self.kept {
            self.clock_is_believed = true;
            self.time = self.time.max(now);
        }
    }

    /// Takes or drops a frame; counts it.
    pub fn judge(&mut self, frame: &RawFrame) -> Judgement {
        let judgement = self.judgement(frame);
        self.counters.count(judgement);
        judgement
    }

    /// What was taken and dropped so far.
    #[must_use]
    pub fn counters(&self) -> SigningCounters {
        self.counters
    }

    /// What to keep, for this guard and for a signer.
    #[must_use]
    pub fn state(&self) -> SigningState {
        let ahead = |(stream, latest): (&Stream, &u64)| (*stream, latest + AHEAD);
        SigningState {
            ours: self.time + AHEAD,
            streams: self.streams.iter().map(ahead).collect(),
        }
    }

    fn judgement(&mut self, frame: &RawFrame) -> Judgement {
        let Some(signature) = Signature::of(frame) else {
            return if self.allowed_unsigned.contains(&frame.message_id) {
                Judgement::AllowedUnsigned
            } else {
                Judgement::Refused(Refusal::Unsigned)
            };
        };
        if !signature.is_by(&self.key, frame) {
            return Judgement::Refused(Refusal::WrongSignature);
        }
        match self.in_time(&signature) {
            Some(refusal) => Judgement::Refused(refusal),
            None => {
                self.accept(&signature);
                Judgement::Signed
            }
        }
    }

    fn in_time(&self, signature: &Signature) -> Option<Refusal> {
        let at = signature.timestamp;
        if self.clock_is_believed && at > self.time + MINUTE {
            return Some(Refusal::Future);
        }
        match self.streams.get(&signature.stream) {
            Some(latest) if at <= *latest => Some(Refusal::Replayed),
            Some(_) => None,
            None if at + MINUTE < self.time => Some(Refusal::Old),
            None => None,
        }
    }

    fn accept(&mut self, signature: &Signature) {
        if self.streams.len() == Self::STREAMS && !self.streams.contains_key(&signature.stream) {
            let oldest = self.streams.iter().min_by_key(|(_, latest)| **latest);
            if let Some(oldest) = oldest.map(|(stream, _)| *stream) {
                self.streams.remove(&oldest);
            }
        }
        self.streams.insert(signature.stream, signature.timestamp);
        if !self.clock_is_believed {
            self.time = self.time.max(signature.timestamp);
        }
    }
}

/// What stands behind the checksum of a signed frame.
struct Signature {
    stream: Stream,
    timestamp: u64,
    proof: [u8; PROOF_LEN],
}

impl Signature {
    fn of(frame: &RawFrame) -> Option<Self> {
        let signed = frame.version == WireVersion::V2 && frame.bytes.get(2)? & FLAG_SIGNED != 0;
        let tail = signed.then(|| frame.bytes.last_chunk::<SIGNATURE_LEN>())??;
        let [link, t0, t1, t2, t3, t4, t5, proof @ ..] = *tail;
        Some(Self {
            stream: Stream {
                sender: frame.sender(),
                link,
            },
            timestamp: u64::from_le_bytes([t0, t1, t2, t3, t4, t5, 0, 0]),
            proof,
        })
    }

    /// Compared in a time that does not depend on where they differ.
    fn is_by(&self, key: &SigningKey, frame: &RawFrame) -> bool {
        let signed = &frame.bytes[..frame.bytes.len() - PROOF_LEN];
        let proof = key.proof(signed);
        let pairs = proof.iter().zip(&self.proof);
        pairs.fold(0, |differ, (a, b)| differ | (a ^ b)) == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outgoing::{Encoder, companion_heartbeat, request_message};
    use crate::telemetry::decode;
    use emberfix_frames::seconds;

    const PEER: Address = Address::new(1, 1);
    const KEY: SigningKey = SigningKey::new([7; 32]);

    fn at_s(s: f64) -> ServiceTime {
        ServiceTime::from_unix_ns(1_772_366_400_000_000_000) + seconds(s)
    }

    /// A frame of a peer whose clock stands there.
    fn signed_by(key: SigningKey, link: u8, now: ServiceTime) -> RawFrame {
        let mut signer = Signer::new(key, link, &SigningState::default());
        signer.advance(now);
        let message = request_message(Address::new(1, 191), 1);
        let bytes = Encoder::new(PEER).signing(Some(signer)).encode(&message);
        RawFrame::at_start(&bytes).unwrap().0
    }

    fn signed(now: ServiceTime) -> RawFrame {
        signed_by(KEY, 0, now)
    }

    fn guard(state: &SigningState) -> Guard {
        Guard::new(KEY, USUAL_UNSIGNED.to_vec(), state)
    }

    fn guard_at(now: ServiceTime) -> Guard {
        let mut guard = guard(&SigningState::default());
        guard.note_time(now);
        guard
    }

    const fn refused(refusal: Refusal) -> Judgement {
        Judgement::Refused(refusal)
    }

    #[test]
    fn a_signed_frame_passes_once_and_still_says_what_it_says() {
        let mut guard = guard_at(at_s(0.0));
        let frame = signed(at_s(0.0));
        assert!(decode(&frame).is_ok());
        assert_eq!(guard.judge(&frame), Judgement::Signed);
        assert_eq!(guard.judge(&frame), refused(Refusal::Replayed));
        assert_eq!(guard.judge(&signed(at_s(1.0))), Judgement::Signed);
    }

    #[test]
    fn another_key_and_a_changed_byte_are_refused() {
        let mut guard = guard_at(at_s(0.0));
        let stranger = signed_by(SigningKey::new([8; 32]), 0, at_s(0.0));
        assert_eq!(guard.judge(&stranger), refused(Refusal::WrongSignature));
        let good = signed(at_s(0.0));
        for at in 4..good.bytes.len() {
            let mut changed = good.clone();
            changed.bytes[at] ^= 1;
            assert_ne!(guard.judge(&changed), Judgement::Signed, "byte {at}");
        }
        assert_eq!(guard.judge(&good), Judgement::Signed);
    }

    #[test]
    fn only_allowed_messages_pass_unsigned() {
        let mut guard = guard_at(at_s(0.0));
        let frame = |message| {
            RawFrame::at_start(&Encoder::new(PEER).encode(&message))
                .unwrap()
                .0
        };
        let heartbeat = frame(companion_heartbeat(true));
        assert_eq!(guard.judge(&heartbeat), Judgement::AllowedUnsigned);
        let order = frame(request_message(Address::new(1, 191), 1));
        assert_eq!(guard.judge(&order), refused(Refusal::Unsigned));
        assert_eq!(
            (guard.counters().refused(), guard.counters().unsigned),
            (1, 1)
        );
    }

    #[test]
    fn what_was_recorded_before_a_restart_is_refused_after_it_whatever_the_clock_says() {
        let mut before = guard_at(at_s(0.0));
        let recorded: Vec<RawFrame> = (0..20).map(|n| signed(at_s(f64::from(n) * 0.1))).collect();
        for frame in &recorded {
            assert_eq!(before.judge(frame), Judgement::Signed);
        }
        let kept = serde_json::to_string(&before.state()).unwrap();
        let kept: SigningState = serde_json::from_str(&kept).unwrap();
        for clock in [None, Some(at_s(3.0)), Some(ServiceTime::from_unix_ns(0))] {
            let mut after = guard(&kept);
            clock.into_iter().for_each(|clock| after.note_time(clock));
            for frame in &recorded {
                assert_eq!(after.judge(frame), refused(Refusal::Replayed));
            }
            // Over a link that the vehicle never used before, too.
            let elsewhere = signed_by(KEY, 9, at_s(-90.0));
            assert_eq!(after.judge(&elsewhere), refused(Refusal::Old));
            // What is new passes, two seconds after what was kept at the latest.
            assert_eq!(after.judge(&signed(at_s(5.0))), Judgement::Signed);
        }
    }

    #[test]
    fn an_unset_clock_takes_the_time_of_the_vehicle() {
        let mut guard = guard_at(ServiceTime::from_unix_ns(0));
        assert_eq!(guard.judge(&signed(at_s(0.0))), Judgement::Signed);
        assert_eq!(
            guard.judge(&signed_by(KEY, 1, at_s(-120.0))),
            refused(Refusal::Old)
        );
        guard.note_time(at_s(1.0));
        assert_eq!(guard.judge(&signed(at_s(600.0))), refused(Refusal::Future));
    }

    #[test]
    fn a_peer_from_the_future_is_quarantined_alone() {
        let mut guard = guard_at(at_s(0.0));
        assert_eq!(
            guard.judge(&signed_by(KEY, 3, at_s(86_400.0))),
            refused(Refusal::Future)
        );
        assert_eq!(guard.judge(&signed(at_s(0.5))), Judgement::Signed);
        guard.note_time(at_s(86_400.0));
        assert_eq!(
            guard.judge(&signed_by(KEY, 3, at_s(86_401.0))),
            Judgement::Signed
        );
    }

    #[test]
    fn our_own_time_goes_on_after_a_restart_with_an_unset_clock() {
        let kept = guard_at(at_s(0.0)).state();
        let mut signer = Signer::new(KEY, 0, &kept);
        signer.advance(ServiceTime::from_unix_ns(0));
        let bytes = Encoder::new(PEER)
            .signing(Some(signer))
            .encode(&companion_heartbeat(true));
        let frame = RawFrame::at_start(&bytes).unwrap().0;
        assert_eq!(guard_at(at_s(0.0)).judge(&frame), Judgement::Signed);
    }

    #[test]
    fn a_crowd_of_streams_is_bounded() {
        let mut guard = guard_at(at_s(0.0));
        for n in 0..200_u8 {
            guard.judge(&signed_by(KEY, n, at_s(f64::from(n) * 0.01)));
        }
        assert_eq!(guard.streams.len(), Guard::STREAMS);
    }

    #[test]
    fn a_key_is_64_hexadecimal_digits() {
        assert_eq!(
            SigningKey::from_hex(&format!(" {} \n", "07".repeat(32))),
            Some(KEY)
        );
        for wrong in ["", "07", &"0g".repeat(32), &"é".repeat(32)] {
            assert_eq!(SigningKey::from_hex(wrong), None);
        }
    }
}
