//! Lines over TCP: connects to a server, or accepts connections of instruments.

use std::net::SocketAddr;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::connect::Outlet;
use crate::connect::lines::{StreamEnd, read_stream};
use crate::connect::retry::Retry;
use crate::core_input::Link;
use crate::lines::LineFormat;

/// Timeout of an attempt to connect.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// Time without data after which a connection counts as broken. An unplugged cable closes no
/// connection.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// Maximum number of instruments that are connected to one server. Further ones are disconnected.
const MAX_CLIENTS: usize = 64;

/// Connects until the feed stops.
pub(crate) async fn connect(address: String, format: LineFormat, outlet: Outlet) {
    let mut retry = Retry::new();
    while !outlet.is_closed() {
        outlet.link(Link::Connecting).await;
        match timeout(CONNECT_TIMEOUT, TcpStream::connect(&address)).await {
            Ok(Ok(stream)) => {
                retry.reset();
                outlet.link(Link::Open).await;
                let why = match read_stream(stream, &format, PATIENCE, &outlet).await {
                    StreamEnd::Stopped => return,
                    end => reason(&end, &address),
                };
                outlet.failed(why).await;
            }
            Ok(Err(error)) => {
                outlet
                    .failed(format!("cannot connect to {address}: {error}"))
                    .await;
            }
            Err(_elapsed) => {
                let limit_s = CONNECT_TIMEOUT.as_secs();
                outlet
                    .failed(format!(
                        "cannot connect to {address}: no answer within {limit_s} s"
                    ))
                    .await;
            }
        }
        retry.pause().await;
    }
}

fn reason(end: &StreamEnd, address: &str) -> String {
    match end {
        StreamEnd::Closed | StreamEnd::Stopped => format!("{address} closed the connection"),
        StreamEnd::Silent(patience) => {
            format!("no data from {address} for {} s", patience.as_secs())
        }
        StreamEnd::Broken(error) => format!("connection to {address} lost: {error}"),
    }
}

/// Accepts connections until the feed stops.
pub(crate) async fn serve(listen: String, format: LineFormat, outlet: Outlet) {
    let mut retry = Retry::new();
    while !outlet.is_closed() {
        let listener = match TcpListener::bind(&listen).await {
            Ok(listener) => listener,
            Err(error) => {
                outlet
                    .failed(format!("cannot listen on {listen}: {error}"))
                    .await;
                retry.pause().await;
                continue;
            }
        };
        retry.reset();
        outlet.link(Link::Open).await;
        let mut clients = JoinSet::new();
        loop {
            tokio::select! {
                accepted = listener.accept() => match accepted {
                    Ok((stream, from)) if clients.len() < MAX_CLIENTS => {
                        clients.spawn(serve_one(stream, from, format.clone(), outlet.clone()));
                    }
                    Ok((_stream, from)) => {
                        let why = format!("{from} disconnected: {MAX_CLIENTS} are connected \
                                           already");
                        outlet.malformed(why).await;
                    }
                    Err(error) => {
                        outlet.failed(format!("cannot accept on {listen}: {error}")).await;
                        break;
                    }
                },
                Some(_ended) = clients.join_next() => {}
            }
            if outlet.is_closed() {
                return;
            }
        }
        retry.pause().await;
    }
}

async fn serve_one(stream: TcpStream, from: SocketAddr, format: LineFormat, outlet: Outlet) {
    let end = read_stream(stream, &format, PATIENCE, &outlet).await;
    if !matches!(end, StreamEnd::Stopped) {
        outlet.malformed(reason(&end, &from.to_string())).await;
    }
}
