//! State of the view from the messages on the bus.

use super::natural_name::NaturalName;
use super::trail::Trail;
use spandrel_bus::{
    AlertMessage, AlertState, Arrivals, Event, EventKind, FitDisplay, LossDisplay, MAX_CHANNELS,
    ModelClassDisplay, Name, NodeDisplay, NoiseDisplay, Pace, ParameterDisplay, Progress, Service,
    Status, is_without_date, pace_told,
};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Maximum number of structures. Messages of further structures are counted and dropped.
const MOST_STRUCTURES: usize = 256;
/// Maximum number of service instances and sensor nodes of one structure.
const MOST_INSTANCES: usize = MAX_CHANNELS;
/// Maximum number of events of all structures together. A further event replaces the oldest.
const EVENTS_KEPT: usize = 100;
/// Number of messages of a node over which its traffic is averaged.
const TRAFFIC_OVER: usize = 10;
/// Silence after which data is stale. Display topics are published at 10 Hz, the status at 1 Hz.
const STALE_AFTER: Duration = Duration::from_secs(3);

/// An input of the state.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// Time since a fixed moment. Later inputs are received at this time.
    Now(Duration),
    Parameter(ParameterDisplay),
    Loss(LossDisplay),
    Noise(NoiseDisplay),
    Classes(ModelClassDisplay),
    Node(NodeDisplay),
    Fit(FitDisplay),
    /// The alert of a parameter has changed.
    Alert(AlertMessage),
    /// The state of an alert in reply to a query.
    StandingAlert(AlertMessage),
    Event(Event),
    Status(Status),
    /// Progress of ingest of a structure.
    Ingested(Name, Progress),
    /// All instances that are present.
    Present(BTreeSet<Instance>),
    /// A message whose content contradicts its key.
    Misplaced,
}

/// One instance of a service, or one sensor node, of a structure.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Instance {
    pub structure: Name,
    pub service: Service,
    pub id: Name,
}

/// State from all messages so far.
#[derive(Debug, Clone, Default)]
pub struct Heard {
    now: Duration,
    structures: BTreeMap<NaturalName, StructureHeard>,
    /// Events, newest first.
    events: VecDeque<Event>,
    left_out: u64,
}

/// State of one structure.
#[derive(Debug, Clone, Default)]
pub struct StructureHeard {
    pub parameters: BTreeMap<NaturalName, ParameterHeard>,
    /// Losses of the parameters with a rule, once their reference is known.
    pub losses: BTreeMap<NaturalName, LossDisplay>,
    pub noise: BTreeMap<NaturalName, NoiseDisplay>,
    /// State of the model classes. `None` if there is a single model or no message has arrived.
    pub classes: Option<ModelClassDisplay>,
    /// Verdict on the fit. `None` before the first message, and if no service judges it.
    pub fit: Option<FitDisplay>,
    /// Distributed nodes, as their station reports them.
    pub nodes: BTreeMap<NaturalName, NodeHeard>,
    pub alerts: BTreeMap<NaturalName, AlertMessage>,
    /// Alerts whose service has disappeared, and which no other service has confirmed yet.
    stale_alerts: BTreeSet<NaturalName>,
    pub instances: BTreeMap<(Service, Name), InstanceHeard>,
    /// Measurement time of the newest value (ns).
    pub time_ns: Option<i64>,
    arrivals: Arrivals,
}

/// Last value of a parameter, and its recent values.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterHeard {
    pub display: ParameterDisplay,
    pub trail: Trail,
}

/// State of a node, and its recent traffic.
#[derive(Debug, Clone, PartialEq)]
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

/// Presence and last status of an instance.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InstanceHeard {
    pub is_present: bool,
    pub status: Option<Status>,
    status_heard: Duration,
}

