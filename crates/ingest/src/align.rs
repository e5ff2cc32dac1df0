//! Builds frames from the samples of many nodes, without a clock or network.
//!
//! Frame k is at t0 + round(k·10⁹/rate) ns, where t0 is the earliest first sample of the nodes. A
//! sample goes to the nearest frame within the tolerance. If it is taken at another instant than
//! its frame, the value at the frame is interpolated from the neighbouring samples of the node. If
//! two samples of a node fall into one frame, the first one counts.
//!
//! A frame closes when its deadline has passed, or when no node can still contribute. A node cannot
//! contribute if it has delivered the frame with the neighbours that the interpolation needs, or a
//! later sample, has ended, or is lost. As long as no
//! deadline passes, frames do not depend on the order in which blocks of different nodes arrive.
//! Nor do they depend on how the samples are cut into blocks.

use spandrel_bus::{
    Block, FrameBlock, Header, NodeClock, Pace, SampleBlock, StreamState, TimeGrid,
};
use spandrel_checkpoint::Position;

use crate::counts::{Counts, NodeCounts};
use crate::layout::Layout;
use crate::node_queue::{NodeQueue, Presence};
use crate::sampling_instants::WINDOW;

/// Maximum number of frames in a block.
const BLOCK_FRAMES: usize = 512;

/// Longest gap that is filled with empty frames, in frames. After a longer gap in the samples of
/// all nodes, a new run starts.
const LONGEST_HOLE: i64 = 100_000;

/// Longest time, ns, by which live samples may lag behind the frames without having gone back in
/// time.
const LONGEST_LAG_NS: i64 = 2_000_000_000;

/// Longest gap, ns, that is filled with empty frames although the node that frames wait for may
/// still deliver. After a longer gap, frames wait as long again for it. If at most half of the
/// nodes continue after the gap, a new run starts.
const LONGEST_LONE_HOLE_NS: i64 = 10_000_000_000;

/// Span of samples from the past, ns, after which a node begins a new run if the other nodes
/// deliver nothing.
const GONE_BACK_NS: i64 = 500_000_000;

/// Number of deadlines for which the other nodes must deliver nothing. The shell sets one every
/// 50 ms. A source that catches up delivers minutes of samples between two of them.
const DEADLINES_OF_SILENCE: u64 = 20;

/// An input of the alignment; `node` is an index into the layout.
#[derive(Clone, Debug)]
pub enum AlignmentInput {
    /// The next samples of a node, in order.
    Samples {
        /// Index of the node.
        node: usize,
        /// Its samples.
        block: SampleBlock,
    },
    /// A node has disappeared without ending its stream. Frames stop waiting for it until its next
    /// samples arrive.
    Lost {
        /// Index of the node.
        node: usize,
    },
    /// A lost node is expected again, because only its link was down.
    Back {
        /// Index of the node.
        node: usize,
    },
    /// The clock of a node differs from that of the majority. Its samples are dropped, and frames
    /// do not wait for it.
    ClockWrong {
        /// Index of the node.
        node: usize,
    },
    /// The clock of such a node agrees with the majority again.
    ClockRight {
        /// Index of the node.
        node: usize,
    },
    /// The recording contains frames of this epoch. Later frames need a higher one.
    Recorded {
        /// The epoch.
        epoch: u64,
    },
    /// The deadline of all frames up to this time has passed. These frames stop waiting for missing
    /// nodes.
    Deadline {
        /// Measurement time, ns since the Unix epoch.
        time_ns: i64,
    },
}

/// The position of alignment in the stream of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodePlace {
    /// Epoch of the stream; 0 before the first sample.
    pub epoch: u64,
    /// Sequence number of the first sample that is not yet part of a frame.
    pub sequence: u64,
    /// Whether the node has ended its stream.
    pub ended: bool,
}

