//! `emberfix calibrate WHAT`: solves for a rig, or brings one in.

mod boresight;
mod export;
mod import;
mod live;
mod mounting;
mod pairs;
mod range;
mod stereo;

use super::Failure;

/// What can be calibrated.
#[derive(Debug, clap::Subcommand)]
pub enum Calibrate {
    /// Both eyes and the pair, from pictures of a board.
    Stereo(stereo::StereoArguments),
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
