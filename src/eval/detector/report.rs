//! Scores as figures, tables and plots.

use super::scores::{
    AtRate, ClassScore, ClipScore, RATES_PER_HOUR, arithmetic_mean, harmonic_mean,
};
use super::{Options, Scored, Spectrum};
use crate::detect::Spent;
use crate::eval::{Report, Table};
use emberfix_report::{Axis, Bound, Chart, Figure, Mark, Series, Sheet};

/// Rows of the table of clips.
const CLIPS: usize = 15;

/// The report on all of them; the first is the one that was asked about.
pub fn report(options: &Options, scored: &[Scored], spent: &Spent) -> Report {
    let first = &scored[0];
    Report {
        figures: figures(options, first, spent),
        details: serde_json::json!({
            "dataset": options.dataset,
            "split": options.split,
            "detectors": scored,
            "milliseconds_per_view": milliseconds(spent),
        }),
        tables: vec![
            fire_table(scored),
            class_table(first),
            rates_table(scored),
            clip_table(&first.classes[0].clips),
            time_table(spent),
        ],
        plots: vec![("detector".to_owned(), sheet(scored))],
    }
}

fn figures(options: &Options, scored: &Scored, spent: &Spent) -> Vec<Figure> {
    let fire = &scored.classes[0];
    let (name, least) = match options.spectrum {
        Spectrum::Visible => ("detector.ap50_fire", 0.75),
        Spectrum::Thermal => ("detector.ap50_thermal", 0.85),
    };
    let told = |name: &str, value: Option<f64>, n: usize| {
        Figure::told(format!("detector.{name}"), value, "", n)
    };
    let ap50 = fire.ap50.map(|interval| interval.value);
    let false_boxes: usize = scored.classes.iter().map(|class| class.false_boxes).sum();
    let per_100 = |count: usize| 100.0 * count as f64 / fire.negatives as f64;
    vec![
        Figure::bounded(name, ap50, "", Bound::AtLeast(least), fire.truths),
        Figure::bounded(
            "detector.false_boxes_per_100",
            (fire.negatives > 0).then(|| per_100(false_boxes)),
            "",
            Bound::AtMost(2.0),
            fire.negatives,
        ),
        Figure::bounded(
            "detector.overhead",
            spent.overhead(),
            "",
            Bound::AtMost(0.10),
            spent.views as usize,
        ),
        told("ap50_95_fire", fire.ap50_95, fire.truths),
        told("precision_fire", Some(fire.shipped.precision), fire.truths),
        told("recall_fire", Some(fire.shipped.recall), fire.truths),
        told("frame_recall_fire", fire.frame_recall, fire.pictures),
        told(
            "calibration_error_fire",
            fire.calibration_error,
            fire.truths,
        ),
        told("mask_ap50_fire", fire.mask_ap.map(|ap| ap[0]), fire.truths),
    ]
}

fn number(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.3}"))
}

fn with_interval(score: &ClassScore) -> String {
    score.ap50.map_or("-".to_owned(), |ap| {
        format!("{:.3} ({:.2} to {:.2})", ap.value, ap.low, ap.high)
    })
}

fn header<const N: usize>(names: [&str; N]) -> Vec<String> {
    names.map(str::to_owned).to_vec()
}

/// AP and what the threshold makes of it, a row for each.
pub fn fire_table(scored: &[Scored]) -> Table {
    let row = |scored: &Scored| {
        let fire = &scored.classes[0];
        let [small, medium, large] = fire.ap50_by_size.map(number);
        let shipped = &fire.shipped;
        vec![
            scored.name.clone(),
            with_interval(fire),
            number(fire.ap50_95),
            small,
            medium,
            large,
            number(Some(shipped.precision)),
            number(Some(shipped.recall)),
            number(Some(shipped.f1)),
            number(fire.frame_recall),
            format!("{} of {}", fire.false_boxes, fire.negatives),
        ]
    };
    let [small, medium, large] = scored[0].classes[0].truths_by_size;
    Table {
        title: format!(
            "Fire, {} boxes in {} pictures ({small} small, {medium} medium, {large} large); intervals over clips, 95 %",
            scored[0].classes[0].truths, scored[0].classes[0].pictures
        ),
        header: header([
            "detector",
            "AP50",
            "AP50-95",
            "AP50 small",
            "medium",
            "large",
            "precision",
            "recall",
            "F1",
            "pictures with a right box",
            "false boxes on negatives",
        ]),
        rows: scored.iter().map(row).collect(),
    }
}

