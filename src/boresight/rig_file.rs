//! Changes the mount, the clock and their sigmas in a rig file, and leaves the rest as it stands,
//! comments and all.

use super::Solution;
use emberfix_calib::{Rig, RigError};
use std::path::{Path, PathBuf};

/// Why a rig file was not changed.
#[derive(Debug, thiserror::Error)]
pub enum RigFileError {
    /// Could not be read or written.
    #[error("rig {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A key that a rig file needs is not where it should be.
    #[error("rig {}: {table}.{key} is not there to be changed", path.display())]
    Missing {
        /// The file.
        path: PathBuf,
        /// Table.
        table: &'static str,
        /// Key.
        key: &'static str,
    },
    /// What was found makes no rig.
    #[error("what was found makes no rig: {source}")]
    Refused {
        /// Why.
        #[from]
        source: RigError,
    },
}

/// Writes the rig file `from` with what was found to `to`, which may be the same; checked as a rig
/// before it takes the place of anything.
///
/// # Errors
/// [`RigFileError`]; `to` is then as it was.
pub fn write(from: &Path, to: &Path, rig: &Rig, solution: &Solution) -> Result<(), RigFileError> {
    let io = |path: &Path, source| RigFileError::Io {
        path: path.to_owned(),
        source,
    };
    let text = std::fs::read_to_string(from).map_err(|source| io(from, source))?;
    let text = changed(&text, &changes(rig, solution)).map_err(|(table, key)| {
        let path = from.to_owned();
        RigFileError::Missing { path, table, key }
    })?;
    let new = to.with_added_extension("new");
    std::fs::write(&new, text).map_err(|source| io(&new, source))?;
    if let Err(source) = Rig::load(&new) {
        let _removed = std::fs::remove_file(&new);
        return Err(source.into());
    }
    std::fs::rename(&new, to).map_err(|source| io(to, source))
}

type Change = (&'static str, &'static str, String);

fn changes(rig: &Rig, solution: &Solution) -> Vec<Change> {
    let degrees = |rad: f64| format!("{:.4}", rad.to_degrees());
    let arm = solution.arm_m;
    let arm_sigma = (3..6)
        .map(|index| solution.sigma(index))
        .fold(0.0, f64::max);
    vec![
        ("mount", "yaw_deg", degrees(solution.mount.yaw_rad)),
        (
            "mount",
            "depression_deg",
            degrees(solution.mount.depression_rad),
        ),
        ("mount", "roll_deg", degrees(solution.mount.roll_rad)),
        (
            "mount",
            "lever_arm_m",
            format!("[{:.4}, {:.4}, {:.4}]", arm.x, arm.y, arm.z),
        ),
        (
            "time",
            "camera_offset_s",
            format!("{:.5}", rig.time_offset_s() + solution.clock_s()),
        ),
        (
            "sigma",
            "boresight_deg",
            degrees(solution.boresight_sigma()),
        ),
        ("sigma", "lever_arm_m", format!("{arm_sigma:.4}")),
        (
            "sigma",
            "time_offset_s",
            format!("{:.5}", solution.sigma(6)),
        ),
    ]
}

/// The text with each value exchanged; the table and key that are not there, if any.
fn changed(text: &str, changes: &[Change]) -> Result<String, (&'static str, &'static str)> {
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    for (table, key, value) in changes {
        let line = place(&lines, table, key).ok_or((*table, *key))?;
        let comment = lines[line]
            .split_once('#')
            .map_or_else(String::new, |(_, comment)| format!("  #{comment}"));
        lines[line] = format!("{key} = {value}{comment}");
    }
    Ok(lines.join("\n") + "\n")
}

fn place(lines: &[String], table: &str, key: &str) -> Option<usize> {
    let mut here = String::new();
    for (number, line) in lines.iter().enumerate() {
        let line = line.trim();
        if let Some(name) = line
            .strip_prefix('[')
            .and_then(|rest| rest.split(']').next())
            && !line.contains('=')
        {
            here = name.trim().to_owned();
        }
        let named = line.split_once('=').map(|(name, _)| name.trim());
        if here == table && named == Some(key) {
            return Some(number);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_named_values_change_and_comments_stay() {
        let text = "# a rig\n[mount]\nyaw_deg = 0.0 # to the right\nlever_arm_m = [0.1, 0.0, 0.0]\n\n[sigma]\nlever_arm_m = 0.02\n";
        let changes = [
            ("mount", "yaw_deg", "3.0".to_owned()),
            ("sigma", "lever_arm_m", "0.01".to_owned()),
        ];
        let expected = "# a rig\n[mount]\nyaw_deg = 3.0  # to the right\nlever_arm_m = [0.1, 0.0, 0.0]\n\n[sigma]\nlever_arm_m = 0.01\n";
        assert_eq!(changed(text, &changes).unwrap(), expected);
        let missing = changed(text, &[("time", "camera_offset_s", "0".to_owned())]);
        assert_eq!(missing.unwrap_err(), ("time", "camera_offset_s"));
    }
}
