//! Determines from arrival times up to which measurement time frames have waited long enough.

use std::collections::VecDeque;
use std::time::Duration;

/// Tracks when samples arrive, and computes the deadline of frames.
///
/// Lateness compares arrival times with each other, not with node clocks. The result is therefore
/// independent of clock errors, and of the age of a replayed record.
#[derive(Debug)]
pub struct Lateness {
    allowed: Duration,
    nodes: Vec<Arrivals>,
}

#[derive(Debug, Default)]
struct Arrivals {
    /// Arrival time, and the time of the newest sample at that moment (ns).
    recent: VecDeque<(Duration, i64)>,
    /// Time of the newest sample that arrived before the allowed lateness began, ns.
    overdue_ns: Option<i64>,
    last: Option<Duration>,
}

impl Lateness {
    /// Creates the state for `nodes` nodes. Samples may be late by `allowed`.
    #[must_use]
    pub fn new(allowed: Duration, nodes: usize) -> Self {
        Self {
            allowed,
            nodes: (0..nodes).map(|_| Arrivals::default()).collect(),
        }
    }

    /// Forgets all arrivals. Call it when a new run starts, because the times of the former run can
    /// lie in its future.
    pub fn reset(&mut self) {
        self.nodes.fill_with(Arrivals::default);
    }

    /// Forgets the arrivals of a node whose clock is wrong.
    pub fn forget(&mut self, node: usize) {
        if let Some(arrivals) = self.nodes.get_mut(node) {
            *arrivals = Arrivals::default();
        }
    }

    /// Records the arrival of a live sample with measurement time `time_ns` (ns). `now` is a
    /// reading of any monotonic clock.
    pub fn arrived(&mut self, node: usize, time_ns: i64, now: Duration) {
        if let Some(arrivals) = self.nodes.get_mut(node) {
            arrivals.recent.push_back((now, time_ns));
            arrivals.last = Some(now);
        }
    }

    /// Returns the measurement time (ns) up to which frames have waited long enough, or `None` if
    /// there is no such time yet.
    ///
    /// The result is the lower median of the newest sample times of the nodes, as of `now` minus
    /// the allowed lateness. It includes only nodes that still deliver, or all nodes if none does.
    /// A node that has begun since then counts as the earliest.
    /// The median prevents one node with a clock far ahead from making the other nodes late.
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
                .map(|a| a.overdue_ns.unwrap_or(i64::MIN)),
        )
        .filter(|time_ns| *time_ns > i64::MIN);
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
    fn silent_node_is_awaited_for_at_most_the_lateness() {
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
    fn first_node_does_not_make_those_late_that_have_just_begun() {
        let mut lateness = Lateness::new(ms(100), 3);
        for step in 0..30 {
            lateness.arrived(0, 1_000_000 + step * 10, ms(10 * step as u64));
        }
        lateness.arrived(1, 300, ms(295));
        lateness.arrived(2, 300, ms(295));
        assert_eq!(lateness.deadline_ns(ms(300)), None);
    }

    #[test]
    fn times_of_a_former_run_set_no_deadline() {
        let mut lateness = Lateness::new(ms(100), 1);
        lateness.arrived(0, 1_000_000, ms(0));
        assert_eq!(lateness.deadline_ns(ms(200)), Some(1_000_000));
        lateness.reset();
        assert_eq!(lateness.deadline_ns(ms(300)), None);
    }

    #[test]
    fn frames_are_closed_after_the_lateness_if_all_nodes_are_silent() {
        let mut lateness = Lateness::new(ms(100), 2);
        lateness.arrived(0, 70, ms(10));
        assert_eq!(lateness.deadline_ns(ms(1000)), Some(70));
    }
}
