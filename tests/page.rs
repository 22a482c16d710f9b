//! A real browser in front of the ground station's page: the real `emberfix ground`, alarms over HTTP or
//! of the real service in flight, Chromium. Exit code 77 of the client means that there is no browser here.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/camera.rs"]
#[expect(dead_code, reason = "it films to the end")]
mod camera;
#[path = "support/clients.rs"]
#[expect(dead_code, reason = "no client states facts here")]
mod clients;
#[path = "support/live.rs"]
mod live;
#[path = "support/pictures.rs"]
#[expect(dead_code, reason = "no lens is covered here")]
mod pictures;
#[path = "support/station.rs"]
#[expect(dead_code, reason = "only the browser acts here")]
mod station;
#[expect(dead_code, reason = "what clients say is read as it comes")]
mod support;

use clients::{Clients, Running};
use live::Service;
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use station::{Station, eventually, fire};
use std::process::Command;
use std::time::{SystemTime, UNIX_EPOCH};
use support::{PLAIN_MISSION, Said, Scratch, root};

/// The browser, ready to be given arguments; with axe-core where Node brought it.
fn browser(clients: &Clients, station: &Station) -> Command {
    let mut browser = clients.client("browser_check.py");
    browser.args([&station.url, "--seconds", "20"]);
    let axe = root().join(".x/node/node_modules/axe-core/axe.min.js");
    if axe.is_file() {
        browser.arg("--axe").arg(axe);
    } else {
        println!("without axe-core (Node 20 or newer, then ./x setup)");
    }
    browser
}

/// What the browser saw; `None` where there is none.
fn seen(said: &Said) -> Option<Value> {
    if said.code == 77 {
        println!("skipped: no browser (set EMBERFIX_BROWSER)");
        return None;
    }
    let seen: Value = serde_json::from_str(&said.out).unwrap();
    assert_eq!(seen["ok"], true, "{seen:#}");
    assert_eq!(seen["foreign_requests"], json!([]), "{seen:#}");
    Some(seen)
}

/// When a step was done, seconds of Unix time.
fn at(seen: &Value, step: &str) -> f64 {
    let steps = seen["steps"].as_array().unwrap();
    let step = steps.iter().find(|s| s["step"] == step).unwrap();
    step["unix_s"].as_f64().unwrap()
}

fn unix_s() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap()
        .as_secs_f64()
}

#[test]
fn an_alarm_appears_within_a_second_and_is_acknowledged_and_taken_back() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let station = Station::start("");
    let mut browser = browser(&clients, &station);
    for step in [
        "wait:Live",
        "ready:",
        "wait:uav-1-7",
        "key:j",
        "wait:31.409422, 119.112017",
        "wait:large: 6.2 m ± 0.6 m wide, 2.1 m ± 0.5 m high",
        "wait:to the east (092° ± 8°), 0.21 ± 0.04 m/s",
        "wait:Intensity over 20 s: now 2.1 times what it was",
        "wait:50R QV 00780 76906",
        "key:a",
        "fill:#name=Ana",
        "click:#name-dialog button[value=ok]",
        "wait:Acknowledged by Ana",
        "key:d",
        "wait:Dismissed by Ana",
        "key:u",
        "wait:Acknowledged by Ana",
        "gone:Dismissed by Ana",
    ] {
        browser.args(["--do", step]);
    }
    browser.args(["--eval", "document.querySelectorAll('.mark .front').length"]);
    let (mut browser, _) = Running::start(browser, "ready {");
    let told_s = unix_s();
    station.tell(&fire());
    let kept_s = unix_s();
    let Some(seen) = seen(&browser.wait()) else {
        return;
    };

    let late_s = at(&seen, "wait:uav-1-7") - kept_s;
    println!(
        "on the page {late_s:.2} s after it was on disk, {:.2} s after it was sent",
        late_s + kept_s - told_s
    );
    assert!(late_s < 1.0, "{late_s} s");
    let operator = |incident: &Value| incident["properties"]["operator"].clone();
    let incident = station.get("/incidents/uav-1-7");
    assert_eq!(operator(&incident)["state"], "acknowledged", "{incident:#}");
    assert_eq!(operator(&incident)["by"], "Ana");
    // What the aircraft is told when it asks.
    let actions = station.get("/actions?uav=uav-1&after=0");
    assert_eq!(actions["actions"][0]["kind"], "acknowledge", "{actions:#}");
    assert_eq!(
        seen["values"].as_object().unwrap().values().next(),
        Some(&json!(1)),
        "the front is drawn"
    );
}

