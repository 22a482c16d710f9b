//! Signing in at the page: `POST /session` takes a token once, and the browser keeps it as a cookie that
//! no script can read (`HttpOnly`), that no other site's page can make it send (`SameSite=Strict`), and that
//! leaves it over TLS alone where the station has TLS (`Secure`, `__Host-`).
//!
//! The cookie is the token itself, so there is nothing here to keep or to lose: a station that starts
//! again has signed nobody out, and a token that is taken out of the configuration is out at once. It ends
//! with the browser, or with `DELETE /session`. A token never stands in an address.

use super::access::{Access, Caller, Doorkeeper, Role};
use super::http::{json_body, refusal};
use super::server::Peer;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use serde::Deserialize;
use serde_json::{Value, json};
use std::sync::Arc;

/// Longest token that is taken, bytes.
const MAX_TOKEN: usize = 512;

/// Name of the cookie. With its prefix the browser takes it over TLS only, and for this host alone.
fn name(tls: bool) -> &'static str {
    if tls { "__Host-emberfix" } else { "emberfix" }
}

/// The token that the cookie shows.
pub(super) fn shown(headers: &HeaderMap, tls: bool) -> Option<Vec<u8>> {
    let cookies = headers.get_all(header::COOKIE).iter();
    let cookies = cookies.filter_map(|line| line.to_str().ok());
    let mut pairs = cookies
        .flat_map(|line| line.split(';'))
        .filter_map(|pair| pair.trim().split_once('='));
    let (_, value) = pairs.find(|(found, _)| *found == name(tls))?;
    URL_SAFE_NO_PAD.decode(value).ok()
}

/// What the browser is told to keep; an empty value is forgotten at once.
fn set_cookie(token: &[u8], tls: bool) -> Option<HeaderValue> {
    let (name, value) = (name(tls), URL_SAFE_NO_PAD.encode(token));
    let secure = if tls { "; Secure" } else { "" };
    let age = if token.is_empty() { "; Max-Age=0" } else { "" };
    let cookie = format!("{name}={value}; Path=/; HttpOnly; SameSite=Strict{secure}{age}");
    HeaderValue::from_str(&cookie).ok()
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Shown {
    token: String,
}

/// `GET /session`: who the caller is here, and what for.
pub(super) async fn who(
    Extension(keeper): Extension<Arc<Doorkeeper>>,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Response {
    let by_cookie = shown(&headers, keeper.tls).is_some();
    Json(match &caller {
        Caller::Anyone => about(None, false),
        Caller::Known(access) => about(Some(access), by_cookie),
    })
    .into_response()
}

/// Where nobody is asked, everyone may act.
fn about(access: Option<&Access>, by_cookie: bool) -> Value {
    let role = access.map_or(Role::Operator, |access| access.role);
    let name = access.map(|access| &access.name);
    json!({ "name": name, "role": role, "signed_in": by_cookie })
}

/// `POST /session`: `{"token": ".."}`.
pub(super) async fn begin(
    Extension(keeper): Extension<Arc<Doorkeeper>>,
    Extension(peer): Extension<Peer>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let body = match json_body(&headers, body) {
        Ok(body) => body,
        Err(error) => return error.answer(),
    };
    let token = match serde_json::from_slice::<Shown>(&body) {
        Ok(shown) if (1..=MAX_TOKEN).contains(&shown.token.len()) => shown.token,
        Ok(_) => return refusal(StatusCode::BAD_REQUEST, "a token has 1 to 512 bytes"),
        // Not in the parser's words: they could quote the token.
        Err(_) => return refusal(StatusCode::BAD_REQUEST, "allowed is {\"token\": \"..\"}"),
    };
    match keeper.recognise_token(&peer, token.as_bytes()) {
        Ok(Caller::Anyone) => Json(about(None, false)).into_response(),
        Ok(Caller::Known(access)) if access.role == Role::Aircraft => refusal(
            StatusCode::FORBIDDEN,
            "this is an aircraft's token: it sends alarms and may not see the page",
        ),
        Ok(Caller::Known(access)) => {
            let cookie = set_cookie(token.as_bytes(), keeper.tls);
            let cookie = cookie.map(|cookie| [(header::SET_COOKIE, cookie)]);
            (cookie, Json(about(Some(&access), true))).into_response()
        }
        Err(refused) => refused.answer(&headers),
    }
}

/// `DELETE /session`: the browser forgets the token.
pub(super) async fn end(Extension(keeper): Extension<Arc<Doorkeeper>>) -> Response {
    let cookie = set_cookie(b"", keeper.tls);
    let cookie = cookie.map(|cookie| [(header::SET_COOKIE, cookie)]);
    (StatusCode::NO_CONTENT, cookie, ()).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_comes_back_from_its_cookie_among_others() {
        for tls in [false, true] {
            let token = "a b;c=\"ü".as_bytes();
            let cookie = set_cookie(token, tls).unwrap();
            let cookie = cookie.to_str().unwrap();
            assert!(cookie.contains("; HttpOnly; SameSite=Strict"), "{cookie}");
            assert_eq!(cookie.contains("; Secure"), tls, "{cookie}");
            let pair = cookie.split(';').next().unwrap();
            let mut headers = HeaderMap::new();
            headers.append(header::COOKIE, HeaderValue::from_static("theme=dark"));
            let line = HeaderValue::from_str(&format!("x=y; {pair}; z=1")).unwrap();
            headers.append(header::COOKIE, line);
            assert_eq!(shown(&headers, tls).as_deref(), Some(token));
            assert_eq!(shown(&headers, !tls), None, "the other's name");
        }
    }
}
