//! Nodes that tell one another a few of their samples.
//!
//! A node sees its own channels at the sampling rate. What relates one storey to another lies in the channels of others: a
//! few of their samples in each fusion period, with the white noise of their sensors, tell more than anything that is
//! filtered before, because nothing in them is counted twice. A node takes them one period late: it goes back to its last
//! message, filters the period once more with the samples of all, and goes on from there.

use crate::extended::FilterState;
use std::ops::Range;

/// Which of their samples nodes tell all others: at so many instants in a fusion period, evenly spaced, the last at its end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SampleExchange {
    /// observations of each node in the filter of all channels
    channels: Vec<Range<usize>>,
    instants: usize,
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
        Self { channels, instants: instants.max(1) }
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
        for (slot, sample) in self.outgoing.iter_mut().skip(start).zip(samples) {
            *slot = sample;
        }
    }

    /// Returns what is to be told of the period that ends now, and begins the next at message `index`.
    pub(super) fn end_period(&mut self, index: u64, steps: u64, state: &FilterState) -> Vec<f64> {
        let whole = |period: &Period| period.index + 1 == index && period.frames.len() as u64 == steps;
        self.ended = self.running.take().filter(whole);
        self.running = Some(Period { index, state: state.clone(), frames: Vec::with_capacity(steps as usize) });
        let len = self.outgoing.len();
        std::mem::replace(&mut self.outgoing, vec![f64::NAN; len])
    }

    /// Forgets the periods: the filter has begun anew, or samples are missing for long.
    pub(super) fn forget(&mut self) {
        (self.ended, self.running) = (None, None);
    }
}

#[cfg(test)]
mod tests;