impl NodePlace {
    /// Returns the sequence number from which the source must be read again after a restart.
    ///
    /// The first samples are already part of frames. They determine the sampling instants of the
    /// node, so the next frames do not depend on the restart.
    #[must_use]
    pub fn read_from(&self) -> u64 {
        self.sequence.saturating_sub(WINDOW)
    }
}

/// Builds the frames of one structure from the samples of its nodes.
///
/// [`Alignment::handle`] takes the inputs and appends complete blocks of frames. A frame closes
/// when no node can still contribute to it, or when a deadline has passed. Without deadlines, the
/// frames do not depend on the order in which blocks of different nodes arrive.
///
/// A closed frame has a missing value for each sample that has not arrived. Late samples are
/// dropped and counted. The alignment has no clock: the caller passes the deadlines.
#[derive(Debug)]
pub struct Alignment {
    layout: Layout,
    queues: Vec<NodeQueue>,
    source: String,
    epoch: u64,
    run: Option<Run>,
    deadline_ns: i64,
    /// Number of deadlines so far.
    deadlines: u64,
    ended: bool,
    /// Number of blocks that did not belong to closed frames.
    in_time: u64,
    counts: Counts,
}

/// The frames on one time grid that starts at t0.
#[derive(Debug)]
struct Run {
    grid: TimeGrid,
    next: u64,
    open: Vec<f64>,
}

impl Alignment {
    /// Creates an alignment whose frames carry the id `source`. Frames of the first run carry
    /// `epoch`.
    #[must_use]
    pub fn new(layout: Layout, source: String, epoch: u64) -> Self {
        let queues = layout
            .nodes()
            .iter()
            .map(|node| NodeQueue::new(node.ranges.clone(), layout.tolerance_ns()))
            .collect();
        Self {
            layout,
            queues,
            source,
            epoch,
            run: None,
            deadline_ns: i64::MIN,
            deadlines: 0,
            ended: false,
            in_time: 0,
            counts: Counts::default(),
        }
    }

    /// Resumes from a recorded state.
    ///
    /// `last` is the last block of closed frames. `nodes` has one entry per node in layout order:
    /// the first sample that is not part of these frames.
    #[must_use]
    pub fn going_on(mut self, last: &FrameBlock, nodes: &[NodePlace]) -> Self {
        let grid = TimeGrid::new(last.t0_ns, last.sampling_rate_hz);
        self.epoch = last.header.epoch;
        self.run = grid.map(|grid| Run {
            grid,
            next: last.end(),
            open: Vec::new(),
        });
        self.ended = last.state == StreamState::Ended;
        for (queue, place) in self.queues.iter_mut().zip(nodes) {
            let presence = if place.ended {
                Presence::Ended
            } else {
                Presence::Expected
            };
            let position = Position {
                epoch: place.epoch,
                sequence: place.sequence,
            };
            queue.go_on(position, presence);
        }
        self
    }

    /// Begins a new run after a recorded state, in the epoch of [`Alignment::new`].
    ///
    /// Frames after the recorded ones may have been published, so that their numbers must not be
    /// used again. The arguments are those of [`Alignment::going_on`]. Recorded samples do not
    /// become part of a second frame.
    #[must_use]
    pub fn beginning_after(self, last: &FrameBlock, nodes: &[NodePlace]) -> Self {
        let epoch = self.epoch;
        Self {
            epoch,
            run: None,
            ..self.going_on(last, nodes)
        }
    }

    /// Returns the position of each node: the first of its samples that is not yet part of a frame.
    #[must_use]
    pub fn places(&self) -> Vec<NodePlace> {
        let place = |queue: &NodeQueue| {
            let Position { epoch, sequence } = queue.position();
            // A node that has ended while samples still wait will deliver these samples again, and
            // its end with them.
            let ended = queue.presence == Presence::Ended && queue.first_ns().is_none();
            NodePlace {
                epoch,
                sequence,
                ended,
            }
        };
        self.queues.iter().map(place).collect()
    }

