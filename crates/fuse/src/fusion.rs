//! The core: receives messages from nodes and returns fused estimates and feedback.
//!
//! The station fuses live nodes at the ticks of its own clock, with the messages that have arrived
//! by then. If nodes replay a record, it waits until all of them have sent their estimate for a
//! period. The speed of the replay therefore does not affect the results.

use crate::error::FuseError;
use crate::node::{Node, SILENT_FUSIONS};
use spandrel_bus::{
    Estimate, EstimateBlock, EstimateFlags, Event, EventKind, Excluded, FeedbackMessage, Header,
    LocalDensity, LocalMessage, MotionNumbers, Name, NodeDisplay, OutlierDisplay, Pace,
    ParameterDisplay, Phase, StreamState, TimeGrid, ToldMotion,
};
use spandrel_filter::fusion::{
    CompressedMotion, Fused, Gaussian, Lineage, LocalEstimate, NodeReport, Station,
};
use spandrel_structure::Structure;
use std::collections::BTreeMap;

mod state;

pub use state::FusionState;

/// Position of the first message of live nodes within its fusion period, as a fraction of the
/// period.
///
/// Nodes that start together also send together. The middle of the period keeps network jitter from
/// deciding which fusion uses a message.
const FIRST_MESSAGE_AT: f64 = 0.5;

/// Maximum time between two readings of the clock, in fusion periods.
///
/// A larger step means that the clock was set forward. It counts as one period, because the
/// estimates have not aged by the whole step.
const LONGEST_LOOK: f64 = 3.0;

/// Maximum difference between the time of a fusion and the time that its number states, in fusion
/// periods.
///
/// Jitter of the station's clock stays below. After a gap, a skipped fusion or a step of the clock,
/// the numbers follow the time.
const OFF_ITS_TIME: f64 = 0.5;

/// Earliest fusion period. `i64::MIN` marks nodes that ended without an estimate.
const FIRST_INDEX: i64 = i64::MIN + 1;

/// An input of [`Fusion`], the logic of a station without I/O.
#[derive(Debug, Clone, PartialEq)]
pub enum FusionInput {
    /// A message from a node.
    Local {
        /// Index of the node in the structure file.
        node: usize,
        /// The message.
        message: Box<LocalMessage>,
        /// Size of the payload, in bytes.
        bytes: u64,
        /// Arrival time by the station's clock, in ns since the Unix epoch.
        arrived_ns: i64,
    },
    /// Which nodes are present, by index in the structure file. The station does not wait for
    /// absent nodes that replay a record.
    Present(Vec<bool>),
    /// Time of the station's clock, in ns since the Unix epoch.
    Tick(i64),
}

/// A message of a node, as in [`FusionInput::Local`].
#[derive(Debug)]
struct Local {
    message: LocalMessage,
    bytes: u64,
    arrived_ns: i64,
}

/// An output of [`Fusion`], the logic of a station without I/O.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// Fused estimates, one block per fusion.
    Estimates(EstimateBlock),
    /// A parameter for display.
    Parameter(ParameterDisplay),
    /// Feedback to the node with this index.
    Feedback(usize, FeedbackMessage),
    /// The state of a node.
    Node(NodeDisplay),
    /// The state of outlier screening for a channel of the node with this index.
    Outliers(usize, OutlierDisplay),
    /// An event.
    Event(Event),
}

