//! Errors of the history service.

use crate::settings::Address;
use spandrel_bus::BusError;
use std::io::ErrorKind;
use std::path::PathBuf;

/// An error of the history service.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    /// The address of the database is not supported.
    #[error(
        "history.database is {found:?}, must be a file, sqlite:FILE, postgres://USER@HOST/DATABASE or none"
    )]
    Address {
        /// The configured value, without a password.
        found: String,
    },
    /// The folder of the file cannot be created.
    #[error("{}: cannot create the history folder", path.display())]
    Folder {
        /// Path of the folder.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The file cannot be created or opened.
    #[error("{}: cannot be opened as the history file", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The database returned an error or did not reply.
    #[error("history database {database} cannot be used")]
    Database {
        /// Address of the database, without a password.
        database: String,
        /// The error of the database.
        source: sqlx::Error,
    },
    /// The tables cannot be migrated to the version of this program.
    #[error(
        "history database {database} cannot be migrated to the version of this program; a program \
         cannot read a database that a later version has written"
    )]
    Version {
        /// Address of the database, without a password.
        database: String,
        /// The error of the migration.
        source: sqlx::migrate::MigrateError,
    },
    /// A message cannot be converted to or from JSON.
    #[error("cannot convert a message of the history to or from JSON")]
    Message(#[from] serde_json::Error),
    /// The bus rejected a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A name cannot be part of a key expression.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
}

impl HistoryError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::Address { .. })
    }
}

impl HistoryError {
    /// Returns `true` if a retry can succeed, for example after a full disk or before a server has
    /// started. A wrong path is permanent.
    pub(crate) fn is_transient(&self, address: &Address) -> bool {
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
                // Codes: I/O error, disk full, cannot open. The database file itself could be
                // opened, so the last one concerns a file beside it.
                matches!(code, Some(10 | 13 | 14))
            }
            _ => false,
        }
    }
}
