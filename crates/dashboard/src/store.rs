//! Present state and bounded past of one structure, updated from messages, without clock or
//! network.

use crate::about::About;
use crate::innovations::{Innovations, Interval};
use crate::levels::Levels;
use crate::series::{Series, Table};
use crate::topic::{Kind, SeriesName};
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, ChannelState, ConditionDisplay, Event, EventKind,
    HistoryLog, LossChange, ModeDisplay, ModelClassDisplay, Name, Phase, SpectrumDisplay,
    WaveformDisplay,
};
use spandrel_listener::{AlertChange, Input, STALE_AFTER, StructureState};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Maximum number of changes of alerts. A further change replaces the oldest. The page states it.
const CHANGES_KEPT: usize = 500;
/// Maximum number of events. A further event replaces the oldest. The page states it.
const EVENTS_KEPT: usize = 200;
/// Maximum number of model classes whose plausibility is stored over time. Further classes are only
/// shown at their current value.
const MOST_CLASSES: usize = 64;
/// Number of past points that a reader receives when it requests a series: 20 s of a waveform, or
/// one second at 20 times real time.
const OVERLAP: u64 = 200;
/// Time after which a structure without any data counts as stale. Before, it may still be starting.
const NEVER_MEASURED_AFTER: Duration = Duration::from_secs(30);
/// Name of series that concern all channels together.
pub(crate) const ALL_CHANNELS: &str = "all";

/// State of one structure from all received messages, and its past.
#[derive(Debug)]
pub(crate) struct Store {
    pub(crate) about: About,
    /// Newest message of each kind, without names that are not in the structure file.
    pub(crate) state: StructureState,
    pub(crate) phase: Option<Phase>,
    /// Acknowledgements, newest first.
    notes: VecDeque<Acknowledgement>,
    /// Changes of alerts, newest first.
    pub(crate) changes: VecDeque<Change>,
    /// Changes of lasting losses, oldest first.
    pub(crate) loss_changes: Vec<LossChange>,
    /// Events, newest first.
    pub(crate) events: VecDeque<Event>,
    /// Channels that an event reported as excluded.
    pub(crate) excluded: BTreeSet<String>,
    /// Measurement time (ns) at which each channel was last used in live data.
    pub(crate) used_ns: BTreeMap<String, i64>,
    /// Samples of the last minute of each channel.
    pub(crate) levels: Levels,
    /// Newest spectra of each node.
    pub(crate) spectra: BTreeMap<Name, SpectrumDisplay>,
    innovations: Innovations,
    series: BTreeMap<SeriesName, Series>,
}

/// A change of an alert to another state.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Change {
    /// The newest message for this state. Its time is that of its revision.
    pub(crate) alert: AlertMessage,
    /// Measurement time of the first message for this state, ns since the Unix epoch, UTC.
    pub(crate) time_ns: i64,
}

impl Store {
    pub(crate) fn new(about: About) -> Self {
        Self {
            innovations: Innovations::new(about.display_rate_hz),
            about,
            state: StructureState::default(),
            phase: None,
            notes: VecDeque::new(),
            changes: VecDeque::new(),
            loss_changes: Vec::new(),
            events: VecDeque::new(),
            excluded: BTreeSet::new(),
            used_ns: BTreeMap::new(),
            levels: Levels::default(),
            spectra: BTreeMap::new(),
            series: BTreeMap::new(),
        }
    }

    /// Processes one input. Ignores names that are not in the structure file.
    pub(crate) fn handle(&mut self, input: Input) {
        if !self.is_relevant(&input) {
            return;
        }
        self.plot(&input);
        if let Input::Outlier(display) = &input
            && display.state == ChannelState::Screening
        {
            self.excluded.remove(display.channel.as_str());
        }
        let is_progress = matches!(input, Input::Ingested(..));
        match input {
            Input::Acknowledgement(note) => {
                self.take_note(note);
            }
            Input::Event(event) => self.take_event(event),
            Input::Past(log) => self.take_past(log),
            Input::Judgement(display) => {
                LossChange::note(&mut self.loss_changes, &display);
                self.state
                    .handle(Input::Judgement(display), &mut Vec::new());
            }
            // The service knows more. Without a state folder, a restarted one knows nothing.
            Input::LastingLosses(log) if !log.changes.is_empty() => self.loss_changes = log.changes,
            Input::Mode(display) => {
                self.note_used_channels(&display);
                self.state.handle(Input::Mode(display), &mut Vec::new());
            }
            Input::Spectrum(display) => {
                self.spectra.insert(display.node.clone(), display);
            }
            input => {
                let mut changes = Vec::new();
                self.state.handle(input, &mut changes);
                changes.into_iter().for_each(|change| self.take(change));
            }
        }
        if is_progress {
            // Of the earlier uses of channels, keeps only those that were not recorded before.
            let state = &self.state;
            self.used_ns.retain(|_, time_ns| state.is_live(*time_ns));
        }
    }

