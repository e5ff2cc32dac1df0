//! Joins the watch on one structure to the bus.

use std::collections::BTreeMap;
use std::future::Future;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Block, Bus, Delivery, DisplayPublisher, EstimateBlock, Keys,
    LatestPublisher, LiveToken, Name, ProgressPublisher, Service, Start, Status, Stream, Subscription,
};
use spandrel_structure::Structure;
use tracing::{info, warn};

use crate::{Acknowledged, Alert, AlertError, Baseline, Watch};

/// How often the status is put.
const STATUS_EVERY: Duration = Duration::from_secs(1);
/// Acknowledgements waiting; when more come at once the oldest is lost and counted, and its sender sees no change.
const ACKNOWLEDGEMENTS_WAITING: usize = 64;

/// The alert service of one structure.
#[derive(Debug)]
pub struct AlertService {
    watch: Watch,
    estimates: Stream<EstimateBlock>,
    acknowledgements: Subscription<Acknowledgement>,
    /// By number of the parameter; each gives its last alert on query too.
    alerts: Vec<AlertTopic>,
    progress: ProgressPublisher,
    status: DisplayPublisher<Status>,
    keys: Keys,
    service: Name,
    id: Name,
    token: Option<LiveToken>,
    done: u64,
    last_time_ns: Option<i64>,
    refused: BTreeMap<&'static str, u64>,
}

/// The alerts of one parameter.
#[derive(Debug)]
struct AlertTopic {
    parameter: Name,
    publisher: LatestPublisher<AlertMessage>,
    /// Whether anything has been put: before that nobody can know how the parameter stands.
    is_told: bool,
}

impl AlertService {
    /// Checks everything and joins the bus; `id` names this instance. References that would be learnt are taken from
    /// `baseline` where it knows the parameter.
    ///
    /// # Errors
    /// When the rules are not consistent with the structure, a name is no key, or the bus refuses a declaration.
    pub async fn start(
        structure: &Structure,
        baseline: Option<&Baseline>,
        bus: &Bus,
        keys: Keys,
        id: Name,
    ) -> Result<Self, AlertError> {
        let watch = Watch::new(structure, baseline)?;
        let service_name = name(Service::Alert.as_str())?;
        let mut alerts = Vec::new();
        for parameter in structure.parameters() {
            let parameter = name(parameter.name())?;
            let publisher = bus.publish_latest(keys.alert(&parameter)).await?;
            alerts.push(AlertTopic { parameter, publisher, is_told: false });
        }
        let acknowledgements = bus.subscribe(keys.all_acknowledgements(), ACKNOWLEDGEMENTS_WAITING).await?;
        let settings = bus.reading(Start::Beginning);
        let parameters = structure.parameters().len();
        let is_of_structure = move |block: &EstimateBlock| match usize::from(block.parameters) == parameters {
            true => Ok(()),
            false => Err("estimates-of-another-structure"),
        };
        let service = Self {
            estimates: bus.follow_fit(keys.estimates(), keys.estimates_buffer(), settings, is_of_structure).await?,
            acknowledgements,
            progress: bus.publish_progress(keys.progress(Service::Alert), id.to_string()).await?,
            status: bus.publish_display(keys.status(Service::Alert, &id)).await?,
            token: Some(bus.announce(keys.live(Service::Alert, &id)).await?),
            watch,
            alerts,
            keys,
            service: service_name,
            id,
            done: 0,
            last_time_ns: None,
            refused: BTreeMap::new(),
        };
        info!(
            structure = service.keys.structure().as_str(),
            rules = structure.alert_rules().len(),
            parameters = service.alerts.len(),
            "alerts ready"
        );
        Ok(service)
    }

    /// Runs until `stop`; estimates that have arrived are still decided.
    ///
    /// # Errors
    /// When the bus is closed underneath.
    pub async fn run(mut self, stop: impl Future<Output = ()>) -> Result<(), AlertError> {
        tokio::pin!(stop);
        let mut status = tokio::time::interval(STATUS_EVERY);
        let deliveries = self.estimates.deliveries().clone();
        let acknowledgements = self.acknowledgements.messages().clone();
        loop {
            tokio::select! {
                biased; // people first: estimates may come without a pause; stop last: what has arrived is still decided
                Ok((key, acknowledgement)) = acknowledgements.recv_async() => {
                    self.acknowledge(&key, acknowledgement).await?;
                }
                _ = status.tick() => self.put_status().await?,
                delivery = deliveries.recv_async() => match delivery {
                    Ok(Delivery::Block(block)) => self.decide(&block).await?,
                    Ok(Delivery::Gap(_)) => {} // logged by the stream; the watch sees it in the number of the next block
                    Err(flume::RecvError::Disconnected) => break,
                },
                () = &mut stop => break,
            }
        }
        if let Some(token) = self.token.take() {
            token.withdraw().await?;
        }
        Ok(())
    }

