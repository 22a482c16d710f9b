//! The measurement model: what the left camera sees of a point, and how each error moves it.

use super::lens::{Distant, Lens, Optics, Predicted};
use super::shared::{SHARED, Shared, SharedPriors};
use super::shot::{ClockSlope, Corrected, Shot, Station, station};
use crate::pose::Pose;
use emberfix_calib::{RectifiedPixel, Rig};
use emberfix_frames::{
    Coordinate, Covariance, Ecef, Matrix3, Metres, MissionEnu, RigidBodyTransform, Vector3, Wgs84,
    ecef_from_enu, enu_from_ecef, rotation_matrix,
};
use nalgebra::{SMatrix, SVector};

/// The vehicle's reported motion about one shutter.
pub trait Motion {
    /// The pose that was reported for `later_s` seconds after the view's own moment (negative:
    /// before); `None` where the telemetry says nothing.
    fn at(&self, later_s: f64) -> Option<Pose>;
}

impl<F: Fn(f64) -> Option<Pose>> Motion for F {
    fn at(&self, later_s: f64) -> Option<Pose> {
        self(later_s)
    }
}

/// Where this moment's image was really looked at.
pub trait Scrutiny {
    /// Whether a thing of this many pixels (its longer side, raw) would have been noticed there.
    fn would_show(&self, pixel: RectifiedPixel, size_px: f64) -> bool;
}

impl<F: Fn(RectifiedPixel, f64) -> bool> Scrutiny for F {
    fn would_show(&self, pixel: RectifiedPixel, size_px: f64) -> bool {
        self(pixel, size_px)
    }
}

/// One camera at one moment, in the plane at the mission datum: everything as it was reported.
#[derive(Clone)]
pub struct View<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// The pose as reported.
    pub pose: &'a Pose,
    /// Optical centre of the left camera, mission plane, metres.
    pub camera_enu: Vector3<f64>,
    /// Takes rectified left camera components to mission-plane components.
    pub enu_from_cam: Matrix3<f64>,
    priors: SharedPriors,
    sigmas: SVector<f64, SHARED>,
    mission_from_ecef: RigidBodyTransform<Ecef, MissionEnu>,
    up: Vector3<f64>,
    motion: Option<&'a dyn Motion>,
    scrutiny: Option<&'a dyn Scrutiny>,
    reported: Lens,
}

/// So near to a shutter that the vehicle goes straight on, seconds.
const SURELY_STRAIGHT_S: f64 = 0.025;

impl<'a> View<'a> {
    /// The view of `rig` at `pose`, in the plane whose origin is `datum`. The vehicle is taken to
    /// go straight on, and turn on, about this moment, until [`View::with_motion`] knows better.
    #[must_use]
    pub fn new(rig: &'a Rig, pose: &'a Pose, priors: &SharedPriors, datum: &Wgs84) -> Self {
        let mission_from_ecef = enu_from_ecef::<MissionEnu>(datum);
        let up_rotation = ecef_from_enu::<emberfix_frames::VehicleEnu>(&pose.place).rotation()
            * mission_from_ecef.rotation();
        let up = rotation_matrix(&up_rotation) * Vector3::z();
        let sigmas = priors.sigmas(pose, rig);
        let optics = Optics::of(rig);
        let station = station(pose, &mission_from_ecef);
        let corrected = Corrected::new(&station, &optics, &up, &SVector::zeros());
        let clock = ClockSlope::straight_on(&station, pose, &corrected);
        let reported = corrected.lens(&optics, &up, &sigmas, &clock, 0.0);
        Self {
            rig,
            pose,
            camera_enu: reported.centre,
            enu_from_cam: reported.enu_from_cam,
            priors: *priors,
            sigmas,
            mission_from_ecef,
            up,
            motion: None,
            scrutiny: None,
            reported,
        }
    }

    /// The same view, knowing what was reported for the moments about it.
    #[must_use]
    pub fn with_motion(mut self, motion: &'a dyn Motion) -> Self {
        self.motion = Some(motion);
        self
    }

    /// The same view, knowing which parts of the image were passed over.
    #[must_use]
    pub fn with_scrutiny(mut self, scrutiny: &'a dyn Scrutiny) -> Self {
        self.scrutiny = Some(scrutiny);
        self
    }

    /// Whether a thing of this many pixels would have been noticed there; all would, until
    /// [`View::with_scrutiny`] knows better.
    #[must_use]
    pub fn would_show(&self, pixel: RectifiedPixel, size_px: f64) -> bool {
        self.scrutiny
            .is_none_or(|scrutiny| scrutiny.would_show(pixel, size_px))
    }

    /// What is known beforehand of the shared errors.
    #[must_use]
    pub fn priors(&self) -> &SharedPriors {
        &self.priors
    }

    /// Prior sigmas of the shared errors at this moment, in the order of [`Shared`].
    #[must_use]
    pub fn sigmas(&self) -> &SVector<f64, SHARED> {
        &self.sigmas
    }

    /// Local vertical at the vehicle, mission plane.
    #[must_use]
    pub fn up(&self) -> &Vector3<f64> {
        &self.up
    }

