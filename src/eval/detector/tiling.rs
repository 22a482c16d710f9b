//! What tiles bring: recall of small flames with and without them, at the same false alarms.
//!
//! Pictures that are larger than the network's input are looked at as they are. Smaller ones are shrunk
//! and laid side by side into pictures as large as a camera's, so that their flames are as small as those
//! far away.

use super::coco::Thing;
use super::dataset::{Loaded, Picture};
use super::scores::{ClassScore, Shown, class_score};
use super::{Contender, DetectorEvalError, Options};
use crate::detect::{BoxPx, DetectionClass, DetectorConfig};
use crate::eval::{Report, Table};
use emberfix_report::{Bound, Figure};
use opencv::core::{CV_8UC3, Mat, MatTrait, MatTraitConst, Rect, Scalar, Size};
use opencv::imgproc;

/// Flames of a smaller side are small: the root of their box's area, pixels.
const SMALL_PX: f64 = 16.0;
/// False boxes a picture at which recalls are compared; the first one is the figure's.
const FALSE_BOXES: [f64; 3] = [0.1, 0.3, 1.0];
/// A camera's picture, columns and rows.
const FRAME: (i32, i32) = (1280, 720);
/// Side of a picture in a frame that is laid out of many, pixels.
const CELL: i32 = 128;

/// Recall of small flames at one threshold.
#[derive(Debug, Clone, Copy, serde::Serialize)]
struct Small {
    threshold: f64,
    false_boxes: usize,
    found: usize,
    all: usize,
}

impl Small {
    fn recall(&self) -> Option<f64> {
        (self.all > 0).then(|| self.found as f64 / self.all as f64)
    }
}

/// Measures on these pictures. `told` hears of each picture that is done with.
///
/// # Errors
/// [`DetectorEvalError`].
pub fn measure(
    options: &Options,
    pictures: &[Picture],
    told: &dyn Fn(),
) -> Result<Report, DetectorEvalError> {
    let mut contenders = [
        Contender::load(&options.model)?,
        Contender::tiled(&options.model)?,
    ];
    let (mut shown, mut found) = (Vec::new(), [Vec::new(), Vec::new()]);
    let mut frames = Frames::new(pictures);
    while let Some(Loaded { bgr, truth }) = frames.next(told)? {
        for (contender, found) in contenders.iter_mut().zip(&mut found) {
            found.push(contender.look(&bgr, shown.len())?);
        }
        shown.push(Shown {
            clip: shown.len().to_string(),
            smoke_labelled: false,
            truth,
        });
    }
    let scores = found.map(|found| {
        let shipped = contenders[0].thresholds[0];
        class_score(DetectionClass::Fire, &shown, &found, shipped, options.hz)
    });
    let levels = FALSE_BOXES.map(|rate| {
        let allowed = (rate * shown.len() as f64) as usize;
        [&scores[0], &scores[1]].map(|score| small(score, &shown, allowed))
    });
    Ok(report(shown.len(), &levels))
}

/// Recall of small flames with at most so many false boxes.
fn small(score: &ClassScore, shown: &[Shown], allowed: usize) -> Small {
    let threshold = threshold_for(score, allowed);
    let is_small = |thing: &Thing| (thing.box_px.width * thing.box_px.height).sqrt() < SMALL_PX;
    let fires = |scene: usize| {
        let truth = shown[score.of_picture[scene]].truth.iter();
        truth.filter(|(class, _)| *class == DetectionClass::Fire)
    };
    let sure = score
        .judgement
        .judged
        .iter()
        .filter(|j| j.score >= threshold);
    let found = sure.filter(|judged| {
        let fire = judged
            .truth
            .and_then(|number| fires(judged.scene).nth(number));
        fire.is_some_and(|(_, thing)| is_small(thing))
    });
    let all = (0..score.of_picture.len()).flat_map(fires);
    Small {
        threshold,
        false_boxes: score.judgement.counts(threshold).1,
        found: found.count(),
        all: all.filter(|(_, thing)| is_small(thing)).count(),
    }
}

/// The least threshold with at most so many false boxes.
fn threshold_for(score: &ClassScore, false_boxes: usize) -> f64 {
    let mut wrong = score
        .judgement
        .judged
        .iter()
        .filter(|judged| !judged.is_right());
    wrong
        .nth(false_boxes)
        .map_or(0.0, |judged| judged.score.next_up())
}

