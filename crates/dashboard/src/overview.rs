//! Overview of a structure: whether it needs attention, and why.

use crate::frequencies;
use crate::sensors::{SensorHealth, SensorState, sensor_states};
use crate::store::{Change, Store};
use crate::view::{AlertKind, present_loss};
use serde::Serialize;
use spandrel_bus::{
    AlertMessage, AlertState, Event, EventKind, FitVerdict, LossDisplay, MonitoringDisplay,
    MonitoringState, ReportPage, Service, Standing, UndecidedBecause,
};
use spandrel_earthquake::Urgency;
use spandrel_earthquake::urgency::{Dated, peak_in, ranking};
use spandrel_structure::Coordinates;
use std::cmp::Ordering;

/// Maximum number of sensors that a sentence names. The page lists all of them in its table.
const SENSORS_NAMED: usize = 4;
/// Lag (s) above which the estimates are too old to act on.
const LATE_S: f64 = 10.0;
/// Maximum number of further parts that the sentence of an alert names.
const PARTS_NAMED: usize = 3;
/// Probability of a loss above which only the loss distinguishes parts. The page shows all of them
/// as above 99.9 %.
const CERTAIN: f64 = 0.999;

/// Urgency of a structure, the most urgent first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Level {
    /// An alert is raised and not acknowledged, or a lasting loss was found.
    Alarm,
    /// No new data arrives, so the current condition is unknown.
    Stale,
    /// A loss is credible but has not lasted long enough, or the basis of the estimates is not
    /// sound.
    Warning,
    /// An alert is acknowledged or cleared.
    Notice,
    /// There is too little information to decide on a part.
    Undecided,
    /// There is no decision yet.
    Learning,
    /// No loss was found.
    Normal,
}

/// Summary of a structure.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Overview {
    pub(crate) name: String,
    pub(crate) description: String,
    /// Coordinates of the structure, for the map. `None` if its file does not state them.
    pub(crate) coordinates: Option<Coordinates>,
    /// Location of the structure, in words; may be empty.
    pub(crate) place: String,
    /// Whether there is a model. Without one, only natural frequencies are followed.
    pub(crate) has_model: bool,
    /// Whether a filter estimates the parts of the model from every frame.
    pub(crate) is_filtered: bool,
    pub(crate) level: Level,
    /// Reason for the level, for people.
    pub(crate) sentence: String,
    /// Further matters that need attention while an alert is raised. Empty without any.
    pub(crate) also: String,
    /// Loss by the newest value, if it is newer than the alert in the sentence.
    pub(crate) now: Option<String>,
    /// Part of the alert in the sentence. `None` if the sentence describes no alert.
    pub(crate) part: Option<String>,
    pub(crate) worst: Option<Worst>,
    /// Wall clock minus time of the last identified frame (s). `None` if no data arrives, or if the
    /// data is not live.
    pub(crate) lag_s: Option<f64>,
    /// Whether the samples come from a record or a simulation.
    pub(crate) replayed: bool,
    /// Whether no more data arrive because the record or the simulation has ended.
    pub(crate) ended: bool,
    /// Time since the last message with data (s).
    pub(crate) age_s: Option<f64>,
    /// Measurement time of the newest value (s since the Unix epoch, UTC).
    pub(crate) time_s: Option<f64>,
    pub(crate) sensors: SensorCount,
    /// Verdict on the fit. `None` if no service judges it.
    pub(crate) fit: Option<FitVerdict>,
    /// Whether the present data reveal damage. `None` if the alert service does not report it.
    pub(crate) monitoring: Option<MonitoringState>,
    pub(crate) last_alert: Option<LastAlert>,
    /// The most urgent report of an earthquake that is not too old.
    pub(crate) earthquake: Option<EarthquakeReported>,
    /// Number of raised alerts that are not acknowledged.
    pub(crate) raised: usize,
    /// Number of active alerts that are acknowledged.
    pub(crate) acknowledged: usize,
}

