//! The rectified surroundings of one box, in both eyes, sampled straight from the raw images.
//!
//! No map of a whole image is made and no pixel is touched that neither the box with its context nor
//! the strip of the search covers. Interpolation is cubic at the exact place: OpenCV's `remap` rounds
//! places to 1/32 px, which alone shifts a disparity by up to 1/64 px per eye.

use super::{RangeError, RawPair};
use crate::detect::BoxPx;
use emberfix_calib::{Eye, RawPixel, RectifiedPixel, Rig};
use opencv::core::{CV_8UC1, CV_8UC3, Mat, MatTraitConst};
use opencv::prelude::MatTraitConstManual;
use std::borrow::Cow;

/// Rectified rows and columns, ends excluded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Area {
    pub left: i32,
    pub top: i32,
    pub right: i32,
    pub bottom: i32,
}

impl Area {
    pub fn width(&self) -> usize {
        (self.right - self.left).max(0) as usize
    }

    pub fn height(&self) -> usize {
        (self.bottom - self.top).max(0) as usize
    }

    pub fn grown(&self, left: i32, right: i32, rows: i32) -> Self {
        Self {
            left: self.left - left,
            top: self.top - rows,
            right: self.right + right,
            bottom: self.bottom + rows,
        }
    }

    pub fn holds(&self, column: i32, row: i32) -> bool {
        (self.left..self.right).contains(&column) && (self.top..self.bottom).contains(&row)
    }

    fn within_rows(&self, height: i32) -> Self {
        Self {
            top: self.top.max(0),
            bottom: self.bottom.min(height),
            ..*self
        }
    }
}

/// Grey levels over an area, row by row; beyond the image its edge repeats.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Gray {
    pub area: Area,
    /// Columns that the image really has.
    pub seen: (i32, i32),
    pub values: Vec<f32>,
}

impl Gray {
    pub fn row(&self, row: i32) -> &[f32] {
        let width = self.area.width();
        let first = (row - self.area.top) as usize * width;
        &self.values[first..first + width]
    }

    pub fn at(&self, column: i32, row: i32) -> f32 {
        self.row(row)[(column - self.area.left) as usize]
    }
}

/// Colours of the left eye over an area, row by row, as they came.
pub(super) struct Colour {
    pub area: Area,
    pub bgr: Vec<[u8; 3]>,
}

/// Samples a rig's images.
pub(super) struct Cutter {
    rig: Rig,
}

/// Luma as OpenCV weighs blue, green, red.
pub(super) const LUMA: [f32; 3] = [0.114, 0.587, 0.299];
/// The exact camera model runs at every so many columns and rows, and straight lines between: on a lens
/// that bends by k1 = -0.1 that is within 0.005 px.
const KNOTS_PX: usize = 8;

impl Cutter {
    pub fn new(rig: &Rig) -> Self {
        Self { rig: rig.clone() }
    }

    /// Of the rectified pair, pixels.
    pub fn focal_px(&self) -> f64 {
        self.rig.rectification().focal_px()
    }

    /// What a disparity exceeds that of infinity by, pixels.
    pub fn beyond_infinity_px(&self, disparity_px: f64) -> f64 {
        disparity_px - self.rig.rectification().infinity_disparity_px()
    }

    /// Whether the right eye sees near infrared.
    pub fn two_spectra(&self) -> bool {
        self.rig.right_near_infrared()
    }

    /// Refuses images that are not the rig's.
    pub fn check(&self, pair: &RawPair) -> Result<(), RangeError> {
        let (width, height) = self.size();
        let eyes = [
            Some((&pair.left_bgr, CV_8UC3)),
            pair.right_gray.as_ref().map(|m| (m, CV_8UC1)),
        ];
        for (image, kind) in eyes.into_iter().flatten() {
            let (found_width, found_height) = (image.cols(), image.rows());
            if (found_width, found_height) != (width, height) {
                return Err(RangeError::Size {
                    found_width,
                    found_height,
                    width: width as u32,
                    height: height as u32,
                });
            }
            if image.typ() != kind {
                let found = opencv::core::type_to_string(image.typ())?;
                return Err(RangeError::Pixels { found });
            }
        }
        Ok(())
    }

    fn size(&self) -> (i32, i32) {
        let (width, height) = self.rig.camera(Eye::Left).image_size_px;
        (width as i32, height as i32)
    }

