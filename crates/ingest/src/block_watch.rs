//! Detects nodes whose blocks are rejected, from the counts of rejected blocks.

use std::time::Duration;

/// Watches the counts of rejected blocks of all nodes. The passage of time is an argument.
#[derive(Debug)]
pub(crate) struct BlockWatch {
    nodes: Vec<Node>,
    over_after: Duration,
}

#[derive(Debug, Default)]
struct Node {
    blocks: u64,
    /// When the last rejected block was read, while blocks are rejected.
    last: Option<Duration>,
}

/// A node whose blocks are newly rejected, or are read again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BlockReport {
    /// Index of the node.
    pub(crate) node: usize,
    /// Number of rejected blocks since the previous reading.
    pub(crate) blocks: u64,
    /// `true` if no further block has been rejected.
    pub(crate) is_over: bool,
}

impl BlockWatch {
    /// Creates the watch for `nodes` nodes. Without a rejected block for `over_after`, the blocks
    /// of a node are read again. This time must exceed the interval between two readings.
    pub(crate) fn new(nodes: usize, over_after: Duration) -> Self {
        Self {
            nodes: (0..nodes).map(|_| Node::default()).collect(),
            over_after,
        }
    }

    /// Reads the counts of rejected blocks, in layout order, and returns the changes.
    pub(crate) fn read(
        &mut self,
        counts: impl Iterator<Item = u64>,
        now: Duration,
    ) -> Vec<BlockReport> {
        let mut reports = Vec::new();
        for (index, (node, count)) in self.nodes.iter_mut().zip(counts).enumerate() {
            let blocks = count.saturating_sub(node.blocks);
            node.blocks = count;
            let was_rejected = node.last.is_some();
            if blocks > 0 {
                node.last = Some(now);
            }
            let is_over = |last: &mut Duration| now.saturating_sub(*last) > self.over_after;
            node.last.take_if(is_over);
            let is_rejected = node.last.is_some();
            if is_rejected != was_rejected {
                reports.push(BlockReport {
                    node: index,
                    blocks,
                    is_over: was_rejected,
                });
            }
        }
        reports
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejection_is_reported_once_and_its_end_when_no_further_block_is_rejected() {
        let mut watch = BlockWatch::new(2, Duration::from_secs(3));
        let mut told = Vec::new();
        for second in 0..20 {
            let rejected = [0, 10 * (u64::clamp(second, 4, 9) - 4)];
            let reports = watch.read(rejected.into_iter(), Duration::from_secs(second));
            told.extend(reports.into_iter().map(|report| (second, report)));
        }
        let report = |blocks, is_over| BlockReport {
            node: 1,
            blocks,
            is_over,
        };
        assert_eq!(told, [(5, report(10, false)), (13, report(0, true))]);
    }
}
