//! Flights grouped by how they were flown and what they had: the numbers of each group, as tables.

use super::flight::Kind;
use super::law::Law;
use super::monte_carlo::Flown;
use super::score::{self, Consistency, Scored, consistency};
use super::truth::Gnss;
use crate::eval::Table;
use serde::Serialize;

/// Flights of one kind and sensor set.
#[derive(Debug, Clone, Serialize)]
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
    /// Root mean square of each observable flight's error over its own bound.
    pub rmse_over_bound: Option<f64>,
    /// The same of P3's printed method, where it gives a position.
    pub printed_over_bound: Option<f64>,
    /// The same of all looks solved at once: what curvature alone costs.
    pub batch_over_bound: Option<f64>,
    /// Consistency of that.
    pub batch: Option<Consistency>,
    /// Consistency of the last alarms, observable flights.
    pub observable: Option<Consistency>,
    /// Consistency of all last alarms.
    pub last: Option<Consistency>,
    /// Consistency of all first alarms.
    pub first: Option<Consistency>,
}

/// [`Cell::rmse_over_bound`] at most.
pub const ALLOWED_OVER_BOUND: f64 = 1.15;

/// All groups that have flights.
#[must_use]
pub fn cells(flown: &[Flown]) -> Vec<Cell> {
    let mut cells = Vec::new();
    for kind in Kind::ALL {
        for gnss in Gnss::ALL {
            for terrain in [false, true] {
                let is_in = |f: &&Flown| {
                    (f.case.kind, f.case.gnss, f.case.terrain) == (kind, gnss, terrain)
                };
                let of: Vec<_> = flown.iter().filter(is_in).collect();
                if !of.is_empty() {
                    cells.push(cell(kind, gnss, terrain, &of));
                }
            }
        }
    }
    cells
}

fn cell(kind: Kind, gnss: Gnss, terrain: bool, flown: &[&Flown]) -> Cell {
    let observable: Vec<&Flown> = flown.iter().copied().filter(|f| f.observable).collect();
    let scored: Vec<Scored> = observable.iter().filter_map(|f| f.last).collect();
    let all = |of: fn(&Flown) -> Option<Scored>| {
        let alarms: Vec<Scored> = flown.iter().filter_map(|f| of(f)).collect();
        consistency(&alarms)
    };
    Cell {
        kind,
        gnss,
        terrain,
        flights: flown.len(),
        observable_share: observable.len() as f64 / flown.len() as f64,
        alarmed_share: scored.len() as f64 / observable.len().max(1) as f64,
        rmse_over_bound: over_bound(&observable, |f| f.last.map(|l| l.error_m)),
        printed_over_bound: over_bound(&observable, |f| f.printed_m),
        batch_over_bound: over_bound(&observable, |f| f.batch.map(|b| b.error_m)),
        batch: consistency(
            &observable
                .iter()
                .filter_map(|f| f.batch)
                .collect::<Vec<_>>(),
        ),
        observable: consistency(&scored),
        last: all(|f| f.last),
        first: all(|f| f.first),
    }
}

/// Root mean square of errors over their bounds; `None` of none.
fn over_bound(flown: &[&Flown], error_m: fn(&Flown) -> Option<f64>) -> Option<f64> {
    let squares: Vec<f64> = flown
        .iter()
        .filter_map(|f| Some((error_m(f)? / f.bound_m?).powi(2)))
        .collect();
    (!squares.is_empty()).then(|| score::mean(squares).sqrt())
}

/// Consistency of the last alarms of one way to fly, observable flights.
#[must_use]
pub fn of_kind(flown: &[Flown], kind: Kind) -> Option<Consistency> {
    let alarms: Vec<Scored> = flown
        .iter()
        .filter(|f| f.case.kind == kind && f.observable)
        .filter_map(|f| f.last)
        .collect();
    consistency(&alarms)
}

/// First and last alarms of one receiver's flights, observable or not.
#[must_use]
pub fn alarms(flown: &[Flown], gnss: Gnss) -> Vec<Scored> {
    let of = flown.iter().filter(|f| f.case.gnss == gnss);
    of.flat_map(|f| [f.first, f.last]).flatten().collect()
}

fn number(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |v| format!("{v:.3}"))
}

/// The groups for people.
#[must_use]
pub fn cell_table(cells: &[Cell]) -> Table {
    let header = [
        "path",
        "GNSS",
        "ground",
        "flights",
        "observable",
        "alarmed",
        "RMSE/bound",
        "at once",
        "P3/bound",
        "ANEES",
        "at once",
        "95 %",
        "first in 90 %",
        "last in 90 %",
        "CE90 ratio",
    ];
    Table {
        title: "Flights whose errors are as the estimator assumes".to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows: cells.iter().map(cell_row).collect(),
    }
}

fn cell_row(cell: &Cell) -> Vec<String> {
    let interval = |c: Consistency| format!("{:.2}..{:.2}", c.anees_95.0, c.anees_95.1);
    vec![
        cell.kind.name().to_owned(),
        cell.gnss.name().to_owned(),
        if cell.terrain { "known" } else { "-" }.to_owned(),
        cell.flights.to_string(),
        format!("{:.2}", cell.observable_share),
        format!("{:.3}", cell.alarmed_share),
        number(cell.rmse_over_bound),
        number(cell.batch_over_bound),
        number(cell.printed_over_bound),
        number(cell.observable.map(|o| o.anees)),
        number(cell.batch.map(|b| b.anees)),
        cell.observable.map_or("-".to_owned(), interval),
        number(cell.first.map(|f| f.coverage90)),
        number(cell.last.map(|l| l.coverage90)),
        number(cell.last.map(|l| l.ce90_ratio)),
    ]
}

/// How far coverage bends under other laws, one row each.
#[derive(Debug, Clone, Serialize)]
pub struct LawRow {
    /// What the errors come from.
    pub law: Law,
    /// In words.
    pub errors: &'static str,
    /// Flights.
    pub flights: usize,
    /// First and last alarms with a consumer receiver.
    pub consumer: Option<Consistency>,
    /// The same with RTK.
    pub rtk: Option<Consistency>,
}

/// One law's flights.
#[must_use]
pub fn law_row(law: Law, flown: &[Flown]) -> LawRow {
    LawRow {
        law,
        errors: law.name(),
        flights: flown.len(),
        consumer: consistency(&alarms(flown, Gnss::Consumer)),
        rtk: consistency(&alarms(flown, Gnss::Rtk)),
    }
}

/// The laws for people.
#[must_use]
pub fn law_table(rows: &[LawRow]) -> Table {
    let row = |row: &LawRow| {
        let mut cells = vec![row.errors.to_owned(), row.flights.to_string()];
        for all in [row.consumer, row.rtk] {
            cells.push(number(all.map(|c| c.coverage90)));
            cells.push(number(all.map(|c| c.anees)));
        }
        cells
    };
    let header = [
        "errors",
        "flights",
        "consumer in 90 %",
        "ANEES",
        "RTK in 90 %",
        "ANEES",
    ];
    Table {
        title: "The same under laws that the estimator does not assume (first and last alarms)"
            .to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows: rows.iter().map(row).collect(),
    }
}
