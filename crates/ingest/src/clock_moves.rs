//! Finds clocks that move against those of the other nodes, by a jump or a drift.
//!
//! The [vote](crate::clock_vote) excludes a node whose clock differs by seconds, and reports it. A
//! smaller difference leaves its samples in the frames, at wrong times, where it looks like a delay
//! of the sensor. A difference from the start is therefore reported as well, once.
//!
//! The offset of a node is the time of its newest sample minus a monotonic clock at its arrival. The
//! largest offset within a window has the least delay.

use std::time::Duration;

/// Span over which the largest offset is determined.
const WINDOW: Duration = Duration::from_secs(5);
/// Least movement that is reported, ns. Links rarely delay all samples of a window by as much.
const LEAST_NS: i64 = 100_000_000;
/// Least difference from the start that is reported, ns. The links of one site differ by less.
const LEAST_APART_NS: i64 = 250_000_000;
/// Minimum number of nodes. With fewer nodes, it is not known whose clock has moved.
const LEAST_NODES: usize = 3;

/// A clock that has moved, or that differs from the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ClockMove {
    /// Index of the node.
    pub(crate) node: usize,
    /// Change of the difference between its clock and that of most nodes, ns: positive if the
    /// clock is now further ahead.
    pub(crate) by_ns: i64,
    /// Span within which the clock has moved. `None` if it has differed since the start.
    pub(crate) within: Option<Duration>,
    /// Number of nodes that were compared.
    pub(crate) nodes: usize,
}

/// The clocks of the nodes of a structure. The passage of time is an argument.
#[derive(Debug)]
pub(crate) struct ClockMoves {
    nodes: Vec<Clock>,
    /// Movement above which the vote decides, ns.
    most_ns: u64,
    window_begin: Option<Duration>,
    /// Number of nodes that were compared in the former window.
    compared: usize,
}

/// Differences are those to the median of the nodes, ns.
#[derive(Clone, Debug, Default)]
struct Clock {
    /// Largest offset within the present window, ns.
    largest_ns: Option<i64>,
    /// Difference in the former window.
    former_ns: Option<i64>,
    /// Difference from which movements count, and the end of its window.
    reference: Option<(i64, Duration)>,
    /// Whether other nodes are compared since the reference was taken.
    is_outdated: bool,
}

impl ClockMoves {
    /// Creates the state of `nodes` nodes. Movements of more than `most` are left to the vote.
    pub(crate) fn new(nodes: usize, most: Duration) -> Self {
        Self {
            nodes: vec![Clock::default(); nodes],
            most_ns: u64::try_from(most.as_nanos()).unwrap_or(u64::MAX),
            window_begin: None,
            compared: 0,
        }
    }

    /// Records the arrival of a live sample with measurement time `time_ns` (ns). `now` is a
    /// reading of any monotonic clock.
    pub(crate) fn arrived(&mut self, node: usize, time_ns: i64, now: Duration) {
        self.window_begin.get_or_insert(now);
        if let Some(clock) = self.nodes.get_mut(node) {
            let now_ns = i64::try_from(now.as_nanos()).unwrap_or(i64::MAX);
            let offset_ns = time_ns.saturating_sub(now_ns);
            clock.largest_ns = clock.largest_ns.max(Some(offset_ns));
        }
    }

    /// Forgets the clock of a node that the vote excludes or includes again.
    pub(crate) fn forget(&mut self, node: usize) {
        if let Some(clock) = self.nodes.get_mut(node) {
            *clock = Clock::default();
        }
    }

