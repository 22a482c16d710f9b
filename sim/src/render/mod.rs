//! What a camera sees of the world.
//!
//! **Purpose.** Raw images of a stereo rig, with lens distortion, noise and gamma, and boxes of what
//! burns in them. **In:** [`World`], [`StereoCamera`], [`BodyState`] (east, north, up of the datum's
//! plane, metres), seconds of flight. **Out:** [`Frame`]s as a camera gives them: left 8-bit BGR,
//! right 8-bit grey; pixels with centres at whole numbers.
//!
//! **Assumptions.** Global shutter, no motion blur, the pose holds for the whole exposure. The same
//! world, configuration, eye, pose and time give the same bytes.
//! **Known limits.** A thing that reaches nearer than half a metre to the camera is not drawn. Flames
//! are translucent clouds without refraction. Shadows are soft spots, not projected shapes.

mod camera;
mod ground;
mod labels;
mod marks;
mod sensor;
mod solids;
mod splats;
pub mod studio;

pub use camera::StereoCamera;
pub use labels::{LabelBox, LabelMask};

use crate::state::BodyState;
use crate::world::{Burning, Splat, World};
use camera::{EyePose, Lens};
use emberfix_calib::Eye;
use ground::{BLOCK, Band, Ground, RayGrid};
use marks::MarkGrid;
use nalgebra::Vector3;
use rayon::prelude::*;
use sensor::{Channels, Sensor};
use solids::Solids;
use splats::SeenSplat;
use std::ops::Range;
use std::sync::Arc;

/// How the cameras expose.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderConfig {
    /// Seed of the noise.
    pub seed: u64,
    /// Noise at mid grey, digital numbers of 255.
    pub noise_sigma_dn: f64,
    /// Factor on all light; 1 suits a clear noon.
    pub exposure: f64,
    /// Right eye's gain against the left one's.
    pub right_gain: f64,
    /// Loss of light in the image's corners, 0 to 1.
    pub vignetting: f64,
}

impl Default for RenderConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            noise_sigma_dn: 2.0,
            exposure: 1.0,
            right_gain: 1.04,
            vignetting: 0.25,
        }
    }
}

/// Layout of a frame's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelFormat {
    /// Blue, green, red; one byte each.
    Bgr8,
    /// One byte.
    Mono8,
}

/// One raw image, rows from the top, no padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Layout of `bytes`.
    pub format: PixelFormat,
    /// `width * height` pixels.
    pub bytes: Vec<u8>,
}

/// Draws a world as a rig sees it.
#[derive(Debug, Clone)]
pub struct Renderer {
    world: Arc<World>,
    camera: StereoCamera,
    sensor: Sensor,
    rays: [RayGrid; 2],
    marks: MarkGrid,
}

impl Renderer {
    /// Prepares what never changes from frame to frame.
    #[must_use]
    pub fn new(world: Arc<World>, camera: StereoCamera, config: RenderConfig) -> Self {
        let rays = [Eye::Left, Eye::Right].map(|eye| RayGrid::new(camera.lens(eye)));
        let marks = MarkGrid::new(&world.things().marks);
        Self {
            world,
            camera,
            sensor: Sensor::new(config),
            rays,
            marks,
        }
    }

    /// The world that it draws.
    #[must_use]
    pub fn world(&self) -> &World {
        &self.world
    }

