//! Error and promised error against range; coverage; NEES; RMSE over bound.

use super::cells::{Cell, LawRow, alarms, of_kind};
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
    let mut by_law = Chart::new(
        "90 % ellipse under other laws (order of the table)",
        Axis::linear("law"),
        Axis::linear("held").within(0.6, 1.0),
    )
    .with(Series::new(
        "honest",
        Mark::Dashed,
        vec![(0.0, 0.9), ((laws.len().max(2) - 1) as f64, 0.9)],
    ));
    let of_law = |value: fn(&LawRow) -> Option<f64>| {
        let points = laws.iter().enumerate();
        points
            .filter_map(|(index, law)| Some((index as f64, value(law)?)))
            .collect()
    };
    by_law = by_law
        .with(Series::new(
            "consumer",
            Mark::Dots,
            of_law(|law| law.consumer.map(|c| c.coverage90)),
        ))
        .with(Series::new(
            "rtk",
            Mark::Dots,
            of_law(|law| law.rtk.map(|c| c.coverage90)),
        ));
    Sheet {
        charts: vec![promised, by_range, by_law],
        columns: 3,
    }
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
    let mut mean_of = Chart::new(
        "ANEES / 2 of observable flights and its 95 % interval",
        Axis::linear("hover, straight-in, fly-by, orbit").within(-0.5, 3.5),
        Axis::linear("ANEES / 2"),
    );
    let (mut values, mut ends) = (Vec::new(), (Vec::new(), Vec::new()));
    for (index, kind) in Kind::ALL.into_iter().enumerate() {
        let of = flown.iter().filter(|f| f.case.kind == kind && f.observable);
        let alarms: Vec<f64> = of.filter_map(|f| f.last).map(|l| l.nees).collect();
        let above = |limit: f64| mean(alarms.iter().map(|n| f64::from(u8::from(*n > limit))));
        let points = (0..=48).map(|i| f64::from(i) / 4.0).map(|x| (x, above(x)));
        spread = spread.with(Series::new(kind.name(), Mark::Line, points.collect()));
        if let Some(all) = of_kind(flown, kind) {
            values.push((index as f64, all.anees));
            ends.0.push((index as f64, all.anees_95.0));
            ends.1.push((index as f64, all.anees_95.1));
        }
    }
    mean_of = mean_of
        .with(Series::new("95 % of honest runs", Mark::Dashed, ends.0))
        .with(Series::new("", Mark::Dashed, ends.1))
        .with(Series::new("measured", Mark::Dots, values));
    Sheet {
        charts: vec![spread, mean_of],
        columns: 2,
    }
}

fn bounds(cells: &[Cell]) -> Sheet {
    let points = |value: fn(&Cell) -> Option<f64>| {
        cells
            .iter()
            .enumerate()
            .filter_map(|(index, cell)| Some((index as f64, value(cell)?)))
            .collect()
    };
    let last = cells.len().max(2) as f64 - 1.0;
    Sheet::of(
        Chart::new(
            "RMSE over the Cramér-Rao bound, one dot per row of the table",
            Axis::linear("row"),
            Axis::log("RMSE / bound"),
        )
        .with(Series::new(
            "bound",
            Mark::Dashed,
            vec![(0.0, 1.0), (last, 1.0)],
        ))
        .with(Series::new(
            "allowed",
            Mark::Dashed,
            vec![(0.0, 1.15), (last, 1.15)],
        ))
        .with(Series::new(
            "emberfix",
            Mark::Dots,
            points(|cell| cell.rmse_over_bound),
        ))
        .with(Series::new(
            "P3 as printed, corrected",
            Mark::Dots,
            points(|cell| cell.printed_over_bound),
        )),
    )
}