/// The parameter with the highest probability of a stiffness loss.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Worst {
    pub(crate) parameter: String,
    pub(crate) probability_of_loss: f64,
    /// Probability at which the parameter's rule requires an alert.
    pub(crate) credibility: f64,
    /// Loss to which the probability refers, as a share of the reference.
    pub(crate) rule_loss: f64,
    /// Estimated loss, as a share of the reference.
    pub(crate) loss: f64,
    pub(crate) mean: f64,
    pub(crate) std: f64,
    /// Whether the alert of the parameter has no decision, for example because of the fit.
    pub(crate) undecided: bool,
    /// Whether the present data do not confirm the alert of the parameter.
    pub(crate) unconfirmed: bool,
}

/// Number of channels, and of channels that work.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct SensorCount {
    pub(crate) alive: usize,
    pub(crate) total: usize,
    /// Names of the channels that need attention.
    pub(crate) troubled: Vec<String>,
    /// Those of them whose samples are used.
    #[serde(skip)]
    pub(crate) doubtful: Vec<String>,
}

/// Last change of an alert or a lasting loss to a state that is more than routine.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct LastAlert {
    pub(crate) kind: AlertKind,
    /// The parameter of a rule, or the judged quantity.
    pub(crate) parameter: String,
    pub(crate) state: AlertState,
    pub(crate) time_s: f64,
    pub(crate) why: String,
}

/// A report of an earthquake.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct EarthquakeReported {
    /// Name of the report.
    pub(crate) report: String,
    /// Time of the last frame in its recording (s since the Unix epoch, UTC).
    pub(crate) time_s: f64,
    /// How soon an inspector is needed, in words.
    pub(crate) urgency: String,
    /// The result in one or two sentences.
    pub(crate) result: String,
    /// The newest report, if it is a less urgent one.
    pub(crate) later: Option<Box<EarthquakeReported>>,
}

/// Returns the report that ranks the structure, and the newest one.
fn earthquake(store: &Store) -> Option<EarthquakeReported> {
    let events = store.events.iter(); // the newest first
    let reports: Vec<EarthquakeReported> =
        events.filter_map(|event| reported(store, event)).collect();
    let dated = |report: &EarthquakeReported| Dated {
        time_s: report.time_s,
        rank: Urgency::of_words(&report.urgency).map_or(u8::MAX, Urgency::rank),
        peak_m_per_s2: peak_in(&report.result).unwrap_or(0.0),
    };
    let until_s = store.state.time_ns.map_or(f64::MIN, |ns| ns as f64 / 1e9);
    let all: Vec<Dated> = reports.iter().map(dated).collect();
    let urgent = reports.get(ranking(&all, until_s)?)?;
    let newest = reports.first().filter(|newest| *newest != urgent);
    Some(EarthquakeReported {
        later: newest.cloned().map(Box::new),
        ..urgent.clone()
    })
}

/// Returns what an event says about a report, or `None` for another event.
fn reported(store: &Store, event: &Event) -> Option<EarthquakeReported> {
    if event.kind != EventKind::EarthquakeReport {
        return None;
    }
    let path = ReportPage::path(&store.about.name, &event.subject);
    Some(EarthquakeReported {
        report: event.subject.clone(),
        time_s: event.time_ns as f64 / 1e9,
        urgency: event.what.strip_prefix(ReportPage::EVENT)?.to_owned(),
        result: event.why.trim_end_matches(&path).trim_end().to_owned(),
        later: None,
    })
}

