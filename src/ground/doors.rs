//! The parts of the configuration that outgrow one machine: TLS, who may do what, limits, another
//! database, the bus.

use super::access::{Access, Role};
use super::bus::BusConfig;
use super::server::Limits;
use ::postgres::config::{Host, SslMode};
use serde::Deserialize;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring::default_provider;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::version::TLS13;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};

/// Keys that are read here.
pub(super) const KNOWN: &[&str] = &[
    "store",
    "store_ca",
    "tls.certificate",
    "tls.key",
    "tls.client_ca",
    "access.name",
    "access.role",
    "access.token_sha256",
    "access.certificate_sha256",
    "access.uavs",
    "limits.connections",
    "limits.per_address",
    "limits.head_s",
    "limits.still_s",
    "bus.url",
    "bus.station",
    "bus.stream",
    "bus.domain",
    "bus.replicas",
    "bus.credentials",
];

/// As it stands in the file.
#[derive(Debug, Default, Deserialize)]
pub(super) struct RawDoors {
    store: Option<String>,
    store_ca: Option<PathBuf>,
    tls: Option<RawTls>,
    #[serde(default)]
    access: Vec<RawAccess>,
    limits: Option<RawLimits>,
    bus: Option<RawBus>,
}

#[derive(Debug, Deserialize)]
struct RawTls {
    certificate: PathBuf,
    key: PathBuf,
    client_ca: Option<PathBuf>,
}

#[derive(Debug, Deserialize)]
struct RawAccess {
    name: String,
    role: String,
    token_sha256: Option<String>,
    certificate_sha256: Option<String>,
    uavs: Option<Vec<String>>,
}

#[derive(Debug, Deserialize)]
struct RawLimits {
    connections: Option<i64>,
    per_address: Option<i64>,
    head_s: Option<f64>,
    still_s: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct RawBus {
    url: String,
    station: String,
    #[serde(default = "default_stream")]
    stream: String,
    domain: Option<String>,
    #[serde(default = "default_replicas")]
    replicas: i64,
    credentials: Option<PathBuf>,
}

fn default_stream() -> String {
    "FIRE".to_owned()
}
fn default_replicas() -> i64 {
    1
}

/// Checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Doors {
    /// A PostgreSQL database; SQLite in the data directory without.
    pub postgres: Option<Server>,
    pub tls: Option<TlsFiles>,
    pub accesses: Vec<Access>,
    pub limits: Limits,
    pub bus: Option<BusConfig>,
}

/// A PostgreSQL database.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Server {
    pub url: String,
    /// Who has signed its certificate; without, the line is not encrypted and stays on this machine.
    pub authority: Option<PathBuf>,
}

/// Where certificate and key lie.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TlsFiles {
    certificate: PathBuf,
    key: PathBuf,
    client_ca: Option<PathBuf>,
}

impl RawDoors {
    pub fn check(self, folder: &Path, problems: &mut Vec<String>) -> Doors {
        let authority = self.store_ca.map(|path| folder.join(path));
        let postgres = self
            .store
            .and_then(|url| check_postgres(url, authority, problems));
        Doors {
            postgres,
            tls: self.tls.map(|raw| raw.check(folder, problems)),
            accesses: check_accesses(self.access, problems),
            limits: self
                .limits
                .map_or_else(Limits::default, |raw| raw.check(problems)),
            bus: self.bus.and_then(|raw| raw.check(folder, problems)),
        }
    }
}

impl Doors {
    /// Beyond this machine, nobody is let in unasked, and nothing goes in the clear.
    pub fn check_address(&self, listen: SocketAddr, problems: &mut Vec<String>) {
        if listen.ip().is_loopback() || (self.tls.is_some() && !self.accesses.is_empty()) {
            return;
        }
        problems.push(format!(
            "listen is {listen}, allowed is a loopback address, or any with a [tls] table and at least \
             one [[access]]: whoever reaches it could post alarms and read them; an example is \
             missions/ground-remote.toml"
        ));
    }
}

