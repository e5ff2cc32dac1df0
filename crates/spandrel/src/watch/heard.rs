//! State of the view: the present state of the structures, recent values and traffic, and events.

use super::natural_name::in_order;
use super::open_alert::{AlertId, AlertKind, Change, OpenAlert};
use super::trail::Trail;
use spandrel_bus::{
    AlertState, Event, EventKind, JudgementDisplay, LossDisplay, Name, NodeDisplay,
    ParameterDisplay, Service,
};
use spandrel_listener::{AlertChange, Input, StructureState, Structures};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// Maximum number of events of all structures together. A further event replaces the oldest.
const EVENTS_KEPT: usize = 100;
/// Number of messages of a node over which its traffic is averaged.
const TRAFFIC_OVER: usize = 10;

/// State from all messages so far.
#[derive(Debug, Clone, Default)]
pub struct Heard {
    structures: Structures,
    /// Recent values of the parameters of each structure.
    trails: BTreeMap<Name, BTreeMap<Name, Trail>>,
    /// Distributed nodes of each structure.
    nodes: BTreeMap<Name, BTreeMap<Name, NodeHeard>>,
    /// Events, newest first.
    events: VecDeque<Event>,
}

/// Last value of a parameter, its loss, and its recent values.
#[derive(Debug, Clone, Copy)]
pub struct ParameterHeard<'h> {
    pub display: &'h ParameterDisplay,
    /// Last loss of the parameter. `None` without a rule, and before the reference is known.
    pub loss: Option<&'h LossDisplay>,
    pub trail: &'h Trail,
}

/// State of a node, and its recent traffic.
#[derive(Debug, Clone, Default)]
pub struct NodeHeard {
    /// Recent messages, oldest first. Never empty.
    lately: VecDeque<NodeDisplay>,
}

/// Origin of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// From sensors, or from a live simulation.
    Measured,
    /// From a record or a simulation with its own times.
    Replayed,
    /// From the recording, replayed after a restart.
    ReadAgain,
}

impl Origin {
    /// Returns the origin of the last value of a structure.
    pub fn of(structure: &StructureState) -> Self {
        if structure.is_from_the_recording() {
            Self::ReadAgain
        } else if structure.is_replayed() {
            Self::Replayed
        } else {
            Self::Measured
        }
    }
}

impl Heard {
    /// Processes one input and appends the resulting changes of alerts to `changes`.
    pub fn handle(&mut self, input: Input, changes: &mut Vec<Change>) {
        match input {
            Input::Parameter(display) => self.take_parameter(display),
            Input::Node(display) => self.take_node(display),
            Input::Judgement(display) => self.take_judgement(display, changes),
            Input::Event(event) => self.take_event(event),
            input => {
                let mut all = Vec::new();
                self.structures.handle(input, &mut all);
                // A normal state is not a change if the alert was unknown.
                let is_news = |change: &AlertChange| {
                    change.was_known || change.alert.state != AlertState::Normal
                };
                let news = all.iter().filter(|change| is_news(change));
                changes.extend(news.map(|change| OpenAlert::Rule(&change.alert).change()));
            }
        }
    }

    fn take_judgement(&mut self, display: JudgementDisplay, changes: &mut Vec<Change>) {
        let state = self.structure(&display.structure);
        let before = state.and_then(|state| state.judgements.get(&display.quantity));
        changes.extend(Change::of_judgement(before, &display));
        let input = Input::Judgement(display);
        self.structures.handle(input, &mut Vec::new());
    }

    fn take_parameter(&mut self, display: ParameterDisplay) {
        let (structure, name) = (display.structure.clone(), display.parameter.clone());
        let (time_ns, mean) = (display.time_ns, display.mean);
        let input = Input::Parameter(display);
        self.structures.handle(input, &mut Vec::new());
        let state = self.structures.structure(&structure);
        if state.is_some_and(|state| state.parameters.contains_key(&name)) {
            let trails = self.trails.entry(structure).or_default();
            trails.entry(name).or_default().push(time_ns, mean);
        }
    }

    fn take_node(&mut self, display: NodeDisplay) {
        let structure = display.structure.clone();
        let input = Input::Node(display.clone());
        self.structures.handle(input, &mut Vec::new());
        let state = self.structures.structure(&structure);
        if state.is_some_and(|state| state.nodes.contains_key(&display.node)) {
            let nodes = self.nodes.entry(structure).or_default();
            let node = nodes.entry(display.node.clone()).or_default();
            node.take(display);
        }
    }

    /// Stores an event. For kinds that recur in normal operation, it keeps only the latest, so that
    /// a failed sensor stays visible.
    fn take_event(&mut self, event: Event) {
        if matches!(event.kind, EventKind::LeadingClass | EventKind::Calibration) {
            let is_outdone = |kept: &Event| {
                (&kept.structure, kept.kind, &kept.subject)
                    == (&event.structure, event.kind, &event.subject)
            };
            self.events.retain(|kept| !is_outdone(kept));
        }
        self.events.push_front(event);
        self.events.truncate(EVENTS_KEPT);
    }

    /// Returns the known structures, in the natural order of their names.
    pub fn structures(&self) -> impl ExactSizeIterator<Item = (&Name, &StructureState)> {
        in_order(self.structures.structures()).into_iter()
    }

