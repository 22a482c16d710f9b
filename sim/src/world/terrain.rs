//! The ground's height as a sum of plane waves.

use super::config::TerrainConfig;
use nalgebra::{Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{FRAC_PI_2, TAU};

/// One plane wave of the ground.
#[derive(Debug, Clone, Copy)]
struct Wave {
    /// Radians per metre, east and north.
    wavenumber: Vector2<f64>,
    amplitude_m: f64,
    phase_rad: f64,
}

/// The ground's height over east and north, metres; smooth everywhere.
#[derive(Debug, Clone)]
pub(crate) struct Terrain {
    base_up_m: f64,
    waves: Vec<Wave>,
    amplitude_m: f64,
    /// Upper bound of the slope, metres per metre.
    steepest: f64,
}

/// Length of each wave against the longest, and its share of the amplitude.
const SPECTRUM: [(f64, f64); 5] = [
    (1.0, 0.4),
    (0.71, 0.25),
    (0.47, 0.18),
    (0.29, 0.11),
    (0.19, 0.06),
];

impl Terrain {
    pub(crate) fn new(config: &TerrainConfig, base_up_m: f64) -> Self {
        let waves = match *config {
            TerrainConfig::Flat {} => Vec::new(),
            TerrainConfig::Hills {
                amplitude_m,
                wavelength_m,
                seed,
            } => waves(amplitude_m, wavelength_m, seed),
        };
        let amplitude_m = waves.iter().map(|w| w.amplitude_m).sum();
        let steepest = waves
            .iter()
            .map(|w| w.amplitude_m * w.wavenumber.norm())
            .sum();
        Self {
            base_up_m,
            waves,
            amplitude_m,
            steepest,
        }
    }

    pub(crate) fn up_m(&self, east: f64, north: f64) -> f64 {
        self.waves.iter().fold(self.base_up_m, |up, wave| {
            let phase = wave.wavenumber.x * east + wave.wavenumber.y * north + wave.phase_rad;
            up + wave.amplitude_m * sine(phase)
        })
    }

    /// Unit normal, pointing up.
    pub(crate) fn normal(&self, east: f64, north: f64) -> Vector3<f64> {
        let slope = self.waves.iter().fold(Vector2::zeros(), |slope, wave| {
            let phase = wave.wavenumber.x * east + wave.wavenumber.y * north + wave.phase_rad;
            slope + wave.wavenumber * (wave.amplitude_m * sine(phase + FRAC_PI_2))
        });
        Vector3::new(-slope.x, -slope.y, 1.0).normalize()
    }

    /// First crossing of `origin + s * ray` with the ground, as `s`; `None` beyond `farthest`.
    pub(crate) fn hit(
        &self,
        origin: &Vector3<f64>,
        ray: &Vector3<f64>,
        farthest: f64,
    ) -> Option<f64> {
        if self.waves.is_empty() {
            let s = (self.base_up_m - origin.z) / ray.z;
            return (ray.z < 0.0 && s > 0.0 && s < farthest).then_some(s);
        }
        self.march(origin, ray, farthest)
    }

    /// Steps that the steepest slope can't overtake, so that no crest is jumped.
    fn march(&self, origin: &Vector3<f64>, ray: &Vector3<f64>, farthest: f64) -> Option<f64> {
        let closing = self.steepest * ray.xy().norm() - ray.z;
        let crest = self.base_up_m + self.amplitude_m;
        let mut s = if ray.z < 0.0 {
            ((crest - origin.z) / ray.z).max(0.0)
        } else {
            0.0
        };
        if closing <= 0.0 || (ray.z >= 0.0 && origin.z > crest) {
            return None;
        }
        for _ in 0..MARCH_STEPS {
            let gap = self.gap(origin, ray, s);
            if gap < CLOSE_M {
                return Some(self.polish(origin, ray, s));
            }
            s += gap / closing;
            if s > farthest || (ray.z >= 0.0 && origin.z + s * ray.z > crest) {
                return None;
            }
        }
        Some(s)
    }

    /// Newton steps from close above the ground.
    fn polish(&self, origin: &Vector3<f64>, ray: &Vector3<f64>, start: f64) -> f64 {
        let mut s = start;
        for _ in 0..3 {
            let at = origin + ray * s;
            let normal = self.normal(at.x, at.y);
            let closing = -ray.dot(&normal) / normal.z;
            if closing < 1e-3 {
                return s;
            }
            s += (at.z - self.up_m(at.x, at.y)) / closing;
        }
        s
    }

    fn gap(&self, origin: &Vector3<f64>, ray: &Vector3<f64>, s: f64) -> f64 {
        let at = origin + ray * s;
        at.z - self.up_m(at.x, at.y)
    }
}

/// Enough for a ray that grazes a crest; what is left after it is a fraction of a pixel.
const MARCH_STEPS: usize = 60;
/// Height above ground from which Newton's three steps land within a millimetre.
const CLOSE_M: f64 = 0.4;

/// Sine to 6e-8: a march asks for millions, and the hills are whatever this says.
fn sine(phase: f64) -> f64 {
    // Adding and taking away 1.5 * 2^52 rounds to a whole number without a library call.
    const ROUNDER: f64 = 6_755_399_441_055_744.0;
    let half_turns = (phase * std::f64::consts::FRAC_1_PI + ROUNDER) - ROUNDER;
    let x = phase - half_turns * std::f64::consts::PI;
    let x2 = x * x;
    // Taylor's series on a quarter turn either side.
    let tail = x2 * (1.0 / 362_880.0 - x2 * (1.0 / 39_916_800.0));
    let series = 1.0 - x2 * (1.0 / 6.0 - x2 * (1.0 / 120.0 - x2 * (1.0 / 5040.0 - tail)));
    let odd =
        1.0 - 2.0 * (half_turns - 2.0 * ((half_turns * 0.5 - 0.25 + ROUNDER) - ROUNDER)).abs();
    odd * x * series
}

fn waves(amplitude_m: f64, wavelength_m: f64, seed: u64) -> Vec<Wave> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    SPECTRUM
        .iter()
        .map(|(length, share)| {
            let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
            Wave {
                wavenumber: Vector2::new(cos, sin) * (TAU / (length * wavelength_m)),
                amplitude_m: share * amplitude_m,
                phase_rad: rng.random_range(0.0..TAU),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hills() -> Terrain {
        let config = TerrainConfig::Hills {
            amplitude_m: 8.0,
            wavelength_m: 120.0,
            seed: 3,
        };
        Terrain::new(&config, 10.0)
    }

    #[test]
    fn a_ray_ends_on_the_ground_and_crosses_nothing_before() {
        let terrain = hills();
        let origin = Vector3::new(5.0, -7.0, 55.0);
        for k in 0..200 {
            let (sin, cos) = (f64::from(k) * 0.17).sin_cos();
            let ray = Vector3::new(cos, sin, -0.15 - 0.004 * f64::from(k));
            let s = terrain.hit(&origin, &ray, 2000.0).expect("looks down");
            assert!(
                terrain.gap(&origin, &ray, s).abs() < 2e-3,
                "ray {k} ends off the ground"
            );
            let before = (0..400).map(|i| s * f64::from(i) / 400.0 * 0.999);
            assert!(
                before
                    .map(|s| terrain.gap(&origin, &ray, s))
                    .all(|gap| gap > -2e-3)
            );
        }
    }

    #[test]
    fn the_quick_sine_is_a_sine() {
        for k in -2000..2000 {
            let phase = f64::from(k) * 0.0173;
            assert!((sine(phase) - phase.sin()).abs() < 1e-7, "{phase}");
        }
    }

    #[test]
    fn hills_stay_within_their_amplitude_and_have_a_consistent_slope() {
        let terrain = hills();
        for k in 0..500 {
            let (e, n) = (f64::from(k) * 7.3, f64::from(k) * -3.1);
            assert!((terrain.up_m(e, n) - 10.0).abs() <= 8.0);
            let normal = terrain.normal(e, n);
            let slope = (terrain.up_m(e + 1e-4, n) - terrain.up_m(e - 1e-4, n)) / 2e-4;
            assert!((slope + normal.x / normal.z).abs() < 1e-6);
        }
    }
}
