//! The HTTP interface: its routes, and the error responses.

use crate::annotations::Noted;
use crate::entrance::{self, SESSION_PATH, pass, signed};
use crate::entries::{person, text, wrong};
use crate::gate::{SessionEnd, Visitor};
use crate::health::{self, LIVE_PATH, READY_PATH};
use crate::history::{self, Asked, Format, Refused, Span, Unkept};
use crate::judgements;
use crate::lasting_alert::{check_loss_acknowledgeable, lasting_alerts};
use crate::live;
use crate::log::{self, FromHistory, WantedLog};
use crate::metrics::{self, metrics};
use crate::overview::overview;
use crate::page::{ASSETS, TRANSPORT_SECURITY, with_headers};
use crate::recorded::{self, Source};
use crate::reports::WantedReport;
use crate::samples::{self, WantedSamples, read_range};
use crate::server::{Server, now_ns};
use crate::serving::ClientAddress;
use crate::store::Store;
use crate::stretch::Stretch;
use crate::view::{Standing, changes, standing_alerts};
use axum::extract::rejection::{JsonRejection, QueryRejection};
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::{ConnectInfo, DefaultBodyLimit, Path, Query, Request, State};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE, STRICT_TRANSPORT_SECURITY};
use axum::http::{HeaderValue, Method, StatusCode, Uri};
use axum::middleware::{Next, from_fn, from_fn_with_state, map_response, map_response_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, delete, get, post};
use axum::{Extension, Json, Router};
use serde::Deserialize;
use serde_json::json;
use spandrel_bus::{Acknowledgement, AlertState, Annotation, Name, Service};
use spandrel_service::{Audit, Refused as Audited};
use std::sync::{Arc, MutexGuard};
use std::time::Duration;

/// OpenAPI description of this interface.
const OPENAPI: &str = include_str!("../openapi.json");
/// Path of the WebSocket.
pub(crate) const LIVE_DATA_PATH: &str = "/api/live";
/// Maximum size of a request body (bytes).
const LARGEST_BODY: usize = 16 * 1024;
/// Time limit for a whole request, mostly for receiving its body. A reply takes a few seconds at
/// most.
const REQUEST_WITHIN: Duration = Duration::from_secs(30);
/// Maximum size of a WebSocket message from a browser (bytes). The server ignores these messages.
const LARGEST_MESSAGE: usize = 4 * 1024;

type Shared = State<Arc<Server>>;

/// Returns all routes of the description: path, method and handler.
fn routes() -> Vec<(&'static str, Method, MethodRouter<Arc<Server>>)> {
    vec![
        ("/api/structures", Method::GET, get(structures)),
        ("/api/structures/{structure}", Method::GET, get(structure)),
        (
            "/api/structures/{structure}/history",
            Method::GET,
            get(read_history),
        ),
        (
            "/api/structures/{structure}/log",
            Method::GET,
            get(read_log),
        ),
        (
            "/api/structures/{structure}/spectra",
            Method::GET,
            get(spectra),
        ),
        (
            "/api/structures/{structure}/samples",
            Method::GET,
            get(read_samples),
        ),
        (
            "/api/structures/{structure}/judgements/{quantity}/course",
            Method::GET,
            get(read_course),
        ),
        (
            "/api/structures/{structure}/alerts/{parameter}/acknowledge",
            Method::POST,
            post(acknowledge),
        ),
        (
            "/api/structures/{structure}/judgements/{quantity}/acknowledge",
            Method::POST,
            post(acknowledge_loss),
        ),
        (
            "/api/structures/{structure}/annotations",
            Method::POST,
            post(annotate),
        ),
        ("/events/{structure}/{file}", Method::GET, get(read_report)),
        ("/api/alerts", Method::GET, get(alerts)),
        (LIVE_DATA_PATH, Method::GET, get(listen)),
        (SESSION_PATH, Method::GET, get(entrance::who)),
        (SESSION_PATH, Method::POST, post(entrance::enter)),
        (SESSION_PATH, Method::DELETE, delete(entrance::leave)),
        ("/api/openapi.json", Method::GET, get(openapi)),
        ("/metrics", Method::GET, get(read_metrics)),
        (LIVE_PATH, Method::GET, get(health::live)),
        (READY_PATH, Method::GET, get(health::ready)),
    ]
}

