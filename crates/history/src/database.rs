//! The database, a SQLite file or a PostgreSQL server, with the same statements for both.

mod file;
mod opening;
mod writing;

use crate::batch::{Batch, Kind, RESOLUTIONS_S, Series};
use crate::error::HistoryError;
use crate::settings::{Address, Keep};
use crate::sums::{Sums, rows};
pub(crate) use opening::CorruptFile;
use opening::Opened;
use spandrel_bus::{
    Acknowledgement, AlertMessage, Event, HistoryLog, HistorySpan, Name, SpanQuery,
};
use sqlx::any::{AnyConnectOptions, AnyRow, install_default_drivers};
use sqlx::{AnyPool, AssertSqlSafe, Executor, Row};
use std::collections::HashMap;
use std::str::FromStr as _;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, MutexGuard, PoisonError};
use tokio::sync::Mutex;
use tracing::warn;
use writing::{Care, Failed, SetAside, Writing};

/// Maximum number of rows for a reply. A longer span uses a coarser resolution.
const MOST_ROWS: i64 = 50_000;
/// Maximum number of rows that are read. If there are more, the newest are missing.
const MOST_READ: i64 = 2 * MOST_ROWS;
/// Interval between display values (ns) at the default display rate: ten per second.
const DISPLAY_NS: i64 = 100_000_000;
const SECOND_NS: i64 = 1_000_000_000;

/// The database handle. Cloning is cheap.
#[derive(Clone, Debug)]
pub(crate) struct Database {
    address: Address,
    opened: Arc<Mutex<Opened>>,
    /// IDs of the series that exist in the database. Whoever holds this lock writes; SQLite permits
    /// one writer, and rejects another one in the middle of its transaction.
    numbers: Arc<Mutex<HashMap<(String, Series), i64>>>,
    /// Number of rows that the database rejected permanently.
    set_aside: Arc<AtomicU64>,
    /// Corrupt files under their new names, until they are reported.
    corrupt: Arc<std::sync::Mutex<Vec<CorruptFile>>>,
    /// Number of values of conditions and modes that were not newer than those in the database.
    repeated: Arc<AtomicU64>,
}

impl Database {
    /// Describes the database without opening it.
    pub(crate) fn new(address: &Address) -> Result<Self, HistoryError> {
        install_default_drivers();
        // An address that the driver cannot read will not become readable.
        let options = AnyConnectOptions::from_str(&address.url());
        options.map_err(|source| database_error(address, source))?;
        Ok(Self {
            address: address.clone(),
            opened: Arc::default(),
            numbers: Arc::default(),
            set_aside: Arc::default(),
            corrupt: Arc::default(),
            repeated: Arc::default(),
        })
    }

    /// Opens the database if it is not open, and migrates the tables to the version of this
    /// program.
    pub(crate) async fn ready(&self) -> Result<(), HistoryError> {
        self.pool().await.map(drop)
    }

    /// Returns the corrupt files that have been set aside since the last call.
    pub(crate) fn take_corrupt(&self) -> Vec<CorruptFile> {
        std::mem::take(&mut self.corrupt_files())
    }

    fn corrupt_files(&self) -> MutexGuard<'_, Vec<CorruptFile>> {
        // No code that holds this lock panics.
        self.corrupt.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes all batches in one transaction, except batches that an earlier attempt of the same
    /// run has written.
    ///
    /// Rows that the database rejects permanently are skipped, counted and logged, so that they do
    /// not block later rows.
    pub(crate) async fn write(
        &self,
        life: &str,
        batches: &[Arc<Batch>],
    ) -> Result<(), HistoryError> {
        if batches.is_empty() {
            return Ok(());
        }
        let pool = self.pool().await?;
        let mut numbers = self.numbers.lock().await;
        let written = match self
            .write_once(&pool, life, batches, &mut numbers, Care::ManyRowsAtOnce)
            .await
        {
            Err(failed) if failed.is_of_the_rows(&self.address) => {
                self.write_once(&pool, life, batches, &mut numbers, Care::SettingAside)
                    .await
            }
            written => written,
        };
        drop(numbers);
        let written = written.map_err(|failed| match failed {
            Failed::Database(source) => self.error(source),
            Failed::Message(source) => source.into(),
        });
        if let Err(error) = &written {
            self.check_file(error).await;
        }
        written
    }

