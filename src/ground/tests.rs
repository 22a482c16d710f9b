//! The whole ground station on a real socket, its own client on the other side.

use super::store::tests::feature;
use super::{Ground, GroundConfig, Overrides, Ping};
use crate::alarm::{Alarm, FireId};
use crate::deliver::http::{HttpError, HttpLink};
use crate::deliver::spatial;
use emberfix_frames::{BootTime, MslAltitude, ServiceTime, Vector3};
use emberfix_mav::telemetry::{CommandAck, CommandInt, CommandResult, GlobalPosition};
use emberfix_mav::{Address, Chunk, Encoder, Inbox, MavMessage, Peer, Telemetry, outgoing};
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;

/// Longest that anything here may take before the test fails.
const PATIENCE: Duration = Duration::from_secs(20);

async fn start(folder: &Path) -> Ground {
    let overrides = Overrides {
        listen: "127.0.0.1:0".parse().ok(),
        ..Overrides::default()
    };
    let text = format!("data_dir = {folder:?}");
    let config = GroundConfig::parse(&text, Path::new("test.toml"), overrides).unwrap();
    Ground::start(config).await.unwrap()
}

fn alarm(id: &str, revision: u32) -> Alarm {
    let captured_at = format!("2026-03-01T12:00:{revision:02}Z");
    Alarm::from_geojson(feature(id, revision, &captured_at).as_bytes()).unwrap()
}

async fn send(address: SocketAddr, alarm: Alarm) -> Result<(), HttpError> {
    let link = HttpLink::new(&format!("http://{address}")).unwrap();
    tokio::task::spawn_blocking(move || link.send_alarm(&alarm).map(|_| ()))
        .await
        .unwrap()
}

/// One request by hand; status and body.
async fn ask(address: SocketAddr, head: &str, body: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!(
        "{head}\r\nconnection: close\r\ncontent-length: {}\r\n\r\n",
        body.len()
    );
    stream.write_all(request.as_bytes()).await.unwrap();
    // A server that refuses early may close before it has read all; the answer counts.
    let _ = stream.write_all(body.as_bytes()).await;
    let mut answer = Vec::new();
    let _ = tokio::time::timeout(PATIENCE, stream.read_to_end(&mut answer))
        .await
        .unwrap();
    let answer = String::from_utf8(answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head[9..12].parse().unwrap(), body.to_owned())
}

async fn get(address: SocketAddr, path: &str) -> (u16, String) {
    ask(
        address,
        &format!("GET {path} HTTP/1.1\r\nhost: {address}"),
        "",
    )
    .await
}

async fn post(address: SocketAddr, path: &str, body: &str) -> (u16, String) {
    let head =
        format!("POST {path} HTTP/1.1\r\nhost: {address}\r\ncontent-type: application/geo+json");
    ask(address, &head, body).await
}

struct Events(BufReader<TcpStream>);

impl Events {
    async fn open(address: SocketAddr, last_event_id: Option<i64>) -> Self {
        let mut stream = TcpStream::connect(address).await.unwrap();
        let resume = last_event_id
            .map(|id| format!("last-event-id: {id}\r\n"))
            .unwrap_or_default();
        let head = format!("GET /events HTTP/1.1\r\nhost: {address}\r\n{resume}\r\n");
        stream.write_all(head.as_bytes()).await.unwrap();
        Self(BufReader::new(stream))
    }

    /// The next event of this kind: its id and its data.
    async fn next(&mut self, kind: &str) -> (Option<i64>, serde_json::Value) {
        tokio::time::timeout(PATIENCE, self.read(kind))
            .await
            .unwrap()
    }

    async fn read(&mut self, kind: &str) -> (Option<i64>, serde_json::Value) {
        let (mut name, mut id) = (String::new(), None);
        loop {
            let mut line = String::new();
            assert!(
                self.0.read_line(&mut line).await.unwrap() > 0,
                "the stream ended"
            );
            match line.trim_end().split_once(": ") {
                Some(("event", value)) => name = value.to_owned(),
                Some(("id", value)) => id = value.parse().ok(),
                Some(("data", value)) if name == kind => {
                    return (id, serde_json::from_str(value).unwrap());
                }
                _ => {}
            }
        }
    }

    async fn next_revision(&mut self) -> (i64, String, u64) {
        let (id, feature) = self.next("alarm").await;
        let properties = &feature["properties"];
        let alarm = properties["id"].as_str().unwrap().to_owned();
        (id.unwrap(), alarm, properties["revision"].as_u64().unwrap())
    }
}

