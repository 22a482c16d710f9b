//! Bad input gets a clear answer: what is refused, is refused at once with exit code 2 and one line that
//! says which file, which key, which value and what would do; what goes bad on the way is counted by
//! name, and gives no position.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/flight.rs"]
mod flight;
#[path = "support/hover.rs"]
mod hover;
#[path = "support/pictures.rs"]
mod pictures;
#[path = "support/replays.rs"]
mod replays;
mod support;

use emberfix::ingest::StereoPair;
use serde_json::Value;
use std::path::{Path, PathBuf};
use support::{PLAIN_MISSION, PLAIN_RIG, Said, Scratch, emberfix, root};

/// Refused: exit code 2, nothing on standard output, one line with every word of `names`.
fn assert_refused(said: &Said, names: &[&str]) {
    assert_eq!((said.code, said.out.as_str()), (2, ""), "{}", said.err);
    assert_eq!(
        said.err.lines().count(),
        1,
        "more than one line: {}",
        said.err
    );
    for name in names {
        assert!(said.err.contains(name), "{name:?} is not in: {}", said.err);
    }
    let told_twice = names
        .first()
        .is_some_and(|file| said.err.matches(file).count() > 2);
    assert!(!told_twice, "the same thing again and again: {}", said.err);
}

/// `replay` of no matter what, without a model.
fn replay_nothing(scratch: &Scratch) -> Said {
    let boxes = scratch.write("boxes.csv", pictures::boxes(1));
    replays::replay(
        scratch,
        &scratch.path("rec.mcap"),
        "out",
        &["--boxes", boxes.to_str().unwrap()],
    )
}

fn edited(text: &str, from: &str, to: &str) -> String {
    let edited = text.replacen(from, to, 1);
    assert_ne!(edited, text, "{from:?} is not in the file");
    edited
}

#[test]
fn a_mission_that_is_not_there_is_refused_with_an_example() {
    let mut command = emberfix();
    let said = command
        .args(["replay", "nowhere.toml", "rec.mcap", "--out", "out"])
        .output();
    let names = [
        "mission nowhere.toml",
        "No such file",
        "missions/gaochun.toml",
    ];
    assert_refused(&Said::of(&said.unwrap()), &names);
}

#[test]
fn each_broken_mission_is_refused_by_file_key_value_and_range() {
    #[rustfmt::skip]
    let broken: [(&str, &str, &[&str]); 10] = [
        ("height_ellipsoid_m", "hight_ellipsoid_m",
            &["datum.hight_ellipsoid_m", "unknown", "did you mean datum.height_ellipsoid_m?"]),
        ("latitude_deg = 31.409422", "latitude_deg = nan",
            &["datum.latitude_deg", "NaN", "-90 to 90"]),
        ("latitude_deg = 31.409422", "latitude_deg = 91.5",
            &["datum.latitude_deg", "91.5", "-90 to 90"]),
        ("latitude_deg = 31.409422", "latitude_deg = \"north\"",
            &["line 6", "latitude_deg", "north", "expected f64"]),
        ("system_id = 1", "system_id = 300", &["system_id", "300", "expected u8"]),
        ("uav = \"uav-1\"\n", "", &["missing field `uav`"]),
        ("uav = \"uav-1\"", "uav = \"my uav\"", &["uav", "my uav", "1 to 32 letters"]),
        ("uav = \"uav-1\"", "uav = ", &["line 3"]),
        ("path = \"no-model.onnx\"", "path = \"m.onnx\"\nthreshold = 1.5",
            &["model.threshold", "1.5", "0.01 to 1"]),
        ("[vehicle]", "[range]\nmax_disparity_px = 100\n[vehicle]",
            &["range.max_disparity_px", "100", "multiples of 16"]),
    ];
    let scratch = Scratch::new();
    for (from, to, names) in broken {
        scratch.write("mission.toml", edited(PLAIN_MISSION, from, to));
        assert_refused(
            &replay_nothing(&scratch),
            &[&["mission.toml"], names].concat(),
        );
    }
}

