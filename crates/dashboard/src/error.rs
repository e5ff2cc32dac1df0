//! Errors of the dashboard.

use spandrel_bus::Name;
use std::io;
use std::path::PathBuf;

/// An error that prevents the dashboard from starting or from serving its page.
#[derive(Debug, thiserror::Error)]
pub enum DashboardError {
    /// The address is in use or invalid, or this process may not listen on it.
    #[error(
        "cannot serve the page on {address}, must be a free address such as 127.0.0.1:8080, or \
         none for no page"
    )]
    Listen {
        /// Requested address.
        address: String,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The page cannot be served any further.
    #[error("the page can no longer be served")]
    Serve {
        /// Error of the operating system.
        source: io::Error,
    },
    /// Other machines could reach the page, and a certificate or a token is missing.
    #[error(
        "refusing to serve the page on {address}: other machines can reach it, and it has no \
         {missing}; set dashboard.certificate and dashboard.tokens (spandrel token creates \
         tokens), or use a loopback address such as 127.0.0.1:8080"
    )]
    Unprotected {
        /// Requested address.
        address: String,
        /// Name of the missing item.
        missing: &'static str,
    },
    /// The certificate cannot be used.
    #[error("certificate {} cannot be used for the page", path.display())]
    Certificate {
        /// Path of the certificate.
        path: PathBuf,
        /// Error of the TLS library.
        source: rustls::Error,
    },
    /// The certificate and key cannot be read or do not belong together.
    #[error(transparent)]
    Tls(#[from] spandrel_bus::TlsError),
    /// The token file cannot be read or written.
    #[error("token file {} cannot be read or written", path.display())]
    TokenFile {
        /// Path of the token file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file is not a token file.
    #[error("{}:{line}: is not a token file; use spandrel token to create one", path.display())]
    NotTokens {
        /// Path of the file.
        path: PathBuf,
        /// Line of the first error.
        line: usize,
    },
    /// The token file contains no token.
    ///
    /// Without any token the page would be open to everybody, so an empty file is an error.
    #[error("token file {} has no token, must have at least one; use spandrel token to add one, \
             or remove dashboard.tokens to serve an open page", path.display())]
    NoTokens {
        /// Path of the file.
        path: PathBuf,
    },
    /// The name already has a token.
    #[error("{name} already has a token in {}; use --replace to create another, which invalidates \
             the old one", path.display())]
    TokenExists {
        /// The name.
        name: Name,
        /// Path of the token file.
        path: PathBuf,
    },
    /// The operating system provides no random numbers.
    #[error("the system provides no random numbers; cannot create a token or session")]
    NoRandom,
    /// A subscription on the bus failed, or the bus is closed.
    #[error(transparent)]
    Bus(#[from] spandrel_bus::BusError),
    /// A name cannot be used in a key.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
}

impl DashboardError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        // An invalid address, unlike one in use, does not become valid later.
        if let Self::Listen { source, .. } = self {
            return source.kind() == io::ErrorKind::InvalidInput;
        }
        matches!(
            self,
            Self::Unprotected { .. }
                | Self::Tls(_)
                | Self::Certificate { .. }
                | Self::TokenFile { .. }
                | Self::NotTokens { .. }
                | Self::NoTokens { .. }
                | Self::TokenExists { .. }
        )
    }
}
