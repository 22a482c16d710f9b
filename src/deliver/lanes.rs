//! HTTP as an [`AlarmLink`]: a few exchanges at once, so that one that hangs holds up no other.

use super::http::{HttpLink, Told};
use super::link::{AlarmLink, Courier, Letter, Receipt, Settled};
use emberfix_frames::ServiceTime;
use std::sync::mpsc::{Receiver, Sender, channel};

/// What came back from one exchange.
struct Done {
    sent: Receipt,
    told: Told,
}

/// Exchanges with one ground station, at most [`Courier::LANES`] at once, each on a thread of its own.
pub struct HttpLanes {
    link: HttpLink,
    courier: Courier,
    done: (Sender<Done>, Receiver<Done>),
    newest_action: u64,
}

impl HttpLanes {
    /// Lanes to where `link` leads.
    #[must_use]
    pub fn new(link: HttpLink) -> Self {
        Self {
            link,
            courier: Courier::new(),
            done: channel(),
            newest_action: 0,
        }
    }

    /// Where it leads.
    #[must_use]
    pub fn link(&self) -> &HttpLink {
        &self.link
    }

    /// The ground is known to be there, by another way.
    pub fn reached(&mut self, now: ServiceTime) {
        self.courier.reached(now);
    }

    /// The ground answered when it was last spoken to, or nobody has tried yet.
    #[must_use]
    pub fn is_reached(&self) -> bool {
        self.courier.is_open()
    }

    /// Greatest number of an operator's action that the ground spoke of.
    #[must_use]
    pub fn newest_action(&self) -> u64 {
        self.newest_action
    }

    fn finished(&mut self, now: ServiceTime) -> Vec<Settled> {
        let done: Vec<Done> = self.done.1.try_iter().collect();
        done.into_iter()
            .map(|Done { sent, told }| {
                self.newest_action = self.newest_action.max(told.newest_action);
                self.courier.settle(&sent, &told.settled, now);
                told.settled
            })
            .collect()
    }

    fn send(&self, letter: &Letter) {
        let (link, letter, done) = (self.link.clone(), letter.clone(), self.done.0.clone());
        let sent = Receipt {
            id: letter.id().to_owned(),
            revision: letter.revision(),
        };
        let failed = Done {
            sent: sent.clone(),
            told: Told::unreachable("no thread could be started"),
        };
        let exchange = move || {
            let told = link.tell(&letter);
            // The receiver is gone only when the service stops.
            let _gone = done.send(Done { sent, told });
        };
        let thread = std::thread::Builder::new().name("http".to_owned());
        if thread.spawn(exchange).is_err() {
            let _gone = self.done.0.send(failed);
        }
    }
}

impl AlarmLink for HttpLanes {
    fn name(&self) -> &'static str {
        super::datagram::DatagramDelivery::NAME
    }

    fn work(&mut self, waiting: &[Letter], now: ServiceTime) -> Vec<Settled> {
        let settled = self.finished(now);
        let just_delivered = |letter: &Letter| {
            settled.iter().any(|settled| {
                matches!(settled, Settled::Delivered(receipt)
                    if receipt.id == letter.id() && receipt.revision == letter.revision())
            })
        };
        let waiting: Vec<Letter> = waiting
            .iter()
            .filter(|letter| !just_delivered(letter))
            .cloned()
            .collect();
        while let Some(letter) = self.courier.choose(&waiting, now) {
            self.send(letter);
        }
        settled
    }
}
