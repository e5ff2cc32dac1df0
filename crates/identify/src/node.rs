//! The core of a sensor node's worker: samples of one node in, a local estimate once in a fusion period out.
//!
//! It knows its own channels and its own clock only. Samples that are replayed wait for the station's answer to each
//! estimate, so that the same record gives the same numbers; samples as they are measured wait for nothing.

use crate::error::IdentifyError;
use spandrel_bus::{
    Event, EventKind, FeedbackMessage, Header, LocalDensity, LocalMessage, MotionNumbers, Name, NodeLineage, Pace,
    SampleBlock, StreamState,
};
use spandrel_filter::fusion::{CompressedMotion, Feedback, FeedbackRule, Gaussian, LocalFilter, Taken};
use spandrel_filter::{BandLimit, Frame};
use spandrel_structure::{Structure, StructureModel};
use std::collections::{BTreeMap, VecDeque};

/// A gap up to this long (s) is bridged by predictions; over a longer one the motion is forgotten and the parameters stay.
const BRIDGED_GAP_S: f64 = 10.0;

/// What the core reacts to.
#[derive(Debug, Clone, PartialEq)]
pub enum NodeInput {
    /// Samples of the node.
    Samples(SampleBlock),
    /// An answer of the station.
    Feedback(FeedbackMessage),
    /// The station has not answered for long: replayed samples go on without it.
    NoAnswer,
}

/// What the core has to say.
#[derive(Debug, Clone, PartialEq)]
pub enum NodeOutput {
    /// A local estimate, or the end of the samples.
    Local(LocalMessage),
    /// Something rare.
    Event(Event),
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
    ranges: Vec<f64>,
    /// scratch: a sample as it came, then as the filter sees it
    sample: Vec<f64>,
    observations: Vec<f64>,
    excitation: Vec<f64>,
    restarts: u64,
    sent: u64,
    dropped: BTreeMap<&'static str, u64>,
    responses: bool,
}

/// Where the samples of the running epoch stand.
#[derive(Debug, Clone, Copy)]
struct Stream {
    epoch: u64,
    /// time of the last sample, ns
    last_ns: i64,
    /// the message that has to be answered before replayed samples go on
    awaits: Option<u64>,
}

