//! The real service, live.

use crate::camera::Camera;
use crate::clients::Running;
use crate::pictures;
use crate::support::{Said, Scratch, emberfix};
use std::net::{TcpListener, UdpSocket};
use std::path::Path;

/// The service on ports of its own.
pub struct Service {
    program: Running,
    /// Where it listens to MAVLink.
    pub mavlink_port: u16,
    camera_port: u16,
}

/// A port of this computer that nobody has just now.
pub fn free_udp_port() -> u16 {
    UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port()
}

fn free_tcp_port() -> u16 {
    TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port()
}

impl Service {
    /// Starts it on the scratch folder's mission, with a box file as its detector.
    pub fn start(scratch: &Scratch, more: &[&str]) -> Self {
        Self::start_with(scratch, more, &[])
    }

    /// The same, in an environment of its own.
    pub fn start_with(scratch: &Scratch, more: &[&str], environment: &[(&str, &Path)]) -> Self {
        let (mavlink_port, camera_port) = (free_udp_port(), free_tcp_port());
        let mut command = emberfix();
        command
            .env("EMBERFIX_LOG", "info")
            .envs(environment.iter().copied())
            .arg("run")
            .arg(scratch.path("mission.toml"));
        command
            .arg("--boxes")
            .arg(scratch.write("boxes.csv", pictures::boxes(1000)));
        command.arg("--state").arg(scratch.path("state"));
        command
            .arg("--mavlink")
            .arg(format!("udpin:127.0.0.1:{mavlink_port}"));
        command
            .arg("--camera")
            .arg(format!("tcp-listen:127.0.0.1:{camera_port}"));
        command.args(more);
        let (program, _) = Running::start(command, "emberfix: ready");
        Self {
            program,
            mavlink_port,
            camera_port,
        }
    }

    /// A camera for it.
    pub fn film(&self) -> Camera {
        Camera::film(self.camera_port)
    }

    /// Ends it; what it logged holds its counters.
    pub fn stop(self) -> Said {
        let said = self.program.stop();
        assert_eq!(said.code, 0, "{}", said.err);
        said
    }
}
