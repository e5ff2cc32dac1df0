//! Exchange of a few samples between nodes.
//!
//! A node filters its own channels at the full sampling rate. The relation between two storeys,
//! however, requires channels of other nodes. A few of their samples per fusion period, with the
//! white noise of their sensors, carry more information than any filtered quantity, because they
//! count nothing twice. A node uses them one period late: it returns to its last message, filters
//! the period again with the samples of all nodes, and continues from there.

use crate::extended::FilterState;
use std::ops::Range;

/// Rounding unit of sent samples as a share of the sensor's noise standard deviation.
///
/// An eighth adds 1/768 to the variance of the noise.
const UNIT_SHARE: f64 = 0.125;
/// Maximum magnitude of a sent sample in units.
const MOST_UNITS: f64 = i32::MAX as f64;

/// Returns the exponent of the rounding unit for a sensor with this noise standard deviation.
///
/// The unit is the largest power of two up to an eighth of the deviation, so that a sent sample is
/// a small whole number of units.
#[must_use]
pub fn unit_exponent(noise_std: f64) -> i16 {
    // The limits keep the unit in the range of normal numbers. A deviation of 0 has the smallest
    // unit.
    (noise_std * UNIT_SHARE)
        .log2()
        .floor()
        .clamp(-1022.0, 1000.0) as i16
}

/// The samples that nodes exchange, at a few instants in each fusion period.
///
/// The instants are evenly spaced, and the last one is at the end of the period.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SampleExchange {
    /// Observations of each node in the filter of all channels.
    channels: Vec<Range<usize>>,
    instants: usize,
    /// Exponents of the rounding units (powers of two) by observation. Samples without an exponent
    /// are not rounded.
    units: Vec<i16>,
}

impl SampleExchange {
    /// Creates the exchange from the number of observations of each node, in the order of the
    /// filter's observations.
    ///
    /// The exchange has at least one instant.
    #[must_use]
    pub fn new(observations: &[usize], instants: usize) -> Self {
        let mut first = 0;
        let channels = observations
            .iter()
            .map(|count| {
                first += count;
                first - count..first
            })
            .collect();
        Self {
            channels,
            instants: instants.max(1),
            units: Vec::new(),
        }
    }

    /// Rounds sent samples to whole multiples of 2^exponent, by observation.
    ///
    /// Samples without an exponent are not rounded.
    #[must_use]
    pub fn rounded_to(self, exponents: Vec<i16>) -> Self {
        Self {
            units: exponents,
            ..self
        }
    }

    /// Returns the unit exponents for the observations of a node; empty if its samples are not
    /// rounded.
    #[must_use]
    pub fn unit_exponents(&self, node: usize) -> &[i16] {
        self.units.get(self.channels(node)).unwrap_or_default()
    }

    /// Returns the number of nodes.
    #[must_use]
    pub fn nodes(&self) -> usize {
        self.channels.len()
    }

    /// Returns the number of instants in a fusion period.
    #[must_use]
    pub fn instants(&self) -> usize {
        self.instants
    }

    /// Returns the range of a node's observations in the filter.
    #[must_use]
    pub fn channels(&self, node: usize) -> Range<usize> {
        self.channels.get(node).cloned().unwrap_or_default()
    }

    /// Returns the count of numbers that a node sends in a fusion period.
    #[must_use]
    pub fn numbers(&self, node: usize) -> usize {
        self.instants * self.channels(node).len()
    }

    /// Returns the number of observations of all nodes.
    #[must_use]
    pub fn observations(&self) -> usize {
        self.channels.last().map_or(0, |last| last.end)
    }

    /// Returns `true` if `samples` has the right length and each value is finite or missing (NaN).
    pub(super) fn is_sound(&self, node: usize, samples: &[f64]) -> bool {
        samples.len() == self.numbers(node) && samples.iter().all(|sample| !sample.is_infinite())
    }
}

/// The samples between two messages of a node.
#[derive(Debug, Clone)]
pub(super) struct Period {
    /// Index of the message at the start of the period.
    pub(super) index: u64,
    /// State of the filter at the start, after the answer to that message if it arrived in time.
    pub(super) state: FilterState,
    /// Observations of all channels (NaN in channels of other nodes) and excitation.
    pub(super) frames: Vec<(Vec<f64>, Vec<f64>)>,
}

/// A node's data for the exchange.
#[derive(Debug, Clone)]
pub(super) struct Shared {
    /// The node's own observations in the filter of all channels.
    pub(super) own: Range<usize>,
    /// Number of samples from one instant to the next.
    pub(super) every: u64,
    /// Rounding units by channel. Channels without a unit are not rounded.
    units: Vec<f64>,
    /// Samples to send, by instant and channel.
    outgoing: Vec<f64>,
    /// The period that ended with the last message.
    pub(super) ended: Option<Period>,
    /// The period since the last message.
    pub(super) running: Option<Period>,
    /// Scratch: a frame of all channels.
    pub(super) frame: Vec<f64>,
}

impl Shared {
    pub(super) fn new(exchange: &SampleExchange, node: usize, steps_per_period: u64) -> Self {
        Self {
            own: exchange.channels(node),
            every: steps_per_period / exchange.instants() as u64,
            units: exchange
                .unit_exponents(node)
                .iter()
                .map(|exponent| 2f64.powi(i32::from(*exponent)))
                .collect(),
            outgoing: vec![f64::NAN; exchange.numbers(node)],
            ended: None,
            running: None,
            frame: vec![f64::NAN; exchange.observations()],
        }
    }

    /// Stores sample `number` of the period (from 1) if it belongs to an instant of the exchange.
    pub(super) fn tell(&mut self, number: u64, samples: impl Iterator<Item = f64>) {
        if !number.is_multiple_of(self.every) {
            return;
        }
        let start = (number / self.every - 1) as usize * self.own.len();
        let units = self.units.iter().map(Some).chain(std::iter::repeat(None));
        for ((slot, sample), unit) in self.outgoing.iter_mut().skip(start).zip(samples).zip(units) {
            *slot = match unit {
                None => sample,
                // exact: a whole number below 2^31 times a power of two
                Some(unit) if (sample / unit).abs() <= MOST_UNITS => (sample / unit).round() * unit,
                Some(_) => f64::NAN,
            };
        }
    }

    /// Returns the samples to send for the period that ends now, and starts the next period at
    /// message `index`.
    pub(super) fn end_period(&mut self, index: u64, steps: u64, state: &FilterState) -> Vec<f64> {
        let whole =
            |period: &Period| period.index + 1 == index && period.frames.len() as u64 == steps;
        self.ended = self.running.take().filter(whole);
        self.running = Some(Period {
            index,
            state: state.clone(),
            frames: Vec::with_capacity(steps as usize),
        });
        let len = self.outgoing.len();
        std::mem::replace(&mut self.outgoing, vec![f64::NAN; len])
    }

    /// Discards both periods after a restart of the filter or a long gap.
    pub(super) fn forget(&mut self) {
        (self.ended, self.running) = (None, None);
    }

    /// Discards both periods and the samples to send, which do not belong to the next period.
    pub(super) fn skip(&mut self) {
        self.forget();
        self.outgoing.fill(f64::NAN);
    }
}

#[cfg(test)]
mod tests;
