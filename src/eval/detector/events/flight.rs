//! One rendered flight through the code that flies, and what is true of what it found.

use super::EventsError;
use super::scene::{FLIGHT_S, LOOKS_HZ, Scene};
use crate::alarm::{AlarmClass, FireId};
use crate::detect::{BoxPx, DetectorConfig};
use crate::ingest::{EncodedImage, ImageEncoding, StereoPair};
use crate::locate::{ConstantPlane, SharedPriors, View};
use crate::pipeline::{Counters, Vision};
use crate::pose::Pose;
use crate::range::{Method, RangeConfig};
use crate::track::event::FEATURES;
use crate::track::{Fire, TrackConfig, Tracker};
use emberfix_calib::{Eye, Rig};
use emberfix_frames::{
    Attitude, Coordinate, EllipsoidHeight, Metres, MissionEnu, ServiceTime, SignedDuration,
    Stamped, Vector3, Wgs84, ecef_from_enu, place_from_degrees, place_from_ecef, seconds,
};
use emberfix_sim::noise::{GaussMarkov, normal, stream};
use emberfix_sim::render::{Frame, LabelBox, Renderer, StereoCamera};
use emberfix_sim::state::BodyState;
use emberfix_sim::world::{BurningClass, LookalikeKind};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Errors of a consumer autopilot, one sigma, and how long they last.
const GNSS_M: (f64, f64) = (1.5, 2.5);
const GNSS_S: f64 = 90.0;
const HEADING_RAD: f64 = 0.02;
const TILT_RAD: f64 = 0.007;
/// What is known of the ground's height, one sigma, metres.
const GROUND_M: f64 = 2.0;
/// A box of something true overlaps it by so much at least: boxes of flames are a matter of taste.
const OVERLAP: f64 = 0.2;
/// Or holds so much of it, or is held by it: a tongue of a flame is no false alarm.
const PART: f64 = 0.6;
/// A fire that is in the picture for fewer looks (ten seconds) is not there to be found.
const LEAST_LOOKS: usize = 25;

/// What a track was at one look.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Moment {
    /// Looks that saw it so far.
    pub hits: u32,
    /// What the model weighs.
    pub features: [f64; FEATURES],
    /// What the model said.
    pub probability: f64,
    /// Whether most of its sightings so far were of something that burns.
    pub burns: bool,
}

/// One track of a flight.
#[derive(Debug, Clone, Serialize)]
pub struct Tracked {
    /// Whether most of its sightings were of something that burns.
    pub burns: bool,
    /// What burned where most of its sightings were when it was told, if it was: one box may hold two fires, and
    /// where there is none, that was a false incident.
    pub told: Option<Vec<usize>>,
    /// The lookalike that it was placed nearest to, and how far off, metres.
    pub nearest: Option<(LookalikeKind, f64)>,
    /// Look by look.
    pub moments: Vec<Moment>,
}

/// A fire that was there to be found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct There {
    /// Its number in the world.
    pub fire: usize,
    /// Looks that it could be seen in.
    pub visible: usize,
    /// Those in which the detector boxed it.
    pub seen: usize,
    /// Mean width in the picture, pixels.
    pub width_px: f64,
    /// Whether an incident was told of it.
    pub told: bool,
}

/// What a flight came to.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Flown {
    /// Seconds.
    pub flown_s: f64,
    /// All tracks.
    pub tracks: Vec<Tracked>,
    /// All fires.
    pub fires: Vec<There>,
    /// Boxes of what does not burn, over all looks.
    pub false_boxes: usize,
}

