//! Connects the watch of one structure to the bus.

use std::collections::{BTreeMap, VecDeque};

use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Block, BoxedFuture, Bus, Delivery, DisplayPublisher,
    EstimateBlock, Event, EventKind, HistoryLog, Keys, LatestPublisher, LiveToken, LossDisplay,
    ModeDisplay, MonitoringDisplay, MonitoringState, Name, ProgressPublisher, Question, Questions,
    SensorHealthDisplay, Service, Start, Status, Stream, Subscription,
};
use spandrel_checkpoint::Position;
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use spandrel_structure::Structure;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use crate::memory::{AlertState as Remembered, Basis, Memory, note};
use crate::model_check::{Agreement, ModelCheck};
use crate::monitoring::Monitoring;
use crate::{Acknowledged, Alert, AlertError, Baseline, ParameterLoss, Watch};

/// Capacity of the queue for acknowledgements. When it is full, the oldest is dropped and counted,
/// and its sender sees no change.
const ACKNOWLEDGEMENTS_WAITING: usize = 64;
/// Capacity of the queue for status messages of ingest. Only the last one matters.
const STATUSES_WAITING: usize = 4;
/// Capacity of the queue for comparisons of the sensors of a node. Only the last of each node
/// matters.
const HEALTH_WAITING: usize = 256;
/// Capacity of the queue for modes. An epoch has at most 64 of them, which are published again.
const MODES_WAITING: usize = 256;
/// Capacity of the queue for queries of the log.
const QUESTIONS_WAITING: usize = 16;

/// Maximum product of parameters and frames for which the calling thread processes a block.
///
/// Such a block takes a few hundred microseconds, which is less than the cost of moving it to
/// another thread.
const BRIEF: usize = 1_000;

/// Start-up settings of the alert service of one structure.
#[derive(Clone, Debug)]
pub struct AlertPlan {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structure whose parameters are watched.
    pub monitored: Monitored,
    /// Baseline that replaces learnt references of the parameters that it contains.
    pub baseline: Option<Baseline>,
}

/// The alert service of one structure: it reads estimates from the bus, applies the alert rules,
/// and publishes each change of an alert.
///
/// The service starts with an [`AlertPlan`]. It resumes from its last checkpoint if checkpoints are
/// configured, and then publishes the state of each parameter again. On a stop, estimates that have
/// arrived are still processed.
#[derive(Debug)]
pub struct AlertService {
    basis: Basis,
    watch: Watch,
    estimates: Stream<EstimateBlock>,
    acknowledgements: Subscription<Acknowledgement>,
    /// Topics by parameter index, including former parameters. Each topic answers queries with its
    /// last alert.
    alerts: Vec<AlertTopic>,
    progress: ProgressPublisher,
    status: StatusPublisher,
    keys: Keys,
    token: Option<LiveToken>,
    monitoring: Monitoring,
    monitoring_topic: DisplayPublisher<MonitoringDisplay>,
    ingest_statuses: Subscription<Status>,
    /// Comparisons of the sensors, while one of them is in doubt.
    sensor_health: Option<Subscription<SensorHealthDisplay>>,
    bus: Bus,
    /// The comparison with the declared modes, and their messages. `None` if there is no model or
    /// no declared mode.
    model_check: Option<(ModelCheck, Subscription<ModeDisplay>)>,
    events: EventPublisher,
    clock: Clock,
    /// Time of the last block of estimates, or of the start.
    received_at: Instant,
    display_rate_hz: f64,
    done: u64,
    last_time_ns: Option<i64>,
    refused: BTreeMap<&'static str, u64>,
    memory: Option<Memory>,
    /// Alerts that an earlier run of this service decided and might not have published.
    unsent: Vec<Alert>,
    /// The last changes, oldest first.
    log: VecDeque<Alert>,
    questions: Questions,
}

/// The publishers of one parameter.
#[derive(Debug)]
struct AlertTopic {
    parameter: Name,
    publisher: LatestPublisher<AlertMessage>,
    losses: DisplayPublisher<LossDisplay>,
    /// Whether the state of the parameter has been published.
    is_published: bool,
}

impl AlertTopic {
    async fn declare(bus: &Bus, keys: &Keys, parameter: Name) -> Result<Self, AlertError> {
        Ok(Self {
            publisher: bus.publish_latest(keys.alert(&parameter)).await?,
            losses: bus.publish_display(keys.loss(&parameter)).await?,
            parameter,
            is_published: false,
        })
    }
}

