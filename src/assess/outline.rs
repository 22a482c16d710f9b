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
    /// Jitter of one box edge that comes of pixels alone, radians.
    pub edge_rad: f64,
}

/// How far flame reaches in one direction over the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    /// Unit vector, east and north.
    pub outwards: Vector2<f64>,
    /// From the anchor, metres.
    pub metres: f64,
    /// One sigma of what differs from look to look, metres.
    pub sigma_m: f64,
    /// How a reported camera that is a metre too high moves it, where it is the near edge's, metres;
    /// 0 for the sides.
    pub by_height: f64,
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
    /// To the right, to the left, and towards the camera where it looks down steeply enough.
    pub reaches: [Option<Reach>; 3],
}

/// Jitter of a detector's box edge, pixels.
const EDGE_PX: f64 = 1.5;
/// Least tangent of the depression from which the lower edge places the near edge.
const LEAST_SLOPE: f64 = 0.2;
/// Flicker moves an edge by this share of the width.
const FLICKER_SHARE: f64 = 0.06;

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
        Self {
            at: sighting.at,
            camera: view.camera_enu,
            left: ray(-0.5, 0.5),
            right: ray(0.5, 0.5),
            foot: ray(0.0, 0.0),
            top: ray(0.0, 1.0),
            edge_rad: EDGE_PX / view.rig.rectification().focal_px(),
        }
    }

    /// The look in metres, when the middle of the burning ground is at `middle` and it is `depth_m`
    /// deep; reaches count from `anchor`. The sides are taken at the middle, the height at the near
    /// edge. `None` when the camera is right above, or a ray misses.
    #[must_use]
    pub fn in_metres(
        &self,
        middle: &Vector3<f64>,
        depth_m: f64,
        anchor: &Vector2<f64>,
    ) -> Option<InMetres> {
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
        let range_m = to_foot.norm();
        let sigma_m = (range_m * self.edge_rad).hypot(FLICKER_SHARE * width_m);
        let slope = -to_foot.z / flat_m;
        let reach = |outwards: Vector2<f64>, point: Vector2<f64>, sigma_m, by_height| Reach {
            outwards,
            metres: (point - anchor).dot(&outwards),
            sigma_m,
            by_height,
        };
        let near = (slope > LEAST_SLOPE)
            .then(|| self.on_ground(foot.z))
            .flatten();
        Some(InMetres {
            width_m,
            apparent_height_m: top.z - low.z,
            slope,
            sight,
            range_m,
            flat_m,
            reaches: [
                Some(reach(to_right, right.xy(), sigma_m, 0.0)),
                Some(reach(-to_right, left.xy(), sigma_m, 0.0)),
                near.map(|near| reach(-sight, near, sigma_m / slope.min(1.0), -1.0 / slope)),
            ],
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

    /// Where the lower edge's ray meets the level of the foot.
    fn on_ground(&self, level: f64) -> Option<Vector2<f64>> {
        let down = (level - self.camera.z) / self.foot.z;
        (down > 0.0).then(|| self.camera.xy() + self.foot.xy() * down)
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
        let metres = look.in_metres(&foot, 0.0, &foot.xy()).unwrap();
        assert!((metres.width_m - 4.0).abs() < 1e-6, "{metres:?}");
        assert!((metres.apparent_height_m - 3.0).abs() < 1e-6);
        let [right, left, near] = metres.reaches.map(Option::unwrap);
        assert!((right.outwards - Vector2::x()).norm() < 1e-6 && (right.metres - 2.0).abs() < 1e-6);
        assert!((left.outwards + Vector2::x()).norm() < 1e-6 && (left.metres - 2.0).abs() < 1e-6);
        assert!((near.outwards + Vector2::y()).norm() < 1e-6 && near.metres.abs() < 1e-6);
        // Twice as far, twice as large.
        let camera = foot - Vector3::new(0.0, 20.0, -10.0);
        let far = camera + (foot - camera) * 2.0;
        assert!((look.in_metres(&far, 0.0, &far.xy()).unwrap().width_m - 8.0).abs() < 1e-6);
    }

    #[test]
    fn from_right_above_there_is_no_size() {
        let (look, foot) = look();
        let beneath = Vector3::new(foot.x, foot.y - 20.0 + 0.1, foot.z);
        assert_eq!(look.in_metres(&beneath, 0.0, &beneath.xy()), None);
    }
}
