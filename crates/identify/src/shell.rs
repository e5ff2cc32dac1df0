//! Connects the identification of one structure to the bus.

use crate::displays::Displays;
use crate::error::IdentifyError;
use crate::identification::{Identification, IdentificationInput, Output};
use crate::load::LoadState;
use crate::memory::Memory;
use crate::pieces::Pieces;
use crate::pool::FilterPool;
use crate::seat::{Precedence, Seat, StandingBy};
use crate::set_aside::Span;
use crate::trouble::Trouble;
use spandrel_bus::{
    Block, BoxedFuture, Bus, BusError, Claims, Delivery, Event, EventKind, FrameBlock, Keys,
    LiveToken, LiveWatch, Load, Name, Pace, ProgressWatch, Service, Start, Status, StreamState,
    Subscription,
};
use spandrel_checkpoint::Position;
use spandrel_faults::SensorReference;
use spandrel_service::{
    Clock, LAST_FRAMES, LAST_FRAMES_IN_ALL, Monitored, Report, STATUS_EVERY, ServiceInstance,
    StatusPublisher, Stop,
};
use spandrel_structure::Structure;
use std::sync::Arc;
use tokio::time::Instant;
use tracing::{debug, info};

mod keeping_up;
mod standing;

pub use standing::ESTIMATES_KEPT;

/// Capacity of the queue for status messages of ingest. Only the last one matters.
const STATUSES_WAITING: usize = 4;

/// Processes one input on a thread of the pool and returns the rest of a long gap, as
/// [`Identification::handle_part`] does.
type ProcessInput =
    fn(&mut Identification, IdentificationInput, &mut Vec<Output>) -> Option<IdentificationInput>;

/// Start-up settings of the identification service of one structure.
#[derive(Clone, Debug)]
pub struct IdentifyPlan {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structure to identify.
    pub monitored: Monitored,
    /// The threads of the filters.
    pub pool: FilterPool,
    /// Whether the instance leads or stands by.
    pub precedence: Precedence,
    /// Reference behaviour of the sensors in the records of the baseline. Empty without a baseline.
    pub sensors: Vec<SensorReference>,
}

/// The identification service of one structure: it reads frames from the bus, and publishes
/// estimates and events.
///
/// Several instances can identify the same structure. One of them leads and the others stand by.
/// The service resumes from its last checkpoint or from the state of the leader.
///
/// On a stop, frames that have arrived are still processed, within one second.
#[derive(Debug)]
pub struct IdentifyService {
    /// `None` while joining, and while a pool thread uses it. It is lost if that thread panics.
    core: Option<Identification>,
    structure: Arc<Structure>,
    sensors: Vec<SensorReference>,
    bus: Bus,
    pool: FilterPool,
    process: ProcessInput,
    trouble: Trouble,
    /// `None` while joining.
    frames: Option<Pieces<FrameBlock>>,
    seat: Seat,
    claims: Claims,
    /// The sources of frames. Without any, there is nothing to lead.
    ingest: LiveWatch,
    /// Progress of the leader.
    led: ProgressWatch,
    /// Highest known term.
    heard: u64,
    awake: Instant,
    failed_joins: u64,
    displays: Displays,
    status: StatusPublisher,
    keys: Keys,
    id: Name,
    clock: Clock,
    token: Option<LiveToken>,
    last_time_ns: Option<i64>,
    epoch: u64,
    memory: Option<Memory>,
    /// Progress of alert. Later estimates stay in memory for longer.
    alert: ProgressWatch,
    /// Progress of ingest.
    made: ProgressWatch,
    ingest_statuses: Subscription<Status>,
    pace: Option<Pace>,
    load: LoadState,
    /// Number of omitted display values.
    shed: u64,
}

impl spandrel_service::Service for IdentifyService {
    type Plan = IdentifyPlan;
    type Error = IdentifyError;

    /// Validates the settings and joins the bus.
    ///
    /// The service resumes from its last checkpoint if [`Monitored::remembering`] is set, or from
    /// the state of the leader.
    ///
    /// # Errors
    /// Returns an error if the filter cannot be created, checkpoints cannot be written, or the bus
    /// rejects a declaration.
    fn start(plan: &IdentifyPlan) -> BoxedFuture<'_, Result<Self, IdentifyError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`. Frames that have arrived by then are still processed, within a limit of
    /// one second. The rest arrives again after a restart.
    ///
    /// # Errors
    /// Returns an error if the bus is closed, or if the thread of a filter was lost.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), IdentifyError>> {
        self.run_until(stop)
    }
}

