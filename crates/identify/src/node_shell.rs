//! Connects the identification by one sensor node to the bus.

use crate::error::{IdentifyError, key_name};
use crate::node::{NodeIdentification, NodeIdentificationState, NodeInput, NodeOutput};
use crate::pieces::Pieces;
use crate::pool::FilterPool;
use crate::set_aside::{SetAside, Span};
use spandrel_bus::{
    Block, BoxedFuture, Bus, Delivery, DisplayPublisher, Event, EventKind, FeedbackMessage,
    LiveToken, LocalMessage, Name, POSITION_TIMEOUT, Pace, SampleBlock, Service, Start,
    Subscription,
};
use spandrel_checkpoint::{Checkpoints, Identity, Keeper, Position, Remembering};
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use spandrel_structure::Structure;
use spandrel_waveforms::{Displays, NodeChannels};
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::time::Instant;
use tracing::{debug, info, warn};

/// After a stop, the service waits until no sample has arrived for this long.
const LAST_SAMPLES: Duration = Duration::from_millis(100);
/// Maximum total wait for samples after a stop, because live sensors continue to send.
const LAST_SAMPLES_IN_ALL: Duration = Duration::from_secs(1);

/// Maximum time for which replayed samples wait for feedback.
const ANSWER_WITHIN: Duration = Duration::from_secs(10);

/// Capacity of the queue for feedback. Only the newest message matters.
const ANSWERS_WAITING: usize = 4;

/// Processes one input on a thread of the pool, as [`NodeIdentification::handle`] does.
type ProcessNodeInput = fn(&mut NodeIdentification, NodeInput, &mut Vec<NodeOutput>);

/// Start-up settings of the worker of one sensor node.
#[derive(Clone, Debug)]
pub struct NodeServicePlan {
    /// The session.
    pub bus: Bus,
    /// The wall clock. It sets the epoch of the estimates, so it must show a later time at each
    /// start.
    pub clock: Clock,
    /// The structure.
    pub monitored: Monitored,
    /// Index of the node in the structure.
    pub position: usize,
    /// The threads of the filters.
    pub pool: FilterPool,
    /// Samples that caused panics in earlier runs. The worker skips them, and adds those that cause
    /// a panic in its run.
    pub set_aside: SetAside,
}

/// The worker of one sensor node.
#[derive(Debug)]
pub struct NodeService {
    core: Option<NodeIdentification>,
    pool: FilterPool,
    process: ProcessNodeInput,
    samples: Pieces<SampleBlock>,
    bus: Bus,
    buffer_key: String,
    keeper: Option<Keeper>,
    /// Whether the worker resumed from a checkpoint. It then also reads later samples from the
    /// sensor's buffer.
    goes_on: bool,
    /// Position of the first live sample measured during this run. `None` before the first.
    begins_at: Option<Position>,
    set_aside: SetAside,
    /// The samples last passed to the filter.
    at_work: Option<Span>,
    feedback: Subscription<FeedbackMessage>,
    local: DisplayPublisher<LocalMessage>,
    /// Waveforms and spectra of the samples. `None` unless the structure file requests them.
    displays: Option<Displays>,
    events: EventPublisher,
    status: StatusPublisher,
    structure: Name,
    clock: Clock,
    node: Name,
    token: Option<LiveToken>,
}

impl spandrel_service::Service for NodeService {
    type Plan = NodeServicePlan;
    type Error = IdentifyError;

    /// Validates the settings and joins the bus.
    ///
    /// If [`Monitored::remembering`] is set, the worker resumes from its last checkpoint and reads
    /// later samples from the sensor's buffer.
    ///
    /// # Errors
    /// Returns an error if the node cannot run its own identification, checkpoints cannot be
    /// written, or the bus rejects a declaration.
    fn start(plan: &NodeServicePlan) -> BoxedFuture<'_, Result<Self, IdentifyError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Samples that have arrived by then are still processed, within a limit of
    /// one second.
    ///
    /// # Errors
    /// Returns an error if the bus is closed, or if the filter has panicked. The next run then
    /// continues without the samples that caused the panic.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), IdentifyError>> {
        self.run_until(stop)
    }
}

