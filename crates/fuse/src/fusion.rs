//! The core: messages of nodes in, fused estimates and answers out.
//!
//! Nodes that measure live are fused at the ticks of the station's own clock, with what has arrived. Nodes that replay a record
//! are fused when all of them have sent their estimate of a period, however fast, so that the same record gives the same
//! numbers.

use crate::error::FuseError;
use spandrel_bus::{
    Estimate, EstimateBlock, EstimateFlags, Event, EventKind, FeedbackMessage, Header, LocalMessage, MotionNumbers,
    Name, NodeDisplay, NodeHealth, Pace, ParameterDisplay, Phase, StreamState,
};
use spandrel_filter::fusion::{CompressedMotion, Fused, Gaussian, Lineage, LocalEstimate, Station};
use spandrel_structure::Structure;
use std::collections::BTreeMap;

/// A node that has been left out in this share of its fusions, and a node that comes back from it, are worth an event.
const OFTEN: f64 = 0.5;

/// Where the first message of live nodes lies within its fusion period. In the middle: nodes that began together send together,
/// and jitter of the network must not decide which fusion hears them.
const FIRST_MESSAGE_AT: f64 = 0.5;

/// Fusions over which that share is taken.
const SHARE_MEMORY: f64 = 20.0;

/// What the core reacts to.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// A message of the node at this place in the file, of so many bytes, at a time of the station's clock (ns).
    Local {
        /// Place in the structure file.
        node: usize,
        /// The message.
        message: LocalMessage,
        /// Bytes of its payload.
        bytes: u64,
        /// When it came, ns since the Unix epoch by the station's clock.
        arrived_ns: i64,
    },
    /// The nodes that are there, by place; replayed ones that are not are no longer waited for.
    Present(Vec<bool>),
    /// The station's clock, ns since the Unix epoch.
    Tick(i64),
}

/// What the core has to say.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// Fused estimates, one a fusion.
    Estimates(EstimateBlock),
    /// A parameter for people.
    Parameter(ParameterDisplay),
    /// An answer to the node at this place.
    Feedback(usize, FeedbackMessage),
    /// How a node does.
    Node(NodeDisplay),
    /// Something rare.
    Event(Event),
}

/// A node in the eyes of the station.
#[derive(Debug, Clone)]
struct Node {
    name: Name,
    epoch: u64,
    present: bool,
    heard_ever: bool,
    ended: bool,
    pace: Pace,
    /// index and time of its last message
    last: Option<(u64, i64)>,
    excluded_since_ns: Option<i64>,
    excluded_share: f64,
    often_excluded: bool,
    messages: u64,
    bytes_received: u64,
    bytes_sent: u64,
    refused: BTreeMap<&'static str, u64>,
    restarts: u64,
}

/// Fusion of one structure.
#[derive(Debug)]
pub struct Fusion {
    structure: Name,
    source: String,
    epoch: u64,
    station: Station,
    nodes: Vec<Node>,
    parameters: Vec<(Name, (f64, f64))>,
    rate_hz: f64,
    distance_limit: Option<f64>,
    /// time of fusion 0, ns
    t0_ns: Option<i64>,
    /// station's clock at the start of the period of the first message, and at the next fusion of live nodes
    begun_ns: Option<i64>,
    due_ns: Option<i64>,
    done: u64,
    /// earliest period of replaying nodes that is not yet fused; `None` after the last that can be counted
    next_index: Option<u64>,
    last_ns: Option<i64>,
    ended: bool,
    /// nodes were used in the last fusion
    healthy: bool,
}

