//! The stereo camera of a flight: what it takes when, how it stamps it, when that arrives.

use crate::autopilot::ErrorsConfig;
use crate::flight::Flight;
use crate::mission::{CameraConfig, Mission};
use crate::noise::{normal, stream};
use crate::render::{RenderConfig, Renderer, StereoCamera, encode_jpeg};
use crate::stream::EncodedPair;
use crate::world::World;
use emberfix_calib::Eye;
use emberfix_frames::{ServiceTime, seconds};
use std::sync::Arc;

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The image could not be compressed.
    #[error("pair {index}: image could not be compressed: {reason}")]
    Compress {
        /// Number of the pair.
        index: u32,
        /// What the encoder said.
        reason: String,
    },
}

/// Takes the pictures of one flight.
pub struct Cameras {
    renderer: Renderer,
    flight: Arc<Flight>,
    config: CameraConfig,
    errors: ErrorsConfig,
    rig_offset_s: f64,
    seed: u64,
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
        let camera = StereoCamera::new(&mission.rig);
        Self {
            renderer: Renderer::new(world, camera, RenderConfig::default()),
            flight,
            config: mission.sim.camera,
            errors: if errors.off {
                errors.sensors_off()
            } else {
                errors.clone()
            },
            rig_offset_s: mission.rig.time_offset_s(),
            seed: mission.sim.seed,
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
    ///
    /// # Errors
    /// [`CameraError`] when an image can't be compressed.
    pub fn take(&self, index: u32) -> Result<TakenPair, CameraError> {
        let taken_s = self.taken_s(index);
        let state = self.flight.state(taken_s);
        let image = |eye| {
            let frame = self.renderer.render(eye, &state, taken_s);
            encode_jpeg(&frame, self.config.jpeg_quality).map_err(|error| CameraError::Compress {
                index,
                reason: error.to_string(),
            })
        };
        Ok(TakenPair {
            stamped_s: taken_s + self.stamp_error_s(index),
            arrives_s: self.arrives_s(index),
            left: image(Eye::Left)?,
            right: image(Eye::Right)?,
        })
    }

    /// The camera's stamp minus mid-exposure: the rig file's offset takes its own part away again.
    fn stamp_error_s(&self, index: u32) -> f64 {
        let jitter = normal(&mut stream(self.seed, &format!("camera stamp {index}")));
        self.errors.camera_offset_s - self.rig_offset_s + self.errors.camera_jitter_s * jitter
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
        }
    }
}