/// Creates the core of a structure whose sensors have shown `sensors`.
fn new_core(
    structure: &Structure,
    id: &Name,
    sensors: &[SensorReference],
) -> Result<Identification, IdentifyError> {
    let mut core = Identification::new(structure, id.as_str())?;
    core.expect_sensors(sensors);
    Ok(core)
}

impl IdentifyService {
    fn start_from(plan: &IdentifyPlan) -> BoxedFuture<'_, Result<Self, IdentifyError>> {
        Box::pin(async move {
            let IdentifyPlan {
                instance,
                monitored,
                pool,
                precedence,
                sensors,
            } = plan;
            let ServiceInstance { bus, id, clock } = instance;
            let Monitored {
                structure,
                keys,
                remembering,
            } = monitored;
            let alert = bus.watch_progress(keys.progress(Service::Alert)).await?;
            let memory = match remembering {
                Some(remembering) => Some(Memory::open(structure, remembering, alert.clone())?),
                None => None,
            };
            let core = new_core(structure, id, sensors)?;
            if matches!(precedence, Precedence::StandsBy) {
                standing::check_size(structure, &core)?;
            }
            let mut service = Self {
                structure: structure.clone(),
                sensors: sensors.clone(),
                trouble: Trouble::default(),
                process: Identification::handle_part,
                pool: pool.clone(),
                frames: None,
                seat: Seat::Joining,
                claims: bus.watch_claims(keys).await?,
                ingest: bus.watch_live(keys.all_live(Service::Ingest)).await?,
                led: bus.watch_progress(keys.progress(Service::Identify)).await?,
                heard: 0,
                awake: Instant::now(),
                failed_joins: 0,
                displays: Displays::declare(&core, bus, keys).await?,
                status: instance.publish_status(Service::Identify, keys).await?,
                token: None,
                core: None,
                last_time_ns: None,
                epoch: 0,
                memory,
                alert,
                made: bus.watch_progress(keys.progress(Service::Ingest)).await?,
                ingest_statuses: bus
                    .subscribe(keys.statuses(Service::Ingest), STATUSES_WAITING)
                    .await?,
                pace: None,
                load: LoadState::new(),
                shed: 0,
                bus: bus.clone(),
                keys: keys.clone(),
                id: id.clone(),
                clock: *clock,
            };
            let leader = bus
                .query_leader(&service.keys, standing::WHO_LEADS_WITHIN)
                .await?;
            service.hear(leader.as_ref());
            match precedence {
                Precedence::Leads => {
                    service.begin().await?;
                    service.lead("the process was started").await?;
                }
                Precedence::StandsBy if leader.is_none() => service.begin().await?,
                Precedence::StandsBy => {}
            }
            service.token = Some(instance.announce(Service::Identify, keys).await?);
            let (parameters, noise_levels) = service.displays.counts();
            info!(
                structure = service.keys.structure().as_str(),
                parameters,
                noise_levels,
                sampling_rate_hz = structure.sampling_rate_hz(),
                state = ?service.seat.standing(),
                "identification ready"
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
            loop {
                // The selection is not biased. At full speed there are always frames, and status
                // and stop still need their turn.
                tokio::select! {
                    delivery = next(self.frames.as_mut()) => match delivery {
                        Some(delivery) => self.take(delivery).await?,
                        None => break,
                    },
                    (question, permit) = self.seat.question() => self.answer(question, permit),
                    () = self.claims.changed() => self.reconsider().await?,
                    _ = self.ingest.changed() => self.reconsider().await?,
                    _ = status.tick() => {
                        self.reconsider().await?;
                        if let Some(memory) = &mut self.memory {
                            memory.look().await;
                        }
                        if let Some(decided) = self.alert.latest() {
                            self.seat.release(&decided);
                        }
                        if !self.update_load().await? {
                            self.put_status().await?;
                        }
                    }
                    () = &mut stop => break,
                }
            }
            // An ingest in this process has already stopped, but its last frames may still be in
            // transit.
            let deadline = Instant::now() + LAST_FRAMES_IN_ALL;
            while Instant::now() < deadline
                && let Ok(Some(delivery)) =
                    tokio::time::timeout(LAST_FRAMES, next(self.frames.as_mut())).await
            {
                self.take(delivery).await?;
            }
            if let (Some(memory), Some(core)) = (self.memory.take(), &self.core) {
                memory.close(core).await;
            }
            if let Seat::Leading(leading) = self.seat {
                leading.token.withdraw().await?; // a standby takes over
            }
            if let Some(token) = self.token.take() {
                token.withdraw().await?;
            }
            Ok(())
        })
    }

