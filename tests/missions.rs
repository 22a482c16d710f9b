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
    let is_ground = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_string_lossy();
        name.starts_with("ground")
    };
    let (ground, missions): (Vec<_>, Vec<_>) = tomls("missions").into_iter().partition(is_ground);
    assert!(missions.len() >= 2 && ground.len() == 2);
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
    for path in ground {
        let loaded = GroundConfig::load(&path, Overrides::default());
        if path.ends_with("ground-remote.toml") {
            // Certificate and key are the reader's own to make.
            let refused = loaded.unwrap_err().to_string();
            assert_eq!(refused.matches("; ").count(), 0, "{refused}");
            assert!(
                refused.contains("tls.certificate /etc/emberfix/ground.crt"),
                "{refused}"
            );
        } else {
            loaded.unwrap();
        }
    }
}
