//! Views of a structure for the page and for scripts.

use crate::conditions::{ConditionView, conditions};
use crate::lasting_alert::{LastingAlert, lasting_alerts};
use crate::sensors::{SensorState, sensor_states};
use crate::store::Store;
use serde::Serialize;
use spandrel_bus::{
    AlertMessage, AlertState, ChangeKind, Event, EventKind, FitDisplay, JudgementDisplay,
    LossDisplay, ModeDisplay, ModelClassDisplay, Name, NodeDisplay, NoiseDisplay, OutlierDisplay,
    ParameterDisplay, ParameterMonitoring, Phase, Service, Status,
};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// Maximum number of alert changes in one message. `/api/alerts` returns all stored changes.
const CHANGES_SHOWN: usize = 50;
/// Maximum number of events in one message.
const EVENTS_SHOWN: usize = 50;

/// Current state of a structure, in addition to its overview.
#[derive(Debug, Serialize)]
pub(crate) struct Standing<'s> {
    parameters: &'s BTreeMap<Name, ParameterDisplay>,
    losses: &'s BTreeMap<Name, LossDisplay>,
    noise: &'s BTreeMap<Name, NoiseDisplay>,
    outliers: &'s BTreeMap<Name, OutlierDisplay>,
    classes: Option<&'s ModelClassDisplay>,
    nodes: &'s BTreeMap<Name, NodeDisplay>,
    conditions: Vec<ConditionView<'s>>,
    /// The judged quantities, in the order of the structure file.
    judgements: Vec<JudgementView<'s>>,
    /// The declared modes, in the order of the structure file.
    modes: Vec<&'s ModeDisplay>,
    /// Verdict on the fit, with its explanation.
    fit: Option<FitView<'s>>,
    training: bool,
    alerts: Vec<AlertView<'s>>,
    /// The lasting losses as alerts, in the order of the structure file.
    lasting_alerts: Vec<LastingAlert<'s>>,
    changes: Vec<ChangeView<'s>>,
    events: Vec<&'s Event>,
    sensors: Vec<SensorState<'s>>,
    services: Vec<ServiceView<'s>>,
    /// Names of the stored series, as `history` accepts them.
    series: Vec<String>,
}

/// What has decided an alert.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum AlertKind {
    /// A rule of the structure file, from the present estimates.
    Rule,
    /// The judgement of lasting change.
    LastingLoss,
}

/// An alert with additional data of the dashboard.
#[derive(Debug, Serialize)]
pub(crate) struct AlertView<'s> {
    kind: AlertKind,
    #[serde(flatten)]
    pub(crate) message: &'s AlertMessage,
    /// Whether the service that published the alert has disappeared.
    pub(crate) stale: bool,
    /// Measurement time of the change to this state, ns since the Unix epoch, UTC. The time of the
    /// message is that of its newest revision.
    pub(crate) changed_ns: i64,
    /// Wall-clock time of the acknowledgement, ns since the Unix epoch, UTC.
    pub(crate) acknowledged_ns: Option<i64>,
    /// Note from the acknowledgement.
    pub(crate) note: Option<&'s str>,
    /// Loss by the newest value, if that is newer than the sentence of the alert.
    pub(crate) now: Option<String>,
    /// Why the present data do not reveal damage of the parameter, if so.
    pub(crate) unwatched: Option<ParameterMonitoring>,
    /// Whom to call; may be empty.
    pub(crate) contact: &'s str,
    /// Address of the instructions.
    pub(crate) runbook: Option<&'s str>,
    /// The last notice of the alert to each receiver, newest first.
    pub(crate) notices: Vec<NoticeView<'s>>,
}

/// A past change of an alert.
#[derive(Debug, Serialize)]
#[serde(untagged)]
pub(crate) enum ChangeView<'s> {
    Rule(AlertView<'s>),
    LastingLoss(LastingAlert<'s>),
}

/// The last attempt to notify a receiver of an alert.
#[derive(Debug, PartialEq, Serialize)]
pub(crate) struct NoticeView<'s> {
    receiver: &'s str,
    /// Time of the attempt, ns since the Unix epoch, UTC.
    time_ns: i64,
    /// Reason of a failure.
    failure: Option<&'s str>,
}

/// The judgement of a quantity as the page shows it.
#[derive(Debug, Serialize)]
pub(crate) struct JudgementView<'s> {
    #[serde(flatten)]
    pub(crate) display: &'s JudgementDisplay,
    /// Name of the lasting change, or else of the state.
    pub(crate) word: &'static str,
}

/// Verdict on the fit as the page shows it.
#[derive(Debug, Serialize)]
struct FitView<'s> {
    #[serde(flatten)]
    display: &'s FitDisplay,
    words: String,
    /// Whether no new data arrive, so that the verdict is the last known one.
    past: bool,
}

