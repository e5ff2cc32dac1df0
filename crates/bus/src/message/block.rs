//! What the numbered blocks of the three lossless streams have in common.

use serde::{Deserialize, Serialize};

use super::{Header, Message};

/// Whether more items will follow in this epoch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum StreamState {
    /// More may follow.
    Running,
    /// The last item of this block is the last one of the epoch.
    Ended,
}

/// A block of numbered items: samples of a node, frames, or estimates.
///
/// The items are what counts: the same stream may be cut into other blocks when it is fetched again.
pub trait Block: Message + Clone + Send + Sync + 'static {
    /// The common header; `sequence` is the number of the first item.
    fn header(&self) -> &Header;

    /// Number of items.
    fn count(&self) -> u64;

    /// Whether the epoch ends with this block.
    fn state(&self) -> StreamState;

    /// Upper bound of the encoded size of one item, bytes.
    fn item_bytes(&self) -> usize;

    /// Drops the first `items` items (all, if there are fewer); number and time of the block follow.
    fn skip(&mut self, items: u64);

    /// Drops all but the first `items` items; the end of the epoch goes with the items after it.
    fn truncate(&mut self, items: u64);

    /// Appends the following block; false, and nothing changes, if it does not continue this one.
    fn append(&mut self, next: &Self) -> bool;

    /// Term of leadership of who says this, where several could put the stream: a lower one has been superseded. 0 where there is only
    /// one source.
    fn term(&self) -> u64 {
        0
    }

    /// Says it in a term of leadership.
    fn set_term(&mut self, _term: u64) {}

    /// Number of the item after the last one of this block.
    fn end(&self) -> u64 {
        self.header().sequence.saturating_add(self.count())
    }
}

/// Whether `next` carries on where a block with `end` stops, as far as the header tells.
pub(super) fn continues(header: &Header, end: u64, state: StreamState, next: &Header) -> bool {
    state == StreamState::Running
        && header.source == next.source
        && header.epoch == next.epoch
        && end == next.sequence
}
