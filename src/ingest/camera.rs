//! A camera through OpenCV's capture: V4L2, GStreamer, or a video file in its place.
//!
//! One device shows both eyes side by side (left half, right half: one exposure, the best kind of
//! synchronisation); two V4L2 devices are grabbed one right after the other, then read. A thread drains
//! the driver's queue, so that the newest frame is the one that is used; a device that stops giving
//! frames is closed and opened again. Pixels come decoded, as `bgr8`.

use super::live::{LiveSource, Producer};
use super::url::ServiceClock;
use super::{
    EncodedImage, Expected, ImageEncoding, SourceCounters, SourceError, StereoPair, StereoSource,
    note,
};
use bytes::Bytes;
use emberfix_frames::{ServiceTime, SignedDuration, Stamped, seconds};
use opencv::core::{Mat, Rect};
use opencv::prelude::{
    MatTraitConst, MatTraitConstManual, VideoCaptureTrait, VideoCaptureTraitConst,
};
use opencv::videoio::{self, VideoCapture};
use std::path::PathBuf;
use std::time::Duration;

/// What a camera's capture times rest on. Whatever is constant in their error belongs into the rig's
/// `camera_offset_s`; what varies is said here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CaptureClock {
    /// The source states them (stream, recording, folder): as good as its maker.
    #[default]
    Stated,
    /// The driver's own monotonic time stamp of the frame: jitter far below a millisecond.
    DriverMonotonic,
    /// A stream position, tied to our clock by the least delay seen: right up to that delay.
    StreamPosition,
    /// When the frame reached us: late by exposure, transport and decoding, which all vary.
    Arrival,
}

/// A camera, and the format that is asked of it.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureAddress {
    /// Which.
    pub device: CaptureDevice,
    /// How.
    pub format: CaptureFormat,
}

/// What OpenCV opens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CaptureDevice {
    /// One V4L2 device, both eyes side by side.
    V4l2(String),
    /// Two V4L2 devices.
    TwoV4l2 {
        /// Left eye.
        left: String,
        /// Right eye.
        right: String,
    },
    /// A GStreamer pipeline that ends in `appsink`, both eyes side by side.
    Gstreamer(String),
    /// A video file, both eyes side by side; every frame is delivered.
    File {
        /// The file.
        path: PathBuf,
        /// Time of its beginning.
        start: ServiceTime,
    },
}

/// What is asked of a V4L2 driver; it may give something else, which is then refused by size.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CaptureFormat {
    /// Columns of a frame (both eyes of a side-by-side one).
    pub width: Option<u32>,
    /// Rows.
    pub height: Option<u32>,
    /// Frames per second.
    pub fps: Option<f64>,
}

impl std::fmt::Display for CaptureDevice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::V4l2(device) => write!(f, "v4l2:{device}"),
            Self::TwoV4l2 { left, right } => write!(f, "v4l2:{left},{right}"),
            Self::Gstreamer(pipeline) => write!(f, "gstreamer:{pipeline}"),
            Self::File { path, .. } => write!(f, "video:{}", path.display()),
        }
    }
}

/// Frames in a row that may fail before the device is opened again.
const FAILURES_BEFORE_REOPENING: u32 = 10;
/// Between two attempts to open a device.
const REOPEN_PAUSE: Duration = Duration::from_secs(1);
/// A driver's stamp that lies further back than this is no monotonic time stamp.
const STAMP_AGE_LIMIT: SignedDuration = SignedDuration::from_secs(5);

/// Opens a camera. A device that is not there, or has the wrong size, is refused now; one that goes
/// away later is awaited.
///
/// # Errors
/// [`SourceError::NotOpened`], [`SourceError::Capture`], [`SourceError::FrameSize`].
pub fn open(
    address: &CaptureAddress,
    expected: &Expected,
    clock: ServiceClock,
) -> Result<Box<dyn StereoSource>, SourceError> {
    let mut grabber = Grabber::open(address, expected.image_size_px(), clock)?;
    if matches!(address.device, CaptureDevice::File { .. }) {
        return Ok(Box::new(VideoFile {
            grabber,
            counters: SourceCounters::default(),
        }));
    }
    let source = LiveSource::start(address.device.to_string(), move |producer| {
        grab_until_stopped(&mut grabber, producer);
        Ok(())
    })?;
    Ok(Box::new(source))
}