    /// One eye's raw image of a moment.
    #[must_use]
    pub fn render(&self, eye: Eye, body: &BodyState, t_s: f64) -> Frame {
        let (lens, pose) = (self.camera.lens(eye), self.camera.pose(eye, body));
        let ground = Ground::new(&self.world, pose, self.rays(eye), &self.marks, t_s);
        let solids = Solids::new(self.world.things(), &pose, lens);
        let near_infrared = self.camera.is_near_infrared(eye);
        let shining = self.shining(&pose, t_s).map(|splat| {
            if near_infrared {
                splats::in_near_infrared(splat)
            } else {
                splat
            }
        });
        let splats = splats::seen(shining, &pose, lens);
        let exposure = self.sensor.exposure(eye, t_s);
        let channels = eye.channels();
        let mut bytes = vec![0; lens.width * lens.height * channels];
        bytes
            .par_chunks_mut(BLOCK * lens.width * channels)
            .enumerate()
            .for_each(|(row, out)| {
                let mut band = ground.band(row, lens.width, lens.height);
                solids.draw(&mut band, &ground);
                if near_infrared {
                    band.turn_near_infrared();
                }
                self.draw_splats(&mut band, &splats);
                self.sensor.develop(&band, lens.height, exposure, out);
            });
        let format = if channels == 3 {
            PixelFormat::Bgr8
        } else {
            PixelFormat::Mono8
        };
        Frame {
            width: lens.width as u32,
            height: lens.height as u32,
            format,
            bytes,
        }
    }

    /// Raw pixel of a point (east, north, up, metres), with distortion; `None` behind the camera and
    /// outside the image. Says nothing of what stands in front of it.
    #[must_use]
    pub fn project(&self, eye: Eye, point_m: Vector3<f64>, body: &BodyState) -> Option<(f64, f64)> {
        let lens = self.camera.lens(eye);
        let pixel = lens.project(&self.camera.pose(eye, body).see(&point_m))?;
        lens.holds(pixel).then_some(pixel)
    }

    /// Boxes of the fire and smoke that the left eye sees, one per fire and class.
    #[must_use]
    pub fn label_boxes(&self, body: &BodyState, t_s: f64) -> Vec<LabelBox> {
        let masks = self.label_masks(body, t_s);
        masks.into_iter().map(|mask| mask.label).collect()
    }

    /// Around all that burns before the lens, hidden or not, as if nothing stood between.
    #[must_use]
    pub fn burning_boxes(&self, body: &BodyState, t_s: f64) -> Vec<LabelBox> {
        let (lens, pose) = (
            self.camera.lens(Eye::Left),
            self.camera.pose(Eye::Left, body),
        );
        let label = |burning: &Burning| labels::unhidden(burning, &self.world, &pose, lens);
        let masks = self.world.burning(t_s);
        masks.iter().filter_map(label).map(|m| m.label).collect()
    }

    /// The same as [`label_boxes`](Self::label_boxes), with their pixels.
    #[must_use]
    pub fn label_masks(&self, body: &BodyState, t_s: f64) -> Vec<LabelMask> {
        let (lens, pose) = (
            self.camera.lens(Eye::Left),
            self.camera.pose(Eye::Left, body),
        );
        let solids = Solids::new(self.world.things(), &pose, lens);
        let label = |burning: &Burning| labels::label(burning, &self.world, &pose, lens, &solids);
        self.world.burning(t_s).iter().filter_map(label).collect()
    }

    fn rays(&self, eye: Eye) -> &RayGrid {
        match eye {
            Eye::Left => &self.rays[0],
            Eye::Right => &self.rays[1],
        }
    }

    fn shining(&self, pose: &EyePose, t_s: f64) -> impl Iterator<Item = Splat> {
        let things = self.world.things();
        let sun = self.world.sun();
        let bright = self.world.light().sun > 0.3;
        let burning = self
            .world
            .burning(t_s)
            .into_iter()
            .flat_map(|burning| burning.splats);
        let glints = things.glints.iter().filter(move |_| bright);
        let glints = glints.flat_map(move |glint| glint.splats(&pose.origin_m, &sun, t_s));
        burning.chain(glints).chain(things.clouds.iter().copied())
    }

    fn draw_splats(&self, band: &mut Band, splats: &[SeenSplat]) {
        let billows = splats::billows(self.world.textures());
        let rows = band.extent_rows();
        for splat in splats.iter().filter(|splat| splat.extent.reaches(&rows)) {
            splat.draw(band, &billows);
        }
    }
}

