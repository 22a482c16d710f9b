//! What the autopilot believes: the truth, seen through its errors.

use super::{AutopilotConfig, ErrorsConfig, SensorErrors};
use crate::earth::{Lla, TangentPlane};
use crate::flight::Flight;
use crate::noise::normal;
use emberfix_frames::{Attitude, BootTime, EllipsoidHeight, MslAltitude, UnitQuaternion, Vector3};
use emberfix_mav::telemetry::{
    AttitudeSample, AttitudeSource, EstimatorFlags, EstimatorStatus, GlobalPosition, GnssFix,
    GnssPlace, GpsRaw, HomePosition, VehicleTime,
};
use nalgebra::{Matrix3, Rotation3};
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;

/// The autopilot's clock against flight time.
#[derive(Debug, Clone, Copy)]
pub(super) struct BootClock {
    booted_before_s: f64,
    rate: f64,
}

impl BootClock {
    pub(super) fn new(config: &AutopilotConfig) -> Self {
        Self {
            booted_before_s: config.booted_before_s,
            rate: 1.0 + config.clock_drift_ppm * 1e-6,
        }
    }

    pub(super) fn at(self, t_s: f64) -> BootTime {
        BootTime::from_ns(((self.booted_before_s + t_s * self.rate) * 1e9) as i64)
    }
}

/// Sensors and estimator, as functions of flight time.
#[derive(Debug, Clone)]
pub(super) struct Sensors {
    flight: Arc<Flight>,
    plane: TangentPlane,
    errors: SensorErrors,
    white: WhiteSigmas,
    stated: StatedSigmas,
    undulation_m: f64,
    home: Lla,
    pub(super) clock: BootClock,
}

#[derive(Debug, Clone, Copy)]
struct WhiteSigmas {
    position_m: f64,
    velocity_m_s: f64,
}

/// What the receiver says of its own quality.
#[derive(Debug, Clone, Copy)]
struct StatedSigmas {
    horizontal_m: f64,
    vertical_m: f64,
}

/// Millimetres on the wire: 0 would read as unknown.
const LEAST_STATED_SIGMA_M: f64 = 0.01;

impl Sensors {
    pub(super) fn new(
        flight: Arc<Flight>,
        datum: Lla,
        config: &AutopilotConfig,
        errors: &ErrorsConfig,
        seed: u64,
    ) -> Self {
        let errors = if errors.off {
            errors.sensors_off()
        } else {
            errors.clone()
        };
        let plane = TangentPlane::at(datum);
        let undulation_m = config.undulation_m.unwrap_or_else(|| {
            emberfix_frames::Geoid::new()
                .undulation(datum.latitude_deg, datum.longitude_deg)
                .m()
        });
        let start = flight.state(0.0).position_m;
        let white = WhiteSigmas {
            position_m: errors.gnss_white_sigma_m,
            velocity_m_s: errors.velocity_sigma_m_s,
        };
        let stated = StatedSigmas {
            horizontal_m: errors.gnss_horizontal_sigma_m.max(LEAST_STATED_SIGMA_M),
            vertical_m: errors.gnss_vertical_sigma_m.max(LEAST_STATED_SIGMA_M),
        };
        Self {
            errors: SensorErrors::new(&errors, seed, flight.duration_s()),
            plane,
            white,
            stated,
            undulation_m,
            home: plane.to_lla(Vector3::new(start.x, start.y, 0.0)),
            clock: BootClock::new(config),
            flight,
        }
    }

    pub(super) fn attitude(&self, t_s: f64) -> AttitudeSample {
        let state = self.flight.state(t_s);
        let here = self.plane.to_lla(state.position_m);
        let local = self.plane.local_from_here(here) * state.enu_from_body;
        let believed =
            self.errors.attitude(t_s) * Rotation3::from_matrix_unchecked(ned_from_enu() * local);
        let q = UnitQuaternion::from_rotation_matrix(&believed);
        AttitudeSample {
            boot: self.clock.at(t_s),
            attitude: attitude(q),
            rate_rad_s: state.rate_rad_s,
            source: AttitudeSource::Quaternion,
        }
    }

