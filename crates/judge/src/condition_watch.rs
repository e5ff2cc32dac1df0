//! Watches a condition: one that is frozen or has jumped gives no statement.

use crate::day::DAY_S;
use serde::{Deserialize, Serialize};

/// A condition that does not move this long (s) is frozen,
const FROZEN_S: f64 = 86_400.0;
/// and over at least this many epochs. A series with one value a day may repeat one by chance.
const FROZEN_EPOCHS: u32 = 8;
/// Largest range (°C) of a thermometer that does not move: an open input has slight noise,
const STILL: f64 = 0.05;
/// and range (°C) in which it has moved before. A room with a constant temperature is measured.
const MOVED: f64 = 1.0;
/// A thermometer that does not move has at most this share of its usual range of a day. A wet or
/// disconnected sensor has more noise than an open input.
const STILL_SHARE: f64 = 0.02;
/// Number of days from which its usual range is known, and of epochs in each.
const USUAL_DAYS: u32 = 20;
const USUAL_EPOCHS: u32 = 4;

/// Change (°C) of a thermometer from one epoch to the next that its weather hardly explains,
const JUMP: f64 = 15.0;
/// in units of its largest change before. Asphalt in the sun changes faster than concrete.
const JUMP_RATIO: f64 = 1.5;
/// Largest change (°C) from one epoch to the next by weather. A larger one is a fault, even if the
/// thermometer goes back.
const MOST_WEATHER: f64 = 30.0;
/// Longest time (s) between two such epochs. Within this time, a change by weather goes back.
const JUMP_S: f64 = 86_400.0;
/// Share of a jump by which the thermometer must go back.
const BACK: f64 = 0.5;

/// Why a value of a condition or quantity does not count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Doubt {
    Frozen,
    Jumped,
}

/// What is known of a condition, in the scale of the model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ConditionWatch {
    still: Option<Still>,
    /// Lowest and highest value of all.
    known: Option<(f64, f64)>,
    /// Time and value of the last epoch.
    last: Option<(f64, f64)>,
    /// Largest change from one epoch to the next that was no jump.
    largest_change: f64,
    jump: Option<Jump>,
    today: DayRange,
    /// Mean range of the days on which the condition moved, and their number.
    usual_range: f64,
    usual_days: u32,
}

/// Range of the values of one day.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct DayRange {
    day: i64,
    low: f64,
    high: f64,
    epochs: u32,
    is_still: bool,
}

/// Values that do not move.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Still {
    since_s: f64,
    low: f64,
    high: f64,
    epochs: u32,
}

/// A jump of a thermometer whose values have not returned.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Jump {
    at_s: f64,
    from: f64,
    size: f64,
}

impl ConditionWatch {
    /// Takes a value (scale of the model), and returns why it does not count, if it does not.
    pub(crate) fn doubt(&mut self, time_s: f64, value: f64, is_temperature: bool) -> Option<Doubt> {
        self.begin_day(time_s);
        let tolerance = match is_temperature {
            true if self.usual_days >= USUAL_DAYS => STILL.max(STILL_SHARE * self.usual_range),
            true => STILL,
            false => 0.0,
        };
        let is_frozen = self.is_frozen(time_s, value, tolerance);
        self.today.add(value, is_frozen);
        if is_frozen {
            // What comes after it cannot be compared with what was before it.
            (self.last, self.jump) = (None, None);
            return Some(Doubt::Frozen);
        }
        (is_temperature && self.has_jumped(time_s, value)).then_some(Doubt::Jumped)
    }

    /// Adds the last day to the usual ones, if a later day begins.
    fn begin_day(&mut self, time_s: f64) {
        let day = (time_s / DAY_S).floor() as i64;
        if self.today.epochs > 0 && self.today.day == day {
            return;
        }
        let DayRange {
            low,
            high,
            epochs,
            is_still,
            ..
        } = std::mem::take(&mut self.today);
        self.today.day = day;
        if epochs >= USUAL_EPOCHS && !is_still {
            self.usual_days = self.usual_days.saturating_add(1);
            self.usual_range += (high - low - self.usual_range) / f64::from(self.usual_days);
        }
    }

    fn is_frozen(&mut self, time_s: f64, value: f64, tolerance: f64) -> bool {
        let (low, high) = self.known.unwrap_or((value, value));
        self.known = Some((low.min(value), high.max(value)));
        let has_moved = high - low >= MOVED;
        let new = Still {
            since_s: time_s,
            low: value,
            high: value,
            epochs: 0,
        };
        let still = self.still.get_or_insert(new);
        let (low, high) = (still.low.min(value), still.high.max(value));
        if high - low > tolerance {
            *still = new;
        } else {
            (still.low, still.high) = (low, high);
        }
        still.epochs = still.epochs.saturating_add(1);
        time_s - still.since_s >= FROZEN_S
            && still.epochs >= FROZEN_EPOCHS
            && (has_moved || still.low == still.high)
    }

