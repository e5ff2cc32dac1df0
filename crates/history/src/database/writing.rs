//! Writes batches within a transaction, with or without skipping rows that the database rejects.

use super::{Address, Series};
use crate::batch::{Batch, Happened, RESOLUTIONS_S, buckets};
use crate::sums::Sums;
use spandrel_bus::AlertMessage;
use sqlx::{AnyConnection, AssertSqlSafe, Executor, Row};
use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::sync::Arc;

/// Number of rows per statement.
const ROWS_AT_ONCE: usize = 100;
const BUCKET_COLUMNS: [&str; 14] = [
    "series",
    "resolution_s",
    "start_s",
    "first_ns",
    "last_ns",
    "count",
    "mean_sum",
    "square_sum",
    "variance_sum",
    "least",
    "largest",
    "low",
    "high",
    "probability",
];

/// The reason why a write failed.
#[derive(Debug)]
pub(super) enum Failed {
    Database(sqlx::Error),
    Message(serde_json::Error),
}

impl From<sqlx::Error> for Failed {
    fn from(source: sqlx::Error) -> Self {
        Self::Database(source)
    }
}

impl From<serde_json::Error> for Failed {
    fn from(source: serde_json::Error) -> Self {
        Self::Message(source)
    }
}

impl Failed {
    /// Returns `true` if the rows are the cause, so that every retry would fail.
    pub(super) fn is_of_the_rows(&self, address: &Address) -> bool {
        let error = match self {
            Self::Message(_) | Self::Database(sqlx::Error::Encode(_)) => return true,
            Self::Database(sqlx::Error::Database(error)) => error,
            Self::Database(_) => return false,
        };
        let code = error.code().unwrap_or_default();
        match address {
            // Classes: data exception, integrity constraint violation, program limit exceeded (such
            // as a row too large for its index).
            Address::Postgres(_) => ["22", "23", "54"]
                .iter()
                .any(|class| code.starts_with(class)),
            // Codes: too big, constraint, mismatch. The low byte of an extended code contains the
            // primary code.
            Address::Sqlite(_) => code
                .parse::<u32>()
                .is_ok_and(|code| [18, 19, 20].contains(&(code & 0xff))),
        }
    }

    fn reason(&self) -> String {
        match self {
            Self::Database(source) => source.to_string(),
            Self::Message(source) => source.to_string(),
        }
    }
}

/// The treatment of rows that the database rejects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Care {
    /// Many rows per statement. A rejected row fails the whole write.
    ManyRowsAtOnce,
    /// Rejected rows are identified and skipped.
    SettingAside,
}

/// The skipped rows.
#[derive(Debug, Default)]
pub(super) struct SetAside {
    pub(super) rows: u64,
    /// Number of values of conditions and modes that were not newer than those in the database.
    pub(super) repeated: u64,
    /// The reason for the last skipped row.
    pub(super) reason: Option<String>,
}

/// Rows of one table.
#[derive(Clone, Copy)]
enum Rows<'r> {
    Points(&'r [(Series, i64, [f64; 3])]),
    Buckets(&'r [(&'r (Series, i64, i64), &'r Sums)]),
    Happened(&'r [Happened]),
}

impl Rows<'_> {
    fn len(self) -> usize {
        match self {
            Self::Points(rows) => rows.len(),
            Self::Buckets(rows) => rows.len(),
            Self::Happened(rows) => rows.len(),
        }
    }

    fn halves(self) -> [Self; 2] {
        let half = self.len() / 2;
        match self {
            Self::Points(rows) => [Self::Points(&rows[..half]), Self::Points(&rows[half..])],
            Self::Buckets(rows) => [Self::Buckets(&rows[..half]), Self::Buckets(&rows[half..])],
            Self::Happened(rows) => [Self::Happened(&rows[..half]), Self::Happened(&rows[half..])],
        }
    }
}

/// A write within one transaction.
pub(super) struct Writing<'w> {
    connection: &'w mut AnyConnection,
    address: &'w Address,
    care: Care,
    /// IDs of the series that exist in the database.
    numbers: &'w HashMap<(String, Series), i64>,
    /// IDs that this transaction looked up or created.
    found: HashMap<(String, Series), i64>,
    set_aside: SetAside,
}

impl<'w> Writing<'w> {
    pub(super) fn new(
        connection: &'w mut AnyConnection,
        address: &'w Address,
        care: Care,
        numbers: &'w HashMap<(String, Series), i64>,
    ) -> Self {
        Self {
            connection,
            address,
            care,
            numbers,
            found: HashMap::new(),
            set_aside: SetAside::default(),
        }
    }

