//! Counters of frames, and of dropped or missing data by reason.

use std::collections::BTreeMap;
use std::ops::AddAssign;

/// Counters of one structure since the start of the service.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Closed frames.
    pub frames: u64,
    /// Samples missing from a frame although their node was connected. Nodes slower than the frames
    /// count too.
    pub missing: u64,
    /// Blocks from a source other than the node.
    pub unknown_node: u64,
    /// The counters of all nodes together.
    pub nodes: NodeCounts,
}

/// Counters of the samples of one node since the start of the service.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NodeCounts {
    /// Received samples, used or not.
    pub received: u64,
    /// Samples whose frame already had a sample of their node.
    pub duplicate: u64,
    /// Samples whose frame was already closed.
    pub late: u64,
    /// Samples further from the nearest frame than the tolerance.
    pub off_grid: u64,
    /// Samples removed because the clock of their node went back.
    pub retracted: u64,
    /// Samples dropped because the clock of their node differs from that of the majority.
    pub wrong_clock: u64,
    /// Samples dropped because the queue of their node was full.
    pub overflowed: u64,
    /// Infinite values, which are treated as missing.
    pub not_finite: u64,
    /// Values beyond the range of their channel, which are treated as missing.
    pub out_of_range: u64,
    /// Blocks whose number of channels differs from the declared number.
    pub wrong_channels: u64,
}

impl AddAssign for NodeCounts {
    fn add_assign(&mut self, other: Self) {
        self.received += other.received;
        self.duplicate += other.duplicate;
        self.late += other.late;
        self.off_grid += other.off_grid;
        self.retracted += other.retracted;
        self.wrong_clock += other.wrong_clock;
        self.overflowed += other.overflowed;
        self.not_finite += other.not_finite;
        self.out_of_range += other.out_of_range;
        self.wrong_channels += other.wrong_channels;
    }
}

impl Counts {
    /// Returns the drop counters that are not zero, for a status message.
    #[must_use]
    pub fn drops(&self) -> BTreeMap<String, u64> {
        let counts = [
            ("missing-samples", self.missing),
            ("duplicate-samples", self.nodes.duplicate),
            ("late-samples", self.nodes.late),
            ("off-grid-samples", self.nodes.off_grid),
            ("retracted-samples", self.nodes.retracted),
            ("wrong-clock-samples", self.nodes.wrong_clock),
            ("overflowed-samples", self.nodes.overflowed),
            ("wrong-channels", self.nodes.wrong_channels),
            ("unknown-node", self.unknown_node),
            ("not-finite-values", self.nodes.not_finite),
            ("out-of-range-values", self.nodes.out_of_range),
        ];
        let counted = counts.into_iter().filter(|(_, count)| *count > 0);
        counted
            .map(|(reason, count)| (reason.to_owned(), count))
            .collect()
    }
}
