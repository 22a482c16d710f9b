//! The ground that a fire stands on, as a plane about where it may be.

use super::chart::{Chart, OF_FIRE, State, TERRAIN};
use super::joint::{Joint, JointVector};
use crate::locate::{Terrain, View};
use emberfix_frames::{Coordinate, Metres, MissionEnu, Vector3, Wgs84Parts};
use nalgebra::{Matrix2, SymmetricEigen};

/// How well a position can be held to the terrain model plus its offset, metres.
const GROUND_NOISE_M: f64 = 0.1;
/// Least step of the terrain's numeric slope, metres.
const SLOPE_STEP_M: f64 = 2.0;
/// Longest step of the terrain's numeric slope over the height above it.
const SLOPE_REACH: f64 = 10.0;

/// The ground about a fire, as a plane: what its height is at a place, how it slopes, and how far
/// the real one strays from that within the fire's own error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalGround {
    at: Vector3<f64>,
    /// Of the ground above `at`, metres.
    height_m: f64,
    slope: (f64, f64),
    stray_m: f64,
}

impl LocalGround {
    /// The base stands on the ground: up = terrain(east, north) + the fire's own terrain offset. Taken
    /// times the inverse depth, in which it is nearly linear.
    pub fn hold(&self, joint: &mut Joint, chart: &Chart, at: &JointVector) {
        let state: State = at.fixed_rows::<OF_FIRE>(0).into_owned();
        let (point, by, over_by) = chart.distant(&state);
        let normal = self.normal().transpose();
        let beneath = normal.dot(&self.at.transpose()) + self.height_m + state[TERRAIN];
        let residual = beneath * point.over - normal.dot(&point.at.transpose());
        let mut by_state = normal * by - over_by * beneath;
        by_state[TERRAIN] -= point.over;
        let mut row = JointVector::zeros();
        row.fixed_rows_mut::<OF_FIRE>(0)
            .copy_from(&by_state.transpose());
        let variance = (GROUND_NOISE_M.powi(2) + self.stray_m.powi(2)) * point.over.powi(2);
        joint.take_one(&row, residual, variance, at);
    }

    /// Upwards, of length one upwards.
    fn normal(&self) -> Vector3<f64> {
        Vector3::new(-self.slope.0, -self.slope.1, 1.0)
    }

    /// The ground about `point` within the horizontal error `covariance`: a plane through what the
    /// model says at the ends of the ellipse's axes, and what the model strays from that plane.
    /// `None` where the model says nothing at one of these places: to take a void for level ground would
    /// make the position surer than anybody is.
    #[must_use]
    pub fn about(
        point: &Vector3<f64>,
        covariance: &Matrix2<f64>,
        view: &View<'_>,
        terrain: &dyn Terrain,
    ) -> Option<Self> {
        let middle = height_of_ground(point, view, terrain)?;
        let limit = SLOPE_REACH * (view.camera_enu.z - point.z).abs().max(SLOPE_STEP_M);
        let ellipse = SymmetricEigen::new(*covariance);
        let (mut slope, mut stray) = (nalgebra::Vector2::zeros(), 0.0_f64);
        for axis in 0..2 {
            let along = ellipse.eigenvectors.column(axis);
            let reach = (3.0 * ellipse.eigenvalues[axis].max(0.0))
                .sqrt()
                .clamp(SLOPE_STEP_M, limit);
            let at = |sign: f64| {
                let step = along * (sign * reach);
                let there = point + Vector3::new(step[0], step[1], 0.0);
                height_of_ground(&there, view, terrain)
            };
            let (ahead, behind) = (at(1.0)?, at(-1.0)?);
            slope += along * ((ahead - behind) / (2.0 * reach));
            // As for the clock: what a parabola strays from its line, at sqrt(3) sigma.
            stray += ((ahead + behind) * 0.5 - middle).powi(2) / 3.0;
        }
        Some(Self {
            at: *point,
            height_m: middle,
            slope: (slope[0], slope[1]),
            stray_m: stray.sqrt(),
        })
    }
}

/// Height of the terrain model above a point of the mission plane, metres.
fn height_of_ground(point: &Vector3<f64>, view: &View<'_>, terrain: &dyn Terrain) -> Option<f64> {
    let place = view.place(&Coordinate::<MissionEnu>::from_metres(*point))?;
    let ground = terrain.height_at(&place)?;
    Some(ground.m() - place.height().m())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::locate::SharedPriors;
    use crate::testing::{datum, pose, rig};
    use emberfix_frames::{EllipsoidHeight, Wgs84, Wgs84Parts};

    /// Ground that rises by a half to the east, and is a void east of the datum by more than this.
    struct Slope {
        void_from_m: f64,
    }

    impl Terrain for Slope {
        fn height_at(&self, place: &Wgs84) -> Option<EllipsoidHeight> {
            let metres_per_deg = 111_320.0 * datum().latitude_deg().to_radians().cos();
            let east_m = (place.longitude_deg() - datum().longitude_deg()) * metres_per_deg;
            (east_m <= self.void_from_m).then(|| EllipsoidHeight::from_m(0.5 * east_m))
        }
        fn sigma_m(&self, _place: &Wgs84) -> f64 {
            1.0
        }
    }

    #[test]
    fn beside_a_void_nothing_is_known_of_the_slope() {
        let (rig, pose, datum) = (rig(30.0), pose(0.0, 0.0, 0.0), datum());
        let view = View::new(&rig, &pose, &SharedPriors::default(), &datum);
        let about = |void_from_m: f64| {
            let point = Vector3::new(0.0, 30.0, -20.0);
            let ellipse = Matrix2::new(100.0, 0.0, 0.0, 4.0);
            LocalGround::about(&point, &ellipse, &view, &Slope { void_from_m })
        };
        let whole = about(f64::INFINITY).unwrap();
        assert!((whole.slope.0 - 0.5).abs() < 1e-2, "{whole:?}");
        // The ellipse reaches 17 m to the east.
        assert!(about(20.0).is_some());
        assert_eq!(about(10.0), None);
    }
}
