//! A simulated structure over years: weather, temperatures, and natural frequencies as a program
//! would identify them.
//!
//! It shares no equation with `spandrel-judge`. Its frequencies depend on two temperatures with
//! different memories, of which one is measured, or only that of the air. Asphalt softens
//! exponentially with warmth, and ice grows and melts with the heat that it takes. Moisture is
//! never measured. Every seed is another structure in another climate.

use super::{PER_DAY, kept};
use crate::statistics::{Normal, Uniform};
use spandrel_judge::Epoch;
use std::f64::consts::TAU;

const DAY_S: f64 = 86_400.0;
/// Day of the year (from 1 January) with the warmest air.
const WARMEST_DAY: f64 = 200.0;
/// Decay of the stiffness of asphalt with its temperature (1/°C).
const ASPHALT_DECAY: f64 = 0.04;
/// Share of epochs in which a frequency belongs to another mode, and how far it is off.
const CONFUSED: f64 = 0.005;
const CONFUSED_BY: f64 = 0.03;

/// What is simulated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted {
    pub(super) modes: usize,
    pub(super) days: u32,
    /// Day of the year on which the series begins.
    pub(super) first_day: f64,
    pub(super) loss: Option<Loss>,
    pub(super) site: Site,
}

/// How massive the structure is, and where its thermometer is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Site {
    /// A slender structure with a thermometer in its deck.
    Slender,
    /// A massive structure: its core follows the air within days. Only the air has a thermometer.
    Massive,
}

impl Site {
    /// Returns the smallest and the largest time constant of the core (days).
    fn core_days(self) -> (f64, f64) {
        match self {
            Self::Slender => (0.4, 1.5),
            Self::Massive => (1.5, 6.0),
        }
    }
}

/// A loss of stiffness of the first mode.
#[derive(Debug, Clone, Copy)]
pub(super) struct Loss {
    pub(super) share: f64,
    /// Day of the series on which it happens.
    pub(super) day: u32,
}

/// Returns the epochs of the structure of a seed: its natural frequencies, and the temperature of
/// its thermometer (°C).
pub(super) fn epochs(seed: u64, wanted: Wanted) -> Vec<Epoch> {
    let mut uniform = Uniform::stream(seed, 0);
    let mut climate = Climate::new(&mut uniform, seed, wanted.site);
    let mut gaps = [
        Gaps::new(seed, 1, 90.0, 4.0),
        Gaps::new(seed, 2, 180.0, 3.0),
    ];
    let mut modes: Vec<Mode> = (0..wanted.modes)
        .map(|mode| Mode::new(&mut uniform, seed, mode))
        .collect();
    let mut moisture = Memory::new(seed, 3, uniform.between(20.0, 45.0));
    let mut chance = Uniform::stream(seed, 4);
    let mut rows = Vec::new();
    for index in 0..wanted.days * PER_DAY {
        let day = (f64::from(index) + 0.5) / f64::from(PER_DAY);
        let air = climate.next(wanted.first_day + day);
        let water = moisture.next();
        let [no_record, no_thermometer] = gaps.each_mut().map(Gaps::next);
        let mut values = Vec::with_capacity(modes.len());
        for (number, mode) in modes.iter_mut().enumerate() {
            let lost = wanted
                .loss
                .filter(|loss| number == 0 && day >= f64::from(loss.day));
            let stiffness = lost.map_or(1.0, |loss| 1.0 - loss.share);
            let value = mode
                .next(&air, water, &mut chance)
                .map(|f| f * stiffness.sqrt());
            values.push(value.filter(|_| !no_record));
        }
        rows.push(Epoch {
            time_s: DAY_S * day,
            quantities: values,
            conditions: vec![(!no_thermometer).then_some(climate.thermometer(wanted.site))],
        });
    }
    rows
}

/// Temperatures of a structure (°C), and the frozen share of its water.
#[derive(Debug, Clone, Copy, Default)]
struct Temperatures {
    air: f64,
    deck: f64,
    core: f64,
    ice: f64,
}

struct Climate {
    mean: f64,
    yearly: f64,
    daily: f64,
    scatter: f64,
    weather: Memory,
    error: Normal,
    deck_days: f64,
    core_days: f64,
    /// Heat that freezes all water (°C · days).
    latent: f64,
    now: Option<Temperatures>,
}

impl Climate {
    fn new(uniform: &mut Uniform, seed: u64, site: Site) -> Self {
        let (shortest, longest) = site.core_days();
        Self {
            mean: uniform.between(3.0, 15.0),
            yearly: uniform.between(6.0, 12.0),
            daily: uniform.between(2.0, 5.0),
            scatter: uniform.between(2.0, 4.5),
            weather: Memory::new(seed, 5, uniform.between(1.5, 4.0)),
            error: Normal::stream(seed, 6),
            deck_days: uniform.between(0.1, 0.4),
            core_days: uniform.between(shortest, longest),
            latent: uniform.between(2.0, 8.0),
            now: None,
        }
    }

