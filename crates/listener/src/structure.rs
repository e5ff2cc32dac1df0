//! The present state of one structure.

use crate::input::{Input, Instance};
use spandrel_bus::{
    AlertMessage, Arrivals, ConditionDisplay, FitDisplay, JudgementDisplay, LossDisplay,
    MAX_CHANNELS, ModeDisplay, ModelClassDisplay, MonitoringDisplay, MonitoringState, Name,
    NodeDisplay, NoiseDisplay, OutlierDisplay, Pace, ParameterDisplay, ParameterMonitoring,
    SensorHealthDisplay, Service, Status, is_without_date, reported_pace,
};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Silence after which data is stale. Display topics are published at 10 Hz, the status at 1 Hz.
pub const STALE_AFTER: Duration = Duration::from_secs(3);

/// Reason of a parameter without new data that no service reports as blind.
const NO_NEW_DATA: &str = "no new data arrive";

/// The present state of one structure: the newest message of each kind, and its age.
///
/// Each map has room for [`MAX_CHANNELS`] names. Messages with further names are counted and
/// dropped.
#[derive(Clone, Debug, Default)]
pub struct StructureState {
    /// Estimates of the parameters.
    pub parameters: BTreeMap<Name, ParameterDisplay>,
    /// Losses of the parameters with a rule, once their reference is known. They are removed when
    /// the alert service disappears, or publishes none for [`STALE_AFTER`] while estimates arrive.
    pub losses: BTreeMap<Name, LossDisplay>,
    /// Estimates of the noise levels.
    pub noise: BTreeMap<Name, NoiseDisplay>,
    /// Outliers of the channels.
    pub outliers: BTreeMap<Name, OutlierDisplay>,
    /// Comparison of the sensors of each node with the others.
    pub sensor_health: BTreeMap<Name, SensorHealthDisplay>,
    /// Latest values of the conditions.
    pub conditions: BTreeMap<Name, ConditionState>,
    /// Last judgement of each quantity.
    pub judgements: BTreeMap<Name, JudgementDisplay>,
    /// Last message of each declared mode.
    pub modes: BTreeMap<Name, ModeDisplay>,
    /// State of the model classes. `None` if there is a single model or no message has arrived.
    pub classes: Option<ModelClassDisplay>,
    /// Verdict on the fit. `None` before the first message, and if no service judges it.
    pub fit: Option<FitDisplay>,
    /// Distributed nodes, as their station reports them.
    pub nodes: BTreeMap<Name, NodeDisplay>,
    /// Alerts of the parameters.
    pub alerts: BTreeMap<Name, AlertMessage>,
    /// Services and nodes that are present or have published a status.
    pub instances: BTreeMap<(Service, Name), InstanceState>,
    /// Services and nodes that have ever been present.
    pub seen: BTreeSet<(Service, Name)>,
    /// Measurement time of the newest value, ns since the Unix epoch, UTC.
    pub time_ns: Option<i64>,
    /// Number of messages that were dropped, because a map was full or the key of the message was
    /// wrong.
    pub left_out: u64,
    /// Alerts whose service has disappeared, and which no other service has confirmed yet.
    stale_alerts: BTreeSet<Name>,
    /// Last report on the monitoring, and its arrival time.
    monitoring: Option<(MonitoringDisplay, Duration)>,
    /// Arrival time of each loss.
    losses_at: BTreeMap<Name, Duration>,
    arrivals: Arrivals,
    now: Duration,
}

/// Presence and last status of a service or node.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct InstanceState {
    /// Whether the liveliness token of the service or node exists.
    pub is_present: bool,
    /// Last status of the service or node. `None` before the first status.
    pub status: Option<Status>,
    /// Arrival time of the last status, as in [`StructureState::now`]. Zero before the first
    /// status.
    pub status_at: Duration,
}

/// Latest value of a condition.
#[derive(Clone, Debug, PartialEq)]
pub struct ConditionState {
    /// The newest message of the condition, with its value, unit and measurement time.
    pub display: ConditionDisplay,
    /// Arrival time.
    at: Duration,
    /// Age at the arrival. It is zero unless the value was queried.
    age: Duration,
}

impl ConditionState {
    /// Number of expected intervals without a value after which a condition is stale. A value may
    /// arrive a little later than its interval.
    const STALE_AFTER_INTERVALS: f64 = 2.0;

    /// Returns the age of the value at the time `now`, as returned by [`StructureState::now`].
    #[must_use]
    pub fn age(&self, now: Duration) -> Duration {
        self.age.saturating_add(now.saturating_sub(self.at))
    }

