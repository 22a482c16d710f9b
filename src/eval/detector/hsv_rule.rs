//! P3's colour gate as a detector by itself: what a rule without learning comes to.
//!
//! Pixels within the gate, grown together over small gaps; each piece is a fire, as sure as its box is
//! full.

use crate::detect::{BoxPx, DetectError, Detection, DetectionClass, Detector, LeftImage};
use crate::range::HsvMask;
use opencv::core::{CV_8UC1, Mat, MatTraitConst, Point, Scalar, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::{MatTraitConstManual, MatTraitManual};

/// Gaps up to this are closed, pixels.
const GAP_PX: i32 = 5;
/// Smaller pieces are noise, share of the picture.
const LEAST_SHARE: f64 = 5e-4;

/// Finds what a colour gate keeps.
pub struct HsvRule(pub HsvMask);

impl Detector for HsvRule {
    fn detect(&mut self, image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        let mut found = pieces(&self.kept(&image.bgr)?)?;
        found.sort_by(|a, b| b.score.total_cmp(&a.score));
        Ok(found)
    }
}

impl HsvRule {
    fn kept(&self, bgr: &Mat) -> opencv::Result<Mat> {
        let mut kept =
            Mat::new_rows_cols_with_default(bgr.rows(), bgr.cols(), CV_8UC1, Scalar::all(0.0))?;
        for row in 0..bgr.rows() {
            let pixels = bgr.at_row::<Vec3b>(row)?;
            for (to, pixel) in kept.at_row_mut::<u8>(row)?.iter_mut().zip(pixels) {
                *to = u8::from(self.0.keeps(pixel.0)) * 255;
            }
        }
        let size = Size::new(GAP_PX, GAP_PX);
        let middle = Point::new(-1, -1);
        let kernel = imgproc::get_structuring_element(imgproc::MORPH_ELLIPSE, size, middle)?;
        let mut closed = Mat::default();
        let border = imgproc::morphology_default_border_value()?;
        imgproc::morphology_ex(
            &kept,
            &mut closed,
            imgproc::MORPH_CLOSE,
            &kernel,
            middle,
            1,
            opencv::core::BORDER_CONSTANT,
            border,
        )?;
        Ok(closed)
    }
}

fn pieces(kept: &Mat) -> opencv::Result<Vec<Detection>> {
    let (mut labels, mut stats, mut centres) = (Mat::default(), Mat::default(), Mat::default());
    let count =
        imgproc::connected_components_with_stats_def(kept, &mut labels, &mut stats, &mut centres)?;
    let least = LEAST_SHARE * f64::from(kept.rows()) * f64::from(kept.cols());
    let mut found = Vec::new();
    // The first is what was not kept.
    for piece in 1..count {
        let of = |what: i32| {
            stats
                .at_2d::<i32>(piece, what)
                .map(|value| f64::from(*value))
        };
        let (width, height) = (of(imgproc::CC_STAT_WIDTH)?, of(imgproc::CC_STAT_HEIGHT)?);
        let area = of(imgproc::CC_STAT_AREA)?;
        if area >= least {
            found.push(Detection {
                class: DetectionClass::Fire,
                score: area / (width * height),
                box_px: BoxPx {
                    x: of(imgproc::CC_STAT_LEFT)? - 0.5,
                    y: of(imgproc::CC_STAT_TOP)? - 0.5,
                    width,
                    height,
                },
                mask: None,
                second_look: None,
            });
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_frames::ServiceTime;
    use opencv::core::{CV_8UC3, Rect};

    #[test]
    fn an_orange_patch_is_a_fire_where_it_is() {
        let grey = Scalar::all(90.0);
        let mut bgr = Mat::new_rows_cols_with_default(100, 100, CV_8UC3, grey).unwrap();
        let orange = Scalar::new(40.0, 120.0, 200.0, 0.0);
        imgproc::rectangle(&mut bgr, Rect::new(20, 30, 10, 12), orange, -1, 8, 0).unwrap();
        let image = LeftImage {
            at: ServiceTime::from_unix_ns(0),
            sequence: 0,
            bgr,
            ground: None,
        };
        let found = HsvRule(HsvMask::printed()).detect(&image).unwrap();
        assert_eq!(found.len(), 1);
        let expected = BoxPx {
            x: 19.5,
            y: 29.5,
            width: 10.0,
            height: 12.0,
        };
        assert_eq!((found[0].box_px, found[0].score), (expected, 1.0));
    }
}
