//! A studio: a few flames before a backdrop, each eye with an exposure of its own.
//!
//! **Purpose.** Stereo pairs by the hundred for measuring rangers, harsher than a flight is: cores
//! that saturate, eyes that expose at different moments or in different light, smoke, glints and
//! branches. **In:** [`Shot`] (what stands there, east, north, up, metres) and a [`Look`] per eye.
//! **Out:** a raw [`Frame`] per eye and [`Seen`]: the box and the true depth of the first flame.
//!
//! **Assumptions.** Flames are the world's own: clouds of soft splats at many depths, so that each
//! eye sees another picture, and a later exposure another flame. Splats are drawn several times
//! finer than the sensor and averaged, so that no place is rounded to a pixel.
//! **Known limits.** Only the surroundings of what burns are drawn; the rest of the frame is grey.
//! Light does not bounce: a flame does not brighten the backdrop. One splat is flat by itself.

use super::camera::{EyePose, Lens};
use super::ground::{BLOCK, RayGrid};
use super::sensor::Sensor;
use super::splats::{SeenSplat, in_near_infrared};
use super::{Frame, PixelBox, PixelFormat, RenderConfig, StereoCamera};
use crate::state::BodyState;
use crate::world::{Flame, Splat, SplatKind, Textures, UNIT, World, hash};
use emberfix_calib::Eye;
use nalgebra::{Vector2, Vector3};
use std::sync::Arc;

/// A rig in a studio.
#[derive(Debug, Clone)]
pub struct Studio {
    world: Arc<World>,
    camera: StereoCamera,
    rays: [RayGrid; 2],
}

/// What stands before the rig at one moment.
#[derive(Debug, Clone)]
pub struct Shot {
    /// Pose of the rig's body.
    pub body: BodyState,
    /// Moment of the left exposure, seconds of the flames' life.
    pub t_s: f64,
    /// What burns. The first is the target: [`Seen`] speaks of it alone.
    pub fires: Vec<StudioFire>,
    /// What is behind.
    pub backdrop: Backdrop,
    /// Daylight on the backdrop; 1 is a sunny noon, 0.02 a night.
    pub daylight: f64,
    /// Dark things in front of the flames, or between them.
    pub branches: Vec<Branch>,
    /// Smoke, lamps, glints.
    pub puffs: Vec<Puff>,
}

/// One flame.
#[derive(Debug, Clone, Copy)]
pub struct StudioFire {
    /// Which flame.
    pub seed: u64,
    /// Where its base stands.
    pub base_m: Vector3<f64>,
    /// Width of the burning bed with its flames.
    pub width_m: f64,
    /// Mean height of its tallest tongues.
    pub height_m: f64,
    /// East and north.
    pub wind_m_s: Vector2<f64>,
}

/// What is behind the flames.
#[derive(Debug, Clone, Copy)]
pub enum Backdrop {
    /// A wall that faces the left eye, at this depth along the left eye's own boresight.
    Wall {
        /// Metres.
        depth_m: f64,
    },
    /// Level ground at this height, and a bright sky above its horizon.
    Ground {
        /// Metres.
        up_m: f64,
    },
}

/// A straight dark stick.
#[derive(Debug, Clone, Copy)]
pub struct Branch {
    /// One end.
    pub from_m: Vector3<f64>,
    /// The other.
    pub to_m: Vector3<f64>,
    /// Half its thickness.
    pub radius_m: f64,
}

/// A soft ball of smoke or of light.
#[derive(Debug, Clone, Copy)]
pub struct Puff {
    /// Its middle.
    pub centre_m: Vector3<f64>,
    /// Where it ends.
    pub radius_m: f64,
    /// What it does.
    pub kind: PuffKind,
    /// The only eye that sees it: a wisp close to a lens, a facet that mirrors into one eye.
    pub only: Option<Eye>,
}

/// What a puff does.
#[derive(Debug, Clone, Copy)]
pub enum PuffKind {
    /// Holds back this share of the light in its middle, and is grey itself.
    Smoke {
        /// 0 to 1.
        opacity: f64,
    },
    /// Adds this much light in its middle; 1 saturates a pixel at noon.
    Light {
        /// Light.
        strength: f64,
    },
}

