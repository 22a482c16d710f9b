//! The doctor as a crew runs it: against nothing, and against a mission that is wrong. It always ends,
//! always says what to do, and its exit code says how it went.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/clients.rs"]
#[expect(dead_code, reason = "no client is needed here")]
mod clients;
#[path = "support/station.rs"]
#[expect(dead_code, reason = "the station is only asked")]
mod station;
#[expect(
    dead_code,
    reason = "the doctor of nothing never ends with exit code 0"
)]
mod support;

use clients::Running;
use serde_json::Value;
use sha2::{Digest as _, Sha256};
use station::Station;
use std::time::{Duration, Instant};
use support::{PLAIN_MISSION, Said, Scratch, emberfix};

fn doctor(scratch: &Scratch, more: &[&str]) -> Said {
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = free.local_addr().unwrap().port();
    drop(free);
    let mut command = emberfix();
    command
        .arg("doctor")
        .arg(scratch.path("mission.toml"))
        .args(["--seconds", "1"])
        .args(["--mavlink", &format!("udpin:127.0.0.1:{port}")])
        .args(["--camera", &format!("tcp-listen:127.0.0.1:{port}")])
        .arg("--state")
        .arg(scratch.path("state"))
        .args(more);
    Said::of(&command.output().unwrap())
}

fn finding<'a>(examination: &'a Value, name: &str) -> &'a Value {
    let sections = examination["sections"].as_array().unwrap();
    let mut findings = sections
        .iter()
        .flat_map(|section| section["findings"].as_array().unwrap());
    findings.find(|finding| finding["name"] == name).unwrap()
}

#[test]
fn with_nothing_there_it_ends_soon_and_every_failure_has_a_remedy() {
    let scratch = Scratch::new();
    let begun = Instant::now();
    let said = doctor(&scratch, &["--json", "--ground", "http://127.0.0.1:9"]);
    // One second of listening; the rest is for a busy machine.
    assert!(begun.elapsed() < Duration::from_secs(30));
    assert_eq!(said.code, 1, "{}", said.err);
    let examination: Value = serde_json::from_str(&said.out).unwrap();
    assert_eq!(examination["verdict"], "fail");
    for name in [
        "model",
        "pairs",
        "heartbeat",
        "ground station",
        "test alarm",
        "ground agent",
    ] {
        let finding = finding(&examination, name);
        assert_eq!(finding["verdict"], "fail", "{finding}");
        assert!(!finding["remedy"].as_str().unwrap().is_empty(), "{finding}");
    }
    assert_eq!(finding(&examination, "disk writes")["verdict"], "pass");
    let figures = examination["figures"].as_array().unwrap();
    assert_eq!(figures[0]["name"], "doctor.fails");
    assert_eq!(figures[0]["holds"], false);
}

#[test]
fn a_mission_that_is_wrong_is_refused_with_every_problem_in_the_table() {
    let scratch = Scratch::new();
    let wrong = PLAIN_MISSION
        .replace("[datum]", "[dathum]")
        .replace("rig = ", "rigg = ");
    assert_ne!(wrong, PLAIN_MISSION);
    scratch.write("mission.toml", wrong);
    let said = doctor(&scratch, &[]);
    assert_eq!(said.code, 2, "{}", said.err);
    for word in ["FAIL", "dathum", "rigg", "->", "NOT READY"] {
        assert!(said.out.contains(word), "{word:?} is not in {}", said.out);
    }
}

#[test]
fn a_ground_station_lets_in_who_has_its_token_and_tells_others_what_to_do() {
    let digest: String = Sha256::digest("good")
        .iter()
        .map(|b| format!("{b:02x}"))
        .collect();
    let station = Station::start(&format!(
        "[[access]]\nname = \"uav-1\"\nrole = \"aircraft\"\ntoken_sha256 = \"{digest}\"\n"
    ));
    let scratch = Scratch::new();
    scratch.write(
        "mission.toml",
        format!(
            "{PLAIN_MISSION}[ground]\nurl = \"{}\"\ntoken_file = \"token\"\n",
            station.url
        ),
    );
    let examined = |token: &str| -> Value {
        scratch.write("token", token);
        serde_json::from_str(&doctor(&scratch, &["--json"]).out).unwrap()
    };
    let good = examined("good\n");
    for name in ["ground station", "test alarm", "datagrams"] {
        assert_eq!(finding(&good, name)["verdict"], "pass", "{good:#}");
    }
    let wrong = examined("wrong\n");
    let told = finding(&wrong, "ground station");
    assert_eq!(told["verdict"], "fail", "{told}");
    assert!(
        told["value"]
            .as_str()
            .unwrap()
            .contains("does not let us in (401"),
        "{told}"
    );
    assert!(
        told["remedy"]
            .as_str()
            .unwrap()
            .contains("ground.token_file"),
        "{told}"
    );

    // Where anyone could read it, the mission is refused.
    scratch.write(
        "mission.toml",
        format!(
            "{PLAIN_MISSION}[ground]\nurl = \"http://10.8.0.1:8470\"\ntoken_file = \"token\"\n"
        ),
    );
    let said = doctor(&scratch, &[]);
    assert_eq!(said.code, 2, "{}", said.err);
    let words = said.out.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words.contains("ask by https://"), "{words}");
}

/// Nothing but a key says who sends a datagram from elsewhere; whoever forgot it must not wonder for days
/// why alarms are slow on a bad link.
#[test]
fn a_ground_beyond_this_computer_without_any_aircrafts_key_says_that_it_takes_no_datagrams() {
    let scratch = Scratch::new();
    let paper = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    scratch.write("ground.crt", paper.cert.pem());
    scratch.write("ground.key", paper.signing_key.serialize_pem());
    let config = format!(
        "listen = \"0.0.0.0:0\"\ndata_dir = \"data\"\n\
         [tls]\ncertificate = \"ground.crt\"\nkey = \"ground.key\"\n\
         [[access]]\nname = \"uav-1\"\nrole = \"aircraft\"\ntoken_sha256 = \"{}\"\n",
        "0".repeat(64)
    );
    let mut command = emberfix();
    command
        .arg("ground")
        .arg(scratch.write("ground.toml", config));
    let (_ground, line) = Running::start(command, "no datagrams");
    assert!(
        line.contains("public_key") && line.contains("emberfix keys"),
        "{line}"
    );
}