fn check_postgres(
    url: String,
    authority: Option<PathBuf>,
    problems: &mut Vec<String>,
) -> Option<Server> {
    let named = url.starts_with("postgres://") || url.starts_with("postgresql://");
    let parsed = url.parse::<::postgres::Config>().ok();
    if let Some(config) = parsed.filter(|_| named) {
        let wants_tls = config.get_ssl_mode() == SslMode::Require;
        if authority.is_none() && (wants_tls || !is_of_this_machine(&config)) {
            problems.push(
                "store is reached over TLS, or over a network: store_ca has to name the PEM file of the \
                 authority that signed the server's certificate; without it only a server of this \
                 machine is reached, in the clear"
                    .to_owned(),
            );
        }
        return Some(Server { url, authority });
    }
    // Never the address itself: it may hold a password.
    problems.push(
        "store is no PostgreSQL address, allowed is postgresql://USER@HOST/DATABASE, or \
         postgresql:///DATABASE?host=/run/postgresql; without it alarms go into data_dir (SQLite)"
            .to_owned(),
    );
    None
}

/// Whether every address of the server is a loopback one, or a socket.
fn is_of_this_machine(config: &::postgres::Config) -> bool {
    if !config.get_hostaddrs().is_empty() {
        return config.get_hostaddrs().iter().all(IpAddr::is_loopback);
    }
    config.get_hosts().iter().all(|host| match host {
        Host::Tcp(name) => {
            let address = name.parse::<IpAddr>();
            name == "localhost" || address.is_ok_and(|address| address.is_loopback())
        }
        Host::Unix(_) => true,
    })
}

impl RawTls {
    fn check(self, folder: &Path, problems: &mut Vec<String>) -> TlsFiles {
        let files = TlsFiles {
            certificate: folder.join(self.certificate),
            key: folder.join(self.key),
            client_ca: self.client_ca.map(|path| folder.join(path)),
        };
        if let Err(problem) = files.server_config() {
            problems.push(problem);
        }
        files
    }
}

impl TlsFiles {
    /// What serves TLS with these files.
    ///
    /// # Errors
    /// In words: which key of the configuration, which file, and why.
    pub fn acceptor(&self) -> Result<TlsAcceptor, String> {
        Ok(TlsAcceptor::from(Arc::new(self.server_config()?)))
    }

    /// TLS 1.3 alone: an older version is refused in the handshake.
    fn server_config(&self) -> Result<ServerConfig, String> {
        let chain = certificates("tls.certificate", &self.certificate)?;
        let key = PrivateKeyDer::from_pem_file(&self.key)
            .map_err(|error| format!("tls.key {}: {error}", self.key.display()))?;
        let builder = ServerConfig::builder_with_provider(Arc::new(default_provider()))
            .with_protocol_versions(&[&TLS13])
            .map_err(|error| format!("tls: {error}"))?;
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(path) => builder.with_client_cert_verifier(verifier(path)?),
        };
        builder
            .with_single_cert(chain, key)
            .map_err(|error| format!("tls.certificate and tls.key do not go together: {error}"))
    }
}

fn certificates(key: &str, path: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let failed = |error: &dyn std::fmt::Display| format!("{key} {}: {error}", path.display());
    let found = CertificateDer::pem_file_iter(path).map_err(|error| failed(&error))?;
    let found: Vec<_> = found
        .collect::<Result<_, _>>()
        .map_err(|error| failed(&error))?;
    if found.is_empty() {
        return Err(failed(&"no certificate in it"));
    }
    Ok(found)
}

/// A client certificate is checked when one is shown; who shows none needs a token.
fn verifier(
    path: &Path,
) -> Result<Arc<dyn tokio_rustls::rustls::server::danger::ClientCertVerifier>, String> {
    let failed =
        |error: &dyn std::fmt::Display| format!("tls.client_ca {}: {error}", path.display());
    let mut roots = RootCertStore::empty();
    for certificate in certificates("tls.client_ca", path)? {
        roots.add(certificate).map_err(|error| failed(&error))?;
    }
    WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::new(default_provider()))
        .allow_unauthenticated()
        .build()
        .map_err(|error| failed(&error))
}

fn check_accesses(raw: Vec<RawAccess>, problems: &mut Vec<String>) -> Vec<Access> {
    let mut checked: Vec<Access> = Vec::new();
    for raw in raw {
        if checked.iter().any(|known| known.name == raw.name) {
            problems.push(format!("access.name {:?} is there twice", raw.name));
        }
        checked.extend(raw.check(problems));
    }
    checked
}

