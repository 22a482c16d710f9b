//! Programs that are not ours read the ground station's pictures, each in its own standard.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/clients.rs"]
#[expect(dead_code, reason = "these clients end by themselves")]
mod clients;
#[path = "support/station.rs"]
#[expect(dead_code, reason = "the station is only told and asked here")]
mod station;
mod support;

use clients::{Clients, Running, facts};
use serde_json::{Value, json};
use station::{Station, eventually, fire};
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::process::{Command, Stdio};
use support::{Scratch, root};

const ID: &str = "uav-1-7";
const CAP: &str = "[cap]\nsender = \"ground@brigade.example\"\nstatus = \"exercise\"\n";

fn read(clients: &Clients, kind: &str, source: &str) -> Value {
    clients.run("screens_check.py", [kind, source]).json()
}

/// Longitude, latitude and height of the fire.
fn is_the_place(found: &Value) {
    let near = |k: usize, want: f64, off: f64| (found[k].as_f64().unwrap() - want).abs() < off;
    // A tenth of a metre: what six decimals of a degree and one of a metre tell.
    assert!(
        near(0, 119.1120167, 1e-6) && near(1, 31.4094222, 1e-6),
        "{found}"
    );
    assert!(near(2, 11.06, 0.1), "{found}");
}

#[test]
fn geojson_kml_and_metrics_are_read_by_programs_that_know_the_standard() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let station = Station::start("");
    station.tell(&fire());

    let geojson = read(
        &clients,
        "geojson",
        &format!("{}/incidents.geojson", station.url),
    );
    assert_eq!(geojson["content_type"], "application/geo+json");
    is_the_place(&geojson["features"][0]["coordinates"]);

    let url = format!("{}/emberfix.kml", station.url);
    let shown = |kml: &Value| kml["linked"]["placemarks"][0].is_object();
    let kml = eventually(|| read(&clients, "kml", &url), shown);
    assert_eq!(kml["link"]["mode"], "onInterval");
    assert_eq!(kml["content_type"], "application/vnd.google-earth.kml+xml");
    let placemark = &kml["linked"]["placemarks"][0];
    assert_eq!(placemark["name"], "FIRE uav-1-7");
    assert_eq!(placemark["geometries"], json!(["Point", "Polygon"]));
    assert_eq!(
        placemark["shapes"][0][2], 8.71,
        "KML's absolute altitude is above mean sea level"
    );
    is_a_ring_of_90_percent(&placemark["shapes"][1]);

    let metrics = read(&clients, "metrics", &format!("{}/metrics", station.url));
    let samples = metrics["samples"].as_array().unwrap();
    let value = |name: &str| samples.iter().find(|s| s["name"] == name).unwrap()["value"].clone();
    assert_eq!(value("emberfix_incidents_unacknowledged"), 1.0);
    assert_eq!(value("emberfix_alarms_total"), 1.0, "{metrics}");
}

/// 1.5 m to each side is 3.22 m at 90 % (chi-square with two degrees of freedom: 4.605).
fn is_a_ring_of_90_percent(ring: &Value) {
    for corner in ring.as_array().unwrap() {
        let east_m = (corner[0].as_f64().unwrap() - 119.1120167) * 95_081.0;
        let north_m = (corner[1].as_f64().unwrap() - 31.4094222) * 110_870.0;
        // A hundredth for the metres per degree that are worked out by hand here.
        assert!(
            (east_m.hypot(north_m) - 3.219).abs() < 0.03,
            "{east_m} {north_m}"
        );
    }
}

#[test]
fn cap_alerts_updates_and_cancels_in_one_chain() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let station = Station::start(CAP);
    let feed = format!("{}/cap.atom", station.url);
    let issued = |n: usize| {
        let messages = |cap: &Value| cap["messages"].as_array().unwrap().len() >= n;
        eventually(|| read(&clients, "cap", &feed), messages)["messages"][n - 1].clone()
    };
    station.tell(&fire());
    let alert = issued(1);
    for (field, wanted) in [
        ("content_type", "application/cap+xml"),
        ("msgType", "Alert"),
        ("status", "Exercise"),
        ("scope", "Restricted"),
        ("certainty", "Likely"),
        ("urgency", "Immediate"),
        ("incidents", ID),
        // 8.7067 m
        ("altitude_ft", "29"),
        // 500 m and CE90 and half of the width
        ("circle", "31.409422,119.112017 0.506"),
    ] {
        assert_eq!(alert[field], wanted, "{field} of {alert:#}");
    }
    assert_eq!(alert["references"], Value::Null);

    station.act(ID, "confirm");
    let update = issued(2);
    assert_eq!(
        (&update["msgType"], &update["certainty"]),
        (&json!("Update"), &json!("Observed"))
    );
    let name = |message: &Value| {
        let part = |field: &str| message[field].as_str().unwrap().to_owned();
        [part("sender"), part("identifier"), part("sent")].join(",")
    };
    assert_eq!(update["references"], name(&alert));

    station.act(ID, "dismiss");
    let cancel = issued(3);
    assert_eq!(cancel["msgType"], "Cancel");
    assert!(cancel["note"].as_str().unwrap().contains("Ana"), "{cancel}");
    assert_eq!(
        cancel["references"],
        format!("{} {}", name(&alert), name(&update))
    );
}

