//! Brings the blocks of a lossless stream into order, and says what to fetch.
//!
//! A pure state machine: blocks and answers go in; what to deliver, what to fetch and what is lost come out. Whatever
//! is dropped, doubled, reordered or cut into other blocks on the way, every item is delivered exactly once and in
//! order, or is part of a gap that is delivered in its place.

use std::collections::BTreeMap;
use std::collections::VecDeque;

use crate::message::{Block, CaughtUp, StreamState};
use crate::range::QueryRange;
use crate::ring::Answer;

/// Where to start reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// At item 0 of the running epoch; what the source no longer has is a gap.
    Beginning,
    /// At the next item that is put.
    Now,
    /// At an item, as after a checkpoint; in a later epoch, at its item 0.
    At {
        /// The epoch of the checkpoint.
        epoch: u64,
        /// Number of the first item wanted.
        sequence: u64,
    },
}

/// Items that can no longer be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gap {
    /// The epoch.
    pub epoch: u64,
    /// Number of the first item lost.
    pub from: u64,
    /// Number of the first item after the gap.
    pub to: u64,
}

/// What the reader gets, in order.
#[derive(Clone, Debug, PartialEq)]
pub enum Delivery<B> {
    /// Items that follow the delivery before; a higher epoch starts anew at item 0.
    Block(B),
    /// Items lost for good.
    Gap(Gap),
}

/// What the shell has to do, in order.
#[derive(Clone, Debug, PartialEq)]
pub enum Action<B> {
    /// Hand this to the reader.
    Deliver(Delivery<B>),
    /// Ask the source, and report with [`Follower::answered`] or [`Follower::unanswered`]; one at a time.
    Fetch {
        /// What to ask for.
        range: QueryRange,
        /// How often this has failed in a row: the shell pauses accordingly.
        failures: u32,
    },
}

/// Why a fetch has brought nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Silence {
    /// Nobody has ever been there to answer.
    NoBuffer,
    /// Somebody has, but did not answer in time.
    NoAnswer,
    /// Somebody has answered, but not with what was asked for, or not in a way that could be read.
    Denied,
}

/// How long missing items are asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Patience {
    /// Eight times, some 6 s: what came behind them must not be late as well. For samples.
    Limited,
    /// Until the source answers that it no longer has them, however long it is away: it keeps them on disk, or makes them
    /// again. What it has of an epoch that is over comes before the next epoch. For frames and estimates.
    UntilAnswered,
}

/// What did not come straight through.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FollowCounts {
    /// Items delivered.
    pub delivered_items: u64,
    /// Items that came again.
    pub duplicate_items: u64,
    /// Items that were fetched from the source.
    pub fetched_items: u64,
    /// Items lost for good.
    pub gap_items: u64,
    /// Blocks of an epoch that is over.
    pub stale_blocks: u64,
    /// Blocks of another source in the same epoch.
    pub foreign_blocks: u64,
    /// Blocks of a source that another one has superseded.
    pub superseded_blocks: u64,
    /// Blocks ahead of a gap that could not be kept; they are fetched again.
    pub unkept_blocks: u64,
    /// Times that blocks were numbered beyond what their source says that it has put.
    pub impossible_blocks: u64,
}

/// Blocks kept that arrived ahead of a gap; more are fetched again. Enough for a source of 40 blocks per second that keeps
/// nothing, until its missing items are given up.
const HELD_BLOCKS: usize = 256;
/// Fetches without an answer after which missing items are given up.
const MAX_FAILURES: u32 = 8;
/// The same where nobody is there to ask: with the pauses between them 0.15 s, so that what came behind the gap is not late
/// as well. More than one, because the word of who answers may come after the first blocks.
const MAX_FAILURES_WITHOUT_BUFFER: u32 = 3;
/// The same for a source whose missing items have been given up before, and that has answered nothing since: it keeps none.
const MAX_FAILURES_OF_A_SILENT_SOURCE: u32 = 1;

/// The state machine of one stream.
#[derive(Debug)]
pub struct Follower<B> {
    start: Start,
    limit: u64,
    patience: Patience,
    /// Highest term of leadership heard of.
    term: u64,
    position: Option<Position>,
    held: BTreeMap<u64, B>,
    /// The first block that came of a later epoch, while something of this one may be left.
    later: Option<B>,
    fetch: Option<Fetching>,
    /// Fetches in a row that have brought nothing, and how many of them were answered.
    failures: u32,
    denials: u32,
    source_is_silent: bool,
    counts: FollowCounts,
}

