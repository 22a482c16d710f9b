//! What each method does with flames that are hard to range.

use super::cases::Hardness;
use super::outcome::{BEST, Bench, FULL_FRAME, NAMES, Round, Said, Verdict};
use super::stage::{RigName, Stage};
use super::stats::rms;
use super::tables::rounds;
use super::{Options, RangeEvalError, Tick};
use crate::eval::Table;
use emberfix_sim::world::World;
use std::sync::Arc;

/// One case's rounds.
pub(super) struct Suite {
    pub case: Hardness,
    pub rounds: Vec<Round>,
}

/// How one method did in one case.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Count {
    pub case: Hardness,
    pub method: &'static str,
    pub of: usize,
    pub right: usize,
    pub refused: usize,
    pub phantom_near: usize,
    pub other_wrong: usize,
    /// Root mean square of error over stated sigma, of weak disparities too.
    pub normalised_error: Option<f64>,
}

/// Runs every case on both short baselines.
pub(super) fn measure(
    world: &Arc<World>,
    options: &Options,
    tick: Tick,
) -> Result<Vec<Suite>, RangeEvalError> {
    let stages = [
        Stage::new(RigName::Ours75, world)?,
        Stage::new(RigName::Ours120, world)?,
    ];
    let benches = stages.each_ref().map(Bench::new);
    let suite = |(k, case): (usize, &Hardness)| {
        let count = match case {
            // Its figure is a share of one in a hundred.
            Hardness::SaturatedCore => 5 * options.hard_repeats(),
            _ => options.hard_repeats(),
        };
        let mut all = Vec::new();
        for (eye, bench) in benches.iter().enumerate() {
            let purpose = 0x1000 | (k as u64) << 4 | eye as u64;
            all.extend(rounds(bench, &case.recipe(), options, purpose, count / 2)?);
        }
        tick(1);
        Ok(Suite {
            case: *case,
            rounds: all,
        })
    };
    Hardness::ALL.iter().enumerate().map(suite).collect()
}

impl Suite {
    pub(super) fn counts(&self) -> Vec<Count> {
        (0..NAMES.len()).map(|method| self.count(method)).collect()
    }

    fn count(&self, method: usize) -> Count {
        let [right, refused, phantom_near, other_wrong] = Verdict::ALL.map(|verdict| {
            let is = |round: &&Round| round.said[method].verdict == verdict;
            self.rounds.iter().filter(is).count()
        });
        let said = self.rounds.iter().map(|round| &round.said[method]);
        let sigmas: Vec<f64> = said.filter_map(Said::off_sigmas).collect();
        Count {
            case: self.case,
            method: NAMES[method],
            normalised_error: rms(&sigmas),
            of: self.rounds.len(),
            right,
            refused,
            phantom_near,
            other_wrong,
        }
    }

    /// Rounds in which the default does not call a phantom, of how many, in percent.
    pub(super) fn phantoms_rejected_percent(&self) -> Option<f64> {
        let phantoms = self.count(BEST).phantom_near;
        let of = self.rounds.len();
        (of > 0).then(|| 100.0 * (1.0 - phantoms as f64 / of as f64))
    }

    /// The same among the rounds in which some reading of the whole frame matched does call one.
    pub(super) fn lures_rejected_percent(&self) -> (Option<f64>, usize) {
        let phantom =
            |round: &Round, method: usize| round.said[method].verdict == Verdict::PhantomNear;
        let lured: Vec<&Round> = self
            .rounds
            .iter()
            .filter(|round| {
                FULL_FRAME
                    .into_iter()
                    .any(|reading| phantom(round, reading))
            })
            .collect();
        let fell = lured.iter().filter(|round| phantom(round, BEST)).count();
        let share = (!lured.is_empty()).then(|| 100.0 * (1.0 - fell as f64 / lured.len() as f64));
        (share, lured.len())
    }
}

/// The table for people: how many right / refused / phantom near / other wrong.
pub(super) fn drawn(suites: &[Suite]) -> Table {
    let mut header = vec!["case".to_owned(), "rounds".to_owned()];
    header.extend(NAMES.map(str::to_owned));
    header.push(format!("{}: error / sigma", NAMES[BEST]));
    let row = |suite: &Suite| {
        let mut row = vec![suite.case.name().to_owned(), suite.rounds.len().to_string()];
        row.extend(suite.counts().iter().map(|count| {
            let Count {
                right,
                refused,
                phantom_near,
                other_wrong,
                ..
            } = count;
            format!("{right} / {refused} / {phantom_near} / {other_wrong}")
        }));
        let normalised = suite.count(BEST).normalised_error;
        row.push(normalised.map_or("-".to_owned(), |value| format!("{value:.2}")));
        row
    };
    Table {
        title: "Hard flames, 75 and 120 mm: right within 3 sigma / refused / phantom near / other wrong"
            .to_owned(),
        header,
        rows: suites.iter().map(row).collect(),
    }
}
