//! The left camera as a function: what it sees of a point, and how each error moves that.

use super::shared::{SHARED, Shared};
use emberfix_calib::{RectifiedPixel, Rig};
use emberfix_frames::{BodyFrd, CamLeft, Matrix3, Metres, Rotation, Vector3, rotation_matrix};
use nalgebra::SMatrix;

/// The left camera with some of the shared errors taken out, and how it moves with each of them.
#[derive(Debug, Clone)]
pub struct Lens {
    pub(super) optics: Optics,
    pub(super) centre: Vector3<f64>,
    pub(super) enu_from_cam: Matrix3<f64>,
    /// Metres that the centre moves per sigma of each shared error.
    pub(super) centre_by_shared: SMatrix<f64, 3, SHARED>,
    /// Rotation vector (mission plane, radians) per sigma of each shared error.
    pub(super) turn_by_shared: SMatrix<f64, 3, SHARED>,
    pub(super) disparity_sigma_px: f64,
    pub(super) disparity_offset_px: f64,
}

/// The rectified pair on its airframe, as the rig has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Optics {
    focal_px: f64,
    principal_point_px: (f64, f64),
    baseline_m: f64,
    infinity_px: f64,
    /// From the body's origin to the left camera, body axes.
    pub(super) lever_arm_m: Vector3<f64>,
    /// Takes rectified left camera components to body components.
    pub(super) body_from_cam: Matrix3<f64>,
}

impl Optics {
    pub(super) fn of(rig: &Rig) -> Self {
        let rectification = rig.rectification();
        let cam: Rotation<CamLeft, BodyFrd> = rig.body_from_cam_left();
        Self {
            focal_px: rectification.focal_px(),
            principal_point_px: rectification.principal_point_px(),
            baseline_m: rig.baseline_m(),
            infinity_px: rectification.infinity_disparity_px(),
            lever_arm_m: rig.lever_arm().metres(),
            body_from_cam: rotation_matrix(&cam),
        }
    }
}

/// A point as `at / over`: far ones have a small `over`, one at infinity has zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distant {
    /// Position times `over`, mission plane, metres times 1/m.
    pub at: Vector3<f64>,
    /// 1 for a plain position; 1/m for an inverse depth.
    pub over: f64,
}

impl Distant {
    /// A plain position.
    #[must_use]
    pub fn near(point: Vector3<f64>) -> Self {
        Self {
            at: point,
            over: 1.0,
        }
    }
}

/// What the camera is predicted to see of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Predicted {
    /// Pixel in the rectified left image.
    pub pixel: RectifiedPixel,
    /// Depth along the boresight, metres.
    pub depth_m: f64,
    /// Disparity, rectified pixels.
    pub disparity_px: f64,
}

/// The same with its slopes; rows are column, row, disparity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Linear {
    /// Column, row, disparity.
    pub value: Vector3<f64>,
    /// Over `at` of the point.
    pub by_at: Matrix3<f64>,
    /// Over `over` of the point.
    pub by_over: Vector3<f64>,
    /// Over the shared errors, each in units of its sigma.
    pub by_shared: SMatrix<f64, 3, SHARED>,
}

impl Lens {
    /// Optical centre, mission plane, metres.
    #[must_use]
    pub fn centre(&self) -> &Vector3<f64> {
        &self.centre
    }

    /// Takes rectified left camera components to mission-plane components.
    #[must_use]
    pub fn enu_from_cam(&self) -> &Matrix3<f64> {
        &self.enu_from_cam
    }

    /// Metres that the centre moves per sigma of each shared error.
    #[must_use]
    pub fn centre_by_shared(&self) -> &SMatrix<f64, 3, SHARED> {
        &self.centre_by_shared
    }

    /// Unit vector of a pixel's ray in the mission plane.
    #[must_use]
    pub fn ray_enu(&self, pixel: RectifiedPixel) -> Vector3<f64> {
        let (cx, cy) = self.optics.principal_point_px;
        let f = self.optics.focal_px;
        (self.enu_from_cam * Vector3::new((pixel.u - cx) / f, (pixel.v - cy) / f, 1.0)).normalize()
    }

    /// Camera components of a point (times its `over`), if it is in front of the camera.
    fn in_camera(&self, point: &Distant) -> Option<Vector3<f64>> {
        let x = self.enu_from_cam.transpose() * (point.at - self.centre * point.over);
        (x.z > 0.1 * point.over && x.z > 1e-6).then_some(x)
    }

    fn seen(&self, x: &Vector3<f64>, over: f64) -> Vector3<f64> {
        let (cx, cy) = self.optics.principal_point_px;
        let disparity = self.optics.focal_px * self.optics.baseline_m * over / x.z
            + self.optics.infinity_px
            + self.disparity_offset_px;
        Vector3::new(
            self.optics.focal_px * x.x / x.z + cx,
            self.optics.focal_px * x.y / x.z + cy,
            disparity,
        )
    }

    /// What is seen of a point; `None` behind the camera.
    #[must_use]
    pub fn predict(&self, point: &Distant) -> Option<Predicted> {
        let x = self.in_camera(point)?;
        let seen = self.seen(&x, point.over);
        Some(Predicted {
            pixel: RectifiedPixel {
                u: seen.x,
                v: seen.y,
            },
            depth_m: x.z / point.over,
            disparity_px: seen.z,
        })
    }

    /// The same with its slopes.
    ///
    /// With `x = R' (p - c)` in camera components, pixel = f (x/z, y/z) + principal point, and
    /// disparity = f b / z + d_infinity + offset; all of it times `over` where the point is.
    #[must_use]
    pub fn linear(&self, point: &Distant) -> Option<Linear> {
        let x = self.in_camera(point)?;
        let (f, fb) = (
            self.optics.focal_px,
            self.optics.focal_px * self.optics.baseline_m,
        );
        let z2 = x.z * x.z;
        #[rustfmt::skip]
        let by_x = Matrix3::new(
            f / x.z, 0.0, -f * x.x / z2,
            0.0, f / x.z, -f * x.y / z2,
            0.0, 0.0, -fb * point.over / z2,
        );
        let by_at = by_x * self.enu_from_cam.transpose();
        let sight = point.at - self.centre * point.over;
        let moved = sight.cross_matrix() * self.turn_by_shared - self.centre_by_shared * point.over;
        let mut by_shared = by_at * moved;
        by_shared[(2, Shared::Disparity as usize)] += self.disparity_sigma_px;
        let mut by_over = -(by_at * self.centre);
        by_over.z += fb / x.z;
        Some(Linear {
            value: self.seen(&x, point.over),
            by_at,
            by_over,
            by_shared,
        })
    }

    /// Metres by which each shared error's sigma moves a point that is held by its pixel and depth.
    pub(super) fn carried_by_shared(&self, point: &Vector3<f64>) -> SMatrix<f64, 3, SHARED> {
        let sight = point - self.centre;
        self.centre_by_shared - sight.cross_matrix() * self.turn_by_shared
    }
}