    /// Returns the IDs of newly found series, and the skipped rows.
    pub(super) fn end(self) -> (HashMap<(String, Series), i64>, SetAside) {
        (self.found, self.set_aside)
    }

    /// Writes all batches, except those that an earlier attempt of the same run has written.
    pub(super) async fn write_all(
        &mut self,
        life: &str,
        batches: &[Arc<Batch>],
    ) -> Result<(), Failed> {
        let Some(last) = batches.last() else {
            return Ok(());
        };
        let written = sqlx::query("SELECT batch FROM writer WHERE id = $1")
            .bind(life.to_owned())
            .fetch_optional(&mut *self.connection)
            .await?;
        let written: i64 = written.map(|row| row.try_get(0)).transpose()?.unwrap_or(0);
        for batch in batches.iter().filter(|batch| batch.number > written) {
            let series = batch
                .points
                .iter()
                .map(|(series, ..)| series)
                .chain(batch.repeatable.iter().map(|(series, ..)| series))
                .chain(batch.buckets.keys().map(|(series, ..)| series));
            for series in series {
                let key = (batch.structure.clone(), series.clone());
                if !self.numbers.contains_key(&key) && !self.found.contains_key(&key) {
                    let number = number_of(self.connection, &key.0, series).await?;
                    self.found.insert(key, number);
                }
            }
            self.write_values(batch, &batch.points, &batch.buckets)
                .await?;
            let new = self.new_values(batch).await?;
            self.write_values(batch, &new, &buckets(&new)).await?;
            if !batch.happened.is_empty() {
                self.write(batch, Rows::Happened(&batch.happened)).await?;
            }
        }
        let statement = "INSERT INTO writer (id, batch) VALUES ($1, $2) ON CONFLICT (id) DO \
                         UPDATE SET batch = excluded.batch";
        sqlx::query(statement)
            .bind(life.to_owned())
            .bind(last.number)
            .execute(&mut *self.connection)
            .await?;
        Ok(())
    }

    /// Writes values and their contributions to the minute, hour and day.
    async fn write_values(
        &mut self,
        batch: &Batch,
        points: &[(Series, i64, [f64; 3])],
        buckets: &BTreeMap<(Series, i64, i64), Sums>,
    ) -> Result<(), Failed> {
        for points in points.chunks(ROWS_AT_ONCE) {
            self.write(batch, Rows::Points(points)).await?;
        }
        let buckets: Vec<_> = buckets.iter().collect();
        for buckets in buckets.chunks(ROWS_AT_ONCE) {
            self.write(batch, Rows::Buckets(buckets)).await?;
        }
        Ok(())
    }

    /// Returns the values of conditions and modes that are newer than those in the database.
    ///
    /// A source repeats values after a restart. Without this check, the sums of an hour would
    /// contain them twice.
    async fn new_values(&mut self, batch: &Batch) -> Result<Vec<(Series, i64, [f64; 3])>, Failed> {
        let mut newest: BTreeMap<&Series, Option<i64>> = BTreeMap::new();
        let mut new = Vec::new();
        for (series, time_ns, values) in &batch.repeatable {
            let known_ns = match newest.get(series) {
                Some(known_ns) => *known_ns,
                None => {
                    let id = self.number(batch, series);
                    newest_ns(self.connection, id).await?
                }
            };
            if known_ns.is_some_and(|known_ns| *time_ns <= known_ns) {
                self.set_aside.repeated += 1;
                newest.insert(series, known_ns);
                continue;
            }
            newest.insert(series, Some(*time_ns));
            new.push((series.clone(), *time_ns, *values));
        }
        Ok(new)
    }

    /// Writes rows. With [`Care::SettingAside`], it finds and skips rejected rows by bisection.
    async fn write(&mut self, batch: &Batch, rows: Rows<'_>) -> Result<(), Failed> {
        if self.care == Care::ManyRowsAtOnce {
            return self.insert(batch, rows).await;
        }
        let mut open = vec![rows];
        while let Some(rows) = open.pop() {
            self.connection.execute("SAVEPOINT piece").await?;
            match self.insert(batch, rows).await {
                Ok(()) => {
                    self.connection.execute("RELEASE SAVEPOINT piece").await?;
                }
                Err(failed) if failed.is_of_the_rows(self.address) => {
                    self.connection
                        .execute("ROLLBACK TO SAVEPOINT piece")
                        .await?;
                    if rows.len() > 1 {
                        let [first, second] = rows.halves();
                        open.extend([second, first]);
                    } else {
                        self.set_aside.rows += 1;
                        self.set_aside.reason = Some(failed.reason());
                    }
                }
                Err(failed) => return Err(failed),
            }
        }
        Ok(())
    }