/// Combines the interface and the page into one router.
pub(crate) fn router(server: Arc<Server>) -> Router {
    let with_page = ASSETS.iter().fold(Router::new(), |router, asset| {
        router.route(asset.path, get(*asset))
    });
    let all = routes()
        .into_iter()
        .fold(with_page, |router, (path, _, answer)| {
            router.route(path, answer)
        });
    all.fallback(nothing_there)
        .method_not_allowed_fallback(wrong_method)
        .layer(DefaultBodyLimit::max(LARGEST_BODY))
        .layer(from_fn_with_state(server.clone(), pass))
        .layer(from_fn(in_time))
        .layer(map_response(with_headers))
        .layer(map_response_with_state(
            server.clone(),
            with_transport_security,
        ))
        .with_state(server)
}

/// Aborts a request that exceeds its time limit.
async fn in_time(request: Request, next: Next) -> Response {
    tokio::time::timeout(REQUEST_WITHIN, next.run(request))
        .await
        .unwrap_or_else(|_elapsed| {
            let allowed = format!("must be complete within {} s", REQUEST_WITHIN.as_secs());
            Mistake::new(
                StatusCode::REQUEST_TIMEOUT,
                "the request takes too long",
                allowed,
            )
            .into_response()
        })
}

/// Adds the header that makes browsers connect over TLS only, if the page is served over TLS.
async fn with_transport_security(State(server): Shared, mut response: Response) -> Response {
    if server.gate().is_secure() {
        response.headers_mut().insert(
            STRICT_TRANSPORT_SECURITY,
            HeaderValue::from_static(TRANSPORT_SECURITY),
        );
    }
    response
}

/// An error response that states the mistake and the permitted values.
#[derive(Debug)]
pub(crate) struct Mistake {
    status: StatusCode,
    what: String,
    allowed: String,
}

impl Mistake {
    pub(crate) fn new(
        status: StatusCode,
        what: impl Into<String>,
        allowed: impl Into<String>,
    ) -> Self {
        Self {
            status,
            what: what.into(),
            allowed: allowed.into(),
        }
    }

    /// Returns what is wrong, without what is permitted.
    pub(crate) fn what(&self) -> &str {
        &self.what
    }
}

impl IntoResponse for Mistake {
    fn into_response(self) -> Response {
        (
            self.status,
            Json(json!({"error": self.what, "allowed": self.allowed})),
        )
            .into_response()
    }
}

impl From<Refused> for Mistake {
    fn from(Refused { what, allowed }: Refused) -> Self {
        Self::new(StatusCode::BAD_REQUEST, what, allowed)
    }
}

impl From<QueryRejection> for Mistake {
    fn from(rejection: QueryRejection) -> Self {
        Self::new(
            StatusCode::BAD_REQUEST,
            rejection.body_text(),
            "must be as in /api/openapi.json",
        )
    }
}

impl From<JsonRejection> for Mistake {
    fn from(rejection: JsonRejection) -> Self {
        Self::new(
            rejection.status(),
            rejection.body_text(),
            "must be JSON as in /api/openapi.json",
        )
    }
}

impl From<WebSocketUpgradeRejection> for Mistake {
    fn from(rejection: WebSocketUpgradeRejection) -> Self {
        Self::new(
            rejection.status(),
            rejection.body_text(),
            "must open a WebSocket",
        )
    }
}

async fn nothing_there(uri: Uri) -> Mistake {
    let what = format!("unknown path {}", uri.path());
    Mistake::new(
        StatusCode::NOT_FOUND,
        what,
        "must be a path of /api/openapi.json, or / for the page",
    )
}

async fn wrong_method(method: Method, uri: Uri) -> Mistake {
    let what = format!("{} does not support {method}", uri.path());
    Mistake::new(
        StatusCode::METHOD_NOT_ALLOWED,
        what,
        "must be a method of /api/openapi.json",
    )
}

