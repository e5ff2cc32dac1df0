//! The core: messages of nodes in, fused estimates and answers out.
//!
//! Nodes that measure live are fused at the ticks of the station's own clock, with what has arrived. Nodes that replay a record
//! are fused when all of them have sent their estimate of a period, however fast, so that the same record gives the same
//! numbers.

use crate::error::FuseError;
use crate::node::{Node, SILENT_FUSIONS};
use spandrel_bus::{
    Estimate, EstimateBlock, EstimateFlags, Event, EventKind, FeedbackMessage, Header,
    LocalMessage, MotionNumbers, Name, NodeDisplay, OutlierDisplay, Pace, ParameterDisplay,
    StreamState, ToldMotion,
};
use spandrel_filter::fusion::{CompressedMotion, Fused, Gaussian, Lineage, LocalEstimate, Station};
use spandrel_structure::Structure;
use std::collections::BTreeMap;

mod state;

pub use state::FusionState;

/// Where the first message of live nodes lies within its fusion period. In the middle: nodes that began together send together,
/// and jitter of the network must not decide which fusion hears them.
const FIRST_MESSAGE_AT: f64 = 0.5;

/// A clock that has gone on by more than so many periods between two looks at it has been set forward: it counts as one period, as
/// nothing that was known has become so much older.
const LONGEST_LOOK: f64 = 3.0;

/// What the core reacts to.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// A message of the node at this place in the file, of so many bytes, at a time of the station's clock (ns).
    Local {
        /// Place in the structure file.
        node: usize,
        /// The message.
        message: Box<LocalMessage>,
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
    /// How the screening of a channel of the node at this place stands.
    Outliers(usize, OutlierDisplay),
    /// Something rare.
    Event(Event),
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
    /// station's clock at the last look
    looked_ns: Option<i64>,
    done: u64,
    /// the period before that of the first message
    origin: Option<i64>,
    /// earliest period of replaying nodes that is not yet fused; `None` after the last that can be counted
    next_index: Option<i64>,
    last_ns: Option<i64>,
    ended: bool,
    /// a node has been there at some time, and none is now
    deserted: bool,
    /// it has not been told that there is nothing to fuse, or that there is again
    healthy: bool,
    /// fusions on end in which nothing could be used
    without: u64,
    /// what nodes send and are sent of a covariance
    variances: bool,
    /// by node, exponents of the units of its samples; none where none are told
    told_units: Vec<Vec<i16>>,
}