/// How one eye exposes.
#[derive(Debug, Clone)]
pub struct Look {
    /// Seconds after the left exposure.
    pub skew_s: f64,
    /// Factor on all light; 1 suits a clear noon, flames saturate from about 2 on.
    pub gain: f64,
    /// Sigma of the lens' blur, pixels.
    pub blur_px: f64,
    /// Share of the light that scatters widely in the lens: the glow around what is too bright.
    pub glare: f64,
    /// Noise at mid grey, digital numbers.
    pub noise_sigma_dn: f64,
    /// Sees light just beyond red: soot shines brighter in it the cooler it is, plants are bright,
    /// smoke is thinner.
    pub near_infrared: bool,
    /// Dirt on the lens.
    pub dirt: Vec<Smudge>,
    /// Of the noise.
    pub seed: u64,
}

/// A smudge on a lens, out of focus.
#[derive(Debug, Clone, Copy)]
pub struct Smudge {
    /// Column and row of its middle.
    pub at_px: (f64, f64),
    /// One sigma of its softness, pixels.
    pub radius_px: f64,
    /// Share of the light that its middle holds back.
    pub opacity: f64,
}

/// The first flame as the left eye truly sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Left, top, right, bottom of the pixels that it lights up, ends excluded, raw left image.
    pub box_px: [f64; 4],
    /// Mean over these pixels of the reciprocal depth of their flame light, 1/m, along `axis`.
    pub inverse_depth_per_m: f64,
    /// Mean row of these pixels, raw left image.
    pub row: f64,
    /// How many pixels.
    pub pixels: usize,
    /// Share of them whose red is saturated.
    pub saturated: f64,
}

/// Flame light from which a pixel counts as flame: clearly brighter than a sunlit meadow.
const LIT: f32 = 0.22;
/// Nothing nearer is drawn, metres of depth.
const NEAREST_M: f64 = 0.05;
/// Flames are drawn this fine, hi-resolution pixels of height.
const FINE_PX: f64 = 200.0;
const FINEST: usize = 8;
/// Surroundings that are drawn, pixels: context and search of any matcher.
const AROUND_PX: (usize, usize) = (160, 48);
/// Light outside of what is drawn.
const UNDRAWN: u8 = 60;
/// Sigma of the wide glow in a lens, pixels.
const GLARE_PX: f64 = 9.0;
const SMOKE: [f32; 3] = [0.32, 0.31, 0.30];
const BARK: f32 = 0.03;
/// How much of the billow texture's tile half a splat spans.
const BILLOW_SHARE: f32 = 0.22;

/// Red, green, blue; what still shines through from behind; the target's light, and the same times
/// its reciprocal depth.
type Lanes = [f32; 6];
const CLEAR: Lanes = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0];

/// One eye's drawing of everything before the backdrop, averaged to pixels.
struct Layer {
    extent: PixelBox,
    pixels: Vec<Lanes>,
}

enum Item {
    Splat {
        seen: SeenSplat,
        inverse_depth: Option<f32>,
        texel_px: f32,
    },
    Stick(Stick),
}

/// A branch in an eye's image.
struct Stick {
    depth_m: f32,
    extent: PixelBox,
    from: (f32, f32),
    along: (f32, f32),
    radius: f32,
}

/// One eye about to expose.
struct View<'a> {
    eye: Eye,
    look: &'a Look,
    pose: EyePose,
    lens: &'a Lens,
}

impl Studio {
    /// Puts a rig before a world's textures.
    #[must_use]
    pub fn new(world: Arc<World>, camera: StereoCamera) -> Self {
        let rays = [Eye::Left, Eye::Right].map(|eye| RayGrid::new(camera.lens(eye)));
        Self {
            world,
            camera,
            rays,
        }
    }

