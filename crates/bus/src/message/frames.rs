//! Frames: aligned samples of all channels of a structure.

use serde::{Deserialize, Serialize};

use super::block::continues;
use super::{
    Block, Format, Header, MAX_CHANNELS, MAX_ITEMS, Malformed, Message, StreamState, check_count,
    check_finite_or_missing,
};
use crate::grid::TimeGrid;

/// Consecutive frames.
///
/// Frame j of the block has number `header.sequence + j`. The time of frame k is
/// `t0_ns + round(k·10⁹/rate)`. The channels follow the order of the structure file, node by node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameBlock {
    /// Source: id of ingest. Sequence and time: number and time of the first frame in this block.
    pub header: Header,
    /// Time of frame 0, ns since the Unix epoch, UTC.
    pub t0_ns: i64,
    /// Sampling rate of the structure, Hz.
    pub sampling_rate_hz: f64,
    /// Number of channels per frame.
    pub channels: u16,
    /// Values, frame by frame, in the units of the channels. NaN = missing.
    pub values: Vec<f64>,
    /// Whether more frames follow this block.
    pub state: StreamState,
}

impl FrameBlock {
    /// Returns the times of the frames, from frame 0 of the epoch. `None` if the sampling rate is
    /// invalid, which [`Message::check`] excludes.
    #[must_use]
    pub fn grid(&self) -> Option<TimeGrid> {
        TimeGrid::new(self.t0_ns, self.sampling_rate_hz)
    }

    /// Iterates over the frames in order, with their numbers. Each frame has one value per channel.
    pub fn iter(&self) -> impl Iterator<Item = (u64, &[f64])> {
        let frames = self.values.chunks_exact(usize::from(self.channels).max(1));
        (self.header.sequence..).zip(frames)
    }
}

impl Message for FrameBlock {
    const TYPE: &'static str = "frames";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        let channels = usize::from(self.channels);
        check_count("channels", channels, 1, MAX_CHANNELS)?;
        if !self.values.len().is_multiple_of(channels) {
            return Err(Malformed::Length {
                what: "values",
                found: self.values.len(),
                expected: self.values.len().next_multiple_of(channels),
            });
        }
        check_count("frames", self.values.len() / channels, 0, MAX_ITEMS)?;
        if self.grid().is_none() {
            return Err(Malformed::Rate {
                found: self.sampling_rate_hz,
            });
        }
        check_finite_or_missing("values", &self.values)?;
        self.header.check(self.count())
    }
}

impl Block for FrameBlock {
    fn header(&self) -> &Header {
        &self.header
    }

    fn count(&self) -> u64 {
        (self.values.len() / usize::from(self.channels).max(1)) as u64
    }

    fn state(&self) -> StreamState {
        self.state
    }

    fn item_bytes(&self) -> usize {
        8 * usize::from(self.channels)
    }

    fn skip(&mut self, items: u64) {
        let items = items.min(self.count());
        self.header.sequence += items;
        if let Some(grid) = self.grid() {
            self.header.time_ns = grid.time_ns(self.header.sequence);
        }
        self.values
            .drain(..items as usize * usize::from(self.channels));
    }

    fn truncate(&mut self, items: u64) {
        if items < self.count() {
            self.values
                .truncate(items as usize * usize::from(self.channels));
            self.state = StreamState::Running;
        }
    }

    fn append(&mut self, next: &Self) -> bool {
        let follows = continues(&self.header, self.end(), self.state, &next.header)
            && self.t0_ns == next.t0_ns
            && self.sampling_rate_hz == next.sampling_rate_hz
            && self.channels == next.channels
            && self.count() + next.count() <= MAX_ITEMS as u64;
        if follows {
            self.values.extend_from_slice(&next.values);
            self.state = next.state;
        }
        follows
    }
}
