//! How likely it is that a fire is one, by all looks at it together: frame scores, persistence, change of
//! shape, flicker.
//!
//! A logistic model over [`FEATURES`] numbers that are kept up from look to look. Looks at one thing are no
//! independent witnesses (a red roof that looks like fire once does so again), so they are not multiplied:
//! the model weighs what they come to. Its weights are fitted on simulated flights
//! (`emberfix eval detector MODEL --part events --fit`) and checked on others (without `--fit`), which prints
//! how often what is said is so.
//!
//! What tells most is the score, and whether the picture changes its shape ([`Patch::change`]): of things up
//! to 30 px, flames change by 0.06 to 0.19 from look to look, lanterns, cars, bushes and roofs by 0.01 to
//! 0.04. A larger box is cut less steadily, and asks for a better score instead; a second look at each box
//! (`detect::second_look`) tells lamps, cars and trees from flames. Growth was tried and left
//! out: over the half minute that a fire is looked at, it told flames from other things no better than chance.

use crate::assess::patch::Patch;
use emberfix_frames::ServiceTime;

/// What one sighting adds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look<'a> {
    /// Mid-exposure.
    pub at: ServiceTime,
    /// Detector score, 0..1.
    pub score: f64,
    /// Log-odds by a second look, where there was one.
    pub second_look: Option<f64>,
    /// Smoke, not flame.
    pub is_smoke: bool,
    /// What it looks like, where its picture is at hand.
    pub patch: Option<&'a Patch>,
    /// Whether that is to be compared with the one before.
    pub is_compared: bool,
    /// Light as in [`Sighting::glow`](crate::locate::Sighting::glow), where there is a measure of it.
    pub glow: Option<f64>,
    /// From the camera, metres.
    pub range_m: f64,
    /// Of its box, square pixels.
    pub area_px2: f64,
}

/// Numbers that the model weighs, the constant among them.
pub const FEATURES: usize = 8;
/// Their names, in order.
pub const NAMES: [&str; FEATURES] = [
    "constant",
    "score",
    "persistence",
    "change of shape",
    "flicker",
    "smoke",
    "score of a large box",
    "second look",
];

/// Fitted, outside this program, to the same features of 110 flights of seed 102 at threshold 0.35, with the ridge of
/// `--fit`: where boxes were looked at twice, and where not (`--no-second-look`).
const LOOKED_AT_TWICE: [f64; FEATURES] = [-3.781, 1.631, -0.206, 5.359, 2.454, 3.996, 3.726, 2.070];
const LOOKED_AT_ONCE: [f64; FEATURES] = [-2.768, 5.853, -0.034, 4.513, 1.952, 3.204, -0.292, 0.0];

/// Looks further apart than this say nothing about flicker: the view has changed too, seconds.
const GAP_S: f64 = 1.5;
/// Changes from look to look before they are weighed.
const LEAST_CHANGES: u32 = 3;
/// Scores beyond are no surer.
const SCORES: (f64, f64) = (0.02, 0.98);
/// Log-odds of a second look beyond are no surer.
const SUREST: f64 = 5.0;
/// Change of a picture in the middle between flames and what is rigid.
const USUAL_CHANGE: f64 = 0.045;
/// A change below is noise, one above is no better sign: the box jumped.
const CHANGES: (f64, f64) = (0.02, 0.06);
/// The same of the logarithm of the light.
const USUAL_FLICKER: f64 = 0.15;
const LEAST_FLICKER: f64 = 0.01;
const MOST_FLICKER: f64 = 1.0;
/// Logarithm of a usual box's side, pixels.
const USUAL_SIDE: f64 = 3.2;
/// Smaller or larger boxes than by this were too few to learn from.
const MOST_SIDE: f64 = 1.0;

/// Running sums over the looks at one fire.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Event {
    hits: f64,
    misses: f64,
    scores: f64,
    sides: f64,
    is_smoke: bool,
    second_looks: Mean,
    last_patch: Option<(ServiceTime, Patch)>,
    shape: Mean,
    last_light: Option<(ServiceTime, f64)>,
    light: Mean,
}

impl Event {
    /// A look that saw it.
    pub fn saw(&mut self, look: &Look<'_>) {
        self.hits += 1.0;
        let score = look.score.clamp(SCORES.0, SCORES.1);
        self.scores += (score / (1.0 - score)).ln();
        let side = look.area_px2.max(1.0).ln() / 2.0 - USUAL_SIDE;
        self.sides += side.clamp(-MOST_SIDE, MOST_SIDE);
        self.is_smoke = look.is_smoke;
        if let Some(log_odds) = look.second_look {
            self.second_looks.add(log_odds.clamp(-SUREST, SUREST));
        }
        self.note_shape(look);
        self.note_light(look);
    }

    /// A look that should have seen it and did not, as a share of a whole look.
    pub fn missed(&mut self, share: f64) {
        self.misses += share;
    }

