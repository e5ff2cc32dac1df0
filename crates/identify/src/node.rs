//! The core of a sensor node's worker: receives samples of one node and returns a local estimate
//! per fusion period.
//!
//! It knows only its own channels and its own clock. It counts samples on the grid of their rate
//! since 1970, UTC. Fusion periods end at multiples of their length. Nodes that started at
//! different times therefore report for the same times.
//!
//! Replayed samples wait for the station's feedback to each estimate, so that the same record gives
//! the same results. Live samples do not wait.

use crate::error::{IdentifyError, key_name};
use crate::identification::{BRIDGED_GAP_S, band_limit_of};
use crate::node_frames::NodeFrames;
use crate::node_screening::NodeScreening;
use serde::{Deserialize, Serialize};
use spandrel_bus::{
    Event, EventKind, FeedbackMessage, FrameBlock, Header, LocalDensity, LocalMessage, Name,
    NodeLineage, Pace, SampleBlock, StreamState, TimeGrid, ToldMotion,
};
use spandrel_checkpoint::Position;
use spandrel_filter::fusion::{
    CompressedMotion, Feedback, FeedbackRule, Gaussian, LocalFilter, Taken,
};
use spandrel_filter::{BandLimit, Frame};
use spandrel_structure::{Structure, StructureModel};
use std::collections::{BTreeMap, VecDeque};

mod state;

pub use state::NodeIdentificationState;

/// Clock drift (samples) at which a sample moves to the next grid position.
///
/// It exceeds half a sample, so that jitter half-way between two positions causes no repeated
/// changes.
const OFF_ITS_PLACE: f64 = 0.75;

/// Time in seconds by which samples must be earlier than the last sample to show that their clock
/// was set back. Smaller steps drop the samples until the clock has caught up.
const SET_BACK_S: f64 = 2.0;

/// Inputs of the core.
#[derive(Debug, Clone, PartialEq)]
pub enum NodeInput {
    /// Samples of the node.
    Samples(SampleBlock),
    /// Samples from before this run. The filter processes them without reports, because the station
    /// may have received them from an earlier run.
    Past(SampleBlock),
    /// Feedback from the station.
    Feedback(FeedbackMessage),
    /// The station has not replied for a long time, so replayed samples continue without it.
    NoAnswer,
}

/// Outputs of the core.
#[derive(Debug, Clone, PartialEq)]
pub enum NodeOutput {
    /// A local estimate, or the end of the samples.
    Local(LocalMessage),
    /// An event.
    Event(Event),
    /// The samples of this run as frames on the grid of their rate since 1970, before the low-pass
    /// filter. Only if the structure file requests waveforms of the nodes.
    Frames(FrameBlock),
}

/// Identification by one sensor node.
#[derive(Debug)]
pub struct NodeIdentification {
    structure: Name,
    node: Name,
    filter: LocalFilter<StructureModel>,
    band_limit: Option<BandLimit>,
    rate_hz: f64,
    epoch: u64,
    answered: bool,
    stream: Option<Stream>,
    waiting: VecDeque<SampleBlock>,
    observation_channels: Vec<usize>,
    excitation_channels: Vec<Option<usize>>,
    /// Means of the excitation components, for those that no channel measures.
    mean_excitation: Vec<f64>,
    ranges: Vec<f64>,
    /// Scratch space: the measured values of one sample.
    sample: Vec<f64>,
    /// Scratch space: the values of the sample for the filter.
    observations: Vec<f64>,
    excitation: Vec<f64>,
    restarts: u64,
    sent: u64,
    /// Number of time steps with a sample since the last message.
    sampled: u64,
    /// One entry per observed channel. Empty if outliers are not screened.
    screening: Vec<NodeScreening>,
    dropped: BTreeMap<&'static str, u64>,
    responses: bool,
    /// Exponents of the units of published samples, by observation. Empty if no samples are
    /// published.
    told_units: Vec<i16>,
    variances: bool,
    done: u64,
    /// The samples of the present input. `None` if the node publishes no waveforms.
    frames: Option<NodeFrames>,
}

