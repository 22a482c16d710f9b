//! Fires' pictures: by datagrams, and over HTTP where no datagram is answered; a part at a time, 500 B/s,
//! and only while no alarm waits.

use super::{IpCourier, Surroundings, lock};
use crate::deliver::DatagramDelivery;
use crate::deliver::datagram::chips::Chips;
use crate::deliver::datagram::wire::{ToAircraft, ToGround};
use crate::deliver::outbox::StoredChip;
use emberfix_frames::ServiceTime;
use std::sync::{Arc, Mutex, PoisonError};

/// The pictures that are on offer.
#[derive(Debug, Default)]
pub(super) struct Pictures {
    /// Number of the newest that was taken from the outbox.
    seen: i64,
    over_http: Chips,
    /// What exchanges over HTTP brought back.
    heard: Arc<Mutex<Vec<Heard>>>,
}

/// How it went with a part.
#[derive(Debug)]
enum Heard {
    Held {
        id: String,
        revision: u32,
        held: u32,
    },
    Nobody,
}

impl Pictures {
    pub fn seen(&self) -> i64 {
        self.seen
    }

    fn heard(&self) -> Vec<Heard> {
        std::mem::take(&mut self.heard.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl IpCourier {
    /// To both ways; the one that gets it there first tells the other.
    pub(super) fn offer_pictures(&mut self, pictures: Vec<StoredChip>) {
        for StoredChip {
            number,
            id,
            revision,
            jpeg,
        } in pictures
        {
            self.pictures.seen = self.pictures.seen.max(number);
            if let Some(link) = &mut self.datagrams {
                link.offer_chip(id.clone(), revision, jpeg.clone());
            }
            self.pictures.over_http.offer(id, revision, jpeg);
        }
    }

    pub(super) fn picture_arrived(&mut self, around: &Surroundings, id: &str, revision: u32) {
        tracing::debug!(id, revision, "the ground has a fire's picture");
        self.pictures.over_http.forget(id, revision);
        if let Some(link) = &mut self.datagrams {
            link.forget_chip(id, revision);
        }
        if let Err(error) = lock(&around.outbox).drop_chip(id, revision) {
            tracing::warn!(%error, "a picture will be sent again");
        }
    }

    /// The datagram of a part, in an exchange of its own.
    pub(super) fn picture_over_http(&mut self, around: &Surroundings, now: ServiceTime) {
        for heard in self.pictures.heard() {
            match heard {
                Heard::Held { id, revision, held } => {
                    if self.pictures.over_http.held(&id, revision, held) {
                        self.picture_arrived(around, &id, revision);
                    }
                }
                Heard::Nobody => self.pictures.over_http.unreached(),
            }
        }
        let up = self.datagrams.as_ref().is_some_and(DatagramDelivery::is_up);
        if up || !self.waiting.is_empty() || !self.http.is_reached() || self.is_asking() {
            return;
        }
        let Some(part) = self.pictures.over_http.next_part(&self.origin, now) else {
            return;
        };
        self.pictures.over_http.spend(part.bytes.len(), now);
        let (key, heard) = (self.key.clone(), Arc::clone(&self.pictures.heard));
        self.apart(move |link| {
            let news = match link.exchange(&ToGround::Chip(part), key.as_ref()) {
                Ok(ToAircraft::ChipHeld {
                    id, revision, held, ..
                }) => Heard::Held { id, revision, held },
                Ok(_) => return,
                Err(error) => {
                    tracing::debug!(%error, "a picture's part was not told");
                    Heard::Nobody
                }
            };
            heard
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .push(news);
        });
    }
}