fn grab_until_stopped(grabber: &mut Grabber, producer: &Producer) {
    let (mut failures, mut bad_frames) = (0, 0);
    producer.slot.count(|counters| counters.openings = 1);
    while !producer.is_stopped() {
        if let Ok(Some(pair)) = grabber.grab() {
            failures = 0;
            producer.slot.set_clock(grabber.capture_clock);
            producer.slot.put(pair);
            continue;
        }
        failures += 1;
        note(&mut bad_frames, "camera gave no usable frame");
        producer
            .slot
            .count(|counters| counters.bad_frames = bad_frames);
        if failures >= FAILURES_BEFORE_REOPENING && producer.pause(REOPEN_PAUSE) {
            tracing::warn!(camera = %grabber.address.device, "opening the camera again");
            failures = 0;
            if grabber.reopen().is_ok() {
                producer.slot.count(|counters| counters.openings += 1);
            }
        }
    }
}

/// A video file in a camera's place.
struct VideoFile {
    grabber: Grabber,
    counters: SourceCounters,
}

impl StereoSource for VideoFile {
    fn next_pair(&mut self) -> Result<Option<Stamped<StereoPair>>, SourceError> {
        let pair = self.grabber.grab()?;
        self.counters.delivered += u64::from(pair.is_some());
        Ok(pair)
    }

    fn counters(&self) -> SourceCounters {
        self.counters
    }

    fn capture_clock(&self) -> CaptureClock {
        self.grabber.capture_clock
    }
}

/// The open devices of one camera.
struct Grabber {
    address: CaptureAddress,
    /// Until the first device is open it may be any.
    eye_size_px: Option<(u32, u32)>,
    clock: ServiceClock,
    captures: Vec<VideoCapture>,
    capture_clock: CaptureClock,
    least_delay: Option<SignedDuration>,
    sequence: u64,
}

impl Grabber {
    fn open(
        address: &CaptureAddress,
        eye_size_px: Option<(u32, u32)>,
        clock: ServiceClock,
    ) -> Result<Self, SourceError> {
        let mut grabber = Self {
            address: address.clone(),
            eye_size_px,
            clock,
            captures: Vec::new(),
            capture_clock: CaptureClock::Arrival,
            least_delay: None,
            sequence: 0,
        };
        grabber.reopen()?;
        Ok(grabber)
    }

    fn reopen(&mut self) -> Result<(), SourceError> {
        self.captures.clear();
        let (names, backend) = match &self.address.device {
            CaptureDevice::V4l2(device) => (vec![device.clone()], Backend::V4l2),
            CaptureDevice::TwoV4l2 { left, right } => {
                (vec![left.clone(), right.clone()], Backend::V4l2)
            }
            CaptureDevice::Gstreamer(pipeline) => (vec![pipeline.clone()], Backend::Gstreamer),
            CaptureDevice::File { path, .. } => {
                (vec![path.to_string_lossy().into_owned()], Backend::Any)
            }
        };
        for name in names {
            let capture = self.open_one(&name, backend)?;
            self.captures.push(capture);
        }
        Ok(())
    }

    fn open_one(&mut self, name: &str, backend: Backend) -> Result<VideoCapture, SourceError> {
        let mut capture =
            VideoCapture::from_file(name, backend.id()).map_err(|source| self.failed(source))?;
        if !capture.is_opened().unwrap_or(false) {
            return Err(SourceError::NotOpened {
                source_name: self.address.device.to_string(),
                backend: backend.name(),
            });
        }
        let CaptureFormat { width, height, fps } = self.address.format;
        let asked = [
            (videoio::CAP_PROP_FRAME_WIDTH, width.map(f64::from)),
            (videoio::CAP_PROP_FRAME_HEIGHT, height.map(f64::from)),
            (videoio::CAP_PROP_FPS, fps),
        ];
        for (property, value) in asked {
            if let Some(value) = value {
                // What the driver made of it shows in the size that is checked next.
                drop(capture.set(property, value));
            }
        }
        let size = |property| capture.get(property).unwrap_or(0.0) as i32;
        let found = (
            size(videoio::CAP_PROP_FRAME_WIDTH),
            size(videoio::CAP_PROP_FRAME_HEIGHT),
        );
        self.check_size(found)?;
        Ok(capture)
    }

