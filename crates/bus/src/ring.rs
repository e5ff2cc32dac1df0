//! Buffer of the latest items of a stream, for readers that have missed them.

use std::marker::PhantomData;
use std::time::{Duration, Instant};

use crate::kept::{Kept, KeptBlocks};
use crate::message::{Block, CaughtUp, Header, StreamState};
use crate::range::QueryRange;

/// Approximate maximum size of one reply, in bytes. A few Zenoh batches are rarely dropped under
/// load.
pub(crate) const ANSWER_BYTES: usize = 256 << 10;

/// A bounded buffer of the most recent items of a stream.
///
/// A publisher stores its latest blocks here, so that subscribers can fetch blocks that they have
/// missed. Blocks remain encoded, which takes a third of the memory of decoded blocks.
///
/// When the ring is full, it drops the oldest block. A query for a dropped block returns the oldest
/// remaining block, and the subscriber detects the gap from its sequence number.
#[derive(Clone, Debug)]
pub struct Ring<B> {
    source: String,
    epoch: u64,
    /// Term of the leader. Replies contain this term, also with blocks stored in an earlier term.
    term: u64,
    blocks: KeptBlocks,
    items: u64,
    keep: Keep,
    /// Number of the first item that a known reader may still need.
    released: u64,
    next: u64,
    state: StreamState,
    block: PhantomData<fn(B)>,
}

/// Limits of the contents of a ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Keep {
    /// Maximum number of items, rounded up to whole blocks.
    pub last: u64,
    /// Earlier removal of items that a reader may still need. `None`: they stay until the ring is
    /// full.
    pub needed: Option<Forget>,
    /// Earlier removal of items that were [released](Ring::release). `None`: as for other items.
    pub released: Option<Forget>,
}

impl Keep {
    /// Keeps the last `last` items, regardless of their age.
    #[must_use]
    pub fn last(last: u64) -> Self {
        Self {
            last,
            needed: None,
            released: None,
        }
    }
}

/// Removal of blocks by age, before a ring is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Forget {
    /// Number of the latest items that are kept regardless of their age.
    pub at_least: u64,
    /// Age from which items are removed, except for the latest `at_least` items.
    pub after: Duration,
}

/// Reply of a ring.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer<B> {
    /// A block. Its first item is at or after the requested number.
    Block(B),
    /// There are no such items yet.
    CaughtUp(CaughtUp),
}

/// A block that does not follow the previous block.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "block starts at item {found} of epoch {found_epoch}, expected item {expected} of epoch \
     {epoch} or a later epoch"
)]
pub struct NotConsecutive {
    /// Expected sequence number.
    pub expected: u64,
    /// Epoch of the stream.
    pub epoch: u64,
    /// Sequence number found.
    pub found: u64,
    /// Epoch found.
    pub found_epoch: u64,
}

impl<B: Block> Ring<B> {
    /// Creates an empty ring.
    #[must_use]
    pub fn new(source: String, epoch: u64, keep: Keep) -> Self {
        let (blocks, state) = (KeptBlocks::default(), StreamState::Running);
        Self {
            source,
            epoch,
            term: 0,
            blocks,
            items: 0,
            keep,
            released: 0,
            next: 0,
            state,
            block: PhantomData,
        }
    }

    /// Continues at item `first` of the epoch. The ring does not contain earlier items.
    #[must_use]
    pub fn going_on(self, first: u64, state: StreamState) -> Self {
        Self {
            next: first,
            state,
            ..self
        }
    }

    /// Sets the term of the leader for all replies.
    pub(crate) fn lead(&mut self, term: u64) {
        self.term = term;
    }

    /// Returns the term of the leader.
    pub(crate) fn term(&self) -> u64 {
        self.term
    }

    /// Returns the epoch.
    pub(crate) fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Returns the number of the oldest stored item, or of the next item if the ring is empty.
    pub(crate) fn first(&self) -> u64 {
        self.blocks
            .front()
            .map_or(self.next, |oldest| oldest.sequence)
    }

