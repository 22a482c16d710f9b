//! Arguments to work: parse, wire, exit.
//!
//! Exit codes: 0 done, 1 failed while running, 2 refused (arguments, configuration, model,
//! calibration, recording). What went wrong is one line on standard error that says what to do.

mod calibrate;
mod doctor;
mod eval;
mod keys;
mod replay;
mod run;

use crate::detect::{self, BoxFileDetector, Detector};
use crate::mission::Mission;
use crate::pipeline::RightEye;
use clap::{Parser, Subcommand};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Finds fire from a UAV's stereo camera and tells the ground where it is, and how sure.
#[derive(Debug, Parser)]
#[command(name = "emberfix", version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Runs the service: MAVLink and camera in, alarms out.
    Run(run::RunArguments),
    /// Runs a recording (or a .tlog) through the service; the same bytes come out each time.
    Replay(replay::ReplayArguments),
    /// Runs the ground station: receives, keeps and shows alarms.
    Ground(GroundArguments),
    /// Makes the aircraft's key where there is none, and prints the public one.
    Keys(keys::KeysArguments),
    /// Checks everything before take-off: a table of pass, warn, fail, with remedies.
    Doctor(doctor::DoctorArguments),
    /// Calibrates a rig, or brings one in from another program's file.
    #[command(subcommand)]
    Calibrate(calibrate::Calibrate),
    /// Measures the service against truth.
    #[command(subcommand)]
    Eval(eval::Eval),
}

#[derive(Debug, clap::Args)]
struct GroundArguments {
    /// Configuration, such as missions/ground.toml.
    config: PathBuf,
    /// Address to listen on instead of the configured one.
    #[arg(long)]
    listen: Option<std::net::SocketAddr>,
    /// Folder for what must survive instead of the configured one.
    #[arg(long)]
    data: Option<PathBuf>,
    /// MAVLink URL instead of the configured one.
    #[arg(long)]
    mavlink: Option<String>,
}

/// How a command ended, when it did not end well.
pub(crate) enum Failure {
    /// Refused before any work: exit code 2.
    Refused(anyhow::Error),
    /// Failed while running: exit code 1.
    Failed(anyhow::Error),
}

impl Failure {
    pub(crate) fn refused(error: impl Into<anyhow::Error>) -> Self {
        Self::Refused(error.into())
    }
    pub(crate) fn failed(error: impl Into<anyhow::Error>) -> Self {
        Self::Failed(error.into())
    }
}

/// The whole program.
#[must_use]
pub fn main() -> ExitCode {
    let arguments = Arguments::parse();
    tracing_subscriber::fmt()
        .with_env_filter(
            tracing_subscriber::EnvFilter::try_from_env("EMBERFIX_LOG")
                .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(usual_log(&arguments))),
        )
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .init();
    let done = match arguments.command {
        Command::Run(arguments) => run::run(arguments),
        Command::Replay(arguments) => replay::replay(&arguments),
        Command::Ground(arguments) => ground(arguments),
        Command::Keys(arguments) => keys::keys(arguments),
        Command::Doctor(arguments) => doctor::doctor(&arguments),
        Command::Calibrate(what) => calibrate::calibrate(&what),
        Command::Eval(what) => eval::eval(&what),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure::Refused(error)) => {
            eprintln!("emberfix: {}", in_one_line(&error));
            ExitCode::from(2)
        }
        Err(Failure::Failed(error)) => {
            eprintln!("emberfix: {}", in_one_line(&error));
            ExitCode::FAILURE
        }
    }
}

/// What is logged when nobody says: the doctor tells what is wrong in its own words.
fn usual_log(arguments: &Arguments) -> &'static str {
    match arguments.command {
        Command::Doctor(_) => "off",
        _ => "info,ort=warn,async_nats=warn",
    }
}

/// An error and what caused it, leaving out causes that it has told already.
fn in_one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if line.is_empty() {
            line = cause;
        } else if !line.contains(&cause) {
            line = format!("{line}: {cause}");
        }
    }
    line.replace('\n', " ")
}

/// The mission's model, or given boxes in its place.
pub(crate) fn detector(
    mission: &Mission,
    boxes: Option<&Path>,
) -> Result<Box<dyn Detector>, Failure> {
    Ok(match boxes {
        Some(path) => Box::new(BoxFileDetector::load(path).map_err(Failure::refused)?),
        None => detect::open(&mission.detector).map_err(Failure::refused)?,
    })
}

/// The right eye's model, where the mission has one.
pub(crate) fn right_eye(mission: &Mission) -> Result<Option<RightEye>, Failure> {
    let Some(config) = &mission.right_eye else {
        return Ok(None);
    };
    let detector = detect::open(&config.detector).map_err(Failure::refused)?;
    Ok(Some(RightEye::new(detector, config.fusion)))
}

/// A runtime for the commands that talk.
pub(crate) fn runtime() -> Result<tokio::runtime::Runtime, Failure> {
    tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(Failure::failed)
}

fn ground(arguments: GroundArguments) -> Result<(), Failure> {
    let overrides = crate::ground::Overrides {
        listen: arguments.listen,
        data_dir: arguments.data,
        mavlink_url: arguments.mavlink,
    };
    let ended = runtime()?.block_on(crate::ground::run(&arguments.config, overrides));
    ended.map_err(|error| {
        if error.is_refusal() {
            Failure::refused(error)
        } else {
            Failure::failed(error)
        }
    })
}