impl Heard {
    /// Processes one input and appends the resulting changes of alerts to `changes`.
    pub fn handle(&mut self, input: Input, changes: &mut Vec<AlertMessage>) {
        match input {
            Input::Now(now) => self.now = now,
            Input::Parameter(display) => self.take_parameter(display),
            Input::Loss(display) => self.take_loss(display),
            Input::Noise(display) => self.take_noise(display),
            Input::Alert(alert) => self.take_alert(alert, changes),
            Input::StandingAlert(alert) => {
                // A change received by subscription is at least as new, unless it comes from an
                // earlier run.
                let known = self
                    .structure(&alert.structure)
                    .and_then(|structure| structure.alert(&alert.parameter));
                if known.is_none_or(|known| known.time_ns < alert.time_ns || self.is_stale(known)) {
                    self.take_alert(alert, changes);
                }
            }
            Input::Classes(display) => {
                if let Some(structure) = self.structure_mut(&display.structure) {
                    structure.classes = Some(display);
                }
            }
            Input::Fit(display) => {
                if let Some(structure) = self.structure_mut(&display.structure) {
                    structure.fit = Some(display);
                }
            }
            Input::Node(display) => self.take_node(display),
            Input::Event(event) => self.take_event(event),
            Input::Status(status) => self.take_status(status),
            Input::Ingested(structure, progress) => {
                if let Some(structure) = self.structure_mut(&structure) {
                    structure
                        .arrivals
                        .ingested(progress.header.epoch, progress.header.time_ns);
                }
            }
            Input::Present(instances) => self.take_present(&instances),
            Input::Misplaced => self.left_out += 1,
        }
    }

    fn take_parameter(&mut self, display: ParameterDisplay) {
        let (now, time_ns) = (self.now, display.time_ns);
        let Some(structure) = self.structure_mut(&display.structure) else {
            return;
        };
        let name = NaturalName(display.parameter.clone());
        if !has_room(&structure.parameters, &name, MAX_CHANNELS) {
            self.left_out += 1;
            return;
        }
        structure.arrivals.value(time_ns, now);
        structure.time_ns = Some(time_ns);
        let mean = display.mean;
        let heard = match structure.parameters.entry(name) {
            std::collections::btree_map::Entry::Vacant(entry) => entry.insert(ParameterHeard {
                display,
                trail: Trail::default(),
            }),
            std::collections::btree_map::Entry::Occupied(entry) => {
                let heard = entry.into_mut();
                heard.display = display;
                heard
            }
        };
        heard.trail.push(time_ns, mean);
    }

    fn take_loss(&mut self, display: LossDisplay) {
        let Some(structure) = self.structure_mut(&display.structure) else {
            return;
        };
        let name = NaturalName(display.parameter.clone());
        if !has_room(&structure.losses, &name, MAX_CHANNELS) {
            self.left_out += 1;
            return;
        }
        structure.losses.insert(name, display);
    }

    fn take_node(&mut self, display: NodeDisplay) {
        let Some(structure) = self.structure_mut(&display.structure) else {
            return;
        };
        let name = NaturalName(display.node.clone());
        if !has_room(&structure.nodes, &name, MOST_INSTANCES) {
            self.left_out += 1;
            return;
        }
        structure
            .nodes
            .entry(name)
            .or_insert_with(|| NodeHeard {
                lately: VecDeque::new(),
            })
            .take(display);
    }

