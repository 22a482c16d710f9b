//! Labelled pictures for the detector's training, from random worlds and poses.
//!
//! **Purpose.** JPEGs of 416 by 416 pixels as the detector sees them, with YOLO labels. **In:** a
//! rig, a count, a seed. **Out:** `images/NNNNNN.jpg` and `labels/NNNNNN.txt` (class, centre x,
//! centre y, width, height, all but the class as shares of the side; class 0 is fire, 1 smoke; an
//! empty file is a picture without either).
//!
//! With [`Form::outlines`] a label is an outline instead: the class, then columns and rows of a closed line's
//! corners as shares of the sides, which encloses the pixels of flame or smoke by the rule of odd crossings.
//!
//! Most pictures are cut from the raw left image at its own scale; some are the whole image, shrunk
//! and letter-boxed. Or, by [`Framing::Whole`], each is the raw left image as it is. The same rig, count,
//! seed and framing give the same bytes.
//! **Known limits.** One lens and one kind of flame: real pictures must be mixed in.

mod label;
mod outline;

use crate::render::{
    Frame, LabelBox, LabelMask, PixelFormat, RenderConfig, Renderer, StereoCamera, encode_jpeg,
};
use crate::state::BodyState;
use crate::world::{
    BurningClass, FireConfig, GroundCover, LightConfig, LookalikeConfig, LookalikeKind,
    SmokeConfig, TerrainConfig, TreesConfig, WindConfig, World, WorldConfig, WorldError,
};
use emberfix_calib::{Eye, Rig};
use image::{RgbImage, imageops};
use label::{Window, YoloLabel};
use nalgebra::{Matrix3, Vector2, Vector3};
use rand::seq::IndexedRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Side of a picture, pixels.
const SIDE: u32 = 416;
/// Grey of the letter-box's bars.
const BARS: u8 = 114;
/// Pictures taken in one world.
const POSES: usize = 4;

/// Why no data set was written.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A file or folder can't be written.
    #[error("data set {path}: {source}", path = path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A random world broke a world's rules.
    #[error("data set: {0}")]
    World(#[from] WorldError),
    /// The rig's images are smaller than the pictures.
    #[error("data set: images of {width} by {height} pixels, needed are at least {SIDE} by {SIDE}")]
    TooSmall {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
}

/// What of the raw left image a picture shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Framing {
    /// What a detector gets to see: a cut-out, or all of it shrunk.
    Cut,
    /// All of it at its own scale.
    Whole,
}

/// How pictures and labels are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Form {
    /// What pictures show.
    pub framing: Framing,
    /// Labels are outlines instead of boxes.
    pub outlines: bool,
}

/// What was written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DatasetSummary {
    /// All pictures.
    pub pictures: usize,
    /// Those with at least one flame.
    pub with_fire: usize,
    /// Those with neither flame nor smoke.
    pub empty: usize,
    /// Flames labelled.
    pub fires: usize,
    /// Smokes labelled.
    pub smokes: usize,
}

/// Writes `pictures` labelled pictures into `dir`.
///
/// # Errors
/// [`DatasetError`] that names the file that can't be written, or the rig's limit.
pub fn write(
    dir: &Path,
    pictures: usize,
    seed: u64,
    rig: &Rig,
    form: Form,
) -> Result<DatasetSummary, DatasetError> {
    let camera = StereoCamera::new(rig);
    let (width, height) = camera.image_size_px(Eye::Left);
    if width < SIDE || height < SIDE {
        return Err(DatasetError::TooSmall { width, height });
    }
    for folder in ["images", "labels"] {
        let path = dir.join(folder);
        std::fs::create_dir_all(&path).map_err(|source| DatasetError::Write { path, source })?;
    }
    let worlds: Vec<usize> = (0..pictures.div_ceil(POSES)).collect();
    let summaries: Result<Vec<DatasetSummary>, DatasetError> = worlds
        .into_par_iter()
        .map(|k| {
            let numbers = k * POSES..((k + 1) * POSES).min(pictures);
            let seed = seed.wrapping_add((k as u64) << 20);
            write_world(dir, numbers, seed, &camera, form)
        })
        .collect();
    Ok(summaries?
        .iter()
        .fold(DatasetSummary::default(), DatasetSummary::plus))
}

impl DatasetSummary {
    fn plus(self, other: &Self) -> Self {
        Self {
            pictures: self.pictures + other.pictures,
            with_fire: self.with_fire + other.with_fire,
            empty: self.empty + other.empty,
            fires: self.fires + other.fires,
            smokes: self.smokes + other.smokes,
        }
    }

