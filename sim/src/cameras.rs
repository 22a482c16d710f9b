//! The stereo camera of a flight: what it takes when, how it stamps it, when that arrives.

use crate::autopilot::ErrorsConfig;
use crate::flight::Flight;
use crate::mission::{CameraConfig, Mission};
use crate::noise::{normal, stream};
use crate::render::{RenderConfig, Renderer, StereoCamera, encode_jpeg};
use crate::score::{Class, Truth};
use crate::spectrometer::{self, SpectrometerConfig};
use crate::state::BodyState;
use crate::stream::EncodedPair;
use crate::world::{BurningClass, FireTruth, World};
use emberfix_calib::Eye;
use emberfix_frames::{ServiceTime, seconds};
use std::sync::Arc;

/// Takes the pictures of one flight.
pub struct Cameras {
    renderer: Renderer,
    flight: Arc<Flight>,
    config: CameraConfig,
    errors: ErrorsConfig,
    rig_offset_s: f64,
    seed: u64,
    spectrometer: Option<SpectrometerConfig>,
}

impl Cameras {
    /// The mission's cameras, in its world, on its flight.
    #[must_use]
    pub fn new(
        mission: &Mission,
        world: Arc<World>,
        flight: Arc<Flight>,
        errors: &ErrorsConfig,
    ) -> Self {
        let camera = StereoCamera::new(&mission.rig)
            .with_mount_error(mission.sim.camera.mount_error_deg.map(f64::to_radians));
        Self {
            renderer: Renderer::new(
                world,
                camera,
                RenderConfig {
                    seed: mission.sim.seed,
                    ..RenderConfig::default()
                },
            ),
            flight,
            config: mission.sim.camera,
            errors: if errors.off {
                errors.sensors_off()
            } else {
                errors.clone()
            },
            rig_offset_s: mission.rig.time_offset_s(),
            seed: mission.sim.seed,
            spectrometer: mission.sim.spectrometer,
        }
    }

    /// How many pairs the flight has.
    #[must_use]
    pub fn count(&self) -> u32 {
        (self.flight.duration_s() * self.config.rate_hz).floor() as u32
    }

    /// Flight time of a pair's mid-exposure, seconds.
    #[must_use]
    pub fn taken_s(&self, index: u32) -> f64 {
        (f64::from(index) + 0.5) / self.config.rate_hz
    }

    /// Flight time at which a pair reaches the service, seconds.
    #[must_use]
    pub fn arrives_s(&self, index: u32) -> f64 {
        self.taken_s(index) + self.config.latency_s
    }

    /// Renders and compresses a pair.
    #[must_use]
    pub fn take(&self, index: u32) -> TakenPair {
        let taken_s = self.taken_s(index);
        let state = self.flight.state(taken_s);
        let jpeg = |eye| {
            let frame = self.renderer.render(eye, &state, taken_s);
            encode_jpeg(&frame, self.config.jpeg_quality)
        };
        TakenPair {
            stamped_s: taken_s + self.stamp_error_s(index),
            arrives_s: self.arrives_s(index),
            left: jpeg(Eye::Left),
            right: jpeg(Eye::Right),
            spectrum: self.spectrum(&state, taken_s),
        }
    }

    fn spectrum(&self, state: &BodyState, taken_s: f64) -> Option<Vec<u8>> {
        let config = self.spectrometer?;
        let world = self.renderer.world();
        spectrometer::reading(&config, world, &state.position_m, taken_s, self.seed)
    }

    /// What burns in the world and was seen by the left eye in [`SEEN_PAIRS`] pairs at least.
    #[must_use]
    pub fn seen(&self) -> Vec<Truth> {
        let fires = self.renderer.world().fires();
        let mut pairs = vec![0_u32; fires.len()];
        for index in 0..self.count() {
            for fire in self.seen_in(index) {
                pairs[fire] += 1;
            }
        }
        let seen = fires
            .iter()
            .zip(pairs)
            .filter(|(_, pairs)| *pairs >= SEEN_PAIRS);
        seen.map(|(fire, _)| truth(fire)).collect()
    }

    /// Indices of the fires whose own class is seen in a pair: a flame's plume does not count.
    fn seen_in(&self, index: u32) -> Vec<usize> {
        let taken_s = self.taken_s(index);
        let fires = self.renderer.world().fires();
        let boxes = self
            .renderer
            .label_boxes(&self.flight.state(taken_s), taken_s);
        let own = boxes
            .iter()
            .filter(|seen| fires[seen.fire].class == seen.class);
        let large = own.filter(|seen| {
            (seen.right_px - seen.left_px).max(seen.bottom_px - seen.top_px) >= SEEN_PX
        });
        large.map(|seen| seen.fire).collect()
    }

    /// The camera's stamp minus mid-exposure: the rig file's offset takes its own part away again.
    fn stamp_error_s(&self, index: u32) -> f64 {
        let jitter = normal(&mut stream(self.seed, &format!("camera stamp {index}")));
        self.errors.camera_offset_s - self.rig_offset_s + self.errors.camera_jitter_s * jitter
    }
}

/// Pairs in which a fire must be seen before it must be found.
pub const SEEN_PAIRS: u32 = 5;
/// Longer side that counts as seen, pixels.
pub const SEEN_PX: f64 = 8.0;

fn truth(fire: &FireTruth) -> Truth {
    let class = match fire.class {
        BurningClass::Fire => Class::Fire,
        BurningClass::Smoke => Class::Smoke,
    };
    Truth {
        name: fire.name.clone(),
        class,
        base_m: fire.base_m,
    }
}

/// A pair in flight time, before anybody says when the flight began.
#[derive(Debug, Clone, PartialEq)]
pub struct TakenPair {
    /// The camera's stamp of mid-exposure, seconds of flight.
    pub stamped_s: f64,
    /// When it reaches the service, seconds of flight.
    pub arrives_s: f64,
    /// Left image, JPEG.
    pub left: Vec<u8>,
    /// Right image, JPEG.
    pub right: Vec<u8>,
    /// Spectrometer reading of the same moment, JSON.
    pub spectrum: Option<Vec<u8>>,
}

impl TakenPair {
    /// The same pair of a flight that began at `start`.
    #[must_use]
    pub fn at(self, start: ServiceTime) -> EncodedPair {
        EncodedPair {
            stamped: start + seconds(self.stamped_s),
            arrives: start + seconds(self.arrives_s),
            left: self.left,
            right: self.right,
            spectrum: self.spectrum,
        }
    }
}
