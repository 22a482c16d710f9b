//! Datagrams between aircraft and ground: their bytes, and who signed them.
//!
//! `EF`, version 1, kind (1 byte), 1 if signed (1 byte), the signature (64) if so, the payload; all
//! little-endian. A letter's signature is that of its envelope; the others sign
//! `emberfix datagram 1`, a zero byte, the kind and the payload.
//!
//! | kind | to | payload |
//! |---|---|---|
//! | 1 letter | ground | attempt (4); the envelope, zstd with `DICTIONARY` |
//! | 2 receipt | aircraft | origin; sequence (8); attempt (4); verdict (1); newest action (8); reason |
//! | 3 beat | ground | origin; newest sequence (8); waiting (4); newest action known (8); stamp (8); position as JSON, or nothing |
//! | 4 answer | aircraft | origin; stamp (8); newest action (8) |
//! | 5 ask | ground | origin; stamp (8); after action (8) |
//! | 6 actions | aircraft | origin; stamp (8); JSON list |
//! | 7 chip | ground | origin; alarm id; revision (4); whole length (4); from (4); bytes |
//! | 8 chip held | aircraft | origin; alarm id; revision (4); bytes held from the start (4) |
//!
//! An origin is the length of the aircraft's name (1), the name, the outbox (8). Every datagram says
//! whose it is, so that the ground answers many aircraft from one port, and an answer to one
//! aircraft means nothing to another. Stamps are random: an answer that was recorded before is none.

use crate::deliver::envelope::{Envelope, MAX_ALARM, Origin, Reader, Sealed, put_name};
use crate::deliver::keys::{PublicKey, SIGNATURE_LEN, SecretKey, Signature};

/// Largest datagram that is sent, bytes: no usual path cuts it up.
pub const MAX_DATAGRAM: usize = 1_200;
/// Room for a datagram that comes, bytes.
pub const RECEIVE_BUFFER: usize = 2_048;
const MARK: [u8; 3] = [b'E', b'F', 1];
const SIGNED_AS: &[u8] = b"emberfix datagram 1\0";
/// What zstd knows beforehand; part of version 1, never changed.
const DICTIONARY: &[u8] = include_bytes!("dictionary.json");
/// zstd's; higher ones gain nothing on a thousand bytes.
const LEVEL: i32 = 9;
/// Longest alarm id, bytes.
const MAX_ID: usize = 64;
/// Longest reason of a refusal, bytes.
const MAX_REASON: usize = 200;
/// Head beyond the alarm in an envelope, generously.
const HEAD_ROOM: usize = 64;

/// Why a datagram is not taken.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// Not ours, or of a newer version.
    #[error("not an emberfix datagram of version 1")]
    Foreign,
    /// Cut, or of an unknown kind.
    #[error("a datagram of kind {kind} that can't be read")]
    Malformed {
        /// Its kind.
        kind: u8,
    },
    /// Too large to be sent.
    #[error("{len} bytes do not fit into a datagram of {MAX_DATAGRAM}")]
    TooLarge {
        /// How large it would be.
        len: usize,
    },
}

/// What became of a letter, in the ground's words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// It is on the ground's disk.
    Stored,
    /// The ground will not have this very alarm.
    Refused(String),
    /// The ground can't keep anything now; ask again.
    Later(String),
}

/// From an aircraft.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ToGround {
    /// An alarm.
    Letter {
        /// Counts this letter's sendings, to measure the way there and back.
        attempt: u32,
        /// The alarm.
        sealed: Sealed,
    },
    /// "Are you there? I am, and this is where I stand."
    Beat(Beat),
    /// Asks for the operators' actions after a number.
    Ask(Ask),
    /// Part of a fire's picture.
    Chip(ChipPart),
}

/// See [`ToGround::Beat`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Beat {
    /// Whose.
    pub origin: Origin,
    /// Greatest sequence that its outbox gave out.
    pub newest: u64,
    /// How many alarms wait for this link.
    pub waiting: u32,
    /// Greatest number of an action that it took.
    pub actions_known: u64,
    /// Random; the answer repeats it.
    pub stamp: u64,
    /// The aircraft's position as JSON ([`crate::ground::Ping`]); empty without news.
    pub ping: Vec<u8>,
}

/// See [`ToGround::Ask`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ask {
    /// Whose.
    pub origin: Origin,
    /// Random; the answer repeats it.
    pub stamp: u64,
    /// Greatest number that is known.
    pub after: u64,
}

