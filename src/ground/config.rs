//! The ground station's configuration file: raw TOML to a checked [`GroundConfig`], every problem
//! at once.

use super::doors::{self, Doors, RawDoors};
use super::receive::Keyring;
use super::screens::config::{self as screens, RawScreens, ScreensConfig};
use crate::deliver::keys::PublicKey;
use emberfix_calib::{KeyProblem, toml_problem, unknown_keys};
use emberfix_mav::{LinkUrl, LinkUrlError, SigningKey};
use serde::Deserialize;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file can't be read.
    #[error(
        "ground configuration {path}: {source}; an example is missions/ground.toml",
        path = path.display()
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, or a value of the wrong type.
    #[error("ground configuration {path}: {message}", path = path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What the TOML reader said.
        message: String,
    },
    /// Values that can't be, and keys that nothing reads.
    #[error("ground configuration {path}: {}", problems.join("; "), path = path.display())]
    Values {
        /// The file.
        path: PathBuf,
        /// One sentence per problem: key, value, allowed range, remedy.
        problems: Vec<String>,
    },
}

/// What the command line says instead of the file.
#[derive(Debug, Clone, Default)]
pub struct Overrides {
    /// `--listen`: address and port; port 0 takes a free one.
    pub listen: Option<SocketAddr>,
    /// `--data`: data directory, relative to the working directory.
    pub data_dir: Option<PathBuf>,
    /// `--mavlink`: URL of the MAVLink endpoint.
    pub mavlink_url: Option<String>,
}

/// A checked configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundConfig {
    pub(super) listen: SocketAddr,
    pub(super) host_names: Vec<String>,
    /// How others reach the station, without a final slash; where it is not what they ask for.
    pub(super) public_url: Option<String>,
    pub(super) data_dir: PathBuf,
    pub(super) exercise: bool,
    pub(super) mavlink: Option<MavlinkConfig>,
    pub(super) uavs: Vec<Uav>,
    pub(super) screens: ScreensConfig,
    pub(super) doors: Doors,
    pub(super) datagrams: bool,
}

impl GroundConfig {
    /// Whose word counts.
    pub(super) fn keyring(&self) -> Keyring {
        let named = |uav: &Uav| (uav.name.clone(), uav.public_key);
        Keyring::new(self.uavs.iter().map(named))
    }
}

/// The ground agent's end of MAVLink.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct MavlinkConfig {
    pub url: LinkUrl,
    pub system_id: u8,
    pub component_id: u8,
    pub signing_key: Option<SigningKey>,
}

/// Which aircraft flies under which MAVLink system id.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Uav {
    pub system_id: u8,
    pub name: String,
    pub public_key: Option<PublicKey>,
}

#[derive(Deserialize)]
struct RawConfig {
    #[serde(default = "default_listen")]
    listen: String,
    allow_remote: Option<bool>,
    #[serde(default)]
    host_names: Vec<String>,
    public_url: Option<String>,
    data_dir: PathBuf,
    #[serde(default)]
    exercise: bool,
    mavlink: Option<RawMavlink>,
    #[serde(default)]
    uav: Vec<RawUav>,
    #[serde(flatten)]
    screens: RawScreens,
    #[serde(flatten)]
    doors: RawDoors,
    #[serde(default = "yes")]
    datagrams: bool,
}

fn yes() -> bool {
    true
}

#[derive(Deserialize)]
struct RawMavlink {
    url: String,
    #[serde(default = "default_system_id")]
    system_id: i64,
    #[serde(default = "default_component_id")]
    component_id: i64,
    signing_key: Option<PathBuf>,
}

impl RawMavlink {
    fn usual() -> Self {
        Self {
            url: String::new(),
            system_id: default_system_id(),
            component_id: default_component_id(),
            signing_key: None,
        }
    }
}

#[derive(Deserialize)]
struct RawUav {
    system_id: i64,
    name: String,
    public_key: Option<String>,
}

