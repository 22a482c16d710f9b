//! What all methods look at: one target's surroundings in both eyes, and which pixels are flame.

use super::patch::{Area, Colour, Cutter, Gray};
use super::reach::honest;
use super::{Disparity, Method, Miss, RangeConfig, RangeError, RawPair, Refusal, Target};
use crate::detect::DetectionClass;
use opencv::core::Mat;

/// Disparities that are tried, whole pixels, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Search {
    pub least: i32,
    pub greatest: i32,
}

impl Search {
    pub fn all(self) -> impl Iterator<Item = i32> {
        self.least..=self.greatest
    }
}

/// Neighbouring pixels of one row: columns from and to, end excluded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Run {
    pub row: i32,
    pub from: i32,
    pub to: i32,
}

/// Some pixels of an area.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Mask {
    pub area: Area,
    pub kept: Vec<bool>,
}

impl Mask {
    pub fn count(&self) -> usize {
        self.kept.iter().filter(|kept| **kept).count()
    }

    /// Every pixel within `reach` columns and rows of one that is kept.
    pub fn grown(&self, reach: usize) -> Self {
        let (width, height) = (self.area.width(), self.area.height());
        let mut wide = vec![false; self.kept.len()];
        for (k, _) in self.kept.iter().enumerate().filter(|(_, kept)| **kept) {
            let (row, column) = (k / width, k % width);
            let last = (column + reach).min(width - 1);
            wide[row * width + column.saturating_sub(reach)..=row * width + last].fill(true);
        }
        let mut kept = vec![false; self.kept.len()];
        for row in 0..height {
            let reached = row.saturating_sub(reach)..=(row + reach).min(height - 1);
            for near in reached {
                for column in 0..width {
                    kept[near * width + column] |= wide[row * width + column];
                }
            }
        }
        Self {
            area: self.area,
            kept,
        }
    }

    pub fn runs(&self) -> Vec<Run> {
        let mut runs = Vec::new();
        for (row, kept) in (self.area.top..).zip(self.kept.chunks(self.area.width().max(1))) {
            let mut from = None;
            for (column, kept) in (self.area.left..).zip(kept.iter().chain([&false])) {
                match (from, *kept) {
                    (None, true) => from = Some(column),
                    (Some(first), false) => {
                        runs.push(Run {
                            row,
                            from: first,
                            to: column,
                        });
                        from = None;
                    }
                    _ => {}
                }
            }
        }
        runs
    }

    /// Mean column and row.
    pub fn centroid(&self) -> (f64, f64) {
        let width = self.area.width();
        let (mut n, mut u, mut v) = (0.0, 0.0, 0.0);
        for (k, _) in self.kept.iter().enumerate().filter(|(_, kept)| **kept) {
            n += 1.0;
            u += (k % width) as f64;
            v += (k / width) as f64;
        }
        (
            u / n + f64::from(self.area.left),
            v / n + f64::from(self.area.top),
        )
    }
}

/// One target in one pair.
pub(super) struct Scene<'a> {
    pub cutter: &'a Cutter,
    pub left_bgr: &'a Mat,
    /// The box, rectified.
    pub target: Area,
    /// The box and its context.
    pub left: Colour,
    /// The same rows of the right eye, as far as the search reaches, good to whole pixels.
    pub right: Gray,
    pub right_gray: &'a Mat,
    /// The flame, over the left eye's area.
    pub flame: Mask,
    pub search: Search,
    /// Of the rectified pair, pixels.
    pub focal_px: f64,
}

impl<'a> Scene<'a> {
    /// Cuts it out, or says why it can't be ranged.
    pub fn new(
        cutter: &'a Cutter,
        pair: &'a RawPair,
        target: &Target,
        search: Search,
        config: &RangeConfig,
    ) -> Result<Self, Miss> {
        if target.class == DetectionClass::Smoke {
            return Err(Refusal::Smoke.into());
        }
        let Some(right_gray) = &pair.right_gray else {
            return Err(Refusal::NoSecondEye.into());
        };
        let Some(area) = cutter.target(&target.box_px)? else {
            return Err(Refusal::OutsideImage.into());
        };
        let context = config.context_px as i32;
        let around = area.grown(context, context, context);
        let left = cutter.left(&pair.left_bgr, around)?;
        let strip = around.grown(search.greatest.max(0), (-search.least).max(0), 0);
        let right = cutter.right_draft(right_gray, strip)?;
        let flame = flame(&left, &area, config);
        Ok(Self {
            cutter,
            left_bgr: &pair.left_bgr,
            target: area,
            left,
            right,
            right_gray,
            flame,
            search,
            focal_px: cutter.focal_px(),
        })
    }

    /// A method's disparity with the sigma that its errors truly have.
    pub fn honest(&self, method: Method, found: &Disparity) -> Disparity {
        honest(method, found, self.target.width(), self.focal_px)
    }

    /// What the right eye shows `offset` columns from where the left one's context is, exactly.
    pub fn opposite(&self, offset: i32) -> Result<Gray, RangeError> {
        let area = self.left.gray.area.grown(-offset, offset, 0);
        self.cutter.right(self.right_gray, area)
    }

    /// The left eye as far as what the right one shows `offset` columns on may come from there.
    pub fn back(&self, offset: i32) -> Result<Gray, RangeError> {
        let area = self.left.gray.area;
        let area = area.grown(
            -offset - self.search.least,
            offset + self.search.greatest,
            0,
        );
        self.cutter.left_draft(self.left_bgr, area)
    }
}

/// The flame's pixels in the box: those that the gate keeps and that outshine the surroundings.
/// Where that leaves too few (dry grass is as yellow as flame), what the gate keeps; where that is
/// too little as well (a thing in colours that the gate does not know), all of them.
fn flame(left: &Colour, target: &Area, config: &RangeConfig) -> Mask {
    let area = left.gray.area;
    let inside: Vec<bool> = (area.top..area.bottom)
        .flat_map(|row| (area.left..area.right).map(move |column| (column, row)))
        .map(|(column, row)| target.holds(column, row))
        .collect();
    let floor = brightness_around(left, &inside);
    let gate: Vec<bool> = inside
        .iter()
        .zip(&left.bgr)
        .map(|(inside, pixel)| *inside && config.mask.keeps(*pixel))
        .collect();
    let shining = gate
        .iter()
        .zip(&left.bgr)
        .map(|(kept, pixel)| *kept && shine(*pixel) > floor)
        .collect();
    let enough =
        |kept: &Vec<bool>| kept.iter().filter(|kept| **kept).count() >= config.min_support as usize;
    let kept = [shining, gate].into_iter().find(enough).unwrap_or(inside);
    Mask { area, kept }
}

/// How much like flame a pixel shines: bright in red, weak in blue.
fn shine(bgr: [u8; 3]) -> i32 {
    2 * i32::from(bgr[2]) - i32::from(bgr[0])
}

/// Shine that hardly anything around the target exceeds.
fn brightness_around(left: &Colour, inside: &[bool]) -> i32 {
    let mut shines: Vec<i32> = left
        .bgr
        .iter()
        .zip(inside)
        .filter(|(_, inside)| !**inside)
        .map(|(pixel, _)| shine(*pixel))
        .collect();
    if shines.is_empty() {
        return i32::MIN;
    }
    let rank = shines.len() * 95 / 100;
    *shines.select_nth_unstable(rank).1
}