    /// Returns `true` if a value is overdue at the time `now`, as returned by
    /// [`StructureState::now`]. Without a stated interval, no value is overdue.
    #[must_use]
    pub fn is_stale(&self, now: Duration) -> bool {
        let interval_s = self.display.interval_s;
        interval_s.is_some_and(|interval_s| {
            self.age(now).as_secs_f64() > Self::STALE_AFTER_INTERVALS * interval_s
        })
    }
}

/// A new state of an alert.
#[derive(Clone, Debug, PartialEq)]
pub struct AlertChange {
    /// State of the alert after the change.
    pub alert: AlertMessage,
    /// Whether an earlier state of the alert was known.
    pub was_known: bool,
}

impl StructureState {
    /// Processes one input of this structure, and appends the resulting changes of alerts to
    /// `changes`.
    pub fn handle(&mut self, input: Input, changes: &mut Vec<AlertChange>) {
        let left_out = &mut self.left_out;
        match input {
            Input::Now(now) => self.now = now,
            Input::Parameter(display) => {
                let time_ns = display.time_ns;
                let name = display.parameter.clone();
                let loss_at = self.losses_at.get(&name);
                if loss_at.is_some_and(|at| self.now.saturating_sub(*at) > STALE_AFTER) {
                    self.losses.remove(&name);
                    self.losses_at.remove(&name);
                }
                let is_kept = keep(&mut self.parameters, name, display, left_out);
                // `modes` repeats the estimates of its last epoch, also while no frame arrives.
                if is_kept && !self.has_only_modes() {
                    self.arrivals.value(time_ns, self.now);
                    self.time_ns = Some(time_ns);
                }
            }
            Input::Loss(display) => {
                let name = display.parameter.clone();
                if keep(&mut self.losses, name.clone(), display, left_out) {
                    self.losses_at.insert(name, self.now);
                }
            }
            Input::Noise(display) => {
                let time_ns = display.time_ns;
                if keep(&mut self.noise, display.name.clone(), display, left_out) {
                    self.arrivals.value(time_ns, self.now);
                    // A noise level may be one step behind the parameters.
                    let is_newest = self.parameters.is_empty() || self.time_ns < Some(time_ns);
                    self.time_ns = if is_newest {
                        Some(time_ns)
                    } else {
                        self.time_ns
                    };
                }
            }
            Input::Outlier(display) => {
                let name = display.channel.clone();
                keep(&mut self.outliers, name, display, left_out);
            }
            Input::SensorHealth(display) => {
                keep(
                    &mut self.sensor_health,
                    display.node.clone(),
                    display,
                    left_out,
                );
            }
            Input::Condition(display) => self.take_condition(display, Duration::ZERO),
            Input::StandingCondition(display, age) => {
                let known = self.conditions.get(&display.name);
                if known.is_none_or(|known| known.display.time_ns < display.time_ns) {
                    self.take_condition(display, age);
                }
            }
            Input::Judgement(display) => {
                let name = display.quantity.clone();
                keep(&mut self.judgements, name, display, left_out);
            }
            Input::Mode(display) => {
                keep(&mut self.modes, display.mode.clone(), *display, left_out);
            }
            Input::Classes(display) => self.classes = Some(display),
            Input::Node(display) => {
                keep(&mut self.nodes, display.node.clone(), display, left_out);
            }
            Input::Fit(display) => self.fit = Some(display),
            Input::Monitoring(display) => self.monitoring = Some((display, self.now)),
            Input::Alert(alert) => self.take_alert(alert, changes),
            Input::StandingAlert(alert) => {
                // A change received by subscription is at least as new, unless it comes from an
                // earlier run.
                let name = &alert.parameter;
                let is_known = self.alerts.get(name).is_some_and(|known| {
                    known.time_ns >= alert.time_ns && !self.stale_alerts.contains(name)
                });
                if !is_known {
                    self.take_alert(alert, changes);
                }
            }
            Input::Status(status) => self.take_status(status),
            Input::Ingested(_, progress) => {
                let header = progress.header;
                self.arrivals.ingested(header.epoch, header.time_ns);
                // Progress is repeated, and has no time before the first frame.
                let is_new = header.time_ns > i64::MIN && self.time_ns != Some(header.time_ns);
                if self.has_only_modes() && is_new {
                    self.arrivals.value(header.time_ns, self.now);
                    self.time_ns = Some(header.time_ns);
                }
            }
            Input::Present(present) => self.take_present(present),
            Input::Misplaced => self.left_out += 1,
            // They concern the past or single frames.
            Input::Waveform(_)
            | Input::Spectrum(_)
            | Input::Estimates(..)
            | Input::LoggedAlert(_)
            | Input::Acknowledgement(_)
            | Input::Event(_)
            | Input::Past(_)
            | Input::LastingLosses(_) => {}
        }
    }

