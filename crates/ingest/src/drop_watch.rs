//! Detects nodes that lose a large share of their samples on the way to the frames.

use std::collections::VecDeque;
use std::time::Duration;

use crate::counts::NodeCounts;

/// Length of the span over which shares are computed.
const SPAN: Duration = Duration::from_secs(5);
/// Time after the first sample of a node, or after a silence of the same length, in which nothing is
/// reported. If one clock is ahead, the first frames are those of its time, and the samples of all
/// other nodes are late at first. Within this time, the clocks are compared, and the wrong one is
/// reported instead.
const FIRST: Duration = Duration::from_secs(7);
/// Minimum number of samples in a span. A few dropped samples at the start are no finding.
const MIN_SAMPLES: u64 = 20;
/// Share of dropped samples above which a node is reported, and below which it has recovered. The
/// distance prevents repeated reports of a share near one limit.
const REPORTED_ABOVE: f64 = 0.2;
const RECOVERED_BELOW: f64 = 0.05;

/// A report on one node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct DropReport {
    /// Index of the node.
    pub(crate) node: usize,
    /// What happened, with numbers.
    pub(crate) what: String,
    /// The cause, and advice.
    pub(crate) why: String,
    /// `true` if the node has recovered.
    pub(crate) is_over: bool,
}

/// Watches the counters of all nodes. The passage of time is an argument.
#[derive(Debug)]
pub(crate) struct DropWatch {
    nodes: Vec<Node>,
    /// Advice for the two causes that settings can change.
    lateness_s: f64,
    tolerance_s: f64,
}

#[derive(Debug, Default)]
struct Node {
    /// Reading with the first samples.
    first: Option<Duration>,
    /// Last reading with new samples, and the number of samples so far.
    last: (Duration, u64),
    /// Readings of the counters, oldest first.
    readings: VecDeque<(Duration, NodeCounts)>,
    is_reported: bool,
}

impl DropWatch {
    /// Creates the watch for `nodes` nodes. The other arguments are settings of ingest, in seconds.
    pub(crate) fn new(nodes: usize, lateness_s: f64, tolerance_s: f64) -> Self {
        Self {
            nodes: (0..nodes).map(|_| Node::default()).collect(),
            lateness_s,
            tolerance_s,
        }
    }

    /// Reads the counters of the nodes, in layout order, and appends a report for each node that
    /// starts or ceases to lose samples.
    pub(crate) fn read(
        &mut self,
        counts: impl Iterator<Item = NodeCounts>,
        now: Duration,
        reports: &mut Vec<DropReport>,
    ) {
        for (index, (node, counts)) in self.nodes.iter_mut().zip(counts).enumerate() {
            if counts.received == node.last.1 {
                let is_silent = now.saturating_sub(node.last.0) >= FIRST;
                node.first.take_if(|_| is_silent);
                continue;
            }
            node.last = (now, counts.received);
            let first = *node.first.get_or_insert(now);
            if now.saturating_sub(first) < FIRST {
                continue;
            }
            node.readings.push_back((now, counts));
            let is_over = |(at, _): &mut (Duration, NodeCounts)| now.saturating_sub(*at) > SPAN;
            while node.readings.len() > 2 && node.readings.pop_front_if(is_over).is_some() {}
            let Some((since, first)) = node.readings.front() else {
                continue;
            };
            let drops = Drops::between(first, &counts);
            let share = drops.share();
            if drops.received < MIN_SAMPLES {
                continue;
            }
            let span_s = now.saturating_sub(*since).as_secs_f64();
            let report = match node.is_reported {
                true if share < RECOVERED_BELOW => DropReport {
                    node: index,
                    what: format!(
                        "{:.0} % of the samples of the last {span_s:.0} s reached the frames",
                        100.0 * (1.0 - share)
                    ),
                    why: "its samples arrive in time again".to_owned(),
                    is_over: true,
                },
                false if share > REPORTED_ABOVE => DropReport {
                    node: index,
                    what: format!(
                        "{:.0} % of the samples of the last {span_s:.0} s were dropped: {} of {}",
                        100.0 * share,
                        drops.in_words(),
                        drops.received
                    ),
                    why: drops.advice(self.lateness_s, self.tolerance_s),
                    is_over: false,
                },
                _ => continue,
            };
            node.is_reported = !report.is_over;
            reports.push(report);
        }
    }
}

/// Samples dropped between two readings, by reason.
#[derive(Debug)]
struct Drops {
    received: u64,
    late: u64,
    duplicate: u64,
    off_grid: u64,
    retracted: u64,
    wrong_clock: u64,
    overflowed: u64,
}

