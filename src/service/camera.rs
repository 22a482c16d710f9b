//! The camera thread: keeps the newest pair, counts what it replaced.

use super::Board;
use super::core::Input;
use crate::ingest::{StereoPair, StereoSource};
use emberfix_frames::Stamped;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

/// Room for one pair. A newer pair replaces the older one.
#[derive(Clone, Default)]
pub struct Slot {
    pair: Arc<Mutex<Option<Stamped<StereoPair>>>>,
}

impl Slot {
    fn put(&self, pair: Stamped<StereoPair>) -> bool {
        let mut held = self.pair.lock().unwrap_or_else(PoisonError::into_inner);
        held.replace(pair).is_some()
    }

    /// Takes the pair out, if there is one.
    pub fn take(&self) -> Option<Stamped<StereoPair>> {
        self.pair
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
    }
}

/// Starts the thread. It ends when the source ends or the service stops.
pub fn start(
    mut source: Box<dyn StereoSource>,
    slot: Slot,
    events: SyncSender<Input>,
    board: Arc<Board>,
) -> std::io::Result<JoinHandle<()>> {
    std::thread::Builder::new()
        .name("camera".to_owned())
        .spawn(move || {
            let mut shed = 0_u64;
            while !board.is_stopping() {
                match source.next_pair() {
                    Ok(Some(pair)) => {
                        shed += u64::from(slot.put(pair));
                        // A full queue already holds a reason to look at the slot.
                        let _told = events.try_send(Input::PairReady);
                    }
                    Ok(None) => {
                        tracing::info!("the camera source has ended");
                        break;
                    }
                    Err(error) if error.is_fatal() => {
                        tracing::error!(%error, "the camera source failed");
                        break;
                    }
                    Err(error) => tracing::warn!(%error, "no pair"),
                }
            }
            let counters = source.counters();
            tracing::info!(?counters, shed, "camera thread ends");
        })
}
