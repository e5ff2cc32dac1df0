//! The latest items of a stream, kept for those who missed them.

use std::collections::VecDeque;

use crate::message::{Block, CaughtUp, Header, StreamState};
use crate::range::QueryRange;

/// Most bytes of one answer, roughly: a few Zenoh batches, so that an answer is rarely dropped under load.
const ANSWER_BYTES: usize = 256 << 10;

/// The last items that a source has put, in their order.
///
/// Full means that the oldest block is forgotten; who asks for it gets the oldest one left, and sees the gap.
#[derive(Clone, Debug)]
pub struct Ring<B> {
    source: String,
    epoch: u64,
    blocks: VecDeque<B>,
    items: u64,
    capacity: u64,
    next: u64,
    state: StreamState,
}

/// What a ring answers.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer<B> {
    /// Items, the first at or after the number asked for.
    Block(B),
    /// There are none yet.
    CaughtUp(CaughtUp),
}

/// A block that does not follow the one before.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "block starts at item {found} of epoch {found_epoch}, expected item {expected} of epoch {epoch} or a later epoch"
)]
pub struct NotConsecutive {
    /// Number expected.
    pub expected: u64,
    /// Epoch of the stream.
    pub epoch: u64,
    /// Number found.
    pub found: u64,
    /// Epoch found.
    pub found_epoch: u64,
}

impl<B: Block> Ring<B> {
    /// An empty ring that keeps at least the last `capacity` items.
    #[must_use]
    pub fn new(source: String, epoch: u64, capacity: u64) -> Self {
        Self { source, epoch, blocks: VecDeque::new(), items: 0, capacity, next: 0, state: StreamState::Running }
    }

    /// Number of the item expected next.
    #[must_use]
    pub fn next(&self) -> u64 {
        self.next
    }

    /// Adds the next block; one of a higher epoch replaces everything.
    ///
    /// The first block of an epoch may start at any number: a source that goes on from a checkpoint does.
    ///
    /// # Errors
    /// The block does not follow the last one, or its epoch is over.
    pub fn push(&mut self, block: B) -> Result<(), NotConsecutive> {
        let header = block.header();
        let restarts = header.epoch > self.epoch;
        let begins = header.epoch == self.epoch && self.next == 0 && self.blocks.is_empty();
        let follows = header.epoch == self.epoch && header.sequence == self.next;
        if !(restarts || begins || follows) {
            return Err(NotConsecutive {
                expected: self.next,
                epoch: self.epoch,
                found: header.sequence,
                found_epoch: header.epoch,
            });
        }
        if restarts {
            *self = Self::new(header.source.clone(), header.epoch, self.capacity);
        }
        self.source.clone_from(&block.header().source);
        self.next = block.end();
        self.state = block.state();
        self.items += block.count();
        self.blocks.push_back(block);
        while let Some(oldest) = self.blocks.front() {
            let left = self.items - oldest.count();
            if left < self.capacity || self.blocks.len() == 1 {
                break;
            }
            self.items = left;
            self.blocks.pop_front();
        }
        Ok(())
    }

    /// The items asked for, joined to one block as far as they fit, or that there are none.
    #[must_use]
    pub fn answer(&self, range: &QueryRange) -> Answer<B> {
        let same_epoch = range.epoch.is_none_or(|epoch| epoch == self.epoch);
        let after = if same_epoch { range.after } else { 0 };
        let first = self.blocks.partition_point(|b| b.end() <= after);
        let Some(first_block) = self.blocks.get(first) else {
            return self.answer_at_the_end(after);
        };
        let mut answer = first_block.clone();
        answer.skip(after.saturating_sub(answer.header().sequence));
        let fits = (ANSWER_BYTES / answer.item_bytes().max(1)).max(1) as u64;
        let limit = range.limit.clamp(1, fits);
        for block in self.blocks.iter().skip(first + 1) {
            if answer.count() >= limit {
                break;
            }
            let mut block = block.clone();
            block.truncate(limit - answer.count());
            if !answer.append(&block) {
                break;
            }
        }
        answer.truncate(limit);
        Answer::Block(answer)
    }

