//! A bounded, ordered history of samples on the autopilot's clock.

use emberfix_frames::{BootTime, SignedDuration};
use std::collections::VecDeque;

/// The last samples, ordered by boot time. Bound: 1000; the oldest go first. A sample that
/// comes late is sorted in; one that is older than all that is kept is dropped.
#[derive(Debug, Clone)]
pub struct History<T> {
    samples: VecDeque<(BootTime, T)>,
}

/// 10 s at 100 Hz.
const CAPACITY: usize = 1000;

/// The sample before a moment, and the one after it if it has come.
#[derive(Debug, Clone, Copy)]
pub struct Bracket<T> {
    /// The moment that was asked for.
    pub at: BootTime,
    /// Latest sample not after the moment.
    pub earlier: (BootTime, T),
    /// Earliest sample after the moment.
    pub later: Option<(BootTime, T)>,
}

impl<T: Copy> History<T> {
    /// Empty.
    #[must_use]
    pub fn new() -> Self {
        Self {
            samples: VecDeque::new(),
        }
    }

    /// Takes a sample in; a second sample of the same moment is dropped.
    pub fn push(&mut self, at: BootTime, value: T) {
        let index = self.samples.partition_point(|(when, _)| *when < at);
        if self.samples.get(index).is_some_and(|(when, _)| *when == at) {
            return;
        }
        self.samples.insert(index, (at, value));
        if self.samples.len() > CAPACITY {
            self.samples.pop_front();
        }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.samples.clear();
    }

    /// Time of the newest sample.
    #[must_use]
    pub fn latest(&self) -> Option<BootTime> {
        self.samples.back().map(|(at, _)| *at)
    }

    /// The samples around a moment; `None` when all samples are after it, or there are none.
    #[must_use]
    pub fn bracket(&self, at: BootTime) -> Option<Bracket<T>> {
        let after = self.samples.partition_point(|(when, _)| *when <= at);
        let earlier = *self.samples.get(after.checked_sub(1)?)?;
        Some(Bracket {
            at,
            earlier,
            later: self.samples.get(after).copied(),
        })
    }

    /// How far the nearest sample is from a moment, if there is one.
    #[must_use]
    pub fn nearest_distance(&self, at: BootTime) -> Option<SignedDuration> {
        self.samples
            .iter()
            .map(|(when, _)| (*when - at).abs())
            .min()
    }
}

impl<T: Copy> Default for History<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Copy> Bracket<T> {
    /// 0 at the earlier sample, 1 at the later; 0 without a later one.
    #[must_use]
    pub fn share(&self) -> f64 {
        let span = self.span_s();
        if self.later.is_some() && span > 0.0 {
            self.age_s() / span
        } else {
            0.0
        }
    }

    /// Seconds from the earlier sample to the moment.
    #[must_use]
    pub fn age_s(&self) -> f64 {
        (self.at - self.earlier.0).as_secs_f64()
    }

    /// Seconds between the two samples; twice the age without a later one.
    #[must_use]
    pub fn span_s(&self) -> f64 {
        match self.later {
            Some((later, _)) => (later - self.earlier.0).as_secs_f64(),
            None => 2.0 * self.age_s(),
        }
    }

    /// Time between the samples, or since the last one.
    #[must_use]
    pub fn gap(&self) -> SignedDuration {
        match self.later {
            Some((later, _)) => later - self.earlier.0,
            None => self.at - self.earlier.0,
        }
    }

    /// Time from the moment to the nearer sample.
    #[must_use]
    pub fn distance(&self) -> SignedDuration {
        let before = self.at - self.earlier.0;
        self.later
            .map_or(before, |(later, _)| before.min(later - self.at))
    }

    /// The sample nearer to the moment.
    #[must_use]
    pub fn nearest(&self) -> T {
        match self.later {
            Some((_, later)) if self.share() > 0.5 => later,
            _ => self.earlier.1,
        }
    }
}
