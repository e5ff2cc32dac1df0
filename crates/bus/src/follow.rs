//! Ordering and recovery of the blocks of a lossless stream.
//!
//! [`Follower`] is a pure state machine. It receives blocks and replies, and returns deliveries,
//! fetches and gaps. Blocks may be dropped, duplicated, reordered or divided differently in
//! transit. Nevertheless, the reader receives every item exactly once and in order, or a gap in its
//! place.

use std::collections::BTreeMap;
use std::collections::VecDeque;

use crate::message::{Block, CaughtUp, Header, StreamState};
use crate::range::QueryRange;
use crate::ring::Answer;

/// Start position of a reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// Item 0 of the current epoch. Items that the source no longer has become a gap.
    Beginning,
    /// The next published item.
    Now,
    /// A given item, as after a checkpoint. In a later epoch, its item 0.
    At {
        /// Epoch of the checkpoint.
        epoch: u64,
        /// Number of the first requested item.
        sequence: u64,
    },
}

/// Items that are no longer available.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gap {
    /// Epoch of the items.
    pub epoch: u64,
    /// Number of the first lost item.
    pub from: u64,
    /// Number of the first item after the gap.
    pub to: u64,
}

/// Data that the reader receives, in order.
#[derive(Clone, Debug, PartialEq)]
pub enum Delivery<B> {
    /// Items that follow the previous delivery. A higher epoch starts again at item 0.
    Block(B),
    /// Permanently lost items.
    Gap(Gap),
}

/// Instructions for the caller of the state machine, in order.
#[derive(Clone, Debug, PartialEq)]
pub enum Action<B> {
    /// Pass this delivery to the reader.
    Deliver(Delivery<B>),
    /// Query the source, one query at a time. Report the result with [`Follower::answered`] or
    /// [`Follower::unanswered`].
    Fetch {
        /// The items to request.
        range: QueryRange,
        /// Number of consecutive failures. It determines the pause before the query.
        failures: u32,
    },
}

/// Reason why a fetch returned no items.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Silence {
    /// No source has ever been available to reply.
    NoBuffer,
    /// A source was available, but did not reply in time.
    NoAnswer,
    /// The source replied, but without the requested items or with an unreadable reply.
    Denied,
}

/// Duration of the attempts to fetch missing items.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Patience {
    /// Eight attempts with pauses of 5.5 s in total, so that later items are not late as well. For
    /// samples.
    Limited,
    /// Attempts until the source replies that it no longer has the items, regardless of its
    /// downtime.
    ///
    /// Such a source stores its items on disk or reproduces them. The remaining items of an epoch
    /// precede the next epoch. For frames and estimates.
    UntilAnswered,
}

/// Counts of irregularities of a stream.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FollowCounts {
    /// Number of items delivered.
    pub delivered_items: u64,
    /// Number of duplicate items.
    pub duplicate_items: u64,
    /// Number of items that were fetched from the source.
    pub fetched_items: u64,
    /// Number of permanently lost items.
    pub gap_items: u64,
    /// Number of blocks of an earlier epoch.
    pub stale_blocks: u64,
    /// Number of blocks of another source in the same epoch.
    pub foreign_blocks: u64,
    /// Number of blocks of a superseded leader.
    pub superseded_blocks: u64,
    /// Number of blocks after a gap that exceeded the buffer and must be fetched again.
    pub unkept_blocks: u64,
    /// Number of times that received blocks were beyond the end that the source reports, or had an
    /// epoch or term that no source has.
    pub impossible_blocks: u64,
    /// Number of consecutive blocks of an earlier epoch. Their source still runs, and a higher
    /// epoch excludes it.
    pub locked_out_blocks: u64,
}

/// Latest possible epoch and term. Both are wall-clock times in ns, and this is the year 2262.
const LAST_EPOCH: u64 = i64::MAX as u64;
/// Span of measurement time, ns, and number of blocks that an excluded run of the source must
/// deliver before it is read again. A block of the present run restarts the count.
///
/// The blocks that a former run has in transit when a new one starts are fewer.
const READ_AGAIN_AFTER_NS: i64 = 5_000_000_000;
const READ_AGAIN_AFTER_BLOCKS: u32 = 10;