    fn take_condition(&mut self, display: ConditionDisplay, age: Duration) {
        let (name, at) = (display.name.clone(), self.now);
        let state = ConditionState { display, at, age };
        keep(&mut self.conditions, name, state, &mut self.left_out);
    }

    fn take_alert(&mut self, alert: AlertMessage, changes: &mut Vec<AlertChange>) {
        let name = alert.parameter.clone();
        let known = self.alerts.get(&name);
        let (was_known, is_news) = (known.is_some(), known != Some(&alert));
        self.stale_alerts.remove(&name);
        let is_kept = keep(&mut self.alerts, name, alert.clone(), &mut self.left_out);
        if is_kept && is_news {
            changes.push(AlertChange { alert, was_known });
        }
    }

    fn take_status(&mut self, status: Status) {
        let now = self.now;
        let service = Service::from_name(status.service.as_str());
        let key = service.map(|service| (service, status.id.clone()));
        match key.and_then(|key| self.instance_mut(key)) {
            Some(instance) => (instance.status, instance.status_at) = (Some(status), now),
            None => self.left_out += 1,
        }
    }

    fn take_present(&mut self, present: BTreeSet<Instance>) {
        let [had_alert, had_ingest] =
            [Service::Alert, Service::Ingest].map(|service| self.has(service));
        let all = self.instances.values_mut();
        all.for_each(|instance| instance.is_present = false);
        for Instance { service, id, .. } in present {
            let key = (service, id);
            match self.instance_mut(key.clone()) {
                Some(instance) => instance.is_present = true,
                None => self.left_out += 1,
            }
            if self.seen.len() < MAX_CHANNELS {
                self.seen.insert(key);
            }
        }
        // Removes instances that disappeared without ever publishing a status.
        self.instances
            .retain(|_, instance| instance.is_present || instance.status.is_some());
        if had_alert && !self.has(Service::Alert) {
            self.stale_alerts = self.alerts.keys().cloned().collect();
            self.losses.clear();
            self.losses_at.clear();
            self.monitoring = None;
        }
        if had_ingest && !self.has(Service::Ingest) {
            self.arrivals.ingest_left();
        }
    }

    /// Returns the instance, which is created if there is room.
    fn instance_mut(&mut self, key: (Service, Name)) -> Option<&mut InstanceState> {
        let has_room = self.instances.len() < MAX_CHANNELS || self.instances.contains_key(&key);
        has_room.then(|| self.instances.entry(key).or_default())
    }

    /// Returns `true` if no instance is present and no data has ever arrived.
    pub(crate) fn is_silent(&self) -> bool {
        self.parameters.is_empty()
            && self.noise.is_empty()
            && self.alerts.is_empty()
            && self.nodes.is_empty()
            && self.conditions.is_empty()
            && self.modes.is_empty()
            && self.judgements.is_empty()
            && self.instances.is_empty()
    }

    /// Returns `true` if no filter identifies the structure, so that only its natural frequencies
    /// are tracked. They may also update parameters.
    ///
    /// This is the case if a `modes` service has been present, and neither `identify` nor `fuse`.
    /// Frames are then the sign that data arrives, because an epoch has an estimate only at its
    /// end.
    #[must_use]
    pub fn has_only_modes(&self) -> bool {
        let is_seen = |wanted: Service| self.seen.iter().any(|(seen, _)| *seen == wanted);
        is_seen(Service::Modes) && !is_seen(Service::Identify) && !is_seen(Service::Fuse)
    }

    /// Returns the services and nodes that are present.
    pub fn present(&self) -> impl Iterator<Item = &(Service, Name)> {
        let present = self.instances.iter();
        present.filter_map(|(key, instance)| instance.is_present.then_some(key))
    }

    /// Returns `true` if this instance is present.
    #[must_use]
    pub fn is_present(&self, service: Service, id: &Name) -> bool {
        let instance = self.instances.get(&(service, id.clone()));
        instance.is_some_and(|instance| instance.is_present)
    }

    /// Returns `true` if an instance of a service is present.
    #[must_use]
    pub fn has(&self, service: Service) -> bool {
        self.present().any(|(present, _)| *present == service)
    }

    /// Returns the statuses of all instances.
    pub fn statuses(&self) -> impl Iterator<Item = (&(Service, Name), &Status)> {
        let instances = self.instances.iter();
        instances.filter_map(|(key, instance)| Some((key, instance.status.as_ref()?)))
    }

    /// Returns the time of the last [`Input::Now`].
    #[must_use]
    pub fn now(&self) -> Duration {
        self.now
    }

