//! Flies a mission: live, into a recording, as a data set, or as the whole demonstration.

use anyhow::Context;
use clap::{Args, Parser, Subcommand, ValueEnum};
use emberfix_sim::autopilot::ErrorsConfig;
use emberfix_sim::dataset::{Form, Framing};
use emberfix_sim::demo::{Demo, DemoError, Progress, Report};
use emberfix_sim::live::{Control, Edges, LiveFlight};
use emberfix_sim::mission::Mission;
use emberfix_sim::record::record;
use emberfix_sim::{dataset, setup};
use indicatif::{ProgressBar, ProgressStyle};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// A seeded world that plays autopilot and cameras for emberfix.
#[derive(Debug, Parser)]
#[command(
    version,
    args_conflicts_with_subcommands = true,
    arg_required_else_help = true
)]
struct Cli {
    #[command(subcommand)]
    command: Option<SubCommand>,
    #[command(flatten)]
    fly: Option<FlyArgs>,
}

#[derive(Debug, Subcommand)]
enum SubCommand {
    /// Starts the ground station and the service, flies, and scores what the ground was told
    Demo(DemoArgs),
}

#[derive(Debug, Args)]
struct FlyArgs {
    /// Mission file, or the name of one in missions/
    mission: String,
    /// Fly offline into this MCAP recording
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    record: Option<PathBuf>,
    /// Write labelled pictures of random worlds into this folder
    #[arg(long, value_name = "DIR")]
    dataset: Option<PathBuf>,
    /// Pictures of the data set
    #[arg(long, default_value_t = 1000, requires = "dataset")]
    frames: usize,
    /// Whole raw left images instead of what a detector gets to see of them
    #[arg(long, requires = "dataset")]
    whole_frames: bool,
    /// Label pixels by outlines instead of boxes
    #[arg(long, requires = "dataset")]
    outlines: bool,
    /// Seed instead of the mission's
    #[arg(long)]
    seed: Option<u64>,
    /// Sensor errors: as the mission says, or none
    #[arg(long, value_enum, default_value_t = Errors::Mission)]
    errors: Errors,
    /// The service's MAVLink URL instead of the mission's
    #[arg(long, value_name = "URL")]
    mavlink: Option<String>,
    /// The service's camera URL instead of the mission's
    #[arg(long, value_name = "URL")]
    camera: Option<String>,
}

