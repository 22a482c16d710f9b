//! One exchange with the ground station over HTTP: the plain door, and the way of what fits into no
//! datagram.
//!
//! **In:** a [`Letter`]. `POST /alarms` carries the alarm's exact bytes as its body, and what is signed
//! around them in a header ([`envelope::HTTP_HEADER`]). **Out:** a [`Receipt`], only when the ground says
//! that it is stored. Blocking, bounded in time; connections are kept open between alarms. No retry
//! here: [`super::lanes`] and the outbox own that. `POST /wire` carries one datagram each way, for what
//! else the two sides have to say. `https://` with the authority that the mission names, a token or a
//! client certificate ([`Credentials`]). **Known limits:** no redirects; no proxies.

use super::credentials::Credentials;
use super::datagram::wire::{ToAircraft, ToGround, Verdict};
use super::keys::{PublicKey, SecretKey};
use super::{Letter, Receipt, Settled, envelope};
use crate::alarm::Alarm;
use crate::ground::Ping;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use emberfix_frames::ServiceTime;
use serde::Deserialize;
use std::time::Duration;
use tokio_rustls::rustls::{CertificateError, Error as TlsError};
use ureq::http::{Response, StatusCode};
use ureq::typestate::WithBody;
use ureq::{Agent, Body, RequestBuilder};

/// Longest wait for a connection.
const CONNECT: Duration = Duration::from_secs(2);
/// Longest whole exchange. A disk that syncs slowly takes a second; beyond five the outbox tries
/// again, which is harmless.
const EXCHANGE: Duration = Duration::from_secs(5);
/// Largest answer that is read, bytes.
const MAX_ANSWER: u64 = 16 * 1024;
/// The header of an answer that carries the ground's signed receipt.
pub const RECEIPT_HEADER: &str = "emberfix-receipt";

/// Why an alarm or a position did not arrive, as far as the aircraft knows.
#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// The URL is none that this link can use.
    #[error("ground.url is {url:?}, allowed is http://HOST:PORT or https://HOST:PORT")]
    Url {
        /// What was given.
        url: String,
    },
    /// Over `https://` somebody has to vouch for the other side.
    #[error("ground.url is {url:?}, and ground.ca does not name whose certificates are believed")]
    NoAuthority {
        /// What was given.
        url: String,
    },
    /// A token in the clear is everyone's.
    #[error(
        "ground.url is {url:?}, where anyone on the way could read the token of ground.token_file"
    )]
    InTheClear {
        /// What was given.
        url: String,
    },
    /// Not the other side that the authority vouches for, or it does not believe our certificate.
    #[error("ground {url}: {problem}")]
    Tls {
        /// What was asked.
        url: String,
        /// What does not hold.
        problem: String,
    },
    /// The ground's door stays shut for us.
    #[error("ground {url} does not let us in ({status}: {reason})")]
    Denied {
        /// What was asked.
        url: String,
        /// HTTP status.
        status: u16,
        /// The ground's words.
        reason: String,
    },
    /// No answer: down, unreachable, too slow. Worth a retry.
    #[error("ground {url}: {source}")]
    Unreachable {
        /// What was asked.
        url: String,
        /// What went wrong.
        source: Box<ureq::Error>,
    },
    /// The ground has a reason not to take it.
    #[error("ground {url} answered {status}: {reason}")]
    Refused {
        /// What was asked.
        url: String,
        /// HTTP status.
        status: u16,
        /// The ground's words.
        reason: String,
    },
    /// An answer that does not say `stored` for this id and revision: not our ground station.
    #[error("ground {url} answered {status} without a receipt for this alarm")]
    NoReceipt {
        /// What was asked.
        url: String,
        /// HTTP status.
        status: u16,
    },
    /// An answer that the ground whose key we hold did not sign.
    #[error("what answers at {url} is not the ground station whose key the mission names")]
    Forged {
        /// What was asked.
        url: String,
    },
}

