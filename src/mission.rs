//! The mission file: which rig, model, terrain, thresholds and links a flight uses.
//!
//! Raw TOML to a checked [`Mission`], every problem at once. Relative paths are relative to the
//! mission file. The `[sim]` table belongs to the simulator and is not read here.

use crate::detect::{ClassPolicy, DetectorConfig, Family, ModelForm, Provider, YoloxOutput};
use crate::locate::{SharedPriors, Terrain};
use crate::pose::PoseConfig;
use crate::range::{HsvMask, Method, RangeConfig};
use crate::track::TrackConfig;
use emberfix_calib::{Checks, KeyProblem, Rig, RigError, toml_problem, unknown_keys};
use emberfix_frames::{EllipsoidHeight, Wgs84, place_from_degrees};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod gimbal;
mod links;
mod right_eye;
mod terrain;

pub use links::{GroundLinks, MavlinkSigning, load_signing_key};
use links::{RawGround, RawMavlink};
pub use right_eye::RightEyeConfig;

/// Why a mission file was refused.
#[derive(Debug, thiserror::Error)]
pub enum MissionError {
    /// The file can't be read.
    #[error("mission {path}: {source}; examples are missions/gaochun.toml, missions/orbit.toml",
        path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, or a value of the wrong type.
    #[error("mission {path}: {message}", path = path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What the TOML reader said.
        message: String,
    },
    /// Values that no mission has, and keys that nothing reads.
    #[error("mission {path}: {}", problems.join("; "), path = path.display())]
    Values {
        /// The file.
        path: PathBuf,
        /// One sentence per problem: key, value, allowed range, nearest known key.
        problems: Vec<String>,
    },
    /// The rig that it names was refused.
    #[error("mission {path}: {source}", path = path.display())]
    Rig {
        /// The mission file.
        path: PathBuf,
        /// Why.
        source: RigError,
    },
}

/// A checked mission.
#[derive(Clone)]
pub struct Mission {
    /// Name, for reports.
    pub name: String,
    /// Name of the aircraft, as alarms carry it.
    pub uav: String,
    /// The stereo rig.
    pub rig: Arc<Rig>,
    /// The file that it stands in.
    pub rig_path: PathBuf,
    /// Origin of the mission's tangent plane.
    pub datum: Wgs84,
    /// MAVLink system of the vehicle; 0 takes the first autopilot that is heard.
    pub system_id: u8,
    /// Where MAVLink comes from.
    pub mavlink_url: String,
    /// How MAVLink is signed, if it is.
    pub mavlink_signing: Option<MavlinkSigning>,
    /// Where stereo pairs come from.
    pub camera_url: String,
    /// The detector.
    pub detector: DetectorConfig,
    /// The right eye's detector, where that eye sees another spectrum.
    pub right_eye: Option<RightEyeConfig>,
    /// How ranges are measured.
    pub range_method: Method,
    /// Numbers of ranging.
    pub range: RangeConfig,
    /// The ground, if the mission knows it.
    pub terrain: Option<Arc<dyn Terrain>>,
    /// Defaults and limits of the pose.
    pub pose: PoseConfig,
    /// What is known beforehand of the errors that all sightings share.
    pub shared: SharedPriors,
    /// The tracker.
    pub track: TrackConfig,
    /// The ground agent.
    pub ground: GroundLinks,
    /// Where the outbox lies.
    pub state_dir: PathBuf,
    /// What alarms are signed with; by default `uav.key` in the state folder. Made when it is not there.
    pub key_path: Option<PathBuf>,
}

#[derive(Deserialize)]
struct RawMission {
    name: String,
    uav: String,
    rig: PathBuf,
    datum: RawPlace,
    #[serde(default)]
    vehicle: RawVehicle,
    mavlink: RawMavlink,
    camera: RawUrl,
    model: RawModel,
    right_model: Option<RawModel>,
    fusion: Option<right_eye::RawFusion>,
    #[serde(default)]
    range: RawRange,
    terrain: Option<terrain::RawTerrain>,
    gimbal: Option<gimbal::RawGimbal>,
    #[serde(default)]
    sigma: RawSigma,
    #[serde(default)]
    track: RawTrack,
    #[serde(default)]
    ground: RawGround,
    #[serde(default)]
    state: RawState,
}

#[derive(Deserialize)]
struct RawPlace {
    latitude_deg: f64,
    longitude_deg: f64,
    height_ellipsoid_m: f64,
}

