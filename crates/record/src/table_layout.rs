//! Detects the layout of a text table: column separator, position of the header and number format.

use std::io::Read;

use crate::csv_reader::is_missing;
use crate::record_time::TimeForm;

/// Maximum number of lines before the header. Recorders write metadata there.
const MOST_LINES_BEFORE_HEADER: usize = 50;
/// Number of bytes at the start of a file that are examined.
pub(crate) const HEAD_BYTES: u64 = 1 << 16;
const BYTE_ORDER_MARK: &str = "\u{feff}";

/// The column separator of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Separator {
    /// A comma, semicolon or tab.
    Byte(u8),
    /// Any number of blanks.
    Blanks,
}

/// The layout of a table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TableLayout {
    pub(crate) separator: Separator,
    /// Whether numbers are written with a decimal comma (`0,5`).
    pub(crate) has_decimal_comma: bool,
    /// Whether the table has a header. Otherwise column names are numbers from 1.
    pub(crate) has_header: bool,
    /// Number of lines before the header, or before the first row without a header.
    pub(crate) lines_before: u64,
    pub(crate) bytes_before: usize,
    /// Number of fields in the header, or in the first row without a header.
    pub(crate) columns: usize,
}

impl TableLayout {
    /// Detects the layout from the first bytes of a file.
    ///
    /// With `wanted_column`, the header is the first line that names this column. Otherwise, it is
    /// the first line followed by a row of numbers of the same length. If no line qualifies, the
    /// first line is the header, unless it consists of numbers.
    pub(crate) fn find(head: &[u8], wanted_column: Option<&str>) -> Self {
        let text = String::from_utf8_lossy(head);
        let text = text.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&text);
        let mark_bytes = if head.starts_with(BYTE_ORDER_MARK.as_bytes()) {
            BYTE_ORDER_MARK.len()
        } else {
            0
        };
        let mut lines = Vec::new();
        let mut start = 0;
        // Lengths refer to the bytes of the file. Lossy decoding lengthens text that is not UTF-8.
        for line in head[mark_bytes..]
            .split_inclusive(|byte| *byte == b'\n')
            .take(MOST_LINES_BEFORE_HEADER + 2)
        {
            lines.push((
                start + mark_bytes,
                String::from_utf8_lossy(line)
                    .trim_end_matches(['\n', '\r'])
                    .to_owned(),
            ));
            start += line.len();
        }
        // Spreadsheet programs may state the separator in the first line.
        let stated = text
            .lines()
            .next()
            .and_then(|line| line.trim().strip_prefix("sep=")?.bytes().next());
        let first = usize::from(stated.is_some());
        let separator = |line: &str| match stated {
            Some(b' ') | None => separator_of(line),
            Some(stated) => Separator::Byte(stated),
        };
        let header = match wanted_column {
            // A line of numbers is a row, even if one of them equals the number of a column.
            Some(wanted) => lines.iter().position(|(_, line)| {
                let fields = fields(line, separator(line));
                fields.iter().any(|field| field == wanted)
                    && !fields.iter().all(|field| is_number(field))
            }),
            None => (first..lines.len()).find(|index| is_header(&lines, *index, separator)),
        };
        let first_line = lines.get(first).map_or("", |(_, line)| line.as_str());
        let is_numbers = !first_line.trim().is_empty()
            && fields(first_line, separator(first_line))
                .iter()
                .all(|field| is_number(field));
        let (at, has_header) = match header {
            Some(header) => (header, true),
            None => (first, !is_numbers),
        };
        let header_line = lines.get(at).map_or("", |(_, line)| line.as_str());
        let separator = separator(header_line);
        let row = lines
            .get(at + usize::from(has_header))
            .map_or("", |(_, line)| line.as_str());
        let has_decimal_comma = separator != Separator::Byte(b',')
            && fields(row, separator)
                .iter()
                .any(|field| is_comma_number(field));
        Self {
            separator,
            has_decimal_comma,
            has_header,
            lines_before: at as u64,
            bytes_before: lines.get(at).map_or(0, |(start, _)| *start),
            columns: fields(header_line, separator).len(),
        }
    }

    /// Returns `true` if a file is certainly a table: a header, and numbers below it, with a
    /// separator other than blanks.
    pub(crate) fn is_table(head: &[u8]) -> bool {
        let layout = Self::find(head, None);
        let text = String::from_utf8_lossy(head);
        let row = text
            .lines()
            .nth((layout.lines_before + u64::from(layout.has_header)) as usize)
            .unwrap_or_default();
        let fields = fields(row, layout.separator);
        layout.separator != Separator::Blanks
            && fields.len() == layout.columns
            && layout.columns > 1
            && fields.iter().any(|field| is_number(field))
    }

    /// Returns the delimiter for the `csv` crate.
    pub(crate) fn delimiter(&self) -> u8 {
        match self.separator {
            Separator::Byte(separator) => separator,
            Separator::Blanks => b' ',
        }
    }
}

