//! Rigs, and trials before them: a stereo pair of a flame with its truth.

use super::RangeEvalError;
use crate::detect::{BoxPx, DetectionClass};
use crate::range::{RawPair, Target};
use emberfix_calib::{Eye, RawPixel, RectifiedPixel, Rig, RigError};
use emberfix_frames::{Metres, ServiceTime};
use emberfix_sim::noise::{normal, stream};
use emberfix_sim::render::studio::{Backdrop, Branch, Look, Puff, Seen, Shot, Studio, StudioFire};
use emberfix_sim::render::{Frame, PixelFormat, StereoCamera};
use emberfix_sim::state::BodyState;
use emberfix_sim::world::{World, WorldConfig};
use nalgebra::{Matrix3, Vector2, Vector3};
use opencv::core::{CV_8UC1, CV_8UC3, Mat, MatTrait, MatTraitConst, Rect, Scalar};
use opencv::prelude::MatTraitManual;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

/// Which flames: those that ranging may be tuned on, or those that nobody tunes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SeedSet {
    /// For tuning.
    Tuning,
    /// Kept aside; what is reported.
    Report,
}

/// A rig in a studio.
pub(super) struct Stage {
    pub rig: Rig,
    /// Disparities that a matcher has to try for what stands here.
    pub num_disparities: u32,
    studio: Studio,
}

/// The rigs that are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RigName {
    P1,
    P4,
    /// The same with a near-infrared right eye.
    P4Infrared,
    Ours75,
    Ours120,
    Ours500,
}

/// What a trial is made of.
#[derive(Debug, Clone)]
pub(super) struct Recipe {
    /// Of the base, along the rectified boresight.
    pub depth_m: Range<f64>,
    pub width_m: Range<f64>,
    /// Rectified left pixel of the middle of the flame.
    pub u_px: Range<f64>,
    pub v_px: Range<f64>,
    pub daylight: Range<f64>,
    pub exposure: Range<f64>,
    pub wind_m_s: Range<f64>,
    pub indoors: bool,
    pub hardness: Option<super::cases::Hardness>,
}

/// One pair with its truth.
pub(super) struct Trial {
    pub pair: RawPair,
    pub target: Target,
    pub truth: Truth,
}

/// Where the flame truly stands: its upright axis, through its base, in the rectified left camera.
#[derive(Debug, Clone, Copy)]
pub(super) struct Truth {
    /// Base and the way up (of unit length): right, down, along the boresight.
    base_m: Vector3<f64>,
    up: Vector3<f64>,
    height_m: f64,
    focal_px: f64,
    middle_row: f64,
    focal_baseline: f64,
    infinity_px: f64,
    /// By how much the light that the left eye sees lies before the axis, as a share of the flame's width.
    light_before: f64,
}

/// How much two sets of flames differ.
struct Variety {
    aspect: Range<f64>,
    right_gain: Range<f64>,
    blur_px: Range<f64>,
}

impl SeedSet {
    fn variety(self) -> Variety {
        match self {
            Self::Tuning => Variety {
                aspect: 1.3..2.0,
                right_gain: 0.92..1.1,
                blur_px: 0.5..0.75,
            },
            Self::Report => Variety {
                aspect: 1.1..2.4,
                right_gain: 0.85..1.2,
                blur_px: 0.45..0.85,
            },
        }
    }

    fn salt(self) -> u64 {
        match self {
            Self::Tuning => 0x7117_0000_0000,
            Self::Report => 0x2E90_0000_0000,
        }
    }
}

impl RigName {
    fn text(self) -> String {
        let text = match self {
            Self::P1 => include_str!("rigs/p1.toml"),
            Self::P4 | Self::P4Infrared => include_str!("rigs/p4.toml"),
            Self::Ours75 => include_str!("rigs/ours-75mm.toml"),
            Self::Ours120 => include_str!("rigs/ours-120mm.toml"),
            Self::Ours500 => include_str!("rigs/ours-500mm.toml"),
        };
        let right = if self == Self::P4Infrared {
            "[right]\nnear_infrared = true\n"
        } else {
            "[right]\n"
        };
        text.replace("[right]\n", right)
    }

    /// As its file has it.
    pub(super) fn rig(self) -> Result<Rig, RigError> {
        Rig::parse(&self.text(), Path::new("the eval's rig"))
    }

    /// P1's and P4's nearest flames stand at 120 px, the others' within 96.
    fn num_disparities(self) -> u32 {
        match self {
            Self::P1 | Self::P4 | Self::P4Infrared => 144,
            Self::Ours75 | Self::Ours120 | Self::Ours500 => 96,
        }
    }
}

/// The world that lends its textures.
pub(super) fn world() -> Result<Arc<World>, RangeEvalError> {
    Ok(Arc::new(World::new(&WorldConfig::default(), 11)?))
}

impl Stage {
    pub(super) fn new(name: RigName, world: &Arc<World>) -> Result<Self, RangeEvalError> {
        let rig = name.rig()?;
        Ok(Self {
            studio: Studio::new(world.clone(), StereoCamera::new(&rig)),
            num_disparities: name.num_disparities(),
            rig,
        })
    }