    fn next(&mut self, day: f64) -> Temperatures {
        let season = self.yearly * (TAU * (day - WARMEST_DAY) / 365.25).cos();
        let hour = self.daily * (TAU * (day - 0.6)).cos();
        let air = self.mean + season + hour + self.scatter * self.weather.next();
        let before = self.now.unwrap_or(Temperatures {
            air,
            deck: self.mean + season,
            core: self.mean + season,
            ice: 0.0,
        });
        let frozen = -before.deck / (self.latent * f64::from(PER_DAY));
        let now = Temperatures {
            air,
            deck: air + kept(self.deck_days) * (before.deck - air),
            core: air + kept(self.core_days) * (before.core - air),
            ice: (before.ice + frozen).clamp(0.0, 1.0),
        };
        self.now = Some(now);
        now
    }

    fn thermometer(&mut self, site: Site) -> f64 {
        let celsius = self.now.map_or(0.0, |now| match site {
            Site::Slender => now.deck,
            Site::Massive => now.air,
        });
        celsius + 0.2 * self.error.draw()
    }
}

struct Mode {
    frequency: f64,
    /// Relative change per degree of the core (1/°C), share of the asphalt, rise when frozen,
    /// change with moisture.
    slope: f64,
    asphalt: f64,
    rise: f64,
    moisture: f64,
    wander: Memory,
    wanders: f64,
    error: Normal,
    scatter: f64,
    missed: f64,
}

impl Mode {
    fn new(uniform: &mut Uniform, seed: u64, mode: usize) -> Self {
        let stream = 100 + 2 * mode as u64;
        Self {
            frequency: 2.0 * 1.6_f64.powf(mode as f64 + uniform.between(-0.2, 0.2)),
            slope: -uniform.between(0.000_1, 0.001),
            asphalt: uniform.between(0.0, 0.01),
            rise: uniform.between(0.0, 0.04),
            moisture: uniform.between(-0.000_7, 0.000_7),
            wander: Memory::new(seed, stream, uniform.between(3.0, 12.0)),
            wanders: uniform.between(0.000_4, 0.001_2),
            error: Normal::stream(seed, stream + 1),
            scatter: uniform.between(0.001_5, 0.004),
            missed: uniform.between(0.02, 0.3),
        }
    }

    /// Returns the identified frequency (Hz), or `None` if the epoch misses the mode.
    fn next(&mut self, now: &Temperatures, water: f64, chance: &mut Uniform) -> Option<f64> {
        let asphalt = (1.0 + self.asphalt * (-ASPHALT_DECAY * (now.deck - 10.0)).exp()).ln();
        let known = self.slope * now.core + asphalt + self.rise * now.ice;
        let unknown = self.moisture * water + self.wanders * self.wander.next();
        let wrong = match chance.between(0.0, 1.0) {
            share if share < 0.5 * CONFUSED => -CONFUSED_BY,
            share if share < CONFUSED => CONFUSED_BY,
            _ => 0.0,
        };
        let error = self.scatter * self.error.draw() + wrong;
        let present = chance.between(0.0, 1.0) >= self.missed;
        present.then_some(self.frequency * (known + unknown + error).exp())
    }
}

/// Gaps whose beginnings and lengths are exponentially distributed.
struct Gaps {
    random: Uniform,
    every_days: f64,
    last_days: f64,
    /// Epochs until the next change, and whether the gap is open.
    left: f64,
    open: bool,
}

impl Gaps {
    fn new(seed: u64, stream: u64, every_days: f64, last_days: f64) -> Self {
        let mut random = Uniform::stream(seed, stream);
        let left = exponential(&mut random, every_days) * f64::from(PER_DAY);
        Self {
            random,
            every_days,
            last_days,
            left,
            open: false,
        }
    }

    fn next(&mut self) -> bool {
        self.left -= 1.0;
        if self.left < 0.0 {
            self.open = !self.open;
            let mean = if self.open {
                self.last_days
            } else {
                self.every_days
            };
            self.left = exponential(&mut self.random, mean) * f64::from(PER_DAY);
        }
        self.open
    }
}

fn exponential(random: &mut Uniform, mean: f64) -> f64 {
    -mean * random.between(1e-9, 1.0).ln()
}

/// A stationary process with memory, of unit variance.
struct Memory {
    random: Normal,
    value: f64,
    kept: f64,
}

impl Memory {
    fn new(seed: u64, stream: u64, days: f64) -> Self {
        let mut random = Normal::stream(seed, stream);
        Self {
            value: random.draw(),
            kept: kept(days),
            random,
        }
    }

    fn next(&mut self) -> f64 {
        let fresh = (1.0 - self.kept * self.kept).sqrt();
        self.value = self.kept * self.value + fresh * self.random.draw();
        self.value
    }
}