    /// Body origin as reported, mission plane, metres.
    #[must_use]
    pub fn body_enu(&self) -> Vector3<f64> {
        let body = Coordinate::<Ecef>::from_wgs84(&self.pose.place);
        self.mission_from_ecef.transform(body).metres()
    }

    /// A point of the mission plane on the Earth; `None` when it is nowhere near its surface.
    #[must_use]
    pub fn place(&self, point: &Coordinate<MissionEnu>) -> Option<Wgs84> {
        emberfix_frames::place_from_ecef(&self.mission_from_ecef.inverse_transform(*point))
    }

    /// Unit vector of a pixel's ray in the mission plane.
    #[must_use]
    pub fn ray_enu(&self, pixel: RectifiedPixel) -> Vector3<f64> {
        self.enu_from_cam * self.rig.ray(pixel).metres().normalize()
    }

    /// Slant range of a pixel at a depth along the boresight, metres.
    #[must_use]
    pub fn slant(&self, pixel: RectifiedPixel, depth_m: f64) -> f64 {
        self.rig.ray(pixel).metres().norm() * depth_m
    }

    /// Range along `ray` at which it passes beneath `point` (see [`range_beneath`]).
    #[must_use]
    pub fn range_beneath(&self, point: &Vector3<f64>, ray: &Vector3<f64>) -> Option<f64> {
        range_beneath(&(point - self.camera_enu), ray, &self.up)
    }

    /// Error across the ray at a range, from pixels.
    #[must_use]
    pub fn across_covariance(
        &self,
        ray: &Vector3<f64>,
        range_m: f64,
        (sigma_u, sigma_v): (f64, f64),
    ) -> Covariance<MissionEnu> {
        let focal = self.rig.rectification().focal_px();
        let (right, down) = (self.enu_from_cam.column(0), self.enu_from_cam.column(1));
        let flat = |axis: Vector3<f64>| (axis - ray * axis.dot(ray)) * range_m;
        let jacobian = SMatrix::<f64, 3, 2>::from_columns(&[
            flat(right.into_owned()),
            flat(down.into_owned()),
        ]);
        let sigmas = SVector::<f64, 2>::new(sigma_u / focal, sigma_v / focal);
        Covariance::from_sources(&jacobian, &sigmas)
    }

    /// What the shared errors and those of this frame do to a point that was placed along its ray
    /// at a known range. The disparity offset is not in it: it counts as far as stereo was used.
    #[must_use]
    pub fn shared_covariance(&self, point: &Vector3<f64>) -> Covariance<MissionEnu> {
        let by_shared = self.reported.carried_by_shared(point);
        Covariance::from_sources(&by_shared, &SVector::repeat(1.0))
    }

    /// What the camera should see of a point of the mission plane, if everything were as reported;
    /// `None` behind the camera.
    #[must_use]
    pub fn predict(&self, point: &Vector3<f64>) -> Option<Predicted> {
        self.reported.predict(&Distant::near(*point))
    }

    /// The camera as reported.
    #[must_use]
    pub fn reported(&self) -> &Lens {
        &self.reported
    }

    /// This shutter to be kept, where the clock error may lie: at `clock` of its sigmas, known to
    /// `clock_sigma` of them.
    #[must_use]
    pub fn shot(&self, clock: f64, clock_sigma: f64) -> Shot {
        Shot::new(
            self.reported.optics,
            self.up,
            self.sigmas,
            (clock, clock_sigma),
            |later_s| self.station_at(later_s),
        )
    }

    /// The camera with the `shared` errors taken out (see [`Shot::lens`]).
    #[must_use]
    pub fn lens(&self, shared: &SVector<f64, SHARED>, clock_sigma: f64) -> Lens {
        self.shot(shared[Shared::Clock as usize], clock_sigma)
            .lens(shared, clock_sigma)
    }

    /// Where the body was at another moment, and whether that was reported or is straight on.
    fn station_at(&self, later_s: f64) -> (Station, bool) {
        match self.motion.and_then(|motion| motion.at(later_s)) {
            Some(pose) => (station(&pose, &self.mission_from_ecef), true),
            None => {
                let here = station(self.pose, &self.mission_from_ecef);
                (
                    here.straight_on(self.pose, later_s),
                    later_s.abs() < SURELY_STRAIGHT_S,
                )
            }
        }
    }
}

impl std::fmt::Debug for View<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("View")
            .field("pose", self.pose)
            .field("camera_enu", &self.camera_enu)
            .field("knows_motion", &self.motion.is_some())
            .finish_non_exhaustive()
    }
}

/// Range along `ray` at which it passes beneath a point `to_point` away: the plane through the
/// point that contains the vertical and faces the camera. `None` when the ray runs along it.
#[must_use]
pub fn range_beneath(
    to_point: &Vector3<f64>,
    ray: &Vector3<f64>,
    up: &Vector3<f64>,
) -> Option<f64> {
    let horizontal = |v: &Vector3<f64>| v - up * v.dot(up);
    let (flat_point, flat_ray) = (horizontal(to_point), horizontal(ray));
    let facing = flat_point.norm();
    if facing < 1e-3 * to_point.norm() {
        // Straight beneath: the vertical plane is no help, the height is.
        return Some(to_point.norm());
    }
    let along = flat_ray.dot(&flat_point) / facing;
    (along > 0.02).then(|| facing / along)
}