#[derive(Deserialize, Default)]
struct RawVehicle {
    #[serde(default)]
    system_id: u8,
}

#[derive(Deserialize)]
struct RawUrl {
    url: String,
}

#[derive(Deserialize)]
struct RawModel {
    path: PathBuf,
    sha256: Option<String>,
    family: Option<Family>,
    names: Option<Vec<String>>,
    #[serde(default)]
    classes: BTreeMap<String, ClassPolicy>,
    yolox_output: Option<YoloxOutput>,
    anchors: Option<Vec<[[f32; 2]; 3]>>,
    providers: Option<Vec<Provider>>,
    threshold: Option<f64>,
    #[serde(default)]
    whole_frame_only: bool,
    tile_px: Option<u32>,
    overlap_px: Option<u32>,
    frame_budget_ms: Option<f64>,
    threads: Option<u32>,
    second_look: Option<bool>,
}

#[derive(Deserialize, Default)]
struct RawRange {
    method: Option<String>,
    mask: Option<String>,
    max_disparity_px: Option<u32>,
    max_sigma_over_range: Option<f64>,
}

#[derive(Deserialize)]
#[serde(default)]
struct RawSigma {
    gnss_horizontal_m: f64,
    gnss_vertical_m: f64,
    gnss_floor_m: f64,
    heading_deg: f64,
    tilt_deg: f64,
    gnss_constant_share: f64,
    gnss_correlation_s: f64,
    velocity_m_s: f64,
    velocity_correlation_s: f64,
    heading_constant_share: f64,
    heading_correlation_s: f64,
    tilt_constant_share: f64,
    tilt_correlation_s: f64,
}

impl Default for RawSigma {
    fn default() -> Self {
        let (pose, shared) = (PoseConfig::default(), SharedPriors::default());
        Self {
            gnss_horizontal_m: pose.gnss_horizontal_m,
            gnss_vertical_m: pose.gnss_vertical_m,
            gnss_floor_m: pose.gnss_floor_m,
            heading_deg: shared.heading_rad.to_degrees(),
            tilt_deg: shared.tilt_rad.to_degrees(),
            gnss_constant_share: shared.gnss_constant_share,
            gnss_correlation_s: shared.gnss_correlation_s,
            velocity_m_s: shared.velocity_m_s,
            velocity_correlation_s: shared.velocity_correlation_s,
            heading_constant_share: shared.heading_constant_share,
            heading_correlation_s: shared.heading_correlation_s,
            tilt_constant_share: shared.tilt_constant_share,
            tilt_correlation_s: shared.tilt_correlation_s,
        }
    }
}

#[derive(Deserialize)]
#[serde(default)]
struct RawTrack {
    confirm_sightings: u32,
    confirm_span_s: f64,
    forget_suspected_s: f64,
}

impl Default for RawTrack {
    fn default() -> Self {
        let track = TrackConfig::default();
        Self {
            confirm_sightings: track.confirm_sightings,
            confirm_span_s: track.confirm_span_s,
            forget_suspected_s: track.forget_suspected_s,
        }
    }
}

#[derive(Deserialize, Default)]
struct RawState {
    dir: Option<PathBuf>,
    key: Option<PathBuf>,
}

