//! What is signed: one alarm's exact bytes with the aircraft's own numbers around it. The same over
//! every link that carries whole alarms.
//!
//! **Head** (little-endian): `EFA1`, length of the aircraft's name (1 byte), the name, outbox (8),
//! sequence (8), count (4). The alarm's GeoJSON follows, to the end. The signature (Ed25519) is over
//! `emberfix alarm 1` and a zero byte, then head and alarm.
//!
//! **What the numbers are for.** `outbox` is a random name of the aircraft's outbox. Every revision
//! that the outbox stores gets the next `sequence`; `count` says how many this alarm took so far, so
//! that it stands for all of them. With the sequence that the aircraft says is its newest, a ground
//! that sums the counts of what it has knows how many revisions a relay kept back ([`crate::ground`]).

use super::keys::{PublicKey, SIGNATURE_LEN, SecretKey, Signature};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;

const MAGIC: &[u8; 4] = b"EFA1";
const SIGNED_AS: &[u8] = b"emberfix alarm 1\0";
/// Longest name of an aircraft, bytes.
pub const MAX_NAME: usize = 32;
/// Largest alarm, bytes: what the ground's HTTP door takes.
pub const MAX_ALARM: usize = 64 * 1024;
/// The HTTP header that carries head and signature beside the alarm.
pub const HTTP_HEADER: &str = "emberfix-envelope";

/// Why bytes are no envelope.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EnvelopeError {
    /// Too short, too long, or something else.
    #[error("not an alarm envelope: {problem}")]
    Malformed {
        /// What is wrong.
        problem: &'static str,
    },
}

/// Which outbox of which aircraft: its sequence numbers are its own.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Origin {
    /// Name of the aircraft.
    pub uav: String,
    /// Random name of its outbox.
    pub outbox: u64,
}

/// One alarm's exact bytes, with the aircraft's numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Envelope {
    /// Where it comes from.
    pub origin: Origin,
    /// Number of this revision among all that the outbox stored.
    pub sequence: u64,
    /// How many of those were of this alarm, this one included.
    pub count: u32,
    /// The alarm's GeoJSON.
    pub alarm: Vec<u8>,
}

/// An envelope as it came, with the signature under it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sealed {
    /// What it says.
    pub envelope: Envelope,
    /// Under it; none from an aircraft without a key.
    pub signature: Option<Signature>,
}

impl Envelope {
    /// Head and alarm.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        [self.head(), self.alarm.clone()].concat()
    }

    /// Reads [`Envelope::to_bytes`].
    ///
    /// # Errors
    /// [`EnvelopeError`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, EnvelopeError> {
        let mut read = Reader(bytes);
        let envelope = Self::read_head(&mut read)?;
        Self::with_alarm(envelope, read.0)
    }

    /// The signature of this envelope.
    #[must_use]
    pub fn sign(&self, key: &SecretKey) -> Signature {
        key.sign(&self.signed_bytes())
    }

    /// With a signature, for HTTP: what stands beside the alarm.
    #[must_use]
    pub fn http_header(&self, signature: Option<&Signature>) -> String {
        let signature = signature.map_or(&[][..], |signature| signature.as_slice());
        BASE64.encode([&self.head(), signature].concat())
    }

    fn head(&self) -> Vec<u8> {
        let mut head = MAGIC.to_vec();
        put_name(&mut head, &self.origin.uav);
        head.extend(self.origin.outbox.to_le_bytes());
        head.extend(self.sequence.to_le_bytes());
        head.extend(self.count.to_le_bytes());
        head
    }

    fn read_head(read: &mut Reader<'_>) -> Result<Self, EnvelopeError> {
        let malformed = |problem| EnvelopeError::Malformed { problem };
        if read.take(4) != Some(MAGIC) {
            return Err(malformed("it does not begin with EFA1"));
        }
        let cut = || malformed("its head is cut");
        Ok(Self {
            origin: read.origin().ok_or(malformed("its aircraft has no name"))?,
            sequence: read.u64().ok_or_else(cut)?,
            count: read.u32().ok_or_else(cut)?,
            alarm: Vec::new(),
        })
    }

    fn with_alarm(mut self, alarm: &[u8]) -> Result<Self, EnvelopeError> {
        if alarm.is_empty() || alarm.len() > MAX_ALARM {
            return Err(EnvelopeError::Malformed {
                problem: "its alarm is empty or larger than 64 KiB",
            });
        }
        self.alarm = alarm.to_vec();
        Ok(self)
    }

    fn signed_bytes(&self) -> Vec<u8> {
        [SIGNED_AS, &self.head(), &self.alarm].concat()
    }
}

