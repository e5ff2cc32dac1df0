//! The queue of samples of one node that wait for their frames.

use std::collections::VecDeque;

use spandrel_bus::{Block, NodeClock, SampleBlock, StreamState};
use spandrel_checkpoint::Position;

use crate::counts::NodeCounts;
use crate::sampling_instants::{SamplingInstants, Stamp};

/// Maximum number of waiting samples. Further samples are dropped and counted, because a node with
/// a wrong clock may be permanently ahead.
const MAX_WAITING: usize = 1 << 17;
/// Minimum capacity to keep, in samples. Capacity beyond the requirement is released after a node
/// was further ahead.
const ROOM_KEPT: usize = 1 << 10;
/// Maximum number of parked blocks. It covers the blocks in transit from a replay that restarts.
const MAX_PARKED: usize = 1 << 13;
/// Longest span of parked live blocks, ns, while other nodes deliver samples of the present run. It
/// exceeds the time after which nodes that have gone back begin a new run.
const PARKED_LIVE_NS: i64 = 2_000_000_000;

/// The state of a node, which determines whether frames wait for its samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Presence {
    /// The node is expected to send more samples.
    Expected,
    /// The node has ended its stream.
    Ended,
    /// The node has disappeared without ending its stream.
    Lost,
    /// The clock of the node differs from that of the majority.
    Distrusted,
}

/// The waiting samples of a node in time order.
#[derive(Debug)]
pub(crate) struct NodeQueue {
    ranges: Vec<f64>,
    times_ns: VecDeque<i64>,
    /// Position of each waiting sample in the stream of the node.
    positions: VecDeque<Position>,
    values: VecDeque<f64>,
    /// Position of the next sample.
    next: Position,
    pub(crate) presence: Presence,
    /// Time of the newest sample of the node, usable or not, ns. Earlier frames need not wait for
    /// this node.
    pub(crate) newest_ns: Option<i64>,
    /// Epoch of the last block of the node.
    pub(crate) epoch: Option<u64>,
    /// Blocks from the past, parked until it is clear whether all nodes have gone back.
    parked: VecDeque<SampleBlock>,
    /// Number of blocks in time of all nodes when the first parked block arrived.
    pub(crate) in_time_when_parked: u64,
    /// Number of deadlines when the first parked block arrived.
    pub(crate) deadlines_when_parked: u64,
    /// What has become of the samples of this node.
    pub(crate) counts: NodeCounts,
    /// Position of the first sample that the recording does not contain. Samples of this epoch
    /// before it only determine the sampling instants of the node.
    resumed_at: Position,
    instants: SamplingInstants,
}

impl NodeQueue {
    pub(crate) fn new(ranges: Vec<f64>, tolerance_ns: i64) -> Self {
        Self {
            instants: SamplingInstants::new(ranges.len(), tolerance_ns),
            resumed_at: Position::default(),
            ranges,
            times_ns: VecDeque::new(),
            positions: VecDeque::new(),
            values: VecDeque::new(),
            next: Position::default(),
            presence: Presence::Expected,
            newest_ns: None,
            epoch: None,
            parked: VecDeque::new(),
            in_time_when_parked: 0,
            deadlines_when_parked: 0,
            counts: NodeCounts::default(),
        }
    }

    pub(crate) fn channels(&self) -> usize {
        self.ranges.len()
    }

    /// Returns the time of the first waiting sample, ns.
    pub(crate) fn first_ns(&self) -> Option<i64> {
        self.times_ns.front().copied()
    }

    /// Returns the time of the last waiting sample, ns.
    pub(crate) fn last_waiting_ns(&self) -> Option<i64> {
        self.times_ns.back().copied()
    }

    /// Returns the position of the first sample that is not yet part of a frame.
    pub(crate) fn position(&self) -> Position {
        self.positions.front().copied().unwrap_or(self.next)
    }

    /// Resumes from a recorded position in the stream of the node.
    pub(crate) fn go_on(&mut self, position: Position, presence: Presence) {
        self.epoch = Some(position.epoch);
        self.next = position;
        self.resumed_at = position;
        self.presence = presence;
    }

    /// Returns when the node samples, or `None` if it samples at the times of the frames.
    pub(crate) fn clock(&self) -> Option<NodeClock> {
        self.instants.clock()
    }

    pub(crate) fn is_parked(&self) -> bool {
        !self.parked.is_empty()
    }

    /// Parks a block from the past, or counts its samples as overflowed if too many blocks are
    /// parked.
    pub(crate) fn park(&mut self, block: SampleBlock) {
        self.counts.received += block.count();
        if self.parked.len() < MAX_PARKED {
            self.parked.push_back(block);
        } else {
            self.counts.overflowed += block.count();
        }
    }

