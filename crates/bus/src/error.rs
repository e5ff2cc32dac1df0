//! What can go wrong on the bus.

use std::io::ErrorKind;
use std::path::PathBuf;

use crate::message::EncodeError;
use crate::name::NameError;
use crate::ring::NotConsecutive;
use crate::session::Mode;
use crate::tls::TlsError;

/// An error of Zenoh; its types are private, so its text is all it gives.
pub type ZenohError = Box<dyn std::error::Error + Send + Sync>;

/// Errors of the bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// The Zenoh configuration file cannot be used.
    #[error("zenoh configuration file {} cannot be read", path.display())]
    ConfigFile {
        /// The file.
        path: PathBuf,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A setting is none that Zenoh knows.
    #[error("bus setting {key} has the value {value}, which zenoh refuses")]
    Setting {
        /// The key in the Zenoh configuration.
        key: &'static str,
        /// The value.
        value: String,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// The first chunk of all keys is no name.
    #[error("bus.root cannot be used: {source}")]
    Root {
        /// What is wrong with it.
        source: NameError,
    },
    /// A claim to lead has no name that can be a chunk of a key.
    #[error("a claim to lead has no name for the bus: {source}")]
    Claim {
        /// What is wrong with it.
        source: NameError,
    },
    /// A structure has no name that can be a chunk of a key.
    #[error("the structure has no name for the bus: {source}")]
    Structure {
        /// What is wrong with it.
        source: NameError,
    },
    /// A time to connect is none.
    #[error("bus.connect_timeout_s is {found}, must be a time from 0 s, or inf")]
    ConnectTimeout {
        /// What was found, s.
        found: f64,
    },
    /// A lease is none that can be kept.
    #[error("bus.lease_s is {found}, must lie between 0.5 and 3600 s")]
    Lease {
        /// What was found, s.
        found: f64,
    },
    /// A configuration file is not that of a router.
    #[error("{}: is no router file: its mode is {found}, must be router", path.display())]
    NotARouter {
        /// The file.
        path: PathBuf,
        /// The mode that it states.
        found: Mode,
    },
    /// Zenoh takes paths as text only.
    #[error("path {} is not UTF-8, zenoh cannot use it", path.display())]
    PathNotText {
        /// The path.
        path: PathBuf,
    },
    /// Others than this machine could reach an endpoint, and nothing would be encrypted.
    #[error(
        "will not listen on {endpoint}: others than this machine can reach it, and nothing there is encrypted or \
         checked; use quic/… with certificates (bus.tls, made by spandrel site), or an address of this machine such as \
         tcp/127.0.0.1:7447"
    )]
    Unprotected {
        /// The endpoint.
        endpoint: String,
    },
    /// An endpoint whose link would not hold.
    #[error(
        "{endpoint}: TLS over TCP is not used, since Zenoh reads and writes one such connection from two threads at once and \
         breaks it; use quic/… (the same certificates, over UDP)"
    )]
    TlsOverTcp {
        /// The endpoint.
        endpoint: String,
    },
    /// Others than this machine could reach an endpoint, and need not show who they are.
    #[error(
        "will not listen on {endpoint}: others than this machine can reach it without a certificate; \
         set bus.tls, or enable_mtls = true, root_ca_certificate, listen_certificate and listen_private_key of \
         transport/link/tls in the zenoh configuration file"
    )]
    NoCertificateAsked {
        /// The endpoint.
        endpoint: String,
    },
    /// Whoever answers a multicast would become part of the system.
    #[error(
        "scouting/multicast/enabled is true, or not said, in the zenoh configuration file: whoever answers a multicast \
         would be connected to; set it to false, or transport/link/protocols to [\"quic\"]"
    )]
    Multicast,
    /// An endpoint `quic/…` has no certificates.
    #[error("{endpoint} needs certificates: set bus.tls.certificate, or give --certificate")]
    NoCertificates {
        /// The endpoint.
        endpoint: String,
    },
    /// A certificate cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The two sides do not accept each other's certificates.
    #[error(
        "{endpoint} answers, but there is no session: {why}; both sides need certificates of one authority, and the \
         one there must be made for the name or address in the endpoint (spandrel site issue --host)"
    )]
    Handshake {
        /// The endpoint.
        endpoint: String,
        /// What one side says of the other.
        why: String,
    },
    /// Another program listens there already.
    #[error("cannot listen on {endpoint}: {source}; {}", match source.kind() {
        ErrorKind::AddrInUse => format!(
            "another program listens there: if it is a spandrel or a router that this one is to join, --connect {endpoint}; \
             otherwise choose another port with {place}, or port 0 for a free one"
        ),
        _ => format!("choose an address of this machine that may be listened on with {place}"),
    })]
    Listen {
        /// The endpoint.
        endpoint: String,
        /// Where it was chosen.
        place: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// Nobody answers there.
    #[error(
        "nobody answers at {endpoint}: {source}; start spandrel run, spandrel demo or a router there, or say where one is \
         with {place}"
    )]
    Unreachable {
        /// The endpoint.
        endpoint: String,
        /// Where it was chosen.
        place: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// Something answers there, and it is no Zenoh.
    #[error(
        "{endpoint} takes connections, but speaks no Zenoh that this program understands: is it another program, or one with \
         certificates (quic/…)? Say where a spandrel or a router is with {place}"
    )]
    NoZenoh {
        /// The endpoint.
        endpoint: String,
        /// Where it was chosen.
        place: String,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// The session cannot be opened for another reason.
    #[error("cannot open the zenoh session")]
    Open {
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A publisher, subscriber, queryable or token cannot be declared.
    #[error("cannot declare {key}")]
    Declare {
        /// The key expression.
        key: String,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A message cannot be put: the session is closed.
    #[error("cannot put on {key}")]
    Put {
        /// The key.
        key: String,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A message cannot be written.
    #[error("cannot encode a message for {key}")]
    Encode {
        /// The key.
        key: String,
        /// What is wrong with it.
        source: EncodeError,
    },
    /// A block does not continue its stream.
    #[error("cannot put on {key}")]
    NotConsecutive {
        /// The key.
        key: String,
        /// What was expected and found.
        source: NotConsecutive,
    },
    /// The session cannot be closed in order.
    #[error("cannot close the zenoh session")]
    Close {
        /// What Zenoh says.
        source: ZenohError,
    },
}
