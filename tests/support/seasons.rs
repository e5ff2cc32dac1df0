//! A simulated footbridge: natural frequencies of two modes, and the temperature of its deck.

use std::f64::consts::TAU;

/// Epochs per day.
const PER_DAY: u32 = 4;
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
}

/// One row of the series.
#[derive(Debug, Clone)]
pub struct SeasonRow {
    /// Middle of the epoch, in days from the first midnight, which begins the first of July.
    pub day: f64,
    /// Frequency of each mode (Hz), or `None` if it was not determined.
    pub frequencies: [Option<f64>; 2],
    /// Temperature of the deck (°C).
    pub deck: f64,
}

/// Returns the rows of some days. Bridges of different seeds are independent.
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
            let lost = loss.filter(|loss| mode == 0 && day >= f64::from(loss.day));
            let stiffness = lost.map_or(1.0, |loss| 1.0 - loss.share);
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

/// Returns the share that a process with a memory of `days` keeps from one epoch to the next.
fn kept(days: f64) -> f64 {
    (-1.0 / (days * f64::from(PER_DAY))).exp()
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