#[derive(Debug, Args)]
struct DemoArgs {
    /// Mission file, or the name of one in missions/
    #[arg(default_value = "gaochun")]
    mission: String,
    /// End when the score is known, instead of keeping the page up until Ctrl-C
    #[arg(long)]
    headless: bool,
    /// Print one JSON object instead of the table
    #[arg(long)]
    json: bool,
    /// Folder for logs, recording and alarms, which then stay
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Keep the temporary folder
    #[arg(long)]
    keep: bool,
    /// Seed instead of the mission's
    #[arg(long)]
    seed: Option<u64>,
    /// Sensor errors: as the mission says, or none
    #[arg(long, value_enum, default_value_t = Errors::Mission)]
    errors: Errors,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Errors {
    /// As the mission says
    Mission,
    /// Sensors that do not err
    Off,
}

impl Errors {
    fn of(self, mission: &Mission) -> ErrorsConfig {
        let errors = &mission.sim.errors;
        if self == Self::Off || errors.off {
            errors.sensors_off()
        } else {
            errors.clone()
        }
    }
}

/// Refused before anything began.
const REFUSED: u8 = 2;
/// How long a live flight waits for the service; Ctrl-C ends it sooner.
const SERVICE_LIMIT: Duration = Duration::from_secs(600);

fn main() -> ExitCode {
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
        .with_writer(std::io::stderr)
        .init();
    let cli = Cli::parse();
    let (name, seed) = match (&cli.command, &cli.fly) {
        (Some(SubCommand::Demo(demo)), _) => (&demo.mission, demo.seed),
        (None, Some(fly)) => (&fly.mission, fly.seed),
        (None, None) => return ExitCode::from(REFUSED),
    };
    let mut mission = match Mission::load(name) {
        Ok(mission) => mission,
        Err(error) => return refuse(&error),
    };
    mission.sim.seed = seed.unwrap_or(mission.sim.seed);
    let done = match cli {
        Cli {
            command: Some(SubCommand::Demo(args)),
            ..
        } => demo(&args, &mission),
        Cli {
            fly: Some(args), ..
        } => fly(&args, &mission).map(|()| true),
        Cli { .. } => return ExitCode::from(REFUSED),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("emberfix-sim: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn refuse(error: &dyn std::error::Error) -> ExitCode {
    eprintln!("emberfix-sim: {error}");
    ExitCode::from(REFUSED)
}

fn fly(args: &FlyArgs, mission: &Mission) -> anyhow::Result<()> {
    if let Some(folder) = &args.dataset {
        let framing = if args.whole_frames {
            Framing::Whole
        } else {
            Framing::Cut
        };
        let form = Form {
            framing,
            outlines: args.outlines,
        };
        return write_dataset(folder, args.frames, form, mission);
    }
    let errors = args.errors.of(mission);
    match &args.record {
        Some(file) => fly_offline(file, mission, &errors),
        None => fly_live(args, mission, &errors),
    }
}

fn write_dataset(
    folder: &Path,
    frames: usize,
    form: Form,
    mission: &Mission,
) -> anyhow::Result<()> {
    let written = dataset::write(folder, frames, mission.sim.seed, &mission.rig, form)?;
    eprintln!("{}: {written:?}", folder.display());
    Ok(())
}

fn fly_offline(file: &Path, mission: &Mission, errors: &ErrorsConfig) -> anyhow::Result<()> {
    let (world, flight) = setup(mission)?;
    let destination =
        std::fs::File::create(file).with_context(|| format!("recording {}", file.display()))?;
    let pairs = (flight.duration_s() * mission.sim.camera.rate_hz).floor() as u64;
    let bar = bar(pairs, "{pos}/{len} pairs, {eta} left");
    let on_pair = |done: u32| bar.set_position(done.into());
    let recorded = record(
        mission,
        &world,
        &flight,
        errors,
        BufWriter::new(destination),
        on_pair,
    )?;
    bar.finish_and_clear();
    eprintln!(
        "{}: {} pairs, {} MAVLink frames, {:.0} s of flight",
        file.display(),
        recorded.pairs,
        recorded.mavlink_frames,
        flight.duration_s()
    );
    Ok(())
}

fn fly_live(args: &FlyArgs, mission: &Mission, errors: &ErrorsConfig) -> anyhow::Result<()> {
    let (world, flight) = setup(mission)?;
    let edges = Edges {
        mavlink: args
            .mavlink
            .clone()
            .unwrap_or_else(|| mission.mavlink_url.clone()),
        camera: args
            .camera
            .clone()
            .unwrap_or_else(|| mission.camera_url.clone()),
    };
    eprintln!(
        "{}: MAVLink {}, pairs {}",
        mission.name, edges.mavlink, edges.camera
    );
    let service_limit = SERVICE_LIMIT;
    let live = LiveFlight {
        mission,
        world,
        flight: Arc::clone(&flight),
        errors,
        edges,
        service_limit,
    };
    let control = Control::default();
    let bar = flight_bar(flight.duration_s());
    let flown = std::thread::scope(|scope| {
        let pilot = scope.spawn(|| live.fly(live.prepare(&control), &control));
        while !pilot.is_finished() {
            std::thread::sleep(Duration::from_millis(200));
            bar.set_position(control.flown_s() as u64);
        }
        pilot.join()
    });
    bar.finish_and_clear();
    let flown = flown.map_err(|_| anyhow::anyhow!("the flight panicked"))??;
    eprintln!(
        "{} pairs sent, {} late, {} unheard; heard {} heartbeats, {} TIMESYNC requests, {} texts",
        flown.pairs_sent,
        flown.pairs_late,
        flown.pairs_unheard,
        flown.heard.heartbeats,
        flown.heard.timesync_requests,
        flown.heard.texts.len()
    );
    Ok(())
}

/// True when every figure holds.
fn demo(args: &DemoArgs, mission: &Mission) -> anyhow::Result<bool> {
    let stop = stop_on_signal()?;
    let (world, flight) = setup(mission)?;
    let folder = Folder::new(args)?;
    let demo = Demo {
        mission,
        world,
        errors: args.errors.of(mission),
        folder: folder.path.clone(),
        flight: Arc::clone(&flight),
        stop: &stop,
    };
    let (pictures, flying) = (ProgressBar::new_spinner(), flight_bar(flight.duration_s()));
    let ran = demo.run(|progress| match progress {
        Progress::Rendering { pairs } => pictures.set_message(format!("{pairs} pairs rendered")),
        Progress::Flying { flown_s } => {
            pictures.finish_and_clear();
            flying.set_position(flown_s as u64);
        }
    });
    flying.finish_and_clear();
    let (report, ground) = match ran {
        Err(DemoError::Stopped) => return Ok(false),
        ran => ran?,
    };
    std::fs::write(
        folder.path.join("report.json"),
        serde_json::to_vec_pretty(&report)?,
    )?;
    show(args, &report, &folder)?;
    if !args.headless {
        keep_page_up(&report, &stop);
    }
    drop(ground);
    Ok(report.holds())
}

fn show(args: &DemoArgs, report: &Report, folder: &Folder) -> anyhow::Result<()> {
    if args.json {
        println!("{}", serde_json::to_string_pretty(report)?);
    } else {
        println!("{}", report.table());
    }
    if folder.stays {
        eprintln!("logs, recording and report: {}", folder.path.display());
    }
    Ok(())
}

fn keep_page_up(report: &Report, stop: &AtomicBool) {
    eprintln!("the map: {} (Ctrl-C ends)", report.page);
    if std::env::var_os("DISPLAY").is_some() {
        // No browser is no fault: the address stands above.
        let quiet = std::process::Stdio::null;
        let _ = std::process::Command::new("xdg-open")
            .arg(&report.page)
            .stdout(quiet())
            .stderr(quiet())
            .spawn();
    }
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Where the demo's files lie; removed at the end unless somebody wants them.
struct Folder {
    path: PathBuf,
    stays: bool,
}

impl Folder {
    fn new(args: &DemoArgs) -> anyhow::Result<Self> {
        let own = || std::env::temp_dir().join(format!("emberfix-demo-{}", std::process::id()));
        let path = args.out.clone().unwrap_or_else(own);
        std::fs::create_dir_all(&path).with_context(|| format!("folder {}", path.display()))?;
        Ok(Self {
            path: path.canonicalize()?,
            stays: args.keep || args.out.is_some(),
        })
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        if !self.stays {
            // What can't be removed is left to the system's own cleaning.
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// A flag that Ctrl-C and SIGTERM set, so that children end before we do.
fn stop_on_signal() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let mut terminate = {
        let _inside = runtime.enter();
        tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?
    };
    std::thread::spawn(move || {
        runtime.block_on(async {
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
        });
        flag.store(true, Ordering::Relaxed);
    });
    Ok(stop)
}

fn flight_bar(duration_s: f64) -> ProgressBar {
    bar(duration_s as u64, "flying {pos}/{len} s")
}

fn bar(length: u64, words: &str) -> ProgressBar {
    let template = format!("{{bar:40}} {words}");
    let style =
        ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length).with_style(style)
}
