//! What can go wrong with the history.

use spandrel_bus::BusError;
use std::path::PathBuf;

/// Errors of the history service.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    /// The database is none of those that can be used.
    #[error("history.database is {found:?}, must be a file, sqlite:FILE, postgres://USER@HOST/DATABASE or none")]
    Address {
        /// What the configuration says, without a password.
        found: String,
    },
    /// The folder of the file cannot be made.
    #[error("{}: cannot make the folder of the history", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The database refuses, or does not answer.
    #[error("history database {database} cannot be used")]
    Database {
        /// Which one, without a password.
        database: String,
        /// What it says.
        source: sqlx::Error,
    },
    /// The tables cannot be brought to the version of this program.
    #[error(
        "history database {database} cannot be brought to the version of this program; one written by a later version cannot be read by an earlier one"
    )]
    Version {
        /// Which one, without a password.
        database: String,
        /// What was found.
        source: sqlx::migrate::MigrateError,
    },
    /// A message cannot be written as text.
    #[error("cannot write a message to the history")]
    Message(#[from] serde_json::Error),
    /// The bus refuses.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A key is none.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
}
