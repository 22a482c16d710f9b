//! `emberfix calibrate export`: a rig as other programs' files.

use crate::cli::Failure;
use emberfix_calib::Rig;
use emberfix_calib::exchange::{export_opencv, export_ros};
use std::path::{Path, PathBuf};

/// A rig as a file for ROS or OpenCV.
#[derive(Debug, clap::Args)]
pub struct ExportArguments {
    /// Rig file.
    rig: PathBuf,
    /// Format.
    #[arg(long, value_enum)]
    to: To,
    /// File to write (opencv, opencv-xml), or folder for left.yaml and right.yaml (ros).
    #[arg(long)]
    out: PathBuf,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum To {
    /// Two camera_info files.
    Ros,
    /// FileStorage, YAML.
    Opencv,
    /// FileStorage, XML.
    OpencvXml,
}

/// Reads, writes; the mount, which these formats can't hold, stays behind, and it says so.
pub fn export(arguments: &ExportArguments) -> Result<(), Failure> {
    let rig = Rig::load(&arguments.rig).map_err(Failure::refused)?;
    match arguments.to {
        To::Ros => ros(&rig, &arguments.out)?,
        To::Opencv => opencv(&rig, &arguments.out, false)?,
        To::OpencvXml => opencv(&rig, &arguments.out, true)?,
    }
    eprintln!("note: mount, lever arm, time offset and sigmas have no place in this format");
    Ok(())
}

fn ros(rig: &Rig, folder: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(folder).map_err(Failure::failed)?;
    let (left, right) = export_ros(rig);
    super::write(&folder.join("left.yaml"), &left)?;
    super::write(&folder.join("right.yaml"), &right)
}

fn opencv(rig: &Rig, path: &Path, xml: bool) -> Result<(), Failure> {
    let text = export_opencv(rig, xml).map_err(Failure::failed)?;
    super::write(path, &text)
}
