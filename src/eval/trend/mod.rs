//! Trend, size and spread of simulated burns.
//!
//! **In:** a seed, a noise model, a rig. **Out:** P1's trend experiment with all methods side by side
//! ([`contest`]), and size and spread of rendered fires against truth ([`flights`]). Accuracies are
//! percent, margins percentage points; size and speed errors percent of the truth (root of the mean
//! square), directions degrees (root of the mean square), coverages shares.

pub mod burns;
pub mod contest;
mod coverage;
pub mod flights;
pub mod score;

use crate::assess::extent::{KNOWN, LEAST_HEAD_DEG};
use crate::eval::{Report, Table};
use contest::{BURNS, Contest, GROUPS};
use emberfix_calib::Rig;
use emberfix_report::{Axis, Bound, Chart, Figure, Mark, Series, Sheet};
use flights::{FlightError, Outcome, Pair};
use rayon::prelude::*;
use score::Method;
use std::collections::BTreeSet;

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// Seed of burns and flights.
    pub seed: u64,
    /// The first noise model, the second, or both.
    pub sets: Sets,
    /// Rendered flights, in turn of [`FLIGHT_SEEDS`] seeds from `seed`; two in three of the fires run.
    pub flights: usize,
}

/// Ranges that are told apart, metres.
const BANDS: [(f64, f64); 3] = [(10.0, 20.0), (20.0, 50.0), (50.0, 100.0)];
/// Seeds that the flights come from.
pub const FLIGHT_SEEDS: usize = 2;

/// Which noise models are run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sets {
    /// The one that fusion was tuned on.
    First,
    /// The one that was kept aside.
    Second,
    /// Both.
    Both,
}

/// Measures. `told` hears of each burn and each flight that is done.
///
/// # Errors
/// [`FlightError`] when the world of a flight can't be.
pub fn measure(
    options: &Options,
    rig: &Rig,
    told: &(dyn Fn() + Sync),
) -> Result<Report, FlightError> {
    let run = |model| Contest::run(model, options.seed, told);
    let first = (options.sets != Sets::Second).then(|| run(burns::first()));
    let second = (options.sets != Sets::First).then(|| run(burns::second()));
    let flown: Vec<Option<Outcome>> = (0..options.flights)
        .into_par_iter()
        .map(|flight| {
            let seed = options.seed + (flight % FLIGHT_SEEDS) as u64;
            let outcome = flights::fly(rig, seed, flight / FLIGHT_SEEDS);
            told();
            outcome
        })
        .collect::<Result<_, _>>()?;
    let flown: Vec<Outcome> = flown.into_iter().flatten().collect();
    let mut figures = Vec::new();
    figures.extend(first.iter().flat_map(first_figures));
    figures.extend(second.iter().flat_map(second_figures));
    if options.flights > 0 {
        figures.extend(flight_figures(&flown));
    }
    let mut tables: Vec<Table> = first.iter().chain(&second).map(Contest::table).collect();
    let mut plots = Vec::new();
    for (name, contest) in [("trend_first", &first), ("trend_second", &second)] {
        plots.extend(
            contest
                .as_ref()
                .map(|contest| (name.to_owned(), contest.sheet())),
        );
    }
    if !flown.is_empty() {
        tables.push(flight_table(&flown));
        tables.push(spread_table(&flown));
        tables.push(coverage::table(&interval_rows(&flown)));
        plots.push(("trend_size_and_spread".to_owned(), flight_sheet(&flown)));
    }
    Ok(Report {
        figures,
        details: serde_json::json!({
            "first": first,
            "second": second,
            "methods": Method::ALL,
            "dead_band_per_sample": score::DEAD_BAND,
            "seed": options.seed,
            "flights": flown,
            "coverage90": coverage::details(&interval_rows(&flown)),
        }),
        tables,
        plots,
    })
}

