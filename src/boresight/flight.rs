//! Sights of the marker, and the way of the airframe about each, from a recording.

use super::model::{BodyAt, Sight, Start, Stereo, Way};
use crate::detect::{BoxPx, DetectionClass, Detector, LeftImage};
use crate::ingest::{EncodedImage, ImageDecoder, Recorded, Recording, SourceError, StereoPair};
use crate::mission::Mission;
use crate::pose::{PoseAnswer, PoseEstimator};
use crate::range::{Ranger, Ranging, RawPair, Target};
use emberfix_calib::solve::{Board, Corner, find_corners};
use emberfix_calib::{Eye, RawPixel, Rig};
use emberfix_frames::{
    BootTime, ServiceTime, SignedDuration, Stamped, TimeSyncSample, Vector3, Wgs84, enu_offset,
    seconds,
};
use emberfix_mav::telemetry::{GpsRaw, Heartbeat};
use emberfix_mav::{ComponentId, FrameReader, Received, SystemId, Telemetry};
use opencv::core::{Mat, Rect};
use opencv::imgproc::{COLOR_BGR2GRAY, cvt_color_def};
use rayon::prelude::*;
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Picked pixels by the pair's number in the recording.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Picks {
    picks: BTreeMap<u64, RawPixel>,
}

/// Why a file of picks was refused.
#[derive(Debug, thiserror::Error)]
pub enum PicksError {
    /// It can't be read.
    #[error("picks {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line that is no pick.
    #[error("picks {} line {line}: {text:?} is not PAIR,COLUMN,ROW, such as 17,640.5,333.0", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What stands there.
        text: String,
    },
}

impl Picks {
    /// Reads `PAIR,COLUMN,ROW` lines: the pair's number in the recording from 0, and a pixel of the raw
    /// left image, centres at whole numbers. A header, empty lines and lines that begin with `#` are
    /// skipped.
    ///
    /// # Errors
    /// [`PicksError`] naming file and line.
    pub fn load(path: &Path) -> Result<Self, PicksError> {
        let text = std::fs::read_to_string(path).map_err(|source| PicksError::Read {
            path: path.to_owned(),
            source,
        })?;
        let mut picks = BTreeMap::new();
        for (number, line) in (1..).zip(text.lines()) {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') || (number == 1 && line.starts_with("pair"))
            {
                continue;
            }
            let (pair, pixel) = pick(line).ok_or_else(|| PicksError::Line {
                path: path.to_owned(),
                line: number,
                text: line.to_owned(),
            })?;
            picks.insert(pair, pixel);
        }
        Ok(Self { picks })
    }

    /// Picks by pair.
    #[must_use]
    pub fn of(picks: impl IntoIterator<Item = (u64, RawPixel)>) -> Self {
        Self {
            picks: picks.into_iter().collect(),
        }
    }
}

fn pick(line: &str) -> Option<(u64, RawPixel)> {
    let mut fields = line.split(',').map(str::trim);
    let pair = fields.next()?.parse().ok()?;
    let mut coordinate = || fields.next()?.parse::<f64>().ok().filter(|v| v.is_finite());
    let pixel = RawPixel {
        u: coordinate()?,
        v: coordinate()?,
    };
    fields.next().is_none().then_some((pair, pixel))
}

/// What finds the marker in a picture.
pub enum Picker {
    /// Somebody did.
    Picks(Picks),
    /// A chessboard or ChArUco board: its middle.
    Board(Board),
    /// A detector's best fire: the base of its box.
    Fire(Box<dyn Detector>),
    /// A detector's best fire as stereo sees it: the middle of its flame, and how far that is.
    Flame(Box<dyn Detector>, Box<dyn Ranger>),
}

/// What a picker found in a picture.
struct Found {
    pixel: RawPixel,
    sigma_px: f64,
    stereo: Option<Stereo>,
}

/// Sigma of a pick by hand, pixels.
const PICK_SIGMA_PX: f64 = 1.0;
/// Sigma of a board's middle, pixels.
const BOARD_SIGMA_PX: f64 = 0.3;
/// Sigma of a fire's base or middle: pixels at least, and as a share of the box's height.
const FIRE_SIGMA: (f64, f64) = (2.0, 0.1);
/// The airframe is asked for this long before and after each stamp: what the clock may be off.
const REACH_S: f64 = 0.6;
/// Between two poses: fine against gusts, coarse against the autopilot's own rate.
const STEP_S: f64 = 0.02;
/// Telemetry of the last pose may take this long to come.
const LATE: SignedDuration = SignedDuration::from_millis(400);
/// Pictures that may wait for their telemetry; beyond that the oldest goes.
const WAITING: usize = 256;
/// Pictures that are looked at together.
const BATCH: usize = 32;

