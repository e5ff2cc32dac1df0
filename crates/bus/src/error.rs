//! Errors of the bus.

use std::io::ErrorKind;
use std::path::PathBuf;

use crate::message::EncodeError;
use crate::name::NameError;
use crate::ring::NotConsecutive;
use crate::session::Mode;
use crate::tls::TlsError;

/// An error of Zenoh. Zenoh's error types are private, so that only the text is accessible.
pub type ZenohError = Box<dyn std::error::Error + Send + Sync>;

/// Errors of the bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// The Zenoh configuration file cannot be read.
    #[error("zenoh configuration file {} cannot be read", path.display())]
    ConfigFile {
        /// Path of the file.
        path: PathBuf,
        /// Error from Zenoh.
        source: ZenohError,
    },
    /// Zenoh rejects a setting.
    #[error("bus setting {key} has the value {value}, which zenoh rejects")]
    Setting {
        /// The key in the Zenoh configuration.
        key: &'static str,
        /// The value.
        value: String,
        /// Error from Zenoh.
        source: ZenohError,
    },
    /// The first chunk of all keys is not a valid name.
    #[error("bus.root cannot be used: {reason}")]
    Root {
        /// Reason for the rejection.
        reason: NameError,
    },
    /// The name of a claim to lead is not a valid chunk of a key.
    #[error("claim to lead contains an invalid name: {reason}")]
    Claim {
        /// Reason for the rejection.
        reason: NameError,
    },
    /// The name of the structure is not a valid chunk of a key.
    #[error("invalid name of the structure: {reason}")]
    Structure {
        /// Reason for the rejection.
        reason: NameError,
    },
    /// The connection timeout is negative or NaN.
    #[error("bus.connect_timeout_s is {found}, must be at least 0 s, or inf")]
    ConnectTimeout {
        /// Configured value, s.
        found: f64,
    },
    /// The lease is outside its valid range.
    #[error("bus.lease_s is {found}, must lie between 0.5 and 3600 s")]
    Lease {
        /// Configured value, s.
        found: f64,
    },
    /// A configuration file does not configure a router.
    #[error("{}: not a router file: its mode is {found}, must be router", path.display())]
    NotARouter {
        /// Path of the file.
        path: PathBuf,
        /// Mode in the file.
        found: Mode,
    },
    /// A path is not UTF-8, which Zenoh requires.
    #[error("path {} is not UTF-8, zenoh cannot use it", path.display())]
    PathNotText {
        /// The path.
        path: PathBuf,
    },
    /// An endpoint is reachable from other machines and not encrypted.
    #[error(
        "refusing to listen on {endpoint}: other machines can reach it, and it is neither \
         encrypted nor authenticated; use quic/… with certificates (bus.tls, created by spandrel \
         site), or a loopback address such as tcp/127.0.0.1:7447"
    )]
    Unprotected {
        /// The endpoint.
        endpoint: String,
    },
    /// An endpoint uses TLS over TCP, which Zenoh does not operate reliably.
    #[error(
        "{endpoint}: TLS over TCP is not supported, because Zenoh breaks such a connection by \
         reading and writing it from two threads at once; use quic/… (the same certificates, over \
         UDP)"
    )]
    TlsOverTcp {
        /// The endpoint.
        endpoint: String,
    },
    /// An endpoint accepts connections from other machines without a certificate.
    #[error(
        "refusing to listen on {endpoint}: other machines can reach it without a certificate; set \
         bus.tls, or enable_mtls = true, root_ca_certificate, listen_certificate and \
         listen_private_key of \
         transport/link/tls in the zenoh configuration file"
    )]
    NoCertificateAsked {
        /// The endpoint.
        endpoint: String,
    },
    /// Multicast scouting is enabled. Any host that replies would join the system.
    #[error(
        "the zenoh configuration file enables multicast scouting, which connects to any host that \
         replies; set scouting/multicast/enabled to false, or transport/link/protocols to \
         [\"quic\"]"
    )]
    Multicast,
    /// A `quic/…` endpoint has no certificates.
    #[error("{endpoint} requires certificates; set bus.tls.certificate or use --certificate")]
    NoCertificates {
        /// The endpoint.
        endpoint: String,
    },
    /// A client has no endpoint to connect to.
    #[error(
        "a client requires an endpoint to connect to; set --connect (bus.connect), or set --listen \
         (bus.listen) for a process that accepts connections; with --certificate and without \
         --listen, a process is a client"
    )]
    ClientWithoutEndpoint,
    /// A certificate cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// One side rejects the other side's certificate.
    #[error(
        "{endpoint} replies, but no session was opened: {why}; both sides need certificates of \
         the same authority, and the remote certificate must contain the name or address in the \
         endpoint (spandrel site issue --host)"
    )]
    Handshake {
        /// The endpoint.
        endpoint: String,
        /// Reason of the side that rejects the connection.
        why: String,
    },
    /// The session cannot listen on an endpoint, for example because another program uses it.
    #[error("cannot listen on {endpoint}: {reason}; {}", match reason.kind() {
        ErrorKind::AddrInUse => format!(
            "another program already listens there; to join that spandrel or router, use \
             --connect {endpoint}; otherwise choose another port with {place}, or port 0 for a \
             free one"
        ),
        ErrorKind::InvalidInput => format!(
            "state an endpoint such as tcp/127.0.0.1:7447 with {place}"
        ),
        _ => format!("choose another address of this machine with {place}"),
    })]
    Listen {
        /// The endpoint.
        endpoint: String,
        /// Setting that specifies the endpoint.
        place: String,
        /// Error from the operating system.
        reason: std::io::Error,
    },
    /// No program replies at an endpoint.
    #[error("no reply from {endpoint}: {reason}; {}", match reason.kind() {
        ErrorKind::InvalidInput => format!(
            "state an endpoint such as tcp/127.0.0.1:7447 with {place}"
        ),
        _ => format!(
            "start spandrel run, spandrel demo or a router there, or set the address of one with \
             {place}"
        ),
    })]
    Unreachable {
        /// The endpoint.
        endpoint: String,
        /// Setting that specifies the endpoint.
        place: String,
        /// Error from the operating system.
        reason: std::io::Error,
    },
    /// The program at an endpoint does not use a supported Zenoh protocol.
    #[error(
        "{endpoint} accepts connections, but does not speak a supported version of Zenoh; another \
         program might use the port, or it might require certificates (quic/…); set the address \
         of a spandrel or a router with {place}"
    )]
    NoZenoh {
        /// The endpoint.
        endpoint: String,
        /// Setting that specifies the endpoint.
        place: String,
        /// Error from Zenoh.
        source: ZenohError,
    },
    /// The session cannot be opened for another reason.
    #[error("cannot open the zenoh session")]
    Open {
        /// Error from Zenoh.
        source: ZenohError,
    },
    /// A publisher, subscriber, queryable or token cannot be declared.
    #[error("cannot declare {key}")]
    Declare {
        /// The key expression.
        key: String,
        /// Error from Zenoh.
        source: ZenohError,
    },
    /// A message cannot be published, because the session is closed.
    #[error("cannot publish on {key}")]
    Put {
        /// The key.
        key: String,
        /// Error from Zenoh.
        source: ZenohError,
    },
    /// A message cannot be encoded.
    #[error("cannot encode a message for {key}")]
    Encode {
        /// The key.
        key: String,
        /// Reason of the encoder.
        source: EncodeError,
    },
    /// A block does not continue its stream.
    #[error("cannot publish on {key}")]
    NotConsecutive {
        /// The key.
        key: String,
        /// Expected and found position.
        source: NotConsecutive,
    },
    /// The session cannot be closed cleanly.
    #[error("cannot close the zenoh session")]
    Close {
        /// Error from Zenoh.
        source: ZenohError,
    },
}

impl BusError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            // A corrected clock or a new certificate resolves this error, so a service manager must
            // retry.
            Self::Tls(TlsError::NotInTime { .. }) => false,
            // An endpoint that is not an address cannot become one.
            Self::Listen { reason, .. } | Self::Unreachable { reason, .. } => {
                reason.kind() == ErrorKind::InvalidInput
            }
            Self::ConfigFile { .. }
            | Self::Setting { .. }
            | Self::Root { .. }
            | Self::Structure { .. }
            | Self::ConnectTimeout { .. }
            | Self::Lease { .. }
            | Self::TlsOverTcp { .. }
            | Self::NotARouter { .. }
            | Self::PathNotText { .. }
            | Self::Unprotected { .. }
            | Self::NoCertificateAsked { .. }
            | Self::Multicast
            | Self::NoCertificates { .. }
            | Self::ClientWithoutEndpoint
            | Self::Tls(_) => true,
            _ => false,
        }
    }
}