const KNOWN: &[&str] = &[
    "name",
    "uav",
    "rig",
    "datum.latitude_deg",
    "datum.longitude_deg",
    "datum.height_ellipsoid_m",
    "vehicle.system_id",
    "mavlink.url",
    "mavlink.signing_key",
    "mavlink.unsigned_ids",
    "camera.url",
    "model.path",
    "model.sha256",
    "model.family",
    "model.names",
    "model.classes.*",
    "model.yolox_output",
    "model.anchors",
    "model.providers",
    "model.threshold",
    "model.whole_frame_only",
    "model.tile_px",
    "model.overlap_px",
    "model.frame_budget_ms",
    "model.threads",
    "model.second_look",
    "right_model.path",
    "right_model.sha256",
    "right_model.family",
    "right_model.names",
    "right_model.classes.*",
    "right_model.yolox_output",
    "right_model.anchors",
    "right_model.providers",
    "right_model.threshold",
    "right_model.whole_frame_only",
    "right_model.tile_px",
    "right_model.overlap_px",
    "right_model.frame_budget_ms",
    "right_model.threads",
    "fusion.agree_giou",
    "fusion.contend_giou",
    "fusion.one_sided",
    "fusion.right_trust",
    "fusion.threshold",
    "range.mask",
    "range.max_disparity_px",
    "range.max_sigma_over_range",
    "range.method",
    "terrain.kind",
    "terrain.height_ellipsoid_m",
    "terrain.sigma_m",
    "terrain.paths",
    "terrain.vertical_datum",
    "terrain.horizontal_sigma_m",
    "terrain.canopy_m",
    "terrain.reach_m",
    "gimbal.pivot_m",
    "gimbal.component_id",
    "gimbal.device_id",
    "gimbal.sigma_deg",
    "sigma.gnss_horizontal_m",
    "sigma.gnss_vertical_m",
    "sigma.gnss_floor_m",
    "sigma.heading_deg",
    "sigma.tilt_deg",
    "sigma.gnss_constant_share",
    "sigma.gnss_correlation_s",
    "sigma.velocity_m_s",
    "sigma.velocity_correlation_s",
    "sigma.heading_constant_share",
    "sigma.heading_correlation_s",
    "sigma.tilt_constant_share",
    "sigma.tilt_correlation_s",
    "track.confirm_sightings",
    "track.confirm_span_s",
    "track.forget_suspected_s",
    "ground.url",
    "ground.ca",
    "ground.token_file",
    "ground.certificate",
    "ground.key",
    "ground.datagrams",
    "ground.public_key",
    "ground.agent_system_id",
    "ground.agent_component_id",
    "state.dir",
    "state.key",
    "sim.*",
];

impl Mission {
    /// Where the key is that alarms are signed with.
    #[must_use]
    pub fn key_file(&self) -> PathBuf {
        self.key_path
            .clone()
            .unwrap_or_else(|| self.state_dir.join("uav.key"))
    }

    /// Reads and checks a mission file and the rig that it names.
    ///
    /// # Errors
    /// [`MissionError`] naming the file and every problem.
    pub fn load(path: &Path) -> Result<Self, MissionError> {
        let text = std::fs::read_to_string(path).map_err(|source| MissionError::Read {
            path: path.to_owned(),
            source,
        })?;
        let raw = parse(&text, path)?;
        build(raw, path)
    }
}

fn parse(text: &str, path: &Path) -> Result<RawMission, MissionError> {
    let syntax = |error: toml::de::Error| MissionError::Syntax {
        path: path.to_owned(),
        message: toml_problem(text, &error),
    };
    let values = |problems| MissionError::Values {
        path: path.to_owned(),
        problems,
    };
    let table: toml::Table = toml::from_str(text).map_err(syntax)?;
    let unknown: Vec<String> = unknown_keys(&table, KNOWN)
        .iter()
        .map(KeyProblem::to_string)
        .collect();
    let raw: RawMission = match toml::from_str(text) {
        Ok(raw) => raw,
        Err(_) if !unknown.is_empty() => return Err(values(unknown)),
        Err(error) => return Err(syntax(error)),
    };
    let mut problems = unknown;
    problems.extend(check(&raw));
    if problems.is_empty() {
        Ok(raw)
    } else {
        Err(values(problems))
    }
}

fn check(raw: &RawMission) -> Vec<String> {
    let mut checks = Checks::new();
    let name_is_fit = |name: &str| {
        (1..=32).contains(&name.len())
            && name
                .chars()
                .all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
    };
    for (key, name) in [("name", &raw.name), ("uav", &raw.uav)] {
        if !name_is_fit(name) {
            checks.problem(format!(
                "{key} is {name:?}, allowed are 1 to 32 letters, digits, - and _"
            ));
        }
    }
    checks.range(
        "datum.latitude_deg",
        raw.datum.latitude_deg,
        -90.0,
        90.0,
        "",
    );
    checks.range(
        "datum.longitude_deg",
        raw.datum.longitude_deg,
        -180.0,
        180.0,
        "",
    );
    checks.range(
        "datum.height_ellipsoid_m",
        raw.datum.height_ellipsoid_m,
        -500.0,
        9000.0,
        "",
    );
    check_numbers(&mut checks, raw);
    if let Some(terrain) = &raw.terrain {
        terrain.check(&mut checks);
    }
    if let Some(gimbal) = &raw.gimbal {
        gimbal.check(&mut checks);
    }
    check_sigma(&mut checks, &raw.sigma);
    raw.ground.check(&mut checks);
    checks.range(
        "track.confirm_sightings",
        f64::from(raw.track.confirm_sightings),
        2.0,
        100.0,
        "",
    );
    checks.range(
        "track.confirm_span_s",
        raw.track.confirm_span_s,
        0.0,
        60.0,
        "",
    );
    checks.range(
        "track.forget_suspected_s",
        raw.track.forget_suspected_s,
        1.0,
        3600.0,
        "",
    );
    checks.into_problems()
}

