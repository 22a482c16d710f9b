//! A real drive as a recording: what stands still must keep one place while the car drives by.
//!
//! `cargo test --test kitti -- --nocapture` prints the spread of static things by range as figures.
//!
//! The 51 stereo pairs of `shared/data/vehicle/kitti_01` become images, and the car's poses become the
//! telemetry of a vehicle whose nose is the camera's boresight and whose first pose is level, heads
//! north and stands at 49.0 N, 8.4 E, 110 m above mean sea level. `tests/clients/static_boxes.py` picks
//! the boxes from the left images alone. Then the real program replays the recording, and nothing but
//! its `fixes.jsonl` is judged: how far each sighting of a corner lies from the median of all sightings
//! of it, in three dimensions. That holds range noise, matching outliers, the poses' own error, and
//! every slip in frames, heights or clocks, which motion would show as drift.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/clients.rs"]
#[expect(dead_code, reason = "nothing runs beside these tests")]
mod clients;
#[path = "support/flight.rs"]
mod flight;
#[path = "support/replays.rs"]
mod replays;
#[path = "support/shared.rs"]
mod shared;
mod support;

use bytes::Bytes;
use clients::Clients;
use emberfix::ingest::{EncodedImage, ImageEncoding, StereoPair};
use emberfix::record::{RecordOptions, Tape};
use emberfix_calib::Rig;
use emberfix_frames::{
    Attitude, EllipsoidHeight, GeoidUndulation, Matrix3, ServiceTime, SignedDuration, Stamped,
    Vector3, Wgs84, enu_offset, place_from_degrees,
};
use flight::{State, Vehicle};
use nalgebra::{Rotation3, UnitQuaternion};
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use support::Scratch;

/// 2026-03-01T12:00:00Z: the set has no times of its own.
const START: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);
/// The set was taken at about 10 Hz.
const FRAME: SignedDuration = SignedDuration::from_millis(100);
/// PX4's attitude and position, 50 Hz.
const POSES_PER_FRAME: usize = 5;
/// Telemetry before the first and after the last picture, in frames.
const LEAD_FRAMES: usize = 20;
const ANCHOR_DEG: (f64, f64) = (49.0, 8.4);
/// 110 m above mean sea level there.
const ANCHOR_HEIGHT: EllipsoidHeight = EllipsoidHeight::from_m(158.0);
const UNDULATION: GeoidUndulation = GeoidUndulation::from_m(48.0);

const RIG: &str = r#"
name = "kitti-01"
[left]
image_size_px = [1226, 370]
focal_px = [707.0912, 707.0912]
principal_point_px = [601.8873, 183.1104]
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[right]
image_size_px = [1226, 370]
focal_px = [707.0912, 707.0912]
principal_point_px = [601.8873, 183.1104]
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[stereo]
right_from_left_rotation_deg = [0.0, 0.0, 0.0]
right_from_left_translation_m = [-0.537151, 0.0, 0.0]
max_skew_s = 0.001
[mount]
yaw_deg = 0.0
depression_deg = 0.0
roll_deg = 0.0
lever_arm_m = [0.0, 0.0, 0.0]
[time]
camera_offset_s = 0.0
[sigma]
disparity_bias_px = 0.1
boresight_deg = 0.1
lever_arm_m = 0.01
time_offset_s = 0.005
"#;

const MISSION: &str = r#"
name = "kitti-01"
uav = "car-1"
rig = "rig.toml"
[datum]
latitude_deg = 49.0
longitude_deg = 8.4
height_ellipsoid_m = 158.0
[mavlink]
url = "udpin:127.0.0.1:14540"
[camera]
url = "recording:rec.mcap"
[model]
path = "no-model.onnx"
[sigma]
heading_deg = 0.2
tilt_deg = 0.2
"#;

