//! The worst misses and the worst false alarms, as pictures.

use super::coco::Thing;
use super::dataset::{DatasetError, Picture};
use super::scores::{ClassScore, Shown};
use crate::detect::{BoxPx, DetectionClass};
use opencv::core::{CV_8UC3, Mat, MatTrait, MatTraitConst, Point, Rect, Scalar, Size};
use opencv::imgproc;

/// Pictures side by side, and rows of them.
const GRID: (usize, usize) = (6, 4);
/// Side of one, pixels.
const SIDE: i32 = 240;
const TRUTH: (f64, f64, f64) = (80.0, 220.0, 80.0);
const FOUND: (f64, f64, f64) = (60.0, 60.0, 255.0);

/// Why no sheet was drawn.
#[derive(Debug, thiserror::Error)]
pub enum SheetError {
    /// A picture could not be read again.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// OpenCV refused.
    #[error("contact sheet: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// What a sheet shows.
pub struct Reviewed<'a> {
    /// The files.
    pub pictures: &'a [Picture],
    /// What is there.
    pub shown: &'a [Shown],
    /// What was found.
    pub found: &'a [Vec<(DetectionClass, Thing)>],
}

/// Which pictures are worth a look, worst first.
pub struct Worst {
    /// Truths without a finding, the largest first.
    pub misses: Vec<usize>,
    /// Findings without a truth, the surest first.
    pub false_alarms: Vec<usize>,
}

impl Worst {
    /// Of one class, at its shipped threshold.
    #[must_use]
    pub fn of(score: &ClassScore, shown: &[Shown]) -> Self {
        let threshold = score.shipped.threshold;
        let sure = || {
            score
                .judgement
                .judged
                .iter()
                .filter(|j| j.score >= threshold)
        };
        let mut missed: Vec<(f64, usize)> = Vec::new();
        for (scene, &picture) in score.of_picture.iter().enumerate() {
            let truths = shown[picture]
                .truth
                .iter()
                .filter(|(class, _)| *class == score.class);
            for (number, (_, truth)) in truths.enumerate() {
                let found = sure().any(|j| j.scene == scene && j.truth == Some(number));
                if !found {
                    missed.push((truth.box_px.width * truth.box_px.height, picture));
                }
            }
        }
        missed.sort_by(|a, b| b.0.total_cmp(&a.0));
        let wrong = sure().filter(|judged| !judged.is_right());
        Self {
            misses: each_once(missed.into_iter().map(|(_, picture)| picture)),
            false_alarms: each_once(wrong.map(|judged| score.of_picture[judged.scene])),
        }
    }
}

fn each_once(pictures: impl Iterator<Item = usize>) -> Vec<usize> {
    let mut seen = Vec::new();
    for picture in pictures {
        if !seen.contains(&picture) {
            seen.push(picture);
        }
        if seen.len() == GRID.0 * GRID.1 {
            break;
        }
    }
    seen
}

impl Reviewed<'_> {
    /// A grid of pictures: truth green, findings of at least the threshold red with their scores.
    ///
    /// # Errors
    /// [`SheetError`].
    pub fn sheet(
        &self,
        chosen: &[usize],
        class: DetectionClass,
        threshold: f64,
    ) -> Result<Mat, SheetError> {
        let rows = chosen.len().div_ceil(GRID.0).max(1) as i32;
        let (width, height) = (GRID.0 as i32 * SIDE, rows * SIDE);
        let grey = Scalar::all(40.0);
        let mut sheet = Mat::new_rows_cols_with_default(height, width, CV_8UC3, grey)?;
        for (place, &picture) in chosen.iter().enumerate() {
            let (column, row) = ((place % GRID.0) as i32, (place / GRID.0) as i32);
            let drawn = self.drawn(picture, class, threshold)?;
            let at = Rect::new(column * SIDE, row * SIDE, drawn.cols(), drawn.rows());
            drawn.copy_to(&mut sheet.roi_mut(at)?)?;
        }
        Ok(sheet)
    }

    fn drawn(
        &self,
        picture: usize,
        class: DetectionClass,
        threshold: f64,
    ) -> Result<Mat, SheetError> {
        let bgr = self.pictures[picture].load()?.bgr;
        let scale = f64::from(SIDE) / f64::from(bgr.cols().max(bgr.rows()));
        let length = |px: i32| ((f64::from(px) * scale).round() as i32).clamp(1, SIDE);
        let mut small = Mat::default();
        let size = Size::new(length(bgr.cols()), length(bgr.rows()));
        imgproc::resize(&bgr, &mut small, size, 0.0, 0.0, imgproc::INTER_AREA)?;
        for (of, thing) in &self.shown[picture].truth {
            if *of == class {
                outline(&mut small, &thing.box_px, scale, TRUTH)?;
            }
        }
        for (of, thing) in &self.found[picture] {
            if *of == class && thing.score >= threshold {
                outline(&mut small, &thing.box_px, scale, FOUND)?;
                write(
                    &mut small,
                    &format!("{:.2}", thing.score),
                    &thing.box_px,
                    scale,
                )?;
            }
        }
        Ok(small)
    }
}

fn outline(image: &mut Mat, at: &BoxPx, scale: f64, colour: (f64, f64, f64)) -> opencv::Result<()> {
    let px = |length: f64| (length * scale).round() as i32;
    let rect = Rect::new(
        px(at.x),
        px(at.y),
        px(at.width).max(1),
        px(at.height).max(1),
    );
    imgproc::rectangle(image, rect, Scalar::from(colour), 1, imgproc::LINE_8, 0)
}

fn write(image: &mut Mat, text: &str, at: &BoxPx, scale: f64) -> opencv::Result<()> {
    let corner = Point::new((at.x * scale) as i32 + 2, (at.y * scale) as i32 + 11);
    let font = imgproc::FONT_HERSHEY_SIMPLEX;
    let colour = Scalar::from(FOUND);
    imgproc::put_text(
        image,
        text,
        corner,
        font,
        0.35,
        colour,
        1,
        imgproc::LINE_AA,
        false,
    )
}
