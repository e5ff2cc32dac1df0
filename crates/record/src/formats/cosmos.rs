//! COSMOS V0 to V2: a sequence of channels, each with text, integers, reals and comments before its
//! samples.
//!
//! The first line states the number of text lines. The lines before integers, reals, comments and
//! samples state their counts, and their columns as a Fortran format.
//!
//! Integers: 1 processing stage, 2 unit, 40 year, 41 day of the year, 44 hour, 45 minute, 50
//! channel number at the station. Reals: 30 second, 62 time step of these samples (ms), 34 time
//! step of the recorder (s), which may differ.
//!
//! Source: COSMOS, *Strong motion data format v1.20* (2001).

use super::text_lines::{NumberColumns, TextLines, columns_of, text_of};
use crate::fault::Fault;
use crate::rate::rate_from_step;
use crate::record_time::day_of_year_ns;
use crate::recorded::{RecordedChannel, Segment, TimeOrigin};

/// Value of an unknown integer or real.
const UNKNOWN: i64 = -999;

/// Returns `true` if the head of a file is that of a COSMOS file.
pub(crate) fn is_cosmos(head: &str) -> bool {
    let lower = head.lines().next().unwrap_or_default().to_ascii_lowercase();
    lower.contains("(format v") && lower.contains("text lines")
}

/// Reads all channels. Their names are `channel-N.acceleration` and so on, or consist of network,
/// station and component.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let text = text_of(bytes);
    let mut lines = TextLines::new(&text);
    let mut channels = Vec::new();
    while let Some(line) = lines.next() {
        if !line.trim().is_empty() {
            channels.push(read_channel(&mut lines, line, channels.len() + 1)?);
        }
    }
    match channels.is_empty() {
        true => Err(Fault::of_file("number of channels", 0, "at least 1")),
        false => Ok(channels),
    }
}

/// The integers and reals before the samples of a channel.
struct Header {
    integers: Vec<i64>,
    reals: Vec<f64>,
    /// Number of its last line.
    line: u64,
}

impl Header {
    fn read(lines: &mut TextLines<'_>) -> Result<Self, Fault> {
        let (count, columns) = counted(lines, "integer-header values")?;
        let integers = lines.integers(columns, count, "the integers")?;
        let (count, columns) = counted(lines, "real-header values")?;
        let reals = lines.numbers(columns, count, "the reals")?;
        Ok(Self {
            integers,
            reals,
            line: lines.number(),
        })
    }

    /// Returns an integer, counted from 1. `None` if it is unknown.
    fn integer(&self, index: usize) -> Option<i64> {
        let value = self.integers.get(index - 1).copied();
        value.filter(|value| *value != UNKNOWN)
    }

    /// Returns a real, counted from 1. `None` if it is unknown.
    fn real(&self, index: usize) -> Option<f64> {
        let value = self.reals.get(index - 1).copied();
        value.filter(|value| *value != UNKNOWN as f64)
    }

    /// Returns the time step of the samples (s).
    fn step_s(&self) -> Result<f64, Fault> {
        self.real(62)
            .map(|step_ms| step_ms / 1e3)
            .or(self.real(34))
            .filter(|step_s| *step_s > 0.0)
            .ok_or_else(|| {
                let found = self
                    .reals
                    .get(61)
                    .map_or_else(|| "absent".to_owned(), f64::to_string);
                Fault::at_line(
                    self.line,
                    "time step (real 62)",
                    found,
                    "a positive number of milliseconds",
                )
            })
    }

    /// Returns the time of the first sample (ns since the Unix epoch, UTC). `None` if it is
    /// unknown.
    fn start_ns(&self) -> Option<i64> {
        let (year, day) = (self.integer(40)?, self.integer(41)?);
        let (hour, minute) = (self.integer(44)?, self.integer(45)?);
        day_of_year_ns(year, day, hour, minute, self.real(30)?)
    }
}

