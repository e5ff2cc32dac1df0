//! Reads comma-separated records: a time and one column per channel.

use std::{
    borrow::Cow,
    fs::File,
    io::Read,
    path::{Path, PathBuf},
};

use csv::{ByteRecord, ReaderBuilder, Terminator};

use crate::{
    ChannelColumn, ColumnMapping, RecordError, RecordReader, Row, TimeSource, TimeUnit,
    column_mapping::places_of,
    formats::table::unit_of,
    record_time::{TimeForm, seconds_text},
    table_layout::{HEAD_BYTES, Separator, SingleBlanks, TableLayout},
};

/// Reads a CSV record row by row.
///
/// A line names the columns: the first one, or the first of 50 that names the column of the time. A table of numbers alone
/// has columns `1`, `2` and so on. Columns are separated by commas, semicolons, tabulators or blanks; numbers may have a
/// decimal comma where commas do not separate. An empty field, or `NaN` as numerical programs print it, is a missing
/// sample. Columns that the mapping does not name are ignored.
pub struct CsvReader {
    path: PathBuf,
    csv: csv::Reader<Box<dyn Read + Send>>,
    record: ByteRecord,
    layout: TableLayout,
    /// the header is read, or the first row, that stands in its place, is still in `record`
    has_row: bool,
    fields_per_row: usize,
    time: RowTime,
    time_form: Option<TimeForm>,
    previous_time_ns: Option<i64>,
    channels: Vec<String>,
    columns: Vec<MappedColumn>,
    values: Vec<f64>,
}

/// Where the time of a row comes from.
#[derive(Debug, Clone, Copy)]
enum RowTime {
    Column { index: usize, unit: TimeUnit },
    Counted { rate_hz: f64, rows: u64 },
}

impl CsvReader {
    /// Opens a file and reads its header.
    ///
    /// # Errors
    /// The file cannot be opened, or columns of the mapping are missing or there twice.
    pub fn open(path: &Path, mapping: &ColumnMapping) -> Result<Self, RecordError> {
        let file = File::open(path).map_err(|source| RecordError::Open {
            path: path.to_owned(),
            source,
        })?;
        Self::new(Box::new(file), path, mapping)
    }

    /// Reads the header from any input; `path` is its name in errors.
    ///
    /// # Errors
    /// As [`CsvReader::open`].
    pub fn new(
        input: Box<dyn Read + Send>,
        path: &Path,
        mapping: &ColumnMapping,
    ) -> Result<Self, RecordError> {
        let path = path.to_owned();
        let refused = |source: std::io::Error| RecordError::Read {
            path: path.clone(),
            line: 1,
            source: source.into(),
        };
        let mut input = input;
        let mut head = Vec::new();
        input
            .by_ref()
            .take(HEAD_BYTES)
            .read_to_end(&mut head)
            .map_err(refused)?;
        let wanted = match mapping.time() {
            TimeSource::Column { name, .. } => Some(name.as_str()),
            TimeSource::Counted { .. } => mapping.channels().first().map(ChannelColumn::column),
        };
        let layout = TableLayout::find(&head, wanted);
        let rest = std::io::Cursor::new(head.split_off(layout.bytes_before))
            .chain(input)
            .chain(END_OF_LAST_LINE);
        let input: Box<dyn Read + Send> = match layout.separator {
            Separator::Byte(_) => Box::new(rest),
            Separator::Blanks => Box::new(SingleBlanks::new(rest)),
        };
        let mut csv = ReaderBuilder::new()
            .delimiter(layout.delimiter())
            .flexible(true) // we report ragged rows ourselves, with our line numbers
            .has_headers(false)
            // Of the CR LF of Windows the CR stays with the last field and is trimmed as white space. As a terminator it
            // would leave the LF to the next record, and every line number but the first would be one too small.
            .terminator(Terminator::Any(b'\n'))
            .buffer_capacity(READ_BUFFER_BYTES)
            .from_reader(input);
        let mut record = ByteRecord::new();
        csv.read_byte_record(&mut record)
            .map_err(|source| RecordError::Read {
                path: path.clone(),
                line: 1 + layout.lines_before,
                source,
            })?;
        let header: Vec<String> = match layout.has_header {
            true => record
                .iter()
                .map(|field| String::from_utf8_lossy(field.trim_ascii()).into_owned())
                .collect(),
            false => (1..=record.len())
                .map(|number| number.to_string())
                .collect(),
        };

        let (time, columns) = locate_columns(&path, 1 + layout.lines_before, &header, mapping)?;
        Ok(Self {
            path,
            csv,
            record,
            has_row: !layout.has_header,
            layout,
            fields_per_row: header.len(),
            time,
            time_form: None,
            previous_time_ns: None,
            channels: mapping
                .channels()
                .iter()
                .map(|column| column.channel().to_owned())
                .collect(),
            values: vec![f64::NAN; columns.len()],
            columns,
        })
    }

    /// Reads the next record that is not blank, and gives the line on which it ends; `None` at the end of the file.
    fn read_record(&mut self) -> Result<Option<u64>, RecordError> {
        let before = self.layout.lines_before;
        if std::mem::take(&mut self.has_row) {
            return Ok(Some(before + 1));
        }
        loop {
            let is_record = self
                .csv
                .read_byte_record(&mut self.record)
                .map_err(|source| {
                    let line = before + self.csv.position().line();
                    RecordError::Read {
                        path: self.path.clone(),
                        line,
                        source,
                    }
                })?;
            if !is_record {
                return Ok(None);
            }
            let is_blank = self.record.len() == 1 && self.record[0].trim_ascii().is_empty();
            if !is_blank {
                return Ok(Some(before + self.csv.position().line() - 1)); // the reader is on the line after
            }
        }
    }

