//! The doctor as a crew runs it: against nothing, and against a mission that is wrong. It always ends,
//! always says what to do, and its exit code says how it went.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[expect(
    dead_code,
    reason = "the doctor of nothing never ends with exit code 0"
)]
mod support;

use serde_json::Value;
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
