//! Views of a structure for the page and for scripts.

use crate::sensors::{SensorState, sensor_states};
use crate::store::Store;
use serde::Serialize;
use spandrel_bus::{
    AlertMessage, Event, FitDisplay, LossDisplay, ModelClassDisplay, NodeDisplay, NoiseDisplay,
    OutlierDisplay, ParameterDisplay, Phase, Status,
};
use std::collections::BTreeMap;

/// Maximum number of alert changes in one message. `/api/alerts` returns all stored changes.
const CHANGES_SHOWN: usize = 50;
/// Maximum number of events in one message.
const EVENTS_SHOWN: usize = 50;

/// Current state of a structure, in addition to its overview.
#[derive(Debug, Serialize)]
pub(crate) struct Standing<'s> {
    parameters: &'s BTreeMap<String, ParameterDisplay>,
    losses: &'s BTreeMap<String, LossDisplay>,
    noise: &'s BTreeMap<String, NoiseDisplay>,
    outliers: &'s BTreeMap<String, OutlierDisplay>,
    classes: Option<&'s ModelClassDisplay>,
    nodes: &'s BTreeMap<String, NodeDisplay>,
    /// Verdict on the fit, with its explanation.
    fit: Option<FitView<'s>>,
    training: bool,
    alerts: Vec<AlertView<'s>>,
    changes: Vec<AlertView<'s>>,
    events: Vec<&'s Event>,
    sensors: Vec<SensorState>,
    services: Vec<ServiceView<'s>>,
    /// Names of the stored series, as `history` accepts them.
    series: Vec<String>,
}

/// An alert with additional data of the dashboard.
#[derive(Debug, Serialize)]
pub(crate) struct AlertView<'s> {
    #[serde(flatten)]
    pub(crate) message: &'s AlertMessage,
    /// Whether the service that published the alert has disappeared.
    pub(crate) stale: bool,
    /// Note from the acknowledgement.
    pub(crate) note: Option<&'s str>,
    /// Loss by the newest value, if that is newer than the sentence of the alert.
    pub(crate) now: Option<String>,
}

/// Verdict on the fit as the page shows it.
#[derive(Debug, Serialize)]
struct FitView<'s> {
    #[serde(flatten)]
    display: &'s FitDisplay,
    words: String,
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
        let known = store.seen.iter().chain(store.statuses.keys());
        let services: std::collections::BTreeSet<_> = known
            .filter(|(service, _)| *service != spandrel_bus::Service::Sensor)
            .collect();
        let service = |key: &'s (spandrel_bus::Service, spandrel_bus::Name)| ServiceView {
            service: key.0.as_str(),
            id: key.1.as_str(),
            present: store.present.contains(key),
            lag_s: store.told_lag(store.statuses.get(key).and_then(|(status, _)| status.lag_s)),
            status: store.statuses.get(key).map(|(status, _)| status),
        };
        Self {
            parameters: &store.parameters,
            losses: &store.losses,
            noise: &store.noise,
            outliers: &store.outliers,
            classes: store.classes.as_ref(),
            nodes: &store.nodes,
            fit: store.fit.as_ref().map(|display| FitView {
                display,
                words: display.words(),
            }),
            training: store.phase == Some(Phase::Training),
            alerts: standing_alerts(store).collect(),
            changes: changes(store).take(CHANGES_SHOWN).collect(),
            events: store.events.iter().take(EVENTS_SHOWN).collect(),
            sensors: sensor_states(store),
            services: services.into_iter().map(service).collect(),
            series: store.series_names().map(ToString::to_string).collect(),
        }
    }
}

/// Returns the alert of each parameter.
pub(crate) fn standing_alerts(store: &Store) -> impl Iterator<Item = AlertView<'_>> {
    store.alerts.iter().map(|(name, message)| AlertView {
        message,
        stale: store.stale_alerts.contains(name),
        note: store.note(message),
        now: store.present_loss(message),
    })
}

/// Returns the changes of alerts, newest first.
pub(crate) fn changes(store: &Store) -> impl Iterator<Item = AlertView<'_>> {
    store.changes.iter().map(|message| AlertView {
        message,
        stale: false,
        note: store.note(message),
        now: None,
    })
}