    /// Returns the number of the next expected item.
    #[must_use]
    pub fn next(&self) -> u64 {
        self.next
    }

    /// Releases the items before number `first` of an epoch, which no known reader needs any
    /// longer.
    pub fn release(&mut self, epoch: u64, first: u64) {
        if epoch == self.epoch {
            self.released = first;
        }
    }

    /// Removes the items from number `first` on. The source will publish them again.
    pub fn take_back(&mut self, first: u64) {
        while let Some(last) = self.blocks.back().filter(|last| last.end() > first) {
            let (sequence, put_at, kept) = (
                last.sequence,
                last.put_at,
                first.saturating_sub(last.sequence),
            );
            let part = if kept > 0 { decode::<B>(&last) } else { None };
            self.items -= last.count;
            self.blocks.pop_back();
            if let Some(mut part) = part {
                part.truncate(kept);
                if let Ok(payload) = part.encode() {
                    self.items += kept;
                    self.blocks.push(sequence, kept, &payload, put_at);
                }
            }
        }
        self.next = first;
        self.state = StreamState::Running;
    }

    /// Adds the next block with its encoding, published at `now`. A block of a higher epoch
    /// replaces the whole contents.
    ///
    /// The first block of an epoch may start at any number, because a source can resume from a
    /// checkpoint.
    ///
    /// # Errors
    /// Fails if the block does not follow the previous block or belongs to an earlier epoch.
    pub fn push(&mut self, block: &B, payload: &[u8], now: Instant) -> Result<(), NotConsecutive> {
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
            let term = self.term;
            *self = Self::new(header.source.clone(), header.epoch, self.keep);
            self.term = term;
        }
        self.source.clone_from(&header.source);
        self.next = block.end();
        self.state = block.state();
        self.items += block.count();
        self.blocks
            .push(header.sequence, block.count(), payload, now);
        self.forget(now);
        Ok(())
    }

    fn forget(&mut self, now: Instant) {
        while let Some(oldest) = self.blocks.front().filter(|_| self.blocks.len() > 1) {
            let left = self.items - oldest.count;
            let is_released = oldest.end() <= self.released;
            let forget = self
                .keep
                .released
                .filter(|_| is_released)
                .or(self.keep.needed);
            let is_old = forget.is_some_and(|forget| {
                left >= forget.at_least && now.duration_since(oldest.put_at) >= forget.after
            });
            if left < self.keep.last && !is_old {
                return;
            }
            self.items = left;
            self.blocks.pop_front();
        }
    }

    /// Returns the requested items, joined to one block up to the size limit, or reports that there
    /// are none.
    #[must_use]
    pub fn answer(&self, range: &QueryRange) -> Answer<B> {
        let same_epoch = range.epoch.is_none_or(|epoch| epoch == self.epoch);
        let after = if same_epoch { range.after } else { 0 };
        let mut blocks = self.blocks.after(after);
        let Some(mut answer) = blocks.next().and_then(|kept| self.decode(&kept)) else {
            return self.answer_at_the_end(after);
        };
        answer.skip(after.saturating_sub(answer.header().sequence));
        let fits = (ANSWER_BYTES / answer.item_bytes().max(1)).max(1) as u64;
        let limit = range.limit.clamp(1, fits);
        for block in blocks {
            if answer.count() >= limit {
                break;
            }
            let Some(mut block) = self.decode(&block) else {
                break;
            };
            block.truncate(limit - answer.count());
            if !answer.append(&block) {
                break;
            }
        }
        answer.truncate(limit);
        Answer::Block(answer)
    }

    fn decode(&self, kept: &Kept<'_>) -> Option<B> {
        let mut block = decode::<B>(kept)?;
        block.set_term(self.term);
        Some(block)
    }

    /// Replies to a reader that has all items. If the stream has ended, the reader may not know it
    /// yet.
    fn answer_at_the_end(&self, after: u64) -> Answer<B> {
        let has_all = self.state == StreamState::Ended && after == self.next;
        match self
            .blocks
            .back()
            .filter(|_| has_all)
            .and_then(|kept| self.decode(&kept))
        {
            Some(mut end) => {
                end.skip(end.count());
                Answer::Block(end)
            }
            None => Answer::CaughtUp(CaughtUp {
                header: Header {
                    source: self.source.clone(),
                    epoch: self.epoch,
                    sequence: self.next,
                    time_ns: 0,
                },
                state: self.state,
            }),
        }
    }
}

