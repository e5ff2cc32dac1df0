//! Reads a CSV series as epochs, in the order of time.

use crate::error::AppError;
use jiff::Timestamp;
use spandrel_bus::is_without_date;
use spandrel_judge::{Epoch, JudgeError};
use spandrel_record::{ChannelColumn, ColumnMapping, CsvReader, RecordReader};
use spandrel_structure::JudgePlan;
use std::path::Path;
use tracing::warn;

/// Distance from which rows are far ahead, as a multiple of the distance of the rows before them.
const FAR_AHEAD: i64 = 10;
/// Number of rows after which a jump ahead is no mistake.
const MOST_HELD: usize = 100;
/// Largest share of rows that may be out of order: one in this number. With more of them, the file
/// has another order, and what remains would be no series.
const ONE_IN: u64 = 10;
/// What to do about rows that are not in order, if their times have no zone.
const ZONE_HINT: &str = "the times have no zone: a local time repeats an hour when daylight \
                         saving ends; write UTC, or times with their offset";

/// A row of a series.
#[derive(Debug, Clone)]
struct SeriesRow {
    line: u64,
    time_ns: i64,
    values: Vec<f64>,
}

/// Puts rows into the order of time. Rows whose time goes back are left out, and so are rows that
/// are far ahead of both the rows before and after them.
#[derive(Debug, Default)]
struct InOrder {
    /// Rows after a jump ahead that is not confirmed yet.
    held: Vec<SeriesRow>,
    /// Time of the last row before them (ns).
    before_ns: Option<i64>,
    /// Distance of the last two rows (ns).
    step_ns: Option<i64>,
    rows: u64,
    left_out: u64,
    /// The first row that was left out.
    first: Option<LeftOut>,
}

/// A row that is not in order.
#[derive(Debug, Clone, Copy)]
struct LeftOut {
    line: u64,
    time_ns: i64,
    /// Time of the row before it, if it is not later than that one. Otherwise the row is far ahead.
    previous_ns: Option<i64>,
}

impl InOrder {
    /// Takes a row, and appends those whose place is certain to `certain`.
    fn push(&mut self, row: SeriesRow, certain: &mut Vec<SeriesRow>) {
        self.rows += 1;
        let mut last_ns = self.last_ns();
        if let Some(previous_ns) = last_ns.filter(|last_ns| row.time_ns <= *last_ns) {
            if !self.are_far_ahead_of(row.time_ns) {
                self.leave_out(LeftOut {
                    line: row.line,
                    time_ns: row.time_ns,
                    previous_ns: Some(previous_ns),
                });
                return;
            }
            for ahead in std::mem::take(&mut self.held) {
                self.leave_out(LeftOut {
                    line: ahead.line,
                    time_ns: ahead.time_ns,
                    previous_ns: None,
                });
            }
            last_ns = self.before_ns;
        }
        let step_ns = last_ns.map(|last_ns| row.time_ns.saturating_sub(last_ns));
        let is_jump = step_ns.is_some_and(|step_ns| {
            let usual = self.step_ns;
            usual.is_none_or(|usual| step_ns >= usual.saturating_mul(FAR_AHEAD))
        });
        self.step_ns = step_ns.or(self.step_ns);
        if is_jump || self.held.is_empty() || self.held.len() >= MOST_HELD {
            self.release(certain);
        }
        if is_jump || !self.held.is_empty() {
            self.held.push(row);
        } else {
            self.before_ns = Some(row.time_ns);
            certain.push(row);
        }
    }

    /// Appends the held rows to `certain`.
    fn release(&mut self, certain: &mut Vec<SeriesRow>) {
        self.before_ns = self.last_ns();
        certain.append(&mut self.held);
    }

    fn last_ns(&self) -> Option<i64> {
        self.held.last().map(|row| row.time_ns).or(self.before_ns)
    }

    /// Returns `true` if the held rows are far ahead of a row that is later than those before them.
    fn are_far_ahead_of(&self, time_ns: i64) -> bool {
        let Some((first, before_ns)) = self.held.first().zip(self.before_ns) else {
            return false;
        };
        let step_ns = time_ns.saturating_sub(before_ns);
        let ahead_ns = first.time_ns.saturating_sub(before_ns);
        step_ns > 0 && ahead_ns >= step_ns.saturating_mul(FAR_AHEAD)
    }