#[test]
fn where_a_token_is_asked_for_the_page_asks_and_shows_what_the_token_allows() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let access = |name: &str, role: &str| {
        let digest = Sha256::digest(format!("token of {name}"));
        format!("[[access]]\nname = \"{name}\"\nrole = \"{role}\"\ntoken_sha256 = \"{digest:x}\"\n")
    };
    let accesses = [
        ("uav-1", "aircraft"),
        ("wall", "screen"),
        ("duty", "operator"),
    ];
    let station = Station::start(&accesses.map(|(name, role)| access(name, role)).concat());
    let mut told = ureq::post(format!("{}/alarms", station.url));
    told = told.header("authorization", "Bearer token of uav-1");
    told.send_json(fire()).unwrap();

    // Nobody yet: the page asks, and says so when the token is wrong.
    let mut browser = browser(&clients, &station);
    browser.args(["--scheme", "dark", "--phone", "--window", "390x844"]);
    for step in [
        "wait:Access token of this ground station",
        "fill:#token=guessed",
        "click:#enter",
        "wait:The ground station does not know this token.",
        "gone:uav-1-7",
    ] {
        browser.args(["--do", step]);
    }
    if seen(&Said::of(&browser.output().unwrap())).is_none() {
        return;
    }

    // A screen looks; there is nothing to act with, and the keys do nothing.
    let looking = [
        "key:j",
        "wait:31.409422, 119.112017",
        "key:a",
        "wait:This sign-in may look, not act.",
    ];
    let deeds = "document.querySelectorAll('.deeds, #me:not([hidden])').length";
    let seen = signed_in(&clients, &station, "wall", &looking, deeds);
    assert_eq!(seen, json!(0));

    // An operator acts; the token is where no script and no address shows it.
    let acting = [
        "eval:localStorage.setItem('operator', 'Ana')",
        "key:j",
        "key:a",
        "wait:Acknowledged by Ana (duty)",
    ];
    let hidden = "JSON.stringify([document.cookie, location.search, sessionStorage.length, localStorage.getItem('token')])";
    let seen = signed_in(&clients, &station, "duty", &acting, hidden);
    assert_eq!(seen, json!("[\"\",\"\",0,null]"));
}

/// Signs in, takes some steps, and gives the value of an expression.
fn signed_in(
    clients: &Clients,
    station: &Station,
    who: &str,
    steps: &[&str],
    value: &str,
) -> Value {
    let mut browser = browser(clients, station);
    let token = format!("fill:#token=token of {who}");
    let sign_in = [
        "wait:Access token",
        &token,
        "click:#enter",
        "wait:Live",
        "wait:uav-1-7",
    ];
    for step in sign_in.iter().chain(steps) {
        browser.args(["--do", step]);
    }
    browser.args(["--eval", value]);
    let seen = seen(&Said::of(&browser.output().unwrap())).unwrap();
    seen["values"][value].clone()
}

#[test]
fn two_aircrafts_fires_are_put_together_and_taken_apart_by_hand() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let station = Station::start("");
    station.tell(&fire());
    // 60 m further east: nobody takes it for the same fire.
    let mut other = fire();
    other["properties"]["id"] = "uav-2-1".into();
    other["properties"]["uav"] = "uav-2".into();
    other["geometry"]["coordinates"][0] = 119.11265.into();
    station.tell(&other);
    let mut browser = browser(&clients, &station);
    for step in [
        "eval:localStorage.setItem('operator', 'Ana')",
        "wait:uav-2-1",
        "click:[data-choose='uav-1-7']",
        "key:m",
        "wait:Which incident is the same fire as uav-1-7?",
        "click:[data-choose='uav-2-1']",
        "wait:uav-1-7 and uav-2-1 are one fire",
        "wait:Put together from",
        "click:[data-with='uav-2-1']",
        "wait:uav-2-1 is a fire of its own",
        "gone:Put together from",
    ] {
        browser.args(["--do", step]);
    }
    browser.args(["--scheme", "dark"]);
    if seen(&Said::of(&browser.output().unwrap())).is_none() {
        return;
    }
    let apart = |all: &Value| all["features"].as_array().unwrap().len() == 2;
    let all = eventually(|| station.get("/incidents.geojson"), apart);
    assert!(apart(&all), "{all:#}");
}

