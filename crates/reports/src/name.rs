//! Names of recordings and of their reports, and times for people.

use jiff::Timestamp;
use spandrel_bus::Name;
use spandrel_earthquake::Due;
use std::collections::BTreeMap;

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

/// Returns sentences about later judgements that wait, because no samples arrive.
///
/// Earthquakes with the same later judgements share a sentence.
pub(crate) fn waiting_for_samples(due: &[Due]) -> Vec<String> {
    let mut afters: BTreeMap<i64, Vec<f64>> = BTreeMap::new();
    for due in due {
        afters.entry(due.of_ns).or_default().push(due.after_s);
    }
    let mut earthquakes: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (of_ns, mut afters) in afters {
        afters.sort_by(f64::total_cmp);
        let afters: Vec<String> = afters.into_iter().map(duration).collect();
        let of = earthquakes.entry(listed(&afters)).or_default();
        of.push(date(of_ns));
    }
    let sentence = |(after, of): (String, Vec<String>)| {
        let s = if of.len() == 1 { "" } else { "s" };
        let of = of.join("; ");
        format!("The judgement {after} after the earthquake{s} of {of} waits for samples.")
    };
    earthquakes.into_iter().map(sentence).collect()
}

/// Returns a list for people, such as `5 min, 1 h and 1 d`.
fn listed(all: &[String]) -> String {
    match all {
        [before @ .., last] if !before.is_empty() => format!("{} and {last}", before.join(", ")),
        _ => all.concat(),
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

    #[test]
    fn earthquakes_with_the_same_later_judgements_share_a_sentence() {
        let due = |of_s: i64, after_s: f64| Due {
            of_ns: of_s * 1_000_000_000,
            after_s,
            at_ns: 0,
        };
        let hour = 3_600.0;
        let all = [due(0, hour), due(0, 24.0 * hour), due(60, 24.0 * hour)];
        assert_eq!(
            waiting_for_samples(&all),
            [
                "The judgement 1 d after the earthquake of 1 January 1970, 00:01 UTC waits for \
                 samples.",
                "The judgement 1 h and 1 d after the earthquake of 1 January 1970, 00:00 UTC waits \
                 for samples.",
            ]
        );
        let afters = [1.0 / 12.0, 1.0, 24.0, 168.0];
        let default: Vec<Due> = afters.iter().map(|after| due(0, after * hour)).collect();
        assert_eq!(
            waiting_for_samples(&default),
            [
                "The judgement 5 min, 1 h, 1 d and 7 d after the earthquake of 1 January 1970, \
                 00:00 UTC waits for samples."
            ]
        );
        let same = [due(60, hour), due(0, hour)];
        assert_eq!(
            waiting_for_samples(&same),
            [
                "The judgement 1 h after the earthquakes of 1 January 1970, 00:00 UTC; 1 January \
                 1970, 00:01 UTC waits for samples."
            ]
        );
    }
}