/// The fusion of the nodes of one structure, without a clock or network.
///
/// [`Fusion::handle`] takes messages of the nodes and readings of the clock. It appends fused
/// estimates, feedback to the nodes, and events.
///
/// While any live node has not ended, fusions follow the clock of the station, so that no node can
/// block the others. With replaying nodes only, a fusion waits for all of them that are present.
#[derive(Debug)]
pub struct Fusion {
    structure: Name,
    source: String,
    epoch: u64,
    station: Station,
    nodes: Vec<Node>,
    parameters: Vec<Name>,
    rate_hz: f64,
    distance_limit: Option<f64>,
    /// Time of fusion 0 by which the numbers state the present times, in ns.
    t0_ns: Option<i64>,
    /// Station clock at the start of the first message's period, in ns.
    begun_ns: Option<i64>,
    /// Station clock at the next fusion of live nodes, in ns.
    due_ns: Option<i64>,
    /// Last reading of the station clock, in ns.
    looked_ns: Option<i64>,
    done: u64,
    /// The period before the period of the first message.
    origin: Option<i64>,
    /// Earliest period of replaying nodes that is not fused yet. `None` after the last
    /// representable period.
    next_index: Option<i64>,
    /// First messages of nodes that replay a record again, until the others have ended the former
    /// replay.
    again: BTreeMap<usize, Local>,
    last_ns: Option<i64>,
    ended: bool,
    /// `true` if nodes have been present and none is now.
    all_nodes_gone: bool,
    /// `false` from the event that nothing can be fused until the event that fusion has resumed.
    healthy: bool,
    /// Number of consecutive fusions without an estimate from new samples.
    without: u64,
    /// Whether messages contain variances instead of full covariances.
    variances: bool,
    /// Exponents of the sample units of each node. Empty for a node that sends no motion in units.
    told_units: Vec<Vec<i16>>,
}

impl Fusion {
    /// Creates the station of a structure. `source` names it in the headers of its messages.
    /// `epoch` must be higher at each start.
    ///
    /// # Errors
    /// Returns an error if identification is not distributed, the station rejects its settings, or
    /// a name in the structure file cannot be part of a key.
    pub fn new(
        structure: &Structure,
        source: impl Into<String>,
        epoch: u64,
    ) -> Result<Self, FuseError> {
        let name = || structure.name().to_owned();
        let plan = structure
            .fusion()
            .ok_or_else(|| FuseError::NotDistributed { structure: name() })?;
        let station = structure
            .station()
            .ok_or_else(|| FuseError::NotDistributed { structure: name() })?;
        let named = |text: &str| {
            Name::new(text).map_err(|source| FuseError::Name {
                structure: name(),
                source,
            })
        };
        let node = |node: &spandrel_structure::Node| {
            let channels = screened_channels(structure, node).into_iter().map(named);
            Ok(Node::new(
                named(node.name())?,
                channels.collect::<Result<_, FuseError>>()?,
            ))
        };
        Ok(Self {
            structure: named(structure.name())?,
            source: source.into(),
            epoch,
            station: station.map_err(|source| FuseError::Station {
                structure: name(),
                source,
            })?,
            nodes: structure
                .nodes()
                .iter()
                .map(node)
                .collect::<Result<_, FuseError>>()?,
            parameters: structure
                .parameters()
                .iter()
                .map(|parameter| named(parameter.name()))
                .collect::<Result<_, FuseError>>()?,
            rate_hz: plan.rate_hz(),
            distance_limit: plan
                .detector()
                .map(|detector| detector.limit(structure.parameters().len())),
            t0_ns: None,
            begun_ns: None,
            due_ns: None,
            looked_ns: None,
            done: 0,
            origin: None,
            next_index: Some(FIRST_INDEX),
            again: BTreeMap::new(),
            last_ns: None,
            ended: false,
            all_nodes_gone: false,
            healthy: true,
            without: 0,
            variances: plan.sends_variances(),
            told_units: (0..structure.nodes().len())
                .map(|node| structure.told_units(node))
                .collect(),
        })
    }

