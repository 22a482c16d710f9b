//! The whole, as strangers: starts the ground station and the service, flies, and holds what the
//! ground was told against the truth.
//!
//! **In:** a mission and the programs `emberfix` beside this one. **Out:** a [`Report`]: the table,
//! the figures, where the page is. The children are ended whatever happens, except by SIGKILL to us.

use crate::autopilot::ErrorsConfig;
use crate::cameras::Cameras;
use crate::earth::TangentPlane;
use crate::flight::Flight;
use crate::live::{Control, Edges, HeadStart, LiveError, LiveFlight};
use crate::mission::Mission;
use crate::score::{self, AlarmsError, ErrorBound, Score};
use crate::world::World;
use emberfix_frames::ServiceTime;
use emberfix_report::Figure;
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::net::{TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

/// Why a demo came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// A file or port of the demo's own.
    #[error("{what}: {source}")]
    Io {
        /// What was wanted.
        what: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// A program could not be started.
    #[error("{program}: {source}; ./x demo builds it", program = program.display())]
    Start {
        /// The program.
        program: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A program ended though it was needed.
    #[error("{name} ended with {status}; the end of {log}:\n{tail}", log = log.display())]
    Ended {
        /// Which one.
        name: &'static str,
        /// How it ended.
        status: ExitStatus,
        /// Where its words are.
        log: PathBuf,
        /// Its last words.
        tail: String,
    },
    /// The ground station never answered.
    #[error("{url} did not answer within {waited_s} s: {reason}")]
    NoAnswer {
        /// Asked for.
        url: String,
        /// How long was waited, seconds.
        waited_s: u64,
        /// The last failure.
        reason: String,
    },
    /// The flight itself.
    #[error(transparent)]
    Live(#[from] LiveError),
    /// What the ground serves is no list of alarms.
    #[error(transparent)]
    Alarms(#[from] AlarmsError),
    /// Stopped by a signal.
    #[error("stopped")]
    Stopped,
}

/// What to demonstrate, and where to put it.
pub struct Demo<'a> {
    /// The mission.
    pub mission: &'a Mission,
    /// Its world.
    pub world: Arc<World>,
    /// Its flight.
    pub flight: Arc<Flight>,
    /// Sensor errors.
    pub errors: ErrorsConfig,
    /// Folder of logs, recording and stores; it must exist.
    pub folder: PathBuf,
    /// Set from outside to stop at once.
    pub stop: &'a AtomicBool,
}

/// How far a demo is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Progress {
    /// Pictures are rendered before take-off.
    Rendering {
        /// Pairs so far.
        pairs: u32,
    },
    /// In the air.
    Flying {
        /// Seconds of flight so far.
        flown_s: f64,
    },
}

/// What a demo showed.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Name of the mission.
    pub mission: String,
    /// Seed of the world, the flight and the errors.
    pub seed: u64,
    /// Whether sensor errors were turned off.
    pub errors_off: bool,
    /// Truth against alarms.
    #[serde(flatten)]
    pub score: Score,
    /// The figures and their bounds.
    pub figures: Vec<Figure>,
    /// The ground's page.
    pub page: String,
    /// Pairs that were sent, late, and sent to nobody.
    pub pairs: PairCounts,
    /// Heartbeats of the service that the autopilot heard.
    pub service_heartbeats: u64,
    /// Lines that the service said over MAVLink.
    pub status_texts: Vec<String>,
    /// From start to score, seconds.
    pub wall_s: f64,
}

/// What became of the pictures.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct PairCounts {
    /// Sent in time.
    pub sent: u32,
    /// Dropped, because they were not ready in time.
    pub late: u32,
    /// Dropped, because nobody listened.
    pub unheard: u32,
}

impl Report {
    /// Whether every figure keeps its bound.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.figures.iter().all(|figure| figure.holds)
    }
}

const START_LIMIT: Duration = Duration::from_secs(30);
/// The service loads its model first.
const SERVICE_LIMIT: Duration = Duration::from_secs(60);
const POLL: Duration = Duration::from_millis(200);
/// Alarms that do not change for this long have settled.
const SETTLED: Duration = Duration::from_secs(3);
const SETTLE_LIMIT: Duration = Duration::from_secs(20);
/// Time to end in peace before a child is killed.
const END_LIMIT: Duration = Duration::from_secs(5);
const HTTP_LIMIT: Duration = Duration::from_secs(5);

