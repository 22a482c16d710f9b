//! How the left camera stands on the airframe.

use crate::{BodyFrd, CamLeft, CamLeftRaw};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use sguaba::CoordinateSystem;
use sguaba::math::Rotation;
use sguaba::systems::RightHandedXyzLike;

/// Boresight on the airframe, in radians. All zero: the camera looks along the nose, image top up.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MountAngles {
    /// Boresight to the right of the nose.
    pub yaw_rad: f64,
    /// Boresight below the nose; straight down is a right angle.
    pub depression_rad: f64,
    /// Camera turned clockwise about its boresight, seen from behind it.
    pub roll_rad: f64,
}

/// Camera (+X right, +Y down, +Z boresight) to body (forward, right, down).
///
/// With depression alone this is checklist item 48: `F = z cos - y sin`, `R = x`,
/// `D = z sin + y cos`.
#[must_use]
pub fn body_from_camera<Cam>(mount: MountAngles) -> Rotation<Cam, BodyFrd>
where
    Cam: CoordinateSystem<Convention = RightHandedXyzLike>,
{
    // Aeronautical pitch is nose up, depression is boresight down.
    let turned = Rotation3::from_euler_angles(mount.roll_rad, -mount.depression_rad, mount.yaw_rad);
    #[rustfmt::skip]
    let aligned = Matrix3::new(
        0.0, 0.0, 1.0, // forward is the boresight
        1.0, 0.0, 0.0, // right is right
        0.0, 1.0, 0.0, // down is down
    );
    from_matrix(&(turned.into_inner() * aligned))
}

/// Rectified left camera to the left camera as built: the transpose of OpenCV's `R1`, which takes
/// raw components to rectified ones.
#[must_use]
pub fn raw_from_rectified(rectified_from_raw: &Matrix3<f64>) -> Rotation<CamLeft, CamLeftRaw> {
    from_matrix(&rectified_from_raw.transpose())
}

fn from_matrix<From, To>(to_from: &Matrix3<f64>) -> Rotation<From, To> {
    let q = UnitQuaternion::from_matrix(to_from).into_inner();
    #[expect(
        unsafe_code,
        reason = "the one place that states the camera's relations"
    )]
    // SAFETY: private; both callers build the matrix that takes `From` components to `To`
    // components, from the definition of the two frames (the mount angles, OpenCV's R1).
    unsafe {
        Rotation::from_quaternion(q.w, q.i, q.j, q.k)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Attitude, Metres};
    use nalgebra::Vector3;
    use sguaba::Vector;

    fn boresight(mount: MountAngles) -> Vector3<f64> {
        let ten_metres = Vector::<CamLeft>::from_metres(Vector3::new(0.0, 0.0, 10.0));
        body_from_camera::<CamLeft>(mount)
            .transform(ten_metres)
            .metres()
    }

    /// Checklist item 48: level, heading north, 30 degrees down, 10 m on the axis.
    #[test]
    fn thirty_degrees_down_at_ten_metres_is_the_papers_vector() {
        let mount = MountAngles {
            depression_rad: 30_f64.to_radians(),
            ..Default::default()
        };
        let body = boresight(mount);
        assert!(
            (body - Vector3::new(8.660_254, 0.0, 5.0)).norm() < 1e-6,
            "{body}"
        );
        let enu = Attitude::from_angles(0.0, 0.0, 0.0)
            .enu_from_body()
            .transform(Vector::<BodyFrd>::from_metres(body))
            .metres();
        assert!(
            (enu - Vector3::new(0.0, 8.660_254, -5.0)).norm() < 1e-6,
            "{enu}"
        );
    }

    #[test]
    fn the_image_turns_with_the_mount() {
        let image_down = |mount| {
            let y = Vector::<CamLeft>::from_metres(Vector3::y());
            body_from_camera::<CamLeft>(mount).transform(y).metres()
        };
        // Straight down: the lower image edge looks aft.
        let nadir = MountAngles {
            depression_rad: 90_f64.to_radians(),
            ..Default::default()
        };
        assert!((image_down(nadir) + Vector3::x()).norm() < 1e-12);
        assert!((boresight(nadir) - Vector3::new(0.0, 0.0, 10.0)).norm() < 1e-9);
        // Yaw to the right wing; clockwise roll puts the lower edge to the left.
        let right = MountAngles {
            yaw_rad: 90_f64.to_radians(),
            ..Default::default()
        };
        assert!((boresight(right) - Vector3::new(0.0, 10.0, 0.0)).norm() < 1e-9);
        let rolled = MountAngles {
            roll_rad: 90_f64.to_radians(),
            ..Default::default()
        };
        assert!((image_down(rolled) + Vector3::y()).norm() < 1e-12);
    }
}
