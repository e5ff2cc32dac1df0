//! Text tables read as a whole. Every column of numbers is a channel.

use std::io::{self, Cursor, Read};
use std::path::Path;

use crate::record_time::TimeForm;
use crate::recorded::{RecordedChannel, Segment, TimeOrigin};
use crate::row_limit::{MOST_COLUMNS, MOST_ROW_BYTES};
use crate::source::Source;
use crate::table_layout::{HEAD_BYTES, Separator, TableLayout};
use crate::{
    ColumnMapping, CsvReader, ReadOptions, RecordError, RecordReader, TimeSource, TimeUnit,
};

/// Dummy sampling rate for rows without times. The file does not state it, so the channels do not
/// receive it.
const COUNTING_HZ: f64 = 1.0;

/// Reads a table. Skips text columns. A unit in brackets follows the name of a column: `roof [g]`.
///
/// The options can name the time column. By default, it is the first column whose name is `t` or
/// begins with `time`. If there is none, it is the first column if that contains dates.
pub(crate) fn read(
    source: Source<'_>,
    path: &Path,
    options: &ReadOptions,
) -> Result<Vec<RecordedChannel>, RecordError> {
    let layout = TableLayout::find(source.head(), options.time_column.as_deref());
    let mut input = source.into_reader();
    let head = first_rows(&mut input, &layout).map_err(|source| RecordError::Read {
        path: path.to_owned(),
        line: 1 + layout.lines_before,
        source: source.into(),
    })?;
    check_header(&head, &layout, path)?;
    let (header, row) = first_lines(&head, &layout);
    let is_date = |field: &&String| TimeForm::of(field).is_some_and(TimeForm::is_date);
    let time_column = match &options.time_column {
        Some(name) => Some(name.clone()),
        None => {
            let is_time = |name: &&String| {
                name.to_ascii_lowercase().starts_with("time") || name.as_str() == "t"
            };
            let dated = row.first().filter(is_date).and_then(|_| header.first());
            header
                .iter()
                .find(is_time)
                .filter(|_| layout.has_header)
                .or(dated)
                .cloned()
        }
    };
    let is_sample =
        |field: &str| field.is_empty() || field.replace(',', ".").parse::<f64>().is_ok();
    let is_channel = |index: usize| {
        Some(&header[index]) != time_column.as_ref()
            && row.get(index).is_none_or(|field| is_sample(field))
    };
    let columns: Vec<String> = (0..header.len())
        .filter(|index| is_channel(*index))
        .map(|index| header[index].clone())
        .collect();
    let time = match time_column {
        Some(name) => TimeSource::Column {
            name,
            unit: options.time_unit.unwrap_or(TimeUnit::Seconds),
        },
        None => TimeSource::Counted {
            rate_hz: COUNTING_HZ,
        },
    };
    let is_counted = matches!(time, TimeSource::Counted { .. });
    let mapping = ColumnMapping::by_name(columns.iter().cloned()).with_time(time);
    let origin = match row.iter().any(|field| is_date(&field)) {
        true => TimeOrigin::Epoch,
        false => TimeOrigin::Start,
    };

    let mut reader = CsvReader::new(Box::new(Cursor::new(head).chain(input)), path, &mapping)?;
    let mut times_ns = Vec::new();
    let mut samples = vec![Vec::new(); columns.len()];
    while let Some(row) = reader.next_row()? {
        if !is_counted {
            times_ns.push(row.time_ns);
        }
        samples
            .iter_mut()
            .zip(row.values)
            .for_each(|(samples, value)| samples.push(*value));
    }
    let channel = |(name, samples): (String, Vec<f64>)| {
        let unit = unit_of(&name).to_owned();
        let channel = match is_counted {
            true => RecordedChannel::new(name, None, vec![Segment::new(0, samples)]),
            false => RecordedChannel::from_times(name, None, &times_ns, &samples),
        };
        channel.with_unit(unit).with_origin(origin)
    };
    Ok(columns.into_iter().zip(samples).map(channel).collect())
}

/// Reads the lines before the header, the header and the first row, or as much as they may have.
fn first_rows(input: &mut impl Read, layout: &TableLayout) -> io::Result<Vec<u8>> {
    let most = layout.bytes_before + 2 * MOST_ROW_BYTES;
    let mut head = Vec::new();
    loop {
        let before = head.len();
        input.take(HEAD_BYTES).read_to_end(&mut head)?;
        let table = head.get(layout.bytes_before..).unwrap_or_default();
        let is_row = |line: &&[u8]| line.ends_with(b"\n") && !line.trim_ascii().is_empty();
        let rows = table.split_inclusive(|byte| *byte == b'\n').filter(is_row);
        if rows.take(2).count() == 2 || head.len() == before || head.len() >= most {
            return Ok(head);
        }
    }
}

