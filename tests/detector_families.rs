//! Detectors of every family, run by ONNX Runtime and read by us, against an independent program that runs
//! and reads the same models in NumPy.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/clients.rs"]
#[expect(
    dead_code,
    reason = "nothing is started here that has to be stopped again"
)]
mod clients;
#[expect(dead_code, reason = "no mission is flown here")]
mod support;

use clients::Clients;
use emberfix::detect::{
    BoxPx, Detection, DetectionClass, Detector, DetectorConfig, LeftImage, ModelError, OnnxDetector,
};
use emberfix_frames::ServiceTime;
use emberfix_report::{Bound, Figure};
use opencv::core::MatTraitConst;
use opencv::imgcodecs::{IMREAD_COLOR, imread};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// What the other program found with one model.
#[derive(Deserialize)]
struct Truth {
    picture: String,
    threshold: f64,
    /// Left, top, right, bottom, score, class.
    boxes: Vec<[f64; 6]>,
    masks: Option<Vec<Vec<usize>>>,
}

/// The worst agreement of one model.
struct Agreement {
    box_iou: f64,
    mask_iou: Option<f64>,
    boxes: usize,
}

fn detect(folder: &Path, name: &str, truth: &Truth) -> Option<(Vec<Detection>, usize)> {
    let config = DetectorConfig {
        threshold: Some(truth.threshold),
        tile_px: None,
        ..DetectorConfig::new(folder.join(format!("{name}.onnx")))
    };
    let mut detector = match OnnxDetector::load(&config) {
        Err(ModelError::RuntimeMissing { .. }) => return None,
        loaded => loaded.unwrap(),
    };
    let picture = folder.join(&truth.picture);
    let bgr = imread(picture.to_str().unwrap(), IMREAD_COLOR).unwrap();
    let width = bgr.cols() as usize;
    let image = LeftImage {
        at: ServiceTime::from_unix_ns(0),
        sequence: 0,
        bgr,
        ground: None,
    };
    Some((detector.detect(&image).unwrap(), width))
}

/// Both lists are the surest first; of equal scores the box decides which is which.
fn agreement(found: &[Detection], truth: &Truth, width: usize) -> Agreement {
    let mut agreed = Agreement {
        box_iou: 1.0,
        mask_iou: truth.masks.as_ref().map(|_| 1.0),
        boxes: found.len(),
    };
    assert_eq!(found.len(), truth.boxes.len());
    for (index, row) in truth.boxes.iter().enumerate() {
        let [left, top, right, bottom, score, class] = *row;
        let expected = BoxPx {
            x: left,
            y: top,
            width: right - left,
            height: bottom - top,
        };
        let class = [DetectionClass::Fire, DetectionClass::Smoke][class as usize];
        // Sums of f32 in another order.
        let same = |one: &&Detection| one.class == class && (one.score - score).abs() < 1e-4;
        let (iou, ours) = found
            .iter()
            .filter(same)
            .map(|one| (one.box_px.iou(&expected), one))
            .max_by(|a, b| a.0.total_cmp(&b.0))
            .unwrap();
        agreed.box_iou = agreed.box_iou.min(iou);
        if let (Some(worst), Some(masks)) = (&mut agreed.mask_iou, &truth.masks) {
            *worst = worst.min(mask_iou(ours, &masks[index], width));
        }
    }
    agreed
}

fn mask_iou(ours: &Detection, theirs: &[usize], width: usize) -> f64 {
    let pixels = ours.mask.as_ref().unwrap().pixels();
    let ours: BTreeSet<usize> = pixels
        .map(|(column, row)| row as usize * width + column as usize)
        .collect();
    let theirs: BTreeSet<usize> = theirs.iter().copied().collect();
    let either = ours.union(&theirs).count();
    if either == 0 {
        return 1.0;
    }
    ours.intersection(&theirs).count() as f64 / either as f64
}

#[test]
fn every_family_finds_what_an_independent_program_finds() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    clients.run("detector_families.py", [folder]).json();
    let truth = std::fs::read(folder.join("truth.json")).unwrap();
    let truth: BTreeMap<String, Truth> = serde_json::from_slice(&truth).unwrap();
    let mut worst = Agreement {
        box_iou: 1.0,
        mask_iou: None,
        boxes: 0,
    };
    for (name, truth) in &truth {
        let Some((found, width)) = detect(folder, name, truth) else {
            println!("skipped: no ONNX Runtime");
            return;
        };
        let agreed = agreement(&found, truth, width);
        let masks = agreed.mask_iou.map(|iou| format!(", masks {iou:.5}"));
        println!(
            "{name:24} {:4} boxes, worst IoU {:.6}{}",
            agreed.boxes,
            agreed.box_iou,
            masks.unwrap_or_default()
        );
        // A few boxes, or the comparison says little.
        assert!(agreed.boxes >= 5, "{name}");
        worst.box_iou = worst.box_iou.min(agreed.box_iou);
        worst.mask_iou = agreed.mask_iou.or(worst.mask_iou);
        worst.boxes += agreed.boxes;
    }
    let figure = Figure::bounded(
        "detector.decode_parity_iou",
        Some(worst.box_iou),
        "",
        Bound::AtLeast(0.999),
        worst.boxes,
    );
    println!("{figure}");
    assert!(figure.holds, "{figure}");
    // A mask's edge pixels hang on signs of sums near zero.
    assert!(worst.mask_iou.unwrap() >= 0.99);
}
