//! Who may do what: aircraft post, screens read, operators act.
//!
//! Callers show a token (`Authorization: Bearer TOKEN`; Google Earth and the like: Basic, with any user
//! name and the token as password; the page: the cookie of [`super::session`]) or a client certificate. The configuration holds SHA-256
//! digests of both, never a token. Without any `[[access]]` everyone on this machine may do everything;
//! the configuration then allows a loopback address only.
//!
//! Guessing: after [`MAX_FAILURES`] wrong tokens an address is not heard for [`DEAF`].

use super::http::refusal;
use super::lock;
use super::server::Peer;
use super::session;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Wrong tokens from one address before it is not heard any more.
const MAX_FAILURES: u32 = 10;
/// For how long; also after which time a wrong token is forgotten.
const DEAF: Duration = Duration::from_secs(60);
/// Addresses that are remembered for wrong tokens; beyond, all are forgotten.
const MAX_ADDRESSES: usize = 4_096;

/// What a caller is there for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Role {
    /// Posts its own alarms, images and positions; fetches what operators did with them.
    Aircraft,
    /// Reads.
    Screen,
    /// Reads and acts.
    Operator,
}

/// One entry of the configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Access {
    pub name: String,
    pub role: Role,
    /// Aircraft for which it may speak.
    pub uavs: Vec<String>,
    pub token: Option<[u8; 32]>,
    pub certificate: Option<[u8; 32]>,
}

/// Who called, for the handlers.
#[derive(Debug, Clone)]
pub(super) enum Caller {
    /// Nobody is asked here.
    Anyone,
    /// One of the configuration.
    Known(Arc<Access>),
}

impl Caller {
    /// Whether it may speak for an aircraft.
    pub fn speaks_for(&self, uav: &str) -> bool {
        match self {
            Self::Anyone => true,
            Self::Known(access) => access.uavs.iter().any(|own| own == uav),
        }
    }

    /// Its name in the configuration.
    pub fn name(&self) -> Option<&str> {
        match self {
            Self::Anyone => None,
            Self::Known(access) => Some(&access.name),
        }
    }
}

/// Keeps the door.
#[derive(Debug, Default)]
pub(super) struct Doorkeeper {
    accesses: Vec<Arc<Access>>,
    /// Whether the station is reached over TLS.
    pub(super) tls: bool,
    failures: Mutex<HashMap<IpAddr, (u32, Instant)>>,
}

impl Doorkeeper {
    pub fn new(accesses: Vec<Access>, tls: bool) -> Self {
        Self {
            accesses: accesses.into_iter().map(Arc::new).collect(),
            tls,
            failures: Mutex::default(),
        }
    }

    fn recognise(&self, peer: &Peer, headers: &HeaderMap) -> Result<Caller, Refused> {
        if self.accesses.is_empty() {
            return Ok(Caller::Anyone);
        }
        if self.is_deaf_to(peer.address) {
            return Err(Refused::Deaf);
        }
        let by_certificate = peer
            .certificate
            .and_then(|shown| self.find(shown, |access| access.certificate));
        if let Some(access) = by_certificate {
            return Ok(Caller::Known(access));
        }
        let by_cookie = || session::shown(headers, self.tls);
        match token(headers).or_else(by_cookie) {
            Some(token) => self.recognise_token(peer, &token),
            None => Err(Refused::Nobody),
        }
    }

    /// Whose token it is.
    pub(super) fn recognise_token(&self, peer: &Peer, token: &[u8]) -> Result<Caller, Refused> {
        if self.accesses.is_empty() {
            return Ok(Caller::Anyone);
        }
        if self.is_deaf_to(peer.address) {
            return Err(Refused::Deaf);
        }
        match self.find(Sha256::digest(token).into(), |access| access.token) {
            Some(access) => Ok(Caller::Known(access)),
            None => {
                self.note_failure(peer.address);
                Err(Refused::Nobody)
            }
        }
    }

