//! Universal file format, datasets 58 and 58b: functions at nodal degrees of freedom. Only time
//! responses are read.
//!
//! A dataset is enclosed by two lines `    -1`. Its first line is the dataset number. For binary
//! data, this line also contains `b` and the number of bytes. Eleven lines of text follow:
//!
//! - 1 to 5: identification (3 is the date)
//! - 6: function type and degrees of freedom
//! - 7: data type, number of values, spacing, first abscissa and increment
//! - 8 to 11: axes with type, label and unit
//!
//! Text data have fields of 13 characters in single precision, and 20 in double precision.
//!
//! Source: University of Cincinnati, Structural Dynamics Research Laboratory, *Universal file
//! formats*, number 58.

use super::text_lines::{NumberColumns, TextLines, decimal};
use crate::bytes::{ByteOrder, Bytes, text};
use crate::fault::Fault;
use crate::rate::rate_from_step;
use crate::record_time::civil_ns;
use crate::recorded::{RecordedChannel, Segment, TimeOrigin};

const HEADER_LINES: usize = 11;
/// Function type of a time response. Type 0 is a general function, which is a time response if its
/// abscissa is time.
const TIME_RESPONSE: i64 = 1;
/// Axis type of time.
const TIME_AXIS: i64 = 17;
const MONTHS: [&str; 12] = [
    "jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec",
];

/// Returns `true` if a file begins like a universal file.
pub(crate) fn is_uff(head: &str) -> bool {
    let mut lines = head
        .lines()
        .map(str::trim_end)
        .skip_while(|line| line.is_empty());
    lines.next().is_some_and(|line| line.trim() == "-1")
        && lines.next().is_some_and(|line| {
            line.trim_start()
                .starts_with(|first: char| first.is_ascii_digit())
        })
}

/// Reads all time responses. Skips other datasets and functions of other types, but fails if there
/// is no time response.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let mut file = Bytes::new(bytes, ByteOrder::Little);
    let mut channels: Vec<RecordedChannel> = Vec::new();
    let mut left_out = Vec::new();
    while let Some(line) = next_line(&mut file) {
        if line.trim().is_empty() {
            continue;
        }
        if line.trim() != "-1" {
            return Err(Fault::at_byte(
                file.position(),
                "line between datasets",
                format!("`{}`", line.trim()),
                "`    -1`",
            ));
        }
        let Some(number) = next_line(&mut file) else {
            break;
        };
        match number.split_whitespace().next() {
            Some("58") => read_dataset(&mut file, None, &mut channels, &mut left_out)?,
            Some("58b") => {
                let binary = Binary::of(&number, &file)?;
                read_dataset(&mut file, Some(binary), &mut channels, &mut left_out)?;
            }
            Some(other) if other.parse::<u32>().is_ok() => {
                left_out.push(format!("dataset {other}"));
                skip_dataset(&mut file)?;
            }
            Some(_) | None => {
                let found = format!("`{}`", number.trim());
                return Err(Fault::at_byte(
                    file.position(),
                    "number of a dataset",
                    found,
                    "a number, or 58b",
                ));
            }
        }
    }
    match channels.is_empty() {
        true => Err(Fault::of_file(
            "content",
            left_out.join(", "),
            "a time response in a dataset 58 or 58b",
        )),
        false => Ok(channels),
    }
}

/// The format of the numbers in a binary dataset.
#[derive(Debug, Clone, Copy)]
struct Binary {
    order: ByteOrder,
    bytes: usize,
}

impl Binary {
    /// Parses the first line: `58b`, byte order, floating-point format, number of text lines, and
    /// number of bytes after them.
    fn of(line: &str, file: &Bytes<'_>) -> Result<Self, Fault> {
        let refused = |what: &str, allowed: &str| {
            Fault::at_byte(file.position(), what, format!("`{}`", line.trim()), allowed)
        };
        let mut words = line
            .split_whitespace()
            .skip(1)
            .map(|word| word.parse::<usize>().ok());
        let order = match words.next().flatten() {
            Some(1) => ByteOrder::Little,
            Some(2) => ByteOrder::Big,
            _ => return Err(refused("byte order", "1 (little endian) or 2 (big endian)")),
        };
        if words.next().flatten() != Some(2) {
            return Err(refused("kind of floating point numbers", "2 (IEEE 754)"));
        }
        let bytes = words
            .nth(1)
            .flatten()
            .ok_or_else(|| refused("number of bytes", "a number"))?;
        Ok(Self { order, bytes })
    }
}

/// The content of the eleven header lines.
#[derive(Debug, Clone)]
struct Header {
    name: String,
    description: String,
    start_ns: Option<i64>,
    function: i64,
    data: i64,
    count: usize,
    is_even: bool,
    first_s: f64,
    step_s: f64,
    abscissa: i64,
    unit: String,
}