    fn leave_out(&mut self, row: LeftOut) {
        self.left_out += 1;
        self.first.get_or_insert(row);
    }

    /// Reports the rows that were left out.
    ///
    /// # Errors
    /// Too many of them were.
    fn report(&self, path: &Path, column: &str, have_zone: bool) -> Result<(), AppError> {
        let Some(first) = self.first else {
            return Ok(());
        };
        let reason = match first.previous_ns {
            Some(previous_ns) => format!(
                "time {} is not later than {} of the row before it",
                utc(first.time_ns),
                utc(previous_ns)
            ),
            None => format!(
                "time {} is far ahead of both neighbours",
                utc(first.time_ns)
            ),
        };
        let (left_out, rows) = (self.left_out, self.rows);
        let hint = (!have_zone).then_some(ZONE_HINT);
        if left_out.saturating_mul(ONE_IN) > rows {
            let what = format!(
                "{reason}; {left_out} of {rows} rows are not in the order of time, must be at most \
                 a tenth"
            );
            return Err(AppError::SeriesValue {
                path: path.to_owned(),
                line: first.line,
                column: column.to_owned(),
                what: [what.as_str()]
                    .into_iter()
                    .chain(hint)
                    .collect::<Vec<_>>()
                    .join("; "),
            });
        }
        let (file, line) = (path.display(), first.line);
        warn!(%file, line, %reason, left_out, rows, hint, "rows left out");
        Ok(())
    }
}

/// Returns a time (ns since 1970-01-01 UTC) in ISO 8601.
fn utc(time_ns: i64) -> Timestamp {
    Timestamp::from_nanosecond(i128::from(time_ns)).unwrap_or_default()
}

/// Reads the rows of a CSV series as epochs. Rows that are not in the order of time are left out
/// with a warning.
///
/// # Errors
/// The file cannot be read, a value is not possible, or more than a tenth of the rows are not in
/// order.
pub(super) fn read(
    path: &Path,
    plan: &JudgePlan,
    mut handle: impl FnMut(Epoch) -> Result<(), JudgeError>,
) -> Result<(), AppError> {
    let quantities = plan.settings.quantities.iter();
    let names = quantities.map(|quantity| &quantity.name);
    let conditions = plan.settings.conditions.iter();
    let names = names.chain(conditions.map(|condition| &condition.name));
    let columns = plan.quantity_columns.iter().chain(&plan.condition_columns);
    let mapping = names
        .zip(columns)
        .map(|(name, column)| ChannelColumn::new(name).with_column(column))
        .collect();
    let mapping = ColumnMapping::new(mapping).with_time_column(&plan.time_column);
    let mut reader = CsvReader::open(path, &mapping)?.in_any_order();
    let mut previous_ns = None;
    let mut take = |row: SeriesRow| -> Result<(), AppError> {
        let (time_ns, line) = (row.time_ns, row.line);
        check_time(path, plan, line, previous_ns.replace(time_ns), time_ns)?;
        let epoch = epoch(&row, plan.settings.quantities.len());
        check_row(path, plan, line, &epoch)?;
        handle(epoch).map_err(|source| AppError::Epoch {
            path: path.to_owned(),
            line,
            source,
        })
    };
    let (mut in_order, mut certain) = (InOrder::default(), Vec::new());
    while let Some(row) = reader.next_row()? {
        let (time_ns, values) = (row.time_ns, row.values.to_vec());
        let line = reader.line();
        let row = SeriesRow {
            line,
            time_ns,
            values,
        };
        in_order.push(row, &mut certain);
        certain.drain(..).try_for_each(&mut take)?;
    }
    in_order.release(&mut certain);
    certain.drain(..).try_for_each(&mut take)?;
    in_order.report(path, &plan.time_column, reader.times_have_zone())
}

fn epoch(row: &SeriesRow, quantities: usize) -> Epoch {
    let value = |value: &f64| (!value.is_nan()).then_some(*value);
    let (measured, conditions) = row.values.split_at(quantities);
    Epoch {
        time_s: row.time_ns as f64 * 1e-9,
        quantities: measured.iter().map(value).collect(),
        conditions: conditions.iter().map(value).collect(),
    }
}

