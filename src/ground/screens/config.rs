//! Which screens there are, as the ground configuration says: raw TOML tables to checked values.
//! Every problem is named; nothing is on that was not asked for.

use super::cap::{CapConfig, Status};
use super::cot::Profile;
use super::tak::{Endpoint, TakConfig, TlsFiles};
use super::tiles::MapConfig;
use emberfix_mav::{LinkUrl, LinkUrlError};
use serde::Deserialize;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Keys of the tables below, for the check of unknown ones.
pub(in crate::ground) const KNOWN: &[&str] = &[
    "cot.url",
    "cot.profile",
    "cot.stale_s",
    "cot.interface",
    "cot.ca",
    "cot.certificate",
    "cot.key",
    "cot.server_name",
    "cap.sender",
    "cap.sender_name",
    "cap.status",
    "cap.radius_m",
    "adsb.url",
    "adsb.system_id",
    "foxglove.listen",
    "foxglove.allow_remote",
    "map.tiles",
    "map.attribution",
    "map.max_zoom",
];

/// What may stand in the file.
#[derive(Debug, Default, Deserialize)]
pub(in crate::ground) struct RawScreens {
    #[serde(default)]
    cot: Vec<RawCot>,
    cap: Option<RawCap>,
    adsb: Option<RawAdsb>,
    foxglove: Option<RawFoxglove>,
    map: Option<RawMap>,
}

#[derive(Debug, Deserialize)]
struct RawCot {
    url: String,
    profile: Option<String>,
    stale_s: Option<i64>,
    interface: Option<std::net::Ipv4Addr>,
    ca: Option<PathBuf>,
    certificate: Option<PathBuf>,
    key: Option<PathBuf>,
    server_name: Option<String>,
}

#[derive(Debug, Deserialize)]
struct RawCap {
    sender: String,
    sender_name: Option<String>,
    status: String,
    radius_m: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct RawAdsb {
    url: String,
    system_id: Option<i64>,
}

#[derive(Debug, Deserialize)]
struct RawFoxglove {
    listen: Option<String>,
    #[serde(default)]
    allow_remote: bool,
}

#[derive(Debug, Deserialize)]
struct RawMap {
    tiles: String,
    attribution: Option<String>,
    max_zoom: Option<i64>,
}

/// The screens beside the page and what every ground station serves anyway.
#[derive(Debug, Clone, PartialEq, Default)]
pub(in crate::ground) struct ScreensConfig {
    pub cot: Vec<TakConfig>,
    pub cap: Option<CapConfig>,
    pub adsb: Option<AdsbConfig>,
    pub foxglove: Option<SocketAddr>,
    pub map: Option<MapConfig>,
}

/// Where markers go that look like aircraft.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::ground) struct AdsbConfig {
    pub url: LinkUrl,
    /// Under which system the ground station program looks for them: the vehicle's.
    pub system_id: u8,
}

/// How long a CoT marker stands without a word.
const STALE_S: i64 = 600;
/// Radius of a CAP circle: who is to be told, not how well the place is known.
const CAP_RADIUS_M: f64 = 500.0;
const FOXGLOVE: &str = "127.0.0.1:8765";

impl RawScreens {
    /// `folder` is the file's own; `vehicle` the MAVLink port that leads to the aircraft.
    pub(in crate::ground) fn check(
        self,
        folder: &Path,
        vehicle: Option<&LinkUrl>,
        problems: &mut Vec<String>,
    ) -> ScreensConfig {
        ScreensConfig {
            cot: self
                .cot
                .into_iter()
                .filter_map(|raw| raw.check(folder, problems))
                .collect(),
            cap: self.cap.and_then(|raw| raw.check(problems)),
            adsb: self.adsb.and_then(|raw| raw.check(vehicle, problems)),
            foxglove: self.foxglove.and_then(|raw| raw.check(problems)),
            map: self.map.and_then(|raw| raw.check(folder, problems)),
        }
    }
}

impl RawCot {
    fn check(self, folder: &Path, problems: &mut Vec<String>) -> Option<TakConfig> {
        let stale_s = self.stale_s.unwrap_or(STALE_S);
        if !(30..=86_400).contains(&stale_s) {
            problems.push(format!("cot.stale_s is {stale_s}, allowed is 30 to 86400"));
        }
        let profile = self.profile(problems)?;
        let endpoint = self.endpoint(folder, problems)?;
        Some(TakConfig {
            endpoint,
            profile,
            stale_s,
        })
    }

    fn profile(&self, problems: &mut Vec<String>) -> Option<Profile> {
        match self.profile.as_deref() {
            None | Some("marker") => Some(Profile::Marker),
            Some("semantic") => Some(Profile::Semantic),
            Some(other) => {
                problems.push(format!(
                    "cot.profile is {other:?}, allowed are marker and semantic"
                ));
                None
            }
        }
    }