impl HttpError {
    /// What to do about it.
    #[must_use]
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::Url { .. } => "set ground.url to http://HOST:PORT or https://HOST:PORT",
            Self::NoAuthority { .. } => {
                "set ground.ca to the PEM file of the authority that signed the ground's certificate"
            }
            Self::InTheClear { .. } => {
                "ask by https:// (the ground needs [tls]), and set ground.ca"
            }
            Self::Unreachable { .. } => {
                "start it (emberfix ground missions/ground.toml) and look at network and VPN"
            }
            Self::Tls { .. } => {
                "set ground.ca to the authority of that very station and ground.url to a name in its \
                 certificate, set this computer's clock; else find out who answers"
            }
            Self::Denied { status: 429, .. } => {
                "too many wrong tokens came from this address: correct ground.token_file, wait a minute"
            }
            Self::Denied { .. } => {
                "at the ground, give [[access]] role = \"aircraft\", our name in uavs, and as \
                 token_sha256 what printf %s TOKEN | sha256sum says of the token in ground.token_file"
            }
            Self::Forged { .. } => "correct ground.public_key, or find out who answers",
            Self::Refused { .. } | Self::NoReceipt { .. } => {
                "something else answers at this address, or it refuses us: look at its log"
            }
        }
    }

    /// Problem and remedy.
    #[must_use]
    pub fn in_one_line(&self) -> String {
        format!("{self}; {}", self.remedy())
    }

    /// True when the ground will not have this very alarm; else the link or the ground is at fault.
    #[must_use]
    pub fn is_about_the_alarm(&self) -> bool {
        matches!(
            self,
            Self::Refused {
                status: 400 | 409 | 413,
                ..
            }
        )
    }
}

#[derive(Deserialize)]
struct Stored {
    id: String,
    revision: u32,
    stored: bool,
}

impl Stored {
    fn is_of(&self, id: &str, revision: u32) -> bool {
        self.stored && self.id == id && self.revision == revision
    }

    fn receipt(self) -> Receipt {
        Receipt {
            id: self.id,
            revision: self.revision,
        }
    }
}

/// What a ground station says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StationHealth {
    /// Version of its program.
    pub version: String,
    /// UTC by its clock, if it says one.
    pub now: Option<ServiceTime>,
}

#[derive(Deserialize)]
struct RawHealth {
    status: String,
    version: String,
    now: String,
}

#[derive(Deserialize)]
struct Refusal {
    error: String,
}

/// How an exchange went, and what else the ground said.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Told {
    /// How it went.
    pub settled: Settled,
    /// Greatest number of an operator's action for us; 0 where nothing was said.
    pub newest_action: u64,
}

impl Told {
    /// Nobody heard it.
    #[must_use]
    pub fn unreachable(reason: &str) -> Self {
        Self {
            settled: Settled::Unreachable {
                reason: reason.to_owned(),
            },
            newest_action: 0,
        }
    }
}

/// A ground station reached over HTTP.
#[derive(Debug, Clone)]
pub struct HttpLink {
    base_url: String,
    agent: Agent,
    credentials: Credentials,
    ground: Option<PublicKey>,
}

impl HttpLink {
    /// A link to `base_url`, such as `http://10.8.0.1:8470`, that shows nothing. Does not connect yet.
    ///
    /// # Errors
    /// [`HttpError::Url`].
    pub fn new(base_url: &str) -> Result<Self, HttpError> {
        Self::with(base_url, &Credentials::default())
    }

