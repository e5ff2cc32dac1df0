//! What can be wrong with the dashboard.

use std::io;

/// Why the dashboard cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum DashboardError {
    /// The address is taken, is none, or may not be listened on.
    #[error("cannot serve the page on {address}, must be a free address such as 127.0.0.1:8080, or none for no page")]
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
    /// The bus cannot be listened to, or is closed.
    #[error(transparent)]
    Bus(#[from] spandrel_bus::BusError),
    /// A name cannot be a key.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
}
