//! How wrong the autopilot's sensors are, as functions of time.

use crate::noise::{GaussMarkov, normal, stream};
use nalgebra::{Rotation3, Vector3};
use serde::Deserialize;

/// `[sim.errors]`: one-sigma errors of a consumer autopilot.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ErrorsConfig {
    /// True: no sensor errs. Transport still takes its time.
    pub off: bool,
    /// Slow GNSS offset per horizontal axis, metres.
    pub gnss_horizontal_sigma_m: f64,
    /// Slow GNSS offset upwards, metres.
    pub gnss_vertical_sigma_m: f64,
    /// White part of every position, metres per axis.
    pub gnss_white_sigma_m: f64,
    /// White part of every velocity, m/s per axis.
    pub velocity_sigma_m_s: f64,
    /// Heading error that stays (magnetic deviation, declination), degrees.
    pub heading_constant_sigma_deg: f64,
    /// Heading error that wanders, degrees.
    pub heading_slow_sigma_deg: f64,
    /// Roll and pitch error that wanders, degrees per axis.
    pub tilt_sigma_deg: f64,
    /// Correlation time of everything slow, seconds.
    pub correlation_s: f64,
    /// From measuring to the message's arrival, at least, seconds.
    pub message_latency_s: f64,
    /// At most this much more, seconds.
    pub message_jitter_s: f64,
    /// Stamp of the camera minus what the rig file promises, seconds.
    pub camera_offset_s: f64,
    /// Sigma of the camera's stamp, seconds.
    pub camera_jitter_s: f64,
}

impl Default for ErrorsConfig {
    fn default() -> Self {
        Self {
            off: false,
            gnss_horizontal_sigma_m: 1.5,
            gnss_vertical_sigma_m: 2.5,
            gnss_white_sigma_m: 0.03,
            velocity_sigma_m_s: 0.05,
            heading_constant_sigma_deg: 1.2,
            heading_slow_sigma_deg: 0.7,
            tilt_sigma_deg: 0.4,
            correlation_s: 90.0,
            message_latency_s: 0.001,
            message_jitter_s: 0.004,
            camera_offset_s: 0.0,
            camera_jitter_s: 0.000_5,
        }
    }
}

impl ErrorsConfig {
    /// The same transport with sensors that do not err.
    #[must_use]
    pub fn sensors_off(&self) -> Self {
        Self {
            off: true,
            gnss_horizontal_sigma_m: 0.0,
            gnss_vertical_sigma_m: 0.0,
            gnss_white_sigma_m: 0.0,
            velocity_sigma_m_s: 0.0,
            heading_constant_sigma_deg: 0.0,
            heading_slow_sigma_deg: 0.0,
            tilt_sigma_deg: 0.0,
            camera_offset_s: 0.0,
            camera_jitter_s: 0.0,
            ..self.clone()
        }
    }
}

/// The errors of one flight.
#[derive(Debug, Clone)]
pub struct SensorErrors {
    gnss: [GaussMarkov; 3],
    heading_constant_rad: f64,
    heading: GaussMarkov,
    tilt: [GaussMarkov; 2],
}

impl SensorErrors {
    /// Draws the errors of a flight.
    #[must_use]
    pub fn new(config: &ErrorsConfig, seed: u64, duration_s: f64) -> Self {
        let config = if config.off {
            config.sensors_off()
        } else {
            config.clone()
        };
        let mut rng = stream(seed, "sensor errors");
        let horizontal = config.gnss_horizontal_sigma_m;
        let sigmas_m = [horizontal, horizontal, config.gnss_vertical_sigma_m];
        let mut slow = |sigma| GaussMarkov::new(&mut rng, sigma, config.correlation_s, duration_s);
        let gnss = sigmas_m.map(&mut slow);
        let heading = slow(config.heading_slow_sigma_deg.to_radians());
        let tilt = [config.tilt_sigma_deg.to_radians(); 2].map(&mut slow);
        let heading_constant_rad =
            config.heading_constant_sigma_deg.to_radians() * normal(&mut rng);
        Self {
            gnss,
            heading_constant_rad,
            heading,
            tilt,
        }
    }

