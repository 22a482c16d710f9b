//! A live source: a thread that fills a queue of one, and the reader's side of it.

use super::{CaptureClock, SourceCounters, SourceError, StereoPair, StereoSource};
use emberfix_frames::Stamped;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// How long a reader waits for a pair before it says [`SourceError::NoFrames`].
pub const PATIENCE: Duration = Duration::from_secs(2);

/// Queue of one: the newest pair replaces one that nobody has taken, which is counted as shed.
#[derive(Default)]
pub struct LatestPair {
    slot: Mutex<Slot>,
    changed: Condvar,
}

#[derive(Default)]
struct Slot {
    pair: Option<Stamped<StereoPair>>,
    counters: SourceCounters,
    clock: CaptureClock,
    ended: bool,
    failure: Option<SourceError>,
}

/// What a wait on [`LatestPair`] ended with.
#[derive(Debug)]
pub enum Taken {
    /// A pair.
    Pair(Stamped<StereoPair>),
    /// Nothing came in time.
    TimedOut,
    /// Nothing will come any more.
    Ended,
    /// The source broke.
    Failed(SourceError),
}

impl LatestPair {
    fn lock(&self) -> MutexGuard<'_, Slot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts the newest pair in.
    pub fn put(&self, pair: Stamped<StereoPair>) {
        let mut slot = self.lock();
        if slot.pair.replace(pair).is_some() {
            slot.counters.shed += 1;
        }
        self.changed.notify_all();
    }

    /// Changes the source's counters.
    pub fn count(&self, change: impl FnOnce(&mut SourceCounters)) {
        change(&mut self.lock().counters);
    }

    /// Says what the pairs' times rest on.
    pub fn set_clock(&self, clock: CaptureClock) {
        self.lock().clock = clock;
    }

    /// No more pairs will come; `failure` says why, if it is one.
    pub fn end(&self, failure: Option<SourceError>) {
        let mut slot = self.lock();
        slot.ended = true;
        slot.failure = failure;
        self.changed.notify_all();
    }

    /// Takes the pair, waiting for at most `patience`.
    pub fn take(&self, patience: Duration) -> Taken {
        let slot = self.lock();
        let waited = self
            .changed
            .wait_timeout_while(slot, patience, |slot| slot.pair.is_none() && !slot.ended);
        let (mut slot, _) = waited.unwrap_or_else(PoisonError::into_inner);
        if let Some(pair) = slot.pair.take() {
            slot.counters.delivered += 1;
            return Taken::Pair(pair);
        }
        match (slot.ended, slot.failure.take()) {
            (_, Some(failure)) => Taken::Failed(failure),
            (true, None) => Taken::Ended,
            (false, None) => Taken::TimedOut,
        }
    }
}

/// The thread's side of a live source.
pub(crate) struct Producer {
    pub slot: Arc<LatestPair>,
    stop: Arc<AtomicBool>,
}

impl Producer {
    /// True when the reader has gone.
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Sleeps in short steps; false when the reader has gone meanwhile.
    pub fn pause(&self, duration: Duration) -> bool {
        let step = Duration::from_millis(20);
        let steps = duration.as_millis().div_ceil(step.as_millis());
        for _ in 0..steps {
            if self.is_stopped() {
                return false;
            }
            std::thread::sleep(step);
        }
        !self.is_stopped()
    }
}

/// A source that a thread of its own fills.
pub(crate) struct LiveSource {
    name: String,
    slot: Arc<LatestPair>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl LiveSource {
    /// Starts `work`; it returns when the source has ended, broken, or been stopped.
    pub fn start(
        name: String,
        work: impl FnOnce(&Producer) -> Result<(), SourceError> + Send + 'static,
    ) -> Result<Self, SourceError> {
        let (slot, stop) = (Arc::<LatestPair>::default(), Arc::<AtomicBool>::default());
        let producer = Producer {
            slot: Arc::clone(&slot),
            stop: Arc::clone(&stop),
        };
        let thread = std::thread::Builder::new()
            .name("camera".to_owned())
            .spawn(move || producer.slot.end(work(&producer).err()))
            .map_err(|source| SourceError::Io {
                source_name: name.clone(),
                source,
            })?;
        Ok(Self {
            name,
            slot,
            stop,
            thread: Some(thread),
        })
    }
}

impl StereoSource for LiveSource {
    fn next_pair(&mut self) -> Result<Option<Stamped<StereoPair>>, SourceError> {
        match self.slot.take(PATIENCE) {
            Taken::Pair(pair) => Ok(Some(pair)),
            Taken::Ended => Ok(None),
            Taken::Failed(failure) => Err(failure),
            Taken::TimedOut => Err(SourceError::NoFrames {
                source_name: self.name.clone(),
                waited_s: PATIENCE.as_secs_f64(),
            }),
        }
    }

    fn counters(&self) -> SourceCounters {
        self.slot.lock().counters
    }

    fn capture_clock(&self) -> CaptureClock {
        self.slot.lock().clock
    }
}

impl Drop for LiveSource {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The thread only ends; whatever it said stands in the slot.
            drop(thread.join());
        }
    }
}
