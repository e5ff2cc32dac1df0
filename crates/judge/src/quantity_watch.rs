//! Watches a quantity: one that repeats its values, or whose unit has changed, gives no statement.
//!
//! A program that finds no frequency may repeat its last one. Such a value never shows a loss, and
//! when the temperature changes, it seems to be one.

use crate::condition_watch::Doubt;
use crate::day::DAY_S;
use serde::{Deserialize, Serialize};

/// A value that is repeated this long (s) is frozen,
const FROZEN_S: f64 = DAY_S;
/// and over at least this many epochs. A daily mean may repeat by chance.
const FROZEN_EPOCHS: u32 = 8;
/// The resolution of a quantity is coarse if at least one of this number of values is repeated.
const COARSE: u32 = 20;
/// A coarse quantity is frozen if it repeats its value this many times as often as ever before,
const LONGER: u32 = 3;
/// and this long (s), if it has repeated one for a day before. A season has such days.
const COARSE_S: f64 = 30.0 * DAY_S;
/// Change of ln(stiffness) that only another unit explains: a factor of 10 of a frequency.
const OTHER_UNIT: f64 = 2.0 * std::f64::consts::LN_10;
/// Number of first values that can themselves be the wrong ones.
const FIRST_VALUES: u32 = 8;

/// What is known of the values of a quantity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct QuantityWatch {
    repetition: Repetition,
    /// Number of different successive values, and how many of them were repeated.
    values: u32,
    repeated: u32,
    /// Largest number of epochs, and longest time (s), over which a value was repeated and
    /// believed.
    longest: u32,
    longest_s: f64,
    today: Pattern,
    yesterday: Pattern,
    /// Number of epochs of the last days that repeat the day before.
    copied: u32,
    unit: Unit,
    /// Why values of the open day do not count.
    doubt: Option<Doubt>,
}

/// Epochs with exactly the same value.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Repetition {
    value: f64,
    since_s: f64,
    epochs: u32,
    /// Number of epochs, and time (s), until the value was no longer believed.
    believed: u32,
    believed_s: f64,
}

/// The values of a day, in order.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Pattern {
    epochs: u32,
    first: f64,
    is_varied: bool,
    /// FNV-1a of the bits of all values.
    hash: u64,
}

/// The size of the values, from which a value in another unit differs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Unit {
    last: f64,
    epochs: u32,
    /// Number of successive values in another unit.
    other: u32,
}

impl QuantityWatch {
    /// Takes ln(stiffness) of an epoch, and returns why it does not count, if it does not.
    pub(crate) fn doubt(&mut self, time_s: f64, value: f64) -> Option<Doubt> {
        self.today.add(value);
        let is_frozen = self.is_frozen(time_s, value);
        let doubt = match self.unit.is_other(value) {
            true => Some(Doubt::Jumped),
            false => is_frozen.then_some(Doubt::Frozen),
        };
        self.doubt = doubt.or(self.doubt);
        doubt
    }

    /// Ends a day. Returns why values of the day do not count, and whether this holds for all of
    /// them: a whole day can be a copy of the day before.
    pub(crate) fn end_day(&mut self) -> (Option<Doubt>, bool) {
        let today = std::mem::take(&mut self.today);
        let doubt = self.doubt.take();
        if today.epochs == 0 {
            return (doubt, false);
        }
        self.copied = match today == self.yesterday && today.is_varied && !self.is_coarse() {
            true => self.copied.saturating_add(today.epochs),
            false => 0,
        };
        self.yesterday = today;
        match self.copied >= FROZEN_EPOCHS {
            true => (Some(Doubt::Frozen), true),
            false => (doubt, false),
        }
    }

    fn is_frozen(&mut self, time_s: f64, value: f64) -> bool {
        let now = &mut self.repetition;
        if now.epochs == 0 || now.value != value {
            let was = std::mem::replace(
                now,
                Repetition {
                    value,
                    since_s: time_s,
                    epochs: 0,
                    believed: 0,
                    believed_s: 0.0,
                },
            );
            self.values = self.values.saturating_add(u32::from(was.epochs > 0));
            self.repeated = self.repeated.saturating_add(u32::from(was.epochs > 1));
            self.longest = self.longest.max(was.believed);
            self.longest_s = self.longest_s.max(was.believed_s);
        }
        let (is_coarse, longer) = (self.is_coarse(), LONGER.saturating_mul(self.longest));
        let least = if is_coarse {
            FROZEN_EPOCHS.max(longer)
        } else {
            FROZEN_EPOCHS
        };
        let least_s = match is_coarse && self.longest_s >= FROZEN_S {
            true => COARSE_S,
            false => FROZEN_S,
        };
        let now = &mut self.repetition;
        now.epochs = now.epochs.saturating_add(1);
        let passed_s = time_s - now.since_s;
        let is_frozen = passed_s >= least_s && now.epochs >= least;
        if !is_frozen {
            (now.believed, now.believed_s) = (now.epochs, passed_s);
        }
        is_frozen
    }

    /// Returns `true` if values repeat because of their resolution.
    fn is_coarse(&self) -> bool {
        self.repeated > 0 && self.repeated.saturating_mul(COARSE) >= self.values
    }
}

impl Pattern {
    fn add(&mut self, value: f64) {
        /// Offset basis and prime of FNV-1a with 64 bits.
        const BASIS: u64 = 0xcbf2_9ce4_8422_2325;
        const PRIME: u64 = 0x0100_0000_01b3;
        if self.epochs == 0 {
            (self.first, self.hash) = (value, BASIS);
        }
        self.epochs = self.epochs.saturating_add(1);
        self.is_varied |= value != self.first;
        for byte in value.to_bits().to_le_bytes() {
            self.hash = (self.hash ^ u64::from(byte)).wrapping_mul(PRIME);
        }
    }
}