    fn count(&mut self, labels: &[YoloLabel]) {
        let fires = labels
            .iter()
            .filter(|label| label.class == BurningClass::Fire)
            .count();
        self.pictures += 1;
        self.with_fire += usize::from(fires > 0);
        self.empty += usize::from(labels.is_empty());
        self.fires += fires;
        self.smokes += labels.len() - fires;
    }
}

fn write_world(
    dir: &Path,
    numbers: std::ops::Range<usize>,
    seed: u64,
    camera: &StereoCamera,
    form: Form,
) -> Result<DatasetSummary, DatasetError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let config = random_world(&mut rng);
    let world = Arc::new(World::new(&config, seed)?);
    let renderer = Renderer::new(
        world,
        camera.clone(),
        random_exposure(&mut rng, &config.light),
    );
    let mut summary = DatasetSummary::default();
    for number in numbers {
        let t_s = rng.random_range(0.0..600.0);
        let body = random_pose(&mut rng, &config, renderer.world(), camera);
        let frame = renderer.render(Eye::Left, &body, t_s);
        let masks = renderer.label_masks(&body, t_s);
        let (frame, window) = match form.framing {
            Framing::Cut => cut(&mut rng, &frame, &masks),
            Framing::Whole => whole(frame),
        };
        let label = |mask| window.label(mask, form.outlines);
        let labels = masks.iter().filter_map(label).collect();
        let picture = Picture { frame, labels };
        summary.count(&picture.labels);
        save(dir, number, &picture, rng.random_range(70..=95))?;
    }
    Ok(summary)
}

fn save(dir: &Path, number: usize, picture: &Picture, quality: u8) -> Result<(), DatasetError> {
    let text: String = picture.labels.iter().map(YoloLabel::line).collect();
    let files = [
        (
            dir.join(format!("images/{number:06}.jpg")),
            encode_jpeg(&picture.frame, quality),
        ),
        (
            dir.join(format!("labels/{number:06}.txt")),
            text.into_bytes(),
        ),
    ];
    for (path, bytes) in files {
        std::fs::write(&path, bytes).map_err(|source| DatasetError::Write { path, source })?;
    }
    Ok(())
}

/// A picture as the detector gets it.
struct Picture {
    frame: Frame,
    labels: Vec<YoloLabel>,
}

fn cut(rng: &mut ChaCha8Rng, frame: &Frame, masks: &[LabelMask]) -> (Frame, Window) {
    if rng.random_bool(0.15) {
        letter_boxed(frame)
    } else {
        cropped(rng, frame, masks)
    }
}

fn whole(frame: Frame) -> (Frame, Window) {
    let raw_size = (frame.width, frame.height);
    let size = (f64::from(frame.width), f64::from(frame.height));
    let window = Window {
        scale: 1.0,
        shift: (0.0, 0.0),
        size,
        rows: (0.0, size.1),
        raw_first: (0, 0),
        raw_size,
    };
    (frame, window)
}

fn letter_boxed(frame: &Frame) -> (Frame, Window) {
    let scale = f64::from(SIDE) / f64::from(frame.width.max(frame.height));
    let size = |px: u32| ((f64::from(px) * scale).round() as u32).min(SIDE);
    let (width, height) = (size(frame.width), size(frame.height));
    let mut canvas = RgbImage::from_pixel(SIDE, SIDE, image::Rgb([BARS; 3]));
    let (x, y) = ((SIDE - width) / 2, (SIDE - height) / 2);
    if let Some(whole) = RgbImage::from_raw(frame.width, frame.height, frame.rgb()) {
        let small = imageops::resize(&whole, width, height, imageops::FilterType::Triangle);
        imageops::replace(&mut canvas, &small, i64::from(x), i64::from(y));
    }
    let (x, y) = (f64::from(x), f64::from(y));
    (
        from_rgb(canvas),
        Window {
            scale,
            shift: (x, y),
            size: (f64::from(SIDE), f64::from(SIDE)),
            rows: (y, y + f64::from(height)),
            raw_first: (0, 0),
            raw_size: (frame.width, frame.height),
        },
    )
}

fn from_rgb(picture: RgbImage) -> Frame {
    let (width, height) = picture.dimensions();
    let bytes = picture.pixels().flat_map(|p| [p[2], p[1], p[0]]).collect();
    Frame {
        width,
        height,
        format: PixelFormat::Bgr8,
        bytes,
    }
}