impl RawAccess {
    fn check(self, problems: &mut Vec<String>) -> Option<Access> {
        let name = &self.name;
        if name.is_empty() || name.len() > 32 {
            problems.push(format!(
                "access.name is {name:?}, allowed is 1 to 32 characters"
            ));
        }
        if self.token_sha256.is_none() && self.certificate_sha256.is_none() {
            problems.push(format!(
                "access {name:?} has neither token_sha256 nor certificate_sha256"
            ));
        }
        let role = match self.role.as_str() {
            "aircraft" => Some(Role::Aircraft),
            "screen" => Some(Role::Screen),
            "operator" => Some(Role::Operator),
            other => {
                problems.push(format!(
                    "access.role of {name:?} is {other:?}, allowed are aircraft, screen, operator"
                ));
                None
            }
        };
        let token = digest("token_sha256", name, self.token_sha256, problems);
        let certificate = digest(
            "certificate_sha256",
            name,
            self.certificate_sha256,
            problems,
        );
        Some(Access {
            role: role?,
            token,
            certificate,
            uavs: self.uavs.unwrap_or_else(|| vec![self.name.clone()]),
            name: self.name,
        })
    }
}

fn digest(
    key: &str,
    name: &str,
    text: Option<String>,
    problems: &mut Vec<String>,
) -> Option<[u8; 32]> {
    let text = text?;
    let digits: String = text.chars().filter(|digit| *digit != ':').collect();
    let bytes = (0..digits.len() / 2).map(|at| {
        let pair = digits.get(2 * at..2 * at + 2)?;
        u8::from_str_radix(pair, 16).ok()
    });
    let digest: Option<Vec<u8>> = bytes.collect();
    let digest = digest
        .filter(|_| digits.len() == 64)
        .and_then(|digest| digest.try_into().ok());
    if digest.is_none() {
        problems.push(format!(
            "access.{key} of {name:?} has {} characters, allowed are 64 hexadecimal digits: \
             printf %s TOKEN | sha256sum, or openssl x509 -noout -fingerprint -sha256",
            text.len()
        ));
    }
    digest
}

impl RawLimits {
    fn check(self, problems: &mut Vec<String>) -> Limits {
        let usual = Limits::default();
        Limits {
            connections: count(
                "limits.connections",
                self.connections,
                usual.connections,
                problems,
            ),
            per_address: count(
                "limits.per_address",
                self.per_address,
                usual.per_address,
                problems,
            ),
            head: seconds("limits.head_s", self.head_s, usual.head, problems),
            still: seconds("limits.still_s", self.still_s, usual.still, problems),
            ..usual
        }
    }
}

fn count(key: &str, value: Option<i64>, usual: usize, problems: &mut Vec<String>) -> usize {
    let Some(value) = value else { return usual };
    let found = usize::try_from(value)
        .ok()
        .filter(|count| (1..=100_000).contains(count));
    found.unwrap_or_else(|| {
        problems.push(format!("{key} is {value}, allowed is 1 to 100000"));
        usual
    })
}

fn seconds(key: &str, value: Option<f64>, usual: Duration, problems: &mut Vec<String>) -> Duration {
    match value {
        None => usual,
        Some(value) if (0.1..=3600.0).contains(&value) => Duration::from_secs_f64(value),
        Some(value) => {
            problems.push(format!("{key} is {value}, allowed is 0.1 to 3600"));
            usual
        }
    }
}

impl RawBus {
    fn check(self, folder: &Path, problems: &mut Vec<String>) -> Option<BusConfig> {
        let is_name = |text: &str| {
            let plain =
                |character: char| character.is_ascii_alphanumeric() || "-_".contains(character);
            (1..=32).contains(&text.len()) && text.chars().all(plain)
        };
        for (key, text) in [("bus.station", &self.station), ("bus.stream", &self.stream)] {
            if !is_name(text) {
                problems.push(format!(
                    "{key} is {text:?}, allowed are 1 to 32 letters, digits, - and _"
                ));
            }
        }
        if !["nats://", "tls://"]
            .iter()
            .any(|scheme| self.url.starts_with(scheme))
        {
            problems.push(format!(
                "bus.url is {:?}, allowed is nats://HOST:PORT or tls://HOST:PORT",
                self.url
            ));
        }
        let replicas = usize::try_from(self.replicas)
            .ok()
            .filter(|count| (1..=5).contains(count));
        if replicas.is_none() {
            problems.push(format!(
                "bus.replicas is {}, allowed is 1 to 5",
                self.replicas
            ));
        }
        Some(BusConfig {
            replicas: replicas?,
            url: self.url,
            station: self.station,
            stream: self.stream,
            domain: self.domain,
            credentials: self.credentials.map(|path| folder.join(path)),
        })
    }
}
