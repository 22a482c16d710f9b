//! Pictures of fires, in parts, at the speed of what is left over.
//!
//! **Bounds:** [`DatagramDelivery::CHIPS`] pictures wait, [`BYTES_PER_S`] are sent. **Loss rule:** a newer
//! picture of a fire replaces one that is not on its way, beyond the bound the oldest goes, and one of
//! which the ground takes no part for [`GIVE_UP_AFTER`] sendings is given up: the ground has a reason.

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
/// Sendings without one byte more on the other side, while the link is up.
const GIVE_UP_AFTER: u32 = 30;

/// What waits, oldest first; the first is on its way.
#[derive(Debug, Default)]
pub(crate) struct Chips {
    waiting: VecDeque<Chip>,
    /// Sendings of the first since it last got on.
    in_vain: u32,
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
        self.in_vain += 1;
        if self.in_vain > GIVE_UP_AFTER {
            self.in_vain = 0;
            let given_up = self.waiting.pop_front().map(|chip| chip.id);
            tracing::debug!(?given_up, "a picture that the ground does not take");
        }
    }

    /// Nobody is there: what was sent in vain says nothing of the picture.
    pub fn unreached(&mut self) {
        self.in_vain = 0;
    }

    /// The ground has so much from the start; less than before when it has started anew. True when
    /// that is all.
    pub fn held(&mut self, id: &str, revision: u32, held: u32) -> bool {
        let Some(chip) = self.waiting.front_mut() else {
            return false;
        };
        if chip.id != id || chip.revision != revision {
            return false;
        }
        self.again_at = None;
        let held = (held as usize).min(chip.jpeg.len());
        if held > chip.held {
            self.in_vain = 0;
        }
        chip.held = held;
        let whole = chip.held == chip.jpeg.len();
        if whole {
            self.waiting.pop_front();
        }
        whole
    }

    /// It got there another way.
    pub fn forget(&mut self, id: &str, revision: u32) {
        let first = self.waiting.front().map(|chip| chip.id.clone());
        self.waiting
            .retain(|chip| chip.id != id || chip.revision > revision);
        if self.waiting.front().map(|chip| &chip.id) != first.as_ref() {
            (self.in_vain, self.again_at) = (0, None);
        }
    }
}