/// Position in the current epoch of samples.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Stream {
    epoch: u64,
    /// Sequence number of the first sample that is not filtered.
    next: u64,
    /// Time of the last sample, ns.
    last_ns: i64,
    /// Number of the last sample on the grid of the sampling rate since 1970.
    number: i64,
    /// Number of the message whose feedback must arrive before replayed samples continue. Valid
    /// within one run only.
    #[serde(skip)]
    awaits: Option<u64>,
}

impl NodeIdentification {
    /// Creates the worker of the node at `position` in the file. `epoch` must be higher at each
    /// start.
    ///
    /// # Errors
    /// Returns an error if identification is not distributed, there is no such node, or the filter
    /// rejects its settings.
    pub fn new(structure: &Structure, position: usize, epoch: u64) -> Result<Self, IdentifyError> {
        let refused = |source| IdentifyError::Filter {
            structure: structure.name().to_owned(),
            source,
        };
        let named = |name: &str| key_name(structure.name(), name);
        let no_node = || IdentifyError::NotDistributed {
            structure: structure.name().to_owned(),
        };
        let filter = structure
            .local_filter(position)
            .ok_or_else(no_node)?
            .map_err(refused)?;
        let plan = structure.fusion().ok_or_else(no_node)?;
        let node = structure.nodes().get(position).ok_or_else(no_node)?;
        let own = structure.of_node(node.name()).ok_or_else(no_node)?;
        let channels = own.channel_count();
        let band_limit = band_limit_of(&own).map_err(refused)?;
        let screened = |channel: &usize| {
            NodeScreening::new(structure.name(), node.channels()[*channel].name())
        };
        let screening = match own.screens_outliers() {
            true => own
                .observation_channels()
                .iter()
                .map(screened)
                .collect::<Result<_, _>>()?,
            false => Vec::new(),
        };
        Ok(Self {
            structure: named(structure.name())?,
            node: named(node.name())?,
            band_limit,
            rate_hz: own.sampling_rate_hz(),
            epoch,
            answered: plan.feedback() != FeedbackRule::None,
            stream: None,
            waiting: VecDeque::new(),
            observation_channels: own.observation_channels().to_vec(),
            excitation_channels: own.excitation_channels().to_vec(),
            mean_excitation: own.mean_excitation().as_slice().to_vec(),
            ranges: node
                .channels()
                .iter()
                .map(|channel| channel.range())
                .collect(),
            sample: vec![f64::NAN; channels],
            observations: vec![f64::NAN; own.observation_channels().len()],
            excitation: vec![0.0; own.excitation_channels().len()],
            restarts: 0,
            sent: 0,
            sampled: 0,
            screening,
            dropped: BTreeMap::new(),
            responses: plan.passes_motion_on(),
            told_units: structure.told_units(position),
            variances: plan.sends_variances(),
            done: 0,
            frames: plan
                .publishes_waveforms()
                .then(|| NodeFrames::new(node.name(), own.sampling_rate_hz(), channels))
                .flatten(),
            filter,
        })
    }

    /// Processes one input and appends the outputs.
    pub fn handle(&mut self, input: NodeInput, outputs: &mut Vec<NodeOutput>) {
        match input {
            NodeInput::Samples(block) => self.waiting.push_back(block),
            NodeInput::Past(block) => self.catch_up(block, outputs),
            NodeInput::Feedback(feedback) => self.take_feedback(&feedback),
            NodeInput::NoAnswer => self.stop_waiting(),
        }
        while self.awaits().is_none()
            && let Some(block) = self.next_block()
        {
            self.take_block(block, outputs);
        }
        outputs.extend(self.take_frames().into_iter().map(NodeOutput::Frames));
    }

    fn take_frames(&mut self) -> Vec<FrameBlock> {
        self.frames
            .as_mut()
            .map(NodeFrames::take)
            .unwrap_or_default()
    }