    /// Whoever has all items may still not know that the stream has ended.
    fn answer_at_the_end(&self, after: u64) -> Answer<B> {
        match self.blocks.back() {
            Some(last) if self.state == StreamState::Ended && after == self.next => {
                let mut end = last.clone();
                end.skip(end.count());
                Answer::Block(end)
            }
            _ => Answer::CaughtUp(CaughtUp {
                header: Header { source: self.source.clone(), epoch: self.epoch, sequence: self.next, time_ns: 0 },
                state: self.state,
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::frames;

    fn range(after: u64, limit: u64) -> QueryRange {
        QueryRange { after, limit, epoch: None }
    }

    fn ring(capacity: u64, blocks: &[u64]) -> Ring<crate::FrameBlock> {
        let mut ring = Ring::new("source".into(), 1, capacity);
        for &count in blocks {
            ring.push(frames(1, ring.next(), count)).unwrap();
        }
        ring
    }

    fn numbers(answer: Answer<crate::FrameBlock>) -> (u64, u64) {
        match answer {
            Answer::Block(block) => (block.header.sequence, block.end()),
            Answer::CaughtUp(at) => (at.header.sequence, at.header.sequence),
        }
    }

    #[test]
    fn an_answer_joins_blocks_up_to_the_limit() {
        let ring = ring(100, &[3, 4, 5]);
        assert_eq!(numbers(ring.answer(&range(1, 100))), (1, 12));
        assert_eq!(numbers(ring.answer(&range(1, 4))), (1, 5));
        assert_eq!(ring.answer(&range(5, 2)), Answer::Block(frames(1, 5, 2)));
    }

    #[test]
    fn what_is_forgotten_is_answered_with_the_oldest_left() {
        let ring = ring(5, &[3, 3, 3]);
        assert_eq!(numbers(ring.answer(&range(0, 1))), (3, 4));
    }

    #[test]
    fn the_last_items_asked_for_are_always_kept() {
        let ring = ring(5, &[2, 2, 2, 2]);
        assert_eq!(numbers(ring.answer(&range(3, 1))), (3, 4));
    }

    #[test]
    fn who_has_everything_is_told_so() {
        assert!(matches!(
            ring(5, &[3]).answer(&range(3, 9)),
            Answer::CaughtUp(CaughtUp { header: Header { epoch: 1, sequence: 3, .. }, .. })
        ));
        assert_eq!(numbers(ring(5, &[]).answer(&range(u64::MAX, 9))), (0, 0));
    }

    #[test]
    fn who_has_everything_is_told_that_it_has_ended() {
        let mut ring = ring(5, &[3]);
        let mut last = frames(1, 3, 1);
        last.state = StreamState::Ended;
        ring.push(last).unwrap();
        let Answer::Block(end) = ring.answer(&range(4, 9)) else {
            panic!("no block");
        };
        assert_eq!((end.header.sequence, end.count()), (4, 0));
        assert_eq!(end.state, StreamState::Ended);
    }

    #[test]
    fn a_higher_epoch_replaces_everything_and_a_lower_one_is_refused() {
        let mut ring = ring(5, &[3]);
        ring.push(frames(2, 0, 1)).unwrap();
        assert_eq!(numbers(ring.answer(&range(0, 9))), (0, 1));
        assert!(ring.push(frames(1, 3, 1)).is_err());
    }

    #[test]
    fn an_asker_in_another_epoch_gets_the_oldest() {
        let other = QueryRange { epoch: Some(7), ..range(2, 9) };
        assert_eq!(numbers(ring(5, &[3]).answer(&other)), (0, 3));
    }

    #[test]
    fn a_block_that_skips_items_is_refused() {
        let error = ring(5, &[3]).push(frames(1, 4, 1)).unwrap_err();
        assert_eq!((error.expected, error.found), (3, 4));
    }
}