/// What has been asked, and how far the stream was known to reach then.
#[derive(Clone, Copy, Debug)]
struct Fetching {
    after: u64,
    seen_end: u64,
    /// Whether a later epoch was known of.
    later: bool,
}

/// How far the running epoch has been delivered, and is known to reach.
#[derive(Debug)]
struct Position {
    epoch: u64,
    source: Option<String>,
    next: u64,
    seen_end: u64,
    ended: bool,
}

impl Position {
    fn new(epoch: u64, source: Option<String>, next: u64) -> Self {
        Self {
            epoch,
            source,
            next,
            seen_end: next,
            ended: false,
        }
    }
}

impl<B: Block> Follower<B> {
    /// A reader that has nothing yet; it fetches at most `limit` items at a time.
    #[must_use]
    pub fn new(start: Start, limit: u64, patience: Patience) -> Self {
        let position = match start {
            Start::At { epoch, sequence } => Some(Position::new(epoch, None, sequence)),
            Start::Beginning | Start::Now => None,
        };
        Self {
            start,
            limit,
            patience,
            term: 0,
            position,
            held: BTreeMap::new(),
            later: None,
            fetch: None,
            failures: 0,
            denials: 0,
            source_is_silent: false,
            counts: FollowCounts::default(),
        }
    }

    /// What did not come straight through so far.
    #[must_use]
    pub fn counts(&self) -> &FollowCounts {
        &self.counts
    }

    /// A block has arrived as it was put.
    pub fn live(&mut self, block: B, actions: &mut VecDeque<Action<B>>) {
        if self.patience == Patience::UntilAnswered && self.leaves_the_epoch(&block) {
            match self.later {
                Some(_) => self.counts.unkept_blocks += 1,
                None => self.later = Some(block),
            }
            return self.fetch_if_missing(actions); // the source knows what is left of this one, and where to go on
        }
        if self.enter_epoch(&block, actions) {
            self.accept(block, actions);
            self.fetch_if_missing(actions);
        }
    }

    /// Nothing has arrived for a while: the last block may have been lost.
    pub fn idle(&mut self, actions: &mut VecDeque<Action<B>>) {
        if self.fetch.is_none() {
            self.request(actions);
        }
    }

    /// The source has answered the fetch.
    pub fn answered(&mut self, answer: Answer<B>, actions: &mut VecDeque<Action<B>>) {
        match answer {
            Answer::Block(block) => self.answered_with(block, actions),
            Answer::CaughtUp(at) => self.answered_caught_up(&at, actions),
        }
    }

    /// The fetch has failed.
    pub fn unanswered(&mut self, silence: Silence, actions: &mut VecDeque<Action<B>>) {
        self.fetch = None;
        if !self.is_missing() {
            return; // a poll: the next one will tell
        }
        self.failures += 1;
        self.denials += u32::from(silence == Silence::Denied);
        let is_over = match (self.patience, silence) {
            (Patience::UntilAnswered, Silence::NoAnswer) => false,
            (Patience::UntilAnswered, Silence::Denied) => self.denials >= MAX_FAILURES,
            (Patience::UntilAnswered, Silence::NoBuffer) => self.failures >= MAX_FAILURES,
            (Patience::Limited, _) if self.source_is_silent => {
                self.failures >= MAX_FAILURES_OF_A_SILENT_SOURCE
            }
            (Patience::Limited, Silence::NoBuffer) => self.failures >= MAX_FAILURES_WITHOUT_BUFFER,
            (Patience::Limited, Silence::NoAnswer | Silence::Denied) => {
                self.failures >= MAX_FAILURES
            }
        };
        if is_over {
            (self.failures, self.denials) = (0, 0);
            self.source_is_silent = true;
            self.give_up(actions);
        }
        self.fetch_if_missing(actions);
    }

    fn has_answered(&mut self) {
        (self.failures, self.denials) = (0, 0);
        self.source_is_silent = false;
    }

    fn answered_with(&mut self, block: B, actions: &mut VecDeque<Action<B>>) {
        let asked_after = self.fetch.map(|fetch| fetch.after);
        if !self.enter_epoch(&block, actions) {
            return self.unanswered(Silence::Denied, actions);
        }
        let before = self.counts.delivered_items;
        self.deliver_up_to(block.header().sequence, actions);
        let stands_still = |follower: &Self| {
            let next = follower.position.as_ref().map(|p| p.next);
            next == asked_after && block.end() <= next.unwrap_or(0) && follower.lacks_items()
        };
        if stands_still(self) {
            return self.unanswered(Silence::Denied, actions);
        }
        self.accept(block, actions);
        let progress = self.counts.delivered_items - before;
        self.counts.fetched_items += progress;
        self.fetch = None;
        self.has_answered();
        let ended = self.position.as_ref().is_some_and(|p| p.ended);
        if progress > 0 && !ended {
            self.request(actions); // until the source says that this was all
        } else {
            self.fetch_if_missing(actions);
        }
    }

