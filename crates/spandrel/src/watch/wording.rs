//! Numbers, times and states as text for people.

use jiff::Timestamp;
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::Span;
use spandrel_bus::{AlertState, Name, RoundedProbability};
use spandrel_listener::StructureState;
use std::collections::BTreeSet;
use std::time::Duration;

/// Returns the colour of a state. The word shows the same information without colour.
pub fn state_style(state: AlertState) -> Style {
    match state {
        AlertState::Learning => Style::new().fg(Color::Cyan),
        AlertState::Normal => Style::new().fg(Color::Green),
        AlertState::Pending | AlertState::SofteningInMotion => Style::new().fg(Color::Yellow),
        AlertState::Raised | AlertState::Unconfirmed => {
            Style::new().fg(Color::Red).add_modifier(Modifier::BOLD)
        }
        AlertState::Undecided => Style::new().fg(Color::Cyan),
        AlertState::Acknowledged => Style::new().fg(Color::Magenta),
        AlertState::Cleared => Style::new().fg(Color::Blue),
    }
}

/// Returns the number of alerts in each state, as parts of a title. Normal and learning alerts are
/// omitted.
pub fn state_counts(states: impl Iterator<Item = AlertState> + Clone) -> Vec<Span<'static>> {
    let told = [
        AlertState::Raised,
        AlertState::Unconfirmed,
        AlertState::Pending,
        AlertState::SofteningInMotion,
        AlertState::Acknowledged,
        AlertState::Cleared,
        AlertState::Undecided,
    ];
    let mut spans = Vec::new();
    for state in told {
        let count = states.clone().filter(|found| *found == state).count();
        if count > 0 {
            spans.push(Span::raw(format!(" · {count} ")));
            spans.push(Span::styled(state.as_str(), state_style(state)));
        }
    }
    spans
}

/// Returns the text for a view of `place` without any messages. `others` are the structures whose
/// services or sensors run.
pub fn nothing_heard(place: &str, others: &BTreeSet<Name>) -> String {
    if others.is_empty() {
        return format!("no messages yet {place}: no service or sensor is running");
    }
    let others: Vec<&str> = others.iter().map(Name::as_str).collect();
    format!(
        "no messages yet {place}: no service or sensor of it is running; structures with running \
         services: {}",
        others.join(", ")
    )
}

/// Formats a mean and standard deviation: `0.858 ± 0.011`.
pub fn estimate(mean: f64, std: f64) -> String {
    format!("{mean:.3} ± {std:.3}")
}

/// Formats a probability in per cent, never as certainty. It has enough digits to show on which
/// side of `asked` it is.
pub fn probability(value: f64, asked: Option<f64>) -> String {
    RoundedProbability::new(value, asked.as_slice()).percent()
}

/// Formats a share in per cent, with a decimal only if needed.
pub fn share(value: f64) -> String {
    let text = format!("{:.1}", value * 100.0);
    format!("{} %", text.strip_suffix(".0").unwrap_or(&text))
}

/// Formats a value with three significant digits.
pub fn significant(value: f64) -> String {
    /// Values below this limit are more legible with an exponent than with leading zeros.
    const SMALL: f64 = 1e-3;
    /// Values above this limit are more legible with an exponent than with many digits.
    const LARGE: f64 = 1e6;
    if value == 0.0 {
        return "0".to_owned();
    }
    if !(SMALL..LARGE).contains(&value.abs()) {
        return format!("{value:.2e}");
    }
    let decimals = 2 - value.abs().log10().floor() as i32;
    format!("{value:.*}", usize::try_from(decimals).unwrap_or(0))
}

/// Formats a time span in a suitable unit: `12 s`, `5 min`.
pub fn duration(span: Duration) -> String {
    seconds(span.as_secs_f64())
}