    /// Returns `false` for names that are not in the structure file, and for progress that does not
    /// concern the estimates.
    fn is_relevant(&self, input: &Input) -> bool {
        match input {
            Input::Parameter(m) => self.has_parameter(m.parameter.as_str()),
            Input::Loss(m) => self.has_parameter(m.parameter.as_str()),
            Input::Noise(m) => self.has_noise(m.name.as_str()),
            Input::Outlier(m) => self.has_channel(m.channel.as_str()),
            Input::SensorHealth(m) => self.has_node(m.node.as_str()),
            Input::Waveform(m) => self.has_node(m.node.as_str()),
            Input::Spectrum(m) => self.has_node(m.node.as_str()),
            Input::Node(m) => self.has_node(m.node.as_str()),
            Input::Condition(m) | Input::StandingCondition(m, _) => self.has_condition(m),
            Input::Judgement(m) => self.has_judged(m.quantity.as_str()),
            Input::Mode(m) => self.has_mode(m.mode.as_str()),
            Input::Alert(m) | Input::StandingAlert(m) => self.has_parameter(m.parameter.as_str()),
            Input::Acknowledgement(m) => self.has_parameter(m.parameter.as_str()),
            // In distributed identification, samples are not replayed from a recording.
            Input::Ingested(..) => !self.about.distributed,
            _ => true,
        }
    }

    /// Adds the values of an input to their series.
    fn plot(&mut self, input: &Input) {
        match input {
            Input::Parameter(m) => {
                let values = [m.mean, m.std];
                self.push(Kind::Parameter, m.parameter.as_str(), m.time_ns, &values);
            }
            Input::Loss(m) => {
                let ends = [m.interval.low, m.interval.high];
                let values = [m.loss, ends[0], ends[1], m.probability_of_loss];
                self.push(Kind::Loss, m.parameter.as_str(), m.time_ns, &values);
            }
            Input::Noise(m) => {
                self.push(Kind::Noise, m.name.as_str(), m.time_ns, &[m.mean, m.std]);
            }
            Input::Outlier(m) => {
                let values = [m.recent_share, m.flagged as f64];
                self.push(Kind::Outlier, m.channel.as_str(), m.time_ns, &values);
            }
            Input::Condition(m) => {
                self.push(Kind::Condition, m.name.as_str(), m.time_ns, &[m.value]);
            }
            Input::Mode(m) => {
                let last = self.state.modes.get(m.mode.as_str());
                let is_repeated = last.is_some_and(|last| last.time_ns == m.time_ns);
                if let (Some(estimate), false) = (&m.estimate, is_repeated) {
                    let values = [estimate.frequency_hz, estimate.frequency_std_hz];
                    self.push(Kind::Mode, m.mode.as_str(), m.time_ns, &values);
                }
            }
            Input::Waveform(m) => self.plot_waveforms(m),
            Input::Classes(m) => self.plot_classes(m),
            Input::Node(m) => {
                let values = [m.distance, m.distance_limit].map(|value| value.unwrap_or(f64::NAN));
                self.push(Kind::Node, m.node.as_str(), m.time_ns, &values);
            }
            Input::Estimates(_, block) => {
                let mut done = Vec::new();
                self.innovations.handle(block, &mut done);
                done.into_iter()
                    .for_each(|interval| self.take_interval(&interval));
            }
            _ => {}
        }
    }

    fn push(&mut self, kind: Kind, of: &str, time_ns: i64, values: &[f64]) {
        let name = SeriesName::new(kind, of);
        self.series
            .entry(name)
            .or_insert_with(|| kind.series())
            .push(time_ns, values);
    }

    fn has_parameter(&self, name: &str) -> bool {
        let mut known = self.about.parameters.iter();
        known.any(|parameter| parameter.name == name)
    }

    fn has_noise(&self, name: &str) -> bool {
        self.about.noise.iter().any(|level| level.name == name)
    }

    fn has_channel(&self, name: &str) -> bool {
        let mut sensors = self.about.drawing.sensors.iter();
        sensors.any(|sensor| sensor.channel == name)
    }