    /// One eye's raw image: left in colour, right in grey.
    #[must_use]
    pub fn expose(&self, shot: &Shot, eye: Eye, look: &Look) -> Frame {
        let view = self.view(shot, eye, look);
        let layer = self.layer(shot, &view, None);
        self.developed(shot, &view, &layer)
    }

    /// The left eye's raw image and what it truly sees of the first flame; depth counts along `axis`
    /// (east, north, up; of unit length) from the left eye. `None` when the flame lights no pixel.
    #[must_use]
    pub fn expose_left(
        &self,
        shot: &Shot,
        look: &Look,
        axis: &Vector3<f64>,
    ) -> (Frame, Option<Seen>) {
        let view = self.view(shot, Eye::Left, look);
        let layer = self.layer(shot, &view, Some(axis));
        let seen = layer.seen(look.gain as f32);
        (self.developed(shot, &view, &layer), seen)
    }

    fn developed(&self, shot: &Shot, view: &View, layer: &Layer) -> Frame {
        let (width, height) = (view.lens.width, view.lens.height);
        let (channels, format) = match view.eye {
            Eye::Left => (3, PixelFormat::Bgr8),
            Eye::Right => (1, PixelFormat::Mono8),
        };
        let mut bytes = vec![UNDRAWN; width * height * channels];
        let drawn = layer.extent.grown(AROUND_PX, view.lens);
        let light = self.light(shot, view, layer, &drawn);
        develop(&light, &drawn, view, channels, &mut bytes);
        Frame {
            width: width as u32,
            height: height as u32,
            format,
            bytes,
        }
    }

    fn view<'a>(&'a self, shot: &Shot, eye: Eye, look: &'a Look) -> View<'a> {
        View {
            eye,
            look,
            pose: self.camera.pose(eye, &shot.body),
            lens: self.camera.lens(eye),
        }
    }

    /// Everything before the backdrop.
    fn layer(&self, shot: &Shot, view: &View, axis: Option<&Vector3<f64>>) -> Layer {
        let fineness = fineness(shot, view);
        let lens = view.lens.finer(fineness);
        let mut items = self.items(shot, view, &lens, axis);
        items.sort_by(|a, b| b.depth_m().total_cmp(&a.depth_m()));
        let fine = items.iter().map(Item::extent).reduce(|a, b| a.with(&b));
        let fine = fine.unwrap_or(PixelBox {
            left: 0,
            top: 0,
            right: 1,
            bottom: 1,
        });
        let extent = fine.coarser(fineness);
        let (columns, rows) = (extent.columns() * fineness, extent.rows() * fineness);
        let origin = (extent.left * fineness, extent.top * fineness);
        let mut lanes = vec![CLEAR; columns * rows];
        for item in &items {
            item.draw(&mut lanes, origin, columns, self.world.textures());
        }
        Layer {
            pixels: averaged(&lanes, columns, fineness),
            extent,
        }
    }

    fn items(
        &self,
        shot: &Shot,
        view: &View,
        lens: &Lens,
        axis: Option<&Vector3<f64>>,
    ) -> Vec<Item> {
        let t_s = shot.t_s + view.look.skew_s;
        let mut items = Vec::new();
        for (k, fire) in shot.fires.iter().enumerate() {
            let axis = axis.filter(|_| k == 0);
            let splats = fire.flame(t_s).splats();
            items.extend(
                splats
                    .iter()
                    .filter_map(|splat| view.item(splat, lens, axis)),
            );
        }
        let puffs = shot
            .puffs
            .iter()
            .filter(|puff| puff.only.is_none_or(|eye| eye == view.eye));
        items.extend(puffs.filter_map(|puff| view.item(&puff.splat(), lens, None)));
        let sticks = shot
            .branches
            .iter()
            .filter_map(|branch| Stick::new(branch, &view.pose, lens));
        items.extend(sticks.map(Item::Stick));
        items
    }

