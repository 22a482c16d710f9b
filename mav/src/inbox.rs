//! One frame reader per peer: bytes of different senders on one port never mix.

use crate::link::{Chunk, Peer};
use crate::telemetry::Received;
use crate::wire::{FrameReader, WireCounters};
use std::collections::VecDeque;

/// Frame readers by peer; sans-IO.
///
/// **Bound:** [`Inbox::PEERS`] readers. **Loss rule:** the peer that was silent longest loses what
/// it had half sent; its counters stay in the sum.
#[derive(Debug, Default)]
pub struct Inbox {
    /// Latest heard last.
    readers: VecDeque<(Peer, FrameReader)>,
    forgotten: WireCounters,
}

impl Inbox {
    /// Peers that are kept apart at most.
    pub const PEERS: usize = 16;

    /// Nobody heard yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// What a chunk completes, in order.
    pub fn take(&mut self, chunk: &Chunk) -> Vec<Received> {
        let mut reader = self.reader_of(chunk.from);
        reader.push(&chunk.bytes);
        let received = std::iter::from_fn(|| reader.next_received()).collect();
        self.readers.push_back((chunk.from, reader));
        received
    }

    /// What came so far, of all peers together.
    #[must_use]
    pub fn counters(&self) -> WireCounters {
        let each = self.readers.iter().map(|(_, reader)| reader.counters());
        each.fold(self.forgotten, WireCounters::plus)
    }

    fn reader_of(&mut self, peer: Peer) -> FrameReader {
        if let Some(at) = self.readers.iter().position(|(known, _)| *known == peer) {
            return self
                .readers
                .remove(at)
                .map(|(_, reader)| reader)
                .unwrap_or_default();
        }
        if self.readers.len() == Self::PEERS {
            let silent = self
                .readers
                .pop_front()
                .map(|(_, reader)| reader.counters());
            self.forgotten = self.forgotten.plus(silent.unwrap_or_default());
        }
        FrameReader::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outgoing::{Encoder, autopilot_heartbeat};
    use crate::wire::Address;

    fn peer(port: u16) -> Peer {
        Peer::Udp(([127, 0, 0, 1], port).into())
    }

    #[test]
    fn halves_of_two_senders_do_not_mix() {
        let frame = Encoder::new(Address::new(1, 1)).encode(&autopilot_heartbeat(true));
        let (head, tail) = frame.split_at(9);
        let mut inbox = Inbox::new();
        let mut take = |port, bytes: &[u8]| {
            inbox
                .take(&Chunk {
                    from: peer(port),
                    bytes: bytes.to_vec(),
                })
                .len()
        };
        assert_eq!(
            (take(1, head), take(2, head), take(1, tail), take(2, tail)),
            (0, 0, 1, 1)
        );
    }

    #[test]
    fn a_crowd_of_peers_is_bounded_and_stays_counted() {
        let frame = Encoder::new(Address::new(1, 1)).encode(&autopilot_heartbeat(true));
        let mut inbox = Inbox::new();
        for port in 0..100 {
            inbox.take(&Chunk {
                from: peer(port),
                bytes: frame.clone(),
            });
        }
        assert_eq!(
            (inbox.readers.len(), inbox.counters().frames),
            (Inbox::PEERS, 100)
        );
    }
}