impl Demo<'_> {
    /// Runs it. The ground station goes on in the returned [`Ground`] until that is dropped;
    /// `on_progress` hears how far it is.
    ///
    /// # Errors
    /// [`DemoError`] when a program fails, or the ground tells something unreadable.
    pub fn run(
        &self,
        on_progress: impl Fn(Progress) + Sync,
    ) -> Result<(Report, Ground), DemoError> {
        let began = Instant::now();
        let edges = free_edges()?;
        let live = self.live_flight(edges.clone());
        let control = Control::default();
        let head_start = self.prepare(&live, &control, &on_progress)?;
        let mut ground = Ground::start(&self.folder)?;
        ground.await_answer(self.stop)?;
        let mut service = self.start_service(&edges, &ground.url)?;
        let mut watch = Watch::new(&ground.url);
        let flown = std::thread::scope(|scope| {
            let pilot = scope.spawn(|| live.fly(head_start, &control));
            let attended = self.attend(
                || pilot.is_finished(),
                &mut ground,
                &mut service,
                |at_ground| {
                    at_ground.look();
                    on_progress(Progress::Flying {
                        flown_s: control.flown_s(),
                    });
                },
                &mut watch,
            );
            if attended.is_err() {
                control.stop();
            }
            let flown = pilot.join().map_err(|_| DemoError::Stopped)?;
            attended.and(flown.map_err(DemoError::from))
        })?;
        watch.settle(self.stop)?;
        service.end();
        let plane = TangentPlane::at(self.mission.datum);
        let alarms = score::read_alarms(&watch.latest, &plane, &watch.told_at)?;
        let score = score::score(&self.truths(), &alarms);
        let report = Report {
            mission: self.mission.name.clone(),
            seed: self.mission.sim.seed,
            errors_off: self.errors.off,
            figures: score.figures(ErrorBound::for_errors(
                self.errors.off,
                self.mission.sim.horizontal_error_bound_m,
            )),
            score,
            page: ground.url.clone(),
            pairs: PairCounts {
                sent: flown.pairs_sent,
                late: flown.pairs_late,
                unheard: flown.pairs_unheard,
            },
            service_heartbeats: flown.heard.heartbeats,
            status_texts: flown.heard.texts,
            wall_s: began.elapsed().as_secs_f64(),
        };
        Ok((report, ground))
    }

    fn truths(&self) -> Vec<score::Truth> {
        let (world, flight) = (Arc::clone(&self.world), Arc::clone(&self.flight));
        Cameras::new(self.mission, world, flight, &self.errors).seen()
    }

    fn start_service(&self, edges: &Edges, ground_url: &str) -> Result<Program, DemoError> {
        let mut command = emberfix()?;
        command.arg("run").arg(&self.mission.path);
        command.args(["--mavlink", &edges.mavlink, "--camera", &edges.camera]);
        command.args(["--ground", ground_url]);
        command.arg("--state").arg(self.folder.join("state"));
        command.arg("--record").arg(self.folder.join("flight.mcap"));
        Program::start("emberfix run", command, self.folder.join("run.log"))
    }

    fn live_flight(&self, edges: Edges) -> LiveFlight<'_> {
        LiveFlight {
            mission: self.mission,
            world: Arc::clone(&self.world),
            flight: Arc::clone(&self.flight),
            errors: &self.errors,
            edges,
            service_limit: SERVICE_LIMIT,
        }
    }

    /// The pictures, before any other program runs.
    fn prepare(
        &self,
        live: &LiveFlight<'_>,
        control: &Control,
        on_progress: &(impl Fn(Progress) + Sync),
    ) -> Result<HeadStart, DemoError> {
        std::thread::scope(|scope| {
            let renderer = scope.spawn(|| live.prepare(control));
            while !renderer.is_finished() {
                std::thread::sleep(POLL);
                on_progress(Progress::Rendering {
                    pairs: control.prepared(),
                });
                if self.stop.load(Ordering::Relaxed) {
                    control.stop();
                    return Err(DemoError::Stopped);
                }
            }
            renderer.join().map_err(|_| DemoError::Stopped)
        })
    }

    /// Looks at the ground and after the children until the flight is over.
    fn attend(
        &self,
        is_over: impl Fn() -> bool,
        ground: &mut Ground,
        service: &mut Program,
        look: impl Fn(&mut Watch),
        watch: &mut Watch,
    ) -> Result<(), DemoError> {
        while !is_over() {
            std::thread::sleep(POLL);
            look(watch);
            self.trouble(ground, service)?;
        }
        Ok(())
    }

    fn trouble(&self, ground: &mut Ground, service: &mut Program) -> Result<(), DemoError> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(DemoError::Stopped);
        }
        service.must_run()?;
        ground.program.must_run()
    }
}

