//! What was used, refused and lost, by name.

use serde::Serialize;
use std::collections::BTreeMap;

/// Named counts in named groups, ordered, so that two equal runs print equal bytes.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct Counters {
    groups: BTreeMap<&'static str, BTreeMap<&'static str, u64>>,
}

impl Counters {
    /// Adds one to `name` in `group`.
    pub fn add(&mut self, group: &'static str, name: &'static str) {
        let count = self
            .groups
            .entry(group)
            .or_default()
            .entry(name)
            .or_default();
        *count = count.saturating_add(1);
    }

    /// How often `name` in `group` was counted.
    #[must_use]
    pub fn get(&self, group: &str, name: &str) -> u64 {
        self.groups
            .get(group)
            .and_then(|names| names.get(name))
            .copied()
            .unwrap_or(0)
    }
}