/// Around a flame where there is one, so that few pictures are of nothing.
fn cropped(rng: &mut ChaCha8Rng, frame: &Frame, masks: &[LabelMask]) -> (Frame, Window) {
    let boxes: Vec<&LabelBox> = masks.iter().map(|mask| &mask.label).collect();
    let flames: Vec<&LabelBox> = boxes
        .iter()
        .filter(|label| label.class == BurningClass::Fire)
        .copied()
        .collect();
    let pool = if flames.is_empty() { &boxes } else { &flames };
    let pick = pool.choose(rng);
    let middle = pick.map_or(
        (0.5 * f64::from(frame.width), 0.5 * f64::from(frame.height)),
        |label| {
            (
                0.5 * (label.left_px + label.right_px),
                0.5 * (label.top_px + label.bottom_px),
            )
        },
    );
    let mut start = |middle: f64, most: u32| {
        let wanted = middle - f64::from(SIDE) * rng.random_range(0.1..0.9);
        wanted.clamp(0.0, f64::from(most - SIDE)).round() as u32
    };
    let (x, y) = (start(middle.0, frame.width), start(middle.1, frame.height));
    let line = |row: u32| {
        let first = (((y + row) * frame.width + x) * 3) as usize;
        &frame.bytes[first..first + 3 * SIDE as usize]
    };
    let bytes = (0..SIDE).flat_map(line).copied().collect();
    let crop = Frame {
        width: SIDE,
        height: SIDE,
        format: PixelFormat::Bgr8,
        bytes,
    };
    let shift = (-f64::from(x), -f64::from(y));
    (
        crop,
        Window {
            scale: 1.0,
            shift,
            size: (f64::from(SIDE), f64::from(SIDE)),
            rows: (0.0, f64::from(SIDE)),
            raw_first: (x, y),
            raw_size: (SIDE, SIDE),
        },
    )
}

/// Half side of the square in which things stand, metres.
const FIELD_M: f64 = 45.0;

/// A world such as the pictures are taken in.
pub fn random_world(rng: &mut ChaCha8Rng) -> WorldConfig {
    let fires = if rng.random_bool(0.72) {
        rng.random_range(1..=5)
    } else {
        0
    };
    let smokes = u32::from(rng.random_bool(0.3));
    let lookalikes = rng.random_range(0..=6);
    WorldConfig {
        terrain: random_terrain(rng),
        terrain_up_m: 0.0,
        ground: random_ground(rng),
        fires: (0..fires).map(|k| random_fire(rng, k)).collect(),
        spreads: Vec::new(),
        smokes: (0..smokes).map(|k| random_smoke(rng, k)).collect(),
        lookalikes: (0..lookalikes).map(|_| random_lookalike(rng)).collect(),
        boards: Vec::new(),
        trees: TreesConfig {
            count: rng.random_range(0..250),
            seed: rng.random(),
            height_m: rng.random_range(1.0..10.0),
            spread_m: 90.0,
            clearance_m: rng.random_range(0.0..6.0),
        },
        light: random_light(rng),
        wind: WindConfig {
            east_m_s: rng.random_range(-3.0..3.0),
            north_m_s: rng.random_range(-3.0..3.0),
        },
    }
}

fn random_terrain(rng: &mut ChaCha8Rng) -> TerrainConfig {
    if rng.random_bool(0.4) {
        return TerrainConfig::Flat {};
    }
    let amplitude_m = rng.random_range(0.5..8.0);
    let wavelength_m = amplitude_m * rng.random_range(16.0..50.0);
    TerrainConfig::Hills {
        amplitude_m,
        wavelength_m,
        seed: rng.random(),
    }
}

fn random_ground(rng: &mut ChaCha8Rng) -> Vec<GroundCover> {
    let all = [
        GroundCover::Grass,
        GroundCover::Straw,
        GroundCover::Soil,
        GroundCover::RedSoil,
        GroundCover::Rock,
        GroundCover::ForestFloor,
        GroundCover::Asphalt,
        GroundCover::Snow,
    ];
    let kinds = rng.random_range(1..=3);
    all.choose_multiple(rng, kinds).copied().collect()
}