fn report(frames: usize, levels: &[[Small; 2]]) -> Report {
    let gain = |[whole, tiled]: &[Small; 2]| Some(tiled.recall()? - whole.recall()?);
    let row = |name: &str, small: &Small| {
        vec![
            name.to_owned(),
            small.false_boxes.to_string(),
            format!("{:.3}", small.threshold),
            format!("{} of {}", small.found, small.all),
            small
                .recall()
                .map_or("-".to_owned(), |recall| format!("{recall:.3}")),
        ]
    };
    let names = [
        "looks at",
        "false boxes",
        "from score",
        "small flames found",
        "recall",
    ];
    let first = levels.first();
    Report {
        figures: vec![Figure::bounded(
            "detector.tiling_recall_gain",
            first.and_then(gain),
            "",
            Bound::AtLeast(0.10),
            first.map_or(0, |[whole, _]| whole.all),
        )],
        details: serde_json::json!({"levels": levels, "frames": frames}),
        tables: vec![Table {
            title: format!(
                "Flames under {SMALL_PX:.0} px in {frames} pictures, at as many false boxes"
            ),
            header: names.map(str::to_owned).to_vec(),
            rows: levels
                .iter()
                .flat_map(|[whole, tiled]| {
                    [row("the whole picture", whole), row("and tiles", tiled)]
                })
                .collect(),
        }],
        plots: vec![],
    }
}

/// Pictures as large as a camera's.
struct Frames<'a> {
    left: std::slice::Iter<'a, Picture>,
}

impl<'a> Frames<'a> {
    fn new(pictures: &'a [Picture]) -> Self {
        Self {
            left: pictures.iter(),
        }
    }

    fn next(&mut self, told: &dyn Fn()) -> Result<Option<Loaded>, DetectorEvalError> {
        let Some(first) = self.left.next() else {
            return Ok(None);
        };
        let first = first.load()?;
        told();
        if first.bgr.cols() >= FRAME.0 / 2 {
            return Ok(Some(first));
        }
        let (columns, rows) = (FRAME.0 / CELL, FRAME.1 / CELL);
        let grey = Scalar::all(114.0);
        let mut laid = Loaded {
            bgr: Mat::new_rows_cols_with_default(FRAME.1, FRAME.0, CV_8UC3, grey)?,
            truth: Vec::new(),
        };
        let mut next = Some(first);
        for cell in 0..columns * rows {
            let picture = match next.take() {
                Some(first) => first,
                None => match self.left.next() {
                    Some(picture) => {
                        told();
                        picture.load()?
                    }
                    None => break,
                },
            };
            lay(
                &mut laid,
                &picture,
                (cell % columns * CELL, cell / columns * CELL),
            )?;
        }
        Ok(Some(laid))
    }
}

/// Shrinks a picture into a cell.
fn lay(laid: &mut Loaded, picture: &Loaded, corner: (i32, i32)) -> opencv::Result<()> {
    let bgr = &picture.bgr;
    let shrink = f64::from(CELL) / f64::from(bgr.cols().max(bgr.rows()));
    let length = |px: i32| ((f64::from(px) * shrink).round() as i32).clamp(1, CELL);
    let size = Size::new(length(bgr.cols()), length(bgr.rows()));
    let mut small = Mat::default();
    imgproc::resize(bgr, &mut small, size, 0.0, 0.0, imgproc::INTER_AREA)?;
    let at = Rect::new(corner.0, corner.1, size.width, size.height);
    small.copy_to(&mut laid.bgr.roi_mut(at)?)?;
    let scale = (
        f64::from(size.width) / f64::from(bgr.cols()),
        f64::from(size.height) / f64::from(bgr.rows()),
    );
    laid.truth
        .extend(picture.truth.iter().map(|(class, thing)| {
            let at = thing.box_px;
            // Edges, not centres, are what shrinks.
            let box_px = BoxPx {
                x: (at.x + 0.5) * scale.0 - 0.5 + f64::from(corner.0),
                y: (at.y + 0.5) * scale.1 - 0.5 + f64::from(corner.1),
                width: at.width * scale.0,
                height: at.height * scale.1,
            };
            let thing = Thing {
                box_px,
                mask: None,
                score: 1.0,
            };
            (*class, thing)
        }));
    Ok(())
}

impl Contender {
    /// The same model, tiles as well.
    fn tiled(config: &DetectorConfig) -> Result<Self, crate::detect::ModelError> {
        let tile_px = DetectorConfig::new("").tile_px;
        Self::load_with(config, tile_px)
    }
}