fn default_listen() -> String {
    "127.0.0.1:8470".to_owned()
}
/// Ground stations commonly take 255, so our agent beside one takes the next.
fn default_system_id() -> i64 {
    254
}
/// `MAV_COMP_ID_ONBOARD_COMPUTER`.
fn default_component_id() -> i64 {
    191
}

const KNOWN: &[&str] = &[
    "listen",
    "allow_remote",
    "host_names",
    "public_url",
    "data_dir",
    "exercise",
    "mavlink.url",
    "mavlink.system_id",
    "mavlink.component_id",
    "mavlink.signing_key",
    "datagrams",
    "uav.system_id",
    "uav.name",
    "uav.public_key",
];

impl GroundConfig {
    /// Reads and checks a file; `overrides` win. A relative `data_dir` in the file is taken from
    /// the file's own folder.
    ///
    /// # Errors
    /// [`ConfigError`] with every problem.
    pub fn load(path: &Path, overrides: Overrides) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text, path, overrides)
    }

    /// Checks the text of the file `path`.
    ///
    /// # Errors
    /// [`ConfigError`] with every problem.
    pub fn parse(text: &str, path: &Path, overrides: Overrides) -> Result<Self, ConfigError> {
        let syntax = |error: toml::de::Error| ConfigError::Syntax {
            path: path.to_owned(),
            message: toml_problem(text, &error),
        };
        let refuse = |problems| {
            Err(ConfigError::Values {
                path: path.to_owned(),
                problems,
            })
        };
        let table: toml::Table = toml::from_str(text).map_err(syntax)?;
        let known = [KNOWN, screens::KNOWN, doors::KNOWN].concat();
        let mut problems: Vec<String> = unknown_keys(&table, &known)
            .iter()
            .map(KeyProblem::to_string)
            .collect();
        let raw: RawConfig = match toml::from_str(text) {
            Ok(raw) => raw,
            // A misspelt key is also a missing one: name the misspelling, it is what helps.
            Err(_) if !problems.is_empty() => return refuse(problems),
            Err(error) => return Err(syntax(error)),
        };
        let config = check(raw, path, overrides, &mut problems);
        match config {
            Some(config) if problems.is_empty() => Ok(config),
            _ => refuse(problems),
        }
    }
}

fn check(
    raw: RawConfig,
    path: &Path,
    overrides: Overrides,
    problems: &mut Vec<String>,
) -> Option<GroundConfig> {
    let listen = overrides.listen.or_else(|| address(&raw.listen, problems));
    let folder = path.parent().unwrap_or(Path::new(""));
    let doors = raw.doors.check(folder, problems);
    if let Some(address) = listen {
        doors.check_address(address, problems);
    }
    if raw.allow_remote.is_some() {
        problems.push(
            "allow_remote is no longer read: beyond this machine the station needs [tls] and [[access]]"
                .to_owned(),
        );
    }
    let mut mavlink = raw.mavlink;
    if let Some(url) = overrides.mavlink_url {
        let given = mavlink.unwrap_or_else(RawMavlink::usual);
        mavlink = Some(RawMavlink { url, ..given });
    }
    let mavlink = mavlink.and_then(|link| check_mavlink(link, folder, problems));
    let uavs = check_uavs(&raw.uav, problems);
    let public = raw.public_url.and_then(|url| public(&url, problems));
    let mut host_names = raw.host_names;
    host_names.extend(public.iter().map(|public| public.host.clone()));
    let vehicle = mavlink.as_ref().map(|link| &link.url);
    let screens = raw.screens.check(folder, vehicle, problems);
    Some(GroundConfig {
        listen: listen?,
        host_names,
        public_url: public.map(|public| public.url),
        exercise: raw.exercise,
        data_dir: overrides
            .data_dir
            .unwrap_or_else(|| folder.join(raw.data_dir)),
        mavlink,
        uavs,
        screens,
        doors,
        datagrams: raw.datagrams,
    })
}

fn address(text: &str, problems: &mut Vec<String>) -> Option<SocketAddr> {
    let parsed = text.parse().ok();
    if parsed.is_none() {
        problems.push(format!(
            "listen is {text:?}, allowed is an IP address and a port, such as 127.0.0.1:8470"
        ));
    }
    parsed
}

