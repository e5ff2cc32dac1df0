//! The unit of writing, and its collection from messages.

use crate::sums::Sums;
use spandrel_bus::{
    Acknowledgement, AlertMessage, ConditionDisplay, CredibleInterval, Event, ModeDisplay,
};
use spandrel_listener::Input;
use spandrel_structure::{Condition, Structure};
use std::collections::{BTreeMap, BTreeSet};

/// Lengths of the aggregation intervals (s): a minute, an hour, a day.
pub(crate) const RESOLUTIONS_S: [i64; 3] = [60, 3_600, 86_400];
/// Maximum number of series of a structure that its file does not name, such as model classes.
const OTHER_SERIES: usize = 256;

const SECOND_NS: i64 = 1_000_000_000;

/// The kind of quantity of a series.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Kind {
    /// A parameter (ratio to nominal) with its standard deviation.
    Parameter,
    /// The loss of a parameter (share of the reference) with its standard deviation and
    /// probability.
    Loss,
    /// A noise level (variance, unit²) with its standard deviation.
    Noise,
    /// The share of rejected samples among the recent samples of a channel.
    Outlier,
    /// The plausibility of a model class.
    Class,
    /// The distance of a node's own estimate from those of the other nodes.
    Node,
    /// A condition (in its unit), such as a temperature.
    Condition,
    /// The natural frequency of a declared mode (Hz) with its standard deviation.
    Mode,
}

impl Kind {
    pub(crate) const ALL: [Self; 8] = [
        Self::Parameter,
        Self::Loss,
        Self::Noise,
        Self::Outlier,
        Self::Class,
        Self::Node,
        Self::Condition,
        Self::Mode,
    ];

    /// Returns the name of the kind in queries and in the database.
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Parameter => "parameter",
            Self::Loss => "loss",
            Self::Noise => "noise",
            Self::Outlier => "outlier",
            Self::Class => "class",
            Self::Node => "node",
            Self::Condition => "condition",
            Self::Mode => "mode",
        }
    }
}

/// One quantity of one structure.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Series {
    pub(crate) kind: Kind,
    pub(crate) name: String,
}

/// The messages of one structure from about one second.
#[derive(Clone, Debug)]
pub(crate) struct Batch {
    /// `root/structure`.
    pub(crate) structure: String,
    /// Number of the batch within one run of the service, from 1.
    pub(crate) number: i64,
    /// Display values: series, time (ns), mean, standard deviation, probability of loss.
    pub(crate) points: Vec<(Series, i64, [f64; 3])>,
    /// Values of conditions and modes, as in `points`. Their contributions to the minute, hour and
    /// day are computed when they are written, because they may be repeated.
    pub(crate) repeatable: Vec<(Series, i64, [f64; 3])>,
    /// Contributions of the display values to their minute, hour and day: series, resolution (s),
    /// start (s).
    pub(crate) buckets: BTreeMap<(Series, i64, i64), Sums>,
    /// Alerts, acknowledgements and events.
    pub(crate) happened: Vec<Happened>,
}

/// An alert, acknowledgement or event, as a message.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Happened {
    Alert(Box<AlertMessage>),
    Acknowledgement(Acknowledgement),
    Event(Event),
}

impl Batch {
    /// Returns the number of database rows.
    pub(crate) fn rows(&self) -> usize {
        self.points.len() + self.repeatable.len() + self.buckets.len() + self.happened.len()
    }
}

/// Collects the messages of one structure.
#[derive(Debug)]
pub(crate) struct Collector {
    structure: String,
    known: BTreeSet<Series>,
    others: BTreeSet<Series>,
    declared: Vec<Condition>,
    now_ns: i64,
    points: Vec<(Series, i64, [f64; 3])>,
    repeatable: Vec<(Series, i64, [f64; 3])>,
    /// Time of the last message of each mode (ns), which is repeated for late subscribers.
    modes: BTreeMap<String, i64>,
    /// Time of the last message of each parameter (ns). The service modes repeats it.
    parameters: BTreeMap<String, i64>,
    happened: Vec<Happened>,
    /// Time of the newest display value (ns since the Unix epoch, UTC).
    pub(crate) newest_ns: Option<i64>,
    /// Number of values of quantities that the structure file does not name.
    pub(crate) unknown: u64,
    /// Numbers of rejected values of conditions, by reason.
    pub(crate) rejected: BTreeMap<&'static str, u64>,
}

