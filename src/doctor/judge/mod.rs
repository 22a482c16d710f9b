//! From what was seen to what it means. Pure: no I/O, no clock.

pub mod autopilot;
pub mod camera;
pub mod computer;
pub mod ground;
pub mod mission;
pub mod model;
pub mod rig;

use super::Verdict;

/// Limits of a number that should be large.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct AtLeast {
    /// From here on all is well.
    pub good: f64,
    /// Below this it can't work.
    pub usable: f64,
}

impl AtLeast {
    pub fn judge(self, value: f64) -> Verdict {
        if value >= self.good {
            Verdict::Pass
        } else if value >= self.usable {
            Verdict::Warn
        } else {
            Verdict::Fail
        }
    }
}

/// Limits of a number that should be small.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct AtMost {
    /// Up to here all is well.
    pub good: f64,
    /// Above this it can't work.
    pub usable: f64,
}

impl AtMost {
    pub fn judge(self, value: f64) -> Verdict {
        if value <= self.good {
            Verdict::Pass
        } else if value <= self.usable {
            Verdict::Warn
        } else {
            Verdict::Fail
        }
    }
}

/// The middle of some values; `None` of none.
pub(crate) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}