/// P2's table: classes, and their arithmetic and harmonic means.
fn class_table(scored: &Scored) -> Table {
    let there: Vec<&ClassScore> = scored
        .classes
        .iter()
        .filter(|score| score.truths > 0)
        .collect();
    let columns: [fn(&ClassScore) -> f64; 5] = [
        |score| score.shipped.precision,
        |score| score.shipped.recall,
        |score| score.shipped.f1,
        |score| score.ap50.map_or(0.0, |ap| ap.value),
        |score| score.ap50_95.unwrap_or(0.0),
    ];
    let mut rows: Vec<Vec<String>> = there
        .iter()
        .map(|score| {
            let name = format!("{:?}", score.class).to_lowercase();
            let threshold = format!("{:.2}", score.shipped.threshold);
            let mut row = vec![name, score.truths.to_string(), threshold];
            row.extend(columns.map(|column| number(Some(column(score)))));
            row.push(score.mask_ap.map_or("-".to_owned(), |[half, mean]| {
                format!("{half:.3}, {mean:.3}")
            }));
            row
        })
        .collect();
    for (name, mean) in [
        ("arithmetic mean", arithmetic_mean as fn(&[f64]) -> f64),
        ("harmonic mean", harmonic_mean),
    ] {
        let mut row = vec![name.to_owned(), String::new(), String::new()];
        row.extend(columns.map(|column| {
            let values: Vec<f64> = there.iter().map(|score| column(score)).collect();
            number(Some(mean(&values)))
        }));
        row.push(String::new());
        rows.push(row);
    }
    Table {
        title: format!("Classes of {}", scored.name),
        header: header([
            "class",
            "boxes",
            "threshold",
            "precision",
            "recall",
            "F1",
            "AP50",
            "AP50-95",
            "mask AP50, AP50-95",
        ]),
        rows,
    }
}

fn rates_table(scored: &[Scored]) -> Table {
    let row = |scored: &Scored| {
        let at = |at: &AtRate| format!("{:.3} (from {:.2})", at.recall, at.threshold.min(1.0));
        let mut row = vec![scored.name.clone()];
        row.extend(scored.classes[0].at_rates.iter().map(at));
        row
    };
    let mut names = vec!["detector".to_owned()];
    names.extend(RATES_PER_HOUR.map(|rate| format!("{rate:.0} an hour")));
    Table {
        title: format!(
            "Recall of fire where single pictures of {} negatives alarm falsely at most so often",
            scored[0].classes[0].negatives
        ),
        header: names,
        rows: scored.iter().map(row).collect(),
    }
}

fn clip_table(clips: &[ClipScore]) -> Table {
    let row = |clip: &ClipScore| {
        vec![
            clip.clip.clone(),
            clip.pictures.to_string(),
            clip.truths.to_string(),
            clip.right.to_string(),
            clip.wrong.to_string(),
            number(clip.ap50),
        ]
    };
    Table {
        title: format!(
            "Clips where most fires are missed, {} of {}",
            clips.len().min(CLIPS),
            clips.len()
        ),
        header: header(["clip", "pictures", "fires", "found", "false boxes", "AP50"]),
        rows: clips.iter().take(CLIPS).map(row).collect(),
    }
}

fn milliseconds(spent: &Spent) -> [f64; 3] {
    [spent.before, spent.inference, spent.after]
        .map(|time| 1e3 * time.as_secs_f64() / f64::from(spent.views.max(1)))
}

fn time_table(spent: &Spent) -> Table {
    let cells = milliseconds(spent).map(|time| format!("{time:.3}"));
    Table {
        title: "Milliseconds a view of 1280 x 720 pictures, whole and in tiles, one thread"
            .to_owned(),
        header: header(["picture to tensor", "ONNX Runtime", "tensor to detections"]),
        rows: vec![cells.to_vec()],
    }
}

fn sheet(scored: &[Scored]) -> Sheet {
    let curves = scored.iter().fold(
        Chart::new(
            "Fire at IoU 0.5",
            Axis::linear("recall").within(0.0, 1.0),
            Axis::linear("precision").within(0.0, 1.0),
        ),
        |chart, scored| {
            let curve = scored.classes[0].curve.clone();
            chart.with(Series::new(&scored.name, Mark::Line, curve))
        },
    );
    let diagonal = Series::new(
        "right as often as it says",
        Mark::Dashed,
        vec![(0.0, 0.0), (1.0, 1.0)],
    );
    let calibration = scored.iter().fold(
        Chart::new(
            "Calibration of fire",
            Axis::linear("mean score").within(0.0, 1.0),
            Axis::linear("share that is right").within(0.0, 1.0),
        )
        .with(diagonal),
        |chart, scored| {
            let bins = scored.classes[0].reliability.iter();
            let points = bins.map(|bin| (bin.score, bin.right)).collect();
            chart.with(Series::new(&scored.name, Mark::LineAndDots, points))
        },
    );
    Sheet {
        charts: vec![curves, calibration],
        columns: 2,
    }
}
