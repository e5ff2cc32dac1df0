//! Turns arrival times into inputs of the alignment: deadlines, and wrong clocks.

use std::time::Duration;

use spandrel_bus::{Block, Pace, SampleBlock};

use crate::align::AlignmentInput;
use crate::clock_moves::{ClockMove, ClockMoves};
use crate::clock_vote::{ClockVerdict, ClockVote};
use crate::clock_watch::{ClockReport, ClockWatch};
use crate::lateness::Lateness;

/// Clocks and links of nodes may differ by this much more than frames wait for late samples.
const BEYOND_LATENESS: Duration = Duration::from_secs(3);
/// A node may steadily be ahead of most nodes by this much more than frames wait.
const LEAD_BEYOND_LATENESS: Duration = Duration::from_millis(500);

/// Lateness and clocks of the nodes of a structure with live samples. The passage of time is an
/// argument.
#[derive(Debug)]
pub(crate) struct Timekeeping {
    lateness: Lateness,
    vote: ClockVote,
    watch: ClockWatch,
    moves: ClockMoves,
    limit: Duration,
    lead: Duration,
    /// Which nodes the alignment distrusts.
    distrusted: Vec<bool>,
}

impl Timekeeping {
    /// Creates the state of `nodes` nodes for frames that wait for late samples for `allowed`.
    pub(crate) fn new(allowed: Duration, nodes: usize) -> Self {
        let limit = allowed.saturating_add(BEYOND_LATENESS);
        let lead = allowed.saturating_add(LEAD_BEYOND_LATENESS);
        Self {
            lateness: Lateness::new(allowed, nodes),
            vote: ClockVote::new(limit, lead, nodes),
            watch: ClockWatch::new(nodes),
            moves: ClockMoves::new(nodes, limit),
            limit,
            lead,
            distrusted: vec![false; nodes],
        }
    }

    /// Records the arrival of a block, and returns the inputs that precede its samples.
    pub(crate) fn arrived(
        &mut self,
        node: usize,
        block: &SampleBlock,
        now: Duration,
    ) -> Vec<AlignmentInput> {
        // Frames of a replay wait without limit, and its times can lie in the future of the live
        // samples that follow it.
        if block.pace == Pace::Replayed {
            return self.trust_all();
        }
        let (Some(grid), Some(last)) = (block.grid(), block.count().checked_sub(1)) else {
            return Vec::new();
        };
        let time_ns = grid.time_ns(last);
        let inputs = match self.vote.arrived(node, time_ns, now) {
            true => self.changes(),
            false => Vec::new(),
        };
        if !self.vote.is_wrong(node) {
            self.lateness.arrived(node, time_ns, now);
            self.moves.arrived(node, time_ns, now);
        }
        inputs
    }

    /// Returns the deadline of frames, if it is known.
    pub(crate) fn deadline(&mut self, now: Duration) -> Option<AlignmentInput> {
        let time_ns = self.lateness.deadline_ns(now)?;
        Some(AlignmentInput::Deadline { time_ns })
    }

    /// Counts the votes again as time passes.
    pub(crate) fn count_votes(&mut self, now: Duration) -> Vec<AlignmentInput> {
        match self.vote.look(now) {
            true => self.changes(),
            false => Vec::new(),
        }
    }

    /// Sets the time (ns) that the clock of the machine shows at `now`.
    pub(crate) fn set_machine_time(&mut self, time_ns: i64, now: Duration) {
        self.vote.set_machine_time(time_ns, now);
    }

    /// Returns a report on each node whose clock has become wrong or right since the last call.
    pub(crate) fn reports(&mut self, now: Duration) -> Vec<ClockReport> {
        self.watch.read(&self.vote.verdicts(now), self.vote.tally())
    }

    /// Returns the clocks that have moved since the last call without becoming wrong.
    pub(crate) fn moves(&mut self, now: Duration) -> Vec<ClockMove> {
        self.moves.read(now)
    }

    /// Returns the difference between the clock of each node and that of most nodes, s. `None` for
    /// a node whose clock agrees.
    pub(crate) fn differences_s(&self, now: Duration) -> impl Iterator<Item = Option<f64>> {
        self.vote
            .verdicts(now)
            .into_iter()
            .map(|verdict| match verdict {
                ClockVerdict::Wrong { difference_ns } => Some(difference_ns as f64 / 1e9),
                ClockVerdict::Agrees | ClockVerdict::Tied { .. } => None,
            })
    }

    /// Forgets the arrivals of the former run, which can lie in the future of the new one.
    pub(crate) fn begin_run(&mut self) {
        self.lateness.reset();
    }

    fn changes(&mut self) -> Vec<AlignmentInput> {
        let mut inputs = Vec::new();
        for (node, distrusted) in self.distrusted.iter_mut().enumerate() {
            let is_wrong = self.vote.is_wrong(node);
            if std::mem::replace(distrusted, is_wrong) == is_wrong {
                continue;
            }
            self.moves.forget(node);
            if is_wrong {
                self.lateness.forget(node);
            }
            inputs.push(match is_wrong {
                true => AlignmentInput::ClockWrong { node },
                false => AlignmentInput::ClockRight { node },
            });
        }
        inputs
    }

    fn trust_all(&mut self) -> Vec<AlignmentInput> {
        if !self.distrusted.contains(&true) {
            return Vec::new();
        }
        self.vote = ClockVote::new(self.limit, self.lead, self.distrusted.len());
        self.changes()
    }
}
