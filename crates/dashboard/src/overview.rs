//! What somebody has to know first: whether a structure needs attention, and why.

use crate::sensors::{SensorHealth, sensor_states};
use crate::store::Store;
use serde::Serialize;
use spandrel_bus::{AlertMessage, AlertState, FitVerdict, Service, Standing, UndecidedBecause};
use std::time::Duration;

/// For so long a structure of which nothing has come yet may just be starting.
const NEVER_MEASURED_AFTER: Duration = Duration::from_secs(30);

/// How urgent a structure is, the most urgent first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Level {
    /// An alert is raised, and nobody has said that he looks at it.
    Alarm,
    /// Nothing is measured any more, so that nobody knows.
    Stale,
    /// A loss is credible but not yet for long enough, or what the estimates rest on is not sound.
    Warning,
    /// An alert stands that somebody has seen, or is over.
    Notice,
    /// Too little is learnt to decide on a part.
    Undecided,
    /// Nothing is decided yet.
    Learning,
    /// No loss was found.
    Normal,
}

/// A structure in one line.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Overview {
    pub(crate) name: String,
    pub(crate) description: String,
    pub(crate) level: Level,
    /// Why it has this level, for a person.
    pub(crate) sentence: String,
    /// What the newest value says of the alert of the sentence, where that is newer.
    pub(crate) now: Option<String>,
    pub(crate) worst: Option<Worst>,
    /// Wall clock less time of the last frame identified (s); none where nothing comes, or not as it is measured.
    pub(crate) lag_s: Option<f64>,
    /// Whether the samples come from a record or a simulation.
    pub(crate) replayed: bool,
    /// How long ago something was heard (s).
    pub(crate) age_s: Option<f64>,
    /// Time of measurement of the newest value (s since the Unix epoch, UTC).
    pub(crate) time_s: Option<f64>,
    pub(crate) sensors: SensorCount,
    /// The verdict on the fit; none where nobody judges it.
    pub(crate) fit: Option<FitVerdict>,
    pub(crate) last_alert: Option<LastAlert>,
    /// Alerts that are raised, and that nobody has acknowledged.
    pub(crate) raised: usize,
}

/// The parameter that has most probably lost stiffness.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Worst {
    pub(crate) parameter: String,
    pub(crate) probability_of_loss: f64,
    /// The probability from which on its rule calls for an alert; none where no alert has been decided on.
    pub(crate) credibility: Option<f64>,
    /// The loss that the probability is asked for, a share of the reference.
    pub(crate) loss: f64,
    pub(crate) mean: f64,
    pub(crate) std: f64,
}

/// How many channels there are, and do their work.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct SensorCount {
    pub(crate) alive: usize,
    pub(crate) total: usize,
    /// Those that are known not to.
    pub(crate) troubled: Vec<String>,
}

/// The last change of an alert that people should know of.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct LastAlert {
    pub(crate) parameter: String,
    pub(crate) state: AlertState,
    pub(crate) time_s: f64,
    pub(crate) why: String,
}

/// Looks at a structure as a whole.
pub(crate) fn overview(store: &Store) -> Overview {
    let sensors = sensor_count(store);
    let (level, sentence) = attention(store, &sensors);
    let told = store
        .alerts
        .values()
        .find(|alert| sentence.starts_with(alert.why.as_str()));
    let now = told.and_then(|alert| store.present_loss(alert));
    let worst = store
        .parameters
        .values()
        .filter(|display| is_stiffness(store, display.parameter.as_str()));
    // among several that are certain the one that has lost most
    let worst = worst.max_by(|a, b| {
        let ratio = |display: &spandrel_bus::ParameterDisplay| display.mean / display.reference;
        a.probability_of_loss
            .total_cmp(&b.probability_of_loss)
            .then(ratio(b).total_cmp(&ratio(a)))
    });
    let worst = worst.map(|display| Worst {
        parameter: display.parameter.to_string(),
        probability_of_loss: display.probability_of_loss,
        credibility: store
            .alerts
            .get(display.parameter.as_str())
            .map(|alert| alert.rule_credibility),
        loss: display.loss,
        mean: display.mean,
        std: display.std,
    });
    let last_alert = store.changes.front().map(|alert| LastAlert {
        parameter: alert.parameter.to_string(),
        state: alert.state,
        time_s: alert.time_ns as f64 / 1e9,
        why: alert.why.clone(),
    });
    let raised = unseen(store).count();
    Overview {
        name: store.about.name.clone(),
        description: store.about.description.clone(),
        level,
        sentence,
        now,
        worst,
        lag_s: store.told_lag(lag_s(store)),
        replayed: store.is_replayed(),
        age_s: store.silence().map(|silence| silence.as_secs_f64()),
        time_s: store.time_ns.map(|time_ns| time_ns as f64 / 1e9),
        sensors,
        fit: store.fit.as_ref().map(|fit| fit.verdict),
        last_alert,
        raised,
    }
}

fn is_stiffness(store: &Store, name: &str) -> bool {
    store
        .about
        .parameters
        .iter()
        .any(|parameter| parameter.stiffness && parameter.name == name)
}

fn alerts_in(store: &Store, state: AlertState) -> impl Iterator<Item = &AlertMessage> {
    store
        .alerts
        .values()
        .filter(move |alert| alert.state == state)
}

/// The lag of who puts the estimates: the station where nodes identify for themselves, the one that leads where others stand by.
fn lag_s(store: &Store) -> Option<f64> {
    let source = if store.about.distributed {
        Service::Fuse
    } else {
        Service::Identify
    };
    let of_source = store.statuses.iter().filter(|((service, _), (status, _))| {
        *service == source && status.state.is_none_or(|state| state == Standing::Leading)
    });
    // of one that is gone the last status stays
    of_source
        .max_by_key(|(_, (_, heard))| *heard)
        .and_then(|(_, (status, _))| status.lag_s)
}

