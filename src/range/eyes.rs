//! Both eyes against each other, over the whole picture: what a rig that holds its calibration shows.
//!
//! **In:** a raw pair, now and then. **Out:** [`EyesCompared`]: places that both eyes see, with their
//! disparity, their vertical offset (0 in a rectified pair), and how bright and how sharp the left eye
//! sees them against the right one. What it means is judged elsewhere.
//!
//! **Assumptions.** The ground has texture. **Known limits.** `remap` rounds places to 1/32 px, which is
//! nothing here. At most [`CORNERS`] places, 0.1 px each.

use super::RawPair;
use emberfix_calib::{Eye, RectifiedPixel, Rig};
use opencv::core::{
    self, CV_32F, Mat, MatTraitConst, Point, Point2f, Rect, Scalar, Vector, no_array,
};
use opencv::imgproc;

/// One place that both eyes see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SamePlace {
    /// In the rectified left image.
    pub left: RectifiedPixel,
    /// `u_left - u_right`, rectified pixels.
    pub disparity_px: f64,
    /// `v_right - v_left`, rectified pixels; 0 when the calibration holds.
    pub vertical_px: f64,
    /// Mean level in the left eye over that in the right one.
    pub gain: f64,
    /// Edges against contrast in the left eye, over the same in the right one.
    pub sharpness: f64,
}

/// What a comparison gave.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EyesCompared {
    /// Places of the left eye that were looked for in the right one.
    pub tried: usize,
    /// Those that were found.
    pub found: Vec<SamePlace>,
}

/// Compares the eyes of one rig.
#[derive(Debug)]
pub struct EyeComparer {
    maps: [(Mat, Mat); 2],
    reach_px: i32,
}

/// Places that are tried at most.
pub const CORNERS: i32 = 90;
/// Corners weaker than this share of the strongest are no texture.
const QUALITY: f64 = 0.02;
/// Apart at least, pixels, so that they are spread over the picture.
const APART_PX: f64 = 28.0;
/// Half the side of a patch, pixels.
const HALF: i32 = 8;
/// Rows up and down that are searched: a rig further off is another rig.
const ROWS: i32 = 6;
/// Columns beyond infinity that are searched.
const BEYOND: i32 = 6;
/// Nearest thing that is looked for, metres.
const NEAREST_M: f64 = 3.0;
/// Furthest disparity that is searched, whatever the rig.
const MOST_PX: f64 = 200.0;
/// Correlation from which a place counts as the same.
const ALIKE: f64 = 0.8;
/// A second place that is as alike as this share makes it ambiguous.
const AMBIGUOUS: f64 = 0.92;

impl EyeComparer {
    /// For a rig.
    ///
    /// # Errors
    /// What OpenCV says.
    pub fn new(rig: &Rig) -> opencv::Result<Self> {
        let rectification = rig.rectification();
        Ok(Self {
            maps: [
                rectification.maps(Eye::Left)?,
                rectification.maps(Eye::Right)?,
            ],
            reach_px: rig.disparity_px(NEAREST_M).clamp(8.0, MOST_PX) as i32,
        })
    }

    /// Compares the eyes of a pair; nothing is found where one is missing.
    ///
    /// # Errors
    /// What OpenCV says.
    pub fn compare(&self, pair: &RawPair) -> opencv::Result<EyesCompared> {
        let Some(right) = &pair.right_gray else {
            return Ok(EyesCompared::default());
        };
        let mut left = Mat::default();
        imgproc::cvt_color_def(&pair.left_bgr, &mut left, imgproc::COLOR_BGR2GRAY)?;
        let left = Side::new(&left, &self.maps[0])?;
        let right = Side::new(right, &self.maps[1])?;
        let mut corners = Vector::<Point2f>::new();
        imgproc::good_features_to_track_def(&left.gray, &mut corners, CORNERS, QUALITY, APART_PX)?;
        let mut compared = EyesCompared::default();
        for corner in corners.iter() {
            let at = Point::new(corner.x.round() as i32, corner.y.round() as i32);
            if let Some((patch, strip)) = self.windows(at, left.gray.size()?) {
                compared.tried += 1;
                compared.found.extend(same(&left, &right, patch, strip)?);
            }
        }
        Ok(compared)
    }

