//! Autopilot clock to service clock, from TIMESYNC exchanges; the only converter between the two.

use crate::{BootTime, ServiceTime, SignedDuration};
use std::collections::VecDeque;

/// One answered TIMESYNC request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeSyncSample {
    /// Our clock when we asked (`ts1`).
    pub asked: ServiceTime,
    /// The autopilot's clock when it answered (`tc1`).
    pub remote: BootTime,
    /// Our clock when the answer came.
    pub answered: ServiceTime,
}

/// How the conversion was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SyncQuality {
    /// Nothing to convert with.
    None,
    /// Only arrival times: the transport delay is unknown, the result is late by it.
    ArrivalOnly,
    /// Two-way exchanges, still few.
    Converging,
    /// Two-way exchanges, enough of them.
    Converged,
}

/// Offset between the clocks, kept from the quickest of the recent exchanges.
///
/// The error of one exchange is bounded by half its round trip (the two ways need not take equally
/// long), so the quickest exchange of a window is the best one; slower ones only dilute it. The
/// window is short against crystal drift (20 ppm over 10 s: 0.2 ms).
#[derive(Debug, Clone, Default)]
pub struct TimeSync {
    exchanges: VecDeque<Exchange>,
    arrivals: VecDeque<i64>,
    refused: u64,
}

#[derive(Debug, Clone, Copy)]
struct Exchange {
    offset_ns: i64,
    round_trip_ns: i64,
}

/// Exchanges remembered: 10 s at 10 Hz.
const WINDOW: usize = 100;
/// Exchanges before the offset is called converged.
const ENOUGH: usize = 10;
/// Round trips beyond this say nothing about an offset in milliseconds.
const MAX_ROUND_TRIP_NS: i64 = 200_000_000;
/// A jump of the offset beyond this is a new boot of the autopilot, not jitter.
const NEW_EPOCH_NS: i64 = 1_000_000_000;

impl TimeSync {
    /// Nothing known yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes one exchange in. False when it was refused (negative or overlong round trip).
    pub fn add(&mut self, sample: TimeSyncSample) -> bool {
        let round_trip_ns = sample
            .answered
            .unix_ns()
            .saturating_sub(sample.asked.unix_ns());
        if !(0..=MAX_ROUND_TRIP_NS).contains(&round_trip_ns) {
            self.refused += 1;
            return false;
        }
        let middle = sample.asked.unix_ns() + round_trip_ns / 2;
        let offset_ns = middle.saturating_sub(sample.remote.ns());
        let jumped = |e: &Exchange| e.offset_ns.abs_diff(offset_ns) > NEW_EPOCH_NS.unsigned_abs();
        if self.exchanges.back().is_some_and(jumped) {
            self.restart();
        }
        push_bounded(
            &mut self.exchanges,
            Exchange {
                offset_ns,
                round_trip_ns,
            },
        );
        true
    }

    /// Takes the arrival of any message with a boot time in, for links that never answer TIMESYNC.
    pub fn add_arrival(&mut self, boot: BootTime, arrived: ServiceTime) {
        let lag = arrived.unix_ns().saturating_sub(boot.ns());
        let jumped = |last: &i64| last.abs_diff(lag) > NEW_EPOCH_NS.unsigned_abs();
        if self.arrivals.back().is_some_and(jumped) {
            self.restart();
        }
        push_bounded(&mut self.arrivals, lag);
    }

    /// Forgets the old relation: the autopilot booted anew.
    pub fn restart(&mut self) {
        self.exchanges.clear();
        self.arrivals.clear();
    }

    /// Service clock minus boot clock, if known.
    #[must_use]
    pub fn offset(&self) -> Option<SignedDuration> {
        let quickest = self.quickest().map(|exchange| exchange.offset_ns);
        quickest
            .or_else(|| self.arrivals.iter().min().copied())
            .map(SignedDuration::from_nanos)
    }

    /// One sigma of the offset in seconds: a third of the bound (half the quickest round trip), or
    /// the arrival jitter.
    #[must_use]
    pub fn sigma_s(&self) -> Option<f64> {
        if let Some(exchange) = self.quickest() {
            return Some((exchange.round_trip_ns as f64 * 1e-9 / 6.0).max(1e-5));
        }
        let (least, most) = (self.arrivals.iter().min()?, self.arrivals.iter().max()?);
        Some(((most - least) as f64 * 1e-9 / 3.0).max(0.02))
    }

    /// How far the result can be trusted.
    #[must_use]
    pub fn quality(&self) -> SyncQuality {
        match (self.exchanges.len(), self.arrivals.is_empty()) {
            (0, true) => SyncQuality::None,
            (0, false) => SyncQuality::ArrivalOnly,
            (1..ENOUGH, _) => SyncQuality::Converging,
            _ => SyncQuality::Converged,
        }
    }

    /// Exchanges that were refused so far.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// The autopilot's time on our clock.
    #[must_use]
    pub fn to_service(&self, boot: BootTime) -> Option<ServiceTime> {
        let offset = self.offset()?;
        Some(ServiceTime::from_unix_ns(boot.ns()) + offset)
    }

    /// Our time on the autopilot's clock.
    #[must_use]
    pub fn to_boot(&self, service: ServiceTime) -> Option<BootTime> {
        let offset = self.offset()?;
        Some(BootTime::from_ns((service - offset).unix_ns()))
    }

    fn quickest(&self) -> Option<&Exchange> {
        self.exchanges
            .iter()
            .min_by_key(|exchange| exchange.round_trip_ns)
    }
}

fn push_bounded<T>(queue: &mut VecDeque<T>, value: T) {
    if queue.len() == WINDOW {
        queue.pop_front();
    }
    queue.push_back(value);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exchange(asked_ms: i64, out_ms: i64, back_ms: i64) -> TimeSyncSample {
        let true_offset_ms = 1_000_000;
        let asked = asked_ms * 1_000_000;
        TimeSyncSample {
            asked: ServiceTime::from_unix_ns(asked),
            remote: BootTime::from_ns((asked_ms + out_ms - true_offset_ms) * 1_000_000),
            answered: ServiceTime::from_unix_ns(asked + (out_ms + back_ms) * 1_000_000),
        }
    }

    #[test]
    fn the_quickest_exchange_wins_over_asymmetric_ones() {
        let mut sync = TimeSync::new();
        for i in 0..20 {
            assert!(sync.add(exchange(
                2_000_000 + 100 * i,
                2,
                if i == 7 { 2 } else { 40 }
            )));
        }
        assert_eq!(sync.offset(), Some(SignedDuration::from_millis(1_000_000)));
        assert_eq!(sync.quality(), SyncQuality::Converged);
        assert!(sync.sigma_s().unwrap() < 1e-3);
    }

    #[test]
    fn impossible_round_trips_are_refused_and_counted() {
        let mut sync = TimeSync::new();
        assert!(!sync.add(exchange(5, -3, 1)));
        assert!(!sync.add(exchange(5, 300, 1)));
        assert_eq!((sync.refused(), sync.quality()), (2, SyncQuality::None));
        assert_eq!(sync.to_service(BootTime::from_ms(1)), None);
    }

    #[test]
    fn a_reboot_starts_a_new_epoch() {
        let mut sync = TimeSync::new();
        sync.add(exchange(2_000_000, 1, 1));
        let mut after = exchange(2_060_000, 1, 1);
        after.remote = BootTime::from_ms(500);
        sync.add(after);
        let service = sync.to_service(BootTime::from_ms(500)).unwrap();
        assert_eq!(service, ServiceTime::from_unix_ns(2_060_001 * 1_000_000));
    }
}
