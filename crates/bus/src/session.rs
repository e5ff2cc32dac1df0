//! Opening and closing of the Zenoh session.

use std::net::{TcpListener, TcpStream, ToSocketAddrs, UdpSocket};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use zenoh::Session;

use crate::BoxedFuture;
use crate::endpoint::{Endpoint, in_order};
use crate::error::{BusError, ZenohError};
use crate::follow::Start;
use crate::keys::{DEFAULT_ROOT, Keys};
use crate::message::MAX_MESSAGE_BYTES;
use crate::name::Name;
use crate::protection;
use crate::small_file::read_small_file;
use crate::stream::StreamSettings;
use crate::tls::TlsConfig;

/// Endpoint of the first Spandrel process on a machine. Only this machine can reach it.
pub const DEFAULT_ENDPOINT: &str = "tcp/127.0.0.1:7447";

/// Maximum number of bytes that key, encoding and link headers add to a payload.
pub const AROUND_THE_PAYLOAD: usize = 65_536;

/// Valid leases, s. A shorter lease would end links that are merely busy.
const LEASES_S: std::ops::RangeInclusive<f64> = 0.5..=3600.0;

/// Maximum number of connections to this session that have not completed the handshake of Zenoh.
/// With Zenoh's default, 100, as many silent connections keep all others out. Each one takes a file
/// descriptor, and a process often has only 1,024 of them.
const MOST_OPENING: usize = 512;

/// Timeout of that handshake, ms. It takes two round trips. Zenoh's default is 10 s.
const OPEN_WITHIN_MS: u64 = 5_000;

/// Timeout for one endpoint during the diagnosis of a failure.
const DIAGNOSIS: Duration = Duration::from_millis(500);

/// Role of this session in the Zenoh network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", try_from = "String")]
pub enum Mode {
    /// Communicates directly with other peers.
    #[default]
    Peer,
    /// Communicates through one router.
    Client,
    /// Routes messages between other sessions.
    Router,
}

impl Mode {
    /// Returns the name of the mode, as in Zenoh's configuration.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Peer => "peer",
            Self::Client => "client",
            Self::Router => "router",
        }
    }
}

impl TryFrom<String> for Mode {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let all = [Self::Peer, Self::Client, Self::Router];
        let known = all.into_iter().find(|mode| mode.as_str() == text);
        known.ok_or_else(|| format!("unknown mode {text:?}, must be peer, client or router"))
    }
}

impl std::fmt::Display for Mode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// Settings of a connection to the bus.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BusConfig {
    /// First chunk of all key expressions.
    pub root: String,
    /// Peer, client or router. A configuration file takes precedence.
    pub mode: Mode,
    /// Endpoints to listen on, such as `quic/0.0.0.0:7447`. Endpoints that other machines can reach
    /// require `quic`.
    ///
    /// If the list is empty and there is no configuration file, a peer or router without `connect`
    /// listens on [`DEFAULT_ENDPOINT`]. A peer with `connect` listens on a free port of the
    /// loopback interface. Other sessions do not listen.
    pub listen: Vec<String>,
    /// Endpoints to connect to. All of them must reply; for a client, one of them.
    pub connect: Vec<String>,
    /// Timeout of these connections, s. `None`: the session opens at once and keeps trying.
    pub connect_timeout_s: Option<f64>,
    /// Time without any message after which other processes close the connection to this one, s.
    /// `None`: Zenoh's default, 10 s.
    pub lease_s: Option<f64>,
    /// Maximum number of waiting messages per reader of a lossless stream, at least 1. Excess
    /// messages are fetched later.
    pub queue: NonZeroUsize,
    /// Certificates for `quic/…` endpoints. Both sides must present a certificate of the same
    /// authority.
    pub tls: Option<TlsConfig>,
    /// A Zenoh configuration file (JSON5), for access control and all other settings. Non-empty
    /// settings of this struct override it, except `mode`.
    pub config_file: Option<PathBuf>,
    /// Zenoh's `access_control`: what processes may do that connect to this one. `None`:
    /// everything, or what the configuration file states.
    #[serde(skip)]
    pub access_control: Option<Value>,
}

