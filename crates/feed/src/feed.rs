//! The core of the feed: from packets to blocks, without a clock or network.

use std::collections::BTreeMap;

use spandrel_bus::InstrumentStatus;

use crate::condition_feed::{ConditionFeed, Reading};
use crate::core_input::{FeedInput, Moment, Output};
use crate::gap::LostBecause;
use crate::instrument::Instrument;
use crate::node_feed::{Arrival, NodeFeed, NodeOutput, Series};
use crate::packet::Packet;
use crate::rate_check::RateCheck;
use crate::settings::FeedConfig;
use crate::source_plan::{ChannelPlan, SourcePlan, Stamps};
use crate::timing::Timing;

/// Maximum number of names without a mapping that are remembered per source.
const MAX_UNMAPPED: usize = 64;

/// The feed of all sources of a process.
#[derive(Debug)]
pub struct Feed {
    config: FeedConfig,
    sources: Vec<Source>,
    nodes: Vec<NodeFeed>,
}

/// State of one source.
#[derive(Debug)]
struct Source {
    instrument: Instrument,
    /// State of its channels, in the order of the plan.
    channels: Vec<Channel>,
    /// State of its conditions, in the order of the plan.
    conditions: Vec<ConditionFeed>,
    /// Number of samples by the name of a channel without a mapping.
    unmapped: BTreeMap<String, u64>,
}

/// State of one channel of a source.
#[derive(Debug)]
struct Channel {
    timing: Timing,
    rate: RateCheck,
    seen: ChannelSeen,
}

/// What has arrived on a channel, for commissioning.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ChannelSeen {
    /// Number of samples.
    pub(crate) samples: u64,
    /// Measured sampling rate, Hz.
    pub(crate) measured_hz: Option<f64>,
    /// Shortest and longest time from the measurement of the last sample of a packet to its
    /// arrival, s.
    pub(crate) latency_s: Option<(f64, f64)>,
    /// Least and largest value, SI unit.
    pub(crate) range: Option<(f64, f64)>,
}

impl Feed {
    /// Creates the feed. The nodes start with `epoch`, which must increase at each start.
    #[must_use]
    pub fn new(config: FeedConfig, epoch: u64) -> Self {
        let seconds = |seconds: f64| (seconds * 1e9) as i64;
        let mut nodes = Vec::new();
        for (index, plan) in config.nodes.iter().enumerate() {
            let of_node = |channel: &&ChannelPlan| channel.node == index;
            let fed: BTreeMap<usize, String> = config
                .sources
                .iter()
                .flat_map(|source| source.channels.iter().filter(of_node))
                .map(|channel| (channel.position, channel.channel.clone()))
                .collect();
            let wait_s = config
                .sources
                .iter()
                .filter(|source| source.channels.iter().any(|channel| channel.node == index))
                .map(|source| source.wait_s)
                .fold(0.0, f64::max);
            nodes.push(NodeFeed::new(index, plan, &fed, seconds(wait_s), epoch));
        }
        let sources = config.sources.iter().map(|plan| {
            let channel = |channel: &ChannelPlan| {
                let rate_hz = config
                    .nodes
                    .get(channel.node)
                    .map_or(1.0, |node| node.rate_hz);
                Channel {
                    timing: Timing::new(plan.stamps, rate_hz),
                    rate: match plan.stamps {
                        Stamps::Source { .. } => RateCheck::of_source(rate_hz),
                        Stamps::Arrival { .. } => RateCheck::of_arrival(rate_hz),
                    },
                    seen: ChannelSeen::default(),
                }
            };
            Source {
                instrument: match (plan.channels.is_empty(), plan.silent_after_s()) {
                    (false, _) => Instrument::new(seconds(plan.wait_s)),
                    (true, Some(silent_after_s)) => Instrument::slow(seconds(silent_after_s)),
                    (true, None) => Instrument::slow(i64::MAX),
                },
                channels: plan.channels.iter().map(channel).collect(),
                conditions: vec![ConditionFeed::default(); plan.conditions.len()],
                unmapped: BTreeMap::new(),
            }
        });
        Self {
            sources: sources.collect(),
            nodes,
            config,
        }
    }

