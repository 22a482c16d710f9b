//! Ground and sky of one band of an image.
//!
//! Rays are traced at the corners of blocks of 8 pixels. Between them the reciprocal depth and the
//! ray are interpolated linearly, which is exact for a plane seen through an undistorted lens, and
//! keeps a place on the ground at one place for both eyes.

use super::camera::{EyePose, Lens};
use super::marks::MarkGrid;
use crate::world::{Glow, Lod, MarkKind, Rgb, Texture, UNIT, World, mix};
use nalgebra::Vector3;
use rayon::prelude::*;

/// Pixels along the side of a block.
pub(super) const BLOCK: usize = 8;
/// No ground is drawn beyond, metres of depth.
const FARTHEST_M: f64 = 20_000.0;

/// Footprint that textures are cut to, against a pixel's: a lens as sharp as its sensor.
const SHARPNESS: f32 = 0.75;

/// What is known at a block's corner.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Node {
    /// Ray in camera components per metre of depth: right, down.
    pub x: f32,
    pub y: f32,
    /// The same ray, east, north, up.
    pub ray: [f32; 3],
    /// Reciprocal depth of the ground, 1/m; 0 is the sky.
    pub inv_depth: f32,
    /// Direct light on the ground.
    shade: f32,
    /// Slow change of the ground's lightness over a hundred metres.
    tone: f32,
    /// Share of haze in front of the ground.
    haze: f32,
}

/// Corner rays of an eye, which never change.
#[derive(Debug, Clone)]
pub(super) struct RayGrid {
    tangents: Vec<(f64, f64)>,
    pub columns: usize,
    pub rows: usize,
}

impl RayGrid {
    pub(super) fn new(lens: &Lens) -> Self {
        let (columns, rows) = (
            lens.width.div_ceil(BLOCK) + 1,
            lens.height.div_ceil(BLOCK) + 1,
        );
        let corner = |i: usize| {
            lens.unproject(
                ((i % columns) * BLOCK) as f64,
                ((i / columns) * BLOCK) as f64,
            )
        };
        let tangents = (0..columns * rows).into_par_iter().map(corner).collect();
        Self {
            tangents,
            columns,
            rows,
        }
    }

    pub(super) fn tangents(&self, column: usize, row: usize) -> (f64, f64) {
        self.tangents[row * self.columns + column]
    }
}

/// One eye's view of the ground at one moment.
pub(super) struct Ground<'a> {
    world: &'a World,
    pose: EyePose,
    sun: Vector3<f64>,
    grid: &'a RayGrid,
    nodes: Vec<Node>,
    marks: &'a MarkGrid,
    glows: Vec<Glow>,
    sunlight: Rgb,
    left_by_air: Rgb,
    skylight: Rgb,
    /// The eye's place within each texture's tile, metres.
    origins: Origins,
}

#[derive(Clone, Copy)]
struct Origins {
    fine: (f32, f32),
    middle: (f32, f32),
    cover: (f32, f32),
}

/// Colours and reciprocal depths of one band of [`BLOCK`] rows.
pub(super) struct Band {
    pub top: usize,
    pub rows: usize,
    pub width: usize,
    pub colour: Vec<Rgb>,
    pub inv_depth: Vec<f32>,
}

impl Band {
    /// Light becomes near infrared: plants are bright where they are green, all else is about as bright
    /// as it is red.
    pub(super) fn turn_near_infrared(&mut self) {
        for [red, green, blue, _] in &mut self.colour {
            let light = 0.8 * *red + 1.5 * (1.6 * *green - *red).max(0.0);
            (*red, *green, *blue) = (light, light, light);
        }
    }

    /// Rows of the image that it holds.
    pub(super) fn extent_rows(&self) -> std::ops::Range<usize> {
        self.top..self.top + self.rows
    }
}

/// Levels of the ground's textures for one block.
struct Levels<'a> {
    cover: Lod<'a>,
    middle: Lod<'a>,
    /// `None` where it has blurred into its mean.
    fine: Option<Lod<'a>>,
}

