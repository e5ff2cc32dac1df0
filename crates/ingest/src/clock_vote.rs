//! Compares the clocks of the nodes, and decides by majority what time it is.
//!
//! The offset of a node is the time of its newest sample minus the reading of a monotonic clock at
//! its arrival. A delay only lowers the offset, and a node that catches up after a delay raises it
//! quickly. A node therefore votes only with an offset that is steady.
//!
//! A node that is ahead cannot be late, but most other nodes can, for example behind one gateway.
//! If more than half of the nodes agree more closely, and agree better with the clock of the
//! machine, a node that is steadily ahead by less than the limit is wrong as well.
//!
//! More than half of the votes, and at least two, decide. They must agree within a limit. Their
//! decision remains in force as long as one node supports it. A node whose clock jumps, or that
//! restarts first after a power cut, therefore cannot change it alone. If more than half of the
//! nodes are ahead of the decision together, all of them were late when they voted, and it moves at
//! once.
//!
//! If the largest groups of at least two nodes are equally large, the one that agrees with the
//! clock of the machine decides. Otherwise, the group that was there first would keep the correct
//! half out.

use std::collections::VecDeque;
use std::time::Duration;

/// Span, by the monotonic clock, over which an offset must be steady.
const STEADY_FOR: Duration = Duration::from_secs(1);
/// Change of an offset within [`STEADY_FOR`] that is still steady, ns. A node that catches up at
/// 1.25 times real time exceeds it.
const STEADY_WITHIN_NS: i64 = 250_000_000;
/// Interval within which arrivals count as one. It bounds the memory.
const TOGETHER: Duration = Duration::from_millis(10);
/// Span within which late nodes that catch up together follow the first of them.
const CAUGHT_UP_WITHIN: Duration = Duration::from_secs(1);
/// Span for which a node must be steadily behind before its clock is blamed and not its link.
const BEHIND_FOR: Duration = Duration::from_secs(3);
/// Span for which a node must be steadily ahead within the limit.
const AHEAD_FOR: Duration = Duration::from_secs(5);
/// Span for which the vote of a silent node counts. Nodes restart within it after a power cut.
const VOTE_LASTS: Duration = Duration::from_secs(300);
/// Change of an offset that calls for a new count of the votes, ns.
const RECOUNT_NS: i64 = 500_000_000;
/// Span for which clocks must disagree without a majority before that is reported.
const TIED_FOR: Duration = Duration::from_secs(3);

/// Result of the vote on the clock of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockVerdict {
    /// The clock agrees with the majority, or nothing contradicts it.
    Agrees,
    /// The clock differs from that of the majority.
    Wrong {
        /// Clock of the node minus clock of the majority, ns.
        difference_ns: i64,
    },
    /// The clocks differ, and no majority of them agrees.
    Tied {
        /// Largest difference between the clock of this node and that of another node, ns:
        /// positive if this node is ahead.
        difference_ns: i64,
    },
}

/// Majority vote of the nodes of a structure on the correct time.
///
/// It finds nodes whose clock differs from the clock of the majority. It reads no clock: callers
/// pass the monotonic time of each call.
#[derive(Debug)]
pub struct ClockVote {
    limit_ns: i64,
    /// Largest steady lead over most nodes that links explain, ns. At most `limit_ns`.
    lead_ns: i64,
    nodes: Vec<Voter>,
    /// Clock of the majority minus the monotonic clock, ns.
    majority_ns: Option<i64>,
    /// Whether more than half of the votes, and at least two, are within `lead_ns` of it.
    is_close: bool,
    /// Clock of the machine minus the monotonic clock, ns. It decides between equal groups.
    machine_ns: Option<i64>,
    tied_since: Option<Duration>,
}

