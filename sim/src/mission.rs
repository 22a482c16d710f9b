//! What the simulator reads of a mission file: the places where the service listens, and `[sim]`.
//!
//! The rest of the file is the service's and is not looked at; `[sim]` is ours, and a key in it that
//! nothing reads is refused.

use crate::autopilot::{AutopilotConfig, ErrorsConfig};
use crate::earth::Lla;
use crate::flight::{FlightConfig, PathConfig};
use crate::spectrometer::SpectrometerConfig;
use crate::world::WorldConfig;
use emberfix_calib::{Rig, RigError};
use emberfix_frames::ServiceTime;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Why a mission can't be flown.
#[derive(Debug, thiserror::Error)]
pub enum MissionError {
    /// No such file, by path or by name.
    #[error("mission {path}: {source}; missions are files such as missions/gaochun.toml", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, a key is missing, unknown, or of the wrong type.
    #[error("mission {path}: {source}", path = path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What the TOML reader said.
        source: Box<toml::de::Error>,
    },
    /// Values that no flight has.
    #[error("mission {path}: {}", problems.join("; "), path = path.display())]
    Values {
        /// The file.
        path: PathBuf,
        /// One sentence per problem: key, value, allowed.
        problems: Vec<String>,
    },
    /// The rig that the mission names.
    #[error("mission {path}: {source}", path = path.display())]
    Rig {
        /// The mission file.
        path: PathBuf,
        /// What is wrong with the rig.
        source: RigError,
    },
}

/// A mission as the simulator flies it.
#[derive(Debug, Clone)]
pub struct Mission {
    /// File that it came from.
    pub path: PathBuf,
    /// Name for reports.
    pub name: String,
    /// The cameras.
    pub rig: Rig,
    /// Origin of the simulated world's plane.
    pub datum: Lla,
    /// MAVLink system id of the vehicle.
    pub system_id: u8,
    /// Where the service takes MAVLink, as the service's URL says it.
    pub mavlink_url: String,
    /// Where the service takes stereo pairs, as the service's URL says it.
    pub camera_url: String,
    /// The simulation.
    pub sim: SimConfig,
}

/// `[sim]`.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimConfig {
    /// Seed of everything random.
    pub seed: u64,
    /// Greatest mean horizontal error that the demo accepts with the mission's sensor errors, metres.
    #[serde(default)]
    pub horizontal_error_bound_m: Option<f64>,
    /// When a recorded flight begins, RFC 3339.
    pub start_utc: String,
    /// The way.
    pub flight: FlightConfig,
    /// The cameras' timing.
    pub camera: CameraConfig,
    /// The autopilot's clock and home.
    #[serde(default)]
    pub autopilot: AutopilotConfig,
    /// How wrong the sensors are.
    #[serde(default)]
    pub errors: ErrorsConfig,
    /// A spectrometer in step with the frames, if there is one.
    #[serde(default)]
    pub spectrometer: Option<SpectrometerConfig>,
    /// What is there.
    pub world: WorldConfig,
}

/// `[sim.camera]`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Pairs per second.
    pub rate_hz: f64,
    /// JPEG quality, 1 to 100.
    #[serde(default = "default_quality")]
    pub jpeg_quality: u8,
    /// From mid-exposure to the pair's arrival, seconds.
    #[serde(default = "default_latency_s")]
    pub latency_s: f64,
    /// How the camera truly stands, beyond what the rig file says: yaw, depression, roll.
    #[serde(default)]
    pub mount_error_deg: [f64; 3],
}

fn default_quality() -> u8 {
    92
}

fn default_latency_s() -> f64 {
    0.035
}

#[derive(Deserialize)]
struct RawMission {
    name: String,
    rig: PathBuf,
    datum: RawDatum,
    #[serde(default)]
    vehicle: RawVehicle,
    mavlink: RawUrl,
    camera: RawUrl,
    sim: SimConfig,
}

#[derive(Deserialize)]
struct RawDatum {
    latitude_deg: f64,
    longitude_deg: f64,
    height_ellipsoid_m: f64,
}

#[derive(Deserialize)]
struct RawVehicle {
    system_id: u8,
}

impl Default for RawVehicle {
    fn default() -> Self {
        Self { system_id: 1 }
    }
}

#[derive(Deserialize)]
struct RawUrl {
    url: String,
}

impl Mission {
    /// Reads the mission `name_or_path`: a file, or the name of one in `missions/`.
    ///
    /// # Errors
    /// [`MissionError`] that names the file and what is wrong in it.
    pub fn load(name_or_path: &str) -> Result<Self, MissionError> {
        let path = resolve(name_or_path);
        let text = std::fs::read_to_string(&path).map_err(|source| MissionError::Read {
            path: path.clone(),
            source,
        })?;
        Self::parse(&text, &path)
    }

