//! The samples of a node as frames, for the waveforms and spectra that its worker publishes.
//!
//! The frames are numbered on the grid of the node's sampling rate since 1970, as the filter counts
//! its samples. A missing sample is a frame without values.

use spandrel_bus::{Block, FrameBlock, Header, StreamState, TimeGrid};

/// Collects the samples of one input.
#[derive(Debug)]
pub(crate) struct NodeFrames {
    source: String,
    rate_hz: f64,
    channels: u16,
    grid: TimeGrid,
    blocks: Vec<FrameBlock>,
}

impl NodeFrames {
    /// Creates an empty collection for the samples of a node at `rate_hz` (Hz).
    ///
    /// Returns `None` if the rate or the number of channels does not fit into frames.
    pub(crate) fn new(source: &str, rate_hz: f64, channels: usize) -> Option<Self> {
        Some(Self {
            source: source.to_owned(),
            rate_hz,
            channels: u16::try_from(channels).ok()?,
            grid: TimeGrid::new(0, rate_hz)?,
            blocks: Vec::new(),
        })
    }

    /// Adds a sample of an epoch of the sensor. `number` is its number on the grid since 1970.
    ///
    /// Samples from before 1970 are left out.
    pub(crate) fn push(&mut self, epoch: u64, number: i64, sample: &[f64]) {
        let Ok(sequence) = u64::try_from(number) else {
            return;
        };
        let is_next = |block: &FrameBlock| block.header.epoch == epoch && block.end() == sequence;
        if !self.blocks.last().is_some_and(is_next) {
            self.blocks.push(FrameBlock {
                header: Header {
                    source: self.source.clone(),
                    epoch,
                    sequence,
                    time_ns: self.grid.time_ns(sequence),
                },
                t0_ns: self.grid.start_ns(),
                sampling_rate_hz: self.rate_hz,
                channels: self.channels,
                values: Vec::new(),
                state: StreamState::Running,
            });
        }
        if let Some(block) = self.blocks.last_mut() {
            block.values.extend_from_slice(sample);
        }
    }

    /// Removes and returns the collected frames.
    pub(crate) fn take(&mut self) -> Vec<FrameBlock> {
        std::mem::take(&mut self.blocks)
    }
}