    /// Returns the next block to filter. `None` if there is none, or if its time has jumped and the
    /// block after it, which can confirm the jump, has not arrived.
    ///
    /// Drops blocks whose jump the block after them contradicts.
    fn next_block(&mut self) -> Option<SampleBlock> {
        loop {
            let block = self.waiting.pop_front()?;
            if block.state == StreamState::Ended || !self.has_jumped(&block) {
                return Some(block);
            }
            let Some(next) = self.waiting.front() else {
                self.waiting.push_front(block);
                return None;
            };
            let continues_without = next.header.epoch == block.header.epoch
                && !next.samples.is_empty()
                && !self.has_jumped(next);
            if !continues_without {
                return Some(block);
            }
            *self.dropped.entry("samples-of-a-wrong-time").or_default() +=
                spandrel_bus::Block::count(&block);
        }
    }

    /// Returns `true` if a block follows after a gap of more than [`BRIDGED_GAP_S`], or is earlier
    /// than the last sample by more than [`SET_BACK_S`].
    fn has_jumped(&self, block: &SampleBlock) -> bool {
        self.stream.is_some_and(|stream| {
            let is_of_epoch = stream.epoch == block.header.epoch && !block.samples.is_empty();
            let gap_s = seconds_since(stream.last_ns, block.header.time_ns) - 1.0 / self.rate_hz;
            is_of_epoch && (gap_s > BRIDGED_GAP_S || stream.is_set_back(block))
        })
    }

    /// Filters samples from before this run without reports to the station.
    fn catch_up(&mut self, block: SampleBlock, outputs: &mut Vec<NodeOutput>) {
        let mut found = Vec::new();
        self.waiting.push_back(block);
        while let Some(block) = self.next_block() {
            self.take_block(block, &mut found);
            self.stop_waiting();
        }
        drop(self.take_frames()); // the earlier run has published their waveforms
        outputs.extend(
            found
                .into_iter()
                .filter(|output| matches!(output, NodeOutput::Event(_))),
        );
    }

    /// Returns the epoch of the messages, which is higher in each run.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Returns the position of the first sample that is not filtered. `None` before the first.
    #[must_use]
    pub fn position(&self) -> Option<Position> {
        self.stream.map(|stream| Position {
            epoch: stream.epoch,
            sequence: stream.next,
        })
    }

    /// Returns the sequence number of the message whose feedback must arrive before replayed
    /// samples continue. `None` if no feedback is awaited.
    #[must_use]
    pub fn awaits(&self) -> Option<u64> {
        self.stream.and_then(|stream| stream.awaits)
    }

    /// Returns the number of filtered samples, including missing ones in between.
    #[must_use]
    pub fn done(&self) -> u64 {
        self.done
    }

    /// Returns the time (ns) of the last filtered sample, or `None` before the first one.
    #[must_use]
    pub fn last_ns(&self) -> Option<i64> {
        self.stream.map(|stream| stream.last_ns)
    }

