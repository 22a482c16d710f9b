//! Incidents, their history and images, and what operators do with them.

use super::{Shared, geojson, json_body, refusal};
use crate::ground::access::Caller;
use crate::ground::action::{Action, Kind};
use crate::ground::store::{HistoryRow, Search, StoreError};
use crate::ground::writer::{Order, OrderError};
use crate::ground::{ChipError, Incident, News, Station, now};
use axum::Extension;
use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, QueryRejection};
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Redirect, Response};
use emberfix_frames::ServiceTime;
use serde::Deserialize;
use serde_json::{Value, json};
use std::sync::Arc;

/// Incidents of one answer.
const MAX_FOUND: u32 = 10_000;
/// Lines of history of one answer; the newest.
const MAX_HISTORY: u32 = 1_000;
/// Actions of one answer.
const MAX_ACTIONS: u32 = 256;
/// Longest name, note or key, characters.
const MAX_NAME: usize = 64;
const MAX_NOTE: usize = 500;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawSearch {
    bbox: Option<String>,
    since: Option<String>,
    until: Option<String>,
}

/// A query or a body that can't be meant.
#[derive(Debug, thiserror::Error)]
enum AskError {
    #[error("{key} is {value:?}, allowed is {allowed}")]
    Value {
        key: &'static str,
        value: String,
        allowed: &'static str,
    },
    #[error("not an action: {source}")]
    Syntax {
        #[from]
        source: serde_json::Error,
    },
}

impl RawSearch {
    fn check(self) -> Result<Search, AskError> {
        Ok(Search {
            bbox: self.bbox.map(bbox).transpose()?,
            since: self.since.map(|at| time("since", at)).transpose()?,
            until: self.until.map(|at| time("until", at)).transpose()?,
        })
    }
}

fn bbox(text: String) -> Result<[f64; 4], AskError> {
    let numbers: Option<Vec<f64>> = text
        .split(',')
        .map(|part| part.trim().parse().ok())
        .collect();
    let is_sound = |[west, south, east, north]: &[f64; 4]| {
        let longitudes = [west, east]
            .iter()
            .all(|longitude| (-180.0..=180.0).contains(*longitude));
        longitudes && -90.0 <= *south && south <= north && *north <= 90.0
    };
    numbers
        .and_then(|numbers| <[f64; 4]>::try_from(numbers).ok())
        .filter(is_sound)
        .ok_or(AskError::Value {
            key: "bbox",
            value: text,
            allowed: "west,south,east,north in degrees",
        })
}

fn time(key: &'static str, text: String) -> Result<ServiceTime, AskError> {
    ServiceTime::from_rfc3339(&text).ok_or(AskError::Value {
        key,
        value: text,
        allowed: "a time as in 2026-03-01T12:00:00Z (RFC 3339)",
    })
}

/// `GET /incidents.geojson?bbox=W,S,E,N&since=TIME&until=TIME`
pub(super) async fn collection(
    State(station): Shared,
    query: Result<Query<RawSearch>, QueryRejection>,
) -> Response {
    let search = match query {
        Ok(Query(raw)) => raw.check(),
        Err(error) => return refusal(StatusCode::BAD_REQUEST, error),
    };
    let features: Result<Vec<String>, StoreError> = match search {
        Ok(search) if search == Search::default() => Ok(standing(&station)),
        Ok(search) => {
            station
                .with_store(move |store| store.search(&search, MAX_FOUND))
                .await
        }
        Err(error) => return refusal(StatusCode::BAD_REQUEST, error),
    };
    match features {
        Ok(features) => geojson(format!(
            "{{\"type\":\"FeatureCollection\",\"features\":[{}]}}",
            features.join(",\n")
        )),
        Err(error) => refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    }
}

fn standing(station: &Station) -> Vec<String> {
    let incidents = station.incidents();
    incidents
        .iter()
        .map(|incident| incident.feature().to_string())
        .collect()
}

/// An id stands for an incident, for the one that it went into, or for one that is only on disk.
enum Found {
    Standing(Arc<Incident>),
    Heir(String),
    OnDisk(String),
}

async fn find(station: &Station, id: &str) -> Result<Option<Found>, StoreError> {
    if let Some(incident) = station.incident(id) {
        return Ok(Some(if incident.id == id {
            Found::Standing(incident)
        } else {
            Found::Heir(incident.id.clone())
        }));
    }
    let wanted = id.to_owned();
    let found = station
        .with_store(move |store| store.incident(&wanted))
        .await?;
    Ok(found.map(|on_disk| match on_disk.into {
        Some(heir) => Found::Heir(heir),
        None => Found::OnDisk(on_disk.feature),
    }))
}

fn unknown(id: &str) -> Response {
    refusal(StatusCode::NOT_FOUND, format!("there is no incident {id}"))
}