/// Flies one.
///
/// # Errors
/// [`EventsError`].
pub fn fly(
    rig: &Arc<Rig>,
    model: &DetectorConfig,
    seed: u64,
    flight: usize,
) -> Result<Flown, EventsError> {
    let mut rng = stream(seed, &format!("evidence {flight}"));
    let scene = Scene::draw(&mut rng, flight)?;
    let renderer = Renderer::new(
        Arc::new(scene.world.clone()),
        StereoCamera::new(rig),
        scene.exposure,
    );
    let ranger = crate::range::open(Method::default(), rig, &RangeConfig::default())?;
    let mut vision = Vision::new(rig, crate::detect::open(model)?, ranger);
    let autopilot = Autopilot::new(&mut rng)?;
    let ground = ConstantPlane {
        height: EllipsoidHeight::from_m(autopilot.datum_up_m + GROUND_M * normal(&mut rng)),
        sigma_m: GROUND_M,
    };
    let mut tracker = Tracker::new(TrackConfig::default(), FireId(1));
    let mut book = Book::default();
    let mut counters = Counters::default();
    let looks = (FLIGHT_S * LOOKS_HZ) as usize;
    for look in 0..looks {
        let t_s = look as f64 / LOOKS_HZ;
        let body = scene.body(t_s);
        let frame = renderer.render(Eye::Left, &body, t_s);
        let labels = renderer.label_boxes(&body, t_s);
        let Some(seen) = vision.look(&pair(frame, look), None, &mut counters) else {
            continue;
        };
        let Some(pose) = autopilot.pose(&body) else {
            continue;
        };
        let priors = SharedPriors {
            heading_rad: HEADING_RAD,
            tilt_rad: TILT_RAD,
            ..SharedPriors::default()
        };
        let view = View::new(rig, &pose, &priors, &autopilot.datum);
        let sightings: Vec<_> = seen.sightings.iter().map(|(_, seen)| *seen).collect();
        let outcomes = tracker.step(&view, &sightings, Some(&ground));
        let found: Vec<Found> = outcomes
            .iter()
            .map(|outcome| {
                let (found, classified) = &seen.sightings[outcome.index];
                Found {
                    box_px: seen.found[*found].box_px,
                    class: classified.class,
                    fire: outcome.fire,
                }
            })
            .collect();
        let burning = renderer.burning_boxes(&body, t_s);
        book.note(&labels, &burning, &found, tracker.fires());
    }
    Ok(book.closed(looks as f64 / LOOKS_HZ, &scene))
}

fn pair(frame: Frame, look: usize) -> Stamped<StereoPair> {
    let at = ServiceTime::from_unix_ns(0) + seconds(look as f64 / LOOKS_HZ);
    let left = EncodedImage {
        encoding: ImageEncoding::Raw {
            encoding: "bgr8".to_owned(),
            width: frame.width,
            height: frame.height,
            step: 3 * frame.width,
        },
        bytes: frame.bytes.into(),
        at,
    };
    let value = StereoPair {
        sequence: look as u64,
        arrived: at,
        left,
        right: None,
        skew: SignedDuration::from_secs(0),
        spectra: Vec::new(),
    };
    Stamped { at, value }
}

/// What the autopilot says of where it is.
struct Autopilot {
    datum: Wgs84,
    datum_up_m: f64,
    gnss: [GaussMarkov; 3],
    heading_off_rad: f64,
    tilt_off_rad: f64,
}

impl Autopilot {
    fn new(rng: &mut ChaCha8Rng) -> Result<Self, EventsError> {
        let datum_up_m = 11.0;
        let height = EllipsoidHeight::from_m(datum_up_m);
        let mut gnss = |sigma| GaussMarkov::new(rng, sigma, GNSS_S, FLIGHT_S);
        Ok(Self {
            datum: place_from_degrees(31.409_422_2, 119.112_016_7, height)?,
            datum_up_m,
            gnss: [gnss(GNSS_M.0), gnss(GNSS_M.0), gnss(GNSS_M.1)],
            heading_off_rad: HEADING_RAD * normal(rng),
            tilt_off_rad: TILT_RAD * normal(rng),
        })
    }

    fn pose(&self, body: &BodyState) -> Option<Pose> {
        let [east, north, up] = &self.gnss;
        let off = Vector3::new(east.at(body.t_s), north.at(body.t_s), up.at(body.t_s));
        let reported = Coordinate::<MissionEnu>::from_metres(body.position_m + off);
        let nose = body.enu_from_body.column(0);
        let (heading, pitch) = (nose.x.atan2(nose.y), nose.z.asin());
        Some(Pose {
            at: ServiceTime::from_unix_ns(0) + seconds(body.t_s),
            place: place_from_ecef(&ecef_from_enu(&self.datum).transform(reported))?,
            attitude: Attitude::from_angles(
                0.0,
                pitch + self.tilt_off_rad,
                heading + self.heading_off_rad,
            ),
            velocity_enu_m_s: body.velocity_m_s,
            rate_rad_s: body.rate_rad_s,
            gnss_horizontal_m: GNSS_M.0,
            gnss_vertical_m: GNSS_M.1,
            attitude_noise_rad: 0.002,
            position_noise_m: 0.03,
            time_sigma_s: 0.002,
            degraded: BTreeSet::new(),
        })
    }
}

/// One sighting and the fire that it was given to.
struct Found {
    box_px: BoxPx,
    class: AlarmClass,
    fire: Option<FireId>,
}