/// Maximum number of buffered blocks after a gap. Further blocks are fetched again.
///
/// The buffer suffices for a source of 40 blocks per second without storage, until its missing
/// items are abandoned.
const HELD_BLOCKS: usize = 256;
/// Number of fetches without a reply after which missing items are abandoned.
const MAX_FAILURES: u32 = 8;
/// The same limit if no source is available. The fetches and the pauses between them take 0.15 s,
/// so that the items after the gap are not late as well.
///
/// It is above 1 because the declaration of the source may arrive after its first blocks.
const MAX_FAILURES_WITHOUT_BUFFER: u32 = 3;
/// The same limit for a source that has not replied since its missing items were last abandoned.
/// Such a source has no storage.
const MAX_FAILURES_OF_A_SILENT_SOURCE: u32 = 1;

/// State machine of one stream.
#[derive(Debug)]
pub struct Follower<B> {
    start: Start,
    limit: u64,
    patience: Patience,
    /// Highest term of a leader that was received.
    term: u64,
    position: Option<Position>,
    /// Position in the former epoch, until the source confirms the present one.
    former: Option<Position>,
    /// Position in an epoch that the source has denied.
    denied: Option<Position>,
    /// A run of the source that the present epoch or term excludes.
    excluded: Option<Excluded>,
    held: BTreeMap<u64, B>,
    /// First received block of a later epoch, while items of the current epoch may be missing.
    later: Option<B>,
    fetch: Option<Fetching>,
    /// Number of consecutive fetches without items.
    failures: u32,
    denials: u32,
    source_is_silent: bool,
    counts: FollowCounts,
}

/// The pending fetch, and the known extent of the stream at its start.
#[derive(Clone, Copy, Debug)]
struct Fetching {
    after: u64,
    seen_end: u64,
    /// Whether a block of a later epoch had been received.
    later: bool,
    /// Whether the source must confirm the epoch.
    confirms: bool,
}

/// Consecutive blocks of a run of the source that are not delivered.
#[derive(Debug)]
struct Excluded {
    source: String,
    term: u64,
    epoch: u64,
    first_ns: i64,
    next: u64,
    blocks: u32,
}

