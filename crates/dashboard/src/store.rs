//! Bounded state of one structure, updated from messages. It uses neither clock nor network.

use crate::about::About;
use crate::innovations::{Innovations, Interval};
use crate::series::{Series, Table};
use crate::topic::{Kind, SeriesName};
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Arrivals, ChannelState, EstimateBlock, Event,
    EventKind, FitDisplay, HistoryLog, LossDisplay, ModelClassDisplay, Name, NodeDisplay,
    NoiseDisplay, OutlierDisplay, Pace, ParameterDisplay, Phase, Progress, Service, Status,
    is_without_date, pace_told,
};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Maximum number of changes of alerts. A further change replaces the oldest.
const CHANGES_KEPT: usize = 500;
/// Maximum number of events. A further event replaces the oldest.
const EVENTS_KEPT: usize = 200;
/// Maximum number of model classes whose plausibility is stored over time. Further classes are only
/// shown at their current value.
const MOST_CLASSES: usize = 64;
/// Name of series that concern all channels together.
pub(crate) const ALL_CHANNELS: &str = "all";
/// Silence after which data is stale. Display topics are published at 10 Hz, the status at 1 Hz.
pub(crate) const STALE_AFTER: Duration = Duration::from_secs(3);

/// An input of the store.
#[derive(Debug)]
pub(crate) enum Input {
    /// Time since a fixed moment. Later inputs are received at this time.
    Now(Duration),
    Parameter(ParameterDisplay),
    Loss(LossDisplay),
    Noise(NoiseDisplay),
    Outlier(OutlierDisplay),
    Classes(ModelClassDisplay),
    Node(NodeDisplay),
    Fit(FitDisplay),
    Estimates(EstimateBlock),
    /// The alert of a parameter has changed.
    Alert(AlertMessage),
    /// The state of an alert in reply to a query.
    StandingAlert(AlertMessage),
    Acknowledgement(Acknowledgement),
    Event(Event),
    Status(Status),
    /// Progress of ingest.
    Ingested(Progress),
    /// All services and nodes that are present.
    Present(BTreeSet<(Service, Name)>),
    /// Past changes from the history service.
    Past(HistoryLog),
}

/// State of one structure from all received messages.
#[derive(Debug)]
pub(crate) struct Store {
    pub(crate) about: About,
    pub(crate) now: Duration,
    pub(crate) time_ns: Option<i64>,
    pub(crate) parameters: BTreeMap<String, ParameterDisplay>,
    /// Losses of the parameters with a rule, once their reference is known.
    pub(crate) losses: BTreeMap<String, LossDisplay>,
    pub(crate) noise: BTreeMap<String, NoiseDisplay>,
    pub(crate) outliers: BTreeMap<String, OutlierDisplay>,
    pub(crate) classes: Option<ModelClassDisplay>,
    pub(crate) nodes: BTreeMap<String, NodeDisplay>,
    pub(crate) fit: Option<FitDisplay>,
    pub(crate) phase: Option<Phase>,
    pub(crate) alerts: BTreeMap<String, AlertMessage>,
    /// Alerts whose service has disappeared, and which no other service has confirmed yet.
    pub(crate) stale_alerts: BTreeSet<String>,
    pub(crate) notes: BTreeMap<String, Acknowledgement>,
    /// Changes of alerts, newest first.
    pub(crate) changes: VecDeque<AlertMessage>,
    /// Events, newest first.
    pub(crate) events: VecDeque<Event>,
    pub(crate) statuses: BTreeMap<(Service, Name), (Status, Duration)>,
    pub(crate) present: BTreeSet<(Service, Name)>,
    /// Nodes and services that have ever been present.
    pub(crate) seen: BTreeSet<(Service, Name)>,
    /// Channels that an event reported as excluded.
    pub(crate) excluded: BTreeSet<String>,
    /// Measurement time (ns) at which each channel was last used in live data.
    pub(crate) used_ns: BTreeMap<String, i64>,
    arrivals: Arrivals,
    innovations: Innovations,
    series: BTreeMap<SeriesName, Series>,
}

impl Store {
    pub(crate) fn new(about: About) -> Self {
        Self {
            innovations: Innovations::new(about.display_rate_hz),
            about,
            arrivals: Arrivals::default(),
            now: Duration::ZERO,
            time_ns: None,
            parameters: BTreeMap::new(),
            losses: BTreeMap::new(),
            noise: BTreeMap::new(),
            outliers: BTreeMap::new(),
            classes: None,
            nodes: BTreeMap::new(),
            fit: None,
            phase: None,
            alerts: BTreeMap::new(),
            stale_alerts: BTreeSet::new(),
            notes: BTreeMap::new(),
            changes: VecDeque::new(),
            events: VecDeque::new(),
            statuses: BTreeMap::new(),
            present: BTreeSet::new(),
            seen: BTreeSet::new(),
            excluded: BTreeSet::new(),
            used_ns: BTreeMap::new(),
            series: BTreeMap::new(),
        }
    }