impl Fusion {
    /// Makes the station of a structure; `epoch` is higher at each start.
    ///
    /// # Errors
    /// When identification is not distributed, or the station refuses its settings.
    pub fn new(structure: &Structure, source: impl Into<String>, epoch: u64) -> Result<Self, FuseError> {
        let name = || structure.name().to_owned();
        let plan = structure.fusion().ok_or_else(|| FuseError::NotDistributed { structure: name() })?;
        let station = structure.station().ok_or_else(|| FuseError::NotDistributed { structure: name() })?;
        let named = |text: &str| Name::new(text).map_err(|source| FuseError::Name { structure: name(), source });
        let node = |node: &spandrel_structure::Node| {
            Ok(Node {
                name: named(node.name())?,
                epoch: 0,
                present: false,
                heard_ever: false,
                ended: false,
                pace: Pace::Live,
                last: None,
                excluded_since_ns: None,
                excluded_share: 0.0,
                often_excluded: false,
                messages: 0,
                bytes_received: 0,
                bytes_sent: 0,
                refused: BTreeMap::new(),
                restarts: 0,
            })
        };
        let parameter = |(index, parameter): (usize, &spandrel_structure::Parameter)| {
            Ok((named(parameter.name())?, structure.displayed_loss(index)))
        };
        Ok(Self {
            structure: named(structure.name())?,
            source: source.into(),
            epoch,
            station: station.map_err(|source| FuseError::Station { structure: name(), source })?,
            nodes: structure.nodes().iter().map(node).collect::<Result<_, FuseError>>()?,
            parameters: structure.parameters().iter().enumerate().map(parameter).collect::<Result<_, FuseError>>()?,
            rate_hz: plan.rate_hz(),
            distance_limit: plan.detector().map(|detector| detector.limit(structure.parameters().len())),
            t0_ns: None,
            begun_ns: None,
            due_ns: None,
            done: 0,
            next_index: Some(1),
            last_ns: None,
            ended: false,
            healthy: true,
        })
    }

    /// Takes one input and appends what follows from it.
    pub fn handle(&mut self, input: Input, outputs: &mut Vec<Output>) {
        match input {
            Input::Local { node, message, bytes, arrived_ns } => self.take(node, message, bytes, arrived_ns),
            Input::Present(present) => {
                for (node, present) in self.nodes.iter_mut().zip(present) {
                    node.present = present;
                }
            }
            Input::Tick(now_ns) => {
                self.follow_clock(now_ns);
                if self.is_live() && self.due_ns.is_some_and(|due_ns| now_ns >= due_ns) {
                    let periods = self.periods(now_ns);
                    self.fuse(periods, now_ns, outputs);
                    // a station that was held up goes on with the next period of its clock
                    let next_s = (periods.floor() + 1.0) / self.rate_hz;
                    self.due_ns = self.begun_ns.map(|begun_ns| begun_ns + (next_s * 1e9) as i64);
                }
            }
        }
        while let Some(index) = self.complete_index() {
            self.next_index = index.checked_add(1);
            let times = self.nodes.iter().filter_map(|node| node.last.filter(|(at, _)| *at >= index));
            let time_ns = times.map(|(_, time_ns)| time_ns).max().unwrap_or(0);
            self.fuse(index as f64, time_ns, outputs);
        }
        if !self.ended && self.nodes.iter().any(|node| node.ended) && self.nodes.iter().all(Node::is_over) {
            self.end(outputs);
        }
    }

    /// Returns the number of fusions.
    #[must_use]
    pub fn done(&self) -> u64 {
        self.done
    }

    /// Returns the time (ns) up to which everything is done: of the last fusion, or of the last sample once all nodes ended.
    #[must_use]
    pub fn done_ns(&self) -> Option<i64> {
        if !self.ended {
            return self.last_ns;
        }
        self.nodes.iter().filter_map(|node| node.last.map(|(_, time_ns)| time_ns)).max().max(self.last_ns)
    }

    /// Returns the names of the parameters, in the order of the estimates.
    pub fn parameter_names(&self) -> impl Iterator<Item = &Name> {
        self.parameters.iter().map(|(name, _)| name)
    }

    /// Returns the names of the nodes, in the order of the file.
    pub fn node_names(&self) -> impl Iterator<Item = &Name> {
        self.nodes.iter().map(|node| &node.name)
    }

