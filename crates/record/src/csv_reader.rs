//! Reads comma-separated records: a time and one column per channel.

use std::{
    borrow::Cow,
    io::Read,
    path::{Path, PathBuf},
};

use csv::{ByteRecord, ReaderBuilder, Terminator};

use crate::{
    ChannelColumn, ColumnMapping, RecordError, RecordReader, Row, TimeSource, TimeUnit,
    column_mapping::places_of,
    formats::table::unit_of,
    record_time::TimeForm,
    row_limit::{MOST_COLUMNS, MOST_ROW_BYTES, RowLimit},
    source::open_file,
    table_layout::{HEAD_BYTES, Separator, SingleBlanks, TableLayout},
};

/// The times that a file may contain.
const FORMS: &str = "seconds, ISO 8601, DD.MM.YYYY HH:MM or YYYY/MM/DD HH:MM";
/// Words for a missing sample, in any case.
const MISSING: [&str; 5] = ["", "-", "NA", "N/A", "#N/A"];
/// Distance from which a row is far ahead of its neighbours, as a multiple of their distance. Rows
/// in a wrong order are closer.
const FAR_AHEAD: i64 = 10;

/// A reader of CSV records, row by row.
///
/// The header is the first line that names the required column, or the first line of the file. It
/// may follow up to 50 other lines. A table of numbers alone has columns `1`, `2` and so on.
/// Columns are separated by commas, semicolons, tabs or blanks. Numbers may have a decimal comma if
/// commas are not the separator.
///
/// An empty field, `NaN`, `NA`, `N/A`, `#N/A` or `-` is a missing sample. Columns that the mapping
/// does not name are ignored. A row has at most 1 MiB, and a table at most 10,000 columns.
pub struct CsvReader<'a> {
    path: PathBuf,
    csv: csv::Reader<Box<dyn Read + Send + 'a>>,
    limit: RowLimit,
    record: ByteRecord,
    /// Line of the last row, or of the header before the first row.
    line: u64,
    layout: TableLayout,
    /// Whether `record` still contains the first row, because the table has no header.
    has_row: bool,
    fields_per_row: usize,
    time: RowTime,
    time_form: Option<TimeForm>,
    /// Whether the first time states its zone.
    has_zone: bool,
    must_increase: bool,
    previous: Option<PreviousRow>,
    channels: Vec<String>,
    columns: Vec<MappedColumn>,
    values: Vec<f64>,
}

/// The last row that was read.
#[derive(Debug, Clone, Copy)]
struct PreviousRow {
    line: u64,
    time_ns: i64,
    /// Time of the row before it.
    earlier_ns: Option<i64>,
}

/// The source of the time of a row.
#[derive(Debug, Clone, Copy)]
enum RowTime {
    Column { index: usize, unit: TimeUnit },
    Counted { rate_hz: f64, rows: u64 },
}

impl<'a> CsvReader<'a> {
    /// Opens a file and reads its header.
    ///
    /// # Errors
    /// Returns an error if the file cannot be opened, or if columns of the mapping are missing or
    /// occur more than once.
    pub fn open(path: &Path, mapping: &ColumnMapping) -> Result<Self, RecordError> {
        Self::new(Box::new(open_file(path)?), path, mapping)
    }

