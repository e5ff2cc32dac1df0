//! Writes rows in the format that the file name indicates.

use std::io::BufWriter;
use std::path::Path;

use crate::new_file::{self, NewFile};
use crate::{ColumnMapping, CsvWriter, McapWriter, OutputFormat, RecordError};

/// Extensions of formats that are written row by row. miniSEED is written channel by channel.
const ROW_OUTPUTS: &[&str] = &[".csv", ".mcap"];

/// A writer of records, row by row, as CSV or MCAP. It replaces an existing file when it has
/// finished.
pub enum RecordWriter {
    /// Comma-separated values.
    Csv(Box<CsvWriter<NewFile>>),
    /// MCAP, with one topic per channel.
    Mcap(Box<McapWriter<BufWriter<NewFile>>>),
}

impl RecordWriter {
    /// Creates a file with the columns and units of `mapping`, for rows at `rate_hz` (Hz).
    ///
    /// # Errors
    /// Returns an error if the file name does not indicate a supported format, or if the file
    /// cannot be created or written.
    pub fn create(path: &Path, mapping: &ColumnMapping, rate_hz: f64) -> Result<Self, RecordError> {
        match OutputFormat::of(path)? {
            OutputFormat::Csv => {
                let writer = CsvWriter::new(new_file::create(path)?, path, mapping)?;
                Ok(Self::Csv(Box::new(writer)))
            }
            OutputFormat::Mcap => {
                let output = BufWriter::new(new_file::create(path)?);
                let writer = McapWriter::mapped(output, path, mapping, rate_hz)?;
                Ok(Self::Mcap(Box::new(writer)))
            }
            OutputFormat::MiniSeed => Err(RecordError::UnknownOutput {
                path: path.to_owned(),
                allowed: ROW_OUTPUTS,
            }),
        }
    }

    /// Writes one row: `time_ns` in ns, and one value per column in SI units, `NaN` if missing.
    ///
    /// # Errors
    /// Returns an error if the row has the wrong length or an infinite value, or if the file cannot
    /// be written.
    pub fn write_row(&mut self, time_ns: i64, values: &[f64]) -> Result<(), RecordError> {
        match self {
            Self::Csv(writer) => writer.write_row(time_ns, values),
            Self::Mcap(writer) => writer.write_row(time_ns, values),
        }
    }

    /// Completes the file. Dropping the writer without this call removes the rows.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn finish(self) -> Result<(), RecordError> {
        match self {
            Self::Csv(writer) => new_file::finish(writer.finish()?),
            Self::Mcap(writer) => new_file::finish_buffered(writer.finish()?),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ChannelColumn, OffsetRemoval, Quantity, RecordReader, Recording};

    #[test]
    fn rows_of_either_format_read_back_with_the_same_mapping() {
        let folder = tempfile::tempdir().unwrap();
        let roof = ChannelColumn::new("roof")
            .with_column("roof_g")
            .with_unit("g", Quantity::Acceleration)
            .unwrap();
        let base = ChannelColumn::new("base").in_unit_of_file(Quantity::Acceleration);
        let mapping = ColumnMapping::new(vec![roof.with_calibration(-1.0, 0.0).unwrap(), base]);
        for name in ["rows.csv", "rows.mcap"] {
            let path = folder.path().join(name);
            let mut writer = RecordWriter::create(&path, &mapping, 100.0).unwrap();
            for step in 0..10_i64 {
                let base = if step == 4 { f64::NAN } else { 0.5 };
                writer
                    .write_row(step * 10_000_000, &[step as f64, base])
                    .unwrap();
            }
            writer.finish().unwrap();
            let mut recording = Recording::open(&path, &mapping, OffsetRemoval::Keep).unwrap();
            assert_eq!(
                recording.check_sampling_rate(100.0).unwrap(),
                100.0,
                "{name}"
            );
            for step in 0..10_i64 {
                let row = recording.next_row().unwrap().unwrap();
                assert_eq!(row.time_ns, step * 10_000_000, "{name}");
                assert!((row.values[0] - step as f64).abs() < 1e-12, "{name}");
                assert!(
                    if step == 4 {
                        row.values[1].is_nan()
                    } else {
                        row.values[1] == 0.5
                    },
                    "{name}"
                );
            }
        }
    }
}