    fn endpoint(self, folder: &Path, problems: &mut Vec<String>) -> Option<Endpoint> {
        let Some((scheme, place)) = self.url.split_once("://").filter(|(_, p)| is_place(p)) else {
            problems.push(format!(
                "cot.url is {:?}, allowed are udp://, tcp:// and tls:// with HOST:PORT, such as \
                 udp://239.2.3.1:6969",
                self.url
            ));
            return None;
        };
        match scheme {
            "udp" => match place.parse() {
                Ok(to) => Some(Endpoint::Udp {
                    to,
                    interface: self.interface,
                }),
                Err(_) => {
                    problems.push(format!(
                        "cot.url is {:?}, allowed behind udp:// is an IP address",
                        self.url
                    ));
                    None
                }
            },
            "tcp" => Some(Endpoint::Tcp {
                place: place.to_owned(),
            }),
            "tls" => self.tls(place.to_owned(), folder, problems),
            _ => {
                problems.push(format!(
                    "cot.url is {:?}, allowed are udp://, tcp:// and tls://",
                    self.url
                ));
                None
            }
        }
    }

    fn tls(&self, place: String, folder: &Path, problems: &mut Vec<String>) -> Option<Endpoint> {
        let mut file = |key: &str, path: &Option<PathBuf>| {
            if path.is_none() {
                problems.push(format!(
                    "cot.{key} is missing, a TAK server over TLS needs it: a PEM file"
                ));
            }
            path.as_ref().map(|path| folder.join(path))
        };
        let (ca, certificate, key) = (
            file("ca", &self.ca),
            file("certificate", &self.certificate),
            file("key", &self.key),
        );
        let host = place
            .rsplit_once(':')
            .map_or("", |(host, _)| host)
            .to_owned();
        let files = TlsFiles {
            ca: ca?,
            certificate: certificate?,
            key: key?,
            server_name: self.server_name.clone().unwrap_or(host),
        };
        Some(Endpoint::Tls { place, files })
    }
}

fn is_place(place: &str) -> bool {
    place.rsplit_once(':').is_some_and(|(host, port)| {
        !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port > 0)
    })
}

impl RawCap {
    fn check(self, problems: &mut Vec<String>) -> Option<CapConfig> {
        // CAP 1.2, 3.2.1: no spaces, commas or restricted characters in a sender.
        let may_be = |c: char| c.is_ascii_graphic() && !matches!(c, ',' | '<' | '&');
        if self.sender.is_empty() || !self.sender.chars().all(may_be) {
            problems.push(format!(
                "cap.sender is {:?}, allowed is a name that is yours alone, such as \
                 ground@brigade.example: no spaces, commas, < or &",
                self.sender
            ));
        }
        let radius_m = self.radius_m.unwrap_or(CAP_RADIUS_M);
        if !(10.0..=50_000.0).contains(&radius_m) {
            problems.push(format!(
                "cap.radius_m is {radius_m}, allowed is 10 to 50000"
            ));
        }
        let status = Status::named(&self.status);
        if status.is_none() {
            problems.push(format!(
                "cap.status is {:?}, allowed are actual, exercise and test",
                self.status
            ));
        }
        Some(CapConfig {
            sender: self.sender,
            sender_name: self.sender_name,
            status: status?,
            radius_m,
        })
    }
}

impl RawAdsb {
    fn check(self, vehicle: Option<&LinkUrl>, problems: &mut Vec<String>) -> Option<AdsbConfig> {
        let url: LinkUrl = self
            .url
            .parse()
            .map_err(|error: LinkUrlError| problems.push(format!("adsb.url: {error}")))
            .ok()?;
        let LinkUrl::UdpOut(place) = &url else {
            problems.push(format!(
                "adsb.url is {url}, allowed is udpout:HOST:PORT of one ground station program"
            ));
            return None;
        };
        if vehicle.is_some_and(|vehicle| leads_to_the_same(vehicle, place)) {
            problems.push(format!(
                "adsb.url is {url}, which is mavlink.url too and leads to the vehicle: an autopilot \
                 takes these markers for traffic and may fly home; allowed is a port that only a \
                 ground station program listens on"
            ));
        }
        let system_id = self.system_id.unwrap_or(1);
        let id = u8::try_from(system_id).ok().filter(|id| *id > 0);
        if id.is_none() {
            problems.push(format!(
                "adsb.system_id is {system_id}, allowed is 1 to 255"
            ));
        }
        Some(AdsbConfig {
            url,
            system_id: id?,
        })
    }
}

