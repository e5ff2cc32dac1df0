//! Lines of text with numbers in fixed-width columns, as Fortran programs write them.

use std::borrow::Cow;

use crate::fault::Fault;

/// Decodes a file as UTF-8, or as Latin-1 if it is not valid UTF-8.
pub(crate) fn text_of(bytes: &[u8]) -> Cow<'_, str> {
    match std::str::from_utf8(bytes) {
        Ok(text) => Cow::Borrowed(text),
        Err(_) => Cow::Owned(bytes.iter().map(|byte| char::from(*byte)).collect()),
    }
}

/// An iterator over lines without line endings, numbered from 1.
#[derive(Debug, Clone)]
pub(crate) struct TextLines<'a> {
    rest: std::str::Lines<'a>,
    number: u64,
    /// Whether the last line has a line ending. Otherwise it may be truncated within a number.
    is_ended: bool,
}

/// The column layout of numbers: fields per line, and characters per field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct NumberColumns {
    pub(crate) per_line: usize,
    pub(crate) width: usize,
}

impl<'a> TextLines<'a> {
    pub(crate) fn new(text: &'a str) -> Self {
        Self {
            rest: text.lines(),
            number: 0,
            is_ended: text.ends_with('\n'),
        }
    }

    /// Returns the number of the line read last.
    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    /// Returns the next line, or a fault at the end of the file.
    pub(crate) fn line(&mut self, what: &str) -> Result<&'a str, Fault> {
        self.next().ok_or_else(|| {
            Fault::at_line(
                self.number,
                "end of the file",
                "here",
                format!("after {what}"),
            )
        })
    }

    /// Reads `count` decimal numbers. Every line except the last must be full.
    pub(crate) fn numbers(
        &mut self,
        columns: NumberColumns,
        count: usize,
        what: &str,
    ) -> Result<Vec<f64>, Fault> {
        self.values(columns, count, what, decimals)
    }

    /// Reads `count` integers. There may be no blanks between them: `36012069` can be two integers.
    pub(crate) fn integers(
        &mut self,
        columns: NumberColumns,
        count: usize,
        what: &str,
    ) -> Result<Vec<i64>, Fault> {
        self.values(columns, count, what, |line, width| {
            fields(line, width)?
                .into_iter()
                .map(|field| field.parse().ok())
                .collect()
        })
    }

    fn values<T>(
        &mut self,
        columns: NumberColumns,
        count: usize,
        what: &str,
        parse: impl Fn(&str, usize) -> Option<Vec<T>>,
    ) -> Result<Vec<T>, Fault> {
        // The memory grows with the actual content, not with the count in the header.
        let mut values = Vec::new();
        while values.len() < count {
            let Some(line) = self.next() else {
                let found = format!("{} to the end of the file", values.len());
                return Err(Fault::at_line(
                    self.number,
                    format!("number of values of {what}"),
                    found,
                    count.to_string(),
                ));
            };
            let expected = columns.per_line.min(count - values.len());
            let allowed = || format!("{expected} numbers {} wide", columns.width);
            let Some(read) = parse(line, columns.width) else {
                return Err(Fault::at_line(
                    self.number,
                    what,
                    format!("`{}`", line.trim_end()),
                    allowed(),
                ));
            };
            let is_last = self.rest.clone().next().is_none();
            if is_last && !self.is_ended && line.len() % columns.width != 0 {
                let found = format!("cut off after `{}`", line.trim_end());
                return Err(Fault::at_line(
                    self.number,
                    what,
                    found,
                    "a complete last line",
                ));
            }
            if read.len() != expected {
                return Err(Fault::at_line(
                    self.number,
                    what,
                    format!("{} numbers", read.len()),
                    allowed(),
                ));
            }
            values.extend(read);
        }
        Ok(values)
    }
}

impl<'a> Iterator for TextLines<'a> {
    type Item = &'a str;

    fn next(&mut self) -> Option<&'a str> {
        let line = self.rest.next()?;
        self.number += 1;
        Some(line)
    }
}

/// Parses the decimal numbers of a line. Numbers with blanks between them may have any width.
/// Otherwise, as in `-1.5E-2-2.1E-2`, the line is cut into fields of `width` characters.
fn decimals(line: &str, width: usize) -> Option<Vec<f64>> {
    let apart: Option<Vec<f64>> = line.split_whitespace().map(decimal).collect();
    apart.or_else(|| fields(line, width)?.into_iter().map(decimal).collect())
}