impl Fusion {
    /// Makes the station of a structure; `epoch` is higher at each start.
    ///
    /// # Errors
    /// When identification is not distributed, or the station refuses its settings.
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
        let parameter = |(index, parameter): (usize, &spandrel_structure::Parameter)| {
            Ok((named(parameter.name())?, structure.displayed_loss(index)))
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
                .enumerate()
                .map(parameter)
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
            // the lowest is of nodes that have told nothing
            next_index: Some(i64::MIN + 1),
            last_ns: None,
            ended: false,
            deserted: false,
            healthy: true,
            without: 0,
            variances: plan.sends_variances(),
            told_units: (0..structure.nodes().len())
                .map(|node| structure.told_units(node))
                .collect(),
        })
    }

    /// Takes one input and appends what follows from it.
    pub fn handle(&mut self, input: Input, outputs: &mut Vec<Output>) {
        match input {
            Input::Local {
                node,
                message,
                bytes,
                arrived_ns,
            } => {
                self.take(node, *message, bytes, arrived_ns, outputs);
            }
            Input::Present(present) => self.note_presence(&present, outputs),
            Input::Tick(now_ns) => {
                self.follow_clock(now_ns);
                // what would be fused after the end is nothing but older
                if !self.ended
                    && self.is_live()
                    && self.due_ns.is_some_and(|due_ns| now_ns >= due_ns)
                {
                    let periods = self.periods(now_ns);
                    self.fuse(periods, now_ns, outputs);
                    // a station that was held up goes on with the next period of its clock
                    let next_s = (periods.floor() + 1.0) / self.rate_hz;
                    self.due_ns = self
                        .begun_ns
                        .map(|begun_ns| begun_ns + (next_s * 1e9) as i64);
                }
            }
        }
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

    /// Returns the epoch of its estimates: higher in each life.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
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
        self.nodes
            .iter()
            .filter_map(|node| node.last.map(|(_, time_ns)| time_ns))
            .max()
            .max(self.last_ns)
    }

    /// Returns the names of the parameters, in the order of the estimates.
    pub fn parameter_names(&self) -> impl Iterator<Item = &Name> {
        self.parameters.iter().map(|(name, _)| name)
    }

    /// Returns the names of the nodes, in the order of the file.
    pub fn node_names(&self) -> impl Iterator<Item = &Name> {
        self.nodes.iter().map(|node| &node.name)
    }

    /// Returns the names of the channels whose outliers are screened, by node in the order of the file.
    pub fn screened_channels(&self) -> impl Iterator<Item = impl Iterator<Item = &Name>> {
        self.nodes.iter().map(Node::channel_names)
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
        self.begun_ns.map_or(0.0, |begun| {
            now_ns.saturating_sub(begun).max(0) as f64 * 1e-9 * self.rate_hz
        })
    }

    /// Number of a fusion period of measurement time, of which a message with this time is the last.
    fn number(&self, time_ns: i64) -> i64 {
        // the last sample lies just before the end of the period
        (time_ns as f64 * 1e-9 * self.rate_hz).round() as i64
    }

    /// Periods of measurement time since the one before the first message.
    fn since_origin(&self, number: i64) -> f64 {
        number.saturating_sub(self.origin.unwrap_or(number)) as f64
    }

    /// Goes on from where it was when the clock has been set: back by more than a period, or forward.
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

    /// Whether fusions follow the station's clock: a single node that measures does not wait for those that replay, so that no
    /// message of one node can hold up the others.
    fn is_live(&self) -> bool {
        let heard = |pace| {
            self.nodes
                .iter()
                .filter(move |node| node.heard_ever && node.pace == pace)
        };
        heard(Pace::Live).any(|node| !node.is_over()) || heard(Pace::Replayed).next().is_none()
    }

    /// Whether what the nodes send comes as it is measured; none before the first message.
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

    /// Returns the period that all replaying nodes that are there have reached, if it is a new one.
    ///
    /// It is the earliest that any of them has sent: a station that comes late begins where they are, and a jump of their counts
    /// is one fusion.
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
        let waited_for = |node: &&Node| !node.ended && (node.present || !node.heard_ever);
        let all_are_there = self
            .nodes
            .iter()
            .filter(waited_for)
            .all(|node| reached(node).is_some());
        self.nodes
            .iter()
            .filter_map(reached)
            .min()
            .filter(|_| all_are_there)
    }

    /// Takes which nodes are there; that none is any more is told at once, because no fusion may follow.
    fn note_presence(&mut self, present: &[bool], outputs: &mut Vec<Output>) {
        let before = self.nodes.iter().any(|node| node.present);
        for (node, present) in self.nodes.iter_mut().zip(present) {
            node.present = *present;
        }
        let now = self.nodes.iter().any(|node| node.present);
        self.deserted = !now && (before || self.deserted);
        if !before || now || !self.nodes.iter().any(|node| node.heard_ever) {
            return;
        }
        if let Some(time_ns) = self.done_ns() {
            let (what, why) = (
                "no node is there any more",
                "the liveliness tokens of all workers of nodes are gone",
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

    fn take(
        &mut self,
        position: usize,
        mut message: LocalMessage,
        bytes: u64,
        arrived_ns: i64,
        outputs: &mut Vec<Output>,
    ) {
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
            let lineage = density.lineage.map(|lineage| Lineage {
                own: lineage.own,
                answers: lineage.answers,
            });
            // checked when it was decoded; a hand-made message may still be none
            let Some(parameters) = Gaussian::from_triangle(&density.mean, &density.covariance)
            else {
                *node.refused.entry("dimension").or_default() += 1;
                return;
            };
            let motion = density.motion.map(|told| {
                let (mean, variance) = told.into_numbers();
                CompressedMotion {
                    mean: mean.into(),
                    variance: variance.into(),
                }
            });
            let at = match message.pace {
                Pace::Replayed => since_origin,
                Pace::Live => {
                    arrived_ns.saturating_sub(begun_ns).max(0) as f64 * 1e-9 * self.rate_hz
                }
            };
            let instant = (time_ns as f64 * 1e-9) * self.rate_hz;
            let estimate = LocalEstimate {
                index,
                parameters,
                lineage,
                motion,
                instant,
            };
            if let Err(refusal) = self.station.receive(position, estimate, at) {
                *node.refused.entry(refusal.as_str()).or_default() += 1;
                return;
            }
            node.messages += 1;
            node.last = Some((number, time_ns));
            // a sensor may end and begin anew while its worker stays
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
            flags: EstimateFlags {
                prediction_only: fused.used == 0,
                ..EstimateFlags::working()
            },
        };
        outputs.push(Output::Estimates(self.block(
            number,
            t0_ns,
            time_ns,
            vec![estimate],
            StreamState::Running,
        )));
        for (index, (name, asked)) in self.parameters.iter().enumerate() {
            let (mean, variance) = (
                fused.parameters.mean[index],
                fused.parameters.covariance[(index, index)],
            );
            let names = (&self.structure, name);
            outputs.push(Output::Parameter(ParameterDisplay::of_gaussian(
                names,
                time_ns,
                (mean, variance),
                *asked,
            )));
        }
        self.answer(&fused, number, time_ns, outputs);
        self.tell_nodes(&fused, time_ns, outputs);
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
                // a node knows its own
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

    /// Tells how the nodes stand after a fusion, and what is new of them and of the station.
    fn tell_nodes(&mut self, fused: &Fused, time_ns: i64, outputs: &mut Vec<Output>) {
        let mut events = Vec::new();
        for (node, report) in self.nodes.iter_mut().zip(&fused.nodes) {
            let mut news = Vec::new();
            node.judge(*report, node.ended || self.deserted, time_ns, &mut news);
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
        if fused.started_anew {
            let why = "a fused parameter was outside of what is sound".to_owned();
            self.tell(
                EventKind::Restart,
                "fuse",
                "the station begins anew from the prior",
                why,
                time_ns,
                outputs,
            );
        }
        if fused.adopted {
            let (what, why) = (
                "the station takes over what the nodes know",
                "they have been fused by a station before this one",
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
        // as of a node: messages that come a period late, all of them, are no gap
        self.without = if fused.used > 0 { 0 } else { self.without + 1 };
        let told = match (self.healthy, self.without) {
            (true, SILENT_FUSIONS..) => Some((
                EventKind::Gap,
                "nothing to fuse",
                "no node has sent anything that could be used",
            )),
            (false, 0) => Some((
                EventKind::NodeBack,
                "nodes are fused again",
                "something has come that can be used",
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
                node.ended || self.deserted,
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
        // the last nodes ended after the last fusion
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

/// The names of the channels of a node whose outliers are screened, in the order in which it tells of them.
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
