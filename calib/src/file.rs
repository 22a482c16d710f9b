//! The rig file: raw TOML to a checked [`Rig`], every problem at once.

use crate::inverse_depth::{OFFSETS_PER_M, SCALES};
use crate::{
    Calibrated, Camera, Checks, Finding, InverseDepth, KeyProblem, Rectification, Rig, RigSigmas,
    Severity, implausible, toml_problem, unknown_keys,
};
use emberfix_frames::{Metres, MountAngles, Vector, Vector3};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Why a rig file was refused.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The file can't be read.
    #[error("rig {path}: {source}; an example is calib/rigs/oakd-75mm.toml", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, or a value of the wrong type.
    #[error("rig {path}: {message}", path = path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What the TOML reader said.
        message: String,
    },
    /// Values that no rig has, and keys that nothing reads.
    #[error("rig {path}: {}", problems.join("; "), path = path.display())]
    Values {
        /// The file.
        path: PathBuf,
        /// One sentence per problem: key, value, allowed range, remedy.
        problems: Vec<String>,
    },
    /// OpenCV can't rectify this geometry.
    #[error("rig {path}: rectification failed: {source}", path = path.display())]
    Rectify {
        /// The file.
        path: PathBuf,
        /// What OpenCV said.
        source: opencv::Error,
    },
}

#[derive(Deserialize)]
struct RawRig {
    name: String,
    left: RawCamera,
    right: RawCamera,
    stereo: RawStereo,
    mount: RawMount,
    time: RawTime,
    sigma: RawSigma,
    #[serde(default)]
    inverse_depth: RawInverseDepth,
    calibrated: Option<RawCalibrated>,
}

#[derive(Deserialize)]
struct RawCamera {
    image_size_px: [u32; 2],
    focal_px: [f64; 2],
    principal_point_px: [f64; 2],
    distortion: Vec<f64>,
    /// Only of the right eye: the left one sees colour, or there are no flames to find.
    #[serde(default)]
    near_infrared: bool,
}

#[derive(Deserialize)]
struct RawStereo {
    right_from_left_rotation_deg: [f64; 3],
    right_from_left_translation_m: [f64; 3],
    max_skew_s: f64,
}

#[derive(Deserialize)]
struct RawMount {
    yaw_deg: f64,
    depression_deg: f64,
    roll_deg: f64,
    lever_arm_m: [f64; 3],
}

#[derive(Deserialize)]
struct RawTime {
    camera_offset_s: f64,
    #[serde(default)]
    rolling_readout_s: f64,
}

#[derive(Deserialize)]
struct RawSigma {
    disparity_bias_px: f64,
    boresight_deg: f64,
    lever_arm_m: f64,
    time_offset_s: f64,
}

#[derive(Deserialize)]
#[serde(default)]
struct RawInverseDepth {
    scale: f64,
    offset_per_m: f64,
    covariance: [f64; 3],
}

impl Default for RawInverseDepth {
    fn default() -> Self {
        let plain = InverseDepth::default();
        Self {
            scale: plain.scale,
            offset_per_m: plain.offset_per_m,
            covariance: plain.covariance,
        }
    }
}

#[derive(Deserialize)]
struct RawCalibrated {
    at: String,
    pairs: usize,
    rms_px: f64,
    held_out_rms_px: f64,
    range_sigma_at_10m_percent: f64,
}

const KNOWN: &[&str] = &[
    "name",
    "left.image_size_px",
    "left.focal_px",
    "left.principal_point_px",
    "left.distortion",
    "right.image_size_px",
    "right.focal_px",
    "right.principal_point_px",
    "right.distortion",
    "right.near_infrared",
    "stereo.right_from_left_rotation_deg",
    "stereo.right_from_left_translation_m",
    "stereo.max_skew_s",
    "mount.yaw_deg",
    "mount.depression_deg",
    "mount.roll_deg",
    "mount.lever_arm_m",
    "time.camera_offset_s",
    "time.rolling_readout_s",
    "sigma.disparity_bias_px",
    "sigma.boresight_deg",
    "sigma.lever_arm_m",
    "sigma.time_offset_s",
    "inverse_depth.scale",
    "inverse_depth.offset_per_m",
    "inverse_depth.covariance",
    "calibrated.at",
    "calibrated.pairs",
    "calibrated.rms_px",
    "calibrated.held_out_rms_px",
    "calibrated.range_sigma_at_10m_percent",
];

pub(crate) fn load(path: &Path) -> Result<Rig, RigError> {
    let text = std::fs::read_to_string(path).map_err(|source| RigError::Read {
        path: path.to_owned(),
        source,
    })?;
    parse(&text, path)
}