    fn has_node(&self, name: &str) -> bool {
        let mut sensors = self.about.drawing.sensors.iter();
        sensors.any(|sensor| sensor.node == name)
    }

    fn has_judged(&self, name: &str) -> bool {
        self.about.judged.iter().any(|quantity| quantity == name)
    }

    fn has_mode(&self, name: &str) -> bool {
        self.about.modes.iter().any(|mode| mode.name == name)
    }

    /// Returns `true` if the structure file has the condition, in the unit of the message.
    fn has_condition(&self, message: &ConditionDisplay) -> bool {
        let mut conditions = self.about.conditions.iter();
        let name = message.name.as_str();
        conditions.any(|known| known.name == name && known.unit == message.unit)
    }

    fn plot_classes(&mut self, display: &ModelClassDisplay) {
        for class in &display.classes {
            let name = SeriesName::new(Kind::Class, class.class.as_str());
            let known = self
                .series
                .keys()
                .filter(|name| name.kind == Kind::Class)
                .count();
            if known < MOST_CLASSES || self.series.contains_key(&name) {
                self.push(
                    Kind::Class,
                    &class.class,
                    display.time_ns,
                    &[class.plausibility],
                );
            }
        }
    }

    fn plot_waveforms(&mut self, display: &WaveformDisplay) {
        for waveform in &display.channels {
            let channel = waveform.channel.as_str();
            if !self.has_channel(channel) {
                continue;
            }
            self.levels.take(display, waveform);
            for (bucket, ends) in waveform.extremes.iter().enumerate() {
                // A bucket is shown at its middle.
                let middle_s = (bucket as f64 + 0.5) * display.bucket_s;
                let time_ns = display.time_ns.saturating_add((1e9 * middle_s) as i64);
                let ends = ends.map_or([f64::NAN; 2], |ends| ends.map(f64::from));
                self.push(Kind::Waveform, channel, time_ns, &ends);
            }
        }
    }

    fn take_interval(&mut self, interval: &Interval) {
        self.phase = Some(interval.phase);
        if self.about.distributed {
            return; // a station has estimates but no innovations
        }
        if self.state.is_live(interval.time_ns) {
            self.forget_uses_after(interval.time_ns);
        }
        for (row, (least, largest)) in interval.ends.iter().enumerate() {
            let Some(channel) = self.about.observed_channel(row).map(str::to_owned) else {
                return;
            };
            if least.is_finite() && self.state.is_live(interval.time_ns) {
                self.used_ns.insert(channel.clone(), interval.time_ns);
            }
            self.push(
                Kind::Innovation,
                &channel,
                interval.time_ns,
                &[*least, *largest],
            );
        }
        self.push(
            Kind::Consistency,
            ALL_CHANNELS,
            interval.time_ns,
            &[interval.consistency],
        );
    }

    /// Forgets the uses of channels after the newest results.
    ///
    /// They belong to a former run on the time of a clock that was ahead. Compared with them, all
    /// channels of the present run would be silent.
    fn forget_uses_after(&mut self, newest_ns: i64) {
        self.used_ns.retain(|_, used_ns| *used_ns <= newest_ns);
    }

    /// Notes the channels that took part in an epoch. With a model, the innovations show more.
    fn note_used_channels(&mut self, display: &ModeDisplay) {
        let is_useful = !self.about.is_filtered && self.state.is_live(display.time_ns);
        let shape = display.estimate.iter().flat_map(|estimate| &estimate.shape);
        if is_useful {
            self.forget_uses_after(display.time_ns);
        }
        for at in shape.filter(|_| is_useful) {
            self.used_ns.insert(at.channel.clone(), display.time_ns);
        }
    }

    fn take(&mut self, change: AlertChange) {
        let AlertChange { alert, was_known } = change;
        if (was_known || is_notable(&alert)) && !self.revise(&alert) {
            let time_ns = alert.time_ns;
            self.changes.push_front(Change { alert, time_ns });
            self.changes.truncate(CHANGES_KEPT);
        }
    }

    /// Adds a message to the stored change to the same state. Returns `false` if there is none.
    ///
    /// The change keeps the time of its first message and the contents of its newest one.
    fn revise(&mut self, alert: &AlertMessage) -> bool {
        let mut changes = self.changes.iter_mut();
        let Some(known) = changes.find(|known| known.is_of(alert)) else {
            return false;
        };
        known.time_ns = known.time_ns.min(alert.time_ns);
        if alert.revises(&known.alert) {
            known.alert.clone_from(alert);
        }
        true
    }