#[derive(Debug, Default)]
struct Voter {
    /// Arrival, and the offset of the newest sample at that moment (ns).
    recent: VecDeque<(Duration, i64)>,
    /// The last steady offset, ns.
    vote_ns: Option<i64>,
    /// The offset that was counted last, ns.
    counted_ns: Option<i64>,
    /// Since when the node is steadily behind, or steadily ahead within the limit, and its offset
    /// then (ns).
    apart_since: Option<(Duration, i64)>,
    /// Since when the node is ahead without a jump.
    ahead_since: Option<Duration>,
    /// Change of the offset by the newest sample, ns; `None` before the second sample.
    rise_ns: Option<i64>,
    is_wrong: bool,
    /// Whether it is wrong because it is steadily ahead within the limit.
    leads: bool,
}

/// What the clock of a node is compared with, ns.
#[derive(Clone, Copy, Debug)]
struct Comparison {
    majority_ns: Option<i64>,
    limit_ns: i64,
    lead_ns: i64,
    /// Whether more than half of the votes, and at least two, are within `lead_ns` of the majority.
    is_close: bool,
    machine_ns: Option<i64>,
}

impl Comparison {
    /// Returns `true` if the clock of the machine agrees with the majority, and is closer to it than
    /// to this offset.
    ///
    /// Otherwise, most nodes may be late, and the node that leads them is prompt.
    fn confirms(&self, offset_ns: i64) -> bool {
        let both = self.majority_ns.zip(self.machine_ns);
        let is_closer = both.is_some_and(|(majority_ns, machine_ns)| {
            let distance_ns = majority_ns.abs_diff(machine_ns);
            let agrees = distance_ns <= self.limit_ns.unsigned_abs();
            agrees && distance_ns < offset_ns.abs_diff(machine_ns)
        });
        self.is_close && is_closer
    }
}

impl Voter {
    fn heard(&self) -> Option<Duration> {
        self.recent.back().map(|(at, _)| *at)
    }

    /// Returns the difference between the newest offset and another one, ns.
    fn ahead_of(&self, offset_ns: i64) -> i64 {
        let newest = self.recent.back().map(|(_, newest_ns)| *newest_ns);
        newest.map_or(0, |newest_ns| newest_ns.saturating_sub(offset_ns))
    }

    fn arrived(&mut self, offset_ns: i64, now: Duration) {
        let last = self.recent.back();
        self.rise_ns = last.map(|(_, last_ns)| offset_ns.saturating_sub(*last_ns));
        match self.recent.back_mut() {
            Some((at, last_ns)) if now.saturating_sub(*at) < TOGETHER => {
                // A block that arrives together with an earlier one shows the lesser delay, unless
                // the clock has gone back.
                *last_ns = offset_ns;
            }
            _ => self.recent.push_back((now, offset_ns)),
        }
        let before = now.saturating_sub(2 * STEADY_FOR);
        while self.recent.get(1).is_some_and(|(at, _)| *at <= before) {
            self.recent.pop_front();
        }
        if let Some(steady_ns) = self.steady_ns(now) {
            self.vote_ns = Some(steady_ns);
        }
    }

    /// Compares the clock with that of the majority.
    ///
    /// No delay moves a clock ahead, so the first sample that jumps ahead is wrong. A node that
    /// comes ahead without a jump may be the first of late nodes that catch up, and is judged after
    /// [`CAUGHT_UP_WITHIN`]. A node that is behind may be late, and is judged after it has been
    /// steadily behind. So is a node that is ahead within the limit. Its newest sample may be late,
    /// so its largest recent offset counts.
    fn compare(&mut self, with: &Comparison, now: Duration) {
        let Comparison {
            majority_ns,
            limit_ns,
            lead_ns,
            ..
        } = *with;
        let ahead_ns = majority_ns.map_or(0, |majority_ns| self.ahead_of(majority_ns));
        if ahead_ns > limit_ns {
            let since = *self.ahead_since.get_or_insert(now);
            let has_jumped = self.rise_ns.is_none_or(|rise_ns| rise_ns > limit_ns);
            self.is_wrong |= has_jumped || now.saturating_sub(since) >= CAUGHT_UP_WITHIN;
            self.leads = false;
            self.apart_since = None;
            return;
        }
        self.ahead_since = None;
        let steady_ns = self.steady_ns(now);
        if ahead_ns >= -limit_ns {
            let lead = steady_ns
                .zip(majority_ns)
                .map(|(steady_ns, majority_ns)| steady_ns.saturating_sub(majority_ns) > lead_ns);
            match (lead, steady_ns) {
                (Some(true), Some(steady_ns)) if self.leads || with.confirms(steady_ns) => {
                    self.leads |= self.is_apart_for(AHEAD_FOR, steady_ns, now);
                }
                (None, _) => {} // it has just stalled, or moved
                _ => {
                    self.leads = false;
                    self.apart_since = None;
                }
            }
            self.is_wrong = self.leads;
            return;
        }
        self.leads = false;
        if let Some(steady_ns) = steady_ns {
            self.is_wrong |= self.is_apart_for(BEHIND_FOR, steady_ns, now);
        }
    }