/// A service and its last status.
#[derive(Debug, Serialize)]
struct ServiceView<'s> {
    service: &'static str,
    id: &'s str,
    present: bool,
    /// Lag of the service, if it is meaningful.
    lag_s: Option<f64>,
    status: Option<&'s Status>,
}

impl<'s> Standing<'s> {
    pub(crate) fn of(store: &'s Store) -> Self {
        let state = &store.state;
        let known = state.seen.iter().chain(state.instances.keys());
        let services: BTreeSet<_> = known
            .filter(|(service, _)| *service != Service::Sensor)
            .collect();
        let service = |key: &'s (Service, Name)| {
            let instance = state.instances.get(key);
            let status = instance.and_then(|instance| instance.status.as_ref());
            ServiceView {
                service: key.0.as_str(),
                id: key.1.as_str(),
                present: instance.is_some_and(|instance| instance.is_present),
                lag_s: store.displayed_lag(status.and_then(|status| status.lag_s)),
                status,
            }
        };
        Self {
            parameters: &store.state.parameters,
            losses: &store.state.losses,
            noise: &store.state.noise,
            outliers: &store.state.outliers,
            classes: store.state.classes.as_ref(),
            nodes: &store.state.nodes,
            conditions: conditions(store).collect(),
            judgements: judgements(store).collect(),
            modes: modes(store).collect(),
            fit: store.state.fit.as_ref().map(|display| FitView {
                display,
                words: display.words(),
                past: store.is_stale(),
            }),
            training: store.phase == Some(Phase::Training),
            alerts: standing_alerts(store).collect(),
            lasting_alerts: lasting_alerts(store).collect(),
            changes: changes(store, CHANGES_SHOWN),
            events: store.events.iter().take(EVENTS_SHOWN).collect(),
            sensors: sensor_states(store),
            services: services.into_iter().map(service).collect(),
            series: store.series_names().map(ToString::to_string).collect(),
        }
    }
}

/// Returns the judgements that have arrived, in the order of the structure file.
pub(crate) fn judgements(store: &Store) -> impl Iterator<Item = JudgementView<'_>> {
    let judged = store.about.judged.iter();
    let judged = judged.filter_map(|name| store.state.judgements.get(name.as_str()));
    judged.map(|display| JudgementView {
        display,
        word: display.word(),
    })
}

/// Returns the modes that have arrived, in the order of the structure file.
pub(crate) fn modes(store: &Store) -> impl Iterator<Item = &ModeDisplay> {
    let declared = store.about.modes.iter();
    declared.filter_map(|mode| store.state.modes.get(mode.name.as_str()))
}

/// Returns the alert of each parameter.
pub(crate) fn standing_alerts(store: &Store) -> impl Iterator<Item = AlertView<'_>> {
    store.state.alerts.iter().map(|(name, message)| AlertView {
        stale: store.state.is_alert_stale(name),
        now: present_loss(store, message),
        unwatched: store.state.unwatched(name),
        contact: &store.about.contact,
        runbook: store.about.runbook.as_deref(),
        notices: notices(store, message),
        ..AlertView::of(store, message, store.changed_ns(message))
    })
}

impl<'s> AlertView<'s> {
    /// Returns the view of a past change.
    fn of(store: &'s Store, message: &'s AlertMessage, changed_ns: i64) -> Self {
        let acknowledgement = store.acknowledgement(message);
        let note = acknowledgement.map(|seen| seen.note.as_str());
        Self {
            kind: AlertKind::Rule,
            message,
            stale: false,
            changed_ns,
            acknowledged_ns: acknowledgement.map(|seen| seen.time_ns),
            note: note.filter(|note| !note.is_empty()),
            now: None,
            unwatched: None,
            contact: "",
            runbook: None,
            notices: Vec::new(),
        }
    }
}

/// Returns the last notice of an alert to each receiver, newest first. An alert that was active
/// earlier had its own notices.
fn notices<'s>(store: &'s Store, alert: &AlertMessage) -> Vec<NoticeView<'s>> {
    let since_ns = alert.since_ns.unwrap_or(alert.time_ns);
    let is_own = |event: &Event| !is_about_lasting_change(event);
    notices_since(store, &alert.parameter, since_ns, is_own)
}

/// Returns `true` if a notice that was sent is about a lasting change, and not about the alert of
/// the parameter with the same name.
pub(crate) fn is_about_lasting_change(sent: &Event) -> bool {
    let mut kinds = [ChangeKind::LastingLoss, ChangeKind::Stiffer].into_iter();
    kinds.any(|kind| {
        let rest = sent.why.strip_prefix(kind.as_str());
        rest.is_some_and(|rest| rest.starts_with(" at "))
    })
}