    /// A link to `base_url`, such as `https://ground.example:8470`. Does not connect yet.
    ///
    /// # Errors
    /// [`HttpError::Url`], [`HttpError::NoAuthority`], [`HttpError::InTheClear`].
    pub fn with(base_url: &str, credentials: &Credentials) -> Result<Self, HttpError> {
        let refused = || HttpError::Url {
            url: base_url.to_owned(),
        };
        let trimmed = base_url.trim_end_matches('/');
        let uri: ureq::http::Uri = trimmed.parse().map_err(|_| refused())?;
        let bare = matches!(uri.path_and_query().map(|p| p.as_str()), None | Some("/"));
        let host = uri
            .host()
            .filter(|host| !host.is_empty() && bare)
            .ok_or_else(refused)?;
        check_scheme(uri.scheme_str(), host, base_url, credentials)?;
        let mut config = Agent::config_builder();
        if let Some(tls) = credentials.tls() {
            config = config.tls_config(tls.clone());
        }
        let config = config
            .timeout_connect(Some(CONNECT))
            .timeout_global(Some(EXCHANGE))
            .max_redirects(0)
            .max_redirects_will_error(false)
            .http_status_as_error(false)
            // An environment variable must not send a fire alarm elsewhere.
            .proxy(None)
            .build();
        Ok(Self {
            base_url: trimmed.to_owned(),
            agent: config.into(),
            credentials: credentials.clone(),
            ground: None,
        })
    }

    /// Believes only answers that this ground signed.
    #[must_use]
    pub fn trusting(mut self, ground: Option<PublicKey>) -> Self {
        self.ground = ground;
        self
    }

    /// Host and port.
    #[must_use]
    pub fn place(&self) -> String {
        let (place, port) = match self.base_url.strip_prefix("https://") {
            Some(place) => (place, 443),
            None => (self.base_url.trim_start_matches("http://"), 80),
        };
        let has_port = place
            .rfind(':')
            .is_some_and(|at| !place[at..].contains(']'));
        if has_port {
            place.to_owned()
        } else {
            format!("{place}:{port}")
        }
    }

    /// Where it sends to.
    #[must_use]
    pub fn base_url(&self) -> &str {
        &self.base_url
    }

    /// Sends one revision; `Ok` only when the ground says that this revision is on its disk. The
    /// number is that of the newest operator's action.
    ///
    /// # Errors
    /// [`HttpError`]; see [`HttpError::is_about_the_alarm`].
    pub fn send_letter(&self, letter: &Letter) -> Result<(Receipt, u64), HttpError> {
        let url = format!("{}/alarms", self.base_url);
        let sealed = &letter.sealed;
        let head = sealed.envelope.http_header(sealed.signature.as_ref());
        let request = self
            .posting(&url, "application/geo+json")
            .header(envelope::HTTP_HEADER, head);
        let sent = request.send(&sealed.envelope.alarm[..]);
        let mut answer = sent.map_err(|source| unreachable(&url, source))?;
        let status = check_status(&url, &mut answer)?;
        let newest_action = self.check_receipt(&url, letter, &answer)?;
        match read_json::<Stored>(&mut answer) {
            Some(said) if said.is_of(letter.id(), letter.revision()) => {
                Ok((said.receipt(), newest_action))
            }
            _ => Err(HttpError::NoReceipt {
                url,
                status: status.as_u16(),
            }),
        }
    }

    /// Sends an alarm by the plain door, unsigned.
    ///
    /// # Errors
    /// [`HttpError`].
    pub fn send_alarm(&self, alarm: &Alarm) -> Result<Receipt, HttpError> {
        let url = format!("{}/alarms", self.base_url);
        let json = alarm.to_geojson().to_string();
        let mut answer = self.post(&url, "application/geo+json", &json)?;
        let status = check_status(&url, &mut answer)?.as_u16();
        let properties = &alarm.properties;
        match read_json::<Stored>(&mut answer) {
            Some(said) if said.is_of(&properties.id, properties.revision) => Ok(said.receipt()),
            _ => Err(HttpError::NoReceipt { url, status }),
        }
    }