fn first_figures(contest: &Contest) -> Vec<Figure> {
    let n = GROUPS * BURNS;
    let told = |method: Method| {
        let name = format!("trend.{}", method.name());
        Figure::told(name, Some(contest.mean(method)), "%", n)
    };
    let ours = Some(contest.mean(Method::Ours));
    vec![
        Figure::bounded("trend.ours", ours, "%", Bound::AtLeast(93.0), n),
        Figure::bounded(
            "trend.margin_worst_group",
            Some(contest.worst_margin()),
            "points",
            Bound::AtLeast(2.0),
            GROUPS,
        ),
        told(Method::Spectral),
        told(Method::Visible),
        told(Method::Printed),
        told(Method::Turned),
        Figure::told("trend.printed_aligned", Some(contest.aligned[0]), "%", n),
        Figure::told("trend.turned_aligned", Some(contest.aligned[1]), "%", n),
        Figure::told("trend.ours_spectral_alone", Some(contest.alone[0]), "%", n),
        Figure::told("trend.ours_visible_alone", Some(contest.alone[1]), "%", n),
    ]
}

fn second_figures(contest: &Contest) -> Vec<Figure> {
    vec![
        Figure::bounded(
            "trend.ours_second_model",
            Some(contest.mean(Method::Ours)),
            "%",
            Bound::AtLeast(93.0),
            GROUPS * BURNS,
        ),
        Figure::bounded(
            "trend.margin_worst_group_second_model",
            Some(contest.worst_margin()),
            "points",
            Bound::AtLeast(2.0),
            GROUPS,
        ),
    ]
}

/// A height that claims to be known.
fn known_height(outcome: &Outcome) -> Option<Pair> {
    Some(outcome.height).filter(|height| height.sigma <= KNOWN * height.told)
}

/// All widths, and the heights that claim to be known.
fn sizes(flown: &[Outcome]) -> Vec<Pair> {
    let widths = flown.iter().map(|outcome| outcome.width);
    widths
        .chain(flown.iter().filter_map(known_height))
        .collect()
}

/// All widths and all heights.
fn sides(flown: &[Outcome]) -> Vec<Pair> {
    flown
        .iter()
        .flat_map(|outcome| [outcome.width, outcome.height])
        .collect()
}

fn flight_figures(flown: &[Outcome]) -> Vec<Figure> {
    let sizes = sizes(flown);
    let speeds: Vec<Pair> = flown.iter().filter_map(|outcome| outcome.speed).collect();
    let azimuths: Vec<Pair> = flown.iter().filter_map(|outcome| outcome.azimuth).collect();
    let running = flown.iter().filter(|outcome| outcome.runs).count();
    let wide = flown
        .iter()
        .filter(|outcome| outcome.runs && is_wide(outcome))
        .count();
    let backwards = azimuths.iter().filter(|pair| is_backwards(pair)).count();
    let still = flown.len() - running;
    let wrongly = flown.iter().filter(|outcome| outcome.false_spread).count();
    let share = |count: usize, of: usize| (of > 0).then(|| count as f64 / of as f64);
    let coverage = |name, pairs: &[Pair]| {
        let held = pairs.iter().filter(|pair| pair.holds90()).count();
        Figure::bounded(
            name,
            share(held, pairs.len()),
            "",
            Bound::Within(0.87, 0.93),
            pairs.len(),
        )
    };
    let bounded =
        |name, value, unit, bound, n| Figure::bounded(name, value, unit, Bound::AtMost(bound), n);
    vec![
        bounded(
            "size.error",
            rms(&sizes, |p| 100.0 * p.share()),
            "%",
            20.0,
            sizes.len(),
        ),
        coverage("size.coverage90", &sides(flown)),
        Figure::told(
            "size.heights_known_share",
            share(sizes.len() - flown.len(), flown.len()),
            "",
            flown.len(),
        ),
        bounded(
            "spread.speed_error",
            rms(&speeds, |p| 100.0 * p.share()),
            "%",
            25.0,
            speeds.len(),
        ),
        bounded(
            "spread.direction_error_deg",
            rms(&azimuths, |p| p.told - p.truth),
            "deg",
            15.0,
            azimuths.len(),
        ),
        coverage("spread.coverage90", &[speeds.clone(), azimuths].concat()),
        Figure::told("spread.told", Some(speeds.len() as f64), "fires", running),
        Figure::told(
            "spread.withheld",
            Some((running - speeds.len()) as f64),
            "fires",
            running,
        ),
        Figure::told(
            "spread.told_share",
            share(speeds.len(), running),
            "",
            running,
        ),
        Figure::told(
            "spread.told_share_wide_view",
            share(speeds.len(), wide),
            "",
            wide,
        ),
        Figure::told(
            "spread.told_backwards",
            Some(backwards as f64),
            "fires",
            speeds.len(),
        ),
        Figure::told("spread.false_share", share(wrongly, still), "", still),
    ]
}