    async fn write_once(
        &self,
        pool: &AnyPool,
        life: &str,
        batches: &[Arc<Batch>],
        numbers: &mut HashMap<(String, Series), i64>,
        care: Care,
    ) -> Result<(), Failed> {
        let mut connection = pool.acquire().await?;
        let written = async {
            connection.execute(self.begin()).await?;
            let mut writing = Writing::new(&mut connection, &self.address, care, numbers);
            writing.write_all(life, batches).await?;
            let (found, set_aside) = writing.end();
            connection.execute("COMMIT").await?;
            Ok((found, set_aside))
        };
        match written.await {
            Ok((
                found,
                SetAside {
                    rows,
                    repeated,
                    reason,
                },
            )) => {
                numbers.extend(found);
                self.repeated.fetch_add(repeated, Ordering::Relaxed);
                let before = self.set_aside.fetch_add(rows, Ordering::Relaxed);
                let total = before + rows;
                // A permanently rejected value can recur every second. It is therefore logged only
                // when the count has doubled.
                let has_doubled = before == 0 || total.ilog2() > before.ilog2();
                if let Some(reason) = reason.filter(|_| has_doubled) {
                    warn!(
                        rows = total,
                        reason, "history database permanently rejects some rows; skipping them"
                    );
                }
                Ok(())
            }
            Err(failed) => {
                // SQLite rolls back by itself when the disk is full, but not after every error. The
                // state of the connection is then unknown, and its next statements might never be
                // committed.
                connection.close_on_drop();
                Err(failed)
            }
        }
    }

