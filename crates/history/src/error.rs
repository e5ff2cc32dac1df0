//! Errors of the history service.

use crate::settings::Address;
use spandrel_bus::BusError;
use std::io::ErrorKind;
use std::path::PathBuf;

/// Error codes of SQLite: the file is damaged, and the file is no database.
const SQLITE_CORRUPT: u32 = 11;
const SQLITE_NOTADB: u32 = 26;

/// An error that prevents the history service from starting, or from storing or reading values.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    /// The address of the database is not supported.
    #[error(
        "history.database is {found:?}, must be a file, sqlite:FILE, \
         postgres://USER@HOST/DATABASE or none"
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
    /// Returns `true` if the cause is a path that can never be a file, so that a retry is useless.
    ///
    /// All other causes can end: a full or read-only disk, a missing right, an unreachable server.
    pub(crate) fn is_of_the_path(&self) -> bool {
        let (Self::Folder { source, .. } | Self::File { source, .. }) = self else {
            return false;
        };
        matches!(
            source.kind(),
            ErrorKind::IsADirectory
                | ErrorKind::NotADirectory
                | ErrorKind::AlreadyExists
                | ErrorKind::InvalidFilename
        )
    }

    /// Returns `true` if the file of the database is damaged, or is no database.
    pub(crate) fn is_of_a_corrupt_file(&self, address: &Address) -> bool {
        let (Self::Database { source, .. }, Address::Sqlite(_)) = (self, address) else {
            return false;
        };
        let code = source.as_database_error().and_then(|error| error.code());
        let code = code.and_then(|code| code.parse::<u32>().ok());
        // The low byte of an extended code contains the primary code.
        code.is_some_and(|code| [SQLITE_CORRUPT, SQLITE_NOTADB].contains(&(code & 0xff)))
    }

    /// Returns the chain of sources of the error.
    pub(crate) fn reason(&self) -> String {
        let mut reason = String::new();
        let mut source = std::error::Error::source(self);
        while let Some(error) = source {
            if !reason.is_empty() {
                reason.push_str(": ");
            }
            reason.push_str(&error.to_string());
            source = error.source();
        }
        reason
    }
}