    async fn take(&mut self, delivery: Delivery<FrameBlock>) -> Result<(), IdentifyError> {
        let input = match delivery {
            Delivery::Block(block) => {
                self.epoch = block.header.epoch;
                if block.state == StreamState::Ended {
                    debug!(
                        structure = self.keys.structure().as_str(),
                        "received the last frames"
                    );
                }
                IdentificationInput::Frames(block)
            }
            Delivery::Gap(_) if self.is_in_step() => {
                // The leader may have these frames, and its state includes them.
                self.leave();
                return Ok(());
            }
            Delivery::Gap(gap) => IdentificationInput::gap(gap.from, gap.to),
        };
        for input in self.trouble.cut(input) {
            let mut left = Some(input);
            while let Some(input) = left {
                let (from, to) = match &input {
                    IdentificationInput::Frames(block) => (block.header.sequence, block.end()),
                    IdentificationInput::Gap { from, to, .. } => (*from, *to),
                };
                let Some(mut core) = self.core.take() else {
                    return Err(IdentifyError::ThreadLost {
                        structure: self.keys.structure().to_string(),
                    });
                };
                core.thin_display(self.load.load() != Load::Normal);
                let process = self.process;
                let work = self.pool.run(move || {
                    let mut outputs = Vec::new();
                    let left = process(&mut core, input, &mut outputs);
                    (core, outputs, left)
                });
                let Some((mut core, outputs, rest)) = work.await else {
                    return self.revive(from, to).await; // the following frames arrive again
                };
                left = rest;
                self.shed += core.take_omitted();
                self.core = Some(core);
                if !self.has_kept_the_lead().await? {
                    return Ok(());
                }
                for output in outputs {
                    self.say(output).await?;
                }
            }
        }
        let done = self.core.as_ref().map_or(0, Identification::done);
        match &mut self.seat {
            Seat::Leading(leading) => {
                leading
                    .progress
                    .set(self.epoch, done, self.last_time_ns.unwrap_or(i64::MIN));
            }
            Seat::StandingBy(standing_by) => {
                if let Some(led) = self.led.latest() {
                    standing_by.held.done(&led);
                }
            }
            Seat::Joining => {}
        }
        if let (Some(memory), Some(core)) = (&mut self.memory, &self.core) {
            memory.keep_if_due(core).await;
        }
        self.update_load().await?;
        Ok(())
    }

    /// Returns `true` if this process is a standby in step with its leader.
    fn is_in_step(&self) -> bool {
        matches!(
            &self.seat,
            Seat::StandingBy(StandingBy {
                in_step_with: Some(_),
                ..
            })
        )
    }

    /// Recovers from a panic in frames `from` to before `to`.
    ///
    /// The identification restores its last checkpoint and processes the frames again. A standby in
    /// step with the leader requests the leader's state instead. Other structures are not affected.
    async fn revive(&mut self, from: u64, to: u64) -> Result<(), IdentifyError> {
        let set_aside = self.trouble.died(
            Instant::now(),
            Span {
                epoch: self.epoch,
                from,
                to,
            },
        );
        if self.trouble.is_hopeless() {
            return Err(IdentifyError::ThreadLost {
                structure: self.keys.structure().to_string(),
            });
        }
        if self.is_in_step() {
            self.leave();
            return Ok(());
        }
        let new = || new_core(&self.structure, &self.id, &self.sensors);
        let mut core = match &mut self.memory {
            Some(memory) => memory.recall_last(new).await?,
            None => new()?,
        };
        if core
            .position()
            .is_some_and(|position| position.epoch != self.epoch)
        {
            core = new()?; // estimates of a former epoch are not published again
        }
        let first = core.done();
        let Seat::Leading(leading) = &self.seat else {
            return self.stand_by(core, None).await;
        };
        leading.estimates.take_back(first);
        self.frames =
            Some(follow_frames(&self.structure, &self.bus, &self.keys, start_of(&core)).await?);
        self.last_time_ns = core.last_time_ns();
        self.core = Some(core);
        let what = match set_aside {
            Some(frame) => format!("frame {frame} is skipped and counts as missing"),
            None => format!("identification resumes from frame {first}"),
        };
        let why = format!("it panicked in frames {from} to {}", to.saturating_sub(1));
        self.tell(EventKind::Restart, what, why).await
    }

