//! The matchers on real texture: Middlebury's cones and teddy (Scharstein and Szeliski, CVPR 2003),
//! from the shared data, where they are.
//!
//! **Known limits.** The truth comes in quarters of a pixel, and a scene has few flat boxes. On cones every
//! matcher, semi-global matching too, reads 0.01 to 0.13 px less than the truth, about the same from box to box:
//! that is the truth's, and what tells the matchers apart there is below it.

use super::RangeEvalError;
use super::papers::FullFrame;
use super::stats::{median, rms};
use crate::detect::{BoxPx, DetectionClass};
use crate::range::{Method, RangeConfig, Ranging, RawPair, Target, open};
use emberfix_calib::Rig;
use emberfix_frames::ServiceTime;
use nalgebra::{Matrix3, Vector3};
use opencv::core::{Mat, MatTraitConst};
use opencv::imgcodecs::{IMREAD_COLOR, IMREAD_GRAYSCALE, imread};
use std::path::{Path, PathBuf};

/// Grey values of the truth images to the pixel.
const GREYS_PER_PX: f64 = 4.0;
const BOX_PX: i32 = 40;
/// A box whose true disparities differ by more has no one disparity.
const FLAT_PX: f64 = 0.5;

/// How one method does on all boxes of one scene.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Scene {
    pub scene: &'static str,
    pub method: &'static str,
    pub boxes: usize,
    pub measured: usize,
    pub median_error_px: Option<f64>,
    pub rms_px: Option<f64>,
    /// Off by more than two pixels.
    pub outliers: usize,
}

/// Where the shared data lies, if it does.
fn folder() -> Option<PathBuf> {
    let shared = std::env::var_os("EMBERFIX_SHARED").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
        PathBuf::from,
    );
    let folder = shared.join("data/stereo/middlebury2003");
    folder.is_dir().then_some(folder)
}

/// Every method on both scenes; nothing without the shared data.
pub(super) fn measure() -> Result<Vec<Scene>, RangeEvalError> {
    let Some(folder) = folder() else {
        return Ok(Vec::new());
    };
    let mut found = Vec::new();
    for scene in ["cones", "teddy"] {
        found.extend(one(scene, &folder.join(scene))?);
    }
    Ok(found)
}

fn one(scene: &'static str, folder: &Path) -> Result<Vec<Scene>, RangeEvalError> {
    let read = |name: &str, flags| imread(folder.join(name), flags);
    let pair = RawPair {
        at: ServiceTime::from_unix_ns(0),
        left_bgr: read("im2.ppm", IMREAD_COLOR)?,
        right_gray: Some(read("im6.ppm", IMREAD_GRAYSCALE)?),
    };
    let truth = read("disp2.pgm", IMREAD_GRAYSCALE)?;
    let boxes = boxes(&truth)?;
    let rig = Rig::parse(
        include_str!("rigs/middlebury.toml"),
        Path::new("middlebury"),
    )?;
    let mut scenes = Vec::new();
    for method in Method::ALL {
        let mut ranger = open(method, &rig, &RangeConfig::default())?;
        let mut off = Vec::new();
        for (target, surface) in &boxes {
            if let Ranging::Measured {
                disparity_px,
                centroid,
                ..
            } = ranger.range(&pair, target)?
            {
                off.push(disparity_px - surface.at(centroid.u, centroid.v));
            }
        }
        scenes.push(summary(scene, method.name(), boxes.len(), &off));
    }
    let mut papers = FullFrame::new(&rig, 96)?;
    let mut off = Vec::new();
    for (target, surface) in &boxes {
        if let Some(single_px) = papers.read(&pair, &target.box_px)?.single_px {
            let (column, row) = target.box_px.centre();
            off.push(single_px - surface.at(column, row));
        }
    }
    scenes.push(summary(
        scene,
        "full-frame SGBM, P4's pixel",
        boxes.len(),
        &off,
    ));
    Ok(scenes)
}

fn summary(scene: &'static str, method: &'static str, boxes: usize, off: &[f64]) -> Scene {
    let sizes: Vec<f64> = off.iter().map(|off| off.abs()).collect();
    Scene {
        scene,
        method,
        boxes,
        measured: off.len(),
        median_error_px: median(&sizes),
        rms_px: rms(off),
        outliers: sizes.iter().filter(|size| **size > 2.0).count(),
    }
}

/// A surface that is flat enough for one disparity; which one is a matter of the place still.
struct Surface {
    /// Disparity at the middle, and its change by column and by row.
    plane: Vector3<f64>,
    middle: (f64, f64),
}

impl Surface {
    fn at(&self, column: f64, row: f64) -> f64 {
        let place = Vector3::new(1.0, column - self.middle.0, row - self.middle.1);
        self.plane.dot(&place)
    }
}

/// Boxes over surfaces of about one disparity that both eyes see.
fn boxes(truth: &Mat) -> opencv::Result<Vec<(Target, Surface)>> {
    let mut boxes = Vec::new();
    for top in (0..truth.rows() - BOX_PX).step_by(BOX_PX as usize / 2) {
        for left in (64..truth.cols() - BOX_PX).step_by(BOX_PX as usize / 2) {
            if let Some(surface) = surface(truth, left, top)? {
                let box_px = BoxPx {
                    x: f64::from(left),
                    y: f64::from(top),
                    width: f64::from(BOX_PX - 1),
                    height: f64::from(BOX_PX - 1),
                };
                let class = DetectionClass::Fire;
                boxes.push((Target { class, box_px }, surface));
            }
        }
    }
    Ok(boxes)
}

/// The plane that fits the known disparities of a box best, if they are flat enough.
fn surface(truth: &Mat, left: i32, top: i32) -> opencv::Result<Option<Surface>> {
    let half = 0.5 * f64::from(BOX_PX - 1);
    let middle = (f64::from(left) + half, f64::from(top) + half);
    let (mut low, mut high, mut known) = (f64::INFINITY, 0.0_f64, 0);
    let (mut normal, mut pull) = (Matrix3::zeros(), Vector3::zeros());
    for row in top..top + BOX_PX {
        for column in left..left + BOX_PX {
            let grey = *truth.at_2d::<u8>(row, column)?;
            if grey > 0 {
                let disparity_px = f64::from(grey) / GREYS_PER_PX;
                let (x, y) = (f64::from(column) - middle.0, f64::from(row) - middle.1);
                let place = Vector3::new(1.0, x, y);
                normal += place * place.transpose();
                pull += place * disparity_px;
                low = low.min(disparity_px);
                high = high.max(disparity_px);
                known += 1;
            }
        }
    }
    let whole = known * 20 >= BOX_PX * BOX_PX * 19;
    let plane = normal.try_inverse().map(|inverse| inverse * pull);
    Ok(plane
        .filter(|_| whole && high - low <= 2.0 * FLAT_PX)
        .map(|plane| Surface { plane, middle }))
}
