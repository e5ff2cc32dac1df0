//! What can be wrong with a recording.

use std::path::PathBuf;

/// Why a recording could not be read or written; lines count from 1, the header included.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file could not be opened or created.
    #[error("{}: cannot be opened", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// The end of the file name is that of no known format.
    #[error("{}: is of no known format, must end in {}", path.display(), allowed.join(", "))]
    UnknownFormat {
        /// The file.
        path: PathBuf,
        /// The known ends of file names.
        allowed: &'static [&'static str],
    },
    /// Reading failed below the level of records: input/output.
    #[error("{}:{line}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Line that was being read.
        line: u64,
        /// What the reader said.
        source: csv::Error,
    },
    /// Writing failed.
    #[error("{}:{line}: cannot be written", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Line that was being written.
        line: u64,
        /// What the writer said.
        source: csv::Error,
    },
    /// Columns that the mapping needs are not in the header.
    #[error(
        "{}:1: has no column {}; its columns are {}",
        path.display(), quoted(missing), quoted(found)
    )]
    MissingColumns {
        /// The file.
        path: PathBuf,
        /// All needed columns that are not there.
        missing: Vec<String>,
        /// The header as found.
        found: Vec<String>,
    },
    /// A column that the mapping needs is in the header more than once.
    #[error("{}:1: column `{column}` is there more than once, must be there once", path.display())]
    RepeatedColumn {
        /// The file.
        path: PathBuf,
        /// Its name.
        column: String,
    },
    /// A row has more or fewer fields than the header.
    #[error("{}:{line}: row has {found} fields, must have {expected} as the header", path.display())]
    RaggedRow {
        /// The file.
        path: PathBuf,
        /// Line of the row.
        line: u64,
        /// Fields of this row.
        found: usize,
        /// Fields of the header.
        expected: usize,
    },
    /// A field is no finite number.
    #[error(
        "{}:{line}: column `{column}` is `{found}`, must be a finite number, or empty for a missing sample",
        path.display()
    )]
    BadNumber {
        /// The file.
        path: PathBuf,
        /// Line of the row.
        line: u64,
        /// Name of the column in the file.
        column: String,
        /// The text of the field.
        found: String,
    },
    /// A time is neither seconds nor ISO 8601, or is not in the form of the first row.
    #[error("{}:{line}: time is `{found}`, must be {allowed}", path.display())]
    BadTime {
        /// The file.
        path: PathBuf,
        /// Line of the row.
        line: u64,
        /// The text of the field.
        found: String,
        /// The forms allowed here.
        allowed: &'static str,
    },
    /// A time is not later than that of the row before.
    #[error(
        "{}:{line}: time {found_s} s is not later than {previous_s} s of the row before, must increase",
        path.display()
    )]
    TimeNotIncreasing {
        /// The file.
        path: PathBuf,
        /// Line of the row.
        line: u64,
        /// Its time in s, as decimal text.
        found_s: String,
        /// The time of the row before in s, as decimal text.
        previous_s: String,
    },
    /// There are fewer than two rows, so that the file has no sampling rate.
    #[error("{}: has {rows} rows, must have at least 2 to have a sampling rate", path.display())]
    TooShort {
        /// The file.
        path: PathBuf,
        /// Rows found.
        rows: usize,
    },
    /// The sampling rate of the file is not the declared one.
    #[error("{}: is sampled at {found_hz:.4} Hz, must be {declared_hz} Hz as declared", path.display())]
    SamplingRate {
        /// The file.
        path: PathBuf,
        /// Rate found in the first rows, in Hz.
        found_hz: f64,
        /// Declared rate, in Hz.
        declared_hz: f64,
    },
    /// A unit is unknown, or is none of the quantity of the channel.
    #[error("channel `{channel}`: unit is `{found}`, must be one of {} for {quantity}", quoted(allowed))]
    Unit {
        /// The channel.
        channel: String,
        /// The unit found.
        found: String,
        /// The quantity in words.
        quantity: &'static str,
        /// The units of this quantity.
        allowed: Vec<&'static str>,
    },
    /// A scale is zero or not finite, or an offset is not finite.
    #[error("channel `{channel}`: {setting} is {found}, must be finite, and a scale not zero")]
    Calibration {
        /// The channel.
        channel: String,
        /// `scale` or `offset`.
        setting: &'static str,
        /// The value found.
        found: f64,
    },
    /// The span for the mean of the offset is not a positive time.
    #[error("span of the offset is {found_s} s, must be more than 0 and finite")]
    OffsetSpan {
        /// The span found, in s.
        found_s: f64,
    },
    /// A row to be written does not have one value per column.
    #[error("{}:{line}: row has {found} values, must have {expected}", path.display())]
    RowLength {
        /// The file.
        path: PathBuf,
        /// Line to be written.
        line: u64,
        /// Values given.
        found: usize,
        /// Columns besides the time.
        expected: usize,
    },
    /// A value to be written is infinite.
    #[error("{}:{line}: value of `{column}` is {found}, must be finite, or NaN for missing", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// Line to be written.
        line: u64,
        /// The column.
        column: String,
        /// The value given.
        found: f64,
    },
}

/// Lists names as a person would: `a`, `b`.
fn quoted<T: AsRef<str>>(names: &[T]) -> String {
    names.iter().map(|name| format!("`{}`", name.as_ref())).collect::<Vec<_>>().join(", ")
}