/// The precision of numbers, which determines their bytes or columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Precision {
    Single,
    Double,
}

fn read_dataset(
    file: &mut Bytes<'_>,
    binary: Option<Binary>,
    channels: &mut Vec<RecordedChannel>,
    left_out: &mut Vec<String>,
) -> Result<(), Fault> {
    let start = file.position();
    let header = Header::read(file)?;
    let is_time =
        header.function == TIME_RESPONSE || (header.function == 0 && header.abscissa == TIME_AXIS);
    if !is_time {
        left_out.push(format!("function of type {}", header.function));
        if let Some(binary) = binary {
            file.take(binary.bytes)?;
        }
        return skip_dataset(file);
    }
    let precision = match header.data {
        2 => Precision::Single,
        4 => Precision::Double,
        other => {
            let allowed = "2 (real, single precision) or 4 (real, double precision)";
            return Err(Fault::at_byte(
                start,
                "data type of a time response",
                other,
                allowed,
            ));
        }
    };
    let (abscissae, samples) = match binary {
        Some(binary) => binary_samples(file, binary, precision, &header)?,
        None => text_samples(file, precision, &header)?,
    };
    end_of_dataset(file)?;
    let mut name = header.name.clone();
    let same = channels
        .iter()
        .filter(|channel| channel.name().split('#').next() == Some(&header.name))
        .count();
    if same > 0 {
        name += &format!("#{}", same + 1);
    }
    let channel = header.channel(name, start, &abscissae, samples)?;
    let origin = if header.start_ns.is_some() {
        TimeOrigin::Epoch
    } else {
        TimeOrigin::Start
    };
    channels.push(
        channel
            .with_unit(header.unit)
            .with_description(header.description)
            .with_origin(origin),
    );
    Ok(())
}

impl Header {
    /// Returns the samples with their rate or their own times. `start` is the position of the
    /// dataset.
    fn channel(
        &self,
        name: String,
        start: usize,
        abscissae: &[f64],
        samples: Vec<f64>,
    ) -> Result<RecordedChannel, Fault> {
        let seconds_ns = |seconds: f64| (seconds * 1e9).round() as i64;
        let start_ns = self.start_ns.unwrap_or(0);
        match self.is_even {
            true => {
                let first_ns = start_ns.saturating_add(seconds_ns(self.first_s));
                Ok(RecordedChannel::new(
                    name,
                    Some(rate_from_step(self.step_s)),
                    vec![Segment::new(first_ns, samples)],
                ))
            }
            false => {
                let times_ns: Vec<i64> = abscissae
                    .iter()
                    .map(|time_s| start_ns.saturating_add(seconds_ns(*time_s)))
                    .collect();
                if let Some(index) = times_ns.windows(2).position(|pair| pair[1] <= pair[0]) {
                    let found = format!("{} s after {} s", abscissae[index + 1], abscissae[index]);
                    return Err(Fault::at_byte(
                        start,
                        "abscissa",
                        found,
                        "later than the previous one",
                    ));
                }
                Ok(RecordedChannel::from_times(name, None, &times_ns, &samples))
            }
        }
    }

    fn read(file: &mut Bytes<'_>) -> Result<Self, Fault> {
        let mut lines = Vec::new();
        let mut starts = Vec::new();
        for number in 1..=HEADER_LINES {
            starts.push(file.position());
            lines.push(next_line(file).ok_or_else(|| {
                Fault::at_byte(
                    file.position(),
                    "end of the file",
                    "here",
                    format!("after line {number} of 11 of the header"),
                )
            })?);
        }
        let refused = |line: usize, what: &str, allowed: &str| {
            Fault::at_byte(
                starts[line - 1],
                what,
                format!("`{}`", lines[line - 1].trim_end()),
                allowed,
            )
        };
        let words = |line: usize| lines[line - 1].split_whitespace();
        let whole = |word: Option<&str>| word.and_then(|word| word.parse::<i64>().ok());

        let function =
            whole(words(6).next()).ok_or_else(|| refused(6, "function type", "a number"))?;
        let mut numbers = words(7);
        let (data, count, spacing) = (
            whole(numbers.next()),
            whole(numbers.next()),
            whole(numbers.next()),
        );
        let count = count.and_then(|count| usize::try_from(count).ok());
        let Some(((data, count), spacing)) = data.zip(count).zip(spacing) else {
            return Err(refused(
                7,
                "data type, number of values and spacing",
                "three whole numbers",
            ));
        };
        let first_s = numbers.next().and_then(decimal);
        let step_s = numbers.next().and_then(decimal);
        let (Some(first_s), Some(step_s)) = (first_s, step_s) else {
            return Err(refused(
                7,
                "first abscissa and increment",
                "two numbers of seconds",
            ));
        };
        let is_even = spacing == 1;
        if is_even && step_s <= 0.0 {
            return Err(refused(
                7,
                "increment of the abscissa",
                "a positive number of seconds",
            ));
        }
        let abscissa =
            whole(words(8).next()).ok_or_else(|| refused(8, "type of the abscissa", "a number"))?;
        let (label, unit) = axis(&lines[8]);
        Ok(Self {
            name: name_of(&lines[5], label.as_deref(), &lines[0]),
            description: stated(&lines[1]).unwrap_or_default(),
            start_ns: start_ns(&lines[2]),
            function,
            data,
            count,
            is_even,
            first_s,
            step_s,
            abscissa,
            unit: unit.unwrap_or_default(),
        })
    }
}

