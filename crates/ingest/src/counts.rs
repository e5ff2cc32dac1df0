//! What does not become part of a frame is counted, by reason.

use std::collections::BTreeMap;

/// Counters of one structure since the start of the service.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Frames closed.
    pub frames: u64,
    /// Samples that a frame had to do without, although their node was there; nodes slower than the frames count too.
    pub missing: u64,
    /// Samples whose frame already had one of that node.
    pub duplicate: u64,
    /// Samples whose frame was closed already.
    pub late: u64,
    /// Samples too far from any frame.
    pub off_grid: u64,
    /// Samples taken back because the clock of their node went back.
    pub retracted: u64,
    /// Samples that found the queue of their node full.
    pub overflowed: u64,
    /// Blocks with another number of channels than declared.
    pub wrong_channels: u64,
    /// Blocks of a source that is not the node.
    pub unknown_node: u64,
    /// Values that were infinite, now missing.
    pub not_finite: u64,
    /// Values beyond the range of their channel, now missing.
    pub out_of_range: u64,
}

impl Counts {
    /// The counters that are not zero, for a status message.
    #[must_use]
    pub fn drops(&self) -> BTreeMap<String, u64> {
        let counts = [
            ("missing-samples", self.missing),
            ("duplicate-samples", self.duplicate),
            ("late-samples", self.late),
            ("off-grid-samples", self.off_grid),
            ("retracted-samples", self.retracted),
            ("overflowed-samples", self.overflowed),
            ("wrong-channels", self.wrong_channels),
            ("unknown-node", self.unknown_node),
            ("not-finite-values", self.not_finite),
            ("out-of-range-values", self.out_of_range),
        ];
        let counted = counts.into_iter().filter(|(_, count)| *count > 0);
        counted
            .map(|(reason, count)| (reason.to_owned(), count))
            .collect()
    }
}
