//! Samples of one node.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::block::continues;
use super::samples_text::{WrittenSamples, read_samples};
use super::{
    Block, Format, Header, MAX_CHANNELS, MAX_ITEMS, Malformed, Message, StreamState, check_count,
};
use crate::grid::TimeGrid;

/// Whether more samples of the node follow.
pub type NodeState = StreamState;

/// Whether the samples are live or replayed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pace {
    /// The samples are sent as they are measured. A silent node is late by the wall clock.
    Live,
    /// The samples come from a record or a simulation, at any speed.
    ///
    /// One node can be thousands of blocks ahead of another. Frames wait for all nodes without a
    /// time limit, so that the same record yields the same frames.
    Replayed,
}

/// Consecutive samples of all channels of one node.
///
/// The time of sample j is `header.time_ns + round(j·10⁹/rate)`. A gap in time starts a new block.
/// Values are in the units of the channels; NaN is missing. Infinite values are allowed here:
/// ingest counts them as faults of the channel. JSON cannot represent infinite values.
///
/// The derived functions of serde write the postcard format. The implementations of its traits
/// choose between postcard and JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(remote = "Self")]
pub struct SampleBlock {
    /// Source: name of the node; sequence: number of the first sample in this block.
    pub header: Header,
    /// Sampling rate of the node, Hz.
    pub sampling_rate_hz: f64,
    /// Whether the samples are live or replayed.
    pub pace: Pace,
    /// Number of channels of the node.
    pub channels: u16,
    /// Values, sample by sample: sample 0 of all channels, sample 1 of all channels, and so on.
    pub samples: Vec<f64>,
    /// Whether more samples of the node follow this block.
    pub state: NodeState,
    /// Quality of the times as the source states it, from 0 to 100 per cent. `None` if it states
    /// none.
    ///
    /// It travels as an attachment, so that readers of former versions read the block. Replies to
    /// queries do not contain it.
    #[serde(skip)]
    pub clock_quality: Option<u8>,
}

/// Start of the attachment with the quality of the times.
const CLOCK_QUALITY: &str = "clock-quality=";
/// Best quality of a time, per cent.
const BEST_CLOCK_QUALITY: u8 = 100;

impl SampleBlock {
    /// Returns the times of the samples. `None` if the sampling rate is invalid, which
    /// [`Message::check`] excludes.
    #[must_use]
    pub fn grid(&self) -> Option<TimeGrid> {
        TimeGrid::new(self.header.time_ns, self.sampling_rate_hz)
    }

    /// Iterates over the samples in order. Each has one value per channel.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &[f64]> {
        self.samples.chunks_exact(usize::from(self.channels).max(1))
    }
}

impl Serialize for SampleBlock {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match serializer.is_human_readable() {
            true => WrittenSamples::of(self).serialize(serializer),
            false => Self::serialize(self, serializer),
        }
    }
}

impl<'de> Deserialize<'de> for SampleBlock {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        match deserializer.is_human_readable() {
            true => read_samples(deserializer),
            false => Self::deserialize(deserializer),
        }
    }
}

impl Message for SampleBlock {
    const TYPE: &'static str = "samples";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Postcard;
    const ACCEPTED: &'static [Format] = &[Format::Postcard, Format::Json];

    fn attachment(&self) -> Option<String> {
        let quality = self.clock_quality?;
        Some(format!("{CLOCK_QUALITY}{quality}"))
    }

    fn attach(&mut self, attachment: &str) {
        let stated = attachment.strip_prefix(CLOCK_QUALITY);
        let quality = stated.and_then(|quality| quality.parse().ok());
        self.clock_quality = quality.filter(|quality| *quality <= BEST_CLOCK_QUALITY);
    }

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
        // Both times are rounded independently, so that a difference of 1 ns is not a gap.
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
            self.clock_quality = next.clock_quality;
        }
        follows
    }
}
