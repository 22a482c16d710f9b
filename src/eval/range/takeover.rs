//! What the estimator makes of a disparity's error: where terrain and parallax take over.
//!
//! **In:** a rig, a range, one sigma of a disparity there. **Out:** one sigma of the range along the line of
//! sight, by the service's own `locate` and `track`: of one sighting's terrain, and of all there is after
//! flying past. Measurements are given as they should be; only their errors count. The aircraft knows its
//! own place to centimetres (RTK), so that what is left is the range's.

use crate::alarm::{AlarmClass, FireId};
use crate::locate::{ConstantPlane, DisparityOf, SharedPriors, Sighting, View, fix};
use crate::pose::Pose;
use crate::track::{Classified, TrackConfig, Tracker};
use emberfix_calib::Rig;
use emberfix_frames::{
    Attitude, Coordinate, Covariance, EllipsoidHeight, Metres, MissionEnu, ServiceTime, Vector3,
    VehicleEnu, Wgs84, ecef_from_enu, place_from_degrees, place_from_ecef, seconds,
};
use std::collections::BTreeSet;

/// One sigma of the range, metres.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub(super) struct Predicted {
    /// Of one sighting's ray to the ground.
    pub terrain_m: Option<f64>,
    /// Of disparities, parallax and ground together, after flying past.
    pub passed_m: Option<f64>,
}

/// Height above the ground, metres; lower where the fire is nearer than twice that.
const HEIGHT_M: f64 = 15.0;
/// Sideways past the fire, metres a second, for so long, with so many looks a second.
const SPEED_M_S: f64 = 5.0;
const PASS_S: f64 = 4.0;
const LOOKS_HZ: f64 = 3.0;
/// How far the ground strays from what is known of it, one sigma, metres.
const GROUND_SIGMA_M: f64 = 1.0;
/// Of the aircraft's place, metres.
const RTK_M: f64 = 0.02;
/// Of the foot of the box, pixels.
const BASE_PX: f64 = 2.0;

/// For a fire at a range; `None` where the rig does not see it.
pub(super) fn predicted(rig: &Rig, range_m: f64, sigma_px: f64) -> Option<Predicted> {
    let datum = place_from_degrees(31.4, 119.1, EllipsoidHeight::from_m(0.0)).ok()?;
    let scene = Scene {
        rig,
        datum,
        range_m,
        sigma_px,
        ground: ConstantPlane {
            height: EllipsoidHeight::from_m(0.0),
            sigma_m: GROUND_SIGMA_M,
        },
    };
    Some(Predicted {
        terrain_m: scene.terrain_m(),
        passed_m: scene.passed_m(),
    })
}

/// A fire at the datum and a camera to its south.
struct Scene<'a> {
    rig: &'a Rig,
    datum: Wgs84,
    range_m: f64,
    sigma_px: f64,
    ground: ConstantPlane,
}

impl Scene<'_> {
    fn terrain_m(&self) -> Option<f64> {
        let pose = self.pose(0.0)?;
        let priors = SharedPriors::default();
        let view = View::new(self.rig, &pose, &priors, &self.datum);
        let alone = Sighting {
            disparity: None,
            ..self.sighting(&view)?
        };
        let fix = fix(&alone, &view, Some(&self.ground))?;
        Some(along(&fix.covariance, &view))
    }

    fn passed_m(&self) -> Option<f64> {
        let mut tracker = Tracker::new(TrackConfig::default(), FireId(1));
        let mut sigma_m = None;
        for look in 0..=(PASS_S * LOOKS_HZ) as u32 {
            let pose = self.pose(f64::from(look) / LOOKS_HZ)?;
            let priors = SharedPriors::default();
            let view = View::new(self.rig, &pose, &priors, &self.datum);
            let seen = Classified {
                sighting: self.sighting(&view)?,
                class: AlarmClass::Fire,
                score: 0.9,
                second_look: None,
                patch: None,
            };
            tracker.step(&view, &[seen], Some(&self.ground));
            let fire = tracker.fires().first()?;
            sigma_m = Some(along(&fire.covariance(), &view));
        }
        sigma_m
    }

    /// On a straight line that has the fire abeam halfway, the nose to the fire.
    fn pose(&self, t_s: f64) -> Option<Pose> {
        let up_m = HEIGHT_M.min(0.5 * self.range_m);
        let south_m = (self.range_m.powi(2) - up_m.powi(2)).sqrt();
        let east_m = SPEED_M_S * (t_s - 0.5 * PASS_S);
        let at = Coordinate::<VehicleEnu>::from_metres(Vector3::new(east_m, -south_m, up_m));
        let at = ecef_from_enu::<VehicleEnu>(&self.datum).transform(at);
        Some(Pose {
            at: ServiceTime::from_unix_ns(0) + seconds(t_s),
            place: place_from_ecef(&at)?,
            attitude: Attitude::from_angles(0.0, 0.0, (-east_m).atan2(south_m)),
            velocity_enu_m_s: Vector3::new(SPEED_M_S, 0.0, 0.0),
            rate_rad_s: Vector3::zeros(),
            gnss_horizontal_m: RTK_M,
            gnss_vertical_m: RTK_M,
            attitude_noise_rad: 0.002,
            position_noise_m: 0.01,
            time_sigma_s: 0.002,
            degraded: BTreeSet::new(),
        })
    }

    /// Of the fire, as the rig should see it.
    fn sighting(&self, view: &View<'_>) -> Option<Sighting> {
        let seen = view.predict(&Vector3::zeros())?;
        Some(Sighting {
            at: view.pose.at,
            base: seen.pixel,
            base_sigma_px: (BASE_PX, BASE_PX),
            size_px: (20.0, 30.0),
            disparity: Some(DisparityOf {
                px: seen.disparity_px,
                sigma_px: self.sigma_px,
                centroid: seen.pixel,
            }),
            glow: None,
            at_least_m: None,
        })
    }
}

/// One sigma along the line of sight to the fire, metres.
fn along(covariance: &Covariance<MissionEnu>, view: &View<'_>) -> f64 {
    let sight = -view.camera_enu.normalize();
    let [a, b, c, d, e, f, g, h, i] = covariance.row_major();
    let m2 = emberfix_frames::Matrix3::new(a, b, c, d, e, f, g, h, i);
    sight.dot(&(m2 * sight)).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::rig;

    /// Far away the ground is better than the disparity, near it is not; and passing by is never worse.
    #[test]
    fn terrain_takes_over_with_the_range() {
        let rig = rig(30.0);
        let focal_baseline = rig.rectification().focal_px() * rig.baseline_m();
        let stereo_m = |range_m: f64| 0.1 * range_m.powi(2) / focal_baseline;
        let of = |range_m: f64| predicted(&rig, range_m, 0.1).unwrap();
        assert!(of(8.0).terrain_m.unwrap() > stereo_m(8.0), "{:?}", of(8.0));
        assert!(
            of(70.0).terrain_m.unwrap() < stereo_m(70.0),
            "{:?}",
            of(70.0)
        );
        for range_m in [8.0, 20.0, 70.0] {
            let Predicted {
                terrain_m,
                passed_m,
            } = of(range_m);
            let alone = terrain_m.unwrap().min(stereo_m(range_m));
            assert!(
                passed_m.unwrap() < 1.05 * alone,
                "{range_m} m: {:?}",
                of(range_m)
            );
        }
    }
}