/// Returns the last notice about a part to each receiver, newest first, of those since a time (ns
/// since the Unix epoch, UTC) for which `is_wanted` returns `true`.
pub(crate) fn notices_since<'s>(
    store: &'s Store,
    part: &Name,
    since_ns: i64,
    is_wanted: impl Fn(&Event) -> bool,
) -> Vec<NoticeView<'s>> {
    // The times of a simulation can be after those of its notices.
    let is_simulated = store.state.is_replayed();
    let is_own = |event: &&Event| {
        let is_later = is_simulated || event.time_ns >= since_ns;
        is_later && event.subject == part.as_str() && is_wanted(event)
    };
    let notice = |event: &'s Event| {
        let (start, failure) = match event.kind {
            EventKind::NoticeSent => (Event::NOTICE_SENT, None),
            EventKind::NoticeFailed => (Event::NOTICE_FAILED, Some(event.why.as_str())),
            _ => return None,
        };
        Some(NoticeView {
            receiver: event.what.strip_prefix(start)?,
            time_ns: event.time_ns,
            failure,
        })
    };
    let mut seen = BTreeSet::new();
    let all = store.events.iter().filter(is_own).filter_map(notice);
    all.filter(|notice| seen.insert(notice.receiver)).collect()
}

/// Returns the loss by the newest value, if that is newer than the sentence of the alert.
///
/// A parameter remains normal without a new sentence, so its sentence is as old as its first
/// decision. The newest value of an unconfirmed alert is no finding, and would contradict its
/// sentence.
pub(crate) fn present_loss(store: &Store, message: &AlertMessage) -> Option<String> {
    if message.state == AlertState::Unconfirmed {
        return None;
    }
    if message.state != AlertState::Normal {
        return store.state.present_loss(message);
    }
    let loss = store.state.losses.get(&message.parameter)?;
    let is_newer = loss.rule_loss == message.rule_loss && loss.time_ns > message.time_ns;
    is_newer.then(|| loss.words())
}

impl ChangeView<'_> {
    /// Returns the state after the change.
    pub(crate) fn state(&self) -> AlertState {
        match self {
            Self::Rule(alert) => alert.message.state,
            Self::LastingLoss(loss) => loss.state,
        }
    }

    /// Returns the time of the change, ns since the Unix epoch, UTC.
    pub(crate) fn changed_ns(&self) -> i64 {
        match self {
            Self::Rule(alert) => alert.changed_ns,
            Self::LastingLoss(loss) => loss.changed_ns,
        }
    }
}

/// Returns the newest changes of alerts, newest first; at most `most`.
pub(crate) fn changes(store: &Store, most: usize) -> Vec<ChangeView<'_>> {
    let rules = store.changes.iter().take(most);
    let rules = rules.map(|change| AlertView::of(store, &change.alert, change.time_ns));
    let losses = store.loss_changes.iter().rev().take(most);
    let losses = losses.map(|change| LastingAlert::past(store, change));
    let mut all: Vec<ChangeView<'_>> = rules.map(ChangeView::Rule).collect();
    all.extend(losses.map(ChangeView::LastingLoss));
    all.sort_by_key(|change| Reverse(change.changed_ns()));
    all.truncate(most);
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{alert, demo, name};
    use spandrel_listener::Input;

    #[test]
    fn an_alert_names_the_last_notice_to_each_receiver_since_its_start() {
        let mut store = demo();
        let raised = AlertMessage {
            since_ns: Some(50),
            ..alert("storey-2", 60, AlertState::Raised)
        };
        store.handle(Input::Alert(raised.clone()));
        let mut notice = |time_ns, subject: &str, kind, what: &str, why: &str| {
            store.handle(Input::Event(Event {
                structure: name("demo"),
                time_ns,
                kind,
                subject: subject.to_owned(),
                what: what.to_owned(),
                why: why.to_owned(),
            }));
        };
        let (sent, failed) = (EventKind::NoticeSent, EventKind::NoticeFailed);
        notice(40, "storey-2", sent, "notice sent to old.example", "raised");
        notice(61, "storey-1", sent, "notice sent to ada.example", "raised");
        notice(
            62,
            "storey-2",
            failed,
            "notice not sent to ada.example",
            "timed out",
        );
        notice(
            63,
            "storey-2",
            failed,
            "notice not sent to bo.example",
            "timed out",
        );
        notice(64, "storey-2", sent, "notice sent to ada.example", "raised");
        let of = |receiver, time_ns, failure| NoticeView {
            receiver,
            time_ns,
            failure,
        };
        assert_eq!(
            notices(&store, &raised),
            [
                of("ada.example", 64, None),
                of("bo.example", 63, Some("timed out"))
            ]
        );
    }
}