    /// Returns `true` from a jump on, until the thermometer jumps back.
    fn has_jumped(&mut self, time_s: f64, value: f64) -> bool {
        let before = self.last.replace((time_s, value));
        let before = before.filter(|(before_s, _)| time_s - before_s <= JUMP_S);
        let change = before.map_or(0.0, |(_, before)| value - before);
        if let Some(Jump { at_s, from, size }) = self.jump {
            // The change of a day goes back within a day.
            if time_s - at_s <= JUMP_S && (value - from) / size <= 1.0 - BACK {
                if size.abs() <= MOST_WEATHER {
                    self.largest_change = self.largest_change.max(size.abs());
                }
                self.jump = None;
            } else if -change / size >= BACK {
                self.jump = None;
            }
        } else if change.abs() >= JUMP.max(JUMP_RATIO * self.largest_change) {
            self.jump = Some(Jump {
                at_s: time_s,
                from: value - change,
                size: change,
            });
        } else {
            self.largest_change = self.largest_change.max(change.abs());
        }
        self.jump.is_some()
    }
}

impl DayRange {
    fn add(&mut self, value: f64, is_still: bool) {
        if self.epochs == 0 {
            (self.low, self.high) = (value, value);
        }
        (self.low, self.high) = (self.low.min(value), self.high.max(value));
        self.epochs = self.epochs.saturating_add(1);
        self.is_still |= is_still;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR_S: f64 = 3600.0;

    /// Returns the doubts of a thermometer with one value an hour.
    fn doubts(celsius: impl Iterator<Item = f64>) -> Vec<Option<Doubt>> {
        let mut watch = ConditionWatch::default();
        let hours = celsius.enumerate();
        hours
            .map(|(hour, value)| watch.doubt(hour as f64 * HOUR_S, value, true))
            .collect()
    }

    /// Two days between 5 and 15 °C.
    fn weather() -> impl Iterator<Item = f64> {
        (0..48).map(|hour| 10.0 + 5.0 * (f64::from(hour) * std::f64::consts::TAU / 24.0).sin())
    }

    #[test]
    fn open_input_with_slight_noise_is_frozen_after_a_day_until_it_moves() {
        let open = (0..100).map(|hour| 0.01 * f64::from(hour % 3));
        let found = doubts(weather().chain(open).chain([12.0, 12.5]));
        let first = found.iter().position(Option::is_some);
        assert_eq!(first, Some(48 + 24));
        assert!(
            found[72..148]
                .iter()
                .all(|doubt| *doubt == Some(Doubt::Frozen))
        );
        assert_eq!(found[148..], [None, None]);
    }

    #[test]
    fn thermometer_with_a_range_far_below_its_usual_one_is_frozen() {
        let weeks = || (0..15).flat_map(|_| weather());
        let noise = (0..100).map(|hour| 10.0 + 0.06 * (f64::from(hour) * 12.9898).sin());
        let found = doubts(weeks().chain(noise).chain(weather()));
        let first = found.iter().position(Option::is_some);
        assert_eq!(first, Some(30 * 24 + 24));
        let still = &found[31 * 24..30 * 24 + 100];
        assert!(still.iter().all(|doubt| *doubt == Some(Doubt::Frozen)));
        let after = &found[30 * 24 + 101..];
        assert!(after.iter().all(Option::is_none), "{after:?}");
    }

    #[test]
    fn spikes_are_faults_however_many_there_are() {
        let days = || (0..15).flat_map(|_| weather());
        let spiked = days().enumerate().map(|(hour, celsius)| match hour % 19 {
            7 => 79.0,
            _ => celsius,
        });
        for (hour, doubt) in doubts(spiked).into_iter().enumerate() {
            let expected = (hour % 19 == 7).then_some(Doubt::Jumped);
            assert_eq!(doubt, expected, "hour {hour}");
        }
    }

    #[test]
    fn room_that_has_always_had_one_temperature_is_measured() {
        let found = doubts((0..500).map(|hour| 21.0 + 0.02 * f64::from(hour % 2)));
        assert!(found.iter().all(Option::is_none));
    }

    #[test]
    fn jump_that_stays_is_in_doubt_until_the_thermometer_jumps_back() {
        let off = weather().map(|celsius| celsius + 20.0);
        let found = doubts(weather().chain(off).chain(weather()));
        assert!(found[..48].iter().all(Option::is_none));
        assert!(
            found[48..96]
                .iter()
                .all(|doubt| *doubt == Some(Doubt::Jumped))
        );
        assert!(found[96..].iter().all(Option::is_none));
    }

    #[test]
    fn asphalt_in_the_sun_changes_as_fast_on_the_second_day_without_a_doubt() {
        let day = (0..24).map(|hour| if (10..16).contains(&hour) { 38.0 } else { 20.0 });
        let found = doubts(day.clone().chain(day));
        let in_doubt = found.iter().filter(|doubt| doubt.is_some()).count();
        assert_eq!(in_doubt, 6, "only the first hours in the sun: {found:?}");
    }
}