/// Whether a fire was seen from so many sides that a head may be told at all.
fn is_wide(outcome: &Outcome) -> bool {
    outcome.view_deg >= LEAST_HEAD_DEG
}

/// Told to run to the other side.
fn is_backwards(azimuth: &Pair) -> bool {
    (azimuth.told - azimuth.truth).abs() > 90.0
}

/// How many heads are told and withheld, and why.
fn spread_table(flown: &[Outcome]) -> Table {
    let row = |(name, inside): (String, Vec<&Outcome>)| {
        let count = |of: &dyn Fn(&Outcome) -> bool| {
            let counted = inside.iter().filter(|outcome| of(outcome));
            counted.count().to_string()
        };
        let withheld = |outcome: &Outcome| outcome.runs && outcome.speed.is_none();
        vec![
            name,
            count(&|outcome| outcome.runs),
            count(&|outcome| outcome.speed.is_some()),
            count(&|outcome| withheld(outcome) && !is_wide(outcome)),
            count(&|outcome| withheld(outcome) && is_wide(outcome)),
            count(&|outcome| outcome.azimuth.as_ref().is_some_and(is_backwards)),
            count(&|outcome| !outcome.runs),
            count(&|outcome| outcome.false_spread),
            count(&|outcome| known_height(outcome).is_some()),
        ]
    };
    let inside = |low: f64, high: f64| {
        let inside = flown
            .iter()
            .filter(|outcome| (low..high).contains(&outcome.range_m));
        (format!("{low:.0} to {high:.0} m"), inside.collect())
    };
    let mut kinds: Vec<(String, Vec<&Outcome>)> = BANDS
        .iter()
        .map(|(low, high)| inside(*low, *high))
        .collect();
    kinds.push(("all".to_owned(), flown.iter().collect()));
    let header = [
        "range",
        "run",
        "told",
        "withheld: seen from one side",
        "withheld: not sure",
        "told backwards",
        "stand",
        "told to run",
        "heights known",
    ];
    Table {
        title: format!(
            "Fires whose head is told and withheld; one side is less than {LEAST_HEAD_DEG:.0} degrees of view"
        ),
        header: header.map(str::to_owned).to_vec(),
        rows: kinds.into_iter().map(row).collect(),
    }
}

/// What the 90 % intervals are counted over.
fn interval_rows(flown: &[Outcome]) -> Vec<(&'static str, Vec<Pair>)> {
    let of = |pick: fn(&Outcome) -> Option<Pair>| flown.iter().filter_map(pick).collect();
    vec![
        ("width", of(|outcome| Some(outcome.width))),
        ("height", of(|outcome| Some(outcome.height))),
        ("speed of the head", of(|outcome| outcome.speed)),
        ("direction of the head", of(|outcome| outcome.azimuth)),
    ]
}

fn rms(pairs: &[Pair], of: impl Fn(&Pair) -> f64) -> Option<f64> {
    let squares: f64 = pairs.iter().map(|pair| of(pair).powi(2)).sum();
    (!pairs.is_empty()).then(|| (squares / pairs.len() as f64).sqrt())
}