/// Returns the store of a structure.
fn find<'s>(server: &'s Server, name: &str) -> Result<MutexGuard<'s, Store>, Mistake> {
    server.store(name).ok_or_else(|| {
        let allowed = format!("must be one of: {}", server.names().join(", "));
        Mistake::new(
            StatusCode::NOT_FOUND,
            format!("structure `{name}` is not known"),
            allowed,
        )
    })
}

async fn openapi() -> Response {
    ([(CONTENT_TYPE, "application/json")], OPENAPI).into_response()
}

async fn read_metrics(State(server): Shared) -> Result<Response, Mistake> {
    let text = metrics(server.stores(), &Audit::of_process().counts());
    let text = text.map_err(|error| {
        Mistake::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            error.to_string(),
            "try again",
        )
    })?;
    Ok(([(CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response())
}

async fn structures(State(server): Shared) -> Response {
    Json(json!({"structures": server.overviews()})).into_response()
}

async fn structure(State(server): Shared, Path(name): Path<String>) -> Result<Response, Mistake> {
    let store = find(&server, &name)?;
    Ok(Json(json!({"about": store.about, "overview": overview(&store), "standing": Standing::of(&store)}))
        .into_response())
}

async fn spectra(State(server): Shared, Path(name): Path<String>) -> Result<Response, Mistake> {
    let store = find(&server, &name)?;
    let nodes: Vec<_> = store.spectra.values().collect();
    Ok(Json(json!({"nodes": nodes})).into_response())
}

async fn read_history(
    State(server): Shared,
    Path(name): Path<String>,
    asked: Result<Query<Asked>, QueryRejection>,
) -> Result<Response, Mistake> {
    let Query(asked) = asked?;
    let (mut span, earlier, source) = {
        let store = find(&server, &name)?;
        let (span, earlier) = history::read(&store, &history::Request::new(&asked, &store)?);
        (span, earlier, Source::of(&store))
    };
    let replies = server.ask_history(&name, earlier).await;
    if replies.is_incomplete && asked.format == Format::Csv {
        // A table has no place to state that rows are missing.
        return Err(Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "the history did not answer in time",
            "try again",
        ));
    }
    span.incomplete = replies.is_incomplete;
    for (earlier, answer) in replies.spans {
        span.put_before(&earlier, &answer);
    }
    let unkept = std::mem::take(&mut span.unkept);
    match recorded::read(&server, &name, &source, unkept.clone()).await {
        Ok(tables) => {
            let both = unkept.iter().zip(tables);
            both.for_each(|(range, table)| span.put_recorded(range, table));
        }
        // A table has no place to state that rows are missing.
        Err(mistake)
            if asked.format == Format::Csv && refuses(mistake.status, &source, &span, &unkept) =>
        {
            return Err(mistake);
        }
        Err(mistake) => span.unread_waveforms = Some(mistake.what),
    }
    Ok(match asked.format {
        Format::Json => Json(span).into_response(),
        Format::Csv => csv(&name, span.csv()),
    })
}

/// Returns `true` if a table is not written, because waveforms could not be read.
///
/// If ingest is busy, another attempt gives the whole table. Otherwise, the table contains what
/// there is, unless it would not show that waveforms are missing.
fn refuses(why: StatusCode, source: &Source, span: &Span, unkept: &[Unkept]) -> bool {
    match why {
        _ if !source.has_ingest => span.is_empty(), // no attempt can help
        StatusCode::SERVICE_UNAVAILABLE => true,
        StatusCode::NOT_FOUND => span.is_empty(), // nothing was recorded
        _ => span.lacks(unkept),
    }
}

async fn read_log(
    State(server): Shared,
    Path(name): Path<String>,
    asked: Result<Query<log::Asked>, QueryRejection>,
) -> Result<Response, Mistake> {
    let Query(asked) = asked?;
    let wanted = WantedLog::new(&asked)?;
    let has_history = find(&server, &name)?.state.has(Service::History);
    let (history, log) = if has_history {
        let log = server.ask_log(&name, &wanted.query()).await;
        let history = log
            .as_ref()
            .map_or(FromHistory::NoReply, |_| FromHistory::Read);
        (history, log)
    } else {
        (FromHistory::Absent, None)
    };
    // After the query, so that nothing that happens meanwhile is missing.
    let past = find(&server, &name)?.past();
    let write = move || wanted.response(past, history, log);
    let written = tokio::task::spawn_blocking(write).await;
    written.map_err(|error| {
        Mistake::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            error.to_string(),
            "try again",
        )
    })
}

