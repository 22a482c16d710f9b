//! Flames, smoke and lamps in an eye's image.

use super::PixelBox;
use super::camera::EyePose;
use super::camera::Lens;
use super::ground::Band;
use crate::world::{Lod, Splat, SplatKind, Textures, UNIT};
use nalgebra::Vector3;

/// Nothing nearer to the camera than this is drawn, metres of depth.
const NEAREST_M: f64 = 0.5;
/// A splat is never drawn smaller than this; a smaller one is fainter instead, pixels.
const SMALLEST_PX: f64 = 1.2;

/// A splat that an eye may see.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenSplat {
    pub extent: PixelBox,
    pub kind: SplatKind,
    pub depth_m: f32,
    /// Right and down of the boresight per metre of depth.
    pub tangents: (f32, f32),
    /// Ground or things nearer than this hide it, 1/m.
    inv_hiding_depth: f32,
    middle_px: (f32, f32),
    /// Along the long axis, per pixel.
    long_per_px: (f32, f32),
    /// Across it, per pixel.
    wide_per_px: (f32, f32),
    colour: [f32; 3],
    opacity: f32,
    billow: (f32, f32),
}

impl SeenSplat {
    pub(super) fn new(splat: &Splat, pose: &EyePose, lens: &Lens) -> Option<Self> {
        Self::beyond(NEAREST_M, splat, pose, lens)
    }

    /// A splat, if all of it is beyond `nearest_m` of depth.
    pub(super) fn beyond(
        nearest_m: f64,
        splat: &Splat,
        pose: &EyePose,
        lens: &Lens,
    ) -> Option<Self> {
        let centre = pose.see(&splat.centre_m);
        if centre.z < nearest_m + splat.half_width_m {
            return None;
        }
        let middle = lens.project(&centre)?;
        let tip = lens.project(&pose.see(&(splat.centre_m + splat.half_axis_m)))?;
        let scale = lens.focal_px.0 / centre.z;
        let (long, wide, axis) = shape(splat, middle, tip, scale);
        let (drawn_long, drawn_wide) = (long.max(SMALLEST_PX), wide.max(SMALLEST_PX));
        let faintness = (long * wide) / (drawn_long * drawn_wide);
        let reach = (
            (drawn_long * axis.0.abs()).hypot(drawn_wide * axis.1.abs()) + 1.0,
            (drawn_long * axis.1.abs()).hypot(drawn_wide * axis.0.abs()) + 1.0,
        );
        let fade = faintness as f32;
        Some(Self {
            extent: PixelBox::around(middle, reach, lens)?,
            kind: splat.kind,
            depth_m: centre.z as f32,
            tangents: ((centre.x / centre.z) as f32, (centre.y / centre.z) as f32),
            inv_hiding_depth: (1.0 / (centre.z - 0.3 * splat.half_width_m)) as f32,
            middle_px: (middle.0 as f32, middle.1 as f32),
            long_per_px: ((axis.0 / drawn_long) as f32, (axis.1 / drawn_long) as f32),
            wide_per_px: ((-axis.1 / drawn_wide) as f32, (axis.0 / drawn_wide) as f32),
            colour: if splat.kind == SplatKind::Light {
                splat.colour.map(|c| c * fade)
            } else {
                splat.colour
            },
            opacity: splat.opacity * fade,
            billow: splat.billow,
        })
    }

    /// How much of the splat a pixel sees: 0 outside, 1 in the middle, torn by the billows.
    #[inline]
    pub(super) fn cover(&self, px: usize, py: usize, billows: &Lod) -> f32 {
        let (dx, dy) = (px as f32 - self.middle_px.0, py as f32 - self.middle_px.1);
        let along = dx * self.long_per_px.0 + dy * self.long_per_px.1;
        let across = dx * self.wide_per_px.0 + dy * self.wide_per_px.1;
        let r2 = along * along + across * across;
        if r2 >= 1.0 {
            return 0.0;
        }
        let kernel = (1.0 - r2) * (1.0 - r2);
        if self.kind == SplatKind::Light {
            return kernel;
        }
        let torn =
            billows.at(self.billow.0 + 0.22 * across, self.billow.1 - 0.22 * along)[1] * UNIT;
        // Soot shines in filaments with gaps between them.
        kernel * torn * torn * torn.min(1.4)
    }

