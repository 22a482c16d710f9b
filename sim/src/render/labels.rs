//! Where fire and smoke are seen in the left image: boxes for training and for scoring.

use super::PixelBox;
use super::camera::{EyePose, Lens};
use super::solids::Solids;
use super::splats::{SeenSplat, billows, ray_to};
use crate::world::{Burning, BurningClass, Splat, SplatKind, World};

/// A fire or smoke that the left eye sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LabelBox {
    /// Flame or smoke.
    pub class: BurningClass,
    /// Index into [`World::fires`] of what burns; a flame and its plume share it.
    pub fire: usize,
    /// Left edge, raw left pixels; pixel centres at whole numbers.
    pub left_px: f64,
    /// Upper edge.
    pub top_px: f64,
    /// Right edge.
    pub right_px: f64,
    /// Lower edge.
    pub bottom_px: f64,
}

/// A fire or smoke that the left eye sees, and its pixels: those where it holds back so much light that
/// an annotator would call them flame or smoke. What hides a part of a flame hides that part's whole puffs.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelMask {
    /// Around all of it.
    pub label: LabelBox,
    /// First column and row of the raster, raw left pixels.
    first_px: (usize, usize),
    /// Side of the raster's cells, pixels.
    cell_px: usize,
    columns: usize,
    /// Row by row.
    covered: Vec<bool>,
}

impl LabelMask {
    /// Whether a raw left pixel (column, row) is flame or smoke.
    #[must_use]
    pub fn covers(&self, column: u32, row: u32) -> bool {
        let cell = |at: u32, first: usize| Some((at as usize).checked_sub(first)? / self.cell_px);
        let across = cell(column, self.first_px.0).filter(|across| *across < self.columns);
        let down = cell(row, self.first_px.1);
        let index = across.zip(down).map(|(x, y)| y * self.columns + x);
        index.is_some_and(|index| self.covered.get(index).copied().unwrap_or(false))
    }
}

/// Alpha from which an annotator would call a pixel flame or smoke.
fn visible_alpha(class: BurningClass) -> f32 {
    match class {
        BurningClass::Fire => 0.30,
        BurningClass::Smoke => 0.14,
    }
}

/// Smaller than this nobody could label it, pixels.
const SMALLEST_PX: f64 = 3.0;
/// Hidden to a greater share than this it is not labelled.
const MOST_HIDDEN: f64 = 0.8;
/// Boxes longer than this are searched on a coarser raster, pixels.
const RASTER_PX: usize = 256;

pub(super) fn label(
    burning: &Burning,
    world: &World,
    pose: &EyePose,
    lens: &Lens,
    solids: &Solids,
) -> Option<LabelMask> {
    let all = splats(burning, pose, lens);
    let visible: Vec<SeenSplat> = all
        .iter()
        .filter(|(splat, seen)| is_free(splat, seen, world, pose, solids))
        .map(|(_, seen)| *seen)
        .collect();
    if visible.is_empty() || (visible.len() as f64) < (1.0 - MOST_HIDDEN) * all.len() as f64 {
        return None;
    }
    outlined(burning, &visible, world)
}

/// The same of all that is before the lens, whatever stands between.
pub(super) fn unhidden(
    burning: &Burning,
    world: &World,
    pose: &EyePose,
    lens: &Lens,
) -> Option<LabelMask> {
    let all: Vec<SeenSplat> = splats(burning, pose, lens)
        .into_iter()
        .map(|(_, seen)| seen)
        .collect();
    outlined(burning, &all, world)
}

fn splats<'a>(burning: &'a Burning, pose: &EyePose, lens: &Lens) -> Vec<(&'a Splat, SeenSplat)> {
    let kept = |splat: &&Splat| splat.kind != SplatKind::Light;
    let seen = |splat: &'a Splat| SeenSplat::new(splat, pose, lens).map(|seen| (splat, seen));
    burning
        .splats
        .iter()
        .filter(kept)
        .filter_map(seen)
        .collect()
}

fn outlined(burning: &Burning, seen: &[SeenSplat], world: &World) -> Option<LabelMask> {
    let raster = Raster::of(seen, world, visible_alpha(burning.class))?;
    let extent = raster.extent()?;
    let (width, height) = (extent.2 - extent.0, extent.3 - extent.1);
    (width >= SMALLEST_PX && height >= SMALLEST_PX).then_some(LabelMask {
        label: LabelBox {
            class: burning.class,
            fire: burning.fire,
            left_px: extent.0,
            top_px: extent.1,
            right_px: extent.2,
            bottom_px: extent.3,
        },
        first_px: (raster.area.left, raster.area.top),
        cell_px: raster.step,
        columns: raster.columns,
        covered: raster.covered,
    })
}

fn is_free(
    splat: &Splat,
    seen: &SeenSplat,
    world: &World,
    pose: &EyePose,
    solids: &Solids,
) -> bool {
    let ray = ray_to(splat, pose);
    let behind_hill = world.terrain().hit(&pose.origin_m, &ray, 0.98).is_some();
    !behind_hill && !solids.hide(seen.tangents, 0.99 * seen.depth_m)
}

/// Where splats together hold back at least so much light, cell by cell.
struct Raster {
    area: PixelBox,
    /// Side of a cell, pixels.
    step: usize,
    columns: usize,
    covered: Vec<bool>,
}

impl Raster {
    fn of(splats: &[SeenSplat], world: &World, alpha: f32) -> Option<Self> {
        let (first, rest) = splats.split_first()?;
        let area = rest
            .iter()
            .fold(first.extent, |area, splat| area.with(&splat.extent));
        let step = (area.columns().max(area.rows()) / RASTER_PX).max(1);
        let (columns, rows) = (area.columns().div_ceil(step), area.rows().div_ceil(step));
        let mut clear = vec![1.0_f32; columns * rows];
        let billows = billows(world.textures());
        for splat in splats {
            darken(&mut clear, columns, &area, step, splat, &billows);
        }
        Some(Self {
            area,
            step,
            columns,
            covered: clear.iter().map(|clear| *clear < 1.0 - alpha).collect(),
        })
    }

    /// Left, upper, right and lower edge of what is covered, pixels with centres at whole numbers.
    fn extent(&self) -> Option<(f64, f64, f64, f64)> {
        let (mut low, mut high) = ((usize::MAX, usize::MAX), (0, 0));
        for (k, _) in self
            .covered
            .iter()
            .enumerate()
            .filter(|(_, covered)| **covered)
        {
            let (x, y) = (k % self.columns, k / self.columns);
            low = (low.0.min(x), low.1.min(y));
            high = (high.0.max(x + 1), high.1.max(y + 1));
        }
        let edge = |start: usize, cells: usize| (start + cells * self.step) as f64 - 0.5;
        (low.0 < high.0).then(|| {
            (
                edge(self.area.left, low.0),
                edge(self.area.top, low.1),
                edge(self.area.left, high.0),
                edge(self.area.top, high.1),
            )
        })
    }
}

/// Takes away the light that one splat holds back.
fn darken(
    clear: &mut [f32],
    columns: usize,
    area: &PixelBox,
    step: usize,
    splat: &SeenSplat,
    billows: &crate::world::Lod,
) {
    let range = |low: usize, high: usize, start: usize| {
        (low - start).div_ceil(step)..=(high - 1 - start) / step
    };
    for row in range(splat.extent.top, splat.extent.bottom, area.top) {
        for column in range(splat.extent.left, splat.extent.right, area.left) {
            let cover = splat.cover(area.left + column * step, area.top + row * step, billows);
            clear[row * columns + column] *= 1.0 - splat.alpha(cover);
        }
    }
}
