//! Ranging as the papers ran it: semi-global matching over the whole frames (P3, P4), then the mean
//! under P3's printed mask, or P4's single reading at the flame's middle.
//!
//! Kept for comparison only. The matcher sees the rows of the flame with 64 px around it and the
//! columns that its disparities reach, which a test shows to be the same as the whole frame there;
//! times are taken over the whole frame.

use super::RangeEvalError;
use super::stats::{mean, median};
use crate::detect::BoxPx;
use crate::range::{HsvMask, RawPair};
use emberfix_calib::{Eye, RawPixel, Rig};
use opencv::calib3d::{StereoSGBM, StereoSGBM_MODE_SGBM};
use opencv::core::{BORDER_CONSTANT, Mat, MatTraitConst, Ptr, Rect, Scalar, Vec3b};
use opencv::imgproc;
use opencv::prelude::StereoMatcherTrait;

/// Whole frames matched, then read in a box.
pub(super) struct FullFrame {
    rig: Rig,
    left: (Mat, Mat),
    right: (Mat, Mat),
    matcher: Ptr<StereoSGBM>,
    num_disparities: i32,
}

/// What the papers' readings give for one box.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Reading {
    /// P3: mean of the valid disparities under its mask.
    pub masked_px: Option<f64>,
    /// P4: the disparity at the middle of the box.
    pub single_px: Option<f64>,
    /// Better than either printed: the median of the valid disparities under our own mask.
    pub median_px: Option<f64>,
    /// Row of the box's middle in the rectified left image.
    pub row: f64,
}

const BLOCK_PX: i32 = 5;
const ROWS_AROUND_PX: i32 = 64;

impl FullFrame {
    pub(super) fn new(rig: &Rig, num_disparities: u32) -> Result<Self, RangeEvalError> {
        let area = BLOCK_PX * BLOCK_PX;
        Ok(Self {
            left: rig.rectification().maps(Eye::Left)?,
            right: rig.rectification().maps(Eye::Right)?,
            rig: rig.clone(),
            num_disparities: num_disparities as i32,
            // Penalties as OpenCV's manual gives them; the cap is P4's.
            matcher: StereoSGBM::create(
                0,
                num_disparities as i32,
                BLOCK_PX,
                8 * area,
                32 * area,
                1,
                15,
                10,
                100,
                2,
                StereoSGBM_MODE_SGBM,
            )?,
        })
    }

    /// Rectifies and matches both whole frames.
    pub(super) fn match_frames(&mut self, pair: &RawPair) -> Result<Option<Mat>, RangeEvalError> {
        let whole = Rect::new(0, 0, self.left.0.cols(), self.left.0.rows());
        Ok(self
            .matched(pair, whole)?
            .map(|(disparities, _)| disparities))
    }

    /// What the papers would read in a box.
    pub(super) fn read(
        &mut self,
        pair: &RawPair,
        box_px: &BoxPx,
    ) -> Result<Reading, RangeEvalError> {
        let Some(target) = self.rectified(box_px)? else {
            return Ok(Reading::default());
        };
        let nothing = Reading {
            row: f64::from(target.y) + 0.5 * f64::from(target.height),
            ..Reading::default()
        };
        let part = self.around(target);
        let Some((disparities, left_bgr)) = self.matched(pair, part)? else {
            return Ok(nothing);
        };
        let inside = target - part.tl();
        Ok(Reading {
            masked_px: mean(&masked(
                &disparities,
                &left_bgr,
                inside,
                &HsvMask::printed(),
            )?),
            median_px: median(&masked(&disparities, &left_bgr, inside, &HsvMask::flame())?),
            single_px: at(
                &disparities,
                inside.x + inside.width / 2,
                inside.y + inside.height / 2,
            )?,
            ..nothing
        })
    }

