//! `emberfix calibrate stereo --live URL`: which poses of the board are still missing.

use crate::cli::Failure;
use emberfix_calib::solve::Board;
use std::path::PathBuf;

/// A camera instead of files.
#[derive(Debug, Clone, clap::Args)]
pub struct LiveArguments {
    /// Camera (the URLs of a mission) to take pictures from; tells which poses of the board are missing.
    #[arg(long, value_name = "URL")]
    pub live: Option<String>,
    /// Folder for the pictures that --live keeps.
    #[arg(long, value_name = "FOLDER")]
    pub keep: Option<PathBuf>,
}

/// Takes pictures until the poses are complete.
pub fn guide(_url: &str, _board: &Board, _arguments: &LiveArguments) -> Result<(), Failure> {
    Err(Failure::Refused(anyhow::anyhow!("not there yet")))
}
