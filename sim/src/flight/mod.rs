//! Where the aircraft flies.
//!
//! **In:** `[sim.flight]` and the ground's height. **Out:** [`Flight::state`], a smooth function of
//! time: position in the east-north-up plane at the datum (metres), attitude, velocity, body rates.
//! **Assumptions.** A multirotor: the rotors' thrust points along body up, so the airframe banks and
//! pitches with its acceleration and against its drag. **Known limits.** Gusts turn the airframe but
//! do not push it off its path.

mod gusts;
mod path;

pub use gusts::GustConfig;
pub use path::{Nose, PathConfig};

use crate::state::BodyState;
use gusts::Gusts;
use nalgebra::{Matrix3, Rotation3, Vector3};
use path::Path;
use serde::Deserialize;

/// `[sim.flight]`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightConfig {
    /// Length of the flight, seconds.
    pub duration_s: f64,
    /// The way through the air.
    pub path: PathConfig,
    /// How rough the air is.
    #[serde(default)]
    pub gusts: GustConfig,
}

/// A flight: a path, and air that shakes it.
#[derive(Debug, Clone)]
pub struct Flight {
    duration_s: f64,
    path: Path,
    gusts: Gusts,
}

const GRAVITY_M_S2: f64 = 9.80665;
/// Deceleration by drag per speed; 6 m/s cost about 2 degrees of pitch.
const DRAG_PER_S: f64 = 0.05;
/// Steps of the numerical derivatives: far above rounding, far below the path's own time scale.
const PATH_STEP_S: f64 = 0.01;
/// The rates must follow vibration of up to 80 Hz.
const RATE_STEP_S: f64 = 0.000_5;

impl Flight {
    /// The flight that `config` asks for over a ground whose height is `ground_up_m(east, north)`.
    #[must_use]
    pub fn new(config: &FlightConfig, seed: u64, ground_up_m: impl Fn(f64, f64) -> f64) -> Self {
        Self {
            duration_s: config.duration_s,
            path: Path::new(&config.path, ground_up_m),
            gusts: Gusts::new(&config.gusts, seed, config.duration_s),
        }
    }

    /// Length of the flight, seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// Where the aircraft truly is `t_s` seconds after the start.
    #[must_use]
    pub fn state(&self, t_s: f64) -> BodyState {
        BodyState {
            t_s,
            position_m: self.path.position_m(t_s),
            enu_from_body: self.enu_from_body(t_s).into_inner(),
            velocity_m_s: self.velocity_m_s(t_s),
            rate_rad_s: self.rate_rad_s(t_s),
        }
    }

    fn velocity_m_s(&self, t_s: f64) -> Vector3<f64> {
        let at = |t| self.path.position_m(t);
        (at(t_s + PATH_STEP_S) - at(t_s - PATH_STEP_S)) / (2.0 * PATH_STEP_S)
    }

    fn acceleration_m_s2(&self, t_s: f64) -> Vector3<f64> {
        let at = |t| self.path.position_m(t);
        (at(t_s + PATH_STEP_S) - 2.0 * at(t_s) + at(t_s - PATH_STEP_S)) / PATH_STEP_S.powi(2)
    }

    fn rate_rad_s(&self, t_s: f64) -> Vector3<f64> {
        let before = self.enu_from_body(t_s - RATE_STEP_S);
        let after = self.enu_from_body(t_s + RATE_STEP_S);
        (before.inverse() * after).scaled_axis() / (2.0 * RATE_STEP_S)
    }

    fn enu_from_body(&self, t_s: f64) -> Rotation3<f64> {
        let velocity = self.velocity_m_s(t_s);
        let thrust = self.acceleration_m_s2(t_s)
            + Vector3::new(velocity.x, velocity.y, 0.0) * DRAG_PER_S
            + Vector3::z() * GRAVITY_M_S2;
        let nose = self.path.nose(t_s, velocity);
        calm_attitude(thrust, nose) * self.gusts.turn(t_s)
    }
}