    /// Returns the counters of frames and of samples that did not become part of a frame.
    #[must_use]
    pub fn counts(&self) -> Counts {
        let mut counts = self.counts;
        for queue in &self.queues {
            counts.nodes += queue.counts;
        }
        counts
    }

    /// Returns the counters of each node, in layout order.
    pub fn node_counts(&self) -> impl Iterator<Item = NodeCounts> {
        self.queues.iter().map(|queue| queue.counts)
    }

    /// Returns when each node samples, in layout order. `None` for a node that samples at the times
    /// of the frames.
    pub fn node_clocks(&self) -> impl Iterator<Item = Option<NodeClock>> {
        self.queues.iter().map(NodeQueue::clock)
    }

    /// Returns the epoch of the frames. It rises with each run.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Processes an input, and appends the frames that it closes to `blocks`, in order.
    pub fn handle(&mut self, input: AlignmentInput, blocks: &mut Vec<FrameBlock>) {
        let given = blocks.len();
        match input {
            AlignmentInput::Samples { node, block } => self.take(node, block, blocks),
            AlignmentInput::Lost { node } => {
                if let Some(queue) = self
                    .queues
                    .get_mut(node)
                    .filter(|queue| queue.presence == Presence::Expected)
                {
                    queue.presence = Presence::Lost;
                }
            }
            AlignmentInput::Back { node } => {
                if let Some(queue) = self
                    .queues
                    .get_mut(node)
                    .filter(|queue| queue.presence == Presence::Lost)
                {
                    queue.presence = Presence::Expected;
                }
            }
            AlignmentInput::ClockWrong { node } => {
                if let Some(queue) = self.queues.get_mut(node) {
                    queue.distrust();
                    // It may have been the time of this node.
                    self.deadline_ns = i64::MIN;
                    self.leave_the_time_of_a_wrong_clock(blocks);
                }
            }
            AlignmentInput::ClockRight { node } => {
                if let Some(queue) = self
                    .queues
                    .get_mut(node)
                    .filter(|queue| queue.presence == Presence::Distrusted)
                {
                    queue.presence = Presence::Expected;
                }
            }
            AlignmentInput::Recorded { epoch } if epoch > self.epoch => {
                self.flush(StreamState::Ended, blocks);
                self.next_run();
                self.epoch = epoch + 1;
            }
            AlignmentInput::Recorded { .. } => {}
            AlignmentInput::Deadline { time_ns } => {
                self.deadlines += 1;
                // It goes back if clocks were ahead, which must not close the frames of the future.
                self.deadline_ns = time_ns;
            }
        }
        self.close_frames(blocks);
        self.end_if_over(given, blocks);
    }

    fn take(&mut self, node: usize, block: SampleBlock, blocks: &mut Vec<FrameBlock>) {
        let known = self
            .layout
            .nodes()
            .get(node)
            .is_some_and(|n| n.name.as_str() == block.header.source);
        if !known {
            self.counts.unknown_node += 1;
            return;
        }
        if usize::from(block.channels) != self.queues[node].channels() {
            self.queues[node].counts.wrong_channels += 1;
            return;
        }
        if self.queues[node].presence == Presence::Distrusted {
            self.queues[node].drop_block(&block);
            return;
        }
        let is_known = block.count() > 0 && self.queues[node].known(&block) == block.count();
        if is_known && (self.ended || block.state == StreamState::Running) {
            self.queues[node].remember(&block);
            return;
        }
        if self.ended {
            // All nodes had ended, so new samples start a new run.
            self.next_run();
            self.ended = false;
            for queue in self
                .queues
                .iter_mut()
                .filter(|queue| queue.presence == Presence::Ended)
            {
                queue.presence = Presence::Expected;
            }
        }
        if self.is_behind(node, &block) {
            self.park(node, block, blocks);
            return;
        }
        self.in_time += 1;
        self.queues[node].drop_parked();
        self.push(node, &block);
    }

