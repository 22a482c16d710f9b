//! What the pictures' way into the network and back costs, against the network itself.

use crate::detect::{
    DetectError, Detector, DetectorConfig, LeftImage, ModelError, OnnxDetector, Spent,
};
use emberfix_frames::ServiceTime;
use opencv::core::{Mat, Size};
use opencv::imgproc;

/// A camera's picture, columns and rows.
const FRAME: (i32, i32) = (1280, 720);
/// Looks before the clock counts.
const WARM_UP: usize = 2;

/// Why it could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum OverheadError {
    /// The model was refused.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A picture was.
    #[error(transparent)]
    Detect(#[from] DetectError),
    /// OpenCV refused.
    #[error(transparent)]
    OpenCv(#[from] opencv::Error),
}

/// Looks at pictures as large as a camera's, whole and in tiles as in flight, all on one thread.
///
/// # Errors
/// [`OverheadError`].
pub fn measure(config: &DetectorConfig, pictures: &[Mat]) -> Result<Spent, OverheadError> {
    let config = DetectorConfig {
        threads: 1,
        ..config.clone()
    };
    let threads = opencv::core::get_num_threads()?;
    opencv::core::set_num_threads(1)?;
    let spent = look(&config, pictures);
    opencv::core::set_num_threads(threads)?;
    spent
}

fn look(config: &DetectorConfig, pictures: &[Mat]) -> Result<Spent, OverheadError> {
    let mut detector = OnnxDetector::load(config)?;
    let mut before = Spent::default();
    for (number, picture) in pictures
        .iter()
        .cycle()
        .take(pictures.len() + WARM_UP)
        .enumerate()
    {
        if number == WARM_UP {
            before = detector.spent();
        }
        let mut bgr = Mat::default();
        let size = Size::new(FRAME.0, FRAME.1);
        imgproc::resize(picture, &mut bgr, size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        detector.detect(&LeftImage {
            at: ServiceTime::from_unix_ns(0),
            sequence: number as u64,
            bgr,
            ground: None,
        })?;
    }
    Ok(detector.spent() - before)
}
