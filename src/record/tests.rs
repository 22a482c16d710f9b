//! Recordings written, read back, torn, and read by strangers.

use super::*;
use crate::alarm::{Alarm, AlarmClass, AlarmProperties, FireState, Method};
use crate::assess::spectrum::Spectrum;
use crate::detect::{BoxPx, Detection, DetectionClass};
use crate::ingest::testing::{at, pair, rig, workspace};
use crate::ingest::{McapStream, Recorded, Recording, StereoPair, StreamEvent};
use emberfix_calib::Eye;
use emberfix_frames::{EllipsoidHeight, ServiceTime, Stamped, place_from_degrees};
use std::path::Path;
use std::process::Command;

const PAIRS: i64 = 32;

fn place() -> Wgs84 {
    place_from_degrees(31.409_422, 119.112_017, EllipsoidHeight::from_m(24.5)).unwrap()
}

fn alarm(ms: i64) -> Alarm {
    Alarm {
        place: place(),
        properties: AlarmProperties {
            id: "ember-1-1".to_owned(),
            revision: 1,
            uav: "ember-1".to_owned(),
            class: AlarmClass::Fire,
            state: FireState::Confirmed,
            confidence: 0.93,
            first_seen_at: at(0),
            captured_at: at(ms),
            altitude_msl_m: 13.9,
            height_above_ground_m: None,
            ce90_m: 1.8,
            le90_m: 1.1,
            covariance_enu_m2: [0.7, 0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.0, 0.4],
            methods: vec![Method::Stereo],
            sightings: 5,
            range_m: 17.2,
            size_m: None,
            trend: Some(0.01),
            advice: None,
            burning: Default::default(),
            degraded: vec!["one_eye".to_owned()],
        },
    }
}

/// A MAVLink 2 heartbeat, packed by pymavlink (sequence 0, system 1, component 1).
const HEARTBEAT: [u8; 21] = [
    0xFD, 0x09, 0x00, 0x00, 0x00, 0x01, 0x01, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x02, 0x0C,
    0x00, 0x04, 0x03, 0xB6, 0xBD,
];
/// What a short flight records: telemetry before each pair, results after it.
fn record(path: &Path, options: &RecordOptions) {
    let mut tape = Tape::create(path, &rig(), options).unwrap();
    for n in 0..PAIRS {
        let exposed = at(100 * n);
        tape.write_mavlink(at(100 * n - 5), &HEARTBEAT).unwrap();
        tape.write_pair(&recorded_pair(n)).unwrap();
        let fix = UavFix {
            place: place(),
            covariance: Covariance::from_sigmas_m(1.0, 1.0, 2.0),
            heading_rad: Some(1.5),
        };
        tape.write_uav_fix(exposed, &fix).unwrap();
        let pose = BodyPose {
            position_enu_m: Vector3::new(1.0, 2.0, 12.0),
            enu_from_body: UnitQuaternion::identity(),
        };
        tape.write_body_pose(exposed, &pose).unwrap();
        let box_px = BoxPx {
            x: 10.0,
            y: 8.0,
            width: 6.0,
            height: 9.0,
        };
        let detection = Detection {
            class: DetectionClass::Fire,
            score: 0.9,
            box_px,
            mask: None,
            second_look: None,
        };
        tape.write_detections(exposed, &[detection]).unwrap();
        let fix = serde_json::json!({"type": "Feature", "geometry": null,
            "properties": {"fire": 1, "box_px": [10, 8, 6, 9]}});
        tape.write_fix_json(exposed, &fix).unwrap();
    }
    tape.write_alarm(at(100 * PAIRS), &alarm(100 * PAIRS))
        .unwrap();
    tape.finish().unwrap();
}

/// Every fourth pair has lost its right eye, and before every fourth the spectrometer has spoken.
fn recorded_pair(n: i64) -> Stamped<StereoPair> {
    let mut pair = pair(n);
    if n % 4 == 3 {
        pair.value.right = None;
        pair.value.skew = emberfix_frames::SignedDuration::ZERO;
    }
    if n % 4 == 1 {
        let (nm, light) = (vec![588.0, 589.3, 591.0], vec![1.0, 7.5, 1.25]);
        pair.value.spectra = vec![Spectrum::new(pair.at, nm, light).unwrap()];
    }
    pair
}

fn recorded(name: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    record(&path, &RecordOptions::default());
    (folder, path)
}

fn replay(path: &Path) -> Vec<Recorded> {
    let mut recording = Recording::open(path, &rig()).unwrap();
    std::iter::from_fn(|| recording.next_event().unwrap()).collect()
}

