//! The header that every postcard message starts with.

use serde::{Deserialize, Serialize};

use super::Malformed;

/// Longest source id, in bytes.
pub const MAX_SOURCE_BYTES: usize = 128;

/// Who says it, in which life, which item it is, and when that was measured.
///
/// These fields never change within a version, whatever follows them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// Id of the source: the node, or the id of the service.
    pub source: String,
    /// Raised at each start or takeover of the source; a higher one starts the numbers anew, a lower one is stale.
    pub epoch: u64,
    /// Number of the first item (sample, frame, estimate) of the block; the next block starts at this plus its items.
    pub sequence: u64,
    /// Time of measurement of the first item, ns since the Unix epoch, UTC.
    pub time_ns: i64,
}

impl Header {
    pub(super) fn check(&self, items: u64) -> Result<(), Malformed> {
        if self.source.len() > MAX_SOURCE_BYTES {
            return Err(Malformed::Text {
                what: "source",
                found: self.source.len(),
                most: MAX_SOURCE_BYTES,
            });
        }
        match self.sequence.checked_add(items) {
            Some(_) => Ok(()),
            None => Err(Malformed::SequenceOverflow {
                sequence: self.sequence,
                count: items,
            }),
        }
    }
}
