//! The measurement model: what the left camera sees of a point, and how each error moves it.

use crate::pose::Pose;
use emberfix_calib::{RectifiedPixel, Rig};
use emberfix_frames::{
    BodyFrd, CamLeft, Coordinate, Covariance, Ecef, Matrix3, Metres, MissionEnu,
    RigidBodyTransform, Rotation, Vector3, Wgs84, ecef_from_enu, enu_from_ecef, rotation_matrix,
};
use nalgebra::{SMatrix, SVector};

/// Number of shared errors.
pub const SHARED: usize = 9;

/// Index of each error that stays the same from frame to frame, in the shared error vector.
///
/// Signs: the value is what must be ADDED to the truth to get what was reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(usize)]
pub enum Shared {
    /// GNSS offset to the east, metres (north and up follow).
    GnssEast = 0,
    /// Heading, radians clockwise.
    Heading = 3,
    /// Rotation of the camera against the attitude reference about body axes (roll; pitch and yaw
    /// follow), radians: tilt error of the autopilot and boresight error together.
    BodyRoll = 4,
    /// Disparity offset, pixels.
    Disparity = 7,
    /// Camera clock late against the autopilot's, seconds.
    Clock = 8,
}

/// One-sigma priors of the shared errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SharedSigmas {
    /// Heading of the autopilot, radians.
    pub heading_rad: f64,
    /// Tilt of the autopilot, radians per axis.
    pub tilt_rad: f64,
}

impl SharedSigmas {
    /// Prior sigmas in the order of [`Shared`], for one pose and rig.
    #[must_use]
    pub fn vector(&self, pose: &Pose, rig: &Rig) -> SVector<f64, SHARED> {
        let rig_sigmas = rig.sigmas();
        let tilt = self.tilt_rad.hypot(rig_sigmas.boresight_rad);
        let clock = pose.time_sigma_s.hypot(rig_sigmas.time_offset_s);
        SVector::from([
            pose.gnss_horizontal_m,
            pose.gnss_horizontal_m,
            pose.gnss_vertical_m,
            self.heading_rad,
            tilt,
            tilt,
            rig_sigmas.boresight_rad,
            rig_sigmas.disparity_bias_px,
            clock,
        ])
    }
}

/// One camera at one moment: the pose as reported, in the plane at the mission datum.
#[derive(Debug, Clone)]
pub struct View<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// The pose as reported.
    pub pose: &'a Pose,
    /// Optical centre of the left camera, mission plane, metres.
    pub camera_enu: Vector3<f64>,
    /// Takes rectified left camera components to mission-plane components.
    pub enu_from_cam: Matrix3<f64>,
    enu_from_body: Matrix3<f64>,
    shared_sigmas: SVector<f64, SHARED>,
    mission_from_ecef: RigidBodyTransform<Ecef, MissionEnu>,
    up: Vector3<f64>,
}

/// What the camera is predicted to see of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Predicted {
    /// Pixel in the rectified left image.
    pub pixel: RectifiedPixel,
    /// Depth along the boresight, metres.
    pub depth_m: f64,
    /// Pixel (column, row) over the point's position, px/m.
    pub by_position: SMatrix<f64, 2, 3>,
    /// Pixel over the shared errors.
    pub by_shared: SMatrix<f64, 2, SHARED>,
    /// Disparity, rectified pixels.
    pub disparity_px: f64,
    /// Disparity over the point's position, px/m.
    pub disparity_by_position: SMatrix<f64, 1, 3>,
    /// Disparity over the shared errors.
    pub disparity_by_shared: SMatrix<f64, 1, SHARED>,
}

impl<'a> View<'a> {
    /// The view of `rig` at `pose`, in the plane whose origin is `datum`.
    #[must_use]
    pub fn new(rig: &'a Rig, pose: &'a Pose, sigmas: &SharedSigmas, datum: &Wgs84) -> Self {
        let mission_from_ecef = enu_from_ecef::<MissionEnu>(datum);
        // Body to the vehicle's own plane to ECEF to the mission's plane: a rotation, typed.
        let vehicle_from_body = pose.attitude.enu_from_body();
        let ecef_from_vehicle = ecef_from_enu(&pose.place);
        let to_mission: Rotation<BodyFrd, MissionEnu> =
            vehicle_from_body * ecef_from_vehicle.rotation() * mission_from_ecef.rotation();
        let cam_to_mission: Rotation<CamLeft, MissionEnu> = rig.body_from_cam_left() * to_mission;
        let enu_from_body = rotation_matrix(&to_mission);
        let body_enu = mission_from_ecef.transform(Coordinate::<Ecef>::from_wgs84(&pose.place));
        let up_at_vehicle =
            rotation_matrix(&(ecef_from_vehicle.rotation() * mission_from_ecef.rotation()))
                * Vector3::z();
        Self {
            rig,
            pose,
            camera_enu: body_enu.metres() + enu_from_body * rig.lever_arm().metres(),
            enu_from_cam: rotation_matrix(&cam_to_mission),
            enu_from_body,
            shared_sigmas: sigmas.vector(pose, rig),
            mission_from_ecef,
            up: up_at_vehicle,
        }
    }

    /// Prior sigmas of the shared errors at this moment.
    #[must_use]
    pub fn shared_sigmas(&self) -> &SVector<f64, SHARED> {
        &self.shared_sigmas
    }

