//! The real ground station, and an aircraft's alarm for it.

use crate::clients::Running;
use crate::support::{Scratch, emberfix};
use emberfix::alarm::Alarm;
use emberfix::deliver::http::HttpLink;
use serde_json::Value;
use std::time::{Duration, Instant};

/// A running ground station with a data directory of its own.
pub struct Station {
    program: Running,
    /// Where it is reached: `http://127.0.0.1:PORT`.
    pub url: String,
    _scratch: Scratch,
}

impl Station {
    /// Starts it; `more` is added to its configuration.
    pub fn start(more: &str) -> Self {
        Self::start_in(Scratch::new(), more)
    }

    /// The same, with files of its configuration in `scratch`.
    pub fn start_in(scratch: Scratch, more: &str) -> Self {
        let text = format!("listen = \"127.0.0.1:0\"\ndata_dir = \"data\"\n{more}");
        let config = scratch.write("ground.toml", text);
        let mut command = emberfix();
        command.arg("ground").arg(&config);
        let (program, line) = Running::start(command, "http://");
        let url = line
            .split_whitespace()
            .find(|word| word.starts_with("http://"));
        Self {
            program,
            url: url.unwrap().to_owned(),
            _scratch: scratch,
        }
    }

    /// An aircraft tells an alarm; when this returns, it is on the ground's disk.
    pub fn tell(&self, alarm: &Value) {
        let alarm = Alarm::from_geojson(alarm.to_string().as_bytes()).unwrap();
        HttpLink::new(&self.url)
            .unwrap()
            .send_alarm(&alarm)
            .unwrap();
    }

    /// An operator does something.
    pub fn act(&self, incident: &str, kind: &str) {
        self.order(incident, &serde_json::json!({ "kind": kind, "by": "Ana" }));
    }

    /// The same, in full.
    pub fn order(&self, incident: &str, order: &Value) {
        let url = format!("{}/incidents/{incident}/actions", self.url);
        ureq::post(&url).send_json(order).unwrap();
    }

    /// A JSON answer.
    pub fn get(&self, path: &str) -> Value {
        let mut answer = ureq::get(format!("{}{path}", self.url)).call().unwrap();
        answer.body_mut().read_json().unwrap()
    }

    /// Stops it at once.
    pub fn kill(self) {
        drop(self.program);
    }
}

/// Asks again until it is so; the last answer. Ten seconds, because the computer has other things to do.
pub fn eventually(ask: impl Fn() -> Value, holds: impl Fn(&Value) -> bool) -> Value {
    let begun = Instant::now();
    loop {
        let answer = ask();
        if holds(&answer) || begun.elapsed() > Duration::from_secs(10) {
            return answer;
        }
        std::thread::sleep(Duration::from_millis(100));
    }
}

/// A fire at P3's place, as an aircraft tells it.
pub fn fire() -> Value {
    serde_json::from_str(FIRE).unwrap()
}

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
