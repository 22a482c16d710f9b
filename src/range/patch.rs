//! The rectified surroundings of one box, in both eyes, without rectifying the whole images.

use super::{RangeError, RawPair};
use crate::detect::BoxPx;
use emberfix_calib::{Eye, RawPixel, Rig};
use opencv::core::{
    BORDER_REPLICATE, CV_8UC1, CV_8UC3, Mat, MatTraitConst, Rect, Scalar, copy_make_border,
};
use opencv::imgproc;

/// Rectifies patches of a rig's images; its maps are made once.
pub(super) struct Cutter {
    rig: Rig,
    left: (Mat, Mat),
    right: (Mat, Mat),
}

/// How far a patch reaches beyond the box, pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Margins {
    /// Context on every side.
    pub context: i32,
    /// Extra columns on the left: the greatest disparity.
    pub left: i32,
    /// Extra columns on the right: disparities below zero.
    pub right: i32,
}

/// Both eyes over the same rectified rows and columns.
pub(super) struct Patch {
    pub left_bgr: Mat,
    pub left_gray: Mat,
    pub right_gray: Mat,
    /// Rectified column and row of the patch's first pixel.
    pub origin: (i32, i32),
    /// The target's box inside the patch.
    pub target: Rect,
    /// Patch columns that the images really have; beyond them pixels repeat.
    pub seen_columns: (i32, i32),
}

impl Cutter {
    pub fn new(rig: &Rig) -> Result<Self, RangeError> {
        let rectification = rig.rectification();
        Ok(Self {
            left: rectification.maps(Eye::Left)?,
            right: rectification.maps(Eye::Right)?,
            rig: rig.clone(),
        })
    }

    /// Refuses images that are not the rig's.
    pub fn check(&self, pair: &RawPair) -> Result<(), RangeError> {
        let (width, height) = self.rig.camera(Eye::Left).image_size_px;
        let eyes = [
            Some((&pair.left_bgr, CV_8UC3)),
            pair.right_gray.as_ref().map(|m| (m, CV_8UC1)),
        ];
        for (image, kind) in eyes.into_iter().flatten() {
            let (found_width, found_height) = (image.cols(), image.rows());
            if (found_width, found_height) != (width as i32, height as i32) {
                return Err(RangeError::Size {
                    found_width,
                    found_height,
                    width,
                    height,
                });
            }
            if image.typ() != kind {
                let found = opencv::core::type_to_string(image.typ())?;
                return Err(RangeError::Pixels { found });
            }
        }
        Ok(())
    }

    /// The patch around a raw box; `None` when nothing of the box is in the rectified image.
    pub fn cut(
        &self,
        left_bgr: &Mat,
        right_gray: &Mat,
        box_px: &BoxPx,
        margins: Margins,
    ) -> Result<Option<Patch>, RangeError> {
        let (width, height) = (self.left.0.cols(), self.left.0.rows());
        let Some(target) = self
            .rectified_box(box_px)?
            .and_then(|b| within(b, width, height))
        else {
            return Ok(None);
        };
        let Margins {
            context,
            left,
            right,
        } = margins;
        let rows = (
            (target.y - context).max(0),
            (target.y + target.height + context).min(height),
        );
        let wanted = (
            target.x - context - left,
            target.x + target.width + context + right,
        );
        let there = (wanted.0.max(0), wanted.1.min(width));
        let seen = Rect::new(there.0, rows.0, there.1 - there.0, rows.1 - rows.0);
        let missing = (there.0 - wanted.0, wanted.1 - there.1);
        let left_bgr = rectified(left_bgr, &self.left, seen, missing)?;
        let mut left_gray = Mat::default();
        imgproc::cvt_color_def(&left_bgr, &mut left_gray, imgproc::COLOR_BGR2GRAY)?;
        Ok(Some(Patch {
            left_gray,
            left_bgr,
            right_gray: rectified(right_gray, &self.right, seen, missing)?,
            origin: (wanted.0, rows.0),
            target: Rect::new(
                target.x - wanted.0,
                target.y - rows.0,
                target.width,
                target.height,
            ),
            seen_columns: (missing.0, missing.0 + seen.width),
        }))
    }

    /// Whole rectified pixels around a raw box, as `(left, top, right, bottom)`, ends excluded.
    fn rectified_box(&self, box_px: &BoxPx) -> Result<Option<[f64; 4]>, RangeError> {
        let BoxPx {
            x,
            y,
            width,
            height,
        } = *box_px;
        let at = |across: f64, down: f64| RawPixel {
            u: x + width * across,
            v: y + height * down,
        };
        // Straight edges bend: the middles of the edges count as well as the corners.
        let outline = [0.0, 0.5, 1.0]
            .map(|a| [0.0, 0.5, 1.0].map(|d| at(a, d)))
            .concat();
        let rectified = self.rig.rectification().rectify(Eye::Left, &outline)?;
        if rectified
            .iter()
            .any(|pixel| !(pixel.u.is_finite() && pixel.v.is_finite()))
        {
            return Ok(None);
        }
        let least = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::INFINITY, f64::min);
        let left = least(&mut rectified.iter().map(|pixel| pixel.u));
        let top = least(&mut rectified.iter().map(|pixel| pixel.v));
        let right = -least(&mut rectified.iter().map(|pixel| -pixel.u));
        let bottom = -least(&mut rectified.iter().map(|pixel| -pixel.v));
        Ok(Some([
            left.floor(),
            top.floor(),
            right.ceil() + 1.0,
            bottom.ceil() + 1.0,
        ]))
    }
}

/// The part of a box that lies in the image.
fn within([left, top, right, bottom]: [f64; 4], width: i32, height: i32) -> Option<Rect> {
    let (left, top) = (left.max(0.0) as i32, top.max(0.0) as i32);
    let (right, bottom) = ((right as i32).min(width), (bottom as i32).min(height));
    (right > left && bottom > top).then(|| Rect::new(left, top, right - left, bottom - top))
}

fn rectified(
    image: &Mat,
    maps: &(Mat, Mat),
    seen: Rect,
    missing: (i32, i32),
) -> opencv::Result<Mat> {
    let mut found = Mat::default();
    imgproc::remap(
        image,
        &mut found,
        &maps.0.roi(seen)?,
        &maps.1.roi(seen)?,
        imgproc::INTER_LINEAR,
        BORDER_REPLICATE,
        Scalar::default(),
    )?;
    if missing == (0, 0) {
        return Ok(found);
    }
    let mut padded = Mat::default();
    let (left, right) = missing;
    copy_make_border(
        &found,
        &mut padded,
        0,
        0,
        left,
        right,
        BORDER_REPLICATE,
        Scalar::default(),
    )?;
    Ok(padded)
}