    /// Processes one input and appends the outputs.
    pub fn handle(&mut self, input: FusionInput, outputs: &mut Vec<Output>) {
        match input {
            FusionInput::Local {
                node,
                message,
                bytes,
                arrived_ns,
            } => {
                let local = Local {
                    message: *message,
                    bytes,
                    arrived_ns,
                };
                if self.is_again(node, &local.message) {
                    self.again.insert(node, local);
                } else {
                    if local.message.density.is_some() {
                        self.again.remove(&node);
                    }
                    self.take(node, local, outputs);
                }
            }
            FusionInput::Present(present) => self.note_presence(&present, outputs),
            FusionInput::Tick(now_ns) => {
                self.follow_clock(now_ns);
                // After the end, a fusion would only repeat older estimates.
                if !self.ended
                    && self.is_live()
                    && self.due_ns.is_some_and(|due_ns| now_ns >= due_ns)
                {
                    let periods = self.periods(now_ns);
                    self.fuse(periods, now_ns, outputs);
                    // A delayed station continues with the next period of its clock.
                    let next_s = (periods.floor() + 1.0) / self.rate_hz;
                    self.due_ns = self
                        .begun_ns
                        .map(|begun_ns| begun_ns + (next_s * 1e9) as i64);
                }
            }
        }
        self.replay_again(outputs);
        while let Some(index) = self.complete_index() {
            self.next_index = index.checked_add(1);
            let times = self
                .nodes
                .iter()
                .filter_map(|node| node.last.filter(|(at, _)| *at >= index));
            let time_ns = times.map(|(_, time_ns)| time_ns).max().unwrap_or(0);
            self.fuse(self.since_origin(index), time_ns, outputs);
        }
        if !self.ended
            && self.nodes.iter().any(|node| node.ended)
            && self.nodes.iter().all(Node::is_over)
        {
            self.end(outputs);
        }
    }

    /// Returns the epoch of the estimates, which is higher in each run.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Returns the number of fusions.
    #[must_use]
    pub fn done(&self) -> u64 {
        self.done
    }

    /// Returns the time up to which all data are processed, in ns.
    ///
    /// This is the time of the last fusion or, after all nodes have ended, of the last sample. It
    /// is `None` while neither exists.
    #[must_use]
    pub fn done_ns(&self) -> Option<i64> {
        if !self.ended {
            return self.last_ns;
        }
        self.nodes
            .iter()
            .filter_map(|node| node.last.map(|(_, time_ns)| time_ns))
            .max()
            .max(self.last_ns)
    }

    /// Returns the names of the parameters in the order of the estimates.
    pub fn parameter_names(&self) -> impl Iterator<Item = &Name> {
        self.parameters.iter()
    }

    /// Returns the names of the nodes in the order of the structure file.
    pub fn node_names(&self) -> impl Iterator<Item = &Name> {
        self.nodes.iter().map(|node| &node.name)
    }

    /// Returns the names of the channels screened for outliers, by node in the order of the
    /// structure file.
    pub fn screened_channels(&self) -> impl Iterator<Item = impl Iterator<Item = &Name>> {
        self.nodes.iter().map(Node::channel_names)
    }

    /// Adds `bytes` to the count of bytes sent to the node with the index `node`.
    pub fn count_sent(&mut self, node: usize, bytes: u64) {
        if let Some(node) = self.nodes.get_mut(node) {
            node.bytes_sent += bytes;
        }
    }

    /// Returns the number of rejected messages of all nodes, by reason.
    #[must_use]
    pub fn refused(&self) -> BTreeMap<String, u64> {
        let mut sum: BTreeMap<String, u64> = BTreeMap::new();
        for (reason, count) in self.nodes.iter().flat_map(|node| &node.refused) {
            *sum.entry(format!("refused-{reason}")).or_default() += count;
        }
        sum
    }

    /// Returns the time of the station's clock, in fusion periods since its first message.
    fn periods(&self, now_ns: i64) -> f64 {
        self.begun_ns.map_or(0.0, |begun| {
            now_ns.saturating_sub(begun).max(0) as f64 * 1e-9 * self.rate_hz
        })
    }

    /// Returns the number of the fusion period that ends with a message of this measurement time.
    fn number(&self, time_ns: i64) -> i64 {
        // The last sample is just before the end of the period.
        (time_ns as f64 * 1e-9 * self.rate_hz).round() as i64
    }

    /// Returns the number of periods of measurement time since the period before the first message.
    fn since_origin(&self, number: i64) -> f64 {
        number.saturating_sub(self.origin.unwrap_or(number)) as f64
    }

