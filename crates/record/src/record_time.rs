//! Times in files to nanoseconds and back.
//!
//! Seconds are read as decimal digits, not through `f64`: seconds since 1970 in `f64` are known to 0.24 µs only.

use std::fmt::Write as _;

use jiff::{Timestamp, civil::DateTime, tz::TimeZone};

const NANOSECONDS_PER_SECOND: i64 = 1_000_000_000;
/// Digits after the point that a nanosecond needs.
const FRACTION_DIGITS: usize = 9;

/// The form of the times of one file; a file does not mix them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TimeForm {
    Seconds,
    Iso8601,
}

impl TimeForm {
    /// The form of the first time of a file.
    pub(crate) fn of(text: &str) -> Option<Self> {
        if seconds_to_ns(text).is_some() {
            return Some(Self::Seconds);
        }
        iso_8601_to_ns(text).map(|_| Self::Iso8601)
    }

    /// Reads a time of this form in ns.
    pub(crate) fn parse_ns(self, text: &str) -> Option<i64> {
        match self {
            Self::Seconds => seconds_to_ns(text),
            Self::Iso8601 => iso_8601_to_ns(text),
        }
    }

    /// The form in words.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Seconds => "in seconds as the first time of the file",
            Self::Iso8601 => "in ISO 8601 as the first time of the file",
        }
    }
}

/// Reads seconds as nanoseconds: round(seconds × 10⁹), half away from zero; `None` if it is no number or out of range.
fn seconds_to_ns(text: &str) -> Option<i64> {
    let (sign, digits) = match text.strip_prefix('-') {
        Some(rest) => (-1, rest),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    if digits.contains(['e', 'E']) {
        return exponent_seconds_to_ns(text);
    }
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let is_number = !(whole.is_empty() && fraction.is_empty())
        && whole.bytes().chain(fraction.bytes()).all(|byte| byte.is_ascii_digit());
    if !is_number {
        return None;
    }
    let whole_s: i64 = if whole.is_empty() { 0 } else { whole.parse().ok()? };
    let mut nanoseconds = 0;
    for place in 0..FRACTION_DIGITS {
        let digit = fraction.as_bytes().get(place).map_or(0, |byte| i64::from(byte - b'0'));
        nanoseconds = nanoseconds * 10 + digit;
    }
    let rounds_up = fraction.as_bytes().get(FRACTION_DIGITS).is_some_and(|byte| *byte >= b'5');
    let magnitude = whole_s.checked_mul(NANOSECONDS_PER_SECOND)?.checked_add(nanoseconds + i64::from(rounds_up))?;
    Some(sign * magnitude)
}

/// Reads seconds with an exponent, as programs print very small times, through `f64`.
fn exponent_seconds_to_ns(text: &str) -> Option<i64> {
    let nanoseconds = (text.parse::<f64>().ok()? * NANOSECONDS_PER_SECOND as f64).round();
    let is_in_range = nanoseconds.abs() < i64::MAX as f64;
    is_in_range.then_some(nanoseconds as i64)
}

/// Reads ISO 8601 as nanoseconds since 1970; without an offset from UTC it is taken as UTC.
fn iso_8601_to_ns(text: &str) -> Option<i64> {
    let timestamp = match text.parse::<Timestamp>() {
        Ok(timestamp) => timestamp,
        Err(_) => text.parse::<DateTime>().ok()?.to_zoned(TimeZone::UTC).ok()?.timestamp(),
    };
    i64::try_from(timestamp.as_nanosecond()).ok()
}

/// Writes `time_ns` in seconds with as many digits as it needs, so that it reads back as the same nanosecond.
///
/// ```
/// let mut text = String::new();
/// spandrel_record::record_time::write_seconds(8_333_333, &mut text);
/// assert_eq!(text, "0.008333333");
/// ```
pub fn write_seconds(time_ns: i64, text: &mut String) {
    let magnitude = time_ns.unsigned_abs();
    let sign = if time_ns < 0 { "-" } else { "" };
    let whole = magnitude / NANOSECONDS_PER_SECOND.unsigned_abs();
    let fraction = magnitude % NANOSECONDS_PER_SECOND.unsigned_abs();
    let _ = write!(text, "{sign}{whole}"); // writing to a String does not fail
    if fraction > 0 {
        let _ = write!(text, ".{fraction:09}");
        text.truncate(text.trim_end_matches('0').len());
    }
}

/// `time_ns` in seconds as decimal text.
pub(crate) fn seconds_text(time_ns: i64) -> String {
    let mut text = String::new();
    write_seconds(time_ns, &mut text);
    text
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn seconds_are_rounded_to_the_nearest_nanosecond() {
        for (text, expected) in [
            ("0", 0),
            ("0.008333", 8_333_000),
            ("-1.5", -1_500_000_000),
            (".25", 250_000_000),
            ("3.", 3_000_000_000),
            ("+2", 2_000_000_000),
            ("0.0000000014", 1),
            ("0.0000000015", 2),
            ("-0.0000000015", -2),
            ("1.2e-3", 1_200_000),
            ("1700000000.123456789", 1_700_000_000_123_456_789),
        ] {
            assert_eq!(seconds_to_ns(text), Some(expected), "{text}");
        }
    }

    #[test]
    fn no_number_gives_no_seconds() {
        for text in ["", "-", ".", "1.2.3", "12x", "nan", "inf", "1e400", "99999999999", "0x10", "1 2", "--1"] {
            assert_eq!(seconds_to_ns(text), None, "{text}");
        }
    }

    #[test]
    fn iso_8601_keeps_nanoseconds_and_offset() {
        // 2024-02-29T12:00:00Z is 1709208000 s (date -u -d @1709208000).
        for text in ["2024-02-29T12:00:00.000000001Z", "2024-02-29T13:00:00.000000001+01:00"] {
            assert_eq!(iso_8601_to_ns(text), Some(1_709_208_000_000_000_001), "{text}");
        }
    }

    #[test]
    fn iso_8601_without_offset_is_utc() {
        assert_eq!(iso_8601_to_ns("2024-02-29T12:00:00"), Some(1_709_208_000_000_000_000));
        assert_eq!(iso_8601_to_ns("2024-02-29 12:00:00.5"), Some(1_709_208_000_500_000_000));
    }

    proptest! {
        #[test]
        fn time_written_reads_back_as_the_same_nanosecond(time_ns in -i64::MAX..i64::MAX) {
            prop_assert_eq!(seconds_to_ns(&seconds_text(time_ns)), Some(time_ns));
        }

        #[test]
        fn decimal_reading_equals_rounded_product(milliseconds in 0_i64..10_000_000, digits in 3_usize..7) {
            let seconds = milliseconds as f64 / 1e3;
            let text = format!("{seconds:.digits$}");
            prop_assert_eq!(seconds_to_ns(&text), Some((seconds * 1e9).round() as i64));
        }

        #[test]
        fn any_text_is_read_or_refused(text in ".*") {
            let _ = TimeForm::of(&text);
        }
    }
}