    /// Linear light on the drawn part of the sensor.
    fn light(&self, shot: &Shot, view: &View, layer: &Layer, drawn: &PixelBox) -> Vec<[f32; 3]> {
        let mut light = Vec::with_capacity(drawn.columns() * drawn.rows());
        let backdrop = BackdropView::new(self, shot, view);
        for row in drawn.top..drawn.bottom {
            for column in drawn.left..drawn.right {
                let behind = backdrop.at(column, row);
                let lanes = layer.at(column, row).unwrap_or(CLEAR);
                light.push(std::array::from_fn(|c| behind[c] * lanes[3] + lanes[c]));
            }
        }
        blurred(light, drawn.columns(), view.look)
    }
}

impl StudioFire {
    fn flame(&self, t_s: f64) -> Flame {
        Flame {
            seed: self.seed,
            base_m: self.base_m,
            width_m: self.width_m,
            height_m: self.height_m,
            wind_m_s: self.wind_m_s,
            t_s,
        }
    }
}

impl Puff {
    fn splat(&self) -> Splat {
        let (kind, colour, opacity) = match self.kind {
            PuffKind::Smoke { opacity } => (SplatKind::Smoke, SMOKE, opacity as f32),
            PuffKind::Light { strength } => (SplatKind::Light, [strength as f32; 3], 1.0),
        };
        let own = hash(self.radius_m.to_bits(), (self.centre_m.x * 1e4) as u32, 5);
        Splat {
            kind,
            centre_m: self.centre_m,
            half_axis_m: Vector3::new(0.0, 0.0, self.radius_m),
            half_width_m: self.radius_m,
            colour,
            opacity,
            billow: ((own % 997) as f32 / 997.0, (own % 991) as f32 / 991.0),
        }
    }
}

impl View<'_> {
    /// A splat as this eye sees it, in its kind of light.
    fn item(&self, splat: &Splat, lens: &Lens, axis: Option<&Vector3<f64>>) -> Option<Item> {
        let splat = if self.look.near_infrared {
            in_near_infrared(*splat)
        } else {
            *splat
        };
        let seen = SeenSplat::beyond(NEAREST_M, &splat, &self.pose, lens)?;
        let inverse_depth =
            axis.map(|axis| (1.0 / (splat.centre_m - self.pose.origin_m).dot(axis)) as f32);
        let seen_px = seen.across_per_px();
        Some(Item::Splat {
            seen,
            inverse_depth,
            texel_px: seen_px,
        })
    }
}

fn fineness(shot: &Shot, view: &View) -> usize {
    let heights = shot.fires.iter().map(|fire| {
        let depth = view.pose.see(&fire.base_m).z.max(0.1);
        fire.height_m * view.lens.focal_px.1 / depth
    });
    let tallest = heights.fold(1.0, f64::max);
    ((FINE_PX / tallest).ceil() as usize).clamp(2, FINEST)
}

/// Means over squares of `fineness` pixels.
fn averaged(lanes: &[Lanes], columns: usize, fineness: usize) -> Vec<Lanes> {
    let (wide, share) = (columns / fineness, 1.0 / (fineness * fineness) as f32);
    let mut means = vec![[0.0; 6]; lanes.len() / (fineness * fineness)];
    for (row, line) in lanes.chunks_exact(columns).enumerate() {
        for (column, pixel) in line.iter().enumerate() {
            let mean = &mut means[row / fineness * wide + column / fineness];
            for (sum, lane) in mean.iter_mut().zip(pixel) {
                *sum += lane * share;
            }
        }
    }
    means
}

impl Layer {
    /// What stands in it of the target.
    fn seen(&self, gain: f32) -> Option<Seen> {
        let (mut sum, mut rows, mut pixels, mut saturated) = (0.0, 0.0, 0usize, 0usize);
        let mut reach = [usize::MAX, usize::MAX, 0, 0];
        for (index, lanes) in self.pixels.iter().enumerate() {
            if lanes[4] * gain < LIT {
                continue;
            }
            let (column, row) = self.extent.place(index);
            reach = [
                reach[0].min(column),
                reach[1].min(row),
                reach[2].max(column),
                reach[3].max(row),
            ];
            sum += f64::from(lanes[5] / lanes[4]);
            rows += row as f64;
            pixels += 1;
            saturated += usize::from(lanes[0] * gain > 1.0);
        }
        let [left, top, right, bottom] = reach.map(|edge| edge as f64);
        (pixels > 0).then(|| Seen {
            box_px: [left, top, right + 1.0, bottom + 1.0],
            inverse_depth_per_m: sum / pixels as f64,
            row: rows / pixels as f64,
            pixels,
            saturated: saturated as f64 / pixels as f64,
        })
    }

