//! What one sighting says about a fire's outline, as rays: metres come later, from the best range
//! that is known then.
//!
//! **Assumption.** The box's sides touch the flames' sides, its lower edge the near edge of what
//! burns, its upper edge the tallest flame.

use crate::locate::{Sighting, View};
use emberfix_calib::RectifiedPixel;
use emberfix_frames::{ServiceTime, Vector3};
use nalgebra::Vector2;

/// One sighting's box as rays from a camera; mission plane, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Mid-exposure.
    pub at: ServiceTime,
    camera: Vector3<f64>,
    left: Vector3<f64>,
    right: Vector3<f64>,
    foot: Vector3<f64>,
    top: Vector3<f64>,
    planes: [Vector3<f64>; 3],
    /// Jitter of one box edge that comes of pixels alone, radians.
    pub edge_rad: f64,
}

/// One look in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InMetres {
    /// Across the line of sight.
    pub width_m: f64,
    /// From the foot's ray to the top's, both above the near edge: the reported camera's own height,
    /// which wanders, is not in it.
    pub apparent_height_m: f64,
    /// Tangent of the depression.
    pub slope: f64,
    /// Horizontal, from the camera to the fire: east and north, unit.
    pub sight: Vector2<f64>,
    /// Slant range, metres.
    pub range_m: f64,
    /// Horizontal, from the camera to the near edge, metres.
    pub flat_m: f64,
}

/// Jitter of a detector's box edge, pixels.
const EDGE_PX: f64 = 1.0;

impl Look {
    /// The rays of a sighting's box.
    #[must_use]
    pub fn of(sighting: &Sighting, view: &View<'_>) -> Self {
        let (width, height) = sighting.size_px;
        let base = sighting.base;
        let ray = |right: f64, up: f64| {
            view.ray_enu(RectifiedPixel {
                u: base.u + right * width,
                v: base.v - up * height,
            })
        };
        let (low_left, low_right) = (ray(-0.5, 0.0), ray(0.5, 0.0));
        let (high_left, high_right) = (ray(-0.5, 1.0), ray(0.5, 1.0));
        Self {
            at: sighting.at,
            camera: view.camera_enu,
            planes: [
                outward(&low_left, &high_left, &low_right),
                outward(&low_right, &high_right, &low_left),
                outward(&low_left, &low_right, &high_left),
            ],
            left: ray(-0.5, 0.5),
            right: ray(0.5, 0.5),
            foot: ray(0.0, 0.0),
            top: ray(0.0, 1.0),
            edge_rad: EDGE_PX / view.rig.rectification().focal_px(),
        }
    }

    /// Where the camera was reported.
    #[must_use]
    pub fn camera(&self) -> &Vector3<f64> {
        &self.camera
    }

    /// Planes through the camera in which the left side, the right side and the lower edge of the box
    /// lie: unit normals that point away from the box.
    #[must_use]
    pub fn planes(&self) -> [Vector3<f64>; 3] {
        self.planes
    }

    /// Half the box's width, metres at the distance of a point.
    #[must_use]
    pub fn half_width_m(&self, at: &Vector3<f64>) -> f64 {
        0.5 * (self.right - self.left).norm() * (at - self.camera).norm()
    }

    /// The box's height, metres at the distance of a point.
    #[must_use]
    pub fn box_height_m(&self, at: &Vector3<f64>) -> f64 {
        (self.top - self.foot).norm() * (at - self.camera).norm()
    }

    /// The look in metres, when the middle of the burning ground is at `middle` and it is `depth_m`
    /// deep. The sides are taken at the middle, the height at the near
    /// edge. `None` when the camera is right above, or a ray misses.
    #[must_use]
    pub fn in_metres(&self, middle: &Vector3<f64>, depth_m: f64) -> Option<InMetres> {
        let foot = self.near_edge(middle, depth_m)?;
        let to_foot = foot - self.camera;
        let flat_m = to_foot.xy().norm();
        if flat_m < 0.5 || -to_foot.z > 8.0 * flat_m {
            return None;
        }
        let sight = to_foot.xy() / flat_m;
        let at = |ray: &Vector3<f64>, flat_m: f64| {
            let along = ray.xy().dot(&sight);
            (along > 0.05).then(|| self.camera + ray * (flat_m / along))
        };
        let middle_m = flat_m + depth_m / 2.0;
        let (left, right) = (at(&self.left, middle_m)?, at(&self.right, middle_m)?);
        let (low, top) = (at(&self.foot, flat_m)?, at(&self.top, flat_m)?);
        let to_right = Vector2::new(sight.y, -sight.x);
        let width_m = (right - left).xy().dot(&to_right);
        Some(InMetres {
            width_m,
            apparent_height_m: top.z - low.z,
            slope: -to_foot.z / flat_m,
            sight,
            range_m: to_foot.norm(),
            flat_m,
        })
    }

