//! A stereo rig: two cameras, how they stand to each other, how they stand on the airframe.
//!
//! **Purpose.** Reads a rig TOML and checks it; holding a [`Rig`] means that it was checked.
//! **In:** `rigs/*.toml`, every key of which `calib/README.md` explains with unit, frame and sign.
//! **Out:** pixels to rectified pixels, rectified pixels to rays, camera to body.
//!
//! **Assumptions.** Pinhole cameras with OpenCV's five-term distortion (k1 k2 p1 p2 k3), pixel
//! centres at whole numbers. **Known limits.** No fisheye; a rolling shutter has a time
//! but no model.

pub mod exchange;
mod file;
mod inverse_depth;
mod nearest;
mod page;
mod parts;
mod plausible;
mod rectify;
pub mod solve;
#[cfg(test)]
mod tests;

pub use file::RigError;
pub use inverse_depth::{InverseDepth, InverseDepthError, Reading, Sightings};
pub use nearest::{Checks, KeyProblem, nearest_key, toml_problem, unknown_keys};
pub use page::{PageInput, page};
pub use parts::{Calibrated, Mounting, RigParts, mount_angles};
pub use plausible::{Finding, MAX_K3, MAX_TURN_DEG, Severity, implausible};
pub use rectify::Rectification;

use emberfix_frames::{
    BodyFrd, CamLeft, CamLeftRaw, Coordinate, Matrix3, Metres, MountAngles, Rotation, Vector,
    Vector3, body_from_camera, raw_from_rectified,
};

/// Which camera of the pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Eye {
    /// The reference: boxes, bearings and times are its own.
    Left,
    /// The other one.
    Right,
}

/// A pixel of an image as the camera gave it: column, row; centres at whole numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawPixel {
    /// Column, to the right.
    pub u: f64,
    /// Row, downwards.
    pub v: f64,
}

/// A pixel after undistortion and rectification.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RectifiedPixel {
    /// Column, to the right.
    pub u: f64,
    /// Row, downwards.
    pub v: f64,
}

/// One camera: pinhole and OpenCV distortion.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// Columns, rows.
    pub image_size_px: (u32, u32),
    /// Focal lengths along columns and rows, pixels.
    pub focal_px: (f64, f64),
    /// Principal point: column, row.
    pub principal_point_px: (f64, f64),
    /// k1, k2, p1, p2, k3.
    pub distortion: [f64; 5],
}

/// One-sigma errors of the rig, each constant in a flight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigSigmas {
    /// Disparity offset that calibration leaves, pixels.
    pub disparity_bias_px: f64,
    /// Boresight direction, radians per axis.
    pub boresight_rad: f64,
    /// Lever arm, metres per axis.
    pub lever_arm_m: f64,
    /// Time offset of the camera, seconds.
    pub time_offset_s: f64,
}

/// Two checked cameras on an airframe.
#[derive(Debug, Clone)]
pub struct Rig {
    name: String,
    left: Camera,
    right: Camera,
    /// Takes left-camera components to right-camera components (OpenCV's R).
    right_from_left: Matrix3<f64>,
    /// Left camera's origin in right-camera components, metres (OpenCV's T).
    translation_m: Vector3<f64>,
    mount: MountAngles,
    lever_arm: Vector<BodyFrd>,
    time_offset_s: f64,
    rolling_readout_s: f64,
    max_skew_s: f64,
    sigmas: RigSigmas,
    inverse_depth: InverseDepth,
    rectification: Rectification,
    calibrated: Option<Calibrated>,
    doubts: Vec<Finding>,
    right_near_infrared: bool,
}

impl Rig {
    /// Reads and checks a rig file.
    ///
    /// # Errors
    /// [`RigError`] that names the file and every problem in it.
    pub fn load(path: &std::path::Path) -> Result<Self, RigError> {
        file::load(path)
    }

    /// Checks the text of a rig file; `origin` is what errors call it.
    ///
    /// # Errors
    /// [`RigError`] that names the origin and every problem in it.
    pub fn parse(text: &str, origin: &std::path::Path) -> Result<Self, RigError> {
        file::parse(text, origin)
    }