    /// Returns `true` if the steady offset has been the same for this span.
    fn is_apart_for(&mut self, span: Duration, steady_ns: i64, now: Duration) -> bool {
        let is_same = |(_, first_ns): &(Duration, i64)| {
            first_ns.abs_diff(steady_ns) <= STEADY_WITHIN_NS.unsigned_abs()
        };
        let first = self.apart_since.filter(is_same);
        let first = *self.apart_since.insert(first.unwrap_or((now, steady_ns)));
        now.saturating_sub(first.0) >= span
    }

    /// Returns the largest recent offset if it has not changed for [`STEADY_FOR`].
    fn steady_ns(&self, now: Duration) -> Option<i64> {
        let begin = now.checked_sub(STEADY_FOR)?;
        let largest = |is_early: bool| {
            let of_part = self
                .recent
                .iter()
                .filter(|(at, _)| (*at <= begin) == is_early);
            of_part.map(|(_, offset_ns)| *offset_ns).max()
        };
        let (early_ns, late_ns) = (largest(true)?, largest(false)?);
        (early_ns.abs_diff(late_ns) <= STEADY_WITHIN_NS.unsigned_abs()).then_some(late_ns)
    }
}

impl ClockVote {
    /// Creates the vote of `nodes` nodes whose clocks and links may differ by `limit`. A node may
    /// steadily be ahead of most nodes by `lead`.
    #[must_use]
    pub fn new(limit: Duration, lead: Duration, nodes: usize) -> Self {
        let ns = |span: Duration| i64::try_from(span.as_nanos()).unwrap_or(i64::MAX);
        Self {
            limit_ns: ns(limit),
            lead_ns: ns(lead.min(limit)),
            nodes: (0..nodes).map(|_| Voter::default()).collect(),
            majority_ns: None,
            is_close: false,
            machine_ns: None,
            tied_since: None,
        }
    }

    /// Sets the time (ns) that the clock of the machine shows at `now`.
    pub fn set_machine_time(&mut self, time_ns: i64, now: Duration) {
        let now_ns = i64::try_from(now.as_nanos()).unwrap_or(i64::MAX);
        self.machine_ns = Some(time_ns.saturating_sub(now_ns));
    }

    /// Records the arrival of a live sample with measurement time `time_ns` (ns). `now` is a
    /// reading of any monotonic clock.
    ///
    /// Returns `true` if a clock has become wrong or right.
    pub fn arrived(&mut self, node: usize, time_ns: i64, now: Duration) -> bool {
        let Some(voter) = self.nodes.get_mut(node) else {
            return false;
        };
        let now_ns = i64::try_from(now.as_nanos()).unwrap_or(i64::MAX);
        voter.arrived(time_ns.saturating_sub(now_ns), now);
        let has_moved = match (voter.vote_ns, voter.counted_ns) {
            (Some(vote_ns), Some(counted_ns)) => vote_ns.abs_diff(counted_ns) > RECOUNT_NS as u64,
            (vote_ns, counted_ns) => vote_ns != counted_ns,
        };
        let newest = self.nodes.get(node);
        let is_ahead = newest
            .zip(self.majority_ns)
            .is_some_and(|(voter, majority_ns)| voter.ahead_of(majority_ns) > self.limit_ns);
        let is_outdated = is_ahead && self.move_ahead(now);
        match has_moved || is_outdated {
            true => self.look(now),
            false => self.judge(node, now),
        }
    }

