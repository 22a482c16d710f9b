//! Data sets for tests, which are not part of the project.

use std::path::PathBuf;

/// A file or folder of `shared/data`, or `None` (and it says so) where there is none.
pub fn shared_data(path: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("EMBERFIX_SHARED")
        .map_or_else(|| crate::support::root().join("../shared"), PathBuf::from);
    let found = folder.join("data").join(path);
    if found.exists() {
        return Some(found);
    }
    println!("skipped: no shared data (set EMBERFIX_SHARED)");
    None
}
