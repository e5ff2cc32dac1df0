//! Reports nodes whose clocks differ from those of the other nodes.

use crate::clock_moves::ClockMove;
use crate::clock_vote::{ClockVerdict, Tally};

/// A report on the clock of one node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ClockReport {
    /// Index of the node.
    pub(crate) node: usize,
    /// What happened, with numbers.
    pub(crate) what: String,
    /// The reason, and advice.
    pub(crate) why: String,
    /// `true` if the clock agrees again.
    pub(crate) is_over: bool,
}

/// Compares the verdicts on all nodes with those that were reported last.
#[derive(Debug)]
pub(crate) struct ClockWatch {
    reported: Vec<ClockVerdict>,
}

impl ClockWatch {
    /// Creates the watch for `nodes` nodes.
    pub(crate) fn new(nodes: usize) -> Self {
        Self {
            reported: vec![ClockVerdict::Agrees; nodes],
        }
    }

    /// Reads the verdicts in layout order, and returns a report for each node whose verdict has
    /// changed.
    pub(crate) fn read(&mut self, verdicts: &[ClockVerdict], tally: Tally) -> Vec<ClockReport> {
        let mut reports = Vec::new();
        for (node, (reported, verdict)) in self.reported.iter_mut().zip(verdicts).enumerate() {
            let is_new = std::mem::discriminant(reported) != std::mem::discriminant(verdict);
            if is_new {
                *reported = *verdict;
                reports.push(report(node, *verdict, tally));
            }
        }
        reports
    }
}

fn report(node: usize, verdict: ClockVerdict, tally: Tally) -> ClockReport {
    let Tally { votes, agreeing } = tally;
    let (what, why) = match verdict {
        ClockVerdict::Agrees => (
            "the clock of the node agrees with the other nodes again".to_owned(),
            "its samples are used again".to_owned(),
        ),
        ClockVerdict::Wrong { difference_ns } => (
            format!(
                "the clock of the node is {} {}",
                in_words(difference_ns),
                if 2 * agreeing > votes {
                    "most nodes"
                } else {
                    "other nodes"
                },
            ),
            format!(
                "{agreeing} of {votes} nodes agree on another time; samples of this node are \
                 dropped until its clock is right; check its time synchronisation and time zone"
            ),
        ),
        ClockVerdict::Tied { difference_ns } => (
            format!(
                "the clock of the node is {} another node",
                in_words(difference_ns)
            ),
            format!(
                "no majority of the {votes} nodes agrees on the time, so that their frames do not \
                 belong together; check the time synchronisation of all nodes"
            ),
        ),
    };
    ClockReport {
        node,
        what,
        why,
        is_over: verdict == ClockVerdict::Agrees,
    }
}

/// Returns what happened, with numbers, and the reason with advice.
pub(crate) fn describe_move(moved: &ClockMove) -> (String, String) {
    let Some(within) = moved.within else {
        return describe_difference(moved);
    };
    let (direction, causes) = match moved.by_ns < 0 {
        true => (
            "back",
            "was set back or is slow, or its samples now arrive later",
        ),
        false => (
            "forward",
            "was set forward or is fast, or its samples now arrive earlier",
        ),
    };
    let seconds = moved.by_ns.unsigned_abs() as f64 / 1e9;
    let what = format!(
        "the clock of the node has moved {direction} by {seconds:.2} s against most nodes within \
         {} s",
        within.as_secs()
    );
    let why = format!(
        "the clock {causes}; its samples are used at the times that it states; check its time \
         synchronisation"
    );
    (what, why)
}

/// Describes a clock that has differed since the start.
fn describe_difference(apart: &ClockMove) -> (String, String) {
    let seconds = apart.by_ns.unsigned_abs() as f64 / 1e9;
    let others = match apart.nodes {
        2 => "the other node",
        _ => "most nodes",
    };
    let (side, cause) = match apart.by_ns < 0 {
        true => (
            "behind",
            "its samples arrive later than those of other nodes",
        ),
        false => ("ahead of", "the samples of other nodes arrive later"),
    };
    let what = format!("the clock of the node is {seconds:.2} s {side} {others}");
    let why = format!(
        "its clock is wrong, or {cause}; its samples are used at the times that it states, and look \
         delayed if the clock is wrong; check its time synchronisation"
    );
    (what, why)
}

/// Returns a difference between two clocks, such as `3.5 s ahead of`.
fn in_words(difference_ns: i64) -> String {
    let seconds = difference_ns.unsigned_abs() as f64 / 1e9;
    let side = match difference_ns < 0 {
        true => "behind",
        false => "ahead of",
    };
    format!("{seconds:.1} s {side}")
}

#[cfg(test)]
mod tests {
    use super::*;

    const TALLY: Tally = Tally {
        votes: 6,
        agreeing: 5,
    };

    #[test]
    fn movement_is_described_with_its_direction_and_size() {
        let moved = |by_ns| {
            let within = Some(std::time::Duration::from_secs(15));
            describe_move(&ClockMove {
                node: 0,
                by_ns,
                within,
                nodes: 3,
            })
        };
        assert_eq!(
            moved(300_000_000).0,
            "the clock of the node has moved forward by 0.30 s against most nodes within 15 s"
        );
        assert!(moved(-300_000_000).1.contains("arrive later"));
    }

    #[test]
    fn difference_from_the_start_is_described_with_its_side() {
        let apart = |by_ns, nodes| {
            describe_move(&ClockMove {
                node: 0,
                by_ns,
                within: None,
                nodes,
            })
        };
        assert_eq!(
            apart(300_000_000, 3).0,
            "the clock of the node is 0.30 s ahead of most nodes"
        );
        assert_eq!(
            apart(-300_000_000, 2).0,
            "the clock of the node is 0.30 s behind the other node"
        );
    }

    #[test]
    fn change_of_the_verdict_is_reported_once_with_the_difference() {
        let mut watch = ClockWatch::new(2);
        let wrong = |difference_ns| [ClockVerdict::Agrees, ClockVerdict::Wrong { difference_ns }];
        let reports = watch.read(&wrong(600_000_000_000), TALLY);
        assert_eq!(reports.len(), 1);
        assert_eq!((reports[0].node, reports[0].is_over), (1, false));
        assert_eq!(
            reports[0].what,
            "the clock of the node is 600.0 s ahead of most nodes"
        );
        assert!(reports[0].why.starts_with("5 of 6 nodes"), "{reports:?}");
        assert_eq!(watch.read(&wrong(600_100_000_000), TALLY), []);
        let reports = watch.read(&[ClockVerdict::Agrees; 2], TALLY);
        assert_eq!(reports.len(), 1);
        assert!(reports[0].is_over);
    }
}