/// Rejects numbers that are not seconds, such as numbers of hours. Read as seconds, they are in
/// 1970 and closer together than epochs.
fn check_time(
    path: &Path,
    plan: &JudgePlan,
    line: u64,
    previous_ns: Option<i64>,
    time_ns: i64,
) -> Result<(), AppError> {
    let step_s = previous_ns.map(|previous_ns| (time_ns - previous_ns) as f64 * 1e-9);
    let epoch_s = plan.epoch_s;
    match step_s {
        Some(step_s) if is_without_date(time_ns) && step_s < f64::from(epoch_s) => {
            Err(AppError::SeriesValue {
                path: path.to_owned(),
                line,
                column: plan.time_column.clone(),
                what: format!(
                    "read as seconds since 1970, the row is {step_s} s after the previous one, \
                     must be at least judge.epoch-s, {epoch_s} s; write a time as seconds since \
                     1970, or in ISO 8601, such as 2025-01-01T06:00:00Z"
                ),
            })
        }
        _ => Ok(()),
    }
}

/// Rejects a value that its column cannot have. Offline, a wrong unit is a mistake in the file, and
/// not a day without a statement.
fn check_row(path: &Path, plan: &JudgePlan, line: u64, epoch: &Epoch) -> Result<(), AppError> {
    let conditions = plan.settings.conditions.iter().zip(&plan.condition_columns);
    for ((condition, column), value) in conditions.zip(&epoch.conditions) {
        if let Some(value) = value {
            condition
                .kind
                .convert(*value)
                .map_err(|source| AppError::SeriesValue {
                    path: path.to_owned(),
                    line,
                    column: column.clone(),
                    what: source.to_string(),
                })?;
        }
    }
    let wrong =
        |value: &&Option<f64>| value.is_some_and(|value| !(value > 0.0 && value.is_finite()));
    let columns = plan.quantity_columns.iter().zip(&epoch.quantities);
    match columns.into_iter().find(|(_, value)| wrong(value)) {
        Some((column, value)) => Err(AppError::SeriesValue {
            path: path.to_owned(),
            line,
            column: column.clone(),
            what: format!(
                "is {}, must be above 0; leave the value of a mode that was not found empty",
                value.unwrap_or_default()
            ),
        }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR_NS: i64 = 3_600_000_000_000;

    /// Returns the hours that remain, and the lines that were left out first and in all.
    fn ordered(hours: impl IntoIterator<Item = i64>) -> (Vec<i64>, Option<u64>, u64) {
        let (mut in_order, mut certain) = (InOrder::default(), Vec::new());
        for (line, hour) in (2..).zip(hours) {
            let row = SeriesRow {
                line,
                time_ns: hour * HOUR_NS,
                values: Vec::new(),
            };
            in_order.push(row, &mut certain);
        }
        in_order.release(&mut certain);
        let hours = certain.iter().map(|row| row.time_ns / HOUR_NS);
        let first = in_order.first.map(|first| first.line);
        (hours.collect(), first, in_order.left_out)
    }

    #[test]
    fn rows_in_order_remain_also_after_an_outage() {
        let hours = || (0..50).chain(1000..1400).chain(9000..9010);
        assert_eq!(ordered(hours()), (hours().collect(), None, 0));
    }

    #[test]
    fn rows_that_go_back_or_jump_ahead_are_left_out() {
        let expected: Vec<i64> = (0..100).collect();
        // An hour that daylight saving repeats.
        let autumn = (0..50).chain(49..100);
        assert_eq!(ordered(autumn), (expected.clone(), Some(52), 1));
        // The same soon after an outage, which is no mistake.
        let autumn = (0..10).chain(500..520).chain(519..600);
        let remaining = (0..10).chain(500..600).collect();
        assert_eq!(ordered(autumn), (remaining, Some(32), 1));
        // Some rows of a clock that is years ahead, and some of one that has lost its date.
        let ahead = (0..50).chain(90_000..90_005).chain(50..100);
        assert_eq!(ordered(ahead), (expected.clone(), Some(52), 5));
        let back = (1..50).chain(0..1).chain(50..100);
        assert_eq!(ordered(back), ((1..100).collect(), Some(51), 1));
        // The second row, before any distance is known.
        let second = [0, 90_000].into_iter().chain(1..100);
        assert_eq!(ordered(second), (expected, Some(3), 1));
    }
}