/// What the rooms check themselves, with the mission's key in front.
fn check_numbers(checks: &mut Checks, raw: &RawMission) {
    let model = detector(&raw.model, &Path::to_owned).problems();
    let range = range(&raw.range).problems();
    model
        .into_iter()
        .for_each(|problem| checks.problem(format!("model.{problem}")));
    right_eye::check(checks, raw.right_model.as_ref(), raw.fusion.as_ref());
    for problem in range {
        // The mission says what the number is for, the matcher what OpenCV calls it.
        let problem = problem.replace("num_disparities", "max_disparity_px");
        checks.problem(format!("range.{problem}"));
    }
    check_range_names(checks, &raw.range);
}

fn check_sigma(checks: &mut Checks, sigma: &RawSigma) {
    checks.range(
        "sigma.gnss_horizontal_m",
        sigma.gnss_horizontal_m,
        0.005,
        100.0,
        "",
    );
    checks.range(
        "sigma.gnss_vertical_m",
        sigma.gnss_vertical_m,
        0.005,
        100.0,
        "",
    );
    checks.range("sigma.gnss_floor_m", sigma.gnss_floor_m, 0.001, 100.0, "");
    checks.range(
        "sigma.heading_deg",
        sigma.heading_deg,
        0.01,
        180.0,
        " (degrees)",
    );
    checks.range("sigma.tilt_deg", sigma.tilt_deg, 0.01, 45.0, " (degrees)");
    for (key, share) in [
        ("sigma.gnss_constant_share", sigma.gnss_constant_share),
        ("sigma.heading_constant_share", sigma.heading_constant_share),
        ("sigma.tilt_constant_share", sigma.tilt_constant_share),
    ] {
        checks.range(key, share, 0.0, 1.0, " (of the variance)");
    }
    for (key, seconds) in [
        ("sigma.gnss_correlation_s", sigma.gnss_correlation_s),
        ("sigma.heading_correlation_s", sigma.heading_correlation_s),
        ("sigma.tilt_correlation_s", sigma.tilt_correlation_s),
    ] {
        checks.range(key, seconds, 1.0, 1e6, "");
    }
    checks.range("sigma.velocity_m_s", sigma.velocity_m_s, 0.01, 10.0, "");
    let correlation_s = sigma.velocity_correlation_s;
    checks.range("sigma.velocity_correlation_s", correlation_s, 0.01, 1e4, "");
}