    fn take_note(&mut self, note: Acknowledgement) {
        self.join_note(note);
        self.notes.truncate(CHANGES_KEPT);
    }

    fn join_note(&mut self, note: Acknowledgement) {
        if !self.notes.contains(&note) {
            let place = self
                .notes
                .partition_point(|known| known.time_ns > note.time_ns);
            self.notes.insert(place, note);
        }
    }

    fn take_event(&mut self, event: Event) {
        if self.has_channel(&event.subject) {
            match event.kind {
                EventKind::ChannelExcluded => self.excluded.insert(event.subject.clone()),
                EventKind::ChannelBack => self.excluded.remove(&event.subject),
                EventKind::Restart
                | EventKind::Takeover
                | EventKind::Calibration
                | EventKind::Unidentified
                | EventKind::LeadingClass
                | EventKind::NodeExcluded
                | EventKind::NodeSilent
                | EventKind::NodeBack
                | EventKind::ChannelInDoubt
                | EventKind::SamplesDropped
                | EventKind::SamplesBack
                | EventKind::ClockWrong
                | EventKind::ClockMoved
                | EventKind::ClockDoubtful
                | EventKind::ClockRight
                | EventKind::Monitoring
                | EventKind::Maintenance
                | EventKind::NoticeSent
                | EventKind::NoticeFailed
                | EventKind::Gap
                | EventKind::Overloaded
                | EventKind::CaughtUp
                | EventKind::HistoryUnavailable
                | EventKind::HistoryBack
                | EventKind::StateLost
                | EventKind::StateBack
                | EventKind::LastingChange
                | EventKind::Annotation
                | EventKind::ModeProposed
                | EventKind::ModeLost
                | EventKind::ModeFound
                | EventKind::ModePaired
                | EventKind::ModeParted
                | EventKind::ModelContradicted
                | EventKind::ModelAgrees
                | EventKind::Earthquake
                | EventKind::EarthquakeReport
                | EventKind::EarthquakeUnreported
                | EventKind::ReaderDisconnected => false,
            };
        }
        self.events.push_front(event);
        self.events.truncate(EVENTS_KEPT);
    }

    /// Adds past changes that are not known yet. Only the alert service determines the current
    /// state of alerts.
    fn take_past(&mut self, log: HistoryLog) {
        self.join(log);
        self.changes.truncate(CHANGES_KEPT);
        self.events.truncate(EVENTS_KEPT);
        self.notes.truncate(CHANGES_KEPT);
    }

    /// Returns a store with only the changes, acknowledgements and events of this one.
    pub(crate) fn past(&self) -> Self {
        Self {
            notes: self.notes.clone(),
            changes: self.changes.clone(),
            loss_changes: self.loss_changes.clone(),
            events: self.events.clone(),
            ..Self::new(self.about.clone())
        }
    }

    /// Adds all past changes, acknowledgements and events that are not known yet, of any number.
    ///
    /// A way back to a normal state is a change, because it ends the alert before it.
    pub(crate) fn join(&mut self, log: HistoryLog) {
        let mut last: BTreeMap<Name, AlertState> = BTreeMap::new();
        for alert in log.alerts {
            let before = last
                .insert(alert.parameter.clone(), alert.state)
                .or_else(|| self.state_before(&alert));
            let is_change = before.is_some_and(|before| before != alert.state);
            if (is_change || is_notable(&alert)) && !self.revise(&alert) {
                let time_ns = alert.time_ns;
                let place = self
                    .changes
                    .partition_point(|known| known.time_ns > time_ns);
                self.changes.insert(place, Change { alert, time_ns });
            }
        }
        for event in log.events {
            if !self.events.contains(&event) {
                let place = self
                    .events
                    .partition_point(|known| known.time_ns > event.time_ns);
                self.events.insert(place, event);
            }
        }
        log.acknowledgements
            .into_iter()
            .for_each(|note| self.join_note(note));
    }

    /// Returns the state to which the last known change before an alert led.
    fn state_before(&self, alert: &AlertMessage) -> Option<AlertState> {
        let mut changes = self.changes.iter();
        let before = changes.find(|change| {
            change.alert.parameter == alert.parameter && change.time_ns < alert.time_ns
        });
        before.map(|change| change.alert.state)
    }

    /// Returns `true` if data has stopped, or if alerts exist but no data has arrived.
    pub(crate) fn is_stale(&self) -> bool {
        match self.state.silence() {
            Some(_) => self.state.stale_for().is_some(),
            None => self.state.now() > STALE_AFTER && !self.state.alerts.is_empty(),
        }
    }

