//! Error and promised error against range; coverage; NEES; RMSE over bound.

use super::cells::{ALLOWED_OVER_BOUND, Cell, LawRow, alarms, of_kind};
use super::flight::Kind;
use super::monte_carlo::Flown;
use super::score::{CHI2_2_90, Scored, mean};
use super::truth::Gnss;
use emberfix_report::{Axis, Chart, Mark, Series, Sheet};

/// Edges of the range classes, metres: about three per octave's third power, enough flights in each.
const RANGES_M: [f64; 10] = [
    10.0, 16.0, 25.0, 40.0, 63.0, 100.0, 160.0, 250.0, 400.0, 500.0,
];

/// All sheets, each with its file name's stem.
#[must_use]
pub fn plots(flown: &[Flown], cells: &[Cell], laws: &[LawRow]) -> Vec<(String, Sheet)> {
    vec![
        ("location-error".to_owned(), errors(flown)),
        ("location-coverage".to_owned(), coverage(flown, laws)),
        ("location-nees".to_owned(), nees(flown)),
        ("location-bound".to_owned(), bounds(cells)),
    ]
}

/// Root mean square of a number in each range class.
fn against_range(flown: &[&Flown], value: fn(&Flown) -> Option<f64>) -> Vec<(f64, f64)> {
    RANGES_M
        .windows(2)
        .filter_map(|ends| {
            let inside = |f: &&&Flown| (ends[0]..ends[1]).contains(&f.case.slant_m);
            let squares: Vec<f64> = flown
                .iter()
                .filter(inside)
                .filter_map(|f| value(f).map(|v| v * v))
                .collect();
            (squares.len() >= 5).then(|| ((ends[0] * ends[1]).sqrt(), mean(squares).sqrt()))
        })
        .collect()
}

fn errors(flown: &[Flown]) -> Sheet {
    let mut charts = Vec::new();
    for gnss in Gnss::ALL {
        for terrain in [false, true] {
            let of: Vec<&Flown> = flown
                .iter()
                .filter(|f| f.case.gnss == gnss && f.case.terrain == terrain && f.observable)
                .collect();
            let ground = if terrain { "ground known" } else { "no ground" };
            let line = |label: &str, mark, value: fn(&Flown) -> Option<f64>| {
                Series::new(label, mark, against_range(&of, value))
            };
            charts.push(
                Chart::new(
                    format!("{}, {ground}: last alarm, all paths", gnss.name()),
                    Axis::log("slant range at the start, m"),
                    Axis::log("horizontal RMS, m"),
                )
                .with(line("P3 as printed, corrected", Mark::LineAndDots, |f| {
                    f.printed_m
                }))
                .with(line("error", Mark::LineAndDots, |f| {
                    f.last.map(|l| l.error_m)
                }))
                .with(line("predicted error", Mark::Line, |f| {
                    f.last.map(|l| l.predicted_m)
                }))
                .with(line("Cramér-Rao bound", Mark::Dashed, |f| f.bound_m)),
            );
        }
    }
    Sheet { charts, columns: 2 }
}

/// Share of alarms whose truth lies inside the ellipse that should hold `share` of them.
fn held(alarms: &[Scored], share: f64) -> f64 {
    let limit = -2.0 * (1.0 - share).ln();
    mean(alarms.iter().map(|a| f64::from(u8::from(a.nees <= limit))))
}

fn coverage(flown: &[Flown], laws: &[LawRow]) -> Sheet {
    let mut promised = Chart::new(
        "Share of alarms inside their ellipse",
        Axis::linear("promised").within(0.0, 1.0),
        Axis::linear("held").within(0.0, 1.0),
    )
    .with(Series::new(
        "honest",
        Mark::Dashed,
        vec![(0.0, 0.0), (1.0, 1.0)],
    ));
    let mut by_range = Chart::new(
        "90 % ellipse against range",
        Axis::log("slant range at the start, m"),
        Axis::linear("held").within(0.6, 1.0),
    )
    .with(Series::new(
        "honest",
        Mark::Dashed,
        vec![(10.0, 0.9), (500.0, 0.9)],
    ));
    for gnss in Gnss::ALL {
        let all = alarms(flown, gnss);
        let curve = (1..40).map(|i| f64::from(i) / 40.0);
        let points = curve.map(|share| (share, held(&all, share))).collect();
        promised = promised.with(Series::new(gnss.name(), Mark::Line, points));
        let of: Vec<&Flown> = flown.iter().filter(|f| f.case.gnss == gnss).collect();
        // A root mean square of zeros and ones is the root of their share.
        let points = against_range(&of, |f| {
            f.last.map(|l| f64::from(u8::from(l.nees <= CHI2_2_90)))
        });
        let points = points.into_iter().map(|(x, y)| (x, y * y)).collect();
        by_range = by_range.with(Series::new(gnss.name(), Mark::LineAndDots, points));
    }
    Sheet {
        charts: vec![promised, by_range, by_law(laws)],
        columns: 3,
    }
}

