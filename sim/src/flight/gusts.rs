//! Air and motors that turn the airframe: slow gusts and fast vibration.

use crate::noise::{GaussMarkov, stream};
use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;

/// `[sim.flight.gusts]`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GustConfig {
    /// Sigma of the gusts' turn about each body axis, degrees.
    pub sigma_deg: f64,
    /// Correlation time of the gusts, seconds.
    pub correlation_s: f64,
    /// Amplitude of the vibration about each body axis, degrees.
    pub vibration_deg: f64,
}

impl Default for GustConfig {
    fn default() -> Self {
        Self {
            sigma_deg: 1.2,
            correlation_s: 1.5,
            vibration_deg: 0.02,
        }
    }
}

impl GustConfig {
    /// Air that does not move and motors without vibration.
    #[must_use]
    pub fn calm() -> Self {
        Self {
            sigma_deg: 0.0,
            correlation_s: 1.0,
            vibration_deg: 0.0,
        }
    }
}

/// Disturbance of the attitude as a smooth function of time.
#[derive(Debug, Clone)]
pub(super) struct Gusts {
    axes: [GaussMarkov; 3],
    vibration: [Tone; TONES],
}

#[derive(Debug, Clone, Copy)]
struct Tone {
    amplitude_rad: Vector3<f64>,
    rate_rad_s: f64,
    phase_rad: Vector3<f64>,
}

/// Rotor, twice rotor and frame, one each in the thirds of 20 to 80 Hz.
const TONES: usize = 3;

impl Gusts {
    pub(super) fn new(config: &GustConfig, seed: u64, duration_s: f64) -> Self {
        let mut rng = stream(seed, "gusts");
        let sigma_rad = config.sigma_deg.to_radians();
        let axes = std::array::from_fn(|_| {
            GaussMarkov::new(&mut rng, sigma_rad, config.correlation_s, duration_s)
        });
        let amplitude_rad = config.vibration_deg.to_radians() / TONES as f64;
        let vibration = std::array::from_fn(|third| tone(&mut rng, third, amplitude_rad));
        Self { axes, vibration }
    }

    /// What to turn the calm attitude by, about body axes.
    pub(super) fn turn(&self, t_s: f64) -> Rotation3<f64> {
        let gust = Vector3::from_fn(|axis, _| self.axes[axis].at(t_s));
        let shake: Vector3<f64> = self.vibration.iter().map(|tone| tone.at(t_s)).sum();
        Rotation3::from_scaled_axis(gust + shake)
    }
}

fn tone(rng: &mut ChaCha8Rng, third: usize, amplitude_rad: f64) -> Tone {
    let low_hz = 20.0 + 20.0 * third as f64;
    Tone {
        amplitude_rad: Vector3::from_fn(|_, _| amplitude_rad * rng.random_range(0.5..1.0)),
        rate_rad_s: std::f64::consts::TAU * rng.random_range(low_hz..low_hz + 20.0),
        phase_rad: Vector3::from_fn(|_, _| rng.random_range(0.0..std::f64::consts::TAU)),
    }
}

impl Tone {
    fn at(&self, t_s: f64) -> Vector3<f64> {
        self.phase_rad
            .map(|phase| (phase + self.rate_rad_s * t_s).sin())
            .component_mul(&self.amplitude_rad)
    }
}