impl Unit {
    /// Returns `true` from a jump on that only another unit explains, until the values jump back.
    fn is_other(&mut self, value: f64) -> bool {
        let is_same = self.epochs == 0 || (value - self.last).abs() < OTHER_UNIT;
        if is_same {
            self.last = value;
            self.epochs = self.epochs.saturating_add(1);
            self.other = 0;
            return false;
        }
        self.other = self.other.saturating_add(1);
        // A series may begin with a wrong value.
        if self.other > self.epochs && self.epochs < FIRST_VALUES {
            *self = Self {
                last: value,
                epochs: self.other,
                other: 0,
            };
            return false;
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR_S: f64 = 3600.0;

    /// Returns the number of doubts of each day of a quantity with some values a day.
    fn doubts(per_day: u32, values: impl Iterator<Item = f64>) -> Vec<u32> {
        let mut watch = QuantityWatch::default();
        let mut days: Vec<u32> = Vec::new();
        let mut in_doubt = 0;
        for (index, value) in (0_u32..).zip(values) {
            let time_s = f64::from(index) * DAY_S / f64::from(per_day);
            in_doubt += u32::from(watch.doubt(time_s, value).is_some());
            if (index + 1) % per_day == 0 {
                let (_, is_copy) = watch.end_day();
                days.push(if is_copy { per_day } else { in_doubt });
                in_doubt = 0;
            }
        }
        days
    }

    /// Returns ln(stiffness) of a frequency of 3 Hz that varies by some 0.4 %.
    fn varying(index: u32) -> f64 {
        2.0 * (3.0 + 0.012 * (f64::from(index) * 12.9898).sin()).ln()
    }

    fn rounded(hertz: f64, per_hertz: f64) -> f64 {
        2.0 * ((hertz * per_hertz).round() / per_hertz).ln()
    }

    #[test]
    fn a_value_that_is_repeated_is_frozen_after_a_day_until_it_varies() {
        let held = std::iter::repeat_n(varying(239), 120);
        let values = (0..240)
            .map(varying)
            .chain(held)
            .chain((0..48).map(varying));
        let found = doubts(24, values);
        assert!(found[..10].iter().all(|count| *count == 0), "{found:?}");
        assert_eq!(found[10..15], [1, 24, 24, 24, 24], "{found:?}");
        assert_eq!(found[15..], [0, 0], "{found:?}");
        let always = doubts(24, std::iter::repeat_n(2.0, 240));
        assert_eq!(always[..2], [0, 24]);
        assert!(always[1..].iter().all(|count| *count == 24));
    }

    #[test]
    fn a_day_that_is_repeated_is_frozen() {
        let copies = (0..5).flat_map(|_| (0..24).map(varying));
        let values = (100..124)
            .map(varying)
            .chain(copies)
            .chain((200..224).map(varying));
        assert_eq!(doubts(24, values), [0, 0, 24, 24, 24, 24, 0]);
    }

    #[test]
    fn a_coarse_resolution_or_a_daily_mean_is_not_frozen() {
        let hour = |index: u32| f64::from(index) * HOUR_S / DAY_S;
        let noise = |day: f64| 0.004 * (day * day * 12.9898).sin();
        let season =
            |day: f64| 1.2 - 0.012 * (day / 58.0).sin() - 0.003 * (day * 0.7).sin() + noise(day);
        let days = 2 * 365;
        // Two decimals, an epoch an hour, with and without a change within the day.
        for diurnal in [0.004, 0.0] {
            let hertz = |day: f64| season(day) + diurnal * (day * std::f64::consts::TAU).sin();
            let found = doubts(
                24,
                (0..24 * days).map(|index| rounded(hertz(hour(index)), 100.0)),
            );
            let lost = found.iter().filter(|count| **count > 0).count();
            assert!(lost <= 5, "{lost} days, {diurnal}");
        }
        // A daily mean with two decimals, once and in every hour of its day.
        let mean = |day: u32| rounded(season(f64::from(day)), 100.0);
        let found = doubts(1, (0..days).map(mean));
        let lost = found.iter().filter(|count| **count > 0).count();
        assert!(lost <= 5, "{lost} days");
        let daily = |day: u32| varying(day);
        let found = doubts(24, (0..24 * days).map(|index| daily(index / 24)));
        assert!(found.iter().all(|count| *count == 0));
    }

    #[test]
    fn a_coarse_quantity_that_stays_far_longer_than_ever_is_frozen() {
        let values = (0..2400).map(|index| rounded(varying(index).exp().sqrt(), 100.0));
        let held = std::iter::repeat_n(rounded(3.0, 100.0), 240);
        let found = doubts(24, values.chain(held));
        assert!(found[..100].iter().all(|count| *count == 0));
        assert!(found[102..].iter().all(|count| *count == 24), "{found:?}");
    }

    #[test]
    fn another_unit_is_in_doubt_until_the_former_one_returns() {
        let in_mhz = |index| varying(index) + 2.0 * 1000_f64.ln();
        let values = (0..240).map(varying).chain((240..480).map(in_mhz));
        let found = doubts(24, values.chain((480..528).map(varying)));
        assert!(found[..10].iter().all(|count| *count == 0));
        assert!(found[10..20].iter().all(|count| *count == 24));
        assert_eq!(found[20..], [0, 0]);
        // Only the first value is wrong.
        let found = doubts(24, std::iter::once(in_mhz(0)).chain((1..48).map(varying)));
        assert_eq!(found, [1, 0]);
    }
}