/// What a recording gave.
#[derive(Debug, Default)]
pub struct Gathered {
    /// Sights with their ways.
    pub sights: Vec<Sight>,
    /// Pairs in the recording.
    pub pairs: u64,
    /// Pairs in which the marker was found.
    pub seen: u64,
    /// Of those, pairs about which the airframe's way is not known.
    pub without_way: u64,
}

/// The marker's place.
#[derive(Debug, Clone, Copy)]
pub struct Marker {
    /// Where.
    pub place: Wgs84,
    /// One sigma per axis, metres.
    pub sigma_m: f64,
}

impl Marker {
    /// In the plane at the mission's datum, metres.
    #[must_use]
    pub fn enu_m(&self, datum: &Wgs84) -> Vector3<f64> {
        enu_offset(datum, &self.place)
    }
}

/// Reads a recording through. `progress` is told the number of pairs so far. A board is only looked for
/// where a surveyed marker can be, by `start`.
///
/// # Errors
/// [`SourceError`] when it can't be read.
pub fn gather(
    recording: &Path,
    mission: &Mission,
    start: &Start,
    picker: Picker,
    progress: &mut dyn FnMut(u64),
) -> Result<Gathered, SourceError> {
    let mut source = Recording::open(recording, &mission.rig)?;
    let mut gatherer = Gatherer::new(mission, start.clone(), picker);
    let mut frames = FrameReader::new();
    while let Some(event) = source.next_event()? {
        match event {
            Recorded::Mavlink { arrived, bytes } => {
                frames.push(&bytes);
                while let Some(received) = frames.next_received() {
                    gatherer.take_mavlink(arrived, &received);
                }
            }
            Recorded::Pair(pair) => {
                gatherer.take_pair(pair);
                progress(gatherer.gathered.pairs);
            }
            Recorded::Calibration { .. } | Recorded::Action { .. } => {}
        }
    }
    Ok(gatherer.finish())
}

/// Where the diagonals of a board's outer inner corners meet: its middle from any side. `None` unless
/// all four are seen.
fn middle(board: &Board, corners: &[Corner]) -> Option<RawPixel> {
    let at = |id: usize| {
        let corner = corners.iter().find(|corner| corner.id == id)?;
        Some(Vector3::new(corner.pixel.u, corner.pixel.v, 1.0))
    };
    let last = board.corners() - 1;
    let falling = at(0)?.cross(&at(last)?);
    let rising = at(board.columns - 1)?.cross(&at(last + 1 - board.columns)?);
    let meeting = falling.cross(&rising);
    (meeting.z.abs() > f64::EPSILON).then(|| RawPixel {
        u: meeting.x / meeting.z,
        v: meeting.y / meeting.z,
    })
}

/// The middle of the board in a picture.
fn middle_in(board: &Board, rig: &Rig, picture: &Picture, window: Rect) -> Option<Found> {
    let bgr = ImageDecoder::new(rig).left(&picture.left).ok()?;
    let part = Mat::roi(&bgr, window).ok()?;
    let mut grey = Mat::default();
    cvt_color_def(&part, &mut grey, COLOR_BGR2GRAY).ok()?;
    let corners = find_corners(&grey, board).ok()??;
    let middle = middle(board, &corners)?;
    let pixel = RawPixel {
        u: middle.u + f64::from(window.x),
        v: middle.v + f64::from(window.y),
    };
    Some(Found {
        pixel,
        sigma_px: BOARD_SIGMA_PX,
        stereo: None,
    })
}

/// Part of the picture in which the marker can be: the whole of it, unless it was surveyed. `None` when
/// it can't be seen.
fn window(start: &Start, way: &Way) -> Option<Rect> {
    let size = start.camera.image_size_px;
    let (width, height) = (f64::from(size.0), f64::from(size.1));
    if start.marker_m.is_none() {
        return Some(Rect::new(0, 0, size.0 as i32, size.1 as i32));
    }
    let margin = start.camera.focal_px.0 * WINDOW_RAD;
    let (mut low, mut high) = ((f64::MAX, f64::MAX), (f64::MIN, f64::MIN));
    for step in -4..=4 {
        if let Some(pixel) = start.predict(way, f64::from(step) * 0.1) {
            low = (low.0.min(pixel.u), low.1.min(pixel.v));
            high = (high.0.max(pixel.u), high.1.max(pixel.v));
        }
    }
    let left = (low.0 - margin).max(0.0);
    let top = (low.1 - margin).max(0.0);
    let right = (high.0 + margin).min(width);
    let bottom = (high.1 + margin).min(height);
    let large = right - left > LEAST_WINDOW_PX && bottom - top > LEAST_WINDOW_PX;
    large.then(|| {
        let (x, y) = (left as i32, top as i32);
        Rect::new(x, y, right as i32 - x, bottom as i32 - y)
    })
}