    /// Returns `true` if no data has arrived although the server has had the time to receive some.
    pub(crate) fn has_never_measured(&self) -> bool {
        self.state.silence().is_none() && self.state.now() >= NEVER_MEASURED_AFTER
    }

    /// Returns the acknowledgement of an alert, with its wall-clock time.
    ///
    /// An alert message does not contain it. If a person has acknowledged a parameter several
    /// times, these acknowledgements belong to its last alerts, in their order.
    pub(crate) fn acknowledgement(&self, alert: &AlertMessage) -> Option<&Acknowledgement> {
        let who = alert.acknowledged_by.as_deref()?;
        let is_same = |of: &AlertMessage| {
            of.parameter == alert.parameter && of.acknowledged_by == alert.acknowledged_by
        };
        let seen = self.changes.iter().filter(|change| is_same(&change.alert));
        let mut later: Vec<Option<i64>> = seen
            .map(|change| change.alert.since_ns)
            .take_while(|since_ns| *since_ns != alert.since_ns)
            .collect();
        later.dedup();
        let notes = self.notes.iter();
        let mut own = notes.filter(|note| note.parameter == alert.parameter && note.who == who);
        own.nth(later.len())
    }

    /// Returns the measurement time of the change to the present state of an alert, ns.
    pub(crate) fn changed_ns(&self, alert: &AlertMessage) -> i64 {
        let mut changes = self.changes.iter();
        let known = changes.find(|known| known.is_of(alert));
        known.map_or(alert.time_ns, |known| known.time_ns)
    }

    /// Returns the lag behind the wall clock if it is meaningful and data arrives.
    pub(crate) fn displayed_lag(&self, lag_s: Option<f64>) -> Option<f64> {
        let arrives = self.state.silence().is_some() && self.state.stale_for().is_none();
        lag_s.filter(|_| arrives && self.state.has_lag())
    }

    /// Returns one series over time.
    pub(crate) fn series(&self, name: &SeriesName) -> Option<&Series> {
        self.series.get(name)
    }

    /// Returns `true` if a series with this name exists or can exist.
    pub(crate) fn may_have(&self, name: &SeriesName) -> bool {
        let of = name.of.as_str();
        match name.kind {
            Kind::Parameter | Kind::Loss => self.has_parameter(of),
            Kind::Noise => self.has_noise(of),
            Kind::Innovation | Kind::Outlier | Kind::Waveform => self.has_channel(of),
            Kind::Consistency => of == ALL_CHANNELS,
            Kind::Class => self.series.contains_key(name),
            Kind::Node => self.has_node(of),
            Kind::Mode => self.has_mode(of),
            Kind::Condition => {
                let mut conditions = self.about.conditions.iter();
                conditions.any(|condition| condition.name == of)
            }
        }
    }

    /// Returns the names of all series with points.
    pub(crate) fn series_names(&self) -> impl Iterator<Item = &SeriesName> {
        self.series.keys()
    }

    /// Returns the new points of each series since a reader's last call, and advances the reader's
    /// positions. For a series that the reader does not request, only the position advances.
    pub(crate) fn news(
        &self,
        read: &mut BTreeMap<SeriesName, u64>,
        most: usize,
        wants: impl Fn(Kind) -> bool,
    ) -> Vec<(SeriesName, u64, Table)> {
        let mut news = Vec::new();
        for (name, series) in &self.series {
            let place = read.entry(name.clone()).or_default();
            if !wants(name.kind) {
                // A reader that begins to want them has fetched the points before, but perhaps not
                // the very last.
                *place = series.pushed().saturating_sub(OVERLAP);
            } else if *place < series.pushed() {
                news.push((
                    name.clone(),
                    series.generation(),
                    series.since(*place, most),
                ));
                *place = series.pushed();
            }
        }
        news
    }
}

impl Change {
    /// Returns `true` if a message concerns the same state, as a revision or a repetition.
    fn is_of(&self, alert: &AlertMessage) -> bool {
        alert.revises(&self.alert) || self.alert.revises(alert) || self.alert == *alert
    }
}

/// Returns `true` if the first known alert of a parameter counts as a change. A normal or undecided
/// state does not.
fn is_notable(alert: &AlertMessage) -> bool {
    !matches!(
        alert.state,
        AlertState::Normal | AlertState::Learning | AlertState::Undecided
    )
}

#[cfg(test)]
mod tests;