    fn at(&self, column: usize, row: usize) -> Option<Lanes> {
        let extent = &self.extent;
        let inside = (extent.left..extent.right).contains(&column)
            && (extent.top..extent.bottom).contains(&row);
        inside.then(|| self.pixels[(row - extent.top) * extent.columns() + column - extent.left])
    }
}

impl PixelBox {
    /// The whole pixels of a sensor that is `fineness` times coarser.
    fn coarser(&self, fineness: usize) -> Self {
        Self {
            left: self.left / fineness,
            top: self.top / fineness,
            right: self.right.div_ceil(fineness),
            bottom: self.bottom.div_ceil(fineness),
        }
    }

    fn grown(&self, (across, down): (usize, usize), lens: &Lens) -> Self {
        Self {
            left: self.left.saturating_sub(across),
            top: self.top.saturating_sub(down),
            right: (self.right + across).min(lens.width),
            bottom: (self.bottom + down).min(lens.height),
        }
    }

    /// Column and row of a pixel, row by row.
    fn place(&self, index: usize) -> (usize, usize) {
        (
            self.left + index % self.columns(),
            self.top + index / self.columns(),
        )
    }
}

impl Item {
    fn depth_m(&self) -> f32 {
        match self {
            Self::Splat { seen, .. } => seen.depth_m,
            Self::Stick(stick) => stick.depth_m,
        }
    }

    fn extent(&self) -> PixelBox {
        match self {
            Self::Splat { seen, .. } => seen.extent,
            Self::Stick(stick) => stick.extent,
        }
    }

    /// Draws it over what is there.
    fn draw(
        &self,
        lanes: &mut [Lanes],
        origin: (usize, usize),
        columns: usize,
        textures: &Textures,
    ) {
        let extent = self.extent();
        let billows = match self {
            Self::Splat { texel_px, .. } => textures.billows.lod(BILLOW_SHARE * texel_px),
            Self::Stick(_) => textures.billows.lod(1.0),
        };
        for py in extent.top..extent.bottom {
            let line = (py - origin.1) * columns;
            for px in extent.left..extent.right {
                let pixel = &mut lanes[line + px - origin.0];
                match self {
                    Self::Splat {
                        seen,
                        inverse_depth,
                        ..
                    } => {
                        let cover = seen.cover(px, py, &billows);
                        if cover > 0.002 {
                            seen.lay_over(pixel, cover, *inverse_depth);
                        }
                    }
                    Self::Stick(stick) => stick.lay_over(pixel, px, py),
                }
            }
        }
    }
}

impl SeenSplat {
    fn lay_over(&self, pixel: &mut Lanes, cover: f32, inverse_depth: Option<f32>) {
        let ([red, green, blue], kept) = self.given(cover);
        for lane in pixel.iter_mut() {
            *lane *= kept;
        }
        pixel[0] += red;
        pixel[1] += green;
        pixel[2] += blue;
        if let Some(inverse_depth) = inverse_depth {
            // The eye knows flame by its red.
            pixel[4] += red;
            pixel[5] += red * inverse_depth;
        }
    }
}

impl Stick {
    fn new(branch: &Branch, pose: &EyePose, lens: &Lens) -> Option<Self> {
        let (from, to) = (pose.see(&branch.from_m), pose.see(&branch.to_m));
        let depth_m = 0.5 * (from.z + to.z);
        let radius = branch.radius_m * lens.focal_px.0 / depth_m;
        let (a, b) = (lens.project(&from)?, lens.project(&to)?);
        let around = |p| PixelBox::around(p, (radius + 1.0, radius + 1.0), lens);
        Some(Self {
            depth_m: depth_m as f32,
            extent: around(a)?.with(&around(b)?),
            from: (a.0 as f32, a.1 as f32),
            along: ((b.0 - a.0) as f32, (b.1 - a.1) as f32),
            radius: radius as f32,
        })
    }

