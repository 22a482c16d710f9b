//! Sigma, error and bias as pictures.

use super::outcome::{BEST, NAMES};
use super::subpixel::Step;
use super::tables::{Line, Measured};
use super::takeover::{Predicted, predicted};
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

/// The default's stated and true errors of the range, beside Z squared over f b, and what takes over from
/// them. Medians: a few flames half behind something would otherwise stand for all.
fn sigma(table: &Measured) -> Chart {
    let lines = table.lines_of(BEST);
    let focal_baseline = table.cells.first().and_then(|cell| cell.rounds.first());
    let focal_baseline = focal_baseline.map_or(f64::NAN, |round| round.truth.focal_baseline());
    let by_disparity = |px: f64, range_m: f64| px * range_m.powi(2) / focal_baseline;
    let series = |px: &dyn Fn(&Line) -> Option<f64>| -> Vec<(f64, f64)> {
        let point = |line: &Line| Some((line.distance_m, by_disparity(px(line)?, line.distance_m)));
        lines.iter().filter_map(point).collect()
    };
    let rig = table.series.rig.rig().ok();
    let predicted = |of: &dyn Fn(&Predicted) -> Option<f64>| -> Vec<(f64, f64)> {
        let point = |line: &Line| {
            let predicted = predicted(rig.as_ref()?, line.distance_m, line.usual_sigma_px?)?;
            Some((line.distance_m, of(&predicted)?))
        };
        lines.iter().filter_map(point).collect()
    };
    let curve = |px: f64| {
        let label = format!("Z² / (f b) · {px} px");
        Series::new(label, Mark::Dashed, series(&|_| Some(px)))
    };
    let (stated, found) = (
        series(&|line| line.usual_sigma_px),
        series(&|line| line.usual_error_px),
    );
    Chart::new(
        format!("{}: error of the range, best", table.series.name),
        Axis::log("range, m"),
        Axis::log("one sigma, m"),
    )
    .with(Series::new("disparity, stated", Mark::LineAndDots, stated))
    .with(Series::new("disparity, found", Mark::Dots, found))
    .with(curve(0.05))
    .with(Series::new(
        "terrain (1 m) by one sighting",
        Mark::Line,
        predicted(&|predicted| predicted.terrain_m),
    ))
    .with(Series::new(
        "all, flown past for 4 s",
        Mark::LineAndDots,
        predicted(&|predicted| predicted.passed_m),
    ))
}

fn error(table: &Measured) -> Chart {
    let axes = (
        Axis::log("range, m"),
        Axis::log("mean error, % of the range").within(0.1, 200.0),
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