    async fn insert(&mut self, batch: &Batch, rows: Rows<'_>) -> Result<(), Failed> {
        match rows {
            Rows::Points(points) => self.insert_points(batch, points).await,
            Rows::Buckets(buckets) => self.insert_buckets(batch, buckets).await,
            Rows::Happened(all) => {
                for happened in all {
                    insert_happened(self.connection, &batch.structure, happened).await?;
                }
                Ok(())
            }
        }
    }

    fn number(&self, batch: &Batch, series: &Series) -> i64 {
        let key = (batch.structure.clone(), series.clone());
        self.numbers
            .get(&key)
            .or_else(|| self.found.get(&key))
            .copied()
            .unwrap_or_default()
    }

    async fn insert_points(
        &mut self,
        batch: &Batch,
        points: &[(Series, i64, [f64; 3])],
    ) -> Result<(), Failed> {
        let statement = format!(
            "INSERT INTO point (series, time_ns, mean, std, probability) VALUES {} ON CONFLICT DO \
             NOTHING",
            placeholders(points.len(), 5)
        );
        let mut insert =
            sqlx::query(AssertSqlSafe(statement)).persistent(points.len() == ROWS_AT_ONCE);
        for (series, time_ns, [mean, std, probability]) in points {
            insert = insert
                .bind(self.number(batch, series))
                .bind(*time_ns)
                .bind(*mean)
                .bind(*std)
                .bind(*probability);
        }
        insert.execute(&mut *self.connection).await?;
        Ok(())
    }

    async fn insert_buckets(
        &mut self,
        batch: &Batch,
        buckets: &[(&(Series, i64, i64), &Sums)],
    ) -> Result<(), Failed> {
        // SQLite and PostgreSQL have different functions for the minimum and maximum of two values.
        let lesser = |c: &str| {
            format!(
                "{c} = CASE WHEN excluded.{c} < bucket.{c} THEN excluded.{c} ELSE bucket.{c} END"
            )
        };
        let larger = |c: &str| {
            format!(
                "{c} = CASE WHEN excluded.{c} > bucket.{c} THEN excluded.{c} ELSE bucket.{c} END"
            )
        };
        let sum = |c: &str| format!("{c} = bucket.{c} + excluded.{c}");
        let updates: Vec<String> = ["count", "mean_sum", "square_sum", "variance_sum"]
            .map(sum)
            .into_iter()
            .chain(["first_ns", "least", "low"].map(lesser))
            .chain(["last_ns", "largest", "high", "probability"].map(larger))
            .collect();
        let statement = format!(
            "INSERT INTO bucket ({}) VALUES {} ON CONFLICT (series, resolution_s, start_s) DO \
             UPDATE SET {}",
            BUCKET_COLUMNS.join(", "),
            placeholders(buckets.len(), BUCKET_COLUMNS.len()),
            updates.join(", ")
        );
        let mut insert =
            sqlx::query(AssertSqlSafe(statement)).persistent(buckets.len() == ROWS_AT_ONCE);
        for ((series, resolution_s, start_s), sums) in buckets {
            insert = insert
                .bind(self.number(batch, series))
                .bind(*resolution_s)
                .bind(*start_s);
            insert = insert
                .bind(sums.first_ns)
                .bind(sums.last_ns)
                .bind(sums.count);
            insert = insert
                .bind(sums.mean_sum)
                .bind(sums.square_sum)
                .bind(sums.variance_sum);
            insert = insert
                .bind(sums.least)
                .bind(sums.largest)
                .bind(sums.low)
                .bind(sums.high)
                .bind(sums.probability);
        }
        insert.execute(&mut *self.connection).await?;
        Ok(())
    }
}

/// Returns the time of the newest value of a series (ns).
async fn newest_ns(connection: &mut AnyConnection, id: i64) -> Result<Option<i64>, sqlx::Error> {
    let statement = "SELECT last_ns FROM bucket WHERE series = $1 AND resolution_s = $2 \
                     ORDER BY start_s DESC LIMIT 1";
    let coarsest_s = RESOLUTIONS_S[RESOLUTIONS_S.len() - 1];
    let select = sqlx::query(statement).bind(id).bind(coarsest_s);
    let row = select.fetch_optional(connection).await?;
    row.map(|row| row.try_get(0)).transpose()
}

/// Returns the ID of a series. Creates one if the series is new.
async fn number_of(
    connection: &mut AnyConnection,
    structure: &str,
    series: &Series,
) -> Result<i64, sqlx::Error> {
    let statement = "INSERT INTO series (id, structure, kind, name) \
                     SELECT COALESCE(MAX(id), 0) + 1, $1, $2, $3 FROM series WHERE TRUE \
                     ON CONFLICT (structure, kind, name) DO NOTHING";
    let (kind, name) = (series.kind.as_str(), series.name.clone());
    let insert = sqlx::query(statement)
        .bind(structure.to_owned())
        .bind(kind)
        .bind(name.clone());
    insert.execute(&mut *connection).await?;
    let select =
        sqlx::query("SELECT id FROM series WHERE structure = $1 AND kind = $2 AND name = $3");
    select
        .bind(structure.to_owned())
        .bind(kind)
        .bind(name)
        .fetch_one(connection)
        .await?
        .try_get(0)
}