impl Drops {
    fn between(first: &NodeCounts, last: &NodeCounts) -> Self {
        Self {
            received: last.received.saturating_sub(first.received),
            late: last.late.saturating_sub(first.late),
            duplicate: last.duplicate.saturating_sub(first.duplicate),
            off_grid: last.off_grid.saturating_sub(first.off_grid),
            retracted: last.retracted.saturating_sub(first.retracted),
            wrong_clock: last.wrong_clock.saturating_sub(first.wrong_clock),
            overflowed: last.overflowed.saturating_sub(first.overflowed),
        }
    }

    fn reasons(&self) -> [(&'static str, u64); 6] {
        [
            ("late", self.late),
            ("duplicate", self.duplicate),
            ("off the grid", self.off_grid),
            ("retracted", self.retracted),
            ("of a wrong clock", self.wrong_clock),
            ("overflowed", self.overflowed),
        ]
    }

    /// Returns the share of dropped samples, at most 1. A sample parked earlier can be dropped now.
    fn share(&self) -> f64 {
        let dropped: u64 = self.reasons().iter().map(|(_, count)| count).sum();
        (dropped as f64 / self.received.max(1) as f64).min(1.0)
    }

    fn in_words(&self) -> String {
        let words = self
            .reasons()
            .into_iter()
            .filter(|(_, count)| *count > 0)
            .map(|(reason, count)| format!("{count} {reason}"));
        words.collect::<Vec<_>>().join(", ")
    }

    /// Returns the cause of the most frequent reason, with advice.
    fn advice(&self, lateness_s: f64, tolerance_s: f64) -> String {
        let (reason, _) = self
            .reasons()
            .into_iter()
            .max_by_key(|(_, count)| *count)
            .unwrap_or_default();
        match reason {
            "late" => format!(
                "their frames were already closed; compare the clock of the node with the other \
                 nodes, and the delay of its link with ingest.lateness-s ({lateness_s} s)"
            ),
            "duplicate" => "their frames already had a sample of this node; compare the sampling \
                            rate of the node with the structure file, and its clock with the other \
                            nodes"
                .to_owned(),
            "off the grid" => format!(
                "they lie between two frames; synchronise the clock of the node with the other \
                 nodes, or allow a larger ingest.tolerance-s ({tolerance_s} s)"
            ),
            "of a wrong clock" => {
                "the clock of the node differs from that of the other nodes; check its time \
                 synchronisation"
                    .to_owned()
            }
            "retracted" => {
                "the clock of the node went back; check its time synchronisation".to_owned()
            }
            _ => "the node is far ahead of the other nodes; check its clock".to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(received: u64, late: u64) -> NodeCounts {
        NodeCounts {
            received,
            late,
            ..NodeCounts::default()
        }
    }

    /// Returns the reports of a watch over one node, with the second of each.
    fn reports(course: impl Iterator<Item = NodeCounts>) -> Vec<(u64, DropReport)> {
        let mut watch = DropWatch::new(1, 1.0, 0.005);
        let mut all = Vec::new();
        for (second, counts) in (0..).zip(course) {
            let mut reports = Vec::new();
            let now = Duration::from_secs(second);
            watch.read(std::iter::once(counts), now, &mut reports);
            all.extend(reports.into_iter().map(|report| (second, report)));
        }
        all
    }

    #[test]
    fn node_whose_samples_are_late_is_reported_once_with_numbers_and_advice() {
        let told = reports((0..20).map(|second| counts(100 * second, 67 * second)));
        assert_eq!(told.len(), 1, "{told:?}");
        let (second, report) = &told[0];
        assert!(*second <= 9 && !report.is_over, "{told:?}");
        assert_eq!(
            report.what,
            "67 % of the samples of the last 1 s were dropped: 67 late of 100"
        );
        assert!(report.why.contains("ingest.lateness-s (1 s)"), "{told:?}");
    }

    #[test]
    fn recovery_is_reported_after_a_span_without_drops() {
        let told = reports((0..30).map(|second| counts(100 * second, 67 * second.min(10))));
        let is_over: Vec<_> = told.iter().map(|(_, report)| report.is_over).collect();
        assert_eq!(is_over, [false, true], "{told:?}");
        // The last dropped sample is read at second 10, and leaves the span of 5 s at second 15.
        assert_eq!(told[1].0, 15);
    }

    #[test]
    fn few_samples_and_few_drops_are_not_reported() {
        assert_eq!(
            reports((0..10).map(|second| counts(3 * second, 3 * second))),
            []
        );
        assert_eq!(
            reports((0..30).map(|second| counts(100 * second, 15 * second))),
            []
        );
    }
}
