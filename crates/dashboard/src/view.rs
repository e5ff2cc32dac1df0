//! What the page and scripts get to see of a structure.

use crate::sensors::{SensorState, sensor_states};
use crate::store::Store;
use serde::Serialize;
use spandrel_bus::{
    AlertMessage, Event, FitDisplay, ModelClassDisplay, NodeDisplay, NoiseDisplay, OutlierDisplay,
    ParameterDisplay, Phase, Status,
};
use std::collections::BTreeMap;

/// Changes of alerts sent at a time; all that are kept are at `/api/alerts`.
const CHANGES_SHOWN: usize = 50;
/// Events sent at a time.
const EVENTS_SHOWN: usize = 50;

/// A structure as it stands now, beside its overview.
#[derive(Debug, Serialize)]
pub(crate) struct Standing<'s> {
    parameters: &'s BTreeMap<String, ParameterDisplay>,
    noise: &'s BTreeMap<String, NoiseDisplay>,
    outliers: &'s BTreeMap<String, OutlierDisplay>,
    classes: Option<&'s ModelClassDisplay>,
    nodes: &'s BTreeMap<String, NodeDisplay>,
    /// The verdict on the fit, with its words.
    fit: Option<FitView<'s>>,
    training: bool,
    alerts: Vec<AlertView<'s>>,
    changes: Vec<AlertView<'s>>,
    events: Vec<&'s Event>,
    sensors: Vec<SensorState>,
    services: Vec<ServiceView<'s>>,
    /// What is kept over time, by the names that history takes.
    series: Vec<String>,
}

/// An alert with what the dashboard knows of it beside.
#[derive(Debug, Serialize)]
pub(crate) struct AlertView<'s> {
    #[serde(flatten)]
    pub(crate) message: &'s AlertMessage,
    /// Whether the service that said so has gone.
    pub(crate) stale: bool,
    /// What was written with the acknowledgement.
    pub(crate) note: Option<&'s str>,
    /// What the newest value says of the loss, where that is newer than the sentence of the alert.
    pub(crate) now: Option<String>,
}

/// The verdict on the fit as the page shows it.
#[derive(Debug, Serialize)]
struct FitView<'s> {
    #[serde(flatten)]
    display: &'s FitDisplay,
    words: String,
}

/// A service and what it says of itself.
#[derive(Debug, Serialize)]
struct ServiceView<'s> {
    service: &'static str,
    id: &'s str,
    present: bool,
    /// Its lag, where that says something.
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

/// The alert of each parameter.
pub(crate) fn standing_alerts(store: &Store) -> impl Iterator<Item = AlertView<'_>> {
    store.alerts.iter().map(|(name, message)| AlertView {
        message,
        stale: store.stale_alerts.contains(name),
        note: store.note(message),
        now: store.present_loss(message),
    })
}

/// The changes of alerts, newest first.
pub(crate) fn changes(store: &Store) -> impl Iterator<Item = AlertView<'_>> {
    store.changes.iter().map(|message| AlertView {
        message,
        stale: false,
        note: store.note(message),
        now: None,
    })
}