    /// A trial of a recipe; the same seed, the same bytes. `None` when the flame lights no pixel.
    pub(super) fn trial(
        &self,
        recipe: &Recipe,
        set: SeedSet,
        seed: u64,
    ) -> Result<Option<Trial>, RangeEvalError> {
        let mut rng = stream(seed ^ set.salt(), "range trial");
        let set_up = self.set_up(recipe, set, &mut rng);
        let axis = self.boresight();
        let (left, seen) = self.studio.expose_left(&set_up.shot, &set_up.left, &axis);
        let Some(seen) = seen else {
            return Ok(None);
        };
        let left = mat(&left)?;
        let right = match set_up.right {
            Some(look) => Some(mat(&self.studio.expose(&set_up.shot, Eye::Right, &look))?),
            None => None,
        };
        let truth = self.truth(&set_up.shot.fires[0], &seen)?;
        Ok(Some(Trial {
            pair: RawPair {
                at: ServiceTime::from_unix_ns(0),
                left_bgr: left,
                right_gray: right,
            },
            target: Target {
                class: DetectionClass::Fire,
                box_px: drawn_box(&seen, &mut rng),
            },
            truth,
        }))
    }

    fn set_up(&self, recipe: &Recipe, set: SeedSet, rng: &mut ChaCha8Rng) -> SetUp {
        let variety = set.variety();
        let depth_m = within(rng, &recipe.depth_m);
        let width_m = within(rng, &recipe.width_m);
        let height_m = width_m * within(rng, &variety.aspect);
        let pixel = RectifiedPixel {
            u: within(rng, &recipe.u_px),
            v: within(rng, &recipe.v_px),
        };
        // The middle of the flame is aimed at; the base stands below it.
        let base_m = self.place(pixel, depth_m) - Vector3::z() * (0.5 * height_m);
        let (sin, cos) = rng.random_range(0.0..std::f64::consts::TAU).sin_cos();
        let wind = within(rng, &recipe.wind_m_s);
        let fire = StudioFire {
            seed: rng.random(),
            base_m,
            width_m,
            height_m,
            wind_m_s: Vector2::new(wind * cos, wind * sin),
        };
        let backdrop = if recipe.indoors {
            Backdrop::Wall {
                depth_m: depth_m + rng.random_range(0.8..3.0),
            }
        } else {
            Backdrop::Ground { up_m: base_m.z }
        };
        let left = Look {
            skew_s: 0.0,
            gain: within(rng, &recipe.exposure),
            blur_px: within(rng, &variety.blur_px),
            glare: 0.0,
            noise_sigma_dn: rng.random_range(1.5..3.0),
            near_infrared: false,
            dirt: Vec::new(),
            seed: rng.random(),
        };
        let right = Look {
            gain: left.gain * within(rng, &variety.right_gain),
            near_infrared: self.rig.right_near_infrared(),
            blur_px: left.blur_px * rng.random_range(0.9..1.15),
            seed: rng.random(),
            ..left.clone()
        };
        let shot = Shot {
            body: level(),
            t_s: rng.random_range(5.0..50.0),
            fires: vec![fire],
            backdrop,
            daylight: within(rng, &recipe.daylight),
            branches: Vec::new(),
            puffs: Vec::new(),
        };
        let mut set_up = SetUp {
            shot,
            left,
            right: Some(right),
            depth_m,
        };
        if let Some(hardness) = recipe.hardness {
            hardness.apply(self, &mut set_up, rng);
        }
        set_up
    }

    /// Of the point at a depth behind a rectified left pixel: east, north, up.
    pub(super) fn place(&self, pixel: RectifiedPixel, depth_m: f64) -> Vector3<f64> {
        self.enu(self.rig.ray(pixel).metres() * depth_m)
    }

    /// Rectified-camera components as east, north, up.
    pub(super) fn enu(&self, camera_m: Vector3<f64>) -> Vector3<f64> {
        let body = self
            .rig
            .body_from_cam_left()
            .transform(emberfix_frames::Vector::from_metres(camera_m));
        enu_from_body() * body.metres()
    }

    /// Rectified left column and row of a point, east, north, up.
    pub(super) fn left_pixel(&self, point_m: Vector3<f64>) -> (f64, f64) {
        let rect = self.rig.rectification();
        let seen_m = self.camera(point_m);
        let (cx, cy) = rect.principal_point_px();
        (
            rect.focal_px() * seen_m.x / seen_m.z + cx,
            rect.focal_px() * seen_m.y / seen_m.z + cy,
        )
    }

    fn boresight(&self) -> Vector3<f64> {
        self.enu(Vector3::z())
    }

