//! Converts times in files to nanoseconds and back.
//!
//! Seconds are parsed as decimal digits, not as `f64`. An `f64` resolves seconds since 1970 only to
//! 0.24 µs.

use std::fmt::Write as _;

use jiff::{Timestamp, civil::DateTime, tz::TimeZone};

use crate::TimeUnit;

const NANOSECONDS_PER_SECOND: i64 = 1_000_000_000;

/// The form of the times in a file. All times of a file have the same form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TimeForm {
    /// A number in the unit of the mapping.
    Seconds,
    /// A number since 1970 in another unit than seconds, which its size reveals.
    Since1970(TimeUnit),
    Iso8601,
    /// `DD.MM.YYYY`, `DD.MM.YYYY HH:MM` or `DD.MM.YYYY HH:MM:SS`, UTC.
    DayMonthYear,
    /// The same with `YYYY/MM/DD`.
    YearMonthDay,
}

/// The years in which a number since 1970 reveals its unit: 2000 to 2100 (ns since 1970).
const REVEALING_NS: std::ops::Range<i64> = 946_684_800_000_000_000..4_102_444_800_000_000_000;

impl TimeForm {
    /// Returns the form of the first time in a file.
    pub(crate) fn of(text: &str) -> Option<Self> {
        if seconds_to_ns(text).is_some() {
            return Some(Self::Seconds);
        }
        // As seconds, such a number would be after the year 2262. The ranges of the units do not
        // overlap.
        let reveals = |unit: &TimeUnit| {
            number_to_ns(text, unit.fraction_digits()).is_some_and(|ns| REVEALING_NS.contains(&ns))
        };
        let smaller = [
            TimeUnit::Milliseconds,
            TimeUnit::Microseconds,
            TimeUnit::Nanoseconds,
        ];
        if let Some(unit) = smaller.into_iter().find(reveals) {
            return Some(Self::Since1970(unit));
        }
        [Self::Iso8601, Self::DayMonthYear, Self::YearMonthDay]
            .into_iter()
            .find(|form| form.parse_ns(text, TimeUnit::Seconds).is_some())
    }

    /// Returns `true` if times of this form have a date.
    pub(crate) fn is_date(self) -> bool {
        match self {
            Self::Seconds | Self::Since1970(_) => false,
            Self::Iso8601 | Self::DayMonthYear | Self::YearMonthDay => true,
        }
    }

    /// Returns `true` if a time of this form does not depend on a time zone.
    pub(crate) fn has_zone(self, text: &str) -> bool {
        match self {
            Self::Seconds | Self::Since1970(_) => true,
            Self::Iso8601 => text.parse::<Timestamp>().is_ok(),
            Self::DayMonthYear | Self::YearMonthDay => false,
        }
    }

    /// Returns a time (ns) in this form, with its unit.
    pub(crate) fn text(self, time_ns: i64) -> String {
        match self {
            Self::Seconds => format!("{} s", seconds_text(time_ns)),
            Self::Since1970(_) | Self::Iso8601 | Self::DayMonthYear | Self::YearMonthDay => {
                iso_text(time_ns)
            }
        }
    }

    /// Parses a time of this form as ns. `unit` is the unit of a time that is a number.
    pub(crate) fn parse_ns(self, text: &str, unit: TimeUnit) -> Option<i64> {
        match self {
            Self::Seconds => number_to_ns(text, unit.fraction_digits()),
            // A declared unit counts.
            Self::Since1970(revealed) => {
                let unit = if unit == TimeUnit::Seconds {
                    revealed
                } else {
                    unit
                };
                number_to_ns(text, unit.fraction_digits())
            }
            Self::Iso8601 => iso_8601_to_ns(text),
            Self::DayMonthYear => {
                let ([day, month, year], time) = date_and_time(text, '.')?;
                civil_text_ns([year, month, day], time)
            }
            Self::YearMonthDay => {
                let (date, time) = date_and_time(text, '/')?;
                civil_text_ns(date, time)
            }
        }
    }