    /// Name of the rig, for reports.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }
    /// One of its cameras.
    #[must_use]
    pub fn camera(&self, eye: Eye) -> &Camera {
        match eye {
            Eye::Left => &self.left,
            Eye::Right => &self.right,
        }
    }
    /// Takes left-camera components to right-camera components (OpenCV's R).
    #[must_use]
    pub fn right_from_left(&self) -> &Matrix3<f64> {
        &self.right_from_left
    }
    /// Left camera's origin in right-camera components, metres (OpenCV's T).
    #[must_use]
    pub fn right_from_left_translation_m(&self) -> &Vector3<f64> {
        &self.translation_m
    }
    /// Between the optical centres, metres.
    #[must_use]
    pub fn baseline_m(&self) -> f64 {
        self.translation_m.norm()
    }
    /// How the left camera stands on the airframe.
    #[must_use]
    pub fn mount(&self) -> MountAngles {
        self.mount
    }
    /// Body origin to the left camera's centre, body axes.
    #[must_use]
    pub fn lever_arm(&self) -> Vector<BodyFrd> {
        self.lever_arm
    }
    /// Autopilot time = camera time + this, seconds (Kalibr's `timeshift_cam_imu`).
    #[must_use]
    pub fn time_offset_s(&self) -> f64 {
        self.time_offset_s
    }
    /// From the exposure of the first row to that of the last, seconds; 0 for a global shutter.
    #[must_use]
    pub fn rolling_readout_s(&self) -> f64 {
        self.rolling_readout_s
    }
    /// Greatest difference of the eyes' exposures that still counts as one moment, seconds.
    #[must_use]
    pub fn max_skew_s(&self) -> f64 {
        self.max_skew_s
    }
    /// What the rig's calibration leaves open.
    #[must_use]
    pub fn sigmas(&self) -> &RigSigmas {
        &self.sigmas
    }
    /// What the calibration said of itself, if the file tells.
    #[must_use]
    pub fn calibrated(&self) -> Option<&Calibrated> {
        self.calibrated.as_ref()
    }
    /// What is implausible, yet no reason to refuse the rig.
    #[must_use]
    pub fn doubts(&self) -> &[Finding] {
        &self.doubts
    }
    /// Whether the right eye sees near infrared, where the left one sees colour (P4's rig).
    #[must_use]
    pub fn right_near_infrared(&self) -> bool {
        self.right_near_infrared
    }
    /// The rectified pair's geometry and the way into it.
    #[must_use]
    pub fn rectification(&self) -> &Rectification {
        &self.rectification
    }

    /// Rectified left camera to body.
    #[must_use]
    pub fn body_from_cam_left(&self) -> Rotation<CamLeft, BodyFrd> {
        let raw = raw_from_rectified(self.rectification.rectified_from_raw(Eye::Left));
        raw * body_from_camera::<CamLeftRaw>(self.mount)
    }

    /// Depth along the boresight in metres of a disparity in rectified pixels.
    ///
    /// `Z = f b / d` with `d = u_left - u_right` (P3 eq. 7 prints a sum, P4 eq. 8 the reverse
    /// difference: checklist E1, E2). `None` at zero and below: nothing stands beyond infinity.
    #[must_use]
    pub fn depth_m(&self, disparity_px: f64) -> Option<f64> {
        let rect = &self.rectification;
        let from_infinity = disparity_px - rect.infinity_disparity_px();
        (from_infinity > 0.0).then(|| rect.focal_px() * self.baseline_m() / from_infinity)
    }

    /// Disparity in rectified pixels of a depth in metres.
    #[must_use]
    pub fn disparity_px(&self, depth_m: f64) -> f64 {
        let rect = &self.rectification;
        rect.focal_px() * self.baseline_m() / depth_m + rect.infinity_disparity_px()
    }

    /// What known distances said of this rig.
    #[must_use]
    pub fn inverse_depth(&self) -> &InverseDepth {
        &self.inverse_depth
    }

    /// Disparity that stands for the true depth, from a measured one, both rectified pixels. Whoever
    /// measures applies it once; [`Rig::depth_m`] expects it.
    #[must_use]
    pub fn corrected_disparity_px(&self, measured_px: f64) -> f64 {
        let rect = &self.rectification;
        let (focal_baseline, infinity) = (
            rect.focal_px() * self.baseline_m(),
            rect.infinity_disparity_px(),
        );
        let measured_per_m = (measured_px - infinity) / focal_baseline;
        focal_baseline * self.inverse_depth.corrected_per_m(measured_per_m) + infinity
    }

    /// One sigma of the disparity offset that calibration leaves at a corrected disparity, pixels.
    #[must_use]
    pub fn disparity_bias_sigma_px(&self, corrected_px: f64) -> f64 {
        let rect = &self.rectification;
        let focal_baseline = rect.focal_px() * self.baseline_m();
        let per_m = (corrected_px - rect.infinity_disparity_px()) / focal_baseline;
        let left = focal_baseline * self.inverse_depth.sigma_per_m(per_m);
        self.sigmas.disparity_bias_px.hypot(left)
    }

    /// Direction of a rectified left pixel: metres in [`CamLeft`] per metre of depth.
    #[must_use]
    pub fn ray(&self, pixel: RectifiedPixel) -> Vector<CamLeft> {
        let (focal, (cx, cy)) = (
            self.rectification.focal_px(),
            self.rectification.principal_point_px(),
        );
        Vector::from_metres(Vector3::new(
            (pixel.u - cx) / focal,
            (pixel.v - cy) / focal,
            1.0,
        ))
    }

    /// The point at `depth_m` along the boresight behind a rectified left pixel.
    #[must_use]
    pub fn point(&self, pixel: RectifiedPixel, depth_m: f64) -> Coordinate<CamLeft> {
        Coordinate::from_metres(self.ray(pixel).metres() * depth_m)
    }
}