    fn truth(&self, fire: &StudioFire, seen: &Seen) -> Result<Truth, RangeEvalError> {
        let rect = self.rig.rectification();
        let mut truth = Truth {
            base_m: self.camera(fire.base_m),
            up: self.camera(Vector3::z()),
            height_m: fire.height_m,
            focal_px: rect.focal_px(),
            middle_row: rect.principal_point_px().1,
            focal_baseline: rect.focal_px() * self.rig.baseline_m(),
            infinity_px: rect.infinity_disparity_px(),
            light_before: 0.0,
        };
        let [left, _, right, _] = seen.box_px;
        let light = RawPixel {
            u: 0.5 * (left + right),
            v: seen.row,
        };
        let row = rect.rectify(Eye::Left, &[light])?[0].v;
        let axis_m = truth.depth_m(truth.disparity_px(row));
        truth.light_before = (axis_m - 1.0 / seen.inverse_depth_per_m) / fire.width_m;
        Ok(truth)
    }

    /// East, north, up as rectified-camera components.
    fn camera(&self, enu_m: Vector3<f64>) -> Vector3<f64> {
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
        Vector3::from(axes.map(|axis| self.enu(axis).dot(&enu_m)))
    }
}

impl Truth {
    /// Disparity of the flame's axis at a row of the rectified image.
    pub(super) fn disparity_px(&self, row: f64) -> f64 {
        // (base + h up) shows at the row: its y over its z is the row's tangent.
        let tangent = (row - self.middle_row) / self.focal_px;
        let high_m = (tangent * self.base_m.z - self.base_m.y) / (self.up.y - tangent * self.up.z);
        self.infinity_px + self.focal_baseline / (self.base_m.z + high_m * self.up.z)
    }

    /// Row of the middle of the flame, rectified.
    pub(super) fn row(&self) -> f64 {
        let middle_m = self.base_m + self.up * (0.5 * self.height_m);
        self.middle_row + self.focal_px * middle_m.y / middle_m.z
    }

    /// Depth that a disparity means.
    pub(super) fn depth_m(&self, disparity_px: f64) -> f64 {
        self.focal_baseline / (disparity_px - self.infinity_px)
    }

    pub(super) fn focal_baseline(&self) -> f64 {
        self.focal_baseline
    }

    /// By how much the light that the left eye sees lies before the axis, in widths of the flame.
    pub(super) fn light_before(&self) -> f64 {
        self.light_before
    }
}

/// A shot and how each eye exposes it, before it is taken.
pub(super) struct SetUp {
    pub shot: Shot,
    pub left: Look,
    /// `None`: no image comes from this eye.
    pub right: Option<Look>,
    pub depth_m: f64,
}

impl SetUp {
    pub(super) fn target(&self) -> StudioFire {
        self.shot.fires[0]
    }

    pub(super) fn add_branch(&mut self, branch: Branch) {
        self.shot.branches.push(branch);
    }

    pub(super) fn add_puff(&mut self, puff: Puff) {
        self.shot.puffs.push(puff);
    }
}

pub(super) fn within(rng: &mut ChaCha8Rng, range: &Range<f64>) -> f64 {
    if range.end > range.start {
        rng.random_range(range.clone())
    } else {
        range.start
    }
}

/// The flame's box as a detector draws it: not quite.
fn drawn_box(seen: &Seen, rng: &mut ChaCha8Rng) -> BoxPx {
    // Pixel centres stand at whole numbers: a pixel begins half a pixel before.
    let [left, top, right, bottom] = seen.box_px.map(|edge| edge - 0.5);
    let mut off = |size: f64| (0.8 + 0.02 * size) * normal(rng);
    let (wide, high) = (right - left, bottom - top);
    let (left, right) = (left + off(wide), right + off(wide));
    let (top, bottom) = (top + off(high), bottom + off(high));
    BoxPx {
        x: left.max(-0.5),
        y: top.max(-0.5),
        width: (right - left).max(2.0),
        height: (bottom - top).max(2.0),
    }
}

/// Level, nose to the north, at the origin.
fn level() -> BodyState {
    BodyState {
        t_s: 0.0,
        position_m: Vector3::zeros(),
        enu_from_body: enu_from_body(),
        velocity_m_s: Vector3::zeros(),
        rate_rad_s: Vector3::zeros(),
    }
}

fn enu_from_body() -> Matrix3<f64> {
    Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0)
}

fn mat(frame: &Frame) -> opencv::Result<Mat> {
    let kind = match frame.format {
        PixelFormat::Bgr8 => CV_8UC3,
        PixelFormat::Mono8 => CV_8UC1,
    };
    let mut mat = Mat::new_rows_cols_with_default(
        frame.height as i32,
        frame.width as i32,
        kind,
        Scalar::default(),
    )?;
    mat.data_bytes_mut()?.copy_from_slice(&frame.bytes);
    Ok(mat)
}

/// Copies a part (left, top, width, height) of one pair's images into another's.
pub(super) fn pasted(mut to: RawPair, from: &RawPair, part: [i32; 4]) -> opencv::Result<RawPair> {
    let [left, top, width, height] = part;
    let whole = Rect::new(0, 0, to.left_bgr.cols(), to.left_bgr.rows());
    let part = Rect::new(left, top, width, height) & whole;
    from.left_bgr
        .roi(part)?
        .copy_to(&mut to.left_bgr.roi_mut(part)?)?;
    if let (Some(to), Some(from)) = (&mut to.right_gray, &from.right_gray) {
        from.roi(part)?.copy_to(&mut to.roi_mut(part)?)?;
    }
    Ok(to)
}
