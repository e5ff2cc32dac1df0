//! Reads comma-separated records: a time and one column per channel.

use std::{
    fs::File,
    io::Read,
    path::{Path, PathBuf},
};

use csv::{ByteRecord, ReaderBuilder, Terminator};

use crate::{
    ChannelColumn, ColumnMapping, RecordError, RecordReader, Row,
    record_time::{TimeForm, seconds_text},
};

/// Reads a CSV record row by row.
///
/// The first line names the columns. An empty field, or `NaN` as numerical programs print it, is a missing sample.
/// Columns that the mapping does not name are ignored.
pub struct CsvReader {
    path: PathBuf,
    csv: csv::Reader<Box<dyn Read + Send>>,
    record: ByteRecord,
    fields_per_row: usize,
    time_index: usize,
    time_form: Option<TimeForm>,
    previous_time_ns: Option<i64>,
    channels: Vec<String>,
    columns: Vec<(usize, ChannelColumn)>,
    values: Vec<f64>,
}

impl CsvReader {
    /// Opens a file and reads its header.
    ///
    /// # Errors
    /// The file cannot be opened, or columns of the mapping are missing or there twice.
    pub fn open(path: &Path, mapping: &ColumnMapping) -> Result<Self, RecordError> {
        let file = File::open(path).map_err(|source| RecordError::Open { path: path.to_owned(), source })?;
        Self::new(Box::new(file), path, mapping)
    }

    /// Reads the header from any input; `path` is its name in errors.
    ///
    /// # Errors
    /// As [`CsvReader::open`].
    pub fn new(input: Box<dyn Read + Send>, path: &Path, mapping: &ColumnMapping) -> Result<Self, RecordError> {
        let path = path.to_owned();
        let input: Box<dyn Read + Send> = Box::new(input.chain(END_OF_LAST_LINE));
        let mut csv = ReaderBuilder::new()
            .flexible(true) // we report ragged rows ourselves, with our line numbers
            .has_headers(false)
            // Of the CR LF of Windows the CR stays with the last field and is trimmed as white space. As a terminator it
            // would leave the LF to the next record, and every line number but the first would be one too small.
            .terminator(Terminator::Any(b'\n'))
            .buffer_capacity(READ_BUFFER_BYTES)
            .from_reader(input);
        let mut record = ByteRecord::new();
        csv.read_byte_record(&mut record).map_err(|source| RecordError::Read {
            path: path.clone(),
            line: 1,
            source,
        })?;
        let header: Vec<String> =
            record.iter().map(|field| String::from_utf8_lossy(field.trim_ascii()).into_owned()).collect();

        let (time_index, columns) = locate_columns(&path, &header, mapping)?;
        Ok(Self {
            path,
            csv,
            record,
            fields_per_row: header.len(),
            time_index,
            time_form: None,
            previous_time_ns: None,
            channels: mapping.channels().iter().map(|column| column.channel().to_owned()).collect(),
            values: vec![f64::NAN; columns.len()],
            columns,
        })
    }

    /// Reads the next record that is not blank, and gives the line on which it ends; `None` at the end of the file.
    fn read_record(&mut self) -> Result<Option<u64>, RecordError> {
        loop {
            let is_record = self.csv.read_byte_record(&mut self.record).map_err(|source| {
                let line = self.csv.position().line();
                RecordError::Read { path: self.path.clone(), line, source }
            })?;
            if !is_record {
                return Ok(None);
            }
            let is_blank = self.record.len() == 1 && self.record[0].trim_ascii().is_empty();
            if !is_blank {
                return Ok(Some(self.csv.position().line() - 1)); // the reader is on the line after
            }
        }
    }

