//! USGS records (SMC): text, integers, reals and comments, and then the numbers of one channel.
//!
//! A file has 11 lines of text, 48 integers (8 fields of 10 characters per line, missing = -32768)
//! and 50 reals (5 fields of 15 characters per line, missing = 1.7e38). Then follow comment lines,
//! whose number is integer 16, and the samples (8 fields of 10 characters per line). Integer 17 is
//! the number of samples, and real 2 is the sampling rate in Hz.
//!
//! The date in the integers is that of the earthquake, to the minute. The file does not state the
//! time of the first sample, so times are relative to the first sample.
//!
//! Source: USGS National Strong-Motion Program, *SMC-format data files* (Converse and Brady 1992,
//! appendix).

use super::text_lines::{NumberColumns, TextLines, text_of};
use crate::fault::Fault;
use crate::recorded::{RecordedChannel, Segment};

const TEXT_LINES: usize = 11;
const INTEGERS: usize = 48;
const REALS: usize = 50;
/// Smallest value that counts as missing. Files contain 1.7e38.
const MISSING_REAL: f64 = 1e38;
const INTEGER_COLUMNS: NumberColumns = NumberColumns {
    per_line: 8,
    width: 10,
};
const REAL_COLUMNS: NumberColumns = NumberColumns {
    per_line: 5,
    width: 15,
};
const SAMPLE_COLUMNS: NumberColumns = NumberColumns {
    per_line: 8,
    width: 10,
};

/// Kinds of time series: number in the first line, name and unit.
const KINDS: [(&str, &str, &str); 4] = [
    ("1", "acceleration", "cm/s2"),
    ("2", "acceleration", "cm/s2"),
    ("3", "velocity", "cm/s"),
    ("4", "displacement", "cm"),
];

/// Returns `true` if the head of a file is that of any kind of SMC file, including spectra.
pub(crate) fn is_smc(head: &str) -> bool {
    let Some(first) = head.lines().next() else {
        return false;
    };
    let Some((kind, words)) = first.trim_start().split_once(' ') else {
        return false;
    };
    let words = words.to_ascii_uppercase();
    let is_named = ["ACCELEROGRAM", "VELOCITY", "DISPLACEMENT", "SPECTR"]
        .iter()
        .any(|name| words.contains(name));
    kind.parse::<u8>().is_ok()
        && is_named
        && head
            .lines()
            .nth(1)
            .is_some_and(|line| line.starts_with('*'))
}

/// Reads the channel of a file.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let text = text_of(bytes);
    let mut lines = TextLines::new(&text);
    let first = lines.line("the kind of file")?.trim();
    let number = first.split_whitespace().next().unwrap_or_default();
    let Some((_, name, unit)) = KINDS.into_iter().find(|(kind, ..)| *kind == number) else {
        let allowed = "a time series: 1 or 2 acceleration, 3 velocity, 4 displacement";
        return Err(Fault::at_line(
            1,
            "kind of file",
            format!("`{first}`"),
            allowed,
        ));
    };
    let mut station = "";
    for _ in 1..TEXT_LINES {
        let line = lines.line("the eleven lines of text")?;
        if let Some(rest) = line.trim_start().strip_prefix("station") {
            station = rest.trim_start_matches([' ', '=']).trim();
        }
    }
    let integers = lines.integers(INTEGER_COLUMNS, INTEGERS, "the integers")?;
    let reals = lines.numbers(REAL_COLUMNS, REALS, "the reals")?;
    let header_line = lines.number();
    let count = |index: usize, what: &str| {
        usize::try_from(integers[index - 1]).map_err(|_| {
            Fault::at_line(
                header_line,
                format!("{what} (integer {index})"),
                integers[index - 1],
                "a number from 0",
            )
        })
    };
    let (comments, samples) = (
        count(16, "number of comment lines")?,
        count(17, "number of samples")?,
    );
    let rate_hz = reals[1];
    if !(rate_hz > 0.0 && rate_hz < MISSING_REAL) {
        return Err(Fault::at_line(
            header_line,
            "sampling rate (real 2)",
            rate_hz,
            "a positive number of Hz",
        ));
    }
    let mut location = None;
    for _ in 0..comments {
        let comment = lines.line("the comment lines")?;
        let label = comment
            .split_once("<loclbl=>")
            .map(|(_, rest)| rest.split("<end>").next().unwrap_or(rest));
        location = location.or(label.map(str::trim));
    }
    let samples = lines.numbers(SAMPLE_COLUMNS, samples, name)?;
    let samples = samples.into_iter().map(|sample| {
        if sample.abs() >= MISSING_REAL {
            f64::NAN
        } else {
            sample
        }
    });

    let channel = RecordedChannel::new(
        name,
        Some(rate_hz),
        vec![Segment::new(0, samples.collect())],
    )
    .with_unit(unit);
    Ok(vec![channel.with_description(location.unwrap_or(station))])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a file with the given first line, eleven samples at 50 Hz and one comment.
    fn file(first: &str) -> String {
        let mut integers = [-32768; INTEGERS];
        for (index, value) in [(16, 1), (17, 11)] {
            integers[index - 1] = value;
        }
        let mut reals = [1.7e38; REALS];
        reals[1] = 50.0;
        let mut text = format!("{first}\n*\n{}", "text\n".repeat(9));
        for line in integers.chunks(8) {
            text += &(line
                .iter()
                .map(|value| format!("{value:>10}"))
                .collect::<String>()
                + "\n");
        }
        for line in reals.chunks(5) {
            text += &(line
                .iter()
                .map(|value| format!("{value:>15.7E}"))
                .collect::<String>()
                + "\n");
        }
        text += "|<loclbl=>roof<end>\n";
        text += &format!(
            "{}\n{}\n",
            "-1.5289E-2".repeat(8),
            " 2.5000E+0-3.5000E+0   1.7E+38"
        );
        text
    }

    #[test]
    fn touching_and_missing_samples_and_location_are_read() {
        let channels = read(file("2 CORRECTED ACCELEROGRAM").as_bytes()).unwrap();
        let channel = &channels[0];
        let samples: Vec<f64> = channel.samples().collect();
        assert_eq!(
            (samples.len(), samples[7], samples[8], samples[9]),
            (11, -1.5289e-2, 2.5, -3.5)
        );
        assert!(samples[10].is_nan(), "1.7e38 is a missing sample");
        assert_eq!(
            (
                channel.sampling_rate_hz(),
                channel.unit(),
                channel.description()
            ),
            (Some(50.0), Some("cm/s2"), Some("roof"))
        );
    }

    #[test]
    fn spectra_are_refused() {
        let told = read(file("6 RESPONSE SPECTRA").as_bytes())
            .unwrap_err()
            .to_string();
        assert!(
            told.starts_with("line 1: kind of file is `6 RESPONSE SPECTRA`, must be a time series"),
            "{told}"
        );
    }

    #[test]
    fn file_cut_anywhere_is_refused() {
        let file = file("2 CORRECTED ACCELEROGRAM");
        for end in 0..file.len() - 1 {
            assert!(read(&file.as_bytes()[..end]).is_err(), "cut at {end}");
        }
    }
}