    /// Returns how often the filter has restarted.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        self.filter.restarts()
    }

    /// Returns the number of dropped items, by reason.
    #[must_use]
    pub fn dropped(&self) -> &BTreeMap<&'static str, u64> {
        &self.dropped
    }

    /// Returns the filter.
    #[must_use]
    pub fn filter(&self) -> &LocalFilter<StructureModel> {
        &self.filter
    }

    fn take_block(&mut self, mut block: SampleBlock, outputs: &mut Vec<NodeOutput>) {
        let channels = usize::from(block.channels);
        if block.grid().is_none() || channels != self.sample.len() {
            *self.dropped.entry("samples-of-another-node").or_default() += 1;
            return;
        }
        if !self.find_place(&mut block, outputs) {
            // The end of the samples still counts.
            block.samples.clear();
        }
        let Some(grid) = block.grid() else { return };
        let count = (block.samples.len() / channels.max(1)) as u64;
        for number in 0..count {
            let start = number as usize * channels;
            self.take_sample(&block.samples[start..start + channels]);
            if let Some(stream) = &mut self.stream {
                stream.last_ns = grid.time_ns(number);
                stream.number += 1;
                stream.next = block.header.sequence + number + 1;
            }
            self.tell_restart(outputs);
            self.tell_outliers(grid.time_ns(number), outputs);
            if self.filter.is_due() && self.report(block.pace, outputs) && number + 1 < count {
                // The rest of the block waits for the feedback.
                spandrel_bus::Block::skip(&mut block, number + 1);
                self.waiting.push_front(block);
                return;
            }
        }
        if block.state == StreamState::Ended {
            let last = self.message(None, block.pace, StreamState::Ended);
            outputs.push(NodeOutput::Local(last));
        }
    }

    /// Advances to the first sample of a block: bridges missing samples and drops duplicates.
    fn find_place(&mut self, block: &mut SampleBlock, outputs: &mut Vec<NodeOutput>) -> bool {
        let time_ns = block.header.time_ns;
        let Some(stream) = self
            .stream
            .filter(|stream| stream.epoch == block.header.epoch)
        else {
            self.begin_stream(block, "its source of samples started a new epoch", outputs);
            return true;
        };
        if block.samples.is_empty() {
            return true;
        }
        if stream.is_set_back(block) {
            self.begin_stream(block, "the clock of its samples was set back", outputs);
            return true;
        }
        let steps = (seconds_since(stream.last_ns, time_ns) * self.rate_hz).round();
        if steps < 1.0 {
            *self.dropped.entry("samples-out-of-order").or_default() += 1;
            return false;
        }
        let mut missing = steps as u64 - 1;
        // Offset of the sample clock from the grid, in samples.
        let off = time_ns as f64 * 1e-9 * self.rate_hz - (stream.number as f64 + steps);
        if off > OFF_ITS_PLACE {
            missing += 1;
        } else if off < -OFF_ITS_PLACE && missing > 0 {
            missing -= 1;
        } else if off < -OFF_ITS_PLACE {
            // Its position is taken, and the next sample is the closest to the following position.
            *self.dropped.entry("samples-out-of-step").or_default() += 1;
            spandrel_bus::Block::skip(block, 1);
        }
        if missing == 0 {
            return true;
        }
        *self.dropped.entry("missing-samples").or_default() += missing;
        if missing as f64 > BRIDGED_GAP_S * self.rate_hz {
            self.skip(missing);
            let why = "gap too long to bridge: parameters kept, motion reset";
            outputs.push(self.event(
                time_ns,
                EventKind::Gap,
                &format!("{missing} samples are permanently lost"),
                why,
            ));
            return true;
        }
        let nothing = vec![f64::NAN; self.sample.len()];
        for number in 1..=missing {
            self.take_sample(&nothing);
            if let Some(running) = &mut self.stream {
                let since_ns = number as f64 * 1e9 / self.rate_hz;
                running.last_ns = stream.last_ns.saturating_add(since_ns.round() as i64);
                running.number += 1;
            }
            if self.filter.is_due() {
                self.report(Pace::Live, outputs); // no feedback is awaited within a gap
            }
        }
        true
    }

    /// Finds the position of an epoch's first sample within its fusion period.
    ///
    /// If the source has restarted, the time in between is skipped. `why` states the cause.
    fn begin_stream(&mut self, block: &SampleBlock, why: &str, outputs: &mut Vec<NodeOutput>) {
        let (time_ns, period) = (block.header.time_ns, self.filter.steps_per_period());
        let nearest = TimeGrid::new(0, self.rate_hz).map_or(0, |grid| grid.nearest(time_ns));
        match self.stream {
            None => self
                .filter
                .begin_at(nearest.rem_euclid(period as i64).unsigned_abs()),
            Some(stream) => {
                let ahead = nearest.saturating_sub(stream.number.saturating_add(1));
                // A repeated measurement, or a clock that was set back, keeps its position in the
                // period.
                self.skip(
                    u64::try_from(ahead)
                        .unwrap_or_else(|_| ahead.rem_euclid(period as i64).unsigned_abs()),
                );
                outputs.push(self.event(
                    time_ns,
                    EventKind::Restart,
                    "motion reset, parameters kept",
                    why,
                ));
            }
        }
        let last_ns = time_ns.saturating_sub((1e9 / self.rate_hz) as i64);
        let number = nearest.saturating_sub(1);
        let (epoch, next) = (block.header.epoch, block.header.sequence);
        self.stream = Some(Stream {
            epoch,
            next,
            last_ns,
            number,
            awaits: None,
        });
    }

    /// Skips samples after a gap that is too long to bridge, and advances the position.
    fn skip(&mut self, samples: u64) {
        self.filter.skip(samples);
        if let Some(stream) = &mut self.stream {
            stream.number = stream.number.saturating_add_unsigned(samples);
        }
        self.reset_band_limit();
    }

    fn take_sample(&mut self, sample: &[f64]) {
        for ((value, sample), range) in self.sample.iter_mut().zip(sample).zip(&self.ranges) {
            *value = if sample.abs() <= *range {
                *sample
            } else {
                f64::NAN
            };
            if !(sample.is_nan() || sample.abs() <= *range) {
                *self.dropped.entry("absurd-samples").or_default() += 1;
            }
        }
        if let Some((frames, stream)) = self.frames.as_mut().zip(self.stream) {
            frames.push(stream.epoch, stream.number.saturating_add(1), &self.sample);
        }
        if let Some(band_limit) = &mut self.band_limit {
            band_limit.apply(&mut self.sample);
        }
        for (value, channel) in self.observations.iter_mut().zip(&self.observation_channels) {
            *value = self.sample[*channel];
        }
        let known = self.excitation_channels.iter().zip(&self.mean_excitation);
        for (value, (channel, mean)) in self.excitation.iter_mut().zip(known) {
            *value = channel.map_or(*mean, |channel| self.sample[channel]);
        }
        self.done += 1;
        self.sampled += u64::from(self.sample.iter().any(|value| !value.is_nan()));
        // The sizes match the model, and a filter that diverges has already restarted.
        let _ = self.filter.step(Frame {
            observations: &self.observations,
            excitation: &self.excitation,
        });
    }

    /// Sends the local estimate. Returns `true` if replayed samples must wait for its feedback.
    fn report(&mut self, pace: Pace, outputs: &mut Vec<NodeOutput>) -> bool {
        let estimate = self.filter.report();
        self.tell_restart(outputs);
        self.sent = estimate.index;
        let density = LocalDensity {
            mean: estimate.parameters.mean.as_slice().to_vec(),
            covariance: match self.variances {
                true => estimate.parameters.variances(),
                false => estimate.parameters.triangle(),
            },
            lineage: estimate.lineage.map(|lineage| NodeLineage {
                own: lineage.own,
                answers: lineage.answers,
            }),
            motion: estimate.motion.map(|motion| {
                ToldMotion::new(
                    motion.mean.as_slice(),
                    motion.variance.as_slice(),
                    &self.told_units,
                )
            }),
        };
        let message = self.message(Some(density), pace, StreamState::Running);
        outputs.push(NodeOutput::Local(message));
        let waits = pace == Pace::Replayed && self.answered;
        if let Some(stream) = self.stream.as_mut().filter(|_| waits) {
            stream.awaits = Some(estimate.index);
        }
        waits
    }

    fn message(
        &mut self,
        density: Option<LocalDensity>,
        pace: Pace,
        state: StreamState,
    ) -> LocalMessage {
        let screens = self.filter.screens();
        let screening = self
            .screening
            .iter_mut()
            .zip(screens)
            .map(|(channel, screen)| channel.report(screen));
        LocalMessage {
            header: Header {
                source: self.node.to_string(),
                epoch: self.epoch,
                sequence: self.sent,
                time_ns: self.stream.map_or(0, |stream| stream.last_ns),
            },
            pace,
            density,
            restarts: self.filter.restarts(),
            samples: std::mem::take(&mut self.sampled),
            screening: screening.collect(),
            state,
        }
    }

    fn take_feedback(&mut self, message: &FeedbackMessage) {
        let reason = match self.filter_takes(message) {
            Some(Taken::Applied) => None,
            Some(Taken::Stale) => Some("stale-feedback"),
            Some(Taken::Refused) | None => Some("useless-feedback"),
        };
        if let Some(reason) = reason {
            *self.dropped.entry(reason).or_default() += 1;
        }
        if self
            .awaits()
            .is_some_and(|index| message.node_epoch == self.epoch && message.answers >= index)
        {
            self.stop_waiting();
        }
    }

    fn filter_takes(&mut self, message: &FeedbackMessage) -> Option<Taken> {
        if message.node_epoch != self.epoch {
            return Some(Taken::Stale);
        }
        let feedback = Feedback {
            answers: message.answers,
            parameters: Gaussian::from_triangle(&message.mean, &message.covariance)?,
            nodes: usize::from(message.nodes),
            motion: message
                .motion
                .clone()
                .map(|numbers| compressed((numbers.mean, numbers.variance))),
            responses: match self.responses {
                true => message
                    .responses
                    .iter()
                    .map(|told| told.clone().map(|told| compressed(told.into_numbers())))
                    .collect(),
                false => Vec::new(),
            },
        };
        (feedback.parameters.mean.len() == self.filter.filter().parameters().mean.len())
            .then(|| self.filter.take(&feedback))
    }

    fn stop_waiting(&mut self) {
        if let Some(stream) = &mut self.stream {
            stream.awaits = None;
        }
    }

    fn reset_band_limit(&mut self) {
        if let Some(band_limit) = &mut self.band_limit {
            band_limit.reset();
        }
    }

    fn tell_restart(&mut self, outputs: &mut Vec<NodeOutput>) {
        if self.filter.restarts() > self.restarts {
            self.restarts = self.filter.restarts();
            let time_ns = self.stream.map_or(0, |stream| stream.last_ns);
            let why = "it diverged or left the range of plausible values";
            outputs.push(self.event(
                time_ns,
                EventKind::Restart,
                "filter of the node restarted",
                why,
            ));
        }
    }

    /// Reports a changed screening of a channel after the last sample.
    fn tell_outliers(&mut self, time_ns: i64, outputs: &mut Vec<NodeOutput>) {
        for (channel, screen) in self.screening.iter_mut().zip(self.filter.screens()) {
            let Some((kind, what, why)) = channel.take(time_ns, screen) else {
                continue;
            };
            outputs.push(NodeOutput::Event(Event {
                structure: self.structure.clone(),
                time_ns,
                kind,
                subject: channel.channel().to_string(),
                what: what.to_owned(),
                why,
            }));
        }
    }

    fn event(&self, time_ns: i64, kind: EventKind, what: &str, why: &str) -> NodeOutput {
        NodeOutput::Event(Event {
            structure: self.structure.clone(),
            time_ns,
            kind,
            subject: self.node.to_string(),
            what: what.to_owned(),
            why: why.to_owned(),
        })
    }
}

impl Stream {
    /// Returns `true` if new samples are earlier than the last sample by more than [`SET_BACK_S`].
    fn is_set_back(&self, block: &SampleBlock) -> bool {
        block.header.sequence >= self.next
            && seconds_since(self.last_ns, block.header.time_ns) < -SET_BACK_S
    }
}

fn seconds_since(before_ns: i64, time_ns: i64) -> f64 {
    time_ns.saturating_sub(before_ns) as f64 * 1e-9
}

fn compressed((mean, variance): (Vec<f64>, Vec<f64>)) -> CompressedMotion {
    CompressedMotion {
        mean: mean.into(),
        variance: variance.into(),
    }
}

#[cfg(test)]
mod tests;
