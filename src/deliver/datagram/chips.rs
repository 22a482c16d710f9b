//! Pictures of fires, in parts, at the speed of what is left over.

use super::DatagramDelivery;
use super::wire::ChipPart;
use crate::deliver::envelope::Origin;
use emberfix_frames::{ServiceTime, SignedDuration};
use std::collections::VecDeque;

/// Bytes of a picture in one datagram.
const PART: usize = 400;
/// Bytes per second, datagrams whole.
const BYTES_PER_S: f64 = 500.0;
/// A part without an answer goes again after this.
const ANSWER_IN: SignedDuration = SignedDuration::from_secs(2);
/// Largest picture.
const LARGEST: usize = 32 * 1024;

/// What waits, oldest first; the first is on its way.
#[derive(Debug, Default)]
pub(super) struct Chips {
    waiting: VecDeque<Chip>,
    /// Not before this: the rate.
    open_at: Option<ServiceTime>,
    /// Not before this: the answer.
    again_at: Option<ServiceTime>,
}

#[derive(Debug)]
struct Chip {
    id: String,
    revision: u32,
    jpeg: Vec<u8>,
    held: usize,
}

impl Chips {
    /// A newer picture of the same fire takes the place of one that is not on its way yet.
    pub fn offer(&mut self, id: String, revision: u32, jpeg: Vec<u8>) {
        if jpeg.is_empty() || jpeg.len() > LARGEST {
            return;
        }
        let begun = usize::from(self.waiting.front().is_some_and(|first| first.held > 0));
        let mut place = 0;
        self.waiting.retain(|chip| {
            place += 1;
            place <= begun || chip.id != id
        });
        if self.waiting.len() == DatagramDelivery::CHIPS {
            self.waiting.remove(begun);
        }
        self.waiting.push_back(Chip {
            id,
            revision,
            jpeg,
            held: 0,
        });
    }

    pub fn next_part(&self, origin: &Origin, now: ServiceTime) -> Option<ChipPart> {
        let early = |at: Option<ServiceTime>| at.is_some_and(|at| now < at);
        if early(self.open_at) || early(self.again_at) {
            return None;
        }
        let chip = self.waiting.front()?;
        let rest = chip.jpeg.get(chip.held..)?;
        Some(ChipPart {
            origin: origin.clone(),
            id: chip.id.clone(),
            revision: chip.revision,
            whole: u32::try_from(chip.jpeg.len()).ok()?,
            from: u32::try_from(chip.held).ok()?,
            bytes: rest[..rest.len().min(PART)].to_vec(),
        })
    }

    pub fn spend(&mut self, bytes: usize, now: ServiceTime) {
        self.open_at = Some(now + emberfix_frames::seconds(bytes as f64 / BYTES_PER_S));
        self.again_at = Some(now + ANSWER_IN);
    }

    /// The ground has so much from the start; less than before when it has started anew.
    pub fn held(&mut self, id: &str, revision: u32, held: u32) {
        let Some(chip) = self.waiting.front_mut() else {
            return;
        };
        if chip.id != id || chip.revision != revision {
            return;
        }
        self.again_at = None;
        chip.held = (held as usize).min(chip.jpeg.len());
        if chip.held == chip.jpeg.len() {
            self.waiting.pop_front();
        }
    }
}