#[test]
fn each_broken_rig_is_refused_by_file_key_value_and_range() {
    #[rustfmt::skip]
    let broken: [(&str, &str, &[&str]); 7] = [
        ("disparity_bias_px", "disparity_bais_px",
            &["sigma.disparity_bais_px", "did you mean sigma.disparity_bias_px?"]),
        ("[-0.3, 0.0, 0.0]", "[0.3, 0.0, 0.0]", &["right_from_left_translation_m", "0.3", "swapped"]),
        ("[-0.3, 0.0, 0.0]", "[-300.0, 0.0, 0.0]", &["300", "0.005 to 5", "metres, not mm"]),
        ("focal_px = [440.0, 440.0]", "focal_px = [4.4, 4.4]",
            &["left.focal_px", "4.4", "64 to 12800"]),
        ("image_size_px = [640, 360]", "image_size_px = [640, 480]", &["480", "both eyes need one size"]),
        ("boresight_deg = 0.1", "boresight_deg = inf", &["sigma.boresight_deg", "inf", "0 to 45"]),
        ("max_skew_s = 0.001", "max_skew_s = \"short\"", &["max_skew_s", "short", "expected f64"]),
    ];
    let scratch = Scratch::new();
    for (from, to, names) in broken {
        scratch.write("rig.toml", edited(PLAIN_RIG, from, to));
        assert_refused(&replay_nothing(&scratch), &[&["rig.toml"], names].concat());
    }
    std::fs::remove_file(scratch.path("rig.toml")).unwrap();
    assert_refused(
        &replay_nothing(&scratch),
        &["rig.toml", "No such file", "oakd-75mm.toml"],
    );
}

fn shipped_model() -> PathBuf {
    root().join("models/ember-nano.onnx")
}

/// `replay` with a model, and with more keys for it.
fn with_model(model: &Path, keys: &str) -> Said {
    let scratch = Scratch::new();
    let path = format!("\"{}\"\n{keys}", model.display());
    scratch.write(
        "mission.toml",
        edited(PLAIN_MISSION, "\"no-model.onnx\"", &path),
    );
    replays::replay(&scratch, &scratch.path("rec.mcap"), "out", &[])
}

#[test]
fn each_file_that_is_no_model_of_ours_is_refused_by_name() {
    let scratch = Scratch::new();
    let whole = std::fs::read(shipped_model()).unwrap();
    let empty = scratch.write("empty.onnx", "");
    let noise = scratch.write("noise.onnx", [0x5A; 5000]);
    let cut = scratch.write("cut.onnx", &whole[..whole.len() / 3]);
    assert_refused(
        &with_model(&scratch.path("none.onnx"), ""),
        &["none.onnx", "No such file"],
    );
    assert_refused(&with_model(&empty, ""), &["empty.onnx", "0 bytes", "1 to"]);
    assert_refused(&with_model(&noise, ""), &["noise.onnx", "not an ONNX file"]);
    assert_refused(&with_model(&cut, ""), &["cut.onnx", "cut short"]);
}

#[test]
fn a_model_that_is_not_the_missions_is_refused_by_what_differs() {
    let zeros = "0".repeat(64);
    let hash = with_model(&shipped_model(), &format!("sha256 = \"{zeros}\""));
    assert_refused(&hash, &["ember-nano.onnx", "sha256", &zeros]);
    let short = with_model(&shipped_model(), "sha256 = \"abc\"");
    assert_refused(
        &short,
        &[
            "mission.toml",
            "model.sha256",
            "abc",
            "64 hexadecimal digits",
        ],
    );
    let family = with_model(&shipped_model(), "family = \"yolo9\"");
    assert_refused(
        &family,
        &["mission.toml", "yolo9", "nanodet-plus", "yolov8"],
    );
}

