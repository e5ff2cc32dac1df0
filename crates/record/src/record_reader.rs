//! The common interface of all formats: rows.

use std::path::Path;

use crate::RecordError;

/// The values of a recording at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row<'a> {
    /// Time of measurement in ns, since 1970 UTC, or since the start of the record if its times are
    /// relative.
    pub time_ns: i64,
    /// One value per channel in SI units, in the order of the mapping; `NaN` if missing.
    pub values: &'a [f64],
}

/// A reader that returns the rows of a recording one after the other.
///
/// Times increase strictly. Gaps in time remain gaps: readers neither fill nor interpolate them.
pub trait RecordReader: Send {
    /// Returns the path of the file.
    fn path(&self) -> &Path;

    /// Returns the names of the channels, in the order of the values of a row.
    fn channels(&self) -> &[String];

    /// Reads the next row. Returns `None` at the end.
    ///
    /// # Errors
    /// Returns a [`RecordError`] that names the file and, for a table, the line. Reading cannot
    /// continue after an error.
    fn next_row(&mut self) -> Result<Option<Row<'_>>, RecordError>;
}
