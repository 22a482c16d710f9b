//! The one place that hands the flights to the estimator that flies, through its public interface.

use super::truth::{Autopilot, ErrorModel, Flame, IMAGE_PX, LEVER_ARM_M, Lens, Reported, Seen};
use crate::alarm::{AlarmClass, FireId};
use crate::locate::{DisparityOf, SharedPriors, Sighting, Terrain, View};
use crate::pose::Pose;
use crate::track::{Classified, Estimated, TrackConfig, Tracker};
use emberfix_calib::{RectifiedPixel, Rig, RigError};
use emberfix_frames::{
    Attitude, Covariance, EllipsoidHeight, MissionEnu, ServiceTime, Wgs84, Wgs84Parts,
    place_from_degrees, seconds,
};
use emberfix_frames::{Metres, Vector3};
use emberfix_sim::earth::{Lla, TangentPlane};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use std::collections::BTreeSet;

/// Origin of the plane: P3's fire.
const DATUM: Lla = Lla {
    latitude_deg: 31.409_422_2,
    longitude_deg: 119.112_016_7,
    height_m: 8.7067,
};

/// Why a rig or a plane could not be made.
#[derive(Debug, thiserror::Error)]
pub enum SetupError {
    /// The rig was refused.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// A place is not on the Earth.
    #[error("evaluation: a place is not on the Earth: {0}")]
    Place(String),
}

/// A tilted plane of ground as the service knows it.
#[derive(Debug, Clone, Copy)]
pub struct Ground {
    /// Ellipsoid height at the datum's latitude and longitude, metres.
    pub height_m: f64,
    /// Rise to the east and north, metres per metre.
    pub slope: (f64, f64),
    /// One sigma of its error, metres.
    pub sigma_m: f64,
}

impl Ground {
    fn height_of(&self, enu_m: &Vector3<f64>) -> f64 {
        self.height_m + self.slope.0 * enu_m.x + self.slope.1 * enu_m.y
    }
}

impl Terrain for Ground {
    fn height_at(&self, place: &Wgs84) -> Option<EllipsoidHeight> {
        let here = Lla {
            latitude_deg: place.latitude_deg(),
            longitude_deg: place.longitude_deg(),
            height_m: place.height().m(),
        };
        let enu = TangentPlane::at(DATUM).from_lla(here);
        Some(EllipsoidHeight::from_m(self.height_of(&enu)))
    }
    fn sigma_m(&self, _place: &Wgs84) -> f64 {
        self.sigma_m
    }
}

/// Where a fire stands whose ground is `error_m` above the known ground, near a place of the plane.
#[must_use]
pub fn on_ground(ground: &Ground, east_m: f64, north_m: f64, error_m: f64) -> Vector3<f64> {
    let plane = TangentPlane::at(DATUM);
    let mut place = plane.to_lla(Vector3::new(east_m, north_m, 0.0));
    place.height_m = ground.height_of(&Vector3::new(east_m, north_m, 0.0)) + error_m;
    plane.from_lla(place)
}

/// Ground through the datum's own height.
#[must_use]
pub fn ground_at_datum(slope: (f64, f64), sigma_m: f64) -> Ground {
    Ground {
        height_m: DATUM.height_m,
        slope,
        sigma_m,
    }
}

/// One fire as the estimator has it.
#[derive(Debug, Clone, PartialEq)]
pub struct Told {
    /// Its number.
    pub id: u32,
    /// Whether an alarm would have gone out.
    pub confirmed: bool,
    /// Position, metres.
    pub position_m: Vector3<f64>,
    /// Covariance, m².
    pub covariance_m2: Matrix3<f64>,
    /// Radius that holds the truth in 90 %, metres.
    pub ce90_m: f64,
}

/// What the estimator has learned of errors that all fires share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Learned {
    /// All that turns the camera against the reported attitude, about body axes, radians.
    pub pointing_rad: Vector3<f64>,
    /// Its sigma about each axis, radians.
    pub pointing_sigma_rad: Vector3<f64>,
    /// The mount's own share of it.
    pub boresight_rad: Vector3<f64>,
    /// Camera clock late, seconds.
    pub clock_s: f64,
    /// Its sigma, seconds.
    pub clock_sigma_s: f64,
}

/// The service's side of one flight.
pub struct Pilot {
    kit: Kit,
    tracker: Tracker,
}

/// What the service is told before it flies.
struct Kit {
    rig: Rig,
    datum: Wgs84,
    errors: ErrorModel,
    priors: SharedPriors,
    ground: Option<Ground>,
}

