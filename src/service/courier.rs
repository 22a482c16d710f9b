//! The HTTP thread: takes what waits in the outbox to the ground station, and says where we are.

use super::{Board, HTTP, SharedOutbox, lock};
use crate::deliver::http::{HttpError, HttpLink};
use crate::deliver::{AlarmLink, Courier, LinkError};
use crate::ingest::ServiceClock;
use crate::mission::Mission;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The aircraft's HTTP link and its pauses.
pub struct HttpCourier {
    link: HttpLink,
    courier: Courier,
    complained: bool,
}

/// How often the outbox is looked at.
const LOOK: Duration = Duration::from_millis(50);
/// How often the ground is told where we are.
const PING: Duration = Duration::from_millis(500);
/// Alarms that are read at once.
const BATCH: usize = 32;

impl HttpCourier {
    /// The link of a mission, if it has one.
    pub fn new(mission: &Mission) -> Result<Option<Self>, HttpError> {
        let Some(url) = &mission.ground.url else {
            return Ok(None);
        };
        let link = HttpLink::new(url)?;
        Ok(Some(Self {
            link,
            courier: Courier::new(),
            complained: false,
        }))
    }

    /// Starts the thread. It ends when the service stops.
    pub fn start(
        mut self,
        outbox: SharedOutbox,
        board: Arc<Board>,
        clock: ServiceClock,
    ) -> std::io::Result<JoinHandle<()>> {
        std::thread::Builder::new()
            .name("http".to_owned())
            .spawn(move || {
                let mut pinged = Instant::now();
                while !board.is_stopping() {
                    while self.deliver_one(&outbox, &clock) {}
                    if pinged.elapsed() > PING {
                        pinged = Instant::now();
                        self.ping(&board);
                    }
                    std::thread::sleep(LOOK);
                }
            })
    }

    /// Sends one alarm; true when another one may follow at once.
    fn deliver_one(&mut self, outbox: &SharedOutbox, clock: &ServiceClock) -> bool {
        let pending = match lock(outbox).pending(HTTP, BATCH) {
            Ok(pending) => pending,
            Err(error) => {
                tracing::error!(%error, "outbox not readable");
                return false;
            }
        };
        let Some(alarm) = self.courier.choose(&pending, clock()) else {
            return false;
        };
        // The outbox is not locked while the network takes its time.
        let outcome = AlarmLink::send(&mut self.link, alarm);
        self.courier.settle(&outcome, clock());
        match outcome {
            Ok(receipt) => {
                self.complained = false;
                let stored = lock(outbox).acknowledge(HTTP, &receipt.id, receipt.revision);
                if let Err(error) = &stored {
                    tracing::error!(%error, "receipt not stored; it will be sent again");
                }
                stored.is_ok()
            }
            Err(error) => {
                self.complain(&error);
                matches!(error, LinkError::Refused { .. })
            }
        }
    }

    fn ping(&mut self, board: &Board) {
        let Some(ping) = board.latest().ping.take() else {
            return;
        };
        if let Err(error) = self.link.send_track(&ping) {
            tracing::debug!(%error, "position not told");
        }
    }

    /// Once per outage.
    fn complain(&mut self, error: &LinkError) {
        if !std::mem::replace(&mut self.complained, true) {
            tracing::warn!(%error, "ground station not reached; alarms wait in the outbox");
        }
    }
}