/// Returns the overview of a structure.
pub(crate) fn overview(store: &Store) -> Overview {
    let sensors = sensor_count(store);
    let (level, sentence) = attention(store, &sensors);
    let also = match level {
        Level::Alarm => besides_the_alarm(store, &sensors, &sentence),
        _ => String::new(),
    };
    let told = store
        .state
        .alerts
        .values()
        .find(|alert| sentence.starts_with(alert.why.as_str()));
    let now = told.and_then(|alert| present_loss(store, alert));
    let worst = store
        .state
        .losses
        .values()
        .filter(|display| is_stiffness(store, display.parameter.as_str()));
    let worst = worst.max_by(|a, b| {
        let of = |display: &LossDisplay| Severity::new(display.probability_of_loss, display.loss);
        of(a).total_cmp(&of(b))
    });
    let worst = worst.and_then(|display| {
        let estimate = store.state.parameters.get(display.parameter.as_str())?;
        Some((display, estimate))
    });
    let is_in = |display: &LossDisplay, state| {
        alerts_in(store, state).any(|alert| alert.parameter == display.parameter)
    };
    let worst = worst.map(|(display, estimate)| Worst {
        parameter: display.parameter.to_string(),
        probability_of_loss: display.probability_of_loss,
        credibility: display.rule_credibility,
        rule_loss: display.rule_loss,
        loss: display.loss,
        mean: estimate.mean,
        std: estimate.std,
        undecided: is_in(display, AlertState::Undecided),
        unconfirmed: is_in(display, AlertState::Unconfirmed),
    });
    let lasting = |state| frequencies::lasting_losses(store, state).count();
    let raised = unseen(store).count() + lasting(AlertState::Raised);
    let acknowledged = alerts_in(store, AlertState::Acknowledged)
        .chain(alerts_in(store, AlertState::Unconfirmed).filter(|alert| !alert.is_unseen()))
        .count()
        + lasting(AlertState::Acknowledged);
    Overview {
        name: store.about.name.clone(),
        description: store.about.description.clone(),
        coordinates: store.about.coordinates,
        place: store.about.place.clone(),
        has_model: store.about.has_model,
        is_filtered: store.about.is_filtered,
        level,
        sentence,
        also,
        now,
        part: told
            .filter(|alert| !is_routine(alert.state))
            .map(|alert| alert.parameter.to_string()),
        worst,
        lag_s: store.displayed_lag(lag_s(store)),
        replayed: store.state.is_replayed(),
        ended: has_ended(store),
        age_s: store.state.silence().map(|silence| silence.as_secs_f64()),
        time_s: store.state.time_ns.map(|time_ns| time_ns as f64 / 1e9),
        sensors,
        fit: store.state.fit.as_ref().map(|fit| fit.verdict),
        monitoring: store.state.monitoring().map(|display| display.state),
        last_alert: last_alert(store),
        earthquake: earthquake(store),
        raised,
        acknowledged,
    }
}

/// Returns the newest of the changes of alerts and of lasting losses that are more than routine.
fn last_alert(store: &Store) -> Option<LastAlert> {
    let is_alert = |change: &&Change| !is_routine(change.alert.state);
    let of_rule = store.changes.iter().find(is_alert);
    let of_rule = of_rule.map(|Change { alert, time_ns }| LastAlert {
        kind: AlertKind::Rule,
        parameter: alert.parameter.to_string(),
        state: alert.state,
        time_s: *time_ns as f64 / 1e9,
        why: alert.why.clone(),
    });
    let losses = store.loss_changes.iter();
    let of_loss = losses.max_by_key(|change| change.time_ns);
    let of_loss = of_loss.map(|change| LastAlert {
        kind: AlertKind::LastingLoss,
        parameter: change.quantity.to_string(),
        state: change.state,
        time_s: change.time_ns as f64 / 1e9,
        why: change.sentence.clone(),
    });
    let both = [of_rule, of_loss].into_iter().flatten();
    both.max_by(|a, b| a.time_s.total_cmp(&b.time_s))
}

fn is_stiffness(store: &Store, name: &str) -> bool {
    store
        .about
        .parameters
        .iter()
        .any(|parameter| parameter.stiffness && parameter.name == name)
}

/// How severe a probable loss is: first its probability, then its size.
#[derive(Clone, Copy, Debug)]
struct Severity {
    /// Probability of the loss, at most [`CERTAIN`].
    probability: f64,
    /// Loss, as a share of the reference.
    loss: f64,
}

impl Severity {
    fn new(probability: f64, loss: f64) -> Self {
        Self {
            probability: probability.min(CERTAIN),
            loss,
        }
    }

    fn of(alert: &AlertMessage) -> Self {
        Self::new(alert.credibility, alert.loss.unwrap_or(0.0))
    }

    fn total_cmp(&self, other: &Self) -> Ordering {
        let by_probability = self.probability.total_cmp(&other.probability);
        by_probability.then(self.loss.total_cmp(&other.loss))
    }
}