/// Where others reach the station.
struct Public {
    url: String,
    host: String,
}

fn public(text: &str, problems: &mut Vec<String>) -> Option<Public> {
    let url = text.trim_end_matches('/');
    let parsed: Option<axum::http::Uri> = url.parse().ok();
    let host = parsed.as_ref().and_then(|uri| {
        let known = matches!(uri.scheme_str(), Some("http" | "https"));
        let plain = uri.query().is_none() && !url.contains(['@', '#']);
        uri.host().filter(|_| known && plain)
    });
    match host {
        Some(host) => Some(Public {
            host: host.trim_matches(['[', ']']).to_owned(),
            url: url.to_owned(),
        }),
        None => {
            problems.push(format!(
                "public_url is {text:?}, allowed is http or https, a host and perhaps a port and a path, \
                 such as https://fires.example"
            ));
            None
        }
    }
}

fn check_mavlink(
    raw: RawMavlink,
    folder: &Path,
    problems: &mut Vec<String>,
) -> Option<MavlinkConfig> {
    let signing_key = raw.signing_key.map(|path| {
        crate::mission::load_signing_key(&folder.join(path))
            .map_err(|problem| problems.push(format!("mavlink.signing_key: {problem}")))
    });
    let system_id = id("mavlink.system_id", raw.system_id, problems);
    let component_id = id("mavlink.component_id", raw.component_id, problems);
    let url = raw
        .url
        .parse()
        .map_err(|error: LinkUrlError| problems.push(format!("mavlink.url: {error}")))
        .ok();
    Some(MavlinkConfig {
        url: url?,
        system_id: system_id?,
        component_id: component_id?,
        signing_key: signing_key.transpose().ok()?,
    })
}

fn id(key: &str, value: i64, problems: &mut Vec<String>) -> Option<u8> {
    let id = u8::try_from(value).ok().filter(|id| *id > 0);
    if id.is_none() {
        problems.push(format!("{key} is {value}, allowed is 1 to 255"));
    }
    id
}

