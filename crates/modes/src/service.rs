//! Connects the declared modes of one structure to the bus.

use crate::declared::ModesOutput;
use crate::error::ModesError;
use crate::following::Following;
use crate::memory::Memory;
use crate::stiffness::Stiffnesses;
use spandrel_bus::{
    BoxedFuture, Delivery, DisplayPublisher, FrameBlock, LiveToken, ModeDisplay, Name,
    ParameterDisplay, ProgressPublisher, Service, Stream,
};
use spandrel_service::{
    EventPublisher, LAST_FRAMES, LAST_FRAMES_IN_ALL, Monitored, Report, STATUS_EVERY,
    ServiceInstance, StatusPublisher, Stop,
};
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::time::Instant;
use tracing::info;

/// Interval at which each mode is published again, for new subscribers.
const REPEAT_EVERY: Duration = Duration::from_secs(5);

/// Start-up settings of the mode tracking service of one structure.
#[derive(Clone, Debug)]
pub struct ModesPlan {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structure to track. The service does not start if the structure file has no table
    /// `[modal]`.
    pub monitored: Monitored,
}

/// The service that follows the modes of one structure.
#[derive(Debug)]
pub struct ModesService {
    /// `None` only while another thread uses it.
    core: Option<Following>,
    frames: Stream<FrameBlock>,
    topics: BTreeMap<Name, DisplayPublisher<ModeDisplay>>,
    parameters: BTreeMap<Name, DisplayPublisher<ParameterDisplay>>,
    events: EventPublisher,
    status: StatusPublisher,
    /// Without a model, sources wait for it.
    progress: ProgressPublisher,
    token: LiveToken,
    memory: Option<Memory>,
}

impl spandrel_service::Service for ModesService {
    type Plan = ModesPlan;
    type Error = ModesError;

    /// Resumes from the last checkpoint, and joins the bus.
    ///
    /// # Errors
    /// Returns an error if the structure has no table `[modal]`, checkpoints cannot be written, or
    /// the bus rejects a declaration.
    fn start(plan: &ModesPlan) -> BoxedFuture<'_, Result<Self, ModesError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Frames that have arrived by then are still processed, within a limit of
    /// one second. The rest arrives again after a restart.
    ///
    /// # Errors
    /// Returns an error if the bus is closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), ModesError>> {
        self.run_until(stop)
    }
}