    fn answered_caught_up(&mut self, at: &CaughtUp, actions: &mut VecDeque<Action<B>>) {
        let Some(position) = &self.position else {
            let source = Some(at.header.source.clone());
            let next = match self.start {
                Start::Beginning | Start::At { .. } => 0,
                Start::Now => at.header.sequence,
            };
            self.position = Some(Position::new(at.header.epoch, source, next));
            self.fetch = None;
            return;
        };
        if at.header.epoch < position.epoch {
            self.counts.stale_blocks += 1;
            return self.unanswered(Silence::Denied, actions);
        }
        if at.header.epoch > position.epoch {
            self.change_epoch(at.header.epoch, at.header.source.clone(), actions);
        } else if self.lacks_items()
            && self
                .fetch
                .is_some_and(|fetch| fetch.seen_end > at.header.sequence)
        {
            self.disbelieve(at.header.sequence, actions);
        } else if self.fetch.is_some_and(|fetch| fetch.later) {
            self.counts.impossible_blocks += 1;
            self.later = None; // the source is in this epoch: it has not put that block
        }
        self.see_end(at.header.sequence);
        if self.is_missing() {
            return self.unanswered(Silence::Denied, actions); // it is known to exist, but not to this source: ask again
        }
        self.fetch = None;
        self.has_answered();
    }

    /// The source was asked after blocks had arrived that are numbered beyond its end: it never put them.
    ///
    /// Everything a source puts is in its buffer first. An answer to what was asked before they arrived says nothing of them.
    fn disbelieve(&mut self, end: u64, actions: &mut VecDeque<Action<B>>) {
        self.counts.impossible_blocks += 1;
        self.held.retain(|_, block| block.end() <= end);
        if let Some(position) = &mut self.position {
            position.seen_end = position.next.max(end);
        }
        self.deliver_held(actions);
    }

    /// Takes up term and epoch of a block; false if the block is not of this stream.
    ///
    /// Who leads in a higher term puts the same stream, from then on alone: what has come of it stays, and goes on.
    fn enter_epoch(&mut self, block: &B, actions: &mut VecDeque<Action<B>>) -> bool {
        let header = block.header();
        if block.term() < self.term {
            self.counts.superseded_blocks += 1;
            return false;
        }
        if block.term() > self.term {
            self.term = block.term();
            self.failures = 0;
            self.source_is_silent = false;
            if let Some(position) = &mut self.position {
                position.source = None;
            }
        }
        let Some(position) = &mut self.position else {
            let next = match self.start {
                Start::Beginning | Start::At { .. } => 0,
                Start::Now => header.sequence,
            };
            let source = Some(header.source.clone());
            self.position = Some(Position::new(header.epoch, source, next));
            return true;
        };
        if header.epoch < position.epoch {
            self.counts.stale_blocks += 1;
            return false;
        }
        if header.epoch > position.epoch {
            self.change_epoch(header.epoch, header.source.clone(), actions);
            return true;
        }
        let source = position.source.get_or_insert_with(|| header.source.clone());
        if *source != header.source {
            self.counts.foreign_blocks += 1;
            return false;
        }
        true
    }

    /// The source of the old epoch is gone: what is missing of it cannot be had any more.
    fn change_epoch(&mut self, epoch: u64, source: String, actions: &mut VecDeque<Action<B>>) {
        if let Some(seen_end) = self.position.as_ref().map(|p| p.seen_end) {
            self.deliver_up_to(seen_end, actions);
        }
        self.held.clear();
        self.has_answered();
        self.position = Some(Position::new(epoch, Some(source), 0));
        if let Some(later) = self.later.take_if(|later| later.header().epoch <= epoch)
            && later.header().epoch == epoch
        {
            self.accept(later, actions);
        }
    }

    /// Whether a block is of a later epoch, and this one may go on behind what has been delivered.
    fn leaves_the_epoch(&self, block: &B) -> bool {
        self.position
            .as_ref()
            .is_some_and(|p| block.header().epoch > p.epoch && !p.ended)
    }

