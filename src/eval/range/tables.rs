//! Ranges at stated distances: the papers' tables and ours.

use super::outcome::{BEST, Bench, NAMES, Round, Said};
use super::stage::{Recipe, RigName, Stage};
use super::stats::{deviation, half_interval95, mean, median, rms};
use super::{Options, RangeEvalError, Tick};
use crate::eval::Table;
use emberfix_sim::world::World;
use rayon::prelude::*;
use std::sync::Arc;

/// One table: a rig before flames at some distances.
pub(super) struct Series {
    pub name: &'static str,
    pub rig: RigName,
    pub distances_m: &'static [f64],
    /// Mean error that a paper printed at each distance, percent; empty for ours.
    pub printed_percent: &'static [f64],
    width_m: (f64, f64),
    indoors: bool,
}

/// P1's six distances with its printed average error rates.
pub(super) const P1: Series = Series {
    name: "P1",
    rig: RigName::P1,
    distances_m: &[0.5, 1.0, 2.0, 3.0, 5.0, 10.0],
    printed_percent: &[2.16, 2.06, 2.20, 3.15, 4.18, 7.37],
    width_m: (0.05, 0.10),
    indoors: true,
};
/// P4's eight, with its true errors (checklist E10), two visible eyes.
pub(super) const P4_VISIBLE: Series = Series {
    name: "P4 visible",
    rig: RigName::P4,
    distances_m: &[1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5],
    printed_percent: &[0.64, 0.45, 0.45, 1.20, 0.12, 3.80, 4.93, 0.45],
    width_m: (0.08, 0.16),
    indoors: true,
};
/// The same with a near-infrared right eye.
pub(super) const P4_INFRARED: Series = Series {
    name: "P4 visible + near infrared",
    rig: RigName::P4Infrared,
    ..P4_VISIBLE
};
const FAR_M: &[f64] = &[5.0, 10.0, 15.0, 20.0, 30.0, 50.0, 75.0, 100.0];
const OURS_75: Series = Series {
    name: "ours, 75 mm",
    rig: RigName::Ours75,
    distances_m: FAR_M,
    printed_percent: &[],
    width_m: (0.6, 1.6),
    indoors: false,
};
const OURS_120: Series = Series {
    name: "ours, 120 mm",
    rig: RigName::Ours120,
    ..OURS_75
};
const OURS_500: Series = Series {
    name: "ours, 500 mm",
    rig: RigName::Ours500,
    ..OURS_75
};

/// All of them.
pub(super) const ALL: [Series; 6] = [P1, P4_VISIBLE, P4_INFRARED, OURS_75, OURS_120, OURS_500];

/// All rounds at one distance.
pub(super) struct Cell {
    pub distance_m: f64,
    pub rounds: Vec<Round>,
}

/// One table's rounds.
pub(super) struct Measured {
    pub series: &'static Series,
    pub cells: Vec<Cell>,
}

/// What one method makes of one distance.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Line {
    pub table: &'static str,
    pub distance_m: f64,
    pub method: &'static str,
    /// Rounds in which it stood by a range, of how many.
    pub measured: usize,
    pub of: usize,
    /// Measured ranges, metres.
    pub mean_m: Option<f64>,
    pub deviation_m: Option<f64>,
    /// Half of the 95 % interval of the mean.
    pub interval95_m: Option<f64>,
    pub bias_percent: Option<f64>,
    /// Mean of the absolute errors.
    pub error_percent: Option<f64>,
    /// Of the disparities, weak ones too, against what the left eye truly sees.
    pub rms_px: Option<f64>,
    pub bias_px: Option<f64>,
    /// Root mean square of error over stated sigma.
    pub normalised_error: Option<f64>,
    /// Root mean square of the stated sigmas.
    pub stated_sigma_px: Option<f64>,
    /// Median of the stated sigmas.
    pub usual_sigma_px: Option<f64>,
    /// One sigma of a normal error that has the median of the errors' sizes.
    pub usual_error_px: Option<f64>,
}

