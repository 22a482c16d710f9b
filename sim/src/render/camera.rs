//! Two lenses on an airframe, with this crate's own maths.
//!
//! Nothing here calls `frames` or the projection in `calib`: only the rig's numbers come from there,
//! so that a wrong sign on either side shows.

use crate::state::BodyState;
use emberfix_calib::{Camera, Eye, Rig};
use emberfix_frames::Metres;
use nalgebra::{Matrix3, Vector3};

/// One lens: pinhole and the five-term distortion k1 k2 p1 p2 k3 (Brown's model as OpenCV's manual
/// prints it).
#[derive(Debug, Clone)]
pub(crate) struct Lens {
    pub width: usize,
    pub height: usize,
    pub focal_px: (f64, f64),
    centre_px: (f64, f64),
    distortion: [f64; 5],
    /// Beyond this squared tangent of the off-axis angle the polynomial is not a lens any more.
    farthest_r2: f64,
}

/// Where an eye is and how it looks.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EyePose {
    /// East, north, up, metres.
    pub origin_m: Vector3<f64>,
    /// Takes camera (right, down, boresight) components to east, north, up.
    pub enu_from_camera: Matrix3<f64>,
}

/// The stereo rig on its airframe.
#[derive(Debug, Clone)]
pub struct StereoCamera {
    left: Lens,
    right: Lens,
    /// Yaw, depression, roll.
    mount_rad: [f64; 3],
    body_from_left: Matrix3<f64>,
    left_from_right: Matrix3<f64>,
    /// Right camera's centre in left-camera components, metres.
    right_in_left_m: Vector3<f64>,
    /// Left camera's centre in body (forward, right, down) components, metres.
    lever_arm_m: Vector3<f64>,
    right_near_infrared: bool,
}

impl StereoCamera {
    /// Takes the numbers of a rig.
    #[must_use]
    pub fn new(rig: &Rig) -> Self {
        let mount = rig.mount();
        let left_from_right = rig.right_from_left().transpose();
        Self {
            left: Lens::new(rig.camera(Eye::Left)),
            right: Lens::new(rig.camera(Eye::Right)),
            mount_rad: [mount.yaw_rad, mount.depression_rad, mount.roll_rad],
            body_from_left: body_from_camera(mount.yaw_rad, mount.depression_rad, mount.roll_rad),
            // x_right = R x_left + T is zero at the right eye's own centre.
            right_in_left_m: -(left_from_right * rig.right_from_left_translation_m()),
            left_from_right,
            lever_arm_m: rig.lever_arm().metres(),
            right_near_infrared: rig.right_near_infrared(),
        }
    }

    /// The same rig, mounted otherwise than its file says: yaw, depression, roll beyond it, radians.
    #[must_use]
    pub fn with_mount_error(mut self, [yaw, depression, roll]: [f64; 3]) -> Self {
        let [y, d, r] = self.mount_rad;
        self.mount_rad = [y + yaw, d + depression, r + roll];
        let [y, d, r] = self.mount_rad;
        self.body_from_left = body_from_camera(y, d, r);
        self
    }

    /// Columns and rows of an eye's image.
    #[must_use]
    pub fn image_size_px(&self, eye: Eye) -> (u32, u32) {
        let lens = self.lens(eye);
        (lens.width as u32, lens.height as u32)
    }

    /// Takes left-camera components to body (forward, right, down).
    pub(crate) fn body_from_left(&self) -> &Matrix3<f64> {
        &self.body_from_left
    }

    /// Whether an eye sees just beyond red instead of light.
    pub(crate) fn is_near_infrared(&self, eye: Eye) -> bool {
        eye == Eye::Right && self.right_near_infrared
    }

    pub(crate) fn lens(&self, eye: Eye) -> &Lens {
        match eye {
            Eye::Left => &self.left,
            Eye::Right => &self.right,
        }
    }

    pub(crate) fn pose(&self, eye: Eye, body: &BodyState) -> EyePose {
        let enu_from_left = body.enu_from_body * self.body_from_left;
        let left_m = body.position_m + body.enu_from_body * self.lever_arm_m;
        match eye {
            Eye::Left => EyePose {
                origin_m: left_m,
                enu_from_camera: enu_from_left,
            },
            Eye::Right => EyePose {
                origin_m: left_m + enu_from_left * self.right_in_left_m,
                enu_from_camera: enu_from_left * self.left_from_right,
            },
        }
    }
}