    /// Reads the time of the record at hand and checks that it increases.
    fn parse_time(&mut self, line: u64) -> Result<i64, RecordError> {
        let (index, unit) = match &mut self.time {
            RowTime::Column { index, unit } => (*index, *unit),
            RowTime::Counted { rate_hz, rows } => {
                let time_ns = (*rows as f64 * 1e9 / *rate_hz).round() as i64;
                *rows += 1;
                return Ok(time_ns);
            }
        };
        let text = field_text(&self.record, index, self.layout.has_decimal_comma);
        let text = text.as_deref();
        let bad_time = |allowed| RecordError::BadTime {
            path: self.path.clone(),
            line,
            found: text_for_error(text),
            allowed,
        };
        let form = match self.time_form {
            Some(form) => form,
            None => text
                .and_then(TimeForm::of)
                .ok_or_else(|| bad_time("seconds or ISO 8601"))?,
        };
        let time_ns = text
            .and_then(|text| form.parse_ns(text, unit))
            .ok_or_else(|| bad_time(form.name()))?;
        if let Some(previous_ns) = self
            .previous_time_ns
            .filter(|previous_ns| time_ns <= *previous_ns)
        {
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
        for (value, mapped) in self.values.iter_mut().zip(&self.columns) {
            let text = field_text(&self.record, mapped.index, self.layout.has_decimal_comma);
            let text = text.as_deref();
            *value = text
                .and_then(|text| parse_sample(text, mapped))
                .ok_or_else(|| RecordError::BadNumber {
                    path: self.path.clone(),
                    line,
                    column: mapped.column.column().to_owned(),
                    found: text_for_error(text),
                })?;
        }
        Ok(Some(Row {
            time_ns,
            values: &self.values,
        }))
    }
}

/// Where a channel stands in a row, and the way from its number to SI.
struct MappedColumn {
    index: usize,
    /// by the unit in brackets behind the name of the column, where that counts
    si_from_file: f64,
    column: ChannelColumn,
}

/// Ends the last line of files that do not; line numbers rely on it.
const END_OF_LAST_LINE: &[u8] = b"\n";
/// Some hundred rows per system call.
const READ_BUFFER_BYTES: usize = 64 * 1024;

/// Finds the columns of the mapping in the header: that of the time, and those of the channels.
fn locate_columns(
    path: &Path,
    line: u64,
    header: &[String],
    mapping: &ColumnMapping,
) -> Result<(RowTime, Vec<MappedColumn>), RecordError> {
    let time_column = match mapping.time() {
        TimeSource::Column { name, .. } => Some(name.as_str()),
        TimeSource::Counted { .. } => None,
    };
    let needed = || {
        time_column
            .into_iter()
            .chain(mapping.channels().iter().map(ChannelColumn::column))
    };
    let mut missing: Vec<String> = Vec::new();
    let mut indices = Vec::new();
    for name in needed() {
        match places_of(name, header.iter().map(String::as_str))[..] {
            [index] => indices.push(index),
            [] => missing.push(name.to_owned()),
            [_, _, ..] => {
                return Err(RecordError::RepeatedColumn {
                    path: path.to_owned(),
                    line,
                    column: name.to_owned(),
                });
            }
        }
    }
    if !missing.is_empty() {
        return Err(RecordError::MissingColumns {
            path: path.to_owned(),
            line,
            missing,
            found: header.to_vec(),
        });
    }
    let mut indices = indices.into_iter();
    let time = match mapping.time() {
        TimeSource::Column { unit, .. } => RowTime::Column {
            index: indices.next().unwrap_or(0),
            unit: *unit,
        },
        TimeSource::Counted { rate_hz } => RowTime::Counted {
            rate_hz: *rate_hz,
            rows: 0,
        },
    };
    let channel = |(index, column): (usize, &ChannelColumn)| {
        let si_from_file = column.si_from_stated(unit_of(&header[index]))?;
        Ok(MappedColumn {
            index,
            si_from_file,
            column: column.clone(),
        })
    };
    Ok((
        time,
        indices
            .zip(mapping.channels())
            .map(channel)
            .collect::<Result<_, RecordError>>()?,
    ))
}

/// Reads a sample in SI; `NaN` if it is missing, `None` if it is no finite number.
fn parse_sample(text: &str, mapped: &MappedColumn) -> Option<f64> {
    if text.is_empty() {
        return Some(f64::NAN);
    }
    let number: f64 = text.parse().ok()?;
    if number.is_nan() {
        return Some(f64::NAN);
    }
    Some(mapped.column.si_from_number(number * mapped.si_from_file))
        .filter(|value| value.is_finite())
}

/// A field without white space around it, decimal commas as points; `None` if it is no UTF-8.
fn field_text(record: &ByteRecord, index: usize, has_decimal_comma: bool) -> Option<Cow<'_, str>> {
    let text = record
        .get(index)
        .and_then(|field| std::str::from_utf8(field.trim_ascii()).ok())?;
    match has_decimal_comma && text.contains(',') {
        true => Some(Cow::Owned(text.replace(',', "."))),
        false => Some(Cow::Borrowed(text)),
    }
}

fn text_for_error(text: Option<&str>) -> String {
    text.unwrap_or("(not UTF-8)").to_owned()
}

#[cfg(test)]
mod tests;