    fn failed(&self, source: opencv::Error) -> SourceError {
        SourceError::Capture {
            source_name: self.address.device.to_string(),
            source,
        }
    }

    /// How many eyes stand side by side in a frame.
    fn eyes_in_a_frame(&self) -> u32 {
        match self.address.device {
            CaptureDevice::TwoV4l2 { .. } => 1,
            _ => 2,
        }
    }

    /// Every frame must have the size that the first had, if none was asked for.
    fn check_size(&mut self, found_px: (i32, i32)) -> Result<(), SourceError> {
        let eyes = self.eyes_in_a_frame();
        let found = (found_px.0.unsigned_abs(), found_px.1.unsigned_abs());
        let (width, height) = *self.eye_size_px.get_or_insert((found.0 / eyes, found.1));
        if found == (eyes * width, height) {
            return Ok(());
        }
        Err(SourceError::FrameSize {
            source_name: self.address.device.to_string(),
            found_px,
            expected_px: ((eyes * width) as i32, height as i32),
        })
    }

    /// The next pair; none when the device has nothing more to give.
    fn grab(&mut self) -> Result<Option<Stamped<StereoPair>>, SourceError> {
        let mut arrivals = Vec::with_capacity(2);
        for capture in &mut self.captures {
            if !capture.grab().unwrap_or(false) {
                return Ok(None);
            }
            arrivals.push(Moment {
                service: (self.clock)(),
                monotonic: monotonic_now(),
            });
        }
        let mut frames = Vec::with_capacity(2);
        for (index, grabbed) in arrivals.iter().enumerate() {
            let mut frame = Mat::default();
            let got = self.captures[index].retrieve_def(&mut frame);
            if !got.map_err(|source| self.failed(source))? || frame.empty() {
                return Ok(None);
            }
            self.check_size((frame.cols(), frame.rows()))?;
            let at = self.capture_time(index, *grabbed);
            frames.push((frame, at));
        }
        let arrived = arrivals.last().map(|moment| moment.service);
        self.pair(&frames, arrived)
            .map_err(|source| self.failed(source))
    }

    fn pair(
        &mut self,
        frames: &[(Mat, ServiceTime)],
        arrived: Option<ServiceTime>,
    ) -> opencv::Result<Option<Stamped<StereoPair>>> {
        let width = self.eye_size_px.unwrap_or_default().0 as i32;
        let (left, right) = match frames {
            [(left, left_at), (right, right_at)] => (
                eye(left, 0, width, *left_at)?,
                eye(right, 0, width, *right_at)?,
            ),
            [(both, at)] => (eye(both, 0, width, *at)?, eye(both, width, width, *at)?),
            _ => return Ok(None),
        };
        let sequence = self.sequence;
        self.sequence += 1;
        let (at, skew) = (left.at, right.at - left.at);
        // A file arrives when it was exposed: replaying it needs no clock.
        let is_file = matches!(self.address.device, CaptureDevice::File { .. });
        let arrived = arrived.filter(|_| !is_file).unwrap_or(at);
        let value = StereoPair {
            spectra: Vec::new(),
            sequence,
            arrived,
            left,
            right: Some(right),
            skew,
        };
        Ok(Some(Stamped { at, value }))
    }

    /// When a device's latest frame was taken, as well as the driver lets us know.
    fn capture_time(&mut self, index: usize, grabbed: Moment) -> ServiceTime {
        let arrived = grabbed.service;
        let position_ms = self.captures[index]
            .get(videoio::CAP_PROP_POS_MSEC)
            .unwrap_or(-1.0);
        let position = seconds(position_ms / 1000.0);
        let (at, capture_clock) = match &self.address.device {
            CaptureDevice::File { start, .. } => (*start + position, CaptureClock::Stated),
            CaptureDevice::Gstreamer(_) if position.is_positive() => (
                self.tied_by_least_delay(arrived, position),
                CaptureClock::StreamPosition,
            ),
            CaptureDevice::Gstreamer(_) => (arrived, CaptureClock::Arrival),
            CaptureDevice::V4l2(_) | CaptureDevice::TwoV4l2 { .. } => {
                from_monotonic(grabbed, position)
            }
        };
        self.capture_clock = capture_clock;
        at
    }