    /// The patch about a place, and the strip of the other eye to search; `None` at the edges.
    fn windows(&self, at: Point, size: core::Size) -> Option<(Rect, Rect)> {
        let side = 2 * HALF + 1;
        let patch = Rect::new(at.x - HALF, at.y - HALF, side, side);
        let strip = Rect::new(
            patch.x - self.reach_px,
            patch.y - ROWS,
            side + self.reach_px + BEYOND,
            side + 2 * ROWS,
        );
        let inside = |r: &Rect| {
            r.x >= 0 && r.y >= 0 && r.x + r.width <= size.width && r.y + r.height <= size.height
        };
        (inside(&patch) && inside(&strip)).then_some((patch, strip))
    }
}

/// One eye, rectified, and its edges.
struct Side {
    gray: Mat,
    edges: Mat,
}

impl Side {
    fn new(raw: &Mat, (columns, rows): &(Mat, Mat)) -> opencv::Result<Self> {
        let (mut gray, mut edges) = (Mat::default(), Mat::default());
        imgproc::remap_def(raw, &mut gray, columns, rows, imgproc::INTER_LINEAR)?;
        imgproc::laplacian_def(&gray, &mut edges, CV_32F)?;
        Ok(Self { gray, edges })
    }

    /// Mean level, and edges over contrast, of a patch.
    fn looks(&self, patch: Rect) -> opencv::Result<(f64, f64)> {
        let spread = |mat: &Mat| -> opencv::Result<(f64, f64)> {
            let (mut mean, mut deviation) = (Scalar::default(), Scalar::default());
            core::mean_std_dev_def(&Mat::roi(mat, patch)?, &mut mean, &mut deviation)?;
            Ok((mean[0], deviation[0]))
        };
        let (mean, contrast) = spread(&self.gray)?;
        let (_, edges) = spread(&self.edges)?;
        Ok((mean, edges / contrast.max(1e-6)))
    }
}

/// The same place in the other eye, if there is one and only one.
fn same(left: &Side, right: &Side, patch: Rect, strip: Rect) -> opencv::Result<Option<SamePlace>> {
    let mut alike = Mat::default();
    imgproc::match_template_def(
        &Mat::roi(&right.gray, strip)?,
        &Mat::roi(&left.gray, patch)?,
        &mut alike,
        imgproc::TM_CCOEFF_NORMED,
    )?;
    let (best, at) = peak(&alike)?;
    let edge = at.x == 0 || at.y == 0 || at.x == alike.cols() - 1 || at.y == alike.rows() - 1;
    if best < ALIKE || edge {
        return Ok(None);
    }
    let value = |x: i32, y: i32| alike.at_2d::<f32>(y, x).map(|value| f64::from(*value));
    let column = f64::from(at.x) + vertex(value(at.x - 1, at.y)?, best, value(at.x + 1, at.y)?);
    let row = f64::from(at.y) + vertex(value(at.x, at.y - 1)?, best, value(at.x, at.y + 1)?);
    let around = Rect::new((at.x - 3).max(0), 0, 7, alike.rows());
    let around = around & Rect::new(0, 0, alike.cols(), alike.rows());
    let mut others = alike.try_clone()?;
    imgproc::rectangle(
        &mut others,
        around,
        Scalar::all(-1.0),
        -1,
        imgproc::LINE_8,
        0,
    )?;
    if peak(&others)?.0 > AMBIGUOUS * best {
        return Ok(None);
    }
    let there = Rect::new(strip.x + at.x, strip.y + at.y, patch.width, patch.height);
    let ((mean, edges), (other_mean, other_edges)) = (left.looks(patch)?, right.looks(there)?);
    Ok(Some(SamePlace {
        left: RectifiedPixel {
            u: f64::from(patch.x + HALF),
            v: f64::from(patch.y + HALF),
        },
        disparity_px: f64::from(patch.x - strip.x) - column,
        vertical_px: f64::from(strip.y - patch.y) + row,
        gain: mean / other_mean.max(1e-6),
        sharpness: edges / other_edges.max(1e-6),
    }))
}

