//! Sigma, error and bias as pictures.

use super::outcome::{BEST, NAMES};
use super::subpixel::Step;
use super::tables::{Line, Measured};
use emberfix_report::{Axis, Chart, Mark, Series, Sheet};

/// Error and sigma against range of every table that is ours; error of the papers' tables.
pub(super) fn sheets(tables: &[Measured], steps: &[Step]) -> Vec<(String, Sheet)> {
    let far = tables
        .iter()
        .filter(|table| table.series.printed_percent.is_empty());
    let near = tables
        .iter()
        .filter(|table| !table.series.printed_percent.is_empty());
    let far = Sheet {
        charts: far.flat_map(|table| [sigma(table), error(table)]).collect(),
        columns: 2,
    };
    let near = Sheet {
        charts: near.map(error).collect(),
        columns: 3,
    };
    vec![
        ("range_sigma".to_owned(), far),
        ("range_papers".to_owned(), near),
        ("range_subpixel".to_owned(), Sheet::of(subpixel(steps))),
    ]
}

/// The default's stated and true errors of the range, beside Z squared over f b.
fn sigma(table: &Measured) -> Chart {
    let lines = table.lines_of(BEST);
    let focal_baseline = table.cells.first().and_then(|cell| cell.rounds.first());
    let focal_baseline = focal_baseline.map_or(f64::NAN, |round| round.truth.focal_baseline());
    let metres = |px: Option<f64>, line: &Line| {
        Some((
            line.distance_m,
            px? * line.distance_m.powi(2) / focal_baseline,
        ))
    };
    let stated = lines
        .iter()
        .filter_map(|line| metres(line.stated_sigma_px, line));
    let found = lines.iter().filter_map(|line| metres(line.rms_px, line));
    let curve = |px: f64| {
        let points = lines.iter().filter_map(|line| metres(Some(px), line));
        Series::new(
            format!("Z² / (f b) · {px} px"),
            Mark::Dashed,
            points.collect(),
        )
    };
    Chart::new(
        format!(
            "{}: error of the range by its disparity, best",
            table.series.name
        ),
        Axis::log("range, m"),
        Axis::log("one sigma, m"),
    )
    .with(Series::new("stated", Mark::LineAndDots, stated.collect()))
    .with(Series::new("found", Mark::Dots, found.collect()))
    .with(curve(0.05))
    .with(curve(0.2))
}

fn error(table: &Measured) -> Chart {
    let axes = (
        Axis::log("range, m"),
        Axis::log("mean error, % of the range").within(0.05, 2000.0),
    );
    let mut chart = Chart::new(format!("{}: error", table.series.name), axes.0, axes.1);
    for (method, name) in NAMES.into_iter().enumerate() {
        let points = table.lines_of(method);
        let points = points
            .iter()
            .filter_map(|line| Some((line.distance_m, line.error_percent?)));
        let mark = if method == BEST {
            Mark::LineAndDots
        } else {
            Mark::Line
        };
        chart = chart.with(Series::new(name, mark, points.collect()));
    }
    let printed = table.series.distances_m.iter().copied();
    let printed: Vec<(f64, f64)> = printed
        .zip(table.series.printed_percent.iter().copied())
        .collect();
    if printed.is_empty() {
        return chart;
    }
    chart.with(Series::new("printed", Mark::Dashed, printed))
}

fn subpixel(steps: &[Step]) -> Chart {
    let mut chart = Chart::new(
        "Bias over the fraction of a pixel",
        Axis::linear("fraction of the disparity, px"),
        Axis::linear("mean error, px").within(-0.4, 0.6),
    );
    for (method, name) in NAMES.into_iter().enumerate() {
        let points = steps
            .iter()
            .filter_map(|step| Some((step.fraction_px, step.methods[method].bias_px?)));
        chart = chart.with(Series::new(name, Mark::LineAndDots, points.collect()));
    }
    chart
}
