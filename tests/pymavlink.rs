//! The real service between an autopilot and a ground station that are not ours: pymavlink plays both
//! over UDP, and a camera that writes MCAP into a socket feeds it.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/camera.rs"]
mod camera;
#[path = "support/clients.rs"]
#[expect(dead_code, reason = "nothing runs to its end before these tests begin")]
mod clients;
#[path = "support/live.rs"]
mod live;
#[path = "support/pictures.rs"]
#[expect(dead_code, reason = "no lens is covered here")]
mod pictures;
mod support;

use clients::{Clients, Running, facts};
use live::Service;
use serde_json::Value;
use std::net::UdpSocket;
use std::time::Duration;
use support::{PLAIN_MISSION, Scratch};

/// As the vehicle's companion: the vehicle's system, component 191.
const COMPANION: &str = "1/191";

/// An autopilot, and a ground station behind it.
struct Others {
    autopilot: Running,
    ground: Running,
}

impl Others {
    fn start(clients: &Clients, service: &Service, autopilot: &[&str], ground: &[&str]) -> Self {
        let mut station = clients.client("mav_ground.py");
        station
            .args(["--port", "0", "--seconds", "120", "--ack-as", "254/191"])
            .args(ground);
        let (ground, ready) = Running::start(station, "ready ");
        let mut pilot = clients.client("mav_autopilot.py");
        pilot.args([
            "--seconds",
            "120",
            "--port",
            &service.mavlink_port.to_string(),
        ]);
        pilot
            .args(["--ground-port", &facts(&ready)["port"].to_string()])
            .args(autopilot);
        let (autopilot, _) = Running::start(pilot, "ready ");
        Self { autopilot, ground }
    }

    /// What the autopilot and the ground station have seen.
    fn stop(self) -> (Value, Value) {
        (self.autopilot.stop().json(), self.ground.stop().json())
    }
}

fn wait_s(seconds: f64) {
    std::thread::sleep(Duration::from_secs_f64(seconds));
}

fn list<'a>(summary: &'a Value, key: &str) -> &'a [Value] {
    summary[key].as_array().unwrap()
}

/// Nothing that a listener could take for an alarm.
fn assert_silent(ground: &Value) {
    for key in ["statustexts", "geo_statuses", "command_ints"] {
        assert!(list(ground, key).is_empty(), "{key}: {}", ground[key]);
    }
}

#[test]
fn it_announces_itself_only_while_it_works_and_brings_an_alarm_to_both_kinds_of_ground_station() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let service = Service::start(&scratch, &[]);
    // Our agent stays silent at first: the alarm has to be said again.
    let others = Others::start(&clients, &service, &[], &["--ignore-first", "2"]);
    let blind_s = 5.0;
    wait_s(blind_s);
    let camera = service.film();
    wait_s(12.0);
    camera.stop();
    wait_s(6.0);
    let (autopilot, ground) = others.stop();
    service.stop();

    // Whom it is, and when.
    let heartbeat = &autopilot["heartbeats"][COMPANION];
    let number = |key: &str| heartbeat[key].as_f64().unwrap();
    assert_eq!(
        heartbeat["type"], 18,
        "an onboard controller: {}",
        autopilot["heartbeats"]
    );
    assert_eq!(heartbeat["autopilot"], 8, "no autopilot");
    assert!(
        number("first_s") > blind_s - 1.0,
        "without a camera it is not healthy: {heartbeat}"
    );
    let span_s = number("last_s") - number("first_s");
    // Filmed for 12 s; it takes 3 s to notice that nothing comes, and up to 1.5 s to say so.
    assert!((8.0..17.5).contains(&span_s), "{heartbeat}");
    // 1 Hz, on a computer that has other things to do.
    assert!((number("count") - 1.0 - span_s).abs() < 2.0, "{heartbeat}");
    assert!(number("longest_gap_s") < 2.0, "{heartbeat}");
    assert_eq!(
        autopilot["heartbeats"].as_object().unwrap().len(),
        1,
        "it speaks as nobody else"
    );

    // What it asks for.
    let asked: Vec<i64> = list(&autopilot, "message_intervals")
        .iter()
        .map(|i| i["id"].as_i64().unwrap())
        .collect();
    for id in [31, 33, 24, 2, 230] {
        assert!(
            asked.contains(&id),
            "message {id} was not asked for: {asked:?}"
        );
    }
    let requests = autopilot["timesync"]["requests_received"].as_u64().unwrap();
    assert!((100..260).contains(&requests), "10 Hz for 23 s: {requests}");

    // What a stock ground station sees.
    let texts = list(&ground, "statustexts");
    assert!(!texts.is_empty(), "{ground}");
    for text in texts {
        let said = text["text"].as_str().unwrap();
        assert!((1..=50).contains(&said.len()), "{said:?}");
        assert_eq!(text["from"], COMPANION);
    }
    let places = list(&ground, "geo_statuses");
    assert!(!places.is_empty());
    // It hovers 12 m above P3's fire, looks north and 30 degrees down at something 16.5 m away.
    let (lat, lon) = (
        places[0]["lat"].as_f64().unwrap() / 1e7,
        places[0]["lon"].as_f64().unwrap() / 1e7,
    );
    let north_m = (lat - 31.409422) * 110_870.0;
    let east_m = (lon - 119.112017) * 95_080.0;
    assert!(
        (10.0..16.0).contains(&north_m) && east_m.abs() < 1.5,
        "{north_m} {east_m}"
    );

    // What our agent sees: unanswered, it comes again; answered, it stops.
    assert_eq!(ground["ignored"], 2);
    let commands = list(&ground, "command_ints");
    let acknowledged = list(&ground, "acknowledged");
    assert!(!acknowledged.is_empty(), "{ground}");
    assert!(
        commands
            .iter()
            .all(|c| c["command"] == 31005 && c["target_system"] == 254)
    );
    assert_eq!(
        commands.len(),
        2 + acknowledged.len(),
        "each is said until it is acknowledged"
    );
    // What comes again after an acknowledgement is news: a revision, once in a few seconds at most.
    assert!(acknowledged.len() <= 6, "{acknowledged:?}");
}