    /// Share of the light behind that it holds back at a cover.
    #[inline]
    pub(super) fn alpha(&self, cover: f32) -> f32 {
        (self.opacity * cover * 1.3).min(0.97)
    }

    /// Draws it into a band, over what is there.
    pub(super) fn draw(&self, band: &mut Band, billows: &Lod) {
        self.extent.each_pixel(band, |band, px, py, offset| {
            if band.inv_depth[offset] > self.inv_hiding_depth {
                return;
            }
            let cover = self.cover(px, py, billows);
            if cover > 0.002 {
                self.blend(&mut band.colour[offset], cover);
            }
        });
    }

    #[inline]
    fn blend(&self, colour: &mut [f32; 4], cover: f32) {
        let (added, kept) = self.given(cover);
        for (c, own) in added.iter().enumerate() {
            colour[c] = colour[c] * kept + own;
        }
    }

    /// Light that it adds at a cover, and the share of the light behind that it lets through.
    #[inline]
    pub(super) fn given(&self, cover: f32) -> ([f32; 3], f32) {
        let alpha = self.alpha(cover);
        let (kept, added) = match self.kind {
            // Soot holds back less than it shines.
            SplatKind::Flame => (1.0 - 0.6 * alpha, alpha),
            SplatKind::Smoke => (1.0 - alpha, alpha),
            SplatKind::Light => (1.0, cover),
        };
        (self.colour.map(|own| own * added), kept)
    }

    /// Half widths of the splat that a pixel spans.
    pub(super) fn across_per_px(&self) -> f32 {
        self.wide_per_px.0.hypot(self.wide_per_px.1)
    }
}

/// Half length, half width and the long axis' direction, pixels.
fn shape(splat: &Splat, middle: (f64, f64), tip: (f64, f64), scale: f64) -> (f64, f64, (f64, f64)) {
    let (du, dv) = (tip.0 - middle.0, tip.1 - middle.1);
    let seen = du.hypot(dv);
    let wide = splat.half_width_m * scale;
    let full = (splat.half_axis_m.norm() * scale).max(1e-9);
    // Seen end on, an ellipsoid shows its width.
    let end_on = (1.0 - (seen / full).powi(2)).clamp(0.0, 1.0);
    let long = (seen * seen + wide * wide * end_on).sqrt();
    let axis = if seen > 1e-6 {
        (du / seen, dv / seen)
    } else {
        (0.0, -1.0)
    };
    (long, wide, axis)
}

/// What shines and smokes before an eye, farthest first.
pub(super) fn seen(
    splats: impl Iterator<Item = Splat>,
    pose: &EyePose,
    lens: &Lens,
) -> Vec<SeenSplat> {
    let mut seen: Vec<SeenSplat> = splats
        .filter_map(|splat| SeenSplat::new(&splat, pose, lens))
        .collect();
    seen.sort_by(|a, b| b.depth_m.total_cmp(&a.depth_m));
    seen
}

/// The billows as every splat cuts them.
pub(super) fn billows(textures: &Textures) -> Lod<'_> {
    textures.billows.lod(0.001)
}

/// Distance of a splat's far side from an eye: where a ray to it must pass freely.
pub(super) fn ray_to(splat: &Splat, pose: &EyePose) -> Vector3<f64> {
    splat.centre_m - pose.origin_m
}

/// A splat as it is seen just beyond red: the cooler (redder) its soot, the more light; smoke is thinner.
pub(super) fn in_near_infrared(splat: Splat) -> Splat {
    let [red, green, blue] = splat.colour;
    let light = match splat.kind {
        SplatKind::Flame => {
            let redness = 1.0 - green / red.max(1e-6);
            red * (0.8 + 1.2 * redness * redness)
        }
        SplatKind::Smoke | SplatKind::Light => (red + green + blue) / 3.0,
    };
    let thinner = if splat.kind == SplatKind::Smoke {
        0.6
    } else {
        1.0
    };
    Splat {
        colour: [light; 3],
        opacity: thinner * splat.opacity,
        ..splat
    }
}