    /// Replaces the votes of the nodes that are ahead of the majority and agree, if they are more
    /// than half of the nodes. Returns `true` if they are.
    ///
    /// No delay moves a clock ahead. The votes came from a time in which all nodes were late.
    fn move_ahead(&mut self, now: Duration) -> bool {
        let Some(majority_ns) = self.majority_ns else {
            return false;
        };
        let limit_ns = self.limit_ns;
        let is_ahead = |voter: &Voter| {
            let is_recent = |at: Duration| now.saturating_sub(at) <= STEADY_FOR;
            voter.heard().is_some_and(is_recent) && voter.ahead_of(majority_ns) > limit_ns
        };
        let ahead = self.nodes.iter().filter(|voter| is_ahead(voter));
        let mut ahead_ns: Vec<i64> = ahead.map(|voter| voter.ahead_of(majority_ns)).collect();
        ahead_ns.sort_unstable();
        // The clock of one node may be wrong at the same time.
        let largest = largest_group(&ahead_ns, limit_ns);
        // A declared node that has never voted takes no part.
        let takes_part = |voter: &&Voter| voter.counted_ns.is_some() || is_ahead(voter);
        let nodes = self.nodes.iter().filter(takes_part).count();
        let (Some(&least_ns), Some(&most_ns)) = (largest.first(), largest.last()) else {
            return false;
        };
        if largest.len() < 2 || 2 * largest.len() <= nodes {
            return false;
        }
        let has_moved = |voter: &Voter| {
            is_ahead(voter) && (least_ns..=most_ns).contains(&voter.ahead_of(majority_ns))
        };
        for voter in self.nodes.iter_mut().filter(|voter| has_moved(voter)) {
            voter.vote_ns = voter.recent.back().map(|(_, offset_ns)| *offset_ns);
        }
        true
    }

    /// Recounts the votes as time passes, because the votes of silent nodes expire.
    ///
    /// Returns `true` if a clock has become wrong or right.
    pub fn look(&mut self, now: Duration) -> bool {
        self.count(now);
        let nodes = 0..self.nodes.len();
        nodes.filter(|node| self.judge(*node, now)).count() > 0
    }

    /// Returns the verdict on each node.
    pub fn verdicts(&self, now: Duration) -> Vec<ClockVerdict> {
        let is_tied = self
            .tied_since
            .is_some_and(|since| now.saturating_sub(since) >= TIED_FOR);
        let votes = || self.nodes.iter().filter_map(|voter| voter.counted_ns);
        let verdict = |voter: &Voter| match (voter.is_wrong, self.majority_ns, voter.counted_ns) {
            (true, Some(majority_ns), _) => ClockVerdict::Wrong {
                difference_ns: voter.ahead_of(majority_ns),
            },
            (_, _, Some(own_ns)) if is_tied => {
                let differences = votes().map(|vote_ns| own_ns.saturating_sub(vote_ns));
                ClockVerdict::Tied {
                    difference_ns: differences
                        .max_by_key(|difference_ns| difference_ns.unsigned_abs())
                        .unwrap_or(0),
                }
            }
            _ => ClockVerdict::Agrees,
        };
        self.nodes.iter().map(verdict).collect()
    }

    /// Returns `true` if the clock of a node differs from that of the majority.
    #[must_use]
    pub fn is_wrong(&self, node: usize) -> bool {
        self.nodes.get(node).is_some_and(|voter| voter.is_wrong)
    }

    /// Returns how many nodes have voted, and how many of them agree with the majority. A node whose
    /// clock is wrong disagrees, even if its last vote was right.
    #[must_use]
    pub fn tally(&self) -> Tally {
        let agrees = |vote_ns: i64| self.majority_ns.is_some_and(|of| self.agree(vote_ns, of));
        let voters = || self.nodes.iter().filter(|voter| voter.counted_ns.is_some());
        let right = voters().filter(|voter| !voter.is_wrong);
        Tally {
            votes: voters().count(),
            agreeing: right
                .filter(|voter| voter.counted_ns.is_some_and(agrees))
                .count(),
        }
    }