#[test]
fn a_megabyte_of_noise_on_the_port_does_not_keep_an_alarm_back() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let service = Service::start(&scratch, &[]);
    let others = Others::start(&clients, &service, &["--garbage"], &[]);
    let _camera = service.film();
    let noise = UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut state = 7_u64;
    for _ in 0..1_000 {
        let bytes: Vec<u8> = std::iter::repeat_with(|| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        })
        .take(1_000)
        .collect();
        noise
            .send_to(&bytes, ("127.0.0.1", service.mavlink_port))
            .unwrap();
        wait_s(0.005);
    }
    wait_s(5.0);
    let (autopilot, ground) = others.stop();
    service.stop();
    assert!(autopilot["sent"]["garbage"].as_u64().unwrap() > 50);
    assert!(!list(&ground, "acknowledged").is_empty(), "{ground}");
    assert!(!list(&ground, "statustexts").is_empty());
}

/// A flight with a working camera, and something wrong with the autopilot: what the ground station
/// saw, what the autopilot saw, and what the service logged.
fn troubled(mission: &str, fault: &[&str]) -> Option<(Value, Value, String)> {
    let clients = Clients::find()?;
    let scratch = Scratch::new();
    scratch.write("mission.toml", mission);
    let service = Service::start(&scratch, &[]);
    let others = Others::start(&clients, &service, fault, &[]);
    wait_s(3.0);
    let camera = service.film();
    wait_s(7.0);
    camera.stop();
    let (autopilot, ground) = others.stop();
    Some((autopilot, ground, service.stop().err))
}

#[test]
fn without_a_gnss_fix_there_is_no_position_and_no_heartbeat() {
    let Some((autopilot, ground, log)) = troubled(PLAIN_MISSION, &["--no-gps-fix"]) else {
        return;
    };
    assert_silent(&ground);
    assert_eq!(autopilot["heartbeats"].get(COMPANION), None);
    assert!(
        log.contains("\"null_position\""),
        "zero positions are counted by name: {log}"
    );
}

#[test]
fn with_an_attitude_that_fell_silent_there_is_no_position() {
    let Some((autopilot, ground, log)) = troubled(PLAIN_MISSION, &["--stale-attitude", "1.5"])
    else {
        return;
    };
    assert_silent(&ground);
    assert_eq!(autopilot["heartbeats"].get(COMPANION), None);
    assert!(
        log.contains("\"pose_stale\""),
        "stale poses are counted by name: {log}"
    );
}

#[test]
fn with_an_attitude_that_is_no_number_there_is_no_position() {
    let Some((_, ground, log)) = troubled(PLAIN_MISSION, &["--nan-attitude"]) else {
        return;
    };
    assert_silent(&ground);
    assert!(
        log.contains("mavlink_refused") && log.contains("attitude"),
        "{log}"
    );
}

#[test]
fn another_vehicle_than_the_missions_is_counted_and_never_spoken_to() {
    let mission = PLAIN_MISSION.replacen("system_id = 1", "system_id = 7", 1);
    let Some((autopilot, ground, log)) = troubled(&mission, &[]) else {
        return;
    };
    assert_silent(&ground);
    assert_eq!(autopilot["counts"], serde_json::json!({}), "not one frame");
    assert!(log.contains("\"other_sender\""), "{log}");
}
