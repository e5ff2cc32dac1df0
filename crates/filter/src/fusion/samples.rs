//! Nodes that tell one another a few of their samples.
//!
//! A node sees its own channels at the sampling rate. What relates one storey to another lies in the channels of others: a
//! few of their samples in each fusion period, with the white noise of their sensors, tell more than anything that is
//! filtered before, because nothing in them is counted twice. A node takes them one period late: it goes back to its last
//! message, filters the period once more with the samples of all, and goes on from there.

use crate::extended::FilterState;
use std::ops::Range;

/// The part of a sensor's noise deviation that told samples are rounded to. An eighth adds 1/768 to the variance of the noise.
const UNIT_SHARE: f64 = 0.125;
/// Most units of a told sample.
const MOST_UNITS: f64 = i32::MAX as f64;

/// The exponent of the unit that samples of a sensor with this noise deviation are told in: the largest power of two that is no more
/// than an eighth of it, so that a told sample is a small whole number.
#[must_use]
pub fn unit_exponent(noise_std: f64) -> i16 {
    // the range of normal numbers; what is no number gets the smallest unit
    (noise_std * UNIT_SHARE)
        .log2()
        .floor()
        .clamp(-1022.0, 1000.0) as i16
}

/// Which of their samples nodes tell all others: at so many instants in a fusion period, evenly spaced, the last at its end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SampleExchange {
    /// observations of each node in the filter of all channels
    channels: Vec<Range<usize>>,
    instants: usize,
    /// by observation, exponent of the power of two that told samples are whole multiples of; none: told as they are
    units: Vec<i16>,
}

impl SampleExchange {
    /// Makes the exchange of nodes that have so many observations each, in the order of the filter's observations; at least one
    /// instant.
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

    /// Rounds what is told to whole multiples of 2^exponent, by observation; missing exponents round nothing.
    #[must_use]
    pub fn rounded_to(self, exponents: Vec<i16>) -> Self {
        Self {
            units: exponents,
            ..self
        }
    }

    /// Returns the exponents of the units in which a node tells its samples, by its observations; none if they are not rounded.
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

    /// Returns which observations of the filter are those of a node.
    #[must_use]
    pub fn channels(&self, node: usize) -> Range<usize> {
        self.channels.get(node).cloned().unwrap_or_default()
    }

    /// Returns how many numbers a node tells in a fusion period.
    #[must_use]
    pub fn numbers(&self, node: usize) -> usize {
        self.instants * self.channels(node).len()
    }

    /// Returns the number of observations of all nodes.
    #[must_use]
    pub fn observations(&self) -> usize {
        self.channels.last().map_or(0, |last| last.end)
    }

    /// Tells whether these are samples of a node for one period: as many as there should be, finite or missing (NaN).
    pub(super) fn is_sound(&self, node: usize, samples: &[f64]) -> bool {
        samples.len() == self.numbers(node) && samples.iter().all(|sample| !sample.is_infinite())
    }
}

/// Samples from one message of a node to the next.
#[derive(Debug, Clone)]
pub(super) struct Period {
    /// The message at its beginning.
    pub(super) index: u64,
    /// The filter then, after the answer to that message where one came in time.
    pub(super) state: FilterState,
    /// Observations of all channels, those of others missing, and excitation.
    pub(super) frames: Vec<(Vec<f64>, Vec<f64>)>,
}

/// What a node keeps for the exchange.
#[derive(Debug, Clone)]
pub(super) struct Shared {
    /// its own observations in the filter of all channels
    pub(super) own: Range<usize>,
    /// samples from one instant to the next
    pub(super) every: u64,
    /// what its samples are rounded to, by channel; fewer: as they are
    units: Vec<f64>,
    /// what it will tell, by instant and channel
    outgoing: Vec<f64>,
    /// the period that its last message has ended
    pub(super) ended: Option<Period>,
    /// the period since
    pub(super) running: Option<Period>,
    /// scratch: a frame of all channels
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

    /// Keeps what is told of the sample with this number in the period, from 1.
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

    /// Returns what is to be told of the period that ends now, and begins the next at message `index`.
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

    /// Forgets the periods: the filter has begun anew, or samples are missing for long.
    pub(super) fn forget(&mut self) {
        (self.ended, self.running) = (None, None);
    }

    /// Forgets the periods, and what was to be told: it is of another period than the samples to come.
    pub(super) fn skip(&mut self) {
        self.forget();
        self.outgoing.fill(f64::NAN);
    }
}

#[cfg(test)]
mod tests;