    /// Sends one revision, and says how it went in the words of links.
    #[must_use]
    pub fn tell(&self, letter: &Letter) -> Told {
        match self.send_letter(letter) {
            Ok((receipt, newest_action)) => Told {
                settled: Settled::Delivered(receipt),
                newest_action,
            },
            Err(error) if error.is_about_the_alarm() => Told {
                settled: Settled::Refused {
                    id: letter.id().to_owned(),
                    revision: letter.revision(),
                    reason: error.to_string(),
                },
                newest_action: 0,
            },
            Err(error @ (HttpError::Tls { .. } | HttpError::Denied { .. })) => {
                Told::unreachable(&error.in_one_line())
            }
            Err(error) => Told::unreachable(&error.to_string()),
        }
    }

    /// Says something that is no alarm, and hears the answer.
    ///
    /// # Errors
    /// [`HttpError`].
    pub fn exchange(
        &self,
        said: &ToGround,
        key: Option<&SecretKey>,
    ) -> Result<ToAircraft, HttpError> {
        let url = format!("{}/wire", self.base_url);
        let request = self.posting(&url, WIRE_KIND);
        let sent = request.send(&said.datagram(key)[..]);
        let mut answer = sent.map_err(|source| unreachable(&url, source))?;
        let status = check_status(&url, &mut answer)?.as_u16();
        let bytes = read_bytes(&mut answer).unwrap_or_default();
        let no_receipt = |url| HttpError::NoReceipt { url, status };
        let (answer, signed) = ToAircraft::read(&bytes).map_err(|_| no_receipt(url.clone()))?;
        if self.ground.is_some_and(|key| !signed.is_by(&key)) {
            return Err(HttpError::Forged { url });
        }
        Ok(answer)
    }

    /// What the ground signed beside its answer: the newest action. Without a key to check it with,
    /// none is needed.
    fn check_receipt(
        &self,
        url: &str,
        letter: &Letter,
        answer: &Response<Body>,
    ) -> Result<u64, HttpError> {
        let header = answer.headers().get(RECEIPT_HEADER);
        let read = header
            .and_then(|header| BASE64.decode(header.as_bytes()).ok())
            .and_then(|bytes| ToAircraft::read(&bytes).ok());
        let forged = || HttpError::Forged {
            url: url.to_owned(),
        };
        let Some((said, signed)) = read else {
            return self.ground.map_or(Ok(0), |_| Err(forged()));
        };
        let ours = self.ground.is_none_or(|key| signed.is_by(&key));
        match said {
            ToAircraft::Receipt {
                origin,
                sequence,
                verdict: Verdict::Stored,
                newest_action,
                ..
            } if ours
                && origin == letter.sealed.envelope.origin
                && sequence == letter.sequence() =>
            {
                Ok(newest_action)
            }
            _ => Err(forged()),
        }
    }

    /// Tells where the aircraft is. Lost positions are not repeated: the next one is better.
    ///
    /// # Errors
    /// [`HttpError`].
    pub fn send_track(&self, ping: &Ping) -> Result<(), HttpError> {
        let url = format!("{}/track", self.base_url);
        let json = serde_json::json!(ping).to_string();
        let mut answer = self.post(&url, "application/json", &json)?;
        check_status(&url, &mut answer).map(|_| ())
    }

    /// What the ground says of itself.
    ///
    /// # Errors
    /// [`HttpError`].
    pub fn health(&self) -> Result<StationHealth, HttpError> {
        let url = format!("{}/health", self.base_url);
        let asked = self.showing(self.agent.get(&url)).call();
        let mut answer = asked.map_err(|source| unreachable(&url, source))?;
        let status = check_status(&url, &mut answer)?;
        read_json::<RawHealth>(&mut answer)
            .filter(|health| health.status == "ok")
            .map(|health| StationHealth {
                version: health.version,
                now: ServiceTime::from_rfc3339(&health.now),
            })
            .ok_or(HttpError::NoReceipt {
                url,
                status: status.as_u16(),
            })
    }

