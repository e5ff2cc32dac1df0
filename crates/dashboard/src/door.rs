//! Accepts connections to the page, over TLS if there is a certificate.

use crate::error::DashboardError;
use crate::places::{Place, Places};
use rustls::ServerConfig;
use rustls::crypto::ring::default_provider;
use spandrel_bus::read_pair;
use spandrel_service::{Audit, Refused};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;
use tracing::warn;

/// Capacity of the queue of accepted connections. Further ones wait for their turn.
const GUESTS_WAITING: usize = 64;
/// Time limit for a handshake.
const HANDSHAKE_WITHIN: Duration = Duration::from_secs(10);
/// Pause after a failure to accept a connection, usually because file descriptors ran out.
const PAUSE: Duration = Duration::from_secs(1);

/// A certificate and its private key (PEM).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageCertificate {
    /// Path of the certificate, with all intermediate certificates up to its authority.
    pub certificate: PathBuf,
    /// Path of the private key.
    pub key: PathBuf,
}

impl PageCertificate {
    /// Reads both files and checks that they belong together.
    pub(crate) fn acceptor(&self) -> Result<TlsAcceptor, DashboardError> {
        let (chain, key) = read_pair(&self.certificate, &self.key)?;
        let unusable = |source| DashboardError::Certificate {
            path: self.certificate.clone(),
            source,
        };
        let mut config = ServerConfig::builder_with_provider(Arc::new(default_provider()))
            .with_safe_default_protocol_versions()
            .map_err(unusable)?
            .with_no_client_auth()
            .with_single_cert(chain, key)
            .map_err(unusable)?;
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(TlsAcceptor::from(Arc::new(config)))
    }
}

/// An accepted connection.
#[derive(Debug)]
pub(crate) struct Guest {
    pub(crate) stream: Either<TcpStream, Box<TlsStream<TcpStream>>>,
    pub(crate) address: SocketAddr,
    pub(crate) place: Place,
}

/// Accepts connections.
///
/// Handshakes run concurrently, so an unfinished handshake does not block other connections. The
/// number of [`Places`] also limits the number of handshakes. If there is no free place, the door
/// closes a new connection immediately.
#[derive(Debug)]
pub(crate) struct Door {
    guests: mpsc::Receiver<Guest>,
    taking: JoinSet<()>,
}

impl Door {
    pub(crate) fn new(listener: TcpListener, acceptor: Option<TlsAcceptor>) -> Self {
        let (out, guests) = mpsc::channel(GUESTS_WAITING);
        let mut taking = JoinSet::new();
        taking.spawn(take(listener, acceptor, out));
        Self { guests, taking }
    }

    /// Stops accepting connections, and releases the address.
    pub(crate) async fn close(mut self) {
        self.taking.shutdown().await;
    }

    /// Returns the next connection, or `None` after accepting has ended.
    pub(crate) async fn next(&mut self) -> Option<Guest> {
        self.guests.recv().await
    }
}

async fn take(listener: TcpListener, acceptor: Option<TlsAcceptor>, out: mpsc::Sender<Guest>) {
    let places = Places::of_connections();
    let mut handshakes = JoinSet::new();
    loop {
        while handshakes.try_join_next().is_some() {}
        let (stream, address) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                warn!(%error, "cannot accept a connection to the page");
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        let Some(place) = places.take(address.ip(), Instant::now()) else {
            let why = "too many requests in progress; closed the new connection";
            Audit::of_process().refuse(Refused::Connection, &address.ip().to_string(), why);
            continue;
        };
        let Some(acceptor) = acceptor.clone() else {
            let stream = Either::Left(stream);
            let guest = Guest {
                stream,
                address,
                place,
            };
            if out.send(guest).await.is_err() {
                return;
            }
            continue;
        };
        let out = out.clone();
        handshakes.spawn(async move {
            let must_leave = place.must_leave();
            let shaken = tokio::select! {
                shaken = tokio::time::timeout(HANDSHAKE_WITHIN, acceptor.accept(stream)) => shaken,
                () = must_leave => return, // the audit log has the reason
            };
            let why = match shaken {
                Ok(Ok(stream)) => {
                    let stream = Either::Right(Box::new(stream));
                    let guest = Guest {
                        stream,
                        address,
                        place,
                    };
                    return drop(out.send(guest).await);
                }
                Ok(Err(error)) => error.to_string(),
                Err(_) => format!("no handshake within {} s", HANDSHAKE_WITHIN.as_secs()),
            };
            Audit::of_process().refuse(Refused::Handshake, &address.ip().to_string(), &why);
        });
    }
}
