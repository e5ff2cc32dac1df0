//! Opens and closes the Zenoh session.

use std::net::{TcpListener, TcpStream, ToSocketAddrs};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use zenoh::Session;

use crate::error::{BusError, ZenohError};
use crate::follow::Start;
use crate::keys::{DEFAULT_ROOT, Keys};
use crate::name::{Name, NameError};
use crate::stream::StreamSettings;

/// Endpoint of the first Spandrel on a machine: reachable from this machine only.
pub const DEFAULT_ENDPOINT: &str = "tcp/127.0.0.1:7447";

/// How long an endpoint is tried again when the reason of a failure is looked for.
const DIAGNOSIS: Duration = Duration::from_millis(500);

/// The part that this session plays in the Zenoh network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Talks to other peers directly.
    #[default]
    Peer,
    /// Talks through one router.
    Client,
    /// Routes for others.
    Router,
}

/// How to join the bus.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BusConfig {
    /// First chunk of all key expressions.
    pub root: String,
    /// Peer, client or router; a configuration file takes precedence.
    pub mode: Mode,
    /// Endpoints to listen on, such as `tcp/0.0.0.0:7447`. Empty: [`DEFAULT_ENDPOINT`] if nothing is to be connected
    /// to, otherwise any free port of the loopback interface (peers), or none (clients).
    pub listen: Vec<String>,
    /// Endpoints to connect to. All of them must answer (of a client: one).
    pub connect: Vec<String>,
    /// Time within which they must, s; none: the session opens at once and keeps trying.
    pub connect_timeout_s: Option<f64>,
    /// Messages that wait for each reader of a lossless stream, at least 1; what finds no room is fetched later.
    pub queue: NonZeroUsize,
    /// A Zenoh configuration file (JSON5), for TLS, access control and all else; the settings above that are not
    /// empty are laid over it.
    pub config_file: Option<PathBuf>,
}

impl Default for BusConfig {
    fn default() -> Self {
        Self {
            root: DEFAULT_ROOT.into(),
            mode: Mode::Peer,
            listen: Vec::new(),
            connect: Vec::new(),
            connect_timeout_s: Some(5.0),
            queue: const { NonZeroUsize::new(256).unwrap() },
            config_file: None,
        }
    }
}

impl BusConfig {
    /// Endpoints to listen on, with the default that the documentation of `listen` promises.
    fn effective_listen(&self) -> Vec<String> {
        let nothing_said = self.listen.is_empty() && self.config_file.is_none();
        match (nothing_said, self.mode, self.connect.is_empty()) {
            (true, Mode::Peer | Mode::Router, true) => vec![DEFAULT_ENDPOINT.into()],
            (true, Mode::Peer, false) => vec!["tcp/127.0.0.1:0".into()],
            _ => self.listen.clone(),
        }
    }

    fn zenoh_config(&self) -> Result<zenoh::Config, BusError> {
        let mut config = match &self.config_file {
            Some(path) => {
                zenoh::Config::from_file(path).map_err(|source| BusError::ConfigFile { path: path.clone(), source })?
            }
            None => zenoh::Config::default(),
        };
        let mut set = |key: &'static str, value: serde_json::Value| {
            let value = value.to_string();
            config.insert_json5(key, &value).map_err(|source| BusError::Setting { key, value, source })
        };
        if self.config_file.is_none() {
            let mode = match self.mode {
                Mode::Peer => "peer",
                Mode::Client => "client",
                Mode::Router => "router",
            };
            set("mode", mode.into())?;
            // On a site network, whoever answers a multicast would become part of the system.
            set("scouting/multicast/enabled", false.into())?;
            set("listen/endpoints", self.effective_listen().into())?;
        } else if !self.listen.is_empty() {
            set("listen/endpoints", self.listen.clone().into())?;
        }
        if !self.connect.is_empty() {
            set("connect/endpoints", self.connect.clone().into())?;
            let (timeout_ms, fail) = match self.connect_timeout_s {
                Some(seconds) => ((seconds.clamp(0.0, 1e6) * 1e3) as i64, true),
                None => (-1, false),
            };
            set("connect/timeout_ms", timeout_ms.into())?;
            set("connect/exit_on_failure", fail.into())?;
        }
        Ok(config)
    }

    /// Zenoh says little when it cannot open a session: tries what it tried, to name the endpoint and the reason.
    fn diagnose(&self, source: ZenohError) -> BusError {
        for endpoint in self.effective_listen() {
            if let Some(Err(source)) = tcp_address(&endpoint).map(TcpListener::bind) {
                return BusError::Listen { endpoint, source };
            }
        }
        for endpoint in &self.connect {
            let failure = tcp_address(endpoint).and_then(|address| reach(address).err());
            if let Some(source) = failure {
                return BusError::Unreachable { endpoint: endpoint.clone(), source };
            }
        }
        BusError::Open { source }
    }
}

/// `host:port` of a TCP endpoint.
fn tcp_address(endpoint: &str) -> Option<&str> {
    let address = endpoint.strip_prefix("tcp/")?;
    address.split(['?', '#']).next()
}

fn reach(address: &str) -> std::io::Result<TcpStream> {
    let not_found = || std::io::Error::new(std::io::ErrorKind::NotFound, "no such host");
    let mut result = Err(not_found());
    for socket_address in address.to_socket_addrs()? {
        result = TcpStream::connect_timeout(&socket_address, DIAGNOSIS);
        if result.is_ok() {
            break;
        }
    }
    result
}

/// A session, shared by all services of a process; cloning is cheap.
#[derive(Clone, Debug)]
pub struct Bus {
    session: Session,
    queue: NonZeroUsize,
}

impl Bus {
    /// Opens a session; needs a multi-threaded tokio runtime.
    ///
    /// # Errors
    /// An endpoint that is taken or does not answer is named, with what to do about it.
    pub async fn open(config: &BusConfig) -> Result<Self, BusError> {
        let zenoh_config = config.zenoh_config()?;
        match zenoh::open(zenoh_config).await {
            Ok(session) => Ok(Self { session, queue: config.queue }),
            Err(source) => Err(config.diagnose(source)),
        }
    }

    /// Settings for reading a lossless stream, with the queue of the configuration.
    #[must_use]
    pub fn reading(&self, start: Start) -> StreamSettings {
        let settings = StreamSettings::new(start);
        StreamSettings { queue: self.queue.get(), deliveries: self.queue.get().min(settings.deliveries), ..settings }
    }

    /// The Zenoh session below, for what this room does not offer.
    #[must_use]
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// Closes the session: everything declared on it ends, and others see its tokens go.
    ///
    /// # Errors
    /// Zenoh could not say goodbye in time.
    pub async fn close(self) -> Result<(), BusError> {
        let closed = self.session.close().await;
        closed.map_err(|source| BusError::Close { source })
    }
}

impl BusConfig {
    /// The keys of a structure below the root of this configuration.
    ///
    /// # Errors
    /// The root or the structure is no [`Name`].
    pub fn keys(&self, structure: &str) -> Result<Keys, NameError> {
        Ok(Keys::new(Name::new(&*self.root)?, Name::new(structure)?))
    }
}
