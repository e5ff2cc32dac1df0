//! Joins the watch on one structure to the bus.

use std::collections::{BTreeMap, VecDeque};
use std::future::Future;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Block, BoxedFuture, Bus, Delivery, DisplayPublisher,
    EstimateBlock, HistoryLog, Keys, LatestPublisher, LiveToken, Name, ProgressPublisher, Question,
    Questions, Service, Start, Status, Stream, Subscription,
};
use spandrel_checkpoint::Remembering;
use spandrel_structure::Structure;
use tracing::{debug, info, warn};

use crate::memory::{AlertState as Remembered, Basis, Memory, note};
use crate::{Acknowledged, Alert, AlertError, Baseline, Watch};

/// How often the status is put.
const STATUS_EVERY: Duration = Duration::from_secs(1);
/// Acknowledgements waiting; when more come at once the oldest is lost and counted, and its sender sees no change.
const ACKNOWLEDGEMENTS_WAITING: usize = 64;
/// Queries for the last changes that wait.
const QUESTIONS_WAITING: usize = 16;

/// Parameters times frames up to which a block is decided on within some hundred microseconds: to lend a thread for that costs more.
const BRIEF: usize = 1_000;

/// The alert service of one structure.
#[derive(Debug)]
pub struct AlertService {
    basis: Basis,
    watch: Watch,
    estimates: Stream<EstimateBlock>,
    acknowledgements: Subscription<Acknowledgement>,
    /// By number of the parameter, also of those that the structure file has no longer; each gives its last alert on query.
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
    memory: Option<Memory>,
    /// What the last life of this service decided and may not have put.
    unsent: Vec<Alert>,
    /// The last changes, oldest first.
    log: VecDeque<Alert>,
    questions: Questions,
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
    /// `baseline` where it knows the parameter. Where `remembering` says that checkpoints are kept, the service goes on from
    /// the last one, and puts again where each parameter stands; alerts that a changed structure file no longer raises end.
    ///
    /// # Errors
    /// When the rules are not consistent with the structure, a name is no key, the checkpoints cannot be kept, or the bus
    /// refuses a declaration.
    pub fn start<'a>(
        structure: &'a Structure,
        baseline: Option<&'a Baseline>,
        bus: &'a Bus,
        keys: Keys,
        id: Name,
        remembering: Option<&'a Remembering>,
    ) -> BoxedFuture<'a, Result<Self, AlertError>> {
        Box::pin(async move {
            let mut memory = match remembering {
                Some(remembering) => Some(Memory::open(structure, remembering)?),
                None => None,
            };
            let state = begin(structure, baseline, memory.as_mut())?;
            let Remembered {
                basis,
                watch,
                unsent,
                log,
                last_time_ns,
            } = state;
            let start = match watch.position() {
                Some((epoch, sequence)) => Start::At { epoch, sequence },
                None => Start::Beginning,
            };
            let service_name = name(Service::Alert.as_str())?;
            let mut alerts = Vec::new();
            for parameter in &basis.parameters {
                let parameter = name(parameter)?;
                let publisher = bus.publish_latest(keys.alert(&parameter)).await?;
                alerts.push(AlertTopic {
                    parameter,
                    publisher,
                    is_told: false,
                });
            }
            let acknowledgements = bus
                .subscribe(keys.all_acknowledgements(), ACKNOWLEDGEMENTS_WAITING)
                .await?;
            let settings = bus.reading(start).patient(); // an identify service that comes back has them, or makes them again
            let parameters = structure.parameters().len();
            let is_of_structure =
                move |block: &EstimateBlock| match usize::from(block.parameters) == parameters {
                    true => Ok(()),
                    false => Err("estimates-of-another-structure"),
                };
            let progress = bus
                .publish_progress(keys.progress(Service::Alert), id.to_string())
                .await?;
            let done = watch.position().map_or(0, |(epoch, done)| {
                // Sources may wait for what this service did last before it was killed, and could not say.
                progress.set(epoch, done, last_time_ns.unwrap_or(i64::MIN));
                done
            });
            let service = Self {
                estimates: bus
                    .follow_fit(
                        keys.estimates(),
                        keys.estimates_buffer(),
                        settings,
                        is_of_structure,
                    )
                    .await?,
                acknowledgements,
                progress,
                status: bus
                    .publish_display(keys.status(Service::Alert, &id))
                    .await?,
                basis,
                watch,
                alerts,
                service: service_name,
                done,
                last_time_ns,
                refused: BTreeMap::new(),
                memory,
                unsent,
                log,
                questions: bus.questions(keys.alert_log(), QUESTIONS_WAITING).await?,
                // Last, because others ask when they see it: who answers is there by then.
                token: Some(bus.announce(keys.live(Service::Alert, &id)).await?),
                id,
                keys,
            };
            info!(
                structure = service.keys.structure().as_str(),
                rules = structure.alert_rules().len(),
                parameters,
                "alerts ready"
            );
            Ok(service)
        })
    }

    /// Runs until `stop`; estimates that have arrived are still decided.
    ///
    /// # Errors
    /// When the bus is closed underneath.
    pub fn run<'a>(
        self,
        stop: impl Future<Output = ()> + Send + 'a,
    ) -> BoxedFuture<'a, Result<(), AlertError>> {
        self.run_until(Box::pin(stop))
    }

    fn run_until(
        mut self,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), AlertError>> {
        Box::pin(async move {
            let mut status = tokio::time::interval(STATUS_EVERY);
            let deliveries = self.estimates.deliveries().clone();
            let acknowledgements = self.acknowledgements.messages().clone();
            self.put_again().await?;
            loop {
                tokio::select! {
                    biased; // people first: estimates may come without a pause
                    Ok((key, acknowledgement)) = acknowledgements.recv_async() => {
                        self.acknowledge(&key, acknowledgement).await?;
                    }
                    Some(question) = self.questions.next() => self.answer(&question).await?,
                    _ = status.tick() => self.put_status().await?,
                    () = &mut stop => break,
                    delivery = deliveries.recv_async() => match delivery {
                        Ok(delivery) => self.take(delivery).await?,
                        Err(flume::RecvError::Disconnected) => break,
                    },
                }
            }
            // what has arrived by now is still decided, and not what an identification of another process goes on to put
            for delivery in deliveries.drain() {
                self.take(delivery).await?;
            }
            self.keep(Vec::new());
            if let Some(token) = self.token.take() {
                token.withdraw().await?;
            }
            Ok(())
        })
    }

    /// Puts what the last life of this service may not have put, and where each parameter stands: who was not there then
    /// learns it, who was knows it by its key.
    async fn put_again(&mut self) -> Result<(), AlertError> {
        let unsent = std::mem::take(&mut self.unsent);
        self.publish(unsent).await?;
        let structure = self.keys.structure();
        for (parameter, topic) in self.alerts.iter_mut().enumerate() {
            let standing = self.watch.standing(parameter);
            if let Some(standing) = standing {
                topic
                    .publisher
                    .put(&standing.to_message(structure, &topic.parameter))
                    .await?;
            }
            topic.is_told = standing.is_some(); // the end of an alert of a former rule says nothing of another one
        }
        Ok(())
    }

    /// Keeps what has been decided; returns the alerts that follow from the last block, which may be put from then on.
    fn keep(&mut self, alerts: Vec<Alert>) -> Vec<Alert> {
        alerts.iter().for_each(|alert| note(&mut self.log, alert));
        let Some(memory) = &mut self.memory else {
            return alerts;
        };
        let (watch, log) = (self.watch.clone(), self.log.clone());
        let basis = self.basis.clone();
        let state = Remembered {
            basis,
            watch,
            unsent: alerts,
            log,
            last_time_ns: self.last_time_ns,
        };
        tokio::task::block_in_place(|| memory.keep(&state));
        state.unsent
    }

    /// Tells the last changes.
    async fn answer(&self, question: &Question) -> Result<(), AlertError> {
        let structure = self.keys.structure();
        let named = |alert: &Alert| {
            let topic = self.alerts.get(alert.parameter)?;
            Some(alert.to_message(structure, &topic.parameter))
        };
        let log = HistoryLog {
            structure: structure.clone(),
            alerts: self.log.iter().filter_map(named).collect(),
            acknowledgements: Vec::new(),
            events: Vec::new(),
        };
        Ok(question.answer(&self.keys.alert_log(), &log).await?)
    }

    async fn take(&mut self, delivery: Delivery<EstimateBlock>) -> Result<(), AlertError> {
        match delivery {
            Delivery::Block(block) => self.decide(&block).await,
            Delivery::Gap(_) => Ok(()), // logged by the stream; the watch sees it in the number of the next block
        }
    }

    async fn decide(&mut self, block: &EstimateBlock) -> Result<(), AlertError> {
        let mut alerts = Vec::new();
        let values = block.estimates.len() * usize::from(block.parameters);
        let decided = match values <= BRIEF {
            true => self.watch.handle_block(block, &mut alerts),
            // A block that was fetched may hold thousands of frames: too long for a thread of the runtime.
            false => tokio::task::block_in_place(|| self.watch.handle_block(block, &mut alerts)),
        };
        if let Err(error) = decided {
            self.refuse("estimates-of-another-structure", &error);
        }
        self.done = block.end();
        if let (Some(grid), Some(last)) = (block.grid(), block.end().checked_sub(1)) {
            self.last_time_ns = Some(grid.time_ns(last));
        }
        if !alerts.is_empty() || self.memory.as_ref().is_some_and(Memory::is_due) {
            alerts = self.keep(alerts);
        }
        self.publish(alerts).await?;
        self.publish_first().await?;
        let epoch = block.header.epoch;
        let kept = self
            .memory
            .as_ref()
            .map_or(self.done, |memory| memory.kept(epoch));
        self.progress.set_kept(
            epoch,
            self.done,
            self.last_time_ns.unwrap_or(i64::MIN),
            kept,
        );
        Ok(())
    }

    async fn acknowledge(
        &mut self,
        key: &str,
        acknowledgement: Acknowledgement,
    ) -> Result<(), AlertError> {
        let Acknowledgement {
            structure,
            parameter,
            who,
            note,
            ..
        } = acknowledgement;
        let index = self
            .alerts
            .iter()
            .position(|topic| topic.parameter == parameter);
        let is_on_its_key =
            structure == *self.keys.structure() && key == self.keys.acknowledge(&parameter);
        let Some(index) = index.filter(|_| is_on_its_key) else {
            *self
                .refused
                .entry("acknowledgement-on-another-key")
                .or_default() += 1;
            return Ok(());
        };
        let mut alerts = Vec::new();
        let is_taken = self
            .watch
            .acknowledge(index, &Acknowledged { who, note }, &mut alerts);
        if !is_taken {
            *self
                .refused
                .entry("acknowledgement-without-alert")
                .or_default() += 1;
        }
        let alerts = if alerts.is_empty() {
            alerts
        } else {
            self.keep(alerts)
        };
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
                topic
                    .publisher
                    .put(&alert.to_message(structure, &topic.parameter))
                    .await?;
                last_put.insert(alert.parameter, alert);
            }
        }
        for (parameter, last) in last_put {
            let standing = self
                .watch
                .standing(parameter)
                .filter(|standing| standing.rule != last.rule);
            if let (Some(topic), Some(standing)) = (self.alerts.get(parameter), standing) {
                topic
                    .publisher
                    .put(&standing.to_message(structure, &topic.parameter))
                    .await?;
            }
        }
        Ok(())
    }

    /// Puts where a parameter stands that has not changed since the first estimate: who comes later, and who remembers an
    /// earlier life of this service, learns that it is normal.
    async fn publish_first(&mut self) -> Result<(), AlertError> {
        let structure = self.keys.structure();
        for (index, topic) in self
            .alerts
            .iter_mut()
            .enumerate()
            .filter(|(_, topic)| !topic.is_told)
        {
            if let Some(alert) = self.watch.unannounced(index) {
                topic
                    .publisher
                    .put(&alert.to_message(structure, &topic.parameter))
                    .await?;
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
        #[expect(
            clippy::disallowed_methods,
            reason = "the status tells the lag behind the wall clock"
        )]
        let now = SystemTime::now();
        let now_ns = now
            .duration_since(UNIX_EPOCH)
            .map_or(0, |elapsed| elapsed.as_nanos() as i64);
        let mut drops = self.estimates.counts().drops();
        let unread = self.acknowledgements.refused().into_iter();
        drops.extend(unread.map(|(reason, count)| (format!("acknowledgement-{reason}"), count)));
        drops.extend(
            self.memory
                .as_ref()
                .and_then(|memory| memory.failures().drops()),
        );
        drops.extend(
            self.refused
                .iter()
                .map(|(reason, count)| ((*reason).to_owned(), *count)),
        );
        let status = Status {
            structure: self.keys.structure().clone(),
            service: self.service.clone(),
            id: self.id.clone(),
            time_ns: now_ns,
            lag_s: self
                .last_time_ns
                .map(|time_ns| now_ns.saturating_sub(time_ns) as f64 / 1e9),
            pace: None,
            load: None,
            frames_behind: None,
            fit: None,
            undecided: self.watch.undecided(),
            state: None,
            done: self.done,
            drops,
            restarts: 0,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        Ok(self.status.put(&status).await?)
    }
}