impl Default for BusConfig {
    fn default() -> Self {
        Self {
            root: DEFAULT_ROOT.into(),
            mode: Mode::Peer,
            listen: Vec::new(),
            connect: Vec::new(),
            connect_timeout_s: Some(5.0),
            lease_s: None,
            queue: const { NonZeroUsize::new(256).unwrap() },
            tls: None,
            config_file: None,
            access_control: None,
        }
    }
}

impl BusConfig {
    /// Returns the endpoints to listen on, with the defaults described at `listen`.
    fn effective_listen(&self) -> Vec<String> {
        let nothing_said = self.listen.is_empty() && self.config_file.is_none();
        match (nothing_said, self.mode, self.connect.is_empty()) {
            (true, Mode::Peer | Mode::Router, true) => vec![DEFAULT_ENDPOINT.into()],
            (true, Mode::Peer, false) => vec!["tcp/127.0.0.1:0".into()],
            _ => self.listen.clone(),
        }
    }

    fn zenoh_config(&self) -> Result<zenoh::Config, BusError> {
        if let Some(found) = self
            .connect_timeout_s
            .filter(|seconds| seconds.is_nan() || *seconds < 0.0)
        {
            return Err(BusError::ConnectTimeout { found });
        }
        if let Some(found) = self.lease_s.filter(|seconds| !LEASES_S.contains(seconds)) {
            return Err(BusError::Lease { found });
        }
        if self.config_file.is_none() && self.mode == Mode::Client && self.connect.is_empty() {
            return Err(BusError::ClientWithoutEndpoint);
        }
        let mut config = match &self.config_file {
            Some(path) => read_config(path)?,
            None => zenoh::Config::default(),
        };
        let mut set = |key: &'static str, value: Value| set(&mut config, key, &value);
        if self.config_file.is_none() {
            set("mode", self.mode.as_str().into())?;
            // On a site network, any host that replies to a multicast would become part of the
            // system.
            set("scouting/multicast/enabled", false.into())?;
            // Zenoh would otherwise reassemble messages of up to 1 GiB, only to have them rejected
            // here.
            set(
                "transport/link/rx/max_message_size",
                (MAX_MESSAGE_BYTES + AROUND_THE_PAYLOAD).into(),
            )?;
            set("transport/unicast/accept_pending", MOST_OPENING.into())?;
            set("transport/unicast/accept_timeout", OPEN_WITHIN_MS.into())?;
            set("listen/endpoints", all_in_order(&self.effective_listen()))?;
        } else if !self.listen.is_empty() {
            set("listen/endpoints", all_in_order(&self.listen))?;
        }
        if !self.connect.is_empty() {
            set("connect/endpoints", all_in_order(&self.connect))?;
            let (timeout_ms, fail) = match self.connect_timeout_s {
                Some(seconds) => ((seconds.min(1e6) * 1e3) as i64, true),
                None => (-1, false),
            };
            set("connect/timeout_ms", timeout_ms.into())?;
            set("connect/exit_on_failure", fail.into())?;
        }
        if let Some(lease_s) = self.lease_s {
            set("transport/link/tx/lease", ((lease_s * 1e3) as u64).into())?;
        }
        if let Some(tls) = &self.tls {
            let (certificate, key) = (text(&tls.certificate)?, text(&tls.key())?);
            set(
                "transport/link/tls/root_ca_certificate",
                text(&tls.authority())?,
            )?;
            set("transport/link/tls/listen_certificate", certificate.clone())?;
            set("transport/link/tls/listen_private_key", key.clone())?;
            set("transport/link/tls/connect_certificate", certificate)?;
            set("transport/link/tls/connect_private_key", key)?;
            set("transport/link/tls/enable_mtls", true.into())?;
            set("transport/link/tls/verify_name_on_connect", true.into())?;
            set("transport/link/tls/close_link_on_expiration", true.into())?;
        }
        if let Some(rules) = &self.access_control {
            set("access_control", rules.clone())?;
        }
        protection::check(&mut config)?;
        Ok(config)
    }