impl NodeIdentification {
    /// Makes the worker of the node at `position` in the file; `epoch` is higher at each start.
    ///
    /// # Errors
    /// When identification is not distributed, there is no such node, or the filter refuses its settings.
    pub fn new(structure: &Structure, position: usize, epoch: u64) -> Result<Self, IdentifyError> {
        let refused = |source| IdentifyError::Filter { structure: structure.name().to_owned(), source };
        let named = |name: &str| {
            Name::new(name).map_err(|source| IdentifyError::Name { structure: structure.name().to_owned(), source })
        };
        let no_node = || IdentifyError::NotDistributed { structure: structure.name().to_owned() };
        let filter = structure.local_filter(position).ok_or_else(no_node)?.map_err(refused)?;
        let plan = structure.fusion().ok_or_else(no_node)?;
        let node = structure.nodes().get(position).ok_or_else(no_node)?;
        let own = structure.of_node(node.name()).ok_or_else(no_node)?;
        let channels = own.channel_count();
        let band_limit = own
            .band_limit()
            .map(|limit| BandLimit::low_pass(limit.order, limit.frequency_hz, own.sampling_rate_hz(), channels))
            .transpose()
            .map_err(refused)?;
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
            ranges: node.channels().iter().map(|channel| channel.range()).collect(),
            sample: vec![f64::NAN; channels],
            observations: vec![f64::NAN; own.observation_channels().len()],
            excitation: vec![0.0; own.excitation_channels().len()],
            restarts: 0,
            sent: 0,
            dropped: BTreeMap::new(),
            responses: plan.passes_motion_on(),
            filter,
        })
    }

    /// Takes one input and appends what follows from it.
    pub fn handle(&mut self, input: NodeInput, outputs: &mut Vec<NodeOutput>) {
        match input {
            NodeInput::Samples(block) => self.waiting.push_back(block),
            NodeInput::Feedback(feedback) => self.take_feedback(&feedback),
            NodeInput::NoAnswer => self.stop_waiting(),
        }
        while self.awaits().is_none() {
            let Some(block) = self.waiting.pop_front() else { return };
            self.take_block(block, outputs);
        }
    }

    /// Returns the message whose answer replayed samples wait for.
    #[must_use]
    pub fn awaits(&self) -> Option<u64> {
        self.stream.and_then(|stream| stream.awaits)
    }

    /// Returns the number of samples filtered.
    #[must_use]
    pub fn done(&self) -> u64 {
        self.filter.steps()
    }

    /// Returns the time (ns) of the last sample filtered.
    #[must_use]
    pub fn last_ns(&self) -> Option<i64> {
        self.stream.map(|stream| stream.last_ns)
    }

    /// Returns how often the filter has started anew.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        self.filter.restarts()
    }

    /// Returns what was dropped, by reason.
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
        let (Some(grid), true) = (block.grid(), channels == self.sample.len()) else {
            *self.dropped.entry("samples-of-another-node").or_default() += 1;
            return;
        };
        if !self.find_place(&block, outputs) {
            return;
        }
        let count = (block.samples.len() / channels.max(1)) as u64;
        for number in 0..count {
            let start = number as usize * channels;
            self.take_sample(&block.samples[start..start + channels]);
            if let Some(stream) = &mut self.stream {
                stream.last_ns = grid.time_ns(number);
            }
            self.tell_restart(outputs);
            if self.filter.is_due() && self.report(block.pace, outputs) && number + 1 < count {
                // the rest waits for the answer
                spandrel_bus::Block::skip(&mut block, number + 1);
                self.waiting.push_front(block);
                return;
            }
        }
        if block.state == StreamState::Ended {
            outputs.push(NodeOutput::Local(self.message(None, block.pace, StreamState::Ended)));
        }
    }

    /// Moves on to the first sample of a block: bridges what is missing, and drops what has been there.
    fn find_place(&mut self, block: &SampleBlock, outputs: &mut Vec<NodeOutput>) -> bool {
        let time_ns = block.header.time_ns;
        let Some(stream) = self.stream.filter(|stream| stream.epoch == block.header.epoch) else {
            if self.stream.is_some() {
                self.filter.skip(0);
                self.reset_band_limit();
                let why = "its source of samples began a new epoch";
                outputs.push(self.event(time_ns, EventKind::Restart, "motion forgotten, parameters kept", why));
            }
            let step_ns = (1e9 / self.rate_hz) as i64;
            let epoch = block.header.epoch;
            self.stream = Some(Stream { epoch, last_ns: time_ns - step_ns, awaits: None });
            return true;
        };
        if block.samples.is_empty() {
            return true;
        }
        let steps = (time_ns.saturating_sub(stream.last_ns) as f64 * 1e-9 * self.rate_hz).round();
        if steps < 1.0 {
            *self.dropped.entry("samples-out-of-order").or_default() += 1;
            return false;
        }
        let missing = steps as u64 - 1;
        if missing == 0 {
            return true;
        }
        *self.dropped.entry("missing-samples").or_default() += missing;
        if missing as f64 > BRIDGED_GAP_S * self.rate_hz {
            self.filter.skip(missing);
            self.reset_band_limit();
            let why = "longer than can be bridged: parameters kept, motion forgotten";
            outputs.push(self.event(time_ns, EventKind::Gap, &format!("{missing} samples are lost for good"), why));
            return true;
        }
        let nothing = vec![f64::NAN; self.sample.len()];
        for _ in 0..missing {
            self.take_sample(&nothing);
            if self.filter.is_due() {
                self.report(Pace::Live, outputs); // nobody waits within a gap
            }
        }
        true
    }

    fn take_sample(&mut self, sample: &[f64]) {
        for ((value, sample), range) in self.sample.iter_mut().zip(sample).zip(&self.ranges) {
            *value = if sample.abs() <= *range { *sample } else { f64::NAN };
            if !(sample.is_nan() || sample.abs() <= *range) {
                *self.dropped.entry("absurd-samples").or_default() += 1;
            }
        }
        if let Some(band_limit) = &mut self.band_limit {
            band_limit.apply(&mut self.sample);
        }
        for (value, channel) in self.observations.iter_mut().zip(&self.observation_channels) {
            *value = self.sample[*channel];
        }
        for (value, channel) in self.excitation.iter_mut().zip(&self.excitation_channels) {
            *value = channel.map_or(0.0, |channel| self.sample[channel]);
        }
        // the sizes are those of the model; a filter that diverges has started anew
        let _ = self.filter.step(Frame { observations: &self.observations, excitation: &self.excitation });
    }

    /// Sends the local estimate; tells whether its answer is waited for.
    fn report(&mut self, pace: Pace, outputs: &mut Vec<NodeOutput>) -> bool {
        let estimate = self.filter.report();
        self.tell_restart(outputs);
        self.sent = estimate.index;
        let density = LocalDensity {
            mean: estimate.parameters.mean.as_slice().to_vec(),
            covariance: estimate.parameters.triangle(),
            lineage: estimate.lineage.map(|lineage| NodeLineage { own: lineage.own, answers: lineage.answers }),
            motion: estimate.motion.map(|motion| MotionNumbers {
                mean: motion.mean.as_slice().to_vec(),
                variance: motion.variance.as_slice().to_vec(),
            }),
        };
        outputs.push(NodeOutput::Local(self.message(Some(density), pace, StreamState::Running)));
        let waits = pace == Pace::Replayed && self.answered;
        if let Some(stream) = self.stream.as_mut().filter(|_| waits) {
            stream.awaits = Some(estimate.index);
        }
        waits
    }

    fn message(&self, density: Option<LocalDensity>, pace: Pace, state: StreamState) -> LocalMessage {
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
        if self.awaits().is_some_and(|index| message.node_epoch == self.epoch && message.answers >= index) {
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
            motion: message.motion.as_ref().map(compressed),
            responses: match self.responses {
                true => message.responses.iter().map(|numbers| numbers.as_ref().map(compressed)).collect(),
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
            let why = "it diverged, or left the range of sound values";
            outputs.push(self.event(time_ns, EventKind::Restart, "filter of the node started anew", why));
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

fn compressed(numbers: &MotionNumbers) -> CompressedMotion {
    CompressedMotion { mean: numbers.mean.clone().into(), variance: numbers.variance.clone().into() }
}

#[cfg(test)]
mod tests;