    async fn decide(&mut self, block: &EstimateBlock) -> Result<(), AlertError> {
        let mut alerts = Vec::new();
        // A block that was fetched may hold thousands of frames: too long for a thread of the runtime.
        let decided = tokio::task::block_in_place(|| self.watch.handle_block(block, &mut alerts));
        if let Err(error) = decided {
            self.refuse("estimates-of-another-structure", &error);
        }
        self.publish(alerts).await?;
        self.publish_first().await?;
        self.done = block.end();
        if let (Some(grid), Some(last)) = (block.grid(), block.end().checked_sub(1)) {
            self.last_time_ns = Some(grid.time_ns(last));
        }
        self.progress.set(block.header.epoch, self.done, self.last_time_ns.unwrap_or(i64::MIN));
        Ok(())
    }

    async fn acknowledge(&mut self, key: &str, acknowledgement: Acknowledgement) -> Result<(), AlertError> {
        let Acknowledgement { structure, parameter, who, note, .. } = acknowledgement;
        let index = self.alerts.iter().position(|topic| topic.parameter == parameter);
        let is_on_its_key = structure == *self.keys.structure() && key == self.keys.acknowledge(&parameter);
        let Some(index) = index.filter(|_| is_on_its_key) else {
            *self.refused.entry("acknowledgement-on-another-key").or_default() += 1;
            return Ok(());
        };
        let mut alerts = Vec::new();
        let is_taken = self.watch.acknowledge(index, &Acknowledged { who, note }, &mut alerts);
        if !is_taken {
            *self.refused.entry("acknowledgement-without-alert").or_default() += 1;
        }
        self.publish(alerts).await
    }

    /// Puts each change; then again what stands for the parameter, if that is the alert of another rule.
    async fn publish(&mut self, alerts: Vec<Alert>) -> Result<(), AlertError> {
        let structure = self.keys.structure();
        let mut last_put: BTreeMap<usize, Alert> = BTreeMap::new();
        for alert in alerts {
            if let Some(topic) = self.alerts.get_mut(alert.parameter) {
                topic.is_told = true;
                log(structure, &topic.parameter, &alert);
                topic.publisher.put(&alert.to_message(structure, &topic.parameter)).await?;
                last_put.insert(alert.parameter, alert);
            }
        }
        for (parameter, last) in last_put {
            let standing = self.watch.standing(parameter).filter(|standing| standing.rule != last.rule);
            if let (Some(topic), Some(standing)) = (self.alerts.get(parameter), standing) {
                topic.publisher.put(&standing.to_message(structure, &topic.parameter)).await?;
            }
        }
        Ok(())
    }

    /// Puts where a parameter stands that has not changed since the first estimate: who comes later, and who remembers an
    /// earlier life of this service, learns that it is normal.
    async fn publish_first(&mut self) -> Result<(), AlertError> {
        let structure = self.keys.structure();
        for (index, topic) in self.alerts.iter_mut().enumerate().filter(|(_, topic)| !topic.is_told) {
            if let Some(alert) = self.watch.unannounced(index) {
                topic.publisher.put(&alert.to_message(structure, &topic.parameter)).await?;
                topic.is_told = true;
            }
        }
        Ok(())
    }

    /// Counted always, logged each time the count has doubled.
    fn refuse(&mut self, reason: &'static str, error: &AlertError) {
        let count = self.refused.entry(reason).or_default();
        *count += 1;
        if count.is_power_of_two() {
            warn!(structure = self.keys.structure().as_str(), %error, reason, count = *count, "estimates refused");
        }
    }

    async fn put_status(&self) -> Result<(), AlertError> {
        #[expect(clippy::disallowed_methods, reason = "the status tells the lag behind the wall clock")]
        let now = SystemTime::now();
        let now_ns = now.duration_since(UNIX_EPOCH).map_or(0, |elapsed| elapsed.as_nanos() as i64);
        let mut drops = self.estimates.counts().drops();
        let unread = self.acknowledgements.refused().into_iter();
        drops.extend(unread.map(|(reason, count)| (format!("acknowledgement-{reason}"), count)));
        drops.extend(self.refused.iter().map(|(reason, count)| ((*reason).to_owned(), *count)));
        let status = Status {
            structure: self.keys.structure().clone(),
            service: self.service.clone(),
            id: self.id.clone(),
            time_ns: now_ns,
            lag_s: self.last_time_ns.map(|time_ns| now_ns.saturating_sub(time_ns) as f64 / 1e9),
            done: self.done,
            drops,
            restarts: 0,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        Ok(self.status.put(&status).await?)
    }
}

fn name(text: &str) -> Result<Name, AlertError> {
    Name::new(text).map_err(|source| AlertError::Name { found: text.to_owned(), source })
}

fn log(structure: &Name, parameter: &Name, alert: &Alert) {
    let (structure, parameter, why) = (structure.as_str(), parameter.as_str(), alert.why.as_str());
    match alert.state {
        AlertState::Raised => warn!(structure, parameter, why, "alert raised"),
        state => info!(structure, parameter, state = state.as_str(), why, "alert changed"),
    }
}