pub(crate) fn parse(text: &str, path: &Path) -> Result<Rig, RigError> {
    let syntax = |error: toml::de::Error| RigError::Syntax {
        path: path.to_owned(),
        message: toml_problem(text, &error),
    };
    let table: toml::Table = toml::from_str(text).map_err(syntax)?;
    let unknown: Vec<String> = unknown_keys(&table, KNOWN)
        .iter()
        .map(KeyProblem::to_string)
        .collect();
    let raw: RawRig = match toml::from_str(text) {
        Ok(raw) => raw,
        // A misspelt key is also a missing one: name the misspelling, it is what helps.
        Err(_) if !unknown.is_empty() => return Err(values(path, unknown)),
        Err(error) => return Err(syntax(error)),
    };
    let mut problems = unknown;
    problems.extend(check(&raw));
    if !problems.is_empty() {
        return Err(values(path, problems));
    }
    build(raw, path)
}

fn values(path: &Path, problems: Vec<String>) -> RigError {
    RigError::Values {
        path: path.to_owned(),
        problems,
    }
}

fn check(raw: &RawRig) -> Vec<String> {
    let mut checks = Checks::new();
    if raw.name.trim().is_empty() {
        checks.problem(format!(
            "name is {:?}, needed is a word for reports",
            raw.name
        ));
    }
    check_camera(&mut checks, "left", &raw.left);
    check_camera(&mut checks, "right", &raw.right);
    if raw.left.image_size_px != raw.right.image_size_px {
        checks.problem(format!(
            "right.image_size_px is {:?}, left.image_size_px is {:?}; both eyes need one size",
            raw.right.image_size_px, raw.left.image_size_px
        ));
    }
    check_stereo(&mut checks, &raw.stereo);
    check_mount(&mut checks, &raw.mount);
    checks.range(
        "time.camera_offset_s",
        raw.time.camera_offset_s,
        -2.0,
        2.0,
        " (seconds)",
    );
    checks.range(
        "time.rolling_readout_s",
        raw.time.rolling_readout_s,
        0.0,
        0.2,
        " (0 is a global shutter)",
    );
    let sigma = &raw.sigma;
    checks.range(
        "sigma.disparity_bias_px",
        sigma.disparity_bias_px,
        0.0,
        20.0,
        "",
    );
    checks.range("sigma.boresight_deg", sigma.boresight_deg, 0.0, 45.0, "");
    checks.range("sigma.lever_arm_m", sigma.lever_arm_m, 0.0, 5.0, "");
    checks.range("sigma.time_offset_s", sigma.time_offset_s, 0.0, 2.0, "");
    check_inverse_depth(&mut checks, &raw.inverse_depth);
    checks.into_problems()
}

fn check_inverse_depth(checks: &mut Checks, raw: &RawInverseDepth) {
    let (scales, offsets) = (SCALES, OFFSETS_PER_M);
    checks.range("inverse_depth.scale", raw.scale, scales.0, scales.1, "");
    checks.range(
        "inverse_depth.offset_per_m",
        raw.offset_per_m,
        offsets.0,
        offsets.1,
        "",
    );
    let [scale, both, offset] = raw.covariance;
    checks.range("inverse_depth.covariance[0]", scale, 0.0, 1.0, "");
    checks.range("inverse_depth.covariance[2]", offset, 0.0, 1.0, "");
    let most = (scale * offset).max(0.0).sqrt() * (1.0 + 1e-2);
    checks.range("inverse_depth.covariance[1]", both, -most, most, "");
}

fn check_camera(checks: &mut Checks, eye: &str, camera: &RawCamera) {
    let [width, height] = camera.image_size_px.map(f64::from);
    checks.range(&format!("{eye}.image_size_px[0]"), width, 64.0, 8192.0, "");
    checks.range(&format!("{eye}.image_size_px[1]"), height, 64.0, 8192.0, "");
    for (axis, focal) in camera.focal_px.iter().enumerate() {
        checks.range(
            &format!("{eye}.focal_px[{axis}]"),
            *focal,
            0.1 * width,
            20.0 * width,
            " (pixels, not mm)",
        );
    }
    let [cx, cy] = camera.principal_point_px;
    checks.range(
        &format!("{eye}.principal_point_px[0]"),
        cx,
        0.0,
        width - 1.0,
        "",
    );
    checks.range(
        &format!("{eye}.principal_point_px[1]"),
        cy,
        0.0,
        height - 1.0,
        "",
    );
    if camera.distortion.len() != 5 {
        checks.problem(format!(
            "{eye}.distortion has {} terms, needed are 5 (k1, k2, p1, p2, k3)",
            camera.distortion.len()
        ));
    }
    for (term, value) in camera.distortion.iter().enumerate() {
        checks.range(
            &format!("{eye}.distortion[{term}]"),
            *value,
            -10.0,
            10.0,
            "",
        );
    }
}

