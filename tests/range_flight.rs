//! `emberfix calibrate range` from a flight: a fire that is placed without stereo shows what is wrong with the
//! rig's range.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[expect(dead_code, reason = "the mission is another one here")]
mod support;

use emberfix_calib::Rig;
use emberfix_sim::flight::PathConfig;
use emberfix_sim::mission::Mission as SimMission;
use emberfix_sim::render::{RenderConfig, Renderer, StereoCamera};
use emberfix_sim::world::{BurningClass, FireConfig};
use std::fmt::Write;
use std::path::Path;
use std::sync::Arc;
use support::{Said, emberfix, root};

const RATE_HZ: f64 = 2.5;
const FLIGHT_S: f64 = 36.0;
/// The baseline that the rig file has, over the true one.
const WRONG: f64 = 1.06;

/// In from afar, strafing left and right, and round: RTK, and a rig whose mount and clock are as its file says.
fn flight() -> SimMission {
    let path = root().join("missions/marker.toml");
    let mut simulated = SimMission::load(path.to_str().unwrap()).unwrap();
    let sim = &mut simulated.sim;
    sim.world.boards.clear();
    sim.world.fires = vec![FireConfig {
        name: "fire".to_owned(),
        east_m: 0.0,
        north_m: 0.0,
        width_m: 0.9,
        height_m: 1.3,
        smoke: false,
        ignites_at_s: 0.0,
        growth_m_s: 0.0,
    }];
    sim.camera.rate_hz = RATE_HZ;
    sim.camera.mount_error_deg = [0.0; 3];
    sim.errors.camera_offset_s = 0.0;
    sim.flight.duration_s = FLIGHT_S;
    sim.flight.path = PathConfig::Patrol {
        waypoints_m: vec![
            [-4.0, -30.0, 12.0],
            [6.0, -24.0, 11.0],
            [-6.0, -18.0, 10.0],
            [6.0, -12.0, 9.0],
            [12.0, -2.0, 8.0],
            [6.0, 10.0, 9.0],
            [-6.0, 12.0, 10.0],
        ],
        speed_m_s: 2.2,
        laps: 1,
        look_at_m: Some([0.0, 0.0]),
    };
    simulated
}

/// The recording, and the boxes of the flame.
fn fly(simulated: &SimMission, folder: &Path) {
    let (world, flight) = emberfix_sim::setup(simulated).unwrap();
    let renderer = Renderer::new(
        Arc::clone(&world),
        StereoCamera::new(&simulated.rig),
        RenderConfig::default(),
    );
    let mut boxes = String::new();
    for sequence in 0..(FLIGHT_S * RATE_HZ) as u64 {
        let t_s = (sequence as f64 + 0.5) / RATE_HZ;
        let labels = renderer.label_boxes(&flight.state(t_s), t_s);
        for label in labels
            .iter()
            .filter(|label| label.class == BurningClass::Fire)
        {
            let (width, height) = (
                label.right_px - label.left_px,
                label.bottom_px - label.top_px,
            );
            let (x, y) = (label.left_px, label.top_px);
            writeln!(boxes, "{sequence},{x},{y},{width},{height},fire").unwrap();
        }
    }
    std::fs::write(folder.join("boxes.csv"), boxes).unwrap();
    let file = std::fs::File::create(folder.join("flight.mcap")).unwrap();
    let writer = std::io::BufWriter::new(file);
    let errors = simulated.sim.errors.clone();
    emberfix_sim::record::record(simulated, &world, &flight, &errors, writer, |_| {}).unwrap();
}

/// The mission with a rig whose baseline is wrong, and receiver sigmas of choice.
fn mission_file(folder: &Path, name: &str, gnss_m: f64) {
    let read = |name: &str| std::fs::read_to_string(root().join(name)).unwrap();
    let rig_path = "calib/rigs/oakd-75mm.toml";
    let rig = Rig::load(&root().join(rig_path)).unwrap();
    let translation_m = rig.right_from_left_translation_m();
    let wrong: Vec<String> = read(rig_path)
        .lines()
        .map(|line| match line.split_once(" = [") {
            Some(("right_from_left_translation_m", _)) => {
                let longer = WRONG * translation_m;
                let [x, y, z] = [longer.x, longer.y, longer.z];
                format!("right_from_left_translation_m = [{x}, {y}, {z}]")
            }
            _ => line.to_owned(),
        })
        .collect();
    std::fs::write(folder.join("rig.toml"), wrong.join("\n")).unwrap();
    let mission = read("missions/marker.toml")
        .replace("../calib/rigs/oakd-75mm.toml", "rig.toml")
        .replace("../models", root().join("models").to_str().unwrap())
        .replacen(
            "gnss_horizontal_m = 0.02",
            &format!("gnss_horizontal_m = {gnss_m}"),
            1,
        )
        .replacen(
            "gnss_vertical_m = 0.03",
            &format!("gnss_vertical_m = {gnss_m}"),
            1,
        );
    std::fs::write(folder.join(name), mission).unwrap();
}

fn calibrate(folder: &Path, mission: &str) -> std::process::Output {
    let mut command = emberfix();
    command.args(["calibrate", "range", "--json"]);
    command.arg("--flight").arg(folder.join("flight.mcap"));
    command.arg("--mission").arg(folder.join(mission));
    command.arg("--boxes").arg(folder.join("boxes.csv"));
    command.output().unwrap()
}

#[test]
fn a_wrong_baseline_is_found_and_written_by_flying_past_a_fire() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fly(&flight(), folder);

    // Distances by a receiver that may wander by ten metres say less than the rig file.
    mission_file(folder, "wandering.toml", 10.0);
    let before = std::fs::read_to_string(folder.join("rig.toml")).unwrap();
    let refused = calibrate(folder, "wandering.toml");
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && said.contains("RTK"), "{said}");
    let after = std::fs::read_to_string(folder.join("rig.toml")).unwrap();
    assert_eq!(before, after, "a refusal writes nothing");

    mission_file(folder, "rtk.toml", 0.02);
    let found = Said::of(&calibrate(folder, "rtk.toml")).json();
    let number = |value: &serde_json::Value| value.as_f64().unwrap();
    let (scale, offset_per_m) = (number(&found["scale"]), number(&found["offset_per_m"]));
    let [scale_variance, both, offset_variance] =
        [0, 1, 2].map(|term| number(&found["covariance"][term]));
    // Measured inverse depths are too small by what the baseline is too long. Judged where it was flown.
    let per_m = 1.0 / 15.0;
    let off = (scale * per_m + offset_per_m) * WRONG / per_m - 1.0;
    let variance = scale_variance * per_m * per_m + 2.0 * both * per_m + offset_variance;
    let sigma = variance.sqrt() * WRONG / per_m;
    println!("at 15 m {off:+.4} ± {sigma:.4}; scale {scale:.4}, offset {offset_per_m:+.5} 1/m");
    assert!(off.abs() < 3.0 * sigma, "{off} ± {sigma}");
    assert!(off.abs() < 0.02, "a third of what was wrong: {off}");
    let written = Rig::load(&folder.join("rig.toml")).unwrap();
    assert!((written.inverse_depth().scale - scale).abs() < 1e-6);
}
