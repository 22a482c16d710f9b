//! Which way to fly, so that a fire's ellipse shrinks most.
//!
//! **In:** what is known of the fire and of the errors that all fires share, as one covariance, and
//! where camera and fire are. **Out:** a course and the CE90 that is to be expected after flying it,
//! or nothing when no course is worth it. Pure.
//!
//! For each of [`COURSES`] courses the looks on the way are played through the covariance alone (the
//! Fisher information needs no measured values): bearings, and disparity as far as it reaches. The
//! camera is taken to be kept on the fire. **Known limits.** Wind, obstacles and airspace are the
//! pilot's; a course that leads nearer to the fire than [`NEAREST_SHARE`] of the present ground range
//! or [`NEAREST_M`] is never proposed. Errors are taken not to wander during the few seconds.

use super::chart::OF_FIRE;
use super::joint::JOINT;
use super::{Fire, Tracker};
use crate::alarm::{Advice, FireState};
use crate::locate::{Shared, View};
use emberfix_frames::{Covariance, Matrix3, MissionEnu, Vector3};
use nalgebra::{SMatrix, SVector};

/// Numbers of the covariance that advice rests on: where the fire is, east, north, up (m); then what must be
/// added to the truth to get what is reported: GNSS east, north, up (m), heading (rad clockwise),
/// turns of the camera about the body axes (rad), disparity (px), clock (s).
pub const ADVISED: usize = 12;

const GNSS: usize = 3;
const HEADING: usize = 6;
const TURN: usize = 7;
const DISPARITY: usize = 10;
const CLOCK: usize = 11;

/// What a look is worth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LookQuality {
    /// One sigma of a bearing, new in each look, radians.
    pub bearing_rad: f64,
    /// Focal length times baseline, px m.
    pub focal_baseline_px_m: f64,
    /// One sigma of a disparity, new in each look, pixels.
    pub disparity_px: f64,
}

/// Where things stand.
#[derive(Debug, Clone, Copy)]
pub struct Outlook<'a> {
    /// See [`ADVISED`].
    pub covariance: &'a SMatrix<f64, ADVISED, ADVISED>,
    /// The fire, mission plane, metres.
    pub fire: Vector3<f64>,
    /// The camera, mission plane, metres.
    pub camera: Vector3<f64>,
    /// Speed to fly at, m/s.
    pub speed_m_s: f64,
    /// What a look is worth.
    pub look: LookQuality,
}

/// Courses that are weighed.
pub const COURSES: u32 = 36;
/// Looks on the way.
const LOOKS: u32 = 8;
/// Way to fly: this share of the range, within limits.
const WAY_SHARE: f64 = 0.5;
const WAY_M: (f64, f64) = (10.0, 80.0);
/// No course leads nearer to the fire than this share of the present ground range.
pub const NEAREST_SHARE: f64 = 0.5;
/// Nor nearer than this, slant, metres.
pub const NEAREST_M: f64 = 12.0;
/// A course is worth it when CE90 falls below this share of what staying brings.
const WORTH: f64 = 0.9;
/// A disparity is matched while its sigma is below this share of the depth.
const STEREO_REACH: f64 = 0.25;

/// The best course; `None` when none is worth flying.
#[must_use]
pub fn advise(outlook: &Outlook<'_>) -> Option<Advice> {
    let range = (outlook.fire - outlook.camera).norm();
    let distance_m = (WAY_SHARE * range).clamp(WAY_M.0, WAY_M.1);
    let staying = outlook.ce90_after(&Vector3::zeros())?;
    let best = (0..COURSES)
        .map(|course| 360.0 * f64::from(course) / f64::from(COURSES))
        .filter_map(|course_deg| {
            let (sin, cos) = course_deg.to_radians().sin_cos();
            let way = Vector3::new(sin, cos, 0.0) * distance_m;
            outlook
                .keeps_away(&way)
                .then(|| outlook.ce90_after(&way))
                .flatten()
                .map(|ce90_m| Advice {
                    course_deg,
                    distance_m,
                    ce90_m,
                })
        })
        .min_by(|a, b| a.ce90_m.total_cmp(&b.ce90_m))?;
    (best.ce90_m < WORTH * staying).then_some(best)
}