    /// Processes one input. Ignores names that are not in the structure file.
    pub(crate) fn handle(&mut self, input: Input) {
        match input {
            Input::Now(now) => self.now = now,
            Input::Parameter(display) => self.take_parameter(display),
            Input::Loss(display) => self.take_loss(display),
            Input::Noise(display) => {
                if self
                    .about
                    .noise
                    .iter()
                    .any(|level| level.name == display.name.as_str())
                {
                    self.heard_data(display.time_ns);
                    self.push(
                        Kind::Noise,
                        display.name.as_str(),
                        display.time_ns,
                        &[display.mean, display.std],
                    );
                    self.noise.insert(display.name.to_string(), display);
                }
            }
            Input::Outlier(display) => self.take_outlier(display),
            Input::Classes(display) => self.take_classes(display),
            Input::Node(display) => self.take_node(display),
            Input::Fit(display) => self.fit = Some(display),
            Input::Estimates(block) => {
                let mut done = Vec::new();
                self.innovations.handle(&block, &mut done);
                done.into_iter()
                    .for_each(|interval| self.take_interval(&interval));
            }
            Input::Alert(alert) => self.take_alert(alert),
            Input::StandingAlert(alert) => {
                let name = alert.parameter.as_str();
                // A change received by subscription is at least as new, unless it comes from an
                // earlier run.
                let known = self.alerts.get(name);
                if known.is_none_or(|known| {
                    known.time_ns < alert.time_ns || self.stale_alerts.contains(name)
                }) {
                    self.take_alert(alert);
                }
            }
            Input::Acknowledgement(acknowledgement) => {
                if self
                    .about
                    .parameters
                    .iter()
                    .any(|known| known.name == acknowledgement.parameter.as_str())
                {
                    self.notes
                        .insert(acknowledgement.parameter.to_string(), acknowledgement);
                }
            }
            Input::Event(event) => self.take_event(event),
            Input::Status(status) => self.take_status(status),
            Input::Ingested(progress) => self.take_ingested(&progress),
            Input::Present(present) => self.take_present(present),
            Input::Past(log) => self.take_past(log),
        }
    }

    fn heard_data(&mut self, time_ns: i64) {
        self.arrivals.value(time_ns, self.now);
        self.time_ns = Some(time_ns);
    }

    /// Updates the progress of ingest. Of the earlier uses of channels, keeps only those that
    /// ingest has not yet recorded.
    fn take_ingested(&mut self, progress: &Progress) {
        // In distributed identification, samples are not replayed from a recording.
        if self.about.distributed
            || !self
                .arrivals
                .ingested(progress.header.epoch, progress.header.time_ns)
        {
            return;
        }
        let arrivals = &self.arrivals;
        self.used_ns.retain(|_, time_ns| arrivals.is_live(*time_ns));
    }

    fn push(&mut self, kind: Kind, of: &str, time_ns: i64, values: &[f64]) {
        let name = SeriesName::new(kind, of);
        self.series
            .entry(name)
            .or_insert_with(|| kind.series())
            .push(time_ns, values);
    }

    fn has_channel(&self, name: &str) -> bool {
        self.about
            .drawing
            .sensors
            .iter()
            .any(|sensor| sensor.channel == name)
    }

    fn take_parameter(&mut self, display: ParameterDisplay) {
        let name = display.parameter.as_str();
        if !self.about.parameters.iter().any(|known| known.name == name) {
            return;
        }
        self.heard_data(display.time_ns);
        self.push(
            Kind::Parameter,
            name,
            display.time_ns,
            &[display.mean, display.std],
        );
        self.parameters
            .insert(display.parameter.to_string(), display);
    }

    fn take_loss(&mut self, display: LossDisplay) {
        let name = display.parameter.as_str();
        if !self.about.parameters.iter().any(|known| known.name == name) {
            return;
        }
        let values = [
            display.loss,
            display.interval.low,
            display.interval.high,
            display.probability_of_loss,
        ];
        self.push(Kind::Loss, name, display.time_ns, &values);
        self.losses.insert(display.parameter.to_string(), display);
    }