    /// Adds to the bytes sent to a node.
    pub fn count_sent(&mut self, node: usize, bytes: u64) {
        if let Some(node) = self.nodes.get_mut(node) {
            node.bytes_sent += bytes;
        }
    }

    /// Returns what was refused, by reason, of all nodes.
    #[must_use]
    pub fn refused(&self) -> BTreeMap<String, u64> {
        let mut sum: BTreeMap<String, u64> = BTreeMap::new();
        for (reason, count) in self.nodes.iter().flat_map(|node| &node.refused) {
            *sum.entry(format!("refused-{reason}")).or_default() += count;
        }
        sum
    }

    /// Time on the station's clock, in fusion periods since its first message.
    fn periods(&self, now_ns: i64) -> f64 {
        self.begun_ns.map_or(0.0, |begun| now_ns.saturating_sub(begun).max(0) as f64 * 1e-9 * self.rate_hz)
    }

    /// Goes on from where it was when the clock has been set back by more than a period.
    fn follow_clock(&mut self, now_ns: i64) {
        let Some((begun_ns, due_ns)) = self.begun_ns.as_mut().zip(self.due_ns.as_mut()) else { return };
        let ahead_ns = due_ns.saturating_sub(now_ns);
        if ahead_ns as f64 * 1e-9 * self.rate_hz > 1.0 {
            *begun_ns = begun_ns.saturating_sub(ahead_ns);
            *due_ns = now_ns;
        }
    }

    /// Whether fusions follow the station's clock: a single node that measures does not wait for those that replay, so that no
    /// message of one node can hold up the others.
    fn is_live(&self) -> bool {
        let heard = |pace| self.nodes.iter().filter(move |node| node.heard_ever && node.pace == pace);
        heard(Pace::Live).any(|node| !node.is_over()) || heard(Pace::Replayed).next().is_none()
    }

    /// Returns the period that all replaying nodes that are there have reached, if it is a new one.
    ///
    /// It is the earliest that any of them has sent: a station that comes late begins where they are, and a jump of their counts
    /// is one fusion.
    fn complete_index(&self) -> Option<u64> {
        if self.is_live() {
            return None;
        }
        let next = self.next_index?;
        let reached = |node: &Node| node.last.map(|(index, _)| index).filter(|index| *index >= next);
        let waited_for = |node: &&Node| !node.ended && (node.present || !node.heard_ever);
        let all_are_there = self.nodes.iter().filter(waited_for).all(|node| reached(node).is_some());
        self.nodes.iter().filter_map(reached).min().filter(|_| all_are_there)
    }

    fn take(&mut self, position: usize, message: LocalMessage, bytes: u64, arrived_ns: i64) {
        let Some(node) = self.nodes.get_mut(position) else { return };
        node.bytes_received += bytes;
        if node.heard_ever && message.header.epoch < node.epoch {
            *node.refused.entry("stale-epoch").or_default() += 1;
            return;
        }
        if message.header.epoch > node.epoch {
            if node.heard_ever {
                self.station.forget(position);
            }
            (node.epoch, node.last, node.ended) = (message.header.epoch, None, false);
            self.ended = false;
        }
        let begun_ns = *self.begun_ns.get_or_insert_with(|| {
            let phase_ns = (FIRST_MESSAGE_AT / self.rate_hz * 1e9) as i64;
            arrived_ns.saturating_sub(phase_ns)
        });
        let index = message.header.sequence;
        if let Some(density) = message.density {
            let lineage = density.lineage.map(|lineage| Lineage { own: lineage.own, answers: lineage.answers });
            // checked when it was decoded; a hand-made message may still be none
            let Some(parameters) = Gaussian::from_triangle(&density.mean, &density.covariance) else {
                *node.refused.entry("dimension").or_default() += 1;
                return;
            };
            let motion = density
                .motion
                .map(|numbers| CompressedMotion { mean: numbers.mean.into(), variance: numbers.variance.into() });
            let at = match message.pace {
                Pace::Replayed => index as f64,
                Pace::Live => arrived_ns.saturating_sub(begun_ns).max(0) as f64 * 1e-9 * self.rate_hz,
            };
            if let Err(refusal) =
                self.station.receive(position, LocalEstimate { index, parameters, lineage, motion }, at)
            {
                *node.refused.entry(refusal.as_str()).or_default() += 1;
                return;
            }
            node.messages += 1;
            node.last = Some((index, message.header.time_ns));
        }
        (node.pace, node.heard_ever, node.restarts) = (message.pace, true, message.restarts);
        if message.pace == Pace::Live && self.due_ns.is_none() {
            self.due_ns = Some(begun_ns + (1e9 / self.rate_hz) as i64);
        }
        if message.state == StreamState::Ended {
            node.ended = true;
            let before = node.last.map_or(0, |(index, _)| index);
            node.last = Some((before, message.header.time_ns));
        }
    }

