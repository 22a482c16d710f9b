//! `emberfix calibrate WHAT`: solves for a rig, or brings one in.

mod boresight;
mod export;
mod import;
mod mounting;
mod pairs;
mod range;
mod stereo;

use super::Failure;
use emberfix_calib::{Eye, Rig};
use std::path::Path;

/// What can be calibrated.
#[derive(Debug, clap::Subcommand)]
pub enum Calibrate {
    /// Both eyes and the pair, from pictures of a board.
    Stereo(Box<stereo::StereoArguments>),
    /// A rig from a file of Kalibr, ROS, OpenCV or DepthAI.
    Import(import::ImportArguments),
    /// A rig as a file for ROS or OpenCV.
    Export(export::ExportArguments),
    /// How the camera sits on the airframe and how late its clock is, from a flight.
    Boresight(boresight::BoresightArguments),
    /// Scale and offset of inverse depth, from known distances.
    Range(range::RangeArguments),
}

/// Calibrates one of them.
pub fn calibrate(what: &Calibrate) -> Result<(), Failure> {
    match what {
        Calibrate::Stereo(arguments) => stereo::stereo(arguments),
        Calibrate::Import(arguments) => import::import(arguments),
        Calibrate::Export(arguments) => export::export(arguments),
        Calibrate::Boresight(arguments) => boresight::boresight(arguments),
        Calibrate::Range(arguments) => range::range(arguments),
    }
}

/// Writes a file and says so.
fn write(path: &Path, text: &str) -> Result<(), Failure> {
    std::fs::write(path, text)
        .map_err(|error| Failure::Failed(anyhow::anyhow!("{}: {error}", path.display())))?;
    eprintln!("written: {}", path.display());
    Ok(())
}

/// What a rig comes to, for people or as JSON.
fn tell_rig(rig: &Rig, json: bool) {
    let baseline_mm = 1e3 * rig.baseline_m();
    let (focal, turn_deg) = (
        rig.rectification().focal_px(),
        rig.rectification().turn_rad(Eye::Left).to_degrees(),
    );
    let mount = rig.mount();
    let (yaw, depression, roll) = (
        mount.yaw_rad.to_degrees(),
        mount.depression_rad.to_degrees(),
        mount.roll_rad.to_degrees(),
    );
    if json {
        let value = serde_json::json!({
            "name": rig.name(), "baseline_m": rig.baseline_m(), "focal_px": focal,
            "rectifying_rotation_deg": turn_deg,
            "mount_deg": {"yaw": yaw, "depression": depression, "roll": roll},
            "doubts": rig.doubts().iter().map(ToString::to_string).collect::<Vec<_>>(),
        });
        println!("{value:#}");
        return;
    }
    println!(
        "{}: baseline {baseline_mm:.2} mm, rectified focal length {focal:.1} px, rectifying rotation \
         {turn_deg:.2} degrees, boresight {yaw:.2} right, {depression:.2} down, rolled {roll:.2} degrees",
        rig.name()
    );
}
