//! A spectrometer beside the cameras: the flames' sodium and potassium lines on a continuum of soot
//! and daylight, in step with the frames.
//!
//! **Out:** JSON `{"wavelengths_nm": [..], "intensity": [..]}` as the contract has it. The lines' light
//! goes with a flame's face, its flicker and the inverse square of its range; the instrument sees all
//! flames of the world at once. **Known limits.** Nothing hides a flame, and smoke dims nothing.

use crate::noise::{normal, stream};
use crate::world::World;
use nalgebra::Vector3;
use serde::Deserialize;

/// `[sim.spectrometer]`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpectrometerConfig {
    /// One sigma of noise of each value; a flame of one square metre in ten metres has lines of 100.
    pub noise: f64,
    /// Seconds of flight after which it gives nothing more.
    pub dies_at_s: f64,
}

impl Default for SpectrometerConfig {
    fn default() -> Self {
        Self {
            noise: 0.5,
            dies_at_s: f64::INFINITY,
        }
    }
}

/// First wavelength, step and number of values.
const FIRST_NM: f64 = 500.0;
const STEP_NM: f64 = 0.5;
const VALUES: u32 = 640;
/// Middle in nm and share of the light of each line; about 2 nm wide in the instrument.
const LINES: [(f64, f64); 3] = [(589.3, 1.0), (766.5, 0.7), (769.9, 0.4)];
const LINE_SIGMA_NM: f64 = 0.9;
/// Lines of a flame of 1 m² in 1 m range.
const LIGHT: f64 = 1e4;

/// One reading in flight, as JSON; `None` when the instrument is dead.
#[must_use]
pub fn reading(
    config: &SpectrometerConfig,
    world: &World,
    from_m: &Vector3<f64>,
    t_s: f64,
    seed: u64,
) -> Option<Vec<u8>> {
    if t_s >= config.dies_at_s {
        return None;
    }
    let light = LIGHT * world.flame_light(from_m, t_s);
    let mut rng = stream(seed, &format!("spectrometer {t_s}"));
    let wavelengths: Vec<f64> = (0..VALUES)
        .map(|k| FIRST_NM + STEP_NM * f64::from(k))
        .collect();
    let intensity: Vec<f64> = wavelengths
        .iter()
        .map(|nm| {
            let lines = LINES
                .iter()
                .map(|(at, share)| share * (-0.5 * ((nm - at) / LINE_SIGMA_NM).powi(2)).exp());
            let soot = 0.05 * light * (nm / 700.0).powi(4);
            let daylight = 40.0 * (1.3 - nm / 1000.0);
            light * lines.sum::<f64>() + soot + daylight + config.noise * normal(&mut rng)
        })
        .collect();
    let reading = serde_json::json!({"wavelengths_nm": wavelengths, "intensity": intensity});
    serde_json::to_vec(&reading).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{FireConfig, WorldConfig};

    #[test]
    fn lines_stand_out_and_fall_with_the_range() {
        let fire = FireConfig {
            name: "a".to_owned(),
            east_m: 0.0,
            north_m: 0.0,
            width_m: 1.0,
            height_m: 1.5,
            smoke: false,
            ignites_at_s: 0.0,
            growth_m_s: 0.0,
        };
        let config = WorldConfig {
            fires: vec![fire],
            ..WorldConfig::default()
        };
        let world = World::new(&config, 1).unwrap();
        let line = |range_m: f64| {
            let config = SpectrometerConfig::default();
            let from = Vector3::new(0.0, range_m, 0.0);
            let bytes = reading(&config, &world, &from, 2.0, 1).unwrap();
            let value: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
            let at = |nm: f64| value["intensity"][((nm - FIRST_NM) / STEP_NM) as usize].as_f64();
            at(589.5).unwrap() - (at(580.0).unwrap() + at(600.0).unwrap()) / 2.0
        };
        assert!(line(10.0) > 30.0, "{}", line(10.0));
        let ratio = line(10.0) / line(20.0);
        assert!((3.3..4.8).contains(&ratio), "{ratio}");
        let dead = SpectrometerConfig {
            dies_at_s: 1.0,
            ..SpectrometerConfig::default()
        };
        assert_eq!(reading(&dead, &world, &Vector3::zeros(), 2.0, 1), None);
    }
}