/// Returns `true` if a state of an alert requires no attention.
fn is_routine(state: AlertState) -> bool {
    matches!(
        state,
        AlertState::Normal | AlertState::Learning | AlertState::Undecided
    )
}

fn alerts_in(store: &Store, state: AlertState) -> impl Iterator<Item = &AlertMessage> {
    store
        .state
        .alerts
        .values()
        .filter(move |alert| alert.state == state)
}

/// Returns the lag of the service that publishes the results.
///
/// This is the station in distributed identification, and the leader if there are standbys. Without
/// a model, only natural frequencies are followed.
fn lag_s(store: &Store) -> Option<f64> {
    let source = match (store.about.is_filtered, store.about.distributed) {
        (false, _) => Service::Modes,
        (true, true) => Service::Fuse,
        (true, false) => Service::Identify,
    };
    let instances = store.state.instances.iter();
    let of_source = instances.filter(|((service, _), _)| *service == source);
    let leading = of_source.filter_map(|(_, instance)| {
        let status = instance.status.as_ref()?;
        let leads = status.state.is_none_or(|state| state == Standing::Leading);
        leads.then_some((instance.status_at, status.lag_s))
    });
    // The last status of a terminated service remains, so take the newest.
    leading.max_by_key(|(at, _)| *at)?.1
}

/// Returns `true` if no more data arrive because the record or the simulation has ended.
fn has_ended(store: &Store) -> bool {
    let mut seen = store.state.seen.iter();
    let was_there = seen.any(|(service, _)| *service == Service::Sensor);
    let is_there = store.state.has(Service::Sensor);
    store.is_stale() && store.state.is_replayed() && was_there && !is_there
}

fn sensor_count(store: &Store) -> SensorCount {
    let states = sensor_states(store);
    let troubled: Vec<&SensorState<'_>> = states
        .iter()
        .filter(|sensor| sensor.health.is_trouble())
        .collect();
    // A faulty sensor on the ground is still used, because nothing replaces it.
    let drawing = &store.about.drawing;
    let is_excitation = |channel: &str| {
        let mut sensors = drawing.sensors.iter();
        sensors.any(|sensor| sensor.excitation && sensor.channel == channel)
    };
    let doubtful = troubled.iter().filter(|sensor| {
        let is_faulty_ground =
            sensor.health == SensorHealth::Faulty && is_excitation(&sensor.channel);
        sensor.health.delivers() || is_faulty_ground
    });
    SensorCount {
        alive: states
            .iter()
            .filter(|sensor| sensor.health.delivers())
            .count(),
        total: states.len(),
        doubtful: doubtful.map(|sensor| sensor.channel.clone()).collect(),
        troubled: troubled
            .iter()
            .map(|sensor| sensor.channel.clone())
            .collect(),
    }
}

fn attention(store: &Store, sensors: &SensorCount) -> (Level, String) {
    let by_severity =
        |a: &&AlertMessage, b: &&AlertMessage| Severity::of(a).total_cmp(&Severity::of(b));
    if let Some(first) = unseen(store).max_by(by_severity) {
        return (Level::Alarm, with_others(store, first));
    }
    if let Some(sentence) = frequencies::alarm(store) {
        return (Level::Alarm, sentence);
    }
    let concerns = concerns(store, sensors);
    let told = || concerns.iter().map(|(_, sentence)| sentence.as_str());
    if store.is_stale() {
        // Open concerns remain when the data stops.
        let as_it_was = match has_ended(store) {
            true => "the record has ended; this page shows its last state",
            false => "no new data; this page shows the last state",
        };
        // The end of a record does not end an acknowledged alert. A badge states the end.
        let level = match concerns.first() {
            Some((Level::Notice, _)) if has_ended(store) => Level::Notice,
            _ => Level::Stale,
        };
        return (
            level,
            told().chain([as_it_was]).collect::<Vec<_>>().join("; "),
        );
    }
    if let Some((most_urgent, _)) = concerns.first() {
        // An alert that somebody has seen does not hide that new damage would not be noticed.
        let unwatched = unwatched(store).filter(|_| *most_urgent == Level::Notice);
        let words = unwatched.map(MonitoringDisplay::words);
        let level = match words {
            Some(_) => Level::Warning,
            None => *most_urgent,
        };
        let told = words.as_deref().into_iter().chain(told());
        return (level, told.collect::<Vec<_>>().join("; "));
    }
    if store.has_never_measured() {
        let sentence =
            "no data since the server was started; check which services and sensors are running";
        return (Level::Stale, sentence.to_owned());
    }
    if !store.about.is_filtered {
        return frequencies::attention(store);
    }
    if store.state.silence().is_none() {
        return (
            Level::Learning,
            "waiting for the first estimates".to_owned(),
        );
    }
    if let Some(sentence) = undecided(store, false) {
        return (Level::Undecided, sentence);
    }
    if alerts_in(store, AlertState::Learning).next().is_some() {
        return (
            Level::Learning,
            "the reference values are being learnt".to_owned(),
        );
    }
    if store.state.alerts.is_empty() {
        return (Level::Learning, "no alert decision yet".to_owned());
    }
    // Only a proof that damage would be noticed makes a structure normal.
    match store.state.monitoring() {
        Some(display) if display.state == MonitoringState::Watching => (
            Level::Normal,
            "no loss found that satisfies a rule".to_owned(),
        ),
        Some(display) => (Level::Warning, display.words()),
        None => (
            Level::Undecided,
            "the alert service does not report whether the data reveal damage".to_owned(),
        ),
    }
}

