//! The screens that are asked for over HTTP.

use super::metrics::{Kind, Page, resident_bytes};
use super::{aircraft, kml, view};
use crate::ground::http::refusal;
use crate::ground::incident::{Incident, OperatorState};
use crate::ground::{Station, now};
use axum::Router;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

type Shared = State<Arc<Station>>;

/// Routes of this room.
pub(in crate::ground) fn routes() -> Router<Arc<Station>> {
    Router::new()
        .route("/emberfix.kml", get(network_link))
        .route("/incidents.kml", get(incidents))
        .route("/cap.atom", get(feed))
        .route("/cap/{name}", get(message))
        .route("/metrics", get(metrics))
        .route("/map.json", get(map))
        .route("/tiles/{zoom}/{x}/{y}", get(tile))
}

fn answer(kind: &'static str, text: String) -> Response {
    ([(header::CONTENT_TYPE, kind)], text).into_response()
}

/// Where this station is reached: as configured, or as the asker did, whose name for it was checked to
/// be ours.
fn base(station: &Station, headers: &HeaderMap) -> String {
    if let Some(url) = &station.public_url {
        return url.clone();
    }
    let host = headers
        .get(header::HOST)
        .and_then(|host| host.to_str().ok());
    format!("{}://{}", station.scheme, host.unwrap_or("localhost"))
}

async fn network_link(State(station): Shared, headers: HeaderMap) -> Response {
    answer(
        "application/vnd.google-earth.kml+xml",
        kml::network_link(&base(&station, &headers)),
    )
}

async fn incidents(State(station): Shared, headers: HeaderMap) -> Response {
    let incidents = Arc::clone(&station.screens.incidents.borrow());
    let base = base(&station, &headers);
    let text = kml::document(&incidents, &aircraft(&station), &base, now());
    answer("application/vnd.google-earth.kml+xml", text)
}

const NO_CAP: &str = "CAP is off: the ground configuration has no [cap] table";

async fn feed(State(station): Shared, headers: HeaderMap) -> Response {
    let Some(cap) = &station.screens.cap else {
        return refusal(StatusCode::NOT_FOUND, NO_CAP);
    };
    match cap.feed(&base(&station, &headers), now()) {
        Ok(feed) => answer("application/atom+xml", feed),
        Err(error) => refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    }
}

async fn message(State(station): Shared, Path(name): Path<String>) -> Response {
    let Some(cap) = &station.screens.cap else {
        return refusal(StatusCode::NOT_FOUND, NO_CAP);
    };
    match cap.message(name.strip_suffix(".xml").unwrap_or(&name)) {
        Ok(Some(xml)) => answer("application/cap+xml", xml),
        Ok(None) => refusal(
            StatusCode::NOT_FOUND,
            "no such message was issued; see /cap.atom",
        ),
        Err(error) => refusal(StatusCode::SERVICE_UNAVAILABLE, error),
    }
}

async fn map(State(station): Shared) -> Response {
    let map = station.screens.map.as_ref();
    axum::Json(map.map_or(serde_json::Value::Null, super::tiles::MapConfig::told)).into_response()
}

async fn tile(State(station): Shared, Path((zoom, x, y)): Path<(u8, u32, String)>) -> Response {
    let y = y.strip_suffix(".png").and_then(|y| y.parse().ok());
    let (Some(y), true) = (y, station.screens.map.is_some()) else {
        return refusal(StatusCode::NOT_FOUND, "no such tile");
    };
    let read = tokio::task::spawn_blocking(move || station.screens.map.as_ref()?.tile(zoom, x, y));
    match read.await.ok().flatten() {
        Some(png) => ([(header::CONTENT_TYPE, "image/png")], png).into_response(),
        None => refusal(StatusCode::NOT_FOUND, "no such tile"),
    }
}

async fn metrics(State(station): Shared) -> Response {
    let incidents = Arc::clone(&station.screens.incidents.borrow());
    let mut page = Page::default();
    incidents_in(&mut page, &incidents);
    station_in(&mut page, &station);
    screens_in(&mut page, &station);
    answer("text/plain; version=0.0.4; charset=utf-8", page.into_text())
}

fn incidents_in(page: &mut Page, incidents: &[Arc<Incident>]) {
    let open = incidents.iter().filter(|incident| view::is_open(incident));
    let unseen = open
        .clone()
        .filter(|incident| incident.operator.state == OperatorState::New)
        .count();
    let open = open.count();
    page.family(
        "emberfix_incidents",
        Kind::Gauge,
        "Incidents, by whether they still burn.",
    )
    .sample(&[("state", "open")], open)
    .sample(&[("state", "closed")], incidents.len() - open);
    page.family(
        "emberfix_incidents_unacknowledged",
        Kind::Gauge,
        "Open incidents that nobody has seen.",
    )
    .sample(&[], unseen);
}

fn station_in(page: &mut Page, station: &Station) {
    let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    let counters = &station.counters;
    page.family(
        "emberfix_alarms_total",
        Kind::Counter,
        "Alarm revisions that came, by what became of them.",
    )
    .sample(&[("result", "stored")], read(&counters.stored))
    .sample(&[("result", "repeated")], read(&counters.repeated))
    .sample(&[("result", "refused")], read(&counters.refused));
    page.family("emberfix_event_streams", Kind::Gauge, "Open event streams.")
        .sample(&[], read(&counters.streams));
    let mut heard = page.family(
        "emberfix_aircraft_heard_timestamp_seconds",
        Kind::Gauge,
        "When an aircraft last said where it is.",
    );
    for ping in aircraft(station) {
        heard.sample(&[("uav", &ping.uav)], ping.at.unix_ns() as f64 * 1e-9);
    }
    if let Some(bytes) = resident_bytes() {
        page.family(
            "process_resident_memory_bytes",
            Kind::Gauge,
            "Memory in use.",
        )
        .sample(&[], bytes);
    }
    page.family("emberfix_build_info", Kind::Gauge, "Which program this is.")
        .sample(&[("version", env!("CARGO_PKG_VERSION"))], 1);
}

fn screens_in(page: &mut Page, station: &Station) {
    let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    let screens = &station.screens;
    let mut connected = page.family(
        "emberfix_cot_connected",
        Kind::Gauge,
        "Whether a TAK receiver is reached.",
    );
    for (to, health) in &screens.tak {
        connected.sample(
            &[("to", to)],
            u8::from(health.connected.load(Ordering::Relaxed)),
        );
    }
    let mut sent = page.family(
        "emberfix_cot_events_total",
        Kind::Counter,
        "Events told to a TAK receiver.",
    );
    for (to, health) in &screens.tak {
        sent.sample(&[("to", to)], read(&health.sent));
    }
    let mut failed = page.family(
        "emberfix_cot_failures_total",
        Kind::Counter,
        "Times that a TAK receiver was lost or not reached.",
    );
    for (to, health) in &screens.tak {
        failed.sample(&[("to", to)], read(&health.failed));
    }
    if let Some(health) = &screens.adsb {
        page.family(
            "emberfix_adsb_markers_total",
            Kind::Counter,
            "Markers sent.",
        )
        .sample(&[], read(&health.sent));
        page.family(
            "emberfix_adsb_autopilots_heard",
            Kind::Gauge,
            "1: an autopilot is behind the port, and sending has ended.",
        )
        .sample(&[], read(&health.refused));
    }
}