    /// Parks a block of a node that has gone back in time. Starts a new run if no node delivers
    /// samples of the present run any longer.
    fn park(&mut self, node: usize, block: SampleBlock, blocks: &mut Vec<FrameBlock>) {
        let queue = &mut self.queues[node];
        if !queue.is_parked() {
            queue.in_time_when_parked = self.in_time;
            queue.deadlines_when_parked = self.deadlines;
        }
        // A live node that has fallen silent must not hold back the others.
        let is_live = block.pace == Pace::Live;
        if is_live && queue.in_time_when_parked != self.in_time {
            // Other nodes deliver samples of the present run, so only this node has gone back.
            queue.drop_old_parked(&block);
        }
        queue.park(block);
        let others_are_silent = is_live
            && queue.in_time_when_parked == self.in_time
            && queue.parked_ns() >= GONE_BACK_NS
            && self.deadlines - queue.deadlines_when_parked >= DEADLINES_OF_SILENCE;
        let expected = |queue: &&NodeQueue| queue.presence == Presence::Expected;
        let mut expected = self.queues.iter().filter(expected);
        if others_are_silent || expected.all(NodeQueue::is_parked) {
            self.go_back(blocks);
        }
    }

    fn push(&mut self, node: usize, block: &SampleBlock) {
        self.queues[node].epoch = Some(block.header.epoch);
        self.queues[node].push(block);
    }

    fn next_run(&mut self) {
        if self.run.take().is_some() {
            self.epoch += 1;
        }
        // The deadline of the former run may lie in the future of the new one.
        self.deadline_ns = i64::MIN;
        // Waiting samples belong to the new run. Earlier samples do not show how far a node has
        // come in it.
        for queue in &mut self.queues {
            queue.newest_ns = queue.last_waiting_ns();
        }
    }

    /// Returns `true` if a block belongs to closed frames for another reason than being late.
    ///
    /// This happens when a source restarts and replays its record, when live samples follow a
    /// simulation, or when clocks are set back. A restarted live node continues on the same time
    /// scale, and may permanently lag a little behind the other nodes.
    fn is_behind(&self, node: usize, block: &SampleBlock) -> bool {
        let Some(run) = &self.run else {
            return false;
        };
        let queue = &self.queues[node];
        let next = run.next as i64;
        match block.pace {
            Pace::Replayed => {
                let number = run.grid.nearest(block.header.time_ns);
                let restarted = queue.epoch.is_some_and(|epoch| block.header.epoch > epoch);
                let is_far = number.saturating_add(LONGEST_HOLE) < next;
                number < next && (restarted || is_far || queue.is_parked())
            }
            Pace::Live => {
                // The end of a block may still be in time.
                let last = block.count().saturating_sub(1);
                let last_ns = block.grid().map_or(i64::MAX, |grid| grid.time_ns(last));
                let is_far = last_ns.saturating_add(LONGEST_LAG_NS) < run.grid.time_ns(run.next);
                run.grid.nearest(last_ns) < next && (is_far || queue.is_parked())
            }
        }
    }

    /// Starts a new run, because all nodes have gone back in time. Otherwise, all their samples
    /// would be late forever.
    fn go_back(&mut self, blocks: &mut Vec<FrameBlock>) {
        self.flush(StreamState::Ended, blocks);
        self.next_run();
        for node in 0..self.queues.len() {
            for block in self.queues[node].unpark() {
                self.push(node, &block);
            }
        }
    }

    /// Ends the present run if it is on the time of nodes that are no longer trusted.
    ///
    /// If their clocks are ahead, the blocks of the other nodes are parked. If they are behind, the
    /// other nodes have not come near the next frame in this run.
    fn leave_the_time_of_a_wrong_clock(&mut self, blocks: &mut Vec<FrameBlock>) {
        let Some(run) = &self.run else {
            return;
        };
        let next_ns = run.grid.time_ns(run.next);
        let trusted = || {
            let queues = self.queues.iter();
            queues.filter(|queue| queue.presence != Presence::Distrusted)
        };
        let is_ahead = trusted().all(|queue| queue.first_ns().is_none())
            && trusted().any(NodeQueue::is_parked);
        let is_near =
            |newest_ns: i64| newest_ns.abs_diff(next_ns) <= LONGEST_LONE_HOLE_NS.unsigned_abs();
        let is_behind = !trusted().filter_map(|queue| queue.newest_ns).any(is_near);
        if is_ahead || is_behind {
            self.go_back(blocks);
        }
    }

