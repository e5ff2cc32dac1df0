//! What can go wrong with roles and certificates.

use std::path::PathBuf;

use crate::role::{Party, PartyError, Role};
use spandrel_bus::TlsError;

/// Errors of this room. None of them holds any part of a private key.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// A role and a name do not make a party.
    #[error(transparent)]
    Party(#[from] PartyError),
    /// A file cannot be read or written.
    #[error("{} cannot be {what}", path.display())]
    File {
        /// What was tried.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Something is there already.
    #[error("{} is there already; --replace writes it anew, and what it was is lost", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// A folder is none of a site.
    #[error("{} is no folder of a site: it has no {file}; spandrel site create makes one", folder.display())]
    NoSite {
        /// The folder.
        folder: PathBuf,
        /// The file that it lacks.
        file: &'static str,
    },
    /// The authority cannot be used.
    #[error("{} is no certificate of an authority", path.display())]
    NoAuthority {
        /// Its certificate.
        path: PathBuf,
    },
    /// The authority is over.
    #[error("the authority {} has expired on {expired}; spandrel site create --replace makes a new one", path.display())]
    AuthorityExpired {
        /// Its certificate.
        path: PathBuf,
        /// The last day on which it was valid.
        expired: String,
    },
    /// A certificate cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// A key or certificate cannot be made.
    #[error("cannot make the {what}")]
    Make {
        /// What was to be made.
        what: &'static str,
        /// What the library says.
        source: rcgen::Error,
    },
    /// A certificate that others connect to must say under which names.
    #[error(
        "a {role} is connected to: say under which names and addresses, such as --host 10.0.0.5"
    )]
    NoHost {
        /// The role.
        role: Role,
    },
    /// A host cannot stand in a certificate.
    #[error("`{host}` is no host name and no address")]
    Host {
        /// The text.
        host: String,
    },
    /// A length of life that no calendar has.
    #[error("{days} days from now is beyond the calendar, must be 1 to 36500")]
    Days {
        /// The days.
        days: u32,
    },
    /// The router has no certificate.
    #[error("{} has no certificate of a router; spandrel site issue router NAME --host HOST makes one", folder.display())]
    NoRouter {
        /// The folder.
        folder: PathBuf,
    },
    /// The folder has certificates of several routers.
    #[error(
        "{} has certificates of several routers ({}); say which with --router NAME",
        folder.display(),
        found.iter().map(Party::common_name).collect::<Vec<_>>().join(", ")
    )]
    SeveralRouters {
        /// The folder.
        folder: PathBuf,
        /// The routers.
        found: Vec<Party>,
    },
    /// The router would listen without certificates.
    #[error("the router would listen on {endpoint} without certificates, must be quic/HOST:PORT")]
    PlainEndpoint {
        /// The endpoint.
        endpoint: String,
    },
    /// A path cannot stand in the file of a router.
    #[error("path {} is not UTF-8, zenoh cannot use it", path.display())]
    PathNotText {
        /// The path.
        path: PathBuf,
    },
}