    fn see_end(&mut self, end: u64) {
        if let Some(position) = &mut self.position {
            position.seen_end = position.seen_end.max(end);
        }
    }

    /// Whether there is something to ask for: items, or what is left of an epoch.
    fn is_missing(&self) -> bool {
        self.later.is_some() || self.lacks_items()
    }

    fn lacks_items(&self) -> bool {
        self.position.as_ref().is_some_and(|p| p.seen_end > p.next)
    }

    /// Delivers the block if it is next, keeps it if it is ahead.
    fn accept(&mut self, block: B, actions: &mut VecDeque<Action<B>>) {
        self.see_end(block.end());
        let Some(position) = &self.position else {
            return;
        };
        let sequence = block.header().sequence;
        if sequence <= position.next {
            self.deliver(block, actions);
            self.deliver_held(actions);
            return;
        }
        let kept = self.held.get(&sequence).map_or(0, Block::count);
        if self.held.len() < HELD_BLOCKS && kept <= block.count() {
            self.held.insert(sequence, block);
        } else {
            self.counts.unkept_blocks += 1;
        }
    }

    /// Delivers what is new of a block that starts at or before the next item.
    fn deliver(&mut self, mut block: B, actions: &mut VecDeque<Action<B>>) {
        let Some(position) = &mut self.position else {
            return;
        };
        let known = position.next.saturating_sub(block.header().sequence);
        let duplicates = known.min(block.count());
        self.counts.duplicate_items += duplicates;
        let ends_now =
            block.state() == StreamState::Ended && block.end() == position.next && !position.ended;
        if block.end() <= position.next && !ends_now {
            return;
        }
        block.skip(duplicates);
        self.counts.delivered_items += block.count();
        position.next = block.end();
        position.ended = block.state() == StreamState::Ended;
        actions.push_back(Action::Deliver(Delivery::Block(block)));
    }

    fn deliver_held(&mut self, actions: &mut VecDeque<Action<B>>) {
        while let Some(entry) = self.held.first_entry() {
            let next = self.position.as_ref().map_or(0, |p| p.next);
            if *entry.key() > next {
                return;
            }
            let block = entry.remove();
            self.deliver(block, actions);
        }
    }

    /// Delivers what is kept below `end`, with gaps for what is not.
    fn deliver_up_to(&mut self, end: u64, actions: &mut VecDeque<Action<B>>) {
        while let Some(position) = &mut self.position {
            if position.next >= end {
                return;
            }
            let ahead = self.held.first_key_value().map(|(sequence, _)| *sequence);
            let to = ahead.map_or(end, |sequence| sequence.min(end));
            if to > position.next {
                let gap = Gap {
                    epoch: position.epoch,
                    from: position.next,
                    to,
                };
                self.counts.gap_items += gap.to - gap.from;
                position.next = to;
                position.seen_end = position.seen_end.max(to);
                actions.push_back(Action::Deliver(Delivery::Gap(gap)));
            }
            self.deliver_held(actions);
        }
    }

    /// The source does not have what is missing: goes on behind it.
    fn give_up(&mut self, actions: &mut VecDeque<Action<B>>) {
        if let Some(later) = self.later.take() {
            if self.enter_epoch(&later, actions) {
                self.accept(later, actions);
            }
            return;
        }
        let ahead = self.held.first_key_value().map(|(sequence, _)| *sequence);
        let seen_end = self.position.as_ref().map_or(0, |p| p.seen_end);
        self.deliver_up_to(ahead.unwrap_or(seen_end), actions);
        self.deliver_held(actions);
    }

    fn fetch_if_missing(&mut self, actions: &mut VecDeque<Action<B>>) {
        if self.fetch.is_none() && self.is_missing() {
            self.request(actions);
        }
    }

    fn request(&mut self, actions: &mut VecDeque<Action<B>>) {
        let after = match (&self.position, self.start) {
            (Some(position), _) => position.next,
            (None, Start::Now) => u64::MAX, // only asks where the stream stands
            (None, Start::Beginning | Start::At { .. }) => 0,
        };
        let seen_end = self.position.as_ref().map_or(0, |p| p.seen_end);
        self.fetch = Some(Fetching {
            after,
            seen_end,
            later: self.later.is_some(),
        });
        actions.push_back(Action::Fetch {
            range: QueryRange {
                after,
                limit: self.limit,
                epoch: self.position.as_ref().map(|p| p.epoch),
            },
            failures: self.failures,
        });
    }
}

#[cfg(test)]
mod tests;
