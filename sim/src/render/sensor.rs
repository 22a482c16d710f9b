//! From light to the bytes of a camera: gain, vignetting, shot noise, gamma.

use super::RenderConfig;
use super::ground::Band;
use crate::world::hash;
use emberfix_calib::Eye;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Entries of the curve from light to digital numbers.
const CURVE: usize = 4096;
/// Entries of the table of normal deviates; a power of two.
const DEVIATES: usize = 2048;
/// Light at which the noise has the configured sigma: the grey of a sunlit meadow.
const MID_GREY: f32 = 0.2;
/// Share of colour that a monochrome sensor with its infrared tail takes.
const MONO: [f32; 3] = [0.40, 0.44, 0.16];

/// One sensor type, both eyes.
#[derive(Debug, Clone)]
pub(super) struct Sensor {
    config: RenderConfig,
    /// Digital number and its sigma, by light.
    curve: Vec<(f32, f32)>,
    deviates: Vec<f32>,
}

/// Which eye's exposure of which moment.
#[derive(Debug, Clone, Copy)]
pub(super) struct Exposure {
    eye: Eye,
    seed: u64,
    gain: f32,
}

impl Sensor {
    pub(super) fn new(config: RenderConfig) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
        let deviates = (0..DEVIATES)
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        let curve = (0..CURVE)
            .map(|k| response(k as f32 / (CURVE - 1) as f32, &config))
            .collect();
        Self {
            config,
            curve,
            deviates,
        }
    }

    pub(super) fn exposure(&self, eye: Eye, t_s: f64) -> Exposure {
        let (own, gain) = match eye {
            Eye::Left => (1, 1.0),
            Eye::Right => (2, self.config.right_gain),
        };
        let seed = hash(self.config.seed ^ t_s.to_bits(), own, 0xC0DE);
        Exposure {
            eye,
            seed,
            gain: (self.config.exposure * gain) as f32,
        }
    }

    /// Bytes of a band: blue, green, red for the left eye, one for the right.
    pub(super) fn develop(&self, band: &Band, height: usize, exposure: Exposure, out: &mut [u8]) {
        let channels = exposure.eye.channels();
        let corner2 = (band.width.pow(2) + height.pow(2)) as f32 / 4.0;
        for row in 0..band.rows {
            let py = band.top + row;
            let mut bits = hash(exposure.seed, py as u32, 0) as u32 | 1;
            let dy = py as f32 - height as f32 / 2.0;
            let line = &band.colour[row * band.width..(row + 1) * band.width];
            let bytes = &mut out[row * band.width * channels..(row + 1) * band.width * channels];
            for (px, (colour, pixel)) in line
                .iter()
                .zip(bytes.chunks_exact_mut(channels))
                .enumerate()
            {
                let dx = px as f32 - band.width as f32 / 2.0;
                let falloff = 1.0 - self.config.vignetting as f32 * (dx * dx + dy * dy) / corner2;
                bits = xorshift(bits);
                self.expose(*colour, exposure.gain * falloff, bits, pixel);
            }
        }
    }

    #[inline]
    pub(super) fn expose(&self, colour: [f32; 4], gain: f32, bits: u32, pixel: &mut [u8]) {
        if let [blue, green, red] = pixel {
            *red = self.digital(colour[0] * gain, bits);
            *green = self.digital(colour[1] * gain, bits >> 10);
            *blue = self.digital(colour[2] * gain, bits >> 20);
        } else if let [grey] = pixel {
            let light = colour[0] * MONO[0] + colour[1] * MONO[1] + colour[2] * MONO[2];
            *grey = self.digital(light * gain, bits);
        }
    }

    #[inline]
    fn digital(&self, light: f32, bits: u32) -> u8 {
        let index = (light.clamp(0.0, 1.0) * (CURVE - 1) as f32) as usize;
        let (level, sigma) = self.curve[index.min(CURVE - 1)];
        (level + sigma * self.deviates[bits as usize % DEVIATES] + 0.5) as u8
    }
}

/// Channels of an eye's image.
pub(super) trait Channels {
    fn channels(&self) -> usize;
}

impl Channels for Eye {
    fn channels(&self) -> usize {
        match self {
            Eye::Left => 3,
            Eye::Right => 1,
        }
    }
}

/// Digital number and sigma at a light: shot noise before, gamma after it.
fn response(light: f32, config: &RenderConfig) -> (f32, f32) {
    let slope = |x: f32| 255.0 / 2.2 * x.max(0.01).powf(1.0 / 2.2 - 1.0);
    let shot = |x: f32| (x + 0.02).sqrt() * slope(x);
    let saturated = if light >= 0.999 { 0.0 } else { 1.0 };
    let sigma = config.noise_sigma_dn as f32 * shot(light) / shot(MID_GREY) * saturated;
    (255.0 * light.powf(1.0 / 2.2), sigma)
}

/// Marsaglia's 32-bit xorshift: enough for picking deviates.
fn xorshift(mut x: u32) -> u32 {
    x ^= x << 13;
    x ^= x >> 17;
    x ^ (x << 5)
}