/// See [`ToGround::Chip`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChipPart {
    /// Whose.
    pub origin: Origin,
    /// Alarm id.
    pub id: String,
    /// Revision of the alarm.
    pub revision: u32,
    /// Bytes of the whole picture.
    pub whole: u32,
    /// Where these bytes belong.
    pub from: u32,
    /// Some of its bytes.
    pub bytes: Vec<u8>,
}

/// From the ground.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ToAircraft {
    /// What became of a letter.
    Receipt {
        /// To whom.
        origin: Origin,
        /// Of which letter.
        sequence: u64,
        /// Of which sending.
        attempt: u32,
        /// What became of it.
        verdict: Verdict,
        /// Greatest number of an action for this aircraft.
        newest_action: u64,
    },
    /// "I am here."
    Answer {
        /// To whom.
        origin: Origin,
        /// The beat's.
        stamp: u64,
        /// Greatest number of an action for this aircraft.
        newest_action: u64,
    },
    /// The actions that were asked for, the oldest first, as many as fit.
    Actions {
        /// To whom.
        origin: Origin,
        /// The asking's.
        stamp: u64,
        /// JSON list.
        json: Vec<u8>,
    },
    /// How much of a picture is there.
    ChipHeld {
        /// To whom.
        origin: Origin,
        /// Alarm id.
        id: String,
        /// Revision of the alarm.
        revision: u32,
        /// Bytes from its start that are there.
        held: u32,
    },
}

/// A signature over a datagram's own bytes, to be checked once it is known whose it should be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Signed {
    bytes: Vec<u8>,
    signature: Option<Signature>,
}

impl Signed {
    /// Whether the signature is this key's.
    #[must_use]
    pub fn is_by(&self, key: &PublicKey) -> bool {
        self.signature
            .is_some_and(|signature| key.verifies(&self.bytes, &signature))
    }

    /// Whether there is one at all.
    #[must_use]
    pub fn is_signed(&self) -> bool {
        self.signature.is_some()
    }
}

/// A letter's payload: made once, sent as often as it takes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PackedLetter {
    signature: Option<Signature>,
    compressed: Vec<u8>,
}

impl PackedLetter {
    /// Packs an envelope.
    ///
    /// # Errors
    /// [`WireError::TooLarge`]: it goes another way.
    pub fn pack(sealed: &Sealed) -> Result<Self, WireError> {
        let plain = sealed.envelope.to_bytes();
        // Only a lack of memory makes it fail; then it is as if nothing could be compressed.
        let compressed = zstd::bulk::Compressor::with_dictionary(LEVEL, DICTIONARY)
            .and_then(|mut zstd| zstd.compress(&plain));
        let packed = Self {
            signature: sealed.signature,
            compressed: compressed.map_err(|_| WireError::TooLarge { len: plain.len() })?,
        };
        match packed.datagram(0).len() {
            len if len > MAX_DATAGRAM => Err(WireError::TooLarge { len }),
            _ => Ok(packed),
        }
    }

    /// The datagram of one sending.
    #[must_use]
    pub fn datagram(&self, attempt: u32) -> Vec<u8> {
        let payload = [&attempt.to_le_bytes()[..], &self.compressed].concat();
        frame(kind::LETTER, self.signature.as_ref(), &payload)
    }
}

mod kind {
    pub const LETTER: u8 = 1;
    pub const RECEIPT: u8 = 2;
    pub const BEAT: u8 = 3;
    pub const ANSWER: u8 = 4;
    pub const ASK: u8 = 5;
    pub const ACTIONS: u8 = 6;
    pub const CHIP: u8 = 7;
    pub const CHIP_HELD: u8 = 8;
}

impl ToGround {
    /// As a datagram; a letter comes from [`PackedLetter`], which is compressed once.
    #[must_use]
    pub fn datagram(&self, key: Option<&SecretKey>) -> Vec<u8> {
        let mut payload = Vec::new();
        let kind = match self {
            Self::Letter { attempt, sealed } => {
                return PackedLetter::pack(sealed)
                    .map(|packed| packed.datagram(*attempt))
                    .unwrap_or_default();
            }
            Self::Beat(beat) => {
                put_origin(&mut payload, &beat.origin);
                payload.extend(beat.newest.to_le_bytes());
                payload.extend(beat.waiting.to_le_bytes());
                payload.extend(beat.actions_known.to_le_bytes());
                payload.extend(beat.stamp.to_le_bytes());
                payload.extend(&beat.ping);
                kind::BEAT
            }
            Self::Ask(ask) => {
                put_origin(&mut payload, &ask.origin);
                payload.extend(ask.stamp.to_le_bytes());
                payload.extend(ask.after.to_le_bytes());
                kind::ASK
            }
            Self::Chip(part) => {
                put_origin(&mut payload, &part.origin);
                put_name_of(&mut payload, &part.id, MAX_ID);
                payload.extend(part.revision.to_le_bytes());
                payload.extend(part.whole.to_le_bytes());
                payload.extend(part.from.to_le_bytes());
                payload.extend(&part.bytes);
                kind::CHIP
            }
        };
        seal(kind, key, &payload)
    }

