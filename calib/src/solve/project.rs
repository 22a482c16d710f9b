//! The camera model with its derivatives.

use crate::{Camera, RawPixel};
use emberfix_frames::Vector3;
use nalgebra::{SMatrix, Vector2};

/// Parameters of one camera: fx, fy, cx, cy, k1, k2, p1, p2, k3.
pub(super) const INTRINSICS: usize = 9;

/// A pixel, and how it moves with the camera's parameters and with the point.
pub(super) struct Projection {
    pub pixel: Vector2<f64>,
    pub by_intrinsics: SMatrix<f64, 2, INTRINSICS>,
    pub by_point: SMatrix<f64, 2, 3>,
}

/// As [`Camera::project`], with derivatives.
pub(super) fn project(camera: &Camera, point: &Vector3<f64>) -> Projection {
    let (x, y) = (point.x / point.z, point.y / point.z);
    let [k1, k2, p1, p2, k3] = camera.distortion;
    let (fx, fy) = camera.focal_px;
    let r2 = x * x + y * y;
    let (r4, r6) = (r2 * r2, r2 * r2 * r2);
    let radial = 1.0 + k1 * r2 + k2 * r4 + k3 * r6;
    let slope = k1 + 2.0 * k2 * r2 + 3.0 * k3 * r4;
    let xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
    let yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
    let across = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
    let by_plane = SMatrix::<f64, 2, 2>::new(
        fx * (radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x),
        fx * across,
        fy * across,
        fy * (radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x),
    );
    let plane_by_point = SMatrix::<f64, 2, 3>::new(1.0, 0.0, -x, 0.0, 1.0, -y) * (1.0 / point.z);
    #[rustfmt::skip]
    let by_intrinsics = SMatrix::<f64, 2, INTRINSICS>::from_row_slice(&[
        xd, 0.0, 1.0, 0.0, fx * x * r2, fx * x * r4, fx * 2.0 * x * y, fx * (r2 + 2.0 * x * x), fx * x * r6,
        0.0, yd, 0.0, 1.0, fy * y * r2, fy * y * r4, fy * (r2 + 2.0 * y * y), fy * 2.0 * x * y, fy * y * r6,
    ]);
    let RawPixel { u, v } = camera.project(point);
    Projection {
        pixel: Vector2::new(u, v),
        by_intrinsics,
        by_point: by_plane * plane_by_point,
    }
}

/// A camera's parameters as a list, and back.
pub(super) fn intrinsics(camera: &Camera) -> [f64; INTRINSICS] {
    let [k1, k2, p1, p2, k3] = camera.distortion;
    let ((fx, fy), (cx, cy)) = (camera.focal_px, camera.principal_point_px);
    [fx, fy, cx, cy, k1, k2, p1, p2, k3]
}

pub(super) fn camera(size: (u32, u32), values: [f64; INTRINSICS]) -> Camera {
    let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = values;
    Camera {
        image_size_px: size,
        focal_px: (fx, fy),
        principal_point_px: (cx, cy),
        distortion: [k1, k2, p1, p2, k3],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let values = [
            880.0, 870.0, 643.0, 357.0, -0.085, 0.062, 0.004, -0.003, -0.012,
        ];
        let size = (1280, 720);
        let point = Vector3::new(0.4, -0.25, 0.9);
        let here = project(&camera(size, values), &point);
        let close = |found: f64, expected: f64| {
            // Central differences with steps of 1e-6 are good to about 1e-6 of the value.
            assert!(
                (found - expected).abs() < 1e-4 * (1.0 + expected.abs()),
                "{found} {expected}"
            );
        };
        for index in 0..INTRINSICS {
            let moved = |step: f64| {
                let mut values = values;
                values[index] += step;
                camera(size, values).project(&point)
            };
            let (plus, minus) = (moved(1e-6), moved(-1e-6));
            close(here.by_intrinsics[(0, index)], (plus.u - minus.u) / 2e-6);
            close(here.by_intrinsics[(1, index)], (plus.v - minus.v) / 2e-6);
        }
        for axis in 0..3 {
            let moved = |step: f64| {
                let mut point = point;
                point[axis] += step;
                camera(size, values).project(&point)
            };
            let (plus, minus) = (moved(1e-6), moved(-1e-6));
            close(here.by_point[(0, axis)], (plus.u - minus.u) / 2e-6);
            close(here.by_point[(1, axis)], (plus.v - minus.v) / 2e-6);
        }
    }
}