/// Dots at rows that have a value: the first on top.
fn dots<T>(label: &str, rows: &[T], value: fn(&T) -> Option<f64>) -> Series {
    let rows = rows.iter().enumerate();
    let points = rows.filter_map(|(row, of)| Some((value(of)?, -(row as f64))));
    Series::new(label, Mark::Dots, points.collect())
}

/// A dashed line down all rows.
fn upright(label: &str, x: f64, rows: usize) -> Series {
    let ends = vec![(x, 0.5), (x, 0.5 - rows as f64)];
    Series::new(label, Mark::Dashed, ends)
}

fn by_law(laws: &[LawRow]) -> Chart {
    let names = laws.iter().map(|law| law.errors.to_owned()).collect();
    Chart::new(
        "90 % ellipse under laws that are not assumed",
        Axis::linear("held").within(0.7, 1.0),
        Axis::named(names),
    )
    .with(upright("honest", 0.9, laws.len()))
    .with(dots("consumer", laws, |law| {
        law.consumer.map(|c| c.coverage90)
    }))
    .with(dots("rtk", laws, |law| law.rtk.map(|c| c.coverage90)))
}

fn nees(flown: &[Flown]) -> Sheet {
    let mut spread = Chart::new(
        "NEES of the last alarms against chi-square (2)",
        Axis::linear("NEES").within(0.0, 12.0),
        Axis::log("share above"),
    )
    .with(Series::new(
        "chi-square",
        Mark::Dashed,
        (0..=48)
            .map(|i| f64::from(i) / 4.0)
            .map(|x| (x, (-0.5 * x).exp()))
            .collect(),
    ));
    for kind in Kind::ALL {
        let of = flown.iter().filter(|f| f.case.kind == kind && f.observable);
        let alarms: Vec<f64> = of.filter_map(|f| f.last).map(|l| l.nees).collect();
        let above = |limit: f64| mean(alarms.iter().map(|n| f64::from(u8::from(*n > limit))));
        let points = (0..=48).map(|i| f64::from(i) / 4.0).map(|x| (x, above(x)));
        spread = spread.with(Series::new(kind.name(), Mark::Line, points.collect()));
    }
    Sheet {
        charts: vec![spread, mean_nees(flown)],
        columns: 2,
    }
}

fn mean_nees(flown: &[Flown]) -> Chart {
    let kinds = Kind::ALL.map(|kind| (kind, of_kind(flown, kind)));
    let names = kinds.iter().map(|(kind, _)| kind.name().to_owned());
    let honest = kinds.iter().enumerate().filter_map(|(row, (_, of))| {
        let ends = (*of)?.anees_95;
        Some([ends.0, ends.1].map(|x| (x, -(row as f64))))
    });
    Chart::new(
        "Mean NEES / 2 of each way to fly (above 1: over-confident)",
        Axis::linear("ANEES / 2").within(0.8, 1.2),
        Axis::named(names.collect()),
    )
    .with(Series::new(
        "95 % of honest runs",
        Mark::Spans,
        honest.flatten().collect(),
    ))
    .with(dots("measured", &kinds, |(_, of)| of.map(|of| of.anees)))
}

fn bounds(cells: &[Cell]) -> Sheet {
    let name = |cell: &Cell| {
        let ground = if cell.terrain {
            "ground known"
        } else {
            "no ground"
        };
        format!("{}, {}, {ground}", cell.kind.name(), cell.gnss.name())
    };
    Sheet::of(
        Chart::new(
            "RMSE over the Cramér-Rao bound",
            Axis::log("RMSE / bound"),
            Axis::named(cells.iter().map(name).collect()),
        )
        .with(upright("bound", 1.0, cells.len()))
        .with(upright("allowed", ALLOWED_OVER_BOUND, cells.len()))
        .with(dots("emberfix", cells, |cell| cell.rmse_over_bound))
        .with(dots("P3 as printed, corrected", cells, |cell| {
            cell.printed_over_bound
        })),
    )
}
