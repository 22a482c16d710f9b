//! How much flame a box shows: area times red, of the light of the scene around it.
//!
//! Levels are taken back to light by the cameras' gamma and divided by the scene's own level outside
//! of all boxes, so that an exposure that changes is not taken for a fire that does. A red channel
//! that saturates counts as full: area says the rest.

use crate::detect::BoxPx;
use opencv::core::{Mat, MatTraitConst, Vec3b};
use opencv::prelude::MatTraitConstManual;

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
/// A scene darker than this says nothing of exposure; full light is 1.
const LEAST_SCENE: f64 = 0.002;

/// Median light of the scene outside the boxes, full scale 1. `None` when hardly anything is outside,
/// or it is dark.
pub fn scene_level(bgr: &Mat, boxes: &[BoxPx]) -> Option<f64> {
    let mut levels = Vec::new();
    for row in (0..bgr.rows()).step_by(STRIDE) {
        let pixels = bgr.at_row::<Vec3b>(row).ok()?;
        for (column, pixel) in pixels.iter().enumerate().step_by(STRIDE) {
            if !boxes
                .iter()
                .any(|found| holds(found, column as f64, f64::from(row)))
            {
                levels.push(pixel[1]);
            }
        }
    }
    if levels.len() < 50 {
        return None;
    }
    let middle = levels.len() / 2;
    let (_, median, _) = levels.select_nth_unstable(middle);
    Some(light(*median)).filter(|level| *level >= LEAST_SCENE)
}

/// Flame in a box: the sum of its pixels' red light over the scene's level, pixels. `None` when no
/// pixel is flame: that flame was not seen, not that it is out.
pub fn flame(bgr: &Mat, found: &BoxPx, scene: f64) -> Option<f64> {
    let clamp = |value: f64, size: i32| (value.round() as i32).clamp(0, size);
    let (across, down) = (MARGIN * found.width, MARGIN * found.height);
    let columns =
        clamp(found.x - across, bgr.cols())..clamp(found.x + found.width + across, bgr.cols());
    let rows = clamp(found.y - down, bgr.rows())..clamp(found.y + found.height + down, bgr.rows());
    let mut sum = 0.0;
    for row in rows {
        let pixels = bgr.at_row::<Vec3b>(row).ok()?;
        let inside = pixels.get(columns.start as usize..columns.end as usize)?;
        sum += inside
            .iter()
            .filter(|pixel| is_flame(pixel))
            .map(|pixel| light(pixel[2]))
            .sum::<f64>();
    }
    (sum > 0.0).then_some(sum / scene)
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
    use opencv::core::{CV_8UC3, MatTrait, Scalar};

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
}