    fn fuse(&mut self, at: f64, time_ns: i64, outputs: &mut Vec<Output>) {
        let fused = self.station.fuse(at);
        let t0_ns = *self.t0_ns.get_or_insert(time_ns);
        let number = self.done;
        self.done += 1;
        self.last_ns = Some(time_ns);
        let estimate = Estimate {
            mean: fused.parameters.mean.as_slice().to_vec(),
            covariance: fused.parameters.triangle(),
            noise_mean: Vec::new(),
            noise_covariance: Vec::new(),
            innovations: Vec::new(),
            normalised_innovation_squared: 0.0,
            log_evidence: 0.0,
            used_channels: 0,
            flags: EstimateFlags { phase: Phase::Working, restarted: false, prediction_only: fused.used == 0 },
        };
        outputs.push(Output::Estimates(self.block(number, t0_ns, time_ns, vec![estimate], StreamState::Running)));
        for (index, (name, asked)) in self.parameters.iter().enumerate() {
            let (mean, variance) = (fused.parameters.mean[index], fused.parameters.covariance[(index, index)]);
            let names = (&self.structure, name);
            outputs.push(Output::Parameter(ParameterDisplay::of_gaussian(names, time_ns, (mean, variance), *asked)));
        }
        self.answer(&fused, number, time_ns, outputs);
        self.tell_nodes(&fused, time_ns, outputs);
    }

    fn answer(&self, fused: &Fused, number: u64, time_ns: i64, outputs: &mut Vec<Output>) {
        let numbers = |motion: &CompressedMotion| MotionNumbers {
            mean: motion.mean.as_slice().to_vec(),
            variance: motion.variance.as_slice().to_vec(),
        };
        for (position, feedback) in fused.feedback.iter().enumerate() {
            let Some(feedback) = feedback else { continue };
            let responses = feedback.responses.iter().enumerate();
            let message = FeedbackMessage {
                header: Header { source: self.source.clone(), epoch: self.epoch, sequence: number, time_ns },
                node_epoch: self.nodes[position].epoch,
                answers: feedback.answers,
                nodes: feedback.nodes as u16,
                mean: feedback.parameters.mean.as_slice().to_vec(),
                covariance: feedback.parameters.triangle(),
                motion: feedback.motion.as_ref().map(numbers),
                // a node knows its own
                responses: responses
                    .map(|(node, motion)| motion.as_ref().filter(|_| node != position).map(numbers))
                    .collect(),
            };
            outputs.push(Output::Feedback(position, message));
        }
    }