/// `GET /incidents/ID`: the incident with its history, newest first.
pub(super) async fn whole(State(station): Shared, Path(id): Path<String>) -> Response {
    let feature = match find(&station, &id).await {
        Ok(Some(Found::Standing(incident))) => incident.to_geojson(),
        Ok(Some(Found::OnDisk(feature))) => serde_json::from_str(&feature).unwrap_or_default(),
        Ok(Some(Found::Heir(heir))) => return moved(&heir, ""),
        Ok(None) => return unknown(&id),
        Err(error) => return refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    };
    let alarms: Vec<String> = feature["properties"]["alarms"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|member| Some(member["alarm"].as_str()?.to_owned()))
        .collect();
    let history = station
        .with_store(move |store| {
            Ok((
                store.history(&alarms, MAX_HISTORY)?,
                store.actions_on(&alarms)?,
            ))
        })
        .await;
    match history {
        Ok((rows, actions)) => geojson(with_history(feature, rows, &actions).to_string()),
        Err(error) => refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    }
}

fn moved(heir: &str, tail: &str) -> Response {
    let segment: String = heir.bytes().map(percent).collect();
    Redirect::temporary(&format!("/incidents/{segment}{tail}")).into_response()
}

/// Whatever is not plainly part of a path segment is written as `%XX` (RFC 3986).
fn percent(byte: u8) -> String {
    match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' | b'.' => {
            char::from(byte).to_string()
        }
        _ => format!("%{byte:02X}"),
    }
}

fn with_history(mut feature: Value, rows: Vec<HistoryRow>, actions: &[Action]) -> Value {
    let alarms = rows.into_iter().map(|row| {
        let alarm: Value = serde_json::from_str(&row.feature).unwrap_or_default();
        let line = json!({
            "kind": "alarm", "row": row.row, "at": row.received_at, "link": row.link, "alarm": alarm,
        });
        (row.row, line)
    });
    let actions = actions.iter().map(|action| {
        let line = json!({
            "kind": "action", "row": action.row, "at": action.at.rfc3339(), "action": action,
        });
        (action.row, line)
    });
    let mut lines: Vec<(i64, Value)> = alarms.chain(actions).collect();
    lines.sort_by_key(|(row, _)| -row);
    feature["history"] = lines.into_iter().map(|(_, line)| line).collect();
    feature
}

/// `GET /incidents/ID/chip.jpg`
pub(super) async fn chip(State(station): Shared, Path(id): Path<String>) -> Response {
    let Some(incident) = station.incident(&id) else {
        return unknown(&id);
    };
    let Some(path) = station.chip_of(&incident) else {
        return refusal(StatusCode::NOT_FOUND, "there is no image of this incident");
    };
    match tokio::fs::read(path).await {
        Ok(jpeg) => ([(header::CONTENT_TYPE, "image/jpeg")], jpeg).into_response(),
        Err(error) => refusal(StatusCode::NOT_FOUND, error),
    }
}

