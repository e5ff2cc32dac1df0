//! Reports nodes that a higher epoch under their name excludes.

use std::time::Duration;

use crate::drop_watch::DropReport;

/// Time without an excluded block after which a node is no longer locked out. It exceeds the
/// interval between two readings.
const OVER_AFTER: Duration = Duration::from_secs(3);

/// Watches the counts of excluded blocks of all nodes. The passage of time is an argument.
#[derive(Debug)]
pub(crate) struct LockoutWatch {
    nodes: Vec<Node>,
}

#[derive(Debug, Default)]
struct Node {
    blocks: u64,
    /// When the last excluded block was read, while the node is locked out.
    last: Option<Duration>,
}

impl LockoutWatch {
    /// Creates the watch for `nodes` nodes.
    pub(crate) fn new(nodes: usize) -> Self {
        Self {
            nodes: (0..nodes).map(|_| Node::default()).collect(),
        }
    }

    /// Reads the counts of excluded blocks, in layout order, and appends a report for each node
    /// that is newly locked out, or is read again.
    pub(crate) fn read(
        &mut self,
        counts: impl Iterator<Item = u64>,
        now: Duration,
        reports: &mut Vec<DropReport>,
    ) {
        for (index, (node, blocks)) in self.nodes.iter_mut().zip(counts).enumerate() {
            let is_excluded = blocks > node.blocks;
            node.blocks = blocks;
            let was_excluded = node.last.is_some();
            if is_excluded {
                node.last = Some(now);
            } else if node
                .last
                .is_some_and(|last| now.saturating_sub(last) > OVER_AFTER)
            {
                node.last = None;
            }
            match (was_excluded, node.last.is_some()) {
                (false, true) => reports.push(DropReport {
                    node: index,
                    what:
                        "the blocks of the node are dropped: another source uses its name with a \
                           higher epoch"
                            .to_owned(),
                    why: "a second program, or an earlier run with its clock in the future; the \
                          node is read again once it alone has delivered for 5 s and 10 blocks"
                        .to_owned(),
                    is_over: false,
                }),
                (true, false) => reports.push(DropReport {
                    node: index,
                    what: "the blocks of the node are no longer dropped".to_owned(),
                    why: "no other source excludes them".to_owned(),
                    is_over: true,
                }),
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lockout_is_reported_once_and_its_end_when_no_further_block_is_excluded() {
        let mut watch = LockoutWatch::new(2);
        let mut told = Vec::new();
        for second in 0..20 {
            let excluded = [0, 10 * (u64::clamp(second, 4, 9) - 4)];
            let mut reports = Vec::new();
            let now = Duration::from_secs(second);
            watch.read(excluded.into_iter(), now, &mut reports);
            told.extend(
                reports
                    .into_iter()
                    .map(|report| (second, report.node, report.is_over)),
            );
        }
        assert_eq!(told, [(5, 1, false), (13, 1, true)]);
    }
}