    /// Returns a description of the form.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Seconds | Self::Since1970(_) => "a number as the first time of the file",
            Self::DayMonthYear => "DD.MM.YYYY HH:MM:SS as the first time of the file",
            Self::YearMonthDay => "YYYY/MM/DD HH:MM:SS as the first time of the file",
            Self::Iso8601 => "in ISO 8601 as the first time of the file",
        }
    }
}

/// Parses a time as ns since 1970, or since the start of a recording without a date.
///
/// The text is a number in the given unit, or a date and time in ISO 8601. A date without a UTC
/// offset counts as UTC. Returns `None` for any other text.
///
/// ```
/// use spandrel_record::{TimeUnit, record_time::parse_time_ns};
/// assert_eq!(parse_time_ns("1507760140.53", TimeUnit::Seconds), Some(1_507_760_140_530_000_000));
/// assert_eq!(parse_time_ns("1970-01-01T00:00:01Z", TimeUnit::Seconds), Some(1_000_000_000));
/// ```
pub fn parse_time_ns(text: &str, unit: TimeUnit) -> Option<i64> {
    number_to_ns(text, unit.fraction_digits()).or_else(|| iso_8601_to_ns(text))
}

/// Parses seconds as nanoseconds.
fn seconds_to_ns(text: &str) -> Option<i64> {
    number_to_ns(text, TimeUnit::Seconds.fraction_digits())
}