#[test]
fn a_model_of_another_shape_is_refused_with_the_shape_it_should_have() {
    if !root().join(".x/onnxruntime/libonnxruntime.so").exists()
        && std::env::var_os("ORT_DYLIB_PATH").is_none_or(|path| !Path::new(&path).exists())
    {
        println!("skipped: no ONNX Runtime (./x setup)");
        return;
    }
    let said = with_model(&shipped_model(), "family = \"yolov8\"");
    assert_refused(
        &said,
        &[
            "ember-nano.onnx",
            "output",
            "a yolov8 model has",
            "classes + 4",
        ],
    );
}

#[test]
fn a_file_that_is_no_recording_is_refused() {
    let scratch = Scratch::new();
    assert_refused(&replay_nothing(&scratch), &["rec.mcap", "No such file"]);
    scratch.write("rec.mcap", [0x5A; 3000]);
    assert_refused(
        &replay_nothing(&scratch),
        &["rec.mcap", "no MCAP file", "3000 bytes"],
    );
    let no_log = scratch.write("a.tlog", [0x5A; 3000]);
    assert_refused(
        &replays::replay(&scratch, &no_log, "out", &[]),
        &["a.tlog", "no MAVLink frame"],
    );
    let boxes = ["--boxes", "nowhere.jsonl"];
    assert_refused(
        &replays::replay(&scratch, &no_log.with_extension("mcap"), "out", &boxes),
        &["nowhere.jsonl"],
    );
}

#[test]
fn a_recording_cut_before_its_first_message_is_refused_and_a_torn_one_is_used_as_far_as_it_goes() {
    let scratch = Scratch::new();
    let whole = std::fs::read(hover::record(&scratch, 20, |_| {})).unwrap();
    scratch.write("rec.mcap", &whole[..300]);
    assert_refused(
        &replay_nothing(&scratch),
        &["rec.mcap", "holds no whole message", "bytes cut off"],
    );
    scratch.write("rec.mcap", &whole[..whole.len() * 6 / 10]);
    let torn = replay_nothing(&scratch);
    assert!(
        torn.err.contains("torn or damaged"),
        "said loudly: {}",
        torn.err
    );
    let torn = torn.json();
    assert!((1..20).contains(&torn["pairs"].as_u64().unwrap()), "{torn}");
    assert!(torn["stream"]["lost_bytes"].as_u64().unwrap() > 0, "{torn}");
}

/// `run` with other URLs, which has to be refused before it does anything.
fn run(mavlink: &str, camera: &str, more: &[&str]) -> Said {
    let scratch = Scratch::new();
    let boxes = scratch.write("boxes.csv", pictures::boxes(1));
    let mut command = emberfix();
    command
        .arg("run")
        .arg(scratch.path("mission.toml"))
        .arg("--boxes")
        .arg(boxes);
    command.arg("--state").arg(scratch.path("state"));
    command
        .args(["--mavlink", mavlink, "--camera", camera])
        .args(more);
    Said::of(&command.output().unwrap())
}

#[test]
fn each_address_that_is_none_is_refused_with_the_forms_that_are() {
    let (port, camera) = ("udpout:127.0.0.1:9", "tcp-listen:127.0.0.1:0");
    assert_refused(
        &run("udp:1", camera, &[]),
        &["mavlink.url", "udp:1", "udpin:HOST:PORT", "serial:"],
    );
    assert_refused(
        &run("udpin:127.0.0.1", camera, &[]),
        &["mavlink.url", "HOST:PORT", "1 to 65535"],
    );
    assert_refused(
        &run(port, "rtsp://x", &[]),
        &["camera.url", "rtsp://x", "unix-listen:PATH"],
    );
    assert_refused(
        &run(port, "tcp-listen:5", &[]),
        &["camera.url", "tcp-listen:HOST:PORT"],
    );
    assert_refused(
        &run(port, "folder:/nowhere/at-all", &[]),
        &["/nowhere/at-all", "expected left/"],
    );
    assert_refused(
        &run(port, "recording:/nowhere.mcap", &[]),
        &["/nowhere.mcap", "No such file"],
    );
    assert_refused(
        &run(port, camera, &["--ground", "ftp://x"]),
        &["ground.url", "ftp://x", "http://HOST:PORT"],
    );
}

