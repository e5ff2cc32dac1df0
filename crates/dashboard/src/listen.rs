//! Subscribes to all topics for display of one structure.

use crate::store::Input;
use spandrel_bus::{
    Acknowledgement, AlertMessage, Bus, BusError, EstimateBlock, Event, FitDisplay, HistoryLog,
    KeyFamily, Keys, LiveWatch, LossDisplay, ModelClassDisplay, Name, NodeDisplay, NoiseDisplay,
    OutlierDisplay, ParameterDisplay, Progress, ProgressWatch, Service, SpanQuery, Status,
    Subscription, Topic, parse_key,
};
use std::collections::BTreeSet;
use std::time::Duration;
use tokio::task::JoinSet;
use tracing::warn;

/// Queue length for values at the display rate. At full speed, new values overwrite the oldest,
/// which are counted.
const VALUES_WAITING: usize = 8_192;
/// Queue length for blocks of estimates. Only the innovations are used, so a lost block is a gap in
/// a plot.
const BLOCKS_WAITING: usize = 256;
/// Queue length for alerts and other messages that must not be lost. It far exceeds the number of
/// messages per tick.
const ALERTS_WAITING: usize = 4_096;
/// Number of past alerts, acknowledgements and events to query from the history.
const PAST: usize = 1_000;
/// Time limit for the alert service to reply with its current alerts.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);

/// All subscriptions of one structure.
#[derive(Debug)]
pub(crate) struct Listening {
    bus: Bus,
    keys: Keys,
    parameters: Subscription<ParameterDisplay>,
    losses: Subscription<LossDisplay>,
    noise: Subscription<NoiseDisplay>,
    outliers: Subscription<OutlierDisplay>,
    classes: Subscription<ModelClassDisplay>,
    nodes: Subscription<NodeDisplay>,
    fits: Subscription<FitDisplay>,
    estimates: Subscription<EstimateBlock>,
    alerts: Subscription<AlertMessage>,
    acknowledgements: Subscription<Acknowledgement>,
    events: Subscription<Event>,
    statuses: Subscription<Status>,
    ingested: ProgressWatch,
    last_ingested: Option<Progress>,
    live: Vec<LiveWatch>,
    present: BTreeSet<(Service, Name)>,
    asked: JoinSet<Result<Vec<(String, AlertMessage)>, BusError>>,
    past: JoinSet<Result<Vec<(String, HistoryLog)>, BusError>>,
}

impl Listening {
    pub(crate) async fn start(bus: &Bus, keys: &Keys) -> Result<Self, BusError> {
        let mut live = Vec::new();
        for service in Service::ALL {
            live.push(bus.watch_live(keys.all_live(service)).await?);
        }
        let mut listening = Self {
            parameters: bus.subscribe(keys.all_parameters(), VALUES_WAITING).await?,
            losses: bus.subscribe(keys.all_losses(), VALUES_WAITING).await?,
            noise: bus.subscribe(keys.all_noise(), VALUES_WAITING).await?,
            outliers: bus.subscribe(keys.all_outliers(), VALUES_WAITING).await?,
            classes: bus.subscribe(keys.model_class(), VALUES_WAITING).await?,
            nodes: bus.subscribe(keys.all_nodes(), VALUES_WAITING).await?,
            fits: bus.subscribe(keys.fit(), VALUES_WAITING).await?,
            estimates: bus.subscribe(keys.estimates(), BLOCKS_WAITING).await?,
            alerts: bus.subscribe(keys.all_alerts(), ALERTS_WAITING).await?,
            acknowledgements: bus
                .subscribe(keys.all_acknowledgements(), ALERTS_WAITING)
                .await?,
            events: bus.subscribe(keys.event(), ALERTS_WAITING).await?,
            statuses: bus.subscribe(keys.all_statuses(), ALERTS_WAITING).await?,
            ingested: bus.watch_progress(keys.progress(Service::Ingest)).await?,
            last_ingested: None,
            live,
            present: BTreeSet::new(),
            asked: JoinSet::new(),
            past: JoinSet::new(),
            bus: bus.clone(),
            keys: keys.clone(),
        };
        listening.ask();
        Ok(listening)
    }

    /// Queries the current alerts. A later call of `gather` collects the reply.
    fn ask(&mut self) {
        let (bus, alerts) = (self.bus.clone(), self.keys.all_alerts());
        self.asked
            .spawn(async move { bus.ask(&alerts, ANSWER_WITHIN).await });
    }

    /// Queries past changes. A later call of `gather` collects the reply.
    fn ask_past(&mut self) {
        let log = format!(
            "{}?{}",
            self.keys.history_log(),
            SpanQuery {
                points: PAST,
                ..SpanQuery::default()
            }
        );
        let bus = self.bus.clone();
        self.past
            .spawn(async move { bus.ask_present(&log, ANSWER_WITHIN).await });
    }

