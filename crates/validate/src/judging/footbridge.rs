//! A simulated footbridge for documentation and practice: natural frequencies of two modes, and the
//! temperature of its deck, over seasons, weather and frost.
//!
//! Every seed is the same bridge under other weather. In contrast, every seed of `bridge` is another
//! structure. The two share no random numbers: published figures depend on those of `bridge`, while
//! files in the documentation depend on these.

use super::{PER_DAY, kept};
use std::f64::consts::TAU;
use std::fmt::Write as _;

const DAY_S: f64 = 86_400.0;
/// First day: 1 July 2024 (days since 1970-01-01 UTC).
const FIRST_DAY: f64 = 19_905.0;
/// Mean, yearly and daily amplitude of the air temperature (°C).
const AIR: (f64, f64, f64) = (8.0, 10.0, 4.0);
/// Standard deviation (°C) and memory (days) of the weather.
const WEATHER: (f64, f64) = (3.0, 3.0);
/// Memory of the deck, and of the frozen share of its asphalt (days).
const DECK_DAYS: f64 = 0.3;
const FROZEN_DAYS: f64 = 1.0;
/// Frequencies (Hz), slopes (1/°C) and relative rise when all asphalt is frozen, per mode.
const MODES: [(f64, f64, f64); 2] = [(2.31, -0.0012, 0.04), (3.87, -0.0007, 0.02)];
/// Standard deviation and memory (days) of the slow part of ln(frequency).
const WANDER: (f64, f64) = (0.0010, 10.0);
/// Standard deviation and memory (days) of its fast part.
const HOURS: (f64, f64) = (0.0020, 0.3);
/// Standard deviation of ln(frequency) of one epoch alone.
const ERROR: f64 = 0.003;
/// Probability that an epoch misses a mode.
const MISSED: f64 = 0.08;

/// Loss of stiffness of the first mode.
#[derive(Debug, Clone, Copy)]
pub struct StiffnessLoss {
    /// Lost share of the stiffness.
    pub share: f64,
    /// Day of the series on which it happens, from 0.
    pub day: u32,
    /// Day of the series from which the stiffness is as before. `None` if it remains lost.
    pub repair_day: Option<u32>,
}

/// One row of the series.
#[derive(Debug, Clone, PartialEq)]
pub struct SeasonRow {
    /// Middle of the epoch, in days from the first midnight, which begins 1 July 2024 UTC.
    pub day: f64,
    /// Frequency of each mode (Hz), or `None` if it was not determined.
    pub frequencies: [Option<f64>; 2],
    /// Temperature of the deck (°C).
    pub deck: f64,
}

impl SeasonRow {
    /// Returns the middle of the epoch (s since 1970-01-01 UTC).
    #[must_use]
    pub fn time_s(&self) -> f64 {
        DAY_S * (self.day + FIRST_DAY)
    }
}

impl StiffnessLoss {
    /// Returns the remaining share of the stiffness at a time of the series (days).
    fn remaining(&self, day: f64) -> f64 {
        let is_repaired = self
            .repair_day
            .is_some_and(|repair| day >= f64::from(repair));
        match day >= f64::from(self.day) && !is_repaired {
            true => 1.0 - self.share,
            false => 1.0,
        }
    }
}

/// Returns the series as a CSV file, with an empty field for a frequency that was not determined.
#[must_use]
pub fn seasons_csv(rows: &[SeasonRow]) -> String {
    let mut text = "time,f1_hz,f2_hz,deck_celsius\n".to_owned();
    for row in rows {
        // Writing to a string cannot fail.
        let _ = write!(text, "{:.0},", row.time_s());
        for value in row.frequencies {
            if let Some(hertz) = value {
                let _ = write!(text, "{hertz:.4}");
            }
            text.push(',');
        }
        let _ = writeln!(text, "{:.2}", row.deck);
    }
    text
}

