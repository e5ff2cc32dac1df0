//! What every format gives: rows.

use std::path::Path;

use crate::RecordError;

/// One instant of a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row<'a> {
    /// Time of measurement in ns: since 1970 UTC, or since the start of the record if its times are relative.
    pub time_ns: i64,
    /// One value per channel in SI units, in the order of the mapping; `NaN` is a missing sample.
    pub values: &'a [f64],
}

/// Gives the rows of a recording one after the other, in constant memory.
///
/// Times increase strictly. A gap in time stays a gap: nothing is filled or interpolated.
pub trait RecordReader: Send {
    /// The file that is read.
    fn path(&self) -> &Path;

    /// Names of the channels in the order of the values of a row.
    fn channels(&self) -> &[String];

    /// Reads the next row; `None` at the end.
    ///
    /// # Errors
    /// A [`RecordError`] with file and line; reading cannot go on after it.
    fn next_row(&mut self) -> Result<Option<Row<'_>>, RecordError>;
}
