//! Subscribes to the bus and collects the messages.

use super::heard::{Input, Instance};
use super::topics::{KeyExpressions, OnTopic, ingested, input, instance};
use crate::error::AppError;
use spandrel_bus::{
    AlertMessage, Bus, BusError, Event, FitDisplay, LiveWatch, LossDisplay, ModelClassDisplay,
    Name, NodeDisplay, NoiseDisplay, ParameterDisplay, Progress, Service, Status, Subscription,
};
use std::collections::BTreeSet;
use std::time::Duration;
use tokio::task::JoinSet;
use tracing::warn;

/// Queue length for values until the next redraw. New values overwrite the oldest, which are
/// counted.
const VALUES_WAITING: usize = 8192;
/// Queue length for alerts and events. They are rare, and none must be lost.
const ALERTS_WAITING: usize = 8192;
/// Queue length for statuses, model classes and progress of ingest. Each structure publishes a few
/// of them per second.
const STATUSES_WAITING: usize = 1024;
/// Time limit for the alert services to reply with their current alerts.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);

/// The subscriptions of a view.
#[derive(Debug)]
pub struct Listening {
    bus: Bus,
    root: Name,
    expressions: KeyExpressions,
    parameters: Subscription<ParameterDisplay>,
    losses: Subscription<LossDisplay>,
    noise: Subscription<NoiseDisplay>,
    classes: Subscription<ModelClassDisplay>,
    fits: Subscription<FitDisplay>,
    nodes: Subscription<NodeDisplay>,
    alerts: Subscription<AlertMessage>,
    events: Subscription<Event>,
    statuses: Subscription<Status>,
    ingested: Subscription<Progress>,
    live: Vec<LiveWatch>,
    present: BTreeSet<Instance>,
    /// Pending queries for the current alerts.
    asked: JoinSet<Result<Vec<(String, AlertMessage)>, BusError>>,
}

impl Listening {
    /// Subscribes, and queries the current alerts.
    ///
    /// # Errors
    /// The session is closed.
    pub async fn start(bus: &Bus, root: &Name, structure: Option<&Name>) -> Result<Self, AppError> {
        let expressions = KeyExpressions::new(root, structure)?;
        let mut live = Vec::new();
        for expression in &expressions.live {
            live.push(bus.watch_live(expression.clone()).await?);
        }
        let mut listening = Self {
            bus: bus.clone(),
            root: root.clone(),
            parameters: bus
                .subscribe(expressions.parameters.clone(), VALUES_WAITING)
                .await?,
            losses: bus
                .subscribe(expressions.losses.clone(), VALUES_WAITING)
                .await?,
            noise: bus
                .subscribe(expressions.noise.clone(), VALUES_WAITING)
                .await?,
            classes: bus
                .subscribe(expressions.classes.clone(), STATUSES_WAITING)
                .await?,
            fits: bus
                .subscribe(expressions.fits.clone(), STATUSES_WAITING)
                .await?,
            nodes: bus
                .subscribe(expressions.nodes.clone(), VALUES_WAITING)
                .await?,
            alerts: bus
                .subscribe(expressions.alerts.clone(), ALERTS_WAITING)
                .await?,
            events: bus
                .subscribe(expressions.events.clone(), ALERTS_WAITING)
                .await?,
            statuses: bus
                .subscribe(expressions.statuses.clone(), STATUSES_WAITING)
                .await?,
            ingested: bus
                .subscribe(expressions.ingested.clone(), STATUSES_WAITING)
                .await?,
            live,
            present: BTreeSet::new(),
            asked: JoinSet::new(),
            expressions,
        };
        listening.ask();
        Ok(listening)
    }

    /// Queries the current alerts. A later call of `gather` collects the reply.
    fn ask(&mut self) {
        let (bus, alerts) = (self.bus.clone(), self.expressions.alerts.clone());
        self.asked
            .spawn(async move { bus.ask(&alerts, ANSWER_WITHIN).await });
    }

    /// Returns all messages since the last call.
    pub fn gather(&mut self) -> Vec<Input> {
        let mut inputs = Vec::new();
        self.gather_present(&mut inputs);
        // Before the values, because it determines which of them are replayed from the recording.
        let words = self.ingested.messages();
        let words = words.try_iter().take(words.len());
        inputs.extend(words.map(|(key, progress)| ingested(&self.root, &key, progress)));
        drain(&self.root, &self.statuses, &mut inputs);
        drain(&self.root, &self.parameters, &mut inputs);
        drain(&self.root, &self.losses, &mut inputs);
        drain(&self.root, &self.noise, &mut inputs);
        drain(&self.root, &self.classes, &mut inputs);
        drain(&self.root, &self.fits, &mut inputs);
        drain(&self.root, &self.nodes, &mut inputs);
        drain(&self.root, &self.alerts, &mut inputs);
        drain(&self.root, &self.events, &mut inputs);
        while let Some(answer) = self.asked.try_join_next() {
            match answer {
                Ok(Ok(alerts)) => inputs.extend(
                    alerts
                        .into_iter()
                        .map(|(key, alert)| standing(&self.root, &key, alert)),
                ),
                Ok(Err(error)) => warn!(%error, "cannot query recent alerts"),
                Err(error) => warn!(%error, "query for recent alerts failed"),
            }
        }
        inputs
    }

    fn gather_present(&mut self, inputs: &mut Vec<Input>) {
        let keys = self.live.iter().flat_map(LiveWatch::present);
        let present: BTreeSet<Instance> =
            keys.filter_map(|key| instance(&self.root, &key)).collect();
        if present == self.present {
            return;
        }
        // A service that restarted or reconnected may have a different state.
        let has_new_alert_service = present
            .difference(&self.present)
            .any(|instance| instance.service == Service::Alert);
        if has_new_alert_service {
            self.ask();
        }
        self.present.clone_from(&present);
        inputs.push(Input::Present(present));
    }

    /// Returns the number of messages that were overwritten before a call of `gather`.
    pub fn overwritten(&self) -> u64 {
        let refused = [
            self.parameters.refused(),
            self.noise.refused(),
            self.classes.refused(),
            self.fits.refused(),
            self.nodes.refused(),
            self.alerts.refused(),
            self.events.refused(),
            self.statuses.refused(),
            self.ingested.refused(),
        ];
        refused.iter().flat_map(|reasons| reasons.values()).sum()
    }
}

fn drain<M: OnTopic + Send + 'static>(
    root: &Name,
    subscription: &Subscription<M>,
    inputs: &mut Vec<Input>,
) {
    let messages = subscription.messages();
    // Leaves later messages in the queue. A source at full speed would otherwise prolong this call.
    inputs.extend(
        messages
            .try_iter()
            .take(messages.len())
            .map(|(key, message)| input(root, &key, message)),
    );
}

fn standing(root: &Name, key: &str, alert: AlertMessage) -> Input {
    match input(root, key, alert) {
        Input::Alert(alert) => Input::StandingAlert(alert),
        other => other,
    }
}

#[cfg(test)]
mod tests;