/// Returns the separator of a line. Semicolons take precedence over tabs, and tabs over commas,
/// because numbers may contain commas.
fn separator_of(line: &str) -> Separator {
    let mut is_quoted = false;
    let mut found = [false; 3];
    for symbol in line.bytes() {
        match symbol {
            b'"' => is_quoted = !is_quoted,
            b';' if !is_quoted => found[0] = true,
            b'\t' if !is_quoted => found[1] = true,
            b',' if !is_quoted => found[2] = true,
            _ => {}
        }
    }
    match found {
        [true, ..] => Separator::Byte(b';'),
        [_, true, _] => Separator::Byte(b'\t'),
        [_, _, true] => Separator::Byte(b','),
        _ if line.split_whitespace().nth(1).is_some() => Separator::Blanks,
        _ => Separator::Byte(b','),
    }
}

fn fields(line: &str, separator: Separator) -> Vec<String> {
    let plain = |field: &str| field.trim().trim_matches('"').trim().to_owned();
    match separator {
        Separator::Blanks => line.split_whitespace().map(plain).collect(),
        Separator::Byte(separator) => line.split(char::from(separator)).map(plain).collect(),
    }
}

/// Returns `true` if a line is not a row, and the next non-blank line is a row of the same length.
fn is_header(
    lines: &[(usize, String)],
    index: usize,
    separator: impl Fn(&str) -> Separator,
) -> bool {
    let line = &lines[index].1;
    let Some((_, row)) = lines[index + 1..]
        .iter()
        .find(|(_, line)| !line.trim().is_empty())
    else {
        return false;
    };
    let separator = separator(line);
    let (names, values) = (fields(line, separator), fields(row, separator));
    let is_value =
        |field: &String| is_missing(field) || is_number(field) || TimeForm::of(field).is_some();
    let is_row = values.iter().any(|field| is_number(field))
        && values.iter().filter(|field| is_value(field)).count() * 2 >= values.len();
    names.len() == values.len() && is_row && !names.iter().all(is_value)
}

fn is_number(field: &str) -> bool {
    field.parse::<f64>().is_ok() || is_comma_number(field)
}

fn is_comma_number(field: &str) -> bool {
    field.matches(',').count() == 1 && field.replace(',', ".").parse::<f64>().is_ok()
}

/// A reader that merges repeated blanks and tabs, and removes them at the ends of lines, so that a
/// single blank separates columns.
pub(crate) struct SingleBlanks<R> {
    input: R,
    ready: Vec<u8>,
    served: usize,
    is_after_blank: bool,
    is_line_start: bool,
}

/// Number of bytes read at once.
const PIECE_BYTES: usize = 64 * 1024;

impl<R: Read> SingleBlanks<R> {
    pub(crate) fn new(input: R) -> Self {
        Self {
            input,
            ready: Vec::new(),
            served: 0,
            is_after_blank: false,
            is_line_start: true,
        }
    }

