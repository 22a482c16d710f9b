//! The camera: pairs as they come, and what some of them show.

use crate::doctor::judge::median;
use crate::ingest::{
    self, CameraUrl, CaptureClock, EncodedImage, Expected, EyeHealth, EyeWatch, ImageDecoder,
    SourceCounters, StereoPair, StereoSource,
};
use crate::mission::Mission;
use crate::range::{EyeComparer, RawPair};
use crate::service::service_clock;
use emberfix_frames::{ServiceTime, Stamped};
use opencv::core::{self, Mat, MatTraitConst, Scalar};
use opencv::imgproc;
use std::time::{Duration, Instant};

/// What the camera delivered.
#[derive(Debug, Clone, Default)]
pub struct CameraSeen {
    /// Why it could not be opened, or stopped.
    pub broken: Option<String>,
    /// Whether it did not even come back to say so.
    pub hangs: bool,
    /// When each pair was exposed and when it came.
    pub pairs: Vec<PairSeen>,
    /// Looks at left eyes, some of those that came.
    pub left: Vec<EyeSeen>,
    /// Looks at right eyes, of the same pairs.
    pub right: Vec<EyeSeen>,
    /// Rows between the eyes at places that both see, pixels; the median of each look at both.
    pub rows_px: Vec<f64>,
    /// Pictures that can't be read: the first reason.
    pub unreadable: Option<String>,
    /// What the source counted.
    pub counters: SourceCounters,
    /// What its times rest on.
    pub clock: CaptureClock,
}

/// One pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairSeen {
    /// Mid-exposure of the left eye.
    pub at: ServiceTime,
    /// When it reached us.
    pub arrived: ServiceTime,
    /// Right minus left exposure, seconds; `None` for one eye.
    pub skew_s: Option<f64>,
}

/// One eye's picture in numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EyeSeen {
    /// Mean grey level, 0..255.
    pub mean: f64,
    /// Share of pixels at full brightness.
    pub burnt: f64,
    /// Standard deviation of the Laplacian over the mean level: edges, whatever the exposure.
    pub sharpness: f64,
    /// What the service would make of it.
    pub health: EyeHealth,
}

/// Pictures that are looked at per second: enough to judge by, few enough for a small computer.
const LOOKS_PER_S: f64 = 2.0;
/// Places that both eyes must see before their rows are compared.
const ENOUGH_PLACES: usize = 8;
/// Grey level from which a pixel is burnt out.
const BURNT_LEVEL: f64 = 250.0;

impl CameraSeen {
    /// For a probe that never came back.
    #[must_use]
    pub fn hanging() -> Self {
        Self {
            hangs: true,
            ..Self::default()
        }
    }

    /// Pairs per second by the times of exposure.
    #[must_use]
    pub fn rate_hz(&self) -> Option<f64> {
        let (first, last) = (self.pairs.first()?, self.pairs.last()?);
        let span_s = (last.at - first.at).as_secs_f64();
        (span_s > 0.0).then(|| (self.pairs.len() - 1) as f64 / span_s)
    }
}

/// Watches for `listen` from the first pair, which is waited for as long as `patience` beyond that.
#[must_use]
pub fn look(mission: &Mission, listen: Duration, patience: Duration) -> CameraSeen {
    let mut seen = CameraSeen::default();
    let mut source = match open(mission) {
        Ok(source) => source,
        Err(reason) => {
            seen.broken = Some(reason);
            return seen;
        }
    };
    let mut eyes = Eyes::new(mission);
    let mut end = Instant::now() + listen + patience;
    let mut look_due = Instant::now();
    while Instant::now() < end {
        match source.next_pair() {
            Ok(Some(pair)) => {
                if seen.pairs.is_empty() {
                    end = end.min(Instant::now() + listen);
                }
                seen.pairs.push(pair_seen(&pair));
                if Instant::now() >= look_due {
                    look_due = Instant::now() + Duration::from_secs_f64(1.0 / LOOKS_PER_S);
                    eyes.look(&pair.value, &mut seen);
                }
            }
            Ok(None) => break,
            Err(error) if error.is_fatal() => {
                seen.broken = Some(error.to_string());
                break;
            }
            // Nothing yet: the judge sees that from what came.
            Err(_) => {}
        }
    }
    seen.counters = source.counters();
    seen.clock = source.capture_clock();
    seen
}