    /// Local vertical at the vehicle, mission plane.
    #[must_use]
    pub fn up(&self) -> &Vector3<f64> {
        &self.up
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

    /// Range along `ray` at which it passes beneath `point`: the plane through `point` that
    /// contains the vertical and faces the camera. `None` when the ray runs along that plane.
    #[must_use]
    pub fn range_beneath(&self, point: &Vector3<f64>, ray: &Vector3<f64>) -> Option<f64> {
        let horizontal = |v: &Vector3<f64>| v - self.up * v.dot(&self.up);
        let to_point = point - self.camera_enu;
        let (flat_point, flat_ray) = (horizontal(&to_point), horizontal(ray));
        let facing = flat_point.norm();
        if facing < 1e-3 * to_point.norm() {
            // Straight beneath: the vertical plane is no help, the height is.
            return Some(to_point.norm());
        }
        let along = flat_ray.dot(&flat_point) / facing;
        (along > 0.02).then(|| facing / along)
    }

    /// Error across the ray at a range, from pixels and what is new in each frame.
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
        let noise = self.pose.attitude_noise_rad;
        let sigmas = SVector::<f64, 2>::new(
            (sigma_u / focal).hypot(noise),
            (sigma_v / focal).hypot(noise),
        );
        let p = self.pose.position_noise_m;
        Covariance::from_sources(&jacobian, &sigmas) + Covariance::from_sigmas_m(p, p, p)
    }

    /// How the shared errors move a point that was placed along its ray: metres per unit.
    #[must_use]
    pub fn position_by_shared(&self, point: &Vector3<f64>) -> SMatrix<f64, 3, SHARED> {
        // Along the ray the point is held by its range, so each angle moves it across: by the
        // cross product with the line of sight; GNSS moves it as it moves the camera.
        let sight = point - self.camera_enu;
        let mut by = SMatrix::<f64, 3, SHARED>::zeros();
        by.fixed_view_mut::<3, 3>(0, Shared::GnssEast as usize)
            .copy_from(&Matrix3::identity());
        let heading_axis = -self.up;
        by.set_column(Shared::Heading as usize, &heading_axis.cross(&sight));
        for axis in 0..3 {
            let about = self.enu_from_body.column(axis).into_owned();
            by.set_column(Shared::BodyRoll as usize + axis, &about.cross(&sight));
        }
        let rate = self.enu_from_body * self.pose.rate_rad_s;
        // Reported pose is that of `clock` seconds later than the exposure.
        by.set_column(
            Shared::Clock as usize,
            &(self.pose.velocity_enu_m_s + rate.cross(&sight)),
        );
        by.set_column(Shared::Disparity as usize, &self.point_by_disparity(&sight));
        by
    }

    /// A positive disparity error brings a point nearer along its line of sight.
    fn point_by_disparity(&self, sight: &Vector3<f64>) -> Vector3<f64> {
        let depth = self.enu_from_cam.column(2).dot(sight);
        let focal = self.rig.rectification().focal_px();
        -sight * depth / (focal * self.rig.baseline_m())
    }

    /// The share of a fix's covariance that other looks of the same flight would repeat, without
    /// the disparity offset (which only counts as far as stereo was used).
    #[must_use]
    pub fn shared_covariance(&self, point: &Vector3<f64>) -> Covariance<MissionEnu> {
        let mut sigmas = self.shared_sigmas;
        sigmas[Shared::Disparity as usize] = 0.0;
        Covariance::from_sources(&self.position_by_shared(point), &sigmas)
    }

    /// What the camera should see of a point of the mission plane; `None` behind the camera.
    ///
    /// With `x = R' (p - c)` in camera components, pixel = f (x/z, y/z) + principal point, and
    /// disparity = f b / z + d_infinity. The shared errors enter through the REPORTED pose: if they
    /// carry the placed point by D, the true point is seen where the reported pose would see the
    /// point that lies D further.
    #[must_use]
    pub fn predict(&self, point: &Vector3<f64>) -> Option<Predicted> {
        let cam_from_enu = self.enu_from_cam.transpose();
        let x = cam_from_enu * (point - self.camera_enu);
        if x.z <= 0.1 {
            return None;
        }
        let rect = self.rig.rectification();
        let (focal, (cx, cy)) = (rect.focal_px(), rect.principal_point_px());
        #[rustfmt::skip]
        let pixel_by_x = SMatrix::<f64, 2, 3>::new(
            focal / x.z, 0.0, -focal * x.x / (x.z * x.z),
            0.0, focal / x.z, -focal * x.y / (x.z * x.z),
        );
        let disparity_by_x =
            SMatrix::<f64, 1, 3>::new(0.0, 0.0, -focal * self.rig.baseline_m() / (x.z * x.z));
        // The disparity offset adds to the disparity itself, not to where the point is seen.
        let mut moved = self.position_by_shared(point);
        moved.set_column(Shared::Disparity as usize, &Vector3::zeros());
        let x_by_shared = cam_from_enu * moved;
        let mut disparity_by_shared = disparity_by_x * x_by_shared;
        disparity_by_shared[Shared::Disparity as usize] = 1.0;
        Some(Predicted {
            pixel: RectifiedPixel {
                u: focal * x.x / x.z + cx,
                v: focal * x.y / x.z + cy,
            },
            depth_m: x.z,
            by_position: pixel_by_x * cam_from_enu,
            by_shared: pixel_by_x * x_by_shared,
            disparity_px: self.rig.disparity_px(x.z),
            disparity_by_position: disparity_by_x * cam_from_enu,
            disparity_by_shared,
        })
    }
}
