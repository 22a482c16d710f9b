//! For and against a fire's being real, as log-odds over looks.

/// Evidence for one fire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evidence {
    log_odds: f64,
    hits: u32,
    highest: f64,
}

/// What a sighting adds at least, and per unit of score. A detector that sees three fires in four
/// and a false box in a tenth of all looks has ln(0.75 / 0.1) = 2.0 for a sighting of full score.
const HIT: f64 = 0.6;
const HIT_PER_SCORE: f64 = 1.4;
/// What a look without a sighting takes: ln(0.25 / 0.9) = -1.3, less because misses come in runs.
const MISS: f64 = -0.8;
/// Bounds: no amount of old evidence outweighs a long run of new looks.
const LOWEST: f64 = -3.0;
const HIGHEST: f64 = 6.0;
/// 95 % on even prior odds.
const CONVINCING: f64 = 3.0;
/// 10 %.
const REFUTED: f64 = -2.2;

impl Default for Evidence {
    fn default() -> Self {
        Self {
            log_odds: 0.0,
            hits: 0,
            highest: 0.0,
        }
    }
}

impl Evidence {
    /// A look that saw it.
    pub fn hit(&mut self, score: f64) {
        self.hits = self.hits.saturating_add(1);
        self.add(HIT + HIT_PER_SCORE * score.clamp(0.0, 1.0));
    }

    /// A look that should have seen it and did not.
    pub fn miss(&mut self) {
        self.add(MISS);
    }

    fn add(&mut self, amount: f64) {
        self.log_odds = (self.log_odds + amount).clamp(LOWEST, HIGHEST);
        self.highest = self.highest.max(self.log_odds);
    }

    /// Sightings so far.
    #[must_use]
    pub fn hits(&self) -> u32 {
        self.hits
    }

    /// Probability that it is real.
    #[must_use]
    pub fn probability(&self) -> f64 {
        1.0 / (1.0 + (-self.log_odds).exp())
    }

    /// Enough to alarm.
    #[must_use]
    pub fn is_convincing(&self) -> bool {
        self.log_odds >= CONVINCING
    }

    /// Was enough to alarm once.
    #[must_use]
    pub fn was_convincing(&self) -> bool {
        self.highest >= CONVINCING
    }

    /// Looked for and not there.
    #[must_use]
    pub fn is_refuted(&self) -> bool {
        self.log_odds <= REFUTED
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_look_never_convinces_and_a_run_of_misses_refutes() {
        let mut evidence = Evidence::default();
        evidence.hit(1.0);
        assert!(!evidence.is_convincing());
        for _ in 0..3 {
            evidence.hit(0.8);
        }
        assert!(evidence.is_convincing());
        for _ in 0..40 {
            evidence.miss();
        }
        assert!(evidence.is_refuted() && evidence.was_convincing());
    }
}
