//! Opens the database and its tables, again and again if need be.

use super::file::{FileId, Folder, make_file, set_aside};
use super::{Database, database_error};
use crate::error::HistoryError;
use crate::settings::Address;
use sqlx::any::AnyPoolOptions;
use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::{AnyPool, Executor, SqlSafeStr};
use std::borrow::Cow;
use std::path::PathBuf;
use std::time::Duration;

/// Maximum number of connections: one writes, the others serve queries.
const CONNECTIONS: u32 = 4;
/// Time limit for a connection to the database.
const CONNECT_WITHIN: Duration = Duration::from_secs(5);

/// Whether the database is open.
#[derive(Debug, Default)]
pub(super) enum Opened {
    /// It was never open.
    #[default]
    Never,
    /// It was open, and must be opened again.
    Before,
    /// It is open.
    Now {
        pool: AnyPool,
        /// `None` for a server.
        file: Option<FileId>,
    },
}

/// A corrupt file under its new name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct CorruptFile {
    pub(crate) path: PathBuf,
    pub(crate) aside: PathBuf,
    pub(crate) why: String,
}

impl Database {
    /// Returns the connections. Opens the database first if it is not open, and migrates the tables
    /// to the version of this program.
    ///
    /// If the file is no longer at its path, the database is opened again. A corrupt file is set
    /// aside and replaced by a new one.
    pub(super) async fn pool(&self) -> Result<AnyPool, HistoryError> {
        let mut opened = self.opened.lock().await;
        let folder = match &*opened {
            Opened::Now { pool, file } if *file == self.file() => return Ok(pool.clone()),
            Opened::Now { pool, .. } => {
                // The file has been moved or deleted. What is written to it is lost to its path.
                pool.close().await;
                *opened = Opened::Before;
                Folder::MustExist
            }
            Opened::Before => Folder::MustExist,
            Opened::Never => Folder::Create,
        };
        let pool = match self.open(folder).await {
            Err(error) if error.is_of_a_corrupt_file(&self.address) => {
                self.set_file_aside(&error)?;
                self.open(Folder::MustExist).await?
            }
            opened => opened?,
        };
        self.numbers.lock().await.clear();
        *opened = Opened::Now {
            pool: pool.clone(),
            file: self.file(),
        };
        Ok(pool)
    }

    /// Sets the file aside if an error shows that it is corrupt. The next use begins a new file.
    pub(super) async fn check_file(&self, error: &HistoryError) {
        if !error.is_of_a_corrupt_file(&self.address) {
            return;
        }
        let mut opened = self.opened.lock().await;
        if let Opened::Now { pool, .. } = &*opened {
            pool.close().await;
            *opened = Opened::Before;
            // If this fails, the next use reports the same error again.
            let _ = self.set_file_aside(error);
        }
    }

    fn set_file_aside(&self, error: &HistoryError) -> Result<(), HistoryError> {
        let Address::Sqlite(path) = &self.address else {
            return Ok(());
        };
        let file = CorruptFile {
            path: path.clone(),
            aside: set_aside(path)?,
            why: error.reason(),
        };
        self.corrupt_files().push(file);
        Ok(())
    }

    fn file(&self) -> Option<FileId> {
        match &self.address {
            Address::Sqlite(path) => FileId::of(path),
            Address::Postgres(_) => None,
        }
    }

    async fn open(&self, folder: Folder) -> Result<AnyPool, HistoryError> {
        let is_file = matches!(self.address, Address::Sqlite(_));
        let options = AnyPoolOptions::new()
            .max_connections(CONNECTIONS)
            .acquire_timeout(CONNECT_WITHIN)
            .after_connect(move |connection, _| {
                Box::pin(async move {
                    if is_file {
                        connection.execute("PRAGMA busy_timeout = 5000").await?;
                        // Each commit is synced. With NORMAL, a power failure loses all commits
                        // since SQLite last moved the WAL into the database, which can be hours. If
                        // the file is unreadable, the next statement reports the reason. An error
                        // here would only appear as a timeout of the pool.
                        let _ = connection.execute("PRAGMA synchronous = FULL").await;
                    }
                    Ok(())
                })
            });
        let pool = options
            .connect_lazy(&self.address.url())
            .map_err(|source| self.error(source))?;
        let migrated = self.migrate(&pool, folder).await;
        if migrated.is_err() {
            pool.close().await;
        }
        migrated.map(|()| pool)
    }

    /// Migrates the tables to the version of this program.
    async fn migrate(&self, pool: &AnyPool, folder: Folder) -> Result<(), HistoryError> {
        let sql = match &self.address {
            Address::Sqlite(path) => {
                make_file(path, folder)?;
                // WAL mode is stored in the file. Readers see the last committed state during a
                // write. A crash of the machine does not damage the file.
                let journal = sqlx::query("PRAGMA journal_mode = WAL").execute(pool).await;
                journal.map_err(|source| self.error(source))?;
                include_str!("../../migrations/sqlite-1.sql")
            }
            Address::Postgres(_) => include_str!("../../migrations/postgres-1.sql"),
        };
        let first = Migration::new(
            1,
            Cow::Borrowed("history"),
            MigrationType::Simple,
            sql.into_sql_str(),
            false,
        );
        let migrated = Migrator::with_migrations(vec![first]).run(pool).await;
        migrated.map_err(|source| match source {
            MigrateError::Execute(source) | MigrateError::ExecuteMigration(source, _) => {
                self.error(source)
            }
            source => HistoryError::Version {
                database: self.address.to_string(),
                source,
            },
        })
    }

    pub(super) fn error(&self, source: sqlx::Error) -> HistoryError {
        database_error(&self.address, source)
    }
}
