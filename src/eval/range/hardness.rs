//! What each method does with flames that are hard to range.

use super::cases::Hardness;
use super::outcome::{BEST, Bench, FULL_FRAME, NAMES, OURS, Round, Said, Verdict};
use super::stage::{RigName, Stage};
use super::stats::rms;
use super::tables::rounds;
use super::{Options, RangeEvalError, Tick};
use crate::eval::Table;
use emberfix_sim::world::World;
use std::ops::Range;
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
    /// Disparities, weak ones too.
    pub answered: usize,
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
            Hardness::SaturatedCore => 3 * options.hard_repeats(),
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
            answered: sigmas.len(),
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

/// The normalised error that is the farthest from 1 of some methods over all cases, and the answers that it
/// rests on; cases with fewer than `fewest` answers are no measurement.
pub(super) fn least_honest(
    suites: &[Suite],
    methods: Range<usize>,
    fewest: usize,
) -> (Option<f64>, usize) {
    let counts = suites.iter().flat_map(Suite::counts);
    let wanted: Vec<&str> = NAMES[methods].to_vec();
    let told = counts
        .filter(|count| count.answered >= fewest && wanted.contains(&count.method))
        .filter_map(|count| Some((count.normalised_error?, count.answered)));
    let far = |value: f64| value.ln().abs();
    let farthest = told.max_by(|a, b| far(a.0).total_cmp(&far(b.0)));
    farthest.map_or((None, 0), |(value, n)| (Some(value), n))
}

/// The tables for people: how many right / refused / phantom near / other wrong, and whether sigmas are true.
pub(super) fn drawn(suites: &[Suite]) -> [Table; 2] {
    let header = |names: &[&str]| -> Vec<String> {
        let first = ["case", "rounds"];
        first.iter().chain(names).map(|s| (*s).to_owned()).collect()
    };
    let row = |suite: &Suite, methods: usize, cell: &dyn Fn(&Count) -> String| -> Vec<String> {
        let first = [suite.case.name().to_owned(), suite.rounds.len().to_string()];
        let counts = suite.counts();
        let cells = counts.iter().take(methods).map(cell);
        first.into_iter().chain(cells).collect()
    };
    let verdicts = |count: &Count| {
        let Count {
            right,
            refused,
            phantom_near,
            other_wrong,
            ..
        } = count;
        format!("{right} / {refused} / {phantom_near} / {other_wrong}")
    };
    let honesty = |count: &Count| match count.normalised_error {
        Some(value) => format!(
            "{value:.2} ({:.0} %)",
            100.0 * count.answered as f64 / count.of.max(1) as f64
        ),
        None => "-".to_owned(),
    };
    let rows = |methods: usize, cell: &dyn Fn(&Count) -> String| -> Vec<Vec<String>> {
        suites
            .iter()
            .map(|suite| row(suite, methods, cell))
            .collect()
    };
    [
        Table {
            title: "Hard flames, 75 and 120 mm: right within 3 sigma / refused / phantom near / other wrong"
                .to_owned(),
            header: header(&NAMES),
            rows: rows(NAMES.len(), &verdicts),
        },
        Table {
            title: "Hard flames: error over sigma, root mean square (share that has a disparity)".to_owned(),
            header: header(&NAMES[..OURS]),
            rows: rows(OURS, &honesty),
        },
    ]
}
