//! A near-infrared right eye, from rendered pictures to the alarm: each of two fires in view has a signal of
//! its own. A spectrometer, which sees both at once, says nothing of either.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

use emberfix::alarm::{AlarmProperties, FireId};
use emberfix::detect::{BoxPx, DetectError, Detection, DetectionClass, Detector, LeftImage};
use emberfix::ingest::{Recorded, Recording};
use emberfix::mission::Mission;
use emberfix::pipeline::{Event, Output, Pipeline};
use emberfix::range;
use emberfix_mav::FrameReader;
use emberfix_sim::flight::{Nose, PathConfig};
use emberfix_sim::render::{RenderConfig, Renderer, StereoCamera};
use emberfix_sim::world::{BurningClass, FireConfig, TreesConfig};
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const RATE_HZ: f64 = 3.0;
const FLIGHT_S: f64 = 14.0;

/// Two fires side by side: one grows by a fourteenth of its height a second, the other one shrinks.
fn fires() -> Vec<FireConfig> {
    let fire = |name: &str, east_m, height_m, growth_m_s| FireConfig {
        name: name.to_owned(),
        east_m,
        north_m: 0.0,
        width_m: 0.8 * height_m,
        height_m,
        smoke: false,
        ignites_at_s: 0.0,
        growth_m_s,
    };
    vec![
        fire("grows", -2.5, 0.7, 0.05),
        fire("dies", 2.5, 1.7, -0.05),
    ]
}

/// The demonstration's mission with another rig, in a folder of its own.
fn mission_file(folder: &Path, near_infrared: bool) -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let read = |name: &str| std::fs::read_to_string(root.join(name)).unwrap();
    let right = "[right]\n";
    let seen = format!("{right}near_infrared = {near_infrared}\n");
    let rig = read("calib/rigs/oakd-75mm.toml");
    assert!(rig.contains(right));
    std::fs::write(folder.join("rig.toml"), rig.replace(right, &seen)).unwrap();
    let mut text =
        read("missions/gaochun.toml").replace("../calib/rigs/oakd-75mm.toml", "rig.toml");
    if near_infrared {
        text.push_str("\n[range]\nmethod = \"cross_spectral\"\n");
    }
    text.push_str("\n[sim.spectrometer]\n");
    let path = folder.join("mission.toml");
    std::fs::write(&path, text).unwrap();
    path
}

/// Boxes of the flames of each pair, as the renderer knows them.
struct Given(VecDeque<Vec<Detection>>);

impl Detector for Given {
    fn detect(&mut self, _image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        Ok(self.0.pop_front().unwrap_or_default())
    }
}

struct Flown {
    pipeline: Pipeline,
    /// The latest alarm of each fire.
    told: BTreeMap<String, AlarmProperties>,
    pairs: u64,
}

