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
//! - [`column_mapping`]: which column is which channel
//! - [`record_time`]: times in files to nanoseconds and back
//! - [`record_reader`]: what every format gives: rows
//! - [`csv_reader`], [`csv_writer`], [`estimate_writer`]: the formats
//! - [`recording`]: a file of any format with its sampling rate, and its offsets removed
//!
//! Samples are neither resampled, interpolated nor filtered here: that is the work of alignment, not of reading.

pub mod column_mapping;
pub mod csv_reader;
pub mod csv_writer;
pub mod error;
pub mod estimate_writer;
pub mod quantity;
pub mod record_reader;
pub mod record_time;
pub mod recording;

pub use column_mapping::{ChannelColumn, ColumnMapping};
pub use csv_reader::CsvReader;
pub use csv_writer::CsvWriter;
pub use error::RecordError;
pub use estimate_writer::EstimateWriter;
pub use quantity::Quantity;
pub use record_reader::{RecordReader, Row};
pub use recording::{OffsetRemoval, Recording};