    /// Returns the clocks that have moved since the last call. A movement must last for two
    /// windows.
    pub(crate) fn read(&mut self, now: Duration) -> Vec<ClockMove> {
        let is_over = |begin: Duration| now.saturating_sub(begin) >= WINDOW;
        if !self.window_begin.is_some_and(is_over) {
            return Vec::new();
        }
        self.window_begin = None;
        let largest = self.nodes.iter().filter_map(|clock| clock.largest_ns);
        let mut largest: Vec<i64> = largest.collect();
        largest.sort_unstable();
        let nodes = largest.len();
        // The median of other nodes differs, although no clock has moved.
        let is_other_median = std::mem::replace(&mut self.compared, nodes) != nodes;
        let median_ns = largest.get(nodes / 2).copied();
        let mut moves = Vec::new();
        for (node, clock) in self.nodes.iter_mut().enumerate() {
            clock.is_outdated |= is_other_median && clock.reference.is_some();
            let offset_ns = clock.largest_ns.take();
            let difference_ns = offset_ns
                .zip(median_ns)
                .map(|(offset_ns, median_ns)| offset_ns.saturating_sub(median_ns));
            let former_ns = std::mem::replace(&mut clock.former_ns, difference_ns);
            let (Some(difference_ns), Some(former_ns)) = (difference_ns, former_ns) else {
                continue;
            };
            if difference_ns.abs_diff(former_ns) > LEAST_NS as u64 / 2 {
                continue; // still moving, or catching up after an outage
            }
            let is_outdated = std::mem::take(&mut clock.is_outdated);
            let (by_ns, within) = match clock.reference {
                None if difference_ns.unsigned_abs() >= LEAST_APART_NS as u64 => {
                    (difference_ns, None)
                }
                Some((reference_ns, since)) if nodes >= LEAST_NODES && !is_outdated => {
                    let by_ns = difference_ns.saturating_sub(reference_ns);
                    (by_ns, Some(now.saturating_sub(since)))
                }
                _ => (0, None),
            };
            let has_moved = by_ns.unsigned_abs() >= LEAST_NS as u64;
            if clock.reference.is_none() || has_moved || is_outdated {
                clock.reference = Some((difference_ns, now));
            }
            if has_moved && by_ns.unsigned_abs() <= self.most_ns {
                moves.push(ClockMove {
                    node,
                    by_ns,
                    within,
                    nodes,
                });
            }
        }
        moves
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const T0_NS: i64 = 1_700_000_000_000_000_000;

    /// Clocks, with the present time. Nodes deliver a block every 0.1 s.
    struct Rig {
        moves: ClockMoves,
        now: Duration,
        blocks: u64,
    }

    impl Rig {
        fn new(nodes: usize) -> Self {
            Self {
                moves: ClockMoves::new(nodes, Duration::from_secs(5)),
                now: Duration::from_secs(1000),
                blocks: 0,
            }
        }

        /// Lets nodes deliver for some seconds. `off_ms` is the error of the clock of a node minus
        /// the delay of its link, ms, at a time (s from now).
        fn run(&mut self, seconds: u64, off_ms: impl Fn(usize, f64) -> f64) -> Vec<ClockMove> {
            self.run_some(seconds, 0..self.moves.nodes.len(), off_ms)
        }

        /// As [`Self::run`], for some of the nodes.
        fn run_some(
            &mut self,
            seconds: u64,
            nodes: std::ops::Range<usize>,
            off_ms: impl Fn(usize, f64) -> f64,
        ) -> Vec<ClockMove> {
            let (begin, mut found) = (self.now, Vec::new());
            for _ in 0..10 * seconds {
                self.now += Duration::from_millis(100);
                self.blocks += 1;
                for node in nodes.clone() {
                    // Links delay four blocks of five by up to 80 ms.
                    let delay_ms = 20.0 * ((self.blocks + node as u64) % 5) as f64;
                    let elapsed_s = (self.now - begin).as_secs_f64();
                    let off_ns = ((off_ms(node, elapsed_s) - delay_ms) * MS as f64) as i64;
                    let time_ns = T0_NS + self.now.as_nanos() as i64 + off_ns;
                    self.moves.arrived(node, time_ns, self.now);
                }
                found.extend(self.moves.read(self.now));
            }
            found
        }
    }

    #[test]
    fn jump_of_one_clock_is_reported_once_with_its_size() {
        let mut rig = Rig::new(4);
        assert_eq!(rig.run(60, |_, _| 0.0), []);
        let ahead = |node: usize, _: f64| if node == 2 { 300.0 } else { 0.0 };
        let moves = rig.run(60, ahead);
        let [
            ClockMove {
                node: 2,
                by_ns,
                within: Some(within),
                ..
            },
        ] = moves[..]
        else {
            panic!("{moves:?}");
        };
        assert_eq!(by_ns, 300 * MS);
        assert!(within <= Duration::from_secs(70), "{within:?}");
        let moves = rig.run(60, |_, _| 0.0);
        assert_eq!(moves.len(), 1);
        assert_eq!((moves[0].node, moves[0].by_ns), (2, -300 * MS));
    }

    #[test]
    fn node_that_joins_or_leaves_moves_no_clock() {
        let mut rig = Rig::new(3);
        let apart = |node: usize, _: f64| if node == 0 { 0.0 } else { -200.0 };
        assert_eq!(rig.run_some(60, 0..2, apart), []);
        assert_eq!(rig.run_some(60, 0..3, apart), []);
        assert_eq!(rig.run_some(60, 0..2, apart), []);
    }

    #[test]
    fn drift_is_reported_whenever_it_has_reached_the_limit() {
        let mut rig = Rig::new(3);
        // 500 ppm, which is 0.5 ms per second.
        let moves = rig.run(1000, |node, t_s| if node == 1 { 0.5 * t_s } else { 0.0 });
        assert!((4..=5).contains(&moves.len()), "{moves:?}");
        assert!(moves.iter().all(|moved| moved.node == 1), "{moves:?}");
        let sum_ns: i64 = moves.iter().map(|moved| moved.by_ns).sum();
        assert!(
            (400 * MS..=500 * MS).contains(&sum_ns),
            "{sum_ns} of 500 ms"
        );
    }

    #[test]
    fn different_constant_delays_and_jitter_are_no_movement() {
        let mut rig = Rig::new(4);
        assert_eq!(rig.run(300, |node, _| -60.0 * node as f64), []);
    }

    #[test]
    fn difference_from_the_start_is_reported_once() {
        let mut rig = Rig::new(4);
        let behind = |node: usize, _: f64| if node == 1 { -300.0 } else { 0.0 };
        let apart = |node, by_ms, nodes| ClockMove {
            node,
            by_ns: by_ms * MS,
            within: None,
            nodes,
        };
        assert_eq!(rig.run(300, behind), [apart(1, -300, 4)]);
        // Of two nodes, the one that is behind is named.
        let mut rig = Rig::new(2);
        let behind = |node: usize, _: f64| if node == 0 { -300.0 } else { 0.0 };
        assert_eq!(rig.run(300, behind), [apart(0, -300, 2)]);
    }

    #[test]
    fn clock_that_jumps_by_hours_is_left_to_the_vote() {
        let mut rig = Rig::new(4);
        assert_eq!(rig.run(30, |_, _| 0.0), []);
        let hours = |node: usize, _: f64| if node == 2 { 7_200_000.0 } else { 0.0 };
        assert_eq!(rig.run(30, hours), []);
    }

    #[test]
    fn clocks_that_step_together_have_not_moved_against_each_other() {
        let mut rig = Rig::new(3);
        assert_eq!(rig.run(30, |_, _| 0.0), []);
        assert_eq!(rig.run(30, |_, _| 3_600_000.0), []);
    }

    // Its samples arrive ever less late, which is no movement of its clock.
    #[test]
    fn node_that_catches_up_after_an_outage_has_not_moved() {
        let mut rig = Rig::new(3);
        assert_eq!(rig.run(30, |_, _| 0.0), []);
        let catching_up = |node: usize, t_s: f64| match node {
            0 => (-20_000.0 + 1000.0 * t_s).min(0.0),
            _ => 0.0,
        };
        assert_eq!(rig.run(60, catching_up), []);
    }

    #[test]
    fn of_two_nodes_nobody_knows_which_one_has_moved() {
        let mut rig = Rig::new(2);
        assert_eq!(rig.run(30, |_, _| 0.0), []);
        assert_eq!(rig.run(30, |node, _| 500.0 * node as f64), []);
    }
}
