//! Reads and writes recordings of vibration, and writes recordings of estimates.
//!
//! A reader takes a file and a [`ColumnMapping`] and returns rows. A row is a time in nanoseconds
//! and one value per channel in SI units, `NaN` where a sample is missing. A writer takes rows of a
//! record or of estimates and writes a file. Values written and read back are bit-identical.
//!
//! ```
//! use spandrel_record::{ChannelColumn, ColumnMapping, CsvReader, Quantity, RecordReader};
//! let text = "time_s,roof_g\n0.00,0.5\n0.01,\n";
//! let mapping = ColumnMapping::new(vec![
//!     ChannelColumn::new("roof-x").with_column("roof_g").with_unit("g", Quantity::Acceleration)?,
//! ])
//! .with_time_column("time_s");
//! let mut reader = CsvReader::new(Box::new(text.as_bytes()), "roof.csv".as_ref(), &mapping)?;
//! let row = reader.next_row()?.unwrap();
//! assert_eq!((row.time_ns, row.values), (0, &[0.5 * 9.80665][..]));
//! let row = reader.next_row()?.unwrap();
//! assert!(row.time_ns == 10_000_000 && row.values[0].is_nan());
//! # Ok::<(), spandrel_record::RecordError>(())
//! ```
//!
//! - [`quantity`]: units of columns, and their factors to SI
//! - [`column_mapping`]: assigns columns or channels of a file to channels of the structure
//! - [`record_time`]: converts times in files to nanoseconds and back
//! - [`record_reader`]: the trait that returns the rows of any format
//! - [`format`](mod@format): the supported formats, detected by content and file name
//! - [`recorded`]: channels as stored in a file; [`recorded_file`]: reads a file of any format
//! - [`csv_reader`], [`recorded_rows`]: the rows of a table that is streamed, and of a file in
//!   memory
//! - [`resample`]: converts to another sampling rate, with an anti-aliasing filter
//! - [`recording`]: reads a file of any format, determines its sampling rate and removes its
//!   offsets
//! - [`spectrum`], [`recording_summary`]: summarise the content of a recording
//! - [`csv_writer`], [`mcap_writer`], [`record_writer`], [`estimate_writer`], [`convert`]: write
//!   files; [`convert`] also writes miniSEED
//! - [`NewFile`]: replaces a file once the new content is complete
//! - [`frame_log`]: records frames on disk before they are published
//!
//! Samples are resampled or filtered only on request, and never interpolated. Alignment, not
//! reading, assigns samples to frames.

mod bytes;
pub mod column_mapping;
pub mod convert;
pub mod csv_reader;
pub mod csv_writer;
pub mod error;
pub mod estimate_writer;
pub mod fault;
pub mod format;
mod formats;
pub mod frame_log;
mod mcap_record;
pub mod mcap_writer;
mod mini_seed_writer;
mod new_file;
pub mod quantity;
mod rate;
pub mod record_reader;
pub mod record_time;
pub mod record_writer;
pub mod recorded;
pub mod recorded_file;
pub mod recorded_rows;
pub mod recording;
pub mod recording_summary;
pub mod resample;
mod row_limit;
mod source;
pub mod spectrum;
mod table_layout;
mod unpacked;

pub use column_mapping::{ChannelColumn, ColumnMapping, TimeSource, TimeUnit};
pub use convert::OutputFormat;
pub use csv_reader::CsvReader;
pub use csv_writer::CsvWriter;
pub use error::RecordError;
pub use estimate_writer::EstimateWriter;
pub use fault::Fault;
pub use format::Format;
pub use formats::mini_seed::read as read_mini_seed;
pub use frame_log::{
    FrameLog, FrameLogReader, LogLayout, LogSettings, LogSpan, LogSyncer, LoggedFrames,
    NodePosition, OpenedLog,
};
pub use mcap_writer::{McapChannel, McapWriter};
pub use new_file::{NewFile, write_whole};
pub use quantity::Quantity;
pub use record_reader::{RecordReader, Row};
pub use record_writer::RecordWriter;
pub use recorded::{Gap, RecordedChannel, Segment, TimeOrigin};
pub use recorded_file::{ReadOptions, RecordedFile};
pub use recorded_rows::RecordedRows;
pub use recording::{OffsetRemoval, Recording, Resampling};
pub use recording_summary::{
    ChannelSummary, GapSummary, PeakSummary, RecordingSummary, Statistics,
};
pub use spectrum::{SpectralPeak, Spectrum};