fn decode<B: Block>(kept: &Kept<'_>) -> Option<B> {
    B::decode(&B::encoding(), kept.payload).ok() // encoded by this crate
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::Message;
    use crate::testing::{frames, push};

    fn range(after: u64, limit: u64) -> QueryRange {
        QueryRange {
            after,
            limit,
            epoch: None,
        }
    }

    fn ring(capacity: u64, blocks: &[u64]) -> Ring<crate::FrameBlock> {
        let mut ring = Ring::new("source".into(), 1, Keep::last(capacity));
        for &count in blocks {
            let next = ring.next();
            push(&mut ring, &frames(1, next, count)).unwrap();
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
    fn reply_joins_blocks_up_to_the_limit() {
        let ring = ring(100, &[3, 4, 5]);
        assert_eq!(numbers(ring.answer(&range(1, 100))), (1, 12));
        assert_eq!(numbers(ring.answer(&range(1, 4))), (1, 5));
        assert_eq!(ring.answer(&range(5, 2)), Answer::Block(frames(1, 5, 2)));
    }

    #[test]
    fn query_for_dropped_items_returns_the_oldest_remaining_block() {
        let ring = ring(5, &[3, 3, 3]);
        assert_eq!(numbers(ring.answer(&range(0, 1))), (3, 4));
    }

    #[test]
    fn ring_keeps_at_least_its_capacity() {
        let ring = ring(5, &[2, 2, 2, 2]);
        assert_eq!(numbers(ring.answer(&range(3, 1))), (3, 4));
    }

    #[test]
    fn withdrawn_items_can_be_stored_again() {
        let mut ring = ring(100, &[3, 4, 5]);
        ring.take_back(5);
        assert_eq!(
            (ring.next(), numbers(ring.answer(&range(0, 100)))),
            (5, (0, 5))
        );
        push(&mut ring, &frames(1, 5, 9)).unwrap();
        assert_eq!(numbers(ring.answer(&range(0, 100))), (0, 14));
    }

    /// Creates a ring that received a block of two frames per second for one minute.
    #[expect(
        clippy::disallowed_methods,
        reason = "origin of the fixed times of the tests"
    )]
    fn of_a_minute(keep: Keep, release: impl Fn(u64) -> u64) -> (Ring<crate::FrameBlock>, Instant) {
        let mut ring = Ring::new("source".into(), 1, keep);
        let start = Instant::now();
        for second in 0..60 {
            let block = frames(1, 2 * second, 2);
            ring.release(1, release(second));
            ring.push(
                &block,
                &block.encode().unwrap(),
                start + Duration::from_secs(second),
            )
            .unwrap();
        }
        (ring, start)
    }

    #[test]
    fn old_items_are_dropped_except_the_last() {
        let forget = Forget {
            at_least: 4,
            after: Duration::from_secs(30),
        };
        let (mut ring, start) = of_a_minute(
            Keep {
                needed: Some(forget),
                ..Keep::last(100)
            },
            |_| 0,
        );
        assert_eq!(ring.first(), 60, "30 s of the last 60");
        let late = frames(1, 120, 1);
        ring.push(
            &late,
            &late.encode().unwrap(),
            start + Duration::from_secs(1000),
        )
        .unwrap();
        assert_eq!(
            (ring.first(), ring.next()),
            (116, 121),
            "whole blocks with four items or more"
        );
    }

    #[test]
    fn needed_items_are_kept_longer_than_released_items() {
        let keep = Keep {
            needed: Some(Forget {
                at_least: 40,
                after: Duration::from_secs(30),
            }),
            released: Some(Forget {
                at_least: 4,
                after: Duration::from_secs(10),
            }),
            ..Keep::last(100)
        };
        let first = |release: fn(u64) -> u64| of_a_minute(keep, release).0.first();
        assert_eq!(first(|_| 0), 60, "nobody says anything: 30 s");
        assert_eq!(first(|second| 2 * second), 100, "the reader has all: 10 s");
        assert_eq!(
            first(|second| second.min(15) * 2),
            60,
            "it has gone away, and what it had is old anyway"
        );
        assert_eq!(
            first(|second| second.min(40) * 2),
            80,
            "it has gone away, and finds all that it has not"
        );
        let restarted = of_a_minute(keep, |second| 2 * second);
        let mut ring = restarted.0;
        push(&mut ring, &frames(2, 0, 1)).unwrap();
        ring.release(1, 1000);
        assert_eq!(
            (ring.first(), ring.released),
            (0, 0),
            "nothing is released of an epoch that has begun"
        );
    }

    #[test]
    fn full_ring_drops_needed_items_too() {
        let keep = Keep {
            released: Some(Forget {
                at_least: 0,
                after: Duration::ZERO,
            }),
            ..Keep::last(40)
        };
        assert_eq!(of_a_minute(keep, |_| 0).0.first(), 80);
        assert_eq!(
            of_a_minute(keep, |second| 2 * second).0.first(),
            118,
            "the last block is always kept"
        );
    }

    #[test]
    fn reader_with_all_items_receives_caught_up() {
        assert!(matches!(
            ring(5, &[3]).answer(&range(3, 9)),
            Answer::CaughtUp(CaughtUp {
                header: Header {
                    epoch: 1,
                    sequence: 3,
                    ..
                },
                ..
            })
        ));
        assert_eq!(numbers(ring(5, &[]).answer(&range(u64::MAX, 9))), (0, 0));
    }

    #[test]
    fn reader_with_all_items_receives_the_end() {
        let mut ring = ring(5, &[3]);
        let mut last = frames(1, 3, 1);
        last.state = StreamState::Ended;
        push(&mut ring, &last).unwrap();
        let Answer::Block(end) = ring.answer(&range(4, 9)) else {
            panic!("no block");
        };
        assert_eq!((end.header.sequence, end.count()), (4, 0));
        assert_eq!(end.state, StreamState::Ended);
    }

    #[test]
    fn a_higher_epoch_replaces_everything_and_a_lower_one_is_refused() {
        let mut ring = ring(5, &[3]);
        push(&mut ring, &frames(2, 0, 1)).unwrap();
        assert_eq!(numbers(ring.answer(&range(0, 9))), (0, 1));
        assert!(push(&mut ring, &frames(1, 3, 1)).is_err());
    }

    #[test]
    fn resumed_ring_accepts_the_next_item_and_replies_with_its_position() {
        let mut ring =
            Ring::new("source".into(), 1, Keep::last(5)).going_on(7, StreamState::Running);
        assert_eq!(
            (ring.first(), numbers(ring.answer(&range(0, 9)))),
            (7, (7, 7))
        );
        assert!(push(&mut ring, &frames(1, 0, 1)).is_err());
        push(&mut ring, &frames(1, 7, 2)).unwrap();
        assert_eq!(
            (ring.first(), numbers(ring.answer(&range(0, 9)))),
            (7, (7, 9))
        );
    }

    #[test]
    fn query_of_another_epoch_returns_the_oldest_items() {
        let other = QueryRange {
            epoch: Some(7),
            ..range(2, 9)
        };
        assert_eq!(numbers(ring(5, &[3]).answer(&other)), (0, 3));
    }

    #[test]
    fn a_block_that_skips_items_is_refused() {
        let error = push(&mut ring(5, &[3]), &frames(1, 4, 1)).unwrap_err();
        assert_eq!((error.expected, error.found), (3, 4));
    }
}