    pub(super) fn global_position(&self, t_s: f64, rng: &mut ChaCha8Rng) -> GlobalPosition {
        let place = self.believed_place(t_s, rng);
        let (_, _, heading) = self.attitude(t_s).attitude.angles();
        GlobalPosition {
            boot: self.clock.at(t_s),
            latitude_deg: place.latitude_deg,
            longitude_deg: place.longitude_deg,
            altitude: self.msl(place),
            above_home_m: place.height_m - self.home.height_m,
            velocity_ned_m_s: self.believed_velocity(t_s, rng),
            heading_rad: Some(heading.rem_euclid(std::f64::consts::TAU)),
        }
    }

    pub(super) fn gps_raw(&self, t_s: f64, rng: &mut ChaCha8Rng) -> GpsRaw {
        let place = self.believed_place(t_s, rng);
        let velocity = self.believed_velocity(t_s, rng);
        let course = velocity
            .y
            .atan2(velocity.x)
            .rem_euclid(std::f64::consts::TAU);
        GpsRaw {
            time: VehicleTime::Boot(self.clock.at(t_s)),
            fix: GnssFix::Fix3d,
            place: Some(GnssPlace {
                latitude_deg: place.latitude_deg,
                longitude_deg: place.longitude_deg,
                altitude: self.msl(place),
                height: Some(EllipsoidHeight::from_m(place.height_m)),
            }),
            horizontal_sigma_m: Some(self.stated.horizontal_m),
            vertical_sigma_m: Some(self.stated.vertical_m),
            ground_speed_m_s: Some(velocity.x.hypot(velocity.y)),
            course_rad: Some(course),
            satellites: Some(14),
        }
    }

    pub(super) fn estimator_status(&self, t_s: f64) -> EstimatorStatus {
        EstimatorStatus {
            time: VehicleTime::Boot(self.clock.at(t_s)),
            horizontal_sigma_m: Some(self.stated.horizontal_m),
            vertical_sigma_m: Some(self.stated.vertical_m),
            flags: EstimatorFlags::HEALTHY,
        }
    }

    pub(super) fn home(&self) -> HomePosition {
        HomePosition {
            latitude_deg: self.home.latitude_deg,
            longitude_deg: self.home.longitude_deg,
            altitude: self.msl(self.home),
        }
    }

    fn msl(&self, place: Lla) -> MslAltitude {
        MslAltitude::from_m(place.height_m - self.undulation_m)
    }

    fn believed_place(&self, t_s: f64, rng: &mut ChaCha8Rng) -> Lla {
        let white = Vector3::from_fn(|_, _| self.white.position_m * normal(rng));
        let truth = self.flight.state(t_s).position_m;
        self.plane
            .to_lla(truth + self.errors.position_m(t_s) + white)
    }

    fn believed_velocity(&self, t_s: f64, rng: &mut ChaCha8Rng) -> Vector3<f64> {
        let state = self.flight.state(t_s);
        let here = self.plane.to_lla(state.position_m);
        let local = self.plane.local_from_here(here) * state.velocity_m_s;
        let white = Vector3::from_fn(|_, _| self.white.velocity_m_s * normal(rng));
        ned_from_enu() * local + white
    }
}

#[rustfmt::skip]
fn ned_from_enu() -> Matrix3<f64> {
    Matrix3::new(
        0.0, 1.0, 0.0,
        1.0, 0.0, 0.0,
        0.0, 0.0, -1.0,
    )
}

/// A unit quaternion is never refused; level is what remains to say if it were.
fn attitude(q: UnitQuaternion<f64>) -> Attitude {
    Attitude::from_mavlink_quaternion([q.w, q.i, q.j, q.k])
        .unwrap_or_else(|_| Attitude::from_angles(0.0, 0.0, 0.0))
}
