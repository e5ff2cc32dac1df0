//! What can be wrong with the dashboard.

use spandrel_bus::Name;
use std::io;
use std::path::PathBuf;

/// Why the dashboard cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum DashboardError {
    /// The address is taken, is none, or may not be listened on.
    #[error(
        "cannot serve the page on {address}, must be a free address such as 127.0.0.1:8080, or none for no page"
    )]
    Listen {
        /// The address asked for.
        address: String,
        /// What the system says.
        source: io::Error,
    },
    /// The connection to browsers broke down.
    #[error("the page can no longer be served")]
    Serve {
        /// What the system says.
        source: io::Error,
    },
    /// Others than this machine could see the page, and something that it then needs is missing.
    #[error(
        "will not serve the page on {address}: others than this machine can reach it, and it has no {missing}; \
         set dashboard.certificate and dashboard.tokens (spandrel token makes them), or use an address of this machine \
         such as 127.0.0.1:8080"
    )]
    Unprotected {
        /// The address asked for.
        address: String,
        /// What is missing.
        missing: &'static str,
    },
    /// The certificate cannot be used.
    #[error("certificate {} cannot be used for the page", path.display())]
    Certificate {
        /// The certificate.
        path: PathBuf,
        /// What the library says.
        source: rustls::Error,
    },
    /// Certificate and key cannot be read, or do not belong together.
    #[error(transparent)]
    Tls(#[from] spandrel_bus::TlsError),
    /// The file of tokens cannot be read or written.
    #[error("tokens {} cannot be read or written", path.display())]
    TokenFile {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file of tokens is none.
    #[error("{}:{line}: is no file of tokens, spandrel token writes one", path.display())]
    NotTokens {
        /// The file.
        path: PathBuf,
        /// The line at which it is none.
        line: usize,
    },
    /// A file of tokens that lets nobody in: without one, the page would be open to everybody.
    #[error("tokens {} has no token, must have one at least: spandrel token adds one; without dashboard.tokens the page is open", path.display())]
    NoTokens {
        /// The file.
        path: PathBuf,
    },
    /// A name has a token.
    #[error("{name} has a token in {} already; --replace makes another, and the old one is worth nothing then", path.display())]
    TokenExists {
        /// The name.
        name: Name,
        /// The file.
        path: PathBuf,
    },
    /// The system has no random numbers.
    #[error("the system gives no random numbers, no token or session can be made")]
    NoRandom,
    /// The bus cannot be listened to, or is closed.
    #[error(transparent)]
    Bus(#[from] spandrel_bus::BusError),
    /// A name cannot be a key.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
}
