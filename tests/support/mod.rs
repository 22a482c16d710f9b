//! What every test of whole programs starts from: a scratch folder with a plain rig and mission, and
//! the real `emberfix`.

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// The project's folder.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// What one run of a program said and how it ended.
#[derive(Debug)]
pub struct Said {
    /// Exit code.
    pub code: i32,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

impl Said {
    /// Of a finished program.
    pub fn of(output: &Output) -> Self {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Self {
            code: output.status.code().unwrap_or(-1),
            out: text(&output.stdout),
            err: text(&output.stderr),
        }
    }

    /// Standard output as JSON, of a program that did its work.
    pub fn json(&self) -> Value {
        assert_eq!(self.code, 0, "{}{}", self.out, self.err);
        serde_json::from_str(&self.out).unwrap()
    }
}

/// The real program, ready to be given arguments; it logs no more than warnings.
pub fn emberfix() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_emberfix"));
    command
        .current_dir(root())
        .env("EMBERFIX_LOG", "warn")
        .stdin(Stdio::null());
    command
}

/// A folder of its own for one test, gone when the test is.
pub struct Scratch {
    folder: tempfile::TempDir,
}

impl Scratch {
    /// Holds `rig.toml` (no distortion, 30 degrees down, 300 mm) and `mission.toml`, which names a
    /// model that is not there: give `--boxes`, or name another.
    pub fn new() -> Self {
        let scratch = Self {
            folder: tempfile::tempdir().unwrap(),
        };
        scratch.write("rig.toml", PLAIN_RIG);
        scratch.write("mission.toml", PLAIN_MISSION);
        scratch
    }

    /// A path in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a file into the folder.
    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }
}

/// A rig whose pixels can be worked out by hand.
pub const PLAIN_RIG: &str = r#"
name = "plain"
[left]
image_size_px = [640, 360]
focal_px = [440.0, 440.0]
principal_point_px = [319.5, 179.5]
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[right]
image_size_px = [640, 360]
focal_px = [440.0, 440.0]
principal_point_px = [319.5, 179.5]
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[stereo]
right_from_left_rotation_deg = [0.0, 0.0, 0.0]
right_from_left_translation_m = [-0.3, 0.0, 0.0]
max_skew_s = 0.001
[mount]
yaw_deg = 0.0
depression_deg = 30.0
roll_deg = 0.0
lever_arm_m = [0.0, 0.0, 0.0]
[time]
camera_offset_s = 0.0
[sigma]
disparity_bias_px = 0.1
boresight_deg = 0.1
lever_arm_m = 0.01
time_offset_s = 0.002
"#;

/// Where P3's fire stood.
pub const PLAIN_MISSION: &str = r#"
name = "plain"
uav = "uav-1"
rig = "rig.toml"
[datum]
latitude_deg = 31.409422
longitude_deg = 119.112017
height_ellipsoid_m = 11.0
[vehicle]
system_id = 1
[mavlink]
url = "udpin:127.0.0.1:14540"
[camera]
url = "tcp-listen:127.0.0.1:14600"
[model]
path = "no-model.onnx"
"#;