/// Checks the size of the header before its columns need memory.
fn check_header(head: &[u8], layout: &TableLayout, path: &Path) -> Result<(), RecordError> {
    let table = head.get(layout.bytes_before..).unwrap_or_default();
    let header = table
        .split(|byte| *byte == b'\n')
        .next()
        .unwrap_or_default();
    let (path, line) = (path.to_owned(), 1 + layout.lines_before);
    if header.len() > MOST_ROW_BYTES {
        let most = MOST_ROW_BYTES;
        return Err(RecordError::LongRow { path, line, most });
    }
    let columns = match layout.separator {
        Separator::Byte(separator) => header.split(|byte| *byte == separator).count(),
        Separator::Blanks => header
            .split(u8::is_ascii_whitespace)
            .filter(|name| !name.is_empty())
            .count(),
    };
    match columns {
        found if found > MOST_COLUMNS => {
            let most = MOST_COLUMNS;
            Err(RecordError::TooManyColumns {
                path,
                line,
                found,
                most,
            })
        }
        _ => Ok(()),
    }
}

/// Returns the names of the columns, and the fields of the first row.
fn first_lines(bytes: &[u8], layout: &TableLayout) -> (Vec<String>, Vec<String>) {
    let mut lines = bytes[layout.bytes_before.min(bytes.len())..].split(|byte| *byte == b'\n');
    let fields = |line: &[u8]| -> Vec<String> {
        let line = String::from_utf8_lossy(line);
        let plain = |field: &str| field.trim().trim_matches('"').to_owned();
        match layout.separator {
            Separator::Blanks => line.split_whitespace().map(plain).collect(),
            Separator::Byte(separator) => line.split(char::from(separator)).map(plain).collect(),
        }
    };
    let first = lines.next().map(fields).unwrap_or_default();
    match layout.has_header {
        true => {
            let is_blank = |line: &&[u8]| line.trim_ascii().is_empty();
            (
                first,
                lines
                    .find(|line| !is_blank(line))
                    .map(fields)
                    .unwrap_or_default(),
            )
        }
        false => (
            (1..=first.len()).map(|number| number.to_string()).collect(),
            first,
        ),
    }
}

/// Returns the unit in brackets at the end of a name, or an empty string.
pub(crate) fn unit_of(name: &str) -> &str {
    let inner = |open: char, close: char| {
        name.trim_end()
            .strip_suffix(close)?
            .rsplit_once(open)
            .map(|(_, unit)| unit.trim())
    };
    inner('[', ']')
        .or_else(|| inner('(', ')'))
        .filter(|unit| *unit != "-")
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_text(text: &str, options: &ReadOptions) -> Vec<RecordedChannel> {
        let source = Source::new(Cursor::new(text.as_bytes().to_vec())).unwrap();
        read(source, Path::new("hall.csv"), options).unwrap()
    }

    #[test]
    fn columns_of_numbers_become_channels_with_unit_rate_and_gap() {
        let text =
            "Time (-),note,roof [g],base (kN)\n0.00,calm,1,\n0.01,calm,2,5\n0.05,windy,3,6\n";
        let channels = read_text(text, &ReadOptions::default());
        let names: Vec<&str> = channels.iter().map(RecordedChannel::name).collect();
        assert_eq!(names, ["roof [g]", "base (kN)"]);
        assert_eq!(
            (channels[0].unit(), channels[1].unit()),
            (Some("g"), Some("kN"))
        );
        assert_eq!(channels[1].present(), 2);
        assert_eq!(channels[0].segments().len(), 2);
    }

    #[test]
    fn dates_in_the_first_column_are_the_time() {
        let text = "when,a\n2022-11-04 08:36:24.897,1\n2022-11-04 08:36:24.907,2\n\
                    2022-11-04 08:36:24.917,3\n";
        let channels = read_text(text, &ReadOptions::default());
        // Source: `date -u -d '2022-11-04T08:36:24Z' +%s`
        assert_eq!(channels[0].start_ns(), Some(1_667_550_984_897_000_000));
        assert_eq!(
            (channels[0].sampling_rate_hz(), channels[0].origin()),
            (Some(100.0), TimeOrigin::Epoch)
        );
    }

    #[test]
    fn table_without_times_has_no_rate() {
        let channels = read_text("1.5\t2\n2.5\t3\n", &ReadOptions::default());
        assert_eq!(
            (channels[1].name(), channels[1].sampling_rate_hz()),
            ("2", None)
        );
        assert_eq!(channels[0].samples().collect::<Vec<_>>(), [1.5, 2.5]);
    }

    #[test]
    fn named_time_column_in_microseconds_is_used() {
        let time_column = Some("fine".to_owned());
        let options = ReadOptions {
            time_column,
            time_unit: Some(TimeUnit::Microseconds),
            ..ReadOptions::default()
        };
        let channels = read_text(
            "who:,me\n\nn,fine,a\n0,10000,1\n1,20000,2\n2,30000,3\n",
            &options,
        );
        assert_eq!(channels[0].sampling_rate_hz(), Some(100.0));
    }
}