/// Delivered and known extent of the current epoch.
#[derive(Clone, Debug)]
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
    /// Creates a reader without items. It fetches at most `limit` items at a time.
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
            former: None,
            denied: None,
            excluded: None,
            held: BTreeMap::new(),
            later: None,
            fetch: None,
            failures: 0,
            denials: 0,
            source_is_silent: false,
            counts: FollowCounts::default(),
        }
    }

    /// Returns the counts of irregularities so far.
    #[must_use]
    pub fn counts(&self) -> &FollowCounts {
        &self.counts
    }

    /// Processes a published block.
    pub fn live(&mut self, block: B, actions: &mut VecDeque<Action<B>>) {
        if self.is_of_an_excluded_run(&block) {
            if !self.outlasts_the_present_run(&block) {
                return;
            }
            self.read_again(&block);
        } else if block.header().epoch > LAST_EPOCH || block.term() > LAST_EPOCH {
            self.counts.impossible_blocks += 1;
            return;
        }
        if self.patience == Patience::UntilAnswered && self.leaves_the_epoch(&block) {
            match self.later {
                Some(_) => self.counts.unkept_blocks += 1,
                None => self.later = Some(block),
            }
            // The source knows the remaining items of this epoch, and the next position.
            return self.fetch_if_missing(actions);
        }
        if self.enter_epoch(&block, actions) {
            self.excluded = None;
            self.accept(block, actions);
            self.fetch_if_missing(actions);
        }
    }

    /// Returns `true` if a block belongs to a run of the source that the present one excludes.
    fn is_of_an_excluded_run(&self, block: &B) -> bool {
        let epoch = block.header().epoch;
        let has_earlier_epoch = self.position.as_ref().is_some_and(|p| epoch < p.epoch);
        block.term() < self.term
            || self.patience == Patience::Limited && (has_earlier_epoch || self.has_denied(epoch))
    }

    /// Returns `true` if an excluded run has delivered long enough while the present one was
    /// silent. Otherwise counts the block.
    fn outlasts_the_present_run(&mut self, block: &B) -> bool {
        let header = block.header();
        let (term, epoch) = (block.term(), header.epoch);
        let excluded = self.excluded.take_if(|run| {
            (run.term, run.epoch) == (term, epoch)
                && run.source == header.source
                && run.next <= header.sequence
        });
        let continues = excluded.is_some();
        let mut run = excluded.unwrap_or_else(|| Excluded {
            source: header.source.clone(),
            term,
            epoch,
            first_ns: header.time_ns,
            next: 0,
            blocks: 0,
        });
        run.next = block.end();
        run.blocks += 1;
        let lasted_ns = header.time_ns.saturating_sub(run.first_ns);
        if run.blocks >= READ_AGAIN_AFTER_BLOCKS && lasted_ns >= READ_AGAIN_AFTER_NS {
            return true;
        }
        self.excluded = Some(run);
        let count = match (term < self.term, self.has_denied(epoch)) {
            (true, _) => &mut self.counts.superseded_blocks,
            (false, true) => &mut self.counts.impossible_blocks,
            (false, false) if continues => &mut self.counts.locked_out_blocks,
            (false, false) => &mut self.counts.stale_blocks,
        };
        *count += 1;
        false
    }

    /// Reads an excluded run from this block on. If only the term excluded it, or if the source had
    /// denied its epoch, the stream continues where it was.
    fn read_again(&mut self, block: &B) {
        let Header {
            source,
            epoch,
            sequence,
            ..
        } = block.header().clone();
        self.term = block.term();
        let denied = self.denied.take().filter(|denied| denied.epoch == epoch);
        self.has_answered();
        match &mut self.position {
            Some(position) if position.epoch == epoch => position.source = None,
            Some(_) if self.patience == Patience::Limited => {
                self.former = None;
                self.held.clear();
                let next = denied.map_or(sequence, |denied| denied.next);
                self.position = Some(Position::new(epoch, Some(source), next));
            }
            _ => {}
        }
    }

    /// Polls the source after a period without blocks, because the last block may have been lost.
    pub fn idle(&mut self, actions: &mut VecDeque<Action<B>>) {
        if self.fetch.is_none() {
            self.request(actions);
        }
    }

    /// Processes the reply of the source to a fetch.
    pub fn answered(&mut self, answer: Answer<B>, actions: &mut VecDeque<Action<B>>) {
        match answer {
            Answer::Block(block) => self.answered_with(block, actions),
            Answer::CaughtUp(at) => self.answered_caught_up(&at, actions),
        }
    }

    /// Processes a failed fetch.
    pub fn unanswered(&mut self, silence: Silence, actions: &mut VecDeque<Action<B>>) {
        self.fetch = None;
        if !self.is_missing() {
            return; // a poll; the next poll repeats it
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
        if self.is_denied_by(block.header().epoch) {
            return self.return_to_the_former_epoch(actions);
        }
        let asked_after = self.fetch.map(|fetch| fetch.after);
        // A superseded leader cannot deny what its successor has.
        let silence = match block.term() < self.term {
            true => Silence::NoAnswer,
            false => Silence::Denied,
        };
        if !self.enter_epoch(&block, actions) {
            return self.unanswered(silence, actions);
        }
        self.former = None;
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
            self.request(actions); // until the source reports that this was all
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
        if self.is_denied_by(at.header.epoch) {
            return self.return_to_the_former_epoch(actions);
        }
        if at.header.epoch < position.epoch {
            self.counts.stale_blocks += 1;
            return self.unanswered(Silence::Denied, actions);
        }
        self.former = None;
        if at.header.epoch > position.epoch {
            self.change_epoch(at.header.epoch, at.header.source.clone(), actions);
            self.former = None;
        } else if self.lacks_items()
            && self
                .fetch
                .is_some_and(|fetch| fetch.seen_end > at.header.sequence)
        {
            self.disbelieve(at.header.sequence, actions);
        } else if self.fetch.is_some_and(|fetch| fetch.later) {
            self.counts.impossible_blocks += 1;
            // The source is in this epoch, so it has not published that block.
            self.later = None;
        }
        self.see_end(at.header.sequence);
        if self.is_missing() {
            // The item is known to exist, but not to this source: retry.
            return self.unanswered(Silence::Denied, actions);
        }
        self.fetch = None;
        self.has_answered();
    }

    /// Returns `true` if a reply shows that the source has never begun the present epoch.
    fn is_denied_by(&self, epoch: u64) -> bool {
        let former = self.former.as_ref();
        self.fetch.is_some_and(|fetch| fetch.confirms)
            && former.is_some_and(|former| former.epoch == epoch)
    }

    /// Returns `true` if the source has denied this epoch.
    fn has_denied(&self, epoch: u64) -> bool {
        self.denied
            .as_ref()
            .is_some_and(|denied| denied.epoch == epoch)
    }

    /// Drops the present epoch, which the source has denied.
    fn return_to_the_former_epoch(&mut self, actions: &mut VecDeque<Action<B>>) {
        self.counts.impossible_blocks += 1;
        self.denied = self.position.take();
        self.position = self.former.take();
        self.held.clear();
        self.has_answered();
        self.request(actions);
    }

    /// Drops blocks beyond the end that the source reports. The source never published them.
    ///
    /// A source stores every block in its buffer before it publishes the block. A reply does not
    /// apply to blocks that arrived after the query.
    fn disbelieve(&mut self, end: u64, actions: &mut VecDeque<Action<B>>) {
        self.counts.impossible_blocks += 1;
        self.held.retain(|_, block| block.end() <= end);
        if let Some(position) = &mut self.position {
            position.seen_end = position.next.max(end);
        }
        self.deliver_held(actions);
    }

    /// Adopts the term and epoch of a block. Returns `false` if the block does not belong to the
    /// stream.
    ///
    /// The leader of a higher term is from then on the only publisher of the stream. Items of the
    /// former leader remain valid, and the stream continues after them.
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

    /// Changes the epoch. The source of the former epoch no longer exists, so its missing items
    /// become a gap.
    fn change_epoch(&mut self, epoch: u64, source: String, actions: &mut VecDeque<Action<B>>) {
        if let Some(seen_end) = self.position.as_ref().map(|p| p.seen_end) {
            self.deliver_up_to(seen_end, actions);
        }
        self.held.clear();
        self.has_answered();
        // A source that had just started can deny an epoch and then enter it. Its first items have
        // been delivered.
        let next = match self.denied.take_if(|denied| denied.epoch == epoch) {
            Some(denied) => denied.next,
            None => 0,
        };
        let before = self
            .position
            .replace(Position::new(epoch, Some(source), next));
        if self.patience == Patience::Limited {
            // A reply must confirm the new epoch. Its blocks do not wait for that.
            self.former = self.former.take().or(before);
        }
        if let Some(later) = self.later.take_if(|later| later.header().epoch <= epoch)
            && later.header().epoch == epoch
        {
            self.accept(later, actions);
        }
    }

    /// Returns `true` if a block has a later epoch while the current epoch may have undelivered
    /// items.
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

    /// Returns `true` if there is a reason to fetch: missing items, or the rest of an epoch.
    fn is_missing(&self) -> bool {
        self.later.is_some() || self.former.is_some() || self.lacks_items()
    }

    fn lacks_items(&self) -> bool {
        self.position.as_ref().is_some_and(|p| p.seen_end > p.next)
    }

    /// Delivers the block if it is next, and buffers it if it follows a gap.
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

    /// Delivers the new items of a block that starts at or before the next item.
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

    /// Delivers the buffered items below `end`, with gaps for missing items.
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

    /// Abandons the missing items that the source does not have, and continues after them.
    fn give_up(&mut self, actions: &mut VecDeque<Action<B>>) {
        if let Some(later) = self.later.take() {
            if self.enter_epoch(&later, actions) {
                self.accept(later, actions);
            }
            return;
        }
        // Nobody confirms the epoch, as for a source that stores nothing.
        self.former = None;
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
            (None, Start::Now) => u64::MAX, // only requests the position of the stream
            (None, Start::Beginning | Start::At { .. }) => 0,
        };
        let seen_end = self.position.as_ref().map_or(0, |p| p.seen_end);
        self.fetch = Some(Fetching {
            after,
            seen_end,
            later: self.later.is_some(),
            confirms: self.former.is_some(),
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
