//! Cuts the rows of a node into numbered sample blocks.

use spandrel_bus::{Block, Header, Pace, SampleBlock, StreamState, TimeGrid};

use crate::node_rows::Row;

/// Duration of a block, s. Shorter packets are collected up to it.
pub const BLOCK_S: f64 = 0.05;
/// Maximum number of samples in a block.
const MAX_BLOCK: u64 = 512;
/// Maximum deviation of a sample from the even spacing of its block, as a fraction of the time
/// step. A larger deviation starts a new block. `spandrel replay` uses the same.
const UNEVEN_SHARE: f64 = 0.01;

/// The open block of a node.
#[derive(Clone, Debug)]
pub(crate) struct Blocks {
    open: SampleBlock,
    step_ns: f64,
    full: u64,
    last_ns: Option<i64>,
}

impl Blocks {
    /// Creates the blocks of a node. The first block has sequence number 0.
    pub(crate) fn new(node: &str, channels: u16, rate_hz: f64, epoch: u64) -> Self {
        Self {
            open: SampleBlock {
                header: Header {
                    source: node.to_owned(),
                    epoch,
                    sequence: 0,
                    time_ns: 0,
                },
                sampling_rate_hz: rate_hz,
                pace: Pace::Live,
                channels,
                samples: Vec::new(),
                state: StreamState::Running,
                clock_quality: None,
            },
            step_ns: 1e9 / rate_hz,
            full: ((BLOCK_S * rate_hz) as u64).clamp(1, MAX_BLOCK),
            last_ns: None,
        }
    }

    /// Sets the quality of the times, per cent, from the open block on.
    pub(crate) fn set_clock_quality(&mut self, quality: Option<u8>) {
        self.open.clock_quality = quality;
    }

    /// Adds rows, and appends complete blocks to `blocks`.
    pub(crate) fn push(&mut self, rows: Vec<Row>, blocks: &mut Vec<SampleBlock>) {
        for row in rows {
            // Times with jitter may overlap the previous packet. Ingest requires that they
            // increase.
            let least_ns = self
                .last_ns
                .map(|last_ns| last_ns.saturating_add((0.5 * self.step_ns) as i64));
            let time_ns = least_ns.map_or(row.time_ns, |least_ns| row.time_ns.max(least_ns));
            if self.open.count() > 0 && !self.continues(time_ns) {
                self.flush(blocks);
            }
            if self.open.samples.is_empty() {
                self.open.header.time_ns = time_ns;
            }
            self.open.samples.extend(row.values);
            self.last_ns = Some(time_ns);
            if self.open.count() >= MAX_BLOCK {
                self.flush(blocks);
            }
        }
        if self.open.count() >= self.full {
            self.flush(blocks);
        }
    }

    /// Ends the open block, and appends it to `blocks` unless it is empty.
    pub(crate) fn flush(&mut self, blocks: &mut Vec<SampleBlock>) {
        if self.open.count() == 0 {
            return;
        }
        let mut next = self.open.clone();
        next.skip(self.open.count());
        blocks.push(std::mem::replace(&mut self.open, next));
    }

    /// Starts a new epoch. The open block must be empty.
    pub(crate) fn restart(&mut self, epoch: u64) {
        self.open.header.epoch = epoch;
        self.open.header.sequence = 0;
        self.open.samples.clear();
        self.last_ns = None;
    }

    /// Returns the epoch.
    pub(crate) fn epoch(&self) -> u64 {
        self.open.header.epoch
    }

    fn continues(&self, time_ns: i64) -> bool {
        let Some(grid) = TimeGrid::new(self.open.header.time_ns, self.open.sampling_rate_hz) else {
            return false;
        };
        let off_ns = grid.time_ns(self.open.count()).abs_diff(time_ns);
        off_ns as f64 <= UNEVEN_SHARE * self.step_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: i64 = 10_000_000;

    fn row(time_ns: i64, value: f64) -> Row {
        Row {
            time_ns,
            values: vec![value],
        }
    }

    #[test]
    fn blocks_follow_each_other_in_number_across_a_gap_in_time() {
        let mut cut = Blocks::new("roof", 1, 100.0, 7);
        let mut blocks = Vec::new();
        cut.push(
            (0..5).map(|n| row(n * STEP, n as f64)).collect(),
            &mut blocks,
        );
        cut.push(
            (90..95).map(|n| row(n * STEP, n as f64)).collect(),
            &mut blocks,
        );
        let heads: Vec<_> = blocks
            .iter()
            .map(|block| (block.header.sequence, block.header.time_ns, block.count()))
            .collect();
        assert_eq!(heads, [(0, 0, 5), (5, 90 * STEP, 5)]);
    }

    #[test]
    fn single_samples_are_collected_and_the_rest_can_be_flushed() {
        let mut cut = Blocks::new("roof", 1, 100.0, 7);
        let mut blocks = Vec::new();
        for number in 0..7 {
            cut.push(vec![row(number * STEP, 0.0)], &mut blocks);
        }
        assert_eq!(blocks.len(), 1); // 5 samples are 50 ms
        cut.flush(&mut blocks);
        assert_eq!((blocks[1].header.sequence, blocks[1].count()), (5, 2));
    }

    #[test]
    fn times_always_increase() {
        let mut cut = Blocks::new("roof", 1, 100.0, 7);
        let mut blocks = Vec::new();
        cut.push(
            vec![row(0, 0.0), row(STEP, 1.0), row(STEP - 1, 2.0)],
            &mut blocks,
        );
        cut.flush(&mut blocks);
        let last = blocks.last().unwrap();
        assert_eq!(
            (last.header.time_ns, last.samples.as_slice()),
            (STEP + STEP / 2, &[2.0][..])
        );
    }
}