#[tokio::test]
async fn an_alarm_that_was_acknowledged_is_served_and_outlives_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    send(ground.address(), alarm("a-1", 2)).await.unwrap();
    send(ground.address(), alarm("a-1", 2)).await.unwrap();
    send(ground.address(), alarm("a-1", 1)).await.unwrap();
    ground.stop().await.unwrap();

    let ground = start(folder.path()).await;
    let (status, body) = get(ground.address(), "/alarms.geojson").await;
    let collection: serde_json::Value = serde_json::from_str(&body).unwrap();
    assert_eq!(
        (status, &collection["type"]),
        (200, &"FeatureCollection".into())
    );
    let features = collection["features"].as_array().unwrap();
    assert_eq!(
        (features.len(), &features[0]["properties"]["revision"]),
        (1, &2.into())
    );
    let (_, health) = get(ground.address(), "/health").await;
    let health: serde_json::Value = serde_json::from_str(&health).unwrap();
    assert_eq!(
        (&health["incidents"], &health["alarms"]),
        (&1.into(), &2.into())
    );
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn a_stream_begins_with_what_stands_goes_on_live_and_resumes_by_id() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    let address = ground.address();
    send(address, alarm("a-1", 1)).await.unwrap();
    send(address, alarm("a-1", 2)).await.unwrap();

    let mut events = Events::open(address, None).await;
    assert_eq!(events.next_revision().await, (2, "a-1".to_owned(), 2));
    send(address, alarm("a-2", 1)).await.unwrap();
    assert_eq!(events.next_revision().await, (3, "a-2".to_owned(), 1));
    drop(events);

    send(address, alarm("a-1", 3)).await.unwrap();
    send(address, alarm("a-1", 4)).await.unwrap();
    let mut events = Events::open(address, Some(3)).await;
    assert_eq!(events.next_revision().await, (4, "a-1".to_owned(), 3));
    assert_eq!(events.next_revision().await, (5, "a-1".to_owned(), 4));

    // An id that this store never gave: all is told anew.
    let mut events = Events::open(address, Some(999)).await;
    assert_eq!(events.next_revision().await.0, 3);
    assert_eq!(events.next_revision().await.0, 5);
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn many_incidents_reach_a_new_stream_each_once_in_order() {
    let folder = tempfile::tempdir().unwrap();
    {
        let store = super::store::sqlite::Sqlite::open(folder.path()).unwrap();
        let kit = super::store::tests::Kit::open(std::sync::Arc::new(store));
        for number in 0..300 {
            let raw = feature(&format!("a-{number}"), 1, "2026-03-01T12:00:00Z");
            let alarm = Alarm::from_geojson(raw.as_bytes()).unwrap();
            let delivery = super::Delivery {
                alarm,
                raw,
                received_at: super::now(),
                link: "test",
                completeness: super::Completeness::Full,
            };
            kit.keep(delivery).await.unwrap();
        }
    }
    let ground = start(folder.path()).await;
    let mut events = Events::open(ground.address(), None).await;
    for number in 0..300 {
        assert_eq!(
            events.next_revision().await,
            (number + 1, format!("a-{number}"), 1)
        );
    }
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn an_aircraft_appears_on_the_stream_and_in_the_track() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    let address = ground.address();
    let mut events = Events::open(address, None).await;
    events.next("hello").await;
    let link = HttpLink::new(&format!("http://{address}")).unwrap();
    let ping = |second: i64| Ping {
        uav: "a".to_owned(),
        at: ServiceTime::from_unix_ns(second * 1_000_000_000),
        latitude_deg: 31.4,
        longitude_deg: 119.1,
        height_ellipsoid_m: 30.0,
        heading_deg: None,
        health: "ok".to_owned(),
    };
    let pings = [ping(1), ping(2)];
    tokio::task::spawn_blocking(move || pings.iter().try_for_each(|ping| link.send_track(ping)))
        .await
        .unwrap()
        .unwrap();
    assert_eq!(events.next("track").await.1["latitude_deg"], 31.4);
    let (_, track) = get(address, "/track.geojson").await;
    let track: serde_json::Value = serde_json::from_str(&track).unwrap();
    assert_eq!(track["features"][0]["geometry"]["coordinates"][1][2], 30.0);
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn what_is_no_alarm_is_refused_with_the_reason_and_not_kept() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    let address = ground.address();
    let good = feature("a-1", 1, "2026-03-01T12:00:01Z");
    let cases = [
        ("{", 400, "not an alarm"),
        (
            &good.replace("119.112017,31.409422", "31.409422,119.112017"),
            400,
            "latitude 119",
        ),
        (
            &good.replace("0.93", "1.93"),
            400,
            "confidence is 1.93, allowed is 0 to 1",
        ),
        (
            &good.replace("[1.6,0.3", "[-9.0,0.3"),
            400,
            "covariance_enu_m2",
        ),
        (&good.replace("\"fire\"", "\"barbecue\""), 400, "barbecue"),
        (
            &format!("{good}{}", " ".repeat(65 * 1024)),
            413,
            "65536 bytes",
        ),
    ];
    for (body, status, reason) in cases {
        let (answered, text) = post(address, "/alarms", body).await;
        assert_eq!(answered, status, "{text}");
        assert!(text.contains(reason), "{reason:?} is not in {text}");
    }
    let (_, health) = get(address, "/health").await;
    let health: serde_json::Value = serde_json::from_str(&health).unwrap();
    assert_eq!(
        (&health["alarms"], &health["since_start"]["refused"]),
        (&0.into(), &6.into())
    );
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn a_foreign_web_page_can_neither_post_nor_read() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    let address = ground.address();
    let good = feature("a-1", 1, "2026-03-01T12:00:01Z");
    let head = format!("POST /alarms HTTP/1.1\r\nhost: {address}\r\ncontent-type: text/plain");
    assert_eq!(ask(address, &head, &good).await.0, 415);
    let rebound = "GET /alarms.geojson HTTP/1.1\r\nhost: evil.example:8470";
    assert_eq!(ask(address, rebound, "").await.0, 421);
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn a_stop_ends_open_streams_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    let mut events = Events::open(ground.address(), None).await;
    events.next("hello").await;
    let asked = std::time::Instant::now();
    ground.stop().await.unwrap();
    assert!(asked.elapsed() < super::GRACE, "it waited for the stream");
}