/// Returns the trimmed text, or `None` if it is blank or `NONE`.
fn stated(field: &str) -> Option<String> {
    Some(field.trim())
        .filter(|field| !field.is_empty() && *field != "NONE")
        .map(str::to_owned)
}

/// Returns the characters `from` to `to` of a line. Label and unit may contain non-ASCII
/// characters.
fn characters(line: &str, from: usize, to: usize) -> String {
    line.chars().skip(from).take(to - from).collect()
}

/// Parses label and unit of an axis line: `I10,3I5,2(1X,20A1)`.
fn axis(line: &str) -> (Option<String>, Option<String>) {
    (
        stated(&characters(line, 26, 46)),
        stated(&characters(line, 47, 67)),
    )
}

/// Returns a name from the response: entity, node and direction. Otherwise returns the label of the
/// ordinate, or the first header line.
fn name_of(degrees_of_freedom: &str, label: Option<&str>, first: &str) -> String {
    // Fortran format: 2(I5,I10),2(1X,10A1,I10,I4)
    let entity = stated(&characters(degrees_of_freedom, 31, 41));
    let node = characters(degrees_of_freedom, 41, 51)
        .trim()
        .parse::<i64>()
        .ok()
        .filter(|node| *node != 0);
    let direction = characters(degrees_of_freedom, 51, 55)
        .trim()
        .parse::<i64>()
        .ok()
        .unwrap_or(0);
    let axis = match direction.unsigned_abs() {
        1 => "x",
        2 => "y",
        3 => "z",
        4 => "rx",
        5 => "ry",
        6 => "rz",
        _ => "",
    };
    let sign = if direction < 0 { "-" } else { "" };
    let place = node.map(|node| match axis {
        "" => format!("{node}"),
        axis => format!("{node}.{sign}{axis}"),
    });
    match (entity, place) {
        (Some(entity), Some(place)) => format!("{entity}.{place}"),
        (Some(entity), None) => entity,
        (None, Some(place)) => place,
        (None, None) => label
            .map(str::to_owned)
            .or_else(|| stated(first))
            .unwrap_or_else(|| "function".to_owned()),
    }
}

/// Parses `18-Apr-16 13:49:58`, assumed to be UTC.
fn start_ns(line: &str) -> Option<i64> {
    let (date, time) = line.trim().split_once(' ')?;
    let mut date = date.split('-');
    let day = date.next()?.trim().parse().ok()?;
    let month = date.next()?.to_ascii_lowercase();
    let month = MONTHS.iter().position(|name| *name == month)? as i64 + 1;
    let year: i64 = date.next()?.trim().parse().ok()?;
    let year = match year {
        0..70 => 2000 + year,
        70..100 => 1900 + year,
        _ => year,
    };
    let mut time = time.trim().split(':');
    civil_ns(
        year,
        month,
        day,
        time.next()?.parse().ok()?,
        time.next()?.parse().ok()?,
        decimal(time.next()?)?,
    )
}

/// Abscissae, if the file contains them, and samples.
type Values = (Vec<f64>, Vec<f64>);

fn binary_samples(
    file: &mut Bytes<'_>,
    binary: Binary,
    precision: Precision,
    header: &Header,
) -> Result<Values, Fault> {
    let start = file.position();
    let mut data = Bytes::new(file.take(binary.bytes)?, binary.order);
    let (mut abscissae, mut samples) = (Vec::new(), Vec::new());
    for _ in 0..header.count {
        let value = |data: &mut Bytes<'_>| match precision {
            Precision::Single => data.f32().map(f64::from),
            Precision::Double => data.f64(),
        };
        if !header.is_even {
            // Abscissae have single precision, regardless of the ordinates.
            abscissae.push(f64::from(
                data.f32().map_err(|fault| fault.moved_by(start))?,
            ));
        }
        let sample = value(&mut data).map_err(|fault| fault.moved_by(start))?;
        samples.push(if sample.is_finite() { sample } else { f64::NAN });
    }
    Ok((abscissae, samples))
}