    fn lay_over(&self, pixel: &mut Lanes, px: usize, py: usize) {
        let (x, y) = (px as f32 - self.from.0, py as f32 - self.from.1);
        let (ax, ay) = self.along;
        let along = ((x * ax + y * ay) / (ax * ax + ay * ay).max(1e-6)).clamp(0.0, 1.0);
        let off = (x - along * ax).hypot(y - along * ay);
        let alpha = (self.radius + 0.5 - off).clamp(0.0, 1.0);
        for (k, lane) in pixel.iter_mut().enumerate() {
            *lane = *lane * (1.0 - alpha) + if k < 3 { BARK * alpha } else { 0.0 };
        }
    }
}

/// The backdrop as one eye sees it.
struct BackdropView<'a> {
    studio: &'a Studio,
    shot: &'a Shot,
    view: &'a View<'a>,
    rays: &'a RayGrid,
    /// A point of the plane, its normal, and two directions along it.
    plane: [Vector3<f64>; 4],
}

impl<'a> BackdropView<'a> {
    fn new(studio: &'a Studio, shot: &'a Shot, view: &'a View<'a>) -> Self {
        let left = studio.camera.pose(Eye::Left, &shot.body);
        let plane = match shot.backdrop {
            Backdrop::Wall { depth_m } => {
                let [right, down, ahead] =
                    [0, 1, 2].map(|k| left.enu_from_camera.column(k).into_owned());
                [left.origin_m + ahead * depth_m, ahead, right, down]
            }
            Backdrop::Ground { up_m } => [
                Vector3::z() * up_m,
                -Vector3::z(),
                Vector3::x(),
                Vector3::y(),
            ],
        };
        let rays = &studio.rays[usize::from(view.eye == Eye::Right)];
        Self {
            studio,
            shot,
            view,
            rays,
            plane,
        }
    }

    /// Linear light of a pixel.
    fn at(&self, column: usize, row: usize) -> [f32; 3] {
        let (x, y) = self.rays.at(column, row);
        let ray = self.view.pose.enu_from_camera * Vector3::new(x, y, 1.0);
        let [point, normal, across, down] = self.plane;
        let depth = (point - self.view.pose.origin_m).dot(&normal) / ray.dot(&normal);
        let light = self.shot.daylight as f32;
        if !(depth > 0.0 && depth < 2000.0) {
            return [0.75 * light; 3];
        }
        let place = self.view.pose.origin_m + ray * depth - point;
        let footprint = (depth / self.view.lens.focal_px.0) as f32;
        self.albedo(
            place.dot(&across) as f32,
            place.dot(&down) as f32,
            footprint,
        )
        .map(|a| a * light)
    }

    fn albedo(&self, x: f32, y: f32, footprint_m: f32) -> [f32; 3] {
        let textures = self.studio.world.textures();
        let cover = textures.cover.lod(footprint_m).at(x, y);
        let middle = textures.middle.lod(footprint_m).at(x, y)[1] * UNIT;
        let fine = textures.fine.lod(footprint_m).at(x, y)[1] * UNIT;
        let [red, green, blue] = [0, 1, 2].map(|c| cover[c] * (2.2 / 255.0));
        if self.view.look.near_infrared {
            // Plants are bright where they are green, and dark spots are not the same spots.
            let plants = 1.6 * green - red;
            return [(0.12 + 1.5 * plants.max(0.0)) * (1.7 - 0.7 * middle) * (0.6 + 0.4 * fine); 3];
        }
        let colour = match self.shot.backdrop {
            // Rooms are plastered, not turfed.
            Backdrop::Wall { .. } => [(red + green + blue) / 3.0; 3],
            Backdrop::Ground { .. } => [red, green, blue],
        };
        colour.map(|c| c * middle * fine)
    }
}