/// Direct light of a clear noon: red, green, blue, near infrared.
const NOON: Rgb = [2.3, 2.15, 1.9, 2.15];
/// What one more vertical air mass takes away; blue goes first.
const LOST: Rgb = [0.02, 0.05, 0.12, 0.01];
/// From here down the sun reddens, degrees; above, what the air takes is in the noon's colours.
const LOW_SUN_DEG: f64 = 12.0;

/// Share of the direct light that a low sun's longer way through the air leaves.
fn left_by_air(sun_elevation_deg: f64) -> Rgb {
    let air_mass = |deg: f64| 1.0 / deg.max(2.0).to_radians().sin();
    let more = (air_mass(sun_elevation_deg) - air_mass(LOW_SUN_DEG)).max(0.0) as f32;
    LOST.map(|lost| (-lost * more).exp())
}

impl<'a> Ground<'a> {
    pub(super) fn new(
        world: &'a World,
        pose: EyePose,
        grid: &'a RayGrid,
        marks: &'a MarkGrid,
        t_s: f64,
    ) -> Self {
        let light = world.light();
        let (sun, sky) = (light.sun as f32, light.ambience as f32);
        let left = left_by_air(light.sun_elevation_deg);
        let at = (pose.origin_m.x, pose.origin_m.y);
        let textures = world.textures();
        let origin = |texture: &Texture| texture.origin(at);
        let mut ground = Self {
            world,
            pose,
            sun: world.sun(),
            grid,
            nodes: Vec::new(),
            marks,
            glows: world.glows(t_s),
            sunlight: std::array::from_fn(|c| NOON[c] * left[c] * sun),
            left_by_air: left,
            skylight: [0.50, 0.56, 0.66, 0.56].map(|c| c * sky),
            origins: Origins {
                fine: origin(&textures.fine),
                middle: origin(&textures.middle),
                cover: origin(&textures.cover),
            },
        };
        let corners = (0..grid.columns * grid.rows).into_par_iter();
        ground.nodes = corners
            .map(|i| ground.node(ground.grid.tangents(i % grid.columns, i / grid.columns)))
            .collect();
        ground
    }

    fn node(&self, (x, y): (f64, f64)) -> Node {
        let ray = self.pose.enu_from_camera * Vector3::new(x, y, 1.0);
        let mut node = Node {
            x: x as f32,
            y: y as f32,
            ray: [ray.x as f32, ray.y as f32, ray.z as f32],
            ..Node::default()
        };
        let Some(depth) = self
            .world
            .terrain()
            .hit(&self.pose.origin_m, &ray, FARTHEST_M)
        else {
            return node;
        };
        let at = self.pose.origin_m + ray * depth;
        let normal = self.world.terrain().normal(at.x, at.y);
        node.inv_depth = (1.0 / depth) as f32;
        node.shade = normal.dot(&self.sun).max(0.0) as f32;
        node.tone = self.tone(at.x, at.y);
        node.haze = (1.0 - (-depth / self.world.light().visibility_m).exp()) as f32;
        node
    }

    /// Lightness over fields of a hundred metres, so that the cover's tile is not seen to repeat.
    fn tone(&self, east: f64, north: f64) -> f32 {
        let slow = self.world.textures().middle.lod(0.5);
        let level = slow.at((east / 37.0) as f32, (north / 37.0) as f32)[1] * UNIT;
        0.45 + 0.55 * level
    }

    /// Where a pixel's ray goes in camera components, right and down per metre of depth.
    pub(super) fn tangents_at(&self, px: usize, py: usize) -> (f32, f32) {
        let (column, row) = (px / BLOCK, py / BLOCK);
        let fx = (px % BLOCK) as f32 / BLOCK as f32;
        let fy = (py % BLOCK) as f32 / BLOCK as f32;
        let corner = |c: usize, r: usize| &self.nodes[(row + r) * self.grid.columns + column + c];
        let along = |value: fn(&Node) -> f32| {
            let top = value(corner(0, 0)) * (1.0 - fx) + value(corner(1, 0)) * fx;
            let bottom = value(corner(0, 1)) * (1.0 - fx) + value(corner(1, 1)) * fx;
            top * (1.0 - fy) + bottom * fy
        };
        (along(|n| n.x), along(|n| n.y))
    }