    /// Returns the configuration.
    #[must_use]
    pub fn config(&self) -> &FeedConfig {
        &self.config
    }

    /// Processes an input that arrives at `at`, and appends the outputs to `out`.
    pub fn handle(&mut self, input: FeedInput, at: Moment, out: &mut Vec<Output>) {
        match input {
            FeedInput::Packets { source, packets } => {
                for packet in &packets {
                    self.packet(source, packet, at, out);
                }
                self.each_node(out, |node, given| node.release(at, given));
            }
            FeedInput::Malformed { source, fault } => self.error(source, fault, 1, at, out),
            FeedInput::Dropped { source, messages } => {
                let why = "messages dropped, because they arrived faster than they can be read";
                self.error(source, why.to_owned(), messages, at, out);
            }
            FeedInput::Link { source, link } => {
                if let Some(state) = self.sources.get_mut(source)
                    && let Some((why, count)) = state.instrument.link(link, at)
                {
                    out.push(Output::Error { source, why, count });
                }
            }
            FeedInput::Recorded {
                structure,
                recorded,
            } => {
                let nodes = self.nodes.iter_mut().zip(&self.config.nodes);
                for (node, _) in nodes.filter(|(_, plan)| plan.structure == structure) {
                    node.set_recorded(recorded);
                }
            }
            FeedInput::Stored {
                source,
                condition,
                newest_ns,
            } => {
                let conditions = self
                    .sources
                    .get_mut(source)
                    .map(|state| &mut state.conditions);
                if let Some(state) = conditions.and_then(|all| all.get_mut(condition)) {
                    state.set_stored(newest_ns);
                }
            }
            FeedInput::Tick => self.each_node(out, |node, given| node.tick(at, given)),
            FeedInput::Stop => self.each_node(out, NodeFeed::stop),
        }
        self.report_states(at, out);
    }

    /// Returns the status of a source.
    #[must_use]
    pub fn status(&self, source: usize) -> Option<InstrumentStatus> {
        Some(self.sources.get(source)?.instrument.status())
    }

    /// Returns the counts of dropped and lost samples of a structure, by reason.
    #[must_use]
    pub fn drops(&self, structure: usize) -> BTreeMap<String, u64> {
        let mut drops = BTreeMap::new();
        for (node, _) in self.nodes_of(structure) {
            for (reason, count) in node.counts() {
                *drops.entry((*reason).to_owned()).or_default() += count;
            }
        }
        let conditions = self.config.sources.iter().zip(&self.sources);
        let repeated: u64 = conditions
            .flat_map(|(plan, state)| plan.conditions.iter().zip(&state.conditions))
            .filter(|(plan, _)| plan.structure == structure)
            .map(|(_, state)| state.repeated())
            .sum();
        if repeated > 0 {
            drops.insert("repeated-conditions".to_owned(), repeated);
        }
        drops
    }

    /// Returns the time of the newest published sample of a structure, ns, and the number of
    /// published samples.
    #[must_use]
    pub fn published(&self, structure: usize) -> (Option<i64>, u64) {
        self.nodes_of(structure)
            .map(|(node, _)| node.published())
            .fold((None, 0), |(newest, all), (time_ns, samples)| {
                (newest.max(time_ns), all + samples)
            })
    }

    fn nodes_of(
        &self,
        structure: usize,
    ) -> impl Iterator<Item = (&NodeFeed, &crate::source_plan::NodePlan)> {
        self.nodes
            .iter()
            .zip(&self.config.nodes)
            .filter(move |(_, plan)| plan.structure == structure)
    }

    /// Returns what has arrived on the channels of a source, and the names without a mapping.
    pub(crate) fn seen(&self, source: usize) -> Option<(Vec<ChannelSeen>, &BTreeMap<String, u64>)> {
        let state = self.sources.get(source)?;
        let seen = state.channels.iter().map(|channel| ChannelSeen {
            measured_hz: channel.rate.measured_hz(),
            ..channel.seen.clone()
        });
        Some((seen.collect(), &state.unmapped))
    }