    /// Reads a mission from its text; `path` is where relative paths in it start.
    ///
    /// # Errors
    /// As [`Mission::load`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, MissionError> {
        let raw: RawMission = toml::from_str(text).map_err(|source| MissionError::Syntax {
            path: path.to_owned(),
            source: Box::new(source),
        })?;
        let problems = problems(&raw);
        if !problems.is_empty() {
            return Err(MissionError::Values {
                path: path.to_owned(),
                problems,
            });
        }
        let rig_path = path.parent().unwrap_or(Path::new("")).join(&raw.rig);
        let rig = Rig::load(&rig_path).map_err(|source| MissionError::Rig {
            path: path.to_owned(),
            source,
        })?;
        Ok(Self {
            path: path.to_owned(),
            name: raw.name,
            rig,
            datum: Lla {
                latitude_deg: raw.datum.latitude_deg,
                longitude_deg: raw.datum.longitude_deg,
                height_m: raw.datum.height_ellipsoid_m,
            },
            system_id: raw.vehicle.system_id,
            mavlink_url: raw.mavlink.url,
            camera_url: raw.camera.url,
            sim: raw.sim,
        })
    }

    /// When a recorded flight begins.
    #[must_use]
    pub fn start(&self) -> ServiceTime {
        // Checked when the mission was read.
        ServiceTime::from_rfc3339(&self.sim.start_utc).unwrap_or(ServiceTime::from_unix_ns(0))
    }
}

/// A file as given, or `missions/NAME.toml` here, or beside the workspace that built us.
fn resolve(name_or_path: &str) -> PathBuf {
    let given = PathBuf::from(name_or_path);
    if given.exists() {
        return given;
    }
    let named = format!("missions/{name_or_path}.toml");
    let built = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("..")
        .join(&named);
    [PathBuf::from(named), built]
        .into_iter()
        .find(|path| path.exists())
        .unwrap_or(given)
}

/// Collects "key is value, allowed is range"; NaN is always out.
#[derive(Default)]
struct Checks(Vec<String>);

impl Checks {
    fn range(&mut self, key: &str, value: f64, low: f64, high: f64) {
        if !(low..=high).contains(&value) {
            self.0
                .push(format!("{key} is {value}, allowed is {low} to {high}"));
        }
    }
}

fn problems(raw: &RawMission) -> Vec<String> {
    let mut checks = Checks::default();
    checks.range("datum.latitude_deg", raw.datum.latitude_deg, -90.0, 90.0);
    checks.range(
        "datum.longitude_deg",
        raw.datum.longitude_deg,
        -360.0,
        360.0,
    );
    checks.range(
        "datum.height_ellipsoid_m",
        raw.datum.height_ellipsoid_m,
        -500.0,
        9000.0,
    );
    check_sim(&mut checks, &raw.sim);
    check_errors(&mut checks, &raw.sim.errors);
    check_path(&mut checks, &raw.sim.flight.path);
    checks.0
}

fn check_sim(checks: &mut Checks, sim: &SimConfig) {
    if ServiceTime::from_rfc3339(&sim.start_utc).is_none() {
        checks.0.push(format!(
            "sim.start_utc is {:?}, allowed is a time such as 2026-03-01T12:00:00Z",
            sim.start_utc
        ));
    }
    checks.range("sim.flight.duration_s", sim.flight.duration_s, 1.0, 3600.0);
    let gusts = &sim.flight.gusts;
    checks.range("sim.flight.gusts.sigma_deg", gusts.sigma_deg, 0.0, 15.0);
    checks.range(
        "sim.flight.gusts.correlation_s",
        gusts.correlation_s,
        0.2,
        60.0,
    );
    checks.range(
        "sim.flight.gusts.vibration_deg",
        gusts.vibration_deg,
        0.0,
        1.0,
    );
    checks.range("sim.camera.rate_hz", sim.camera.rate_hz, 0.1, 60.0);
    checks.range(
        "sim.camera.jpeg_quality",
        f64::from(sim.camera.jpeg_quality),
        1.0,
        100.0,
    );
    checks.range("sim.camera.latency_s", sim.camera.latency_s, 0.0, 2.0);
    for (axis, error) in sim.camera.mount_error_deg.iter().enumerate() {
        let key = format!("sim.camera.mount_error_deg[{axis}]");
        checks.range(&key, *error, -45.0, 45.0);
    }
    checks.range(
        "sim.autopilot.booted_before_s",
        sim.autopilot.booted_before_s,
        0.0,
        4e6,
    );
    checks.range(
        "sim.autopilot.clock_drift_ppm",
        sim.autopilot.clock_drift_ppm,
        -200.0,
        200.0,
    );
    if let Some(undulation_m) = sim.autopilot.undulation_m {
        checks.range("sim.autopilot.undulation_m", undulation_m, -110.0, 90.0);
    }
}

