//! Subscribes to the display topics, and queries what was published before.

use crate::input::{Input, Instance};
use spandrel_bus::{
    AlertMessage, BoxedFuture, Bus, BusError, ConditionDisplay, HistoryLog, JudgementLog,
    KeyFamily as K, LiveWatch, Message, Name, Service, SpanQuery, Subscription,
};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::warn;

/// Queue length for values at the display rate. At full speed, new values overwrite the oldest,
/// which are counted.
const VALUES_WAITING: usize = 16_384;
/// Queue length for blocks of estimates. A lost block is a gap in a plot.
const BLOCKS_WAITING: usize = 256;
/// Queue length for messages that must not be lost. It far exceeds the number of messages between
/// two calls of [`Listener::gather`].
const ALERTS_WAITING: usize = 8_192;
/// Number of past alerts, acknowledgements and events to query from the history.
const PAST: usize = 1_000;
/// Time limit for a reply of a service.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);
/// Interval between queries for the current alerts.
///
/// A busy network may drop a published change. The alert would otherwise be shown in its former
/// state until its next change.
const ASK_AGAIN_EVERY: Duration = Duration::from_secs(30);

/// A topic, or all topics of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DisplayTopic {
    /// [`Input::Ingested`]. It precedes the values, because it determines which of them are live.
    Ingested,
    /// [`Input::Status`] of all services.
    Statuses,
    /// [`Input::Parameter`]
    Parameters,
    /// [`Input::Loss`]
    Losses,
    /// [`Input::Noise`]
    Noise,
    /// [`Input::Outlier`]
    Outliers,
    /// [`Input::SensorHealth`]
    SensorHealth,
    /// [`Input::Waveform`]
    Waveforms,
    /// [`Input::Spectrum`]
    Spectra,
    /// [`Input::Condition`]
    Conditions,
    /// [`Input::Judgement`]
    Judgements,
    /// [`Input::Mode`]
    Modes,
    /// [`Input::Classes`]
    Classes,
    /// [`Input::Node`]
    Nodes,
    /// [`Input::Fit`]
    Fit,
    /// [`Input::Monitoring`]
    Monitoring,
    /// [`Input::Estimates`]
    Estimates,
    /// [`Input::Acknowledgement`]
    Acknowledgements,
    /// [`Input::Alert`]
    Alerts,
    /// [`Input::Event`]
    Events,
}

/// The part of the bus that a service needs.
#[derive(Clone, Copy, Debug)]
pub struct Needs {
    /// Topics, in the order in which [`Listener::gather`] returns their messages.
    pub topics: &'static [DisplayTopic],
    /// Services whose liveliness tokens are watched. They must include the alert service.
    pub services: &'static [Service],
    /// Services whose logs are queried when they appear: of the alert service, the history service
    /// and the service `judge`.
    pub logs: &'static [Service],
}

/// The subscriptions to one structure, or to all below a root.
///
/// Whenever an alert service appears, it queries the current alerts, because the service may have
/// restarted. It repeats this query, because a published change may be lost. Whenever a feed
/// appears, it queries the latest values of the conditions.
#[derive(Debug)]
pub struct Listener {
    at: StructureScope,
    needs: Needs,
    queues: Vec<Box<dyn Queue>>,
    live: Vec<LiveWatch>,
    present: BTreeSet<Instance>,
    asked: JoinSet<Result<Vec<Input>, BusError>>,
    ask_again_at: Instant,
    taken: u64,
}

