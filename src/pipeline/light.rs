//! How much flame a box shows: area times red, of the light of the scene around it.
//!
//! Levels are taken back to light by the cameras' gamma and divided by the scene's own level outside
//! of all boxes, so that an exposure that changes is not taken for a fire that does. A red channel
//! that saturates counts as full: area says the rest. Of a near-infrared eye's picture it is what stands
//! out of a box's surroundings: soot and potassium shine there, and smoke is thin.

use crate::detect::BoxPx;
use opencv::core::{DataType, Mat, MatTraitConst, Vec3b};
use opencv::prelude::MatTraitConstManual;
use std::ops::Range;

/// Gamma of the cameras' pictures.
const GAMMA: f64 = 2.2;
/// Red from which a pixel may be flame, grey levels; dimmer ones are ground in the sun.
const LEAST_RED: u8 = 140;
/// A flame's red is above its blue by this many levels at least, unless all channels are full.
const REDDER: i16 = 25;
const FULL: u8 = 250;
/// Every so many-th pixel of the scene, along rows and columns, says what its level is.
const STRIDE: usize = 16;
/// Margin about a box: its edges jitter, light must not.
const MARGIN: f64 = 0.1;
/// Margin at whose edge a box's surroundings are read in near infrared, as a share of it.
const SURROUNDINGS: f64 = 0.5;
/// Grey levels by which a pixel stands out of them; noise does not.
const STANDS_OUT: u8 = 20;
/// A scene darker than this says nothing of exposure; full light is 1.
const LEAST_SCENE: f64 = 0.002;

/// Median light of the scene outside the boxes in the left eye's picture, full scale 1. `None` when
/// hardly anything is outside, or it is dark.
pub fn scene_level(bgr: &Mat, boxes: &[BoxPx]) -> Option<f64> {
    scene(bgr, boxes, |pixel: &Vec3b| pixel[1])
}

/// The same in the right eye's grey picture.
pub fn scene_level_grey(grey: &Mat, boxes: &[BoxPx]) -> Option<f64> {
    scene(grey, boxes, |pixel: &u8| *pixel)
}

fn scene<P: DataType>(image: &Mat, boxes: &[BoxPx], level: impl Fn(&P) -> u8) -> Option<f64> {
    let mut levels = Vec::new();
    for row in (0..image.rows()).step_by(STRIDE) {
        let pixels = image.at_row::<P>(row).ok()?;
        for (column, pixel) in pixels.iter().enumerate().step_by(STRIDE) {
            if !boxes
                .iter()
                .any(|found| holds(found, column as f64, f64::from(row)))
            {
                levels.push(level(pixel));
            }
        }
    }
    if levels.len() < 50 {
        return None;
    }
    Some(light(median(&mut levels)?)).filter(|level| *level >= LEAST_SCENE)
}

fn median(levels: &mut [u8]) -> Option<u8> {
    let middle = levels.len() / 2;
    (!levels.is_empty()).then(|| *levels.select_nth_unstable(middle).1)
}

/// Flame in a box: the sum of its pixels' red light over the scene's level, pixels. `None` when no
/// pixel is flame: that flame was not seen, not that it is out.
pub fn flame(bgr: &Mat, found: &BoxPx, scene: f64) -> Option<f64> {
    let (columns, rows) = inside(bgr, found, MARGIN);
    let mut sum = 0.0;
    for row in rows {
        let pixels = bgr.at_row::<Vec3b>(row).ok()?;
        sum += pixels
            .get(columns.clone())?
            .iter()
            .filter(|pixel| is_flame(pixel))
            .map(|pixel| light(pixel[2]))
            .sum::<f64>();
    }
    (sum > 0.0).then_some(sum / scene)
}

/// Near-infrared light in a box of the right eye: the sum of its pixels above what surrounds it, over
/// the scene's level, pixels. `None` when nothing stands out: it was not seen, not that it is out.
pub fn near_infrared(grey: &Mat, found: &BoxPx, scene: f64) -> Option<f64> {
    let around = surroundings(grey, found)?;
    let (columns, rows) = inside(grey, found, MARGIN);
    let mut sum = 0.0;
    for row in rows {
        let pixels = grey.at_row::<u8>(row).ok()?;
        sum += pixels
            .get(columns.clone())?
            .iter()
            .filter(|level| **level >= around.saturating_add(STANDS_OUT))
            .map(|level| light(*level) - light(around))
            .sum::<f64>();
    }
    (sum > 0.0).then_some(sum / scene)
}

/// Median grey level along the edge of a box that is larger by [`SURROUNDINGS`].
fn surroundings(grey: &Mat, found: &BoxPx) -> Option<u8> {
    let (columns, rows) = inside(grey, found, SURROUNDINGS);
    let mut levels = Vec::new();
    for row in rows.clone() {
        let pixels = grey.at_row::<u8>(row).ok()?.get(columns.clone())?;
        if row == rows.start || row + 1 == rows.end {
            levels.extend_from_slice(pixels);
        } else {
            levels.extend(pixels.first());
            levels.extend(pixels.last());
        }
    }
    median(&mut levels)
}