    /// Whole rectified pixels around a raw box, as far as they lie in the image; `None` when nothing does.
    pub fn target(&self, box_px: &BoxPx) -> Result<Option<Area>, RangeError> {
        let at = |across: f64, down: f64| RawPixel {
            u: box_px.x + box_px.width * across,
            v: box_px.y + box_px.height * down,
        };
        // Straight edges bend: the middles of the edges count as well as the corners.
        let outline = [0.0, 0.5, 1.0]
            .map(|a| [0.0, 0.5, 1.0].map(|d| at(a, d)))
            .concat();
        let rectified = self.rig.rectification().rectify(Eye::Left, &outline)?;
        let whole = |pixel: &RectifiedPixel| pixel.u.is_finite() && pixel.v.is_finite();
        if !rectified.iter().all(whole) {
            return Ok(None);
        }
        let least = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::INFINITY, f64::min);
        let (width, height) = self.size();
        let area = Area {
            left: (least(&mut rectified.iter().map(|p| p.u)).floor() as i32).max(0),
            top: (least(&mut rectified.iter().map(|p| p.v)).floor() as i32).max(0),
            right: (-least(&mut rectified.iter().map(|p| -p.u)).floor() as i32 + 1).min(width),
            bottom: (-least(&mut rectified.iter().map(|p| -p.v)).floor() as i32 + 1).min(height),
        };
        Ok((area.width() > 0 && area.height() > 0).then_some(area))
    }

    /// The left eye over an area, whose rows are cut to the image: each place as its nearest pixel.
    pub fn left(&self, image: &Mat, area: Area) -> Result<Colour, RangeError> {
        let area = area.within_rows(self.size().1);
        let raw = Raw::<3>::of(image)?;
        let mut bgr = Vec::with_capacity(area.width() * area.height());
        self.each_place(Eye::Left, area, 1, |u, v| bgr.push(raw.nearest(u, v)));
        Ok(Colour { area, bgr })
    }

    /// The left eye over an area in gray, each place as its nearest pixel: enough to find whole pixels.
    /// Only rows `every` apart are filled.
    pub fn left_draft(&self, image: &Mat, area: Area, every: i32) -> Result<Gray, RangeError> {
        let raw = Raw::<3>::of(image)?;
        Ok(self.draft(Eye::Left, area, every, |u, v| luma(&raw.nearest(u, v))))
    }

    /// The right eye over an area, straight lines between pixels: enough to find whole pixels. Only rows
    /// `every` apart are filled.
    pub fn right_draft(&self, image: &Mat, area: Area, every: i32) -> Result<Gray, RangeError> {
        let raw = Raw::<1>::of(image)?;
        Ok(self.draft(Eye::Right, area, every, |u, v| raw.linear(u, v)))
    }

    fn draft(&self, eye: Eye, area: Area, every: i32, level: impl Fn(f32, f32) -> f32) -> Gray {
        let area = area.within_rows(self.size().1);
        let width = area.width();
        let mut filled = Vec::with_capacity(width * area.height().div_ceil(every as usize));
        let seen = self.each_place(eye, area, every, |u, v| filled.push(level(u, v)));
        if every == 1 {
            return Gray {
                area,
                seen,
                values: filled,
            };
        }
        let mut values = vec![0.0; width * area.height()];
        let rows = (area.top..area.bottom).zip(values.chunks_exact_mut(width.max(1)));
        let rows = rows.filter(|(row, _)| row % every == 0);
        for ((_, line), filled) in rows.zip(filled.chunks_exact(width.max(1))) {
            line.copy_from_slice(filled);
        }
        Gray { area, seen, values }
    }

    /// The left eye over an area in gray, at the exact places.
    pub fn left_gray(&self, image: &Mat, area: Area) -> Result<Gray, RangeError> {
        self.left_mixed(image, area, LUMA)
    }

    /// The left eye over an area at the exact places, in a mixture of blue, green and red.
    pub fn left_mixed(
        &self,
        image: &Mat,
        area: Area,
        mixture: [f32; 3],
    ) -> Result<Gray, RangeError> {
        let area = area.within_rows(self.size().1);
        let raw = Raw::<3>::of(image)?;
        let crop = self.crop(Eye::Left, &raw, area, |bgr| mixed(bgr, mixture));
        let mut values = Vec::with_capacity(area.width() * area.height());
        let seen = self.each_place(Eye::Left, area, 1, |u, v| values.push(crop.cubic(u, v)));
        Ok(Gray { area, seen, values })
    }

    /// The right eye over an area, at the exact places.
    pub fn right(&self, image: &Mat, area: Area) -> Result<Gray, RangeError> {
        let area = area.within_rows(self.size().1);
        let raw = Raw::<1>::of(image)?;
        let crop = self.crop(Eye::Right, &raw, area, |[value]| f32::from(*value));
        let mut values = Vec::with_capacity(area.width() * area.height());
        let seen = self.each_place(Eye::Right, area, 1, |u, v| values.push(crop.cubic(u, v)));
        Ok(Gray { area, seen, values })
    }

    /// The raw pixels that an area may need, each as one number.
    fn crop<const N: usize>(
        &self,
        eye: Eye,
        raw: &Raw<'_, N>,
        area: Area,
        level: impl Fn(&[u8; N]) -> f32,
    ) -> Crop {
        let mut low = (f32::INFINITY, f32::INFINITY);
        let mut high = (f32::NEG_INFINITY, f32::NEG_INFINITY);
        let edges = [area.top, (area.top + area.bottom) / 2, area.bottom];
        for (u, v) in edges.into_iter().flat_map(|row| self.knots(eye, area, row)) {
            low = (low.0.min(u), low.1.min(v));
            high = (high.0.max(u), high.1.max(v));
        }
        let bound = |value: f32, last: usize| (value.max(0.0) as usize).min(last);
        let left = bound(low.0 - EDGE_PX, raw.columns - 1);
        let top = bound(low.1 - EDGE_PX, raw.rows - 1);
        let right = bound(high.0 + EDGE_PX, raw.columns - 1);
        let bottom = bound(high.1 + EDGE_PX, raw.rows - 1);
        raw.crop(left, top, right + 1, bottom + 1, level)
    }

    /// Hands the raw place of every pixel of an area's rows `every` apart to `take`, row by row; says which
    /// columns the image really has.
    fn each_place(
        &self,
        eye: Eye,
        area: Area,
        every: i32,
        mut take: impl FnMut(f32, f32),
    ) -> (i32, i32) {
        let last_column = (self.size().0 - 1) as f32;
        let mut seen = (area.left, area.right);
        let between =
            |a: (f32, f32), b: (f32, f32), t: f32| (a.0 + (b.0 - a.0) * t, a.1 + (b.1 - a.1) * t);
        let step = KNOTS_PX as i32;
        let (mut upper, mut lower) = (Vec::new(), self.knots(eye, area, area.top));
        for row in area.top..area.bottom {
            let below = (row - area.top) % step;
            if below == 0 {
                upper = lower;
                lower = self.knots(eye, area, row + step);
            }
            if row % every != 0 {
                continue;
            }
            let down = below as f32 / KNOTS_PX as f32;
            let knot = |k: usize| between(upper[k], lower[k], down);
            for k in 0..upper.len() - 1 {
                let (a, b) = (knot(k), knot(k + 1));
                let first = k * KNOTS_PX;
                let outside = a.0.min(b.0) < 0.0 || a.0.max(b.0) > last_column;
                for j in 0..KNOTS_PX.min(area.width() - first) {
                    let (u, v) = between(a, b, j as f32 / KNOTS_PX as f32);
                    if outside {
                        let column = area.left + (first + j) as i32;
                        if u < 0.0 {
                            seen.0 = seen.0.max(column + 1);
                        } else if u > last_column {
                            seen.1 = seen.1.min(column);
                        }
                    }
                    take(u, v);
                }
            }
        }
        seen
    }

    /// Raw places of a row's every `KNOTS_PX`-th column, one beyond the last included.
    fn knots(&self, eye: Eye, area: Area, row: i32) -> Vec<(f32, f32)> {
        let rectification = self.rig.rectification();
        (0..=area.width().div_ceil(KNOTS_PX))
            .map(|k| {
                let raw = rectification.unrectify(
                    eye,
                    RectifiedPixel {
                        u: f64::from(area.left) + (k * KNOTS_PX) as f64,
                        v: f64::from(row),
                    },
                );
                (raw.u as f32, raw.v as f32)
            })
            .collect()
    }
}