impl ModesService {
    fn start_from(plan: &ModesPlan) -> BoxedFuture<'_, Result<Self, ModesError>> {
        Box::pin(async move {
            let ModesPlan {
                instance,
                monitored,
            } = plan;
            let Monitored {
                structure,
                keys,
                remembering,
            } = monitored;
            let plan = structure.modal().ok_or_else(|| ModesError::NotFollowed {
                structure: structure.name().to_owned(),
            })?;
            let stiffnesses = Stiffnesses::new(structure)?;
            let updated = stiffnesses.iter().flat_map(Stiffnesses::names).cloned();
            let updated: Vec<Name> = updated.collect();
            let mut core = Following::new(keys.structure(), plan, stiffnesses)?;
            let memory = match remembering {
                Some(remembering) => {
                    // Only the update of stiffnesses depends on the model.
                    let of_model = match structure.modal().is_some_and(|plan| plan.update.is_some())
                    {
                        true => structure.identification_basis(),
                        false => String::new(),
                    };
                    let basis = format!("{plan:?}{of_model}");
                    let memory = Memory::open(keys, basis, remembering)?;
                    tokio::task::block_in_place(|| memory.recall(&mut core));
                    Some(memory)
                }
                None => None,
            };
            let bus = &instance.bus;
            let mut topics = BTreeMap::new();
            for name in core.declared().names() {
                let topic = bus.publish_display(keys.mode(name)).await?;
                topics.insert(name.clone(), topic);
            }
            let mut parameters = BTreeMap::new();
            for name in updated {
                let topic = bus.publish_display(keys.parameter(&name)).await?;
                parameters.insert(name, topic);
            }
            let (channels, rate_hz) = (structure.channel_count(), structure.sampling_rate_hz());
            let is_of_structure = move |block: &FrameBlock| match usize::from(block.channels)
                == channels
                && block.sampling_rate_hz == rate_hz
            {
                true => Ok(()),
                false => Err("frames-of-another-structure"),
            };
            let reading = bus.reading(core.start()).patient();
            let progress = bus
                .publish_progress(keys.progress(Service::Modes), instance.id.to_string())
                .await?;
            put_progress(&progress, &core);
            info!(
                structure = keys.structure().as_str(),
                modes = topics.len(),
                channels = plan.channels.len(),
                epochs = core.declared().epochs(),
                "modes ready"
            );
            Ok(Self {
                frames: bus
                    .follow_fit(keys.frames(), keys.recording(), reading, is_of_structure)
                    .await?,
                core: Some(core),
                progress,
                topics,
                parameters,
                events: EventPublisher::declare(bus, keys).await?,
                status: instance.publish_status(Service::Modes, keys).await?,
                token: instance.announce(Service::Modes, keys).await?,
                memory,
            })
        })
    }

    fn run_until(
        mut self,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), ModesError>> {
        Box::pin(async move {
            let mut repeat = tokio::time::interval(REPEAT_EVERY);
            let mut status = tokio::time::interval(STATUS_EVERY);
            let deliveries = self.frames.deliveries().clone();
            loop {
                // The selection is not biased. At full speed there are always frames, and the
                // others still need their turn.
                tokio::select! {
                    delivery = deliveries.recv_async() => match delivery {
                        Ok(delivery) => self.take(delivery).await?,
                        Err(_) => break, // the session is closed
                    },
                    _ = repeat.tick() => self.put_modes().await?,
                    _ = status.tick() => self.put_status().await?,
                    () = &mut stop => break,
                }
            }
            // An ingest in this process has already stopped, but its last frames may still be in
            // transit.
            let deadline = Instant::now() + LAST_FRAMES_IN_ALL;
            while Instant::now() < deadline
                && let Ok(Ok(delivery)) =
                    tokio::time::timeout(LAST_FRAMES, deliveries.recv_async()).await
            {
                self.take(delivery).await?;
            }
            if let (Some(memory), Some(core)) = (self.memory.take(), &self.core) {
                memory.close(core).await;
            }
            self.token.withdraw().await?;
            Ok(())
        })
    }

    /// Processes frames on a thread of their own, because an epoch takes longer than an async
    /// thread may be blocked.
    async fn take(&mut self, delivery: Delivery<FrameBlock>) -> Result<(), ModesError> {
        let Some(mut core) = self.core.take() else {
            return Ok(()); // an earlier call has ended the service
        };
        let before = core.declared().epochs();
        let worked = tokio::task::spawn_blocking(move || {
            let mut outputs = Vec::new();
            core.handle(&delivery, &mut outputs);
            (core, outputs)
        });
        let (core, outputs) = match worked.await {
            Ok(worked) => worked,
            // The supervisor restarts the service, which then resumes from its checkpoint.
            Err(error) => match error.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                Err(_) => return Ok(()), // the runtime is shutting down
            },
        };
        for output in outputs {
            match output {
                ModesOutput::Mode(display) => self.put_mode(&display).await?,
                ModesOutput::Parameter(display) => self.put_parameter(&display).await?,
                ModesOutput::Event(event) => self.events.put(&event).await?,
            }
        }
        if let Some(memory) = &mut self.memory {
            let is_epoch_over = core.declared().epochs() > before;
            memory.keep(&core, is_epoch_over).await;
        }
        put_progress(&self.progress, &core);
        self.core = Some(core);
        Ok(())
    }

    async fn put_modes(&self) -> Result<(), ModesError> {
        let displays = self.core.iter().flat_map(|core| core.declared().displays());
        for display in displays {
            self.put_mode(display).await?;
        }
        let parameters = self
            .core
            .iter()
            .flat_map(|core| core.declared().parameters());
        for display in parameters {
            self.put_parameter(display).await?;
        }
        Ok(())
    }

    async fn put_parameter(&self, display: &ParameterDisplay) -> Result<(), ModesError> {
        match self.parameters.get(&display.parameter) {
            Some(topic) => Ok(topic.put(display).await?),
            None => Ok(()), // every parameter has a topic
        }
    }

    async fn put_mode(&self, display: &ModeDisplay) -> Result<(), ModesError> {
        match self.topics.get(&display.mode) {
            Some(topic) => Ok(topic.put(display).await?),
            None => Ok(()), // every declared mode has a topic
        }
    }

    async fn put_status(&mut self) -> Result<(), ModesError> {
        let mut drops = self.frames.counts().drops();
        if let Some(memory) = &mut self.memory {
            memory.look().await;
            drops.extend(memory.drops());
        }
        let core = self.core.as_ref();
        let unidentified = core.map_or(0, Following::unidentified);
        if unidentified > 0 {
            drops.insert("unidentified-epochs".to_owned(), unidentified);
        }
        let failed = core.map_or(0, |core| core.declared().failed_updates());
        if failed > 0 {
            drops.insert("failed-updates".to_owned(), failed);
        }
        let report = Report {
            done: core
                .and_then(Following::position)
                .map_or(0, |at| at.sequence),
            processed_ns: core.and_then(Following::last_time_ns),
            drops,
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

/// Reports the processed frames. A source can be waiting for the last progress before a restart.
fn put_progress(progress: &ProgressPublisher, core: &Following) {
    if let Some(at) = core.position() {
        progress.set(
            at.epoch,
            at.sequence,
            core.last_time_ns().unwrap_or(i64::MIN),
        );
    }
}