fn random_light(rng: &mut ChaCha8Rng) -> LightConfig {
    // A third of the days is overcast; some evenings are nearly dark, on some the sun stands low and red.
    let sun = if rng.random_bool(0.33) {
        0.0
    } else {
        rng.random_range(0.3..1.1)
    };
    let dusk = rng.random_bool(0.15);
    let evening = rng.random_bool(0.2);
    LightConfig {
        sun_azimuth_deg: rng.random_range(0.0..360.0),
        sun_elevation_deg: if evening {
            rng.random_range(3.0..10.0)
        } else {
            rng.random_range(12.0..75.0)
        },
        sun: if dusk { 0.0 } else { sun },
        ambience: if dusk {
            rng.random_range(0.05..0.3)
        } else {
            rng.random_range(0.6..1.4)
        },
        visibility_m: log_uniform(rng, 400.0, 20_000.0),
    }
}

/// What an automatic exposure would choose in this light, and how far it is off.
pub fn random_exposure(rng: &mut ChaCha8Rng, light: &LightConfig) -> RenderConfig {
    let scene = 0.7 * light.sun + 0.45 * light.ambience;
    RenderConfig {
        seed: rng.random(),
        noise_sigma_dn: rng.random_range(1.0..5.0),
        exposure: (1.0 / scene).min(3.0) * rng.random_range(0.45..1.3),
        vignetting: rng.random_range(0.0..0.4),
        ..RenderConfig::default()
    }
}

fn random_fire(rng: &mut ChaCha8Rng, k: u32) -> FireConfig {
    let width_m = log_uniform(rng, 0.4, 5.0);
    let place = random_place(rng);
    FireConfig {
        name: format!("fire {k}"),
        east_m: place.x,
        north_m: place.y,
        width_m,
        height_m: (width_m * rng.random_range(0.6..2.2)).clamp(0.4, 6.0),
        smoke: rng.random_bool(0.5),
        ignites_at_s: 0.0,
        growth_m_s: 0.0,
    }
}

fn random_smoke(rng: &mut ChaCha8Rng, k: u32) -> SmokeConfig {
    let place = random_place(rng);
    SmokeConfig {
        name: format!("smoke {k}"),
        east_m: place.x,
        north_m: place.y,
        width_m: log_uniform(rng, 0.5, 5.0),
        height_m: log_uniform(rng, 4.0, 40.0),
        ignites_at_s: 0.0,
    }
}

fn random_lookalike(rng: &mut ChaCha8Rng) -> LookalikeConfig {
    let (kind, size_m) = match rng.random_range(0..6) {
        0 => (LookalikeKind::RedRoof, rng.random_range(4.0..14.0)),
        1 => (LookalikeKind::SunGlint, rng.random_range(0.6..6.0)),
        2 => (LookalikeKind::OrangeVehicle, rng.random_range(2.5..7.0)),
        3 => (LookalikeKind::Headlamps, rng.random_range(2.5..7.0)),
        4 => (LookalikeKind::Fog, log_uniform(rng, 2.0, 28.0)),
        _ => (LookalikeKind::Lantern, rng.random_range(0.1..0.7)),
    };
    let place = random_place(rng);
    LookalikeConfig {
        kind,
        east_m: place.x,
        north_m: place.y,
        size_m,
    }
}

fn random_place(rng: &mut ChaCha8Rng) -> Vector2<f64> {
    Vector2::new(
        rng.random_range(-FIELD_M..FIELD_M),
        rng.random_range(-FIELD_M..FIELD_M),
    )
}

fn log_uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    rng.random_range(low.ln()..high.ln()).exp()
}

/// Looks at something that stands in the world, not quite straight, banked.
fn random_pose(
    rng: &mut ChaCha8Rng,
    config: &WorldConfig,
    world: &World,
    camera: &StereoCamera,
) -> BodyState {
    let place = random_target(rng, config);
    let target = Vector3::new(place.x, place.y, world.ground_up_m(place.x, place.y));
    let range_m = log_uniform(rng, 10.0, 100.0);
    let height_m = rng
        .random_range(8.0..80.0_f64)
        .min(0.95 * range_m)
        .max(0.25 * range_m);
    let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
    let out_m = (range_m * range_m - height_m * height_m).max(0.0).sqrt();
    let mut eye = target + Vector3::new(out_m * cos, out_m * sin, height_m);
    eye.z = eye.z.max(world.ground_up_m(eye.x, eye.y) + 4.0);
    let enu_from_camera = facing(rng, &(target - eye));
    BodyState {
        t_s: 0.0,
        position_m: eye,
        enu_from_body: enu_from_camera * camera.body_from_left().transpose(),
        velocity_m_s: Vector3::zeros(),
        rate_rad_s: Vector3::zeros(),
    }
}