/// Returns sentences on everything besides the sentence of the alarm that needs attention; may be
/// empty.
fn besides_the_alarm(store: &Store, sensors: &SensorCount, alarm: &str) -> String {
    let unwatched = unwatched(store).map(MonitoringDisplay::words);
    let mut told: Vec<String> = unwatched.into_iter().collect();
    for (_, sentence) in concerns(store, sensors) {
        if sentence != alarm && !told.contains(&sentence) {
            told.push(sentence);
        }
    }
    told.join("; ")
}

/// Returns the report that damage would not be noticed, unless the filter only learns.
fn unwatched(store: &Store) -> Option<&MonitoringDisplay> {
    let display = store.state.monitoring()?;
    (display.state != MonitoringState::Watching && !display.only_learns() && !store.is_stale())
        .then_some(display)
}

/// Lists names in words, at most `most` of them.
fn listed(names: &[impl AsRef<str>], most: usize) -> String {
    let shown: Vec<&str> = names.iter().take(most).map(AsRef::as_ref).collect();
    match names.len() - shown.len() {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

/// Returns the report on the monitoring if a sensor is the cause.
fn sensor_trouble(store: &Store) -> Option<&MonitoringDisplay> {
    let display = store.state.monitoring()?;
    let mut channels = display.channels.iter();
    let is_used = channels.all(|channel| channel.state == MonitoringState::Watching);
    (display.state != MonitoringState::Watching && !is_used).then_some(display)
}

/// Returns further matters that need attention besides raised alerts, the most urgent first. Each
/// kind has one sentence.
fn concerns(store: &Store, sensors: &SensorCount) -> Vec<(Level, String)> {
    let alerts = |state| {
        alerts_in(store, state)
            .next()
            .map(|first| with_others(store, first))
    };
    let is_unused = |channel: &&String| !sensors.doubtful.contains(*channel);
    let unused: Vec<&String> = sensors.troubled.iter().filter(is_unused).collect();
    let results = match store.about.is_filtered {
        true => "estimates",
        false => "natural frequencies",
    };
    let unused = (!unused.is_empty()).then(|| {
        format!(
            "not used: {}; the {results} use the other sensors",
            listed(&unused, SENSORS_NAMED)
        )
    });
    let doubtful = (!sensors.doubtful.is_empty()).then(|| {
        format!(
            "probably faulty: {}",
            listed(&sensors.doubtful, SENSORS_NAMED)
        )
    });
    let troubled: Vec<String> = [unused, doubtful].into_iter().flatten().collect();
    let troubled = (!troubled.is_empty()).then(|| troubled.join("; "));
    // The report on the monitoring also covers channels that lose only some of their samples.
    let troubled = sensor_trouble(store)
        .filter(|_| !store.is_stale())
        .map(MonitoringDisplay::words)
        .or(troubled);
    let late = store
        .displayed_lag(lag_s(store))
        .filter(|lag_s| *lag_s > LATE_S && store.about.is_filtered)
        .map(|lag_s| format!("the estimates are {lag_s:.0} s behind the samples"));
    let missing =
        missing_service(store).map(|missing| format!("the service {} is gone", missing.as_str()));
    let all = [
        (Level::Warning, alerts(AlertState::Pending)),
        (Level::Warning, undecided(store, true)),
        (Level::Warning, contradicted_fit(store)),
        (Level::Warning, troubled),
        (Level::Warning, late),
        (Level::Warning, missing),
        (Level::Notice, alerts(AlertState::SofteningInMotion)),
        // A cleared alert waits for its acknowledgement.
        (Level::Notice, alerts(AlertState::Cleared)),
        (Level::Notice, alerts(AlertState::Acknowledged)),
        (Level::Notice, seen_unconfirmed(store)),
    ];
    let all = all.into_iter();
    let mut all: Vec<(Level, String)> = all
        .filter_map(|(level, sentence)| Some((level, sentence?)))
        .chain(frequencies::concerns(store))
        .collect();
    all.sort_by_key(|(level, _)| *level);
    all
}

/// Returns the sentence of an undecided alert.
///
/// With `is_wrong`, the cause is a fault. Otherwise too little has been learnt or the noise
/// training continues.
fn undecided(store: &Store, is_wrong: bool) -> Option<String> {
    let is_of_kind = |alert: &&AlertMessage| match alert.undecided_because {
        Some(UndecidedBecause::NothingLearnt | UndecidedBecause::NoiseTraining) => !is_wrong,
        Some(
            UndecidedBecause::ExcitationSilent
            | UndecidedBecause::SensorInDoubt
            | UndecidedBecause::FitContradicted
            | UndecidedBecause::ParameterAtBound,
        ) => is_wrong,
        None => false,
    };
    alerts_in(store, AlertState::Undecided)
        .find(is_of_kind)
        .map(|first| with_others(store, first))
}

/// Returns the active alerts that are not acknowledged.
fn unseen(store: &Store) -> impl Iterator<Item = &AlertMessage> {
    store
        .state
        .alerts
        .values()
        .filter(|alert| alert.is_unseen())
}

/// Returns the sentence of an acknowledged alert that the current data does not confirm.
fn seen_unconfirmed(store: &Store) -> Option<String> {
    alerts_in(store, AlertState::Unconfirmed)
        .find(|alert| !alert.is_unseen())
        .map(|first| with_others(store, first))
}

/// Returns the reason for a contradicted fit, unless an alert already reports it.
fn contradicted_fit(store: &Store) -> Option<String> {
    let fit = store
        .state
        .fit
        .as_ref()
        .filter(|fit| fit.verdict == FitVerdict::Contradicted)?;
    let is_told = store
        .state
        .alerts
        .values()
        .any(|alert| alert.undecided_because == Some(UndecidedBecause::FitContradicted));
    (!is_told).then(|| fit.words())
}

/// Returns the sentence of an alert and the names of further parts in the same state.
fn with_others(store: &Store, first: &AlertMessage) -> String {
    let state = first.state.as_str();
    let others = alerts_in(store, first.state).filter(|alert| alert.parameter != first.parameter);
    let names: Vec<&str> = others.map(|alert| alert.parameter.as_str()).collect();
    match names.len() {
        0 => first.why.clone(),
        1 => format!("{}; {} is {state} too", first.why, names[0]),
        _ => {
            let listed = listed(&names, PARTS_NAMED);
            format!("{}; also {state}: {listed}", first.why)
        }
    }
}

/// Returns the first required service that was present and has disappeared.
fn missing_service(store: &Store) -> Option<Service> {
    let needed: &[Service] = match store.about.is_filtered {
        true => &[
            Service::Identify,
            Service::Fuse,
            Service::Alert,
            Service::Ingest,
        ],
        false => &[Service::Modes, Service::Ingest],
    };
    needed.iter().copied().find(|service| {
        let was_there = store.state.seen.iter().any(|(seen, _)| seen == service);
        was_there && !store.state.has(*service)
    })
}

#[cfg(test)]
mod tests;