/// `POST /alarms/ID/chips/REVISION`: the image of an alarm.
pub(super) async fn take_chip(
    State(station): Shared,
    Path((alarm, revision)): Path<(String, u32)>,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let uav = alarm.rsplit_once('-').map_or("", |(uav, _)| uav);
    if !caller.speaks_for(uav) {
        return refusal(
            StatusCode::FORBIDDEN,
            format!("{alarm:?} is another aircraft's alarm"),
        );
    }
    let kind = headers.get(header::CONTENT_TYPE);
    if kind.is_none_or(|kind| kind != "image/jpeg") {
        let reason = "Content-Type of an image is image/jpeg";
        return refusal(StatusCode::UNSUPPORTED_MEDIA_TYPE, reason);
    }
    let jpeg = match body {
        Ok(jpeg) => jpeg.to_vec(),
        Err(error) => return refusal(error.status(), error),
    };
    match station.keep_chip(&alarm, revision, jpeg).await {
        Ok(kept) => {
            axum::Json(json!({ "id": alarm, "revision": revision, "kept": kept })).into_response()
        }
        Err(error @ ChipError::Disk { .. }) => refusal(StatusCode::SERVICE_UNAVAILABLE, error),
        Err(error) => refusal(StatusCode::BAD_REQUEST, error),
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawOrder {
    /// The client's own id of this action: sent again under the same id, it is done once.
    id: Option<String>,
    kind: Kind,
    by: String,
    note: Option<String>,
    with: Option<String>,
}

impl RawOrder {
    fn check(self, incident: String, caller: &Caller) -> Result<Order, AskError> {
        length("by", Some(&self.by), MAX_NAME, "1 to 64 characters")?;
        length("id", self.id.as_ref(), MAX_NAME, "1 to 64 characters")?;
        length("with", self.with.as_ref(), MAX_NAME, "1 to 64 characters")?;
        length("note", self.note.as_ref(), MAX_NOTE, "1 to 500 characters")?;
        Ok(Order {
            key: self.id.unwrap_or_else(|| uuid::Uuid::new_v4().to_string()),
            kind: self.kind,
            incident,
            with: self.with,
            // Whose token it was is on record, whatever the hand that used it calls itself.
            by: match caller.name() {
                Some(name) if name != self.by => format!("{} ({name})", self.by),
                _ => self.by,
            },
            note: self.note,
            at: now(),
        })
    }
}

fn length(
    key: &'static str,
    text: Option<&String>,
    most: usize,
    allowed: &'static str,
) -> Result<(), AskError> {
    match text {
        Some(text) if !(1..=most).contains(&text.chars().count()) => Err(AskError::Value {
            key,
            value: text.chars().take(most).collect(),
            allowed,
        }),
        _ => Ok(()),
    }
}

/// `POST /incidents/ID/actions`
pub(super) async fn act(
    State(station): Shared,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let body = match json_body(&headers, body) {
        Ok(body) => body,
        Err(error) => return error.answer(),
    };
    let raw = serde_json::from_slice::<RawOrder>(&body).map_err(AskError::from);
    let order = match raw.and_then(|raw| raw.check(id, &caller)) {
        Ok(order) => order,
        Err(error) => return refusal(StatusCode::BAD_REQUEST, error),
    };
    match station.act(order).await {
        Ok(done) => {
            let status = if done.again {
                StatusCode::OK
            } else {
                StatusCode::CREATED
            };
            let incident = done
                .action
                .alarms
                .first()
                .and_then(|alarm| station.incident(alarm));
            let incident = incident.map(|incident| incident.to_geojson());
            let answer = json!({ "recorded": true, "action": done.action, "incident": incident });
            (status, axum::Json(answer)).into_response()
        }
        Err(error) => refusal(status_of(&error), error),
    }
}

fn status_of(error: &OrderError) -> StatusCode {
    match error {
        OrderError::NoIncident { .. } => StatusCode::NOT_FOUND,
        OrderError::With { .. } => StatusCode::BAD_REQUEST,
        OrderError::Key { .. } => StatusCode::CONFLICT,
        OrderError::Store(_) => StatusCode::SERVICE_UNAVAILABLE,
    }
}

#[derive(Deserialize)]
pub(super) struct Fetch {
    uav: String,
    #[serde(default)]
    after: i64,
}

/// `GET /actions?uav=NAME&after=N`: what operators did with this aircraft's alarms. Asking for what
/// comes after N says that everything up to N has arrived.
pub(super) async fn for_aircraft(
    State(station): Shared,
    Extension(caller): Extension<Caller>,
    query: Result<Query<Fetch>, QueryRejection>,
) -> Response {
    let Fetch { uav, after } = match query {
        Ok(Query(fetch)) => fetch,
        Err(error) => return refusal(StatusCode::BAD_REQUEST, error),
    };
    if !caller.speaks_for(&uav) {
        return refusal(
            StatusCode::FORBIDDEN,
            format!("{uav:?} is another aircraft"),
        );
    }
    let asked = uav.clone();
    let told = station
        .with_store(move |store| store.actions_for(&asked, after, MAX_ACTIONS))
        .await;
    let told = match told {
        Ok(told) => told,
        Err(error) => return refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    };
    station.fetched(uav, after);
    let actions: Vec<Value> = told
        .into_iter()
        .map(|told| {
            json!({ "number": told.number, "alarm": told.alarm, "kind": told.kind, "at": told.at,
                    "by": told.by })
        })
        .collect();
    axum::Json(json!({ "actions": actions })).into_response()
}

/// `GET /incidents/changes?after=ROW`: what changed since a row, each incident once, oldest first.
pub(super) async fn changes(
    State(station): Shared,
    query: Result<Query<Since>, QueryRejection>,
) -> Response {
    let after = match query {
        Ok(Query(since)) => since.after,
        Err(error) => return refusal(StatusCode::BAD_REQUEST, error),
    };
    let news = station.incidents_since(after, MAX_FOUND as usize);
    let row = news.last().map_or(after, News::row);
    let news: Vec<Value> = news
        .iter()
        .map(|news| match news {
            News::Changed(incident) => incident.to_geojson(),
            News::Gone { row, id, into } => json!({ "gone": id, "row": row, "into": into }),
        })
        .collect();
    axum::Json(json!({ "row": row, "changes": news })).into_response()
}

#[derive(Deserialize)]
pub(super) struct Since {
    #[serde(default)]
    after: i64,
}
