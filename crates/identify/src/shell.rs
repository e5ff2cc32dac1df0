//! Joins the identification of one structure to the bus.

use crate::error::IdentifyError;
use crate::identification::{Identification, Input, Output};
use crate::load::LoadState;
use crate::memory::Memory;
use crate::pool::FilterPool;
use crate::trouble::Trouble;
use spandrel_bus::{
    Block, Bus, BusError, Delivery, Description, DisplayPublisher, EstimateBlock, Event, EventKind, Forget, FrameBlock,
    Keys, LatestPublisher, LiveToken, Load, Message, ModelClassDisplay, Name, NoiseDisplay, NumberedPublisher,
    NumberedStream, OutlierDisplay, Pace, ParameterDisplay, ProgressPublisher, ProgressWatch, Service, Start, Status,
    Stream, StreamState, Subscription,
};
use spandrel_checkpoint::Remembering;
use spandrel_structure::Structure;
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::future::Future;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tracing::{debug, info, warn};

/// Estimates kept for readers that missed some, for a while.
pub const ESTIMATES_KEPT: u64 = 32_768;
/// In live operation fewer: larger than the window that a replay keeps.
const FORGET: Forget = Forget { at_least: 8_192, after: Duration::from_secs(30) };

/// How often the status is put.
const STATUS_EVERY: Duration = Duration::from_secs(1);

/// Statuses of ingest that wait to be read: the last one counts.
const STATUSES_WAITING: usize = 4;

/// Panics of one identification after which the service gives up: they are no longer single frames.
const MOST_DEATHS: u64 = 100;

/// After a stop, frames are waited for until none has come for this long.
const LAST_FRAMES: Duration = Duration::from_millis(100);

/// The identification service of one structure.
#[derive(Debug)]
pub struct IdentifyService {
    /// taken while a thread of the pool has it, and lost where that has panicked
    core: Option<Identification>,
    structure: Structure,
    bus: Bus,
    pool: FilterPool,
    trouble: Trouble,
    frames: Stream<FrameBlock>,
    estimates: NumberedPublisher<EstimateBlock>,
    parameters: BTreeMap<Name, DisplayPublisher<ParameterDisplay>>,
    noise: BTreeMap<Name, DisplayPublisher<NoiseDisplay>>,
    outliers: BTreeMap<Name, DisplayPublisher<OutlierDisplay>>,
    classes: Option<DisplayPublisher<ModelClassDisplay>>,
    events: DisplayPublisher<Event>,
    _description: LatestPublisher<Description>,
    progress: ProgressPublisher,
    status: DisplayPublisher<Status>,
    keys: Keys,
    service: Name,
    id: Name,
    token: Option<LiveToken>,
    last_time_ns: Option<i64>,
    epoch: u64,
    memory: Option<Memory>,
    /// how far ingest is, and whether its samples wait for nobody
    ingest: ProgressWatch,
    ingest_statuses: Subscription<Status>,
    pace: Option<Pace>,
    load: LoadState,
    /// values for people that were left out
    shed: u64,
}