fn luma(bgr: &[u8; 3]) -> f32 {
    mixed(bgr, LUMA)
}

fn mixed(bgr: &[u8; 3], mixture: [f32; 3]) -> f32 {
    (0..3).map(|c| mixture[c] * f32::from(bgr[c])).sum()
}

/// Pixels beyond an area that interpolation and the bend of its edges need.
const EDGE_PX: f32 = 4.0;

/// A raw image's bytes.
struct Raw<'a, const N: usize> {
    pixels: Cow<'a, [[u8; N]]>,
    columns: usize,
    rows: usize,
}

impl<'a, const N: usize> Raw<'a, N> {
    fn of(image: &'a Mat) -> Result<Self, RangeError> {
        let pixels = if image.is_continuous() {
            Cow::Borrowed(image.data_bytes()?.as_chunks().0)
        } else {
            Cow::Owned(image.try_clone()?.data_bytes()?.as_chunks().0.to_vec())
        };
        Ok(Self {
            pixels,
            columns: image.cols() as usize,
            rows: image.rows() as usize,
        })
    }

    fn nearest(&self, u: f32, v: f32) -> [u8; N] {
        let column = ((u + 0.5).max(0.0) as i32 as usize).min(self.columns - 1);
        let row = ((v + 0.5).max(0.0) as i32 as usize).min(self.rows - 1);
        self.pixels[row * self.columns + column]
    }