impl Sealed {
    /// From the HTTP header and the body.
    ///
    /// # Errors
    /// [`EnvelopeError`].
    pub fn from_http(header: &str, body: &[u8]) -> Result<Self, EnvelopeError> {
        let malformed = |problem| EnvelopeError::Malformed { problem };
        let bytes = BASE64
            .decode(header)
            .map_err(|_| malformed("its header is no base64"))?;
        let mut read = Reader(&bytes);
        let envelope = Envelope::read_head(&mut read)?.with_alarm(body)?;
        let signature = match read.0 {
            [] => None,
            rest => Some(
                rest.try_into()
                    .map_err(|_| malformed("its signature is cut"))?,
            ),
        };
        Ok(Self {
            envelope,
            signature,
        })
    }

    /// Whether the signature is this key's.
    #[must_use]
    pub fn is_signed_by(&self, key: &PublicKey) -> bool {
        self.signature
            .is_some_and(|signature| key.verifies(&self.envelope.signed_bytes(), &signature))
    }
}

/// Appends a name behind its length; longer ones are cut by configuration, never here.
pub(super) fn put_name(bytes: &mut Vec<u8>, name: &str) {
    debug_assert!(name.len() <= MAX_NAME);
    bytes.push(u8::try_from(name.len()).unwrap_or(u8::MAX));
    bytes.extend(name.as_bytes());
}

/// Takes values off the front of bytes.
pub(super) struct Reader<'a>(pub &'a [u8]);

impl<'a> Reader<'a> {
    pub fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (front, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(front)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.take(N)?.try_into().ok()
    }

    pub fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub fn signature(&mut self) -> Option<Signature> {
        self.array::<SIGNATURE_LEN>()
    }

    pub fn text(&mut self, longest: usize) -> Option<String> {
        let length = usize::from(self.u8()?);
        let bytes = self
            .take(length)
            .filter(|_| (1..=longest).contains(&length))?;
        String::from_utf8(bytes.to_vec()).ok()
    }

    pub fn origin(&mut self) -> Option<Origin> {
        Some(Origin {
            uav: self.text(MAX_NAME)?,
            outbox: self.u64()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn envelope() -> Envelope {
        Envelope {
            origin: Origin {
                uav: "uav-1".to_owned(),
                outbox: 0x1234_5678_9ABC_DEF0,
            },
            sequence: 7,
            count: 2,
            alarm: br#"{"type":"Feature"}"#.to_vec(),
        }
    }

    #[test]
    fn bytes_and_http_header_read_back() {
        let key = SecretKey::random();
        let signature = envelope().sign(&key);
        let bytes = envelope().to_bytes();
        assert_eq!(Envelope::from_bytes(&bytes).unwrap(), envelope());
        for given in [None, Some(signature)] {
            let header = envelope().http_header(given.as_ref());
            let sealed = Sealed::from_http(&header, &envelope().alarm).unwrap();
            assert_eq!(
                (sealed.envelope.clone(), sealed.signature),
                (envelope(), given)
            );
            assert_eq!(sealed.is_signed_by(&key.public()), given.is_some());
        }
    }

    #[test]
    fn whatever_is_changed_breaks_the_signature() {
        let key = SecretKey::random();
        let sealed = |changed: Envelope| Sealed {
            envelope: changed,
            signature: Some(envelope().sign(&key)),
        };
        assert!(sealed(envelope()).is_signed_by(&key.public()));
        let change: [fn(&mut Envelope); 5] = [
            |e| e.origin.uav = "uav-2".to_owned(),
            |e| e.origin.outbox += 1,
            |e| e.sequence += 1,
            |e| e.count += 1,
            |e| e.alarm[3] ^= 1,
        ];
        for change in change {
            let mut forged = envelope();
            change(&mut forged);
            assert!(!sealed(forged).is_signed_by(&key.public()));
        }
        assert!(!sealed(envelope()).is_signed_by(&SecretKey::random().public()));
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = Envelope::from_bytes(&bytes);
            let _ = Envelope::from_bytes(&[MAGIC.to_vec(), bytes.clone()].concat());
            let _ = Sealed::from_http(&BASE64.encode(&bytes), &bytes);
        }
    }
}
