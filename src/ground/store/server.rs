//! A PostgreSQL server of the tests' own, if this machine has one with PostGIS.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Runs while it lives.
pub(super) struct Server {
    folder: tempfile::TempDir,
    programs: PathBuf,
}

/// PostgreSQL does not run as root; on a machine where the tests do, this user stands in.
const USER: &str = "postgres";

impl Server {
    /// Starts one; or why not.
    pub fn start() -> Result<Self, String> {
        let programs = programs().ok_or("no PostgreSQL server (Debian: postgresql)")?;
        let version = programs
            .parent()
            .and_then(Path::file_name)
            .unwrap_or_default();
        let postgis = Path::new("/usr/share/postgresql")
            .join(version)
            .join("extension/postgis.control");
        if !postgis.is_file() {
            return Err(format!("no PostGIS: {} is not there", postgis.display()));
        }
        let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
        let server = Self { folder, programs };
        if is_root() {
            let owner = Command::new("chown")
                .arg(USER)
                .arg(server.folder.path())
                .status();
            owner.map_err(|error| error.to_string())?;
        }
        let data = server.data();
        server.run(
            "initdb",
            &[
                "-D",
                &data,
                "-U",
                "postgres",
                "-A",
                "trust",
                "--no-sync",
                "-E",
                "UTF8",
            ],
        )?;
        let options = format!(
            "-k {} -c listen_addresses=''",
            server.folder.path().display()
        );
        let log = server.folder.path().join("log");
        server.run(
            "pg_ctl",
            &[
                "-D",
                &data,
                "-o",
                &options,
                "-l",
                &log.display().to_string(),
                "-w",
                "start",
            ],
        )?;
        Ok(server)
    }

    fn data(&self) -> String {
        self.folder.path().join("data").display().to_string()
    }

    fn run(&self, program: &str, arguments: &[&str]) -> Result<(), String> {
        let mut command = if is_root() {
            let mut command = Command::new("setpriv");
            command.args(["--reuid", USER, "--regid", USER, "--clear-groups"]);
            command.arg(self.programs.join(program));
            command
        } else {
            Command::new(self.programs.join(program))
        };
        let begun = Instant::now();
        let done = command
            .args(arguments)
            .current_dir("/")
            .stdout(Stdio::null())
            .status();
        match done {
            Ok(status) if status.success() && begun.elapsed() < Duration::from_secs(120) => Ok(()),
            other => Err(format!("{program}: {other:?}")),
        }
    }

    /// Address of a fresh database.
    pub fn database(&self, name: &str) -> String {
        let host = self.folder.path().display();
        let to = |database: &str| format!("postgresql:///{database}?host={host}&user=postgres");
        let mut client = ::postgres::Client::connect(&to("postgres"), ::postgres::NoTls).unwrap();
        client
            .batch_execute(&format!("CREATE DATABASE {name}"))
            .unwrap();
        to(name)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.run("pg_ctl", &["-D", &self.data(), "-m", "immediate", "stop"]);
    }
}

fn is_root() -> bool {
    use std::os::unix::fs::MetadataExt;
    std::fs::metadata("/proc/self").is_ok_and(|about| about.uid() == 0)
}

/// Folder of the newest server's programs.
fn programs() -> Option<PathBuf> {
    let versions = std::fs::read_dir("/usr/lib/postgresql").ok()?;
    let folders = versions.flatten().map(|version| version.path().join("bin"));
    folders
        .filter(|folder| folder.join("initdb").is_file())
        .max()
}
