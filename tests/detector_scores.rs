//! `emberfix eval detector` as its users run it, its scores held against pycocotools.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/clients.rs"]
#[expect(
    dead_code,
    reason = "nothing is started here that has to be stopped again"
)]
mod clients;
mod support;

use clients::Clients;
use emberfix_calib::Rig;
use emberfix_sim::dataset::{self, Form, Framing};
use serde_json::Value;
use support::{Said, Scratch, emberfix};

/// Equal to pycocotools, or both have nothing to say.
fn agree(ours: &Value, theirs: &Value, what: &str) {
    match (ours.as_f64(), theirs.as_f64()) {
        (Some(a), Some(b)) => assert!((a - b).abs() < 1e-6, "{what}: {a} and {b}"),
        (a, b) => assert_eq!(a, b, "{what}"),
    }
}

#[test]
fn boxes_and_masks_score_as_pycocotools_scores_them() {
    let Some(clients) = Clients::find() else {
        return;
    };
    if emberfix_without_runtime() {
        return;
    }
    let scratch = Scratch::new();
    let folder = scratch.path("families");
    clients.run("detector_families.py", [&folder]).json();
    let out = scratch.path("out");
    let mut command = emberfix();
    command
        .args(["eval", "detector", "--json", "--out"])
        .arg(&out);
    command
        .arg(folder.join("yolov8-seg.onnx"))
        .arg(folder.join("set"));
    let said = Said::of(&command.output().unwrap());
    // Random weights keep no bound of a detector's.
    assert_eq!(said.code, 1, "{}", said.err);
    let ours: Value = serde_json::from_str(&said.out).unwrap();
    let files = ["detector_truth.json", "detector_found.json"].map(|name| out.join(name));
    let theirs = clients.run("coco_score.py", files).json();
    let mut told = 0;
    for (number, class) in ["fire", "smoke"].into_iter().enumerate() {
        let ours = &ours["details"]["detectors"][0]["classes"][number];
        let theirs = &theirs[class];
        let all = &theirs["box"]["all"];
        agree(&ours["ap50"]["value"], &all["ap50"], "AP50");
        agree(&ours["ap50_95"], &all["ap50_95"], "AP50-95");
        for (size, name) in ["small", "medium", "large"].into_iter().enumerate() {
            let of_size = &theirs["box"][name];
            agree(&ours["ap50_by_size"][size], &of_size["ap50"], name);
            agree(&ours["ap50_95_by_size"][size], &of_size["ap50_95"], name);
            told += usize::from(of_size["ap50"].as_f64().is_some_and(|ap| ap > 0.05));
        }
        let masks = &theirs["mask"]["all"];
        agree(&ours["mask_ap"][0], &masks["ap50"], "mask AP50");
        agree(&ours["mask_ap"][1], &masks["ap50_95"], "mask AP50-95");
        told += usize::from(masks["ap50"].as_f64().is_some_and(|ap| ap > 0.05));
    }
    // Scores that are all nothing agree with anything.
    assert!(told >= 3, "{theirs}");
    for name in [
        "detector_misses.png",
        "detector_false_alarms.png",
        "detector.svg",
    ] {
        assert!(out.join(name).metadata().unwrap().len() > 1000, "{name}");
    }
}

/// The simulator knows each flame's pixels.
#[test]
fn the_shipped_masks_cover_simulated_flames() {
    if emberfix_without_runtime() {
        return;
    }
    let scratch = Scratch::new();
    let set = scratch.path("set");
    let rig = Rig::load(&support::root().join("calib/rigs/oakd-75mm.toml")).unwrap();
    let form = Form {
        framing: Framing::Cut,
        outlines: true,
    };
    let summary = dataset::write(&set, 48, 5, &rig, form).unwrap();
    assert!(summary.fires >= 20, "{summary:?}");
    let mut command = emberfix();
    command
        .args(["eval", "detector", "--json", "models/ember-seg.onnx"])
        .arg(&set);
    let said = Said::of(&command.output().unwrap());
    // So few pictures may well miss a bound.
    assert!(said.code <= 1, "{}", said.err);
    let ours: Value = serde_json::from_str(&said.out).unwrap();
    let fire = &ours["details"]["detectors"][0]["classes"][0];
    let ap = fire["mask_ap"][0].as_f64().unwrap();
    // About half of what the model's card says of such pictures.
    assert!(ap > 0.3, "{ap}");
}

#[test]
fn what_is_no_data_set_or_no_model_is_refused_by_name() {
    let scratch = Scratch::new();
    let set = scratch.path("nothing");
    let run = |model: &str, set: &std::path::Path| {
        let mut command = emberfix();
        command.args(["eval", "detector", model]).arg(set);
        Said::of(&command.output().unwrap())
    };
    let said = run("models/ember-nano.onnx", &set);
    assert_eq!(said.code, 2, "{}", said.err);
    assert!(said.err.contains("images"), "{}", said.err);
}

fn emberfix_without_runtime() -> bool {
    use emberfix::detect::{DetectorConfig, ModelError, OnnxDetector};
    let model = support::root().join("models/ember-nano.onnx");
    let missing = matches!(
        OnnxDetector::load(&DetectorConfig::new(model)),
        Err(ModelError::RuntimeMissing { .. })
    );
    if missing {
        println!("skipped: no ONNX Runtime");
    }
    missing
}
