//! Samples of one node.

use serde::{Deserialize, Serialize};

use super::block::continues;
use super::{
    Block, Format, Header, MAX_CHANNELS, MAX_ITEMS, Malformed, Message, StreamState, check_count,
};
use crate::grid::TimeGrid;

/// Whether the node goes on.
pub type NodeState = StreamState;

/// Whether samples come as they are measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pace {
    /// As they are measured: a node that stays silent is late by the wall clock.
    Live,
    /// From a record or a simulation, at any speed: one node can lead another by thousands of blocks, and frames wait for
    /// the others without limit, so that the same record gives the same frames.
    Replayed,
}

/// Consecutive samples of all channels of one node.
///
/// Sample j is at `header.time_ns + round(j·10⁹/rate)`; a gap in time starts a new block. Values are in the units of
/// the channels; NaN is missing. Infinities are not refused here: ingest counts them against the channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SampleBlock {
    /// Source: the name of the node; sequence: number of its first sample here.
    pub header: Header,
    /// Sampling rate of the node, Hz.
    pub sampling_rate_hz: f64,
    /// Whether they come as they are measured.
    pub pace: Pace,
    /// Channels of the node.
    pub channels: u16,
    /// Sample-major: sample 0 of all channels, sample 1 of all channels, ...
    pub samples: Vec<f64>,
    /// Whether the node goes on after this block.
    pub state: NodeState,
}

impl SampleBlock {
    /// Times of the samples; `None` only if the block was never checked and its rate is no rate.
    #[must_use]
    pub fn grid(&self) -> Option<TimeGrid> {
        TimeGrid::new(self.header.time_ns, self.sampling_rate_hz)
    }

    /// The samples in order, each with a value per channel.
    pub fn iter(&self) -> impl Iterator<Item = &[f64]> {
        self.samples.chunks_exact(usize::from(self.channels).max(1))
    }
}

impl Message for SampleBlock {
    const TYPE: &'static str = "samples";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        let channels = usize::from(self.channels);
        check_count("channels", channels, 1, MAX_CHANNELS)?;
        if !self.samples.len().is_multiple_of(channels) {
            return Err(Malformed::Length {
                what: "samples",
                found: self.samples.len(),
                expected: self.samples.len().next_multiple_of(channels),
            });
        }
        check_count("samples", self.samples.len() / channels, 0, MAX_ITEMS)?;
        if self.grid().is_none() {
            return Err(Malformed::Rate {
                found: self.sampling_rate_hz,
            });
        }
        self.header.check(self.count())
    }
}

impl Block for SampleBlock {
    fn header(&self) -> &Header {
        &self.header
    }

    fn count(&self) -> u64 {
        (self.samples.len() / usize::from(self.channels).max(1)) as u64
    }

    fn state(&self) -> StreamState {
        self.state
    }

    fn item_bytes(&self) -> usize {
        8 * usize::from(self.channels)
    }

    fn skip(&mut self, items: u64) {
        let items = items.min(self.count());
        if let Some(grid) = self.grid() {
            self.header.time_ns = grid.time_ns(items);
        }
        self.header.sequence += items;
        self.samples
            .drain(..items as usize * usize::from(self.channels));
    }

    fn truncate(&mut self, items: u64) {
        if items < self.count() {
            self.samples
                .truncate(items as usize * usize::from(self.channels));
            self.state = StreamState::Running;
        }
    }

    fn append(&mut self, next: &Self) -> bool {
        // Both times are rounded, each on its own: 1 ns apart is no gap.
        const ROUNDING_NS: u64 = 1;
        let Some(grid) = self.grid() else {
            return false;
        };
        let follows = continues(&self.header, self.end(), self.state, &next.header)
            && self.sampling_rate_hz == next.sampling_rate_hz
            && self.channels == next.channels
            && grid.time_ns(self.count()).abs_diff(next.header.time_ns) <= ROUNDING_NS
            && self.count() + next.count() <= MAX_ITEMS as u64;
        if follows {
            self.samples.extend_from_slice(&next.samples);
            self.state = next.state;
        }
        follows
    }
}