impl NodeService {
    fn start_from(plan: &NodeServicePlan) -> BoxedFuture<'_, Result<Self, IdentifyError>> {
        Box::pin(async move {
            let NodeServicePlan {
                bus,
                clock,
                monitored,
                position,
                pool,
                set_aside,
            } = plan;
            let Monitored {
                structure,
                keys,
                remembering,
            } = monitored;
            let mut core = NodeIdentification::new(structure, *position, clock.epoch())?;
            let displays = start_displays(bus, monitored, *position).await?;
            let node = key_name(structure.name(), structure.nodes()[*position].name())?;
            let instance = ServiceInstance {
                bus: bus.clone(),
                id: node.clone(),
                clock: *clock,
            };
            let keeper = remembering
                .as_ref()
                .map(|remembering| recall(&mut core, structure, &node, remembering))
                .transpose()?;
            let position = core.position();
            let settings = bus.reading(position.map_or(
                Start::Beginning,
                |Position { epoch, sequence }| Start::At { epoch, sequence },
            ));
            let samples = bus
                .follow(keys.samples(&node), keys.buffer(&node), settings)
                .await?;
            let service = Self {
                samples: Pieces::of(samples),
                bus: bus.clone(),
                buffer_key: keys.buffer(&node),
                keeper,
                goes_on: position.is_some(),
                begins_at: None,
                set_aside: set_aside.clone(),
                at_work: None,
                pool: pool.clone(),
                feedback: bus.subscribe(keys.feedback(&node), ANSWERS_WAITING).await?,
                local: bus.publish_display(keys.local(&node)).await?,
                displays,
                events: EventPublisher::declare(bus, keys).await?,
                status: instance.publish_status(Service::Identify, keys).await?,
                token: Some(instance.announce(Service::Identify, keys).await?),
                structure: keys.structure().clone(),
                clock: *clock,
                node,
                core: Some(core),
                process: NodeIdentification::handle,
            };
            info!(
                structure = structure.name(),
                node = service.node.as_str(),
                "node ready"
            );
            Ok(service)
        })
    }

    fn run_until(
        mut self,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), IdentifyError>> {
        Box::pin(async move {
            let mut status = tokio::time::interval(STATUS_EVERY);
            let answers = self.feedback.messages().clone();
            // The estimate whose feedback the samples await, and the end of the wait. It outlasts
            // the turns of the loop, because the status ends one every second.
            let mut wait: Option<(u64, Instant)> = None;
            loop {
                let awaited = self.core.as_ref().and_then(NodeIdentification::awaits);
                if awaited != wait.map(|(estimate, _)| estimate) {
                    wait = awaited.map(|estimate| (estimate, Instant::now() + ANSWER_WITHIN));
                }
                let deadline = wait.map_or_else(Instant::now, |(_, deadline)| deadline);
                tokio::select! {
                    answer = answers.recv_async() => match answer {
                        Ok((_, feedback)) => self.take(NodeInput::Feedback(feedback)).await?,
                        Err(flume::RecvError::Disconnected) => break,
                    },
                    delivery = self.samples.next(), if wait.is_none() => match delivery {
                        Some(delivery) => self.take_delivery(delivery).await?,
                        None => break,
                    },
                    () = tokio::time::sleep_until(deadline), if wait.is_some() => {
                        wait = None;
                        let (structure, node) = (self.structure.as_str(), self.node.as_str());
                        warn!(structure, node, "no reply from the station; continuing without it");
                        self.take(NodeInput::NoAnswer).await?;
                    }
                    _ = status.tick() => {
                        if let Some(keeper) = &mut self.keeper {
                            keeper.look().await;
                        }
                        self.put_status().await?;
                    }
                    () = &mut stop => break,
                }
            }
            let deadline = Instant::now() + LAST_SAMPLES_IN_ALL;
            while Instant::now() < deadline
                && let Ok(Some(delivery)) =
                    tokio::time::timeout(LAST_SAMPLES, self.samples.next()).await
            {
                self.take_delivery(delivery).await?;
                self.take(NodeInput::NoAnswer).await?;
            }
            if let Some(displays) = self.displays.take() {
                displays.close().await;
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

    async fn take_delivery(
        &mut self,
        delivery: Delivery<SampleBlock>,
    ) -> Result<(), IdentifyError> {
        let block = match delivery {
            Delivery::Block(block) => block,
            // The timestamp of the next block determines the number of missing samples.
            Delivery::Gap(gap) => {
                debug!(
                    node = self.node.as_str(),
                    from = gap.from,
                    to = gap.to,
                    "samples lost"
                );
                return Ok(());
            }
        };
        for block in self.set_aside.cut(block) {
            let span = Span {
                epoch: block.header.epoch,
                from: block.header.sequence,
                to: block.end(),
            };
            let input = match (self.was_before(&block).await, self.goes_on) {
                (true, false) => continue,
                (true, true) => NodeInput::Past(block),
                (false, _) => NodeInput::Samples(block),
            };
            self.at_work = Some(span);
            self.take(input).await?;
        }
        Ok(())
    }

    /// Returns `true` if live samples were measured before this worker started.
    ///
    /// The station may have received their information from an earlier run, and would count it
    /// twice.
    async fn was_before(&mut self, block: &SampleBlock) -> bool {
        if block.pace == Pace::Replayed {
            return false;
        }
        let Position { epoch, sequence } = match self.begins_at {
            Some(position) => position,
            None => {
                let answer = self
                    .bus
                    .stream_position(&self.buffer_key, POSITION_TIMEOUT)
                    .await;
                // A sensor without a buffer sends no earlier samples.
                let position = answer.map(|at| Position {
                    epoch: at.header.epoch,
                    sequence: at.header.sequence,
                });
                *self.begins_at.insert(position.unwrap_or_default())
            }
        };
        block.header.epoch == epoch && block.end() <= sequence
    }

    async fn take(&mut self, input: NodeInput) -> Result<(), IdentifyError> {
        let lost = || IdentifyError::ThreadLost {
            structure: self.structure.to_string(),
        };
        let mut core = self.core.take().ok_or_else(lost)?;
        let process = self.process;
        let work = self.pool.run(move || {
            let mut outputs = Vec::new();
            process(&mut core, input, &mut outputs);
            (core, outputs)
        });
        let Some((core, outputs)) = work.await else {
            return self.die().await;
        };
        self.core = Some(core);
        for output in outputs {
            match output {
                NodeOutput::Local(message) => self.local.put(&message).await?,
                NodeOutput::Event(event) => self.events.put(&event).await?,
                NodeOutput::Frames(block) => {
                    if let Some(displays) = &mut self.displays {
                        displays.offer(&block);
                    }
                }
            }
        }
        if self.keeper.as_ref().is_some_and(Keeper::is_due) {
            self.keep().await;
        }
        Ok(())
    }

    /// Records the samples that caused the filter to panic, so that the next run skips them.
    async fn die(&mut self) -> Result<(), IdentifyError> {
        if let Some(span) = self.at_work.take() {
            self.set_aside.add(span);
            let event = Event {
                structure: self.structure.clone(),
                time_ns: self.clock.now_ns(),
                kind: EventKind::Restart,
                subject: self.node.to_string(),
                what: format!(
                    "samples {} to {} are skipped and count as missing",
                    span.from,
                    span.to.saturating_sub(1)
                ),
                why: "they caused a panic in the filter of the node".to_owned(),
            };
            self.events.put(&event).await?;
        }
        Err(IdentifyError::ThreadLost {
            structure: self.structure.to_string(),
        })
    }

    /// Saves a checkpoint if there has been a sample.
    async fn keep(&mut self) {
        let Some((keeper, core)) = self.keeper.as_mut().zip(self.core.as_ref()) else {
            return;
        };
        if core.done() > 0 {
            keeper
                .keep(
                    Position {
                        epoch: core.epoch(),
                        sequence: core.done(),
                    },
                    core.state(),
                    None,
                )
                .await;
        }
    }

    async fn put_status(&self) -> Result<(), IdentifyError> {
        let mut drops: BTreeMap<String, u64> = self.samples.counts().drops();
        let core = self.core.as_ref();
        for (reason, count) in core.into_iter().flat_map(NodeIdentification::dropped) {
            *drops.entry((*reason).to_owned()).or_default() += count;
        }
        let shed = self.displays.as_ref().map_or(0, Displays::dropped);
        if shed > 0 {
            drops.insert("shed-frames".to_owned(), shed);
        }
        if self.set_aside.samples() > 0 {
            drops.insert("samples-set-aside".to_owned(), self.set_aside.samples());
        }
        drops.extend(
            self.keeper
                .as_ref()
                .and_then(|keeper| keeper.failures().drops()),
        );
        let report = Report {
            done: core.map_or(0, NodeIdentification::done),
            processed_ns: core.and_then(NodeIdentification::last_ns),
            drops,
            restarts: core.map_or(0, NodeIdentification::restarts) + self.set_aside.deaths(),
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

/// Starts the waveforms and spectra of the node at `position`. Returns `None` unless the structure
/// file requests them.
async fn start_displays(
    bus: &Bus,
    monitored: &Monitored,
    position: usize,
) -> Result<Option<Displays>, IdentifyError> {
    let Monitored {
        structure, keys, ..
    } = monitored;
    let is_requested = structure
        .fusion()
        .is_some_and(|plan| plan.publishes_waveforms());
    let Some(node) = structure.nodes().get(position).filter(|_| is_requested) else {
        return Ok(None);
    };
    let named = |name: &str| key_name(structure.name(), name);
    let channels = node.channels().iter().map(|channel| named(channel.name()));
    let shown = NodeChannels {
        node: named(node.name())?,
        channels: channels.collect::<Result<_, _>>()?,
    };
    let rate_hz = node
        .sampling_rate_hz()
        .unwrap_or(structure.sampling_rate_hz());
    Ok(Some(
        Displays::start(bus, keys, vec![shown], rate_hz).await?,
    ))
}

/// Restores the worker from its last readable checkpoint, if any. Returns the keeper of the next
/// checkpoints.
///
/// Each node has its own folder within the state folder.
fn recall(
    core: &mut NodeIdentification,
    structure: &Structure,
    node: &Name,
    remembering: &Remembering,
) -> Result<Keeper, IdentifyError> {
    let identity = Identity {
        kind: "node",
        version: NodeIdentificationState::VERSION,
        of: format!("{}/{node}", structure.name()),
        basis: structure.identification_basis(),
    };
    let checkpoints = Checkpoints::open(
        &remembering.folder.join("nodes").join(node.as_str()),
        identity,
    )?;
    if let Some((position, ())) = checkpoints.recall(|state| core.restore(state)) {
        let (structure, node) = (structure.name(), node.as_str());
        info!(
            structure,
            node,
            epoch = position.epoch,
            samples = position.sequence,
            "resumed from its checkpoint"
        );
    }
    Ok(Keeper::new(checkpoints, remembering.every))
}

#[cfg(test)]
mod tests;