/// Columns and rows of a box with a margin, as a share of it, that the picture holds.
fn inside(image: &Mat, found: &BoxPx, margin: f64) -> (Range<usize>, Range<i32>) {
    let clamp = |value: f64, size: i32| (value.round() as i32).clamp(0, size);
    let (across, down) = (margin * found.width, margin * found.height);
    let columns =
        clamp(found.x - across, image.cols())..clamp(found.x + found.width + across, image.cols());
    let rows =
        clamp(found.y - down, image.rows())..clamp(found.y + found.height + down, image.rows());
    (columns.start as usize..columns.end as usize, rows)
}

fn is_flame(pixel: &Vec3b) -> bool {
    let redder = i16::from(pixel[2]) - i16::from(pixel[0]) >= REDDER;
    pixel[2] >= LEAST_RED && (redder || pixel.iter().all(|level| *level >= FULL))
}

fn light(level: u8) -> f64 {
    (f64::from(level) / 255.0).powf(GAMMA)
}

fn holds(found: &BoxPx, column: f64, row: f64) -> bool {
    (found.x..found.x + found.width).contains(&column)
        && (found.y..found.y + found.height).contains(&row)
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::{CV_8UC1, CV_8UC3, MatTrait, Scalar};

    const BOX: BoxPx = BoxPx {
        x: 100.0,
        y: 100.0,
        width: 40.0,
        height: 40.0,
    };

    /// A grey scene with a flame of so many pixels, all of it under one gain.
    fn scene(flame_px: i32, gain: f64) -> Mat {
        let level = |of_full: f64| 255.0 * (of_full * gain).min(1.0).powf(1.0 / GAMMA);
        let grey = level(0.1);
        let mut bgr =
            Mat::new_rows_cols_with_default(300, 400, CV_8UC3, Scalar::new(grey, grey, grey, 0.0))
                .unwrap();
        for k in 0..flame_px {
            let pixel = bgr.at_2d_mut::<Vec3b>(105 + k / 30, 105 + k % 30).unwrap();
            *pixel = Vec3b::from([level(0.05) as u8, level(0.2) as u8, level(0.5) as u8]);
        }
        bgr
    }

    fn shown(flame_px: i32, gain: f64) -> Option<f64> {
        let bgr = scene(flame_px, gain);
        flame(&bgr, &BOX, scene_level(&bgr, &[BOX]).unwrap())
    }

    #[test]
    fn twice_the_flame_is_twice_the_signal_and_exposure_is_none() {
        let one = shown(200, 1.0).unwrap();
        assert!((shown(400, 1.0).unwrap() / one - 2.0).abs() < 0.01);
        for gain in [0.7, 1.6] {
            let other = shown(200, gain).unwrap();
            // Eight-bit levels.
            assert!(
                (other / one - 1.0).abs() < 0.05,
                "{gain}: {other} against {one}"
            );
        }
    }

    #[test]
    fn no_flame_pixel_is_a_missing_sample_and_a_black_scene_has_no_level() {
        assert_eq!(shown(0, 1.0), None);
        let black = Mat::new_rows_cols_with_default(300, 400, CV_8UC3, Scalar::all(0.0)).unwrap();
        assert_eq!(scene_level(&black, &[]), None);
    }

    /// A grey picture with a bright square in the box, all of it under one gain.
    fn grey_scene(side_px: i32, of_full: f64, gain: f64) -> Mat {
        let level = |of_full: f64| 255.0 * (of_full * gain).min(1.0).powf(1.0 / GAMMA);
        let mut grey =
            Mat::new_rows_cols_with_default(300, 400, CV_8UC1, Scalar::all(level(0.15))).unwrap();
        for k in 0..side_px * side_px {
            let pixel = grey
                .at_2d_mut::<u8>(105 + k / side_px, 105 + k % side_px)
                .unwrap();
            *pixel = level(of_full) as u8;
        }
        grey
    }

    fn shown_in_infrared(side_px: i32, of_full: f64, gain: f64) -> Option<f64> {
        let grey = grey_scene(side_px, of_full, gain);
        near_infrared(&grey, &BOX, scene_level_grey(&grey, &[BOX]).unwrap())
    }

    #[test]
    fn near_infrared_is_what_stands_out_of_the_surroundings_whatever_the_exposure() {
        let one = shown_in_infrared(10, 0.5, 1.0).unwrap();
        // 100 pixels of (0.5 - 0.15) / 0.15.
        assert!((one / 233.0 - 1.0).abs() < 0.03, "{one}");
        assert!((shown_in_infrared(20, 0.5, 1.0).unwrap() / one - 4.0).abs() < 0.01);
        for gain in [0.7, 1.6] {
            let other = shown_in_infrared(10, 0.5, gain).unwrap();
            assert!((other / one - 1.0).abs() < 0.05, "{gain}: {other} {one}");
        }
        // Ground in the box that is as bright as around it is no flame.
        assert_eq!(shown_in_infrared(20, 0.15, 1.0), None);
    }

    #[test]
    fn a_box_over_the_edge_of_a_picture_or_outside_of_it_is_no_panic() {
        let grey = grey_scene(10, 0.5, 1.0);
        for (x, y) in [(-20.0, 290.0), (390.0, -30.0), (1e4, 1e4), (-1e4, 0.0)] {
            let outside = BoxPx { x, y, ..BOX };
            assert_eq!(near_infrared(&grey, &outside, 0.15), None);
        }
    }
}