#[test]
fn cap_takes_back_what_went_into_another_incident() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let station = Station::start(CAP);
    station.tell(&fire());
    let mut other = fire();
    other["properties"]["id"] = "uav-1-8".into();
    // 90 m further east: nobody takes it for the same fire.
    other["geometry"]["coordinates"][0] = 119.113.into();
    station.tell(&other);
    let feed = format!("{}/cap.atom", station.url);
    let of = |n: usize| {
        let many = |cap: &Value| cap["messages"].as_array().unwrap().len() >= n;
        eventually(|| read(&clients, "cap", &feed), many)["messages"].clone()
    };
    let alerts = of(2);
    assert_eq!(
        (&alerts[0]["msgType"], &alerts[1]["msgType"]),
        (&json!("Alert"), &json!("Alert"))
    );
    station.order(
        "uav-1-7",
        &json!({ "kind": "merge", "by": "Ana", "with": "uav-1-8" }),
    );
    let cancel = of(3)[2].clone();
    assert_eq!(cancel["msgType"], "Cancel", "{cancel:#}");
    assert_eq!(cancel["incidents"], "uav-1-8 uav-1-7");
    assert_eq!(
        cancel["note"],
        "The same fire as uav-1-7, under which it goes on."
    );
    assert!(
        cancel["references"]
            .as_str()
            .unwrap()
            .contains(",uav-1-8.1,"),
        "{cancel:#}"
    );
}

#[test]
fn foxglove_shows_the_fire_live() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let port = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port();
    let station = Station::start(&format!("[foxglove]\nlisten = \"127.0.0.1:{port}\"\n"));
    station.tell(&fire());
    let has_fire = |seen: &Value| seen["topics"]["/fire/incidents"]["fixes"][0].is_object();
    let seen = eventually(
        || read(&clients, "foxglove", &format!("ws://127.0.0.1:{port}")),
        has_fire,
    );
    let fix = &seen["topics"]["/fire/incidents"]["fixes"][0];
    is_the_place(&fix["place"]);
    assert_eq!(fix["covariance"][8], 6.25);
    let features = &seen["topics"]["/fire/incidents/geojson"]["geojson"]["features"];
    assert_eq!(features[0]["properties"]["name"], "FIRE uav-1-7");
    assert_eq!(features[1]["geometry"]["type"], "Polygon");
}

fn free_udp_port() -> u16 {
    UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port()
}

#[test]
fn a_marker_reaches_a_ground_station_program_and_ends_where_an_autopilot_answers() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let port = free_udp_port();
    let station = Station::start(&format!("[adsb]\nurl = \"udpout:127.0.0.1:{port}\"\n"));
    station.tell(&fire());
    let mut gcs = clients.client("mav_ground.py");
    gcs.args([
        "--port",
        &port.to_string(),
        "--seconds",
        "20",
        "--until",
        "traffic",
    ]);
    let (mut gcs, _) = Running::start(gcs, "ready ");
    let seen = gcs.wait().json();
    let marker = &seen["traffic"][0];
    assert_eq!(marker["callsign"], "FIRE0007", "{seen}");
    assert_eq!(marker["lat"], 314094222);
    assert_eq!(marker["lon"], 1191120167);
    assert_eq!(marker["altitude"], 8707, "mm above mean sea level");
    assert_eq!(
        marker["from"], "1/191",
        "as the vehicle's own, or programs pass it over"
    );
    let icao = marker["ICAO_address"].as_u64().unwrap();
    assert!(
        (0x4000..0x9f_ffff).contains(&icao),
        "what MAVProxy draws: {icao:x}"
    );

    // A router may lead further than it seems: an autopilot's heartbeat comes back.
    let mut pilot = clients.client("mav_ground.py");
    pilot.args([
        "--port",
        &port.to_string(),
        "--seconds",
        "5",
        "--as-autopilot",
    ]);
    let (mut pilot, _) = Running::start(pilot, "ready ");
    let heard = pilot.wait().json()["traffic"].as_array().unwrap().len();
    assert!(heard <= 3, "it went on for {heard} s");
    let metrics = read(&clients, "metrics", &format!("{}/metrics", station.url));
    let samples = metrics["samples"].as_array().unwrap();
    let stopped = samples
        .iter()
        .find(|s| s["name"] == "emberfix_adsb_autopilots_heard")
        .unwrap();
    assert_eq!(stopped["value"], 1.0);
}

