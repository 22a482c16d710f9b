//! How fast frames may follow each other.

use emberfix_frames::{ServiceTime, SignedDuration};

/// How fast frames may follow each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pacing {
    /// Least time between two frames.
    pub gap: SignedDuration,
    /// Sustained bytes per second, frame overhead included.
    pub bytes_per_s: f64,
    /// Bytes that may go at once after a pause.
    pub burst_bytes: f64,
}

impl Default for Pacing {
    fn default() -> Self {
        Self {
            gap: SignedDuration::from_millis(50),
            bytes_per_s: 120.0,
            burst_bytes: 240.0,
        }
    }
}

/// A token bucket and a least gap.
#[derive(Debug)]
pub(super) struct Pace {
    pacing: Pacing,
    /// Of the sustained rate, in 0..1: what a radio's buffer leaves to us.
    share: f64,
    heeded: Option<ServiceTime>,
    tokens: f64,
    filled_at: Option<ServiceTime>,
    last_frame: Option<ServiceTime>,
}

impl Pace {
    pub fn new(pacing: Pacing) -> Self {
        Self {
            pacing,
            share: 1.0,
            heeded: None,
            tokens: pacing.burst_bytes,
            filled_at: None,
            last_frame: None,
        }
    }

    pub fn is_open(&self, now: ServiceTime) -> bool {
        self.last_frame
            .is_none_or(|last| now - last >= self.pacing.gap)
    }

    /// A radio told how much of its buffer is free; true when that slows us.
    pub fn heed(&mut self, free_percent: u8, now: ServiceTime) -> bool {
        let step = match free_percent {
            0..20 => 0.5,
            20..50 => 0.8,
            50..90 => 1.0,
            _ => 1.25,
        };
        self.heeded = Some(now);
        self.share = (self.share * step).clamp(LEAST_SHARE, 1.0);
        step < 1.0
    }

    /// A radio that says nothing any more holds nothing up.
    pub fn share(&self, now: ServiceTime) -> f64 {
        let fresh = self
            .heeded
            .is_some_and(|heeded| now - heeded < RADIO_SILENCE);
        if fresh { self.share } else { 1.0 }
    }

    /// False, and nothing spent, when there is no room for a frame of this length yet.
    pub fn spend(&mut self, frame_len: usize, now: ServiceTime) -> bool {
        let since_s = self
            .filled_at
            .map_or(0.0, |filled| (now - filled).as_secs_f64());
        let gained = since_s.max(0.0) * self.pacing.bytes_per_s * self.share(now);
        self.tokens = (self.tokens + gained).min(self.pacing.burst_bytes);
        self.filled_at = Some(now);
        let needed = frame_len as f64;
        if self.tokens < needed {
            return false;
        }
        self.tokens -= needed;
        self.last_frame = Some(now);
        true
    }
}

/// Least share of the sustained rate: one alarm in five seconds still goes, whatever a radio says.
const LEAST_SHARE: f64 = 0.1;
/// Radios tell their state at 1 Hz.
const RADIO_SILENCE: SignedDuration = SignedDuration::from_secs(10);