/// Camera axes (right, down, forward) of the first frame to north, east, down.
fn ned_from_first_camera() -> Matrix3<f64> {
    Matrix3::new(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
}

/// The car's states at the pictures' moments: `X0 = R Xi + t` a line.
fn states(poses: &str) -> Vec<State> {
    let numbers = |line: &str| {
        line.split_whitespace()
            .map(|n| n.parse::<f64>().unwrap())
            .collect()
    };
    let poses: Vec<Vec<f64>> = poses
        .lines()
        .filter(|line| !line.is_empty())
        .map(numbers)
        .collect();
    let turn = ned_from_first_camera();
    let ned = |i: usize| turn * Vector3::new(poses[i][3], poses[i][7], poses[i][11]);
    (0..poses.len())
        .map(|i| {
            let (before, after) = (i.saturating_sub(1), (i + 1).min(poses.len() - 1));
            let span_s = FRAME.as_secs_f64() * (after - before) as f64;
            let p = &poses[i];
            let camera = Matrix3::new(p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10]);
            let place = ned(i);
            State {
                position_enu_m: Vector3::new(place.y, place.x, -place.z),
                velocity_ned_m_s: (ned(after) - ned(before)) / span_s,
                attitude: attitude(&(turn * camera * turn.transpose())),
            }
        })
        .collect()
}

fn attitude(ned_from_body: &Matrix3<f64>) -> Attitude {
    let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(ned_from_body));
    Attitude::from_mavlink_quaternion([q.w, q.i, q.j, q.k]).unwrap()
}

/// Between two pictures: cubic in place (as a car moves), along the shortest arc in attitude.
fn between(a: &State, b: &State, share: f64) -> State {
    let h = FRAME.as_secs_f64();
    let enu = |v: &Vector3<f64>| Vector3::new(v.y, v.x, -v.z);
    let (va, vb) = (enu(&a.velocity_ned_m_s) * h, enu(&b.velocity_ned_m_s) * h);
    let step = b.position_enu_m - a.position_enu_m;
    let (s, s2, s3) = (share, share * share, share.powi(3));
    State {
        position_enu_m: a.position_enu_m
            + va * (s3 - 2.0 * s2 + s)
            + step * (3.0 * s2 - 2.0 * s3)
            + vb * (s3 - s2),
        velocity_ned_m_s: a.velocity_ned_m_s.lerp(&b.velocity_ned_m_s, share),
        attitude: a.attitude.slerp(&b.attitude, share),
    }
}

fn frames(count: usize) -> SignedDuration {
    FRAME * i32::try_from(count).unwrap()
}

/// The car stands before its first and after its last picture.
fn standing(state: &State) -> State {
    State {
        velocity_ned_m_s: Vector3::zeros(),
        ..*state
    }
}

fn record_telemetry(tape: &mut Tape, states: &[State]) {
    let (first, last) = (standing(&states[0]), standing(states.last().unwrap()));
    let booted = START - SignedDuration::from_secs(100);
    let mut car = Vehicle::new(ANCHOR_DEG, ANCHOR_HEIGHT, UNDULATION, booted);
    let mut write = |(arrived, frame): (ServiceTime, Vec<u8>)| {
        tape.write_mavlink(arrived, &frame).unwrap();
    };
    for frame in 0..2 * LEAD_FRAMES + states.len() {
        let index = frame as isize - LEAD_FRAMES as isize;
        let state = |index: isize| match usize::try_from(index) {
            Err(_) => first,
            Ok(index) => states.get(index).copied().unwrap_or(last),
        };
        let at = START + frames(frame) - frames(LEAD_FRAMES);
        car.surroundings(at, &state(index))
            .into_iter()
            .for_each(&mut write);
        for step in 0..POSES_PER_FRAME {
            let share = step as f64 / POSES_PER_FRAME as f64;
            let moment =
                at + SignedDuration::from_millis(100 * step as i64 / POSES_PER_FRAME as i64);
            let here = between(&state(index), &state(index + 1), share);
            car.pose(moment, &here).into_iter().for_each(&mut write);
        }
    }
}

fn record_images(tape: &mut Tape, set: &Path, count: usize) {
    for sequence in 0..count {
        let at = START + frames(sequence);
        let eye = |folder: &str| EncodedImage {
            encoding: ImageEncoding::Png,
            bytes: Bytes::from(
                std::fs::read(set.join(folder).join(format!("{sequence:06}.png"))).unwrap(),
            ),
            at,
        };
        let value = StereoPair {
            spectra: Vec::new(),
            sequence: sequence as u64,
            arrived: at + SignedDuration::from_millis(30),
            left: eye("image_l"),
            right: Some(eye("image_r")),
            skew: SignedDuration::ZERO,
        };
        tape.write_pair(&Stamped { at, value }).unwrap();
    }
}

