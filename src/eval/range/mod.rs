//! Ranging against truth: the papers' tables, ours, hard flames, fractions of a pixel, real texture,
//! and time.
//!
//! **Purpose.** Says how far each way of ranging can be trusted, and keeps the figures of ranging.
//! **In:** [`Options`]: a seed, how many flames, and which set of them. **Out:** [`Report`].
//!
//! **Truth.** Flames are rendered by the simulator's studio as both raw eyes see them, through their
//! own lenses. Ranges, disparities and sigmas are held against the flame's upright axis, through its base,
//! at the row of the answer's centroid: that is what the estimator takes a disparity for.
//! **Two sets.** Methods may be tuned on [`SeedSet::Tuning`]; [`SeedSet::Report`] has other seeds,
//! shapes, gains and lenses, and is what is reported.
//! **Known limits.** Rendered flames are the simulator's. Calibration is perfect here: what it leaves
//! open is measured by `emberfix eval calibration`.

mod cases;
mod hardness;
mod middlebury;
mod outcome;
mod papers;
mod plots;
mod speed;
mod stage;
mod stats;
mod subpixel;
mod tables;
mod takeover;
#[cfg(test)]
mod tests;

pub use stage::SeedSet;

use super::{Report, Table};
use crate::range::RangeError;
use cases::Hardness;
use emberfix_calib::RigError;
use emberfix_report::{Bound, Figure};
use emberfix_sim::world::WorldError;
use hardness::Suite;
use middlebury::Scene;
use outcome::{BEST, FULL_FRAME, NAMES, OURS, Round};
use speed::Speed;
use stage::RigName;
use stats::{mean, rms};
use subpixel::Step;
use tables::{Line, Measured};

/// What is measured.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Which flames.
    pub seed: u64,
    /// Flames at each distance.
    pub repeats: usize,
    /// A few flames only, seconds instead of minutes; its figures are coarse.
    pub quick: bool,
    /// Which set of flames.
    pub set: SeedSet,
    /// Only this part; the figures of the others have no value then.
    pub only: Option<Part>,
    /// Every single answer goes into the details as well.
    pub rounds: bool,
}

/// A part of the measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Part {
    /// The papers' distances and ours.
    Tables,
    /// Hard flames.
    Hard,
    /// Fractions of a pixel.
    Subpixel,
    /// Middlebury's scenes.
    Middlebury,
    /// Time.
    Speed,
}

impl Options {
    fn wants(&self, part: Part) -> bool {
        self.only.is_none_or(|only| only == part)
    }

    /// Flames in each hard case.
    fn hard_repeats(&self) -> usize {
        if self.quick { 8 } else { 4 * self.repeats }
    }
}

/// Called with the number of steps that were done.
pub type Tick<'a> = &'a (dyn Fn(u64) + Sync);