fn build(raw: RawMission, path: &Path) -> Result<Mission, MissionError> {
    let beside = |relative: &Path| path.parent().unwrap_or(Path::new(".")).join(relative);
    let rig = Rig::load(&beside(&raw.rig)).map_err(|source| MissionError::Rig {
        path: path.to_owned(),
        source,
    })?;
    let datum = place_from_degrees(
        raw.datum.latitude_deg,
        raw.datum.longitude_deg,
        EllipsoidHeight::from_m(raw.datum.height_ellipsoid_m),
    )
    .map_err(|error| MissionError::Values {
        path: path.to_owned(),
        problems: vec![format!("datum: {error}")],
    })?;
    let terrain = raw
        .terrain
        .as_ref()
        .map(|terrain| terrain.build(&datum, &beside))
        .transpose()
        .map_err(|problems| MissionError::Values {
            path: path.to_owned(),
            problems,
        })?;
    let mavlink_signing = raw
        .mavlink
        .signing(&beside)
        .map_err(|problem| MissionError::Values {
            path: path.to_owned(),
            problems: vec![problem],
        })?;
    let ground = raw
        .ground
        .build(&beside)
        .map_err(|problems| MissionError::Values {
            path: path.to_owned(),
            problems,
        })?;
    let state_dir = raw
        .state
        .dir
        .as_deref()
        .map_or_else(|| Path::new(".emberfix").join(&raw.name), beside);
    Ok(Mission {
        detector: DetectorConfig {
            second_look: raw.model.second_look.unwrap_or(true),
            ..detector(&raw.model, &beside)
        },
        right_eye: right_eye::right_eye(raw.right_model.as_ref(), raw.fusion.as_ref(), &beside),
        range_method: method(&raw.range).unwrap_or_default(),
        range: range(&raw.range),
        pose: PoseConfig {
            gnss_horizontal_m: raw.sigma.gnss_horizontal_m,
            gnss_vertical_m: raw.sigma.gnss_vertical_m,
            gnss_floor_m: raw.sigma.gnss_floor_m,
            rolling_readout_s: rig.rolling_readout_s(),
            gimbal: raw.gimbal.as_ref().map(gimbal::RawGimbal::build),
            ..PoseConfig::default()
        },
        shared: SharedPriors {
            gnss_constant_share: raw.sigma.gnss_constant_share,
            gnss_correlation_s: raw.sigma.gnss_correlation_s,
            velocity_m_s: raw.sigma.velocity_m_s,
            velocity_correlation_s: raw.sigma.velocity_correlation_s,
            heading_rad: raw.sigma.heading_deg.to_radians(),
            heading_constant_share: raw.sigma.heading_constant_share,
            heading_correlation_s: raw.sigma.heading_correlation_s,
            tilt_rad: (raw.sigma.tilt_deg.to_radians()).hypot(
                raw.gimbal
                    .as_ref()
                    .map_or(0.0, gimbal::RawGimbal::sigma_rad),
            ),
            tilt_constant_share: raw.sigma.tilt_constant_share,
            tilt_correlation_s: raw.sigma.tilt_correlation_s,
        },
        track: TrackConfig {
            confirm_sightings: raw.track.confirm_sightings,
            confirm_span_s: raw.track.confirm_span_s,
            forget_suspected_s: raw.track.forget_suspected_s,
        },
        ground,
        mavlink_signing,
        key_path: raw.state.key.as_deref().map(beside),
        name: raw.name,
        uav: raw.uav,
        rig_path: beside(&raw.rig),
        rig: Arc::new(rig),
        datum,
        system_id: raw.vehicle.system_id,
        mavlink_url: raw.mavlink.url,
        camera_url: raw.camera.url,
        terrain,
        state_dir,
    })
}

fn detector(raw: &RawModel, beside: &dyn Fn(&Path) -> PathBuf) -> DetectorConfig {
    let usual = DetectorConfig::new(beside(&raw.path));
    let mut classes = usual.classes.clone();
    classes.extend(raw.classes.clone());
    DetectorConfig {
        sha256: raw.sha256.clone(),
        family: raw.family,
        names: raw.names.clone(),
        classes,
        form: ModelForm {
            yolox_output: raw.yolox_output,
            anchors: raw.anchors.clone(),
        },
        providers: raw.providers.clone().unwrap_or(usual.providers.clone()),
        threshold: raw.threshold,
        tile_px: if raw.whole_frame_only {
            None
        } else {
            raw.tile_px.or(usual.tile_px)
        },
        overlap_px: raw.overlap_px.unwrap_or(usual.overlap_px),
        frame_budget_ms: raw.frame_budget_ms,
        threads: raw
            .threads
            .map_or(usual.threads, |threads| threads as usize),
        ..usual
    }
}

/// Methods and masks are named, not numbered.
fn check_range_names(checks: &mut Checks, raw: &RawRange) {
    let methods = Method::ALL.map(Method::name).join(", ");
    for (key, named, known, allowed) in [
        (
            "method",
            &raw.method,
            method(raw).is_some(),
            methods.as_str(),
        ),
        ("mask", &raw.mask, mask(raw).is_some(), "flame, printed"),
    ] {
        if let (Some(name), false) = (named, known) {
            checks.problem(format!("range.{key} is {name:?}, allowed are {allowed}"));
        }
    }
}

fn method(raw: &RawRange) -> Option<Method> {
    raw.method.as_deref().and_then(Method::from_name)
}

fn mask(raw: &RawRange) -> Option<HsvMask> {
    match raw.mask.as_deref()? {
        "flame" => Some(HsvMask::flame()),
        "printed" => Some(HsvMask::printed()),
        _ => None,
    }
}

fn range(raw: &RawRange) -> RangeConfig {
    let usual = RangeConfig::default();
    RangeConfig {
        mask: mask(raw).unwrap_or(usual.mask),
        num_disparities: raw.max_disparity_px.unwrap_or(usual.num_disparities),
        max_sigma_over_range: raw
            .max_sigma_over_range
            .unwrap_or(usual.max_sigma_over_range),
        ..usual
    }
}