    /// Reads a datagram. Whose it should be is in it; whether it is theirs, [`Signed`] knows, or for
    /// a letter its [`Sealed`].
    ///
    /// # Errors
    /// [`WireError`].
    pub fn read(datagram: &[u8]) -> Result<(Self, Signed), WireError> {
        let (kind, signature, payload) = open(datagram)?;
        let read = match kind {
            kind::LETTER => letter(signature, payload),
            kind::BEAT => beat(payload).map(Self::Beat),
            kind::ASK => ask(payload).map(Self::Ask),
            kind::CHIP => chip(payload).map(Self::Chip),
            _ => None,
        };
        let read = read.ok_or(WireError::Malformed { kind })?;
        Ok((read, Signed::of(kind, signature, payload)))
    }
}

impl ToAircraft {
    /// As a datagram.
    #[must_use]
    pub fn datagram(&self, key: Option<&SecretKey>) -> Vec<u8> {
        let mut payload = Vec::new();
        put_origin(&mut payload, self.origin());
        let kind = match self {
            Self::Receipt {
                sequence,
                attempt,
                verdict,
                newest_action,
                ..
            } => {
                payload.extend(sequence.to_le_bytes());
                payload.extend(attempt.to_le_bytes());
                let (number, reason) = verdict.on_wire();
                payload.push(number);
                payload.extend(newest_action.to_le_bytes());
                payload.extend(reason.bytes().take(MAX_REASON));
                kind::RECEIPT
            }
            Self::Answer {
                stamp,
                newest_action,
                ..
            } => {
                payload.extend(stamp.to_le_bytes());
                payload.extend(newest_action.to_le_bytes());
                kind::ANSWER
            }
            Self::Actions { stamp, json, .. } => {
                payload.extend(stamp.to_le_bytes());
                payload.extend(json);
                kind::ACTIONS
            }
            Self::ChipHeld {
                id, revision, held, ..
            } => {
                put_name_of(&mut payload, id, MAX_ID);
                payload.extend(revision.to_le_bytes());
                payload.extend(held.to_le_bytes());
                kind::CHIP_HELD
            }
        };
        seal(kind, key, &payload)
    }

    /// Reads a datagram.
    ///
    /// # Errors
    /// [`WireError`].
    pub fn read(datagram: &[u8]) -> Result<(Self, Signed), WireError> {
        let (kind, signature, payload) = open(datagram)?;
        let mut read = Reader(payload);
        let said = match kind {
            kind::RECEIPT => receipt(&mut read),
            kind::ANSWER => answer(&mut read),
            kind::ACTIONS => actions(&mut read),
            kind::CHIP_HELD => chip_held(&mut read),
            _ => None,
        };
        let said = said.ok_or(WireError::Malformed { kind })?;
        Ok((said, Signed::of(kind, signature, payload)))
    }

    /// To whom.
    #[must_use]
    pub fn origin(&self) -> &Origin {
        match self {
            Self::Receipt { origin, .. }
            | Self::Answer { origin, .. }
            | Self::Actions { origin, .. }
            | Self::ChipHeld { origin, .. } => origin,
        }
    }
}

impl Verdict {
    fn on_wire(&self) -> (u8, &str) {
        match self {
            Self::Stored => (0, ""),
            Self::Refused(reason) => (1, reason),
            Self::Later(reason) => (2, reason),
        }
    }

    fn read(number: u8, reason: &[u8]) -> Option<Self> {
        let reason = String::from_utf8_lossy(&reason[..reason.len().min(MAX_REASON)]).into_owned();
        match number {
            0 => Some(Self::Stored),
            1 => Some(Self::Refused(reason)),
            2 => Some(Self::Later(reason)),
            _ => None,
        }
    }
}

impl Signed {
    fn of(kind: u8, signature: Option<Signature>, payload: &[u8]) -> Self {
        Self {
            bytes: signed_bytes(kind, payload),
            signature,
        }
    }
}

fn signed_bytes(kind: u8, payload: &[u8]) -> Vec<u8> {
    [SIGNED_AS, &[kind], payload].concat()
}