    /// Returns the number of values of the conditions of a source, each with its last value.
    pub(crate) fn seen_conditions(&self, source: usize) -> Vec<(u64, Option<f64>)> {
        let state = self.sources.get(source);
        let conditions = state.into_iter().flat_map(|state| &state.conditions);
        conditions.map(ConditionFeed::published).collect()
    }

    fn error(&mut self, source: usize, why: String, count: u64, at: Moment, out: &mut Vec<Output>) {
        if let Some(state) = self.sources.get_mut(source)
            && let Some((why, count)) = state.instrument.error(why, count, at)
        {
            out.push(Output::Error { source, why, count });
        }
    }

    fn report_states(&mut self, at: Moment, out: &mut Vec<Output>) {
        for (source, state) in self.sources.iter_mut().enumerate() {
            if let Some(changed) = state.instrument.changed(at) {
                let is_failed = changed == spandrel_bus::InstrumentState::Failed;
                let why = state.instrument.last_error().filter(|_| is_failed);
                out.push(Output::State {
                    source,
                    state: changed,
                    why: why.map(str::to_owned),
                });
            }
        }
    }

    fn each_node(&mut self, out: &mut Vec<Output>, act: impl Fn(&mut NodeFeed, &mut NodeOutput)) {
        for (index, node) in self.nodes.iter_mut().enumerate() {
            let mut given = NodeOutput::default();
            act(node, &mut given);
            append(index, given, out);
        }
    }

    fn packet(&mut self, source: usize, packet: &Packet, at: Moment, out: &mut Vec<Output>) {
        let Some(plan) = self.config.sources.get(source) else {
            return;
        };
        let mut errors = Vec::new();
        let mut is_mapped = match self.sources.get_mut(source) {
            Some(state) => {
                state.take_conditions(plan, Arriving { source, packet, at }, &mut errors, out)
            }
            None => false,
        };
        for (index, channel) in plan.channels.iter().enumerate() {
            if channel.label != packet.label {
                continue;
            }
            is_mapped = true;
            let (Some(state), Some(node)) = (
                self.sources.get_mut(source),
                self.nodes.get_mut(channel.node),
            ) else {
                continue;
            };
            let Some(seen) = state.channels.get_mut(index) else {
                continue;
            };
            let delivery = Delivery {
                packet,
                plan: channel,
                can_repeat: plan.kind.can_repeat(),
                can_go_back: plan.kind.can_go_back(),
                at,
            };
            let mut given = NodeOutput::default();
            match delivery.deliver(seen, node, &mut given) {
                Ok(samples) => state.instrument.accepted(samples, at),
                Err(why) => errors.push(why),
            }
            errors.append(&mut given.faults);
            append(channel.node, given, out);
        }
        if !is_mapped && let Some(state) = self.sources.get_mut(source) {
            let samples = packet.values.len() as u64;
            if let Some(count) = state.unmapped.get_mut(&packet.label) {
                *count += samples;
            } else if state.unmapped.len() < MAX_UNMAPPED {
                state.unmapped.insert(packet.label.clone(), samples);
            }
        }
        for why in errors {
            self.error(source, why, 1, at, out);
        }
    }
}

/// A packet of one source.
#[derive(Clone, Copy)]
struct Arriving<'a> {
    source: usize,
    packet: &'a Packet,
    at: Moment,
}

impl Source {
    /// Gives a packet to the conditions that it belongs to. Returns `true` if there is one.
    fn take_conditions(
        &mut self,
        plan: &SourcePlan,
        Arriving { source, packet, at }: Arriving<'_>,
        errors: &mut Vec<String>,
        out: &mut Vec<Output>,
    ) -> bool {
        let mut is_mapped = false;
        for (condition, of) in plan.conditions.iter().enumerate() {
            let Some(state) = self.conditions.get_mut(condition) else {
                continue;
            };
            if of.label != packet.label {
                continue;
            }
            is_mapped = true;
            let mut readings = Vec::new();
            let taken = state.take(packet, of, plan.stamps, at, &mut readings);
            errors.extend(taken.err());
            self.instrument.accepted(readings.len() as u64, at);
            let output = |reading: Reading| Output::Condition {
                source,
                condition,
                time_ns: reading.time_ns,
                value: reading.value,
            };
            out.extend(readings.into_iter().map(output));
        }
        is_mapped
    }
}