    fn note_shape(&mut self, look: &Look<'_>) {
        let Some(patch) = look.patch else { return };
        if let Some((before, old)) = &self.last_patch
            && look.is_compared
            && is_soon(*before, look.at)
            && let Some(change) = patch.change(old)
        {
            self.shape
                .add((change.clamp(CHANGES.0, CHANGES.1) / USUAL_CHANGE).ln());
        }
        self.last_patch = Some((look.at, *patch));
    }

    fn note_light(&mut self, look: &Look<'_>) {
        let Some(glow) = look.glow.filter(|glow| *glow > 0.0) else {
            return;
        };
        let light = (glow * look.range_m.powi(2)).ln();
        if let Some((before, old)) = self.last_light
            && is_soon(before, look.at)
        {
            self.light.add((light - old).abs().min(MOST_FLICKER));
        }
        self.last_light = Some((look.at, light));
    }

    /// What the model weighs; what is not known is 0, which is what is usual.
    #[must_use]
    pub fn features(&self) -> [f64; FEATURES] {
        let of_looks = |sum: f64| sum / self.hits.max(1.0);
        let flicker = self.light.mean(LEAST_CHANGES);
        let flicker = flicker.map_or(0.0, |mean| ((LEAST_FLICKER + mean) / USUAL_FLICKER).ln());
        let score = of_looks(self.scores);
        [
            1.0,
            score,
            ((self.hits + 1.0) / (self.misses + 1.0)).ln(),
            self.shape.mean(LEAST_CHANGES).unwrap_or(0.0),
            flicker,
            f64::from(u8::from(self.is_smoke)),
            score * of_looks(self.sides),
            self.second_looks.mean(1).unwrap_or(0.0),
        ]
    }

    /// Probability that it is real.
    #[must_use]
    pub fn probability(&self) -> f64 {
        let weights = match self.second_looks.mean(1) {
            Some(_) => LOOKED_AT_TWICE,
            None => LOOKED_AT_ONCE,
        };
        let terms = self.features().into_iter().zip(weights);
        let log_odds: f64 = terms.map(|(feature, weight)| feature * weight).sum();
        1.0 / (1.0 + (-log_odds).exp())
    }
}

fn is_soon(before: ServiceTime, at: ServiceTime) -> bool {
    (at - before).as_secs_f64() < GAP_S
}

/// Of what was seen in some looks.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Mean {
    count: u32,
    sum: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.count = self.count.saturating_add(1);
        self.sum += value;
    }

    /// `None` of fewer than so many.
    fn mean(&self, least: u32) -> Option<f64> {
        (self.count >= least).then(|| self.sum / f64::from(self.count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::assess::patch::SIDE;
    use emberfix_frames::SignedDuration;

    /// A blob; one that flickers has another shape, light and place in each look.
    fn picture(turn: f64) -> Patch {
        let (x, y) = (
            12.0 + 4.0 * (1.9 * turn).sin(),
            12.0 + 5.0 * (2.3 * turn).sin(),
        );
        let radius = 3.0 + 1.5 * (3.1 * turn).sin();
        let level = |index: usize| {
            let (column, row) = ((index % SIDE) as f64, (index / SIDE) as f64);
            let squared = ((column - x).powi(2) + 0.6 * (row - y).powi(2)) / (radius * radius);
            (40.0 + 180.0 * (-squared).exp()) as u8
        };
        Patch(std::array::from_fn(level))
    }

    fn see(event: &mut Event, number: i64, score: f64, flickers: bool) {
        let turn = if flickers { number as f64 } else { 0.0 };
        event.saw(&Look {
            at: ServiceTime::from_unix_ns(0) + SignedDuration::from_millis(400 * number),
            score,
            second_look: None,
            is_smoke: false,
            patch: Some(&picture(turn)),
            is_compared: true,
            glow: Some(5000.0 * (1.0 + 0.3 * (2.7 * turn).sin())),
            range_m: 30.0,
            area_px2: 600.0,
        });
    }

    fn after(looks: i64, score: f64, flickers: bool) -> f64 {
        let mut event = Event::default();
        (0..looks).for_each(|number| see(&mut event, number, score, flickers));
        event.probability()
    }

    #[test]
    fn what_changes_its_shape_is_a_fire_and_what_never_does_is_none() {
        assert!(after(16, 0.7, true) > 0.9, "{}", after(16, 0.7, true));
        assert!(after(16, 0.45, false) < 0.2, "{}", after(16, 0.45, false));
        assert!(after(16, 0.7, true) > after(16, 0.7, false));
        assert!(after(16, 0.7, true) > after(16, 0.4, true));
    }

    #[test]
    fn looks_far_apart_say_nothing_of_flicker() {
        let mut event = Event::default();
        (0..16).for_each(|number| see(&mut event, 5 * number, 0.7, true));
        let [_, _, _, shape, flicker, ..] = event.features();
        assert_eq!((shape, flicker), (0.0, 0.0));
    }
}