fn check_stereo(checks: &mut Checks, stereo: &RawStereo) {
    for (axis, angle) in stereo.right_from_left_rotation_deg.iter().enumerate() {
        let key = format!("stereo.right_from_left_rotation_deg[{axis}]");
        checks.range(&key, *angle, -30.0, 30.0, " (degrees)");
    }
    let [x, y, z] = stereo.right_from_left_translation_m;
    checks.range(
        "stereo.max_skew_s",
        stereo.max_skew_s,
        0.0,
        0.1,
        " (seconds)",
    );
    if x > 0.0 {
        checks.problem(format!(
            "stereo.right_from_left_translation_m[0] is {x}, allowed is below 0: the eyes are \
             swapped, or the translation is that of left from right"
        ));
        return;
    }
    let baseline = Vector3::new(x, y, z).norm();
    let baseline_hint = " (the baseline in metres, not mm)";
    checks.range(
        "stereo.right_from_left_translation_m",
        baseline,
        0.005,
        5.0,
        baseline_hint,
    );
    checks.range(
        "stereo.right_from_left_translation_m[1]",
        y,
        x,
        -x,
        " (eyes one above the other)",
    );
}

fn check_mount(checks: &mut Checks, mount: &RawMount) {
    checks.range("mount.yaw_deg", mount.yaw_deg, -180.0, 180.0, "");
    checks.range(
        "mount.depression_deg",
        mount.depression_deg,
        -90.0,
        90.0,
        " (positive below the nose)",
    );
    checks.range("mount.roll_deg", mount.roll_deg, -180.0, 180.0, "");
    for (axis, arm) in mount.lever_arm_m.iter().enumerate() {
        checks.range(
            &format!("mount.lever_arm_m[{axis}]"),
            *arm,
            -20.0,
            20.0,
            " (metres)",
        );
    }
}

fn build(raw: RawRig, path: &Path) -> Result<Rig, RigError> {
    let (left, right) = (camera(&raw.left), camera(&raw.right));
    let turn = Vector3::from(raw.stereo.right_from_left_rotation_deg).map(f64::to_radians);
    let right_from_left = emberfix_frames::UnitQuaternion::from_scaled_axis(turn)
        .to_rotation_matrix()
        .into_inner();
    let translation_m = Vector3::from(raw.stereo.right_from_left_translation_m);
    let rectification = Rectification::new(&left, &right, &right_from_left, &translation_m)
        .map_err(|source| RigError::Rectify {
            path: path.to_owned(),
            source,
        })?;
    let findings = implausible(&left, &right, &rectification, &translation_m);
    if findings
        .iter()
        .any(|found| found.severity == Severity::Refusal)
    {
        return Err(values(
            path,
            findings.iter().map(Finding::to_string).collect(),
        ));
    }
    Ok(Rig {
        right_near_infrared: raw.right.near_infrared,
        name: raw.name,
        left,
        right,
        right_from_left,
        translation_m,
        mount: MountAngles {
            yaw_rad: raw.mount.yaw_deg.to_radians(),
            depression_rad: raw.mount.depression_deg.to_radians(),
            roll_rad: raw.mount.roll_deg.to_radians(),
        },
        lever_arm: Vector::from_metres(Vector3::from(raw.mount.lever_arm_m)),
        time_offset_s: raw.time.camera_offset_s,
        rolling_readout_s: raw.time.rolling_readout_s,
        max_skew_s: raw.stereo.max_skew_s,
        sigmas: RigSigmas {
            disparity_bias_px: raw.sigma.disparity_bias_px,
            boresight_rad: raw.sigma.boresight_deg.to_radians(),
            lever_arm_m: raw.sigma.lever_arm_m,
            time_offset_s: raw.sigma.time_offset_s,
        },
        inverse_depth: InverseDepth {
            scale: raw.inverse_depth.scale,
            offset_per_m: raw.inverse_depth.offset_per_m,
            covariance: raw.inverse_depth.covariance,
        },
        rectification,
        calibrated: raw.calibrated.map(calibrated),
        doubts: findings,
    })
}

fn calibrated(raw: RawCalibrated) -> Calibrated {
    Calibrated {
        at: raw.at,
        pairs: raw.pairs,
        rms_px: raw.rms_px,
        held_out_rms_px: raw.held_out_rms_px,
        range_sigma_at_10m_percent: raw.range_sigma_at_10m_percent,
    }
}

fn camera(raw: &RawCamera) -> Camera {
    let [width, height] = raw.image_size_px;
    let mut distortion = [0.0; 5];
    for (term, value) in distortion.iter_mut().zip(&raw.distortion) {
        *term = *value;
    }
    Camera {
        image_size_px: (width, height),
        focal_px: (raw.focal_px[0], raw.focal_px[1]),
        principal_point_px: (raw.principal_point_px[0], raw.principal_point_px[1]),
        distortion,
    }
}