impl Collector {
    pub(crate) fn new(structure: &Structure, root: &str) -> Self {
        let series = |kind, name: &str| Series {
            kind,
            name: name.to_owned(),
        };
        let parameters = structure.parameters().iter().flat_map(|parameter| {
            [Kind::Parameter, Kind::Loss].map(|kind| series(kind, parameter.name()))
        });
        let nodes = structure
            .nodes()
            .iter()
            .map(|node| series(Kind::Node, node.name()));
        let channels = structure.nodes().iter().flat_map(|node| node.channels());
        let channels = channels.map(|channel| series(Kind::Outlier, channel.name()));
        let conditions = structure
            .conditions()
            .iter()
            .map(|condition| series(Kind::Condition, condition.name()));
        let modes = structure.modal().into_iter().flat_map(|plan| &plan.modes);
        let modes = modes.map(|mode| series(Kind::Mode, &mode.name));
        let levels = structure
            .noise_levels()
            .iter()
            .map(|level| series(Kind::Noise, level.name()));
        Self {
            structure: format!("{root}/{}", structure.name()),
            known: parameters
                .chain(levels)
                .chain(nodes)
                .chain(channels)
                .chain(conditions)
                .chain(modes)
                .collect(),
            others: BTreeSet::new(),
            declared: structure.conditions().to_vec(),
            now_ns: i64::MAX,
            points: Vec::new(),
            repeatable: Vec::new(),
            modes: BTreeMap::new(),
            parameters: BTreeMap::new(),
            happened: Vec::new(),
            newest_ns: None,
            unknown: 0,
            rejected: BTreeMap::new(),
        }
    }

    /// Returns the series that the structure file names.
    pub(crate) fn named(&self) -> &BTreeSet<Series> {
        &self.known
    }

    /// Sets the wall-clock time of the next messages (ns since the Unix epoch).
    pub(crate) fn set_now(&mut self, now_ns: i64) {
        self.now_ns = now_ns;
    }

    /// Processes a message. Ignores inputs that are not stored.
    pub(crate) fn handle(&mut self, input: Input) {
        match input {
            Input::Parameter(m) => {
                let name = m.parameter.as_str();
                if self.parameters.get(name) == Some(&m.time_ns) {
                    return; // repeated for late subscribers
                }
                self.parameters.insert(name.to_owned(), m.time_ns);
                self.push(
                    Kind::Parameter,
                    m.parameter.as_str(),
                    m.time_ns,
                    [m.mean, m.std, 0.0],
                );
            }
            Input::Loss(m) => {
                let width = 2.0 * CredibleInterval::HALF_WIDTH_95;
                let std = (m.interval.high - m.interval.low) / width;
                self.push(
                    Kind::Loss,
                    m.parameter.as_str(),
                    m.time_ns,
                    [m.loss, std, m.probability_of_loss],
                );
            }
            Input::Noise(m) => self.push(
                Kind::Noise,
                m.name.as_str(),
                m.time_ns,
                [m.mean, m.std, 0.0],
            ),
            Input::Outlier(m) => self.push(
                Kind::Outlier,
                m.channel.as_str(),
                m.time_ns,
                [m.recent_share, 0.0, 0.0],
            ),
            Input::Classes(m) => {
                for class in &m.classes {
                    self.push(
                        Kind::Class,
                        &class.class,
                        m.time_ns,
                        [class.plausibility, 0.0, 0.0],
                    );
                }
            }
            Input::Node(m) => {
                if let Some(distance) = m.distance {
                    self.push(Kind::Node, m.node.as_str(), m.time_ns, [distance, 0.0, 0.0]);
                }
            }
            // The database stores only values that are newer than the last one.
            Input::Condition(m) | Input::StandingCondition(m, _) => self.take_condition(&m),
            Input::Mode(m) => self.take_mode(&m),
            // The database stores a change once, however often it arrives.
            Input::Alert(alert) | Input::StandingAlert(alert) | Input::LoggedAlert(alert) => {
                self.happened.push(Happened::Alert(Box::new(alert)));
            }
            Input::Acknowledgement(acknowledgement) => self
                .happened
                .push(Happened::Acknowledgement(acknowledgement)),
            Input::Event(event) => self.happened.push(Happened::Event(event)),
            Input::Now(_)
            | Input::Fit(_)
            | Input::SensorHealth(_)
            | Input::Waveform(_)
            | Input::Spectrum(_)
            | Input::Judgement(_)
            | Input::Monitoring(_)
            | Input::Estimates(..)
            | Input::Status(_)
            | Input::Ingested(..)
            | Input::Present(_)
            | Input::Past(_)
            | Input::LastingLosses(_)
            | Input::Misplaced => {}
        }
    }