    /// Repeats the steps of opening a session to identify the endpoint and the reason of a failure.
    ///
    /// Zenoh itself reports little.
    async fn diagnose(&self, listen: &[String], source: ZenohError) -> BusError {
        for endpoint in listen {
            let parts = Endpoint::new(endpoint);
            let bound = match () {
                () if parts.is_tcp() => TcpListener::bind(parts.address()).map(drop),
                () if parts.is_quic() => UdpSocket::bind(parts.address()).map(drop),
                () => Ok(()),
            };
            if let Err(reason) = bound {
                return BusError::Listen {
                    endpoint: endpoint.clone(),
                    place: self.place("listen"),
                    reason,
                };
            }
        }
        let mut answering = None;
        for endpoint in &self.connect {
            let parts = Endpoint::new(endpoint);
            let reached = match &self.tls {
                Some(tls) if parts.is_quic() => {
                    tls.reach(parts.address(), parts.host(), DIAGNOSIS).await
                }
                _ if parts.is_tcp() => reach(parts.address()).map(|()| None),
                _ => Ok(None),
            };
            match reached {
                Err(reason) => {
                    return BusError::Unreachable {
                        endpoint: endpoint.clone(),
                        place: self.place("connect"),
                        reason,
                    };
                }
                Ok(Some(why)) => {
                    return BusError::Handshake {
                        endpoint: endpoint.clone(),
                        why,
                    };
                }
                Ok(None) if parts.is_tcp() => answering = Some(endpoint.clone()),
                Ok(None) => {}
            }
        }
        match answering {
            Some(endpoint) => BusError::NoZenoh {
                endpoint,
                place: self.place("connect"),
                source,
            },
            None => BusError::Open { source },
        }
    }

    /// Returns the setting that specifies the endpoints to listen on or to connect to.
    fn place(&self, what: &str) -> String {
        let is_said_here = match what {
            "connect" => !self.connect.is_empty(),
            _ => !self.listen.is_empty(),
        };
        match &self.config_file {
            Some(file) if !is_said_here => format!("{what}/endpoints of {}", file.display()),
            Some(_) | None => format!("--{what} (bus.{what})"),
        }
    }
}

/// Sets one value of a Zenoh configuration.
pub(crate) fn set(
    config: &mut zenoh::Config,
    key: &'static str,
    value: &Value,
) -> Result<(), BusError> {
    let value = value.to_string();
    config
        .insert_json5(key, &value)
        .map_err(|source| BusError::Setting { key, value, source })
}

/// Reads a configuration file of Zenoh.
fn read_config(path: &Path) -> Result<zenoh::Config, BusError> {
    let failed = |source: ZenohError| BusError::ConfigFile {
        path: path.to_owned(),
        source,
    };
    // Zenoh would wait for the writer of a pipe, and read a device without end.
    read_small_file(path).map_err(|error| failed(error.into()))?;
    zenoh::Config::from_file(path).map_err(failed)
}

/// Converts a path for the Zenoh configuration.
fn text(path: &Path) -> Result<Value, BusError> {
    let text = path.to_str().ok_or_else(|| BusError::PathNotText {
        path: path.to_owned(),
    })?;
    Ok(text.into())
}

/// Converts endpoints for the Zenoh configuration.
fn all_in_order(endpoints: &[String]) -> Value {
    endpoints
        .iter()
        .map(|endpoint| in_order(endpoint))
        .collect()
}

fn reach(address: &str) -> std::io::Result<()> {
    let mut result = Err(std::io::Error::new(
        std::io::ErrorKind::NotFound,
        "no such host",
    ));
    for socket_address in address.to_socket_addrs()? {
        result = TcpStream::connect_timeout(&socket_address, DIAGNOSIS).map(drop);
        if result.is_ok() {
            break;
        }
    }
    result
}

