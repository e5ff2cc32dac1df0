//! Writes comma-separated records: a time and one column per channel.

use std::{
    fmt::Write as _,
    fs::File,
    io::Write,
    path::{Path, PathBuf},
};

use crate::{
    ColumnMapping, RecordError, column_mapping::ChannelColumn, record_time::write_seconds,
};

/// A writer of CSV records, row by row: the time in s, then the given columns in SI units.
///
/// Numbers have the digits required to read back bit-identical values. A missing sample is an empty
/// field.
pub struct CsvWriter<W: Write = File> {
    path: PathBuf,
    csv: csv::Writer<W>,
    columns: Vec<ChannelColumn>,
    line: u64,
    text: String,
}

impl CsvWriter {
    /// Creates or truncates the file, and writes the header.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created or written.
    pub fn create<S: AsRef<str>>(path: &Path, columns: &[S]) -> Result<Self, RecordError> {
        let mapping = ColumnMapping::by_name(columns.iter().map(AsRef::as_ref));
        let file = File::create(path).map_err(|source| RecordError::Open {
            path: path.to_owned(),
            source,
        })?;
        Self::new(file, path, &mapping)
    }
}

impl<W: Write> CsvWriter<W> {
    /// Writes the header of a file to `output`, with the columns, units and time column of
    /// `mapping`. Errors name `path`.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    pub fn new(output: W, path: &Path, mapping: &ColumnMapping) -> Result<Self, RecordError> {
        let mut writer = Self {
            path: path.to_owned(),
            csv: csv::WriterBuilder::new()
                .buffer_capacity(WRITE_BUFFER_BYTES)
                .from_writer(output),
            columns: mapping.channels().to_vec(),
            line: 1,
            text: String::new(),
        };
        let header = std::iter::once(mapping.time_column())
            .chain(writer.columns.iter().map(ChannelColumn::column));
        writer
            .csv
            .write_record(header)
            .map_err(|source| writer.error(source))?;
        Ok(writer)
    }

    /// Writes one row: `time_ns` in ns, and one value per column in SI units, `NaN` if missing.
    ///
    /// # Errors
    /// Returns an error if the row has the wrong length or an infinite value, or if the file cannot
    /// be written.
    pub fn write_row(&mut self, time_ns: i64, values: &[f64]) -> Result<(), RecordError> {
        self.line += 1;
        if values.len() != self.columns.len() {
            return Err(RecordError::RowLength {
                path: self.path.clone(),
                line: self.line,
                found: values.len(),
                expected: self.columns.len(),
            });
        }
        if let Some((column, found)) = self
            .columns
            .iter()
            .zip(values)
            .find(|(_, value)| value.is_infinite())
        {
            return Err(RecordError::NotFinite {
                path: self.path.clone(),
                line: self.line,
                column: column.column().to_owned(),
                found: *found,
            });
        }
        self.text.clear();
        write_seconds(time_ns, &mut self.text);
        self.write_field()?;
        for (column, value) in values.iter().enumerate() {
            self.text.clear();
            let value = self.columns[column].number_from_si(*value);
            if !value.is_nan() {
                // Debug format writes the shortest digits that read back as the same bits, and an
                // exponent for very large or small numbers.
                // Writing to a `String` does not fail.
                let _ = write!(self.text, "{value:?}");
            }
            self.write_field()?;
        }
        self.csv
            .write_record(None::<&[u8]>)
            .map_err(|source| self.error(source))
    }

    /// Flushes buffered rows, and returns the output. Dropping the writer without this call may
    /// silently lose the last rows.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn finish(self) -> Result<W, RecordError> {
        let (path, line) = (self.path, self.line);
        self.csv.into_inner().map_err(|error| RecordError::Write {
            path,
            line,
            source: error.into_error().into(),
        })
    }

    fn write_field(&mut self) -> Result<(), RecordError> {
        self.csv
            .write_field(&self.text)
            .map_err(|source| self.error(source))
    }

    fn error(&self, source: csv::Error) -> RecordError {
        RecordError::Write {
            path: self.path.clone(),
            line: self.line,
            source,
        }
    }
}

/// Size of the write buffer: some hundred rows per system call.
const WRITE_BUFFER_BYTES: usize = 64 * 1024;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{ColumnMapping, CsvReader, RecordReader};

    #[test]
    fn file_has_time_header_and_empty_field_for_a_missing_sample() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.csv");
        let mut writer = CsvWriter::create(&path, &["ground", "a,b"]).unwrap();
        writer.write_row(0, &[0.1, f64::NAN]).unwrap();
        writer.write_row(8_333_333, &[f64::NAN, -2e-20]).unwrap();
        writer.finish().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text, "time,ground,\"a,b\"\n0,0.1,\n0.008333333,,-2e-20\n");
    }

    #[test]
    fn infinite_value_is_refused_with_line_and_column() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.csv");
        let mut writer = CsvWriter::create(&path, &["ground"]).unwrap();
        let error = writer.write_row(0, &[f64::INFINITY]).unwrap_err();
        assert!(
            matches!(error, RecordError::NotFinite { line: 2, ref column, .. } if column == "ground")
        );
    }

    #[test]
    fn row_of_another_length_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = CsvWriter::create(&folder.path().join("out.csv"), &["ground"]).unwrap();
        let error = writer.write_row(0, &[1.0, 2.0]).unwrap_err();
        assert!(matches!(
            error,
            RecordError::RowLength {
                found: 2,
                expected: 1,
                ..
            }
        ));
    }

    /// Generates any finite number by its bits, or a missing sample.
    fn sample() -> impl Strategy<Value = f64> {
        any::<u64>()
            .prop_map(f64::from_bits)
            .prop_map(|value| if value.is_finite() { value } else { f64::NAN })
    }

    proptest! {
        #[test]
        fn rows_written_read_back_as_the_same_bits(
            steps in prop::collection::vec((1_i64..10_000_000_000, sample(), sample()), 0..50),
            start_ns in -1_000_000_000_000_i64..2_000_000_000_000_000_000,
        ) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("out.csv");
            let mut writer = CsvWriter::create(&path, &["a", "b"]).unwrap();
            let mut time_ns = start_ns;
            let mut written = Vec::new();
            for (step_ns, a, b) in steps {
                time_ns += step_ns;
                writer.write_row(time_ns, &[a, b]).unwrap();
                written.push((time_ns, a.to_bits(), b.to_bits()));
            }
            writer.finish().unwrap();

            let mut reader = CsvReader::open(&path, &ColumnMapping::by_name(["a", "b"])).unwrap();
            let mut read = Vec::new();
            while let Some(row) = reader.next_row().unwrap() {
                read.push((row.time_ns, row.values[0].to_bits(), row.values[1].to_bits()));
            }
            prop_assert_eq!(read, written);
        }
    }
}
