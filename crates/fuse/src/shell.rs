//! Connects the station of one structure to the bus.

use crate::error::FuseError;
use crate::fusion::{Fusion, FusionInput, FusionState, Output};
use spandrel_bus::{
    BoxedFuture, BusError, Description, DisplayPublisher, EstimateBlock, FeedbackMessage, Keep,
    LatestPublisher, LiveToken, LiveWatch, LocalMessage, Message, Name, NodeDisplay,
    NumberedPublisher, NumberedStream, OutlierDisplay, ParameterDisplay, ProgressPublisher,
    Service, StreamState, Subscription,
};
use spandrel_checkpoint::{Checkpoints, Identity, Keeper, Position, Remembering};
use spandrel_filter::fusion::compression::MISSED_MASS;
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report, ServiceInstance, StatusPublisher, Stop,
};
use spandrel_structure::Structure;
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::time::Instant;
use tracing::{info, warn};

/// Number of estimates kept for subscribers that have missed some.
pub const ESTIMATES_KEPT: u64 = 4096;

/// Interval between readings of the clock.
const TICK: Duration = Duration::from_millis(50);
/// Number of ticks between two status messages.
const TICKS_PER_STATUS: u32 = 20;

/// After a stop, the service waits until no message has arrived for this long.
const LAST_MESSAGES: Duration = Duration::from_millis(100);
/// Maximum total wait for messages after a stop, because workers in other processes continue to
/// send.
const LAST_MESSAGES_IN_ALL: Duration = Duration::from_secs(1);

/// Capacity of the queue for node messages. When it is full, the oldest message is dropped.
const MESSAGES_WAITING: usize = 1024;

/// Start-up settings of the fusion service of one structure.
#[derive(Clone, Debug)]
pub struct FusePlan {
    /// Session, id and clock of the service. The clock sets the epoch of the estimates, so it must
    /// show a later time at each start.
    pub instance: ServiceInstance,
    /// The structure whose nodes are fused.
    pub monitored: Monitored,
}

/// The fusion service of one structure.
#[derive(Debug)]
pub struct FuseService {
    core: Fusion,
    messages: Subscription<LocalMessage>,
    presence: LiveWatch,
    estimates: NumberedPublisher<EstimateBlock>,
    parameters: BTreeMap<Name, DisplayPublisher<ParameterDisplay>>,
    feedback: Vec<DisplayPublisher<FeedbackMessage>>,
    nodes: BTreeMap<Name, DisplayPublisher<NodeDisplay>>,
    outliers: BTreeMap<Name, DisplayPublisher<OutlierDisplay>>,
    /// Index of each node, by the key of its messages.
    positions: BTreeMap<String, usize>,
    /// Keys of the liveliness tokens of the nodes, by index.
    tokens: Vec<String>,
    events: EventPublisher,
    _description: LatestPublisher<Description>,
    progress: ProgressPublisher,
    status: StatusPublisher,
    keeper: Option<Keeper>,
    clock: Clock,
    token: Option<LiveToken>,
}

impl spandrel_service::Service for FuseService {
    type Plan = FusePlan;
    type Error = FuseError;

    /// Validates the settings and joins the bus.
    ///
    /// If [`Monitored::remembering`] is set, the station resumes from its last checkpoint.
    ///
    /// # Errors
    /// Returns an error if the nodes do not identify the structure, checkpoints cannot be written,
    /// or the bus rejects a declaration.
    fn start(plan: &FusePlan) -> BoxedFuture<'_, Result<Self, FuseError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Messages that have arrived by then are still fused, within a limit of one
    /// second.
    ///
    /// # Errors
    /// Returns an error if the bus is closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), FuseError>> {
        self.run_until(stop)
    }
}

