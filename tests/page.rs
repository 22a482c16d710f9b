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
        "state": "confirmed", "confidence": 0.95,
        "first_seen_at": "2026-03-01T04:00:10.000000000Z",
        "captured_at": "2026-03-01T04:00:14.000000000Z",
        "altitude_msl_m": 8.7067, "height_above_ground_m": 0.1, "ce90_m": 3.2, "le90_m": 4.1,
        "covariance_enu_m2": [2.25, 0, 0, 0, 2.25, 0, 0, 0, 6.25], "methods": ["stereo"],
        "sightings": 9, "range_m": 21.5, "size_m": null, "trend": null, "degraded": []}}"#;

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
