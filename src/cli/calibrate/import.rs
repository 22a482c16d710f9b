//! `emberfix calibrate import`: a rig from another program's file.

use super::mounting::{Known, MountingArguments};
use crate::cli::Failure;
use emberfix_calib::RigParts;
use emberfix_calib::exchange::{Answers, ImuAxes, LengthUnit, import as read};
use std::path::PathBuf;

/// A rig from a file of Kalibr, ROS, OpenCV or DepthAI.
#[derive(Debug, clap::Args)]
pub struct ImportArguments {
    /// Kalibr camchain, ROS camera_info (left and right), OpenCV FileStorage (YAML, XML; one or more), or
    /// DepthAI EEPROM (JSON); told apart by what stands in them.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Rig file to write.
    #[arg(long)]
    out: PathBuf,
    /// Name of the rig; the file's own if not given.
    #[arg(long)]
    name: Option<String>,
    /// One sigma of the disparity offset that this calibration leaves, pixels; 0.3 if nobody knows.
    #[arg(long)]
    disparity_bias_px: f64,
    /// Unit of T in an OpenCV file: that of its squares.
    #[arg(long, value_enum)]
    translation_unit: Option<Unit>,
    /// Size of the images of an OpenCV file, such as 1280x720.
    #[arg(long, value_parser = size)]
    image_size: Option<(u32, u32)>,
    /// Axes of the IMU of Kalibr's T_cam_imu, which must be the autopilot's.
    #[arg(long, value_enum)]
    imu_axes: Option<Axes>,
    /// Print the rig as JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    mounting: MountingArguments,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Unit {
    /// Metres.
    M,
    /// Millimetres.
    Mm,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Axes {
    /// Forward, right, down: PX4.
    Frd,
    /// Forward, left, up: ROS.
    Flu,
}

fn size(text: &str) -> Result<(u32, u32), String> {
    let wrong = || format!("{text:?} is no size such as 1280x720");
    let (width, height) = text.split_once('x').ok_or_else(wrong)?;
    let number = |text: &str| text.parse().map_err(|_| wrong());
    Ok((number(width)?, number(height)?))
}

/// Reads, asks, checks, writes.
pub fn import(arguments: &ImportArguments) -> Result<(), Failure> {
    let answers = Answers {
        translation_unit: arguments.translation_unit.map(|unit| match unit {
            Unit::M => LengthUnit::Metre,
            Unit::Mm => LengthUnit::Millimetre,
        }),
        image_size_px: arguments.image_size,
        imu_axes: arguments.imu_axes.map(|axes| match axes {
            Axes::Frd => ImuAxes::Frd,
            Axes::Flu => ImuAxes::Flu,
        }),
    };
    let found = read(&arguments.files, answers).map_err(Failure::refused)?;
    let asked = arguments.mounting.ask(&Known {
        angles: found.mount.map(|(angles, _)| angles),
        lever_arm_m: found.mount.map(|(_, arm)| arm),
        time_offset_s: found.time_offset_s,
    })?;
    let parts = RigParts {
        name: arguments.name.clone().unwrap_or(found.name),
        left: found.left,
        right: found.right,
        right_from_left: found.right_from_left,
        translation_m: found.translation_m,
        max_skew_s: asked.max_skew_s,
        disparity_bias_px: arguments.disparity_bias_px,
        mounting: asked.mounting,
        calibrated: None,
    };
    let rig = parts.check(&arguments.out).map_err(Failure::refused)?;
    super::write(&arguments.out, &parts.to_toml())?;
    for note in &found.notes {
        eprintln!("note: {note}");
    }
    for doubt in rig.doubts() {
        eprintln!("doubt: {doubt}");
    }
    super::tell_rig(&rig, arguments.json);
    Ok(())
}
