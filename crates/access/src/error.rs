//! Errors of roles and certificates.

use std::path::PathBuf;

use crate::role::{Party, PartyError, Role};
use spandrel_bus::TlsError;

/// An error of a role, a certificate or a site folder.
///
/// No variant contains any part of a private key.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// The role or the name of a party is invalid.
    #[error(transparent)]
    Party(#[from] PartyError),
    /// A file cannot be read or written.
    #[error("{} cannot be {what}", path.display())]
    File {
        /// Attempted operation, as a past participle.
        what: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file already exists.
    #[error("{} already exists; use --replace to overwrite it", path.display())]
    Exists {
        /// Path of the file.
        path: PathBuf,
    },
    /// The folder is not the folder of a site.
    #[error("{} is not a site folder: it has no {file}; create one with spandrel site \
             create", folder.display())]
    NoSite {
        /// Path of the folder.
        folder: PathBuf,
        /// Name of the missing file.
        file: &'static str,
    },
    /// The certificate file of the authority cannot be used.
    #[error("{} is not a certificate of an authority", path.display())]
    NoAuthority {
        /// Path of the certificate.
        path: PathBuf,
    },
    /// The certificate of the authority has expired.
    #[error("the authority {} expired on {expired}; create a new one with spandrel site create \
             --replace", path.display())]
    AuthorityExpired {
        /// Path of the certificate.
        path: PathBuf,
        /// Date of expiry.
        expired: String,
    },
    /// A certificate or key cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// A key or certificate cannot be created.
    #[error("cannot create the {what}")]
    Make {
        /// Object that could not be created.
        what: &'static str,
        /// Error of the certificate library.
        source: rcgen::Error,
    },
    /// A certificate for a role that accepts connections has no host.
    #[error(
        "the certificate of a {role} requires its host names and addresses, such as --host 10.0.0.5"
    )]
    NoHost {
        /// Role of the certificate.
        role: Role,
    },
    /// The text is neither a host name nor an address, so a certificate cannot contain it.
    #[error("`{host}` is not a host name or an address")]
    Host {
        /// The rejected text.
        host: String,
    },
    /// The validity period is zero or beyond the calendar.
    #[error("validity is {days} days, must be 1 to 36500")]
    Days {
        /// Requested validity period, in days.
        days: u32,
    },
    /// The folder contains no certificate of a router, or none with the requested name.
    #[error("{} has no certificate of a router; create one with spandrel site issue router NAME \
             --host HOST", folder.display())]
    NoRouter {
        /// Path of the folder.
        folder: PathBuf,
    },
    /// The folder contains certificates of several routers, and none was chosen.
    #[error(
        "{} has certificates of several routers ({}); choose one with --router NAME",
        folder.display(),
        found.iter().map(Party::common_name).collect::<Vec<_>>().join(", ")
    )]
    SeveralRouters {
        /// Path of the folder.
        folder: PathBuf,
        /// The routers found.
        found: Vec<Party>,
    },
    /// The router would listen without certificates.
    #[error("the router would listen on {endpoint} without certificates, must be quic/HOST:PORT")]
    PlainEndpoint {
        /// The rejected endpoint.
        endpoint: String,
    },
    /// A path is not UTF-8, so the router's configuration cannot contain it.
    #[error("path {} is not UTF-8, zenoh cannot use it", path.display())]
    PathNotText {
        /// The rejected path.
        path: PathBuf,
    },
}

impl AccessError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(
            self,
            Self::Party(_)
                | Self::Exists { .. }
                | Self::NoSite { .. }
                | Self::NoHost { .. }
                | Self::Host { .. }
                | Self::Days { .. }
                | Self::NoRouter { .. }
                | Self::SeveralRouters { .. }
                | Self::PlainEndpoint { .. }
                | Self::PathNotText { .. }
        )
    }
}