/// The set as a recording with mission, rig and boxes, in a scratch folder.
fn recording(set: &Path, clients: &Clients) -> Scratch {
    let scratch = Scratch::new();
    let rig = Rig::load(&scratch.write("rig.toml", RIG)).unwrap();
    scratch.write("mission.toml", MISSION);
    let states = states(&std::fs::read_to_string(set.join("poses.txt")).unwrap());
    let mut tape =
        Tape::create(&scratch.path("rec.mcap"), &rig, &RecordOptions::default()).unwrap();
    record_telemetry(&mut tape, &states);
    record_images(&mut tape, set, states.len());
    tape.finish().unwrap();
    let boxes = clients.run(
        "static_boxes.py",
        [set.join("image_l"), scratch.path("boxes.jsonl")],
    );
    println!("boxes: {}", boxes.json());
    scratch
}

/// One placed sighting of a corner.
struct Placed {
    enu_m: Vector3<f64>,
    range_m: f64,
}

fn lines(path: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

/// What tells the boxes of one picture apart, to a thousandth of a pixel.
fn key(sequence: i64, x: f64, y: f64) -> (i64, i64, i64) {
    (sequence, (x * 1e3).round() as i64, (y * 1e3).round() as i64)
}

/// The placed sightings by the label of their box.
fn by_label(boxes: &Path, fixes: &Path) -> BTreeMap<String, Vec<Placed>> {
    let number = |value: &Value| value.as_f64().unwrap();
    let labels: HashMap<_, _> = lines(boxes)
        .iter()
        .map(|b| {
            let sequence = b["sequence"].as_i64().unwrap();
            (
                key(sequence, number(&b["x"]), number(&b["y"])),
                b["label"].as_str().unwrap().to_owned(),
            )
        })
        .collect();
    let anchor = place_from_degrees(ANCHOR_DEG.0, ANCHOR_DEG.1, ANCHOR_HEIGHT).unwrap();
    let mut placed: BTreeMap<String, Vec<Placed>> = BTreeMap::new();
    for fix in lines(fixes).iter().filter(|fix| !fix["geometry"].is_null()) {
        let properties = &fix["properties"];
        let at = ServiceTime::from_rfc3339(properties["captured_at"].as_str().unwrap()).unwrap();
        let sequence = (at - START).as_millis() as i64 / FRAME.as_millis() as i64;
        let corner = key(
            sequence,
            number(&properties["box_px"][0]),
            number(&properties["box_px"][1]),
        );
        placed
            .entry(labels[&corner].clone())
            .or_default()
            .push(Placed {
                enu_m: enu_offset(&anchor, &place(&fix["geometry"]["coordinates"])),
                range_m: number(&properties["range_m"]),
            });
    }
    placed
}

fn place(coordinates: &Value) -> Wgs84 {
    let [longitude, latitude, height] = [0, 1, 2].map(|i| coordinates[i].as_f64().unwrap());
    place_from_degrees(latitude, longitude, EllipsoidHeight::from_m(height)).unwrap()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Ranges from and to, metres; what a peer measured on the same set with corners of its own and
/// semi-global matching of whole images, metres; and what this test still allows, metres: halfway to
/// the 0.139 and 0.197 m that the same drive gave when every attitude was inverted. The far band is held to the
/// peer alone: corners that used to be refused there now have a place, and its spread is that of matching.
const BANDS: [(u32, u32, f64, f64); 3] = [
    (10, 20, 0.14, 0.12),
    (20, 30, 0.29, 0.18),
    (30, 50, 0.62, 0.62),
];
/// Fewest sightings that make a corner's median its place.
const FEWEST: usize = 8;

fn figures(placed: &BTreeMap<String, Vec<Placed>>) -> Vec<Value> {
    let enough: Vec<_> = placed
        .values()
        .filter(|sightings| sightings.len() >= FEWEST)
        .collect();
    let spread = |(from, to): (u32, u32)| -> Vec<f64> {
        let here = |s: &&Placed| (f64::from(from)..f64::from(to)).contains(&s.range_m);
        let of = |sightings: &&Vec<Placed>| -> Vec<f64> {
            let middle = Vector3::from_fn(|axis, _| {
                median(sightings.iter().map(|s| s.enu_m[axis]).collect())
            });
            sightings
                .iter()
                .filter(here)
                .map(|s| (s.enu_m - middle).norm())
                .collect()
        };
        enough.iter().flat_map(of).collect()
    };
    BANDS
        .into_iter()
        .map(|(from, to, bound, _)| {
            let distances = spread((from, to));
            let n = distances.len();
            let value = median(distances);
            json!({
                "name": format!("kitti.spread_m_{from}_{to}"), "value": value, "unit": "m",
                "bound": bound, "holds": value <= bound, "n": n,
            })
        })
        .collect()
}

fn results(scratch: &Scratch, out: &str) -> [Vec<u8>; 3] {
    ["alarms.geojson", "fixes.jsonl", "summary.json"]
        .map(|name| std::fs::read(scratch.path(out).join(name)).unwrap())
}

/// Through the first camera, which is level and heads north, a place can be worked out by hand: north is
/// `f b / d`, east and up follow from the pixel. The box's base need not stand in the very plane in which
/// its disparity was measured, which is worth its half width: 12 px of 707.
fn first_places_are_where_similar_triangles_put_them(fixes: &Path) -> usize {
    let anchor = place_from_degrees(ANCHOR_DEG.0, ANCHOR_DEG.1, ANCHOR_HEIGHT).unwrap();
    let first = lines(fixes).into_iter().filter(|fix| {
        fix["properties"]["captured_at"] == START.rfc3339() && !fix["geometry"].is_null()
    });
    let check = |fix: Value| {
        let number = |value: &Value| value.as_f64().unwrap();
        let properties = &fix["properties"];
        let [x, y, width, height] = [0, 1, 2, 3].map(|i| number(&properties["box_px"][i]));
        let north = 379.8145 / number(&properties["disparity_px"]);
        let east = (x + width / 2.0 - 601.8873) / 707.0912 * north;
        let up = -(y + height - 183.1104) / 707.0912 * north;
        let found = enu_offset(&anchor, &place(&fix["geometry"]["coordinates"]));
        let off = (found - Vector3::new(east, north, up)).norm();
        assert!(
            off < 0.02 * found.norm() + 0.02,
            "{fix}: {found} is not {east} {north} {up}"
        );
    };
    first.map(check).count()
}

#[test]
fn static_things_keep_one_place_while_the_car_drives_by() {
    let Some(set) = shared::shared_data("vehicle/kitti_01") else {
        return;
    };
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = recording(&set, &clients);
    let boxes: PathBuf = scratch.path("boxes.jsonl");
    let replay = |out: &str| {
        let boxes = boxes.to_str().unwrap();
        replays::replay(
            &scratch,
            &scratch.path("rec.mcap"),
            out,
            &["--boxes", boxes],
        )
        .json()
    };
    let (summary, _again) = (replay("first"), replay("second"));
    println!("{}", summary["counters"]);
    assert_eq!(summary["counters"]["pairs"]["looked_at"], 51, "{summary}");
    assert!(
        results(&scratch, "first") == results(&scratch, "second"),
        "the same bytes twice"
    );

    let fixes = scratch.path("first").join("fixes.jsonl");
    let placed = by_label(&boxes, &fixes);
    let figures = figures(&placed);
    println!("{:#}", json!({ "figures": figures }));
    for (figure, (.., allowed_m)) in figures.iter().zip(BANDS) {
        let (value_m, n) = (
            figure["value"].as_f64().unwrap(),
            figure["n"].as_u64().unwrap(),
        );
        assert!(n >= 100, "too few to say anything: {figure}");
        assert!(
            value_m < allowed_m,
            "a frame, a height or a clock drifts, or matching: {figure}"
        );
    }
    let by_hand = first_places_are_where_similar_triangles_put_them(&fixes);
    assert!(by_hand >= 10, "{by_hand} places in the first picture");
}