/// A flight in half a circle about both fires.
fn fly(near_infrared: bool) -> Flown {
    let folder = tempfile::tempdir().unwrap();
    let path = mission_file(folder.path(), near_infrared);
    let mut simulated = emberfix_sim::mission::Mission::load(path.to_str().unwrap()).unwrap();
    let sim = &mut simulated.sim;
    sim.world.fires = fires();
    sim.world.lookalikes.clear();
    sim.world.trees = TreesConfig::default();
    sim.camera.rate_hz = RATE_HZ;
    sim.flight.duration_s = FLIGHT_S;
    sim.flight.path = PathConfig::Orbit {
        centre_m: [0.0, 0.0],
        radius_m: 14.0,
        height_above_ground_m: 9.0,
        speed_m_s: 2.0,
        start_azimuth_deg: 160.0,
        clockwise: true,
        nose: Nose::Centre,
    };
    let (world, flight) = emberfix_sim::setup(&simulated).unwrap();
    let renderer = Renderer::new(
        Arc::clone(&world),
        StereoCamera::new(&simulated.rig),
        RenderConfig::default(),
    );
    let pairs = (FLIGHT_S * RATE_HZ) as u64;
    let boxes = (0..pairs).map(|k| {
        let t_s = (k as f64 + 0.5) / RATE_HZ;
        let labels = renderer.label_boxes(&flight.state(t_s), t_s);
        let flames = labels
            .into_iter()
            .filter(|label| label.class == BurningClass::Fire);
        let detection = |label: emberfix_sim::render::LabelBox| Detection {
            class: DetectionClass::Fire,
            score: 0.9,
            box_px: BoxPx {
                x: label.left_px,
                y: label.top_px,
                width: label.right_px - label.left_px,
                height: label.bottom_px - label.top_px,
            },
            mask: None,
            second_look: None,
        };
        flames.map(detection).collect()
    });
    let detector = Given(boxes.collect());
    let file = tempfile::NamedTempFile::new().unwrap();
    let errors = simulated.sim.errors.clone();
    let writer = std::io::BufWriter::new(file.reopen().unwrap());
    emberfix_sim::record::record(&simulated, &world, &flight, &errors, writer, |_| {}).unwrap();
    let mission = Mission::load(&path).unwrap();
    let ranger = range::open(mission.range_method, &mission.rig, &mission.range).unwrap();
    let pipeline = Pipeline::new(&mission, Box::new(detector), ranger, FireId(1));
    let recording = Recording::open(file.path(), &mission.rig).unwrap();
    work_off(pipeline, recording, pairs)
}

fn work_off(mut pipeline: Pipeline, mut recording: Recording, pairs: u64) -> Flown {
    let mut told = BTreeMap::new();
    let mut frames = FrameReader::new();
    while let Some(event) = recording.next_event().unwrap() {
        let outputs = match event {
            Recorded::Mavlink { arrived, bytes } => {
                frames.push(&bytes);
                let mut outputs = Vec::new();
                while let Some(received) = frames.next_received() {
                    outputs.extend(pipeline.handle(arrived, Event::Mavlink(Box::new(received))));
                }
                outputs
            }
            Recorded::Pair(pair) => {
                pipeline.handle(pair.value.arrived, Event::Pair(Box::new(pair)))
            }
            Recorded::Action { arrived, action } => pipeline.handle(arrived, Event::Action(action)),
            Recorded::Calibration { .. } => Vec::new(),
        };
        for output in outputs {
            if let Output::Alarm(alarm) = output {
                told.insert(alarm.properties.id.clone(), alarm.properties);
            }
        }
    }
    Flown {
        pipeline,
        told,
        pairs,
    }
}

#[test]
fn a_near_infrared_eye_tells_of_each_of_two_fires_by_itself() {
    let flown = fly(true);
    let counters = flown.pipeline.counters();
    let seen = counters.get("near_infrared", "seen");
    assert!(
        seen > flown.pairs,
        "{seen} samples of two fires in {} pairs: {counters:?}",
        flown.pairs
    );
    assert_eq!(counters.get("spectrometer", "read"), 0);
    let mut trends: Vec<f64> = flown
        .told
        .values()
        .filter_map(|alarm| alarm.trend)
        .collect();
    trends.sort_by(f64::total_cmp);
    assert_eq!(trends.len(), 2, "{:?}", flown.told);
    // Heights that change by 7 % and -3 % a second are faces that change by twice that.
    assert!(trends[0] < -0.03 && trends[1] > 0.03, "{trends:?}");
    let spectral_lost =
        |alarm: &AlarmProperties| alarm.degraded.iter().any(|r| r.starts_with("spectral"));
    assert!(
        !flown.told.values().any(spectral_lost),
        "{counters:?} {:?}",
        flown.told
    );
}

#[test]
fn a_spectrometer_that_sees_two_fires_says_nothing_of_either() {
    let flown = fly(false);
    let counters = flown.pipeline.counters();
    assert_eq!(counters.get("near_infrared", "seen"), 0);
    let both = counters.get("spectrometer", "not_one_fire_alone");
    assert!(both > flown.pairs / 2, "{counters:?}");
}