    /// Shifts the schedule if the clock was set back by more than one period, or forward.
    fn follow_clock(&mut self, now_ns: i64) {
        let looked_ns = self.looked_ns.replace(now_ns);
        let Some((begun_ns, due_ns)) = self.begun_ns.as_mut().zip(self.due_ns.as_mut()) else {
            return;
        };
        let since_ns = looked_ns.map_or(0, |looked_ns| now_ns.saturating_sub(looked_ns));
        if since_ns as f64 * 1e-9 * self.rate_hz > LONGEST_LOOK {
            let beyond_ns = since_ns.saturating_sub((1e9 / self.rate_hz) as i64);
            (*begun_ns, *due_ns) = (
                begun_ns.saturating_add(beyond_ns),
                due_ns.saturating_add(beyond_ns),
            );
        }
        let ahead_ns = due_ns.saturating_sub(now_ns);
        if ahead_ns as f64 * 1e-9 * self.rate_hz > 1.0 {
            *begun_ns = begun_ns.saturating_sub(ahead_ns);
            *due_ns = now_ns;
        }
    }

    /// Returns `true` if fusions follow the station's clock.
    ///
    /// A single live node is enough. It does not wait for nodes that replay a record, so that no
    /// message of one node can block the others.
    fn is_live(&self) -> bool {
        let has_replayed = |node: &Node| node.heard_ever && node.pace == Pace::Replayed;
        self.nodes.iter().any(Node::is_live) || !self.nodes.iter().any(has_replayed)
    }

    /// Returns [`Pace::Live`] while a live node has not ended, or if no node replays a record.
    /// Otherwise returns [`Pace::Replayed`], and before the first message `None`.
    pub fn pace(&self) -> Option<Pace> {
        let is_heard = self.nodes.iter().any(|node| node.heard_ever);
        is_heard.then(|| {
            if self.is_live() {
                Pace::Live
            } else {
                Pace::Replayed
            }
        })
    }

    /// Returns the period that all present replaying nodes have reached, if it is new.
    ///
    /// This is the earliest of the periods that the nodes have sent. A station that starts late
    /// therefore starts at the current period, and a jump in the numbers causes a single fusion.
    fn complete_index(&self) -> Option<i64> {
        if self.is_live() {
            return None;
        }
        let next = self.next_index?;
        let reached = |node: &Node| {
            node.last
                .map(|(index, _)| index)
                .filter(|index| *index >= next)
        };
        let all_are_there = self.waited_for().all(|node| reached(node).is_some());
        self.nodes
            .iter()
            .filter_map(reached)
            .min()
            .filter(|_| all_are_there)
    }

    /// Returns `true` if a message begins a record that the node has replayed before, or an earlier
    /// one.
    fn is_again(&self, position: usize, message: &LocalMessage) -> bool {
        let goes_back = |node: &Node| {
            let number = self.number(message.header.time_ns);
            message.header.epoch == node.epoch && node.last.is_some_and(|(last, _)| number < last)
        };
        message.pace == Pace::Replayed
            && message.density.is_some()
            && self.nodes.get(position).is_some_and(goes_back)
            && !self.station.has_received(position, message.header.sequence)
            && !self.nodes.iter().any(Node::is_live)
    }

    /// Begins the fusions of a record that the nodes replay again, once no node is still in the
    /// former replay.
    fn replay_again(&mut self, outputs: &mut Vec<Output>) {
        if self.again.is_empty() || self.waited_for().next().is_some() {
            return;
        }
        for node in &mut self.nodes {
            (node.last, node.ended) = (None, false);
        }
        (self.next_index, self.origin) = (Some(FIRST_INDEX), None);
        self.station.restart_clock();
        for (position, local) in std::mem::take(&mut self.again) {
            self.take(position, local, outputs);
        }
    }

