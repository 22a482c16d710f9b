//! The two clocks: the autopilot's time since boot, and our service clock.

use serde::{Deserialize, Serialize};
use std::ops::{Add, Sub};

pub use jiff::SignedDuration;

/// A signed duration from seconds; not-a-number and overflow become zero.
#[must_use]
pub fn seconds(seconds: f64) -> SignedDuration {
    SignedDuration::try_from_secs_f64(seconds).unwrap_or(SignedDuration::ZERO)
}

macro_rules! clock {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
        )]
        #[serde(transparent)]
        pub struct $name(i64);
        impl Add<SignedDuration> for $name {
            type Output = Self;
            fn add(self, by: SignedDuration) -> Self {
                Self(self.0.saturating_add(nanoseconds(by)))
            }
        }
        impl Sub<SignedDuration> for $name {
            type Output = Self;
            fn sub(self, by: SignedDuration) -> Self {
                Self(self.0.saturating_sub(nanoseconds(by)))
            }
        }
        impl Sub for $name {
            type Output = SignedDuration;
            fn sub(self, earlier: Self) -> SignedDuration {
                SignedDuration::from_nanos(self.0.saturating_sub(earlier.0))
            }
        }
    };
}

fn nanoseconds(duration: SignedDuration) -> i64 {
    let clamped = duration.as_nanos().clamp(i64::MIN.into(), i64::MAX.into());
    i64::try_from(clamped).unwrap_or_default()
}

clock! {
    /// Autopilot clock: time since it booted. Restarts at zero with the autopilot.
    BootTime
}
clock! {
    /// Our clock: UTC read once at start, then carried on by the monotonic clock.
    ServiceTime
}

impl BootTime {
    /// From nanoseconds since boot.
    #[must_use]
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }
    /// From milliseconds since boot, as most MAVLink messages state it.
    #[must_use]
    pub fn from_ms(ms: u32) -> Self {
        Self(i64::from(ms) * 1_000_000)
    }
    /// From microseconds since boot; saturates.
    #[must_use]
    pub fn from_us(us: u64) -> Self {
        Self(i64::try_from(us).unwrap_or(i64::MAX).saturating_mul(1_000))
    }
    /// Nanoseconds since boot.
    #[must_use]
    pub const fn ns(self) -> i64 {
        self.0
    }
}

impl ServiceTime {
    /// From nanoseconds since 1970-01-01 UTC.
    #[must_use]
    pub const fn from_unix_ns(ns: i64) -> Self {
        Self(ns)
    }
    /// Nanoseconds since 1970-01-01 UTC.
    #[must_use]
    pub const fn unix_ns(self) -> i64 {
        self.0
    }
    /// Nanoseconds since 1970-01-01 UTC as recordings store them; times before 1970 become zero.
    #[must_use]
    pub fn unix_ns_u64(self) -> u64 {
        u64::try_from(self.0).unwrap_or(0)
    }
    /// UTC as RFC 3339 with nine decimals, such as `2026-03-01T12:00:00.000000000Z`.
    #[must_use]
    pub fn rfc3339(self) -> String {
        match jiff::Timestamp::from_nanosecond(i128::from(self.0)) {
            Ok(timestamp) => format!("{timestamp:.9}"),
            Err(_) => "1970-01-01T00:00:00.000000000Z".to_owned(),
        }
    }
    /// Reads what [`ServiceTime::rfc3339`] wrote, or any RFC 3339 time with an offset.
    #[must_use]
    pub fn from_rfc3339(text: &str) -> Option<Self> {
        let timestamp: jiff::Timestamp = text.parse().ok()?;
        i64::try_from(timestamp.as_nanosecond()).ok().map(Self)
    }
}

impl std::fmt::Display for ServiceTime {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.rfc3339())
    }
}

/// A value and the moment for which it holds. For images: mid-exposure, never arrival.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stamped<T> {
    /// When the value held.
    pub at: ServiceTime,
    /// The value.
    pub value: T,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn service_time_reads_what_it_writes_to_the_nanosecond() {
        let at = ServiceTime::from_unix_ns(1_772_366_400_123_456_789);
        assert_eq!(at.rfc3339(), "2026-03-01T12:00:00.123456789Z");
        assert_eq!(ServiceTime::from_rfc3339(&at.rfc3339()), Some(at));
    }

    #[test]
    fn a_fraction_of_a_second_keeps_its_sign() {
        assert_eq!(seconds(-0.25).as_nanos(), -250_000_000);
        assert_eq!(
            BootTime::from_ms(1) + seconds(-0.0005),
            BootTime::from_us(500)
        );
    }
}
