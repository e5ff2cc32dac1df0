//! Reads and writes recordings of vibration and of estimates on disk.
//!
//! A file and a [`ColumnMapping`] go in; rows come out: a time in nanoseconds and one value in SI units per channel, `NaN`
//! where a sample is missing. In the other direction rows of a record or of estimates go in and a file comes out. Values
//! written and read back are the same to the bit.
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
//! - [`quantity`]: units that a column may have, and their factors to SI
//! - [`column_mapping`]: which column or channel of a file is which channel
//! - [`record_time`]: times in files to nanoseconds and back
//! - [`record_reader`]: what every format gives: rows
//! - [`format`](mod@format): the formats, told by content and name
//! - [`recorded`]: channels as they stand in a file; [`recorded_file`]: one entry for all formats
//! - [`csv_reader`], [`recorded_rows`]: rows of a table as it is read, and of any file in memory
//! - [`resample`]: another sampling rate, with a filter against aliasing
//! - [`recording`]: a file of any format with its sampling rate, and its offsets removed
//! - [`spectrum`], [`recording_summary`]: what a recording holds
//! - [`csv_writer`], [`mcap_writer`], [`record_writer`], [`estimate_writer`], [`convert`]: what is written
//! - [`frame_log`]: frames as they are made, on disk before anybody uses them
//!
//! Samples are neither resampled nor filtered unless that is asked for, and never interpolated: which sample belongs to which frame is the
//! work of alignment, not of reading.

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
pub use frame_log::{
    FrameLog, FrameLogReader, LogLayout, LogSettings, LogSpan, LogSyncer, LoggedFrames,
    NodePosition, OpenedLog,
};
pub use mcap_writer::{McapChannel, McapWriter};
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
