//! What can be wrong with a recording.

use std::path::PathBuf;

use crate::Fault;

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
    /// Neither the content nor the name of a file is that of a known format.
    #[error("{}: is of no known format, must be one of {}", path.display(), allowed.join(", "))]
    UnknownFormat {
        /// The file.
        path: PathBuf,
        /// The known formats.
        allowed: Vec<&'static str>,
    },
    /// The content of a file breaks the rules of its format.
    #[error("{}: {format}: {fault}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Its format in words.
        format: &'static str,
        /// Where and what.
        fault: Box<Fault>,
    },
    /// The file could not be read: input/output.
    #[error("{}: cannot be read", path.display())]
    ReadFile {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Channels that the mapping needs are not in the recording.
    #[error("{}: has no channel {}; its channels are {}", path.display(), quoted(missing), quoted(found))]
    MissingChannels {
        /// The file.
        path: PathBuf,
        /// All needed channels that are not there.
        missing: Vec<String>,
        /// Those that are there.
        found: Vec<String>,
    },
    /// The file states no sampling rate of a channel.
    #[error(
        "{}: states no sampling rate of channel `{channel}`; declare one",
        path.display()
    )]
    NoSamplingRate {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
    },
    /// Channels are not sampled alike, so that they have no rows in common.
    #[error(
        "{}: channel `{channel}` is sampled at {found_hz:.4} Hz, must be {first_hz:.4} Hz as `{first}`; resample them",
        path.display()
    )]
    UnequalRates {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
        /// Its rate, in Hz.
        found_hz: f64,
        /// The first channel.
        first: String,
        /// Its rate, in Hz.
        first_hz: f64,
    },
    /// One channel has times of day, another counts from the start of the recording.
    #[error(
        "{}: channels `{first}` and `{channel}`: one has a date and the other has none, must be both or neither",
        path.display()
    )]
    UnequalOrigins {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
        /// The first channel.
        first: String,
    },
    /// Two rates have no ratio that a filter can be made for.
    #[error(
        "{}: channel `{channel}` cannot be resampled from {from_hz} Hz to {to_hz} Hz: their ratio must be one of whole \
         numbers up to {largest}",
        path.display()
    )]
    Resampling {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
        /// Its rate, in Hz.
        from_hz: f64,
        /// The rate asked for, in Hz.
        to_hz: f64,
        /// Largest whole number.
        largest: u64,
    },
    /// A rate that was declared is no rate.
    #[error("sampling rate is {found_hz} Hz, must be positive and finite")]
    DeclaredRate {
        /// The rate found, in Hz.
        found_hz: f64,
    },
    /// The name of a file to be written tells no format.
    #[error("{}: cannot be written, its name must end in {}", path.display(), allowed.join(" or "))]
    UnknownOutput {
        /// The file.
        path: PathBuf,
        /// The known ends of file names.
        allowed: &'static [&'static str],
    },
    /// A sample cannot be written to MCAP.
    #[error("{}: sample {value} at {time_ns} ns cannot be written, {what}", path.display())]
    NotWritable {
        /// The file.
        path: PathBuf,
        /// Time of the sample in ns.
        time_ns: i64,
        /// The sample.
        value: f64,
        /// What is allowed.
        what: &'static str,
    },
    /// Writing an MCAP file failed.
    #[error("{}: cannot be written", path.display())]
    WriteMcap {
        /// The file.
        path: PathBuf,
        /// What the writer said.
        source: Box<mcap::McapError>,
    },
    /// Something else has the folder of a frame log open.
    #[error("{}: the frame log is in use, must be opened by one at a time; stop the other, or give another folder", folder.display())]
    LogInUse {
        /// The folder.
        folder: PathBuf,
    },
    /// The folder of a frame log holds frames of something else.
    #[error(
        "{}: the frame log is of another layout: {what} is `{found}`, must be `{expected}`; move the folder away, or give another",
        folder.display()
    )]
    OtherLog {
        /// The folder.
        folder: PathBuf,
        /// What differs.
        what: &'static str,
        /// What the folder has.
        found: String,
        /// What was asked for.
        expected: String,
    },
    /// Frames cannot be put into the log.
    #[error("frames of `{structure}` cannot be logged: {what} is {found}, must be {allowed}")]
    NotLoggable {
        /// The structure.
        structure: String,
        /// What of them.
        what: &'static str,
        /// What was found.
        found: String,
        /// What is allowed.
        allowed: String,
    },
    /// A file or folder of the frame log could not be written.
    #[error("{}: cannot be written", path.display())]
    WriteLog {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
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
        "{}:{line}: has no column {}; its columns are {}",
        path.display(), quoted(missing), quoted(found)
    )]
    MissingColumns {
        /// The file.
        path: PathBuf,
        /// Line of the header.
        line: u64,
        /// All needed columns that are not there.
        missing: Vec<String>,
        /// The header as found.
        found: Vec<String>,
    },
    /// A column that the mapping needs is in the header more than once.
    #[error("{}:{line}: column `{column}` is there more than once, must be there once", path.display())]
    RepeatedColumn {
        /// The file.
        path: PathBuf,
        /// Line of the header.
        line: u64,
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
    #[error(
        "channel `{channel}`: unit is `{found}`, must be one of {} for {quantity}",
        quoted(allowed)
    )]
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
    names
        .iter()
        .map(|name| format!("`{}`", name.as_ref()))
        .collect::<Vec<_>>()
        .join(", ")
}