/// Ports that are free now. Between here and their use another program might take one; then the
/// service says so.
fn free_edges() -> Result<Edges, DemoError> {
    let io = |source| DemoError::Io {
        what: "a free port".to_owned(),
        source,
    };
    let mavlink = UdpSocket::bind("127.0.0.1:0")
        .and_then(|s| s.local_addr())
        .map_err(io)?;
    let camera = TcpListener::bind("127.0.0.1:0")
        .and_then(|s| s.local_addr())
        .map_err(io)?;
    Ok(Edges {
        mavlink: format!("udpin:{mavlink}"),
        camera: format!("tcp-listen:{camera}"),
    })
}

/// `emberfix`, beside this program.
fn emberfix() -> Result<Command, DemoError> {
    let own = std::env::current_exe().map_err(|source| DemoError::Io {
        what: "own program".to_owned(),
        source,
    })?;
    Ok(Command::new(own.with_file_name("emberfix")))
}

/// A running ground station.
pub struct Ground {
    program: Program,
    /// Address of its page.
    pub url: String,
}

impl Ground {
    fn start(folder: &Path) -> Result<Self, DemoError> {
        let io = |what: &str| {
            let what = what.to_owned();
            move |source| DemoError::Io { what, source }
        };
        let address = TcpListener::bind("127.0.0.1:0")
            .and_then(|listener| listener.local_addr())
            .map_err(io("a free port"))?;
        let config = folder.join("ground.toml");
        let text = format!("listen = \"{address}\"\ndata_dir = \"ground\"\n");
        std::fs::write(&config, text).map_err(io("ground.toml"))?;
        let mut command = emberfix()?;
        command.arg("ground").arg(&config);
        let program = Program::start("emberfix ground", command, folder.join("ground.log"))?;
        Ok(Self {
            program,
            url: format!("http://{address}"),
        })
    }

    fn await_answer(&mut self, stop: &AtomicBool) -> Result<(), DemoError> {
        let url = format!("{}/health", self.url);
        let since = Instant::now();
        loop {
            let reason = match get(&url) {
                Ok(_) => return Ok(()),
                Err(reason) => reason,
            };
            self.program.must_run()?;
            if stop.load(Ordering::Relaxed) {
                return Err(DemoError::Stopped);
            }
            if since.elapsed() > START_LIMIT {
                return Err(DemoError::NoAnswer {
                    url,
                    waited_s: START_LIMIT.as_secs(),
                    reason,
                });
            }
            std::thread::sleep(POLL);
        }
    }
}

/// What the ground has been told so far, and when each alarm first stood there.
struct Watch {
    url: String,
    latest: String,
    told_at: BTreeMap<String, ServiceTime>,
}

const NO_ALARMS: &str = r#"{"type":"FeatureCollection","features":[]}"#;

impl Watch {
    fn new(ground_url: &str) -> Self {
        Self {
            url: format!("{ground_url}/alarms.geojson"),
            latest: NO_ALARMS.to_owned(),
            told_at: BTreeMap::new(),
        }
    }

    /// Looks once; true when something has changed. A failure leaves what was known.
    fn look(&mut self) -> bool {
        let Ok(text) = get(&self.url) else {
            return false;
        };
        let changed = text != self.latest;
        if changed {
            let now = utc_now();
            for id in told_ids(&text) {
                self.told_at.entry(id).or_insert(now);
            }
            self.latest = text;
        }
        changed
    }

    fn settle(&mut self, stop: &AtomicBool) -> Result<(), DemoError> {
        let since = Instant::now();
        let mut changed_at = Instant::now();
        while changed_at.elapsed() < SETTLED && since.elapsed() < SETTLE_LIMIT {
            if stop.load(Ordering::Relaxed) {
                return Err(DemoError::Stopped);
            }
            if self.look() {
                changed_at = Instant::now();
            }
            std::thread::sleep(POLL);
        }
        Ok(())
    }
}

