//! A real browser sees the fire on the ground station's page: the real `emberfix ground`, an alarm
//! over HTTP, Chromium. Exit code 77 of the client means that there is no browser here.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/clients.rs"]
#[expect(
    dead_code,
    reason = "the browser is run to its end, and states no facts"
)]
mod clients;
#[expect(dead_code, reason = "no mission is flown here")]
mod support;

use clients::{Clients, Running};
use emberfix::alarm::Alarm;
use emberfix::deliver::http::HttpLink;
use std::process::Command;
use support::Said;

/// A fire at P3's place, as an aircraft tells it.
const FIRE: &str = r#"{"type": "Feature",
    "geometry": {"type": "Point", "coordinates": [119.1120167, 31.4094222, 11.06]},
    "properties": {"id": "uav-1-7", "revision": 1, "uav": "uav-1", "class": "fire",
        "state": "growing", "confidence": 0.95,
        "first_seen_at": "2026-03-01T04:00:10.000000000Z",
        "captured_at": "2026-03-01T04:00:14.000000000Z",
        "altitude_msl_m": 8.7067, "height_above_ground_m": 0.1, "ce90_m": 3.2, "le90_m": 4.1,
        "covariance_enu_m2": [2.25, 0, 0, 0, 2.25, 0, 0, 0, 6.25], "methods": ["stereo"],
        "sightings": 9, "range_m": 21.5, "size_m": {"width": 6.2, "height": 2.1},
        "size_sigma_m": {"width": 0.6, "height": 0.5}, "size_class": "large",
        "trend": 0.031, "trend_sigma": 0.008, "trend_probability": {"growing": 0.99, "dying": 0.0},
        "intensity": {"value": 2.1, "sigma": 0.2},
        "intensity_history": [[-20, 1.0], [-15, 1.1], [-10, 1.3], [-5, 1.7], [0, 2.1]],
        "area": {"polygon": [[119.11198, 31.40941], [119.11204, 31.40941], [119.11206, 31.40944],
            [119.11204, 31.40947], [119.11198, 31.40947], [119.11197, 31.40944]],
            "edge_sigma_m": 0.7, "square_metres": {"value": 38.0, "sigma": 7.0},
            "front": [[119.11204, 31.40941], [119.11206, 31.40944], [119.11204, 31.40947]]},
        "spread": {"azimuth_deg": {"value": 92.0, "sigma": 8.0},
            "speed_m_s": {"value": 0.21, "sigma": 0.04}, "used_wind": true},
        "degraded": []}}"#;

#[test]
fn a_browser_sees_the_fire_and_asks_no_other_server() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("ground.toml");
    std::fs::write(&config, "listen = \"127.0.0.1:0\"\ndata_dir = \"data\"\n").unwrap();
    let mut ground = Command::new(env!("CARGO_BIN_EXE_emberfix"));
    ground.arg("ground").arg(&config);
    let (ground, line) = Running::start(ground, "http://");
    let url = line
        .split_whitespace()
        .find(|word| word.starts_with("http://"))
        .unwrap();

    let alarm = Alarm::from_geojson(FIRE.as_bytes()).unwrap();
    HttpLink::new(url).unwrap().send_alarm(&alarm).unwrap();

    let mut browser = clients.client("browser_check.py");
    browser.args([
        url,
        "--expect",
        "uav-1-7",
        "--expect",
        "31.409422, 119.112017",
        "--expect",
        "large: 6.2 m ± 0.6 m wide, 2.1 m ± 0.5 m high",
        "--expect",
        "to the east (092° ± 8°), 0.21 ± 0.04 m/s",
        "--expect",
        "Intensity over 20 s: now 2.1 times what it was",
        "--eval",
        "document.querySelectorAll('.mark .front').length",
    ]);
    let said = Said::of(&browser.output().unwrap());
    drop(ground);
    if said.code == 77 {
        println!("skipped: no browser (set EMBERFIX_BROWSER)");
        return;
    }
    let seen = said.json();
    assert_eq!(seen["ok"], true, "{seen:#}");
    assert_eq!(seen["foreign_requests"], serde_json::json!([]), "{seen:#}");
}