    /// Looks at every entry, and at every byte of it: how long it takes says nothing.
    fn find(
        &self,
        shown: [u8; 32],
        secret: impl Fn(&Access) -> Option<[u8; 32]>,
    ) -> Option<Arc<Access>> {
        let mut found = None;
        for access in &self.accesses {
            if secret(access).is_some_and(|known| is_same(&known, &shown)) {
                found = Some(Arc::clone(access));
            }
        }
        found
    }

    fn is_deaf_to(&self, address: IpAddr) -> bool {
        let failures = lock(&self.failures);
        failures
            .get(&address)
            .is_some_and(|(count, since)| *count >= MAX_FAILURES && since.elapsed() < DEAF)
    }

    fn note_failure(&self, address: IpAddr) {
        let mut failures = lock(&self.failures);
        if failures.len() >= MAX_ADDRESSES {
            failures.clear();
        }
        let (count, since) = failures.entry(address).or_insert((0, Instant::now()));
        if since.elapsed() >= DEAF {
            *count = 0;
        }
        (*count, *since) = (*count + 1, Instant::now());
    }
}

/// Constant in time: no early end.
fn is_same(one: &[u8; 32], other: &[u8; 32]) -> bool {
    let differences = one.iter().zip(other).fold(0, |sum, (a, b)| sum | (a ^ b));
    std::hint::black_box(differences) == 0
}

/// The token that a request shows.
fn token(headers: &HeaderMap) -> Option<Vec<u8>> {
    let shown = headers.get(header::AUTHORIZATION)?.to_str().ok()?;
    let (scheme, rest) = shown.split_once(' ')?;
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(rest.trim().as_bytes().to_vec());
    }
    let pair = scheme
        .eq_ignore_ascii_case("basic")
        .then(|| STANDARD.decode(rest.trim()).ok())??;
    let colon = pair.iter().position(|byte| *byte == b':')?;
    Some(pair[colon + 1..].to_vec())
}

/// Why somebody is not let in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refused {
    Nobody,
    Deaf,
    Role,
    CrossSite,
}

impl Refused {
    pub(super) fn answer(self, to: &HeaderMap) -> Response {
        let (status, reason) = match self {
            Self::Nobody => (
                StatusCode::UNAUTHORIZED,
                "show a token or a client certificate",
            ),
            Self::Deaf => (
                StatusCode::TOO_MANY_REQUESTS,
                "too many wrong tokens; wait a minute",
            ),
            Self::Role => (StatusCode::FORBIDDEN, "this is not yours to do or to see"),
            Self::CrossSite => (StatusCode::FORBIDDEN, "a page from elsewhere can't do this"),
        };
        let mut answer = refusal(status, reason);
        if self == Self::Nobody {
            let ask = HeaderValue::from_static(challenge(to));
            answer.headers_mut().insert(header::WWW_AUTHENTICATE, ask);
        }
        answer
    }
}

/// What a refused caller is asked for. Our page asks for a token itself: for a request that a page's script
/// makes (the browser says so), `Basic` would open the browser's own window over it.
fn challenge(to: &HeaderMap) -> &'static str {
    match to.get("sec-fetch-mode") {
        Some(mode) if mode != "navigate" => "Bearer realm=\"emberfix\"",
        _ => "Basic realm=\"emberfix\", charset=\"UTF-8\"",
    }
}

/// What everyone gets: the page's own files, which hold no word of any fire, and the way to sign in.
fn is_open(method: &Method, path: &str) -> bool {
    let reads = *method == Method::GET || *method == Method::HEAD;
    let of_page = path == "/" || path.starts_with("/page/") || path.starts_with("/icons/");
    let signs = *method == Method::POST || *method == Method::DELETE;
    reads && of_page || signs && path == "/session"
}

/// Lets a request in, or not.
pub(super) async fn admit(
    State(keeper): State<Arc<Doorkeeper>>,
    mut request: Request,
    next: Next,
) -> Response {
    match examine(&keeper, &request) {
        Ok(caller) => {
            request.extensions_mut().insert(caller);
            next.run(request).await
        }
        Err(refused) => refused.answer(request.headers()).into_response(),
    }
}