/// Body up along the thrust, nose as near to `nose` as that leaves.
fn calm_attitude(thrust: Vector3<f64>, nose: Vector3<f64>) -> Rotation3<f64> {
    let down = -thrust.normalize();
    let right = down.cross(&nose).normalize();
    let forward = right.cross(&down);
    Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[forward, right, down]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn orbit(nose: Nose) -> Flight {
        let config = FlightConfig {
            duration_s: 60.0,
            path: PathConfig::Orbit {
                centre_m: [10.0, -5.0],
                radius_m: 80.0,
                height_above_ground_m: 60.0,
                speed_m_s: 9.0,
                start_azimuth_deg: 0.0,
                clockwise: true,
                nose,
            },
            gusts: GustConfig::calm(),
        };
        Flight::new(&config, 1, |_, _| 12.0)
    }

    #[test]
    fn an_orbit_keeps_radius_height_and_speed_and_looks_to_its_centre() {
        let flight = orbit(Nose::Centre);
        for t_s in [0.0, 7.3, 31.0, 60.0] {
            let state = flight.state(t_s);
            let out = state.position_m - Vector3::new(10.0, -5.0, 72.0);
            assert!(
                (out.norm() - 80.0).abs() < 1e-9 && out.z.abs() < 1e-9,
                "{out}"
            );
            // 1e-4: the central difference shortens the chord by (omega h)^2 / 6.
            assert!((state.velocity_m_s.norm() - 9.0).abs() < 1e-4);
            let mut nose = state.enu_from_body.column(0).into_owned();
            nose.z = 0.0;
            assert!(nose.normalize().dot(&-out.normalize()) > 0.999);
        }
    }

    #[test]
    fn a_clockwise_orbit_from_its_north_goes_east_and_banks_right() {
        let state = orbit(Nose::Course).state(0.0);
        assert!(state.velocity_m_s.x > 8.9, "{}", state.velocity_m_s);
        // tan(bank) = v^2 / (g R) = 0.1032: 5.9 degrees right wing down.
        let bank = state.enu_from_body[(2, 1)].asin().to_degrees();
        assert!(
            (-6.2..-5.6).contains(&bank),
            "right wing rises by {bank} degrees"
        );
        assert!(state.enu_from_body.column(0).x > 0.99, "the nose is east");
        assert!(state.enu_from_body[(2, 2)] < 0.0, "body down is down");
    }

    #[test]
    fn rates_and_velocity_are_the_derivatives_of_the_state() {
        let mut config = crate::mission::tests::waypoint_flight();
        config.gusts = GustConfig::default();
        let flight = Flight::new(&config, 7, |_, _| 0.0);
        let dt = 1e-4;
        for step in 1..40 {
            let t_s = f64::from(step) * 0.9;
            let (now, next) = (flight.state(t_s), flight.state(t_s + dt));
            let moved = (next.position_m - now.position_m) / dt;
            // 1e-2 m/s: the path's second derivative over the step.
            assert!((moved - now.velocity_m_s).norm() < 1e-2);
            let turn = Rotation3::from_matrix_unchecked(
                now.enu_from_body.transpose() * next.enu_from_body,
            );
            // 0.02 rad/s: vibration turns by up to 0.1 rad/s within its period.
            assert!((turn.scaled_axis() / dt - now.rate_rad_s).norm() < 0.02);
        }
    }

    #[test]
    fn attitude_stays_a_right_handed_rotation() {
        let flight = Flight::new(&crate::mission::tests::waypoint_flight(), 3, |_, _| 0.0);
        for step in 0..60 {
            let rotation = flight.state(f64::from(step)).enu_from_body;
            assert!((rotation.transpose() * rotation - Matrix3::identity()).norm() < 1e-9);
            assert!((rotation.determinant() - 1.0).abs() < 1e-9);
        }
    }
}