/// A Zenoh session, shared by all services of a process.
///
/// [`Bus::open`] opens the session and [`Bus::close`] closes it with all its declarations. Cloning
/// is cheap, and all clones use the same session, so closing one of them ends the others.
///
/// A session requires a multi-threaded tokio runtime.
#[derive(Clone, Debug)]
pub struct Bus {
    session: Session,
    queue: NonZeroUsize,
}

impl Bus {
    /// Opens a session. It requires a multi-threaded tokio runtime.
    ///
    /// # Errors
    /// The error names an endpoint that is in use or does not reply, and suggests a remedy.
    pub fn open<'a>(config: &'a BusConfig) -> BoxedFuture<'a, Result<Self, BusError>> {
        Box::pin(async move {
            if let Some(tls) = &config.tls {
                tls.check()?;
            }
            let zenoh_config = config.zenoh_config()?;
            let listen = protection::listen_endpoints(&zenoh_config)?;
            match zenoh::open(zenoh_config).await {
                Ok(session) => Ok(Self {
                    session,
                    queue: config.queue,
                }),
                Err(source) => Err(config.diagnose(&listen, source).await),
            }
        })
    }

    /// Opens a session that only routes, from a configuration file of `zenohd`.
    ///
    /// It requires a multi-threaded tokio runtime. Returns the session and the endpoints on which
    /// it listens.
    ///
    /// # Errors
    /// The error names the fault in the file, or an endpoint that is in use.
    pub fn open_router<'a>(
        file: &'a Path,
    ) -> BoxedFuture<'a, Result<(Self, Vec<String>), BusError>> {
        Box::pin(async move {
            let config = BusConfig {
                config_file: Some(file.to_owned()),
                ..BusConfig::default()
            };
            let mut zenoh_config = read_config(file)?;
            match protection::mode(&zenoh_config)? {
                // This is the default mode of zenohd.
                None => set(&mut zenoh_config, "mode", &"router".into())?,
                Some(Mode::Router) => {}
                Some(found @ (Mode::Peer | Mode::Client)) => {
                    return Err(BusError::NotARouter {
                        path: file.to_owned(),
                        found,
                    });
                }
            }
            protection::check(&mut zenoh_config)?;
            let listen = protection::listen_endpoints(&zenoh_config)?;
            match zenoh::open(zenoh_config).await {
                Ok(session) => Ok((
                    Self {
                        session,
                        queue: config.queue,
                    },
                    listen,
                )),
                Err(source) => Err(config.diagnose(&listen, source).await),
            }
        })
    }

    /// Returns settings to read a lossless stream, with the queue size of the configuration.
    #[must_use]
    pub fn reading(&self, start: Start) -> StreamSettings {
        let settings = StreamSettings::new(start);
        StreamSettings {
            queue: self.queue.get(),
            deliveries: self.queue.get().min(settings.deliveries),
            ..settings
        }
    }

    /// Returns `true` if the session is connected to a router. A router may enforce access rules
    /// and drop messages.
    pub fn reaches_a_router<'a>(&'a self) -> BoxedFuture<'a, bool> {
        Box::pin(async move { self.session.info().routers_zid().await.next().is_some() })
    }

    /// Returns the Zenoh session, for functions that this crate does not provide.
    #[must_use]
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// Closes the session with all its declarations. Other sessions see its tokens disappear.
    ///
    /// # Errors
    /// Fails if Zenoh cannot close the session in time.
    pub fn close(self) -> BoxedFuture<'static, Result<(), BusError>> {
        Box::pin(async move {
            let closed = self.session.close().await;
            closed.map_err(|source| BusError::Close { source })
        })
    }
}

impl BusConfig {
    /// Returns the keys of a structure below the root of this configuration.
    ///
    /// # Errors
    /// Fails if the root or the structure is not a [`Name`].
    pub fn keys(&self, structure: &str) -> Result<Keys, BusError> {
        let root = Name::new(&*self.root).map_err(|reason| BusError::Root { reason })?;
        let structure = Name::new(structure).map_err(|reason| BusError::Structure { reason })?;
        Ok(Keys::new(root, structure))
    }
}