impl IdentifyService {
    /// Checks everything and joins the bus; `id` names this instance, which goes on from its last checkpoint where
    /// `remembering` says that it keeps any.
    ///
    /// # Errors
    /// When the filter cannot be made, the checkpoints cannot be kept, or the bus refuses a declaration.
    pub async fn start(
        structure: &Structure,
        bus: &Bus,
        keys: Keys,
        id: Name,
        pool: FilterPool,
        remembering: Option<&Remembering>,
    ) -> Result<Self, IdentifyError> {
        let new = || Identification::new(structure, id.as_str());
        let memory = match remembering {
            Some(remembering) => {
                let alert = bus.watch_progress(keys.progress(Service::Alert)).await?;
                Some(Memory::open(structure, remembering, alert)?)
            }
            None => None,
        };
        let core = match &memory {
            Some(memory) => memory.recall(new)?,
            None => new()?,
        };
        let (epoch, first) = core.position().unwrap_or((0, 0)); // without a past: the epoch of the first frames
        let start = start_of(&core);
        let estimates = bus
            .publish_numbered(NumberedStream {
                key: keys.estimates(),
                buffer_key: keys.estimates_buffer(),
                source: id.to_string(),
                epoch,
                first,
                state: StreamState::Running,
                capacity: ESTIMATES_KEPT,
                forget: Some(FORGET),
            })
            .await?;
        let mut parameters = BTreeMap::new();
        for name in core.parameter_names() {
            parameters.insert(name.clone(), bus.publish_display(keys.parameter(name)).await?);
        }
        let mut noise = BTreeMap::new();
        for name in core.noise_names() {
            noise.insert(name.clone(), bus.publish_display(keys.noise(name)).await?);
        }
        let mut outliers = BTreeMap::new();
        for name in core.screened_channels() {
            outliers.insert(name.clone(), bus.publish_display(keys.outlier(name)).await?);
        }
        let classes = match core.compares_classes() {
            true => Some(bus.publish_display(keys.model_class()).await?),
            false => None,
        };
        let description = bus.publish_latest(keys.description()).await?;
        description
            .put(&Description { structure: keys.structure().clone(), text: structure.text().to_owned() })
            .await?;
        let frames = follow_frames(structure, bus, &keys, start).await?;
        let progress = bus.publish_progress(keys.progress(Service::Identify), id.to_string()).await?;
        let ingest = bus.watch_progress(keys.progress(Service::Ingest)).await?;
        let ingest_statuses = bus.subscribe(keys.statuses(Service::Ingest), STATUSES_WAITING).await?;
        let last_time_ns = core.last_time_ns();
        if let Some((epoch, done)) = core.position() {
            // Sources may wait for what this service did last before it was killed, and could not say.
            progress.set(epoch, done, last_time_ns.unwrap_or(i64::MIN));
        }
        let service = Self {
            structure: structure.clone(),
            bus: bus.clone(),
            trouble: Trouble::default(),
            pool,
            frames,
            estimates,
            parameters,
            noise,
            outliers,
            classes,
            events: bus.publish_display(keys.event()).await?,
            _description: description,
            progress,
            status: bus.publish_display(keys.status(Service::Identify, &id)).await?,
            token: Some(bus.announce(keys.live(Service::Identify, &id)).await?),
            core: Some(core),
            service: Name::new(Service::Identify.as_str())
                .map_err(|source| IdentifyError::Name { structure: structure.name().to_owned(), source })?,
            keys,
            id,
            last_time_ns,
            epoch,
            memory,
            ingest,
            ingest_statuses,
            pace: None,
            load: LoadState::new(),
            shed: 0,
        };
        info!(
            structure = service.keys.structure().as_str(),
            parameters = service.parameters.len(),
            noise_levels = service.noise.len(),
            sampling_rate_hz = structure.sampling_rate_hz(),
            "identification ready"
        );
        Ok(service)
    }

    /// Runs until `stop`; blocks that have arrived are still done.
    ///
    /// # Errors
    /// When the bus is closed underneath, or the thread of a filter was lost.
    pub async fn run(mut self, stop: impl Future<Output = ()>) -> Result<(), IdentifyError> {
        tokio::pin!(stop);
        let mut status = tokio::time::interval(STATUS_EVERY);
        loop {
            let deliveries = self.frames.deliveries().clone();
            // Not biased: at full speed frames never stop, and status and stop must still get their turn.
            tokio::select! {
                delivery = deliveries.recv_async() => match delivery {
                    Ok(delivery) => self.take(delivery).await?,
                    Err(flume::RecvError::Disconnected) => break,
                },
                _ = status.tick() => {
                    if !self.look_at_the_load().await? {
                        self.put_status().await?;
                    }
                }
                () = &mut stop => break,
            }
        }
        // Ingest has stopped before: what it put last may still be on its way through the reader.
        loop {
            let deliveries = self.frames.deliveries().clone();
            let Ok(Ok(delivery)) = tokio::time::timeout(LAST_FRAMES, deliveries.recv_async()).await else { break };
            self.take(delivery).await?;
        }
        if let (Some(memory), Some(core)) = (self.memory.take(), &self.core) {
            memory.close(core).await;
        }
        if let Some(token) = self.token.take() {
            token.withdraw().await?;
        }
        Ok(())
    }

