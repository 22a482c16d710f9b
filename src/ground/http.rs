//! The HTTP side: routes, limits, refusals.
//!
//! A refusal is JSON, `{"error": ".."}`, with the reason in words. Requests must name the station
//! by an address, `localhost` or a configured name, and bodies must call themselves JSON: a web
//! page from elsewhere, open in the duty officer's browser, can neither read nor post alarms.

mod incidents;

use super::access::{self, Access, Caller, Doorkeeper};
use super::events::{self, MAX_STREAMS, Show};
use super::receive::Reception;
use super::store::{Kept, StoreError};
use super::tracks::Source;
use super::{Ping, ReceiveError, Station, lock, now, session};
use crate::deliver::envelope;
use crate::deliver::http::{RECEIPT_HEADER, WIRE_KIND};
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{DefaultBodyLimit, Query, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::sse::{KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use serde::Deserialize;
use serde_json::json;
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Largest body, bytes; an alarm has about one thousand.
const MAX_BODY: usize = 64 * 1024;
/// From the end of the head to the head of the answer; a stream's events come after that.
const MAX_REQUEST_TIME: Duration = Duration::from_secs(10);
/// Source of alarms as the store names it.
const LINK_NAME: &str = "http";
/// Alarms read from the store at once.
const PAGE: u32 = 512;

type Shared = State<Arc<Station>>;

pub(super) fn router(
    station: Arc<Station>,
    host_names: Arc<[String]>,
    keeper: Doorkeeper,
) -> Router {
    let keeper = Arc::new(keeper);
    let counting = Arc::clone(&station);
    Router::new()
        .merge(super::page::routes())
        .merge(super::screens::routes())
        .route("/alarms", post(post_alarm))
        .route("/alarms/test", post(post_test))
        .route("/wire", post(post_wire))
        .route("/alarms.geojson", get(alarms))
        .route("/incidents.geojson", get(incidents::collection))
        .route("/incidents/changes", get(incidents::changes))
        .route("/incidents/{id}", get(incidents::whole))
        .route("/incidents/{id}/chip.jpg", get(incidents::chip))
        .route("/incidents/{id}/actions", post(incidents::act))
        .route("/alarms/{id}/chips/{revision}", post(incidents::take_chip))
        .route("/actions", get(incidents::for_aircraft))
        .route("/track", post(post_track))
        .route("/track.geojson", get(tracks))
        .route("/events", get(event_stream))
        .route(
            "/session",
            get(session::who).post(session::begin).delete(session::end),
        )
        .route("/health", get(health))
        .fallback(|| async { refusal(StatusCode::NOT_FOUND, "nothing lives here; see /") })
        .with_state(station)
        .layer(DefaultBodyLimit::max(MAX_BODY))
        .layer(middleware::from_fn(in_time))
        .layer(middleware::from_fn_with_state(Arc::clone(&counting), small))
        .layer(Extension(Arc::clone(&keeper)))
        .layer(middleware::from_fn_with_state(keeper, access::admit))
        .layer(middleware::from_fn_with_state(host_names, only_for_us))
        .layer(middleware::map_response(guarded))
        .layer(middleware::from_fn_with_state(counting, count_refusals))
}

/// What was refused, by status, for `/health`.
async fn count_refusals(State(station): Shared, request: Request, next: Next) -> Response {
    let response = next.run(request).await;
    let status = response.status();
    if status.is_client_error() || status.is_server_error() {
        *lock(&station.refusals).entry(status.as_u16()).or_default() += 1;
    }
    response
}

/// What an alarm or a position says of itself.
#[derive(Deserialize)]
struct Named {
    uav: String,
    id: Option<String>,
}

impl Named {
    /// What names nobody is refused where it is read.
    fn read(body: &[u8]) -> Option<Self> {
        #[derive(Deserialize)]
        struct Alarm {
            properties: Named,
        }
        let alarm = serde_json::from_slice::<Alarm>(body).map(|alarm| alarm.properties);
        alarm.or_else(|_| serde_json::from_slice(body)).ok()
    }
}

/// Refuses an aircraft that speaks in another's name.
fn speaks(caller: &Caller, body: &[u8]) -> Option<Response> {
    let Caller::Known(access) = caller else {
        return None;
    };
    let named = Named::read(body)?;
    (!caller.speaks_for(&named.uav)).then(|| not_for(access, &named.uav))
}

/// Refuses an aircraft that speaks in another's name, or of another's alarm.
fn owns(caller: &Caller, body: &[u8]) -> Option<Response> {
    let Caller::Known(_) = caller else {
        return None;
    };
    if let Some(refused) = speaks(caller, body) {
        return Some(refused);
    }
    let Named { uav, id } = Named::read(body)?;
    let id = id.filter(|id| !is_own(id, &uav))?;
    let reason = format!("alarm {id:?} is none of {uav:?}");
    Some(refusal(StatusCode::FORBIDDEN, reason))
}

fn not_for(access: &Access, uav: &str) -> Response {
    let reason = format!("{} does not speak for {uav:?}", access.name);
    refusal(StatusCode::FORBIDDEN, reason)
}

/// An aircraft's alarms are called after it, with a number.
fn is_own(id: &str, uav: &str) -> bool {
    let number = id.strip_prefix(uav).and_then(|rest| rest.strip_prefix('-'));
    number.is_some_and(|number| number.parse::<u32>().is_ok())
}

pub(super) fn refusal(status: StatusCode, reason: impl std::fmt::Display) -> Response {
    (status, axum::Json(json!({ "error": reason.to_string() }))).into_response()
}

/// Refuses a body by the size that it announces, before any of it is waited for.
async fn small(State(station): Shared, request: Request, next: Next) -> Response {
    let announced = request.headers().get(header::CONTENT_LENGTH);
    let announced = announced.and_then(|length| length.to_str().ok()?.parse::<u64>().ok());
    if announced.is_some_and(|length| length > MAX_BODY as u64) {
        station.refuse(&BodyError::Large, LINK_NAME);
        return BodyError::Large.answer();
    }
    next.run(request).await
}

/// A handler that has not answered in time is dropped.
async fn in_time(request: Request, next: Next) -> Response {
    tokio::time::timeout(MAX_REQUEST_TIME, next.run(request))
        .await
        .unwrap_or_else(|_| {
            let reason = format!(
                "no complete request within {} s",
                MAX_REQUEST_TIME.as_secs()
            );
            refusal(StatusCode::REQUEST_TIMEOUT, reason)
        })
}

/// Refuses requests for a host that we are not: a foreign name that was made to point here.
async fn only_for_us(
    State(host_names): State<Arc<[String]>>,
    request: Request,
    next: Next,
) -> Response {
    let host = request
        .headers()
        .get(header::HOST)
        .and_then(|host| host.to_str().ok());
    match host {
        Some(host) if is_ours(host, &host_names) => next.run(request).await,
        _ => refusal(
            StatusCode::MISDIRECTED_REQUEST,
            "this host name is not ours; add it to host_names in the ground configuration",
        ),
    }
}

fn is_ours(host: &str, host_names: &[String]) -> bool {
    let port = host
        .rfind(':')
        .filter(|colon| !host[*colon..].contains(']'));
    let name = port
        .map_or(host, |colon| &host[..colon])
        .trim_matches(['[', ']']);
    name.parse::<IpAddr>().is_ok()
        || name.eq_ignore_ascii_case("localhost")
        || host_names
            .iter()
            .any(|ours| ours.eq_ignore_ascii_case(name))
}

/// The page loads nothing from elsewhere and sits in no one's frame; the browser is told so.
async fn guarded(mut response: Response) -> Response {
    const HEADERS: [(HeaderName, &str); 4] = [
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
             img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
        ),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-cache"),
    ];
    for (name, value) in HEADERS {
        // The page itself brings a policy of its own.
        response
            .headers_mut()
            .entry(name)
            .or_insert(HeaderValue::from_static(value));
    }
    response
}

/// Why a body was not read.
#[derive(Debug, thiserror::Error)]
pub(super) enum BodyError {
    #[error("Content-Type is {kind:?}, allowed are application/json and application/geo+json")]
    Kind { kind: String },
    #[error("the body is larger than {MAX_BODY} bytes")]
    Large,
    #[error("the body did not come: {source}")]
    Broken { source: BytesRejection },
}

impl BodyError {
    pub(super) fn answer(&self) -> Response {
        let status = match self {
            Self::Kind { .. } => StatusCode::UNSUPPORTED_MEDIA_TYPE,
            Self::Large => StatusCode::PAYLOAD_TOO_LARGE,
            Self::Broken { source } => source.status(),
        };
        refusal(status, self)
    }
}

/// The body, if it is small enough and calls itself JSON.
pub(super) fn json_body(
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Bytes, BodyError> {
    let kind = headers
        .get(header::CONTENT_TYPE)
        .and_then(|kind| kind.to_str().ok());
    let kind = kind
        .unwrap_or_default()
        .split(';')
        .next()
        .unwrap_or_default()
        .trim();
    if !["application/json", "application/geo+json"].contains(&kind) {
        return Err(BodyError::Kind {
            kind: kind.to_owned(),
        });
    }
    body.map_err(|source| match source.status() {
        StatusCode::PAYLOAD_TOO_LARGE => BodyError::Large,
        _ => BodyError::Broken { source },
    })
}

async fn post_alarm(
    State(station): Shared,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let body = match json_body(&headers, body) {
        Ok(body) => body,
        Err(error) => {
            station.refuse(&error, LINK_NAME);
            return error.answer();
        }
    };
    if let Some(refused) = owns(&caller, &body) {
        return refused;
    }
    let header = headers
        .get(envelope::HTTP_HEADER)
        .and_then(|h| h.to_str().ok());
    let received = station.reception.http(&station, header, &body, LINK_NAME);
    let (alarm, kept, signed) = match received.await {
        Ok(received) => received,
        Err(error) => return not_taken(&error),
    };
    let status = match kept {
        Kept::New { .. } => StatusCode::CREATED,
        Kept::Again => StatusCode::OK,
    };
    let properties = alarm.properties;
    let receipt = json!({ "id": properties.id, "revision": properties.revision, "stored": true });
    let signed = signed.and_then(|signed| HeaderValue::from_str(&signed).ok());
    let signed = signed.map(|signed| [(HeaderName::from_static(RECEIPT_HEADER), signed)]);
    (status, signed, axum::Json(receipt)).into_response()
}

/// One datagram of the wire, and its answer, for aircraft that no datagram leaves.
///
/// Its kind is one that a foreign page can't send unasked.
async fn post_wire(
    State(station): Shared,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    // Who has no key is believed by its token alone: then the name has to be the token's.
    if let (Caller::Known(access), Ok(body)) = (&caller, &body)
        && let Some(uav) = Reception::speaker(body)
        && !caller.speaks_for(&uav)
    {
        return not_for(access, &uav);
    }
    let kind = headers.get(header::CONTENT_TYPE);
    let answer = match body {
        Ok(body) if kind.is_some_and(|kind| kind == WIRE_KIND) => {
            station.reception.datagram(&station, &body).await
        }
        _ => None,
    };
    match answer {
        Some(answer) => ([(header::CONTENT_TYPE, WIRE_KIND)], answer).into_response(),
        None => refusal(
            StatusCode::BAD_REQUEST,
            "no datagram that this station answers",
        ),
    }
}

/// An alarm that is only a test: checked as a real one and shown as a test, kept nowhere.
async fn post_test(
    State(station): Shared,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let body = match json_body(&headers, body) {
        Ok(body) => body,
        Err(error) => return error.answer(),
    };
    if let Some(refused) = speaks(&caller, &body) {
        return refused;
    }
    match station.test(&body, LINK_NAME) {
        Ok(alarm) => {
            let properties = alarm.properties;
            let receipt =
                json!({ "id": properties.id, "revision": properties.revision, "stored": false });
            axum::Json(receipt).into_response()
        }
        Err(error) => not_taken(&error),
    }
}

fn not_taken(error: &ReceiveError) -> Response {
    let status = match error {
        ReceiveError::Alarm(_) | ReceiveError::Covariance { .. } | ReceiveError::Envelope(_) => {
            StatusCode::BAD_REQUEST
        }
        ReceiveError::Trust(_) => StatusCode::FORBIDDEN,
        ReceiveError::Store(StoreError::Conflict { .. }) => StatusCode::CONFLICT,
        ReceiveError::Store(_) | ReceiveError::Ledger(_) => StatusCode::SERVICE_UNAVAILABLE,
    };
    refusal(status, error)
}

async fn post_track(
    State(station): Shared,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let body = match json_body(&headers, body) {
        Ok(body) => body,
        Err(error) => return error.answer(),
    };
    if let Some(refused) = speaks(&caller, &body) {
        return refused;
    }
    match Ping::from_json(&body).and_then(|ping| station.moved(ping, Source::Service)) {
        Ok(()) => StatusCode::NO_CONTENT.into_response(),
        Err(error) => refusal(StatusCode::BAD_REQUEST, error),
    }
}

async fn alarms(State(station): Shared) -> Response {
    let features = station
        .with_store(|store| {
            let mut features: Vec<String> = Vec::new();
            let mut after = 0;
            loop {
                let page = store.latest_after(after, PAGE)?;
                let Some(last) = page.last() else {
                    return Ok(features);
                };
                after = last.row;
                features.extend(page.into_iter().map(|row| row.feature));
            }
        })
        .await;
    match features {
        Ok(features) => geojson(format!(
            "{{\"type\":\"FeatureCollection\",\"features\":[{}]}}",
            features.join(",\n")
        )),
        Err(error) => refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    }
}

async fn tracks(State(station): Shared) -> Response {
    let tracks = station.tracks().to_geojson();
    geojson(tracks.to_string())
}

fn geojson(text: String) -> Response {
    ([(header::CONTENT_TYPE, "application/geo+json")], text).into_response()
}

#[derive(Deserialize)]
struct Resume {
    /// For clients that can't set the header.
    last_event_id: Option<i64>,
    #[serde(default)]
    show: Show,
}

async fn event_stream(
    State(station): Shared,
    headers: HeaderMap,
    Query(resume): Query<Resume>,
) -> Response {
    let header = headers.get("last-event-id").and_then(|id| id.to_str().ok());
    let last = header
        .and_then(|id| id.trim().parse().ok())
        .or(resume.last_event_id);
    match events::open(&station, resume.show, last) {
        Some(events) => Sse::new(events)
            .keep_alive(KeepAlive::default())
            .into_response(),
        None => refusal(
            StatusCode::SERVICE_UNAVAILABLE,
            format!("there are {MAX_STREAMS} event streams already"),
        ),
    }
}

async fn health(State(station): Shared) -> Response {
    let census = match station.with_store(|store| store.census()).await {
        Ok(census) => census,
        Err(error) => return refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    };
    let counters = &station.counters;
    let aircraft: Vec<_> = station.tracks().latest().cloned().collect();
    let mavlink = lock(&station.mavlink).clone();
    axum::Json(json!({
        "status": "ok",
        "version": env!("CARGO_PKG_VERSION"),
        "now": now().rfc3339(),
        "wire": station.reception.health(),
        "store": station.store.id(),
        "incidents": census.incidents,
        "alarms": census.alarms,
        "since_start": {
            "stored": counters.stored.load(Ordering::Relaxed),
            "repeated": counters.repeated.load(Ordering::Relaxed),
            "refused": counters.refused.load(Ordering::Relaxed),
        },
        "waiting": station.writer.waiting(),
        "streams": counters.streams.load(Ordering::Relaxed),
        "mavlink": mavlink,
        "bus": station.bus,
        "turned_away": &*station.turned,
        "refused_by_status": lock(&station.refusals).clone(),
        "aircraft": aircraft,
    }))
    .into_response()
}

#[cfg(test)]
mod tests {
    use super::is_ours;

    #[test]
    fn addresses_and_configured_names_are_ours_and_a_rebound_name_is_not() {
        let names = ["ground.example".to_owned()];
        for host in [
            "127.0.0.1:8470",
            "[::1]:8470",
            "[::1]",
            "localhost",
            "Ground.example:80",
            "10.0.0.7",
        ] {
            assert!(is_ours(host, &names), "{host}");
        }
        for host in ["evil.example", "127.0.0.1.evil.example:8470", ""] {
            assert!(!is_ours(host, &names), "{host}");
        }
    }
}