    fn agree(&self, first_ns: i64, second_ns: i64) -> bool {
        first_ns.abs_diff(second_ns) <= self.limit_ns.unsigned_abs()
    }

    /// Finds the largest group of clocks that agree within the limit.
    fn count(&mut self, now: Duration) {
        for voter in &mut self.nodes {
            let is_valid = |heard: Duration| now.saturating_sub(heard) <= VOTE_LASTS;
            voter.counted_ns = voter
                .vote_ns
                .filter(|_| voter.heard().is_some_and(is_valid));
        }
        let mut votes: Vec<i64> = self
            .nodes
            .iter()
            .filter_map(|voter| voter.counted_ns)
            .collect();
        votes.sort_unstable();
        let largest = largest_group(&votes, self.limit_ns);
        let is_majority = largest.len() >= 2 && 2 * largest.len() > votes.len();
        let former_ns = self
            .majority_ns
            .filter(|former_ns| votes.iter().any(|vote_ns| self.agree(*vote_ns, *former_ns)))
            .filter(|_| votes.len() >= 2);
        let median_ns = largest.get(largest.len().saturating_sub(1) / 2).copied();
        let is_tied = match (votes.first(), votes.last()) {
            (Some(first_ns), Some(last_ns)) => !self.agree(*first_ns, *last_ns),
            _ => false,
        };
        self.majority_ns = match is_majority {
            true => median_ns,
            false => self.confirmed_group(&votes, largest.len()).or(former_ns),
        };
        let is_near = |vote_ns: &&i64| {
            let distance_ns = self.majority_ns.map(|of_ns| vote_ns.abs_diff(of_ns));
            distance_ns.is_some_and(|distance_ns| distance_ns <= self.lead_ns.unsigned_abs())
        };
        let near = votes.iter().filter(is_near).count();
        self.is_close = near >= 2 && 2 * near > votes.len();
        self.tied_since = match is_tied && self.majority_ns.is_none() {
            true => self.tied_since.or(Some(now)),
            false => None,
        };
    }

    /// Returns the median of a group of `len` sorted votes that agree with each other and with the
    /// clock of the machine. A single vote is no group.
    fn confirmed_group(&self, votes: &[i64], len: usize) -> Option<i64> {
        let machine_ns = self.machine_ns.filter(|_| len >= 2)?;
        let is_group = |group: &&[i64]| {
            let ends = group.first().zip(group.last());
            ends.is_some_and(|(first_ns, last_ns)| self.agree(*first_ns, *last_ns))
        };
        let mut medians = { votes.windows(len).filter(is_group) }
            .filter_map(|group| group.get((len - 1) / 2).copied());
        medians.find(|median_ns| self.agree(*median_ns, machine_ns))
    }

    /// Compares a node with the majority. Returns `true` if its clock has become wrong or right.
    fn judge(&mut self, node: usize, now: Duration) -> bool {
        let Some(voter) = self.nodes.get_mut(node) else {
            return false;
        };
        let was_wrong = voter.is_wrong;
        let with = Comparison {
            majority_ns: self.majority_ns,
            limit_ns: self.limit_ns,
            lead_ns: self.lead_ns,
            is_close: self.is_close,
            machine_ns: self.machine_ns,
        };
        voter.compare(&with, now);
        voter.is_wrong != was_wrong
    }
}

/// Returns the largest group of `sorted` values that differ by at most `limit_ns`.
///
/// Of groups of equal size, the first one counts: a majority overlaps with every other one.
fn largest_group(sorted: &[i64], limit_ns: i64) -> &[i64] {
    let group_from = |first: usize| {
        let group = &sorted[first..];
        let agrees = |value: &i64| value.abs_diff(sorted[first]) <= limit_ns.unsigned_abs();
        &group[..group.partition_point(agrees)]
    };
    let groups = (0..sorted.len()).rev().map(group_from);
    groups.max_by_key(|group| group.len()).unwrap_or_default()
}