    fn take_noise(&mut self, display: NoiseDisplay) {
        let now = self.now;
        let Some(structure) = self.structure_mut(&display.structure) else {
            return;
        };
        let name = NaturalName(display.name.clone());
        if !has_room(&structure.noise, &name, MAX_CHANNELS) {
            self.left_out += 1;
            return;
        }
        structure.arrivals.value(display.time_ns, now);
        structure.time_ns = structure.time_ns.max(Some(display.time_ns));
        structure.noise.insert(name, display);
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

    fn take_alert(&mut self, alert: AlertMessage, changes: &mut Vec<AlertMessage>) {
        let Some(structure) = self.structure_mut(&alert.structure) else {
            return;
        };
        let name = NaturalName(alert.parameter.clone());
        if !has_room(&structure.alerts, &name, MAX_CHANNELS) {
            self.left_out += 1;
            return;
        }
        structure.stale_alerts.remove(&name);
        let known = structure.alerts.get(&name);
        if known != Some(&alert) {
            // A normal state is not a change if the alert was unknown.
            if known.is_some() || alert.state != AlertState::Normal {
                changes.push(alert.clone());
            }
            structure.alerts.insert(name, alert);
        }
    }

    fn take_status(&mut self, status: Status) {
        let now = self.now;
        let service = Service::from_name(status.service.as_str());
        let Some(service) = service else {
            self.left_out += 1;
            return;
        };
        let Some(structure) = self.structure_mut(&status.structure) else {
            return;
        };
        let key = (service, status.id.clone());
        if !has_room(&structure.instances, &key, MOST_INSTANCES) {
            self.left_out += 1;
            return;
        }
        let heard = structure.instances.entry(key).or_default();
        heard.status = Some(status);
        heard.status_heard = now;
    }

    fn take_present(&mut self, present: &BTreeSet<Instance>) {
        let [had_alert_service, had_ingest] = [Service::Alert, Service::Ingest].map(|service| {
            let had = self
                .structures
                .iter()
                .filter(|(_, structure)| structure.has(service));
            had.map(|(name, _)| name.clone())
                .collect::<Vec<NaturalName>>()
        });
        for structure in self.structures.values_mut() {
            structure
                .instances
                .values_mut()
                .for_each(|instance| instance.is_present = false);
        }
        for instance in present {
            let key = (instance.service, instance.id.clone());
            match self.structure_mut(&instance.structure) {
                Some(structure) if has_room(&structure.instances, &key, MOST_INSTANCES) => {
                    structure.instances.entry(key).or_default().is_present = true;
                }
                Some(_) => self.left_out += 1,
                None => {}
            }
        }
        for name in had_alert_service {
            if let Some(structure) = self
                .structures
                .get_mut(&name)
                .filter(|structure| !structure.has(Service::Alert))
            {
                structure.stale_alerts = structure.alerts.keys().cloned().collect();
            }
        }
        for name in had_ingest {
            if let Some(structure) = self
                .structures
                .get_mut(&name)
                .filter(|structure| !structure.has(Service::Ingest))
            {
                structure.arrivals.ingest_left();
            }
        }
        for structure in self.structures.values_mut() {
            // Removes instances that disappeared without ever publishing a status.
            structure
                .instances
                .retain(|_, instance| instance.is_present || instance.status.is_some());
        }
        self.structures
            .retain(|_, structure| !structure.is_silent());
    }

    /// Returns the structure, which is created if there is room. Counts dropped messages.
    fn structure_mut(&mut self, name: &Name) -> Option<&mut StructureHeard> {
        let key = NaturalName(name.clone());
        if !has_room(&self.structures, &key, MOST_STRUCTURES) {
            self.left_out += 1;
            return None;
        }
        Some(self.structures.entry(key).or_default())
    }

    /// Returns the known structures, in the order of their names.
    pub fn structures(&self) -> impl ExactSizeIterator<Item = (&Name, &StructureHeard)> {
        self.structures
            .iter()
            .map(|(name, structure)| (&name.0, structure))
    }

    /// Returns one structure.
    pub fn structure(&self, name: &Name) -> Option<&StructureHeard> {
        self.structures.get(&NaturalName(name.clone()))
    }

    /// Returns the last events, newest first.
    pub fn events(&self) -> impl ExactSizeIterator<Item = &Event> {
        self.events.iter()
    }

    /// Returns the alerts that are neither normal nor learning, newest first.
    pub fn open_alerts(&self) -> Vec<&AlertMessage> {
        let all = self
            .structures
            .values()
            .flat_map(|structure| structure.alerts.values());
        let mut open: Vec<&AlertMessage> = all.filter(|alert| is_open(alert.state)).collect();
        open.sort_by_key(|alert| std::cmp::Reverse(alert.time_ns));
        open
    }

    /// Returns `true` if the service of an alert has disappeared and no other service has confirmed
    /// the alert.
    pub fn is_stale(&self, alert: &AlertMessage) -> bool {
        self.structure(&alert.structure)
            .is_some_and(|structure| structure.is_stale(&alert.parameter))
    }

    /// Returns the time since the last live data, if the data is stale.
    ///
    /// Returns `None` also before the first live value. Values replayed from the recording do not
    /// count.
    pub fn silence_of_data(&self, structure: &StructureHeard) -> Option<Duration> {
        self.silence_since(structure.arrivals.heard()?)
    }

    /// Returns the time since the last status of a service, if the status is stale. Returns `None`
    /// also without any status.
    pub fn silence_of_status(&self, instance: &InstanceHeard) -> Option<Duration> {
        instance.status.as_ref()?;
        self.silence_since(instance.status_heard)
    }

    fn silence_since(&self, heard: Duration) -> Option<Duration> {
        let silence = self.now.saturating_sub(heard);
        (silence > STALE_AFTER).then_some(silence)
    }

    /// Returns the time of the last [`Input::Now`].
    pub fn now(&self) -> Duration {
        self.now
    }

    /// Returns the number of dropped messages. They had a wrong key, or there was no room.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }
}

impl StructureHeard {
    /// Returns `true` if no instance is present and no data has ever arrived.
    fn is_silent(&self) -> bool {
        let Self {
            parameters,
            noise,
            alerts,
            nodes,
            instances,
            ..
        } = self;
        parameters.is_empty()
            && noise.is_empty()
            && alerts.is_empty()
            && nodes.is_empty()
            && instances.is_empty()
    }