fn seal(kind: u8, key: Option<&SecretKey>, payload: &[u8]) -> Vec<u8> {
    let signature = key.map(|key| key.sign(&signed_bytes(kind, payload)));
    frame(kind, signature.as_ref(), payload)
}

fn frame(kind: u8, signature: Option<&Signature>, payload: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(MARK.len() + 2 + SIGNATURE_LEN + payload.len());
    bytes.extend(MARK);
    bytes.push(kind);
    bytes.push(u8::from(signature.is_some()));
    bytes.extend(signature.into_iter().flatten());
    bytes.extend(payload);
    bytes
}

fn open(datagram: &[u8]) -> Result<(u8, Option<Signature>, &[u8]), WireError> {
    let mut read = Reader(datagram);
    if read.take(MARK.len()) != Some(&MARK) {
        return Err(WireError::Foreign);
    }
    let kind = read.u8().ok_or(WireError::Foreign)?;
    let malformed = WireError::Malformed { kind };
    let signature = match read.u8() {
        Some(0) => None,
        Some(1) => Some(read.signature().ok_or(malformed)?),
        _ => return Err(malformed),
    };
    Ok((kind, signature, read.0))
}

fn put_origin(bytes: &mut Vec<u8>, origin: &Origin) {
    put_name(bytes, &origin.uav);
    bytes.extend(origin.outbox.to_le_bytes());
}

fn put_name_of(bytes: &mut Vec<u8>, text: &str, longest: usize) {
    let length = text.len().min(longest);
    bytes.push(u8::try_from(length).unwrap_or(u8::MAX));
    bytes.extend(&text.as_bytes()[..length]);
}

fn letter(signature: Option<Signature>, payload: &[u8]) -> Option<ToGround> {
    let mut read = Reader(payload);
    let attempt = read.u32()?;
    let mut zstd = zstd::bulk::Decompressor::with_dictionary(DICTIONARY).ok()?;
    let plain = zstd.decompress(read.0, MAX_ALARM + HEAD_ROOM).ok()?;
    let envelope = Envelope::from_bytes(&plain).ok()?;
    Some(ToGround::Letter {
        attempt,
        sealed: Sealed {
            envelope,
            signature,
        },
    })
}

fn beat(payload: &[u8]) -> Option<Beat> {
    let mut read = Reader(payload);
    Some(Beat {
        origin: read.origin()?,
        newest: read.u64()?,
        waiting: read.u32()?,
        actions_known: read.u64()?,
        stamp: read.u64()?,
        ping: read.0.to_vec(),
    })
}

fn ask(payload: &[u8]) -> Option<Ask> {
    let mut read = Reader(payload);
    Some(Ask {
        origin: read.origin()?,
        stamp: read.u64()?,
        after: read.u64()?,
    })
}

fn chip(payload: &[u8]) -> Option<ChipPart> {
    let mut read = Reader(payload);
    Some(ChipPart {
        origin: read.origin()?,
        id: read.text(MAX_ID)?,
        revision: read.u32()?,
        whole: read.u32()?,
        from: read.u32()?,
        bytes: read.0.to_vec(),
    })
}

fn receipt(read: &mut Reader<'_>) -> Option<ToAircraft> {
    let origin = read.origin()?;
    let (sequence, attempt, verdict) = (read.u64()?, read.u32()?, read.u8()?);
    let newest_action = read.u64()?;
    Some(ToAircraft::Receipt {
        origin,
        sequence,
        attempt,
        verdict: Verdict::read(verdict, read.0)?,
        newest_action,
    })
}

fn answer(read: &mut Reader<'_>) -> Option<ToAircraft> {
    Some(ToAircraft::Answer {
        origin: read.origin()?,
        stamp: read.u64()?,
        newest_action: read.u64()?,
    })
}

fn actions(read: &mut Reader<'_>) -> Option<ToAircraft> {
    Some(ToAircraft::Actions {
        origin: read.origin()?,
        stamp: read.u64()?,
        json: read.0.to_vec(),
    })
}