    /// Drops the parked blocks that are more than [`PARKED_LIVE_NS`] older than `newest`, and
    /// counts their samples as late.
    pub(crate) fn drop_old_parked(&mut self, newest: &SampleBlock) {
        let is_old = |parked: &mut SampleBlock| {
            parked.header.time_ns.saturating_add(PARKED_LIVE_NS) < newest.header.time_ns
        };
        while let Some(old) = self.parked.pop_front_if(is_old) {
            self.counts.late += old.count();
        }
    }

    /// Returns the time between the first and the last parked block, ns.
    pub(crate) fn parked_ns(&self) -> i64 {
        match (self.parked.front(), self.parked.back()) {
            (Some(first), Some(last)) => last.header.time_ns.saturating_sub(first.header.time_ns),
            _ => 0,
        }
    }

    /// Removes and returns the parked blocks, which are about to be received again.
    pub(crate) fn unpark(&mut self) -> VecDeque<SampleBlock> {
        let parked = std::mem::take(&mut self.parked);
        self.counts.received -= parked.iter().map(Block::count).sum::<u64>();
        parked
    }

    /// Drops the parked blocks and counts them as late, because only this node had gone back.
    pub(crate) fn drop_parked(&mut self) {
        let parked = std::mem::take(&mut self.parked);
        self.counts.late += parked.iter().map(Block::count).sum::<u64>();
    }

    /// Drops all samples, because the clock of the node is wrong.
    pub(crate) fn distrust(&mut self) {
        let parked = std::mem::take(&mut self.parked);
        self.counts.wrong_clock += parked.iter().map(Block::count).sum::<u64>();
        self.counts.wrong_clock += self.times_ns.len() as u64;
        self.times_ns.clear();
        self.positions.clear();
        self.values.clear();
        self.give_back();
        self.newest_ns = None;
        self.presence = Presence::Distrusted;
    }

    /// Drops a block of a node whose clock is wrong.
    pub(crate) fn drop_block(&mut self, block: &SampleBlock) {
        self.counts.received += block.count();
        self.counts.wrong_clock += block.count();
        self.epoch = Some(block.header.epoch);
        self.next = end_of(block);
    }

    /// Returns the number of first samples of a block that the recording contains already.
    pub(crate) fn known(&self, block: &SampleBlock) -> u64 {
        let Position { epoch, sequence } = self.resumed_at;
        match block.header.epoch == epoch {
            true => sequence
                .saturating_sub(block.header.sequence)
                .min(block.count()),
            false => 0,
        }
    }

    /// Reads the samples of a block that the recording contains already.
    pub(crate) fn remember(&mut self, block: &SampleBlock) {
        let Some(grid) = block.grid() else {
            return;
        };
        self.instants.set_rate(block.sampling_rate_hz);
        let known = self.known(block);
        for (number, sample) in (0..known).zip(block.iter()) {
            let stamp = Stamp {
                position: position_in(block, number),
                time_ns: grid.time_ns(number),
            };
            // They were counted when they became part of frames.
            let mut counted = NodeCounts::default();
            let values = sample.iter().zip(&self.ranges);
            let values = values.map(|(value, range)| checked(*value, *range, &mut counted));
            self.instants.pass(stamp, values);
        }
    }

    /// Appends the samples of a block, which must have the right number of channels.
    pub(crate) fn push(&mut self, block: &SampleBlock) {
        let Some(grid) = block.grid() else {
            // A checked block has a grid.
            return;
        };
        self.remember(block);
        let known = self.known(block);
        self.counts.received += block.count() - known;
        for (number, sample) in (0..).zip(block.iter()) {
            let time_ns = grid.time_ns(number);
            let stamp = Stamp {
                position: position_in(block, number),
                time_ns,
            };
            if number < known {
                continue;
            }
            // The clock of the node has gone back, so the waiting samples from this time on were
            // wrong.
            while self.times_ns.back().is_some_and(|last| *last >= time_ns) {
                self.times_ns.pop_back();
                self.positions.pop_back();
                self.values.truncate(self.values.len() - self.channels());
                self.counts.retracted += 1;
            }
            self.give_back();
            self.newest_ns = Some(time_ns);
            if self.times_ns.len() >= MAX_WAITING {
                self.counts.overflowed += 1;
                continue;
            }
            self.times_ns.push_back(time_ns);
            self.positions.push_back(stamp.position);
            let checked = sample
                .iter()
                .zip(&self.ranges)
                .map(|(value, range)| checked(*value, *range, &mut self.counts));
            self.values.extend(checked);
        }
        self.next = match known == block.count() {
            true => self.next,
            false => end_of(block),
        };
        self.presence = match block.state {
            StreamState::Running => Presence::Expected,
            StreamState::Ended => Presence::Ended,
        };
    }

