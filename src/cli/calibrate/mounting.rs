//! What no picture tells: how the camera stands on the airframe. It is asked for, never assumed.

use crate::cli::Failure;
use emberfix_calib::{Mounting, Rig};
use emberfix_frames::{MountAngles, Vector3};
use std::path::PathBuf;

/// The mount, either from a rig that has it already, or number by number.
#[derive(Debug, Clone, clap::Args)]
pub struct MountingArguments {
    /// Rig file whose mount, lever arm, time offset and their sigmas stay as they are.
    #[arg(long, value_name = "RIG", help_heading = MOUNT)]
    like: Option<PathBuf>,
    /// Boresight to the right of the nose, degrees.
    #[arg(long, allow_hyphen_values = true, help_heading = MOUNT)]
    yaw_deg: Option<f64>,
    /// Boresight below the nose, degrees.
    #[arg(long, allow_hyphen_values = true, help_heading = MOUNT)]
    depression_deg: Option<f64>,
    /// Camera turned clockwise about its boresight, seen from behind, degrees.
    #[arg(long, allow_hyphen_values = true, help_heading = MOUNT)]
    roll_deg: Option<f64>,
    /// From the autopilot's IMU to the left camera: forward,right,down in metres.
    #[arg(long, value_name = "F,R,D", value_delimiter = ',', num_args = 1,
        allow_hyphen_values = true, help_heading = MOUNT)]
    lever_arm_m: Option<Vec<f64>>,
    /// Autopilot time = camera time + this, seconds.
    #[arg(long, allow_hyphen_values = true, help_heading = MOUNT)]
    camera_offset_s: Option<f64>,
    /// One sigma of the boresight, degrees; 2 is a mount that was measured by hand.
    #[arg(long, help_heading = MOUNT)]
    boresight_sigma_deg: Option<f64>,
    /// One sigma of the lever arm, metres; 0.02 is a ruler.
    #[arg(long, help_heading = MOUNT)]
    lever_arm_sigma_m: Option<f64>,
    /// One sigma of the time offset, seconds; 0.05 is a guess.
    #[arg(long, help_heading = MOUNT)]
    time_offset_sigma_s: Option<f64>,
    /// The right eye sees near infrared.
    #[arg(long, help_heading = MOUNT)]
    right_near_infrared: bool,
    /// Greatest difference of the eyes' exposures that is one moment, seconds.
    #[arg(long, help_heading = MOUNT)]
    max_skew_s: Option<f64>,
}

const MOUNT: &str = "What the file or the pictures can't tell";

/// What a source knew of the mount by itself.
#[derive(Debug, Clone, Copy, Default)]
pub struct Known {
    /// Boresight.
    pub angles: Option<MountAngles>,
    /// Lever arm, metres, forward, right, down.
    pub lever_arm_m: Option<Vector3<f64>>,
    /// Autopilot time = camera time + this, seconds.
    pub time_offset_s: Option<f64>,
}

/// A mount, and the greatest skew.
#[derive(Debug, Clone)]
pub struct Asked {
    /// The mount.
    pub mounting: Mounting,
    /// Greatest difference of exposures, seconds.
    pub max_skew_s: f64,
}

impl MountingArguments {
    /// The mount; every number that is missing is named with its flag.
    pub fn ask(&self, known: &Known) -> Result<Asked, Failure> {
        let like = match &self.like {
            Some(path) => Some(Rig::load(path).map_err(Failure::refused)?),
            None => None,
        };
        let like = like
            .as_ref()
            .map(|rig| (Mounting::of(rig), rig.max_skew_s()));
        let mut missing = Vec::new();
        let mut number = |given: Option<f64>, known: Option<f64>, like: Option<f64>, flag| {
            given.or(known).or(like).unwrap_or_else(|| {
                missing.push(flag);
                0.0
            })
        };
        let of = |pick: fn(&Mounting) -> f64| like.as_ref().map(|(mounting, _)| pick(mounting));
        let angle = |pick: fn(&MountAngles) -> f64| known.angles.as_ref().map(pick);
        let radians = |degrees: Option<f64>| degrees.map(f64::to_radians);
        let angles = MountAngles {
            yaw_rad: number(
                radians(self.yaw_deg),
                angle(|m| m.yaw_rad),
                of(|m| m.angles.yaw_rad),
                "--yaw-deg",
            ),
            depression_rad: number(
                radians(self.depression_deg),
                angle(|m| m.depression_rad),
                of(|m| m.angles.depression_rad),
                "--depression-deg",
            ),
            roll_rad: number(
                radians(self.roll_deg),
                angle(|m| m.roll_rad),
                of(|m| m.angles.roll_rad),
                "--roll-deg",
            ),
        };
        let given_arm = self.given_lever_arm()?;
        let arm = |axis: usize| given_arm.map(|arm| arm[axis]);
        let known_arm = |axis: usize| known.lever_arm_m.map(|arm| arm[axis]);
        let lever_arm_m = Vector3::new(
            number(
                arm(0),
                known_arm(0),
                of(|m| m.lever_arm_m.x),
                "--lever-arm-m",
            ),
            number(
                arm(1),
                known_arm(1),
                of(|m| m.lever_arm_m.y),
                "--lever-arm-m",
            ),
            number(
                arm(2),
                known_arm(2),
                of(|m| m.lever_arm_m.z),
                "--lever-arm-m",
            ),
        );
        let mounting = Mounting {
            angles,
            lever_arm_m,
            time_offset_s: number(
                self.camera_offset_s,
                known.time_offset_s,
                of(|m| m.time_offset_s),
                "--camera-offset-s",
            ),
            boresight_sigma_rad: number(
                radians(self.boresight_sigma_deg),
                None,
                of(|m| m.boresight_sigma_rad),
                "--boresight-sigma-deg",
            ),
            lever_arm_sigma_m: number(
                self.lever_arm_sigma_m,
                None,
                of(|m| m.lever_arm_sigma_m),
                "--lever-arm-sigma-m",
            ),
            time_offset_sigma_s: number(
                self.time_offset_sigma_s,
                None,
                of(|m| m.time_offset_sigma_s),
                "--time-offset-sigma-s",
            ),
            right_near_infrared: self.right_near_infrared
                || like
                    .as_ref()
                    .is_some_and(|(mounting, _)| mounting.right_near_infrared),
        };
        let max_skew_s = number(
            self.max_skew_s,
            None,
            like.as_ref().map(|(_, skew)| *skew),
            "--max-skew-s",
        );
        missing.dedup();
        if missing.is_empty() {
            return Ok(Asked {
                mounting,
                max_skew_s,
            });
        }
        Err(Failure::Refused(anyhow::anyhow!(
            "how the camera stands on the airframe is not in there: give {}, or --like RIG to take them \
             from a rig file",
            missing.join(", ")
        )))
    }

    fn given_lever_arm(&self) -> Result<Option<Vector3<f64>>, Failure> {
        let Some(arm) = &self.lever_arm_m else {
            return Ok(None);
        };
        let [forward, right, down] = arm.as_slice() else {
            return Err(Failure::Refused(anyhow::anyhow!(
                "--lever-arm-m has {} numbers, needed are 3: forward,right,down in metres",
                arm.len()
            )));
        };
        Ok(Some(Vector3::new(*forward, *right, *down)))
    }
}
