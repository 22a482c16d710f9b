//! One pair to sightings: decode, judge the eyes, detect, range.

use super::spectra::RightEye;
use super::{Counters, light};
use crate::alarm::AlarmClass;
use crate::assess::PLAIN_LEVEL;
use crate::assess::patch::{MARGIN, Patch, SIDE};
use crate::detect::{BoxPx, Detection, DetectionClass, Detector, GroundScale, LeftImage, Looked};
use crate::ingest::{EncodedImage, EyeHealth, EyeWatch, ImageDecoder, StereoPair};
use crate::locate::{DisparityOf, Sighting};
use crate::range::{Disparity, EyeComparer, EyesCompared, Ranger, Ranging, RawPair, Target};
use crate::track::Classified;
use emberfix_calib::{Eye, RawPixel, RectifiedPixel, Rig};
use emberfix_frames::{ServiceTime, SignedDuration, Stamped};
use opencv::core::{Mat, MatTraitConst, Point2f, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::MatTraitConstManual;
use std::sync::Arc;

/// What one pair showed.
#[derive(Debug, Clone)]
pub struct Seen {
    /// All detections.
    pub found: Vec<Detection>,
    /// Those that may become fires, each with its index in `found`.
    pub sightings: Vec<(usize, Classified)>,
    /// Flame that each of `sightings` shows, over the light of the scene; `None` where none is seen.
    pub flames: Vec<Option<f64>>,
    /// Near-infrared light of each, of the scene's, where the right eye sees that; `None` where it does
    /// not, or nobody knows where in its picture to look.
    pub near_infrared: Vec<Option<f64>>,
    /// True when the right eye was of no use.
    pub mono: bool,
    /// Both eyes against each other; once in `COMPARE_EVERY`.
    pub eyes: Option<EyesCompared>,
    /// The left image, raw.
    pub left_bgr: Mat,
    /// Where it was looked at.
    pub looked: Looked,
}

/// Decoder, detector and ranger of one rig.
pub struct Vision {
    rig: Arc<Rig>,
    decoder: ImageDecoder,
    left_watch: EyeWatch,
    right_watch: EyeWatch,
    detector: Box<dyn Detector>,
    right_eye: Option<RightEye>,
    ranger: Box<dyn Ranger>,
    comparer: Option<EyeComparer>,
    compared: Option<ServiceTime>,
}

/// How often the eyes are compared: often enough to tell a crew, seldom enough to cost nothing; a hair
/// under a second, so that each pair of a camera of one a second is.
pub const COMPARE_EVERY: SignedDuration = SignedDuration::from_millis(900);
/// Margin about a box for its light, as a share of the box: box edges jitter, light must not.
const GLOW_MARGIN: f64 = 0.25;
/// Jitter of a box's edges: pixels at least, and as a share of the box. A bed of embers has a radius of a
/// third of the flame's width, and from above its near rim is the lower edge.
const EDGE_PX: f64 = 2.0;
const EDGE_SHARE: f64 = 0.2;

impl Vision {
    /// For one rig.
    #[must_use]
    pub fn new(rig: &Arc<Rig>, detector: Box<dyn Detector>, ranger: Box<dyn Ranger>) -> Self {
        Self {
            rig: Arc::clone(rig),
            decoder: ImageDecoder::new(rig),
            left_watch: EyeWatch::default(),
            right_watch: EyeWatch::default(),
            detector,
            right_eye: None,
            ranger,
            // A rig that was rectified to be checked has maps.
            comparer: EyeComparer::new(rig).ok(),
            compared: None,
        }
    }

    /// The same, with a detector on a right eye that sees another spectrum.
    #[must_use]
    pub fn with_right_eye(mut self, right_eye: Option<RightEye>) -> Self {
        self.right_eye = right_eye;
        self
    }

    /// Looks at a pair; `ground` is how large things on the ground appear in its left image, where
    /// that is known. `None` when the left eye shows nothing that can be trusted; why is counted.
    pub fn look(
        &mut self,
        pair: &Stamped<StereoPair>,
        ground: Option<GroundScale>,
        counters: &mut Counters,
    ) -> Option<Seen> {
        let bgr = self.left(&pair.value.left, counters)?;
        let image = LeftImage {
            at: pair.at,
            sequence: pair.value.sequence,
            bgr,
            ground,
        };
        let mut found = match self.detector.detect(&image) {
            Ok(found) => found,
            Err(error) => {
                counters.add("detector", error.name());
                tracing::warn!(%error, "frame not used");
                return None;
            }
        };
        counters.add("pairs", "looked_at");
        let right_gray = self.right(pair.value.right.as_ref(), counters);
        if let Some(right_eye) = &mut self.right_eye {
            let right = (&image, right_gray.as_ref());
            found = right_eye.decide(&self.rig, &found, right, counters);
        }
        let raw = RawPair {
            at: pair.at,
            left_bgr: image.bgr,
            right_gray,
        };
        let mut sightings = Vec::new();
        for (index, detection) in found.iter().enumerate() {
            if let Some(classified) = self.sighting(&raw, detection, counters) {
                sightings.push((index, classified));
            }
        }
        let boxes: Vec<BoxPx> = found.iter().map(|detection| detection.box_px).collect();
        let scene = light::scene_level(&raw.left_bgr, &boxes);
        let flames = sightings
            .iter()
            .map(|(index, _)| light::flame(&raw.left_bgr, &boxes[*index], scene?))
            .collect();
        let near_infrared = self.near_infrared(&raw, &sightings, counters);
        Some(Seen {
            eyes: self.compare(&raw, counters),
            near_infrared,
            flames,
            found,
            sightings,
            mono: raw.right_gray.is_none(),
            left_bgr: raw.left_bgr,
            looked: self.detector.looked(),
        })
    }

    /// What a near-infrared right eye shows of each sighting.
    fn near_infrared(
        &self,
        pair: &RawPair,
        sightings: &[(usize, Classified)],
        counters: &mut Counters,
    ) -> Vec<Option<f64>> {
        let right = pair.right_gray.as_ref();
        let Some(grey) = right.filter(|_| self.rig.right_near_infrared()) else {
            return vec![None; sightings.len()];
        };
        let placed = sightings
            .iter()
            .map(|(_, seen)| self.right_box(&seen.sighting));
        let boxes: Vec<Option<BoxPx>> = placed.collect();
        let known: Vec<BoxPx> = boxes.iter().flatten().copied().collect();
        let scene = light::scene_level_grey(grey, &known);
        let mut shown = |found: &Option<BoxPx>| {
            let light = found
                .zip(scene)
                .and_then(|(found, scene)| light::near_infrared(grey, &found, scene));
            let name = match (found, light) {
                (None, _) => "no_disparity",
                (_, None) => "no_flame",
                _ => "seen",
            };
            counters.add("near_infrared", name);
            light
        };
        boxes.iter().map(&mut shown).collect()
    }

    /// A sighting's box in the right eye's raw picture, by its disparity.
    fn right_box(&self, sighting: &Sighting) -> Option<BoxPx> {
        let disparity_px = sighting.disparity?.px;
        let (width, height) = sighting.size_px;
        let rectification = self.rig.rectification();
        let corner = |across: f64, up: f64| {
            let pixel = RectifiedPixel {
                u: sighting.base.u - disparity_px + across * width,
                v: sighting.base.v - up * height,
            };
            rectification.unrectify(Eye::Right, pixel)
        };
        let (low, high) = (corner(-0.5, 0.0), corner(0.5, 1.0));
        Some(BoxPx {
            x: low.u,
            y: high.v,
            width: high.u - low.u,
            height: low.v - high.v,
        })
    }

    fn compare(&mut self, pair: &RawPair, counters: &mut Counters) -> Option<EyesCompared> {
        let due = self
            .compared
            .is_none_or(|last| pair.at - last >= COMPARE_EVERY);
        if !due || pair.right_gray.is_none() {
            return None;
        }
        self.compared = Some(pair.at);
        match self.comparer.as_ref()?.compare(pair) {
            Ok(compared) => Some(compared),
            Err(error) => {
                counters.add("self_check", "failed");
                tracing::warn!(%error, "eyes not compared");
                None
            }
        }
    }

    fn left(&mut self, image: &EncodedImage, counters: &mut Counters) -> Option<Mat> {
        let bgr = match self.decoder.left(image) {
            Ok(bgr) => bgr,
            Err(error) => {
                counters.add("left_eye", "undecodable");
                tracing::warn!(%error, "left image not used");
                return None;
            }
        };
        is_usable(&mut self.left_watch, image, &bgr, "left_eye", counters).then_some(bgr)
    }

    fn right(&mut self, image: Option<&EncodedImage>, counters: &mut Counters) -> Option<Mat> {
        let Some(image) = image else {
            counters.add("right_eye", "missing");
            return None;
        };
        let gray = match self.decoder.right(image) {
            Ok(gray) => gray,
            Err(error) => {
                counters.add("right_eye", "undecodable");
                tracing::warn!(%error, "right image not used");
                return None;
            }
        };
        is_usable(&mut self.right_watch, image, &gray, "right_eye", counters).then_some(gray)
    }

    fn sighting(
        &mut self,
        pair: &RawPair,
        detection: &Detection,
        counters: &mut Counters,
    ) -> Option<Classified> {
        let class = match detection.class {
            DetectionClass::Fire => AlarmClass::Fire,
            DetectionClass::Smoke => AlarmClass::Smoke,
            DetectionClass::NonFire => return None,
        };
        let target = Target {
            class: detection.class,
            box_px: detection.box_px,
        };
        let ranging = match self.ranger.range(pair, &target) {
            Ok(ranging) => Some(ranging),
            Err(error) => {
                counters.add("range", "failed");
                tracing::warn!(%error, "no stereo for this box");
                None
            }
        };
        if let Some(ranging) = &ranging {
            counters.add("range", name_of(ranging));
        }
        let sighting = self.place_in_rectified(pair, &detection.box_px, ranging.as_ref())?;
        Some(Classified {
            sighting,
            class,
            score: detection.score,
            second_look: detection.second_look,
            patch: patch(&pair.left_bgr, &detection.box_px),
        })
    }

    fn place_in_rectified(
        &self,
        pair: &RawPair,
        box_px: &BoxPx,
        ranging: Option<&Ranging>,
    ) -> Option<Sighting> {
        let (u, v) = box_px.base();
        let rectification = self.rig.rectification();
        let base: RectifiedPixel = *rectification
            .rectify(Eye::Left, &[RawPixel { u, v }])
            .ok()?
            .first()?;
        let camera = self.rig.camera(Eye::Left);
        let scale = (
            rectification.focal_px() / camera.focal_px.0,
            rectification.focal_px() / camera.focal_px.1,
        );
        let size_px = (box_px.width * scale.0, box_px.height * scale.1);
        let (disparity, at_least_m) = ranging.map_or((None, None), evidence);
        Some(Sighting {
            at: pair.at,
            base,
            base_sigma_px: (
                EDGE_PX.max(EDGE_SHARE * size_px.0),
                EDGE_PX.max(EDGE_SHARE * size_px.1),
            ),
            size_px,
            disparity,
            glow: glow(&pair.left_bgr, box_px),
            at_least_m,
        })
    }
}

/// What the estimator gets of a ranging: the disparity, a weak one too, and the depth that it excludes.
fn evidence(ranging: &Ranging) -> (Option<DisparityOf>, Option<f64>) {
    let of = |disparity: Disparity| DisparityOf {
        px: disparity.px,
        sigma_px: disparity.sigma_px,
        centroid: disparity.centroid,
    };
    match *ranging {
        Ranging::Measured {
            disparity_px,
            sigma_px,
            centroid,
            ..
        } => {
            let measured = DisparityOf {
                px: disparity_px,
                sigma_px,
                centroid,
            };
            (Some(measured), None)
        }
        Ranging::BeyondReach {
            at_least_m, weak, ..
        } => (Some(of(weak)), Some(at_least_m)),
        Ranging::NoMatch { .. } => (None, None),
    }
}

/// What a box and its margin look like, by green and red, in which flames are bright.
fn patch(bgr: &Mat, box_px: &BoxPx) -> Option<Patch> {
    let side = (MARGIN * box_px.width.max(box_px.height)).ceil().max(8.0) as i32;
    let (column, row) = box_px.centre();
    let middle = Point2f::new(column as f32, row as f32);
    let (mut cut, mut small) = (Mat::default(), Mat::default());
    imgproc::get_rect_sub_pix_def(bgr, Size::new(side, side), middle, &mut cut).ok()?;
    let cells = Size::new(SIDE as i32, SIDE as i32);
    imgproc::resize(&cut, &mut small, cells, 0.0, 0.0, imgproc::INTER_AREA).ok()?;
    let pixels = small.data_typed::<Vec3b>().ok()?;
    let levels = pixels.iter().map(|pixel| pixel[1] / 2 + pixel[2] / 2);
    Some(Patch(levels.collect::<Vec<u8>>().try_into().ok()?))
}

/// Light of a box and a margin about it (see [`Sighting::glow`]).
fn glow(bgr: &Mat, box_px: &BoxPx) -> Option<f64> {
    let margin = |length: f64| GLOW_MARGIN * length;
    let clamp = |value: f64, size: i32| (value.round() as i32).clamp(0, size);
    let left = clamp(box_px.x - margin(box_px.width), bgr.cols());
    let right = clamp(box_px.x + box_px.width + margin(box_px.width), bgr.cols());
    let upper = clamp(box_px.y - margin(box_px.height), bgr.rows());
    let lower = clamp(box_px.y + box_px.height + margin(box_px.height), bgr.rows());
    let mut sum = 0.0;
    for row in upper..lower {
        let pixels = bgr.at_row::<Vec3b>(row).ok()?;
        for pixel in pixels.get(left as usize..right as usize)? {
            let level = (f64::from(pixel[1]) + f64::from(pixel[2])) / 2.0;
            sum += (level - PLAIN_LEVEL).max(0.0);
        }
    }
    Some(sum)
}

fn name_of(ranging: &Ranging) -> &'static str {
    match ranging {
        Ranging::Measured { .. } => "measured",
        Ranging::BeyondReach { .. } => "beyond_reach",
        Ranging::NoMatch { why } => why.name(),
    }
}

fn is_usable(
    watch: &mut EyeWatch,
    image: &EncodedImage,
    pixels: &Mat,
    eye: &'static str,
    counters: &mut Counters,
) -> bool {
    let fault = match watch.check(image, pixels) {
        Ok(EyeHealth::Good) => return true,
        Ok(EyeHealth::Black { .. }) => "black",
        Ok(EyeHealth::Saturated { .. }) => "saturated",
        Ok(EyeHealth::Frozen { .. }) => "frozen",
        Err(_) => "unreadable",
    };
    counters.add(eye, fault);
    false
}
