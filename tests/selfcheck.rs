//! The self-check in flight, on rendered pictures of a whole flight: a rig that holds raises no
//! warning, one that was bent since it was calibrated does, in the words that the operator gets.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

use emberfix::alarm::FireId;
use emberfix::detect::{DetectError, Detection, Detector, LeftImage};
use emberfix::ingest::{Recorded, Recording};
use emberfix::mission::Mission;
use emberfix::pipeline::{Event, Pipeline};
use emberfix::range;
use emberfix_mav::FrameReader;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Ten seconds of the demonstration's flight, a pair a second; consumer sensors.
fn recording() -> &'static Path {
    static RECORDED: OnceLock<tempfile::TempPath> = OnceLock::new();
    RECORDED.get_or_init(|| {
        let path = root().join("missions/gaochun.toml");
        let mut mission = emberfix_sim::mission::Mission::load(path.to_str().unwrap()).unwrap();
        mission.sim.flight.duration_s = 10.0;
        mission.sim.camera.rate_hz = 1.0;
        let (world, flight) = emberfix_sim::setup(&mission).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        let errors = mission.sim.errors.clone();
        let writer = std::io::BufWriter::new(file.reopen().unwrap());
        emberfix_sim::record::record(&mission, &world, &flight, &errors, writer, |_| {}).unwrap();
        file.into_temp_path()
    })
}

/// The demonstration's mission with another rotation between the eyes than the pictures were taken with.
fn mission(folder: &Path, right_from_left_rotation_deg: &str) -> Mission {
    let read = |name: &str| std::fs::read_to_string(root().join(name)).unwrap();
    let as_built = "right_from_left_rotation_deg = [0.12, -0.20, 0.08]";
    let rig = read("calib/rigs/oakd-75mm.toml");
    assert!(rig.contains(as_built));
    let other = format!("right_from_left_rotation_deg = {right_from_left_rotation_deg}");
    std::fs::write(folder.join("rig.toml"), rig.replace(as_built, &other)).unwrap();
    let text = read("missions/gaochun.toml").replace("../calib/rigs/oakd-75mm.toml", "rig.toml");
    let path: PathBuf = folder.join("mission.toml");
    std::fs::write(&path, text).unwrap();
    Mission::load(&path).unwrap()
}

/// Sees nothing: the check needs no fire.
struct Blind;

impl Detector for Blind {
    fn detect(&mut self, _image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        Ok(Vec::new())
    }
}

/// What the operator is told at the end of the flight.
fn told(right_from_left_rotation_deg: &str) -> Vec<&'static str> {
    let folder = tempfile::tempdir().unwrap();
    let mission = mission(folder.path(), right_from_left_rotation_deg);
    let ranger = range::open(mission.range_method, &mission.rig, &mission.range).unwrap();
    let mut pipeline = Pipeline::new(&mission, Box::new(Blind), ranger, FireId(1));
    let mut recording = Recording::open(recording(), &mission.rig).unwrap();
    let mut frames = FrameReader::new();
    while let Some(event) = recording.next_event().unwrap() {
        match event {
            Recorded::Mavlink { arrived, bytes } => {
                frames.push(&bytes);
                while let Some(received) = frames.next_received() {
                    pipeline.handle(arrived, Event::Mavlink(Box::new(received)));
                }
            }
            Recorded::Pair(pair) => {
                pipeline.handle(pair.value.arrived, Event::Pair(Box::new(pair)));
            }
            Recorded::Action { arrived, action } => {
                pipeline.handle(arrived, Event::Action(action));
            }
            Recorded::Calibration { .. } => {}
        }
    }
    assert!(pipeline.counters().get("self_check", "compared") >= 8);
    pipeline.health(pipeline.now()).warnings
}

#[test]
fn a_rig_that_holds_raises_no_warning() {
    assert_eq!(told("[0.12, -0.20, 0.08]"), Vec::<&str>::new());
}

#[test]
fn rows_that_do_not_meet_are_told() {
    // 0.06 degrees are 0.9 px.
    let told = told("[0.18, -0.20, 0.08]");
    assert!(
        told.contains(&"stereo rig is bent: calibrate it again"),
        "{told:?}"
    );
}

#[test]
fn eyes_that_squint_are_told_by_the_ground() {
    // A tenth of a degree is 1.5 px of disparity: at 30 m, where 2.2 px are right, two thirds of the range.
    let told = told("[0.12, -0.30, 0.08]");
    assert!(
        told.contains(&"stereo disagrees with terrain: calibrate it"),
        "{told:?}"
    );
}
