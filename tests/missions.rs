//! Every mission and rig that we ship loads; the ground's configuration too.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

use emberfix::ground::{GroundConfig, Overrides};
use emberfix::mission::Mission;
use std::path::{Path, PathBuf};

fn tomls(folder: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let files = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    files
        .filter(|path| path.extension().is_some_and(|ending| ending == "toml"))
        .collect()
}

#[test]
fn every_shipped_mission_and_rig_loads() {
    let (ground, missions): (Vec<_>, Vec<_>) = tomls("missions")
        .into_iter()
        .partition(|path| path.ends_with("ground.toml"));
    assert!(missions.len() >= 2 && ground.len() == 1);
    for path in missions {
        let mission = Mission::load(&path).unwrap_or_else(|error| panic!("{error}"));
        assert!(
            mission.detector.model.exists(),
            "{}",
            mission.detector.model.display()
        );
    }
    for path in tomls("calib/rigs") {
        emberfix_calib::Rig::load(&path).unwrap_or_else(|error| panic!("{error}"));
    }
    GroundConfig::load(&ground[0], Overrides::default()).unwrap();
}