    /// Returns the nodes for which a fusion of a replayed record waits. A node that replays the
    /// record again sends no further message of the former replay.
    fn waited_for(&self) -> impl Iterator<Item = &Node> {
        let nodes = self.nodes.iter().enumerate();
        let waited_for = nodes.filter(|(position, node)| {
            !node.ended && (node.present || !node.heard_ever) && !self.again.contains_key(position)
        });
        waited_for.map(|(_, node)| node)
    }

    /// Records which nodes are present.
    ///
    /// If the last node has disappeared, the event follows at once, because there might be no
    /// further fusion.
    fn note_presence(&mut self, present: &[bool], outputs: &mut Vec<Output>) {
        let before = self.nodes.iter().any(|node| node.present);
        for (node, present) in self.nodes.iter_mut().zip(present) {
            node.present = *present;
        }
        let now = self.nodes.iter().any(|node| node.present);
        self.all_nodes_gone = !now && (before || self.all_nodes_gone);
        if !before || now || !self.nodes.iter().any(|node| node.heard_ever) {
            return;
        }
        if let Some(time_ns) = self.done_ns() {
            let (what, why) = (
                "no nodes are left",
                "the liveliness tokens of all node workers have disappeared",
            );
            self.tell(
                EventKind::NodeSilent,
                "fuse",
                what,
                why.to_owned(),
                time_ns,
                outputs,
            );
            self.show_nodes(time_ns, outputs);
        }
    }

    fn take(&mut self, position: usize, local: Local, outputs: &mut Vec<Output>) {
        let Local {
            mut message,
            bytes,
            arrived_ns,
        } = local;
        self.follow_clock(arrived_ns);
        let number = self.number(message.header.time_ns);
        if message.density.is_some() {
            self.origin.get_or_insert(number.saturating_sub(1));
        }
        let since_origin = self.since_origin(number);
        let Some(node) = self.nodes.get_mut(position) else {
            return;
        };
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
        let (index, time_ns) = (message.header.sequence, message.header.time_ns);
        if let Some(density) = message.density.take() {
            let instant = (time_ns as f64 * 1e-9) * self.rate_hz;
            let Some(estimate) = local_estimate(density, index, instant) else {
                *node.refused.entry("dimension").or_default() += 1;
                return;
            };
            let at = match message.pace {
                Pace::Replayed => since_origin,
                Pace::Live => {
                    arrived_ns.saturating_sub(begun_ns).max(0) as f64 * 1e-9 * self.rate_hz
                }
            };
            if let Err(refusal) = self.station.receive(position, estimate, at) {
                *node.refused.entry(refusal.as_str()).or_default() += 1;
                return;
            }
            node.messages += 1;
            node.last = Some((number, time_ns));
            // A sensor can end and restart while its worker keeps running.
            (node.ended, self.ended) = (false, false);
        }
        node.note(&message, arrived_ns);
        let screened = node.screened(&self.structure, &message).into_iter();
        outputs.extend(screened.map(|display| Output::Outliers(position, display)));
        (node.pace, node.heard_ever, node.restarts) = (message.pace, true, message.restarts);
        if message.pace == Pace::Live && self.due_ns.is_none() {
            self.due_ns = Some(begun_ns + (1e9 / self.rate_hz) as i64);
        }
        if message.state == StreamState::Ended {
            node.ended = true;
            let before = node.last.map_or(i64::MIN, |(number, _)| number);
            node.last = Some((before, time_ns));
        }
    }