/// Returns a response that a browser saves as `NAME.csv`.
fn csv(name: &str, text: String) -> Response {
    let headers = [
        (CONTENT_TYPE, "text/csv; charset=utf-8".to_owned()),
        (
            CONTENT_DISPOSITION,
            format!("attachment; filename=\"{name}.csv\""),
        ),
    ];
    (headers, text).into_response()
}

async fn read_samples(
    State(server): Shared,
    Path(name): Path<String>,
    asked: Result<Query<samples::Asked>, QueryRejection>,
) -> Result<Response, Mistake> {
    let Query(asked) = asked?;
    let (wanted, sensors, rate_hz) = {
        let store = find(&server, &name)?;
        let (sensors, rate_hz) = (&store.about.drawing.sensors, store.about.sampling_rate_hz);
        let wanted = WantedSamples::new(&asked, sensors.len(), rate_hz)?;
        (wanted, sensors.clone(), rate_hz)
    };
    let stretch = Stretch::new(wanted.from_ns, wanted.to_ns, sensors.len());
    let (place, stretch) = read_range(&server, &name, stretch).await?;
    let write = move || {
        let response = wanted.write(&name, stretch, &sensors, rate_hz);
        drop(place); // the memory of the samples is free again
        response
    };
    let written = tokio::task::spawn_blocking(write).await;
    let failed = |error: String| {
        Mistake::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            error,
            "try another format",
        )
    };
    written
        .map_err(|error| failed(error.to_string()))?
        .map_err(|error| failed(error.to_string()))
}

async fn read_course(
    State(server): Shared,
    Path((structure, quantity)): Path<(String, String)>,
    asked: Result<Query<judgements::Asked>, QueryRejection>,
) -> Result<Response, Mistake> {
    let Query(asked) = asked?;
    let (quantity, query) = {
        let store = find(&server, &structure)?;
        (judgements::quantity(&store, &quantity)?, asked.query()?)
    };
    let course = server.ask_course(&structure, &quantity, &query).await;
    let course = course.ok_or_else(|| {
        Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "the service judge does not answer",
            "must run for this structure; try again",
        )
    })?;
    Ok(match asked.format {
        Format::Json => Json(course).into_response(),
        Format::Csv => csv(&format!("{structure}-{quantity}"), course.csv()),
    })
}

async fn read_report(
    State(server): Shared,
    Path((structure, file)): Path<(String, String)>,
) -> Result<Response, Mistake> {
    drop(find(&server, &structure)?); // names the structures there are
    let wanted = WantedReport::parse(&structure, &file)?;
    let page = server.ask_report(&structure, &wanted.report).await;
    wanted.response(page)
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct AlertFilter {
    structure: Option<String>,
    state: Option<AlertState>,
}

async fn alerts(
    State(server): Shared,
    filter: Result<Query<AlertFilter>, QueryRejection>,
) -> Result<Response, Mistake> {
    let Query(filter) = filter?;
    if let Some(name) = &filter.structure {
        drop(find(&server, name)?);
    }
    let (mut standing, mut changed) = (Vec::new(), Vec::new());
    for store in server.stores() {
        if filter
            .structure
            .as_ref()
            .is_some_and(|name| *name != store.about.name)
        {
            continue;
        }
        let fits = |state: AlertState| filter.state.is_none_or(|wanted| wanted == state);
        let alerts = standing_alerts(&store).filter(|alert| fits(alert.message.state));
        standing.extend(alerts.map(|alert| json!(alert)));
        let losses = lasting_alerts(&store).filter(|loss| fits(loss.state));
        standing.extend(losses.map(|loss| json!(loss)));
        let all = changes(&store, usize::MAX).into_iter();
        let all = all.filter(|change| fits(change.state()));
        changed.extend(all.map(|change| (change.changed_ns(), json!(change))));
    }
    changed.sort_by_key(|(time_ns, _)| std::cmp::Reverse(*time_ns));
    let changed: Vec<_> = changed.into_iter().map(|(_, alert)| alert).collect();
    Ok(Json(json!({"standing": standing, "changes": changed})).into_response())
}

/// Body of an acknowledgement: who acknowledges, and why.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Seen {
    who: String,
    #[serde(default)]
    note: String,
}

