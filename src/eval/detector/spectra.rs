//! What a second spectrum brings: simulated pairs of a visible and a near-infrared eye, looked at with each
//! alone and with both.
//!
//! The scenes are those of [`super::events`]. The right eye sees near infrared, in which foliage, roofs and
//! soil are bright and colours are gone. Its model is the one that is told for it; `ember-nano` itself knows
//! flames by their shape well enough to serve.

use super::coco::{OVERLAPS, Thing};
use super::events::scene::{FLIGHT_S, Scene};
use super::events::{EventsError, RightEye, rig};
use super::report::fire_table;
use super::scores::{ClassScore, Shown, class_score};
use super::{DetectorEvalError, FLOOR, Scored};
use crate::detect::fuse::{Fused, FusionConfig, Verdict};
use crate::detect::{
    BoxPx, Detection, DetectionClass, Detector, DetectorConfig, LeftImage, ModelError, OnnxDetector,
};
use crate::eval::{Report, Table};
use crate::pipeline::spectra::Geometry;
use emberfix_calib::{Eye, Rig};
use emberfix_frames::ServiceTime;
use emberfix_report::Figure;
use emberfix_sim::noise::stream;
use emberfix_sim::render::{Frame, LabelBox, PixelFormat, Renderer, StereoCamera};
use emberfix_sim::world::BurningClass;
use indicatif::ProgressBar;
use opencv::core::{Mat, MatTraitConst};
use opencv::imgproc;
use rand::Rng;
use std::collections::BTreeMap;
use std::sync::Arc;

/// What is measured.
#[derive(Debug, Clone)]
pub struct Options {
    /// The left eye's model.
    pub model: DetectorConfig,
    /// The right eye's.
    pub right_model: DetectorConfig,
    /// How both are heard.
    pub fusion: FusionConfig,
    /// Scenes, one pair each.
    pub scenes: usize,
    /// Of the scenes.
    pub seed: u64,
}

/// Least score of one eye that counts, where nobody says.
const ALONE: f64 = 0.6;
/// Names of what stands in the table.
const NAMES: [&str; 3] = ["visible alone", "near infrared alone", "both, fused"];

/// Measures.
///
/// # Errors
/// [`DetectorEvalError`].
pub fn measure(options: &Options, bar: &ProgressBar) -> Result<Report, DetectorEvalError> {
    let rig = rig(RightEye::NearInfrared)?;
    let looked = look(options, &rig, bar)?;
    Ok(judge(options, &rig, &looked))
}

/// What both eyes' detectors found in one pair, and what burns in the left picture.
pub struct Looked {
    eyes: [Vec<Detection>; 2],
    truth: Vec<(DetectionClass, Thing)>,
}

/// Draws the pairs and looks at them.
///
/// # Errors
/// [`DetectorEvalError`].
pub fn look(
    options: &Options,
    rig: &Rig,
    bar: &ProgressBar,
) -> Result<Vec<Looked>, DetectorEvalError> {
    let mut detectors = [load(&options.model)?, load(&options.right_model)?];
    let mut all = Vec::new();
    for scene in 0..options.scenes {
        let pair = Pair::drawn(rig, options.seed, scene)?;
        let [left, right] = [0, 1].map(|eye| looked(&mut detectors[eye], &pair.eyes[eye], scene));
        all.push(Looked {
            eyes: [left?, right?],
            truth: pair.truth,
        });
        bar.inc(1);
    }
    Ok(all)
}

/// Fuses and scores what was found.
#[must_use]
pub fn judge(options: &Options, rig: &Rig, looked: &[Looked]) -> Report {
    let mut book = Book::default();
    looked.iter().for_each(|pair| book.note(options, rig, pair));
    book.report(options)
}

/// A model at a threshold so low that its whole curve is seen.
fn load(model: &DetectorConfig) -> Result<OnnxDetector, ModelError> {
    OnnxDetector::load(&DetectorConfig {
        threshold: Some(FLOOR),
        tile_px: None,
        ..model.clone()
    })
}

fn looked(
    detector: &mut OnnxDetector,
    bgr: &Mat,
    number: usize,
) -> Result<Vec<Detection>, DetectorEvalError> {
    let image = LeftImage {
        at: ServiceTime::from_unix_ns(0),
        sequence: number as u64,
        bgr: bgr.clone(),
        ground: None,
    };
    let found = detector.detect(&image);
    found.map_err(|source| DetectorEvalError::Detect { number, source })
}

/// Both eyes' pictures of a moment, and what burns in the left one.
struct Pair {
    eyes: [Mat; 2],
    truth: Vec<(DetectionClass, Thing)>,
}

impl Pair {
    fn drawn(rig: &Rig, seed: u64, number: usize) -> Result<Self, DetectorEvalError> {
        let mut rng = stream(seed, &format!("pair {number}"));
        let scene = Scene::draw(&mut rng, number).map_err(EventsError::from)?;
        let camera = StereoCamera::new(rig);
        let renderer = Renderer::new(Arc::new(scene.world.clone()), camera, scene.exposure);
        let t_s = rng.random_range(0.0..FLIGHT_S);
        let body = scene.body(t_s);
        let labels = renderer.label_boxes(&body, t_s);
        let [left, right] =
            [Eye::Left, Eye::Right].map(|eye| bgr(&renderer.render(eye, &body, t_s)));
        Ok(Self {
            eyes: [left?, right?],
            truth: labels.iter().map(truth).collect(),
        })
    }
}

