//! Errors of reading and writing recordings.

use std::path::PathBuf;

use crate::Fault;

/// An error of reading or writing a recording. Line numbers start at 1 and include the header.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file could not be opened or created.
    #[error("{}: cannot be opened", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The path leads to a pipe, a device or a socket.
    #[error("{}: is a pipe, a device or a socket, must be a regular file or a \
             folder", path.display())]
    NotAFile {
        /// The path.
        path: PathBuf,
    },
    /// Neither the content nor the name of a file matches a known format.
    #[error("{}: unknown format, must be one of {}", path.display(), allowed.join(", "))]
    UnknownFormat {
        /// The file.
        path: PathBuf,
        /// The known formats.
        allowed: Vec<&'static str>,
    },
    /// The file is text in UTF-16 or UTF-32.
    #[error("{}: encoding: is {found}, must be UTF-8", path.display())]
    Encoding {
        /// The file.
        path: PathBuf,
        /// Name of the encoding.
        found: &'static str,
    },
    /// The content of a file violates its format.
    #[error("{}: {format}: {fault}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Name of the format.
        format: &'static str,
        /// Position and description of the violation.
        fault: Box<Fault>,
    },
    /// Reading the file failed with an input/output error.
    #[error("{}: cannot be read", path.display())]
    ReadFile {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The recording lacks channels that the mapping requires.
    #[error("{}: has no channel {}; its channels are \
             {}", path.display(), quoted(missing), quoted(found))]
    MissingChannels {
        /// The file.
        path: PathBuf,
        /// All missing channels.
        missing: Vec<String>,
        /// The channels of the recording.
        found: Vec<String>,
    },
    /// The file does not state the sampling rate of a channel.
    #[error(
        "{}: states no sampling rate for channel `{channel}`; state it with --rate HZ",
        path.display()
    )]
    NoSamplingRate {
        /// The file.
        path: PathBuf,
        /// Name of the channel.
        channel: String,
    },
    /// Channels have different sampling rates and therefore no common rows.
    #[error(
        "{}: channel `{channel}` is sampled at {found_hz:.4} Hz, must be {first_hz:.4} Hz like \
         `{first}`; resample them",
        path.display()
    )]
    UnequalRates {
        /// The file.
        path: PathBuf,
        /// Name of the channel.
        channel: String,
        /// Its sampling rate, in Hz.
        found_hz: f64,
        /// The first channel.
        first: String,
        /// Its sampling rate, in Hz.
        first_hz: f64,
    },
    /// One channel has dates, and another has times relative to the start of the recording.
    #[error(
        "{}: only one of the channels `{first}` and `{channel}` has a date, must be both or \
         neither",
        path.display()
    )]
    UnequalOrigins {
        /// The file.
        path: PathBuf,
        /// Name of the channel.
        channel: String,
        /// The first channel.
        first: String,
    },
    /// The ratio of two sampling rates is too large for a filter.
    #[error(
        "{}: channel `{channel}` cannot be resampled from {from_hz} Hz to {to_hz} Hz: the larger \
         rate must be at most {largest} times the smaller",
        path.display()
    )]
    Resampling {
        /// The file.
        path: PathBuf,
        /// Name of the channel.
        channel: String,
        /// Its sampling rate, in Hz.
        from_hz: f64,
        /// The requested sampling rate, in Hz.
        to_hz: f64,
        /// Largest allowed ratio.
        largest: f64,
    },
    /// A recording would be too large after resampling.
    #[error(
        "{}: has {samples:.3e} samples at {to_hz} Hz, must have at most {most}; use a lower rate",
        path.display()
    )]
    TooManySamples {
        /// The file.
        path: PathBuf,
        /// Number of samples of all channels at the requested rate.
        samples: f64,
        /// The requested sampling rate, in Hz.
        to_hz: f64,
        /// Maximum number of samples.
        most: u64,
    },
    /// A declared sampling rate is not positive and finite.
    #[error("sampling rate is {found_hz} Hz, must be positive and finite")]
    DeclaredRate {
        /// The rate found, in Hz.
        found_hz: f64,
    },
    /// The name of an output file does not indicate a supported format.
    #[error("{}: cannot be written, its name must end in {}", path.display(), allowed.join(" or "))]
    UnknownOutput {
        /// The file.
        path: PathBuf,
        /// Supported file name extensions.
        allowed: &'static [&'static str],
    },
    /// A sample cannot be written to MCAP.
    #[error("{}: sample {value} at {time_ns} ns cannot be written, {what}", path.display())]
    NotWritable {
        /// The file.
        path: PathBuf,
        /// Time of the sample, in ns.
        time_ns: i64,
        /// The sample.
        value: f64,
        /// The allowed values.
        what: &'static str,
    },
    /// Writing a miniSEED file failed.
    #[error("{}: cannot be written", path.display())]
    WriteMiniSeed {
        /// The file.
        path: PathBuf,
        /// The error of the operating system, or the time that has no date.
        source: std::io::Error,
    },
    /// Writing an MCAP file failed.
    #[error("{}: cannot be written", path.display())]
    WriteMcap {
        /// The file.
        path: PathBuf,
        /// The error of the MCAP writer.
        source: Box<mcap::McapError>,
    },
    /// Another process or log has the folder of a frame log open.
    #[error("{}: another process is using the frame log; stop that process, or choose another \
             folder", folder.display())]
    LogInUse {
        /// The folder.
        folder: PathBuf,
    },
    /// The folder of a frame log contains frames of another layout.
    #[error(
        "{}: the frame log has another layout: {what} is `{found}`, must be `{expected}`; move \
         the folder, or choose another one",
        folder.display()
    )]
    OtherLog {
        /// The folder.
        folder: PathBuf,
        /// The property that differs.
        what: &'static str,
        /// Its value in the folder.
        found: String,
        /// The requested value.
        expected: String,
    },
    /// The log cannot store the frames.
    #[error("frames of `{structure}` cannot be logged: {what} is {found}, must be {allowed}")]
    NotLoggable {
        /// Name of the structure.
        structure: String,
        /// The invalid property.
        what: &'static str,
        /// Its value.
        found: String,
        /// The allowed values.
        allowed: String,
    },
    /// A new file, or a file or folder of the frame log, could not be written.
    #[error("{}: cannot be written", path.display())]
    WriteLog {
        /// The file or folder.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// Reading a table failed with an input/output error.
    #[error("{}:{line}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The line that was being read.
        line: u64,
        /// The error of the CSV reader.
        source: csv::Error,
    },
    /// Writing a table failed.
    #[error("{}:{line}: cannot be written", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The line that was being written.
        line: u64,
        /// The error of the CSV writer.
        source: csv::Error,
    },
    /// The header lacks columns that the mapping requires.
    #[error(
        "{}:{line}: has no column {}; its columns are {}",
        path.display(), quoted(missing), quoted(found)
    )]
    MissingColumns {
        /// The file.
        path: PathBuf,
        /// Line of the header.
        line: u64,
        /// All missing columns.
        missing: Vec<String>,
        /// The header as found.
        found: Vec<String>,
    },
    /// A row of a table does not end, as in a file without line breaks.
    #[error("{}:{line}: row has no end within {most} bytes, must have at most {most} \
             bytes", path.display())]
    LongRow {
        /// The file.
        path: PathBuf,
        /// Line in which the row begins.
        line: u64,
        /// Maximum length of a row, in bytes.
        most: usize,
    },
    /// A table has too many columns.
    #[error("{}:{line}: has {found} columns, must have at most {most}", path.display())]
    TooManyColumns {
        /// The file.
        path: PathBuf,
        /// Line of the header, or of the first row without a header.
        line: u64,
        /// Number of columns found.
        found: usize,
        /// Maximum number of columns.
        most: usize,
    },
    /// A required column occurs more than once in the header.
    #[error("{}:{line}: column `{column}` occurs more than once, must occur once", path.display())]
    RepeatedColumn {
        /// The file.
        path: PathBuf,
        /// Line of the header.
        line: u64,
        /// Name of the column.
        column: String,
    },
    /// A row has more or fewer fields than the header.
    #[error("{}:{line}: row has {found} fields, must have {expected} like the \
             header", path.display())]
    RaggedRow {
        /// The file.
        path: PathBuf,
        /// Line of the row.
        line: u64,
        /// Number of fields in this row.
        found: usize,
        /// Number of fields in the header.
        expected: usize,
    },
    /// A field is not a finite number.
    #[error(
        "{}:{line}: column `{column}` is `{found}`, must be a finite number, or empty for a \
         missing sample",
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
    /// A time is not valid, or differs in form from the first time of the file.
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
    /// A time is not later than the previous one.
    #[error(
        "{}:{line}: time {found} is not later than {previous} of the previous row, must increase",
        path.display()
    )]
    TimeNotIncreasing {
        /// The file.
        path: PathBuf,
        /// Line of the row.
        line: u64,
        /// Its time in the form of the file, with its unit.
        found: String,
        /// The previous time in the same form.
        previous: String,
    },
    /// A time is so far ahead of the rows before and after it that it is a mistake.
    #[error(
        "{}:{line}: time {found} is far ahead of both neighbours, must be between {previous} and \
         {next}",
        path.display()
    )]
    TimeAhead {
        /// The file.
        path: PathBuf,
        /// Line of the row.
        line: u64,
        /// Its time in the form of the file, with its unit.
        found: String,
        /// The time of the row before it, in the same form.
        previous: String,
        /// The time of the row after it, in the same form.
        next: String,
    },
    /// The file has fewer than two rows and therefore no sampling rate.
    #[error("{}: has {rows} rows, must have at least 2 to determine a sampling \
             rate", path.display())]
    TooShort {
        /// The file.
        path: PathBuf,
        /// Number of rows found.
        rows: usize,
    },
    /// The sampling rate of the file differs from the declared rate.
    #[error("{}: is sampled at {found_hz:.4} Hz, must be {declared_hz} Hz as \
             declared", path.display())]
    SamplingRate {
        /// The file.
        path: PathBuf,
        /// Sampling rate of the first rows, in Hz.
        found_hz: f64,
        /// Declared sampling rate, in Hz.
        declared_hz: f64,
    },
    /// A unit is unknown or belongs to another quantity than the channel.
    #[error(
        "channel `{channel}`: unit is `{found}`, must be one of {} for {quantity}",
        quoted(allowed)
    )]
    Unit {
        /// Name of the channel.
        channel: String,
        /// The unit found.
        found: String,
        /// Name of the quantity.
        quantity: &'static str,
        /// The units of this quantity.
        allowed: Vec<&'static str>,
    },
    /// A scale is zero or not finite, or an offset is not finite.
    #[error(
        "channel `{channel}`: {setting} is {found}, must be finite, and a scale must not be zero"
    )]
    Calibration {
        /// Name of the channel.
        channel: String,
        /// `scale` or `offset`.
        setting: &'static str,
        /// The value found.
        found: f64,
    },
    /// The time span for the offset is not positive and finite.
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
        /// The line to be written.
        line: u64,
        /// Number of values given.
        found: usize,
        /// Number of columns, without the time column.
        expected: usize,
    },
    /// A value to be written is infinite.
    #[error("{}:{line}: value of `{column}` is {found}, must be finite, or NaN for \
             missing", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The line to be written.
        line: u64,
        /// The column.
        column: String,
        /// The value given.
        found: f64,
    },
}

/// Formats names as a list, such as `a`, `b`.
fn quoted<T: AsRef<str>>(names: &[T]) -> String {
    names
        .iter()
        .map(|name| format!("`{}`", name.as_ref()))
        .collect::<Vec<_>>()
        .join(", ")
}
