//! How far off the position is, and whether it says so: a Monte Carlo without pictures.
//!
//! **In:** numbers of flights and a seed. **Out:** the figures of the estimator, next to the
//! Cramér-Rao bound and to P3's printed method on the same sightings. Truth (flight, projection,
//! errors) is written here and in the simulator, apart from the rooms that are measured; those are
//! reached through [`estimator`] only. **Assumptions.** Sightings are what a detector and a matcher
//! would say, with their noise: no pictures are drawn. **Known limits.** One lens model without
//! distortion; plane ground, tilted.

pub mod bound;
pub mod estimator;
pub mod flight;
pub mod law;
pub mod monte_carlo;
pub mod printed;
pub mod score;
pub mod truth;

use super::{Report, Table};
use emberfix_report::{Bound, Figure};
use emberfix_sim::noise::stream;
use estimator::SetupError;
use flight::Kind;
use indicatif::ProgressBar;
use law::Law;
use monte_carlo::{Case, Flown, fly};
use rayon::prelude::*;
use score::{Consistency, Scored, consistency};
use serde_json::json;
use truth::Gnss;

/// What to measure.
#[derive(Debug, Clone)]
pub struct Options {
    /// Flights of the Monte Carlo.
    pub flights: usize,
    /// Flights under each law that the estimator does not assume.
    pub foreign_flights: usize,
    /// Seed of everything.
    pub seed: u64,
    /// Ways to fly.
    pub kinds: Vec<Kind>,
}

impl Options {
    /// Steps of the progress bar.
    #[must_use]
    pub fn total(&self) -> u64 {
        (self.flights + Law::FOREIGN.len() * self.foreign_flights) as u64
    }
}

/// Flies `count` flights under a law, in parallel; the same for a seed whatever the threads.
///
/// # Errors
/// [`SetupError`] when a rig is refused.
pub fn flights(
    options: &Options,
    law: Law,
    count: usize,
    bar: &ProgressBar,
) -> Result<Vec<Flown>, SetupError> {
    let one = |index: usize| {
        let rng = &mut stream(options.seed, &format!("{law:?} {index}"));
        let flown = fly(Case::drawn(rng, &options.kinds, index), law, rng);
        bar.inc(1);
        flown
    };
    (0..count).into_par_iter().map(one).collect()
}

/// Measures everything.
///
/// # Errors
/// [`SetupError`] when a rig is refused.
pub fn measure(options: &Options, bar: &ProgressBar) -> Result<Report, SetupError> {
    let flown = flights(options, Law::Assumed, options.flights, bar)?;
    let mut foreign = Vec::new();
    for law in Law::FOREIGN {
        foreign.push((law, flights(options, law, options.foreign_flights, bar)?));
    }
    let cells = cells(&flown);
    let mut figures = main_figures(&flown, &cells);
    figures.push(Figure::told(
        "location.flights",
        Some(flown.len() as f64),
        "",
        flown.len(),
    ));
    Ok(Report {
        figures,
        details: json!({ "cells": cells }),
        tables: vec![cell_table(&cells), foreign_table(&flown, &foreign)],
        plots: Vec::new(),
    })
}

/// Flights of one kind and sensor set.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Cell {
    /// Way to fly.
    pub kind: Kind,
    /// Receiver.
    pub gnss: Gnss,
    /// Whether the ground is known.
    pub terrain: bool,
    /// Flights.
    pub flights: usize,
    /// Share of them whose position the bound calls observable.
    pub observable_share: f64,
    /// Share of the observable ones with an alarm.
    pub alarmed_share: f64,
    /// RMSE over bound, observable flights; root mean square of each flight's error over its bound.
    pub rmse_over_bound: Option<f64>,
    /// RMSE of P3's printed method over the same bound.
    pub printed_over_bound: Option<f64>,
    /// Consistency of the last alarms, observable flights.
    pub observable: Option<Consistency>,
    /// Consistency of all last alarms.
    pub last: Option<Consistency>,
    /// Consistency of all first alarms.
    pub first: Option<Consistency>,
}

fn cells(flown: &[Flown]) -> Vec<Cell> {
    let mut cells = Vec::new();
    for kind in Kind::ALL {
        for gnss in Gnss::ALL {
            for terrain in [false, true] {
                let of: Vec<_> = flown
                    .iter()
                    .filter(|f| {
                        f.case.kind == kind && f.case.gnss == gnss && f.case.terrain == terrain
                    })
                    .collect();
                if !of.is_empty() {
                    cells.push(cell(kind, gnss, terrain, &of));
                }
            }
        }
    }
    cells
}