/// A packet on its way to one channel.
struct Delivery<'a> {
    packet: &'a Packet,
    plan: &'a ChannelPlan,
    can_repeat: bool,
    can_go_back: bool,
    at: Moment,
}

impl Delivery<'_> {
    /// Gives the samples of the packet to its node, and returns their number.
    fn deliver(
        &self,
        channel: &mut Channel,
        node: &mut NodeFeed,
        out: &mut NodeOutput,
    ) -> Result<u64, String> {
        let Self { packet, plan, .. } = self;
        let label = &packet.label;
        let count = packet.values.len();
        let Some(timed) = channel.timing.time(packet, self.at) else {
            return Err(format!(
                "{label}: no time, must state the time of its first sample"
            ));
        };
        let by_source_ns = packet.start_ns.filter(|_| channel.timing.is_of_source());
        let observed_ns = by_source_ns.unwrap_or(self.at.wall_ns);
        channel.rate.add(observed_ns, count as u64);
        if let Some(found_hz) = channel.rate.wrong_hz(packet.rate_hz) {
            return Err(format!(
                "{label}: sampling rate is {found_hz:.4} Hz, must be {} Hz, the rate of its node \
                 in the structure file",
                channel.rate.nominal_hz()
            ));
        }
        let last_ns = node.time_after(timed.start_ns, count.saturating_sub(1));
        let tolerance_ns = channel.timing.tolerance_ns();
        let kept = packet.values.get(timed.skip..).unwrap_or_default();
        let values: Option<Vec<f64>> = kept
            .iter()
            .map(|number| plan.calibration.si_from_number(*number, timed.start_ns))
            .collect();
        let Some(mut values) = values else {
            return Err(format!(
                "{label}: the StationXML file has no sensitivity for the time of these samples"
            ));
        };
        let mut has_infinite = false;
        for value in values.iter_mut().filter(|value| value.is_infinite()) {
            *value = f64::NAN;
            has_infinite = true;
        }
        if has_infinite {
            out.faults.push(format!(
                "{label}: a sample is infinite, must be a finite number; it counts as missing"
            ));
        }
        channel
            .seen
            .add(&values, self.at.wall_ns.saturating_sub(last_ns));
        let arrival = Arrival {
            at: self.at,
            tolerance_ns,
            can_repeat: self.can_repeat,
            can_go_back: self.can_go_back,
            is_resynchronised: timed.resynchronised > 0,
        };
        if timed.skip > 0 {
            let because = LostBecause::Resynchronised;
            let (start_ns, skip) = (timed.start_ns, timed.skip as u64);
            node.lose(plan.position, skip, start_ns, start_ns, because, out);
        }
        if values.is_empty() {
            return Ok(0);
        }
        let series = Series {
            start_ns: timed.start_ns,
            values,
        };
        node.state_clock_quality(plan.position, packet.clock_quality);
        node.take(plan.position, series, arrival, out);
        Ok(count as u64)
    }
}

impl ChannelSeen {
    fn add(&mut self, values: &[f64], latency_ns: i64) {
        self.samples += values.len() as u64;
        let latency_s = latency_ns as f64 / 1e9;
        let (least, most) = self.latency_s.unwrap_or((latency_s, latency_s));
        self.latency_s = Some((least.min(latency_s), most.max(latency_s)));
        for value in values.iter().filter(|value| value.is_finite()) {
            let (least, most) = self.range.unwrap_or((*value, *value));
            self.range = Some((least.min(*value), most.max(*value)));
        }
    }
}

/// Appends the outputs of a node.
fn append(node: usize, given: NodeOutput, out: &mut Vec<Output>) {
    // The end of the old epoch comes before its first new block, and both carry their epoch.
    if let Some(step) = given.set_back {
        out.push(Output::SetBack {
            node,
            from_ns: step.from_ns,
            to_ns: step.to_ns,
        });
    }
    out.extend(
        given
            .blocks
            .into_iter()
            .map(|block| Output::Block { node, block }),
    );
    out.extend(given.lost.into_iter().map(Output::Lost));
}

#[cfg(test)]
mod tests;
