//! Accepts connections to the page, over TLS if there is a certificate.

use crate::error::DashboardError;
use crate::places::{Place, Places};
use rustls::ServerConfig;
use rustls::crypto::ring::default_provider;
use spandrel_bus::read_pair;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;
use tracing::{debug, warn};

/// Maximum number of concurrent handshakes. Further connections wait in the queue of the operating
/// system.
const MOST_HANDSHAKES: usize = 64;
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
/// Handshakes run concurrently, so an unfinished handshake does not block other connections. If
/// there is no free place, the door closes a new connection immediately.
#[derive(Debug)]
pub(crate) struct Door {
    guests: mpsc::Receiver<Guest>,
    _taking: JoinSet<()>,
}

impl Door {
    pub(crate) fn new(listener: TcpListener, acceptor: Option<TlsAcceptor>) -> Self {
        let (out, guests) = mpsc::channel(MOST_HANDSHAKES);
        let mut taking = JoinSet::new();
        taking.spawn(take(listener, acceptor, out));
        Self {
            guests,
            _taking: taking,
        }
    }

    /// Returns the next connection, or `None` after accepting has ended.
    pub(crate) async fn next(&mut self) -> Option<Guest> {
        self.guests.recv().await
    }
}

async fn take(listener: TcpListener, acceptor: Option<TlsAcceptor>, out: mpsc::Sender<Guest>) {
    let places = Places::default();
    let may_shake_hands = Arc::new(Semaphore::new(MOST_HANDSHAKES));
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
        let Some(place) = places.take(address.ip()) else {
            continue;
        };
        let Some(acceptor) = acceptor.clone() else {
            if out
                .send(Guest {
                    stream: Either::Left(stream),
                    address,
                    place,
                })
                .await
                .is_err()
            {
                return;
            }
            continue;
        };
        let Ok(handshake) = may_shake_hands.clone().acquire_owned().await else {
            return;
        };
        let out = out.clone();
        handshakes.spawn(async move {
            match tokio::time::timeout(HANDSHAKE_WITHIN, acceptor.accept(stream)).await {
                Ok(Ok(stream)) => {
                    let stream = Either::Right(Box::new(stream));
                    drop(
                        out.send(Guest {
                            stream,
                            address,
                            place,
                        })
                        .await,
                    );
                }
                Ok(Err(error)) => debug!(%address, %error, "TLS handshake failed"),
                Err(_) => debug!(%address, "TLS handshake timed out"),
            }
            drop(handshake);
        });
    }
}
