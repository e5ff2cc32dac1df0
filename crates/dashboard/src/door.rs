//! The door of the page: takes connections, over TLS where there is a certificate.

use crate::error::DashboardError;
use axum::extract::connect_info::Connected;
use axum::serve::{IncomingStream, Listener};
use rustls::ServerConfig;
use rustls::crypto::ring::default_provider;
use spandrel_bus::read_pair;
use std::io;
use std::net::{IpAddr, SocketAddr};
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

/// Handshakes at the same time; who comes meanwhile waits in the queue of the system.
const MOST_HANDSHAKES: usize = 64;
/// Time for a handshake.
const HANDSHAKE_WITHIN: Duration = Duration::from_secs(10);
/// Pause after the system could not take a connection, mostly for want of file descriptors.
const PAUSE: Duration = Duration::from_secs(1);

/// A certificate and its private key (PEM).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageCertificate {
    /// The certificate, with what lies between it and its authority.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

impl PageCertificate {
    /// Reads both files and checks that they belong together.
    pub(crate) fn acceptor(&self) -> Result<TlsAcceptor, DashboardError> {
        let (chain, key) = read_pair(&self.certificate, &self.key)?;
        let unusable = |source| DashboardError::Certificate { path: self.certificate.clone(), source };
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

type Connection = Either<TcpStream, Box<TlsStream<TcpStream>>>;

/// Takes connections. Handshakes are done beside each other: who does not finish one keeps nobody else out.
#[derive(Debug)]
pub(crate) struct Door {
    address: SocketAddr,
    connections: mpsc::Receiver<(Connection, SocketAddr)>,
    _taking: JoinSet<()>,
}

impl Door {
    pub(crate) fn new(listener: TcpListener, acceptor: Option<TlsAcceptor>) -> io::Result<Self> {
        let address = listener.local_addr()?;
        let (out, connections) = mpsc::channel(MOST_HANDSHAKES);
        let mut taking = JoinSet::new();
        taking.spawn(take(listener, acceptor, out));
        Ok(Self { address, connections, _taking: taking })
    }
}

async fn take(listener: TcpListener, acceptor: Option<TlsAcceptor>, out: mpsc::Sender<(Connection, SocketAddr)>) {
    let places = Arc::new(Semaphore::new(MOST_HANDSHAKES));
    let mut handshakes = JoinSet::new();
    loop {
        while handshakes.try_join_next().is_some() {}
        let (stream, address) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                warn!(%error, "a connection to the page cannot be taken");
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        let Some(acceptor) = acceptor.clone() else {
            if out.send((Either::Left(stream), address)).await.is_err() {
                return;
            }
            continue;
        };
        let Ok(place) = places.clone().acquire_owned().await else { return };
        let out = out.clone();
        handshakes.spawn(async move {
            match tokio::time::timeout(HANDSHAKE_WITHIN, acceptor.accept(stream)).await {
                Ok(Ok(stream)) => drop(out.send((Either::Right(Box::new(stream)), address)).await),
                Ok(Err(error)) => debug!(%address, %error, "no handshake"),
                Err(_) => debug!(%address, "no handshake in time"),
            }
            drop(place);
        });
    }
}

impl Listener for Door {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        match self.connections.recv().await {
            Some(connection) => connection,
            // the listener is gone, which happens at the end only
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> io::Result<Self::Addr> {
        Ok(self.address)
    }
}

/// Where a request comes from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ClientAddress(pub(crate) IpAddr);

impl Connected<IncomingStream<'_, Door>> for ClientAddress {
    fn connect_info(stream: IncomingStream<'_, Door>) -> Self {
        Self(stream.remote_addr().ip())
    }
}