fn text_samples(
    file: &mut Bytes<'_>,
    precision: Precision,
    header: &Header,
) -> Result<Values, Fault> {
    let start = file.position();
    let mut numbers = Vec::new();
    let per_value = if header.is_even { 1 } else { 2 };
    let count = header.count.saturating_mul(per_value);
    // E13.5: six per line; E20.12: four per line; pairs of E13.5: three per line; pairs of E13.5
    // and E20.12: two per line.
    let (widths, per_line): (&[usize], usize) = match (precision, header.is_even) {
        (Precision::Single, true) => (&[13], 6),
        (Precision::Double, true) => (&[20], 4),
        (Precision::Single, false) => (&[13], 6),
        (Precision::Double, false) => (&[13, 20], 4),
    };
    while numbers.len() < count {
        let at = file.position();
        let expected = per_line.min(count - numbers.len());
        let line = next_line(file).ok_or_else(|| {
            let found = format!("{} to the end of the file", numbers.len());
            Fault::at_byte(start, "number of values", found, count.to_string())
        })?;
        let read = numbers_of_line(&line, widths, expected);
        let refused = || {
            let allowed = format!("{expected} numbers, {} wide", widths[widths.len() - 1]);
            Fault::at_byte(
                at,
                "line of values",
                format!("`{}`", line.trim_end()),
                allowed,
            )
        };
        numbers.extend(read.ok_or_else(refused)?);
    }
    match header.is_even {
        true => Ok((Vec::new(), numbers)),
        false => Ok(numbers
            .chunks_exact(2)
            .map(|pair| (pair[0], pair[1]))
            .unzip()),
    }
}

/// Parses the numbers of a line by blanks, or by widths if there are no blanks between them.
fn numbers_of_line(line: &str, widths: &[usize], expected: usize) -> Option<Vec<f64>> {
    if let [width] = widths {
        let columns = NumberColumns {
            per_line: expected,
            width: *width,
        };
        return TextLines::new(&format!("{line}\n"))
            .numbers(columns, expected, "values")
            .ok();
    }
    let apart: Option<Vec<f64>> = line.split_whitespace().map(decimal).collect();
    apart
        .filter(|numbers| numbers.len() == expected)
        .or_else(|| {
            let mut rest = line.trim_end();
            let mut numbers = Vec::new();
            for width in widths.iter().cycle().take(expected) {
                let (field, after) = rest.split_at_checked((*width).min(rest.len()))?;
                numbers.push(decimal(field.trim())?);
                rest = after;
            }
            Some(numbers)
        })
}

/// Reads the line after the data, which must end the dataset.
fn end_of_dataset(file: &mut Bytes<'_>) -> Result<(), Fault> {
    loop {
        let at = file.position();
        match next_line(file) {
            Some(line) if line.trim().is_empty() => {}
            Some(line) if line.trim() == "-1" => return Ok(()),
            Some(line) => {
                let found = format!("`{}`", line.trim_end());
                return Err(Fault::at_byte(
                    at,
                    "line after the values",
                    found,
                    "`    -1`",
                ));
            }
            None => {
                return Err(Fault::at_byte(
                    at,
                    "end of the file",
                    "here",
                    "after the line `    -1` that ends the dataset",
                ));
            }
        }
    }
}

/// Skips the rest of a dataset, including the line that ends it.
fn skip_dataset(file: &mut Bytes<'_>) -> Result<(), Fault> {
    while let Some(line) = next_line(file) {
        if line.trim() == "-1" {
            return Ok(());
        }
    }
    Err(Fault::at_byte(
        file.position(),
        "end of the file",
        "here",
        "after the line `    -1` that ends the dataset",
    ))
}

/// Returns the next line as text, without its ending. Binary data may follow it.
fn next_line(file: &mut Bytes<'_>) -> Option<String> {
    if file.is_at_end() {
        return None;
    }
    let rest = file.clone().take(file.left()).ok()?;
    let length = rest
        .iter()
        .position(|byte| *byte == b'\n')
        .map_or(rest.len(), |newline| newline + 1);
    let line = file.take(length).ok()?;
    // Only the end of the line is trimmed, because columns count from its start.
    let end = line
        .iter()
        .rposition(|byte| !byte.is_ascii_whitespace())
        .map_or(0, |last| last + 1);
    let indent = line[..end]
        .iter()
        .position(|byte| !byte.is_ascii_whitespace())
        .unwrap_or(0);
    Some(" ".repeat(indent) + &text(&line[indent..end]))
}

#[cfg(test)]
mod tests;
