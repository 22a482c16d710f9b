//! The link over IP: `POST /alarms` to the ground station.
//!
//! **In:** an [`Alarm`]. **Out:** [`HttpReceipt`], only when the ground says that it is stored.
//! Blocking, bounded in time; one connection is kept open between alarms. No retry here: the outbox
//! owns that. **Known limits:** plain HTTP (a VPN guards it); no redirects; no proxies.

use crate::alarm::Alarm;
use crate::ground::Ping;
use serde::Deserialize;
use std::time::Duration;
use ureq::http::{Response, StatusCode};
use ureq::{Agent, Body};

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
    /// The ground has a reason not to take it. A retry of the same will end the same (4xx), or may
    /// not (5xx).
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
    /// True when sending the same again can't help: the alarm itself is refused.
    #[must_use]
    pub fn is_permanent(&self) -> bool {
        match self {
            Self::Refused { status, .. } => matches!(status, 400 | 409 | 413 | 415 | 422),
            Self::Url { .. } => true,
            Self::Unreachable { .. } | Self::NoReceipt { .. } => false,
        }
    }
}

/// The ground has this revision on its disk.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct HttpReceipt {
    /// Alarm id.
    pub id: String,
    /// Revision.
    pub revision: u32,
    stored: bool,
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
    /// [`HttpError`]; see [`HttpError::is_permanent`].
    pub fn send(&self, alarm: &Alarm) -> Result<HttpReceipt, HttpError> {
        let url = format!("{}/alarms", self.base_url);
        let mut answer = self.post(
            &url,
            "application/geo+json",
            &alarm.to_geojson().to_string(),
        )?;
        let status = check_status(&url, &mut answer)?;
        let text = answer
            .body_mut()
            .with_config()
            .limit(MAX_ANSWER)
            .read_to_vec();
        let receipt = text
            .ok()
            .and_then(|text| serde_json::from_slice::<HttpReceipt>(&text).ok());
        let ours = |receipt: &HttpReceipt| {
            let sent = &alarm.properties;
            receipt.stored && receipt.id == sent.id && receipt.revision == sent.revision
        };
        receipt.filter(ours).ok_or(HttpError::NoReceipt {
            url,
            status: status.as_u16(),
        })
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

fn check_status(url: &str, answer: &mut Response<Body>) -> Result<StatusCode, HttpError> {
    let status = answer.status();
    if status.is_success() {
        return Ok(status);
    }
    let text = answer
        .body_mut()
        .with_config()
        .limit(MAX_ANSWER)
        .read_to_vec()
        .unwrap_or_default();
    let reason = match serde_json::from_slice::<Refusal>(&text) {
        Ok(refusal) => refusal.error,
        Err(_) => "no reason given".to_owned(),
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
        let sent = |answer| answering(answer).send(&alarm());
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
    fn a_refusal_carries_the_grounds_words_and_says_whether_to_go_on() {
        let refused =
            answering(r#"409 Conflict|{"error":"numbering has restarted"}"#).send(&alarm());
        let refused = refused.unwrap_err();
        assert!(refused.is_permanent() && refused.to_string().contains("numbering has restarted"));
        let busy = answering("503 Service Unavailable|")
            .send(&alarm())
            .unwrap_err();
        assert!(!busy.is_permanent());
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
