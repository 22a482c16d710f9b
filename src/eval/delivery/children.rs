//! The two sides as processes, to be killed and started again.

use super::proxy::one_port;
use super::quic::Congestion;
use super::{DeliveryError, io};
use crate::deliver::keys::{PublicKey, SecretKey};
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How long a child may take to be ready, while others build on the same machine.
const READY: Duration = Duration::from_secs(60);

/// One alarm that an aircraft put.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Put {
    /// The outbox said that it has it; else it may or may not.
    pub stored: bool,
    pub id: String,
    pub revision: u32,
    pub captured_ns: i64,
    pub decided_ns: i64,
}

impl Put {
    /// Reads `putting` or `put`, ID, REVISION, CAPTURED, DECIDED.
    fn read(line: &str) -> Option<Self> {
        let (what, rest) = line.split_once(' ')?;
        let mut words = rest.split(' ');
        Some(Self {
            stored: match what {
                "put" => true,
                "putting" => false,
                _ => return None,
            },
            id: words.next()?.to_owned(),
            revision: words.next()?.parse().ok()?,
            captured_ns: words.next()?.parse().ok()?,
            decided_ns: words.next()?.parse().ok()?,
        })
    }
}

/// What a child has said so far.
#[derive(Debug, Clone, Default)]
struct Heard(Arc<Mutex<Vec<String>>>);

impl Heard {
    fn listen(to: impl std::io::Read + Send + 'static) -> Self {
        let heard = Self::default();
        let theirs = heard.clone();
        std::thread::spawn(move || {
            for line in BufReader::new(to).lines().map_while(Result::ok) {
                theirs.lines().push(line);
            }
        });
        heard
    }