/// The number of votes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tally {
    /// Number of nodes that have voted.
    pub votes: usize,
    /// Number of nodes that agree with the majority.
    pub agreeing: usize,
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_secs(5);
    const LEAD: Duration = Duration::from_secs(2);
    const S: i64 = 1_000_000_000;
    const T0: i64 = 1_700_000_000 * S;

    /// A vote, with its present time. Nodes deliver a block every 0.1 s.
    struct Rig {
        vote: ClockVote,
        now: Duration,
    }

    impl Rig {
        fn new(nodes: usize) -> Self {
            Self {
                vote: ClockVote::new(LIMIT, LEAD, nodes),
                now: Duration::from_secs(1000),
            }
        }

        /// The clock of the machine is off by some seconds.
        fn with_machine(nodes: usize, off_s: i64) -> Self {
            let mut rig = Self::new(nodes);
            let time_ns = T0 + rig.now.as_nanos() as i64 + off_s * S;
            rig.vote.set_machine_time(time_ns, rig.now);
            rig
        }

        /// Lets some nodes, whose clocks are off by some seconds, deliver for `seconds`.
        fn run(&mut self, seconds: f64, nodes: &[(usize, i64)]) -> Vec<ClockVerdict> {
            for _ in 0..(10.0 * seconds) as u32 {
                self.now += Duration::from_millis(100);
                for (node, off_s) in nodes {
                    let time_ns = T0 + self.now.as_nanos() as i64 + off_s * S;
                    self.vote.arrived(*node, time_ns, self.now);
                }
            }
            self.vote.look(self.now);
            self.vote.verdicts(self.now)
        }

        fn wait(&mut self, seconds: u64) {
            self.now += Duration::from_secs(seconds);
        }
    }

    // All nodes were wrong against each other until their delays were steady.
    #[test]
    fn nodes_that_were_all_late_when_they_voted_are_right_once_they_are_prompt() {
        let mut rig = Rig::new(3);
        let all = |off_s: i64| [(0, off_s), (1, off_s), (2, off_s)];
        rig.run(10.0, &all(0));
        rig.run(10.0, &all(-20));
        let (prompt, slower) = (all(0), all(-1));
        for _ in 0..5 {
            // No vote: the delay changes every second.
            let verdicts = rig.run(1.0, &prompt);
            assert_eq!(verdicts, [ClockVerdict::Agrees; 3]);
            let verdicts = rig.run(1.0, &slower);
            assert_eq!(verdicts, [ClockVerdict::Agrees; 3]);
        }
    }

    #[test]
    fn clock_that_is_ahead_does_not_keep_the_others_from_becoming_prompt() {
        let mut rig = Rig::new(3);
        rig.run(10.0, &[(0, -20), (1, -20), (2, -20)]);
        let verdicts = rig.run(0.5, &[(2, 3600), (0, 0), (1, 0)]);
        assert_eq!(verdicts, [AGREES, AGREES, wrong(3600)]);
    }

    // The difference is within the limit, but no delay of one link explains it.
    #[test]
    fn clock_that_is_steadily_ahead_within_the_limit_is_wrong_if_most_others_agree_closely() {
        let mut rig = Rig::with_machine(4, 0);
        let of = |off_s: i64| [(2, off_s), (0, 0), (1, 0), (3, 0)];
        let told = rig.run(4.0, &of(3));
        assert_eq!(told, [AGREES; 4], "not steady for long enough");
        let ahead = [AGREES, AGREES, wrong(3), AGREES];
        assert_eq!(rig.run(4.0, &of(3)), ahead);
        let tally = rig.vote.tally();
        assert_eq!((tally.votes, tally.agreeing), (4, 3));
        // A stalled link does not make the clock right.
        rig.run(0.7, &of(1));
        assert!(rig.vote.is_wrong(2));
        assert_eq!(rig.run(1.0, &of(3)), ahead);
        assert_eq!(rig.run(4.0, &of(0)), [AGREES; 4]);
        // Links explain a smaller lead, and a node that is behind.
        assert_eq!(rig.run(10.0, &of(1)), [AGREES; 4]);
        assert_eq!(rig.run(10.0, &of(-3)), [AGREES; 4]);
        // Half of the nodes are no majority, and neither is one of two.
        let halves = [(0, 0), (1, 0), (2, 3), (3, 3)];
        assert_eq!(Rig::with_machine(4, 0).run(10.0, &halves), [AGREES; 4]);
        let pair = [(0, 3), (1, 0)];
        assert_eq!(Rig::with_machine(2, 0).run(10.0, &pair), [AGREES; 2]);
    }

    // Most nodes are behind one slow gateway. The others are prompt.
    #[test]
    fn prompt_nodes_are_right_if_most_others_are_late() {
        let nodes = [(0, 0), (1, 0), (2, -3), (3, -3), (4, -3)];
        let mut rig = Rig::with_machine(5, 0);
        assert_eq!(rig.run(60.0, &nodes), [AGREES; 5]);
        // Nobody knows the time, or the clock of the machine is wrong.
        assert_eq!(Rig::new(5).run(60.0, &nodes), [AGREES; 5]);
        let mut rig = Rig::with_machine(5, -3600);
        assert_eq!(rig.run(60.0, &nodes), [AGREES; 5]);
    }

    #[test]
    fn declared_nodes_that_are_not_there_do_not_hold_the_majority_back() {
        let mut rig = Rig::new(7);
        let three = |off_s: i64| [(0, off_s), (1, off_s), (2, off_s)];
        rig.run(10.0, &three(-20));
        let verdicts = rig.run(0.5, &three(0));
        assert_eq!(verdicts, [ClockVerdict::Agrees; 7]);
    }

    // The three nodes that were there first kept the three correct ones out.
    #[test]
    fn clock_of_the_machine_decides_between_equal_groups() {
        for (machine_s, first, others) in [
            (None, AGREES, wrong(-3600)),
            (Some(0), wrong(3600), AGREES),
            (Some(3600), AGREES, wrong(-3600)),
            (Some(1800), AGREES, wrong(-3600)),
        ] {
            let mut rig = Rig::new(6);
            if let Some(machine_s) = machine_s {
                let time_ns = T0 + rig.now.as_nanos() as i64 + machine_s * S;
                rig.vote.set_machine_time(time_ns, rig.now);
            }
            rig.run(5.0, &[(0, 3600), (1, 3600), (2, 3600)]);
            let all = [(0, 3600), (1, 3600), (2, 3600), (3, 0), (4, 0), (5, 0)];
            let verdicts = rig.run(8.0, &all);
            assert_eq!(verdicts[..3], [first; 3], "{machine_s:?}");
            assert_eq!(verdicts[3..], [others; 3], "{machine_s:?}");
        }
    }

    #[test]
    fn clock_of_the_machine_does_not_decide_against_a_majority_or_between_two_nodes() {
        let mut rig = Rig::new(3);
        rig.vote
            .set_machine_time(T0 + rig.now.as_nanos() as i64 + 3600 * S, rig.now);
        let verdicts = rig.run(8.0, &[(0, 3600), (1, 0), (2, 0)]);
        assert_eq!(verdicts, [wrong(3600), AGREES, AGREES]);
        let mut rig = Rig::new(2);
        rig.vote
            .set_machine_time(T0 + rig.now.as_nanos() as i64 + 3600 * S, rig.now);
        rig.run(8.0, &[(0, 0), (1, 0)]);
        let verdicts = rig.run(8.0, &[(0, 3600), (1, 0)]);
        assert_eq!(verdicts, [wrong(3600), AGREES]);
    }

    #[test]
    fn half_of_the_nodes_cannot_move_the_majority_ahead() {
        let mut rig = Rig::new(4);
        rig.run(10.0, &[(0, 0), (1, 0), (2, 0), (3, 0)]);
        let verdicts = rig.run(0.5, &[(0, 0), (1, 0), (2, 60), (3, 60)]);
        assert_eq!(verdicts[2..], [wrong(60); 2]);
        assert_eq!(verdicts[..2], [ClockVerdict::Agrees; 2]);
    }

    fn wrong(seconds: i64) -> ClockVerdict {
        ClockVerdict::Wrong {
            difference_ns: seconds * S,
        }
    }

    const AGREES: ClockVerdict = ClockVerdict::Agrees;

    #[test]
    fn majority_decides_whoever_was_first() {
        for off_s in [3600, 600, 30, -30, -600, -3600] {
            let mut rig = Rig::new(3);
            assert_eq!(rig.run(10.0, &[(0, off_s)]), [AGREES; 3]);
            let verdicts = rig.run(5.0, &[(0, off_s), (1, 0), (2, 0)]);
            assert_eq!(verdicts, [wrong(off_s), AGREES, AGREES]);
            assert_eq!(
                rig.vote.tally(),
                Tally {
                    votes: 3,
                    agreeing: 2
                }
            );
        }
    }

    #[test]
    fn clock_that_is_right_again_agrees_at_once() {
        let mut rig = Rig::new(3);
        rig.run(5.0, &[(0, 600), (1, 0), (2, 0)]);
        assert_eq!(rig.run(0.1, &[(0, 0), (1, 0), (2, 0)]), [AGREES; 3]);
    }

    #[test]
    fn first_node_after_a_power_cut_does_not_decide_alone() {
        let mut rig = Rig::new(3);
        rig.run(5.0, &[(0, 0), (1, 0), (2, 0)]);
        rig.wait(60);
        assert_eq!(rig.run(0.1, &[(0, 600)]), [wrong(600), AGREES, AGREES]);
        // The votes of nodes that stay away expire.
        rig.wait(301);
        assert_eq!(rig.run(2.0, &[(0, 600)]), [AGREES; 3]);
    }

    #[test]
    fn most_clocks_take_the_time_with_them() {
        let mut rig = Rig::new(3);
        rig.run(5.0, &[(0, 0), (1, 0), (2, 0)]);
        let verdicts = rig.run(5.0, &[(0, 600), (1, 600), (2, 0)]);
        assert_eq!(verdicts, [AGREES, AGREES, wrong(-600)]);
    }

    #[test]
    fn two_nodes_that_disagree_are_both_reported() {
        let mut rig = Rig::new(2);
        let tied = |seconds: i64| ClockVerdict::Tied {
            difference_ns: seconds * S,
        };
        assert_eq!(rig.run(2.0, &[(0, 600), (1, 0)]), [AGREES; 2]);
        let verdicts = rig.run(5.0, &[(0, 600), (1, 0)]);
        assert_eq!(verdicts, [tied(600), tied(-600)]);
        // If they have agreed before, the one that jumps is wrong.
        let mut rig = Rig::new(2);
        rig.run(5.0, &[(0, 0), (1, 0)]);
        let verdicts = rig.run(5.0, &[(0, 600), (1, 0)]);
        assert_eq!(verdicts, [wrong(600), AGREES]);
    }

    // The samples of such a node are late, and it is not alone with its time for long.
    #[test]
    fn node_that_delivers_what_it_has_kept_during_an_outage_is_not_blamed() {
        let mut rig = Rig::new(3);
        let (mut behind_ns, step) = (120 * S, Duration::from_millis(100));
        while behind_ns > 0 {
            rig.now += step;
            for node in 0..3 {
                let late_ns = if node == 0 { behind_ns } else { 0 };
                let time_ns = T0 + rig.now.as_nanos() as i64 - late_ns;
                rig.vote.arrived(node, time_ns, rig.now);
            }
            rig.vote.look(rig.now);
            assert_eq!(
                rig.vote.verdicts(rig.now),
                [AGREES; 3],
                "{behind_ns} ns behind"
            );
            behind_ns -= S / 20;
        }
    }

    #[test]
    fn links_of_different_delay_and_jitter_agree() {
        let mut rig = Rig::new(3);
        for step in 0_u64..200 {
            rig.now += Duration::from_millis(100);
            for node in 0..3 {
                let late_ns = (node as i64 * 2 + ((step * 7 + node * 3) % 10) as i64 / 10) * S;
                let time_ns = T0 + rig.now.as_nanos() as i64 - late_ns;
                rig.vote.arrived(node as usize, time_ns, rig.now);
            }
        }
        rig.vote.look(rig.now);
        assert_eq!(rig.vote.verdicts(rig.now), [AGREES; 3]);
    }
}
