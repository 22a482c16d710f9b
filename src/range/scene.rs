//! What all methods look at: one target's surroundings in both eyes, and which pixels are flame.

use super::error::{Matched, Sigma};
use super::hidden::hidden;
use super::patch::{Area, Colour, Cutter, Gray, LUMA};
use super::raster::Weights;
use super::search::rows_apart;
use super::{Miss, RangeConfig, RangeError, RawPair, Refusal, Target};
use crate::detect::DetectionClass;
use nalgebra::{Matrix3, Vector3};
use opencv::core::Mat;
use std::cell::RefCell;
use std::ops::RangeInclusive;
use std::rc::Rc;

/// Disparities that are tried, whole pixels, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Search {
    pub least: i32,
    pub greatest: i32,
}

impl Search {
    /// What the right eye may show of an area.
    pub fn strip(self, area: &Area) -> Area {
        area.grown(self.greatest.max(0), (-self.least).max(0), 0)
    }

    /// Columns from the left eye to the right one, nearest first.
    pub fn offsets(self) -> RangeInclusive<i32> {
        -self.greatest..=-self.least
    }

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
        for (row, line) in wide.chunks_exact(width.max(1)).enumerate() {
            if !line.contains(&true) {
                continue;
            }
            for near in row.saturating_sub(reach)..=(row + reach).min(height - 1) {
                let into = &mut kept[near * width..(near + 1) * width];
                for (kept, wide) in into.iter_mut().zip(line) {
                    *kept |= wide;
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

/// Surroundings of the target that matching may touch: columns and rows.
const AROUND_PX: (i32, i32) = (10, 6);
/// Offsets that differ by no more than this are served by one cut.
const SAME_PLACE_PX: i32 = 2;
/// Least weight of a pixel about the flame.
const FAINTEST: f32 = 0.1;

/// One target in one pair.
pub(super) struct Scene<'a> {
    pub cutter: &'a Cutter,
    pub left_bgr: &'a Mat,
    /// The box, rectified.
    pub target: Area,
    /// The box and its context.
    pub context: Area,
    /// The box and its context in the left eye, in colour.
    colour: Colour,
    /// The box and a little around in the left eye, exactly.
    pub left: Gray,
    /// The same rows of the right eye, as far as the search reaches, good to whole pixels; only rows `every`
    /// apart are filled.
    pub right: Gray,
    /// Which rows are compared to find whole pixels: all, every second one, and so on.
    pub every: i32,
    pub right_gray: &'a Mat,
    /// The flame, over the box and its context.
    pub flame: Mask,
    /// What something thin and dark hides of it, and a little around.
    pub hidden: Option<Mask>,
    /// How far each of its pixels outshines the surroundings, 0 to 1: the less, the more shows through.
    pub shine: Vec<f32>,
    pub search: Search,
    /// Whether the right eye sees near infrared.
    pub two_spectra: bool,
    /// The right eye where it was last looked at exactly.
    exact: RefCell<Option<(i32, Rc<Gray>)>>,
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
        let colour = cutter.left(&pair.left_bgr, around)?;
        let (flame, shine, hidden) = flame(&colour, &area, config);
        let every = rows_apart(&flame.runs());
        let near = nearby(&area);
        let strip = search.strip(&near);
        let right = cutter.right_draft(right_gray, strip, every)?;
        Ok(Self {
            cutter,
            left_bgr: &pair.left_bgr,
            target: area,
            context: colour.area,
            colour,
            left: cutter.left_gray(&pair.left_bgr, near)?,
            right,
            every,
            right_gray,
            flame,
            hidden,
            shine,
            search,
            two_spectra: cutter.two_spectra(),
            exact: RefCell::default(),
        })
    }

    /// What the error of a method's disparity comes to for this target.
    pub fn sigma(&self, matched: &Matched) -> Sigma {
        let width_px = self.target.width() as f64;
        // A flame is about as deep as it is wide: this much disparity its depth spans.
        let depth_px = self.cutter.beyond_infinity_px(matched.found.px) * width_px;
        matched.sigma(width_px, depth_px.abs() / self.cutter.focal_px())
    }

    /// How much is hidden, against the flame.
    pub fn hidden_share(&self) -> f64 {
        let hidden = self.hidden.as_ref().map_or(0, Mask::count);
        hidden as f64 / self.flame.count().max(1) as f64
    }

    /// The flame and so much about it, without what is hidden.
    pub fn compared(&self, reach: usize) -> Mask {
        let mut compared = self.flame.grown(reach);
        if let Some(hidden) = &self.hidden {
            for (kept, hidden) in compared.kept.iter_mut().zip(&hidden.kept) {
                *kept &= !hidden;
            }
        }
        compared
    }

    /// How much the pixels about the flame count: as they outshine what is behind, and a little where
    /// they do not.
    pub fn weights(&self, reach: usize) -> Weights {
        let kept = self.compared(reach).kept;
        let weight = |(kept, shine): (&bool, &f32)| if *kept { shine.max(FAINTEST) } else { 0.0 };
        Weights {
            area: self.flame.area,
            values: kept.iter().zip(&self.shine).map(weight).collect(),
        }
    }

    /// All rows of the right eye, as far as the search reaches, good to whole pixels.
    pub fn right_whole(&self) -> Result<Gray, RangeError> {
        self.cutter.right_draft(self.right_gray, self.right.area, 1)
    }

    /// What the right eye shows `offset` columns from where the target is, exactly, and a little around.
    /// Methods mostly ask for the same place.
    pub fn opposite(&self, offset: i32) -> Result<Rc<Gray>, RangeError> {
        if let Some((there, gray)) = &*self.exact.borrow()
            && (there - offset).abs() <= SAME_PLACE_PX
        {
            return Ok(Rc::clone(gray));
        }
        let area = nearby(&self.target).grown(-offset, offset, 0);
        let gray = Rc::new(self.cutter.right(self.right_gray, area)?);
        *self.exact.borrow_mut() = Some((offset, Rc::clone(&gray)));
        Ok(gray)
    }

    /// The left eye in that mixture of its colours which is most like what the right one shows `offset` columns
    /// on: a sensor without colours answers to a flame's red unlike one whose red alone is saturated, and in
    /// another spectrum colours are told apart by another brightness.
    pub fn left_like(&self, right: &Gray, offset: i32) -> Result<Gray, RangeError> {
        let mixture = mixture(&self.colour, right, offset);
        self.cutter
            .left_mixed(self.left_bgr, self.left.area, mixture)
    }

    /// The left eye as far as what the right one shows `offset` columns on may come from there.
    /// In rows `every` apart.
    pub fn back(&self, offset: i32) -> Result<Gray, RangeError> {
        let area = nearby(&self.target).grown(
            -offset - self.search.least,
            offset + self.search.greatest,
            0,
        );
        self.cutter.left_draft(self.left_bgr, area, self.every)
    }
}

/// Noise of a grey level against how far a mixture may be from luma, squared: what little colour says moves
/// little.
const HELD: f64 = 25.0 / 0.09;

/// Pixels that a mixture is found from, about.
const MIXED_FROM: usize = 600;

/// The mixture of blue, green and red that explains most of the right eye's grey (least squares, held to luma),
/// with luma's own contrast. A gain between the eyes stays for whoever compares them.
fn mixture(colour: &Colour, right: &Gray, offset: i32) -> [f32; 3] {
    let luma = Vector3::from(LUMA.map(f64::from));
    let (mut n, mut grey) = (0.0, 0.0);
    let (mut mean, mut both) = (Vector3::zeros(), Vector3::zeros());
    let mut squares = Matrix3::zeros();
    let rows = colour.area.top.max(right.area.top)..colour.area.bottom.min(right.area.bottom);
    let from = colour
        .area
        .left
        .max(right.seen.0.max(right.area.left) - offset);
    let to = (colour.area.right).min(right.seen.1.min(right.area.right) - offset);
    let all = rows.len() * usize::try_from(to - from).unwrap_or(0);
    let every = all.div_ceil(MIXED_FROM).isqrt().max(1);
    for row in rows.step_by(every) {
        let line = (row - colour.area.top) as usize * colour.area.width();
        for column in (from..to).step_by(every) {
            let bgr = colour.bgr[line + (column - colour.area.left) as usize];
            let bgr = Vector3::from(bgr.map(f64::from));
            let level = f64::from(right.at(column + offset, row));
            (n, grey) = (n + 1.0, grey + level);
            mean += bgr;
            both += bgr * level;
            squares += bgr * bgr.transpose();
        }
    }
    if n < 1.0 {
        return LUMA;
    }
    let squares = squares - mean * mean.transpose() / n;
    let both = both - mean * (grey / n);
    let contrast = |mixture: &Vector3<f64>| (squares * mixture).dot(mixture);
    let gain = luma.dot(&both) / contrast(&luma);
    let held = squares + Matrix3::from_diagonal_element(HELD);
    let found = held
        .cholesky()
        .map(|held| held.solve(&(both + luma * (gain * HELD))));
    match found {
        Some(found) if gain > 0.0 && contrast(&found) > 0.0 => {
            let kept = (contrast(&luma) / contrast(&found)).sqrt();
            (found * kept).map(|weight| weight as f32).into()
        }
        _ => LUMA,
    }
}

fn nearby(target: &Area) -> Area {
    target.grown(AROUND_PX.0, AROUND_PX.0, AROUND_PX.1)
}

/// The flame's pixels in the box and how far they outshine the surroundings: those that the gate keeps
/// and that outshine them at all. Where that leaves too few (dry grass is as yellow as flame), what the
/// gate keeps; where that is too little as well (a thing in colours that the gate does not know), all
/// of them, and all alike. Then what hides some of them, which only those that shine can tell.
fn flame(left: &Colour, target: &Area, config: &RangeConfig) -> (Mask, Vec<f32>, Option<Mask>) {
    let area = left.area;
    let shines: Vec<i16> = left.bgr.iter().map(|pixel| shine(*pixel)).collect();
    let Around {
        bright: floor,
        dark,
    } = brightness_around(&shines, &area, target);
    let width = area.width();
    let inside = (target.left - area.left).max(0) as usize..(target.right - area.left) as usize;
    let rows = (target.top - area.top).max(0) as usize
        ..((target.bottom - area.top) as usize).min(area.height());
    let mut gate = vec![false; shines.len()];
    for row in rows.clone() {
        let end = inside.end.min(width);
        let span = row * width + inside.start.min(end)..row * width + end;
        for (kept, pixel) in gate[span.clone()].iter_mut().zip(&left.bgr[span]) {
            *kept = config.mask.keeps(*pixel);
        }
    }
    let shining: Vec<bool> = gate
        .iter()
        .zip(&shines)
        .map(|(kept, shine)| *kept && *shine > floor)
        .collect();
    let enough =
        |kept: &[bool]| kept.iter().filter(|kept| **kept).count() >= config.min_support as usize;
    if enough(&shining) {
        let excess = excess(&shines, &shining, floor);
        let mask = Mask {
            area,
            kept: shining,
        };
        let hidden = hidden(&mask, &shines, dark, target);
        return (mask, excess, hidden);
    }
    let alike = vec![1.0; shines.len()];
    if enough(&gate) {
        return (Mask { area, kept: gate }, alike, None);
    }
    for row in rows {
        gate[row * width + inside.start..row * width + inside.end.min(width)].fill(true);
    }
    (Mask { area, kept: gate }, alike, None)
}

/// Shine beyond the floor, 1 for what shines as brightly as most of the flame.
fn excess(shines: &[i16], shining: &[bool], floor: i16) -> Vec<f32> {
    let mut bright: Vec<i16> = shines
        .iter()
        .zip(shining)
        .filter_map(|(shine, shining)| shining.then_some(*shine))
        .collect();
    let rank = bright.len() / 2;
    let middle = *bright.select_nth_unstable(rank).1;
    let share = 1.0 / f32::from(middle - floor).max(1.0);
    let excess = |shine: &i16| (share * f32::from(shine - floor)).clamp(0.0, 1.0);
    shines.iter().map(excess).collect()
}

/// How much like flame a pixel shines: bright in red, weak in blue.
fn shine(bgr: [u8; 3]) -> i16 {
    2 * i16::from(bgr[2]) - i16::from(bgr[0])
}

/// What the surroundings of a target shine like.
struct Around {
    /// Hardly anything there exceeds this.
    bright: i16,
    /// What shows through a gap of the flame is mostly brighter than this.
    dark: i16,
}

/// Percent of the surroundings that are darker than what counts as dark.
const DARK_PERCENT: usize = 25;

fn brightness_around(shines: &[i16], area: &Area, target: &Area) -> Around {
    let mut around = Vec::with_capacity(shines.len());
    for (row, line) in (area.top..).zip(shines.chunks_exact(area.width().max(1))) {
        if (target.top..target.bottom).contains(&row) {
            let from = (target.left - area.left).clamp(0, line.len() as i32) as usize;
            let to = (target.right - area.left).clamp(0, line.len() as i32) as usize;
            around.extend_from_slice(&line[..from]);
            around.extend_from_slice(&line[to..]);
        } else {
            around.extend_from_slice(line);
        }
    }
    if around.is_empty() {
        return Around {
            bright: -256,
            dark: -256,
        };
    }
    let rank = around.len() * 95 / 100;
    let bright = *around.select_nth_unstable(rank).1;
    let rank = around.len() * DARK_PERCENT / 100;
    let dark = *around.select_nth_unstable(rank).1;
    Around { bright, dark }
}