fn peak(alike: &Mat) -> opencv::Result<(f64, Point)> {
    let (mut best, mut at) = (0.0, Point::default());
    core::min_max_loc(
        alike,
        None,
        Some(&mut best),
        None,
        Some(&mut at),
        &no_array(),
    )?;
    Ok((best, at))
}

/// Vertex of the parabola through three neighbours, from the middle one.
fn vertex(before: f64, middle: f64, after: f64) -> f64 {
    let bend = before - 2.0 * middle + after;
    if bend < 0.0 {
        (0.5 * (before - after) / bend).clamp(-0.5, 0.5)
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::rig;
    use emberfix_frames::ServiceTime;
    use opencv::core::{CV_8UC1, Size};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Random blots, smooth enough to interpolate.
    fn texture(seed: u64) -> Mat {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let noise: Vec<u8> = (0..720 * 1280).map(|_| rng.random()).collect();
        let noise = Mat::from_slice(&noise)
            .unwrap()
            .reshape(1, 720)
            .unwrap()
            .clone_pointee();
        let mut smooth = Mat::default();
        imgproc::gaussian_blur_def(&noise, &mut smooth, Size::new(0, 0), 2.0).unwrap();
        let mut strong = Mat::default();
        smooth
            .convert_to(&mut strong, CV_8UC1, 5.0, -512.0)
            .unwrap();
        strong
    }

    fn moved(image: &Mat, left_px: f64, down_px: f64) -> Mat {
        let by = Mat::from_slice_2d(&[[1.0, 0.0, -left_px], [0.0, 1.0, down_px]]).unwrap();
        let mut there = Mat::default();
        imgproc::warp_affine_def(image, &mut there, &by, image.size().unwrap()).unwrap();
        there
    }

    fn compared(right: impl FnOnce(&Mat) -> Mat) -> EyesCompared {
        let left = texture(1);
        let mut left_bgr = Mat::default();
        imgproc::cvt_color_def(&left, &mut left_bgr, imgproc::COLOR_GRAY2BGR).unwrap();
        let pair = RawPair {
            at: ServiceTime::from_unix_ns(0),
            left_bgr,
            right_gray: Some(right(&left)),
        };
        EyeComparer::new(&rig(30.0))
            .unwrap()
            .compare(&pair)
            .unwrap()
    }

    fn middle(compared: &EyesCompared, of: fn(&SamePlace) -> f64) -> f64 {
        let mut all: Vec<f64> = compared.found.iter().map(of).collect();
        all.sort_by(f64::total_cmp);
        all[all.len() / 2]
    }

    #[test]
    fn disparity_and_vertical_offset_are_measured_to_a_tenth_of_a_pixel() {
        let seen = compared(|left| moved(left, 7.3, 0.8));
        assert!(seen.found.len() > 50 && seen.found.len() * 10 > seen.tried * 9);
        assert!((middle(&seen, |s| s.disparity_px) - 7.3).abs() < 0.1);
        assert!((middle(&seen, |s| s.vertical_px) - 0.8).abs() < 0.1);
    }

    #[test]
    fn gain_and_blur_of_one_eye_are_measured() {
        let seen = compared(|left| {
            let mut dark = Mat::default();
            moved(left, 5.0, 0.0)
                .convert_to(&mut dark, CV_8UC1, 0.5, 0.0)
                .unwrap();
            dark
        });
        assert!((middle(&seen, |s| s.gain) - 2.0).abs() < 0.1);
        assert!((middle(&seen, |s| s.sharpness) - 1.0).abs() < 0.1);
        let seen = compared(|left| {
            let mut blurred = Mat::default();
            let there = moved(left, 5.0, 0.0);
            imgproc::gaussian_blur_def(&there, &mut blurred, Size::new(0, 0), 1.5).unwrap();
            blurred
        });
        assert!(middle(&seen, |s| s.sharpness) > 1.3);
    }

    #[test]
    fn nothing_is_found_in_another_picture_or_without_one() {
        let other = compared(|_| texture(2));
        assert!(
            other.tried > 50 && other.found.len() * 10 < other.tried,
            "{}",
            other.found.len()
        );
    }
}
