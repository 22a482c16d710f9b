//! The link over IP: `POST /alarms` to the ground station.
//!
//! **In:** an [`Alarm`]. **Out:** a [`Receipt`], only when the ground says that it is stored.
//! Blocking, bounded in time; one connection is kept open between alarms. No retry here: the outbox
//! owns that. **Known limits:** plain HTTP (a VPN guards it); no redirects; no proxies.

use super::{AlarmLink, LinkError, Receipt};
use crate::alarm::Alarm;
use crate::ground::Ping;
use emberfix_frames::ServiceTime;
use serde::Deserialize;
use std::time::Duration;
use ureq::http::{Response, StatusCode};
use ureq::{Agent, Body};

/// Name of this link in the outbox.
const LINK_NAME: &str = "http";
/// Longest wait for a connection.
const CONNECT: Duration = Duration::from_secs(2);
/// Longest whole exchange. A disk that syncs slowly takes a second; beyond five the outbox tries
/// again, which is harmless.
const EXCHANGE: Duration = Duration::from_secs(5);
/// Largest answer that is read, bytes.
const MAX_ANSWER: u64 = 16 * 1024;

/// Why an alarm or a position did not arrive, as far as the aircraft knows.
#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// The URL is none that this link can use.
    #[error("ground URL is {url:?}, allowed is http://HOST:PORT")]
    Url {
        /// What was given.
        url: String,
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
}

impl HttpError {
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

/// A ground station reached over HTTP.
#[derive(Debug, Clone)]
pub struct HttpLink {
    base_url: String,
    agent: Agent,
}

impl HttpLink {
    /// A link to `base_url`, such as `http://10.8.0.1:8470`. Does not connect yet.
    ///
    /// # Errors
    /// [`HttpError::Url`].
    pub fn new(base_url: &str) -> Result<Self, HttpError> {
        let refused = || HttpError::Url {
            url: base_url.to_owned(),
        };
        let trimmed = base_url.trim_end_matches('/');
        let uri: ureq::http::Uri = trimmed.parse().map_err(|_| refused())?;
        let bare = matches!(uri.path_and_query().map(|p| p.as_str()), None | Some("/"));
        if uri.scheme_str() != Some("http") || uri.host().is_none_or(str::is_empty) || !bare {
            return Err(refused());
        }
        let config = Agent::config_builder()
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
        })
    }

    /// Where it sends to.
    #[must_use]
    pub fn base_url(&self) -> &str {
        &self.base_url
    }

    /// Sends one revision; `Ok` only when the ground says that this revision is on its disk.
    ///
    /// # Errors
    /// [`HttpError`]; see [`HttpError::is_about_the_alarm`].
    pub fn send_alarm(&self, alarm: &Alarm) -> Result<Receipt, HttpError> {
        let url = format!("{}/alarms", self.base_url);
        let mut answer = self.post(
            &url,
            "application/geo+json",
            &alarm.to_geojson().to_string(),
        )?;
        let status = check_status(&url, &mut answer)?;
        let stored = read_json::<Stored>(&mut answer);
        let sent = &alarm.properties;
        match stored {
            Some(Stored {
                id,
                revision,
                stored: true,
            }) if id == sent.id && revision == sent.revision => Ok(Receipt { id, revision }),
            _ => Err(HttpError::NoReceipt {
                url,
                status: status.as_u16(),
            }),
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
        let asked = self.agent.get(&url).call();
        let mut answer = asked.map_err(|source| HttpError::Unreachable {
            url: url.clone(),
            source: Box::new(source),
        })?;
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
        self.agent
            .post(url)
            .header("content-type", kind)
            .send(json)
            .map_err(|source| HttpError::Unreachable {
                url: url.to_owned(),
                source: Box::new(source),
            })
    }
}

impl AlarmLink for HttpLink {
    fn name(&self) -> &'static str {
        LINK_NAME
    }

    fn send(&mut self, alarm: &Alarm) -> Result<Receipt, LinkError> {
        self.send_alarm(alarm).map_err(|error| {
            let (link, reason) = (LINK_NAME, error.to_string());
            if !error.is_about_the_alarm() {
                return LinkError::Unreachable { link, reason };
            }
            let sent = &alarm.properties;
            LinkError::Refused {
                link,
                id: sent.id.clone(),
                revision: sent.revision,
                reason,
            }
        })
    }
}

fn read_json<T: serde::de::DeserializeOwned>(answer: &mut Response<Body>) -> Option<T> {
    let text = answer
        .body_mut()
        .with_config()
        .limit(MAX_ANSWER)
        .read_to_vec()
        .ok()?;
    serde_json::from_slice(&text).ok()
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
    Err(HttpError::Refused {
        url: url.to_owned(),
        status: status.as_u16(),
        reason,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};

    fn alarm() -> Alarm {
        let text = crate::ground::store::tests::feature("gaochun-1", 1, "2026-03-01T12:00:01Z");
        Alarm::from_geojson(text.as_bytes()).unwrap()
    }

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
        let sent = |answer| answering(answer).send_alarm(&alarm());
        let good = r#"201 Created|{"id":"gaochun-1","revision":1,"stored":true}"#;
        assert_eq!(sent(good).unwrap().revision, 1);
        for bad in [
            r#"200 OK|{"id":"gaochun-1","revision":2,"stored":true}"#,
            r#"200 OK|{"id":"gaochun-1","revision":1,"stored":false}"#,
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
        let outcome = |answer| answering(answer).send(&alarm()).unwrap_err();
        match outcome(r#"409 Conflict|{"error":"numbering has restarted"}"#) {
            LinkError::Refused {
                id,
                revision,
                reason,
                ..
            } => {
                assert_eq!((id.as_str(), revision), ("gaochun-1", 1));
                assert!(reason.contains("numbering has restarted"), "{reason}");
            }
            other @ LinkError::Unreachable { .. } => panic!("{other}"),
        }
        for failing in ["503 Service Unavailable|", "404 Not Found|", "200 OK|hello"] {
            assert!(
                matches!(outcome(failing), LinkError::Unreachable { .. }),
                "{failing}"
            );
        }
        let mut nobody = HttpLink::new("http://127.0.0.1:9").unwrap();
        assert!(matches!(
            nobody.send(&alarm()),
            Err(LinkError::Unreachable { .. })
        ));
    }

    #[test]
    fn a_url_that_this_link_cannot_use_is_refused_at_once() {
        for url in [
            "https://10.8.0.1",
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