fn cell(kind: Kind, gnss: Gnss, terrain: bool, flown: &[&Flown]) -> Cell {
    let observable: Vec<_> = flown.iter().filter(|f| f.observable).collect();
    let last: Vec<Scored> = flown.iter().filter_map(|f| f.last).collect();
    let first: Vec<Scored> = flown.iter().filter_map(|f| f.first).collect();
    let scored: Vec<Scored> = observable.iter().filter_map(|f| f.last).collect();
    let over = |error: fn(&Flown) -> Option<f64>| {
        let squares: Vec<f64> = observable
            .iter()
            .filter_map(|f| Some((error(f)? / f.bound_m?).powi(2)))
            .collect();
        (!squares.is_empty()).then(|| score::mean(squares).sqrt())
    };
    Cell {
        kind,
        gnss,
        terrain,
        flights: flown.len(),
        observable_share: observable.len() as f64 / flown.len() as f64,
        alarmed_share: scored.len() as f64 / observable.len().max(1) as f64,
        rmse_over_bound: over(|f| f.last.map(|l| l.error_m)),
        printed_over_bound: over(|f| f.printed_m),
        observable: consistency(&scored),
        last: consistency(&last),
        first: consistency(&first),
    }
}

fn main_figures(flown: &[Flown], cells: &[Cell]) -> Vec<Figure> {
    let worst = cells
        .iter()
        .filter_map(|cell| cell.rmse_over_bound)
        .max_by(f64::total_cmp);
    let mut figures = vec![Figure::bounded(
        "location.rmse_over_bound",
        worst,
        "",
        Bound::AtMost(1.15),
        flown.len(),
    )];
    for gnss in Gnss::ALL {
        let alarms: Vec<Scored> = flown
            .iter()
            .filter(|f| f.case.gnss == gnss)
            .flat_map(|f| [f.first, f.last])
            .flatten()
            .collect();
        let all = consistency(&alarms);
        figures.push(Figure::bounded(
            format!("location.coverage90_{}", gnss.name()),
            all.map(|c| c.coverage90),
            "",
            Bound::Within(0.88, 0.92),
            alarms.len(),
        ));
    }
    figures
}

fn cell_table(cells: &[Cell]) -> Table {
    let header = [
        "path",
        "GNSS",
        "ground",
        "flights",
        "observable",
        "alarmed",
        "RMSE/bound",
        "P3/bound",
        "ANEES",
        "95 %",
        "cover last",
        "cover first",
        "CE90 ratio",
    ];
    let number = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.3}"));
    let rows = cells
        .iter()
        .map(|c| {
            vec![
                c.kind.name().to_owned(),
                c.gnss.name().to_owned(),
                if c.terrain { "known" } else { "-" }.to_owned(),
                c.flights.to_string(),
                format!("{:.2}", c.observable_share),
                format!("{:.3}", c.alarmed_share),
                number(c.rmse_over_bound),
                number(c.printed_over_bound),
                number(c.observable.map(|o| o.anees)),
                c.observable.map_or("-".to_owned(), |o| {
                    format!("{:.2}..{:.2}", o.anees_95.0, o.anees_95.1)
                }),
                number(c.last.map(|l| l.coverage90)),
                number(c.first.map(|l| l.coverage90)),
                number(c.last.map(|l| l.ce90_ratio)),
            ]
        })
        .collect();
    Table {
        title: "Flights with the errors that the estimator assumes".to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows,
    }
}

fn foreign_table(flown: &[Flown], foreign: &[(Law, Vec<Flown>)]) -> Table {
    let row = |law: Law, flown: &[Flown]| {
        let mut cells = vec![law.name().to_owned(), flown.len().to_string()];
        for gnss in Gnss::ALL {
            let alarms: Vec<_> = flown
                .iter()
                .filter(|f| f.case.gnss == gnss)
                .filter_map(|f| f.last)
                .collect();
            let all = consistency(&alarms);
            cells.push(all.map_or("-".to_owned(), |c| format!("{:.3}", c.coverage90)));
            cells.push(all.map_or("-".to_owned(), |c| format!("{:.2}", c.anees)));
        }
        cells
    };
    let mut rows = vec![row(Law::Assumed, flown)];
    rows.extend(foreign.iter().map(|(law, flown)| row(*law, flown)));
    Table {
        title: "The same under laws that the estimator does not assume (last alarms)".to_owned(),
        header: [
            "errors",
            "flights",
            "consumer cover",
            "ANEES",
            "RTK cover",
            "ANEES",
        ]
        .map(str::to_owned)
        .to_vec(),
        rows,
    }
}