    async fn take(&mut self, delivery: Delivery<FrameBlock>) -> Result<(), IdentifyError> {
        let input = match delivery {
            Delivery::Block(block) => {
                self.epoch = block.header.epoch;
                if block.state == StreamState::Ended {
                    debug!(structure = self.keys.structure().as_str(), "last frames have come");
                }
                Input::Frames(block)
            }
            Delivery::Gap(gap) => Input::Gap { from: gap.from, to: gap.to },
        };
        for input in self.trouble.cut(input) {
            let (from, to) = match &input {
                Input::Frames(block) => (block.header.sequence, block.end()),
                Input::Gap { from, to } => (*from, *to),
            };
            let Some(mut core) = self.core.take() else {
                return Err(IdentifyError::ThreadLost { structure: self.keys.structure().to_string() });
            };
            core.thin_display(self.load.load() != Load::Normal);
            let work = self.pool.run(move || {
                let mut outputs = Vec::new();
                core.handle(input, &mut outputs);
                (core, outputs)
            });
            let Some((mut core, outputs)) = work.await else {
                return self.revive(from, to).await; // what follows comes again
            };
            self.shed += core.take_shed();
            self.core = Some(core);
            for output in outputs {
                self.put(output).await?;
            }
        }
        let done = self.core.as_ref().map_or(0, Identification::done);
        self.progress.set(self.epoch, done, self.last_time_ns.unwrap_or(i64::MIN));
        if let (Some(memory), Some(core)) = (&mut self.memory, &self.core) {
            memory.keep_if_due(core).await;
        }
        self.look_at_the_load().await?;
        Ok(())
    }

    /// Compares what is done with what ingest has made; a change of the load is told at once, and `true` returned.
    async fn look_at_the_load(&mut self) -> Result<bool, IdentifyError> {
        if let Some((_, status)) = self.ingest_statuses.messages().try_iter().last() {
            self.pace = status.pace;
        }
        let Some(made) = self.ingest.latest() else {
            return Ok(false); // nothing is known of ingest
        };
        let done = self.core.as_ref().map_or(0, Identification::done);
        let behind = match made.header.epoch.cmp(&self.epoch) {
            Ordering::Less => 0, // said in an earlier life
            Ordering::Equal => made.done.saturating_sub(done),
            Ordering::Greater => made.done, // and what is left of the epoch before
        };
        if !self.load.observe(behind, self.pace) {
            return Ok(false);
        }
        self.put_status().await?;
        let (kind, what) = match self.load.load() {
            Load::DisplayShed => (EventKind::Overloaded, "values for people are put at a tenth of their rate"),
            Load::Normal => (EventKind::CaughtUp, "values for people are put as ever"),
            Load::Behind | Load::CatchingUp => return Ok(true),
        };
        let event = Event {
            structure: self.keys.structure().clone(),
            time_ns: self.last_time_ns.unwrap_or(0),
            kind,
            subject: self.service.to_string(),
            what: what.to_owned(),
            why: format!("identification is {behind} frames behind ingest"),
        };
        self.put(Output::Event(event)).await?;
        Ok(true)
    }

    /// The identification has panicked in frames `from` to before `to`: goes back to its last checkpoint, and over the same frames
    /// again. All other structures are not touched.
    async fn revive(&mut self, from: u64, to: u64) -> Result<(), IdentifyError> {
        let set_aside = self.trouble.died(self.epoch, from, to);
        if self.trouble.deaths() > MOST_DEATHS {
            return Err(IdentifyError::ThreadLost { structure: self.keys.structure().to_string() });
        }
        let new = || Identification::new(&self.structure, self.id.as_str());
        let mut core = match &mut self.memory {
            Some(memory) => memory.recall_last(new).await?,
            None => new()?,
        };
        if core.position().is_some_and(|(epoch, _)| epoch != self.epoch) {
            core = new()?; // the estimates of an epoch that is over are not put again
        }
        let first = core.done();
        self.estimates.take_back(first);
        self.frames = follow_frames(&self.structure, &self.bus, &self.keys, start_of(&core)).await?;
        self.last_time_ns = core.last_time_ns();
        self.core = Some(core);
        let what = match set_aside {
            Some(frame) => format!("frame {frame} is set aside: it counts as missing"),
            None => format!("identification goes on from frame {first}"),
        };
        let event = Event {
            structure: self.keys.structure().clone(),
            time_ns: self.last_time_ns.unwrap_or(0),
            kind: EventKind::Restart,
            subject: "identify".to_owned(),
            what,
            why: format!("it has panicked in frames {from} to {}", to.saturating_sub(1)),
        };
        self.put(Output::Event(event)).await
    }