fn random_target(rng: &mut ChaCha8Rng, config: &WorldConfig) -> Vector2<f64> {
    let fires = config
        .fires
        .iter()
        .map(|f| Vector2::new(f.east_m, f.north_m));
    let smokes = config
        .smokes
        .iter()
        .map(|s| Vector2::new(s.east_m, s.north_m));
    let burning: Vec<_> = fires.chain(smokes).collect();
    let others: Vec<_> = config
        .lookalikes
        .iter()
        .map(|l| Vector2::new(l.east_m, l.north_m))
        .collect();
    let pool = if burning.is_empty() || rng.random_bool(0.1) {
        &others
    } else {
        &burning
    };
    pool.choose(rng)
        .copied()
        .unwrap_or_else(|| random_place(rng))
}

/// Camera axes (right, down, boresight as columns) for a look along `way`.
fn facing(rng: &mut ChaCha8Rng, way: &Vector3<f64>) -> Matrix3<f64> {
    let boresight = way.normalize();
    let level = boresight.cross(&Vector3::z());
    let right = level.try_normalize(1e-3).unwrap_or_else(Vector3::x);
    let straight = Matrix3::from_columns(&[right, boresight.cross(&right), boresight]);
    let turn = |axis: Vector3<f64>, angle: f64| nalgebra::Rotation3::new(axis * angle).into_inner();
    straight
        * turn(Vector3::y(), rng.random_range(-0.4..0.4))
        * turn(Vector3::x(), rng.random_range(-0.2..0.2))
        * turn(Vector3::z(), rng.random_range(-0.45..0.45))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig() -> Rig {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../calib/rigs/oakd-75mm.toml");
        Rig::load(path.as_ref()).unwrap()
    }

    const CUT: Form = Form {
        framing: Framing::Cut,
        outlines: false,
    };

    #[test]
    fn the_same_seed_writes_the_same_labelled_pictures() {
        let (one, two) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let summary = write(one.path(), 5, 3, &rig(), CUT).unwrap();
        assert_eq!(summary, write(two.path(), 5, 3, &rig(), CUT).unwrap());
        assert_eq!(summary.pictures, 5);
        for number in 0..5 {
            for name in [
                format!("images/{number:06}.jpg"),
                format!("labels/{number:06}.txt"),
            ] {
                let read = |dir: &Path| std::fs::read(dir.join(&name)).unwrap();
                assert_eq!(read(one.path()), read(two.path()), "{name}");
            }
        }
    }

    /// Whole frames: nothing is cut, so an outline reaches as far as its box.
    #[test]
    fn outlines_reach_as_far_as_boxes() {
        let (boxes, outlines) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let form = |outlines| Form {
            framing: Framing::Whole,
            outlines,
        };
        let summary = write(boxes.path(), 4, 3, &rig(), form(false)).unwrap();
        assert!(summary.fires > 0);
        assert_eq!(
            write(outlines.path(), 4, 3, &rig(), form(true)).unwrap(),
            summary
        );
        let read = |dir: &Path, number: usize| {
            std::fs::read_to_string(dir.join(format!("labels/{number:06}.txt"))).unwrap()
        };
        let shares = |line: &str| -> Vec<f64> {
            let words = line.split(' ').skip(1);
            words.map(|word| word.parse().unwrap()).collect()
        };
        for number in 0..4 {
            let (of_boxes, of_outlines) =
                (read(boxes.path(), number), read(outlines.path(), number));
            for (boxed, outlined) in of_boxes.lines().zip(of_outlines.lines()) {
                let [cx, cy, width, height] = shares(boxed)[..] else {
                    panic!("{boxed}");
                };
                let corners = shares(outlined);
                for (axis, middle, size) in [(0, cx, width), (1, cy, height)] {
                    let along = corners.iter().skip(axis).step_by(2);
                    let low = along.clone().copied().fold(f64::INFINITY, f64::min);
                    let high = along.copied().fold(f64::NEG_INFINITY, f64::max);
                    // Six digits are written, and boxes lie within the picture.
                    assert!(
                        (low.max(0.0) - (middle - 0.5 * size)).abs() < 2e-6,
                        "{outlined}"
                    );
                    assert!(
                        (high.min(1.0) - (middle + 0.5 * size)).abs() < 2e-6,
                        "{outlined}"
                    );
                }
            }
        }
    }
}