/// The mount of a board's flight may be off by this, radians: nine degrees.
const WINDOW_RAD: f64 = 0.157;
/// A board is not found in less, pixels.
const LEAST_WINDOW_PX: f64 = 40.0;

/// The best fire in a picture, and the picture.
fn best_fire(
    detector: &mut dyn Detector,
    rig: &Rig,
    picture: &Picture,
) -> Option<(BoxPx, LeftImage)> {
    let image = LeftImage {
        at: picture.at,
        sequence: picture.number,
        bgr: ImageDecoder::new(rig).left(&picture.left).ok()?,
        ground: None,
    };
    let found = detector.detect(&image).ok()?;
    let best = found.iter().find(|d| d.class == DetectionClass::Fire)?;
    Some((best.box_px, image))
}

fn fire_sigma_px(fire: &BoxPx) -> f64 {
    FIRE_SIGMA.0.max(FIRE_SIGMA.1 * fire.height)
}

/// The base of the best fire in a picture.
fn fire_in(detector: &mut dyn Detector, rig: &Rig, picture: &Picture) -> Option<Found> {
    let (fire, _) = best_fire(detector, rig, picture)?;
    let (u, v) = fire.base();
    Some(Found {
        pixel: RawPixel { u, v },
        sigma_px: fire_sigma_px(&fire),
        stereo: None,
    })
}

/// The middle of the best flame in a picture, if stereo finds it.
fn flame_in(
    (detector, ranger): (&mut dyn Detector, &mut dyn Ranger),
    rig: &Rig,
    picture: &Picture,
) -> Option<Found> {
    let (box_px, image) = best_fire(detector, rig, picture)?;
    let pair = RawPair {
        at: picture.at,
        left_bgr: image.bgr,
        right_gray: Some(ImageDecoder::new(rig).right(picture.right.as_ref()?).ok()?),
    };
    let target = Target {
        class: DetectionClass::Fire,
        box_px,
    };
    let Ok(Ranging::Measured {
        disparity_px,
        sigma_px,
        centroid,
        ..
    }) = ranger.range(&pair, &target)
    else {
        return None;
    };
    let rectification = rig.rectification();
    let focal_baseline = rectification.focal_px() * rig.baseline_m();
    let corrected_per_m = (disparity_px - rectification.infinity_disparity_px()) / focal_baseline;
    Some(Found {
        pixel: rectification.unrectify(Eye::Left, centroid),
        sigma_px: fire_sigma_px(&box_px),
        stereo: Some(Stereo {
            per_m: rig.inverse_depth().measured_per_m(corrected_per_m),
            sigma_per_m: rig.inverse_depth().scale * sigma_px / focal_baseline,
        }),
    })
}

/// A picture that waits for its way, or for its turn to be looked at.
struct Picture {
    number: u64,
    at: ServiceTime,
    left: EncodedImage,
    right: Option<EncodedImage>,
}

struct Gatherer {
    rig: Arc<Rig>,
    datum: Wgs84,
    start: Start,
    picker: Picker,
    poses: PoseEstimator,
    vehicle: Option<SystemId>,
    waiting: VecDeque<Picture>,
    ready: Vec<(Picture, Way)>,
    now: ServiceTime,
    gathered: Gathered,
}

impl Gatherer {
    fn new(mission: &Mission, start: Start, picker: Picker) -> Self {
        Self {
            rig: Arc::clone(&mission.rig),
            datum: mission.datum,
            start,
            picker,
            poses: PoseEstimator::new(mission.pose),
            vehicle: (mission.system_id != 0).then_some(SystemId(mission.system_id)),
            waiting: VecDeque::new(),
            ready: Vec::new(),
            now: ServiceTime::from_unix_ns(0),
            gathered: Gathered::default(),
        }
    }

    fn take_mavlink(&mut self, arrived: ServiceTime, received: &Received) {
        self.now = self.now.max(arrived);
        let Ok(telemetry) = &received.telemetry else {
            return;
        };
        if let Telemetry::Heartbeat(heartbeat) = telemetry
            && Heartbeat::is_autopilot(heartbeat)
        {
            self.vehicle.get_or_insert(received.system());
        }
        let sender = received.frame.sender();
        if Some(sender.system) == self.vehicle && sender.component == ComponentId::AUTOPILOT {
            self.take_telemetry(telemetry);
            self.work_off(LATE);
        }
    }