fn arrival(event: &Recorded) -> ServiceTime {
    match event {
        Recorded::Mavlink { arrived, .. }
        | Recorded::Action { arrived, .. }
        | Recorded::Calibration { arrived, .. } => *arrived,
        Recorded::Pair(pair) => pair.value.arrived,
    }
}

#[test]
fn what_was_recorded_comes_back_byte_for_byte_in_order_of_arrival() {
    let (_folder, path) = recorded("a.mcap");
    let events = replay(&path);
    assert!(events.is_sorted_by_key(arrival));
    let pairs: Vec<_> = events
        .iter()
        .filter_map(|event| match event {
            Recorded::Pair(pair) => Some(pair.clone()),
            _ => None,
        })
        .collect();
    let written: Vec<_> = (0..PAIRS).map(recorded_pair).collect();
    assert_eq!(pairs, written);
    let frames = events
        .iter()
        .filter(|event| matches!(event, Recorded::Mavlink { bytes, .. } if bytes[..] == HEARTBEAT));
    assert_eq!(frames.count(), PAIRS as usize);
    let mut eyes = Vec::new();
    for event in &events {
        if let Recorded::Calibration { eye, stated, .. } = event {
            stated.check(rig().camera(*eye)).unwrap();
            assert!(stated.check(rig().camera(other(*eye))).is_err());
            eyes.push(*eye);
        }
    }
    assert_eq!(eyes, [Eye::Left, Eye::Right]);
    assert!(
        matches!(events[0], Recorded::Mavlink { .. }),
        "telemetry came first"
    );
}

fn other(eye: Eye) -> Eye {
    if eye == Eye::Left {
        Eye::Right
    } else {
        Eye::Left
    }
}

#[test]
fn the_same_calls_give_the_same_bytes_and_none_are_overwritten() {
    let (_one, first) = recorded("a.mcap");
    let (_two, second) = recorded("b.mcap");
    assert_eq!(
        std::fs::read(&first).unwrap(),
        std::fs::read(second).unwrap()
    );
    assert!(matches!(
        Tape::create(&first, &rig(), &RecordOptions::default()),
        Err(RecordError::Io { .. })
    ));
}

#[test]
fn a_replay_recorded_again_is_the_same_replay() {
    let (folder, path) = recorded("a.mcap");
    let again = folder.path().join("again.mcap");
    let mut tape = Tape::create(&again, &rig(), &RecordOptions::default()).unwrap();
    for event in replay(&path) {
        match event {
            Recorded::Mavlink { arrived, bytes } => tape.write_mavlink(arrived, &bytes).unwrap(),
            Recorded::Pair(pair) => tape.write_pair(&pair).unwrap(),
            Recorded::Action { arrived, action } => tape.write_action(arrived, &action).unwrap(),
            Recorded::Calibration { .. } => {} // the tape writes the rig's
        }
    }
    tape.finish().unwrap();
    assert_eq!(replay(&again), replay(&path));
}

#[test]
fn a_recording_torn_at_any_byte_gives_its_whole_beginning() {
    let (folder, path) = recorded("a.mcap");
    let bytes = std::fs::read(&path).unwrap();
    let whole = replay(&path);
    let torn = folder.path().join("torn.mcap");
    let mut most = 0;
    for length in (0..bytes.len()).step_by(bytes.len() / 200) {
        std::fs::write(&torn, &bytes[..length]).unwrap();
        let Ok(mut recording) = Recording::open(&torn, &rig()) else {
            continue;
        };
        let events: Vec<_> = std::iter::from_fn(|| recording.next_event().unwrap()).collect();
        for event in events
            .iter()
            .filter(|event| matches!(event, Recorded::Mavlink { .. }))
        {
            assert!(whole.contains(event), "made up at {length}");
        }
        let mavlink = |events: &[Recorded]| {
            events
                .iter()
                .filter(|e| matches!(e, Recorded::Mavlink { .. }))
                .count()
        };
        assert!(
            mavlink(&events) >= most,
            "a longer file must not hold less, at {length}"
        );
        most = mavlink(&events);
    }
    assert_eq!(most, PAIRS as usize);
    // Into the data, but not at a record's edge: the loss has a number.
    std::fs::write(&torn, &bytes[..bytes.len() / 2]).unwrap();
    let counters = Recording::open(&torn, &rig()).map(|recording| recording.counters().lost_bytes);
    assert!(counters.is_ok_and(|lost| lost > 0));
}

