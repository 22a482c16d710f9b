//! A PostgreSQL server of the tests' own, if this machine has one with PostGIS.

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Runs while it lives.
pub(super) struct Server {
    folder: tempfile::TempDir,
    programs: PathBuf,
    port: u16,
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
        let server = Self {
            folder,
            programs,
            port: free_port(),
        };
        server.papers();
        if is_root() {
            let owner = Command::new("chown")
                .args(["-R", USER])
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
        let folder = server.folder.path().display();
        let options = format!(
            "-k {folder} -c listen_addresses=127.0.0.1 -c port={} -c ssl=on \
             -c ssl_cert_file={folder}/server.pem -c ssl_key_file={folder}/server.key",
            server.port
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

    /// A certificate for localhost, its authority, and another authority.
    fn papers(&self) {
        let authority = |name: &str| {
            let mut params = CertificateParams::new(vec![name.to_owned()]).unwrap();
            params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
            CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap()
        };
        let (ours, others) = (authority("ours"), authority("others"));
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &ours).unwrap();
        for (name, text) in [
            ("ours.pem", ours.pem()),
            ("others.pem", others.pem()),
            ("server.pem", certificate.pem()),
            ("server.key", key.serialize_pem()),
        ] {
            let path = self.folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            // The server refuses a key that others may read.
            std::fs::set_permissions(&path, Permissions::from_mode(0o600)).unwrap();
        }
    }

    /// Address of a fresh database over TLS, the file of its authority, and that of another one.
    pub fn over_tls(&self, name: &str) -> (String, PathBuf, PathBuf) {
        self.database(name);
        let url = format!(
            "postgresql://postgres@localhost:{}/{name}?hostaddr=127.0.0.1",
            self.port
        );
        let file = |name: &str| self.folder.path().join(name);
        (url, file("ours.pem"), file("others.pem"))
    }

    /// Address of a fresh database.
    pub fn database(&self, name: &str) -> String {
        let host = self.folder.path().display();
        let port = self.port;
        let to = |database: &str| {
            format!("postgresql:///{database}?host={host}&port={port}&user=postgres")
        };
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

fn free_port() -> u16 {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    listener.local_addr().unwrap().port()
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