/// The aircraft's side of MAVLink: a bare UDP socket.
struct Aircraft {
    socket: tokio::net::UdpSocket,
    encoder: Encoder,
    inbox: Inbox,
}

impl Aircraft {
    async fn new(port: u16) -> Self {
        let socket = tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap();
        socket.connect(("127.0.0.1", port)).await.unwrap();
        let encoder = Encoder::new(Address::new(7, 191));
        Self {
            socket,
            encoder,
            inbox: Inbox::new(),
        }
    }

    async fn say(&mut self, message: &MavMessage) {
        self.socket
            .send(&self.encoder.encode(message))
            .await
            .unwrap();
    }

    /// The next message that `wanted` takes.
    async fn hear<T>(&mut self, wanted: impl Fn(Address, &Telemetry) -> Option<T>) -> T {
        let heard = async {
            loop {
                let mut bytes = vec![0; 2048];
                let length = self.socket.recv(&mut bytes).await.unwrap();
                bytes.truncate(length);
                let from = Peer::Connection(0);
                for received in self.inbox.take(&Chunk { from, bytes }) {
                    let telemetry = received.telemetry.unwrap();
                    if let Some(found) = wanted(received.frame.sender(), &telemetry) {
                        return found;
                    }
                }
            }
        };
        tokio::time::timeout(PATIENCE, heard).await.unwrap()
    }

    async fn tell(&mut self, order: &CommandInt) -> CommandAck {
        self.say(&outgoing::command_int(order).unwrap()).await;
        self.hear(|_, telemetry| match telemetry {
            Telemetry::CommandAck(ack) => Some(*ack),
            _ => None,
        })
        .await
    }
}

async fn start_with_mavlink(folder: &Path) -> (Ground, u16) {
    let free = std::net::UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port();
    let overrides = Overrides {
        listen: "127.0.0.1:0".parse().ok(),
        mavlink_url: Some(format!("udpin:127.0.0.1:{free}")),
        ..Overrides::default()
    };
    let text = format!("data_dir = {folder:?}\n[[uav]]\nsystem_id = 7\nname = \"a\"");
    let config = GroundConfig::parse(&text, Path::new("test.toml"), overrides).unwrap();
    (Ground::start(config).await.unwrap(), free)
}

