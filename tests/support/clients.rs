//! The independent programs of `tests/clients`.

use crate::support::{Said, root};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

/// The Python of the test environment.
pub struct Clients {
    python: PathBuf,
}

impl Clients {
    /// `None` (and it says so) where `./x setup` has made no environment.
    pub fn find() -> Option<Self> {
        let python = std::env::var_os("EMBERFIX_PYTHON")
            .map_or_else(|| root().join(".x/venv/bin/python"), PathBuf::from);
        if python.exists() {
            return Some(Self { python });
        }
        println!("skipped: no Python for the test clients (./x setup, or set EMBERFIX_PYTHON)");
        None
    }

    /// A client, ready to be given arguments.
    pub fn client(&self, name: &str) -> Command {
        let mut command = Command::new(&self.python);
        command
            .arg(root().join("tests/clients").join(name))
            .stdin(Stdio::null());
        command
    }

    /// Runs a client to its end.
    pub fn run<S: AsRef<std::ffi::OsStr>>(
        &self,
        name: &str,
        arguments: impl IntoIterator<Item = S>,
    ) -> Said {
        Said::of(&self.client(name).args(arguments).output().unwrap())
    }
}

/// A program that runs beside the test; it is stopped at the latest when this is dropped.
pub struct Running {
    child: Option<Child>,
    log: Option<std::thread::JoinHandle<String>>,
}

impl Running {
    /// Starts it, and waits for the line on standard error that holds `ready`. Returns that line.
    pub fn start(mut command: Command, ready: &str) -> (Self, String) {
        let command = command.stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut errors = BufReader::new(child.stderr.take().unwrap());
        let mut said = String::new();
        let line = loop {
            let mut line = String::new();
            assert!(
                errors.read_line(&mut line).unwrap() > 0,
                "never said {ready:?}:\n{said}"
            );
            said.push_str(&line);
            if line.contains(ready) {
                break line;
            }
        };
        // Standard error is read to the end, or the program would hang on a full pipe.
        let log = std::thread::spawn(move || {
            for line in errors.lines().map_while(Result::ok) {
                said.push_str(&line);
                said.push('\n');
            }
            said
        });
        (
            Self {
                child: Some(child),
                log: Some(log),
            },
            line,
        )
    }

    /// Asks it to end (SIGTERM), and waits for it.
    pub fn stop(mut self) -> Said {
        if let Some(child) = &self.child {
            let pid = child.id().to_string();
            Command::new("kill").args(["-TERM", &pid]).status().unwrap();
        }
        self.wait()
    }

    /// Waits until it ends by itself.
    pub fn wait(&mut self) -> Said {
        let output = self.child.take().unwrap().wait_with_output().unwrap();
        let err = self.log.take().unwrap().join().unwrap();
        Said {
            err,
            ..Said::of(&output)
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            // Already gone is as good.
            let _killed = child.kill();
            let _reaped = child.wait();
        }
    }
}

/// What a `ready {..}` line of a client says.
pub fn facts(line: &str) -> Value {
    serde_json::from_str(line.trim().strip_prefix("ready ").unwrap()).unwrap()
}
