//! What can go wrong with the history.

use crate::settings::Address;
use spandrel_bus::BusError;
use std::io::ErrorKind;
use std::path::PathBuf;

/// Errors of the history service.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    /// The database is none of those that can be used.
    #[error(
        "history.database is {found:?}, must be a file, sqlite:FILE, postgres://USER@HOST/DATABASE or none"
    )]
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
    /// The file cannot be made or opened.
    #[error("{}: cannot be opened as the file of the history", path.display())]
    File {
        /// The file.
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

impl HistoryError {
    /// Whether it may pass by itself, as a full disk does or a server that is not there yet; a path that is wrong stays wrong.
    pub(crate) fn may_pass(&self, address: &Address) -> bool {
        match (self, address) {
            (Self::Folder { source, .. } | Self::File { source, .. }, _) => !matches!(
                source.kind(),
                ErrorKind::IsADirectory
                    | ErrorKind::NotADirectory
                    | ErrorKind::NotFound
                    | ErrorKind::PermissionDenied
                    | ErrorKind::ReadOnlyFilesystem
                    | ErrorKind::AlreadyExists
                    | ErrorKind::InvalidFilename
            ),
            (Self::Database { .. }, Address::Postgres(_)) => true,
            (Self::Database { source, .. }, Address::Sqlite(_)) => {
                let code = source.as_database_error().and_then(|error| error.code());
                let code = code
                    .and_then(|code| code.parse::<u32>().ok())
                    .map(|code| code & 0xff);
                // input or output failed, full, and cannot open: the file itself could be opened, so it is one beside it
                matches!(code, Some(10 | 13 | 14))
            }
            _ => false,
        }
    }
}