/// What was seen of everything, look by look.
#[derive(Default)]
struct Book {
    tracks: BTreeMap<FireId, Page>,
    /// Looks that showed each fire, those that boxed it, and its widths' sum.
    fires: BTreeMap<usize, (usize, usize, f64)>,
    false_boxes: usize,
}

#[derive(Default)]
struct Page {
    sightings: u32,
    /// Of what does not burn.
    wrong: u32,
    /// Of each thing that burns.
    of: BTreeMap<usize, u32>,
    told: Option<Vec<usize>>,
    /// Where it was last.
    position_m: Vector3<f64>,
    moments: Vec<Moment>,
}

impl Book {
    /// `labels` are what can be seen, `burning` is all that burns: a place that burns is one whose flame is hidden too.
    fn note(&mut self, labels: &[LabelBox], burning: &[LabelBox], found: &[Found], fires: &[Fire]) {
        let flames = labels
            .iter()
            .filter(|label| label.class == BurningClass::Fire);
        for label in flames {
            let (visible, seen, width) = self.fires.entry(label.fire).or_default();
            *visible += 1;
            *width += label.right_px - label.left_px;
            *seen += usize::from(found.iter().any(|one| overlaps(label, one)));
        }
        for one in found {
            let all = labels.iter().chain(burning);
            let burning: BTreeSet<usize> = all
                .filter(|label| overlaps(label, one))
                .map(|label| label.fire)
                .collect();
            self.false_boxes += usize::from(burning.is_empty());
            let tracked = one
                .fire
                .and_then(|id| fires.iter().find(|fire| fire.id == id));
            if let Some(fire) = tracked {
                let page = self.tracks.entry(fire.id).or_default();
                page.sightings += 1;
                page.wrong += u32::from(burning.is_empty());
                for fire in &burning {
                    *page.of.entry(*fire).or_default() += 1;
                }
                page.position_m = fire.position().metres();
                page.moments.push(Moment {
                    hits: fire.evidence.hits(),
                    features: fire.event.features(),
                    probability: fire.event.probability(),
                    burns: page.burns(),
                });
            }
        }
        for fire in fires
            .iter()
            .filter(|fire| fire.is_confirmed() && fire.merged_into.is_none())
        {
            let page = self.tracks.entry(fire.id).or_default();
            if page.told.is_none() {
                page.told = Some(page.truth());
            }
        }
    }

    fn closed(self, flown_s: f64, scene: &Scene) -> Flown {
        let pages = self.tracks.into_values();
        let tracks: Vec<Tracked> = pages.map(|page| page.closed(scene)).collect();
        let there = |(fire, (visible, seen, width)): (usize, (usize, usize, f64))| There {
            fire,
            visible,
            seen,
            width_px: width / visible as f64,
            told: tracks
                .iter()
                .filter_map(|track| track.told.as_ref())
                .any(|told| told.contains(&fire)),
        };
        let fires = self
            .fires
            .into_iter()
            .filter(|(_, (visible, ..))| *visible >= LEAST_LOOKS);
        Flown {
            flown_s,
            fires: fires.map(there).collect(),
            tracks,
            false_boxes: self.false_boxes,
        }
    }
}

impl Page {
    fn burns(&self) -> bool {
        2 * self.wrong <= self.sightings
    }

    /// What half of its sightings so far were of, or most; nothing where most were of what does not burn.
    fn truth(&self) -> Vec<usize> {
        let most = self.of.values().max();
        let is_it = |n: &u32| 2 * n >= self.sightings || (self.burns() && Some(n) == most);
        let truth = self.of.iter().filter(|(_, n)| is_it(n));
        truth.map(|(fire, _)| *fire).collect()
    }

    fn closed(self, scene: &Scene) -> Tracked {
        Tracked {
            burns: self.burns(),
            told: self.told,
            nearest: scene.nearest(&self.position_m),
            moments: self.moments,
        }
    }
}

/// Whether a box shows something that burns: about all of it, or a part of its kind.
fn overlaps(label: &LabelBox, one: &Found) -> bool {
    let found = &one.box_px;
    let is_kind = (label.class == BurningClass::Fire) == (one.class == AlarmClass::Fire);
    let label = BoxPx {
        x: label.left_px,
        y: label.top_px,
        width: label.right_px - label.left_px,
        height: label.bottom_px - label.top_px,
    };
    let least_px2 = label.area_px2().min(found.area_px2());
    label.iou(found) >= OVERLAP || (is_kind && label.shared_px2(found) >= PART * least_px2)
}