    /// Believed minus true position: east, north, up, metres.
    #[must_use]
    pub fn position_m(&self, t_s: f64) -> Vector3<f64> {
        Vector3::from_fn(|axis, _| self.gnss[axis].at(t_s))
    }

    /// Believed minus true heading, radians clockwise.
    #[must_use]
    pub fn heading_rad(&self, t_s: f64) -> f64 {
        self.heading_constant_rad + self.heading.at(t_s)
    }

    /// Takes true north, east, down components of a body vector to believed ones: tilt about the
    /// level axes, then heading about down.
    #[must_use]
    pub fn attitude(&self, t_s: f64) -> Rotation3<f64> {
        let tilt = Vector3::new(self.tilt[0].at(t_s), self.tilt[1].at(t_s), 0.0);
        Rotation3::from_axis_angle(&Vector3::z_axis(), self.heading_rad(t_s))
            * Rotation3::from_scaled_axis(tilt)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RUNS: u32 = 3000;

    fn sigma_over_runs(value: impl Fn(&SensorErrors) -> f64) -> f64 {
        let config = ErrorsConfig::default();
        let squares: f64 = (0..RUNS)
            .map(|run| value(&SensorErrors::new(&config, u64::from(run), 60.0)).powi(2))
            .sum();
        (squares / f64::from(RUNS)).sqrt()
    }

    #[test]
    fn sensors_err_by_the_stated_sigmas() {
        // 5 %: standard error of a sigma from 3000 draws is 1.3 %, and the smooth join of the grid
        // takes up to 2.5 %.
        let close = |found: f64, stated: f64| (found / stated - 1.0).abs() < 0.05;
        for axis in 0..3 {
            let stated = [1.5, 1.5, 2.5][axis];
            let found = sigma_over_runs(|errors| errors.position_m(30.0)[axis]);
            assert!(
                close(found, stated),
                "axis {axis}: {found} m, stated {stated} m"
            );
        }
        let heading = sigma_over_runs(|errors| errors.heading_rad(30.0).to_degrees());
        assert!(
            close(heading, 1.2_f64.hypot(0.7)),
            "heading {heading} degrees"
        );
        let tilt = sigma_over_runs(|errors| errors.tilt[0].at(30.0).to_degrees());
        assert!(close(tilt, 0.4), "tilt {tilt} degrees");
    }

    #[test]
    fn a_gnss_offset_stays_through_a_pass_over_the_fire() {
        let config = ErrorsConfig::default();
        let moved: f64 = (0..500)
            .map(|run| SensorErrors::new(&config, run, 60.0))
            .map(|errors| (errors.position_m(25.0) - errors.position_m(20.0)).norm())
            .sum::<f64>()
            / 500.0;
        // White noise of these sigmas would move by 4.3 m on average.
        assert!(moved < 1.6, "moved {moved} m in 5 s");
    }

    #[test]
    fn errors_off_is_exact() {
        let config = ErrorsConfig {
            off: true,
            ..ErrorsConfig::default()
        };
        let errors = SensorErrors::new(&config, 9, 60.0);
        assert_eq!(errors.position_m(11.0), Vector3::zeros());
        assert_eq!(errors.attitude(11.0).angle(), 0.0);
    }

    #[test]
    fn a_positive_heading_error_turns_the_believed_nose_clockwise() {
        let mut errors = SensorErrors::new(&ErrorsConfig::default().sensors_off(), 1, 10.0);
        errors.heading_constant_rad = 0.1;
        let north_nose_believed = errors.attitude(5.0) * Vector3::x();
        assert!(
            north_nose_believed.y > 0.09,
            "towards east: {north_nose_believed}"
        );
    }
}