/// Returns `($1, $2), ($3, $4)` for two rows of two columns.
fn placeholders(rows: usize, columns: usize) -> String {
    let mut text = String::new();
    for row in 0..rows {
        text.push_str(if row == 0 { "(" } else { ", (" });
        for column in 1..=columns {
            // Writing to a `String` does not fail.
            let _ = write!(
                text,
                "{}${}",
                if column == 1 { "" } else { ", " },
                row * columns + column
            );
        }
        text.push(')');
    }
    text
}

async fn insert_happened(
    connection: &mut AnyConnection,
    structure: &str,
    happened: &Happened,
) -> Result<(), Failed> {
    if let Happened::Alert(alert) = happened
        && alert.revision > 0
        && replace_revision(connection, structure, alert).await?
    {
        return Ok(());
    }
    let (time_ns, kind, subject, state, message) = match happened {
        Happened::Alert(m) => (
            m.time_ns,
            "alert",
            m.parameter.to_string(),
            m.state.as_str().to_owned(),
            serde_json::to_string(m)?,
        ),
        Happened::Acknowledgement(m) => (
            m.time_ns,
            "acknowledgement",
            m.parameter.to_string(),
            m.who.clone(),
            serde_json::to_string(m)?,
        ),
        Happened::Event(m) => {
            let kind = serde_json::to_string(&m.kind)?;
            (
                m.time_ns,
                "event",
                m.subject.clone(),
                kind,
                serde_json::to_string(m)?,
            )
        }
    };
    let statement = "INSERT INTO happened (structure, time_ns, kind, subject, state, message) \
                     VALUES ($1, $2, $3, $4, $5, $6) ON CONFLICT DO NOTHING";
    let insert = sqlx::query(statement)
        .bind(structure.to_owned())
        .bind(time_ns)
        .bind(kind)
        .bind(subject);
    insert.bind(state).bind(message).execute(connection).await?;
    Ok(())
}

/// Replaces the previous revision of an alert. Returns `false` if this is the first one.
///
/// Each state of an alert therefore has at most two rows: the first message and the latest
/// revision. A revision that is repeated after a later one changes nothing.
async fn replace_revision(
    connection: &mut AnyConnection,
    structure: &str,
    alert: &AlertMessage,
) -> Result<bool, Failed> {
    const LATER: &str = "SELECT time_ns, message FROM happened WHERE structure = $1 AND kind = \
                         'alert' AND subject = $2 AND state = $3 AND time_ns > $4 ORDER BY \
                         time_ns LIMIT 1";
    const FORMER: &str = "SELECT time_ns, message FROM happened WHERE structure = $1 AND kind = \
                          'alert' AND subject = $2 AND state = $3 AND time_ns <= $4 ORDER BY \
                          time_ns DESC LIMIT 1";
    let (subject, state) = (alert.parameter.to_string(), alert.state.as_str());
    let mut found = [None, None];
    for (statement, found) in [LATER, FORMER].into_iter().zip(&mut found) {
        let select = sqlx::query(statement)
            .bind(structure.to_owned())
            .bind(subject.clone())
            .bind(state)
            .bind(alert.time_ns);
        if let Some(row) = select.fetch_optional(&mut *connection).await? {
            let (time_ns, message) = (row.try_get::<i64, _>(0)?, row.try_get::<String, _>(1)?);
            *found = Some((time_ns, serde_json::from_str::<AlertMessage>(&message)?));
        }
    }
    let [later, former] = found;
    if later.is_some_and(|(_, later)| later.revises(alert)) {
        return Ok(true);
    }
    let Some((time_ns, before)) = former else {
        return Ok(false);
    };
    if before.revision == 0 || !alert.revises(&before) {
        return Ok(false);
    }
    let statement = "UPDATE happened SET time_ns = $1, message = $2 \
                     WHERE structure = $3 AND time_ns = $4 AND kind = 'alert' AND subject = $5 \
                     AND state = $6";
    let update = sqlx::query(statement)
        .bind(alert.time_ns)
        .bind(serde_json::to_string(alert)?);
    let update = update
        .bind(structure.to_owned())
        .bind(time_ns)
        .bind(subject)
        .bind(state);
    update.execute(connection).await?;
    Ok(true)
}
