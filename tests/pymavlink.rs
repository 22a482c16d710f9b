//! The real service between an autopilot and a ground station that are not ours: pymavlink plays both
//! over UDP, MAVProxy the ground station too, and a camera that writes MCAP into a socket feeds it.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/camera.rs"]
mod camera;
#[path = "support/clients.rs"]
#[expect(dead_code, reason = "what runs to its end is run as any program")]
mod clients;
#[path = "support/live.rs"]
mod live;
#[path = "support/pictures.rs"]
#[expect(dead_code, reason = "no lens is covered here")]
mod pictures;
#[path = "support/station.rs"]
#[expect(dead_code, reason = "only what a flight needs of the station")]
mod station;
mod support;

use clients::{Clients, Running, facts};
use live::{Service, free_udp_port};
use serde_json::Value;
use station::Station;
use std::collections::BTreeSet;
use std::net::UdpSocket;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;
use support::{PLAIN_MISSION, Said, Scratch};

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

/// A mission whose MAVLink is signed, and the file of its secret.
fn signed_mission(scratch: &Scratch) -> String {
    let secret = "5a17".repeat(16);
    let path = scratch.write("signing.key", secret);
    let mission = PLAIN_MISSION.replacen("[camera]", "signing_key = \"signing.key\"\n[camera]", 1);
    assert_ne!(mission, PLAIN_MISSION);
    scratch.write("mission.toml", mission);
    path.to_str().unwrap().to_owned()
}

/// A number in what the service logged last about frames that it refused.
fn refused(log: &str, name: &str) -> u64 {
    let last = log.lines().rfind(|line| line.contains("frame was refused"));
    assert!(last.is_some(), "nothing was refused: {log}");
    let last = last.unwrap();
    let at = last.find(&format!(" {name}: ")).unwrap() + name.len() + 3;
    let digits = last[at..].chars().take_while(char::is_ascii_digit);
    digits.collect::<String>().parse().unwrap()
}

/// Which fires and revisions were told where, each time that they were; how old the news was then aside.
fn said(ground: &Value) -> Vec<String> {
    let said = |command: &Value| {
        let of = ["param1", "param2", "x", "y", "z"].map(|key| command[key].to_string());
        of.join(" ")
    };
    list(ground, "command_ints").iter().map(said).collect()
}

#[test]
fn signed_both_ways_alarms_pass_and_what_is_unsigned_forged_or_replayed_is_counted() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let secret = signed_mission(&scratch);
    let service = Service::start(&scratch, &[]);
    let sign = ["--sign", secret.as_str()];
    let others = Others::start(&clients, &service, &sign, &sign);
    wait_s(2.0);
    let camera = service.film();
    let mut forger = clients.client("mav_forger.py");
    forger
        .args(["--port", &service.mavlink_port.to_string()])
        .args(sign);
    assert_eq!(Said::of(&forger.output().unwrap()).json()["rounds"], 40);
    wait_s(6.0);
    camera.stop();
    let (autopilot, ground) = others.stop();
    let log = service.stop().err;

    // pymavlink checks every frame of ours, and takes nothing that is not signed.
    let signatures = &autopilot["signatures"];
    assert!(signatures["good"].as_u64().unwrap() > 50, "{signatures}");
    assert_eq!(signatures["bad"], 0, "{signatures}");
    assert_eq!(signatures["unsigned"], 0, "{signatures}");
    for key in ["statustexts", "geo_statuses", "command_ints"] {
        assert!(!list(&ground, key).is_empty(), "{key}: {ground}");
        assert!(
            list(&ground, key).iter().all(|m| m["signed"] == true),
            "{key}"
        );
    }
    // Its signed acknowledgement counts: nothing is said twice.
    let said = said(&ground);
    assert_eq!(
        said.iter().collect::<BTreeSet<_>>().len(),
        said.len(),
        "{said:#?}"
    );
    for name in ["unsigned", "wrong_signature", "replayed"] {
        assert!(refused(&log, name) >= 15, "{name}: {log}");
    }
    assert!(
        refused(&log, "allowed_unsigned") >= 15,
        "heartbeats need none: {log}"
    );
    // Nobody turned it on its back.
    let latitude = list(&ground, "geo_statuses")[0]["lat"].as_f64().unwrap() / 1e7;
    let north_m = (latitude - 31.409422) * 110_870.0;
    assert!((10.0..16.0).contains(&north_m), "{north_m}");
}

/// A library that takes a program back to 1970, where a computer begins whose clock nobody set.
fn unset_clock(scratch: &Scratch) -> PathBuf {
    let source = scratch.write(
        "clock.c",
        "#define _GNU_SOURCE\n#include <time.h>\n#include <unistd.h>\n#include <sys/syscall.h>\n\
         int clock_gettime(clockid_t id, struct timespec *at) {\n\
           return syscall(SYS_clock_gettime, id == CLOCK_REALTIME ? CLOCK_MONOTONIC : id, at);\n}\n",
    );
    let library = scratch.path("clock.so");
    let mut compiler = Command::new("cc");
    compiler
        .args(["-shared", "-fPIC", "-o"])
        .arg(&library)
        .arg(source);
    assert!(compiler.status().unwrap().success());
    library
}