fn flight_table(flown: &[Outcome]) -> Table {
    let percent = |pairs: &[Pair]| {
        rms(pairs, |p| 100.0 * p.share()).map_or("-".to_owned(), |value| format!("{value:.1}"))
    };
    let seeds: BTreeSet<u64> = flown.iter().map(|outcome| outcome.seed).collect();
    let mut kinds: Vec<(String, Vec<Outcome>)> = BANDS
        .map(|(low, high)| {
            let inside = flown
                .iter()
                .filter(|outcome| (low..high).contains(&outcome.range_m));
            (
                format!("{low:.0} to {high:.0} m"),
                inside.copied().collect(),
            )
        })
        .to_vec();
    kinds.extend(seeds.into_iter().map(|seed| {
        let inside = flown.iter().filter(|outcome| outcome.seed == seed);
        (format!("seed {seed}"), inside.copied().collect())
    }));
    let rows = kinds.into_iter().map(|(name, inside)| {
        let of = |pick: fn(&Outcome) -> Option<Pair>| -> Vec<Pair> {
            inside.iter().filter_map(pick).collect()
        };
        let azimuths = of(|outcome| outcome.azimuth);
        vec![
            name,
            inside.len().to_string(),
            percent(&of(|outcome| Some(outcome.width))),
            percent(&of(|outcome| Some(outcome.height))),
            azimuths.len().to_string(),
            percent(&of(|outcome| outcome.speed)),
            rms(&azimuths, |p| p.told - p.truth).map_or("-".to_owned(), |v| format!("{v:.1}")),
        ]
    });
    let header = [
        "range or seed",
        "fires",
        "width, %",
        "height, %",
        "spreads",
        "speed, %",
        "direction, deg",
    ];
    Table {
        title: "Errors (root of the mean square) on rendered fires".to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows: rows.collect(),
    }
}

fn flight_sheet(flown: &[Outcome]) -> Sheet {
    let points = |pairs: &[Pair]| pairs.iter().map(|pair| (pair.truth, pair.told)).collect();
    let chart = |title: &str, unit: &str, pairs: &[Pair]| {
        let most = pairs.iter().map(|pair| pair.truth).fold(0.0, f64::max);
        let least = pairs.iter().map(|pair| pair.truth).fold(most, f64::min);
        let equal = vec![(least, least), (most, most)];
        Chart::new(
            title,
            Axis::linear(format!("truth, {unit}")),
            Axis::linear(format!("told, {unit}")),
        )
        .with(Series::new("equal", Mark::Dashed, equal))
    };
    let dotted = |title: &str, unit: &str, pick: fn(&Outcome) -> Option<Pair>| {
        let pairs: Vec<Pair> = flown.iter().filter_map(pick).collect();
        chart(title, unit, &pairs).with(Series::new("told", Mark::Dots, points(&pairs)))
    };
    let (known, unknown): (Vec<&Outcome>, Vec<&Outcome>) = flown
        .iter()
        .partition(|outcome| known_height(outcome).is_some());
    let heights =
        |of: &[&Outcome]| -> Vec<Pair> { of.iter().map(|outcome| outcome.height).collect() };
    let all: Vec<Pair> = flown.iter().map(|outcome| outcome.height).collect();
    Sheet {
        charts: vec![
            dotted("Width", "m", |outcome| Some(outcome.width)),
            chart("Height", "m", &all)
                .with(Series::new("known", Mark::Dots, points(&heights(&known))))
                .with(Series::new(
                    "told as not known",
                    Mark::Dots,
                    points(&heights(&unknown)),
                )),
            dotted("Speed of the head", "m/s", |outcome| outcome.speed),
            dotted("Direction of the head", "deg", |outcome| outcome.azimuth),
        ],
        columns: 2,
    }
}