fn check_uavs(raw: &[RawUav], problems: &mut Vec<String>) -> Vec<Uav> {
    let mut uavs: Vec<Uav> = Vec::new();
    for uav in raw {
        let Some(system_id) = id("uav.system_id", uav.system_id, problems) else {
            continue;
        };
        if uav.name.is_empty() || uav.name.len() > 32 {
            problems.push(format!(
                "uav.name is {:?}, allowed is 1 to 32 characters",
                uav.name
            ));
        }
        if uavs
            .iter()
            .any(|known| known.system_id == system_id || known.name == uav.name)
        {
            problems.push(format!(
                "uav {:?} with system_id {system_id} repeats a name or a system id",
                uav.name
            ));
        }
        let public_key = uav.public_key.as_deref().map(str::parse).transpose();
        let public_key = public_key.unwrap_or_else(|error| {
            problems.push(format!("uav.public_key of {:?}: {error}", uav.name));
            None
        });
        uavs.push(Uav {
            system_id,
            name: uav.name.clone(),
            public_key,
        });
    }
    uavs
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<GroundConfig, String> {
        GroundConfig::parse(text, Path::new("conf/ground.toml"), Overrides::default())
            .map_err(|error| error.to_string())
    }

    #[test]
    fn the_example_loads() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("missions/ground.toml");
        let config = GroundConfig::load(&path, Overrides::default()).unwrap();
        assert!(config.listen.ip().is_loopback());
        assert_eq!(config.mavlink.unwrap().system_id, 254);
    }

    #[test]
    fn every_problem_is_named_at_once() {
        let text = "data_dir='x'\nlisten='0.0.0.0:80'\nlisen=1\n[mavlink]\nurl='udpin:127.0.0.1:1'\n\
                    system_id=300\n[[uav]]\nsystem_id=0\nname='a'";
        let message = parse(text).unwrap_err();
        for part in [
            "conf/ground.toml",
            "did you mean listen",
            "[[access]]",
            "1 to 255",
            "uav.system_id is 0",
        ] {
            assert!(message.contains(part), "{part:?} is not in {message}");
        }
    }

    #[test]
    fn a_data_directory_is_taken_from_the_files_folder_and_an_override_is_not() {
        assert_eq!(parse("data_dir='d'").unwrap().data_dir, Path::new("conf/d"));
        let overrides = Overrides {
            data_dir: Some("e".into()),
            ..Overrides::default()
        };
        let config = GroundConfig::parse("data_dir='d'", Path::new("c/g.toml"), overrides).unwrap();
        assert_eq!(config.data_dir, Path::new("e"));
    }

    #[test]
    fn a_remote_address_needs_to_be_allowed_even_on_the_command_line() {
        let overrides = Overrides {
            listen: "[::]:8470".parse().ok(),
            ..Overrides::default()
        };
        let refused = GroundConfig::parse("data_dir='d'", Path::new("g.toml"), overrides);
        assert!(matches!(refused, Err(ConfigError::Values { .. })));
        let allowed = parse("data_dir='d'\nlisten='0.0.0.0:8470'\nallow_remote=true").unwrap_err();
        assert!(allowed.contains("no longer read") && allowed.contains("ground-remote.toml"));
    }

    #[test]
    fn a_database_beyond_this_machine_is_reached_over_tls_or_not_at_all() {
        let store = |url: &str, more: &str| parse(&format!("data_dir='d'\nstore='{url}'\n{more}"));
        for here in [
            "postgresql:///fires?host=/run/postgresql",
            "postgresql://duty@localhost/fires",
            "postgresql://duty@127.0.0.1/fires",
            "postgresql://duty@db.example/fires?hostaddr=127.0.0.1",
        ] {
            assert!(store(here, "").is_ok(), "{here}");
        }
        for there in [
            "postgresql://duty@db.example/fires",
            "postgresql://duty@localhost,10.0.0.7/fires",
            "postgresql://duty@localhost/fires?hostaddr=10.0.0.7",
            "postgresql://duty@localhost/fires?sslmode=require",
        ] {
            let message = store(there, "").unwrap_err();
            assert!(message.contains("store_ca"), "{there}: {message}");
            assert!(store(there, "store_ca='ca.pem'").is_ok(), "{there}");
        }
    }

    #[test]
    fn the_public_address_is_one_and_its_name_is_ours() {
        let config = parse("data_dir='d'\npublic_url='https://fires.example/north/'").unwrap();
        assert_eq!(config.public_url.unwrap(), "https://fires.example/north");
        assert_eq!(config.host_names, ["fires.example"]);
        for bad in [
            "fires.example",
            "ftp://a",
            "https://",
            "https://a?b",
            "https://u:p@a",
        ] {
            let message = parse(&format!("data_dir='d'\npublic_url='{bad}'")).unwrap_err();
            assert!(message.contains("public_url"), "{bad}: {message}");
        }
    }

    #[test]
    fn every_problem_of_the_doors_is_named_at_once() {
        let text = "data_dir='d'\nlisten='0.0.0.0:1'\nstore='mysql://x:secret@y'\n\
                    [tls]\ncertificate='no.pem'\nkey='no.key'\n\
                    [[access]]\nname='a'\nrole='king'\ntoken_sha256='12'\n\
                    [limits]\nconnections=0\nhead_s=nan\n\
                    [bus]\nurl='http://x'\nstation='a b'\nreplicas=9";
        let message = parse(text).unwrap_err();
        for part in [
            "tls.certificate conf/no.pem",
            "\"king\", allowed are aircraft, screen, operator",
            "64 hexadecimal digits",
            "store is no PostgreSQL address",
            "limits.connections is 0",
            "limits.head_s is NaN",
            "bus.url is \"http://x\"",
            "bus.station is \"a b\"",
            "bus.replicas is 9",
        ] {
            assert!(message.contains(part), "{part:?} is not in {message}");
        }
        assert!(!message.contains("secret"), "{message}");
    }
}