    /// Prepares the next bytes. Prepares none at the end of the input.
    fn refill(&mut self) -> std::io::Result<()> {
        let mut piece = vec![0; PIECE_BYTES];
        self.ready.clear();
        self.served = 0;
        loop {
            let count = self.input.read(&mut piece)?;
            for byte in &piece[..count] {
                match byte {
                    b' ' | b'\t' => self.is_after_blank = true,
                    b'\n' | b'\r' => {
                        self.ready.push(*byte);
                        (self.is_after_blank, self.is_line_start) = (false, true);
                    }
                    byte => {
                        if self.is_after_blank && !self.is_line_start {
                            self.ready.push(b' ');
                        }
                        self.ready.push(*byte);
                        (self.is_after_blank, self.is_line_start) = (false, false);
                    }
                }
            }
            // A piece of blanks alone yields no bytes, but it is not the end of the input.
            if count == 0 || !self.ready.is_empty() {
                return Ok(());
            }
        }
    }
}

impl<R: Read> Read for SingleBlanks<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        if self.served == self.ready.len() {
            self.refill()?;
        }
        let count = buffer.len().min(self.ready.len() - self.served);
        buffer[..count].copy_from_slice(&self.ready[self.served..self.served + count]);
        self.served += count;
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn separators_are_distinguished_from_decimal_commas() {
        for (line, separator) in [
            ("time,a", Separator::Byte(b',')),
            ("time;a, b", Separator::Byte(b';')),
            ("time\ta\tb", Separator::Byte(b'\t')),
            ("\"time;s\",a", Separator::Byte(b',')),
            ("  0.1   0.2", Separator::Blanks),
            ("alone", Separator::Byte(b',')),
        ] {
            assert_eq!(separator_of(line), separator, "{line}");
        }
        assert!(TableLayout::find(b"time;a\n0,00;1,5\n", None).has_decimal_comma);
        assert!(!TableLayout::find(b"time,a\n0.00,1.5\n", None).has_decimal_comma);
    }

    #[test]
    fn header_is_found_after_the_preamble_of_a_recorder() {
        let head = "sep=,\nDeviceTag:,Xsens DOT\nStartTime: ,2025-03-06\n\u{e4} Ltd\n\n\
                    Packet,Time_us,Acc\n0,10,0.5\n1,20,0.6\n";
        for wanted in [None, Some("Time_us")] {
            let layout = TableLayout::find(head.as_bytes(), wanted);
            assert_eq!(
                (layout.lines_before, layout.has_header, layout.columns),
                (5, true, 3),
                "{wanted:?}"
            );
            assert!(head[layout.bytes_before..].starts_with("Packet"));
        }
    }

    #[test]
    fn table_of_numbers_has_no_header() {
        let layout = TableLayout::find(b"-3.359\t-0.052\n-0.627\t-0.054\n", None);
        assert_eq!(
            (layout.has_header, layout.lines_before, layout.columns),
            (false, 0, 2)
        );
        let layout = TableLayout::find(b"1\t2\n3\t4\n", Some("1"));
        assert_eq!(
            (layout.has_header, layout.lines_before, layout.columns),
            (false, 0, 2)
        );
    }

    #[test]
    fn prose_is_not_a_table() {
        assert!(!TableLayout::is_table(
            b"Channels 17, 18 and 20\nhave been reprocessed, all of them\n"
        ));
        assert!(!TableLayout::is_table(b"  1.0  2.0\n 3.0  4.0\n"));
        assert!(TableLayout::is_table(
            b"Time (-),ACC01_z [g]\n2022-11-04 08:36:24.897,4.9e-05\n"
        ));
    }

    #[test]
    fn blanks_are_merged_for_any_size_of_the_pieces() {
        let text = b"  a   b\t c  \r\n   1  2   3";
        for piece in 1..8 {
            let mut pieces: Box<dyn Read> = Box::new(std::io::empty());
            for part in text.chunks(piece) {
                pieces = Box::new(pieces.chain(part));
            }
            let mut read = String::new();
            SingleBlanks::new(pieces).read_to_string(&mut read).unwrap();
            assert_eq!(read, "a b c\r\n1 2 3", "pieces of {piece}");
        }
    }
}