impl Pilot {
    /// A service that is told the lens, the size of its errors and the ground.
    ///
    /// # Errors
    /// [`SetupError`] when the rig is refused.
    pub fn new(
        lens: &Lens,
        errors: &ErrorModel,
        ground: Option<Ground>,
    ) -> Result<Self, SetupError> {
        let height = EllipsoidHeight::from_m(DATUM.height_m);
        let datum = place_from_degrees(DATUM.latitude_deg, DATUM.longitude_deg, height)
            .map_err(|error| SetupError::Place(error.to_string()))?;
        let kit = Kit {
            rig: Rig::parse(&rig_toml(lens, errors), std::path::Path::new("evaluation"))?,
            datum,
            errors: *errors,
            priors: priors(errors),
            ground,
        };
        Ok(Self {
            kit,
            tracker: Tracker::new(TrackConfig::default(), FireId(1)),
        })
    }

    /// Takes one look in; says which fire each sighting was given to.
    pub fn look(&mut self, autopilot: &Autopilot<'_>, seen: &[Seen]) -> Vec<Option<u32>> {
        let kit = &self.kit;
        let Some(pose) = kit.pose(&autopilot.report(0.0)) else {
            return vec![None; seen.len()];
        };
        let motion = |later_s: f64| kit.pose(&autopilot.report(later_s));
        let view = View::new(&kit.rig, &pose, &kit.priors, &kit.datum).with_motion(&motion);
        let classified: Vec<_> = seen
            .iter()
            .map(|seen| classified(seen, &kit.errors, pose.at))
            .collect();
        let terrain = kit.ground.as_ref().map(|ground| ground as &dyn Terrain);
        let outcomes = self.tracker.step(&view, &classified, terrain);
        outcomes
            .iter()
            .map(|outcome| outcome.fire.map(|fire| fire.0))
            .collect()
    }

    /// How many fires it has, those that turned out to be another one left out.
    #[must_use]
    pub fn open_fires(&self) -> usize {
        let fires = self.tracker.fires().iter();
        fires.filter(|fire| fire.merged_into.is_none()).count()
    }

    /// The fires that it has, those that turned out to be another one left out.
    #[must_use]
    pub fn fires(&self) -> Vec<Told> {
        let open = |fire: &&crate::track::Fire| fire.merged_into.is_none();
        let fires = self.tracker.fires().iter().filter(open);
        fires
            .map(|fire| {
                let covariance: Covariance<MissionEnu> = fire.covariance();
                Told {
                    id: fire.id.0,
                    confirmed: fire.is_confirmed(),
                    position_m: fire.position().metres(),
                    covariance_m2: *covariance.m2(),
                    ce90_m: covariance.ce90_m(),
                }
            })
            .collect()
    }

    /// What it has learned of the errors that all fires share.
    #[must_use]
    pub fn learned(&self) -> Option<Learned> {
        let shared = self.tracker.shared_errors()?;
        let value = |of: &[Estimated; 3]| Vector3::from_fn(|axis, _| of[axis].value);
        Some(Learned {
            pointing_rad: value(&shared.pointing_rad),
            pointing_sigma_rad: Vector3::from_fn(|axis, _| shared.pointing_rad[axis].sigma),
            boresight_rad: value(&shared.boresight_rad),
            clock_s: shared.clock_s.value,
            clock_sigma_s: shared.clock_s.sigma,
        })
    }
}

impl Kit {
    fn pose(&self, reported: &Reported) -> Option<Pose> {
        let place = TangentPlane::at(DATUM).to_lla(reported.position_m);
        let height = EllipsoidHeight::from_m(place.height_m);
        let place = place_from_degrees(place.latitude_deg, place.longitude_deg, height).ok()?;
        Some(Pose {
            at: ServiceTime::from_unix_ns(START_NS) + seconds(reported.t_s),
            place,
            attitude: attitude(&reported.enu_from_body)?,
            velocity_enu_m_s: reported.velocity_m_s,
            rate_rad_s: reported.rate_rad_s,
            gnss_horizontal_m: self.errors.gnss_horizontal_m,
            gnss_vertical_m: self.errors.gnss_vertical_m,
            attitude_noise_rad: self.errors.attitude_noise_rad,
            position_noise_m: self.errors.position_noise_m,
            // The rig's share of the clock's sigma is all of it here.
            time_sigma_s: 0.0,
            degraded: BTreeSet::new(),
        })
    }
}

fn priors(errors: &ErrorModel) -> SharedPriors {
    SharedPriors {
        gnss_constant_share: errors.gnss_constant_share,
        gnss_correlation_s: errors.gnss_correlation_s,
        velocity_m_s: errors.velocity_m_s,
        velocity_correlation_s: errors.velocity_correlation_s,
        heading_rad: errors.heading_deg.to_radians(),
        heading_constant_share: errors.heading_constant_share,
        heading_correlation_s: errors.heading_correlation_s,
        tilt_rad: errors.tilt_deg.to_radians(),
        tilt_constant_share: errors.tilt_constant_share,
        tilt_correlation_s: errors.tilt_correlation_s,
    }
}

/// A date in 2026.
const START_NS: i64 = 1_780_000_000_000_000_000;