/// Sharp light and wide glow.
fn blurred(light: Vec<[f32; 3]>, columns: usize, look: &Look) -> Vec<[f32; 3]> {
    let sharp = gaussian(&light, columns, look.blur_px);
    if look.glare <= 0.0 {
        return sharp;
    }
    let wide = gaussian(&light, columns, GLARE_PX);
    let glare = look.glare as f32;
    let mixed = sharp.iter().zip(&wide);
    mixed
        .map(|(s, w)| std::array::from_fn(|c| s[c] + glare * (w[c] - s[c])))
        .collect()
}

fn gaussian(light: &[[f32; 3]], columns: usize, sigma_px: f64) -> Vec<[f32; 3]> {
    let reach = (3.0 * sigma_px).ceil() as usize;
    let weight = |k: usize| (-0.5 * ((k as f64 - reach as f64) / sigma_px).powi(2)).exp() as f32;
    let weights: Vec<f32> = (0..=2 * reach).map(weight).collect();
    let total: f32 = weights.iter().sum();
    let weights: Vec<f32> = weights.iter().map(|weight| weight / total).collect();
    let across: Vec<[f32; 3]> = light
        .chunks_exact(columns)
        .flat_map(|line| smoothed(line, &weights))
        .collect();
    transposed(
        &transposed(&across, columns)
            .chunks_exact(light.len() / columns)
            .flat_map(|line| smoothed(line, &weights))
            .collect::<Vec<_>>(),
        light.len() / columns,
    )
}

/// One line, its ends repeated, under the weights.
fn smoothed(line: &[[f32; 3]], weights: &[f32]) -> Vec<[f32; 3]> {
    let reach = weights.len() / 2;
    let (first, last) = (line[0], line[line.len() - 1]);
    let mut padded = vec![first; reach];
    padded.extend_from_slice(line);
    padded.resize(line.len() + 2 * reach, last);
    let sum = |window: &[[f32; 3]]| {
        let mut sum = [0.0; 3];
        for (pixel, weight) in window.iter().zip(weights) {
            for (s, p) in sum.iter_mut().zip(pixel) {
                *s += weight * p;
            }
        }
        sum
    };
    padded.windows(weights.len()).map(sum).collect()
}

fn transposed(light: &[[f32; 3]], columns: usize) -> Vec<[f32; 3]> {
    let rows = light.len() / columns;
    let at = |index: usize| light[index % rows * columns + index / rows];
    (0..light.len()).map(at).collect()
}

/// Light to bytes.
fn develop(light: &[[f32; 3]], drawn: &PixelBox, view: &View, channels: usize, bytes: &mut [u8]) {
    let look = view.look;
    let sensor = Sensor::new(RenderConfig {
        noise_sigma_dn: look.noise_sigma_dn,
        ..RenderConfig::default()
    });
    for (index, colour) in light.iter().enumerate() {
        let (column, row) = drawn.place(index);
        let passing: f64 = look
            .dirt
            .iter()
            .map(|smudge| smudge.passing(column, row))
            .product();
        let bits = hash(look.seed, column as u32, row as u32) as u32;
        let offset = (row * view.lens.width + column) * channels;
        let [red, green, blue] = *colour;
        let gain = (look.gain * passing) as f32;
        sensor.expose(
            [red, green, blue, green],
            gain,
            bits,
            &mut bytes[offset..offset + channels],
        );
    }
}

impl Smudge {
    fn passing(&self, column: usize, row: usize) -> f64 {
        let (dx, dy) = (column as f64 - self.at_px.0, row as f64 - self.at_px.1);
        1.0 - self.opacity * (-0.5 * (dx * dx + dy * dy) / self.radius_px.powi(2)).exp()
    }
}