/// Of a normal distribution: its sigma over the median of its absolute values.
const MEDIAN_TO_SIGMA: f64 = 1.4826;

impl Series {
    pub(super) fn recipe(&self, distance_m: f64) -> Recipe {
        Recipe {
            depth_m: distance_m..distance_m,
            width_m: self.width_m.0..self.width_m.1,
            u_px: self.columns(),
            v_px: if self.is_p4() {
                200.0..290.0
            } else {
                250.0..470.0
            },
            daylight: if self.indoors { 0.15..0.6 } else { 0.2..1.2 },
            exposure: if self.indoors { 0.6..1.2 } else { 0.8..1.6 },
            wind_m_s: if self.indoors { 0.0..0.3 } else { 0.0..2.0 },
            indoors: self.indoors,
            hardness: None,
        }
    }

    /// Percent that the paper printed at a distance.
    pub(super) fn printed(&self, distance_m: f64) -> Option<f64> {
        let place = self.distances_m.iter().position(|d| *d == distance_m)?;
        self.printed_percent.get(place).copied()
    }

    /// Takes a range to what it would be of the stated distance: where a rig looks down, each row of an
    /// upright flame has a depth of its own.
    fn scale(distance_m: f64, round: &Round, said: &Said) -> f64 {
        distance_m / round.truth.depth_m(said.truth_px)
    }

    fn is_p4(&self) -> bool {
        matches!(self.rig, RigName::P4 | RigName::P4Infrared)
    }

    fn columns(&self) -> std::ops::Range<f64> {
        if self.is_p4() {
            215.0..290.0
        } else {
            400.0..900.0
        }
    }
}

/// Measures one table.
pub(super) fn measure(
    series: &'static Series,
    world: &Arc<World>,
    options: &Options,
    tick: Tick,
) -> Result<Measured, RangeEvalError> {
    let stage = Stage::new(series.rig, world)?;
    let bench = Bench::new(&stage);
    let cells = series
        .distances_m
        .iter()
        .enumerate()
        .map(|(k, distance_m)| {
            let recipe = series.recipe(*distance_m);
            let purpose = (series.name.len() as u64) << 8 | k as u64;
            let rounds = rounds(&bench, &recipe, options, purpose, options.repeats)?;
            tick(1);
            Ok(Cell {
                distance_m: *distance_m,
                rounds,
            })
        });
    Ok(Measured {
        series,
        cells: cells.collect::<Result<_, RangeEvalError>>()?,
    })
}

/// Rounds of one recipe: the same seeds, the same rounds, in the same order.
pub(super) fn rounds(
    bench: &Bench,
    recipe: &Recipe,
    options: &Options,
    purpose: u64,
    count: usize,
) -> Result<Vec<Round>, RangeEvalError> {
    let one = |k: usize| {
        let seed = options.seed.wrapping_mul(0x9E37_79B9) ^ purpose << 20 ^ k as u64;
        let trial = bench.stage.trial(recipe, options.set, seed)?;
        trial.map(|trial| bench.round(&trial)).transpose()
    };
    let rounds: Result<Vec<_>, RangeEvalError> = (0..count).into_par_iter().map(one).collect();
    Ok(rounds?.into_iter().flatten().collect())
}

impl Measured {
    pub(super) fn lines(&self) -> Vec<Line> {
        let of_cell = |cell: &Cell| {
            (0..NAMES.len())
                .map(|method| cell.line(self.series, method))
                .collect::<Vec<_>>()
        };
        self.cells.iter().flat_map(of_cell).collect()
    }

    /// What one method makes of each distance.
    pub(super) fn lines_of(&self, method: usize) -> Vec<Line> {
        self.cells
            .iter()
            .map(|cell| cell.line(self.series, method))
            .collect()
    }
}