#[tokio::test]
async fn an_alarm_over_mavlink_is_acknowledged_stored_and_shown_with_its_doubt() {
    let folder = tempfile::tempdir().unwrap();
    let (ground, port) = start_with_mavlink(folder.path()).await;
    let mut aircraft = Aircraft::new(port).await;
    aircraft.say(&outgoing::companion_heartbeat(true)).await;
    let agent = aircraft
        .hear(|sender, telemetry| matches!(telemetry, Telemetry::Heartbeat(_)).then_some(sender))
        .await;
    assert_eq!(agent, Address::new(254, 191));

    let order = spatial::encode(&alarm("a-3", 2), agent, super::now()).unwrap();
    let receipt = spatial::receipt(FireId(3), 2);
    for _ in 0..2 {
        let ack = aircraft.tell(&order).await;
        assert_eq!(
            (ack.result, ack.result_param2),
            (CommandResult::Accepted, receipt)
        );
        assert_eq!(ack.target, Address::new(7, 191));
    }
    let mut events = Events::open(ground.address(), None).await;
    let feature = events.next("alarm").await.1;
    assert_eq!(feature["properties"]["id"], "a-3");
    assert_eq!(feature["properties"]["degraded"][0], "mavlink_summary");
    let longitude = feature["geometry"]["coordinates"][0].as_f64().unwrap();
    // Half of MAVLink's step of 1e-7 degrees.
    assert!((longitude - 119.112017).abs() <= 0.51e-7, "{longitude}");
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn a_command_for_someone_else_or_without_a_place_is_never_stored() {
    let folder = tempfile::tempdir().unwrap();
    let (ground, port) = start_with_mavlink(folder.path()).await;
    let mut aircraft = Aircraft::new(port).await;
    let ground_agent = Address::new(254, 191);
    let good = spatial::encode(&alarm("a-3", 2), ground_agent, super::now()).unwrap();
    let elsewhere = CommandInt {
        target: Address::new(255, 190),
        ..good
    };
    aircraft
        .say(&outgoing::command_int(&elsewhere).unwrap())
        .await;
    let nowhere = CommandInt {
        x: i32::MAX,
        ..good
    };
    let ack = aircraft.tell(&nowhere).await;
    assert_eq!(ack.result, CommandResult::Denied);
    let (_, collection) = get(ground.address(), "/alarms.geojson").await;
    assert!(collection.contains("\"features\":[]"), "{collection}");
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn an_aircraft_heard_over_mavlink_is_drawn_at_its_ellipsoid_height() {
    let folder = tempfile::tempdir().unwrap();
    let (ground, port) = start_with_mavlink(folder.path()).await;
    let mut events = Events::open(ground.address(), None).await;
    events.next("hello").await;
    let position = GlobalPosition {
        boot: BootTime::from_ms(1000),
        latitude_deg: 31.409_422_2,
        longitude_deg: 119.112_016_7,
        altitude: MslAltitude::from_m(20.0),
        above_home_m: 10.0,
        velocity_ned_m_s: Vector3::zeros(),
        heading_rad: Some(std::f64::consts::FRAC_PI_2),
    };
    Aircraft::new(port)
        .await
        .say(&outgoing::global_position(&position))
        .await;
    let ping = events.next("track").await.1;
    assert_eq!(
        (&ping["uav"], &ping["heading_deg"]),
        (&"a".into(), &90.0.into())
    );
    // EGM96 at Gaochun is 2.355 m; the message carries millimetres.
    let height = ping["height_ellipsoid_m"].as_f64().unwrap();
    assert!((height - 22.355).abs() < 0.01, "{height}");
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn a_refused_alarm_is_news_on_the_stream() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    let mut events = Events::open(ground.address(), None).await;
    events.next("hello").await;
    let first = feature("a-1", 1, "2026-03-01T12:00:01Z");
    assert_eq!(post(ground.address(), "/alarms", &first).await.0, 201);
    let restarted = feature("a-1", 1, "2026-03-01T13:00:01Z");
    assert_eq!(post(ground.address(), "/alarms", &restarted).await.0, 409);
    let told = events.next("refused").await.1;
    assert!(
        told["reason"]
            .as_str()
            .unwrap()
            .contains("numbering has restarted"),
        "{told}"
    );
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn a_test_alarm_is_checked_and_shown_and_kept_nowhere() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path()).await;
    let address = ground.address();
    let mut events = Events::open(address, None).await;
    let link = HttpLink::new(&format!("http://{address}")).unwrap();
    let sent = tokio::task::spawn_blocking(move || {
        let health = link.health().unwrap();
        (link.send_test(&alarm("uav-1-test", 1)), health)
    });
    let (sent, health) = sent.await.unwrap();
    sent.unwrap();
    assert_eq!(health.version, env!("CARGO_PKG_VERSION"));
    assert!(health.now.is_some());
    let (_, told) = events.next("test").await;
    assert_eq!(told["link"], "http");
    let (_, alarms) = get(address, "/alarms.geojson").await;
    assert!(!alarms.contains("uav-1-test"), "{alarms}");
    let (status, _) = post(address, "/alarms/test", "{\"type\":\"Feature\"}").await;
    assert_eq!(status, 400);
    ground.stop().await.unwrap();
}