/// JPEG of a frame, quality 1 to 100. Empty only for a frame whose bytes don't fit its size.
#[must_use]
pub fn encode_jpeg(frame: &Frame, quality: u8) -> Vec<u8> {
    let mut jpeg = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, quality);
    let (pixels, colour) = match frame.format {
        PixelFormat::Mono8 => (frame.bytes.clone(), image::ExtendedColorType::L8),
        PixelFormat::Bgr8 => (frame.rgb(), image::ExtendedColorType::Rgb8),
    };
    let fits = pixels.len() as u64
        == u64::from(frame.width) * u64::from(frame.height) * u64::from(colour.channel_count());
    let written = fits
        && image::ImageEncoder::write_image(encoder, &pixels, frame.width, frame.height, colour)
            .is_ok();
    if written { jpeg } else { Vec::new() }
}

impl Frame {
    /// Pixels as red, green, blue (grey stays grey, three times).
    #[must_use]
    pub fn rgb(&self) -> Vec<u8> {
        match self.format {
            PixelFormat::Mono8 => self.bytes.iter().flat_map(|grey| [*grey; 3]).collect(),
            PixelFormat::Bgr8 => self
                .bytes
                .chunks_exact(3)
                .flat_map(|p| [p[2], p[1], p[0]])
                .collect(),
        }
    }
}

/// Whole pixels: from left and top, up to and without right and bottom.
#[derive(Debug, Clone, Copy)]
struct PixelBox {
    left: usize,
    top: usize,
    right: usize,
    bottom: usize,
}

/// The same before it is clipped to an image.
#[derive(Debug, Clone, Copy)]
struct Reach {
    low: (f64, f64),
    high: (f64, f64),
}

impl PixelBox {
    fn unclipped(middle: (f64, f64), reach: (f64, f64)) -> Reach {
        Reach {
            low: (middle.0 - reach.0, middle.1 - reach.1),
            high: (middle.0 + reach.0, middle.1 + reach.1),
        }
    }

    fn around(middle: (f64, f64), reach: (f64, f64), lens: &Lens) -> Option<Self> {
        Self::unclipped(middle, reach).clipped(lens)
    }

    fn with(&self, other: &Self) -> Self {
        Self {
            left: self.left.min(other.left),
            top: self.top.min(other.top),
            right: self.right.max(other.right),
            bottom: self.bottom.max(other.bottom),
        }
    }

    fn columns(&self) -> usize {
        self.right - self.left
    }

    fn rows(&self) -> usize {
        self.bottom - self.top
    }

    fn reaches(&self, rows: &Range<usize>) -> bool {
        self.top < rows.end && self.bottom > rows.start
    }

    /// Visits the pixels that it shares with a band: column, row, offset in the band.
    fn each_pixel(&self, band: &mut Band, mut visit: impl FnMut(&mut Band, usize, usize, usize)) {
        for py in self.top.max(band.top)..self.bottom.min(band.top + band.rows) {
            let line = (py - band.top) * band.width;
            for px in self.left..self.right {
                visit(band, px, py, line + px);
            }
        }
    }
}

impl Reach {
    fn with(&self, other: &Self) -> Self {
        Self {
            low: (self.low.0.min(other.low.0), self.low.1.min(other.low.1)),
            high: (self.high.0.max(other.high.0), self.high.1.max(other.high.1)),
        }
    }

    fn clipped(&self, lens: &Lens) -> Option<PixelBox> {
        let edge = |value: f64, most: usize| value.clamp(0.0, most as f64) as usize;
        let clipped = PixelBox {
            left: edge(self.low.0.floor(), lens.width),
            top: edge(self.low.1.floor(), lens.height),
            right: edge(self.high.0.floor() + 1.0, lens.width),
            bottom: edge(self.high.1.floor() + 1.0, lens.height),
        };
        (clipped.left < clipped.right && clipped.top < clipped.bottom).then_some(clipped)
    }
}

#[cfg(test)]
mod tests;