impl spandrel_service::Service for AlertService {
    type Plan = AlertPlan;
    type Error = AlertError;

    /// Validates the settings and joins the bus.
    ///
    /// If [`Monitored::remembering`] is set, the service resumes from its last checkpoint and
    /// publishes the state of each parameter again. If the structure file has changed since, alerts
    /// that the new file does not raise end.
    ///
    /// # Errors
    /// Returns an error if the rules do not match the structure, a name cannot be a key,
    /// checkpoints cannot be written, or the bus rejects a declaration.
    fn start(plan: &AlertPlan) -> BoxedFuture<'_, Result<Self, AlertError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Estimates that have arrived by then are still processed.
    ///
    /// # Errors
    /// Returns an error if the bus is closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), AlertError>> {
        self.run_until(stop)
    }
}

impl AlertService {
    fn start_from(plan: &AlertPlan) -> BoxedFuture<'_, Result<Self, AlertError>> {
        Box::pin(async move {
            let AlertPlan {
                instance,
                monitored,
                baseline,
            } = plan;
            let ServiceInstance { bus, id, clock } = instance;
            let Monitored {
                structure,
                keys,
                remembering,
            } = monitored;
            let mut memory = match remembering {
                Some(remembering) => Some(Memory::open(structure, remembering)?),
                None => None,
            };
            let state = begin(structure, baseline.as_ref(), memory.as_mut())?;
            let Remembered {
                basis,
                mut watch,
                unsent,
                log,
                last_time_ns,
            } = state;
            let model_check = compare_modes(structure, &mut watch, bus, keys).await?;
            let start = match watch.position() {
                Some(Position { epoch, sequence }) => Start::At { epoch, sequence },
                None => Start::Beginning,
            };
            let mut alerts = Vec::new();
            for parameter in &basis.parameters {
                alerts.push(AlertTopic::declare(bus, keys, name(parameter)?).await?);
            }
            let acknowledgements = bus
                .subscribe(keys.all_acknowledgements(), ACKNOWLEDGEMENTS_WAITING)
                .await?;
            let parameters = structure.parameters().len();
            let progress = bus
                .publish_progress(keys.progress(Service::Alert), id.to_string())
                .await?;
            let done = watch.position().map_or(0, |at| {
                // A source can be waiting for the last progress, which a killed run was unable to
                // publish.
                progress.set(at.epoch, at.sequence, last_time_ns.unwrap_or(i64::MIN));
                at.sequence
            });
            let service = Self {
                estimates: follow_estimates(parameters, bus, keys, start).await?,
                acknowledgements,
                progress,
                status: instance.publish_status(Service::Alert, keys).await?,
                basis,
                watch,
                alerts,
                monitoring: Monitoring::new(structure)?,
                monitoring_topic: bus.publish_display(keys.monitoring()).await?,
                sensor_health: None,
                bus: bus.clone(),
                ingest_statuses: bus
                    .subscribe(keys.statuses(Service::Ingest), STATUSES_WAITING)
                    .await?,
                model_check,
                events: EventPublisher::declare(bus, keys).await?,
                clock: *clock,
                received_at: Instant::now(),
                display_rate_hz: structure.display_rate_hz(),
                done,
                last_time_ns,
                refused: BTreeMap::new(),
                memory,
                unsent,
                log,
                questions: bus.questions(keys.alert_log(), QUESTIONS_WAITING).await?,
                // The token comes last, because other services send queries as soon as they see it.
                token: Some(instance.announce(Service::Alert, keys).await?),
                keys: keys.clone(),
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
                    biased; // people have priority over a continuous stream of estimates
                    Ok((key, acknowledgement)) = acknowledgements.recv_async() => {
                        self.acknowledge(&key, acknowledgement).await?;
                    }
                    Some(question) = self.questions.next() => self.answer(&question).await?,
                    _ = status.tick() => {
                        self.look_at_the_memory();
                        self.check_the_model().await?;
                        self.put_status().await?;
                        self.put_monitoring().await?;
                    }
                    () = &mut stop => break,
                    delivery = deliveries.recv_async() => match delivery {
                        Ok(delivery) => self.take(delivery).await?,
                        Err(flume::RecvError::Disconnected) => break,
                    },
                }
            }
            // Process the estimates that have arrived by now. An identify service in another
            // process may continue to publish.
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

    /// Publishes unsent alerts of an earlier run and the state of each parameter.
    ///
    /// Late subscribers receive the state. Other subscribers detect the duplicates by their keys.
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
            // The end of an alert under a former rule does not determine the state under another
            // rule.
            topic.is_published = standing.is_some();
        }
        Ok(())
    }

    /// Reports a missing checkpoint folder, and saves a checkpoint once the folder exists again.
    fn look_at_the_memory(&mut self) {
        let Some(memory) = &mut self.memory else {
            return;
        };
        memory.look();
        // At most one attempt per interval of checkpoints, because the disk may still be full.
        if memory.is_back() && memory.is_due() {
            self.keep(Vec::new());
        }
    }

    /// Saves a checkpoint with the new alerts, and returns the alerts. They must not be published
    /// earlier.
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

    /// Replies to a query with the last changes.
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
            Delivery::Gap(_) => Ok(()), // the stream logs it, and the watch detects it
        }
    }

    async fn decide(&mut self, block: &EstimateBlock) -> Result<(), AlertError> {
        let (mut alerts, mut losses) = (Vec::new(), Vec::new());
        let values = block.estimates.len() * usize::from(block.parameters);
        let rate_hz = self.display_rate_hz;
        let mut decide = || {
            self.watch
                .handle_block_with_display(block, rate_hz, &mut alerts, &mut losses)
        };
        let decided = match values <= BRIEF {
            true => decide(),
            // A fetched block can contain thousands of frames, which would block a runtime thread
            // for too long.
            false => tokio::task::block_in_place(decide),
        };
        if let Err(error) = decided {
            self.refuse("estimates-of-another-structure", &error);
        } else {
            self.monitoring.take(block);
            if let Some((check, _)) = &mut self.model_check {
                check.take_estimates(block);
            }
            self.received_at = Instant::now();
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
        self.display(&losses).await?;
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

    /// Publishes each change. If another rule has a more severe alert for the parameter, publishes
    /// that alert again.
    async fn publish(&mut self, alerts: Vec<Alert>) -> Result<(), AlertError> {
        let structure = self.keys.structure();
        let mut last_put: BTreeMap<usize, Alert> = BTreeMap::new();
        for alert in alerts {
            if let Some(topic) = self.alerts.get_mut(alert.parameter) {
                topic.is_published = true;
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

    /// Publishes the first state of parameters that have not changed since the first estimate.
    ///
    /// New subscribers, and subscribers that remember an earlier run of this service, thus learn
    /// that the parameter is normal.
    async fn publish_first(&mut self) -> Result<(), AlertError> {
        let structure = self.keys.structure();
        for (index, topic) in self
            .alerts
            .iter_mut()
            .enumerate()
            .filter(|(_, topic)| !topic.is_published)
        {
            if let Some(alert) = self.watch.unannounced(index) {
                topic
                    .publisher
                    .put(&alert.to_message(structure, &topic.parameter))
                    .await?;
                topic.is_published = true;
            }
        }
        Ok(())
    }

    async fn display(&self, losses: &[ParameterLoss]) -> Result<(), AlertError> {
        let structure = self.keys.structure();
        for loss in losses {
            if let Some(topic) = self.alerts.get(loss.parameter) {
                let message = loss.to_message(structure, &topic.parameter);
                topic.losses.put(&message).await?;
            }
        }
        Ok(())
    }

    /// Counts a rejected block. Logs it each time the count has doubled.
    fn refuse(&mut self, reason: &'static str, error: &AlertError) {
        let count = self.refused.entry(reason).or_default();
        *count += 1;
        if count.is_power_of_two() {
            warn!(structure = self.keys.structure().as_str(), %error, reason, count = *count, "estimates rejected");
        }
    }

    /// Compares the modes of an epoch with the model, and publishes an event if the result has
    /// changed.
    async fn check_the_model(&mut self) -> Result<(), AlertError> {
        let Some((check, modes)) = &mut self.model_check else {
            return Ok(());
        };
        for (_, display) in modes.messages().try_iter() {
            check.take_mode(display);
        }
        // The modes of a large model take longer than an async thread may be blocked.
        let Some(change) = tokio::task::block_in_place(|| check.compare()) else {
            return Ok(());
        };
        self.watch.set_contradicting_modes(check.contradicting());
        let (kind, what) = match change.agreement {
            Agreement::Contradicted => (
                EventKind::ModelContradicted,
                "measured modes contradict the model, so no alert is decided",
            ),
            Agreement::Agrees => (
                EventKind::ModelAgrees,
                "measured modes agree with the model again",
            ),
        };
        let event = Event {
            structure: self.keys.structure().clone(),
            time_ns: change.time_ns,
            kind,
            subject: change.subject,
            what: what.to_owned(),
            why: change.why,
        };
        Ok(self.events.put(&event).await?)
    }

    /// Determines which sensors are in doubt. The comparisons arrive at the display rate and cost
    /// more than the decisions, so this service subscribes to them only while a sensor is in doubt.
    async fn find_suspects(&mut self) -> Result<(), AlertError> {
        if !self.monitoring.has_sensor_in_doubt() {
            self.sensor_health = None;
            self.monitoring.clear_suspects();
            return Ok(());
        }
        match &self.sensor_health {
            Some(comparisons) => {
                for (_, of_node) in comparisons.messages().try_iter() {
                    self.monitoring.take_health(&of_node);
                }
            }
            None => {
                let key = self.keys.all_sensor_health();
                self.sensor_health = Some(self.bus.subscribe(key, HEALTH_WAITING).await?);
            }
        }
        Ok(())
    }

    /// Publishes the state of the monitoring, and an event if it has changed.
    async fn put_monitoring(&mut self) -> Result<(), AlertError> {
        self.find_suspects().await?;
        if let Some((_, status)) = self.ingest_statuses.messages().try_iter().last() {
            self.monitoring.take_status(&status);
        }
        let silence = self.received_at.elapsed();
        let now_ns = self.clock.now_ns();
        let (display, change) = self.monitoring.judge(&self.watch, silence, now_ns);
        self.monitoring_topic.put(&display).await?;
        if let Some(change) = change {
            let state = change.display.state;
            let event = Event {
                structure: self.keys.structure().clone(),
                time_ns: change.display.measured_ns.unwrap_or(now_ns),
                kind: EventKind::Monitoring,
                subject: state.as_str().to_owned(),
                what: format!(
                    "the monitoring changed from {} to {}",
                    change.before.as_str(),
                    state.as_str()
                ),
                why: match state {
                    MonitoringState::Watching => {
                        "the present data reveal damage of every part".to_owned()
                    }
                    MonitoringState::Degraded | MonitoringState::Blind => {
                        change.display.reasons.join("; ")
                    }
                },
            };
            self.events.put(&event).await?;
        }
        Ok(())
    }

    async fn put_status(&self) -> Result<(), AlertError> {
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
        let report = Report {
            done: self.done,
            processed_ns: self.last_time_ns,
            drops,
            undecided: self.watch.undecided(),
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

/// Returns the initial state: the checkpoint under the present rules, or an empty state.
///
/// If the rules have changed, the new state is saved before the function returns.
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
    if !state.is_stored_like(&former) {
        // The new alerts follow the unsent alerts of the last run.
        let ended = state
            .unsent
            .iter()
            .skip(former.unsent.len())
            .filter(|alert| alert.state == AlertState::Cleared);
        let ended = ended.count();
        info!(
            structure = structure.name(),
            ended, "rules, model or baseline changed; decisions continue under the new rules"
        );
        memory.keep(&state);
    }
    Ok(state)
}

/// Starts to compare the measured modes with the model. Returns `None` if the structure declares
/// none.
async fn compare_modes(
    structure: &Structure,
    watch: &mut Watch,
    bus: &Bus,
    keys: &Keys,
) -> Result<Option<(ModelCheck, Subscription<ModeDisplay>)>, AlertError> {
    let Some(mut check) = ModelCheck::new(structure)? else {
        return Ok(None);
    };
    if watch.was_contradicted_by_modes() {
        check.resume_contradicted();
        watch.set_contradicting_modes(check.contradicting());
    }
    let modes = bus.subscribe(keys.all_modes(), MODES_WAITING).await?;
    Ok(Some((check, modes)))
}

/// Reads the estimates of this number of parameters, and rejects others.
async fn follow_estimates(
    parameters: usize,
    bus: &Bus,
    keys: &Keys,
    start: Start,
) -> Result<Stream<EstimateBlock>, AlertError> {
    // A restarted identify service has the missing estimates or computes them again, so the reader
    // waits for them.
    let settings = bus.reading(start).patient();
    let is_of_structure =
        move |block: &EstimateBlock| match usize::from(block.parameters) == parameters {
            true => Ok(()),
            false => Err("estimates-of-another-structure"),
        };
    let (key, buffer_key) = (keys.estimates(), keys.estimates_buffer());
    let estimates = bus.follow_fit(key, buffer_key, settings, is_of_structure);
    Ok(estimates.await?)
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
        // The web page shows the loss of a raised alert.
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