    /// Draws ground and sky into a fresh band.
    pub(super) fn band(&self, block_row: usize, width: usize, height: usize) -> Band {
        let top = block_row * BLOCK;
        let rows = BLOCK.min(height - top);
        let mut band = Band {
            top,
            rows,
            width,
            colour: vec![[0.0; 4]; width * rows],
            inv_depth: vec![0.0; width * rows],
        };
        for column in 0..width.div_ceil(BLOCK) {
            self.block(&mut band, column, block_row);
        }
        band
    }

    fn block(&self, band: &mut Band, column: usize, row: usize) {
        let first = row * self.grid.columns + column;
        let second = first + self.grid.columns;
        let corners = [
            self.nodes[first],
            self.nodes[first + 1],
            self.nodes[second],
            self.nodes[second + 1],
        ];
        let nearest = corners.iter().map(|n| n.inv_depth).fold(0.0, f32::max);
        let farthest = corners
            .iter()
            .map(|n| n.inv_depth)
            .fold(f32::INFINITY, f32::min);
        // A crest or the horizon runs through: every pixel for itself.
        let broken = nearest > 0.0 && farthest < 0.7 * nearest;
        if broken {
            self.broken_block(band, column, row);
        } else if nearest == 0.0 {
            self.sky_block(band, column, &corners);
        } else {
            self.ground_block(band, column, &corners);
        }
    }

    fn ground_block(&self, band: &mut Band, column: usize, corners: &[Node; 4]) {
        let levels = self.levels(corners);
        let marks = self.marks_under(corners);
        let left = column * BLOCK;
        let columns = BLOCK.min(band.width - left);
        for row in 0..band.rows {
            let down = row as f32 / BLOCK as f32;
            let (start, end) = (
                between(&corners[0], &corners[2], down),
                between(&corners[1], &corners[3], down),
            );
            let offset = row * band.width + left;
            for k in 0..columns {
                let at = between(&start, &end, k as f32 / BLOCK as f32);
                band.inv_depth[offset + k] = at.inv_depth;
                band.colour[offset + k] = self.ground_colour(&at, &levels, &marks);
            }
        }
    }

    fn sky_block(&self, band: &mut Band, column: usize, corners: &[Node; 4]) {
        let left = column * BLOCK;
        for row in 0..band.rows {
            let down = row as f32 / BLOCK as f32;
            let (start, end) = (
                between(&corners[0], &corners[2], down),
                between(&corners[1], &corners[3], down),
            );
            for k in 0..BLOCK.min(band.width - left) {
                let at = between(&start, &end, k as f32 / BLOCK as f32);
                band.colour[row * band.width + left + k] = self.sky(&at.ray);
            }
        }
    }

    fn broken_block(&self, band: &mut Band, column: usize, block_row: usize) {
        let left = column * BLOCK;
        for row in 0..band.rows {
            for px in left..(left + BLOCK).min(band.width) {
                let (x, y) = self.tangents_at(px, block_row * BLOCK + row);
                let node = self.node((f64::from(x), f64::from(y)));
                let offset = row * band.width + px;
                band.inv_depth[offset] = node.inv_depth;
                band.colour[offset] = if node.inv_depth > 0.0 {
                    let levels = self.levels_for(self.grazing_footprint(&node));
                    self.ground_colour(&node, &levels, &self.marks_under(&[node; 4]))
                } else {
                    self.sky(&node.ray)
                };
            }
        }
    }

    /// Ground that a pixel sees at a grazing angle, metres.
    fn grazing_footprint(&self, node: &Node) -> f32 {
        let across =
            (self.grid.tangents(1, 0).0 - self.grid.tangents(0, 0).0) as f32 / BLOCK as f32;
        3.0 * across / node.inv_depth
    }

