//! Common interface of the numbered blocks of the three lossless streams.

use serde::{Deserialize, Serialize};

use super::{Header, Message};

/// Whether more items follow in this epoch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StreamState {
    /// More items may follow.
    #[default]
    Running,
    /// The last item of this block is the last item of the epoch.
    Ended,
}

/// A block of numbered items: samples of a node, frames, or estimates.
///
/// A stream consists of items. A repeated query may return the same items in different blocks.
pub trait Block: Message + Clone + Send + Sync + 'static {
    /// Returns the common header. Its `sequence` is the number of the first item.
    fn header(&self) -> &Header;

    /// Returns the number of items.
    fn count(&self) -> u64;

    /// Returns whether the epoch ends with this block.
    fn state(&self) -> StreamState;

    /// Returns an upper bound of the encoded size of one item, in bytes.
    fn item_bytes(&self) -> usize;

    /// Drops the first `items` items, or all if the block has fewer. Updates the number and the
    /// time of the block.
    fn skip(&mut self, items: u64);

    /// Keeps only the first `items` items. If this drops items, the block is no longer the end of
    /// its epoch.
    fn truncate(&mut self, items: u64);

    /// Appends the next block. Returns `false` and changes nothing if it does not continue this
    /// block.
    fn append(&mut self, next: &Self) -> bool;

    /// Returns the term of the leader that published the block. Readers drop blocks of a lower
    /// term. 0 if the stream has only one source.
    fn term(&self) -> u64 {
        0
    }

    /// Sets the term of the leader.
    fn set_term(&mut self, _term: u64) {}

    /// Returns the sequence number after the last item of this block.
    fn end(&self) -> u64 {
        self.header().sequence.saturating_add(self.count())
    }
}

/// Returns `true` if the header of `next` continues a block that ends at `end`.
pub(super) fn continues(header: &Header, end: u64, state: StreamState, next: &Header) -> bool {
    state == StreamState::Running
        && header.source == next.source
        && header.epoch == next.epoch
        && end == next.sequence
}