/// Cuts a line into fields. Only trailing fields may be blank.
fn fields(line: &str, width: usize) -> Option<Vec<&str>> {
    let line = line.trim_end();
    if !line.is_ascii() || width == 0 {
        return None;
    }
    let cut = |start: usize| {
        line.get(start..(start + width).min(line.len()))
            .map(str::trim)
    };
    (0..line.len())
        .step_by(width)
        .map(cut)
        .map(|field| field.filter(|field| !field.is_empty()))
        .collect()
}

/// Parses a number in Fortran notation. The exponent may begin with D.
pub(crate) fn decimal(text: &str) -> Option<f64> {
    let number = match text.contains(['D', 'd']) {
        true => text.replace(['D', 'd'], "E").parse().ok(),
        false => text.parse::<f64>().ok(),
    };
    number.filter(|number| number.is_finite())
}

/// Parses columns from a Fortran format: `8f10.5`, `1E15.6`, `1P5E15.7`.
pub(crate) fn columns_of(format: &str) -> Option<NumberColumns> {
    let format = format.trim().to_ascii_lowercase();
    let format = match format.split_once('p') {
        Some((scale, rest)) if scale.bytes().all(|byte| byte.is_ascii_digit()) => {
            rest.trim_start_matches(',')
        }
        _ => format.as_str(),
    };
    let (count, rest) = format.split_once(|symbol: char| symbol.is_ascii_alphabetic())?;
    let per_line = if count.is_empty() {
        1
    } else {
        count.trim().parse().ok()?
    };
    let width = rest.split('.').next()?.trim().parse().ok()?;
    (per_line > 0 && width > 0).then_some(NumberColumns { per_line, width })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn touching_numbers_are_cut_at_their_width() {
        let mut lines = TextLines::new("-1.5289E-2 2.1143E-2\n 2.2332E-2-3.7283E-3\n");
        let columns = NumberColumns {
            per_line: 2,
            width: 10,
        };
        let numbers = lines.numbers(columns, 4, "acceleration").unwrap();
        assert_eq!(numbers, [-1.5289e-2, 2.1143e-2, 2.2332e-2, -3.7283e-3]);
    }

    #[test]
    fn separated_numbers_need_no_width() {
        let columns = NumberColumns {
            per_line: 3,
            width: 10,
        };
        assert_eq!(
            TextLines::new("1.5 2.5 -3\n")
                .numbers(columns, 3, "x")
                .unwrap(),
            [1.5, 2.5, -3.0]
        );
    }

    #[test]
    fn touching_integers_are_cut_at_their_width() {
        let columns = NumberColumns {
            per_line: 3,
            width: 5,
        };
        assert_eq!(
            TextLines::new("    736012   -1\n")
                .integers(columns, 3, "x")
                .unwrap(),
            [7, 36012, -1]
        );
    }

    #[test]
    fn error_names_the_line_of_missing_or_unreadable_values() {
        let columns = NumberColumns {
            per_line: 2,
            width: 6,
        };
        let told = |text: &str| {
            TextLines::new(text)
                .numbers(columns, 4, "velocity")
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            told("1.0 2.0\n3.0\n"),
            "line 2: velocity is 1 numbers, must be 2 numbers 6 wide"
        );
        assert_eq!(
            told("1.0 2.0\n******   4.0\n"),
            "line 2: velocity is `******   4.0`, must be 2 numbers 6 wide"
        );
        assert_eq!(
            told("1.0   2.0\n3.0   4."),
            "line 2: velocity is cut off after `3.0   4.`, must be a complete last line"
        );
        assert_eq!(
            told("1.0 2.0\n"),
            "line 1: number of values of velocity is 2 to the end of the file, must be 4"
        );
    }

    #[test]
    fn fortran_formats_give_columns() {
        let columns = |per_line, width| Some(NumberColumns { per_line, width });
        assert_eq!(columns_of("8f10.5"), columns(8, 10));
        assert_eq!(columns_of("1E15.6"), columns(1, 15));
        assert_eq!(columns_of("1P5E15.7"), columns(5, 15));
        assert_eq!(columns_of("10I8"), columns(10, 8));
        for wrong in ["", "8", "f", "0f8.1", "8f0"] {
            assert_eq!(columns_of(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn nan_infinity_and_overflow_are_not_parsed() {
        for wrong in ["nan", "inf", "1e400", "", "1.2.3"] {
            assert_eq!(decimal(wrong), None, "{wrong}");
        }
        assert_eq!(decimal("1.5D+02"), Some(150.0));
    }
}