impl Listener {
    /// Subscribes to one structure, or to all below the root.
    ///
    /// # Errors
    /// Returns an error if Zenoh rejects a key expression or the session is closed.
    pub fn start<'a>(
        bus: &'a Bus,
        root: &'a Name,
        structure: Option<&'a Name>,
        needs: Needs,
    ) -> BoxedFuture<'a, Result<Self, BusError>> {
        let at = StructureScope {
            bus: bus.clone(),
            root: root.clone(),
            structure: structure.cloned(),
        };
        Box::pin(async move {
            let mut live = Vec::new();
            for service in needs.services {
                live.push(bus.watch_live(at.key(K::Live(*service))).await?);
            }
            let mut queues = Vec::new();
            for topic in needs.topics {
                queues.push(at.subscribe(*topic).await?);
            }
            let mut asked = JoinSet::new();
            // The log and the current alerts belong together, and only a present service replies to
            // the query for its log.
            if !needs.logs.contains(&Service::Alert) {
                asked.spawn(at.clone().alerts());
            }
            Ok(Self {
                at,
                needs,
                queues,
                live,
                present: BTreeSet::new(),
                asked,
                ask_again_at: Instant::now() + ASK_AGAIN_EVERY,
                taken: 0,
            })
        })
    }

    /// Returns all inputs since the last call.
    pub fn gather(&mut self) -> Vec<Input> {
        let mut inputs: Vec<Input> = self.newly_present().into_iter().collect();
        self.ask_again();
        let before = inputs.len();
        for queue in &self.queues {
            queue.take(&self.at.root, &mut inputs);
        }
        let is_taken = |input: &&Input| !matches!(input, Input::Misplaced);
        self.taken += inputs[before..].iter().filter(is_taken).count() as u64;
        while let Some(answer) = self.asked.try_join_next() {
            match answer {
                Ok(Ok(past)) => inputs.extend(past),
                Ok(Err(error)) => warn!(%error, "cannot query earlier alerts and events"),
                Err(error) => warn!(%error, "query for earlier alerts and events failed"),
            }
        }
        inputs
    }

    /// Returns the present instances if they have changed, and queries new services.
    fn newly_present(&mut self) -> Option<Input> {
        let keys = self.live.iter().flat_map(LiveWatch::present);
        let present: BTreeSet<Instance> = keys
            .filter_map(|key| Instance::of_token(&self.at.root, &key))
            .collect();
        if present == self.present {
            return None;
        }
        let is_new = |wanted: Service| {
            let mut new = present.difference(&self.present);
            new.any(|instance| instance.service == wanted)
        };
        let is_logged = |service| self.needs.logs.contains(&service);
        match (is_new(Service::Alert), is_logged(Service::Alert)) {
            (true, true) => drop(self.asked.spawn(self.at.clone().alerts_with_log())),
            (true, false) => drop(self.asked.spawn(self.at.clone().alerts())),
            (false, _) => {}
        }
        if is_new(Service::History) && is_logged(Service::History) {
            self.asked.spawn(self.at.clone().past());
        }
        if is_new(Service::Judge) && is_logged(Service::Judge) {
            self.asked.spawn(self.at.clone().lasting_losses());
        }
        // A slow quantity has its next value perhaps in an hour.
        if is_new(Service::Feed) && self.needs.topics.contains(&DisplayTopic::Conditions) {
            self.asked.spawn(self.at.clone().conditions());
        }
        self.present.clone_from(&present);
        Some(Input::Present(present))
    }

    /// Queries the current alerts again if it is time.
    fn ask_again(&mut self) {
        let now = Instant::now();
        let has_alerts = |instance: &Instance| instance.service == Service::Alert;
        if now >= self.ask_again_at && self.present.iter().any(has_alerts) {
            self.ask_again_at = now + ASK_AGAIN_EVERY;
            self.asked.spawn(self.at.clone().alerts());
        }
    }

    /// Returns the number of messages that [`Self::gather`] has returned, without misplaced ones.
    #[must_use]
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// Returns the number of overwritten and rejected messages by reason, as in a status.
    #[must_use]
    pub fn refused(&self) -> BTreeMap<String, u64> {
        let mut sum = BTreeMap::new();
        for (reason, count) in self.queues.iter().flat_map(|queue| queue.refused()) {
            let reason = match reason {
                "overwritten" => reason.to_owned(),
                _ => format!("refused-{reason}"),
            };
            *sum.entry(reason).or_default() += count;
        }
        sum
    }
}