impl EyePose {
    /// A point in camera components.
    pub(crate) fn see(&self, point_m: &Vector3<f64>) -> Vector3<f64> {
        self.enu_from_camera.tr_mul(&(point_m - self.origin_m))
    }
}

/// From the definition of the mount: the boresight stands `yaw` to the right of the nose and
/// `depression` below it; then the camera is turned clockwise about it, seen from behind.
fn body_from_camera(yaw: f64, depression: f64, roll: f64) -> Matrix3<f64> {
    let boresight = Vector3::new(
        depression.cos() * yaw.cos(),
        depression.cos() * yaw.sin(),
        depression.sin(),
    );
    let level_right = Vector3::new(-yaw.sin(), yaw.cos(), 0.0);
    let level_down = boresight.cross(&level_right);
    // Clockwise from behind: what was right goes down, what was down goes left.
    let right = level_right * roll.cos() + level_down * roll.sin();
    let down = level_down * roll.cos() - level_right * roll.sin();
    Matrix3::from_columns(&[right, down, boresight])
}

impl Lens {
    fn new(camera: &Camera) -> Self {
        let mut lens = Self {
            width: camera.image_size_px.0 as usize,
            height: camera.image_size_px.1 as usize,
            focal_px: camera.focal_px,
            centre_px: camera.principal_point_px,
            distortion: camera.distortion,
            farthest_r2: f64::INFINITY,
        };
        let corner_r2 = lens
            .corners()
            .map(|(x, y)| x * x + y * y)
            .into_iter()
            .fold(0.0, f64::max);
        lens.farthest_r2 = 1.5 * corner_r2;
        lens
    }

    /// The same lens before a sensor with `fineness` times as many, smaller pixels a side.
    pub(crate) fn finer(&self, fineness: usize) -> Self {
        let k = fineness as f64;
        // Pixel centres stand at whole numbers, edges at halves.
        let centre = |c: f64| (c + 0.5) * k - 0.5;
        Self {
            width: self.width * fineness,
            height: self.height * fineness,
            focal_px: (self.focal_px.0 * k, self.focal_px.1 * k),
            centre_px: (centre(self.centre_px.0), centre(self.centre_px.1)),
            ..self.clone()
        }
    }

    fn corners(&self) -> [(f64, f64); 4] {
        let (w, h) = (self.width as f64, self.height as f64);
        [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)].map(|(u, v)| self.unproject(u, v))
    }

    /// Pixel of a point in camera components; `None` behind the camera and far outside the image.
    pub(crate) fn project(&self, point: &Vector3<f64>) -> Option<(f64, f64)> {
        let (x, y) = (point.x / point.z, point.y / point.z);
        if point.z <= 1e-3 || x * x + y * y > self.farthest_r2 {
            return None;
        }
        let (xd, yd) = self.distort(x, y);
        Some((
            self.focal_px.0 * xd + self.centre_px.0,
            self.focal_px.1 * yd + self.centre_px.1,
        ))
    }

    fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        let (radial, tangential) = self.terms(x, y);
        (x * radial + tangential.0, y * radial + tangential.1)
    }

    fn terms(&self, x: f64, y: f64) -> (f64, (f64, f64)) {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3);
        let tangential_x = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let tangential_y = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        (radial, (tangential_x, tangential_y))
    }

    /// Tangents of a pixel's ray, right and down of the boresight. Fixed-point iteration on the
    /// distortion, until it stands still.
    pub(crate) fn unproject(&self, u: f64, v: f64) -> (f64, f64) {
        let xd = (u - self.centre_px.0) / self.focal_px.0;
        let yd = (v - self.centre_px.1) / self.focal_px.1;
        let (mut x, mut y) = (xd, yd);
        for _ in 0..60 {
            let (radial, (tx, ty)) = self.terms(x, y);
            let next = ((xd - tx) / radial, (yd - ty) / radial);
            let moved = (next.0 - x).abs() + (next.1 - y).abs();
            (x, y) = next;
            if moved < 1e-14 {
                break;
            }
        }
        (x, y)
    }

    pub(crate) fn holds(&self, (u, v): (f64, f64)) -> bool {
        // Pixel centres at whole numbers: an image begins half a pixel before the first.
        (-0.5..self.width as f64 - 0.5).contains(&u)
            && (-0.5..self.height as f64 - 0.5).contains(&v)
    }
}