    /// Returns the time since a parameter or noise level last arrived live, or `None` before the
    /// first. For a structure with [modes only](Self::has_only_modes), frames count.
    ///
    /// Values replayed from the recording do not count.
    #[must_use]
    pub fn silence(&self) -> Option<Duration> {
        Some(self.now.saturating_sub(self.arrivals.heard()?))
    }

    /// Returns [`Self::silence`] if it exceeds [`STALE_AFTER`], and otherwise `None`.
    #[must_use]
    pub fn stale_for(&self) -> Option<Duration> {
        self.silence().filter(|silence| *silence > STALE_AFTER)
    }

    /// Returns the last report on whether the present data reveal damage.
    ///
    /// Returns `None` if the alert service, which publishes a report each second, has not published
    /// one for [`STALE_AFTER`].
    #[must_use]
    pub fn monitoring(&self) -> Option<&MonitoringDisplay> {
        let (display, at) = self.monitoring.as_ref()?;
        (self.now.saturating_sub(*at) <= STALE_AFTER).then_some(display)
    }

    /// Returns the report on a parameter if the present data do not reveal its damage.
    ///
    /// No parameter of a blind structure is watched, whatever the report on the parameter states.
    /// Without new data, none is watched even if nothing reports it.
    #[must_use]
    pub fn unwatched(&self, parameter: &Name) -> Option<ParameterMonitoring> {
        let display = self.monitoring();
        let mut parameters = display.into_iter().flat_map(|display| &display.parameters);
        let is_it = |of: &&ParameterMonitoring| {
            of.parameter == *parameter && of.state != MonitoringState::Watching
        };
        let of_it = parameters.find(is_it);
        let blind = display.filter(|display| display.state == MonitoringState::Blind);
        let why = match blind {
            Some(display) => display.reasons.first().cloned(),
            None if self.stale_for().is_some() => Some(NO_NEW_DATA.to_owned()),
            None => return of_it.cloned(),
        };
        let why = of_it.and_then(|of_it| of_it.why.clone()).or(why);
        Some(ParameterMonitoring {
            parameter: parameter.clone(),
            state: MonitoringState::Blind,
            why,
            sustained_std: None,
        })
    }

    /// Returns the time since the last status of an instance, if it exceeds [`STALE_AFTER`].
    /// Returns `None` for a newer status, and without a status.
    #[must_use]
    pub fn status_stale_for(&self, instance: &InstanceState) -> Option<Duration> {
        instance.status.as_ref()?;
        let silence = self.now.saturating_sub(instance.status_at);
        (silence > STALE_AFTER).then_some(silence)
    }

    /// Returns `true` if the service of a parameter's alert has disappeared and no other service
    /// has confirmed the alert.
    #[must_use]
    pub fn is_alert_stale(&self, parameter: &Name) -> bool {
        self.stale_alerts.contains(parameter)
    }

    /// Returns `true` if a value measured at this time (ns since the Unix epoch, UTC) is not from
    /// the recording.
    #[must_use]
    pub fn is_live(&self, time_ns: i64) -> bool {
        self.arrivals.is_live(time_ns)
    }

    /// Returns `true` if the last parameter or noise level comes from the recording.
    #[must_use]
    pub fn is_from_the_recording(&self) -> bool {
        self.arrivals.is_from_the_recording()
    }

    /// Returns `true` if the data comes from a record or a simulation.
    ///
    /// Its times are independent of the wall clock, so a lag has no meaning.
    #[must_use]
    pub fn is_replayed(&self) -> bool {
        let Some(time_ns) = self.time_ns else {
            return false;
        };
        is_without_date(time_ns) || self.pace() == Some(Pace::Replayed)
    }

    /// Returns `true` if a lag behind the wall clock is meaningful, because the samples are known
    /// to be live.
    #[must_use]
    pub fn has_lag(&self) -> bool {
        self.pace() == Some(Pace::Live) && !self.is_replayed()
    }

    fn pace(&self) -> Option<Pace> {
        reported_pace(self.statuses().map(|(_, status)| status))
    }

    /// Returns the newest loss of an alert's parameter in words, if it is newer than the alert and
    /// belongs to the same rule.
    #[must_use]
    pub fn present_loss(&self, alert: &AlertMessage) -> Option<String> {
        self.losses.get(&alert.parameter)?.since(alert)
    }
}

/// Stores a value if there is room, and counts it otherwise. Returns `true` if it is stored.
fn keep<V>(map: &mut BTreeMap<Name, V>, name: Name, value: V, left_out: &mut u64) -> bool {
    let has_room = map.len() < MAX_CHANNELS || map.contains_key(&name);
    if has_room {
        map.insert(name, value);
    } else {
        *left_out += 1;
    }
    has_room
}