impl FuseService {
    fn start_from(plan: &FusePlan) -> BoxedFuture<'_, Result<Self, FuseError>> {
        Box::pin(async move {
            let FusePlan {
                instance,
                monitored,
            } = plan;
            let ServiceInstance { bus, id, clock } = instance;
            let Monitored {
                structure,
                keys,
                remembering,
            } = monitored;
            let mut core = Fusion::new(structure, id.as_str(), clock.epoch())?;
            let keeper = remembering
                .as_ref()
                .map(|remembering| recall(&mut core, structure, remembering))
                .transpose()?;
            let estimates = bus
                .publish_numbered(NumberedStream {
                    key: keys.estimates(),
                    buffer_key: keys.estimates_buffer(),
                    source: id.to_string(),
                    epoch: core.epoch(),
                    first: 0,
                    state: StreamState::Running,
                    keep: Keep::last(ESTIMATES_KEPT),
                })
                .await?;
            let mut parameters = BTreeMap::new();
            for name in core.parameter_names() {
                parameters.insert(
                    name.clone(),
                    bus.publish_display(keys.parameter(name)).await?,
                );
            }
            let (mut feedback, mut nodes, mut positions) =
                (Vec::new(), BTreeMap::new(), BTreeMap::new());
            let mut tokens = Vec::new();
            for (position, name) in core.node_names().enumerate() {
                feedback.push(bus.publish_display(keys.feedback(name)).await?);
                nodes.insert(name.clone(), bus.publish_display(keys.node(name)).await?);
                positions.insert(keys.local(name), position);
                tokens.push(keys.live(Service::Identify, name));
            }
            let mut outliers = BTreeMap::new();
            for channel in core.screened_channels().flatten() {
                outliers.insert(
                    channel.clone(),
                    bus.publish_display(keys.outlier(channel)).await?,
                );
            }
            let description = bus.publish_latest(keys.description()).await?;
            description
                .put(&Description {
                    structure: keys.structure().clone(),
                    text: structure.text().to_owned(),
                })
                .await?;
            let service = Self {
                messages: bus.subscribe(keys.all_local(), MESSAGES_WAITING).await?,
                presence: bus.watch_live(keys.all_live(Service::Identify)).await?,
                estimates,
                parameters,
                feedback,
                nodes,
                outliers,
                positions,
                tokens,
                events: EventPublisher::declare(bus, keys).await?,
                _description: description,
                progress: bus
                    .publish_progress(keys.progress(Service::Fuse), id.to_string())
                    .await?,
                status: instance.publish_status(Service::Fuse, keys).await?,
                token: Some(instance.announce(Service::Fuse, keys).await?),
                core,
                keeper,
                clock: *clock,
            };
            info!(
                structure = structure.name(),
                nodes = service.feedback.len(),
                "station ready"
            );
            if let Some(modes) = structure
                .sent_modes()
                .filter(|modes| modes.missed_mass > MISSED_MASS)
            {
                warn!(
                    structure = structure.name(),
                    modes = modes.count,
                    missed = modes.missed_mass,
                    "the modes that nodes send miss a share of the mass"
                );
            }
            Ok(service)
        })
    }

    fn run_until(
        mut self,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), FuseError>> {
        Box::pin(async move {
            let mut clock = tokio::time::interval(TICK);
            let messages = self.messages.messages().clone();
            let mut ticks = 0;
            self.note_presence().await?;
            loop {
                tokio::select! {
                    message = messages.recv_async() => match message {
                        Ok((key, message)) => self.take(&key, message).await?,
                        Err(flume::RecvError::Disconnected) => break,
                    },
                    _present = self.presence.changed() => self.note_presence().await?,
                    _ = clock.tick() => {
                        self.handle(FusionInput::Tick(self.clock.now_ns())).await?;
                        ticks += 1;
                        if ticks % TICKS_PER_STATUS == 0 {
                            if let Some(keeper) = &mut self.keeper {
                                keeper.look().await;
                            }
                            self.put_status().await?;
                        }
                    }
                    () = &mut stop => break,
                }
            }
            let deadline = Instant::now() + LAST_MESSAGES_IN_ALL;
            while Instant::now() < deadline
                && let Ok(Ok((key, message))) =
                    tokio::time::timeout(LAST_MESSAGES, messages.recv_async()).await
            {
                self.take(&key, message).await?;
            }
            self.keep().await;
            if let Some(keeper) = &mut self.keeper {
                keeper.finish().await;
            }
            if let Some(token) = self.token.take() {
                token.withdraw().await?;
            }
            Ok(())
        })
    }

    async fn note_presence(&mut self) -> Result<(), FuseError> {
        let present = self.presence.present();
        self.handle(FusionInput::Present(
            self.tokens
                .iter()
                .map(|token| present.contains(token))
                .collect(),
        ))
        .await
    }

    async fn take(&mut self, key: &str, message: LocalMessage) -> Result<(), FuseError> {
        let Some(node) = self.positions.get(key).copied() else {
            warn!(key, "message from a node that is not in the structure file");
            return Ok(());
        };
        let bytes = message.encode().map_or(0, |payload| payload.len() as u64);
        let pace = self.core.pace();
        self.handle(FusionInput::Local {
            node,
            message: Box::new(message),
            bytes,
            arrived_ns: self.clock.now_ns(),
        })
        .await?;
        if self.core.pace() != pace {
            // The status must reach dashboards before they show values without their pace for long.
            self.put_status().await?;
        }
        Ok(())
    }

    async fn handle(&mut self, input: FusionInput) -> Result<(), FuseError> {
        let mut outputs = Vec::new();
        let before = self.core.done();
        self.core.handle(input, &mut outputs);
        for output in outputs {
            self.put(output).await?;
        }
        if let Some(done_ns) = self.core.done_ns() {
            self.progress
                .set(self.core.epoch(), self.core.done(), done_ns);
        }
        // Directly after a fusion, a checkpoint loses no waiting messages.
        if self.core.done() != before && self.keeper.as_ref().is_some_and(Keeper::is_due) {
            self.keep().await;
        }
        Ok(())
    }

    /// Saves a checkpoint if there has been a fusion.
    async fn keep(&mut self) {
        let position = Position {
            epoch: self.core.epoch(),
            sequence: self.core.done(),
        };
        if let Some(keeper) = self.keeper.as_mut().filter(|_| position.sequence > 0) {
            keeper.keep(position, self.core.state(), None).await;
        }
    }

    async fn put(&mut self, output: Output) -> Result<(), FuseError> {
        match output {
            Output::Estimates(block) => self.estimates.put(block).await?,
            Output::Parameter(display) => {
                if let Some(publisher) = self.parameters.get(&display.parameter) {
                    show(publisher, &display).await?;
                }
            }
            Output::Feedback(node, message) => {
                if let Some(publisher) = self.feedback.get(node) {
                    let bytes = message.encode().map_or(0, |payload| payload.len() as u64);
                    self.core.count_sent(node, bytes);
                    show(publisher, &message).await?;
                }
            }
            Output::Node(display) => {
                if let Some(publisher) = self.nodes.get(&display.node) {
                    show(publisher, &display).await?;
                }
            }
            Output::Outliers(_, display) => {
                if let Some(publisher) = self.outliers.get(&display.channel) {
                    show(publisher, &display).await?;
                }
            }
            Output::Event(event) => self.events.put(&event).await?,
        }
        Ok(())
    }

    async fn put_status(&self) -> Result<(), FuseError> {
        let mut drops = self.core.refused();
        for (reason, count) in self.messages.refused() {
            *drops.entry(format!("refused-{reason}")).or_default() += count;
        }
        drops.extend(
            self.keeper
                .as_ref()
                .and_then(|keeper| keeper.failures().drops()),
        );
        let report = Report {
            done: self.core.done(),
            processed_ns: self.core.done_ns(),
            drops,
            pace: self.core.pace(),
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

/// Restores the station from its last readable checkpoint, if any. Returns the keeper of the next
/// checkpoints.
fn recall(
    core: &mut Fusion,
    structure: &Structure,
    remembering: &Remembering,
) -> Result<Keeper, FuseError> {
    let identity = Identity {
        kind: "fuse",
        version: FusionState::VERSION,
        of: structure.name().to_owned(),
        basis: structure.identification_basis(),
    };
    let checkpoints = Checkpoints::open(&remembering.folder, identity)?;
    if let Some((position, ())) = checkpoints.recall(|state| core.restore(state)) {
        info!(
            structure = structure.name(),
            epoch = position.epoch,
            fusion = position.sequence,
            "resumed from its checkpoint"
        );
    }
    Ok(Keeper::new(checkpoints, remembering.every))
}

/// Publishes a message. A message that cannot be encoded is logged and dropped.
async fn show<M: Message>(publisher: &DisplayPublisher<M>, message: &M) -> Result<(), BusError> {
    match publisher.put(message).await {
        Err(error @ BusError::Encode { .. }) => {
            warn!(%error, "not sent");
            Ok(())
        }
        result => result,
    }
}
