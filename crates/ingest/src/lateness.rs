//! Decides up to which measurement time lateness is over, from what has arrived when.

use std::collections::VecDeque;
use std::time::Duration;

/// Compares arrivals with arrivals, not clocks with clocks: a node whose clock is wrong, or a record of last year
/// replayed today, is as late as it arrives.
#[derive(Debug)]
pub struct Lateness {
    allowed: Duration,
    nodes: Vec<Arrivals>,
}

#[derive(Debug, Default)]
struct Arrivals {
    /// When, and the time of the newest sample then, ns.
    recent: VecDeque<(Duration, i64)>,
    /// Time of the newest sample that had arrived when the lateness began, ns.
    overdue_ns: Option<i64>,
    last: Option<Duration>,
}

impl Lateness {
    /// Lateness allowed to each of some nodes.
    #[must_use]
    pub fn new(allowed: Duration, nodes: usize) -> Self {
        Self {
            allowed,
            nodes: (0..nodes).map(|_| Arrivals::default()).collect(),
        }
    }

    /// A sample of measurement time `time_ns` has arrived; `now` is any clock that only goes forward.
    pub fn arrived(&mut self, node: usize, time_ns: i64, now: Duration) {
        if let Some(arrivals) = self.nodes.get_mut(node) {
            arrivals.recent.push_back((now, time_ns));
            arrivals.last = Some(now);
        }
    }

    /// Frames up to this measurement time (ns) have waited long enough.
    ///
    /// It is what half of the nodes that still deliver had delivered when the allowed lateness began (so that one node
    /// with a clock far ahead does not make the others late); of all nodes, when none delivers any more.
    pub fn deadline_ns(&mut self, now: Duration) -> Option<i64> {
        let begin = now.checked_sub(self.allowed)?;
        for arrivals in &mut self.nodes {
            while let Some((_, time_ns)) = arrivals.recent.front().filter(|(at, _)| *at <= begin) {
                arrivals.overdue_ns = Some(*time_ns);
                arrivals.recent.pop_front();
            }
        }
        let delivers = |arrivals: &&Arrivals| arrivals.last.is_some_and(|last| last > begin);
        let delivering = lower_median(
            self.nodes
                .iter()
                .filter(delivers)
                .filter_map(|a| a.overdue_ns),
        );
        let some_deliver = self.nodes.iter().any(|arrivals| delivers(&arrivals));
        if some_deliver {
            delivering
        } else {
            lower_median(self.nodes.iter().filter_map(|a| a.overdue_ns))
        }
    }
}

fn lower_median(times: impl Iterator<Item = i64>) -> Option<i64> {
    let mut times: Vec<i64> = times.collect();
    times.sort_unstable();
    times.get(times.len().saturating_sub(1) / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    #[test]
    fn a_silent_node_is_waited_for_no_longer_than_allowed() {
        let mut lateness = Lateness::new(ms(100), 2);
        lateness.arrived(1, 0, ms(0));
        for step in 0..30 {
            lateness.arrived(0, step * 10, ms(10 * step as u64));
        }
        assert_eq!(lateness.deadline_ns(ms(90)), None);
        assert_eq!(lateness.deadline_ns(ms(300)), Some(200));
    }

    #[test]
    fn a_clock_far_ahead_does_not_make_the_others_late() {
        let mut lateness = Lateness::new(ms(100), 2);
        for step in 0..30 {
            lateness.arrived(0, step * 10, ms(10 * step as u64));
            lateness.arrived(1, 1_000_000 + step * 10, ms(10 * step as u64));
        }
        assert_eq!(lateness.deadline_ns(ms(300)), Some(200));
    }

    #[test]
    fn when_all_are_silent_what_arrived_is_not_kept_back_for_ever() {
        let mut lateness = Lateness::new(ms(100), 2);
        lateness.arrived(0, 70, ms(10));
        assert_eq!(lateness.deadline_ns(ms(1000)), Some(70));
    }
}