#[test]
fn signatures_go_on_after_a_restart_with_an_unset_clock_and_recordings_do_not_pass() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let secret = signed_mission(&scratch);
    let sign = ["--sign", secret.as_str()];
    // Before: our agent does not sign, and is not believed.
    let service = Service::start(&scratch, &[]);
    let others = Others::start(&clients, &service, &sign, &[]);
    wait_s(2.0);
    let camera = service.film();
    wait_s(6.0);
    camera.stop();
    let (before, ground) = others.stop();
    service.stop();
    let said = said(&ground);
    let different: BTreeSet<_> = said.iter().collect();
    assert!(
        different.len() < said.len(),
        "an unsigned acknowledgement counted: {said:#?}"
    );
    let newest = |summary: &Value| summary["signatures"]["newest"]["0/1/191"].as_u64().unwrap();
    let (told, recorded) = (newest(&before), before["last_attitude"].as_str().unwrap());

    // After: 1970 by its own clock.
    let clock = unset_clock(&scratch);
    let service = Service::start_with(&scratch, &[], &[("LD_PRELOAD", &clock)]);
    let mut pilot = clients.client("mav_autopilot.py");
    pilot
        .args(sign)
        .args(["--newest-of-companion", &told.to_string()]);
    pilot.args([
        "--seconds",
        "60",
        "--port",
        &service.mavlink_port.to_string(),
    ]);
    let (pilot, _) = Running::start(pilot, "ready ");
    wait_s(1.5);
    let mut thief = clients.client("mav_forger.py");
    thief
        .args([
            "--port",
            &service.mavlink_port.to_string(),
            "--recorded",
            recorded,
        ])
        .args(sign);
    assert!(thief.output().unwrap().status.success());
    wait_s(1.5);
    let after = pilot.stop().json();
    let log = service.stop().err;
    assert!(
        log.contains("1970-01-01T"),
        "the clock was to be unset: {log}"
    );
    let signatures = &after["signatures"];
    assert!(signatures["good"].as_u64().unwrap() > 20, "{signatures}");
    assert_eq!(signatures["bad"], 0, "{signatures}");
    assert!(newest(&after) > told, "{signatures}");
    assert!(
        !list(&after, "message_intervals").is_empty(),
        "it believes the autopilot"
    );
    assert!(refused(&log, "replayed") >= 15, "{log}");
}

#[test]
fn mavproxy_shows_the_alarm_and_the_marker_and_its_operator_acknowledges() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let (vehicle, markers) = (free_udp_port(), free_udp_port());
    let station = Station::start(&format!("[adsb]\nurl = \"udpout:127.0.0.1:{markers}\"\n"));
    let scratch = Scratch::new();
    scratch.write(
        "mission.toml",
        format!("{PLAIN_MISSION}[ground]\nurl = \"{}\"\n", station.url),
    );
    let service = Service::start(&scratch, &[]);
    let mut proxy = clients.client("mavproxy_ground.py");
    for port in [vehicle, markers] {
        proxy.args(["--master", &format!("udpin:127.0.0.1:{port}")]);
    }
    proxy.args(["--module", "adsb", "--seconds", "60"]);
    // As our agent; the action: fire 1, acknowledged, the operator's first.
    proxy.args([
        "--source",
        "254/191",
        "--target-component",
        "191",
        "--after",
        "FIRE 1 ",
    ]);
    proxy.args([
        "--say",
        "long MAV_CMD_USER_2 1 1 1 0",
        "--say",
        "adsb status",
        "--say",
        "status ADSB_VEHICLE",
    ]);
    let expected = [
        r"^(MAV> )*AP: FIRE 1 31\.4\d+,119\.1\d+ ",
        "Got COMMAND_ACK: USER_2: ACCEPTED",
        "total threat count: 1",
        r"ADSB_VEHICLE \{.*callsign : FIRE0001",
    ];
    for text in expected {
        proxy.args(["--expect", text]);
    }
    let (mut proxy, _) = Running::start(proxy, "ready ");
    let mut pilot = clients.client("mav_autopilot.py");
    pilot.args([
        "--seconds",
        "90",
        "--port",
        &service.mavlink_port.to_string(),
    ]);
    pilot.args(["--ground-port", &vehicle.to_string()]);
    let (_pilot, _) = Running::start(pilot, "ready ");
    let _camera = service.film();
    let seen = proxy.wait();
    let log = service.stop().err;
    println!("{}", seen.out);
    assert_eq!(seen.code, 0, "{}{}", seen.out, seen.err);
    assert!(
        log.contains("an operator acted") && log.contains("Acknowledge"),
        "{log}"
    );
}