    fn fuse(&mut self, at: f64, time_ns: i64, outputs: &mut Vec<Output>) {
        let fused = self.station.fuse(at);
        let is_measured =
            |(node, report): (&Node, &NodeReport)| report.is_used() && node.has_samples();
        // A node whose sensors have failed sends predictions. They contain nothing new.
        let is_prediction = !self.nodes.iter().zip(&fused.nodes).any(is_measured);
        self.without = if is_prediction { self.without + 1 } else { 0 };
        let number = self.done;
        let t0_ns = self.follow_time(number, time_ns);
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
            flags: EstimateFlags {
                phase: match self.without {
                    SILENT_FUSIONS.. => Phase::ResponseSilent,
                    _ => Phase::Working,
                },
                restarted: fused.restarted_from_prior,
                prediction_only: is_prediction,
                ..EstimateFlags::working()
            },
            excluded: Excluded::None,
            sustained_information: Vec::new(),
        };
        outputs.push(Output::Estimates(self.block(
            number,
            t0_ns,
            time_ns,
            vec![estimate],
            StreamState::Running,
        )));
        for (index, name) in self.parameters.iter().enumerate() {
            let mean = fused.parameters.mean[index];
            let variance = fused.parameters.covariance[(index, index)];
            let display =
                ParameterDisplay::of_normal(&self.structure, name, time_ns, mean, variance);
            outputs.push(Output::Parameter(display));
        }
        self.answer(&fused, number, time_ns, outputs);
        self.tell_nodes(&fused, time_ns, outputs);
    }

    /// Returns the time of fusion 0 by which fusion `number` is at `time_ns`.
    fn follow_time(&mut self, number: u64, time_ns: i64) -> i64 {
        let since_ns = TimeGrid::new(0, self.rate_hz).map_or(0, |grid| grid.time_ns(number));
        let own_ns = time_ns.saturating_sub(since_ns);
        let t0_ns = self.t0_ns.get_or_insert(own_ns);
        if own_ns.abs_diff(*t0_ns) as f64 * 1e-9 * self.rate_hz > OFF_ITS_TIME {
            *t0_ns = own_ns;
        }
        *t0_ns
    }

    fn answer(&self, fused: &Fused, number: u64, time_ns: i64, outputs: &mut Vec<Output>) {
        let numbers = |motion: &CompressedMotion| MotionNumbers {
            mean: motion.mean.as_slice().to_vec(),
            variance: motion.variance.as_slice().to_vec(),
        };
        let told = |motion: &CompressedMotion, node: usize| {
            ToldMotion::new(
                motion.mean.as_slice(),
                motion.variance.as_slice(),
                &self.told_units[node],
            )
        };
        for (position, feedback) in fused.feedback.iter().enumerate() {
            let Some(feedback) = feedback else { continue };
            let responses = feedback.responses.iter().enumerate();
            let message = FeedbackMessage {
                header: Header {
                    source: self.source.clone(),
                    epoch: self.epoch,
                    sequence: number,
                    time_ns,
                },
                node_epoch: self.nodes[position].epoch,
                answers: feedback.answers,
                nodes: feedback.nodes as u16,
                mean: feedback.parameters.mean.as_slice().to_vec(),
                covariance: match self.variances {
                    true => feedback.parameters.variances(),
                    false => feedback.parameters.triangle(),
                },
                motion: feedback.motion.as_ref().map(numbers),
                // A node knows its own motion.
                responses: responses
                    .map(|(node, motion)| {
                        motion
                            .as_ref()
                            .filter(|_| node != position)
                            .map(|motion| told(motion, node))
                    })
                    .collect(),
            };
            outputs.push(Output::Feedback(position, message));
        }
    }

    /// Outputs the state of the nodes after a fusion, and events of the nodes and the station.
    fn tell_nodes(&mut self, fused: &Fused, time_ns: i64, outputs: &mut Vec<Output>) {
        let mut events = Vec::new();
        for (node, report) in self.nodes.iter_mut().zip(&fused.nodes) {
            let mut news = Vec::new();
            node.judge(
                *report,
                node.ended || self.all_nodes_gone,
                time_ns,
                &mut news,
            );
            let distance = report.distance.zip(self.distance_limit);
            events.extend(news.into_iter().map(|(kind, what, mut why)| {
                if let Some((distance, limit)) = distance {
                    why.push_str(&format!(
                        "; distance {distance:.1}, regular up to {limit:.1}"
                    ));
                }
                (kind, node.name.to_string(), what, why)
            }));
        }
        for (kind, subject, what, why) in events {
            self.tell(kind, &subject, what, why, time_ns, outputs);
        }
        self.show_nodes(time_ns, outputs);
        if fused.restarted_from_prior {
            let why = "a fused parameter was invalid or outside its plausible range".to_owned();
            self.tell(
                EventKind::Restart,
                "fuse",
                "the station restarts from the prior",
                why,
                time_ns,
                outputs,
            );
        }
        if fused.adopted {
            let (what, why) = (
                "the station takes over the knowledge of the nodes",
                "a previous station has already fused them",
            );
            self.tell(
                EventKind::Restart,
                "fuse",
                what,
                why.to_owned(),
                time_ns,
                outputs,
            );
        }
        // A single fusion without data is not an event, because all messages can be one period
        // late.
        let told = match (self.healthy, self.without) {
            (true, SILENT_FUSIONS..) => Some((
                EventKind::Gap,
                "nothing to fuse",
                "no node has sent an estimate from new samples",
            )),
            (false, 0) => Some((
                EventKind::NodeBack,
                "nodes are fused again",
                "an estimate from new samples has arrived",
            )),
            (true, _) | (false, _) => None,
        };
        if let Some((kind, what, why)) = told {
            self.healthy = !self.healthy;
            self.tell(kind, "fuse", what, why.to_owned(), time_ns, outputs);
        }
    }

    fn show_nodes(&self, time_ns: i64, outputs: &mut Vec<Output>) {
        let displays = self.nodes.iter().map(|node| {
            node.display(
                &self.structure,
                time_ns,
                node.ended || self.all_nodes_gone,
                self.distance_limit,
            )
        });
        outputs.extend(displays.map(Output::Node));
    }

    fn tell(
        &self,
        kind: EventKind,
        subject: &str,
        what: &str,
        why: String,
        time_ns: i64,
        outputs: &mut Vec<Output>,
    ) {
        outputs.push(Output::Event(Event {
            structure: self.structure.clone(),
            time_ns,
            kind,
            subject: subject.to_owned(),
            what: what.to_owned(),
            why,
        }));
    }

    fn end(&mut self, outputs: &mut Vec<Output>) {
        self.ended = true;
        if let (Some(t0_ns), Some(last_ns)) = (self.t0_ns, self.last_ns) {
            outputs.push(Output::Estimates(self.block(
                self.done,
                t0_ns,
                last_ns,
                Vec::new(),
                StreamState::Ended,
            )));
        }
        // The last nodes ended after the last fusion.
        if let Some(done_ns) = self.done_ns() {
            self.show_nodes(done_ns, outputs);
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
            header: Header {
                source: self.source.clone(),
                epoch: self.epoch,
                sequence: number,
                time_ns,
            },
            term: 0,
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

/// Returns the estimate of a node, or `None` if the sizes of its density disagree.
///
/// Decoding checks the sizes, but a message built in code can still be invalid.
fn local_estimate(density: LocalDensity, index: u64, instant: f64) -> Option<LocalEstimate> {
    let parameters = Gaussian::from_triangle(&density.mean, &density.covariance)?;
    let lineage = density.lineage.map(|lineage| Lineage {
        own: lineage.own,
        answers: lineage.answers,
    });
    let motion = density.motion.map(|told| {
        let (mean, variance) = told.into_numbers();
        CompressedMotion {
            mean: mean.into(),
            variance: variance.into(),
        }
    });
    Some(LocalEstimate {
        index,
        parameters,
        lineage,
        motion,
        instant,
    })
}

/// Returns the names of the channels of a node that are screened for outliers, in the order of the
/// node's reports.
fn screened_channels<'s>(
    structure: &Structure,
    node: &'s spandrel_structure::Node,
) -> Vec<&'s str> {
    let Some(own) = structure
        .of_node(node.name())
        .filter(Structure::screens_outliers)
    else {
        return Vec::new();
    };
    own.observation_channels()
        .iter()
        .map(|channel| node.channels()[*channel].name())
        .collect()
}

#[cfg(test)]
mod tests;