    /// Stores a value of a condition, unless it contradicts the structure file or the clock.
    fn take_condition(&mut self, message: &ConditionDisplay) {
        let name = message.name.as_str();
        let Some(declared) = self.declared.iter().find(|known| known.name() == name) else {
            self.unknown += 1;
            return;
        };
        let fault = if message.unit != declared.unit() {
            Some("wrong-unit")
        } else if !declared.is_plausible(message.value) {
            Some("out-of-range")
        } else if message.time_ns > self.now_ns.saturating_add(ConditionDisplay::MAX_AHEAD_NS) {
            Some("ahead-of-clock")
        } else {
            None
        };
        match fault {
            Some(fault) => *self.rejected.entry(fault).or_default() += 1,
            None => {
                let series = Series {
                    kind: Kind::Condition,
                    name: name.to_owned(),
                };
                self.repeatable
                    .push((series, message.time_ns, [message.value, 0.0, 0.0]));
            }
        }
    }

    /// Stores the frequency of a mode, unless the message is a repetition of the last one.
    fn take_mode(&mut self, message: &ModeDisplay) {
        let series = Series {
            kind: Kind::Mode,
            name: message.mode.to_string(),
        };
        if !self.known.contains(&series) {
            self.unknown += 1;
            return;
        }
        let last = self.modes.insert(series.name.clone(), message.time_ns);
        let Some(estimate) = &message.estimate else {
            return;
        };
        if last != Some(message.time_ns) {
            let values = [estimate.frequency_hz, estimate.frequency_std_hz, 0.0];
            self.repeatable.push((series, message.time_ns, values));
        }
    }

    fn push(&mut self, kind: Kind, name: &str, time_ns: i64, values: [f64; 3]) {
        let series = Series {
            kind,
            name: name.to_owned(),
        };
        if !self.known.contains(&series) && !self.others.contains(&series) {
            let may_come =
                matches!(kind, Kind::Noise | Kind::Class) && self.others.len() < OTHER_SERIES;
            if !may_come {
                self.unknown += 1;
                return;
            }
            self.others.insert(series.clone());
        }
        self.newest_ns = self.newest_ns.max(Some(time_ns));
        self.points.push((series, time_ns, values));
    }

    /// Returns the messages collected since the last call, or `None` if there were none.
    pub(crate) fn take(&mut self, number: i64) -> Option<Batch> {
        let (points, repeatable, happened) = (
            std::mem::take(&mut self.points),
            std::mem::take(&mut self.repeatable),
            std::mem::take(&mut self.happened),
        );
        if points.is_empty() && repeatable.is_empty() && happened.is_empty() {
            return None;
        }
        Some(Batch {
            structure: self.structure.clone(),
            number,
            buckets: buckets(&points),
            points,
            repeatable,
            happened,
        })
    }
}

/// Returns the contributions of values to their minute, hour and day: series, resolution (s), start
/// (s).
pub(crate) fn buckets(points: &[(Series, i64, [f64; 3])]) -> BTreeMap<(Series, i64, i64), Sums> {
    let mut buckets: BTreeMap<(Series, i64, i64), Sums> = BTreeMap::new();
    for (series, time_ns, values) in points {
        let value = Sums::of(*time_ns, *values);
        for resolution_s in RESOLUTIONS_S {
            let start_s = time_ns.div_euclid(resolution_s * SECOND_NS) * resolution_s;
            let bucket = buckets.entry((series.clone(), resolution_s, start_s));
            bucket.and_modify(|sums| sums.add(&value)).or_insert(value);
        }
    }
    buckets
}