/// The events of a list through both readers; node-cot's answer, where there is Node.
fn readers(clients: &Clients, scratch: &Scratch, events: &[Value]) -> (Value, Option<Value>) {
    let lines: String = events.iter().map(|event| format!("{event}\n")).collect();
    let file = scratch.write("events", &lines);
    let takproto = read(clients, "takproto", file.to_str().unwrap());
    let modules = root().join(".x/node/node_modules");
    if !modules.is_dir() {
        println!("skipped: no node-cot (Node 20 or newer, then ./x setup)");
        return (takproto, None);
    }
    let mut node = Command::new("node")
        .arg(root().join("tests/clients/cot_read.mjs"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    node.stdin
        .take()
        .unwrap()
        .write_all(lines.as_bytes())
        .unwrap();
    let said = node.wait_with_output().unwrap();
    (
        takproto,
        Some(serde_json::from_slice(&said.stdout).unwrap()),
    )
}

/// Until so many events have come: what a listener heard.
fn heard(listener: &mut Running) -> Vec<Value> {
    listener.wait().json()["events"].as_array().unwrap().clone()
}

#[test]
fn tak_sees_the_fire_over_multicast_and_over_tls_and_sees_it_go() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let keys = scratch.path("keys");
    clients
        .run("tak.py", ["certificates".as_ref(), keys.as_os_str()])
        .json();
    let mut relay = clients.client("tak.py");
    relay.args(["relay".as_ref(), keys.as_os_str()]);
    let (_relay, ready) = Running::start(relay, "ready ");
    let server = facts(&ready)["port"].to_string();
    let mut viewer = clients.client("tak.py");
    viewer.args(["pytak".as_ref(), keys.as_os_str()]);
    viewer.args(["--port", &server, "--count", "2"]);
    let (mut viewer, _) = Running::start(viewer, "ready ");
    // A group of our own: others on this network may use TAK's.
    let group = format!("239.2.3.1:{}", free_udp_port());
    let mut mesh = clients.client("tak.py");
    mesh.args(["multicast", &group, "--count", "4"]);
    let (mut mesh, _) = Running::start(mesh, "ready ");

    let station = Station::start(&format!(
        "[[cot]]\nurl = \"udp://{group}\"\ninterface = \"127.0.0.1\"\nprofile = \"semantic\"\n\
         [[cot]]\nurl = \"tls://127.0.0.1:{server}\"\nca = {0:?}\ncertificate = {1:?}\nkey = {2:?}\n",
        keys.join("ca.pem"),
        keys.join("ground.pem"),
        keys.join("ground.key"),
    ));
    station.tell(&fire());
    std::thread::sleep(std::time::Duration::from_secs(2));
    station.act(ID, "dismiss");

    let events = heard(&mut mesh);
    let (takproto, node) = readers(&clients, &scratch, &events);
    let first = &takproto["events"][0];
    assert_eq!(first["uid"], "emberfix.uav-1-7");
    assert_eq!(first["type"], "a-u-X-i-f-h");
    assert_eq!(first["callsign"], "FIRE uav-1-7");
    is_the_place(&json!([first["lon"], first["lat"], first["hae"]]));
    assert_eq!((&first["ce"], &first["le"]), (&json!(3.2), &json!(4.1)));
    assert_eq!(first["stale_s"], 600.0);
    let gone = takproto["events"].as_array().unwrap().last().unwrap();
    assert_eq!(
        (&gone["uid"], &gone["type"]),
        (&first["uid"], &json!("t-x-d-d"))
    );
    if let Some(node) = node {
        let feature = &node["features"][0];
        assert_eq!(feature["id"], "emberfix.uav-1-7");
        is_the_place(&feature["geometry"]["coordinates"]);
        assert_eq!(feature["properties"]["marker-color"], "#FF0000");
        let icon = feature["properties"]["icon"].as_str().unwrap();
        assert!(icon.ends_with("/Google/firedept.png"), "{icon}");
        assert_eq!(
            node["features"].as_array().unwrap().last().unwrap()["deletes"],
            true
        );
    }

    let over_tls = heard(&mut viewer);
    let texts: Vec<&str> = over_tls
        .iter()
        .map(|event| event.as_str().unwrap())
        .collect();
    assert!(
        texts.iter().any(|text| text.contains("type=\"a-u-G\"")),
        "{texts:#?}"
    );
    assert!(
        texts.iter().any(|text| text.contains("type=\"t-x-d-d\"")),
        "{texts:#?}"
    );
}

#[test]
fn a_tak_server_that_is_not_ours_is_refused_and_the_station_goes_on() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let keys = scratch.path("keys");
    clients
        .run("tak.py", ["certificates".as_ref(), keys.as_os_str()])
        .json();
    let mut relay = clients.client("tak.py");
    relay.args([
        "relay".as_ref(),
        keys.as_os_str(),
        "--seconds".as_ref(),
        "4".as_ref(),
    ]);
    let (mut relay, ready) = Running::start(relay, "ready ");
    let server = facts(&ready)["port"].to_string();
    let station = Station::start(&format!(
        "[[cot]]\nurl = \"tls://127.0.0.1:{server}\"\nca = {0:?}\ncertificate = {1:?}\nkey = {2:?}\n",
        keys.join("stranger.pem"),
        keys.join("ground.pem"),
        keys.join("ground.key"),
    ));
    station.tell(&fire());
    assert_eq!(
        relay.wait().json()["clients"],
        json!([]),
        "nothing was told to it"
    );
    let metrics = read(&clients, "metrics", &format!("{}/metrics", station.url));
    let samples = metrics["samples"].as_array().unwrap();
    let failed = samples
        .iter()
        .find(|s| s["name"] == "emberfix_cot_failures_total")
        .unwrap();
    assert!(failed["value"].as_f64().unwrap() >= 1.0, "{failed}");
}