impl Outlook<'_> {
    /// Whether no point of the way is too near to the fire.
    fn keeps_away(&self, way: &Vector3<f64>) -> bool {
        let ground = |from: &Vector3<f64>| (self.fire - from).xy().norm();
        let least = NEAREST_SHARE * ground(&self.camera);
        self.stations(way)
            .all(|at| ground(&at) >= least && (self.fire - at).norm() >= NEAREST_M)
    }

    fn stations(&self, way: &Vector3<f64>) -> impl Iterator<Item = Vector3<f64>> {
        let (camera, way) = (self.camera, *way);
        (1..=LOOKS).map(move |look| camera + way * (f64::from(look) / f64::from(LOOKS)))
    }

    /// CE90 after the looks on a way.
    fn ce90_after(&self, way: &Vector3<f64>) -> Option<f64> {
        let mut covariance = *self.covariance;
        for at in self.stations(way) {
            for (row, variance) in self.rows(&at, way)? {
                let lever = covariance * row;
                covariance -= lever * lever.transpose() / (row.dot(&lever) + variance);
            }
        }
        let position: Matrix3<f64> = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let position = (position + position.transpose()) * 0.5;
        Covariance::<MissionEnu>::new(position)
            .ok()
            .map(|covariance| covariance.ce90_m())
    }

    /// What a look from `at` says: two bearings and, within reach, a disparity; each as a row over
    /// the numbers of [`ADVISED`] and its variance.
    fn rows(&self, at: &Vector3<f64>, way: &Vector3<f64>) -> Option<Vec<(Row, f64)>> {
        let sight = self.fire - at;
        let range = sight.norm();
        let ahead = sight.try_normalize(1e-6)?;
        // A level airframe with its nose to the fire.
        let nose = Vector3::new(sight.x, sight.y, 0.0)
            .try_normalize(1e-6)
            .unwrap_or_else(Vector3::y);
        let right = Vector3::new(nose.y, -nose.x, 0.0);
        let across = ahead.cross(&right).normalize();
        let bearing = (range * self.look.bearing_rad).powi(2);
        let displaced = self.displacement(&sight, &nose, &right, way);
        let mut rows = vec![
            (displaced.tr_mul(&right), bearing),
            (displaced.tr_mul(&across), bearing),
        ];
        // dR = R^2 / (f b) dd
        let metres_per_px = range * range / self.look.focal_baseline_px_m;
        if metres_per_px * self.look.disparity_px < STEREO_REACH * range {
            let mut row: Row = displaced.tr_mul(&ahead);
            row[DISPARITY] = -metres_per_px;
            rows.push((row, (metres_per_px * self.look.disparity_px).powi(2)));
        }
        Some(rows)
    }

    /// Where a look would place the fire, over all numbers, metres: where it truly is and, with that,
    /// what each error adds.
    fn displacement(
        &self,
        sight: &Vector3<f64>,
        nose: &Vector3<f64>,
        right: &Vector3<f64>,
        way: &Vector3<f64>,
    ) -> SMatrix<f64, 3, ADVISED> {
        let mut by = SMatrix::<f64, 3, ADVISED>::zeros();
        by.fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&Matrix3::identity());
        by.fixed_view_mut::<3, 3>(0, GNSS)
            .copy_from(&Matrix3::identity());
        let down = -Vector3::z();
        by.set_column(HEADING, &down.cross(sight));
        for (axis, about) in [*nose, *right, down].into_iter().enumerate() {
            by.set_column(TURN + axis, &about.cross(sight));
        }
        let velocity = way.try_normalize(1e-6).unwrap_or_default() * self.speed_m_s;
        // The nose follows the fire: the reported pose of later has turned with it.
        let ground = sight.xy().norm_squared().max(1.0);
        let turning = (sight.x * -velocity.y + sight.y * velocity.x) / ground;
        by.set_column(CLOCK, &(velocity + Vector3::z().cross(sight) * turning));
        by
    }
}

type Row = SVector<f64, ADVISED>;

/// New in each look, for want of the coming ones' own: edge of a box, disparity, pixels.
const BOX_PX: f64 = 2.0;
const DISPARITY_PX: f64 = 0.25;
/// Slowest flight that is advised, m/s.
const SLOWEST_M_S: f64 = 3.0;

impl Tracker {
    /// Which way to fly from `view` so that a fire's ellipse shrinks most; `None` when nothing is
    /// worth it, and for fires that are out or turned out to be another one.
    #[must_use]
    pub fn advise(&self, fire: &Fire, view: &View<'_>) -> Option<Advice> {
        if fire.state == FireState::Out || fire.merged_into.is_some() {
            return None;
        }
        let rect = view.rig.rectification();
        let covariance = Self::advised(fire, view);
        advise(&Outlook {
            covariance: &covariance,
            fire: fire.estimate.position_m(),
            camera: view.camera_enu,
            speed_m_s: view.pose.velocity_enu_m_s.norm().max(SLOWEST_M_S),
            look: LookQuality {
                bearing_rad: (BOX_PX / rect.focal_px()).hypot(view.pose.attitude_noise_rad),
                focal_baseline_px_m: rect.focal_px() * view.rig.baseline_m(),
                disparity_px: DISPARITY_PX,
            },
        })
    }