fn examine(keeper: &Doorkeeper, request: &Request) -> Result<Caller, Refused> {
    let nobody = Peer {
        address: IpAddr::from([0, 0, 0, 0]),
        certificate: None,
    };
    let peer = request.extensions().get::<Peer>().unwrap_or(&nobody);
    let (method, path) = (request.method(), request.uri().path());
    let reads = *method == Method::GET || *method == Method::HEAD;
    if !reads && is_cross_site(request.headers()) {
        return Err(Refused::CrossSite);
    }
    if is_open(method, path) {
        return Ok(Caller::Anyone);
    }
    let caller = keeper.recognise(peer, request.headers())?;
    match &caller {
        Caller::Known(access) if !may(access.role, reads, path) => Err(Refused::Role),
        _ => Ok(caller),
    }
}

/// The browser itself says so, and no page can make it say otherwise.
fn is_cross_site(headers: &HeaderMap) -> bool {
    let text = |name| {
        headers
            .get(name)
            .and_then(|value: &HeaderValue| value.to_str().ok())
    };
    let site = text(header::HeaderName::from_static("sec-fetch-site"));
    let origin = text(header::ORIGIN).and_then(|origin| origin.split_once("://"));
    let foreign = origin.is_some_and(|(_, host)| Some(host) != text(header::HOST));
    matches!(site, Some("cross-site" | "same-site"))
        || foreign
        || text(header::ORIGIN) == Some("null")
}

fn may(role: Role, reads: bool, path: &str) -> bool {
    let of_aircraft = path == "/actions"
        || ["/alarms", "/track", "/wire", "/chips"]
            .iter()
            .any(|root| !reads && (path == *root || path.starts_with(&format!("{root}/"))));
    match role {
        Role::Aircraft => of_aircraft || path == "/health",
        Role::Screen => reads && !of_aircraft,
        Role::Operator => !of_aircraft,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_role_has_its_own_ways() {
        use Role::{Aircraft, Operator, Screen};
        let cases = [
            (false, "/alarms", [true, false, false]),
            (false, "/alarms/a-1/chips/2", [true, false, false]),
            (true, "/actions", [true, false, false]),
            (true, "/health", [true, true, true]),
            (true, "/alarms.geojson", [false, true, true]),
            (true, "/events", [false, true, true]),
            (true, "/session", [false, true, true]),
            (false, "/incidents/a-1/actions", [false, false, true]),
        ];
        for (reads, path, allowed) in cases {
            let found = [Aircraft, Screen, Operator].map(|role| may(role, reads, path));
            assert_eq!(found, allowed, "{path}");
        }
    }

    #[test]
    fn only_the_pages_own_files_and_the_way_to_sign_in_are_open() {
        let open = ["/", "/page/main.js", "/icons/fire.png"];
        assert!(open.iter().all(|path| is_open(&Method::GET, path)));
        assert!(is_open(&Method::POST, "/session"));
        for (method, path) in [
            (Method::GET, "/session"),
            (Method::GET, "/events"),
            (Method::GET, "/incidents.geojson"),
            (Method::GET, "/pages"),
            (Method::POST, "/"),
            (Method::POST, "/page/main.js"),
            (Method::POST, "/alarms"),
        ] {
            assert!(!is_open(&method, path), "{method} {path}");
        }
    }

    #[test]
    fn a_token_comes_as_bearer_or_as_the_password_of_any_user() {
        let shown = |text: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::AUTHORIZATION, HeaderValue::from_static(text));
            token(&headers)
        };
        assert_eq!(shown("Bearer abc").as_deref(), Some(&b"abc"[..]));
        // "duty:a:b"
        assert_eq!(shown("basic ZHV0eTphOmI=").as_deref(), Some(&b"a:b"[..]));
        assert_eq!(shown("Basic !!!"), None);
        assert_eq!(shown("abc"), None);
    }
}