    /// Returns `true` if samples that the value at a frame depends on have not arrived yet.
    pub(crate) fn awaits_neighbours(&mut self, frame_ns: i64) -> bool {
        let Some(stamp) = self.first() else {
            return false;
        };
        let steps = self.instants.steps_from(frame_ns, stamp);
        steps.is_some_and(|steps| self.times_ns.len() <= SamplingInstants::required_after(steps))
    }

    /// Moves the first sample into `frame`, as it would have been at the time of the frame.
    pub(crate) fn pop_into(&mut self, frame: &mut [f64], frame_ns: i64) {
        for (place, value) in frame.iter_mut().zip(&self.values) {
            *place = *value;
        }
        if let Some(stamp) = self.first()
            && let Some(steps) = self.instants.steps_from(frame_ns, stamp)
        {
            let stamps = self.positions.iter().zip(&self.times_ns).skip(1);
            let next = stamps.map(|(position, time_ns)| Stamp {
                position: *position,
                time_ns: *time_ns,
            });
            self.instants
                .interpolate(steps, stamp, next, &self.values, frame);
        }
        self.pop();
    }

    /// Drops the first sample.
    pub(crate) fn pop(&mut self) {
        let Some(stamp) = self.first() else {
            return;
        };
        self.times_ns.pop_front();
        self.positions.pop_front();
        self.instants
            .pass(stamp, self.values.drain(..self.ranges.len()));
        self.give_back();
    }

    fn first(&self) -> Option<Stamp> {
        let (position, time_ns) = (*self.positions.front()?, *self.times_ns.front()?);
        Some(Stamp { position, time_ns })
    }

    /// Shrinks the capacity to twice the length if three quarters of it are unused.
    fn give_back(&mut self) {
        let (waiting, room) = (self.times_ns.len(), self.times_ns.capacity());
        if room <= 2 * ROOM_KEPT || waiting >= room / 4 {
            return;
        }
        let kept = (2 * waiting).max(ROOM_KEPT);
        self.times_ns.shrink_to(kept);
        self.positions.shrink_to(kept);
        self.values.shrink_to(kept * self.ranges.len());
    }
}

/// Returns the position of the sample with this index in a block.
fn position_in(block: &SampleBlock, index: u64) -> Position {
    Position {
        epoch: block.header.epoch,
        sequence: block.header.sequence + index,
    }
}

/// Returns the position after a block.
fn end_of(block: &SampleBlock) -> Position {
    Position {
        epoch: block.header.epoch,
        sequence: block.end(),
    }
}

/// Returns the value, or NaN if it is infinite or beyond the range of its channel.
fn checked(value: f64, range: f64, counts: &mut NodeCounts) -> f64 {
    if value.is_infinite() {
        counts.not_finite += 1;
        return f64::NAN;
    }
    if value.abs() > range {
        counts.out_of_range += 1;
        return f64::NAN;
    }
    value
}

#[cfg(test)]
mod tests {
    use spandrel_bus::{Header, Pace};

    use super::*;

    fn block(sequence: u64, time_ns: i64, count: usize) -> SampleBlock {
        SampleBlock {
            header: Header {
                source: "roof".into(),
                epoch: 1,
                sequence,
                time_ns,
            },
            sampling_rate_hz: 100.0,
            pace: Pace::Live,
            channels: 2,
            samples: vec![0.5; 2 * count],
            state: StreamState::Running,
            clock_quality: None,
        }
    }

    fn room(queue: &NodeQueue) -> usize {
        queue.values.capacity() * 8
            + queue.times_ns.capacity() * 8
            + queue.positions.capacity() * 16
    }

    #[test]
    fn memory_of_a_node_that_was_ahead_is_released() {
        let mut queue = NodeQueue::new(vec![1.0; 2], 1_000);
        queue.push(&block(0, 0, 100_000));
        let most = room(&queue);
        let mut frame = [0.0; 2];
        for _ in 0..99_900 {
            queue.pop_into(&mut frame, 0);
        }
        assert_eq!((queue.first_ns(), frame), (Some(999_000_000_000), [0.5; 2]));
        assert!(
            room(&queue) <= 4 * ROOM_KEPT * 40,
            "{} of {most} bytes",
            room(&queue)
        );
        // When a clock goes back, the queue drops the samples that were ahead.
        queue.push(&block(100_000, 1_000_000_000_000, 100_000));
        queue.push(&block(200_000, 999_000_000_000, 1));
        assert!(
            room(&queue) <= 4 * ROOM_KEPT * 40,
            "{} of {most} bytes",
            room(&queue)
        );
        assert_eq!(queue.first_ns(), queue.last_waiting_ns());
    }
}