    /// Returns the time of the earliest waiting sample, or `None` while the first frame is
    /// undetermined. t0 must not depend on the order of arrival.
    fn first_sample_ns(&self) -> Option<i64> {
        let earliest = self.queues.iter().filter_map(NodeQueue::first_ns).min()?;
        let unheard =
            |queue: &NodeQueue| queue.first_ns().is_none() && queue.presence == Presence::Expected;
        let may_start = earliest <= self.deadline_ns || !self.queues.iter().any(unheard);
        may_start.then_some(earliest)
    }

    fn close_frames(&mut self, blocks: &mut Vec<FrameBlock>) {
        loop {
            if self.run.is_none() {
                let grid = self
                    .first_sample_ns()
                    .and_then(|t0| TimeGrid::new(t0, self.layout.sampling_rate_hz()));
                self.run = grid.map(|grid| Run {
                    grid,
                    next: 0,
                    open: Vec::new(),
                });
            }
            match self.next_frame() {
                NextFrame::Wait => break,
                NextFrame::Close => self.close_frame(blocks),
                NextFrame::NewRun => {
                    self.flush(StreamState::Ended, blocks);
                    self.next_run();
                }
            }
        }
        self.flush(StreamState::Running, blocks);
    }

    /// Decides whether the next frame can close, and drops samples that belong to no open frame.
    fn next_frame(&mut self) -> NextFrame {
        let Some(run) = &self.run else {
            return NextFrame::Wait;
        };
        let next = run.next as i64;
        let mut earliest: Option<i64> = None;
        let (mut waits, mut expected, mut delivering) = (false, 0_usize, 0_usize);
        for queue in &mut self.queues {
            let number = first_usable(queue, run, self.layout.tolerance_ns());
            let passed = match number {
                Some(number) if number == next => {
                    !queue.awaits_neighbours(run.grid.time_ns(run.next))
                }
                Some(_) => true,
                None => has_passed(queue, run),
            };
            waits |= !passed && queue.presence == Presence::Expected;
            expected += usize::from(queue.presence == Presence::Expected);
            delivering += usize::from(number.is_some());
            earliest = earliest.into_iter().chain(number).min();
        }
        let Some(earliest) = earliest else {
            // Frames consist of samples. Without samples, no frame can close.
            return NextFrame::Wait;
        };
        if waits && run.grid.time_ns(run.next) > self.deadline_ns {
            return NextFrame::Wait;
        }
        // Before a long gap is skipped, the vote must have time to find out whose clock has jumped.
        let earliest_ns = run.grid.time_ns(earliest.max(next).unsigned_abs());
        let hole_ns = earliest_ns.saturating_sub(run.grid.time_ns(run.next));
        let is_doubtful = waits && hole_ns > LONGEST_LONE_HOLE_NS;
        if is_doubtful && earliest_ns.saturating_add(LONGEST_LONE_HOLE_NS) > self.deadline_ns {
            return NextFrame::Wait;
        }
        let is_lone = is_doubtful && 2 * delivering <= expected;
        if is_lone || earliest - next > LONGEST_HOLE {
            NextFrame::NewRun
        } else {
            NextFrame::Close
        }
    }

