//! Authentication of every request: the visitor, the client address and the host name.

use crate::api::Mistake;
use crate::gate::{Refusal, Visitor};
use crate::health::{LIVE_PATH, READY_PATH};
use crate::page::ASSETS;
use crate::server::Server;
use crate::serving::ClientAddress;
use crate::tokens::PageRole;
use axum::extract::rejection::JsonRejection;
use axum::extract::{ConnectInfo, Request, State};
use axum::http::header::{HOST, RETRY_AFTER, SET_COOKIE};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Deserialize;
use serde_json::json;
use spandrel_bus::is_loopback;
use std::sync::Arc;

/// Path at which a browser presents its token.
pub(crate) const SESSION_PATH: &str = "/api/session";

/// Forwards a permitted request and replies to all others.
///
/// The page's files are public, because they contain no data of a site.
pub(crate) async fn pass(
    State(server): State<Arc<Server>>,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    mut request: Request,
    next: Next,
) -> Response {
    if server.gate().is_open() {
        return match check_host(request.headers()) {
            Ok(()) => next.run(request).await,
            Err(mistake) => mistake.into_response(),
        };
    }
    let path = request.uri().path();
    let is_free = [SESSION_PATH, LIVE_PATH, READY_PATH].contains(&path)
        || ASSETS.iter().any(|asset| asset.path == path);
    if is_free {
        return next.run(request).await;
    }
    match server
        .gate()
        .admit_for_long(request.headers(), address.0, server.since_start())
    {
        Ok((visitor, end))
            if request.method() == Method::GET || visitor.role == PageRole::Operator =>
        {
            request.extensions_mut().insert(visitor);
            end.and_then(|end| request.extensions_mut().insert(end));
            next.run(request).await
        }
        Ok(_) => {
            let what = "the token is a viewer token, which only permits reading";
            Mistake::new(StatusCode::FORBIDDEN, what, "must be an operator token").into_response()
        }
        Err(refusal) => refused(refusal),
    }
}

/// Checks that the request uses a name or address of this machine.
///
/// Without tokens, the page is for this machine only. Another site could resolve its own name to
/// this machine's address, and its page could then read this interface. Requests under such a name
/// are rejected.
fn check_host(headers: &HeaderMap) -> Result<(), Mistake> {
    let host = headers
        .get(HOST)
        .and_then(|host| host.to_str().ok())
        .unwrap_or_default();
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        Some(_) | None => host,
    };
    let name = name
        .strip_prefix('[')
        .and_then(|name| name.strip_suffix(']'))
        .unwrap_or(name);
    match is_loopback(name) {
        true => Ok(()),
        false => {
            let allowed = "must be an address of this machine, such as 127.0.0.1; dashboard.tokens opens the page to others";
            Err(Mistake::new(
                StatusCode::FORBIDDEN,
                "the request uses a foreign host name",
                allowed,
            ))
        }
    }
}

fn refused(refusal: Refusal) -> Response {
    match refusal {
        Refusal::Unknown => {
            let allowed =
                "must have a token (Authorization: Bearer TOKEN) created by spandrel token";
            Mistake::new(StatusCode::UNAUTHORIZED, "no valid token", allowed).into_response()
        }
        Refusal::Later(pause) => {
            let seconds = pause.as_secs().max(1);
            let what = "too many wrong tokens from this address";
            let mistake = Mistake::new(
                StatusCode::TOO_MANY_REQUESTS,
                what,
                format!("must wait for {seconds} s"),
            );
            let mut response = mistake.into_response();
            response
                .headers_mut()
                .insert(RETRY_AFTER, HeaderValue::from(seconds));
            response
        }
    }
}

/// A token as the page sends it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Shown {
    token: String,
}

/// Reports whether a token is required, and whom the request's token identifies.
pub(crate) async fn who(
    State(server): State<Arc<Server>>,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    headers: HeaderMap,
) -> Response {
    if server.gate().is_open() {
        return Json(json!({"open": true})).into_response();
    }
    match server
        .gate()
        .admit(&headers, address.0, server.since_start())
    {
        Ok(Visitor { name, role }) => {
            Json(json!({"open": false, "name": name, "role": role})).into_response()
        }
        Err(refusal) => refused(refusal),
    }
}

/// Checks a token and starts a session.
pub(crate) async fn enter(
    State(server): State<Arc<Server>>,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    headers: HeaderMap,
    shown: Result<Json<Shown>, JsonRejection>,
) -> Result<Response, Mistake> {
    crate::api::check_origin(&headers)?;
    // serde's error for an invalid body could quote the token.
    let allowed = "must be {\"token\": \"…\"}";
    let Ok(Json(Shown { token })) = shown else {
        return Err(Mistake::new(
            StatusCode::BAD_REQUEST,
            "the body is not a token",
            allowed,
        ));
    };
    let now = server.since_start();
    let visitor = match server.gate().check(token.trim(), address.0, now) {
        Ok(visitor) => visitor,
        Err(refusal) => return Ok(refused(refusal)),
    };
    let answer = json!({"open": false, "name": visitor.name, "role": visitor.role});
    let cookie = server.gate().begin(visitor, now);
    let cookie = cookie.map_err(|error| {
        Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            error.to_string(),
            "try again",
        )
    })?;
    Ok(([(SET_COOKIE, cookie)], Json(answer)).into_response())
}

/// Ends a session.
pub(crate) async fn leave(
    State(server): State<Arc<Server>>,
    headers: HeaderMap,
) -> Result<Response, Mistake> {
    crate::api::check_origin(&headers)?;
    let cookie = server.gate().end(&headers);
    let cookie = cookie.map_err(|error| {
        Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            error.to_string(),
            "try again",
        )
    })?;
    Ok(([(SET_COOKIE, cookie)], Json(json!({"left": true}))).into_response())
}

/// Returns the name of the person who acknowledges, followed by the name on the token if the names
/// differ.
pub(crate) fn signed(who: String, visitor: Option<&Extension<Visitor>>) -> String {
    match visitor {
        Some(Extension(Visitor { name, .. })) if *name.as_str() != who => format!("{who} ({name})"),
        Some(_) | None => who,
    }
}