    /// The edge towards the camera.
    fn near_edge(&self, middle: &Vector3<f64>, depth_m: f64) -> Option<Vector3<f64>> {
        let sight = (middle - self.camera).xy().try_normalize(1e-3)?;
        let back = sight * (depth_m / 2.0);
        Some(middle - Vector3::new(back.x, back.y, 0.0))
    }

    /// The middle of burning ground that begins at `foot` and is `depth_m` deep, as seen from here.
    #[must_use]
    pub fn middle(&self, foot: &Vector3<f64>, depth_m: f64) -> Vector3<f64> {
        let sight = (foot - self.camera).xy().try_normalize(1e-3);
        let behind = sight.unwrap_or_default() * (depth_m / 2.0);
        foot + Vector3::new(behind.x, behind.y, 0.0)
    }
}

#[cfg(test)]
impl Look {
    /// A look that is known by its planes and the rays through the middles of the box's sides.
    pub(super) fn by_planes(
        at: ServiceTime,
        camera: Vector3<f64>,
        planes: [Vector3<f64>; 3],
        [left, right, foot, top]: [Vector3<f64>; 4],
    ) -> Self {
        Self {
            at,
            camera,
            left,
            right,
            foot,
            top,
            planes,
            edge_rad: 1e-3,
        }
    }
}

/// Normal of the plane through two rays, away from a third; unit.
fn outward(one: &Vector3<f64>, other: &Vector3<f64>, inside: &Vector3<f64>) -> Vector3<f64> {
    let normal = one.cross(other).try_normalize(0.0).unwrap_or_default();
    if normal.dot(inside) > 0.0 {
        -normal
    } else {
        normal
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::locate::SharedPriors;
    use crate::testing::{datum, pose, rig};
    use emberfix_frames::ServiceTime;

    /// A fire 20 m ahead and 10 m below, 4 m wide, box 3 m high.
    fn look() -> (Look, Vector3<f64>) {
        let (rig, pose) = (rig(0.0), pose(0.0, 0.0, 0.0));
        let sigmas = SharedPriors {
            heading_rad: 0.0,
            tilt_rad: 0.0,
            ..SharedPriors::default()
        };
        let view = View::new(&rig, &pose, &sigmas, &datum());
        let foot = view.camera_enu + Vector3::new(0.0, 20.0, -10.0);
        let base = view.predict(&foot).unwrap().pixel;
        let sighting = Sighting {
            at: ServiceTime::from_unix_ns(0),
            base,
            base_sigma_px: (1.0, 1.0),
            size_px: (880.0 * 4.0 / 20.0, 880.0 * 3.0 / 20.0),
            disparity: None,
            glow: None,
            at_least_m: None,
        };
        (Look::of(&sighting, &view), foot)
    }

    #[test]
    fn a_box_is_as_many_metres_wide_and_high_as_the_range_makes_it() {
        let (look, foot) = look();
        let metres = look.in_metres(&foot, 0.0).unwrap();
        assert!((metres.width_m - 4.0).abs() < 1e-6, "{metres:?}");
        assert!((metres.apparent_height_m - 3.0).abs() < 1e-6);
        // The box's sides pass the fire at half its width, its lower edge touches the foot.
        let support = look
            .planes()
            .map(|normal| normal.dot(&(look.camera() - foot)));
        assert!((support[0] / 2.0 - 1.0).abs() < 0.02, "{support:?}");
        assert!((support[1] / 2.0 - 1.0).abs() < 0.02, "{support:?}");
        assert!(support[2].abs() < 1e-6, "{support:?}");
        assert!(look.planes()[0].x < -0.9 && look.planes()[1].x > 0.9);
        assert!(look.planes()[2].y < 0.0 && look.planes()[2].z < 0.0);
        // Twice as far, twice as large.
        let camera = foot - Vector3::new(0.0, 20.0, -10.0);
        let far = camera + (foot - camera) * 2.0;
        assert!((look.in_metres(&far, 0.0).unwrap().width_m - 8.0).abs() < 1e-6);
    }

    #[test]
    fn from_right_above_there_is_no_size() {
        let (look, foot) = look();
        let beneath = Vector3::new(foot.x, foot.y - 20.0 + 0.1, foot.z);
        assert_eq!(look.in_metres(&beneath, 0.0), None);
    }
}
