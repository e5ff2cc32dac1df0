//! The first field of every postcard message.

use serde::{Deserialize, Serialize};

use super::Malformed;

/// Maximum length of a source id, in bytes.
pub const MAX_SOURCE_BYTES: usize = 128;

/// Source, epoch, sequence number and time of a message.
///
/// These fields are the same in all message types and never change within a version.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// Id of the source: the name of the node, or the id of the service.
    pub source: String,
    /// Epoch of the sequence numbers. A higher epoch restarts them, and messages of a lower epoch
    /// are stale.
    pub epoch: u64,
    /// Number of the first item (sample, frame, estimate) of the block. The next block starts at
    /// this number plus the number of items.
    pub sequence: u64,
    /// Measurement time of the first item, ns since the Unix epoch, UTC.
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