/// The messages of one subscription, regardless of their type.
trait Queue: fmt::Debug + Send + Sync {
    /// Appends the waiting messages.
    fn take(&self, root: &Name, inputs: &mut Vec<Input>);

    fn refused(&self) -> BTreeMap<&'static str, u64>;
}

#[derive(Debug)]
struct QueueOf<M> {
    subscription: Subscription<M>,
    input: fn(Name, M) -> Input,
}

impl<M: Message + fmt::Debug + Send + 'static> Queue for QueueOf<M> {
    fn take(&self, root: &Name, inputs: &mut Vec<Input>) {
        let messages = self.subscription.messages();
        // Leaves later messages in the queue. A source at full speed would otherwise prolong this
        // call.
        let waiting = messages.try_iter().take(messages.len());
        inputs.extend(waiting.map(|(key, message)| {
            Input::placed(root, &key, |structure| (self.input)(structure, message))
        }));
    }

    fn refused(&self) -> BTreeMap<&'static str, u64> {
        self.subscription.refused()
    }
}

/// A structure, or all structures below a root.
#[derive(Clone, Debug)]
struct StructureScope {
    bus: Bus,
    root: Name,
    structure: Option<Name>,
}

impl StructureScope {
    fn key(&self, family: K) -> String {
        let (root, structure) = (&self.root, self.structure.as_ref());
        let of_all_services = match family {
            K::Status(_) => family.expression_of_all_services(root, structure),
            _ => None,
        };
        of_all_services.unwrap_or_else(|| family.expression(root, structure, None))
    }

    async fn subscribe(&self, topic: DisplayTopic) -> Result<Box<dyn Queue>, BusError> {
        use DisplayTopic as T;
        let ingest = Service::Ingest;
        match topic {
            T::Ingested => self.queue(K::Progress(ingest), Input::Ingested).await,
            T::Statuses => self.queue(K::Status(ingest), |_, m| Input::Status(m)).await,
            T::Parameters => self.queue(K::Parameter, |_, m| Input::Parameter(m)).await,
            T::Losses => self.queue(K::Loss, |_, m| Input::Loss(m)).await,
            T::Noise => self.queue(K::Noise, |_, m| Input::Noise(m)).await,
            T::Outliers => self.queue(K::Outlier, |_, m| Input::Outlier(m)).await,
            T::SensorHealth => {
                self.queue(K::SensorHealth, |_, m| Input::SensorHealth(m))
                    .await
            }
            T::Waveforms => self.queue(K::Waveform, |_, m| Input::Waveform(m)).await,
            T::Spectra => self.queue(K::Spectrum, |_, m| Input::Spectrum(m)).await,
            T::Conditions => self.queue(K::Condition, |_, m| Input::Condition(m)).await,
            T::Judgements => self.queue(K::Judgement, |_, m| Input::Judgement(m)).await,
            T::Modes => self.queue(K::Mode, |_, m| Input::Mode(Box::new(m))).await,
            T::Classes => self.queue(K::ModelClass, |_, m| Input::Classes(m)).await,
            T::Nodes => self.queue(K::Node, |_, m| Input::Node(m)).await,
            T::Fit => self.queue(K::Fit, |_, m| Input::Fit(m)).await,
            T::Monitoring => self.queue(K::Monitoring, |_, m| Input::Monitoring(m)).await,
            T::Estimates => self.queue(K::Estimates, Input::Estimates).await,
            T::Acknowledgements => {
                self.queue(K::Acknowledge, |_, m| Input::Acknowledgement(m))
                    .await
            }
            T::Alerts => self.queue(K::Alert, |_, m| Input::Alert(m)).await,
            T::Events => self.queue(K::Event, |_, m| Input::Event(m)).await,
        }
    }

