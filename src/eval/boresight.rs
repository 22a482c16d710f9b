//! How well a flight past a surveyed board shows a mount that is off by three degrees and a clock that
//! is off by 300 ms.
//!
//! **In:** a mission with a board in its world (`missions/marker.toml`), flown and rendered with several
//! seeds, each with another mount error of three degrees. **Out:** `calibration.boresight_error_deg` and
//! `calibration.clock_error_ms`, the worst of the flights, and each flight as a row. The board is found
//! in the rendered pictures as [`crate::boresight`] finds it in real ones; nothing of the truth is used
//! but the board's place, which a survey gives.

use super::{Report, Table};
use crate::boresight::{Gathered, Marker, Parameter, Picker, Solution, Start, gather, solve};
use crate::mission::Mission;
use emberfix_calib::solve::Board;
use emberfix_frames::{
    EllipsoidHeight, MountAngles, UnitQuaternion, body_from_camera, rotation_matrix,
};
use emberfix_report::{Bound, Figure};
use emberfix_sim::mission::Mission as SimMission;
use emberfix_sim::world::BoardConfig;
use nalgebra::{Matrix3, Rotation3};
use std::path::Path;

/// What is flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// Flights, each with another seed and another mount.
    pub flights: u32,
    /// Seed of the first.
    pub seed: u64,
}

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
pub enum BoresightEvalError {
    /// The simulator's view of the mission.
    #[error(transparent)]
    Simulator(#[from] emberfix_sim::mission::MissionError),
    /// Its world.
    #[error(transparent)]
    World(#[from] emberfix_sim::world::WorldError),
    /// The service's view of it.
    #[error(transparent)]
    Mission(#[from] crate::mission::MissionError),
    /// The flight could not be recorded.
    #[error(transparent)]
    Record(#[from] emberfix_sim::stream::StreamError),
    /// Or not be read again.
    #[error(transparent)]
    Read(#[from] crate::ingest::SourceError),
    /// No place for the recording.
    #[error("a file for the recording: {source}")]
    File {
        /// What the system said.
        #[from]
        source: std::io::Error,
    },
    /// The mission's world has no board.
    #[error("{path}: [[sim.world.boards]] names no board to calibrate by")]
    NoBoard {
        /// The mission.
        path: String,
    },
    /// Not a board that can be looked for.
    #[error(transparent)]
    Board(#[from] emberfix_calib::solve::BoardError),
}

/// How far the mount is off in every flight, degrees.
pub const MOUNT_OFF_DEG: f64 = 3.0;
/// How early the camera's stamps are, seconds.
pub const CLOCK_OFF_S: f64 = 0.3;
/// Sigma of the survey, metres.
const SURVEY_M: f64 = 0.02;

/// One flight's result.
struct Flown {
    seed: u64,
    gathered: Gathered,
    found: Option<Found>,
}

struct Found {
    boresight_deg: f64,
    clock_ms: f64,
    solution: Solution,
}

/// Flies, calibrates, compares. `tell` hears how many flights are done.
///
/// # Errors
/// [`BoresightEvalError`] when a flight can't be flown; one that does not calibrate is a result.
pub fn measure(
    path: &Path,
    options: Options,
    tell: &mut dyn FnMut(u32),
) -> Result<Report, BoresightEvalError> {
    let mut flown = Vec::new();
    for flight in 0..options.flights {
        flown.push(fly(path, options.seed + u64::from(flight), flight)?);
        tell(flight + 1);
    }
    Ok(report(&flown))
}

fn fly(path: &Path, seed: u64, flight: u32) -> Result<Flown, BoresightEvalError> {
    let mut sim = SimMission::load(&path.to_string_lossy())?;
    sim.sim.seed = seed;
    sim.sim.camera.mount_error_deg = [0.0; 3];
    sim.sim.errors.camera_offset_s = -CLOCK_OFF_S;
    // The service believes the rig file; the truth is turned by three degrees about another axis each time.
    let mount = turned(sim.rig.mount(), axis_of(flight));
    let was = sim.rig.mount();
    sim.sim.camera.mount_error_deg = [
        mount.yaw_rad - was.yaw_rad,
        mount.depression_rad - was.depression_rad,
        mount.roll_rad - was.roll_rad,
    ]
    .map(f64::to_degrees);
    let (world, course) = emberfix_sim::setup(&sim)?;
    let scratch = Scratch::new(seed);
    let writer = std::io::BufWriter::new(std::fs::File::create(&scratch.0)?);
    let errors = sim.sim.errors.clone();
    emberfix_sim::record::record(&sim, &world, &course, &errors, writer, |_| {})?;

    let mission = Mission::load(&sim.path)?;
    let no_board = || BoresightEvalError::NoBoard {
        path: path.display().to_string(),
    };
    let laid = sim.sim.world.boards.first().ok_or_else(no_board)?;
    let board = Board::parse(
        &format!("{}x{}", laid.columns, laid.rows),
        laid.square_m,
        None,
    )?;
    let marker = surveyed(&sim, laid).ok_or_else(no_board)?;
    let start = Start::of(&mission, Some(marker));
    let gathered = gather(
        &scratch.0,
        &mission,
        &start,
        Picker::Board(board),
        &mut |_| {},
    )?;
    let found = solve(&start, &gathered.sights).ok().map(|solution| Found {
        boresight_deg: apart(solution.mount, mount).to_degrees(),
        clock_ms: (solution.clock_s() - CLOCK_OFF_S).abs() * 1e3,
        solution,
    });
    Ok(Flown {
        seed,
        gathered,
        found,
    })
}

/// A recording that goes when it was looked at.
struct Scratch(std::path::PathBuf);

impl Scratch {
    fn new(seed: u64) -> Self {
        let name = format!("emberfix-boresight-{}-{seed}.mcap", std::process::id());
        Self(std::env::temp_dir().join(name))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // What can't be removed the system clears away.
        let _removed = std::fs::remove_file(&self.0);
    }
}

/// Place of the board's printed side, as a survey gives it.
fn surveyed(sim: &SimMission, board: &BoardConfig) -> Option<Marker> {
    let plane = emberfix_sim::earth::TangentPlane::at(sim.datum);
    let up_m = sim.sim.world.terrain_up_m + BoardConfig::THICKNESS_M;
    let lla = plane.to_lla(nalgebra::Vector3::new(board.east_m, board.north_m, up_m));
    let height = EllipsoidHeight::from_m(lla.height_m);
    let place =
        emberfix_frames::place_from_degrees(lla.latitude_deg, lla.longitude_deg, height).ok()?;

    Some(Marker {
        place,
        sigma_m: SURVEY_M,
    })
}

/// Axes all over the sphere, in body components: a golden spiral.
fn axis_of(flight: u32) -> nalgebra::Vector3<f64> {
    let turn = f64::from(flight) * 2.399_963;
    let z = 0.8 - 0.6 * f64::from(flight % 4);
    let flat = (1.0 - z * z).max(0.0).sqrt();
    nalgebra::Vector3::new(flat * turn.cos(), flat * turn.sin(), z)
}

fn matrix(mount: MountAngles) -> Matrix3<f64> {
    rotation_matrix(&body_from_camera::<emberfix_frames::CamLeftRaw>(mount))
}

/// The mount turned about a body axis by [`MOUNT_OFF_DEG`].
fn turned(mount: MountAngles, axis: nalgebra::Vector3<f64>) -> MountAngles {
    let turn = UnitQuaternion::from_scaled_axis(axis.normalize() * MOUNT_OFF_DEG.to_radians());
    crate::boresight::mount_of(&(turn.to_rotation_matrix().into_inner() * matrix(mount)))
}

/// Angle between two mounts, radians.
fn apart(a: MountAngles, b: MountAngles) -> f64 {
    Rotation3::from_matrix_unchecked(matrix(a).transpose() * matrix(b)).angle()
}

fn report(flown: &[Flown]) -> Report {
    let found: Vec<&Found> = flown
        .iter()
        .filter_map(|flight| flight.found.as_ref())
        .collect();
    // A flight that shows nothing is a failure, not a smaller sample.
    let worst = |of: fn(&Found) -> f64| {
        (found.len() == flown.len() && !found.is_empty())
            .then(|| found.iter().map(|found| of(found)).fold(0.0, f64::max))
    };
    let figures = vec![
        Figure::bounded(
            "calibration.boresight_error_deg",
            worst(|found| found.boresight_deg),
            "deg",
            Bound::AtMost(0.1),
            flown.len(),
        ),
        Figure::bounded(
            "calibration.clock_error_ms",
            worst(|found| found.clock_ms),
            "ms",
            Bound::AtMost(5.0),
            flown.len(),
        ),
    ];
    let table = Table {
        title: format!(
            "Boresight: {MOUNT_OFF_DEG} degrees and {:.0} ms off, rendered flights past a surveyed board",
            CLOCK_OFF_S * 1e3
        ),
        header: [
            "seed",
            "pairs",
            "seen",
            "used",
            "mount off by (deg)",
            "one sigma",
            "clock off by (ms)",
            "one sigma",
            "left over (px)",
        ]
        .map(str::to_owned)
        .to_vec(),
        rows: flown.iter().map(row).collect(),
    };
    Report {
        figures,
        details: serde_json::json!({ "flights": flown.iter().map(row).collect::<Vec<_>>() }),
        tables: vec![table],
        plots: Vec::new(),
    }
}

fn row(flight: &Flown) -> Vec<String> {
    let mut row = vec![
        flight.seed.to_string(),
        flight.gathered.pairs.to_string(),
        flight.gathered.seen.to_string(),
    ];
    match &flight.found {
        Some(found) => row.extend([
            found.solution.used.to_string(),
            format!("{:.3}", found.boresight_deg),
            format!("{:.3}", found.solution.boresight_sigma().to_degrees()),
            format!("{:.2}", found.clock_ms),
            format!(
                "{:.2}",
                found.solution.sigma(Parameter::Clock as usize) * 1e3
            ),
            format!("{:.2}", found.solution.rms_px),
        ]),
        None => row.extend(["0"; 6].map(str::to_owned)),
    }
    row
}