fn bgr(frame: &Frame) -> opencv::Result<Mat> {
    let (rows, columns) = (frame.height as i32, frame.width as i32);
    match frame.format {
        PixelFormat::Bgr8 => Ok(Mat::from_slice(&frame.bytes)?
            .reshape(3, rows)?
            .try_clone()?),
        PixelFormat::Mono8 => {
            let gray = Mat::new_rows_cols_with_data(rows, columns, &frame.bytes)?;
            let mut bgr = Mat::default();
            imgproc::cvt_color_def(&gray, &mut bgr, imgproc::COLOR_GRAY2BGR)?;
            Ok(bgr)
        }
    }
}

fn truth(label: &LabelBox) -> (DetectionClass, Thing) {
    let class = match label.class {
        BurningClass::Fire => DetectionClass::Fire,
        BurningClass::Smoke => DetectionClass::Smoke,
    };
    let box_px = BoxPx {
        x: label.left_px,
        y: label.top_px,
        width: label.right_px - label.left_px,
        height: label.bottom_px - label.top_px,
    };
    let thing = Thing {
        box_px,
        mask: None,
        score: 1.0,
    };
    (class, thing)
}

/// What was found in all pairs.
#[derive(Default)]
struct Book {
    shown: Vec<Shown>,
    /// By way of looking, by pair, the surest first.
    found: [Vec<Vec<(DetectionClass, Thing)>>; 3],
    /// Fused boxes of fire from the threshold up, by rule: right, wrong.
    verdicts: BTreeMap<Verdict, [usize; 2]>,
}

impl Book {
    fn note(&mut self, options: &Options, rig: &Rig, pair: &Looked) {
        let [left, right] = &pair.eyes;
        let geometry = Geometry {
            rig,
            ground: None,
            has_right: true,
        };
        // An eye alone is held against no other.
        let alone = FusionConfig {
            one_sided: 1.0,
            right_trust: 1.0,
            threshold: FLOOR,
            ..options.fusion
        };
        let both = FusionConfig {
            threshold: FLOOR,
            ..options.fusion
        };
        let ways = [
            (&left[..], &[][..], alone),
            (&[][..], right, alone),
            (left, right, both),
        ];
        for (found, (left, right, config)) in self.found.iter_mut().zip(ways) {
            let fused = geometry.fuse(left, right, &config);
            found.push(fused.iter().map(thing).collect());
            if config == both {
                count(
                    &mut self.verdicts,
                    &fused,
                    &pair.truth,
                    options.fusion.threshold,
                );
            }
        }
        self.shown.push(Shown {
            clip: self.shown.len().to_string(),
            smoke_labelled: true,
            truth: pair.truth.clone(),
        });
    }

    fn report(&self, options: &Options) -> Report {
        let alone = options.model.threshold.unwrap_or(ALONE);
        let thresholds = [alone, alone, options.fusion.threshold];
        let scored: Vec<Scored> = (0..NAMES.len())
            .map(|way| Scored {
                name: NAMES[way].to_owned(),
                classes: vec![class_score(
                    DetectionClass::Fire,
                    &self.shown,
                    &self.found[way],
                    thresholds[way],
                    1.0,
                )],
            })
            .collect();
        Report {
            figures: figures(&scored),
            details: serde_json::json!({"ways": scored, "rules": self.verdicts}),
            tables: vec![fire_table(&scored), self.rules()],
            plots: vec![],
        }
    }

    fn rules(&self) -> Table {
        let row = |(verdict, [right, wrong]): (&Verdict, &[usize; 2])| {
            let name = match verdict {
                Verdict::Agreement => "agreement",
                Verdict::OneSided => "one-sided",
                Verdict::Conflict => "conflict",
            };
            vec![name.to_owned(), right.to_string(), wrong.to_string()]
        };
        Table {
            title: "Fused boxes of fire from the threshold up, by the rule that they came by"
                .to_owned(),
            header: ["rule", "right", "wrong"].map(str::to_owned).to_vec(),
            rows: self.verdicts.iter().map(row).collect(),
        }
    }
}

fn thing(fused: &Fused) -> (DetectionClass, Thing) {
    let thing = Thing {
        box_px: fused.box_px,
        mask: None,
        score: fused.score,
    };
    (fused.class, thing)
}

fn count(
    verdicts: &mut BTreeMap<Verdict, [usize; 2]>,
    fused: &[Fused],
    truth: &[(DetectionClass, Thing)],
    threshold: f64,
) {
    let is_fire = |one: &&Fused| one.class == DetectionClass::Fire && one.score >= threshold;
    for one in fused.iter().filter(is_fire) {
        let is_right = truth.iter().any(|(class, thing)| {
            *class == DetectionClass::Fire && thing.box_px.iou(&one.box_px) >= OVERLAPS[0]
        });
        verdicts.entry(one.verdict).or_default()[usize::from(!is_right)] += 1;
    }
}

fn figures(scored: &[Scored]) -> Vec<Figure> {
    let names = ["ap50_visible_eye", "ap50_infrared_eye", "ap50_fused"];
    let ap50 = |fire: &ClassScore| fire.ap50.map(|interval| interval.value);
    let told = |(name, scored): (&str, &Scored)| {
        let fire = &scored.classes[0];
        Figure::told(format!("detector.{name}"), ap50(fire), "", fire.truths)
    };
    names.into_iter().zip(scored).map(told).collect()
}