fn check_errors(checks: &mut Checks, errors: &ErrorsConfig) {
    let mut within = |key: &str, value, high| {
        checks.range(&format!("sim.errors.{key}"), value, 0.0, high);
    };
    within(
        "gnss_horizontal_sigma_m",
        errors.gnss_horizontal_sigma_m,
        100.0,
    );
    within("gnss_vertical_sigma_m", errors.gnss_vertical_sigma_m, 100.0);
    within("gnss_white_sigma_m", errors.gnss_white_sigma_m, 10.0);
    within("velocity_sigma_m_s", errors.velocity_sigma_m_s, 10.0);
    within(
        "heading_constant_sigma_deg",
        errors.heading_constant_sigma_deg,
        30.0,
    );
    within(
        "heading_slow_sigma_deg",
        errors.heading_slow_sigma_deg,
        30.0,
    );
    within("tilt_sigma_deg", errors.tilt_sigma_deg, 30.0);
    within("message_latency_s", errors.message_latency_s, 1.0);
    within("message_jitter_s", errors.message_jitter_s, 1.0);
    within("camera_jitter_s", errors.camera_jitter_s, 1.0);
    checks.range(
        "sim.errors.camera_offset_s",
        errors.camera_offset_s,
        -2.0,
        2.0,
    );
    checks.range("sim.errors.correlation_s", errors.correlation_s, 1.0, 1e5);
}

fn check_path(checks: &mut Checks, path: &PathConfig) {
    match path {
        PathConfig::Patrol {
            waypoints_m,
            speed_m_s,
            laps,
            ..
        } => {
            checks.range("sim.flight.path.laps", f64::from(*laps), 1.0, 1e3);
            checks.range("sim.flight.path.speed_m_s", *speed_m_s, 0.5, 60.0);
            checks.range(
                "sim.flight.path.waypoints_m (count)",
                waypoints_m.len() as f64,
                2.0,
                1e4,
            );
            let way_back = (*laps > 1).then_some(waypoints_m.first()).flatten();
            let lap: Vec<_> = waypoints_m.iter().chain(way_back).collect();
            for (leg, ends) in lap.windows(2).enumerate() {
                let apart = (0..3)
                    .map(|i| (ends[1][i] - ends[0][i]).powi(2))
                    .sum::<f64>()
                    .sqrt();
                checks.range(
                    &format!("sim.flight.path.waypoints_m leg {leg}"),
                    apart,
                    0.5,
                    1e5,
                );
            }
        }
        PathConfig::Orbit {
            radius_m,
            height_above_ground_m,
            speed_m_s,
            ..
        } => {
            checks.range("sim.flight.path.speed_m_s", *speed_m_s, 0.5, 60.0);
            checks.range("sim.flight.path.radius_m", *radius_m, 5.0, 5000.0);
            checks.range(
                "sim.flight.path.height_above_ground_m",
                *height_above_ground_m,
                1.0,
                5000.0,
            );
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::flight::GustConfig;

    pub(crate) fn waypoint_flight() -> FlightConfig {
        let waypoints_m = vec![
            [0.0, -50.0, 15.0],
            [5.0, 0.0, 9.0],
            [15.0, 35.0, 11.0],
            [-10.0, 40.0, 12.0],
            [-6.0, -20.0, 8.0],
        ];
        FlightConfig {
            duration_s: 40.0,
            path: PathConfig::Patrol {
                waypoints_m,
                speed_m_s: 5.5,
                laps: 1,
                look_at_m: None,
            },
            gusts: GustConfig::calm(),
        }
    }

    fn file(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../missions")
            .join(name)
    }

    #[test]
    fn both_missions_of_the_project_can_be_flown() {
        for name in ["gaochun", "orbit"] {
            let mission = Mission::load(file(&format!("{name}.toml")).to_str().unwrap()).unwrap();
            assert_eq!(mission.name, name);
            assert!(mission.start().unix_ns() > 0);
        }
    }

    #[test]
    fn an_unknown_key_in_sim_is_refused_by_name() {
        let text = std::fs::read_to_string(file("gaochun.toml")).unwrap();
        let text = text.replace(
            "[sim.errors]",
            "[sim.errors]\ngnss_horisontal_sigma_m = 1.0",
        );
        let error = Mission::parse(&text, &file("gaochun.toml"))
            .unwrap_err()
            .to_string();
        assert!(error.contains("gnss_horisontal_sigma_m"), "{error}");
    }

    #[test]
    fn every_value_out_of_range_is_named_at_once() {
        let text = std::fs::read_to_string(file("gaochun.toml")).unwrap();
        let text = text
            .replace("rate_hz = ", "rate_hz = -")
            .replace("latitude_deg = ", "latitude_deg = 9");
        let error = Mission::parse(&text, &file("gaochun.toml"))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("sim.camera.rate_hz") && error.contains("datum.latitude_deg"),
            "{error}"
        );
    }
}
