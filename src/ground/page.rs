//! The page's files, inside the binary: nothing comes from elsewhere.

use super::Station;
use super::http::refusal;
use axum::Router;
use axum::extract::{Path, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use std::sync::Arc;

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const JS: &str = "text/javascript; charset=utf-8";
const PNG: &str = "image/png";

/// One file: name, kind, bytes.
type File = (&'static str, &'static str, &'static [u8]);

const FILES: &[File] = &[
    ("style.css", CSS, include_bytes!("page/style.css")),
    ("actions.js", JS, include_bytes!("page/actions.js")),
    ("alert.js", JS, include_bytes!("page/alert.js")),
    ("card.js", JS, include_bytes!("page/card.js")),
    ("coords.js", JS, include_bytes!("page/coords.js")),
    ("dom.js", JS, include_bytes!("page/dom.js")),
    ("geo.js", JS, include_bytes!("page/geo.js")),
    ("keys.js", JS, include_bytes!("page/keys.js")),
    ("link.js", JS, include_bytes!("page/link.js")),
    ("list.js", JS, include_bytes!("page/list.js")),
    ("main.js", JS, include_bytes!("page/main.js")),
    ("map.js", JS, include_bytes!("page/map.js")),
    ("session.js", JS, include_bytes!("page/session.js")),
    ("state.js", JS, include_bytes!("page/state.js")),
    ("theme.js", JS, include_bytes!("page/theme.js")),
    ("tiles.js", JS, include_bytes!("page/tiles.js")),
    ("words.js", JS, include_bytes!("page/words.js")),
    ("fire.png", PNG, include_bytes!("page/icons/fire.png")),
    ("smoke.png", PNG, include_bytes!("page/icons/smoke.png")),
    ("out.png", PNG, include_bytes!("page/icons/out.png")),
    ("uav.png", PNG, include_bytes!("page/icons/uav.png")),
];

pub(super) fn routes() -> Router<Arc<Station>> {
    Router::new()
        .route("/", get(index))
        .route("/page/{name}", get(file))
        .route("/icons/{name}", get(file))
}

/// The page may load pictures from its own station and, where one is configured, from a tile server;
/// everything else from its own station alone.
async fn index(State(station): State<Arc<Station>>) -> Response {
    let tiles = station.screens.tile_origin().unwrap_or_default();
    let policy = format!(
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
         img-src 'self' data: {tiles}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    );
    let mut response = (
        [(header::CONTENT_TYPE, HTML)],
        include_str!("page/index.html"),
    )
        .into_response();
    // A configured origin was checked to be one, so this is always a header.
    if let Ok(policy) = HeaderValue::from_str(&policy) {
        response
            .headers_mut()
            .insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    response
}

async fn file(Path(name): Path<String>) -> Response {
    match FILES.iter().find(|(known, ..)| *known == name) {
        Some((_, kind, bytes)) => ([(header::CONTENT_TYPE, *kind)], *bytes).into_response(),
        None => refusal(StatusCode::NOT_FOUND, "the page has no such file"),
    }
}