    /// Reads the time of the record at hand and checks that it increases.
    fn parse_time(&mut self, line: u64) -> Result<i64, RecordError> {
        let text = field_text(&self.record, self.time_index);
        let bad_time =
            |allowed| RecordError::BadTime { path: self.path.clone(), line, found: text_for_error(text), allowed };
        let form = match self.time_form {
            Some(form) => form,
            None => text.and_then(TimeForm::of).ok_or_else(|| bad_time("seconds or ISO 8601"))?,
        };
        let time_ns = text.and_then(|text| form.parse_ns(text)).ok_or_else(|| bad_time(form.name()))?;
        if let Some(previous_ns) = self.previous_time_ns.filter(|previous_ns| time_ns <= *previous_ns) {
            return Err(RecordError::TimeNotIncreasing {
                path: self.path.clone(),
                line,
                found_s: seconds_text(time_ns),
                previous_s: seconds_text(previous_ns),
            });
        }
        self.time_form = Some(form);
        self.previous_time_ns = Some(time_ns);
        Ok(time_ns)
    }
}

impl RecordReader for CsvReader {
    fn path(&self) -> &Path {
        &self.path
    }

    fn channels(&self) -> &[String] {
        &self.channels
    }

    fn next_row(&mut self) -> Result<Option<Row<'_>>, RecordError> {
        let Some(line) = self.read_record()? else {
            return Ok(None);
        };
        if self.record.len() != self.fields_per_row {
            return Err(RecordError::RaggedRow {
                path: self.path.clone(),
                line,
                found: self.record.len(),
                expected: self.fields_per_row,
            });
        }
        let time_ns = self.parse_time(line)?;
        for (value, (index, column)) in self.values.iter_mut().zip(&self.columns) {
            let text = field_text(&self.record, *index);
            *value = text.and_then(|text| parse_sample(text, column)).ok_or_else(|| RecordError::BadNumber {
                path: self.path.clone(),
                line,
                column: column.column().to_owned(),
                found: text_for_error(text),
            })?;
        }
        Ok(Some(Row { time_ns, values: &self.values }))
    }
}

/// Ends the last line of files that do not; line numbers rely on it.
const END_OF_LAST_LINE: &[u8] = b"\n";
/// Some hundred rows per system call.
const READ_BUFFER_BYTES: usize = 64 * 1024;

/// Finds the columns of the mapping in the header: that of the time, and those of the channels.
fn locate_columns(
    path: &Path,
    header: &[String],
    mapping: &ColumnMapping,
) -> Result<(usize, Vec<(usize, ChannelColumn)>), RecordError> {
    let needed = || std::iter::once(mapping.time_column()).chain(mapping.channels().iter().map(ChannelColumn::column));
    let mut missing: Vec<String> = Vec::new();
    let mut indices = Vec::new();
    for name in needed() {
        let mut found = header.iter().enumerate().filter(|(_, column)| *column == name).map(|(index, _)| index);
        match (found.next(), found.next()) {
            (Some(index), None) => indices.push(index),
            (Some(_), Some(_)) => {
                return Err(RecordError::RepeatedColumn { path: path.to_owned(), column: name.to_owned() });
            }
            (None, _) => missing.push(name.to_owned()),
        }
    }
    match indices.split_first() {
        Some((time_index, channel_indices)) if missing.is_empty() => {
            let columns = channel_indices.iter().copied().zip(mapping.channels().iter().cloned()).collect();
            Ok((*time_index, columns))
        }
        _ => Err(RecordError::MissingColumns { path: path.to_owned(), missing, found: header.to_vec() }),
    }
}

/// Reads a sample in SI; `NaN` if it is missing, `None` if it is no finite number.
fn parse_sample(text: &str, column: &ChannelColumn) -> Option<f64> {
    if text.is_empty() {
        return Some(f64::NAN);
    }
    let number: f64 = text.parse().ok()?;
    if number.is_nan() {
        return Some(f64::NAN);
    }
    Some(column.si_from_number(number)).filter(|value| value.is_finite())
}

/// A field without white space around it; `None` if it is no UTF-8.
fn field_text(record: &ByteRecord, index: usize) -> Option<&str> {
    record.get(index).and_then(|field| std::str::from_utf8(field.trim_ascii()).ok())
}

fn text_for_error(text: Option<&str>) -> String {
    text.unwrap_or("(not UTF-8)").to_owned()
}

#[cfg(test)]
mod tests;