/// Whether the vehicle's port is the one at `place`. Ports decide where both are on this machine,
/// by whatever name.
fn leads_to_the_same(vehicle: &LinkUrl, place: &str) -> bool {
    let vehicle = match vehicle {
        LinkUrl::UdpIn(place) | LinkUrl::UdpOut(place) => place,
        LinkUrl::TcpIn(_) | LinkUrl::TcpOut(_) | LinkUrl::Serial { .. } => return false,
    };
    let split = |place: &str| {
        place
            .rsplit_once(':')
            .map(|(host, port)| (host.to_owned(), port.to_owned()))
    };
    match (split(vehicle), split(place)) {
        (Some((host, port)), Some((to, to_port))) => {
            port == to_port && (host == to || is_here(&host) && is_here(&to))
        }
        _ => false,
    }
}

fn is_here(host: &str) -> bool {
    matches!(host, "localhost" | "0.0.0.0" | "[::]" | "[::1]") || host.starts_with("127.")
}

impl RawFoxglove {
    fn check(self, problems: &mut Vec<String>) -> Option<SocketAddr> {
        let text = self.listen.as_deref().unwrap_or(FOXGLOVE);
        let Ok(address) = text.parse::<SocketAddr>() else {
            problems.push(format!(
                "foxglove.listen is {text:?}, allowed is an IP address and a port, such as {FOXGLOVE}"
            ));
            return None;
        };
        if !address.ip().is_loopback() && !self.allow_remote {
            problems.push(format!(
                "foxglove.listen is {address}, allowed is a loopback address: its protocol has no \
                 passwords; set foxglove.allow_remote = true where the network itself is guarded"
            ));
        }
        Some(address)
    }
}

impl RawMap {
    fn check(self, folder: &Path, problems: &mut Vec<String>) -> Option<MapConfig> {
        let max_zoom = self.max_zoom.unwrap_or(19);
        let zoom = u8::try_from(max_zoom)
            .ok()
            .filter(|zoom| (1..=24).contains(zoom));
        if zoom.is_none() {
            problems.push(format!("map.max_zoom is {max_zoom}, allowed is 1 to 24"));
        }
        MapConfig::new(
            &self.tiles,
            folder,
            self.attribution.unwrap_or_default(),
            zoom?,
        )
        .map_err(|problem| problems.push(problem))
        .ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(text: &str) -> (ScreensConfig, Vec<String>) {
        let raw: RawScreens = toml::from_str(text).unwrap();
        let mut problems = Vec::new();
        let vehicle = "udpin:127.0.0.1:14550".parse().unwrap();
        let config = raw.check(Path::new("conf"), Some(&vehicle), &mut problems);
        (config, problems)
    }

    #[test]
    fn nothing_is_on_that_was_not_asked_for() {
        assert_eq!(check(""), (ScreensConfig::default(), Vec::new()));
    }

    #[test]
    fn markers_never_go_where_the_vehicle_is() {
        for url in [
            "udpout:127.0.0.1:14550",
            "udpout:localhost:14550",
            "udpin:127.0.0.1:14551",
        ] {
            let (_, problems) = check(&format!("[adsb]\nurl='{url}'"));
            assert_eq!(problems.len(), 1, "{url}: {problems:?}");
        }
        for url in ["udpout:127.0.0.1:14551", "udpout:10.0.0.9:14550"] {
            let (config, problems) = check(&format!("[adsb]\nurl='{url}'"));
            assert!(
                problems.is_empty() && config.adsb.is_some(),
                "{url}: {problems:?}"
            );
        }
    }

    #[test]
    fn a_tak_server_over_tls_needs_its_three_files() {
        let (_, problems) = check("[[cot]]\nurl='tls://tak.example:8089'\nca='ca.pem'");
        assert!(
            problems.iter().any(|p| p.contains("cot.certificate")),
            "{problems:?}"
        );
        assert!(
            problems.iter().any(|p| p.contains("cot.key")),
            "{problems:?}"
        );
    }

    #[test]
    fn every_problem_is_named() {
        let (_, problems) = check(
            "[[cot]]\nurl='udp://tak.example:1'\n[[cot]]\nurl='x'\n[[cot]]\nurl='tcp://h:1'\nstale_s=1\n\
             [cap]\nsender='a b'\nstatus='real'\nradius_m=nan\n[foxglove]\nlisten='0.0.0.0:1'\n\
             [map]\ntiles='ftp://x'\nmax_zoom=99",
        );
        for part in [
            "udp://tak",
            "\"x\"",
            "stale_s",
            "cap.sender",
            "cap.status",
            "radius_m",
            "allow_remote",
            "max_zoom",
        ] {
            assert!(
                problems.iter().any(|p| p.contains(part)),
                "{part} is not in {problems:#?}"
            );
        }
    }
}
