//! Names of recordings and of their reports, and times for people.

use jiff::Timestamp;
use spandrel_bus::Name;

/// Returns the name of the recording that starts at a time (ns since 1970-01-01 UTC), such as
/// `2022-12-20T10-34-01Z`.
pub(crate) fn stem(start_ns: i64) -> String {
    timestamp(start_ns)
        .strftime("%Y-%m-%dT%H-%M-%SZ")
        .to_string()
}

/// Returns the name of a report on the bus, such as `2022-12-20t10-34-01z`. `None` if the file does
/// not have the name of a recording.
pub(crate) fn report_name(stem: &str) -> Option<Name> {
    Name::new(stem.to_lowercase()).ok()
}

/// Returns a time (ns since 1970-01-01 UTC) for people.
pub(crate) fn date(time_ns: i64) -> String {
    timestamp(time_ns)
        .strftime("%-d %B %Y, %H:%M UTC")
        .to_string()
}

/// Returns a duration (s) for people.
pub(crate) fn duration(seconds: f64) -> String {
    const UNITS: [(f64, &str); 3] = [(86_400.0, "d"), (3_600.0, "h"), (60.0, "min")];
    let fits = |(length, _): &(f64, &str)| seconds >= *length && seconds % length == 0.0;
    match UNITS.into_iter().find(fits) {
        Some((length, unit)) => format!("{} {unit}", seconds / length),
        None => format!("{seconds} s"),
    }
}

fn timestamp(time_ns: i64) -> Timestamp {
    // The calendar of `jiff` includes every time of 64 bits in nanoseconds.
    Timestamp::from_nanosecond(time_ns.into()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_durations_are_those_of_people() {
        let start_ns = 1_671_532_441_500_000_000;
        assert_eq!(stem(start_ns), "2022-12-20T10-34-01Z");
        let name = report_name(&stem(start_ns)).unwrap();
        assert_eq!(name.as_str(), "2022-12-20t10-34-01z");
        assert_eq!(date(start_ns), "20 December 2022, 10:34 UTC");
        let durations = [3_600.0, 86_400.0, 7.0 * 86_400.0, 90.0, 300.0].map(duration);
        assert_eq!(durations, ["1 h", "1 d", "7 d", "90 s", "5 min"]);
    }
}