impl RayGrid {
    /// Tangents of a pixel's ray, between the corners of its block.
    fn at(&self, column: usize, row: usize) -> (f64, f64) {
        let (left, top) = (column / BLOCK, row / BLOCK);
        let (x, y) = (
            (column % BLOCK) as f64 / BLOCK as f64,
            (row % BLOCK) as f64 / BLOCK as f64,
        );
        let [a, b, c, d] =
            [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| self.tangents(left + dx, top + dy));
        let between = |a: f64, b: f64, c: f64, d: f64| {
            (a * (1.0 - x) + b * x) * (1.0 - y) + (c * (1.0 - x) + d * x) * y
        };
        (between(a.0, b.0, c.0, d.0), between(a.1, b.1, c.1, d.1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::WorldConfig;
    use emberfix_calib::Rig;
    use nalgebra::Matrix3;
    use std::path::Path;

    fn studio() -> Studio {
        let rig = Rig::parse(
            include_str!("../../../calib/rigs/oakd-75mm.toml"),
            Path::new("oakd-75mm"),
        )
        .unwrap();
        let world = World::new(&WorldConfig::default(), 1).unwrap();
        Studio::new(Arc::new(world), StereoCamera::new(&rig))
    }

    /// A flame 8 m ahead and 4.6 m down, where the camera looks.
    fn shot() -> Shot {
        Shot {
            body: BodyState {
                t_s: 0.0,
                position_m: Vector3::zeros(),
                enu_from_body: Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0),
                velocity_m_s: Vector3::zeros(),
                rate_rad_s: Vector3::zeros(),
            },
            t_s: 9.0,
            fires: vec![StudioFire {
                seed: 4,
                base_m: Vector3::new(0.0, 8.0, -5.2),
                width_m: 0.7,
                height_m: 1.1,
                wind_m_s: Vector2::zeros(),
            }],
            backdrop: Backdrop::Ground { up_m: -5.2 },
            daylight: 0.2,
            branches: Vec::new(),
            puffs: Vec::new(),
        }
    }

    fn look() -> Look {
        Look {
            skew_s: 0.0,
            gain: 1.0,
            blur_px: 0.6,
            glare: 0.0,
            noise_sigma_dn: 2.0,
            near_infrared: false,
            dirt: Vec::new(),
            seed: 1,
        }
    }

    #[test]
    fn the_depth_that_is_seen_is_within_the_flame() {
        let (sin, cos) = 30.0_f64.to_radians().sin_cos();
        let axis = Vector3::new(0.0, cos, -sin);
        let (_, seen) = studio().expose_left(&shot(), &look(), &axis);
        let seen = seen.unwrap();
        // The lever arm puts the eye 0.12 m ahead and 0.06 m down of the body.
        let base = Vector3::new(0.0, 8.0 - 0.12, -5.2 + 0.06).dot(&axis);
        let (near, far) = (base - 1.1 * sin - 0.4, base + 0.4);
        let depth = 1.0 / seen.inverse_depth_per_m;
        assert!((near..far).contains(&depth), "{depth} m of {near} to {far}");
        assert!(seen.pixels > 500, "{}", seen.pixels);
    }

    #[test]
    fn a_later_exposure_shows_another_flame_and_a_gain_another_brightness() {
        let (studio, shot) = (studio(), shot());
        let bytes = |look: &Look| studio.expose(&shot, Eye::Right, look).bytes;
        let first = bytes(&look());
        assert_eq!(first, bytes(&look()));
        let later = Look {
            skew_s: 0.02,
            ..look()
        };
        assert_ne!(first, bytes(&later));
        let sum = |bytes: &[u8]| bytes.iter().map(|b| u64::from(*b)).sum::<u64>();
        let dimmer = Look {
            gain: 0.5,
            ..look()
        };
        assert!(sum(&bytes(&dimmer)) < sum(&first));
    }

    #[test]
    fn what_lives_in_one_eye_is_not_in_the_other() {
        let (studio, mut lit) = (studio(), shot());
        lit.puffs.push(Puff {
            centre_m: Vector3::new(0.0, 7.8, -4.9),
            radius_m: 0.2,
            kind: PuffKind::Light { strength: 3.0 },
            only: Some(Eye::Right),
        });
        let same = |eye| {
            studio.expose(&shot(), eye, &look()).bytes == studio.expose(&lit, eye, &look()).bytes
        };
        assert!(same(Eye::Left) && !same(Eye::Right));
    }
}