fn read_channel(
    lines: &mut TextLines<'_>,
    first: &str,
    place: usize,
) -> Result<RecordedChannel, Fault> {
    let description = read_description(lines, first)?;
    let header = Header::read(lines)?;
    let source = read_codes(lines)?;
    let step_s = header.step_s()?;

    let (count, line) = number_before(lines, "pts")?;
    let refused = |what: &str, allowed: &str| {
        Fault::at_line(lines.number(), what, format!("`{}`", line.trim()), allowed)
    };
    let lower = line.to_ascii_lowercase();
    let quantity = ["acceleration", "velocity", "displacement"]
        .into_iter()
        .find(|name| lower.contains(name));
    let quantity =
        quantity.ok_or_else(|| refused("quantity", "acceleration, velocity or displacement"))?;
    let unit = lower
        .split_once("units=")
        .map(|(_, rest)| rest.split(['(', ' ', ',']).next().unwrap_or_default());
    let unit = unit
        .ok_or_else(|| refused("unit", "`units=UNIT`"))?
        .trim_end_matches('.')
        .to_owned();
    let columns =
        format_of(&lower).ok_or_else(|| refused("columns", "`Format=(8F10.5)` or similar"))?;
    let samples = lines.numbers(columns, count, quantity)?;
    read_end(lines)?;

    let number = header.integer(50).filter(|number| *number > 0);
    let name = match (number, source) {
        (Some(number), _) => format!("channel-{number}.{quantity}"),
        (None, Some(codes)) => format!("{codes}.{quantity}"),
        (None, None) => format!("channel-{place}.{quantity}"),
    };
    let start_ns = header.start_ns();
    let origin = if start_ns.is_some() {
        TimeOrigin::Epoch
    } else {
        TimeOrigin::Start
    };
    let segment = Segment::new(start_ns.unwrap_or(0), samples);
    let channel = RecordedChannel::new(name, Some(rate_from_step(step_s)), vec![segment]);
    Ok(channel
        .with_unit(unit)
        .with_description(description)
        .with_origin(origin))
}

/// Reads the lines of text, whose number the first line states. Returns the one that names station
/// and channel.
fn read_description(lines: &mut TextLines<'_>, first: &str) -> Result<String, Fault> {
    let lower = first.to_ascii_lowercase();
    let text_lines: usize = lower
        .split_once("with ")
        .and_then(|(_, rest)| rest.split_whitespace().next()?.parse().ok())
        .filter(|_| lower.contains("(format v"))
        .ok_or_else(|| {
            let allowed = "`(Format vNN.NN with NN text lines)`";
            Fault::at_line(
                lines.number(),
                "first line of a channel",
                format!("`{}`", first.trim()),
                allowed,
            )
        })?;
    let mut description = String::new();
    for _ in 1..text_lines {
        let line = lines.line("the lines of text")?;
        if line.to_ascii_lowercase().starts_with("sta cha") {
            description = line.split_whitespace().collect::<Vec<_>>().join(" ");
        }
    }
    Ok(description)
}

/// Reads the comments. Returns the codes of network, station and component, if there are any.
fn read_codes<'a>(lines: &mut TextLines<'a>) -> Result<Option<&'a str>, Fault> {
    let (comments, _) = number_before(lines, "comment line")?;
    let mut source = None;
    for _ in 0..comments {
        let comment = lines.line("the comment lines")?;
        let codes = comment
            .split_once("<SCNL>")
            .and_then(|(_, rest)| rest.split_whitespace().next());
        source = source.or(codes);
    }
    Ok(source)
}

/// Reads the line after the samples.
fn read_end(lines: &mut TextLines<'_>) -> Result<(), Fault> {
    let end = lines.line("the end of the channel")?;
    if end
        .to_ascii_lowercase()
        .replace('-', " ")
        .contains("end of data")
    {
        return Ok(());
    }
    let allowed = "`End-of-data` after the samples";
    Err(Fault::at_line(
        lines.number(),
        "line",
        format!("`{}`", end.trim()),
        allowed,
    ))
}

/// Reads a line that starts with a number and contains `what`.
fn number_before<'a>(lines: &mut TextLines<'a>, what: &str) -> Result<(usize, &'a str), Fault> {
    let line = lines.line("the header")?;
    let number = line
        .split_whitespace()
        .next()
        .and_then(|number| number.parse().ok());
    let number = number.filter(|_| line.to_ascii_lowercase().contains(what));
    let refused = || {
        Fault::at_line(
            lines.number(),
            "line",
            format!("`{}`", line.trim()),
            format!("a number and `{what}`"),
        )
    };
    Ok((number.ok_or_else(refused)?, line))
}

