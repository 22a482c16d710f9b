//! How fast datagrams may follow each other, and how long an answer takes.

use emberfix_frames::{ServiceTime, SignedDuration, seconds};

/// The way there and back (RFC 6298's estimator, without its doubling), and how much is lost.
#[derive(Debug, Default)]
pub(super) struct RoundTrip {
    smoothed_s: Option<f64>,
    deviation_s: f64,
    least_s: Option<f64>,
    loss: f64,
}

/// Weight of a new sample in the smoothed time, and in its deviation.
const GAINS: (f64, f64) = (0.125, 0.25);
/// Weight of a new answer in the share that is lost.
const LOSS_GAIN: f64 = 0.1;

impl RoundTrip {
    pub fn note(&mut self, took: SignedDuration) {
        let took_s = took.as_secs_f64().max(0.0);
        self.least_s = Some(self.least_s.map_or(took_s, |least| least.min(took_s)));
        let (gain, deviation_gain) = GAINS;
        self.smoothed_s = Some(match self.smoothed_s {
            None => {
                self.deviation_s = took_s / 2.0;
                took_s
            }
            Some(smoothed) => {
                let error = took_s - smoothed;
                self.deviation_s += deviation_gain * (error.abs() - self.deviation_s);
                smoothed + gain * error
            }
        });
    }

    /// An answer came to the nth sending; the ones before were lost, they or their answers.
    pub fn note_answer(&mut self, attempt: u32) {
        let lost = 1.0 - 1.0 / f64::from(attempt.max(1));
        self.loss += LOSS_GAIN * (lost - self.loss);
    }

    pub fn loss(&self) -> f64 {
        self.loss
    }

    pub fn smoothed(&self) -> Option<SignedDuration> {
        self.smoothed_s.map(seconds)
    }

    /// After which an answer is not to be expected any more.
    pub fn timeout(&self) -> Option<SignedDuration> {
        self.smoothed_s
            .map(|smoothed| seconds(smoothed + 2.0 * self.deviation_s))
    }

    /// Something queues: the way takes much longer than it can.
    fn is_queueing(&self) -> bool {
        let (Some(smoothed), Some(least)) = (self.smoothed_s, self.least_s) else {
            return false;
        };
        smoothed > 2.0 * least + QUEUE_S
    }
}

/// Longer than any good radio's own changes.
const QUEUE_S: f64 = 0.15;

/// A token bucket whose rate falls while something queues, and rises again.
#[derive(Debug)]
pub(super) struct Pace {
    bytes_per_s: f64,
    tokens: f64,
    filled_at: Option<ServiceTime>,
    changed_at: Option<ServiceTime>,
}

/// Bytes per second, at most and at least.
const RATES: (f64, f64) = (250_000.0, 600.0);
/// Bytes that may go at once after a pause.
const BURST: f64 = 32_768.0;
/// Between two changes of the rate.
const STEADY: SignedDuration = SignedDuration::from_millis(200);
/// By which the rate changes, up and down.
const STEPS: (f64, f64) = (1.25, 0.7);

impl Default for Pace {
    fn default() -> Self {
        Self {
            bytes_per_s: RATES.0,
            tokens: BURST,
            filled_at: None,
            changed_at: None,
        }
    }
}

impl Pace {
    /// Whether anything may go: debts are paid first, so that a large datagram goes too.
    pub fn is_open(&mut self, now: ServiceTime) -> bool {
        let since_s = self
            .filled_at
            .map_or(0.0, |filled| (now - filled).as_secs_f64());
        let room = BURST.min(self.bytes_per_s);
        self.tokens = (self.tokens + since_s.max(0.0) * self.bytes_per_s).min(room);
        self.filled_at = Some(now);
        self.tokens > 0.0
    }

    /// Whether so much may go and something urgent right behind it: what is not urgent makes no debts.
    pub fn affords(&self, bytes: usize) -> bool {
        self.tokens > bytes as f64
    }

    pub fn spend(&mut self, bytes: usize, _now: ServiceTime) {
        self.tokens -= bytes as f64;
    }

    /// A way that has just shown to be as slow as ways get.
    #[cfg(test)]
    pub fn slowest() -> Self {
        Self {
            bytes_per_s: RATES.1,
            tokens: RATES.1,
            ..Self::default()
        }
    }

    /// An answer came: is there a queue?
    pub fn note(&mut self, round_trip: &RoundTrip, now: ServiceTime) {
        if self
            .changed_at
            .is_some_and(|changed| now - changed < STEADY)
        {
            return;
        }
        self.changed_at = Some(now);
        let (up, down) = STEPS;
        let step = if round_trip.is_queueing() { down } else { up };
        let (most, least) = RATES;
        self.bytes_per_s = (self.bytes_per_s * step).clamp(least, most);
    }
}
