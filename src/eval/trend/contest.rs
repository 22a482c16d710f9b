//! P1's experiment: ten groups of burns, every method on the same samples.

use super::burns::{Burn, LEAD, Model, STEP_S};
use super::score::{Method, scaled};
use crate::eval::Table;
use emberfix_report::{Axis, Chart, Mark, Series, Sheet};
use rayon::prelude::*;
use serde::Serialize;

/// Groups, as in P1's Table V.
pub const GROUPS: usize = 10;
/// Burns of each group: their spread is the group's standard deviation.
pub const BURNS: usize = 60;

/// Mean and standard deviation of an accuracy, percent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Accuracy {
    /// Percent.
    pub mean: f64,
    /// Percent; over the burns of a group, or over the groups.
    pub sd: f64,
}

/// All methods in all groups of one noise model.
#[derive(Debug, Clone, Serialize)]
pub struct Contest {
    /// Everything that the burns were drawn from.
    pub model: Model,
    /// Seed.
    pub seed: u64,
    /// Per group, in the order of [`Method::ALL`].
    pub groups: Vec<Vec<Accuracy>>,
    /// Over the groups, in the same order.
    pub overall: Vec<Accuracy>,
    /// What the printed and the turned fusion would score if the two samples by which their window
    /// looks ahead were given to them: percent.
    pub aligned: [f64; 2],
    /// What flies with the spectral, with the visible channel alone: percent.
    pub alone: [f64; 2],
}

impl Contest {
    /// Runs it. `told` hears of each burn that is done.
    pub fn run(model: Model, seed: u64, told: &(dyn Fn() + Sync)) -> Self {
        let burns: Vec<Vec<f64>> = (0..GROUPS * BURNS)
            .into_par_iter()
            .map(|k| {
                let burn = model.burn(seed, k / BURNS, k % BURNS);
                told();
                scores(&burn)
            })
            .collect();
        let of = |burns: &[Vec<f64>], column: usize| {
            accuracy(
                &burns
                    .iter()
                    .map(|scores| scores[column])
                    .collect::<Vec<f64>>(),
            )
        };
        let columns = 0..Method::ALL.len();
        let groups: Vec<Vec<Accuracy>> = burns
            .chunks(BURNS)
            .map(|burns| columns.clone().map(|column| of(burns, column)).collect())
            .collect();
        let mean_of = |column: usize| {
            accuracy(
                &groups
                    .iter()
                    .map(|g| g[column].mean / 100.0)
                    .collect::<Vec<f64>>(),
            )
        };
        Self {
            overall: columns.map(mean_of).collect(),
            aligned: [0, 1].map(|k| of(&burns, Method::ALL.len() + k).mean),
            alone: [2, 3].map(|k| of(&burns, Method::ALL.len() + k).mean),
            groups,
            model,
            seed,
        }
    }

    /// A method's accuracy over all groups, percent.
    #[must_use]
    pub fn mean(&self, method: Method) -> f64 {
        self.overall[method.column()].mean
    }

    /// Points by which ours is above the better single channel, in the worst group.
    #[must_use]
    pub fn worst_margin(&self) -> f64 {
        let margin = |group: &Vec<Accuracy>| {
            let of = |method: Method| group[method.column()].mean;
            of(Method::Ours) - of(Method::Spectral).max(of(Method::Visible))
        };
        self.groups.iter().map(margin).fold(f64::INFINITY, f64::min)
    }

    /// For people.
    #[must_use]
    pub fn table(&self) -> Table {
        let cell = |accuracy: &Accuracy| format!("{:.2} ± {:.2}", accuracy.mean, accuracy.sd);
        let row = |name: String, accuracies: &[Accuracy]| {
            std::iter::once(name)
                .chain(accuracies.iter().map(cell))
                .collect()
        };
        let named = |(k, group): (usize, &Vec<Accuracy>)| {
            let fuel = self.model.fuels[k % self.model.fuels.len()].name;
            row(format!("{} {fuel}", k + 1), group)
        };
        let mut rows: Vec<Vec<String>> = self.groups.iter().enumerate().map(named).collect();
        rows.push(row("all, SD over groups".to_owned(), &self.overall));
        let names = Method::ALL.map(|method| format!("{}, %", method.name()));
        Table {
            title: format!(
                "Trend accuracy (P1 Eq. 7), {} burns a group; {}",
                BURNS, self.model.name
            ),
            header: std::iter::once("group".to_owned()).chain(names).collect(),
            rows,
        }
    }

    /// One burn as in P1's Fig. 5, and the accuracies of the groups.
    #[must_use]
    pub fn sheet(&self) -> Sheet {
        let burn = self.model.burn(self.seed, 0, 0);
        Sheet {
            charts: vec![signals(&burn), self.accuracies()],
            columns: 2,
        }
    }

    fn accuracies(&self) -> Chart {
        let chart = Chart::new(
            "Trend accuracy per group",
            Axis::linear("group"),
            // Room for the legend.
            Axis::linear("accuracy, %").within(LEAST_SHOWN, 124.0),
        );
        Method::ALL.into_iter().fold(chart, |chart, method| {
            let points = self.groups.iter().enumerate();
            let points = points.map(|(k, group)| (k as f64 + 1.0, group[method.column()].mean));
            chart.with(Series::new(
                method.name(),
                Mark::LineAndDots,
                points.collect(),
            ))
        })
    }
}

fn scores(burn: &Burn) -> Vec<f64> {
    let mut scores: Vec<f64> = Method::ALL
        .iter()
        .map(|method| method.accuracy(burn))
        .collect();
    scores.extend([Method::Printed, Method::Turned].map(|method| method.accuracy_aligned(burn)));
    scores.extend([0, 1].map(|channel| Method::accuracy_alone(burn, channel)));
    scores
}

fn accuracy(shares: &[f64]) -> Accuracy {
    let n = shares.len() as f64;
    let mean = shares.iter().sum::<f64>() / n;
    let variance = shares
        .iter()
        .map(|share| (share - mean).powi(2))
        .sum::<f64>()
        / (n - 1.0).max(1.0);
    Accuracy {
        mean: 100.0 * mean,
        sd: 100.0 * variance.sqrt(),
    }
}

/// The burn as each method shows it. Methods come in one order in all charts, so that each keeps its colour.
fn signals(burn: &Burn) -> Chart {
    let timed = |signal: &[f64]| -> Vec<(f64, f64)> {
        let scored = signal.iter().enumerate().skip(LEAD);
        scored
            .map(|(k, value)| ((k - LEAD) as f64 * STEP_S, *value))
            .collect()
    };
    let truth = timed(&scaled(&burn.truth));
    let most = truth.iter().map(|point| point.1).fold(0.0, f64::max);
    let chart = Chart::new(
        "One burn of 12.5 s, as in P1's Fig. 5",
        Axis::linear("time, s"),
        // Room for the legend.
        Axis::linear("intensity, 1 = before the scored part").within(0.0, LEGEND_ROOM * most),
    );
    Method::ALL
        .into_iter()
        .fold(chart, |chart, method| {
            chart.with(Series::new(
                method.name(),
                Mark::Line,
                timed(&method.signal(burn)),
            ))
        })
        .with(Series::new("real (infrared)", Mark::Dashed, truth))
}

/// Accuracy that is shown at least, percent: guessing is a third.
const LEAST_SHOWN: f64 = 40.0;
/// Height of a chart against what is drawn in it.
const LEGEND_ROOM: f64 = 1.6;