/// Reads a line that states the number of values and their columns.
fn counted(lines: &mut TextLines<'_>, what: &str) -> Result<(usize, NumberColumns), Fault> {
    let (count, line) = number_before(lines, what)?;
    let refused = || {
        Fault::at_line(
            lines.number(),
            "columns",
            format!("`{}`", line.trim()),
            "`Format= (10I8)` or similar",
        )
    };
    Ok((
        count,
        format_of(&line.to_ascii_lowercase()).ok_or_else(refused)?,
    ))
}

/// Parses the columns of `format= (8f10.5)`.
fn format_of(lower: &str) -> Option<NumberColumns> {
    let format = lower
        .split_once("format=")?
        .1
        .trim_start()
        .strip_prefix('(')?;
    columns_of(format.split(')').next()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(number: i64, unit: &str) -> String {
        let mut integers = [UNKNOWN; 100];
        for (index, value) in [(40, 2018), (41, 241), (44, 2), (45, 33), (50, number)] {
            integers[index - 1] = value;
        }
        let mut reals = [-999.0; 100];
        (reals[29], reals[33], reals[61]) = (4.4, 0.02, 5.0);
        let mut text =
            "Uncorrected acceleration  (Format v01.20 with 4 text lines)\nHill\n".to_owned();
        text += "Sta Chan  1: 360 deg (Rcrdr Chan  1)\n";
        text += "Values used when parameter or data value is unknown/unspecified:   -999, -999.0\n";
        text += " 100 Integer-header values follow on  10 lines, Format= (10I8)\n";
        for line in integers.chunks(10) {
            text += &(line
                .iter()
                .map(|value| format!("{value:>8}"))
                .collect::<String>()
                + "\n");
        }
        text += " 100 Real-header values follow on  17 lines, Format= (6F13.6)\n";
        for line in reals.chunks(6) {
            text += &(line
                .iter()
                .map(|value| format!("{value:>13.6}"))
                .collect::<String>()
                + "\n");
        }
        text += "   1 Comment line(s) follow, each starting with a \"|\":\n\
                 |<SCNL>HILL.HNZ.XX.--   <AUTH> \n";
        text +=
            &format!("   10 acceleration pts, approx  1 secs, units={unit}(02)Format=(8f9.6)\n");
        text += &format!("{}\n  .000001  .000002\n", "-1.000023".repeat(8));
        text += "End-of-data for Chan  1 acceleration\n";
        text
    }

    #[test]
    fn consecutive_channels_are_read() {
        let file = channel(1, "g     ") + &channel(-999, "cm/sec2");
        let channels = read(file.as_bytes()).unwrap();
        assert_eq!(
            (channels[0].name(), channels[1].name()),
            ("channel-1.acceleration", "HILL.HNZ.XX.--.acceleration")
        );
        assert_eq!(
            (channels[0].unit(), channels[1].unit()),
            (Some("g"), Some("cm/sec2"))
        );
        assert_eq!(
            channels[0].samples().collect::<Vec<_>>()[7..],
            [-1.000023, 1e-6, 2e-6]
        );
        assert_eq!(channels[0].sampling_rate_hz(), Some(200.0));
        // Source: `date -u -d '2018-08-29T02:33:04Z' +%s`
        assert_eq!(channels[0].start_ns(), Some(1_535_509_984_400_000_000));
    }

    #[test]
    fn file_cut_anywhere_is_refused_or_lacks_whole_channels() {
        let one = channel(1, "g").len();
        let file = channel(1, "g") + &channel(2, "g");
        for end in 0..file.len() {
            let cut = &file[..end];
            match read(cut.as_bytes()) {
                Ok(channels) if channels.len() == 1 => {
                    assert!(end + 30 > one && end <= one + 1, "cut at {end}")
                }
                Ok(_) => assert!(end + 30 > file.len(), "cut at {end}"),
                Err(_) => assert!(end < file.len() - 20, "cut at {end}"),
            }
        }
    }

    #[test]
    fn unknown_time_step_is_rejected() {
        let file = channel(1, "g")
            .replace("     0.020000", "     0.000000")
            .replace("     5.000000", "  -999.000000");
        let told = read(file.as_bytes()).unwrap_err().to_string();
        assert!(
            told.contains("time step (real 62) is -999, must be a positive number of milliseconds"),
            "{told}"
        );
    }
}