    /// Reads the header from any input. `path` identifies the input in errors.
    ///
    /// # Errors
    /// Returns the same errors as [`CsvReader::open`], except those of opening the file.
    pub fn new(
        input: Box<dyn Read + Send + 'a>,
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
        let limit = RowLimit::default();
        let rest = limit
            .of(std::io::Cursor::new(head.split_off(layout.bytes_before)).chain(input))
            .chain(END_OF_LAST_LINE);
        let input: Box<dyn Read + Send + 'a> = match layout.separator {
            Separator::Byte(_) => Box::new(rest),
            Separator::Blanks => Box::new(SingleBlanks::new(rest)),
        };
        let mut csv = ReaderBuilder::new()
            .delimiter(layout.delimiter())
            // This reader reports ragged rows itself, with its own line numbers.
            .flexible(true)
            .has_headers(false)
            // The CR of a Windows line ending stays in the last field and is trimmed as white
            // space. With CRLF as the terminator, the LF would belong to the next record. All line
            // numbers after the first would then be too small by one.
            .terminator(Terminator::Any(b'\n'))
            .buffer_capacity(READ_BUFFER_BYTES)
            .from_reader(input);
        let mut record = ByteRecord::new();
        let line = 1 + layout.lines_before;
        csv.read_byte_record(&mut record)
            .map_err(|source| unread_row(&path, line, &limit, source))?;
        limit.complete_row();
        if record.len() > MOST_COLUMNS {
            return Err(RecordError::TooManyColumns {
                path,
                line,
                found: record.len(),
                most: MOST_COLUMNS,
            });
        }
        let header = column_names(&record, &layout);
        let (time, columns) = locate_columns(&path, line, &header, mapping)?;
        Ok(Self {
            path,
            csv,
            limit,
            record,
            line,
            has_row: !layout.has_header,
            layout,
            fields_per_row: header.len(),
            time,
            time_form: None,
            has_zone: true,
            must_increase: true,
            previous: None,
            channels: mapping
                .channels()
                .iter()
                .map(|column| column.channel().to_owned())
                .collect(),
            values: vec![f64::NAN; columns.len()],
            columns,
        })
    }

    /// Reads rows in any order of time. The caller decides about those that are not in order.
    #[must_use]
    pub fn in_any_order(mut self) -> Self {
        self.must_increase = false;
        self
    }

    /// Returns `true` if the first time is a number, or states its zone. A date without a zone
    /// counts as UTC, but may be a local time.
    pub fn times_have_zone(&self) -> bool {
        self.has_zone
    }

    /// Returns the line of the last row, from 1. Before the first row, it is the line of the
    /// header.
    pub fn line(&self) -> u64 {
        self.line
    }

    /// Reads the next non-blank record, and returns the number of its last line. Returns `None` at
    /// the end of the file.
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
                    let position = match self.limit.is_exceeded() {
                        true => self.record.position(),
                        false => None,
                    };
                    let line = position.unwrap_or(self.csv.position()).line();
                    unread_row(&self.path, before + line, &self.limit, source)
                })?;
            self.limit.complete_row();
            if !is_record {
                return Ok(None);
            }
            let is_blank = self.record.len() == 1 && self.record[0].trim_ascii().is_empty();
            if !is_blank {
                // The CSV reader is already on the next line.
                return Ok(Some(before + self.csv.position().line() - 1));
            }
        }
    }

    /// Parses the time of the current record, and checks that it increases.
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
            None => text.and_then(TimeForm::of).ok_or_else(|| bad_time(FORMS))?,
        };
        let time_ns = text
            .and_then(|text| form.parse_ns(text, unit))
            .ok_or_else(|| bad_time(form.name()))?;
        if self.time_form.is_none() {
            self.has_zone = text.is_some_and(|text| form.has_zone(text));
        }
        let previous = self.previous.filter(|_| self.must_increase);
        if let Some(previous) = previous.filter(|previous| time_ns <= previous.time_ns) {
            let path = self.path.clone();
            return Err(match previous.earlier_if_far_ahead(time_ns) {
                Some(earlier_ns) => RecordError::TimeAhead {
                    path,
                    line: previous.line,
                    found: form.text(previous.time_ns),
                    previous: form.text(earlier_ns),
                    next: form.text(time_ns),
                },
                None => RecordError::TimeNotIncreasing {
                    path,
                    line,
                    found: form.text(time_ns),
                    previous: form.text(previous.time_ns),
                },
            });
        }
        self.time_form = Some(form);
        self.previous = Some(PreviousRow {
            line,
            time_ns,
            earlier_ns: self.previous.map(|previous| previous.time_ns),
        });
        Ok(time_ns)
    }
}

impl PreviousRow {
    /// Returns the time of the row before this one, if only this one is wrong: it is far ahead of
    /// that row and of the row after it, which are in order.
    fn earlier_if_far_ahead(&self, next_ns: i64) -> Option<i64> {
        let earlier_ns = self.earlier_ns?;
        let step_ns = next_ns.saturating_sub(earlier_ns);
        let ahead_ns = self.time_ns.saturating_sub(earlier_ns);
        let is_far = step_ns > 0 && ahead_ns >= step_ns.saturating_mul(FAR_AHEAD);
        is_far.then_some(earlier_ns)
    }
}

impl RecordReader for CsvReader<'_> {
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
        self.line = line;
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

/// The position of a channel in a row, and the conversion of its number to SI.
struct MappedColumn {
    index: usize,
    /// Factor from the unit in brackets after the column name; 1 if that unit does not apply.
    si_from_file: f64,
    column: ChannelColumn,
}

/// Terminator appended to the input, because line numbers require that the last line is terminated.
const END_OF_LAST_LINE: &[u8] = b"\n";
/// Size of the read buffer: some hundred rows per system call.
const READ_BUFFER_BYTES: usize = 64 * 1024;

/// Returns the error of a row that could not be read, or is too long.
fn unread_row(path: &Path, line: u64, limit: &RowLimit, source: csv::Error) -> RecordError {
    let path = path.to_owned();
    match limit.is_exceeded() {
        true => RecordError::LongRow {
            path,
            line,
            most: MOST_ROW_BYTES,
        },
        false => RecordError::Read { path, line, source },
    }
}

/// Returns the names in the header, or the numbers of the columns of a table without a header.
fn column_names(first: &ByteRecord, layout: &TableLayout) -> Vec<String> {
    match layout.has_header {
        true => first
            .iter()
            .map(|field| String::from_utf8_lossy(field.trim_ascii()).into_owned())
            .collect(),
        false => (1..=first.len()).map(|number| number.to_string()).collect(),
    }
}

/// Finds the columns of the time and the channels in the header.
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

/// Returns `true` if a field without surrounding white space is a missing sample. `NaN` counts as
/// a number.
pub(crate) fn is_missing(text: &str) -> bool {
    MISSING.iter().any(|word| word.eq_ignore_ascii_case(text))
}

/// Parses a sample in SI. Returns `NaN` if it is missing, and `None` if it is not a finite number.
fn parse_sample(text: &str, mapped: &MappedColumn) -> Option<f64> {
    if is_missing(text) {
        return Some(f64::NAN);
    }
    let number: f64 = text.parse().ok()?;
    if number.is_nan() {
        return Some(f64::NAN);
    }
    Some(mapped.column.si_from_number(number * mapped.si_from_file))
        .filter(|value| value.is_finite())
}

/// Returns a field without surrounding white space and with a decimal point. Returns `None` if it
/// is not UTF-8.
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
