//! Truth and findings as COCO's JSON files, for any other program that scores detectors.

use super::coco::Thing;
use super::scores::Shown;
use crate::detect::{DetectionClass, Mask};
use serde_json::{Value, json};

/// Classes by their numbers in the files.
const CATEGORIES: [(DetectionClass, u32, &str); 2] = [
    (DetectionClass::Fire, 1, "fire"),
    (DetectionClass::Smoke, 2, "smoke"),
];

/// Pictures and what is there; picture sizes are columns and rows.
pub fn truth(shown: &[Shown], sizes: &[(u32, u32)]) -> Value {
    let images: Vec<Value> = (1..)
        .zip(sizes)
        .map(|(id, (width, height))| json!({"id": id, "width": width, "height": height}))
        .collect();
    let mut annotations = Vec::new();
    for ((image, shown), size) in (1..).zip(shown).zip(sizes) {
        for (class, thing) in scored(&shown.truth, shown.smoke_labelled) {
            let mut entry = placed(image, class, thing, *size);
            entry["id"] = (annotations.len() + 1).into();
            entry["iscrowd"] = 0.into();
            entry["area"] = (thing.box_px.width * thing.box_px.height).into();
            annotations.push(entry);
        }
    }
    let categories: Vec<Value> = CATEGORIES
        .iter()
        .map(|(_, id, name)| json!({"id": id, "name": name}))
        .collect();
    json!({"images": images, "annotations": annotations, "categories": categories})
}

/// What was found.
pub fn found(
    shown: &[Shown],
    found: &[Vec<(DetectionClass, Thing)>],
    sizes: &[(u32, u32)],
) -> Value {
    let mut results = Vec::new();
    for (((image, shown), found), size) in (1..).zip(shown).zip(found).zip(sizes) {
        for (class, thing) in scored(found, shown.smoke_labelled) {
            let mut entry = placed(image, class, thing, *size);
            entry["score"] = thing.score.into();
            results.push(entry);
        }
    }
    results.into()
}

/// What counts, with its class's number.
fn scored(
    things: &[(DetectionClass, Thing)],
    smoke_labelled: bool,
) -> impl Iterator<Item = (u32, &Thing)> {
    let number = |class: DetectionClass| {
        let known = CATEGORIES.iter().find(|(of, ..)| *of == class)?;
        Some(known.1)
    };
    things
        .iter()
        .filter(move |(class, _)| smoke_labelled || *class != DetectionClass::Smoke)
        .filter_map(move |(class, thing)| Some((number(*class)?, thing)))
}

fn placed(image: usize, class: u32, thing: &Thing, size: (u32, u32)) -> Value {
    let at = thing.box_px;
    let mut entry = json!({
        "image_id": image,
        "category_id": class,
        "bbox": [at.x, at.y, at.width, at.height],
    });
    if let Some(mask) = &thing.mask {
        entry["segmentation"] = runs(mask, size);
    }
    entry
}

/// Lengths of runs of pixels that are not covered and that are, in turn, column by column.
fn runs(mask: &Mask, (width, height): (u32, u32)) -> Value {
    let mut counts = vec![0_u32];
    let mut covered = false;
    for column in 0..width {
        for row in 0..height {
            if mask.covers(column, row) != covered {
                covered = !covered;
                counts.push(0);
            }
            if let Some(last) = counts.last_mut() {
                *last += 1;
            }
        }
    }
    json!({"counts": counts, "size": [height, width]})
}