    fn levels(&self, corners: &[Node; 4]) -> Levels<'a> {
        let place = |n: &Node| (n.ray[0] / n.inv_depth, n.ray[1] / n.inv_depth);
        let (a, b, c) = (place(&corners[0]), place(&corners[1]), place(&corners[2]));
        let (across, down) = ((b.0 - a.0, b.1 - a.1), (c.0 - a.0, c.1 - a.1));
        let area = (across.0 * down.1 - across.1 * down.0).abs();
        let longest = across.0.hypot(across.1).max(down.0.hypot(down.1)).max(1e-6);
        // Between the short and the long side of a pixel's footprint: neither blur nor alias wins.
        let footprint = (area.sqrt().max(longest / 4.0)) / BLOCK as f32;
        self.levels_for(SHARPNESS * footprint)
    }

    fn levels_for(&self, footprint_m: f32) -> Levels<'a> {
        let textures = self.world.textures();
        let fine = (!textures.fine.is_flat_at(footprint_m)).then(|| textures.fine.lod(footprint_m));
        Levels {
            cover: textures.cover.lod(footprint_m),
            middle: textures.middle.lod(footprint_m),
            fine,
        }
    }

    fn marks_under(&self, corners: &[Node; 4]) -> Vec<LocalMark> {
        let place = |n: &Node| (n.ray[0] / n.inv_depth, n.ray[1] / n.inv_depth);
        let places = corners.map(|n| place(&n));
        let low = places
            .iter()
            .fold((f32::MAX, f32::MAX), |l, p| (l.0.min(p.0), l.1.min(p.1)));
        let high = places
            .iter()
            .fold((f32::MIN, f32::MIN), |h, p| (h.0.max(p.0), h.1.max(p.1)));
        let (east, north) = (self.pose.origin_m.x, self.pose.origin_m.y);
        let mut local = Vec::new();
        self.marks.within(
            (east + f64::from(low.0), north + f64::from(low.1)),
            (east + f64::from(high.0), north + f64::from(high.1)),
            |mark| {
                local.push(LocalMark {
                    effect: Effect::Mark(mark.kind),
                    east: (mark.centre_m.x - east) as f32,
                    north: (mark.centre_m.y - north) as f32,
                    inv_radius: (1.0 / mark.radius_m) as f32,
                });
            },
        );
        local.extend(self.glows.iter().filter_map(|glow| {
            let (e, n) = (
                (glow.centre_m.x - east) as f32,
                (glow.centre_m.y - north) as f32,
            );
            let reach = 4.0 * glow.radius_m as f32;
            let near =
                e > low.0 - reach && e < high.0 + reach && n > low.1 - reach && n < high.1 + reach;
            let inv_radius = (1.0 / glow.radius_m) as f32;
            near.then_some(LocalMark {
                effect: Effect::Glow(glow.strength),
                east: e,
                north: n,
                inv_radius,
            })
        }));
        local
    }

    fn ground_colour(&self, at: &Node, levels: &Levels, marks: &[LocalMark]) -> Rgb {
        let depth = 1.0 / at.inv_depth;
        let (east, north) = (at.ray[0] * depth, at.ray[1] * depth);
        let sample = |lod: &Lod, origin: (f32, f32)| lod.at(east + origin.0, north + origin.1);
        let cover = sample(&levels.cover, self.origins.cover);
        let middle = sample(&levels.middle, self.origins.middle);
        let mut albedo: Rgb =
            std::array::from_fn(|c| cover[c] * middle[c] * (at.tone * UNIT / 255.0));
        if let Some(fine) = &levels.fine {
            let fine = sample(fine, self.origins.fine);
            albedo = std::array::from_fn(|c| albedo[c] * fine[c] * UNIT);
        }
        let (sunlight, skylight) = (self.sunlight, self.skylight);
        let mut light: Rgb = std::array::from_fn(|c| sunlight[c] * at.shade + skylight[c]);
        for mark in marks {
            mark.apply(east, north, middle[1] * UNIT, &mut albedo, &mut light, self);
        }
        let colour = std::array::from_fn(|c| albedo[c] * light[c]);
        if at.haze < 0.004 {
            colour
        } else {
            mix(colour, self.haze_colour(), at.haze)
        }
    }

    fn haze_colour(&self) -> Rgb {
        std::array::from_fn(|c| 0.12 * self.sunlight[c] + 0.75 * self.skylight[c])
    }

    /// Colour of the sky along a ray that need not be of unit length.
    fn sky(&self, ray: &[f32; 3]) -> Rgb {
        let length = (ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]).sqrt();
        let elevation = (ray[2] / length).max(0.0);
        let clear = self.world.light().sun.min(1.0) as f32;
        let grey = self.haze_colour();
        let blue: Rgb = std::array::from_fn(|c| [0.30, 0.55, 1.05, 0.6][c] * self.skylight[c]);
        let zenith = mix(grey, blue, clear);
        let mut colour = mix(grey, zenith, (2.5 * elevation).min(1.0));
        let reach = 0.4 / elevation.max(0.05);
        let billows = self.world.textures().billows.lod(0.004);
        let cloud = billows.at(reach * ray[0] / length, reach * ray[1] / length)[1] * UNIT;
        let cover = ((cloud - 0.95) * 1.6).clamp(0.0, 0.8) * (4.0 * elevation).min(1.0);
        colour = mix(colour, grey.map(|c| 1.15 * c), cover);
        let towards =
            (ray[0] * self.sun.x as f32 + ray[1] * self.sun.y as f32 + ray[2] * self.sun.z as f32)
                / length;
        let glare = clear * (towards.max(0.0).powi(64) * 0.8 + towards.max(0.0).powi(4096) * 60.0);
        let glare_of = |c: usize| [1.0, 0.93, 0.8, 0.93][c] * self.left_by_air[c];
        std::array::from_fn(|c| colour[c] + glare * glare_of(c))
    }

    /// Light on a surface with this normal (east, north, up) and albedo.
    pub(super) fn lit(&self, normal: &Vector3<f32>, albedo: &[f32; 3], gain: f32) -> Rgb {
        let sun = normal.dot(&self.sun.cast::<f32>()).max(0.0);
        let sky = 0.6 + 0.4 * normal.z;
        let light = |c: usize| gain * (self.sunlight[c] * sun + self.skylight[c] * sky);
        [
            albedo[0] * light(0),
            albedo[1] * light(1),
            albedo[2] * light(2),
            albedo[1] * light(1),
        ]
    }

    pub(super) fn world(&self) -> &World {
        self.world
    }

    pub(super) fn pose(&self) -> &EyePose {
        &self.pose
    }
}