#[test]
fn a_damaged_chunk_costs_that_chunk_and_is_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    record(
        &path,
        &RecordOptions {
            compression: ChunkCompression::None,
            ..Default::default()
        },
    );
    let mut bytes = std::fs::read(&path).unwrap();
    // The second message of the first chunk: the bytes of a JPEG.
    let spot = bytes
        .windows(4)
        .position(|w| w == [0xFF, 0xD8, 0xFF, 0xE0])
        .unwrap()
        + 100;
    bytes[spot] ^= 0x10;
    std::fs::write(&path, bytes).unwrap();
    let mut recording = Recording::open(&path, &rig()).unwrap();
    assert_eq!(recording.counters().bad_chunks, 1);
    let events: Vec<_> = std::iter::from_fn(|| recording.next_event().unwrap()).collect();
    let mavlink = events
        .iter()
        .filter(|e| matches!(e, Recorded::Mavlink { .. }))
        .count();
    assert!(
        (20..PAIRS as usize).contains(&mavlink),
        "three of four chunks are whole: {mavlink}"
    );
}

#[test]
fn what_is_no_recording_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let refuse = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        Recording::open(&path, &rig())
            .map(drop)
            .unwrap_err()
            .to_string()
    };
    assert!(refuse(b"").contains("0 bytes"));
    assert!(refuse(&[7; 1000]).contains("no MCAP file"));
    let mut empty = Vec::new();
    let mut writer = mcap::Writer::new(std::io::Cursor::new(&mut empty)).unwrap();
    writer.finish().unwrap();
    drop(writer);
    assert!(refuse(&empty).contains("/mavlink/raw"));
}

/// All events of a stream that arrives in pieces of `piece` bytes.
fn stream(bytes: &[u8], piece: usize) -> (Vec<StreamEvent>, crate::ingest::StreamCounters) {
    let mut stream = McapStream::new(rig().max_skew_s());
    let mut events = Vec::new();
    for part in bytes.chunks(piece) {
        stream.push(part, None);
        events.extend(std::iter::from_fn(|| stream.pop()));
    }
    stream.end();
    events.extend(std::iter::from_fn(|| stream.pop()));
    (events, stream.counters())
}

#[test]
fn a_stream_gives_the_same_in_whatever_pieces_it_comes_and_after_garbage() {
    let (_folder, path) = recorded("a.mcap");
    let bytes = std::fs::read(path).unwrap();
    let (whole, counters) = stream(&bytes, bytes.len());
    assert_eq!((counters.pairs, counters.left_alone), (24, 8));
    assert_eq!((counters.lost_bytes, counters.garbage_bytes), (0, 0));
    for piece in [1, 7, 1000] {
        assert_eq!(stream(&bytes, piece).0, whole, "pieces of {piece}");
    }
    let mut garbage = b"\x89MCAP garbage \x89MCAP0".to_vec();
    let length = garbage.len() as u64;
    garbage.extend_from_slice(&bytes);
    for piece in [1, 1000] {
        let (events, counters) = stream(&garbage, piece);
        assert_eq!(events, whole);
        assert_eq!((counters.garbage_bytes, counters.lost_bytes), (length, 0));
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(200))]
    #[test]
    fn no_damage_makes_a_stream_panic_or_invent_frames(
        share in 0.0..1.0_f64, flip in 1_u8.., cut in 0.0..1.0_f64, insert in 0_usize..20,
    ) {
        static BYTES: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
        let bytes = BYTES.get_or_init(|| std::fs::read(recorded("a.mcap").1).unwrap());
        let mut damaged = bytes.clone();
        let spot = (share * bytes.len() as f64) as usize;
        damaged[spot] ^= flip;
        damaged.splice(spot..spot, std::iter::repeat_n(flip, insert));
        damaged.truncate(bytes.len() - (cut * cut * cut * bytes.len() as f64) as usize);
        let (events, _) = stream(&damaged, 4096);
        for event in events {
            if let StreamEvent::Mavlink { bytes, .. } = event {
                proptest::prop_assert_eq!(&bytes[..], &HEARTBEAT[..]);
            }
        }
    }
}