fn seconds(span_s: f64) -> String {
    const UNITS: [(f64, &str); 5] = [
        (365.25 * 86_400.0, "years"),
        (86_400.0, "days"),
        (3600.0, "h"),
        (60.0, "min"),
        (1.0, "s"),
    ];
    /// Minimum multiple of a unit, so that 90 s do not become 1 min.
    const FROM: f64 = 2.0;
    let fitting = UNITS
        .into_iter()
        .find(|(unit_s, _)| span_s >= FROM * unit_s);
    match fitting {
        Some((unit_s, unit)) => format!("{:.0} {unit}", (span_s / unit_s).floor()),
        None => format!("{span_s:.2} s"),
    }
}

/// Formats the lag behind the clock: `lag 0.12 s`. A simulation ahead of the clock is `12 s ahead`.
pub fn lag(lag_s: f64) -> String {
    if lag_s < 0.0 {
        format!("{} ahead", seconds(-lag_s))
    } else {
        format!("lag {}", seconds(lag_s))
    }
}

/// Formats a measurement time: in seconds for a record that starts at 0, otherwise as a date in
/// UTC.
pub fn time(time_ns: i64) -> String {
    /// Three years. No record from 0 is longer, and no clock is wrong by so much.
    const RECORD_NS: u64 = 100_000_000_000_000_000;
    match Timestamp::from_nanosecond(i128::from(time_ns)) {
        Ok(calendar) if time_ns.unsigned_abs() >= RECORD_NS => {
            calendar.strftime("%Y-%m-%d %H:%M:%S UTC").to_string()
        }
        _ => format!("{:.2} s", time_ns as f64 / 1e9),
    }
}

/// Returns the text on one line without control characters, because messages can come from any
/// publisher.
pub fn printable(text: &str) -> String {
    text.chars()
        .map(|letter| if letter.is_control() { ' ' } else { letter })
        .collect()
}

/// The text in place of the parameters of a structure without a model.
pub const NO_MODEL: &str = "no model: natural frequencies only";

/// Returns the text for a structure without values. If it has alerts, there were values before this
/// view was opened.
pub fn nothing_measured(structure: &StructureState) -> &'static str {
    if structure.alerts.is_empty() {
        "no data yet"
    } else {
        "no data since this view was started"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probabilities_are_never_shown_as_0_or_1() {
        for (value, expected) in [
            (0.0, "< 0.1 %"),
            (0.012, "1.2 %"),
            (0.5, "50.0 %"),
            (1.0, "> 99.9 %"),
        ] {
            assert_eq!(probability(value, Some(0.99)), expected);
        }
        assert_eq!(probability(0.9899, Some(0.99)), "98.99 %");
    }

    #[test]
    fn noise_levels_have_three_significant_digits() {
        for (value, expected) in [
            (0.1, "0.100"),
            (0.005, "0.00500"),
            (205.36, "205"),
            (1234.5, "1234"),
            (1e-7, "1.00e-7"),
            (0.0, "0"),
        ] {
            assert_eq!(significant(value), expected);
        }
    }

    #[test]
    fn durations_have_a_suitable_unit() {
        for (value, expected) in [
            (0.12, "0.12 s"),
            (12.9, "12 s"),
            (90.0, "90 s"),
            (150.0, "2 min"),
            (7300.0, "2 h"),
            (8.7e8, "27 years"),
        ] {
            assert_eq!(seconds(value), expected);
        }
        assert_eq!(lag(0.12), "lag 0.12 s");
        assert_eq!(lag(-12.0), "12 s ahead");
    }

    #[test]
    fn whole_percentages_have_no_decimals() {
        assert_eq!(
            (share(0.05), share(0.125)),
            ("5 %".to_owned(), "12.5 %".to_owned())
        );
    }

    #[test]
    fn times_of_records_are_in_seconds_and_times_of_clocks_are_dates() {
        assert_eq!(time(61_200_000_000), "61.20 s");
        assert_eq!(time(1_709_208_000_000_000_001), "2024-02-29 12:00:00 UTC");
        assert_eq!(time(i64::MIN), "1677-09-21 00:12:43 UTC");
    }

    #[test]
    fn external_texts_cannot_control_the_terminal() {
        assert_eq!(printable("a\u{1b}[2Jb\nc"), "a [2Jb c");
    }
}