    fn take_outlier(&mut self, display: OutlierDisplay) {
        let name = display.channel.as_str();
        if !self.has_channel(name) {
            return;
        }
        self.push(
            Kind::Outlier,
            name,
            display.time_ns,
            &[display.recent_share, display.flagged as f64],
        );
        if display.state == ChannelState::Screening {
            self.excluded.remove(name);
        }
        self.outliers.insert(display.channel.to_string(), display);
    }

    fn take_classes(&mut self, display: ModelClassDisplay) {
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
        self.classes = Some(display);
    }

    fn take_node(&mut self, display: NodeDisplay) {
        let name = display.node.as_str();
        if !self
            .about
            .drawing
            .sensors
            .iter()
            .any(|sensor| sensor.node == name)
        {
            return;
        }
        let [distance, limit] =
            [display.distance, display.distance_limit].map(|value| value.unwrap_or(f64::NAN));
        self.push(Kind::Node, name, display.time_ns, &[distance, limit]);
        self.nodes.insert(display.node.to_string(), display);
    }

    fn take_interval(&mut self, interval: &Interval) {
        self.phase = Some(interval.phase);
        if self.about.distributed {
            return; // a station has estimates but no innovations
        }
        for (row, (least, largest)) in interval.ends.iter().enumerate() {
            let Some(channel) = self.about.observed_channel(row).map(str::to_owned) else {
                return;
            };
            if least.is_finite() && self.arrivals.is_live(interval.time_ns) {
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

    fn take_alert(&mut self, alert: AlertMessage) {
        let name = alert.parameter.as_str();
        if !self.about.parameters.iter().any(|known| known.name == name) {
            return;
        }
        self.stale_alerts.remove(name);
        let known = self.alerts.get(name);
        if known == Some(&alert) {
            return;
        }
        let is_news = known.is_some() || tells_something(&alert);
        if is_news && !self.revise(&alert) {
            self.changes.push_front(alert.clone());
            self.changes.truncate(CHANGES_KEPT);
        }
        self.alerts.insert(alert.parameter.to_string(), alert);
    }

    /// Replaces a stored alert by its revision. Returns `false` if it revises no stored alert.
    fn revise(&mut self, alert: &AlertMessage) -> bool {
        let is_same = |known: &&mut AlertMessage| {
            alert.revises(known) || known.revises(alert) || **known == *alert
        };
        let Some(known) = self.changes.iter_mut().find(is_same) else {
            return false;
        };
        if alert.revises(known) {
            known.clone_from(alert);
        }
        true
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
                | EventKind::Gap
                | EventKind::Overloaded
                | EventKind::CaughtUp => false,
            };
        }
        self.events.push_front(event);
        self.events.truncate(EVENTS_KEPT);
    }

    fn take_status(&mut self, status: Status) {
        let service = Service::from_name(status.service.as_str());
        let Some(service) = service else { return };
        let key = (service, status.id.clone());
        if self.has_room(&key) || self.statuses.contains_key(&key) {
            self.statuses.insert(key, (status, self.now));
        }
    }

    /// Returns `true` if there is room for one more service or node.
    ///
    /// The limit is a multiple of the number of declared nodes plus a constant.
    fn has_room(&self, key: &(Service, Name)) -> bool {
        const OTHERS: usize = 64;
        self.seen.contains(key)
            || self.seen.len() + self.statuses.len() < 4 * self.about.drawing.sensors.len() + OTHERS
    }

    fn take_present(&mut self, present: BTreeSet<(Service, Name)>) {
        let has = |present: &BTreeSet<(Service, Name)>, service| {
            present.iter().any(|(one, _)| *one == service)
        };
        let [alert_leaves, ingest_leaves] = [Service::Alert, Service::Ingest]
            .map(|service| has(&self.present, service) && !has(&present, service));
        if alert_leaves {
            self.stale_alerts = self.alerts.keys().cloned().collect();
        }
        if ingest_leaves {
            self.arrivals.ingest_left();
        }
        for key in &present {
            if self.has_room(key) {
                self.seen.insert(key.clone());
            }
        }
        self.present = present;
    }

    /// Adds past changes that are not known yet. Only the alert service determines the current
    /// state of alerts.
    fn take_past(&mut self, log: HistoryLog) {
        for alert in log.alerts {
            if tells_something(&alert) && !self.revise(&alert) {
                let place = self
                    .changes
                    .partition_point(|known| known.time_ns > alert.time_ns);
                self.changes.insert(place, alert);
            }
        }
        self.changes.truncate(CHANGES_KEPT);
        for event in log.events {
            if !self.events.contains(&event) {
                let place = self
                    .events
                    .partition_point(|known| known.time_ns > event.time_ns);
                self.events.insert(place, event);
            }
        }
        self.events.truncate(EVENTS_KEPT);
        for note in log.acknowledgements {
            let known = self.notes.get(note.parameter.as_str());
            if known.is_none_or(|known| known.time_ns < note.time_ns) {
                self.notes.insert(note.parameter.to_string(), note);
            }
        }
    }

    /// Returns the time of the last message with live data.
    pub(crate) fn data_heard(&self) -> Option<Duration> {
        self.arrivals.heard()
    }

    /// Returns the time since the last live data, or `None` before the first.
    pub(crate) fn silence(&self) -> Option<Duration> {
        Some(self.now.saturating_sub(self.data_heard()?))
    }

    /// Returns `true` if data has stopped, or if alerts exist but no data has arrived.
    pub(crate) fn is_stale(&self) -> bool {
        match self.silence() {
            Some(silence) => silence > STALE_AFTER,
            None => self.now > STALE_AFTER && !self.alerts.is_empty(),
        }
    }

    /// Returns the note of the person who acknowledged an alert.
    pub(crate) fn note(&self, alert: &AlertMessage) -> Option<&str> {
        let note = self.notes.get(alert.parameter.as_str())?;
        let same = alert.acknowledged_by.as_deref() == Some(note.who.as_str());
        (same && !note.note.is_empty()).then_some(note.note.as_str())
    }

    /// Returns the loss of an alert's parameter by its newest value, if that is newer than the alert.
    pub(crate) fn present_loss(&self, alert: &AlertMessage) -> Option<String> {
        self.losses.get(alert.parameter.as_str())?.since(alert)
    }

    /// Returns `true` if the samples come from a record or a simulation.
    ///
    /// Their times are independent of the wall clock, so a lag has no meaning.
    pub(crate) fn is_replayed(&self) -> bool {
        let Some(time_ns) = self.time_ns else {
            return false;
        };
        is_without_date(time_ns) || self.pace() == Some(Pace::Replayed)
    }

    /// Returns `true` if a lag behind the wall clock is meaningful, because the samples are known
    /// to be live.
    pub(crate) fn has_lag(&self) -> bool {
        self.pace() == Some(Pace::Live) && !self.is_replayed()
    }

    /// Returns the lag behind the wall clock if it is meaningful and data arrives.
    pub(crate) fn told_lag(&self, lag_s: Option<f64>) -> Option<f64> {
        let is_told =
            self.has_lag() && self.silence().is_some_and(|silence| silence <= STALE_AFTER);
        lag_s.filter(|_| is_told)
    }

    fn pace(&self) -> Option<Pace> {
        pace_told(self.statuses.values().map(|(status, _)| status))
    }

    /// Returns one series over time.
    pub(crate) fn series(&self, name: &SeriesName) -> Option<&Series> {
        self.series.get(name)
    }

    /// Returns `true` if a series with this name exists or can exist.
    pub(crate) fn may_have(&self, name: &SeriesName) -> bool {
        let of = name.of.as_str();
        match name.kind {
            Kind::Parameter | Kind::Loss => self
                .about
                .parameters
                .iter()
                .any(|parameter| parameter.name == of),
            Kind::Noise => self.about.noise.iter().any(|level| level.name == of),
            Kind::Innovation | Kind::Outlier => self.has_channel(of),
            Kind::Consistency => of == ALL_CHANNELS,
            Kind::Class => self.series.contains_key(name),
            Kind::Node => self
                .about
                .drawing
                .sensors
                .iter()
                .any(|sensor| sensor.node == of),
        }
    }

    /// Returns the names of all series with points.
    pub(crate) fn series_names(&self) -> impl Iterator<Item = &SeriesName> {
        self.series.keys()
    }

    /// Returns the new points of each series since a reader's last call, and advances the reader's
    /// positions.
    pub(crate) fn news(
        &self,
        read: &mut BTreeMap<SeriesName, u64>,
        most: usize,
    ) -> Vec<(SeriesName, u64, Table)> {
        let mut news = Vec::new();
        for (name, series) in &self.series {
            let place = read.entry(name.clone()).or_default();
            if *place < series.pushed() {
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

/// Returns `true` if the first known alert of a parameter counts as a change. A normal or undecided
/// state does not.
fn tells_something(alert: &AlertMessage) -> bool {
    !matches!(
        alert.state,
        AlertState::Normal | AlertState::Learning | AlertState::Undecided
    )
}

#[cfg(test)]
mod tests;