/// Parses a number as nanoseconds: round(number × 10^digits), half away from zero. Returns `None`
/// if the text is not a number or out of range.
fn number_to_ns(text: &str, fraction_digits: usize) -> Option<i64> {
    let (sign, digits) = match text.strip_prefix('-') {
        Some(rest) => (-1, rest),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    if digits.contains(['e', 'E']) {
        return exponent_to_ns(text, fraction_digits);
    }
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let is_number = !(whole.is_empty() && fraction.is_empty())
        && whole
            .bytes()
            .chain(fraction.bytes())
            .all(|byte| byte.is_ascii_digit());
    if !is_number {
        return None;
    }
    let whole: i64 = if whole.is_empty() {
        0
    } else {
        whole.parse().ok()?
    };
    let mut nanoseconds = 0;
    for place in 0..fraction_digits {
        let digit = fraction
            .as_bytes()
            .get(place)
            .map_or(0, |byte| i64::from(byte - b'0'));
        nanoseconds = nanoseconds * 10 + digit;
    }
    let rounds_up = fraction
        .as_bytes()
        .get(fraction_digits)
        .is_some_and(|byte| *byte >= b'5');
    let magnitude = whole
        .checked_mul(10_i64.pow(fraction_digits as u32))?
        .checked_add(nanoseconds + i64::from(rounds_up))?;
    Some(sign * magnitude)
}

/// Parses a number with an exponent, a common notation for very small times, as `f64`.
fn exponent_to_ns(text: &str, fraction_digits: usize) -> Option<i64> {
    let nanoseconds = (text.parse::<f64>().ok()? * 10_f64.powi(fraction_digits as i32)).round();
    let is_in_range = nanoseconds.abs() < i64::MAX as f64;
    is_in_range.then_some(nanoseconds as i64)
}

/// Parses ISO 8601 as nanoseconds since 1970. A time without a UTC offset counts as UTC.
fn iso_8601_to_ns(text: &str) -> Option<i64> {
    let timestamp = match text.parse::<Timestamp>() {
        Ok(timestamp) => timestamp,
        Err(_) => text
            .parse::<DateTime>()
            .ok()?
            .to_zoned(TimeZone::UTC)
            .ok()?
            .timestamp(),
    };
    i64::try_from(timestamp.as_nanosecond()).ok()
}

/// Splits a time at its first blank into the three parts of its date and the time of the day.
fn date_and_time(text: &str, separator: char) -> Option<([&str; 3], Option<&str>)> {
    let (date, time) = match text.split_once(' ') {
        Some((date, time)) => (date, Some(time.trim_start())),
        None => (text, None),
    };
    let mut parts = date.split(separator);
    let date = [parts.next()?, parts.next()?, parts.next()?];
    parts.next().is_none().then_some((date, time))
}

/// Returns the nanoseconds since 1970 of a date (year, month and day) and a time `HH:MM` or
/// `HH:MM:SS`. The time is 0:00 if it is missing.
fn civil_text_ns(date: [&str; 3], time: Option<&str>) -> Option<i64> {
    let number = |text: &str, digits: std::ops::RangeInclusive<usize>| -> Option<i64> {
        let is_number = digits.contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
        text.parse().ok().filter(|_| is_number)
    };
    let [year, month, day] = date;
    let (year, month, day) = (
        number(year, 4..=4)?,
        number(month, 1..=2)?,
        number(day, 1..=2)?,
    );
    let Some(time) = time else {
        return civil_ns(year, month, day, 0, 0, 0.0);
    };
    let mut parts = time.split(':');
    let (hour, minute) = (number(parts.next()?, 1..=2)?, number(parts.next()?, 2..=2)?);
    let second: f64 = match parts.next() {
        Some(second) => second.parse().ok()?,
        None => 0.0,
    };
    let is_whole = parts.next().is_none();
    civil_ns(year, month, day, hour, minute, second).filter(|_| is_whole)
}

/// Returns the nanoseconds since 1970 of a UTC date and time. Returns `None` if the date or time
/// does not exist. A leap second counts as the following second.
pub(crate) fn civil_ns(
    year: i64,
    month: i64,
    day: i64,
    hour: i64,
    minute: i64,
    second: f64,
) -> Option<i64> {
    let date = jiff::civil::Date::new(
        i16::try_from(year).ok()?,
        i8::try_from(month).ok()?,
        i8::try_from(day).ok()?,
    )
    .ok()?;
    ns_of(date, hour, minute, second)
}

/// Works like [`civil_ns`], with the day of the year instead of month and day, starting at 1.
pub(crate) fn day_of_year_ns(
    year: i64,
    day: i64,
    hour: i64,
    minute: i64,
    second: f64,
) -> Option<i64> {
    let first = jiff::civil::Date::new(i16::try_from(year).ok()?, 1, 1).ok()?;
    if !(1..=i64::from(first.days_in_year())).contains(&day) {
        return None;
    }
    ns_of(
        first.checked_add(jiff::Span::new().days(day - 1)).ok()?,
        hour,
        minute,
        second,
    )
}

fn ns_of(date: jiff::civil::Date, hour: i64, minute: i64, second: f64) -> Option<i64> {
    let is_time =
        (0..24).contains(&hour) && (0..60).contains(&minute) && (0.0..61.0).contains(&second);
    let midnight = date
        .to_zoned(TimeZone::UTC)
        .ok()
        .filter(|_| is_time)?
        .timestamp();
    let whole_s = midnight.as_second() + 3600 * hour + 60 * minute;
    let fraction_ns = (second * NANOSECONDS_PER_SECOND as f64).round() as i64;
    whole_s
        .checked_mul(NANOSECONDS_PER_SECOND)?
        .checked_add(fraction_ns)
}

/// Writes `time_ns` in seconds, with enough digits to read back the same nanosecond.
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
    // Writing to a `String` does not fail.
    let _ = write!(text, "{sign}{whole}");
    if fraction > 0 {
        let _ = write!(text, ".{fraction:09}");
        text.truncate(text.trim_end_matches('0').len());
    }
}

/// Returns the UTC date and time of `time_ns` since 1970, in ISO 8601.
pub(crate) fn iso_text(time_ns: i64) -> String {
    Timestamp::from_nanosecond(i128::from(time_ns))
        .map_or_else(|_| seconds_text(time_ns), |timestamp| timestamp.to_string())
}