/// As MAVLink has it: a quaternion from body to north, east, down.
fn attitude(enu_from_body: &Matrix3<f64>) -> Option<Attitude> {
    #[rustfmt::skip]
    let ned_from_enu = Matrix3::new(
        0.0, 1.0, 0.0,
        1.0, 0.0, 0.0,
        0.0, 0.0, -1.0,
    );
    let ned_from_body = Rotation3::from_matrix_unchecked(ned_from_enu * enu_from_body);
    let q = UnitQuaternion::from_rotation_matrix(&ned_from_body);
    Attitude::from_mavlink_quaternion([q.w, q.i, q.j, q.k]).ok()
}

fn classified(seen: &Seen, errors: &ErrorModel, at: ServiceTime) -> Classified {
    let pixel = |(u, v): (f64, f64)| RectifiedPixel { u, v };
    Classified {
        sighting: Sighting {
            at,
            base: pixel(seen.base_px),
            base_sigma_px: (errors.pixel_px, errors.pixel_px),
            size_px: seen.size_px,
            disparity: seen.disparity_px.map(|px| DisparityOf {
                px,
                sigma_px: errors.disparity_px,
                centroid: pixel(seen.centroid_px),
            }),
            glow: Some(seen.glow),
            at_least_m: None,
        },
        class: AlarmClass::Fire,
        score: 0.8,
        second_look: None,
        patch: seen.picture,
    }
}

fn rig_toml(lens: &Lens, errors: &ErrorModel) -> String {
    let camera = format!(
        "image_size_px = [{}, {}]\nfocal_px = [{f:?}, {f:?}]\n\
         principal_point_px = [{:?}, {:?}]\ndistortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n",
        IMAGE_PX.0,
        IMAGE_PX.1,
        0.5 * IMAGE_PX.0,
        0.5 * IMAGE_PX.1,
        f = lens.focal_px,
    );
    format!(
        "name = \"evaluation\"\n[left]\n{camera}[right]\n{camera}[stereo]\n\
         right_from_left_rotation_deg = [0.0, 0.0, 0.0]\n\
         right_from_left_translation_m = [{:?}, 0.0, 0.0]\nmax_skew_s = 0.001\n\
         [mount]\nyaw_deg = 0.0\ndepression_deg = {:?}\nroll_deg = 0.0\n\
         lever_arm_m = {:?}\n[time]\ncamera_offset_s = 0.0\n[sigma]\n\
         disparity_bias_px = {:?}\nboresight_deg = {:?}\nlever_arm_m = {:?}\n\
         time_offset_s = {:?}\n",
        -lens.baseline_m,
        lens.depression_deg,
        LEVER_ARM_M,
        errors.disparity_bias_px,
        errors.boresight_deg,
        errors.lever_arm_m,
        errors.clock_s,
    )
}

/// A flame of a size, standing somewhere.
#[must_use]
pub const fn flame(base_m: Vector3<f64>, size_m: f64) -> Flame {
    Flame { base_m, size_m }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::location::flight::{Course, Kind};
    use crate::eval::location::truth::{Gnss, Slow, TrueCamera};
    use emberfix_sim::noise::stream;

    /// The truth's projection against the estimator's, on a flight without errors: both are
    /// written apart, and what is left is rounding and OpenCV's rectification of a perfect pair.
    #[test]
    fn without_errors_the_service_sees_what_the_true_camera_sees() {
        let lens = Lens {
            depression_deg: 35.0,
            ..Lens::short()
        };
        let errors = ErrorModel::of(Gnss::Rtk, 0.5);
        let pilot = Pilot::new(&lens, &errors, None).unwrap();
        let mut course = Course::drawn(&mut stream(5, "view"), Kind::Orbit, 80.0, 45.0);
        course.azimuth_rad = 0.4;
        for t_s in course.looks(7, 0.5) {
            let state = course.state(t_s);
            let camera = TrueCamera {
                lens: &lens,
                state: &state,
                slow: &Slow::zeros(),
            };
            let flame = flame(Vector3::new(1.0, -2.0, 0.0), 2.0);
            let sight = camera.sight(&flame).unwrap();
            let pose = pilot
                .kit
                .pose(&Reported {
                    t_s,
                    position_m: state.position_m,
                    enu_from_body: state.enu_from_body,
                    velocity_m_s: state.velocity_m_s,
                    rate_rad_s: state.rate_rad_s,
                })
                .unwrap();
            let view = View::new(&pilot.kit.rig, &pose, &pilot.kit.priors, &pilot.kit.datum);
            let predicted = view.predict(&flame.base_m).unwrap();
            let apart = (predicted.pixel.u - sight.base.x).hypot(predicted.pixel.v - sight.base.y);
            assert!(apart < 0.02, "{apart} px apart");
            assert!((predicted.disparity_px - sight.base.z).abs() < 1e-3);
        }
    }
}
