//! The samples of one node that wait for their frames.

use std::collections::VecDeque;

use spandrel_bus::{Block, SampleBlock, StreamState};

use crate::counts::Counts;

/// Most samples that wait; more are dropped and counted, because a node may be ahead for ever with a wrong clock.
const MAX_WAITING: usize = 1 << 17;
/// Room for so many samples is kept; what a node that was further ahead has taken is given back.
const ROOM_KEPT: usize = 1 << 10;
/// Most blocks that are put aside; enough for what a replay has on the way when it is started again.
const MAX_PARKED: usize = 1 << 13;

/// Whether samples of a node are to be waited for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Presence {
    /// More will come.
    Expected,
    /// The node has said that this was all.
    Ended,
    /// The node is gone without a word.
    Lost,
}

/// Samples in the order of their time.
#[derive(Debug)]
pub(crate) struct NodeQueue {
    ranges: Vec<f64>,
    times_ns: VecDeque<i64>,
    /// Epoch and number of each sample that waits in the stream of the node.
    numbers: VecDeque<(u64, u64)>,
    values: VecDeque<f64>,
    /// Epoch and number of the sample that comes next.
    next: (u64, u64),
    pub(crate) presence: Presence,
    /// Time of the newest sample of the node, usable or not, ns: frames before it need not wait.
    pub(crate) newest_ns: Option<i64>,
    /// Epoch of the node's last block.
    pub(crate) epoch: Option<u64>,
    /// Blocks of a time long gone, put aside until it is clear whether all nodes have gone back to it.
    parked: VecDeque<SampleBlock>,
}

impl NodeQueue {
    pub(crate) fn new(ranges: Vec<f64>) -> Self {
        Self {
            ranges,
            times_ns: VecDeque::new(),
            numbers: VecDeque::new(),
            values: VecDeque::new(),
            next: (0, 0),
            presence: Presence::Expected,
            newest_ns: None,
            epoch: None,
            parked: VecDeque::new(),
        }
    }

    pub(crate) fn channels(&self) -> usize {
        self.ranges.len()
    }

    /// Time of the first sample that waits, ns.
    pub(crate) fn first_ns(&self) -> Option<i64> {
        self.times_ns.front().copied()
    }

    /// Time of the last sample that waits, ns.
    pub(crate) fn last_waiting_ns(&self) -> Option<i64> {
        self.times_ns.back().copied()
    }

    /// Epoch and number of the first sample that has not gone into a frame.
    pub(crate) fn position(&self) -> (u64, u64) {
        self.numbers.front().copied().unwrap_or(self.next)
    }

    /// Goes on where the node stood in an earlier life of the alignment.
    pub(crate) fn go_on(&mut self, (epoch, sequence): (u64, u64), presence: Presence) {
        self.epoch = Some(epoch);
        self.next = (epoch, sequence);
        self.presence = presence;
    }

    pub(crate) fn is_parked(&self) -> bool {
        !self.parked.is_empty()
    }

    /// Puts a block of a time long gone aside.
    pub(crate) fn park(&mut self, block: SampleBlock, counts: &mut Counts) {
        if self.parked.len() < MAX_PARKED {
            self.parked.push_back(block);
        } else {
            counts.overflowed += block.count();
        }
    }

    /// The blocks put aside, which count from now on.
    pub(crate) fn unpark(&mut self) -> VecDeque<SampleBlock> {
        std::mem::take(&mut self.parked)
    }

    /// Drops the blocks put aside: the node alone had gone back.
    pub(crate) fn drop_parked(&mut self, counts: &mut Counts) {
        counts.late += self.unpark().iter().map(Block::count).sum::<u64>();
    }

    /// Takes the samples of a block that has the right channels.
    pub(crate) fn push(&mut self, block: &SampleBlock, counts: &mut Counts) {
        let Some(grid) = block.grid() else {
            return; // a checked block has a grid
        };
        for (number, sample) in (0..).zip(block.iter()) {
            let time_ns = grid.time_ns(number);
            // The clock of the node has gone back: what was ahead of it was wrong.
            while self.times_ns.back().is_some_and(|last| *last >= time_ns) {
                self.times_ns.pop_back();
                self.numbers.pop_back();
                self.values.truncate(self.values.len() - self.channels());
                counts.retracted += 1;
            }
            self.give_back();
            self.newest_ns = Some(time_ns);
            if self.times_ns.len() >= MAX_WAITING {
                counts.overflowed += 1;
                continue;
            }
            self.times_ns.push_back(time_ns);
            self.numbers
                .push_back((block.header.epoch, block.header.sequence + number));
            let checked = sample
                .iter()
                .zip(&self.ranges)
                .map(|(value, range)| checked(*value, *range, counts));
            self.values.extend(checked);
        }
        self.next = (block.header.epoch, block.end());
        self.presence = match block.state {
            StreamState::Running => Presence::Expected,
            StreamState::Ended => Presence::Ended,
        };
    }

    /// Moves the first sample into its place in a frame.
    pub(crate) fn pop_into(&mut self, frame: &mut [f64]) {
        self.times_ns.pop_front();
        self.numbers.pop_front();
        for (place, value) in frame.iter_mut().zip(self.values.drain(..self.ranges.len())) {
            *place = value;
        }
        self.give_back();
    }

    /// Drops the first sample.
    pub(crate) fn pop(&mut self) {
        self.times_ns.pop_front();
        self.numbers.pop_front();
        self.values.drain(..self.ranges.len());
        self.give_back();
    }

    /// Keeps room for twice what waits once three quarters of it are empty.
    fn give_back(&mut self) {
        let (waiting, room) = (self.times_ns.len(), self.times_ns.capacity());
        if room <= 2 * ROOM_KEPT || waiting >= room / 4 {
            return;
        }
        let kept = (2 * waiting).max(ROOM_KEPT);
        self.times_ns.shrink_to(kept);
        self.numbers.shrink_to(kept);
        self.values.shrink_to(kept * self.ranges.len());
    }
}

/// The value, or missing if no sensor can have measured it.
fn checked(value: f64, range: f64, counts: &mut Counts) -> f64 {
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
        }
    }

    fn room(queue: &NodeQueue) -> usize {
        queue.values.capacity() * 8 + queue.times_ns.capacity() * 8 + queue.numbers.capacity() * 16
    }

    #[test]
    fn what_a_node_that_was_ahead_has_taken_is_given_back() {
        let (mut queue, mut counts) = (NodeQueue::new(vec![1.0; 2]), Counts::default());
        queue.push(&block(0, 0, 100_000), &mut counts);
        let most = room(&queue);
        let mut frame = [0.0; 2];
        for _ in 0..99_900 {
            queue.pop_into(&mut frame);
        }
        assert_eq!((queue.first_ns(), frame), (Some(999_000_000_000), [0.5; 2]));
        assert!(
            room(&queue) <= 4 * ROOM_KEPT * 40,
            "{} of {most} bytes",
            room(&queue)
        );
        // a clock that goes back takes what was ahead with it
        queue.push(&block(100_000, 1_000_000_000_000, 100_000), &mut counts);
        queue.push(&block(200_000, 999_000_000_000, 1), &mut counts);
        assert!(
            room(&queue) <= 4 * ROOM_KEPT * 40,
            "{} of {most} bytes",
            room(&queue)
        );
        assert_eq!(queue.first_ns(), queue.last_waiting_ns());
    }
}