fn chip_held(read: &mut Reader<'_>) -> Option<ToAircraft> {
    Some(ToAircraft::ChipHeld {
        origin: read.origin()?,
        id: read.text(MAX_ID)?,
        revision: read.u32()?,
        held: read.u32()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::deliver::tests_support::alarm;
    use proptest::prelude::*;

    fn origin() -> Origin {
        Origin {
            uav: "uav-1".to_owned(),
            outbox: 77,
        }
    }

    fn sealed(key: Option<&SecretKey>) -> Sealed {
        let envelope = Envelope {
            origin: origin(),
            sequence: 9,
            count: 1,
            alarm: alarm(1, 1).to_geojson().to_string().into_bytes(),
        };
        let signature = key.map(|key| envelope.sign(key));
        Sealed {
            envelope,
            signature,
        }
    }

    fn to_ground() -> Vec<ToGround> {
        vec![
            ToGround::Letter {
                attempt: 3,
                sealed: sealed(None),
            },
            ToGround::Beat(Beat {
                origin: origin(),
                newest: 12,
                waiting: 2,
                actions_known: 5,
                stamp: 99,
                ping: b"{}".to_vec(),
            }),
            ToGround::Ask(Ask {
                origin: origin(),
                stamp: 1,
                after: 5,
            }),
            ToGround::Chip(ChipPart {
                origin: origin(),
                id: "uav-1-3".to_owned(),
                revision: 2,
                whole: 900,
                from: 400,
                bytes: vec![1, 2, 3],
            }),
        ]
    }

    fn to_aircraft() -> Vec<ToAircraft> {
        let receipt = |verdict| ToAircraft::Receipt {
            origin: origin(),
            sequence: 4,
            attempt: 2,
            verdict,
            newest_action: 8,
        };
        vec![
            receipt(Verdict::Stored),
            receipt(Verdict::Refused("no".to_owned())),
            receipt(Verdict::Later("disk".to_owned())),
            ToAircraft::Answer {
                origin: origin(),
                stamp: 5,
                newest_action: 8,
            },
            ToAircraft::Actions {
                origin: origin(),
                stamp: 5,
                json: b"[]".to_vec(),
            },
            ToAircraft::ChipHeld {
                origin: origin(),
                id: "uav-1-3".to_owned(),
                revision: 2,
                held: 400,
            },
        ]
    }

    #[test]
    fn everything_reads_back_signed_and_unsigned() {
        let key = SecretKey::random();
        for given in [None, Some(&key)] {
            for said in to_ground() {
                let (read, signed) = ToGround::read(&said.datagram(given)).unwrap();
                assert_eq!(read, said);
                if !matches!(said, ToGround::Letter { .. }) {
                    assert_eq!(signed.is_by(&key.public()), given.is_some());
                }
            }
            for said in to_aircraft() {
                let (read, signed) = ToAircraft::read(&said.datagram(given)).unwrap();
                assert_eq!((read, signed.is_by(&key.public())), (said, given.is_some()));
            }
        }
    }

    #[test]
    fn a_changed_byte_never_passes_for_the_ground() {
        let key = SecretKey::random();
        for said in to_aircraft() {
            let datagram = said.datagram(Some(&key));
            for at in 0..datagram.len() {
                let mut forged = datagram.clone();
                forged[at] ^= 0x10;
                let passes =
                    ToAircraft::read(&forged).is_ok_and(|(_, signed)| signed.is_by(&key.public()));
                assert!(!passes, "byte {at} of {said:?}");
            }
        }
    }

    #[test]
    fn a_signed_alarm_takes_less_than_half_of_its_json() {
        let key = SecretKey::random();
        let packed = PackedLetter::pack(&sealed(Some(&key))).unwrap();
        let (packed, plain) = (packed.datagram(0).len(), sealed(None).envelope.alarm.len());
        assert!(2 * packed < plain, "{packed} of {plain} bytes");
        let (read, _) =
            ToGround::read(&PackedLetter::pack(&sealed(Some(&key))).unwrap().datagram(1)).unwrap();
        let ToGround::Letter { sealed, .. } = read else {
            panic!("{read:?}");
        };
        assert!(sealed.is_signed_by(&key.public()));
    }

    #[test]
    fn a_bomb_is_not_unpacked() {
        let zeros = vec![0_u8; 64 << 20];
        let bomb = zstd::bulk::Compressor::with_dictionary(1, DICTIONARY)
            .unwrap()
            .compress(&zeros)
            .unwrap();
        let payload = [&1_u32.to_le_bytes()[..], &bomb].concat();
        let read = ToGround::read(&frame(kind::LETTER, None, &payload));
        assert_eq!(read, Err(WireError::Malformed { kind: kind::LETTER }));
    }

    proptest! {
        #[test]
        fn no_datagram_makes_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            for kind in 0..10 {
                let datagram = [&MARK[..], &[kind], &bytes].concat();
                let _ = ToGround::read(&datagram);
                let _ = ToAircraft::read(&datagram);
            }
        }
    }
}