    /// Returns the statement that begins a transaction that writes.
    ///
    /// In SQLite, a transaction that reads first fails if another process writes before its own
    /// first write. With `IMMEDIATE`, it waits for the other process instead.
    fn begin(&self) -> &'static str {
        match &self.address {
            Address::Sqlite(_) => "BEGIN IMMEDIATE",
            Address::Postgres(_) => "BEGIN",
        }
    }

    /// Returns the number of rows that the database rejected permanently.
    pub(crate) fn set_aside(&self) -> u64 {
        self.set_aside.load(Ordering::Relaxed)
    }

    /// Returns the number of values of conditions and modes that were not newer than those in the
    /// database.
    pub(crate) fn repeated(&self) -> u64 {
        self.repeated.load(Ordering::Relaxed)
    }

    /// Reads one quantity of a structure (`root/structure`) over a time span.
    pub(crate) async fn span(
        &self,
        structure: &str,
        name: &Name,
        of: &Series,
        query: &SpanQuery,
    ) -> Result<HistorySpan, HistoryError> {
        let pool = self.pool().await?;
        let read = self
            .read_span(&pool, structure, of, query)
            .await
            .map_err(|source| self.error(source))?;
        let (resolution_s, kept_from_s, values) = read.unwrap_or((None, None, Vec::new()));
        Ok(HistorySpan {
            structure: name.clone(),
            kind: of.kind.as_str().to_owned(),
            name: of.name.clone(),
            resolution_s,
            kept_from_s,
            rows: rows(&values, query.points),
        })
    }

    /// Finds the series, then the finest resolution that covers the span with at most about
    /// [`MOST_ROWS`] rows.
    async fn read_span(
        &self,
        pool: &AnyPool,
        structure: &str,
        of: &Series,
        query: &SpanQuery,
    ) -> Result<Option<(Option<u32>, Option<f64>, Vec<Sums>)>, sqlx::Error> {
        let found =
            sqlx::query("SELECT id FROM series WHERE structure = $1 AND kind = $2 AND name = $3")
                .bind(structure.to_owned())
                .bind(of.kind.as_str())
                .bind(of.name.clone())
                .fetch_optional(pool)
                .await?;
        let Some(id) = found.map(|row| row.try_get::<i64, _>(0)).transpose()? else {
            return Ok(None);
        };
        let points_from = first(
            sqlx::query("SELECT time_ns FROM point WHERE series = $1 ORDER BY time_ns LIMIT 1")
                .bind(id),
            pool,
        )
        .await?;
        // Each entry: interval (ns), first time (ns), resolution (s). The finest comes first.
        let mut kept = Vec::new();
        kept.extend(points_from.map(|from_ns| (DISPLAY_NS, from_ns, None)));
        for resolution_s in RESOLUTIONS_S {
            let statement = "SELECT first_ns FROM bucket WHERE series = $1 AND resolution_s = $2 \
                             ORDER BY start_s LIMIT 1";
            let first_ns = first(sqlx::query(statement).bind(id).bind(resolution_s), pool).await?;
            kept.extend(
                first_ns.map(|first_ns| (resolution_s * SECOND_NS, first_ns, Some(resolution_s))),
            );
        }
        let Some(oldest) = kept.iter().min_by_key(|(_, from_ns, _)| *from_ns).copied() else {
            return Ok(None);
        };
        let last_ns = self
            .newest_ns(pool, id)
            .await?
            .unwrap_or(i64::MAX)
            .min(query.to_ns);
        let wanted_ns = query.from_ns.max(oldest.1);
        let fits = |(step_ns, from_ns, _): &&(i64, i64, Option<i64>)| {
            let rows = last_ns.saturating_sub(wanted_ns.max(*from_ns)) / step_ns;
            *from_ns <= wanted_ns.saturating_add(*step_ns) && rows <= MOST_ROWS
        };
        let first = { kept.iter() }
            .position(|one| fits(&one))
            .unwrap_or(kept.len() - 1);
        let (mut values, mut resolution_s) = (Vec::new(), None);
        for (_, _, resolution) in &kept[first..] {
            resolution_s = *resolution;
            values = match resolution {
                None => self.read_points(pool, id, query).await?,
                Some(resolution_s) => self.read_buckets(pool, id, *resolution_s, query).await?,
            };
            // The display rate can exceed ten values per second. The newest rows are then missing.
            if values.len() < MOST_READ as usize {
                break;
            }
        }
        let kept_from_s = (oldest.1 as f64) / 1e9;
        Ok(Some((
            resolution_s.and_then(|s| u32::try_from(s).ok()),
            Some(kept_from_s),
            values,
        )))
    }

    /// Returns the time of the newest value of a series (ns).
    async fn newest_ns(&self, pool: &AnyPool, id: i64) -> Result<Option<i64>, sqlx::Error> {
        let statement = "SELECT last_ns FROM bucket WHERE series = $1 AND resolution_s = $2 ORDER \
                         BY start_s DESC LIMIT 1";
        first(
            sqlx::query(statement)
                .bind(id)
                .bind(RESOLUTIONS_S[RESOLUTIONS_S.len() - 1]),
            pool,
        )
        .await
    }

    async fn read_points(
        &self,
        pool: &AnyPool,
        id: i64,
        query: &SpanQuery,
    ) -> Result<Vec<Sums>, sqlx::Error> {
        let statement = "SELECT time_ns, mean, std, probability FROM point \
                         WHERE series = $1 AND time_ns >= $2 AND time_ns <= $3 ORDER BY time_ns \
                         LIMIT $4";
        let found = sqlx::query(statement)
            .bind(id)
            .bind(query.from_ns)
            .bind(query.to_ns)
            .bind(MOST_READ)
            .fetch_all(pool)
            .await?;
        let sums = |row: &AnyRow| -> Result<Sums, sqlx::Error> {
            Ok(Sums::of(
                row.try_get(0)?,
                [row.try_get(1)?, row.try_get(2)?, row.try_get(3)?],
            ))
        };
        found.iter().map(sums).collect()
    }

    async fn read_buckets(
        &self,
        pool: &AnyPool,
        id: i64,
        resolution_s: i64,
        query: &SpanQuery,
    ) -> Result<Vec<Sums>, sqlx::Error> {
        let statement = "SELECT first_ns, last_ns, count, mean_sum, square_sum, variance_sum, \
                         least, largest, low, high, probability FROM bucket WHERE series = $1 AND \
                         resolution_s = $2 AND start_s > $3 AND start_s <= $4 ORDER BY start_s \
                         LIMIT $5";
        let found = sqlx::query(statement)
            .bind(id)
            .bind(resolution_s)
            // The span includes an interval that starts before it and extends into it.
            .bind((query.from_ns.div_euclid(SECOND_NS)).saturating_sub(resolution_s))
            .bind(query.to_ns.div_euclid(SECOND_NS))
            .bind(MOST_READ)
            .fetch_all(pool)
            .await?;
        let sums = |row: &AnyRow| -> Result<Sums, sqlx::Error> {
            Ok(Sums {
                first_ns: row.try_get(0)?,
                last_ns: row.try_get(1)?,
                count: row.try_get(2)?,
                mean_sum: row.try_get(3)?,
                square_sum: row.try_get(4)?,
                variance_sum: row.try_get(5)?,
                least: row.try_get(6)?,
                largest: row.try_get(7)?,
                low: row.try_get(8)?,
                high: row.try_get(9)?,
                probability: row.try_get(10)?,
            })
        };
        found.iter().map(sums).collect()
    }

    /// Reads the log of a time span: the newest `query.points` entries, oldest first.
    pub(crate) async fn log(
        &self,
        structure: &str,
        name: &Name,
        query: &SpanQuery,
    ) -> Result<HistoryLog, HistoryError> {
        let pool = self.pool().await?;
        let statement = "SELECT kind, message FROM happened WHERE structure = $1 AND time_ns >= \
                         $2 AND time_ns <= $3 ORDER BY time_ns DESC LIMIT $4";
        let found = sqlx::query(statement)
            .bind(structure.to_owned())
            .bind(query.from_ns)
            .bind(query.to_ns)
            .bind(i64::try_from(query.points).unwrap_or(i64::MAX))
            .fetch_all(&pool)
            .await
            .map_err(|source| self.error(source))?;
        let mut log = HistoryLog {
            structure: name.clone(),
            alerts: Vec::new(),
            acknowledgements: Vec::new(),
            events: Vec::new(),
        };
        for row in found.iter().rev() {
            let text = |column: usize| {
                row.try_get::<String, _>(column)
                    .map_err(|source| self.error(source))
            };
            let (kind, message) = (text(0)?, text(1)?);
            match kind.as_str() {
                "alert" => log
                    .alerts
                    .push(serde_json::from_str::<AlertMessage>(&message)?.legible()),
                "acknowledgement" => {
                    log.acknowledgements
                        .push(serde_json::from_str::<Acknowledgement>(&message)?.legible());
                }
                _ => log
                    .events
                    .push(serde_json::from_str::<Event>(&message)?.legible()),
            }
        }
        Ok(log)
    }

    /// Deletes rows that exceed their retention time, measured from the newest value of a
    /// structure.
    pub(crate) async fn prune(
        &self,
        structure: &str,
        newest_ns: i64,
        keep: &Keep,
    ) -> Result<(), HistoryError> {
        let pool = self.pool().await?;
        let _writes = self.numbers.lock().await;
        let before = |keep_s: Option<u64>| {
            let keep_ns = i64::try_from(keep_s?).ok()?.checked_mul(SECOND_NS)?;
            newest_ns.checked_sub(keep_ns)
        };
        let of_structure = "series IN (SELECT id FROM series WHERE structure = $1)";
        if let Some(before_ns) = before(keep.display_s) {
            let statement = format!("DELETE FROM point WHERE {of_structure} AND time_ns < $2");
            let delete = sqlx::query(AssertSqlSafe(statement))
                .bind(structure.to_owned())
                .bind(before_ns);
            delete
                .execute(&pool)
                .await
                .map_err(|source| self.error(source))?;
        }
        for (resolution_s, keep_s) in
            RESOLUTIONS_S
                .into_iter()
                .zip([keep.minute_s, keep.hour_s, keep.day_s])
        {
            let Some(before_ns) = before(keep_s) else {
                continue;
            };
            let statement = format!(
                "DELETE FROM bucket WHERE {of_structure} AND resolution_s = $2 AND start_s < $3"
            );
            let delete = sqlx::query(AssertSqlSafe(statement))
                .bind(structure.to_owned())
                .bind(resolution_s);
            let delete = delete.bind(before_ns.div_euclid(SECOND_NS));
            delete
                .execute(&pool)
                .await
                .map_err(|source| self.error(source))?;
        }
        if let Some(before_ns) = before(keep.log_s) {
            let delete = sqlx::query("DELETE FROM happened WHERE structure = $1 AND time_ns < $2");
            let delete = delete.bind(structure.to_owned()).bind(before_ns);
            delete
                .execute(&pool)
                .await
                .map_err(|source| self.error(source))?;
        }
        Ok(())
    }

    /// Closes all connections.
    pub(crate) async fn close(&self) {
        if let Opened::Now { pool, .. } = &*self.opened.lock().await {
            pool.close().await;
        }
    }
}

fn database_error(address: &Address, source: sqlx::Error) -> HistoryError {
    HistoryError::Database {
        database: address.to_string(),
        source,
    }
}

/// Returns the first column of the first row as an integer.
async fn first<'q>(
    query: sqlx::query::Query<'q, sqlx::Any, <sqlx::Any as sqlx::Database>::Arguments>,
    pool: &AnyPool,
) -> Result<Option<i64>, sqlx::Error> {
    query
        .fetch_optional(pool)
        .await?
        .map(|row| row.try_get(0))
        .transpose()
}

impl Series {
    /// Returns the series of a query, or `None` if the kind is unknown.
    pub(crate) fn asked(kind: &str, name: &Name) -> Option<Self> {
        let kind = Kind::ALL.into_iter().find(|known| known.as_str() == kind)?;
        Some(Self {
            kind,
            name: name.to_string(),
        })
    }
}

#[cfg(test)]
mod tests;