#[test]
fn the_recorder_writes_what_the_tape_writes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = Recorder::create(&path, &rig(), &RecordOptions::default()).unwrap();
    for n in 0..PAIRS {
        recorder.write_mavlink(at(100 * n - 5), &HEARTBEAT);
        recorder.write_pair(&recorded_pair(n));
        while recorder.status().written < 2 * n as u64 + 2 {
            std::thread::yield_now();
        }
    }
    let status = recorder.finish().unwrap();
    assert_eq!((status.shed_pairs, status.lost), (0, 0));
    assert!(status.written >= 2 * PAIRS as u64, "and perhaps a flush");
    let (_folder, tape) = recorded("b.mcap");
    assert_eq!(replay(&path), replay(&tape));
}

#[test]
fn a_full_disk_stops_the_recording_loudly_and_nothing_else() {
    if !Path::new("/dev/full").exists() {
        println!("skipped: no /dev/full");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("full");
    std::os::unix::fs::symlink("/dev/full", &path).unwrap();
    let file = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    let tape = Tape::on(file, &path, &rig(), &RecordOptions::default()).unwrap();
    let recorder = Recorder::start(tape, &path).unwrap();
    for n in 0..PAIRS {
        recorder.write_pair(&recorded_pair(n));
        recorder.write_alarm(at(100 * n), &alarm(100 * n));
    }
    recorder.flush();
    let error = recorder.finish().unwrap_err().to_string();
    assert!(error.contains("No space left"), "{error}");
}

#[test]
fn a_slow_disk_costs_images_and_never_telemetry() {
    let (mut disk, file) = std::io::pipe().unwrap();
    let file = std::fs::File::from(std::os::fd::OwnedFd::from(file));
    let path = Path::new("pipe");
    let tape = Tape::on(file, path, &rig(), &RecordOptions::default()).unwrap();
    let recorder = Recorder::start(tape, path).unwrap();
    // Nobody reads: the pipe is full after a few chunks, and the thread waits.
    let pairs = 200;
    for n in 0..pairs {
        recorder.write_mavlink(at(100 * n - 5), &HEARTBEAT);
        recorder.write_pair(&recorded_pair(n % PAIRS));
    }
    let shed = recorder.status().shed_pairs;
    assert!(shed > 0, "no disk is that fast");
    let reading = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        std::io::Read::read_to_end(&mut disk, &mut bytes).map(|_| bytes)
    });
    // A pipe can't be synced, which is all that can fail here.
    assert!(
        recorder
            .finish()
            .unwrap_err()
            .to_string()
            .contains("Invalid argument")
    );
    let (events, counters) = stream(&reading.join().unwrap().unwrap(), 4096);
    assert_eq!(counters.mavlink, pairs as u64);
    assert!(events.len() < 2 * pairs as usize);
}

/// The Python environment of the test clients, when it is set up.
fn python() -> Option<PathBuf> {
    let here = workspace().join(".x/venv/bin/python");
    let chosen = std::env::var_os("EMBERFIX_PYTHON").map_or(here, Into::into);
    let clients = workspace().join("tests/clients/mcap_check.py");
    let there = chosen.exists() && clients.exists();
    if !there {
        println!("skipped: no Python test clients (./x setup)");
    }
    there.then_some(chosen)
}

#[test]
fn the_python_package_reads_our_recording_and_finds_no_problem() {
    let Some(python) = python() else { return };
    let (_folder, path) = recorded("a.mcap");
    let check = workspace().join("tests/clients/mcap_check.py");
    let output = Command::new(python).arg(check).arg(&path).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        output.status.success(),
        "{text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let facts: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(facts["problems"], serde_json::json!([]));
    assert_eq!(facts["topics"]["/stereo/left/image"]["count"], PAIRS);
    assert_eq!(facts["topics"]["/fire/alarms"]["schema"], "emberfix.Alarm");
    assert_eq!(
        facts["topics"]["/mavlink/raw"]["message_encoding"],
        "mavlink"
    );
}

#[test]
fn we_read_what_the_python_package_writes() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    for compression in ["none", "lz4", "zstd"] {
        let path = folder.path().join(compression);
        let write = workspace().join("tests/clients/mcap_write.py");
        let mut command = Command::new(&python);
        command
            .arg(write)
            .arg(&path)
            .args(["--compression", compression]);
        let output = command.output().unwrap();
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        let mut recording = Recording::open(&path, &rig()).unwrap();
        let events: Vec<_> = std::iter::from_fn(|| recording.next_event().unwrap()).collect();
        let counters = recording.counters();
        assert_eq!(
            (counters.pairs, counters.mavlink, counters.calibrations),
            (5, 30, 2)
        );
        assert_eq!((counters.spectrometer, counters.lost_bytes), (5, 0));
        assert!(events.is_sorted_by_key(arrival));
    }
}
