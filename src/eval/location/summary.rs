//! The campaign's figures, tables and details.

use super::cells::{
    ALLOWED_OVER_BOUND, Cell, LawRow, alarms, cell_table, cells, law_row, law_table, of_kind,
};
use super::flight::Kind;
use super::incidents::{FALSE_BOX, MISS, SIGMA_LOOKS, SIGMAS_APART, share_right};
use super::law::Law;
use super::monte_carlo::{Flown, GROUND_SIGMA_M, OBSERVABLE_SHARE};
use super::printed::printed_errors_m;
use super::score::{Scored, consistency};
use super::truth::{ErrorModel, Gnss};
use super::{Campaign, Options, mount, p3, plots};
use crate::eval::{Report, Table};
use emberfix_report::{Bound, Figure};
use serde_json::json;

/// Everything that there is to say.
pub(super) fn report(options: &Options, campaign: &Campaign) -> Report {
    let cells = cells(&campaign.flown);
    let mut laws = vec![law_row(Law::Assumed, &campaign.flown)];
    laws.extend(
        campaign
            .foreign
            .iter()
            .map(|(law, flown)| law_row(*law, flown)),
    );
    let p3 = p3::summary(&campaign.p3);
    let gusty = mount::summary(&campaign.gusty);
    let consumer = mount::summary(&campaign.gusty_consumer);
    let steady = mount::summary(&campaign.steady);
    let mut figures = consistency_figures(campaign);
    let worst = cells
        .iter()
        .filter_map(|c| c.rmse_over_bound)
        .reduce(f64::max);
    let observable = campaign.flown.iter().filter(|f| f.observable).count();
    figures.insert(
        0,
        most(
            "location.rmse_over_bound",
            worst,
            "",
            ALLOWED_OVER_BOUND,
            observable,
        ),
    );
    figures.extend(p3_figures(&p3));
    figures.extend(mount_figures(&gusty, &consumer, &steady));
    figures.extend(incident_figures(campaign));
    figures.extend(time_figures(campaign));
    figures.push(alarmed(&campaign.flown));
    // A part that was not flown has nothing to say.
    figures.retain(|figure| figure.n > 0);
    Report {
        figures,
        details: json!({
            "seed": options.seed,
            "observable": format!(
                "a case counts for RMSE / bound and ANEES where the root of the trace of the \
                 bound's horizontal part is at most that of the receiver's own error and \
                 {OBSERVABLE_SHARE} of the slant range together (root of the sum of squares)"
            ),
            "two_fires": format!(
                "{SIGMAS_APART} sigma: the bound's standard deviation of the difference of the two \
                 positions along the line that joins them, after {SIGMA_LOOKS} looks, no ground; \
                 never nearer than 1.5 of a width of 10 px"
            ),
            "detector": { "missed_share": MISS, "false_box_share": FALSE_BOX },
            "ground_sigma_m": GROUND_SIGMA_M,
            "errors": {
                "consumer": ErrorModel::of(Gnss::Consumer, 1.0),
                "rtk": ErrorModel::of(Gnss::Rtk, 1.0),
                "heading_deg": [0.5, 1.0, 2.0],
            },
            "cells": &cells,
            "worst": least_honest(&campaign.flown),
            "kinds": kinds(&campaign.flown),
            "laws": &laws,
            "p3": p3,
            "p3_printed_m": printed_errors_m(),
            "mount": gusty,
            "mount_consumer": consumer,
            "steady_orbit": steady,
            "one_fire": &campaign.one,
            "two_fires_flown": &campaign.two,
            "step": campaign.times.iter().map(|(fires, ms, kept)| {
                json!({ "fires": fires, "milliseconds": ms, "kept": kept })
            }).collect::<Vec<_>>(),
        }),
        tables: tables(campaign, &cells, &laws),
        plots: plots::plots(&campaign.flown, &cells, &laws),
    }
}

/// The flights whose last alarm was the least honest: where to look first.
fn least_honest(flown: &[Flown]) -> Vec<&Flown> {
    let nees = |f: &Flown| f.last.map_or(0.0, |last| last.nees);
    let mut worst: Vec<&Flown> = flown.iter().collect();
    worst.sort_by(|a, b| nees(b).total_cmp(&nees(a)));
    worst.truncate(WORST);
    worst
}

/// How many of them are shown.
const WORST: usize = 30;