    /// Publishes an event about the identification.
    async fn tell(&self, kind: EventKind, what: String, why: String) -> Result<(), IdentifyError> {
        let event = Event {
            structure: self.keys.structure().clone(),
            time_ns: self.last_time_ns.unwrap_or(0),
            kind,
            subject: "identify".to_owned(),
            what,
            why,
        };
        Ok(self.displays.put(&Output::Event(event)).await?)
    }

    /// Publishes an output, or keeps it for a takeover.
    async fn say(&mut self, output: Output) -> Result<(), IdentifyError> {
        if let Output::Estimates(block) = &output
            && let (Some(grid), Some(last)) = (block.grid(), block.estimates.len().checked_sub(1))
        {
            self.last_time_ns = Some(grid.time_ns(block.header.sequence + last as u64));
        }
        match (&mut self.seat, output) {
            (Seat::Leading(leading), Output::Estimates(block)) => {
                leading.estimates.put(block).await?
            }
            (Seat::Leading(_), output) => self.displays.put(&output).await?,
            (Seat::StandingBy(standing_by), Output::Estimates(block)) => {
                standing_by.estimates.keep(&block)?
            }
            (Seat::StandingBy(standing_by), output) => {
                let core = self.core.as_ref();
                let end = core.and_then(Identification::position).unwrap_or_default();
                standing_by.held.keep(end, output);
            }
            (Seat::Joining, _) => {} // identification is paused
        }
        Ok(())
    }

    async fn put_status(&self) -> Result<(), IdentifyError> {
        let core = self.core.as_ref();
        let mut drops = self
            .frames
            .as_ref()
            .map(|frames| frames.counts().drops())
            .unwrap_or_default();
        if self.trouble.set_aside() > 0 {
            drops.insert("frames-set-aside".to_owned(), self.trouble.set_aside());
        }
        if self.shed > 0 {
            drops.insert("shed-values".to_owned(), self.shed);
        }
        drops.extend(
            self.memory
                .as_ref()
                .and_then(|memory| memory.failures().drops()),
        );
        let report = Report {
            done: core.map_or(0, Identification::done),
            processed_ns: self.last_time_ns,
            drops,
            restarts: core.map_or(0, Identification::restarts) + self.trouble.deaths(),
            state: Some(self.seat.standing()),
            load: Some(self.load.load()),
            frames_behind: self.load.behind(),
            fit: core.and_then(Identification::fit_verdict),
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

/// Waits for the next frames. Never returns without a reader.
async fn next(frames: Option<&mut Pieces<FrameBlock>>) -> Option<Delivery<FrameBlock>> {
    match frames {
        Some(frames) => frames.next().await,
        None => std::future::pending().await,
    }
}

/// Returns the position from which an identification needs frames.
fn start_of(core: &Identification) -> Start {
    match core.position() {
        Some(Position { epoch, sequence }) => Start::At { epoch, sequence },
        None => Start::Beginning,
    }
}

/// Reads the frames of a structure and rejects others.
async fn follow_frames(
    structure: &Structure,
    bus: &Bus,
    keys: &Keys,
    start: Start,
) -> Result<Pieces<FrameBlock>, BusError> {
    let (channels, rate_hz) = (structure.channel_count(), structure.sampling_rate_hz());
    let is_of_structure = move |block: &FrameBlock| match usize::from(block.channels) == channels
        && block.sampling_rate_hz == rate_hz
    {
        true => Ok(()),
        false => Err("frames-of-another-structure"),
    };
    let reading = bus.reading(start).patient();
    Ok(Pieces::of(
        bus.follow_fit(keys.frames(), keys.recording(), reading, is_of_structure)
            .await?,
    ))
}

#[cfg(test)]
mod tests;