/// Returns `time_ns` in seconds as decimal text.
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
    fn times_in_smaller_units_are_read_exactly() {
        assert_eq!(
            TimeForm::Seconds.parse_ns("991011697", TimeUnit::Microseconds),
            Some(991_011_697_000)
        );
        assert_eq!(
            TimeForm::Seconds.parse_ns("1.0000005", TimeUnit::Milliseconds),
            Some(1_000_001)
        );
        assert_eq!(
            TimeForm::Seconds.parse_ns("1700000000123456789", TimeUnit::Nanoseconds),
            Some(1_700_000_000_123_456_789)
        );
        assert_eq!(
            TimeForm::Seconds.parse_ns("0.5", TimeUnit::Nanoseconds),
            Some(1)
        );
    }

    #[test]
    fn text_without_a_number_gives_no_time() {
        for text in [
            "",
            "-",
            ".",
            "1.2.3",
            "12x",
            "nan",
            "inf",
            "1e400",
            "99999999999",
            "0x10",
            "1 2",
            "--1",
        ] {
            assert_eq!(seconds_to_ns(text), None, "{text}");
        }
    }

    #[test]
    fn iso_8601_keeps_nanoseconds_and_offset() {
        // 2024-02-29T12:00:00Z is 1709208000 s (date -u -d @1709208000).
        for text in [
            "2024-02-29T12:00:00.000000001Z",
            "2024-02-29T13:00:00.000000001+01:00",
        ] {
            assert_eq!(
                iso_8601_to_ns(text),
                Some(1_709_208_000_000_000_001),
                "{text}"
            );
        }
    }

    #[test]
    fn dates_of_spreadsheets_are_read_and_dates_with_a_doubtful_order_are_not() {
        let read = |text| {
            let form = TimeForm::of(text)?;
            Some((form, form.parse_ns(text, TimeUnit::Seconds)?))
        };
        let noon = 1_709_208_000_000_000_000;
        for (text, form, expected) in [
            ("29.02.2024 12:00", TimeForm::DayMonthYear, noon),
            (
                "29.2.2024 12:00:00.5",
                TimeForm::DayMonthYear,
                noon + 500_000_000,
            ),
            (
                "29.02.2024",
                TimeForm::DayMonthYear,
                noon - 43_200_000_000_000,
            ),
            ("2024/02/29 12:00:00", TimeForm::YearMonthDay, noon),
            (
                "2024/02/29",
                TimeForm::YearMonthDay,
                noon - 43_200_000_000_000,
            ),
        ] {
            assert_eq!(read(text), Some((form, expected)), "{text}");
            assert!(form.is_date() && !form.has_zone(text), "{text}");
        }
        for text in [
            "02/29/2024 12:00",
            "30.02.2024 12:00",
            "29.02.24 12:00",
            "29.02.2024 24:00",
        ] {
            assert_eq!(read(text), None, "{text}");
        }
    }

    #[test]
    fn the_size_of_a_number_since_1970_reveals_its_unit() {
        let noon = 1_709_208_000_000_000_000;
        for (text, unit) in [
            ("1709208000000", TimeUnit::Milliseconds),
            ("1709208000000000", TimeUnit::Microseconds),
            ("1709208000000000000", TimeUnit::Nanoseconds),
        ] {
            let form = TimeForm::of(text);
            assert_eq!(form, Some(TimeForm::Since1970(unit)), "{text}");
            assert_eq!(
                form.and_then(|of| of.parse_ns(text, TimeUnit::Seconds)),
                Some(noon)
            );
        }
        // Milliseconds of 1973, or seconds of the year 5138.
        assert_eq!(TimeForm::of("100000000000"), None);
    }

    #[test]
    fn iso_8601_without_offset_is_utc() {
        assert_eq!(
            iso_8601_to_ns("2024-02-29T12:00:00"),
            Some(1_709_208_000_000_000_000)
        );
        assert_eq!(
            iso_8601_to_ns("2024-02-29 12:00:00.5"),
            Some(1_709_208_000_500_000_000)
        );
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