    /// Ties a stream position to our clock: the frame with the least delay had nearly none.
    fn tied_by_least_delay(
        &mut self,
        arrived: ServiceTime,
        position: SignedDuration,
    ) -> ServiceTime {
        let origin = ServiceTime::from_unix_ns(0);
        let delay = (arrived - position) - origin;
        let least = self.least_delay.map_or(delay, |least| least.min(delay));
        self.least_delay = Some(least);
        origin + least + position
    }
}

/// A V4L2 stamp is the monotonic clock's when it lies in the last few seconds of that clock.
fn from_monotonic(grabbed: Moment, stamp: SignedDuration) -> (ServiceTime, CaptureClock) {
    let age = grabbed.monotonic - stamp;
    if stamp.is_positive() && !age.is_negative() && age < STAMP_AGE_LIMIT {
        (grabbed.service - age, CaptureClock::DriverMonotonic)
    } else {
        (grabbed.service, CaptureClock::Arrival)
    }
}

/// One moment on two clocks: ours, and the kernel's monotonic one that drivers stamp frames with.
#[derive(Debug, Clone, Copy)]
struct Moment {
    service: ServiceTime,
    monotonic: SignedDuration,
}

fn monotonic_now() -> SignedDuration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    SignedDuration::new(now.tv_sec, i32::try_from(now.tv_nsec).unwrap_or(0))
}

/// One eye's columns of a frame, as plain bytes.
fn eye(
    frame: &Mat,
    first_column: i32,
    width: i32,
    at: ServiceTime,
) -> opencv::Result<EncodedImage> {
    let columns = Mat::roi(frame, Rect::new(first_column, 0, width, frame.rows()))?;
    let pixels = columns.clone_pointee();
    let encoding = match pixels.channels() {
        1 => "mono8",
        _ => "bgr8",
    };
    let bytes = Bytes::copy_from_slice(pixels.data_bytes()?);
    let step = u32::try_from(pixels.step1_def()?).unwrap_or_default();
    Ok(EncodedImage {
        encoding: ImageEncoding::Raw {
            encoding: encoding.to_owned(),
            width: width as u32,
            height: frame.rows() as u32,
            step,
        },
        bytes,
        at,
    })
}

#[derive(Debug, Clone, Copy)]
enum Backend {
    V4l2,
    Gstreamer,
    Any,
}

impl Backend {
    fn id(self) -> i32 {
        match self {
            Self::V4l2 => videoio::CAP_V4L2,
            Self::Gstreamer => videoio::CAP_GSTREAMER,
            Self::Any => videoio::CAP_ANY,
        }
    }
    fn name(self) -> &'static str {
        match self {
            Self::V4l2 => "V4L2",
            Self::Gstreamer => "GStreamer",
            Self::Any => "video file",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::testing::{START_NS, at, picture, rig};
    use opencv::core::Size;
    use opencv::prelude::VideoWriterTrait;
    use opencv::videoio::VideoWriter;
    use std::path::Path;
    use std::sync::Arc;

    fn clock() -> ServiceClock {
        Arc::new(|| at(0))
    }

    /// Five frames at 10 Hz: the left half dark, the right half bright.
    fn write_video(path: &Path, width: i32, height: i32) {
        let code = VideoWriter::fourcc('M', 'J', 'P', 'G').unwrap();
        let name = path.to_string_lossy();
        let size = Size::new(width, height);
        let mut writer = VideoWriter::new_with_backend(
            &*name,
            videoio::CAP_OPENCV_MJPEG,
            code,
            10.0,
            size,
            true,
        )
        .unwrap();
        for _ in 0..5 {
            let mut frame = picture(width, height, 1);
            let halves = [(0, 40.0), (width / 2, 200.0)];
            for (column, grey) in halves {
                let area = Rect::new(column, 0, width / 2, height);
                let colour = opencv::core::Scalar::all(grey);
                opencv::imgproc::rectangle(&mut frame, area, colour, -1, 8, 0).unwrap();
            }
            writer.write(&frame).unwrap();
        }
        writer.release().unwrap();
    }

    fn file_address(path: &Path) -> CaptureAddress {
        let device = CaptureDevice::File {
            path: path.to_owned(),
            start: ServiceTime::from_unix_ns(START_NS),
        };
        CaptureAddress {
            device,
            format: CaptureFormat::default(),
        }
    }

    #[test]
    fn a_side_by_side_video_is_split_into_eyes_with_rising_times() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pair.avi");
        write_video(&path, 2560, 720);
        let mut source = open(&file_address(&path), &Expected::of(&rig()), clock()).unwrap();
        let mut pairs = Vec::new();
        while let Some(pair) = source.next_pair().unwrap() {
            pairs.push(pair);
        }
        assert_eq!((pairs.len(), source.counters().delivered), (5, 5));
        for two in pairs.windows(2) {
            assert_eq!((two[1].at - two[0].at).as_millis(), 100);
        }
        let first = &pairs[0].value;
        let right = first.right.as_ref().unwrap();
        let ImageEncoding::Raw {
            encoding,
            width,
            height,
            step,
        } = &first.left.encoding
        else {
            unreachable!("a camera gives pixels")
        };
        assert_eq!(
            (encoding.as_str(), *width, *height, *step),
            ("bgr8", 1280, 720, 3840)
        );
        // The JPEG inside the video may round a little.
        assert!(first.left.bytes[1_000_000].abs_diff(40) < 5);
        assert!(right.bytes[1_000_000].abs_diff(200) < 5);
        let mut decoder = crate::ingest::decode::ImageDecoder::new(&rig());
        decoder.left(&first.left).unwrap();
        decoder.right(right).unwrap();
    }