async fn acknowledge(
    State(server): Shared,
    Path((structure, parameter)): Path<(String, String)>,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    visitor: Option<Extension<Visitor>>,
    seen: Result<Json<Seen>, JsonRejection>,
) -> Result<Response, Mistake> {
    let Json(Seen { who, note }) = seen?;
    let who = person(&who, "must name the person who has seen the alert")?;
    let note = text("note", &note)?;
    let before = check_acknowledgeable(&*find(&server, &structure)?, &parameter)?;
    let (Ok(structure), Ok(parameter)) = (Name::new(&*structure), Name::new(&*parameter)) else {
        let allowed = "must be lower-case letters, digits and hyphens";
        return Err(wrong("invalid name", allowed));
    };
    let who = signed(who, visitor.as_ref());
    check_certificate(&server, address, Audited::Acknowledgement, &who)?;
    let acknowledgement = Acknowledgement {
        structure,
        parameter,
        time_ns: now_ns(),
        who,
        note,
    };
    match server.acknowledge(&acknowledgement, before).await {
        Ok(Some(state)) => Ok(Json(json!({"sent": true, "state": state})).into_response()),
        Ok(None) => Ok((
            StatusCode::ACCEPTED,
            Json(json!({"sent": true, "state": null})),
        )
            .into_response()),
        Err(error) => Err(Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            error.to_string(),
            "try again",
        )),
    }
}

async fn annotate(
    State(server): Shared,
    Path(name): Path<String>,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    visitor: Option<Extension<Visitor>>,
    noted: Result<Json<Noted>, JsonRejection>,
) -> Result<Response, Mistake> {
    let Json(noted) = noted?;
    let annotation = noted.annotation(&*find(&server, &name)?, now_ns())?;
    let kept = send_annotation(&server, address, visitor.as_ref(), annotation).await?;
    let status = match kept {
        true => StatusCode::OK,
        false => StatusCode::ACCEPTED,
    };
    Ok((status, Json(json!({"sent": true, "kept": kept}))).into_response())
}

async fn acknowledge_loss(
    State(server): Shared,
    Path((structure, quantity)): Path<(String, String)>,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    visitor: Option<Extension<Visitor>>,
    seen: Result<Json<Seen>, JsonRejection>,
) -> Result<Response, Mistake> {
    let Json(Seen { who, note }) = seen?;
    let who = person(&who, "must name the person who has seen the loss")?;
    let note = text("note", &note)?;
    let quantity = check_loss_acknowledgeable(&*find(&server, &structure)?, &quantity)?;
    let allowed = "must be lower-case letters, digits and hyphens";
    let structure = Name::new(&*structure).map_err(|_| wrong("invalid name", allowed))?;
    let annotation = Annotation::acknowledging(structure, quantity, now_ns(), who, note);
    let kept = send_annotation(&server, address, visitor.as_ref(), annotation).await?;
    let (status, state) = match kept {
        true => (StatusCode::OK, Some(AlertState::Acknowledged)),
        false => (StatusCode::ACCEPTED, None),
    };
    Ok((status, Json(json!({"sent": true, "state": state}))).into_response())
}