    fn has(&self, service: Service) -> bool {
        self.instances
            .iter()
            .any(|((one, _), instance)| *one == service && instance.is_present)
    }

    /// Returns the origin of the last value.
    pub fn origin(&self) -> Origin {
        if self.arrivals.is_from_the_recording() {
            Origin::ReadAgain
        } else if self.is_replayed() {
            Origin::Replayed
        } else {
            Origin::Measured
        }
    }

    /// Returns `true` if the service of a parameter's alert has disappeared and no other service
    /// has confirmed the alert.
    pub fn is_stale(&self, parameter: &Name) -> bool {
        self.stale_alerts.contains(&NaturalName(parameter.clone()))
    }

    /// Returns `true` if the data comes from a record or a simulation, whose times are independent
    /// of the wall clock.
    pub fn is_replayed(&self) -> bool {
        let Some(time_ns) = self.time_ns else {
            return false;
        };
        is_without_date(time_ns) || self.pace() == Some(Pace::Replayed)
    }

    /// Returns `true` if a lag behind the wall clock is meaningful, because the samples are known
    /// to be live.
    pub fn has_lag(&self) -> bool {
        self.pace() == Some(Pace::Live) && !self.is_replayed()
    }

    fn pace(&self) -> Option<Pace> {
        pace_told(
            self.instances
                .values()
                .filter_map(|instance| instance.status.as_ref()),
        )
    }

    /// Returns the loss of an alert's parameter by its newest value, if that is newer than the alert.
    pub fn present_loss(&self, alert: &AlertMessage) -> Option<String> {
        let name = NaturalName(alert.parameter.clone());
        self.losses.get(&name)?.since(alert)
    }

    /// Returns the alert of a parameter.
    pub fn alert(&self, parameter: &Name) -> Option<&AlertMessage> {
        self.alerts.get(&NaturalName(parameter.clone()))
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

fn has_room<K: Ord, V>(map: &BTreeMap<K, V>, key: &K, most: usize) -> bool {
    map.len() < most || map.contains_key(key)
}

/// Returns `true` if an alert in this state needs attention.
fn is_open(state: AlertState) -> bool {
    match state {
        AlertState::Pending
        | AlertState::Raised
        | AlertState::Unconfirmed
        | AlertState::Acknowledged
        | AlertState::Cleared
        | AlertState::Undecided => true,
        AlertState::Learning | AlertState::Normal => false,
    }
}

#[cfg(test)]
mod tests;