/// Events of a stream up to and with the first of a kind: names and data, and the last id.
fn events(station: &Station, after: Option<&str>, until: &str) -> (Vec<(String, Value)>, String) {
    let address = station.url.strip_prefix("http://").unwrap();
    let mut stream = TcpStream::connect(address).unwrap();
    let resume = after.map_or_else(String::new, |id| format!("last-event-id: {id}\r\n"));
    write!(
        stream,
        "GET /events?show=incidents HTTP/1.1\r\nhost: {address}\r\n{resume}\r\n"
    )
    .unwrap();
    let (mut told, mut id, mut kind) = (Vec::new(), String::new(), String::new());
    for line in BufReader::new(stream).lines().map_while(Result::ok) {
        match line.split_once(": ").or(line.split_once(':')) {
            Some(("event", name)) => kind = name.to_owned(),
            Some(("id", number)) => id = number.to_owned(),
            Some(("data", data)) => told.push((kind.clone(), serde_json::from_str(data).unwrap())),
            // An event ends with an empty line: its id stands by then.
            _ if line.is_empty() && kind == until => break,
            _ => {}
        }
    }
    (told, id)
}

#[test]
fn a_screen_that_comes_back_is_told_what_it_missed_and_no_more() {
    let station = Station::start("");
    station.tell(&fire());
    let (told, id) = events(&station, None, "upto");
    let names = |told: &[(String, Value)]| -> Vec<String> {
        told.iter()
            .filter(|(kind, _)| kind == "incident")
            .map(|(_, f)| f["id"].to_string())
            .collect()
    };
    assert_eq!(names(&told), ["\"uav-1-7\""]);
    let (told, same) = events(&station, Some(&id), "upto");
    assert_eq!(
        (names(&told), &same),
        (Vec::new(), &id),
        "nothing has happened since"
    );

    station.act(ID, "acknowledge");
    let mut other = fire();
    other["properties"]["id"] = "uav-1-8".into();
    other["geometry"]["coordinates"][0] = 119.113.into();
    station.tell(&other);
    let (told, newer) = events(&station, Some(&id), "upto");
    assert_eq!(names(&told), ["\"uav-1-7\"", "\"uav-1-8\""]);
    assert_eq!(
        told[1].1["properties"]["operator"]["by"], "Ana",
        "{told:#?}"
    );
    assert!(newer.parse::<i64>().unwrap() > id.parse::<i64>().unwrap());
    let (told, _) = events(&station, Some("999999"), "upto");
    assert_eq!(names(&told).len(), 2, "an id of another store: all is told");
}