    /// Sends an alarm to where the ground checks and shows test alarms, and keeps none.
    ///
    /// # Errors
    /// [`HttpError`]; a ground station that knows no test alarms answers 404.
    pub fn send_test(&self, alarm: &Alarm) -> Result<(), HttpError> {
        let url = format!("{}/alarms/test", self.base_url);
        let json = alarm.to_geojson().to_string();
        let mut answer = self.post(&url, "application/geo+json", &json)?;
        let status = check_status(&url, &mut answer)?;
        match read_json::<Stored>(&mut answer) {
            Some(Stored {
                id, stored: false, ..
            }) if id == alarm.properties.id => Ok(()),
            _ => Err(HttpError::NoReceipt {
                url,
                status: status.as_u16(),
            }),
        }
    }

    fn post(&self, url: &str, kind: &str, json: &str) -> Result<Response<Body>, HttpError> {
        let sent = self.posting(url, kind).send(json);
        sent.map_err(|source| unreachable(url, source))
    }

    fn posting(&self, url: &str, kind: &str) -> RequestBuilder<WithBody> {
        self.showing(self.agent.post(url))
            .header("content-type", kind)
    }

    /// Says who we are, if the ground is to know.
    fn showing<Any>(&self, request: RequestBuilder<Any>) -> RequestBuilder<Any> {
        match self.credentials.authorization() {
            Some(token) => request.header("authorization", token),
            None => request,
        }
    }
}

/// Whether what has to stay secret does, and whether somebody vouches for the other side.
fn check_scheme(
    scheme: Option<&str>,
    host: &str,
    base_url: &str,
    credentials: &Credentials,
) -> Result<(), HttpError> {
    let url = base_url.to_owned();
    match scheme {
        Some("https") if credentials.tls().is_none() => Err(HttpError::NoAuthority { url }),
        Some("http") if credentials.authorization().is_some() && !is_this_computer(host) => {
            Err(HttpError::InTheClear { url })
        }
        Some("http" | "https") => Ok(()),
        _ => Err(HttpError::Url { url }),
    }
}