    fn crop(
        &self,
        left: usize,
        top: usize,
        right: usize,
        bottom: usize,
        level: impl Fn(&[u8; N]) -> f32,
    ) -> Crop {
        let mut values = Vec::with_capacity((right - left) * (bottom - top));
        for row in top..bottom {
            let line = &self.pixels[row * self.columns + left..row * self.columns + right];
            values.extend(line.iter().map(&level));
        }
        Crop {
            left: left as f32,
            top: top as f32,
            columns: right - left,
            rows: bottom - top,
            values,
        }
    }
}

impl Raw<'_, 1> {
    fn linear(&self, u: f32, v: f32) -> f32 {
        let u = u.clamp(0.0, (self.columns - 1) as f32);
        let v = v.clamp(0.0, (self.rows - 1) as f32);
        let (column, row) = (u as i32 as usize, v as i32 as usize);
        let (right, below) = (
            (column + 1).min(self.columns - 1),
            (row + 1).min(self.rows - 1),
        );
        let at = |column: usize, row: usize| f32::from(self.pixels[row * self.columns + column][0]);
        let (s, t) = (u - column as f32, v - row as f32);
        let upper = at(column, row) * (1.0 - s) + at(right, row) * s;
        let lower = at(column, below) * (1.0 - s) + at(right, below) * s;
        upper * (1.0 - t) + lower * t
    }
}

/// A part of a raw image, one number a pixel.
struct Crop {
    left: f32,
    top: f32,
    columns: usize,
    rows: usize,
    values: Vec<f32>,
}

impl Crop {
    /// Value between pixels (Catmull and Rom), clipped to what a byte holds; its edges repeat.
    fn cubic(&self, u: f32, v: f32) -> f32 {
        let u = (u - self.left).clamp(0.0, (self.columns - 1) as f32);
        let v = (v - self.top).clamp(0.0, (self.rows - 1) as f32);
        // Signed, because the processor converts those at once.
        let (column, row) = (u as i32 as usize, v as i32 as usize);
        let (across, down) = (cubic(u - column as f32), cubic(v - row as f32));
        let inside = column >= 1 && column + 2 < self.columns && row >= 1 && row + 2 < self.rows;
        if !inside {
            return self.cubic_at_edge((column, row), across, down);
        }
        let first = (row - 1) * self.columns + column - 1;
        let line = |k: usize| {
            let first = first + k * self.columns;
            let taps = &self.values[first..first + 4];
            across[0] * taps[0] + across[1] * taps[1] + across[2] * taps[2] + across[3] * taps[3]
        };
        let sum = down[0] * line(0) + down[1] * line(1) + down[2] * line(2) + down[3] * line(3);
        sum.clamp(0.0, 255.0)
    }

    #[cold]
    fn cubic_at_edge(
        &self,
        (column, row): (usize, usize),
        across: [f32; 4],
        down: [f32; 4],
    ) -> f32 {
        let line = |k: usize| -> f32 {
            let row = (row + k).saturating_sub(1).min(self.rows - 1);
            let at = |j: usize| {
                let column = (column + j).saturating_sub(1).min(self.columns - 1);
                self.values[row * self.columns + column]
            };
            (0..4).map(|j| across[j] * at(j)).sum()
        };
        let sum: f32 = (0..4).map(|k| down[k] * line(k)).sum();
        sum.clamp(0.0, 255.0)
    }
}

/// Catmull and Rom's weights of the four neighbours at a fraction.
fn cubic(t: f32) -> [f32; 4] {
    [
        0.5 * t * (-1.0 + t * (2.0 - t)),
        1.0 + 0.5 * t * t * (-5.0 + 3.0 * t),
        0.5 * t * (1.0 + t * (4.0 - 3.0 * t)),
        0.5 * t * t * (t - 1.0),
    ]
}