impl Cell {
    fn line(&self, series: &Series, method: usize) -> Line {
        let said = || {
            self.rounds
                .iter()
                .map(move |round| (round, &round.said[method]))
        };
        let ranges: Vec<f64> = said()
            .filter_map(|(round, said)| {
                let found_m = round.truth.depth_m(said.measured_px()?);
                Some(found_m * Series::scale(self.distance_m, round, said))
            })
            .collect();
        let percent = |range: f64| 100.0 * (range - self.distance_m) / self.distance_m;
        let errors: Vec<f64> = ranges.iter().map(|range| percent(*range).abs()).collect();
        let off: Vec<f64> = said().filter_map(|(_, said)| said.off_px()).collect();
        let sizes: Vec<f64> = off.iter().map(|off| off.abs()).collect();
        let sigmas: Vec<f64> = said().filter_map(|(_, said)| said.off_sigmas()).collect();
        let stated: Vec<f64> = said()
            .filter_map(|(_, said)| said.disparity.map(|(_, sigma)| sigma))
            .collect();
        Line {
            table: series.name,
            distance_m: self.distance_m,
            method: NAMES[method],
            measured: ranges.len(),
            of: self.rounds.len(),
            mean_m: mean(&ranges),
            deviation_m: deviation(&ranges),
            interval95_m: half_interval95(&ranges),
            bias_percent: mean(&ranges).map(percent),
            error_percent: mean(&errors),
            rms_px: rms(&off),
            bias_px: mean(&off),
            normalised_error: rms(&sigmas),
            stated_sigma_px: rms(&stated),
            usual_sigma_px: median(&stated),
            usual_error_px: median(&sizes).map(|size| MEDIAN_TO_SIGMA * size),
        }
    }
}

impl Line {
    /// Whether it stood by a range in four of five rounds: fewer are no measurement.
    pub(super) fn counts(&self) -> bool {
        5 * self.measured >= 4 * self.of && self.of > 0
    }
}

/// The tables for people: the default's own, and everyone's errors side by side.
pub(super) fn drawn(measured: &Measured) -> [Table; 2] {
    let rows = measured.lines_of(BEST);
    let own = Table {
        title: format!("Ranges by the default, {}", measured.series.name),
        header: [
            "true, m",
            "ranges",
            "mean, m",
            "SD, m",
            "95 % of the mean, m",
            "bias, %",
            "error, %",
            "printed, %",
            "RMS, px",
            "sigma, px",
            "error / sigma",
        ]
        .map(str::to_owned)
        .to_vec(),
        rows: rows
            .iter()
            .map(|line| own_row(measured.series, line))
            .collect(),
    };
    let mut header = vec!["true, m".to_owned()];
    header.extend(NAMES.map(str::to_owned));
    let all = Table {
        title: format!(
            "Mean error of the range in percent (of how many), {}",
            measured.series.name
        ),
        header,
        rows: measured
            .cells
            .iter()
            .map(|cell| all_row(measured.series, cell))
            .collect(),
    };
    [own, all]
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
}

fn own_row(series: &Series, line: &Line) -> Vec<String> {
    let interval = line.mean_m.zip(line.interval95_m).map_or_else(
        || "-".to_owned(),
        |(mean, half)| format!("{:.3} .. {:.3}", mean - half, mean + half),
    );
    vec![
        format!("{}", line.distance_m),
        format!("{}/{}", line.measured, line.of),
        number(line.mean_m, 3),
        number(line.deviation_m, 3),
        interval,
        number(line.bias_percent, 2),
        number(line.error_percent, 2),
        number(series.printed(line.distance_m), 2),
        number(line.rms_px, 3),
        number(line.stated_sigma_px, 3),
        number(line.normalised_error, 2),
    ]
}

fn all_row(series: &'static Series, cell: &Cell) -> Vec<String> {
    let mut row = vec![format!("{}", cell.distance_m)];
    row.extend((0..NAMES.len()).map(|method| {
        let line = cell.line(series, method);
        format!("{} ({})", number(line.error_percent, 2), line.measured)
    }));
    row
}
