//! The whole, as strangers: simulator, service and ground station as they are built, over real
//! sockets. Needs the `emberfix` binary beside the simulator's, which a test run of the whole
//! workspace builds, and ONNX Runtime.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

use serde_json::Value;
use std::path::Path;
use std::process::Command;

fn figure(report: &Value, name: &str) -> f64 {
    let figures = report["figures"].as_array().unwrap();
    let figure = figures.iter().find(|figure| figure["name"] == name);
    figure.unwrap()["value"].as_f64().unwrap()
}

#[test]
fn a_flight_becomes_an_alarm_at_the_place_of_the_fire() {
    let simulator = Path::new(env!("CARGO_BIN_EXE_emberfix-sim"));
    if !simulator.with_file_name("emberfix").exists() {
        println!("skipped: no emberfix binary beside the simulator (cargo test --workspace)");
        return;
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut demo = Command::new(simulator);
    demo.args(["demo", "gaochun", "--errors", "off", "--headless", "--json"]);
    let said = demo.current_dir(root).output().unwrap();
    let words = String::from_utf8_lossy(&said.stderr);
    let report: Value =
        serde_json::from_slice(&said.stdout).unwrap_or_else(|error| panic!("{error}: {words}"));
    assert!(
        (figure(&report, "demo.fires_found") - 1.0).abs() < 0.5,
        "{report:#}"
    );
    // The bound of the issue for exact sensors; GNSS alone is allowed 3 m.
    assert!(
        figure(&report, "demo.horizontal_error_mean_m") <= 0.5,
        "{report:#}"
    );
    assert!(
        report["service_heartbeats"].as_u64().unwrap() > 10,
        "{report:#}"
    );
}