    /// One fire and the sums of the shared errors that turn and move the camera, see [`ADVISED`].
    fn advised(fire: &Fire, view: &View<'_>) -> SMatrix<f64, ADVISED, ADVISED> {
        let mut rows = SMatrix::<f64, ADVISED, JOINT>::zeros();
        rows.fixed_rows_mut::<3>(0)
            .copy_from(&fire.estimate.position_rows());
        for (row, shared) in SUMMED {
            let index = shared.0 as usize + shared.1;
            rows[(row, OF_FIRE + index)] += view.sigmas()[index];
        }
        rows * fire.estimate.joint().covariance() * rows.transpose()
    }
}

/// Which shared errors (kind, axis) make up each number of [`ADVISED`].
const SUMMED: [(usize, (Shared, usize)); 15] = [
    (GNSS, (Shared::GnssConstant, 0)),
    (GNSS + 1, (Shared::GnssConstant, 1)),
    (GNSS + 2, (Shared::GnssConstant, 2)),
    (GNSS, (Shared::Gnss, 0)),
    (GNSS + 1, (Shared::Gnss, 1)),
    (GNSS + 2, (Shared::Gnss, 2)),
    (HEADING, (Shared::HeadingConstant, 0)),
    (HEADING, (Shared::Heading, 0)),
    (TURN, (Shared::Boresight, 0)),
    (TURN + 1, (Shared::Boresight, 1)),
    (TURN + 2, (Shared::Boresight, 2)),
    (TURN, (Shared::Tilt, 0)),
    (TURN + 1, (Shared::Tilt, 1)),
    (DISPARITY, (Shared::Disparity, 0)),
    (CLOCK, (Shared::Clock, 0)),
];

#[cfg(test)]
mod tests {
    use super::*;

    const LOOK: LookQuality = LookQuality {
        bearing_rad: 0.003,
        focal_baseline_px_m: 66.0,
        disparity_px: 0.25,
    };

    /// A fire 100 m to the north of a camera 40 m up, long along the line of sight.
    fn prior(along_m: f64, across_m: f64, gnss_m: f64) -> SMatrix<f64, ADVISED, ADVISED> {
        let heading = 0.02_f64;
        let mut sigmas = SVector::<f64, ADVISED>::zeros();
        sigmas.copy_from_slice(&[
            across_m, along_m, 3.0, gnss_m, gnss_m, gnss_m, heading, 0.005, 0.005, 0.005, 0.1,
            0.005,
        ]);
        let mut prior = SMatrix::from_diagonal(&sigmas.component_mul(&sigmas));
        // Looks have placed the fire where it is and the receiver's error together: what the one has
        // more, the other has less.
        for axis in 0..3 {
            let gnss = prior[(GNSS + axis, GNSS + axis)];
            prior[(axis, axis)] += gnss;
            prior[(axis, GNSS + axis)] = -gnss;
            prior[(GNSS + axis, axis)] = -gnss;
        }
        prior
    }

    fn outlook(covariance: &SMatrix<f64, ADVISED, ADVISED>) -> Outlook<'_> {
        Outlook {
            covariance,
            fire: Vector3::new(0.0, 100.0, 0.0),
            camera: Vector3::new(0.0, 0.0, 40.0),
            speed_m_s: 8.0,
            look: LOOK,
        }
    }

    #[test]
    fn a_range_that_is_unknown_is_shrunk_by_flying_across_the_line_of_sight() {
        let prior = prior(30.0, 1.0, 0.02);
        let advice = advise(&outlook(&prior)).unwrap();
        let off_sight = advice.course_deg.to_radians().sin().abs();
        // Nearer and to the side: parallax needs the side, every bearing gains by being nearer.
        assert!(off_sight > 0.2, "course {}", advice.course_deg);
        assert!(advice.ce90_m < 20.0, "{advice:?}");
    }

    /// What is left is the receiver's offset, which no course can see.
    #[test]
    fn nothing_is_advised_when_only_the_receiver_errs() {
        let prior = prior(0.1, 0.1, 1.5);
        assert_eq!(advise(&outlook(&prior)), None);
    }

    #[test]
    fn no_course_leads_into_the_fire() {
        let prior = prior(30.0, 1.0, 0.02);
        let mut outlook = outlook(&prior);
        outlook.fire = Vector3::new(0.0, 14.0, 0.0);
        outlook.camera = Vector3::new(0.0, 0.0, 8.0);
        let advice = advise(&outlook).unwrap();
        let (sin, cos) = advice.course_deg.to_radians().sin_cos();
        let end = outlook.camera + Vector3::new(sin, cos, 0.0) * advice.distance_m;
        assert!((outlook.fire - end).norm() >= NEAREST_M, "{advice:?}");
    }
}