    /// Appends all messages since the last call. Drops messages that contradict their key.
    pub(crate) fn gather(&mut self, inputs: &mut Vec<Input>) {
        self.gather_present(inputs);
        // Before the values, because it determines which of them are live.
        let ingested = self.ingested.latest();
        if ingested != self.last_ingested {
            inputs.extend(ingested.clone().map(Input::Ingested));
            self.last_ingested = ingested;
        }
        let keys = self.keys.clone();
        let root = keys.root();
        inputs.extend(self.statuses.gather(root, |_| None).map(Input::Status));
        let of_parameter = |m: &ParameterDisplay| Topic::new(KeyFamily::Parameter, &m.parameter);
        let parameters = self
            .parameters
            .gather(root, |m| Some((&m.structure, of_parameter(m))));
        inputs.extend(parameters.map(Input::Parameter));
        let losses = self.losses.gather(root, |m| {
            Some((&m.structure, Topic::new(KeyFamily::Loss, &m.parameter)))
        });
        inputs.extend(losses.map(Input::Loss));
        let noise = self.noise.gather(root, |m| {
            Some((&m.structure, Topic::new(KeyFamily::Noise, &m.name)))
        });
        inputs.extend(noise.map(Input::Noise));
        let outliers = self.outliers.gather(root, |m| {
            Some((&m.structure, Topic::new(KeyFamily::Outlier, &m.channel)))
        });
        inputs.extend(outliers.map(Input::Outlier));
        let classes = self.classes.gather(root, |m| {
            Some((&m.structure, Topic::single(KeyFamily::ModelClass)))
        });
        inputs.extend(classes.map(Input::Classes));
        let nodes = self.nodes.gather(root, |m| {
            Some((&m.structure, Topic::new(KeyFamily::Node, &m.node)))
        });
        inputs.extend(nodes.map(Input::Node));
        let fits = self.fits.gather(root, |m| {
            Some((&m.structure, Topic::single(KeyFamily::Fit)))
        });
        inputs.extend(fits.map(Input::Fit));
        inputs.extend(self.estimates.gather(root, |_| None).map(Input::Estimates));
        let of_acknowledgement =
            |m: &Acknowledgement| Topic::new(KeyFamily::Acknowledge, &m.parameter);
        let acknowledgements = self
            .acknowledgements
            .gather(root, |m| Some((&m.structure, of_acknowledgement(m))));
        inputs.extend(acknowledgements.map(Input::Acknowledgement));
        let alerts = self.alerts.gather(root, |m| {
            Some((&m.structure, Topic::new(KeyFamily::Alert, &m.parameter)))
        });
        inputs.extend(alerts.map(Input::Alert));
        let events = self.events.gather(root, |m| {
            Some((&m.structure, Topic::single(KeyFamily::Event)))
        });
        inputs.extend(events.map(Input::Event));
        while let Some(answer) = self.asked.try_join_next() {
            match answer {
                Ok(Ok(alerts)) => inputs.extend(
                    alerts
                        .into_iter()
                        .map(|(_, alert)| Input::StandingAlert(alert)),
                ),
                Ok(Err(error)) => warn!(%error, "cannot query recent alerts"),
                Err(error) => warn!(%error, "query for recent alerts failed"),
            }
        }
        while let Some(answer) = self.past.try_join_next() {
            match answer {
                Ok(Ok(logs)) => inputs.extend(logs.into_iter().map(|(_, log)| Input::Past(log))),
                Ok(Err(error)) => warn!(%error, "cannot query earlier events"),
                Err(error) => warn!(%error, "query for earlier events failed"),
            }
        }
    }

    fn gather_present(&mut self, inputs: &mut Vec<Input>) {
        let keys = self.live.iter().flat_map(LiveWatch::present);
        let instance = |key: String| match parse_key(self.keys.root(), &key)? {
            (
                _,
                Topic {
                    family: KeyFamily::Live(service),
                    of: Some(id),
                },
            ) => Some((service, id)),
            _ => None,
        };
        let present: BTreeSet<(Service, Name)> = keys.filter_map(instance).collect();
        if present == self.present {
            return;
        }
        // A service that restarted or reconnected may have a different state.
        let new = |wanted: Service| {
            present
                .difference(&self.present)
                .any(|(service, _)| *service == wanted)
        };
        let (has_alerts, has_history) = (new(Service::Alert), new(Service::History));
        if has_alerts {
            self.ask();
        }
        if has_history {
            self.ask_past();
        }
        self.present.clone_from(&present);
        inputs.push(Input::Present(present));
    }

    /// Returns the number of overwritten and rejected messages by reason.
    pub(crate) fn refused(&self) -> std::collections::BTreeMap<String, u64> {
        let all = [
            self.parameters.refused(),
            self.losses.refused(),
            self.noise.refused(),
            self.outliers.refused(),
            self.classes.refused(),
            self.nodes.refused(),
            self.estimates.refused(),
            self.alerts.refused(),
            self.acknowledgements.refused(),
            self.events.refused(),
            self.statuses.refused(),
        ];
        let mut sum = std::collections::BTreeMap::new();
        for (reason, count) in all.into_iter().flatten() {
            let reason = if reason == "overwritten" {
                reason.to_owned()
            } else {
                format!("refused-{reason}")
            };
            *sum.entry(reason).or_default() += count;
        }
        sum
    }
}