    fn lines(&self) -> std::sync::MutexGuard<'_, Vec<String>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait_for(&self, sign: &str, child: &'static str) -> Result<(), DeliveryError> {
        let begun = Instant::now();
        while begun.elapsed() < READY {
            if self.lines().iter().any(|line| line.contains(sign)) {
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Err(DeliveryError::NotReady {
            child,
            limit_s: READY.as_secs(),
            said: self.lines().join(" | "),
        })
    }
}

/// A ground station, its folder and its port.
pub(super) struct Ground {
    folder: PathBuf,
    pub address: SocketAddr,
    pub key: PublicKey,
    child: Option<Child>,
}

impl Ground {
    /// Sets up a station that knows these aircraft, and starts it.
    pub fn start(folder: &Path, uavs: &[(String, PublicKey)]) -> Result<Self, DeliveryError> {
        let data = folder.join("data");
        std::fs::create_dir_all(&data).map_err(io("make the ground's folder"))?;
        let key = SecretKey::load_or_make(&data.join("station.key"))?.public();
        let (tcp, _udp) = one_port()?;
        let address = tcp.local_addr().map_err(io("find a free port"))?;
        let mut config = format!("listen = \"{address}\"\ndata_dir = \"data\"\n");
        for ((name, key), system_id) in uavs.iter().zip(1..) {
            config += &format!(
                "[[uav]]\nsystem_id = {system_id}\nname = \"{name}\"\npublic_key = \"{key}\"\n"
            );
        }
        std::fs::write(folder.join("ground.toml"), config).map_err(io("write a configuration"))?;
        let mut ground = Self {
            folder: folder.to_owned(),
            address,
            key,
            child: None,
        };
        drop((tcp, _udp));
        ground.restart()?;
        Ok(ground)
    }

    /// Kills it if it runs, and starts it again.
    pub fn restart(&mut self) -> Result<(), DeliveryError> {
        self.kill();
        let mut command = ourselves()?;
        command.arg("ground").arg(self.folder.join("ground.toml"));
        command.env("EMBERFIX_LOG", "error").stderr(Stdio::piped());
        let mut child = command.spawn().map_err(io("start emberfix ground"))?;
        let heard = child.stderr.take().map(Heard::listen);
        self.child = Some(child);
        match heard {
            Some(heard) => heard.wait_for("keeps alarms in", "emberfix ground"),
            None => Ok(()),
        }
    }

    /// SIGKILL.
    pub fn kill(&mut self) {
        if let Some(child) = self.child.take() {
            kill(child);
        }
    }

    pub fn database(&self) -> PathBuf {
        crate::ground::database_in(&self.folder.join("data"))
    }
}

impl Drop for Ground {
    fn drop(&mut self) {
        self.kill();
    }
}

/// How an aircraft is to behave.
#[derive(Debug, Clone)]
pub(super) struct Behaviour {
    pub uav: String,
    pub every_ms: u64,
    pub revisions: f64,
    pub way: Way,
}

/// By which of the ways over IP.
#[derive(Debug, Clone)]
pub(super) enum Way {
    /// As the service does it: datagrams, HTTP beside them.
    Datagrams,
    Http,
    /// To who has this certificate.
    Quic(PathBuf, Congestion),
}

/// An aircraft, its folder, and what it put over all its lives.
pub(super) struct Aircraft {
    folder: PathBuf,
    behaviour: Behaviour,
    ground: String,
    ground_key: PublicKey,
    child: Option<Child>,
    heard: Vec<Heard>,
    lives: u64,
}

impl Aircraft {
    /// Where its outbox is.
    pub fn database(folder: &Path) -> PathBuf {
        folder.join("outbox.sqlite")
    }

    /// Its key; made where there is none.
    pub fn key(folder: &Path) -> Result<PublicKey, DeliveryError> {
        std::fs::create_dir_all(folder).map_err(io("make an aircraft's folder"))?;
        Ok(SecretKey::load_or_make(&folder.join("uav.key"))?.public())
    }

    /// Sets up an aircraft that sends to `through`, and starts it.
    pub fn start(
        folder: &Path,
        behaviour: Behaviour,
        through: SocketAddr,
        ground_key: PublicKey,
    ) -> Result<Self, DeliveryError> {
        let mut aircraft = Self {
            folder: folder.to_owned(),
            behaviour,
            ground: format!("http://{through}"),
            ground_key,
            child: None,
            heard: Vec::new(),
            lives: 0,
        };
        aircraft.restart()?;
        Ok(aircraft)
    }

    /// Kills it if it runs, and starts it again.
    pub fn restart(&mut self) -> Result<(), DeliveryError> {
        self.kill();
        self.lives += 1;
        let mut child = self.command()?.spawn().map_err(io("start an aircraft"))?;
        let heard = child.stdout.take().map(Heard::listen).unwrap_or_default();
        self.child = Some(child);
        self.heard.push(heard.clone());
        heard.wait_for("ready", "the aircraft")
    }

    fn command(&self) -> Result<Command, DeliveryError> {
        let Behaviour {
            uav,
            every_ms,
            revisions,
            way,
        } = &self.behaviour;
        let mut command = ourselves()?;
        command
            .args([
                "eval",
                "delivery-aircraft",
                "--uav",
                uav,
                "--ground",
                &self.ground,
            ])
            .args(["--ground-key", &self.ground_key.to_string()])
            .args(["--every-ms", &every_ms.to_string()])
            .args(["--revisions", &revisions.to_string()])
            .args(["--seed", &self.lives.to_string()])
            .arg("--folder")
            .arg(&self.folder);
        match way {
            Way::Datagrams => {}
            Way::Http => {
                command.arg("--http-only");
            }
            Way::Quic(certificate, congestion) => {
                command.arg("--quic").arg(certificate);
                command.args(["--congestion", congestion.name()]);
            }
        }
        command
            .env("EMBERFIX_LOG", "error")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped());
        Ok(command)
    }

    /// SIGKILL.
    pub fn kill(&mut self) {
        if let Some(child) = self.child.take() {
            kill(child);
        }
    }

    /// No further alarms: waits until the outbox is empty and the process has ended.
    pub fn land(&mut self, limit: Duration) -> Result<bool, DeliveryError> {
        let Some(mut child) = self.child.take() else {
            return Ok(false);
        };
        drop(child.stdin.take());
        let begun = Instant::now();
        while begun.elapsed() < limit {
            if let Some(status) = child.try_wait().map_err(io("wait for an aircraft"))? {
                return Ok(status.success());
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        kill(child);
        Ok(false)
    }

    /// What it said that the outbox has, in all its lives, in order.
    pub fn puts(&self) -> Vec<Put> {
        self.said().into_iter().filter(|put| put.stored).collect()
    }

    /// Likewise, and what it was about to put.
    pub fn said(&self) -> Vec<Put> {
        let of = |heard: &Heard| -> Vec<Put> {
            heard
                .lines()
                .iter()
                .filter_map(|line| Put::read(line))
                .collect()
        };
        self.heard.iter().flat_map(of).collect()
    }
}

impl Drop for Aircraft {
    fn drop(&mut self) {
        self.kill();
    }
}

fn kill(mut child: Child) {
    // It may have ended by itself.
    let _ended = child.kill();
    let _reaped = child.wait();
}

/// This very program.
pub(super) fn ourselves() -> Result<Command, DeliveryError> {
    let program = std::env::current_exe().map_err(io("find this program"))?;
    let mut command = Command::new(program);
    command.stdin(Stdio::null());
    Ok(command)
}
