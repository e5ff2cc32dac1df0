//! Authentication of every request: the visitor, the client address and the host name.

use crate::api::{LIVE_DATA_PATH, Mistake};
use crate::gate::{Refusal, Visitor};
use crate::health::{LIVE_PATH, READY_PATH};
use crate::page::ASSETS;
use crate::server::Server;
use crate::serving::ClientAddress;
use crate::tokens::PageRole;
use axum::extract::rejection::JsonRejection;
use axum::extract::{ConnectInfo, Request, State};
use axum::http::header::{HOST, ORIGIN, RETRY_AFTER, SET_COOKIE};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Version};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Deserialize;
use serde_json::json;
use spandrel_bus::is_loopback;
use spandrel_service::{Audit, Refused};
use std::net::IpAddr;
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
    if let Err(mistake) = check_request(&server, &request, address.0) {
        return mistake.into_response();
    }
    if server.gate().is_open() {
        return next.run(request).await;
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
        Ok((visitor, end)) if only_reads(&request) || visitor.role == PageRole::Operator => {
            request.extensions_mut().insert(visitor);
            end.and_then(|end| request.extensions_mut().insert(end));
            next.run(request).await
        }
        Ok((visitor, _)) => {
            let what = "the token is a viewer token, which only permits reading";
            let who = format!("{} ({})", address.0, visitor.name);
            Audit::of_process().refuse(Refused::Forbidden, &who, what);
            Mistake::new(StatusCode::FORBIDDEN, what, "must be an operator token").into_response()
        }
        Err(refusal) => refused(refusal, address.0),
    }
}

/// Returns `true` if a request changes nothing.
fn only_reads(request: &Request) -> bool {
    [Method::GET, Method::HEAD].contains(request.method())
}

/// Checks what does not depend on a token: the host name, and the origin of a request that changes
/// something or opens a WebSocket.
fn check_request(server: &Server, request: &Request, address: IpAddr) -> Result<(), Mistake> {
    let headers = request.headers();
    let audited = |refused: Refused| {
        move |mistake: Mistake| {
            Audit::of_process().refuse(refused, &address.to_string(), mistake.what());
            mistake
        }
    };
    check_one_host(headers, request.version()).map_err(audited(Refused::Malformed))?;
    if server.gate().is_open() {
        check_host(headers).map_err(audited(Refused::ForeignHost))?;
    }
    if !only_reads(request) || request.uri().path() == LIVE_DATA_PATH {
        let is_secure = server.gate().is_secure();
        check_origin(headers, is_secure).map_err(audited(Refused::ForeignOrigin))?;
    }
    Ok(())
}

/// Checks that a request has one host name. Of two names, a proxy and the page might use different
/// ones.
fn check_one_host(headers: &HeaderMap, version: Version) -> Result<(), Mistake> {
    let count = headers.get_all(HOST).iter().count();
    let is_right = count == 1 || (count == 0 && version < Version::HTTP_11);
    is_right.then_some(()).ok_or_else(|| {
        Mistake::new(
            StatusCode::BAD_REQUEST,
            format!("the request has {count} Host headers"),
            "must have one",
        )
    })
}

/// Rejects requests from pages of other sites. Browsers send the origin of a request, and scripts
/// do not.
///
/// A page over TLS has only origins with `https`. Another page over plain HTTP may have a proxy
/// with TLS in front of it.
pub(crate) fn check_origin(headers: &HeaderMap, is_secure: bool) -> Result<(), Mistake> {
    let Some(origin) = headers.get(ORIGIN) else {
        return Ok(());
    };
    let origin = origin
        .to_str()
        .ok()
        .and_then(|origin| origin.split_once("://"))
        .filter(|(scheme, _)| *scheme == "https" || (*scheme == "http" && !is_secure))
        .map(|(_, authority)| authority);
    let host = headers.get(HOST).and_then(|host| host.to_str().ok());
    match (origin, host) {
        (Some(origin), Some(host)) if origin == host => Ok(()),
        (_, _) => Err(Mistake::new(
            StatusCode::FORBIDDEN,
            "the request comes from another site",
            "must come from this site",
        )),
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
            let allowed = "must be an address of this machine, such as 127.0.0.1; \
                           dashboard.tokens opens the page to others";
            Err(Mistake::new(
                StatusCode::FORBIDDEN,
                "the request uses a foreign host name",
                allowed,
            ))
        }
    }
}

fn refused(refusal: Refusal, address: IpAddr) -> Response {
    let audit = |refused, why| Audit::of_process().refuse(refused, &address.to_string(), why);
    match refusal {
        Refusal::Unknown | Refusal::Wrong => {
            if refusal == Refusal::Wrong {
                audit(Refused::WrongToken, "the page does not know the token");
            }
            let allowed =
                "must have a token (Authorization: Bearer TOKEN) created by spandrel token";
            Mistake::new(StatusCode::UNAUTHORIZED, "no valid token", allowed).into_response()
        }
        Refusal::Later(pause) => {
            let seconds = pause.as_secs().max(1);
            let what = "too many wrong tokens from this address";
            audit(Refused::RepeatedToken, what);
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
        Err(refusal) => refused(refusal, address.0),
    }
}

/// Checks a token and starts a session.
pub(crate) async fn enter(
    State(server): State<Arc<Server>>,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    shown: Result<Json<Shown>, JsonRejection>,
) -> Result<Response, Mistake> {
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
        Err(refusal) => return Ok(refused(refusal, address.0)),
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

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(origin: Option<&str>) -> HeaderMap {
        let mut headers = HeaderMap::new();
        headers.insert(HOST, "127.0.0.1:8080".parse().unwrap());
        if let Some(origin) = origin {
            headers.insert(ORIGIN, origin.parse().unwrap());
        }
        headers
    }

    #[test]
    fn only_a_page_of_this_server_may_send() {
        assert!(
            check_origin(&headers(None), false).is_ok(),
            "a script says nothing"
        );
        assert!(check_origin(&headers(Some("http://127.0.0.1:8080")), false).is_ok());
        for other in [
            "http://127.0.0.1:8081",
            "https://example.org",
            "ftp://127.0.0.1:8080",
            "null",
        ] {
            assert!(
                check_origin(&headers(Some(other)), false).is_err(),
                "{other}"
            );
        }
    }

    /// Regression: a page over TLS accepted the origin `http://` with its own name, so that anybody
    /// in the network could send requests through a browser.
    #[test]
    fn a_page_over_tls_has_no_origin_without_tls() {
        let from = |origin, is_secure| check_origin(&headers(Some(origin)), is_secure).is_ok();
        assert!(from("https://127.0.0.1:8080", true) && !from("http://127.0.0.1:8080", true));
        assert!(
            from("https://127.0.0.1:8080", false),
            "a proxy with TLS is in front of the page"
        );
    }

    #[test]
    fn a_request_has_one_host() {
        let is_taken = |count: usize, version| {
            let mut headers = HeaderMap::new();
            for _ in 0..count {
                headers.append(HOST, "127.0.0.1".parse().unwrap());
            }
            check_one_host(&headers, version).is_ok()
        };
        assert!(is_taken(1, Version::HTTP_11) && is_taken(0, Version::HTTP_10));
        assert!(!is_taken(2, Version::HTTP_11) && !is_taken(0, Version::HTTP_11));
        assert!(!is_taken(2, Version::HTTP_10));
    }
}
