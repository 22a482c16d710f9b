//! For and against a fire's being there, as log-odds over looks. Whether it is a fire at all is [`super::event`]'s.

use emberfix_frames::ServiceTime;
use std::f64::consts::TAU;

/// Evidence for one fire.
#[derive(Debug, Clone, PartialEq)]
pub struct Evidence {
    log_odds: f64,
    hits: u32,
    highest: f64,
    last_look: Option<ServiceTime>,
    seen_from: Sectors,
    /// What misses from sides that it was never seen from have taken so far, per side.
    unseen_from: [f64; SECTORS],
}

/// Sides of a fire, by the azimuth that it is looked at from, as a bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Sectors(u32);

/// 15 degrees each.
const SECTORS: usize = 24;

/// What a sighting adds at least, and per unit of score. A detector that sees three fires in four
/// and a false box in a tenth of all looks has ln(0.75 / 0.1) = 2.0 for a sighting of full score.
const HIT: f64 = 0.6;
const HIT_PER_SCORE: f64 = 1.4;
/// What a look without a sighting takes: ln(0.25 / 0.9) = -1.3, less because misses come in runs.
const MISS: f64 = -0.8;
/// Looks closer together than this see the same flame and the same light: they count in part, seconds.
const LOOK_S: f64 = 0.3;
/// What misses from one side can take at most, while the fire was never seen from there: something
/// may stand between in one case in eight.
const HIDDEN: f64 = -2.0;
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
            last_look: None,
            seen_from: Sectors::default(),
            unseen_from: [0.0; SECTORS],
        }
    }
}

impl Evidence {
    /// A look that saw it, from this azimuth (radians, of the fire as seen from the camera).
    pub fn hit(&mut self, at: ServiceTime, azimuth_rad: f64, score: f64) {
        self.hits = self.hits.saturating_add(1);
        self.last_look = Some(at);
        // The neighbours too: what hides a fire is wider than a step of the way around it.
        let sector = sector(azimuth_rad);
        for side in [sector + SECTORS - 1, sector, sector + 1] {
            self.seen_from.add(side % SECTORS);
        }
        self.add(HIT + HIT_PER_SCORE * score.clamp(0.0, 1.0));
    }

    /// A look that should have seen it and did not. From a side that it was never seen from,
    /// something may hide it: that side takes so much and no more. Says what share of a whole look it was.
    pub fn miss(&mut self, at: ServiceTime, azimuth_rad: f64) -> f64 {
        let since_s = self
            .last_look
            .map_or(LOOK_S, |last| (at - last).as_secs_f64());
        self.last_look = Some(at);
        let mut amount = MISS * (since_s / LOOK_S).clamp(0.0, 1.0);
        let sector = sector(azimuth_rad);
        if !self.seen_from.has(sector) {
            amount = amount.max(HIDDEN - self.unseen_from[sector]).min(0.0);
            self.unseen_from[sector] += amount;
        }
        self.add(amount);
        amount / MISS
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

    /// Probability that it is there.
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

impl Sectors {
    fn add(&mut self, sector: usize) {
        self.0 |= 1 << sector;
    }
    fn has(self, sector: usize) -> bool {
        self.0 & (1 << sector) != 0
    }
}

fn sector(azimuth_rad: f64) -> usize {
    let turn = azimuth_rad.rem_euclid(TAU) / TAU;
    ((turn * SECTORS as f64) as usize).min(SECTORS - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_frames::SignedDuration;

    fn at(look: i64) -> ServiceTime {
        ServiceTime::from_unix_ns(0) + SignedDuration::from_millis(300 * look)
    }

    fn seen() -> Evidence {
        let mut evidence = Evidence::default();
        (0..6).for_each(|look| evidence.hit(at(look), 0.0, 0.8));
        evidence
    }

    #[test]
    fn one_look_never_convinces_and_a_run_of_misses_refutes() {
        let mut evidence = Evidence::default();
        evidence.hit(at(0), 0.0, 1.0);
        assert!(!evidence.is_convincing());
        let mut evidence = seen();
        assert!(evidence.is_convincing());
        for look in 6..46 {
            evidence.miss(at(look), 0.0);
        }
        assert!(evidence.is_refuted() && evidence.was_convincing());
    }

    #[test]
    fn a_tree_between_does_not_put_a_fire_out_but_looks_from_all_sides_do() {
        let mut evidence = seen();
        for look in 6..200 {
            evidence.miss(at(look), 2.0);
        }
        assert!(evidence.is_convincing(), "hidden from one side");
        for look in 200..400 {
            evidence.miss(at(look), 2.0 + 0.02 * (look - 200) as f64);
        }
        assert!(evidence.is_refuted(), "not there from any side");
    }

    #[test]
    fn many_looks_in_a_moment_are_no_more_evidence_than_one() {
        let (mut quick, mut slow) = (seen(), seen());
        slow.miss(at(6), 0.0);
        for look in 1..=10 {
            quick.miss(at(5) + SignedDuration::from_millis(30 * look), 0.0);
        }
        assert!((quick.probability() - slow.probability()).abs() < 1e-9);
    }
}