    async fn put(&mut self, output: Output) -> Result<(), IdentifyError> {
        match output {
            Output::Estimates(block) => {
                if let (Some(grid), Some(last)) = (block.grid(), block.estimates.len().checked_sub(1)) {
                    self.last_time_ns = Some(grid.time_ns(block.header.sequence + last as u64));
                }
                self.estimates.put(block).await?;
            }
            Output::Parameter(display) => {
                if let Some(publisher) = self.parameters.get(&display.parameter) {
                    show(publisher, &display).await?;
                }
            }
            Output::Noise(display) => {
                if let Some(publisher) = self.noise.get(&display.name) {
                    show(publisher, &display).await?;
                }
            }
            Output::Outliers(display) => {
                if let Some(publisher) = self.outliers.get(&display.channel) {
                    show(publisher, &display).await?;
                }
            }
            Output::Classes(display) => {
                if let Some(publisher) = &self.classes {
                    show(publisher, &display).await?;
                }
            }
            Output::Responses(_) => {} // for files
            Output::Event(event) => {
                log_event(&event, None);
                self.events.put(&event).await?;
            }
        }
        Ok(())
    }

    async fn put_status(&self) -> Result<(), IdentifyError> {
        #[expect(clippy::disallowed_methods, reason = "the status tells the lag behind the wall clock")]
        let now = SystemTime::now();
        let now_ns = now.duration_since(UNIX_EPOCH).map_or(0, |elapsed| elapsed.as_nanos() as i64);
        let core = self.core.as_ref();
        let mut drops = self.frames.counts().drops();
        if self.trouble.set_aside() > 0 {
            drops.insert("frames-set-aside".to_owned(), self.trouble.set_aside());
        }
        if self.shed > 0 {
            drops.insert("shed-values".to_owned(), self.shed);
        }
        let status = Status {
            structure: self.keys.structure().clone(),
            service: self.service.clone(),
            id: self.id.clone(),
            time_ns: now_ns,
            lag_s: self.last_time_ns.map(|time_ns| now_ns.saturating_sub(time_ns) as f64 / 1e9),
            pace: None,
            load: Some(self.load.load()),
            frames_behind: self.load.behind(),
            done: core.map_or(0, Identification::done),
            drops,
            restarts: core.map_or(0, Identification::restarts) + self.trouble.deaths(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        Ok(self.status.put(&status).await?)
    }
}

/// Where an identification wants its frames from.
fn start_of(core: &Identification) -> Start {
    match core.position() {
        Some((epoch, sequence)) => Start::At { epoch, sequence },
        None => Start::Beginning,
    }
}

/// Reads the frames of a structure; others are refused.
async fn follow_frames(
    structure: &Structure,
    bus: &Bus,
    keys: &Keys,
    start: Start,
) -> Result<Stream<FrameBlock>, BusError> {
    let (channels, rate_hz) = (structure.channel_count(), structure.sampling_rate_hz());
    let is_of_structure =
        move |block: &FrameBlock| match usize::from(block.channels) == channels && block.sampling_rate_hz == rate_hz {
            true => Ok(()),
            false => Err("frames-of-another-structure"),
        };
    bus.follow_fit(keys.frames(), keys.recording(), bus.reading(start).patient(), is_of_structure).await
}

/// Puts a message for people; one that holds no numbers is told of and left out, the service goes on.
async fn show<M: Message>(publisher: &DisplayPublisher<M>, message: &M) -> Result<(), BusError> {
    match publisher.put(message).await {
        Err(error @ BusError::Encode { .. }) => {
            warn!(%error, "not shown");
            Ok(())
        }
        result => result,
    }
}

/// Logs an event: what was mended or lost as a warning, what belongs to normal work as information.
///
/// Its time of measurement is logged in ns since 1970 as on the bus, or in seconds since `start_ns` where a record has one.
pub fn log_event(event: &Event, start_ns: Option<i64>) {
    let (structure, subject) = (event.structure.as_str(), event.subject.as_str());
    let time_s = start_ns.map(|start_ns| event.time_ns.saturating_sub(start_ns) as f64 / 1e9);
    let time_ns = start_ns.is_none().then_some(event.time_ns);
    match event.kind {
        EventKind::Calibration
        | EventKind::LeadingClass
        | EventKind::NodeBack
        | EventKind::ChannelBack
        | EventKind::CaughtUp => {
            info!(structure, subject, time_s, time_ns, what = event.what, why = event.why, "event");
        }
        EventKind::Restart
        | EventKind::Unidentified
        | EventKind::NodeExcluded
        | EventKind::NodeSilent
        | EventKind::ChannelExcluded
        | EventKind::Gap
        | EventKind::Overloaded => {
            warn!(structure, subject, time_s, time_ns, what = event.what, why = event.why, "event");
        }
    }
}

#[cfg(test)]
mod tests;
