//! Serves the requests of all connections.

use crate::door::{Door, Guest};
use crate::places::Place;
use crate::request_lines::Checked;
use axum::Router;
use axum::body::Body;
use axum::extract::ConnectInfo;
use axum::http::header::CONNECTION;
use axum::http::{HeaderValue, StatusCode};
use hyper::Request;
use hyper::body::{Body as _, Bytes, Frame, Incoming, SizeHint};
use hyper::server::conn::http1::Builder;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use spandrel_service::{Audit, Refused};
use std::convert::Infallible;
use std::net::IpAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::debug;

/// Time limit for the head of a request, and for the pause between requests of a connection.
const HEAD_WITHIN: Duration = Duration::from_secs(20);

/// Address of the client of a request.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ClientAddress(pub(crate) IpAddr);

/// Accepts connections until `stopped`, then finishes the requests in progress.
pub(crate) async fn serve(mut door: Door, router: Router, stopped: watch::Receiver<bool>) {
    let mut connections = JoinSet::new();
    let mut stopping = stopped.clone();
    loop {
        tokio::select! {
            guest = door.next() => match guest {
                Some(guest) => drop(connections.spawn(answer(guest, router.clone(), stopped.clone()))),
                None => break,
            },
            Some(_) = connections.join_next() => {}
            // A dropped sender also means stop.
            _ = stopping.wait_for(|stopped| *stopped) => break,
        }
    }
    door.close().await; // the next run needs the address
    while connections.join_next().await.is_some() {}
}

/// Serves the requests of a connection until the connection ends or becomes a WebSocket.
async fn answer(
    Guest {
        stream,
        address,
        place,
    }: Guest,
    router: Router,
    mut stopped: watch::Receiver<bool>,
) {
    let router = TowerToHyperService::new(router);
    let client = ConnectInfo(ClientAddress(address.ip()));
    let (stream, findings) = Checked::new(stream);
    let found = findings.clone();
    let place = Arc::new(place);
    let must_leave = place.must_leave();
    let service = service_fn(move |request: Request<Incoming>| {
        let mut request = request.map(|body| Body::new(Received::new(body, place.clone())));
        request.extensions_mut().insert(client);
        let (reply, place, found) = (router.call(request), place.clone(), found.clone());
        async move {
            let mut reply = reply.await?;
            place.end_request(Instant::now());
            if found.must_end() && reply.status() != StatusCode::SWITCHING_PROTOCOLS {
                let close = HeaderValue::from_static("close");
                reply.headers_mut().insert(CONNECTION, close);
            }
            Ok::<_, Infallible>(reply)
        }
    });
    let mut builder = Builder::new();
    builder
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_WITHIN);
    let mut connection = pin!(
        builder
            .serve_connection(TokioIo::new(stream), service)
            .with_upgrades()
    );
    let stop = async move {
        // A dropped sender also means stop.
        let _ = stopped.wait_for(|stopped| *stopped).await;
    };
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = stop => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
        () = must_leave => return, // the audit log has the reason
    };
    if findings.has_bare_line_feed() {
        let why = "a line of the head does not end with CR LF";
        Audit::of_process().refuse(Refused::Malformed, &address.ip().to_string(), why);
    }
    if let Err(error) = ended {
        debug!(%address, %error, "connection to the page ended");
    }
}

/// The body of a request. The request begins once its body has arrived, so that a client that does
/// not send it must make room for others.
struct Received {
    body: Incoming,
    place: Arc<Place>,
}

impl Received {
    fn new(body: Incoming, place: Arc<Place>) -> Self {
        if body.is_end_stream() {
            place.begin_request(Instant::now());
        }
        Self { body, place }
    }
}

impl hyper::body::Body for Received {
    type Data = Bytes;
    type Error = hyper::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, hyper::Error>>> {
        let frame = Pin::new(&mut self.body).poll_frame(context);
        if matches!(frame, Poll::Ready(None)) {
            self.place.begin_request(Instant::now());
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
