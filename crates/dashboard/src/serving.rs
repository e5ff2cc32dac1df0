//! Serves the requests of all connections.

use crate::door::{Door, Guest};
use axum::Router;
use axum::body::Body;
use axum::extract::ConnectInfo;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1::Builder;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::net::IpAddr;
use std::pin::pin;
use std::time::Duration;
use tokio::sync::watch;
use tokio::task::JoinSet;
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
    drop(door);
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
    let service = service_fn(move |request: Request<Incoming>| {
        let mut request = request.map(Body::new);
        request.extensions_mut().insert(client);
        router.call(request)
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
    };
    if let Err(error) = ended {
        debug!(%address, %error, "connection to the page ended");
    }
    drop(place);
}