/// Ids of the alarms that are more than suspected.
fn told_ids(geojson: &str) -> Vec<String> {
    let collection: serde_json::Value = serde_json::from_str(geojson).unwrap_or_default();
    let features = collection["features"]
        .as_array()
        .cloned()
        .unwrap_or_default();
    let told = features.iter().map(|feature| &feature["properties"]);
    let told = told.filter(|properties| properties["state"] != "suspected");
    told.filter_map(|properties| properties["id"].as_str().map(str::to_owned))
        .collect()
}

fn get(url: &str) -> Result<String, String> {
    let config = ureq::Agent::config_builder()
        .timeout_global(Some(HTTP_LIMIT))
        .build();
    let mut response = ureq::Agent::new_with_config(config)
        .get(url)
        .call()
        .map_err(|error| error.to_string())?;
    response
        .body_mut()
        .read_to_string()
        .map_err(|error| error.to_string())
}

fn utc_now() -> ServiceTime {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    ServiceTime::from_unix_ns(since.map_or(0, |since| since.as_nanos() as i64))
}

/// A child that ends with us.
struct Program {
    name: &'static str,
    child: Child,
    log: PathBuf,
}

impl Program {
    fn start(name: &'static str, mut command: Command, log: PathBuf) -> Result<Self, DemoError> {
        let io = |source| DemoError::Io {
            what: log.display().to_string(),
            source,
        };
        let words = File::create(&log).map_err(io)?;
        let also = words.try_clone().map_err(io)?;
        command.stdin(Stdio::null()).stdout(words).stderr(also);
        let program = command.get_program().into();
        let child = command
            .spawn()
            .map_err(|source| DemoError::Start { program, source })?;
        Ok(Self { name, child, log })
    }

    fn must_run(&mut self) -> Result<(), DemoError> {
        match self.child.try_wait() {
            Ok(Some(status)) => Err(DemoError::Ended {
                name: self.name,
                status,
                tail: tail(&self.log),
                log: self.log.clone(),
            }),
            _ => Ok(()),
        }
    }

    /// Asks it to end; makes it, when it does not.
    fn end(&mut self) {
        if let Ok(Some(_)) = self.child.try_wait() {
            return;
        }
        // A child that is gone already can't be asked: nothing to do then.
        let _ = kill_process(Pid::from_child(&self.child), Signal::TERM);
        let asked = Instant::now();
        while asked.elapsed() < END_LIMIT {
            if let Ok(Some(_)) = self.child.try_wait() {
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.end();
    }
}

/// Lines of a log that are shown when its program failed.
const TAIL_LINES: usize = 12;

fn tail(log: &Path) -> String {
    let text = std::fs::read_to_string(log).unwrap_or_default();
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(TAIL_LINES)..].join("\n")
}

impl Report {
    /// The table for people.
    #[must_use]
    pub fn table(&self) -> String {
        let mut table = comfy_table::Table::new();
        table.load_style(comfy_table::presets::UTF8_HORIZONTAL_ONLY);
        table.set_header([
            "truth",
            "class",
            "alarm",
            "east m",
            "north m",
            "up m",
            "CE90 m",
            "in ellipse",
            "sightings",
            "first sight to alarm s",
        ]);
        for row in &self.score.rows {
            table.add_row(cells(row));
        }
        let mut text = table.to_string();
        for alarm in &self.score.false_alarms {
            let why = alarm.duplicate_of.as_ref().map_or_else(
                || "nothing burns there".to_owned(),
                |truth| format!("{truth} was told already"),
            );
            text.push_str(&format!(
                "\nfalse: {} at {:.1} m east, {:.1} m north: {why}",
                alarm.alarm, alarm.east_m, alarm.north_m
            ));
        }
        text.push('\n');
        text.push_str(&emberfix_report::text_lines(&self.figures));
        text
    }
}

fn cells(row: &score::Row) -> Vec<String> {
    let class = format!("{:?}", row.class).to_lowercase();
    let mut cells = vec![row.truth.clone(), class];
    match &row.found {
        None => cells.push("not told".to_owned()),
        Some(found) => cells.extend([
            found.alarm.clone(),
            format!("{:+.2}", found.error_east_m),
            format!("{:+.2}", found.error_north_m),
            format!("{:+.2}", found.error_up_m),
            format!("{:.2}", found.ce90_m),
            if found.inside_ellipse { "yes" } else { "no" }.to_owned(),
            found.sightings.to_string(),
            found
                .first_sight_to_alarm_s
                .map_or("-".to_owned(), |s| format!("{s:.1}")),
        ]),
    }
    cells
}
