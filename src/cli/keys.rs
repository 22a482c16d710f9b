//! `emberfix keys MISSION`.

use super::Failure;
use crate::deliver::keys::SecretKey;
use crate::mission::Mission;
use std::path::PathBuf;

/// Makes the aircraft's key where there is none, and prints the public one.
#[derive(Debug, clap::Args)]
pub struct KeysArguments {
    /// Mission file, such as missions/gaochun.toml.
    mission: PathBuf,
    /// Folder for what must survive instead of the mission's.
    #[arg(long)]
    state: Option<PathBuf>,
}

/// Prints what goes into the ground's configuration.
pub fn keys(arguments: KeysArguments) -> Result<(), Failure> {
    let mut mission = Mission::load(&arguments.mission).map_err(Failure::refused)?;
    if let Some(folder) = arguments.state {
        mission.state_dir = folder;
    }
    std::fs::create_dir_all(&mission.state_dir).map_err(Failure::failed)?;
    let key = SecretKey::load_or_make(&mission.key_file()).map_err(Failure::refused)?;
    eprintln!("secret key: {}", mission.key_file().display());
    eprintln!("for the ground configuration, into the [[uav]] table of this aircraft:");
    println!(
        "name = \"{}\"\npublic_key = \"{}\"",
        mission.uav,
        key.public()
    );
    Ok(())
}