/// A mark or a glow beside an eye.
struct LocalMark {
    effect: Effect,
    east: f32,
    north: f32,
    inv_radius: f32,
}

enum Effect {
    Mark(MarkKind),
    Glow(f32),
}

impl LocalMark {
    /// `ragged` is about one and wanders from place to place.
    fn apply(
        &self,
        east: f32,
        north: f32,
        ragged: f32,
        albedo: &mut Rgb,
        light: &mut Rgb,
        ground: &Ground,
    ) {
        let (de, dn) = (
            (east - self.east) * self.inv_radius,
            (north - self.north) * self.inv_radius,
        );
        let r2 = de * de + dn * dn;
        let inside = ((1.15 - r2 + 0.8 * (ragged - 1.0)) / 0.45).clamp(0.0, 1.0);
        match self.effect {
            Effect::Glow(strength) => {
                let glow = strength / (1.0 + 3.0 * r2 * r2);
                *light = std::array::from_fn(|c| light[c] + glow * [3.2, 1.2, 0.25, 1.2][c]);
            }
            Effect::Mark(MarkKind::Shadow) => {
                let shaded: Rgb = std::array::from_fn(|c| {
                    ground.skylight[c] + 0.12 * (light[c] - ground.skylight[c])
                });
                *light = mix(*light, shaded, inside);
            }
            Effect::Mark(MarkKind::Scorch) => {
                let burnt = std::array::from_fn(|c| 0.22 * albedo[c] + 0.008);
                *albedo = mix(*albedo, burnt, inside);
            }
            Effect::Mark(MarkKind::Puddle) => {
                *albedo = mix(*albedo, [0.16, 0.18, 0.21, 0.18], inside);
            }
        }
    }
}

/// A node on the straight way from one to another.
#[inline]
fn between(a: &Node, b: &Node, weight: f32) -> Node {
    let along = |a: f32, b: f32| a + (b - a) * weight;
    Node {
        x: 0.0,
        y: 0.0,
        ray: std::array::from_fn(|k| along(a.ray[k], b.ray[k])),
        inv_depth: along(a.inv_depth, b.inv_depth),
        shade: along(a.shade, b.shade),
        tone: along(a.tone, b.tone),
        haze: along(a.haze, b.haze),
    }
}