    fn take_telemetry(&mut self, telemetry: &Telemetry) {
        let now = self.now;
        match telemetry {
            Telemetry::Attitude(s) => {
                self.poses
                    .add_attitude(s.boot, now, s.attitude, s.rate_rad_s);
            }
            Telemetry::GlobalPosition(p) => self.poses.add_position(
                p.boot,
                now,
                (p.latitude_deg, p.longitude_deg),
                p.altitude,
                p.velocity_ned_m_s,
            ),
            Telemetry::GpsRaw(raw) => self.take_gnss(raw),
            Telemetry::TimeSync(sync) if !sync.is_request() => {
                self.poses.add_timesync(TimeSyncSample {
                    asked: ServiceTime::from_unix_ns(sync.ts1_ns),
                    remote: BootTime::from_ns(sync.tc1_ns),
                    answered: now,
                });
            }
            _ => {}
        }
    }

    fn take_gnss(&mut self, raw: &GpsRaw) {
        let place = raw.place;
        let separation = place.and_then(|p| p.height.map(|height| height - p.altitude));
        let sigmas = (raw.horizontal_sigma_m, raw.vertical_sigma_m);
        self.poses
            .add_gnss(self.now, raw.fix.is_3d(), sigmas, separation);
    }

    fn take_pair(&mut self, pair: Stamped<StereoPair>) {
        self.now = self.now.max(pair.value.arrived);
        let number = self.gathered.pairs;
        self.gathered.pairs += 1;
        if self.waiting.len() == WAITING {
            self.waiting.pop_front();
            self.gathered.without_way += 1;
        }
        self.waiting.push_back(Picture {
            number,
            at: pair.at,
            left: pair.value.left,
            right: pair.value.right,
        });
    }

    /// Looks at what is ready: boards in parallel, since looking for one takes longest.
    fn look(&mut self) {
        let ready = std::mem::take(&mut self.ready);
        let rig = Arc::clone(&self.rig);
        let found: Vec<Option<Found>> = match &mut self.picker {
            Picker::Picks(picks) => {
                let pick = |number| {
                    Some(Found {
                        pixel: *picks.picks.get(&number)?,
                        sigma_px: PICK_SIGMA_PX,
                        stereo: None,
                    })
                };
                ready
                    .iter()
                    .map(|(picture, _)| pick(picture.number))
                    .collect()
            }
            Picker::Board(board) => ready
                .par_iter()
                .map(|(picture, way)| {
                    let window = window(&self.start, way)?;
                    middle_in(board, &rig, picture, window)
                })
                .collect(),
            Picker::Fire(detector) => ready
                .iter()
                .map(|(picture, _)| fire_in(detector.as_mut(), &rig, picture))
                .collect(),
            Picker::Flame(detector, ranger) => ready
                .iter()
                .map(|(picture, _)| flame_in((detector.as_mut(), ranger.as_mut()), &rig, picture))
                .collect(),
        };
        for ((picture, way), found) in ready.into_iter().zip(found) {
            if let Some(found) = found {
                self.gathered.seen += 1;
                self.gathered.sights.push(Sight {
                    at: picture.at,
                    pixel: found.pixel,
                    sigma_px: found.sigma_px,
                    way,
                    stereo: found.stereo,
                });
            }
        }
    }

    /// Gives a way to every picture whose telemetry has come.
    fn work_off(&mut self, late: SignedDuration) {
        while let Some(picture) = self.waiting.front() {
            let moment = picture.at + seconds(self.rig.time_offset_s());
            if self.now < moment + seconds(REACH_S) + late {
                return;
            }
            let way = self.way(moment);
            match (self.waiting.pop_front(), way) {
                (Some(picture), Some(way)) => self.ready.push((picture, way)),
                _ => self.gathered.without_way += 1,
            }
            if self.ready.len() == BATCH {
                self.look();
            }
        }
    }

    fn way(&self, moment: ServiceTime) -> Option<Way> {
        let steps = (REACH_S / STEP_S).round() as i32;
        let pose = |step| {
            let then = moment + seconds(f64::from(step) * STEP_S);
            match self.poses.at(then, self.now) {
                PoseAnswer::Fresh(pose) => Some(pose),
                _ => None,
            }
        };
        let body = |step| Some(BodyAt::new(pose(step)?.as_ref(), &self.datum));
        Some(Way {
            from_s: -f64::from(steps) * STEP_S,
            step_s: STEP_S,
            time_sigma_s: pose(0)?.time_sigma_s,
            bodies: (-steps..=steps).map(body).collect::<Option<Vec<_>>>()?,
        })
    }

    fn finish(mut self) -> Gathered {
        // Nothing more will come: what there is has to do, or not.
        self.work_off(seconds(-REACH_S));
        self.gathered.without_way += self.waiting.len() as u64;
        self.look();
        self.gathered
    }
}