fn is_this_computer(host: &str) -> bool {
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    let address = bare.parse::<std::net::IpAddr>();
    host == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

/// What `POST /wire` carries.
pub const WIRE_KIND: &str = "application/octet-stream";

fn unreachable(url: &str, source: ureq::Error) -> HttpError {
    let url = url.to_owned();
    match tls_problem(&source) {
        Some(problem) => HttpError::Tls { url, problem },
        None => HttpError::Unreachable {
            url,
            source: Box::new(source),
        },
    }
}

/// What TLS found wrong, if that is why nobody was reached.
fn tls_problem(error: &ureq::Error) -> Option<String> {
    let error = match error {
        ureq::Error::Rustls(error) => error,
        ureq::Error::Io(error) => error.get_ref()?.downcast_ref::<TlsError>()?,
        _ => return None,
    };
    Some(match error {
        TlsError::InvalidCertificate(
            CertificateError::UnknownIssuer | CertificateError::BadSignature,
        ) => "no authority in ground.ca signed its certificate".to_owned(),
        TlsError::InvalidMessage(_) => "what answers there speaks no TLS".to_owned(),
        other => other.to_string(),
    })
}

fn read_json<T: serde::de::DeserializeOwned>(answer: &mut Response<Body>) -> Option<T> {
    serde_json::from_slice(&read_bytes(answer)?).ok()
}

fn read_bytes(answer: &mut Response<Body>) -> Option<Vec<u8>> {
    let body = answer.body_mut().with_config().limit(MAX_ANSWER);
    body.read_to_vec().ok()
}

fn check_status(url: &str, answer: &mut Response<Body>) -> Result<StatusCode, HttpError> {
    let status = answer.status();
    if status.is_success() {
        return Ok(status);
    }
    let reason = match read_json::<Refusal>(answer) {
        Some(refusal) => refusal.error,
        None => "no reason given".to_owned(),
    };
    let (url, status) = (url.to_owned(), status.as_u16());
    Err(match status {
        401 | 403 | 429 => HttpError::Denied {
            url,
            status,
            reason,
        },
        _ => HttpError::Refused {
            url,
            status,
            reason,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::deliver::tests_support::letter;
    use std::io::{Read, Write};

    /// A server that gives one canned answer and is gone.
    fn answering(answer: &'static str) -> HttpLink {
        let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", socket.local_addr().unwrap());
        std::thread::spawn(move || {
            let (mut stream, _) = socket.accept().unwrap();
            let _ = stream.read(&mut [0; 8192]);
            let head = format!(
                "content-length: {}\r\nconnection: close\r\n\r\n",
                answer.len()
            );
            let (status, body) = answer.split_once('|').unwrap_or((answer, ""));
            let head = head.replace(&answer.len().to_string(), &body.len().to_string());
            stream
                .write_all(format!("HTTP/1.1 {status}\r\n{head}{body}").as_bytes())
                .unwrap();
        });
        HttpLink::new(&url).unwrap()
    }

    #[test]
    fn only_a_receipt_for_this_very_revision_counts_as_stored() {
        let sent = |answer| answering(answer).send_letter(&letter(1, 1));
        let good = r#"201 Created|{"id":"uav-1-1","revision":1,"stored":true}"#;
        assert_eq!(sent(good).unwrap().0.revision, 1);
        for bad in [
            r#"200 OK|{"id":"uav-1-1","revision":2,"stored":true}"#,
            r#"200 OK|{"id":"uav-1-1","revision":1,"stored":false}"#,
            "200 OK|<html>welcome to the hotel</html>",
        ] {
            assert!(
                matches!(sent(bad), Err(HttpError::NoReceipt { .. })),
                "{bad}"
            );
        }
        let redirect = sent("302 Found|").unwrap_err();
        assert!(
            matches!(redirect, HttpError::Refused { status: 302, .. }),
            "{redirect}"
        );
    }

    #[test]
    fn a_refused_alarm_is_told_from_a_link_that_fails() {
        let outcome = |answer| answering(answer).tell(&letter(1, 1)).settled;
        match outcome(r#"409 Conflict|{"error":"numbering has restarted"}"#) {
            Settled::Refused {
                id,
                revision,
                reason,
            } => {
                assert_eq!((id.as_str(), revision), ("uav-1-1", 1));
                assert!(reason.contains("numbering has restarted"), "{reason}");
            }
            other => panic!("{other:?}"),
        }
        for failing in ["503 Service Unavailable|", "404 Not Found|", "200 OK|hello"] {
            let told = outcome(failing);
            assert!(matches!(told, Settled::Unreachable { .. }), "{failing}");
        }
        let nobody = HttpLink::new("http://127.0.0.1:9").unwrap();
        let told = nobody.tell(&letter(1, 1)).settled;
        assert!(matches!(told, Settled::Unreachable { .. }));
    }

    #[test]
    fn a_receipt_that_the_ground_did_not_sign_is_none() {
        let good = r#"201 Created|{"id":"uav-1-1","revision":1,"stored":true}"#;
        let key = SecretKey::random().public();
        let refused = answering(good)
            .trusting(Some(key))
            .send_letter(&letter(1, 1));
        assert!(
            matches!(refused, Err(HttpError::Forged { .. })),
            "{refused:?}"
        );
    }

    #[test]
    fn a_url_that_this_link_cannot_use_is_refused_at_once() {
        for url in [
            "ftp://10.8.0.1",
            "10.8.0.1:8470",
            "http://",
            "http://a/alarms",
            "udp://a:1",
        ] {
            assert!(
                matches!(HttpLink::new(url), Err(HttpError::Url { .. })),
                "{url}"
            );
        }
        assert_eq!(
            HttpLink::new("http://a:8470/").unwrap().base_url(),
            "http://a:8470"
        );
    }
}