    fn close_frame(&mut self, blocks: &mut Vec<FrameBlock>) {
        let Some(run) = &mut self.run else {
            return;
        };
        let start = run.open.len();
        run.open
            .resize(start + self.layout.channel_count(), f64::NAN);
        let mut first = start;
        for queue in &mut self.queues {
            let frame = &mut run.open[first..first + queue.channels()];
            first += queue.channels();
            match queue.first_ns() {
                Some(time_ns) if run.grid.nearest(time_ns) == run.next as i64 => {
                    queue.pop_into(frame, run.grid.time_ns(run.next))
                }
                // The order of arrival determines whether the end of a node is known, but not which
                // frames the node has passed.
                _ => {
                    let was_there = has_passed(queue, run) || queue.presence == Presence::Expected;
                    self.counts.missing += u64::from(was_there);
                }
            }
        }
        run.next += 1;
        self.counts.frames += 1;
        if run.open.len() >= BLOCK_FRAMES * self.layout.channel_count() {
            self.flush(StreamState::Running, blocks);
        }
    }

    /// Moves the closed frames into a block. An `Ended` state produces a block even without frames.
    fn flush(&mut self, state: StreamState, blocks: &mut Vec<FrameBlock>) {
        let Some(run) = &mut self.run else {
            return;
        };
        if run.open.is_empty() && state == StreamState::Running {
            return;
        }
        let values = std::mem::take(&mut run.open);
        let sequence = run.next - (values.len() / self.layout.channel_count()) as u64;
        blocks.push(FrameBlock {
            header: Header {
                source: self.source.clone(),
                epoch: self.epoch,
                sequence,
                time_ns: run.grid.time_ns(sequence),
            },
            t0_ns: run.grid.start_ns(),
            sampling_rate_hz: self.layout.sampling_rate_hz(),
            // `Layout` has checked that the count is at most `MAX_CHANNELS`.
            channels: self.layout.channel_count() as u16,
            values,
            state,
        });
    }

    fn end_if_over(&mut self, given: usize, blocks: &mut Vec<FrameBlock>) {
        let over =
            |queue: &NodeQueue| queue.first_ns().is_none() && queue.presence != Presence::Expected;
        let has_ended = self
            .queues
            .iter()
            .any(|queue| queue.presence == Presence::Ended);
        if self.ended || self.run.is_none() || !has_ended || !self.queues.iter().all(over) {
            return;
        }
        self.ended = true;
        // The end of the stream travels with the last frames if this input closed any.
        match blocks[given..]
            .last_mut()
            .filter(|block| block.header.epoch == self.epoch)
        {
            Some(last) => last.state = StreamState::Ended,
            None => self.flush(StreamState::Ended, blocks),
        }
    }
}

enum NextFrame {
    /// A node may still deliver a sample of the frame.
    Wait,
    /// The frame is complete, or its deadline has passed.
    Close,
    /// The next sample of any node is more than `LONGEST_HOLE` frames away.
    NewRun,
}

/// Returns `true` if the node has delivered a sample later than the next frame, whether usable or
/// not.
fn has_passed(queue: &NodeQueue, run: &Run) -> bool {
    queue
        .newest_ns
        .is_some_and(|newest| run.grid.nearest(newest) > run.next as i64)
}

/// Returns the frame number of the first usable sample. Drops and counts the samples before it.
fn first_usable(queue: &mut NodeQueue, run: &Run, tolerance_ns: i64) -> Option<i64> {
    while let Some(time_ns) = queue.first_ns() {
        let number = run.grid.nearest(time_ns);
        let Some(frame) = u64::try_from(number)
            .ok()
            .filter(|frame| *frame >= run.next)
        else {
            let just_closed = number.saturating_add(1) == run.next as i64;
            let count = if just_closed {
                &mut queue.counts.duplicate
            } else {
                &mut queue.counts.late
            };
            *count += 1;
            queue.pop();
            continue;
        };
        if run.grid.time_ns(frame).abs_diff(time_ns) as i64 <= tolerance_ns {
            return Some(number);
        }
        queue.counts.off_grid += 1;
        queue.pop();
    }
    None
}

#[cfg(test)]
mod clock_tests;
#[cfg(test)]
mod tests;