    #[test]
    fn a_camera_of_the_wrong_size_or_none_at_all_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("small.avi");
        write_video(&path, 640, 240);
        let error = open(&file_address(&path), &Expected::of(&rig()), clock())
            .map(drop)
            .unwrap_err();
        assert!(matches!(
            error,
            SourceError::FrameSize {
                found_px: (640, 240),
                expected_px: (2560, 720),
                ..
            }
        ));
        let device = CaptureDevice::V4l2("/dev/video-none".to_owned());
        let absent = CaptureAddress {
            device,
            format: CaptureFormat::default(),
        };
        let error = open(&absent, &Expected::of(&rig()), clock())
            .map(drop)
            .unwrap_err();
        assert!(
            matches!(
                error,
                SourceError::NotOpened {
                    backend: "V4L2",
                    ..
                }
            ),
            "{error}"
        );
    }

    #[test]
    fn a_gstreamer_pipeline_is_a_live_camera() {
        let pipeline = "videotestsrc is-live=true ! \
                        video/x-raw,format=BGR,width=2560,height=720,framerate=20/1 ! appsink";
        let address = CaptureAddress {
            device: CaptureDevice::Gstreamer(pipeline.to_owned()),
            format: CaptureFormat::default(),
        };
        let now: ServiceClock =
            Arc::new(|| at((monotonic_now().as_millis() % 1_000_000_000) as i64));
        let Ok(mut source) = open(&address, &Expected::of(&rig()), now) else {
            println!("skipped: no GStreamer with videotestsrc (gstreamer1.0-plugins-base)");
            return;
        };
        let first = source.next_pair().unwrap().unwrap();
        let second = source.next_pair().unwrap().unwrap();
        assert!(second.at > first.at);
        assert_eq!(second.value.skew, SignedDuration::ZERO);
        assert_ne!(source.capture_clock(), CaptureClock::Stated);
    }

    #[test]
    fn a_driver_stamp_is_used_only_when_it_is_the_monotonic_clocks() {
        let grabbed = Moment {
            service: at(1000),
            monotonic: SignedDuration::from_secs(500),
        };
        let stamp = |seconds_ago: f64| grabbed.monotonic - seconds(seconds_ago);
        assert_eq!(
            from_monotonic(grabbed, stamp(0.03)),
            (at(970), CaptureClock::DriverMonotonic)
        );
        for wrong in [
            stamp(-0.1),
            stamp(60.0),
            SignedDuration::ZERO,
            seconds(-0.001),
        ] {
            assert_eq!(
                from_monotonic(grabbed, wrong),
                (at(1000), CaptureClock::Arrival)
            );
        }
    }
}