/// Pairs of one hover; long enough for an alarm.
const PAIRS: u64 = 30;

/// The summary, and every fix, of a hover whose pairs went bad in some way.
fn flown(change: impl Fn(&mut StereoPair)) -> (Value, Vec<Value>) {
    let scratch = Scratch::new();
    let recording = hover::record(&scratch, PAIRS, change);
    let boxes = scratch.write("boxes.csv", pictures::boxes(PAIRS));
    let summary = replays::replay(
        &scratch,
        &recording,
        "out",
        &["--boxes", boxes.to_str().unwrap()],
    )
    .json();
    let fixes = std::fs::read_to_string(scratch.path("out").join("fixes.jsonl")).unwrap();
    (
        summary,
        fixes
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect(),
    )
}

fn placed(fixes: &[Value]) -> usize {
    fixes
        .iter()
        .filter(|fix| !fix["geometry"].is_null())
        .count()
}

fn halve(image: &mut bytes::Bytes) {
    image.truncate(image.len() / 2);
}

#[test]
fn a_hover_with_two_good_eyes_gives_positions_and_one_alarm() {
    let (summary, fixes) = flown(|_| {});
    assert_eq!(summary["counters"]["pairs"]["looked_at"], PAIRS);
    assert_eq!(
        (placed(&fixes) as u64, summary["fires"].as_u64()),
        (PAIRS, Some(1)),
        "{summary}"
    );
    let range_m = fixes[0]["properties"]["range_m"].as_f64().unwrap();
    // The base lies 9 degrees below the boresight, beneath the surface's middle: near its depth.
    assert!(
        (range_m / pictures::DEPTH_M - 1.0).abs() < 0.1,
        "{range_m} m"
    );
}

#[test]
fn a_truncated_left_jpeg_is_counted_and_gives_no_position() {
    let (summary, fixes) = flown(|pair| {
        if pair.sequence % 3 == 0 {
            halve(&mut pair.left.bytes);
        }
    });
    assert_eq!(summary["counters"]["left_eye"]["undecodable"], PAIRS / 3);
    assert_eq!(
        fixes.len() as u64,
        PAIRS - PAIRS / 3,
        "the good ones are used"
    );
}

#[test]
fn a_truncated_right_jpeg_is_counted_and_leaves_the_bearing_alone() {
    let (summary, fixes) = flown(|pair| halve(&mut pair.right.as_mut().unwrap().bytes));
    assert_eq!(summary["counters"]["right_eye"]["undecodable"], PAIRS);
    assert_eq!(
        (placed(&fixes), summary["fires"].as_u64()),
        (0, Some(0)),
        "{summary}"
    );
}

#[test]
fn a_dead_right_eye_is_counted_and_leaves_the_bearing_alone() {
    let (summary, fixes) = flown(|pair| pair.right = None);
    assert_eq!(summary["counters"]["right_eye"]["missing"], PAIRS);
    assert_eq!(
        (placed(&fixes), summary["fires"].as_u64()),
        (0, Some(0)),
        "{summary}"
    );
}

#[test]
fn a_black_eye_is_counted_and_gives_no_position() {
    let (left, fixes) = flown(|pair| pair.left.bytes = pictures::black());
    let black = |eye: &Value, frozen: &str| {
        eye["black"].as_u64().unwrap() + eye[frozen].as_u64().unwrap_or(0)
    };
    // The same black picture again and again is a frozen eye too.
    assert_eq!(
        black(&left["counters"]["left_eye"], "frozen"),
        PAIRS,
        "{left}"
    );
    assert_eq!((fixes.len(), left["fires"].as_u64()), (0, Some(0)));
    let (right, fixes) = flown(|pair| pair.right.as_mut().unwrap().bytes = pictures::black());
    assert_eq!(
        black(&right["counters"]["right_eye"], "frozen"),
        PAIRS,
        "{right}"
    );
    assert_eq!(
        (placed(&fixes), right["fires"].as_u64()),
        (0, Some(0)),
        "{right}"
    );
}