    fn tell_nodes(&mut self, fused: &Fused, time_ns: i64, outputs: &mut Vec<Output>) {
        for (node, report) in self.nodes.iter_mut().zip(&fused.nodes) {
            if report.heard {
                let excluded = f64::from(u8::from(report.excluded));
                node.excluded_share += (excluded - node.excluded_share) / SHARE_MEMORY;
                node.excluded_since_ns = if report.excluded { node.excluded_since_ns.or(Some(time_ns)) } else { None };
            }
            let often = match node.often_excluded {
                false => node.excluded_share > OFTEN,
                true => node.excluded_share > OFTEN / 2.0,
            };
            if often != node.often_excluded {
                node.often_excluded = often;
                let (kind, what) = match often {
                    true => (EventKind::NodeExcluded, "the node disagrees with the others and is left out"),
                    false => (EventKind::NodeBack, "the node agrees with the others again"),
                };
                let share = node.excluded_share * 100.0;
                let why = match report.distance.zip(self.distance_limit) {
                    Some((distance, limit)) => {
                        format!("left out in {share:.0} % of late; distance {distance:.1}, regular up to {limit:.1}")
                    }
                    None => format!("left out in {share:.0} % of late"),
                };
                outputs.push(Output::Event(Event {
                    structure: self.structure.clone(),
                    time_ns,
                    kind,
                    subject: node.name.to_string(),
                    what: what.to_owned(),
                    why,
                }));
            }
            outputs.push(Output::Node(NodeDisplay {
                structure: self.structure.clone(),
                node: node.name.clone(),
                time_ns,
                state: match (node.ended, report.heard, report.excluded) {
                    (true, ..) => NodeHealth::Ended,
                    (false, false, _) => NodeHealth::Silent,
                    (false, true, true) => NodeHealth::Excluded,
                    (false, true, false) => NodeHealth::Used,
                },
                distance: report.distance,
                distance_limit: self.distance_limit,
                excluded_since_ns: node.excluded_since_ns,
                excluded_share: node.excluded_share,
                messages: node.messages,
                bytes_received: node.bytes_received,
                bytes_sent: node.bytes_sent,
                refused: node.refused.iter().map(|(reason, count)| ((*reason).to_owned(), *count)).collect(),
                restarts: node.restarts,
            }));
        }
        if fused.started_anew {
            outputs.push(Output::Event(Event {
                structure: self.structure.clone(),
                time_ns,
                kind: EventKind::Restart,
                subject: "fuse".to_owned(),
                what: "the station begins anew from the prior".to_owned(),
                why: "a fused parameter was outside of what is sound".to_owned(),
            }));
        }
        let healthy = fused.used > 0;
        if healthy != self.healthy {
            self.healthy = healthy;
            let (kind, what, why) = match healthy {
                false => (EventKind::Gap, "nothing to fuse", "no node has sent anything that could be used"),
                true => (EventKind::NodeBack, "nodes are fused again", "something has come that can be used"),
            };
            outputs.push(Output::Event(Event {
                structure: self.structure.clone(),
                time_ns,
                kind,
                subject: "fuse".to_owned(),
                what: what.to_owned(),
                why: why.to_owned(),
            }));
        }
    }

    fn end(&mut self, outputs: &mut Vec<Output>) {
        self.ended = true;
        if let (Some(t0_ns), Some(last_ns)) = (self.t0_ns, self.last_ns) {
            outputs.push(Output::Estimates(self.block(self.done, t0_ns, last_ns, Vec::new(), StreamState::Ended)));
        }
    }

    fn block(
        &self,
        number: u64,
        t0_ns: i64,
        time_ns: i64,
        estimates: Vec<Estimate>,
        state: StreamState,
    ) -> EstimateBlock {
        EstimateBlock {
            header: Header { source: self.source.clone(), epoch: self.epoch, sequence: number, time_ns },
            t0_ns,
            sampling_rate_hz: self.rate_hz,
            parameters: self.parameters.len() as u16,
            noise_parameters: 0,
            channels: 0,
            estimates,
            state,
        }
    }
}

impl Node {
    /// Nothing more will come of it.
    fn is_over(&self) -> bool {
        self.ended || !self.present
    }
}

#[cfg(test)]
mod tests;
