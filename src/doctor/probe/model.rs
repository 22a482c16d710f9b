//! The model: loads it as the service would, and times it on a picture of the camera's size.

use crate::detect::{Detector, DetectorInfo, LeftImage, ModelError, OnnxDetector};
use crate::mission::Mission;
use emberfix_calib::Eye;
use emberfix_frames::ServiceTime;
use opencv::core::{CV_8UC3, Mat, Scalar};
use std::time::{Duration, Instant};

/// A model at work.
pub struct ModelSeen {
    /// What was loaded.
    pub info: DetectorInfo,
    /// Whether the mission says which hash it must have.
    pub pinned: bool,
    /// Time for one picture with all its tiles: the median of some; or what went wrong.
    pub look: Result<Duration, String>,
}

/// Pictures that are timed.
const LOOKS: usize = 3;

/// Loads and times.
///
/// # Errors
/// [`ModelError`], as the service would refuse it.
pub fn time(mission: &Mission) -> Result<ModelSeen, ModelError> {
    let mut detector = OnnxDetector::load(&mission.detector)?;
    let info = detector.info().clone();
    let size = mission.rig.camera(Eye::Left).image_size_px;
    Ok(ModelSeen {
        info,
        pinned: mission.detector.sha256.is_some(),
        look: median_look(&mut detector, size),
    })
}

fn median_look(detector: &mut OnnxDetector, size: (u32, u32)) -> Result<Duration, String> {
    let grey = Scalar::all(114.0);
    let bgr = Mat::new_rows_cols_with_default(size.1 as i32, size.0 as i32, CV_8UC3, grey)
        .map_err(|error| error.to_string())?;
    let image = LeftImage {
        at: ServiceTime::from_unix_ns(0),
        sequence: 0,
        bgr,
        ground: None,
    };
    let mut took = Vec::with_capacity(LOOKS);
    for _ in 0..LOOKS {
        let begun = Instant::now();
        detector.detect(&image).map_err(|error| error.to_string())?;
        took.push(begun.elapsed());
    }
    took.sort_unstable();
    Ok(took[LOOKS / 2])
}
