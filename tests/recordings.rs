//! Recordings between us and the Python `mcap` package, both ways; and the way round: what a live run
//! recorded replays to the alarms that it gave.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/camera.rs"]
mod camera;
#[path = "support/clients.rs"]
#[expect(dead_code, reason = "no facts are asked of those who are ready")]
mod clients;
#[path = "support/live.rs"]
mod live;
#[path = "support/pictures.rs"]
#[expect(dead_code, reason = "no lens is covered here")]
mod pictures;
#[path = "support/replays.rs"]
mod replays;
mod support;

use clients::{Clients, Running};
use live::Service;
use serde_json::Value;
use std::time::Duration;
use support::{PLAIN_RIG, Scratch};

fn read_json(path: &std::path::Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// A live run of some seconds, recorded into the scratch folder's `live.mcap`.
fn record_live(clients: &Clients, scratch: &Scratch) {
    let recording = scratch.path("live.mcap");
    let service = Service::start(scratch, &["--record", recording.to_str().unwrap()]);
    let mut autopilot = clients.client("mav_autopilot.py");
    let port = service.mavlink_port.to_string();
    autopilot.args(["--seconds", "60", "--port", &port]);
    let (autopilot, _) = Running::start(autopilot, "ready ");
    std::thread::sleep(Duration::from_secs(3));
    let camera = service.film();
    std::thread::sleep(Duration::from_secs(8));
    camera.stop();
    autopilot.stop().json();
    service.stop();
}

#[test]
fn python_reads_what_a_live_run_recorded_and_its_replay_gives_the_alarm_that_was_given() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    record_live(&clients, &scratch);

    let read = clients
        .run("mcap_check.py", [scratch.path("live.mcap")])
        .json();
    assert_eq!(read["problems"], serde_json::json!([]), "{read}");
    let topics = &read["topics"];
    let count = |topic: &str| topics[topic]["count"].as_u64().unwrap_or(0);
    for topic in [
        "/stereo/left/calibration",
        "/stereo/right/calibration",
        "/fire/alarms/geojson",
    ] {
        assert!(count(topic) > 0, "{topic} is empty: {read}");
    }
    for topic in ["/uav/fix", "/tf", "/fire/detections", "/fire/fixes"] {
        assert!(count(topic) >= 10, "{topic} holds {}", count(topic));
    }
    assert_eq!(
        topics["/stereo/left/image"]["schema"],
        "foxglove.CompressedImage"
    );
    assert_eq!(read["pairs"]["count"], count("/stereo/left/image"));
    let frames = &topics["/mavlink/raw"]["messages"];
    assert!(
        frames["ATTITUDE_QUATERNION"].as_u64().unwrap() > 300,
        "{frames}"
    );
    assert!(frames["TIMESYNC"].as_u64().unwrap() > 50, "{frames}");

    let boxes = scratch.write("boxes.csv", pictures::boxes(1000));
    let more = ["--boxes", boxes.to_str().unwrap()];
    let summary = replays::replay(&scratch, &scratch.path("live.mcap"), "out", &more).json();
    assert_eq!(
        summary["alarm_revisions"],
        count("/fire/alarms"),
        "{summary}"
    );
    assert_eq!(summary["fixes"], count("/fire/fixes"), "{summary}");
    let replayed = read_json(&scratch.path("out/alarms.geojson"));
    assert_eq!(
        replayed["features"].as_array().unwrap().len(),
        1,
        "{replayed}"
    );
    assert_eq!(replayed["features"][0], topics["/fire/alarms"]["last"]);
}

/// Focal length that `mcap_write.py` states for pictures of 640 columns.
const WRITTEN_FOCAL_PX: f64 = 512.0;
const WRITTEN_DISPARITY_PX: f64 = 6.0;
const WRITTEN_BASELINE_M: f64 = 0.3;

/// The sightings of a recording that Python wrote.
fn replay_written(clients: &Clients, options: &[&str]) -> (Value, Vec<Value>) {
    let scratch = Scratch::new();
    scratch.write(
        "rig.toml",
        PLAIN_RIG.replace("[440.0, 440.0]", "[512.0, 512.0]"),
    );
    let path = scratch.path("written.mcap");
    let mut write = vec![path.to_str().unwrap()];
    write.extend(["--pairs", "20", "--size", "640x360", "--baseline-m", "0.3"]);
    clients
        .run("mcap_write.py", write.iter().chain(options))
        .json();
    let boxes = scratch.write("boxes.csv", pictures::boxes(20));
    let more = ["--boxes", boxes.to_str().unwrap()];
    let summary = replays::replay(&scratch, &path, "out", &more).json();
    let fixes = std::fs::read_to_string(scratch.path("out/fixes.jsonl")).unwrap();
    (
        summary,
        fixes
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect(),
    )
}

#[test]
fn we_read_what_python_writes_packed_in_any_way_and_place_what_it_shows() {
    let Some(clients) = Clients::find() else {
        return;
    };
    for options in [
        ["--compression", "zstd", "--format", "jpeg"],
        ["--compression", "lz4", "--format", "jpeg"],
        ["--compression", "none", "--format", "png"],
    ] {
        let (summary, fixes) = replay_written(&clients, &options);
        assert_eq!(summary["pairs"], 20, "{options:?}: {summary}");
        // No telemetry follows the last pair.
        assert_eq!(
            summary["counters"]["pairs"]["looked_at"], 19,
            "{options:?}: {summary}"
        );
        assert_eq!(fixes.len(), 19);
        fixes.iter().for_each(assert_in_the_east);
    }
}

/// The writer's vehicle stands at 31.4094222 N, 119.1120167 E, 27 m above the ellipsoid, nose to the
/// east; the rig looks 30 degrees down. By hand: a surface that faces the camera at depth
/// `Z = f b / d`, a box whose middle lies 35 px and whose base lies 60 px below the boresight.
fn assert_in_the_east(fix: &Value) {
    let depth_m = WRITTEN_FOCAL_PX * WRITTEN_BASELINE_M / WRITTEN_DISPARITY_PX;
    let (sin, cos) = 30.0_f64.to_radians().sin_cos();
    // East and down of a point at depth 1 and a row below the boresight.
    let along = |row: f64| (cos - row * sin, sin + row * cos);
    let middle_east_m = depth_m * along(35.5 / WRITTEN_FOCAL_PX).0;
    let (base_east, base_down) = along(60.5 / WRITTEN_FOCAL_PX);
    // The base stands beneath the middle.
    let up_m = 27.0 - middle_east_m * base_down / base_east;
    let coordinate = |index: usize| fix["geometry"]["coordinates"][index].as_f64().unwrap();
    let east_m = (coordinate(0) - 119.112_016_7) * 95_080.0;
    let north_m = (coordinate(1) - 31.409_422_2) * 110_870.0;
    // A tenth of a pixel of six is 2 %; the matched pixels' middle is known to some pixels.
    assert!(
        (east_m - middle_east_m).abs() < 0.04 * middle_east_m,
        "{east_m} m, not {middle_east_m}: {fix}"
    );
    assert!(north_m.abs() < 0.3, "{north_m} m to the north: {fix}");
    assert!(
        (coordinate(2) - up_m).abs() < 0.04 * depth_m,
        "{} m, not {up_m}: {fix}",
        coordinate(2)
    );
}