    async fn queue<M: Message + fmt::Debug + Send + 'static>(
        &self,
        family: K,
        input: fn(Name, M) -> Input,
    ) -> Result<Box<dyn Queue>, BusError> {
        let length = match family {
            K::Estimates => BLOCKS_WAITING,
            K::Alert | K::Acknowledge | K::Event | K::Status(_) | K::Progress(_) => ALERTS_WAITING,
            _ => VALUES_WAITING,
        };
        let subscription = self.bus.subscribe(self.key(family), length).await?;
        Ok(Box::new(QueueOf {
            subscription,
            input,
        }))
    }

    /// Queries the current alerts.
    async fn alerts(self) -> Result<Vec<Input>, BusError> {
        let key = self.key(K::Alert);
        let alerts = self.bus.ask_present(&key, ANSWER_WITHIN).await?;
        let standing = |(key, alert): (String, AlertMessage)| {
            Input::placed(&self.root, &key, |_| Input::StandingAlert(alert))
        };
        Ok(alerts.into_iter().map(standing).collect())
    }

    /// Queries the latest values of the conditions from a feed that is present.
    async fn conditions(self) -> Result<Vec<Input>, BusError> {
        let key = self.key(K::Condition);
        let found = self.bus.ask_present(&key, ANSWER_WITHIN).await?;
        #[expect(
            clippy::disallowed_methods,
            reason = "the age of a value that was measured before the query"
        )]
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        let now = now.unwrap_or_default();
        let standing = |(key, message): (String, ConditionDisplay)| {
            let measured = Duration::from_nanos(message.time_ns.max(0).unsigned_abs());
            Input::placed(&self.root, &key, |_| {
                Input::StandingCondition(message, now.saturating_sub(measured))
            })
        };
        Ok(found.into_iter().map(standing).collect())
    }

    /// Queries the last changes of alerts, and then the current alerts.
    async fn alerts_with_log(self) -> Result<Vec<Input>, BusError> {
        let logged = self.logs(&self.key(K::AlertLog)).await?;
        let alerts = logged.into_iter().flat_map(|log| {
            let is_own = move |alert: &AlertMessage| alert.structure == log.structure;
            log.alerts.into_iter().filter(is_own)
        });
        let mut inputs: Vec<Input> = alerts.map(Input::LoggedAlert).collect();
        inputs.extend(self.alerts().await?);
        Ok(inputs)
    }

    /// Queries past changes and events from the history service.
    async fn past(self) -> Result<Vec<Input>, BusError> {
        let query = SpanQuery {
            points: PAST,
            ..SpanQuery::default()
        };
        let key = format!("{}?{query}", self.key(K::HistoryLog));
        let logs = self.logs(&key).await?;
        Ok(logs.into_iter().map(Input::Past).collect())
    }

    /// Queries past changes of lasting losses from a service `judge` that is present.
    async fn lasting_losses(self) -> Result<Vec<Input>, BusError> {
        let key = self.key(K::JudgementLog);
        let logs = self.bus.ask_present(&key, ANSWER_WITHIN).await?;
        let placed = |(key, log): (String, JudgementLog)| {
            Input::placed(&self.root, &key, |_| Input::LastingLosses(log))
        };
        Ok(logs.into_iter().map(placed).collect())
    }

    /// Returns the replies of a service that is present, without those for other structures.
    async fn logs(&self, key: &str) -> Result<Vec<HistoryLog>, BusError> {
        let logs: Vec<(String, HistoryLog)> = self.bus.ask_present(key, ANSWER_WITHIN).await?;
        let is_wanted = |log: &HistoryLog| {
            let structure = self.structure.as_ref();
            structure.is_none_or(|structure| *structure == log.structure)
        };
        let logs = logs.into_iter().map(|(_, log)| log);
        Ok(logs.filter(is_wanted).collect())
    }
}

#[cfg(test)]
mod tests;