#[test]
fn a_lost_line_is_shown_with_the_age_of_what_is_seen() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let station = Station::start("");
    station.tell(&fire());
    let mut browser = browser(&clients, &station);
    for step in [
        "wait:uav-1-7",
        "ready:",
        "wait:No connection to the ground station. What you see is as of",
        "wait:uav-1-7",
    ] {
        browser.args(["--do", step]);
    }
    browser.args(["--phone", "--window", "390x844"]);
    let (mut browser, _) = Running::start(browser, "ready {");
    station.kill();
    let Some(seen) = seen(&browser.wait()) else {
        return;
    };
    assert!(
        seen["title"].as_str().unwrap().contains("No connection"),
        "{seen:#}"
    );
}

/// Resolves to the width of the fire's picture, pixels, once the page shows it.
const PICTURE: &str = "new Promise(done => { const look = setInterval(() => { \
    const image = document.querySelector('.chip img'); \
    if (image?.complete && image.naturalWidth > 0) { clearInterval(look); done(image.naturalWidth); } }, 50); })";

/// Camera and autopilot, the real service, the real ground station, a person at the page: what she does is
/// on the aircraft's disk while it flies, and she sees what the aircraft saw.
#[test]
fn what_an_operator_does_on_the_page_reaches_the_aircraft_in_flight_and_she_sees_its_picture() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let station = Station::start("");
    let scratch = Scratch::new();
    scratch.write(
        "mission.toml",
        format!("{PLAIN_MISSION}[ground]\nurl = \"{}\"\n", station.url),
    );
    let recording = scratch.path("flight.mcap");
    let service = Service::start(&scratch, &["--record", recording.to_str().unwrap()]);
    let mut pilot = clients.client("mav_autopilot.py");
    pilot.args([
        "--seconds",
        "120",
        "--port",
        &service.mavlink_port.to_string(),
    ]);
    let (_pilot, _) = Running::start(pilot, "ready ");
    let _camera = service.film();
    let mut browser = browser(&clients, &station);
    let picture = format!("eval:{PICTURE}");
    for step in [
        "wait:uav-1-1",
        "key:j",
        "key:a",
        "fill:#name=Ana",
        "click:#name-dialog button[value=ok]",
        "wait:Acknowledged by Ana",
        &picture,
    ] {
        browser.args(["--do", step]);
    }
    let seen = seen(&Said::of(&browser.output().unwrap()));
    let known = |health: &Value| health["wire"]["outboxes"][0]["actions_known"].as_u64() >= Some(1);
    let health = match seen.is_some() {
        true => eventually(|| station.get("/health"), known),
        false => return,
    };
    let log = service.stop().err;
    assert!(known(&health), "{health:#}");
    assert!(
        log.contains("an operator acted") && log.contains("Acknowledge"),
        "{log}"
    );
    let recorded = std::fs::read(&recording).unwrap();
    let topic = b"/operator/action";
    assert!(
        recorded.windows(topic.len()).any(|part| part == topic),
        "it is recorded"
    );

    let width = seen.unwrap()["steps"].as_array().unwrap().last().unwrap()["value"].as_u64();
    let url = format!("{}/incidents/uav-1-1/chip.jpg", station.url);
    let jpeg = ureq::get(url)
        .call()
        .unwrap()
        .body_mut()
        .read_to_vec()
        .unwrap();
    println!("a picture of {} bytes, {width:?} pixels wide", jpeg.len());
    assert!(jpeg.len() <= 4_096);
    let picture = image::load_from_memory(&jpeg).unwrap();
    assert_eq!(
        Some(u64::from(picture.width())),
        width,
        "what the page shows"
    );
}