fn open(mission: &Mission) -> Result<Box<dyn StereoSource>, String> {
    let url: CameraUrl = mission
        .camera_url
        .parse()
        .map_err(|error: ingest::CameraUrlError| error.to_string())?;
    ingest::open(&url, &Expected::of(&mission.rig), service_clock())
        .map_err(|error| error.to_string())
}

fn pair_seen(pair: &Stamped<StereoPair>) -> PairSeen {
    PairSeen {
        at: pair.at,
        arrived: pair.value.arrived,
        skew_s: pair
            .value
            .right
            .is_some()
            .then(|| pair.value.skew.as_secs_f64()),
    }
}

struct Eyes {
    decoder: ImageDecoder,
    comparer: Option<EyeComparer>,
    left: EyeWatch,
    right: EyeWatch,
}

impl Eyes {
    fn new(mission: &Mission) -> Self {
        Self {
            decoder: ImageDecoder::new(&mission.rig),
            comparer: EyeComparer::new(&mission.rig).ok(),
            left: EyeWatch::default(),
            right: EyeWatch::default(),
        }
    }

    fn look(&mut self, pair: &StereoPair, seen: &mut CameraSeen) {
        let left = self
            .decoder
            .left(&pair.left)
            .map_err(|error| error.to_string());
        let left = note(
            left,
            &mut self.left,
            &pair.left,
            &mut seen.left,
            &mut seen.unreadable,
        );
        let Some(image) = &pair.right else {
            return;
        };
        let right = self.decoder.right(image).map_err(|error| error.to_string());
        let right = note(
            right,
            &mut self.right,
            image,
            &mut seen.right,
            &mut seen.unreadable,
        );
        if let (Some(left_bgr), Some(right_gray)) = (left, right) {
            seen.rows_px.extend(self.rows(RawPair {
                at: pair.left.at,
                left_bgr,
                right_gray: Some(right_gray),
            }));
        }
    }

    /// Rows between the eyes, where they see enough of the same.
    fn rows(&self, pair: RawPair) -> Option<f64> {
        let compared = self.comparer.as_ref()?.compare(&pair).ok()?;
        let rows = compared.found.iter().map(|place| place.vertical_px);
        (compared.found.len() >= ENOUGH_PLACES)
            .then(|| median(rows))
            .flatten()
    }
}

/// Takes a picture in numbers down, and hands it back; the first that can't be read is told.
fn note(
    decoded: Result<Mat, String>,
    watch: &mut EyeWatch,
    image: &EncodedImage,
    into: &mut Vec<EyeSeen>,
    unreadable: &mut Option<String>,
) -> Option<Mat> {
    let looked = decoded.and_then(|pixels| Ok((in_numbers(watch, image, &pixels)?, pixels)));
    match looked {
        Ok((eye, pixels)) => {
            into.push(eye);
            Some(pixels)
        }
        Err(reason) => {
            unreadable.get_or_insert(reason);
            None
        }
    }
}

fn in_numbers(watch: &mut EyeWatch, image: &EncodedImage, pixels: &Mat) -> Result<EyeSeen, String> {
    let health = watch
        .check(image, pixels)
        .map_err(|error| error.to_string())?;
    measure(pixels, health).map_err(|error| error.to_string())
}

fn measure(pixels: &Mat, health: EyeHealth) -> opencv::Result<EyeSeen> {
    let mut grey = Mat::default();
    if pixels.channels() == 3 {
        imgproc::cvt_color_def(pixels, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    } else {
        grey = pixels.try_clone()?;
    }
    let mean = core::mean_def(&grey)?[0];
    let mut burnt = Mat::default();
    core::compare(&grey, &Scalar::all(BURNT_LEVEL), &mut burnt, core::CMP_GE)?;
    let burnt = f64::from(core::count_non_zero(&burnt)?) / (grey.total().max(1) as f64);
    let mut edges = Mat::default();
    imgproc::laplacian_def(&grey, &mut edges, core::CV_32F)?;
    let (mut middle, mut deviation) = (Scalar::default(), Scalar::default());
    core::mean_std_dev_def(&edges, &mut middle, &mut deviation)?;
    Ok(EyeSeen {
        mean,
        burnt,
        sharpness: deviation[0] / mean.max(1.0),
        health,
    })
}