/// Publishes what a person notes. Returns whether the service `judge` confirms in time that it has
/// kept it.
async fn send_annotation(
    server: &Server,
    address: ClientAddress,
    visitor: Option<&Extension<Visitor>>,
    mut annotation: Annotation,
) -> Result<bool, Mistake> {
    annotation.who = signed(annotation.who, visitor);
    check_certificate(server, address, Audited::Annotation, &annotation.who)?;
    let has_judge = find(server, annotation.structure.as_str())?
        .state
        .has(Service::Judge);
    if !has_judge {
        return Err(Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "the service judge does not run, so the annotation was not sent",
            "try again once it runs",
        ));
    }
    let visitor = visitor.map(|Extension(visitor)| visitor);
    let noted = server.gate().note(visitor, address.0, server.since_start());
    if let Err(pause) = noted {
        let what = "too many annotations within an hour";
        let who = format!("{} ({})", address.0, annotation.who);
        Audit::of_process().refuse(Audited::Annotation, &who, what);
        let allowed = format!("must wait for {} s", pause.as_secs().max(1));
        return Err(Mistake::new(StatusCode::TOO_MANY_REQUESTS, what, allowed));
    }
    server.annotate(&annotation).await.map_err(|error| {
        Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            error.to_string(),
            "try again",
        )
    })
}

/// Rejects a message of a person if the router would drop it. A role that may acknowledge may also
/// annotate.
fn check_certificate(
    server: &Server,
    address: ClientAddress,
    refused: Audited,
    person: &str,
) -> Result<(), Mistake> {
    let Some(why) = server.cannot_acknowledge() else {
        return Ok(());
    };
    let who = format!("{} ({person})", address.0);
    Audit::of_process().refuse(refused, &who, why);
    let message = refused.as_str();
    Err(Mistake::new(
        StatusCode::FORBIDDEN,
        format!("the certificate of this page does not permit an {message}: {why}"),
        "must be sent from a page or a command with a certificate of such a role",
    ))
}

/// Returns the state of an alert that can be acknowledged.
fn check_acknowledgeable(store: &Store, parameter: &str) -> Result<AlertState, Mistake> {
    if !store
        .about
        .parameters
        .iter()
        .any(|known| known.name == parameter)
    {
        let names: Vec<&str> = store
            .about
            .parameters
            .iter()
            .map(|known| known.name.as_str())
            .collect();
        let allowed = format!("must be one of: {}", names.join(", "));
        return Err(Mistake::new(
            StatusCode::NOT_FOUND,
            format!("parameter `{parameter}` is not known"),
            allowed,
        ));
    }
    let alert = store.state.alerts.get(parameter);
    let state = alert.map(|alert| alert.state);
    let is_seen = alert.is_some_and(|alert| alert.stands() && !alert.is_unseen());
    match state {
        Some(
            state @ (AlertState::Raised
            | AlertState::Unconfirmed
            | AlertState::Cleared
            | AlertState::Pending),
        ) if !is_seen => Ok(state),
        _ => {
            let state = state.map_or("not known", AlertState::as_str);
            let what = format!("the alert of {parameter} is {state}");
            Err(Mistake::new(
                StatusCode::CONFLICT,
                what,
                "must be raised, unconfirmed, pending or cleared, and not acknowledged",
            ))
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Wanted {
    structure: Option<String>,
}

async fn listen(
    State(server): Shared,
    ConnectInfo(address): ConnectInfo<ClientAddress>,
    wanted: Result<Query<Wanted>, QueryRejection>,
    session: Option<Extension<SessionEnd>>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Mistake> {
    let Query(Wanted { structure }) = wanted?;
    if let Some(name) = &structure {
        drop(find(&server, name)?);
    }
    let upgrade = upgrade?
        .max_message_size(LARGEST_MESSAGE)
        .max_frame_size(LARGEST_MESSAGE);
    let Some(place) = server.admit(address.0) else {
        return Err(Mistake::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "too many browsers are connected",
            "try again later",
        ));
    };
    Ok(upgrade.on_upgrade(async move |socket| {
        let session = session.map(|Extension(session)| session);
        tokio::select! {
            () = live::serve(socket, server, structure, session, &place) => {}
            () = place.must_leave() => {} // the audit log has the reason
        }
    }))
}

#[cfg(test)]
mod tests;