/// Returns the rows of some days, four a day. Series of different seeds are independent.
#[must_use]
pub fn seasons(seed: u64, days: u32, loss: Option<StiffnessLoss>) -> Vec<SeasonRow> {
    let mut random = SplitMix(seed);
    let mut weather = Memory::new(WEATHER.1, &mut random);
    let mut wander = MODES.map(|_| Memory::new(WANDER.1, &mut random));
    let mut hours = MODES.map(|_| Memory::new(HOURS.1, &mut random));
    let (mut deck, mut frozen) = (18.0, 0.0);
    let mut rows = Vec::new();
    for index in 0..days * PER_DAY {
        let day = (f64::from(index) + 0.5) / f64::from(PER_DAY);
        let season = AIR.1 * (TAU * (day / 365.25 - 0.05)).cos();
        let time_of_day = AIR.2 * (TAU * (day - 0.6)).cos();
        let air = AIR.0 + season + time_of_day + WEATHER.0 * weather.next(&mut random);
        deck = air + kept(DECK_DAYS) * (deck - air);
        let freezes = 1.0 / (1.0 + (1.5 * (deck + 1.0)).exp());
        frozen = freezes + kept(FROZEN_DAYS) * (frozen - freezes);
        let mut frequencies = [None; 2];
        for (mode, (frequency, slope, rise)) in MODES.into_iter().enumerate() {
            let scatter = WANDER.0 * wander[mode].next(&mut random)
                + HOURS.0 * hours[mode].next(&mut random)
                + ERROR * random.normal();
            let lost = loss.filter(|_| mode == 0);
            let stiffness = lost.map_or(1.0, |loss| loss.remaining(day));
            let value = frequency * (slope * deck + rise * frozen + scatter).exp();
            let is_present = random.uniform() >= MISSED;
            frequencies[mode] = is_present.then_some(value * stiffness.sqrt());
        }
        rows.push(SeasonRow {
            day,
            frequencies,
            deck,
        });
    }
    rows
}

/// A process with memory, of unit variance.
struct Memory {
    value: f64,
    kept: f64,
}

impl Memory {
    fn new(days: f64, random: &mut SplitMix) -> Self {
        Self {
            value: random.normal(),
            kept: kept(days),
        }
    }

    fn next(&mut self, random: &mut SplitMix) -> f64 {
        self.value =
            self.kept * self.value + (1.0 - self.kept * self.kept).sqrt() * random.normal();
        self.value
    }
}

/// SplitMix64 (Steele, Lea & Flood, 2014): the series must not change with a dependency.
struct SplitMix(u64);

impl SplitMix {
    /// Returns a number above 0 and at most 1.
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        bits ^= bits >> 31;
        ((bits >> 11) + 1) as f64 / (1_u64 << 53) as f64
    }

    /// Returns a standard normal number (Box & Muller, 1958).
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        radius * (TAU * self.uniform()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_changes_only_the_first_mode_until_its_repair() {
        let loss = StiffnessLoss {
            share: 0.19,
            day: 5,
            repair_day: Some(10),
        };
        let (sound, damaged) = (seasons(3, 20, None), seasons(3, 20, Some(loss)));
        for (sound, damaged) in sound.iter().zip(&damaged) {
            let [first, second] = sound.frequencies;
            let is_lost = (5.0..10.0).contains(&sound.day);
            let share = if is_lost { 0.9 } else { 1.0 }; // the frequency is √stiffness
            match (first, damaged.frequencies[0]) {
                (Some(sound), Some(found)) => assert!((found / sound - share).abs() < 1e-12),
                (sound, found) => assert_eq!(sound, found),
            }
            assert_eq!((second, sound.deck), (damaged.frequencies[1], damaged.deck));
        }
    }

    #[test]
    fn a_missing_frequency_is_an_empty_field() {
        let row = SeasonRow {
            day: 0.125,
            frequencies: [Some(2.272_49), None],
            deck: 14.736,
        };
        assert_eq!(
            seasons_csv(&[row]),
            "time,f1_hz,f2_hz,deck_celsius\n1719802800,2.2725,,14.74\n"
        );
    }
}