    /// Returns one structure.
    pub fn structure(&self, name: &Name) -> Option<&StructureState> {
        self.structures.structure(name)
    }

    /// Returns the parameters of a structure, in the natural order of their names.
    pub fn parameters(&self, structure: &Name) -> Vec<ParameterHeard<'_>> {
        let of_structure = (self.structure(structure), self.trails.get(structure));
        let (Some(state), Some(trails)) = of_structure else {
            return Vec::new();
        };
        let heard = |(name, display)| {
            Some(ParameterHeard {
                display,
                loss: state.losses.get(name),
                trail: trails.get(name)?,
            })
        };
        let parameters = in_order(&state.parameters).into_iter();
        parameters.filter_map(heard).collect()
    }

    /// Returns the distributed nodes of a structure, in the natural order of their names.
    pub fn nodes(&self, structure: &Name) -> impl Iterator<Item = &NodeHeard> {
        let nodes = in_order(self.nodes.get(structure).into_iter().flatten());
        nodes.into_iter().map(|(_, node)| node)
    }

    /// Returns the last events, newest first.
    pub fn events(&self) -> impl ExactSizeIterator<Item = &Event> {
        self.events.iter()
    }

    /// Returns the alerts that are neither normal nor learning and the lasting losses, newest first.
    pub fn open_alerts(&self) -> Vec<OpenAlert<'_>> {
        let mut open = Vec::new();
        for (_, structure) in self.structures() {
            let alerts = in_order(&structure.alerts).into_iter();
            let alerts = alerts.map(|(_, alert)| OpenAlert::Rule(alert));
            open.extend(alerts.filter(|alert| is_open(alert.state())));
            let judgements = in_order(&structure.judgements).into_iter();
            open.extend(judgements.filter_map(|(_, display)| OpenAlert::lasting(display)));
        }
        open.sort_by_key(|alert| std::cmp::Reverse(alert.time_ns()));
        open
    }

    /// Returns an alert. `None` if it is not known, or if it is a lasting loss that is over.
    pub fn alert(&self, id: &AlertId) -> Option<OpenAlert<'_>> {
        let structure = self.structure(&id.structure)?;
        match id.kind {
            AlertKind::Rule => structure.alerts.get(&id.part).map(OpenAlert::Rule),
            AlertKind::LastingLoss => {
                let display = structure.judgements.get(&id.part);
                display.and_then(OpenAlert::lasting)
            }
        }
    }

    /// Returns `true` if the service of an alert has disappeared and no other service has confirmed
    /// the alert.
    pub fn is_stale(&self, alert: OpenAlert<'_>) -> bool {
        let Some(structure) = self.structure(alert.structure()) else {
            return false;
        };
        match alert {
            OpenAlert::Rule(alert) => structure.is_alert_stale(&alert.parameter),
            OpenAlert::Lasting(..) => {
                let mut seen = structure.seen.iter();
                let was_there = seen.any(|(service, _)| *service == Service::Judge);
                was_there && !structure.has(Service::Judge)
            }
        }
    }

    /// Returns the time of the last [`Input::Now`].
    pub fn now(&self) -> Duration {
        self.structures.now()
    }

    /// Returns the number of dropped messages. They had a wrong key, or there was no room.
    pub fn left_out(&self) -> u64 {
        self.structures.left_out()
    }
}

impl NodeHeard {
    fn take(&mut self, display: NodeDisplay) {
        // A restarted station counts from zero, and its clock may have been set.
        let goes_on = |last: &NodeDisplay| {
            last.time_ns < display.time_ns
                && last.bytes_received <= display.bytes_received
                && last.bytes_sent <= display.bytes_sent
        };
        if self.lately.back().is_some_and(|last| !goes_on(last)) {
            self.lately.clear();
        }
        if self.lately.len() > TRAFFIC_OVER {
            self.lately.pop_front();
        }
        self.lately.push_back(display);
    }

    /// Returns the latest state.
    pub fn display(&self) -> &NodeDisplay {
        &self.lately[self.lately.len() - 1]
    }

    /// Returns the recent payload per second from the node to the station and back, or `None` after
    /// a single message.
    pub fn bytes_per_s(&self) -> Option<(f64, f64)> {
        let (first, last) = (self.lately.front()?, self.lately.back()?);
        let seconds = last.time_ns.saturating_sub(first.time_ns) as f64 * 1e-9;
        let rate = |first: u64, last: u64| last.saturating_sub(first) as f64 / seconds;
        (seconds > 0.0).then(|| {
            (
                rate(first.bytes_received, last.bytes_received),
                rate(first.bytes_sent, last.bytes_sent),
            )
        })
    }
}

/// Returns `true` if an alert in this state needs attention.
fn is_open(state: AlertState) -> bool {
    match state {
        AlertState::Pending
        | AlertState::Raised
        | AlertState::Unconfirmed
        | AlertState::Acknowledged
        | AlertState::Cleared
        | AlertState::SofteningInMotion
        | AlertState::Undecided => true,
        AlertState::Learning | AlertState::Normal => false,
    }
}

#[cfg(test)]
mod tests;