/// Why ranging could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum RangeEvalError {
    /// A built-in rig was refused.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The textures' world was refused.
    #[error(transparent)]
    World(#[from] WorldError),
    /// A ranger could not be made or broke on a pair.
    #[error(transparent)]
    Range(#[from] RangeError),
    /// OpenCV refused.
    #[error("matching failed: {source}")]
    OpenCv {
        /// What it said.
        #[from]
        source: opencv::Error,
    },
    /// A suite came out empty: no flame was lit, or not every method answered.
    #[error("a suite of flames came out empty")]
    Methods,
}

/// Everything that was measured.
#[derive(Default)]
struct Findings {
    tables: Vec<Measured>,
    suites: Vec<Suite>,
    steps: Vec<Step>,
    scenes: Vec<Scene>,
    speeds: Vec<Speed>,
}

/// Answers from which a normalised error of one method in one table or hard case is a measurement.
const FEWEST: usize = 20;

/// Steps that [`measure`] ticks off.
#[must_use]
pub fn steps(options: &Options) -> u64 {
    let cells: usize = tables::ALL
        .iter()
        .map(|series| series.distances_m.len())
        .sum();
    (cells + Hardness::ALL.len() + OURS) as u64 + subpixel::steps(options)
}

/// Measures every way to range a flame.
///
/// # Errors
/// [`RangeEvalError`] when a rig, a world or OpenCV refuses; a method that ranges badly is no error.
pub fn measure(options: &Options, tick: Tick) -> Result<Report, RangeEvalError> {
    let world = stage::world()?;
    let mut findings = Findings::default();
    // Times first, while nothing else has warmed or worn the machine.
    if options.wants(Part::Speed) {
        findings.speeds = speed::measure(&world, options, tick)?;
    }
    if options.wants(Part::Tables) {
        for series in &tables::ALL {
            let measured = tables::measure(series, &world, options, tick)?;
            findings.tables.push(measured);
        }
    }
    if options.wants(Part::Hard) {
        findings.suites = hardness::measure(&world, options, tick)?;
    }
    if options.wants(Part::Subpixel) {
        findings.steps = subpixel::measure(&world, options, tick)?;
    }
    if options.wants(Part::Middlebury) {
        findings.scenes = middlebury::measure()?;
    }
    Ok(findings.report(options))
}

impl Findings {
    fn report(&self, options: &Options) -> Report {
        let mut tables: Vec<Table> = self.tables.iter().flat_map(tables::drawn).collect();
        tables.extend(hardness::drawn(&self.suites));
        tables.push(self.drawn_steps());
        tables.push(self.drawn_scenes());
        tables.push(self.drawn_speeds());
        Report {
            figures: self.figures(),
            details: self.details(options),
            tables,
            plots: plots::sheets(&self.tables, &self.steps),
        }
    }

    fn figures(&self) -> Vec<Figure> {
        let p1 = self.lines(&["P1"], BEST);
        let p4 = self.lines(&["P4 visible", "P4 visible + near infrared"], BEST);
        let n = |lines: &[Line]| lines.iter().map(|line| line.measured).sum();
        let biases = worst(&p1, |line| line.bias_percent.map(f64::abs));
        let over_paper = worst(&p1, |line| {
            Some(line.error_percent? / tables::P1.printed(line.distance_m)?)
        });
        let p4_worst = worst(&p4, |line| line.error_percent);
        let p4_errors: Option<Vec<f64>> = p4
            .iter()
            .map(|line| line.error_percent.filter(|_| line.counts()))
            .collect();
        let p4_mean = p4_errors.and_then(|errors| mean(&errors));
        let (ratio, compared) = self.rms_over_sgbm(BEST);
        let (normalised, rested_on) = self.least_honest();
        let saturated = self
            .suites
            .iter()
            .find(|suite| suite.case == Hardness::SaturatedCore);
        let phantom = saturated.and_then(Suite::phantoms_rejected_percent);
        let (lures, lured) = saturated.map_or((None, 0), Suite::lures_rejected_percent);
        let (hard_worst, hard_on) = hardness::least_honest(&self.suites, 0..OURS, FEWEST);
        let (hard_best, best_on) = hardness::least_honest(&self.suites, BEST..BEST + 1, FEWEST);
        let best = self.speeds.get(BEST);
        let at_most = |name, value, unit, bound, n| {
            Figure::bounded(name, value, unit, Bound::AtMost(bound), n)
        };
        let at_least = |name, value, unit, bound, n| {
            Figure::bounded(name, value, unit, Bound::AtLeast(bound), n)
        };
        vec![
            at_most("range.p1_bias_worst", biases, "%", 1.0, n(&p1)),
            at_most(
                "range.p1_error_over_paper_worst",
                over_paper,
                "",
                0.5,
                n(&p1),
            ),
            at_most("range.p4_worst", p4_worst, "%", 2.0, n(&p4)),
            at_most("range.p4_mean", p4_mean, "%", 0.75, n(&p4)),
            at_most("range.disparity_rms_over_sgbm", ratio, "", 0.5, compared),
            at_most(
                "range.subpixel_bias_px",
                subpixel::worst_bias_px(&self.steps),
                "px",
                0.02,
                self.steps.iter().map(|step| step.methods[BEST].n).sum(),
            ),
            at_least(
                "range.phantom_rejected",
                phantom,
                "%",
                99.0,
                saturated.map_or(0, |suite| suite.rounds.len()),
            ),
            Figure::bounded(
                "range.normalised_error",
                normalised,
                "",
                Bound::Within(0.8, 1.2),
                rested_on,
            ),
            Figure::bounded(
                "range.hard_normalised_error_worst",
                hard_worst,
                "",
                Bound::Within(0.8, 1.2),
                hard_on,
            ),
            Figure::bounded(
                "range.hard_normalised_error_best",
                hard_best,
                "",
                Bound::Within(0.8, 1.2),
                best_on,
            ),
            at_least(
                "range.speedup_1_fire",
                best.map(|s| s.speedup_one),
                "x",
                50.0,
                1,
            ),
            at_least(
                "range.speedup_16_fires",
                best.map(|s| s.speedup_many),
                "x",
                10.0,
                speed::MANY,
            ),
            Figure::told(
                "range.phantom_rejected_of_sgbms_phantoms",
                lures,
                "%",
                lured,
            ),
        ]
    }

    /// One method's lines of some tables.
    fn lines(&self, names: &[&str], method: usize) -> Vec<Line> {
        let tables = self
            .tables
            .iter()
            .filter(|table| names.contains(&table.series.name));
        tables.flat_map(|table| table.lines_of(method)).collect()
    }

    /// Error of a method over that of the best reading of the whole frame matched.
    fn rms_over_sgbm(&self, method: usize) -> (Option<f64>, usize) {
        let ratios = FULL_FRAME.map(|reading| self.rms_over(method, reading));
        let known = ratios.filter_map(|(ratio, n)| Some((ratio?, n)));
        let worst = known.max_by(|a, b| a.0.total_cmp(&b.0));
        worst.map_or((None, 0), |(ratio, n)| (Some(ratio), n))
    }

    /// Error of one method over another's on the flames that both gave a disparity of. Two spectra are
    /// left out: there the whole frame matched is mostly wrong, which would flatter any other method.
    fn rms_over(&self, method: usize, other: usize) -> (Option<f64>, usize) {
        let rounds = self
            .tables
            .iter()
            .filter(|table| table.series.rig != RigName::P4Infrared)
            .flat_map(|table| &table.cells)
            .flat_map(|c| &c.rounds);
        let (ours, theirs): (Vec<f64>, Vec<f64>) = rounds
            .filter_map(|round| round.said[method].off_px().zip(round.said[other].off_px()))
            .unzip();
        let ratio = rms(&ours)
            .zip(rms(&theirs))
            .map(|(ours, theirs)| ours / theirs);
        (ratio, ours.len())
    }

    /// Normalised error of a method over one table.
    fn normalised_error(table: &Measured, method: usize) -> (Option<f64>, usize) {
        let rounds = table.cells.iter().flat_map(|cell| &cell.rounds);
        let sigmas: Vec<f64> = rounds.filter_map(|r| r.said[method].off_sigmas()).collect();
        (rms(&sigmas), sigmas.len())
    }

    /// That of the method and table where sigma is the farthest from true.
    fn least_honest(&self) -> (Option<f64>, usize) {
        let of = |table| (0..OURS).map(move |method| Self::normalised_error(table, method));
        let told = self.tables.iter().flat_map(of);
        let known = told.filter_map(|(value, n)| Some((value.filter(|_| n >= FEWEST)?, n)));
        let far = |value: f64| value.ln().abs();
        let farthest = known.max_by(|a, b| far(a.0).total_cmp(&far(b.0)));
        farthest.map_or((None, 0), |(value, n)| (Some(value), n))
    }

    /// Every method's normalised error over every table.
    fn honesty(&self) -> Vec<serde_json::Value> {
        let told = |table: &Measured, method: usize| {
            let (normalised_error, n) = Self::normalised_error(table, method);
            serde_json::json!({
                "table": table.series.name,
                "method": NAMES[method],
                "normalised_error": normalised_error,
                "n": n,
            })
        };
        let of = |table| (0..OURS).map(move |method| told(table, method));
        self.tables.iter().flat_map(of).collect()
    }

    /// By how much the light of a flame lies before its axis, in widths: what the methods take for the depth's
    /// share of their sigma.
    fn light_before_axis(&self) -> Vec<serde_json::Value> {
        let of = |table: &Measured| {
            let rounds = table.cells.iter().flat_map(|cell| &cell.rounds);
            let before: Vec<f64> = rounds.map(|round| round.truth.light_before()).collect();
            serde_json::json!({
                "table": table.series.name,
                "mean_widths": mean(&before),
                "rms_widths": rms(&before),
                "n": before.len(),
            })
        };
        self.tables.iter().map(of).collect()
    }

    fn details(&self, options: &Options) -> serde_json::Value {
        let per_method = |method: usize| {
            serde_json::json!({
                "method": NAMES[method],
                "rms_over_sgbm": self.rms_over_sgbm(method).0,
            })
        };
        let lines: Vec<Line> = self.tables.iter().flat_map(Measured::lines).collect();
        let counts: Vec<_> = self.suites.iter().flat_map(Suite::counts).collect();
        let rounds = options.rounds.then(|| self.every_round());
        serde_json::json!({
            "rounds": rounds,
            "set": options.set,
            "seed": options.seed,
            "repeats": options.repeats,
            "methods": (0..OURS).map(per_method).collect::<Vec<_>>(),
            "honesty": self.honesty(),
            "light_before_axis": self.light_before_axis(),
            "ranges": lines,
            "hard_flames": counts,
            "subpixel": self.steps,
            "middlebury": self.scenes,
            "speed": self.speeds,
        })
    }

    /// What every method said of every flame of the tables and of the hard cases.
    fn every_round(&self) -> Vec<serde_json::Value> {
        let told = |of: &str, distance_m: f64, round: &Round| {
            let said = NAMES.iter().zip(&round.said);
            let said: Vec<_> = said.map(|(name, said)| said.told(name)).collect();
            serde_json::json!({ "of": of, "distance_m": distance_m, "said": said })
        };
        let tables = self.tables.iter().flat_map(|table| {
            table.cells.iter().flat_map(move |cell| {
                let rounds = cell.rounds.iter();
                rounds.map(move |round| told(table.series.name, cell.distance_m, round))
            })
        });
        let hard = self.suites.iter().flat_map(|suite| {
            let rounds = suite.rounds.iter();
            rounds.map(move |round| {
                let stands_m = round
                    .truth
                    .depth_m(round.truth.disparity_px(round.truth.row()));
                told(suite.case.name(), stands_m, round)
            })
        });
        tables.chain(hard).collect()
    }

    fn drawn_steps(&self) -> Table {
        let mut header = vec!["fraction, px".to_owned()];
        header.extend(NAMES.iter().map(|name| format!("{name}: bias / RMS, px")));
        let cell = |o: &subpixel::Offset| match (o.bias_px, o.rms_px) {
            (Some(bias), Some(rms)) => format!("{bias:+.3} / {rms:.3}"),
            _ => "-".to_owned(),
        };
        let row = |step: &Step| {
            let mut row = vec![format!("{:.4}", step.fraction_px)];
            row.extend(step.methods.iter().map(cell));
            row
        };
        Table {
            title: "Bias over the fraction of a pixel".to_owned(),
            header,
            rows: self.steps.iter().map(row).collect(),
        }
    }

    fn drawn_scenes(&self) -> Table {
        let number = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.3}"));
        let row = |scene: &Scene| {
            vec![
                scene.scene.to_owned(),
                scene.method.to_owned(),
                format!("{}/{}", scene.measured, scene.boxes),
                number(scene.median_error_px),
                number(scene.rms_px),
                scene.outliers.to_string(),
            ]
        };
        let title = if self.scenes.is_empty() {
            "Middlebury: skipped, no shared data"
        } else {
            "Middlebury cones and teddy, boxes on flat surfaces"
        };
        let header = [
            "scene",
            "method",
            "boxes",
            "median error, px",
            "RMS, px",
            "off by > 2 px",
        ];
        Table {
            title: title.to_owned(),
            header: header.map(str::to_owned).to_vec(),
            rows: self.scenes.iter().map(row).collect(),
        }
    }

    fn drawn_speeds(&self) -> Table {
        let row = |speed: &Speed| {
            vec![
                speed.method.to_owned(),
                format!("{:.3}", speed.one_fire_ms),
                format!("{:.2}", speed.many_fires_ms),
                format!("{:.1}", speed.full_frame_ms),
                format!("{:.0}", speed.speedup_one),
                format!("{:.1}", speed.speedup_many),
            ]
        };
        let header = [
            "method",
            "one fire, ms",
            "16 fires, ms",
            "full frame SGBM, ms",
            "faster, 1 fire",
            "faster, 16 fires",
        ];
        Table {
            title: "Time, 1280x720, 96 disparities, one thread".to_owned(),
            header: header.map(str::to_owned).to_vec(),
            rows: self.speeds.iter().map(row).collect(),
        }
    }
}

/// Greatest of a value over lines; `None` when a line has too few ranges to have one.
fn worst(lines: &[Line], value: impl Fn(&Line) -> Option<f64>) -> Option<f64> {
    let values: Option<Vec<f64>> = lines
        .iter()
        .map(|line| value(line).filter(|_| line.counts()))
        .collect();
    values?.into_iter().reduce(f64::max)
}