/// Tables of the parts that were flown.
fn tables(campaign: &Campaign, cells: &[Cell], laws: &[LawRow]) -> Vec<Table> {
    let mut tables = Vec::new();
    if !campaign.flown.is_empty() {
        tables.push(cell_table(cells));
    }
    if laws.iter().skip(1).any(|law| law.flights > 0) {
        tables.push(law_table(laws));
    }
    if !campaign.p3.is_empty() {
        tables.push(p3_table(&p3::summary(&campaign.p3)));
    }
    if !campaign.gusty.is_empty() {
        tables.push(mount_table(campaign));
    }
    tables
}

fn most(name: &str, value: Option<f64>, unit: &'static str, limit: f64, n: usize) -> Figure {
    Figure::bounded(name, value, unit, Bound::AtMost(limit), n)
}

fn least(name: &str, value: Option<f64>, unit: &'static str, limit: f64, n: usize) -> Figure {
    Figure::bounded(name, value, unit, Bound::AtLeast(limit), n)
}

/// A mean of nothing is no number.
fn real(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn kinds(flown: &[Flown]) -> serde_json::Value {
    let all = Kind::ALL.map(|kind| json!({ "kind": kind, "observable": of_kind(flown, kind) }));
    json!(all)
}

fn consistency_figures(campaign: &Campaign) -> Vec<Figure> {
    let flown = &campaign.flown;
    let kinds: Vec<_> = Kind::ALL
        .iter()
        .filter_map(|kind| of_kind(flown, *kind))
        .collect();
    let inside = kinds.iter().filter(|kind| kind.anees_is_inside()).count();
    let share = (!kinds.is_empty()).then(|| inside as f64 / kinds.len() as f64);
    let mut figures = vec![least("location.anees_inside", share, "", 1.0, kinds.len())];
    for gnss in Gnss::ALL {
        let of = alarms(flown, gnss);
        figures.push(Figure::bounded(
            format!("location.coverage90_{}", gnss.name()),
            consistency(&of).map(|c| c.coverage90),
            "",
            Bound::Within(0.88, 0.92),
            of.len(),
        ));
    }
    let all: Vec<Scored> = Gnss::ALL.iter().flat_map(|g| alarms(flown, *g)).collect();
    figures.push(Figure::bounded(
        "location.ce90_ratio",
        consistency(&all).map(|c| c.ce90_ratio),
        "",
        Bound::Within(0.9, 1.1),
        all.len(),
    ));
    figures
}

/// A fire that could be placed and is not told is no honest ellipse either.
fn alarmed(flown: &[Flown]) -> Figure {
    let observable: Vec<_> = flown.iter().filter(|f| f.observable).collect();
    let told = observable.iter().filter(|f| f.last.is_some()).count();
    let share = (!observable.is_empty()).then(|| told as f64 / observable.len() as f64);
    Figure::told("location.observable_and_told", share, "", observable.len())
}

fn p3_figures(p3: &p3::P3Summary) -> Vec<Figure> {
    let n = p3.flights;
    vec![
        most(
            "location.p3_horizontal_mean_m",
            real(p3.horizontal_mean_m),
            "m",
            2.0,
            n,
        ),
        most("location.p3_bias_m", real(p3.bias_m), "m", 0.5, n),
        Figure::told(
            "location.p3_printed_method_m",
            real(p3.as_printed_mean_m),
            "m",
            n,
        ),
    ]
}

fn mount_figures(
    gusty: &mount::MountSummary,
    consumer: &mount::MountSummary,
    steady: &mount::MountSummary,
) -> Vec<Figure> {
    let n = gusty.flights;
    let kept = steady.clock_sigma_ms / (1e3 * mount::CLOCK_S);
    vec![
        most(
            "location.boresight_error_deg",
            real(gusty.pointing_rms_deg),
            "deg",
            0.3,
            n,
        ),
        most(
            "location.clock_error_ms",
            real(gusty.clock_rms_ms),
            "ms",
            10.0,
            n,
        ),
        Figure::told(
            "location.boresight_error_consumer_deg",
            real(consumer.pointing_rms_deg),
            "deg",
            n,
        ),
        most(
            "location.clock_error_consumer_ms",
            real(consumer.clock_rms_ms),
            "ms",
            10.0,
            n,
        ),
        least(
            "location.coverage90_before_found_consumer",
            real(consumer.early_coverage90),
            "",
            0.88,
            n,
        ),
        least(
            "location.coverage90_before_found",
            real(gusty.early_coverage90),
            "",
            0.88,
            n,
        ),
        least(
            "location.steady_clock_sigma_kept",
            real(kept),
            "",
            0.5,
            steady.flights,
        ),
        least(
            "location.steady_coverage90",
            real(steady.last_coverage90),
            "",
            0.85,
            steady.flights,
        ),
    ]
}

fn incident_figures(campaign: &Campaign) -> Vec<Figure> {
    let share = |of: &[_]| (!of.is_empty()).then(|| share_right(of));
    let (one, two) = (&campaign.one, &campaign.two);
    vec![
        least(
            "location.one_fire_one_incident",
            share(one),
            "",
            0.99,
            one.len(),
        ),
        least("location.two_fires_two", share(two), "", 0.95, two.len()),
    ]
}

/// What a fire may cost in a frame: 10 ms for a thousand.
const MS_PER_FIRE: f64 = 0.01;

fn time_figures(campaign: &Campaign) -> Vec<Figure> {
    let one = |(fires, ms, kept): &(usize, f64, usize)| {
        let name = format!("location.step_{fires}_fires_ms");
        // A frame that forgot fires was not timed with them.
        let value = (kept >= fires).then_some(*ms);
        most(&name, value, "ms", MS_PER_FIRE * *fires as f64, 1)
    };
    let mut figures: Vec<_> = campaign.times.iter().map(one).collect();
    // Of the largest count over the smallest, each per fire: 1 when the cost is linear.
    if let ([(few, first, _), ..], [.., (many, last, _)]) =
        (&campaign.times[..], &campaign.times[..])
        && few < many
    {
        let growth = (last / *many as f64) / (first / *few as f64);
        figures.push(Figure::told(
            "location.step_cost_growth",
            Some(growth),
            "",
            1,
        ));
    }
    figures
}

fn metres(value: f64) -> String {
    format!("{value:.2}")
}

fn p3_table(p3: &p3::P3Summary) -> Table {
    let row = |what: &str, mean: String, bias: String| vec![what.to_owned(), mean, bias];
    let (mean, bias) = printed_errors_m();
    Table {
        title: "P3's flight after ten sightings, metres".to_owned(),
        header: ["", "mean horizontal error", "constant part"]
            .map(str::to_owned)
            .to_vec(),
        rows: vec![
            row("emberfix", metres(p3.horizontal_mean_m), metres(p3.bias_m)),
            row(
                "Cramér-Rao bound",
                metres(p3.bound_m.0),
                metres(p3.bound_m.1),
            ),
            row(
                "P3's method, corrected (E1, E3, E4, E5)",
                metres(p3.corrected_mean_m),
                "-".into(),
            ),
            row(
                "P3's method with E3 as printed",
                metres(p3.as_printed_mean_m),
                "-".into(),
            ),
            row(
                "P3's method, single looks, corrected",
                metres(p3.single_mean_m),
                "-".into(),
            ),
            row("P3's own flight, as it prints", metres(mean), metres(bias)),
        ],
    }
}

fn mount_table(campaign: &Campaign) -> Table {
    let row = |what: &str, flown: &[mount::MountFlown]| {
        let of = mount::summary(flown);
        vec![
            what.to_owned(),
            of.flights.to_string(),
            metres(of.pointing_rms_deg),
            metres(of.pointing_sigma_deg),
            metres(of.boresight_rms_deg),
            metres(of.clock_rms_ms),
            metres(of.clock_sigma_ms),
            format!("{:.3}", of.early_coverage90),
            format!("{:.3}", of.last_coverage90),
            metres(of.error_rms_m),
        ]
    };
    let header = [
        "orbit",
        "flights",
        "pointing, deg",
        "its sigma, deg",
        "boresight, deg",
        "clock, ms",
        "its sigma, ms",
        "first half in 90 %",
        "last in 90 %",
        "error, m",
    ];
    Table {
        title: "A clock 300 ms off, and in gusts a boresight 3 degrees off (RMS)".to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows: vec![
            row("gusts, RTK", &campaign.gusty),
            row("gusts, consumer", &campaign.gusty_consumer),
            row("steady, consumer", &campaign.steady),
        ],
    }
}
