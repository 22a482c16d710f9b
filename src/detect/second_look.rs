//! A second look at what a detector has boxed: does it burn, or does it only look like it?
//!
//! **Purpose.** A detector sees a flame of ten pixels as ten pixels of its whole input; cut out and enlarged, a lantern,
//! an orange car or a lit roof is told from a flame more easily. **In:** the image and its detections. **Out:** the
//! log-odds of each that it is what its class says, for the evidence over time (`track::event`); no detection is
//! dropped here. The network is part of the program: `models/ember-look.onnx`, its card beside it.
//!
//! **Known limits.** Light that eyes see only; what else a model calls fire is not to be looked at a second time. In a
//! crowd only the [`LOOKED_AT`] best detections are.

use super::network::check_finite;
use super::runtime::runtime;
use super::{
    BoxPx, DetectError, Detection, DetectionClass, Detector, LeftImage, Looked, ModelError,
};
use opencv::core::{Mat, Point2f, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::MatTraitConstManual;
use ort::session::Session;
use ort::value::TensorRef;
use std::path::PathBuf;

/// The network, as `models/train/second_look.py` wrote it.
const MODEL: &[u8] = include_bytes!("../../models/ember-look.onnx");
/// Side of its input, pixels, and of what is cut out, in longer sides of the box.
const SIDE: usize = 48;
const MARGIN: f64 = 1.6;
/// Mean and deviation of its input's channels: blue, green, red.
const MEAN: [f32; 3] = [103.53, 116.28, 123.675];
const DEVIATION: [f32; 3] = [57.375, 57.12, 58.395];
/// Columns of its answer: flame, smoke.
const ANSWERS: usize = 2;
/// Detections of an image that are looked at again, at most.
const LOOKED_AT: usize = 64;

/// A detector whose finds are looked at again.
pub struct Twice<D> {
    detector: D,
    session: Session,
    tensor: Vec<f32>,
}

impl<D: Detector> Twice<D> {
    /// A second look on one thread.
    ///
    /// # Errors
    /// [`ModelError`] when ONNX Runtime is missing or refuses the network.
    pub fn open(detector: D) -> Result<Self, ModelError> {
        let refused = |source: ort::Error| ModelError::Unsupported {
            path: PathBuf::from("ember-look (a part of this program)"),
            opsets: "17".to_owned(),
            source,
        };
        let session = || {
            Session::builder(&runtime()?.environment)
                .and_then(|builder| Ok(builder.with_intra_threads(1)?))
                .and_then(|builder| Ok(builder.with_intra_op_spinning(false)?))
                .and_then(|mut builder| builder.commit_from_memory(MODEL))
                .map_err(refused)
        };
        Ok(Self {
            detector,
            session: session()?,
            tensor: Vec::new(),
        })
    }

    /// Log-odds that the best of the detections are what their classes say, in their order.
    fn judge(&mut self, bgr: &Mat, found: &[Detection]) -> Result<Vec<f64>, DetectError> {
        self.tensor.clear();
        for detection in found {
            put(&cut(bgr, &detection.box_px)?, &mut self.tensor)?;
        }
        let shape = [found.len(), 3, SIDE, SIDE];
        let tensor = TensorRef::from_array_view((shape, self.tensor.as_slice()))?;
        let answer = self.session.run(ort::inputs![tensor])?;
        let (shape, values) = answer[0].try_extract_tensor::<f32>()?;
        let expected = [found.len() as i64, ANSWERS as i64];
        if **shape != expected {
            return Err(DetectError::Shape {
                expected: expected.to_vec(),
                found: shape.to_vec(),
            });
        }
        check_finite(values)?;
        let rows = found.iter().zip(values.chunks_exact(ANSWERS));
        Ok(rows
            .map(|(detection, row)| f64::from(row[column(detection.class)]))
            .collect())
    }
}

impl<D: Detector> Detector for Twice<D> {
    fn detect(&mut self, image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        let mut found = self.detector.detect(image)?;
        let best = found.len().min(LOOKED_AT);
        if best > 0 {
            let judged = self.judge(&image.bgr, &found[..best])?;
            for (detection, log_odds) in found.iter_mut().zip(judged) {
                detection.second_look = Some(log_odds);
            }
        }
        Ok(found)
    }

    fn looked(&self) -> Looked {
        self.detector.looked()
    }
}

/// Which answer is asked for: what is no fire was looked at for one.
fn column(class: DetectionClass) -> usize {
    usize::from(class == DetectionClass::Smoke)
}

/// A square about a box, edges of the image repeated, [`SIDE`] pixels a side.
fn cut(bgr: &Mat, box_px: &BoxPx) -> opencv::Result<Mat> {
    let side = (MARGIN * box_px.width.max(box_px.height)).ceil().max(8.0) as i32;
    let (column, row) = box_px.centre();
    let middle = Point2f::new(column as f32, row as f32);
    let (mut cut, mut small) = (Mat::default(), Mat::default());
    imgproc::get_rect_sub_pix_def(bgr, Size::new(side, side), middle, &mut cut)?;
    let size = Size::new(SIDE as i32, SIDE as i32);
    imgproc::resize(&cut, &mut small, size, 0.0, 0.0, imgproc::INTER_AREA)?;
    Ok(small)
}

/// Channel by channel, normalised.
fn put(picture: &Mat, tensor: &mut Vec<f32>) -> opencv::Result<()> {
    let pixels = picture.data_typed::<Vec3b>()?;
    for channel in 0..3 {
        let level =
            |pixel: &Vec3b| (f32::from(pixel[channel]) - MEAN[channel]) / DEVIATION[channel];
        tensor.extend(pixels.iter().map(level));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_frames::ServiceTime;
    use opencv::core::{CV_8UC3, Scalar};

    /// Says the same of every image.
    struct Always(Vec<Detection>);

    impl Detector for Always {
        fn detect(&mut self, _image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
            Ok(self.0.clone())
        }
    }

    #[test]
    fn of_a_crowd_the_best_are_looked_at_wherever_they_stand() {
        let far_outside = Detection {
            class: DetectionClass::Smoke,
            score: 0.6,
            box_px: BoxPx {
                x: 1e4,
                y: -1e4,
                width: 3.0,
                height: 900.0,
            },
            mask: None,
            second_look: None,
        };
        let mut detector = Twice::open(Always(vec![far_outside; LOOKED_AT + 3])).unwrap();
        let grey = Scalar::all(90.0);
        let found = detector.detect(&LeftImage {
            at: ServiceTime::from_unix_ns(0),
            sequence: 0,
            bgr: Mat::new_rows_cols_with_default(48, 64, CV_8UC3, grey).unwrap(),
            ground: None,
        });
        let found = found.unwrap();
        let looked_at = found.iter().filter(|one| one.second_look.is_some()).count();
        assert_eq!((found.len(), looked_at), (LOOKED_AT + 3, LOOKED_AT));
    }
}