fn sensor_count(store: &Store) -> SensorCount {
    let states = sensor_states(store);
    let troubled = states
        .iter()
        .filter(|sensor| sensor.health.is_trouble())
        .map(|sensor| sensor.channel.clone());
    SensorCount {
        alive: states
            .iter()
            .filter(|sensor| sensor.health == SensorHealth::Alive)
            .count(),
        total: states.len(),
        troubled: troubled.collect(),
    }
}

fn attention(store: &Store, sensors: &SensorCount) -> (Level, String) {
    // the largest loss first
    let largest = |a: &&AlertMessage, b: &&AlertMessage| {
        a.loss.unwrap_or(0.0).total_cmp(&b.loss.unwrap_or(0.0))
    };
    if let Some(first) = unseen(store).max_by(largest) {
        return (Level::Alarm, with_others(store, first));
    }
    let concerns = concerns(store, sensors);
    let told = || concerns.iter().map(|(_, sentence)| sentence.as_str());
    if store.is_stale() {
        // what somebody has to look at is not over because no data come
        let as_it_was = "nothing is measured: what is shown is how it was";
        return (
            Level::Stale,
            told().chain([as_it_was]).collect::<Vec<_>>().join("; "),
        );
    }
    if let Some((most_urgent, _)) = concerns.first() {
        return (*most_urgent, told().collect::<Vec<_>>().join("; "));
    }
    if store.data_heard().is_none() && store.now >= NEVER_MEASURED_AFTER {
        let sentence = "nothing has been measured since this page was started: see which services and sensors are there";
        return (Level::Stale, sentence.to_owned());
    }
    if store.data_heard().is_none() {
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
            "the sound values are being learnt".to_owned(),
        );
    }
    if store.alerts.is_empty() {
        return (
            Level::Learning,
            "no alert has been decided on yet".to_owned(),
        );
    }
    (
        Level::Normal,
        "no loss was found that the rules ask about".to_owned(),
    )
}

/// What somebody should look at beside alerts that are raised, the most urgent first: one sentence of each kind.
fn concerns(store: &Store, sensors: &SensorCount) -> Vec<(Level, String)> {
    let alerts = |state| {
        alerts_in(store, state)
            .next()
            .map(|first| with_others(store, first))
    };
    let troubled = (!sensors.troubled.is_empty()).then(|| {
        format!(
            "not used: {}; the estimates rest on the other sensors",
            sensors.troubled.join(", ")
        )
    });
    let missing =
        missing_service(store).map(|missing| format!("the service {} is gone", missing.as_str()));
    let all = [
        (Level::Warning, alerts(AlertState::Pending)),
        (Level::Warning, undecided(store, true)),
        (Level::Warning, contradicted_fit(store)),
        (Level::Warning, troubled),
        (Level::Warning, missing),
        // it waits for somebody who has seen it
        (Level::Notice, alerts(AlertState::Cleared)),
        (Level::Notice, alerts(AlertState::Acknowledged)),
        (Level::Notice, seen_unconfirmed(store)),
    ];
    all.into_iter()
        .filter_map(|(level, sentence)| Some((level, sentence?)))
        .collect()
}

/// The sentence of an alert on which nothing is decided: because something is wrong, or because nothing is learnt yet or in the
/// quiet.
fn undecided(store: &Store, is_wrong: bool) -> Option<String> {
    let is_of_kind = |alert: &&AlertMessage| match alert.undecided_because {
        Some(UndecidedBecause::NothingLearnt | UndecidedBecause::NoiseTraining) => !is_wrong,
        Some(
            UndecidedBecause::ExcitationSilent
            | UndecidedBecause::FitContradicted
            | UndecidedBecause::ParameterAtBound,
        ) => is_wrong,
        None => false,
    };
    alerts_in(store, AlertState::Undecided)
        .find(is_of_kind)
        .map(|first| with_others(store, first))
}

/// Alerts that stand and that nobody has acknowledged.
fn unseen(store: &Store) -> impl Iterator<Item = &AlertMessage> {
    store.alerts.values().filter(|alert| alert.is_unseen())
}

/// The sentence of an alert that somebody has seen, and that the data do not confirm now.
fn seen_unconfirmed(store: &Store) -> Option<String> {
    alerts_in(store, AlertState::Unconfirmed)
        .find(|alert| !alert.is_unseen())
        .map(|first| with_others(store, first))
}

/// What is wrong with the fit, where no alert says so.
fn contradicted_fit(store: &Store) -> Option<String> {
    let fit = store
        .fit
        .as_ref()
        .filter(|fit| fit.verdict == FitVerdict::Contradicted)?;
    let is_told = store
        .alerts
        .values()
        .any(|alert| alert.undecided_because == Some(UndecidedBecause::FitContradicted));
    (!is_told).then(|| fit.words())
}

/// The sentence of an alert, and how many more are in the same state.
fn with_others(store: &Store, first: &AlertMessage) -> String {
    let state = first.state.as_str();
    match alerts_in(store, first.state).count() - 1 {
        0 => first.why.clone(),
        1 => format!("{}; one more alert is {state}", first.why),
        more => format!("{}; {more} more alerts are {state}", first.why),
    }
}

/// The first service that was there and is not any more.
fn missing_service(store: &Store) -> Option<Service> {
    let needed = [
        Service::Identify,
        Service::Fuse,
        Service::Alert,
        Service::Ingest,
    ];
    needed.into_iter().find(|service| {
        let was_there = store.seen.iter().any(|(seen, _)| seen == service);
        was_there && !store.present.iter().any(|(present, _)| present == service)
    })
}

#[cfg(test)]
mod tests;