/// What a service starts from: what it remembers, by the rules of now, or nothing. Ends of alerts are on the disk on return.
fn begin(
    structure: &Structure,
    baseline: Option<&Baseline>,
    memory: Option<&mut Memory>,
) -> Result<Remembered, AlertError> {
    let new = Remembered::new(structure, baseline)?;
    let Some((memory, former)) =
        memory.and_then(|memory| memory.recall().map(|former| (memory, former)))
    else {
        return Ok(new);
    };
    let state = new.succeed(former.clone());
    if state != former {
        // what follows from the change comes after what the last life may not have put
        let ended = state
            .unsent
            .iter()
            .skip(former.unsent.len())
            .filter(|alert| alert.state == AlertState::Cleared);
        let ended = ended.count();
        info!(
            structure = structure.name(),
            ended, "what alerts rest on has changed: decisions go on by the rules of now"
        );
        memory.keep(&state);
    }
    Ok(state)
}

fn name(text: &str) -> Result<Name, AlertError> {
    Name::new(text).map_err(|source| AlertError::Name {
        found: text.to_owned(),
        source,
    })
}

fn log(structure: &Name, parameter: &Name, alert: &Alert) {
    let (structure, parameter, why) = (structure.as_str(), parameter.as_str(), alert.why.as_str());
    match alert.state {
        // the loss of an alert that stands is on the page
        state if alert.revision > 0 => debug!(
            structure,
            parameter,
            state = state.as_str(),
            why,
            "alert revised"
        ),
        AlertState::Raised => warn!(structure, parameter, why, "alert raised"),
        state => info!(
            structure,
            parameter,
            state = state.as_str(),
            why,
            "alert changed"
        ),
    }
}