    /// The median under our mask of a whole frame that was matched before.
    #[cfg(test)]
    pub(super) fn median_in(
        &self,
        disparities: &Mat,
        pair: &RawPair,
        box_px: &BoxPx,
    ) -> Result<Option<f64>, RangeEvalError> {
        let Some(target) = self.rectified(box_px)? else {
            return Ok(None);
        };
        let whole = Rect::new(0, 0, self.left.0.cols(), self.left.0.rows());
        let left_bgr = remapped(&pair.left_bgr, &self.left, whole)?;
        let gate = HsvMask::flame();
        Ok(median(&masked(disparities, &left_bgr, target, &gate)?))
    }

    fn matched(
        &mut self,
        pair: &RawPair,
        part: Rect,
    ) -> Result<Option<(Mat, Mat)>, RangeEvalError> {
        let Some(right) = &pair.right_gray else {
            return Ok(None);
        };
        let left_bgr = remapped(&pair.left_bgr, &self.left, part)?;
        let mut left = Mat::default();
        imgproc::cvt_color_def(&left_bgr, &mut left, imgproc::COLOR_BGR2GRAY)?;
        let right = remapped(right, &self.right, part)?;
        let mut disparities = Mat::default();
        self.matcher.compute(&left, &right, &mut disparities)?;
        Ok(Some((disparities, left_bgr)))
    }

    fn rectified(&self, box_px: &BoxPx) -> Result<Option<Rect>, RangeEvalError> {
        let corner = |u, v| RawPixel { u, v };
        let (right, bottom) = (box_px.x + box_px.width, box_px.y + box_px.height);
        let corners = self.rig.rectification().rectify(
            Eye::Left,
            &[corner(box_px.x, box_px.y), corner(right, bottom)],
        )?;
        let whole = Rect::new(0, 0, self.left.0.cols(), self.left.0.rows());
        let rect = Rect::new(
            corners[0].u.round() as i32,
            corners[0].v.round() as i32,
            (corners[1].u - corners[0].u).round() as i32,
            (corners[1].v - corners[0].v).round() as i32,
        ) & whole;
        Ok((rect.width > 0 && rect.height > 0).then_some(rect))
    }

    fn around(&self, target: Rect) -> Rect {
        let whole = Rect::new(0, 0, self.left.0.cols(), self.left.0.rows());
        // OpenCV's map begins where every disparity has its partner.
        let reach = self.num_disparities + ROWS_AROUND_PX;
        Rect::new(
            target.x - reach,
            target.y - ROWS_AROUND_PX,
            target.width + reach + ROWS_AROUND_PX,
            target.height + 2 * ROWS_AROUND_PX,
        ) & whole
    }
}

fn remapped(image: &Mat, maps: &(Mat, Mat), part: Rect) -> opencv::Result<Mat> {
    let mut found = Mat::default();
    imgproc::remap(
        image,
        &mut found,
        &maps.0.roi(part)?,
        &maps.1.roi(part)?,
        imgproc::INTER_LINEAR,
        BORDER_CONSTANT,
        Scalar::default(),
    )?;
    Ok(found)
}

/// A disparity, if it is valid.
fn at(disparities: &Mat, column: i32, row: i32) -> opencv::Result<Option<f64>> {
    let sixteenths = *disparities.at_2d::<i16>(row, column)?;
    Ok((sixteenths > 0).then(|| f64::from(sixteenths) / 16.0))
}

/// Valid disparities under a mask: P3's text (not its equation 12, which divides by the invalid ones
/// as well: checklist E3).
fn masked(
    disparities: &Mat,
    left_bgr: &Mat,
    inside: Rect,
    gate: &HsvMask,
) -> opencv::Result<Vec<f64>> {
    let mut kept = Vec::new();
    for row in inside.y..inside.y + inside.height {
        for column in inside.x..inside.x + inside.width {
            if gate.keeps(left_bgr.at_2d::<Vec3b>(row, column)?.0) {
                kept.extend(at(disparities, column, row)?);
            }
        }
    }
    Ok(kept)
}
