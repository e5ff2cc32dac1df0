//! Joins the alignment of one structure to the bus.

use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use spandrel_bus::{
    Block, BoxedFuture, Bus, Delivery, DisplayPublisher, Forget, FrameBlock, Keep, Keys, LiveToken,
    LiveWatch, Name, NumberedPublisher, NumberedStream, Older, Pace, ProgressPublisher, Reading,
    SampleBlock, Service, Start, Status, StreamGroup, StreamState,
};
use spandrel_structure::Structure;
use tokio::time::{Instant, MissedTickBehavior, interval};
use tracing::{info, warn};

use crate::align::{Alignment, Input, NodePlace};
use crate::error::IngestError;
use crate::lateness::Lateness;
use crate::layout::Layout;
use crate::recorder::{Past, Recorder, RecordingSettings};

/// Frames for readers that missed some, or begin to read; larger than the window that a replay keeps. Without a recording they
/// are in memory.
pub const FRAMES_KEPT: u64 = 131_072;
/// Frames in memory where there is a recording, for readers that are nearly in time: those that are recorded, of which older ones come
/// out of the recording, and those that wait for the disk.
const IN_MEMORY: Keep = Keep {
    last: 8_192,
    needed: None,
    released: Some(Forget {
        at_least: 1_024,
        after: Duration::ZERO,
    }),
};

/// How often the status is put.
const STATUS_EVERY: Duration = Duration::from_secs(1);
/// How often it is decided whether lateness is over.
const DEADLINE_EVERY: Duration = Duration::from_millis(50);
/// A node without token is lost when nothing of it has arrived for this long: its last blocks may still be on their way.
const GRACE: Duration = Duration::from_secs(2);
/// The same where the tokens of all nodes are gone: that is a link that is down, and they come back one by one.
const GRACE_OF_ALL: Duration = Duration::from_secs(12);
/// How long a frame waits for late samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Waiting {
    /// For ever, so that the same record gives the same frames: for replay and simulation.
    Unlimited,
    /// As long as this after others have delivered it: for sensors that may be silent.
    Limited(Duration),
}

/// What one instance of ingest is told.
#[derive(Clone, Debug)]
pub struct IngestSettings {
    /// The instance.
    pub id: Name,
    /// Epoch of the first run: higher at each start, such as the wall clock in ns.
    pub epoch: u64,
    /// How long frames wait.
    pub waiting: Waiting,
    /// Where frames are recorded; none: nowhere, and a new start begins a new epoch.
    pub recording: Option<RecordingSettings>,
}

/// What is known of the token of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sign {
    /// It is there, or has never been there: a sensor need not have one.
    Present,
    /// It is gone, but samples may still be on their way.
    Gone,
    /// It is gone, and no samples have come since.
    Lost,
}

/// The ingest service of one structure.
#[derive(Debug)]
pub struct IngestService {
    core: Alignment,
    layout: Layout,
    lateness: Option<Lateness>,
    started: Instant,
    nodes: StreamGroup<SampleBlock>,
    last_heard: Vec<Duration>,
    signs: Vec<Sign>,
    /// Until when no node is lost, because the tokens of all were gone at once.
    patient_until: Duration,
    /// Whether they are.
    all_gone: bool,
    /// Nodes whose last block was their end.
    ended: Vec<bool>,
    tokens: LiveWatch,
    frames: NumberedPublisher<FrameBlock>,
    progress: ProgressPublisher,
    status: DisplayPublisher<Status>,
    keys: Keys,
    id: Name,
    service: Name,
    /// That of the last block: the nodes of a structure are either all live or all replayed.
    pace: Pace,
    /// The same, for the status: none before the first block.
    pace_heard: Option<Pace>,
    done: u64,
    last_time_ns: Option<i64>,
    /// away while the thread for that writes
    recorder: Option<Box<Recorder>>,
    token: LiveToken,
}

impl IngestService {
    /// Checks everything and joins the bus.
    ///
    /// # Errors
    /// The structure makes no frames, or the bus refuses a declaration.
    pub async fn start(
        structure: &Structure,
        bus: &Bus,
        keys: Keys,
        settings: IngestSettings,
    ) -> Result<Self, IngestError> {
        let layout = Layout::of(structure).map_err(|source| IngestError::Layout {
            structure: structure.name().to_owned(),
            source,
        })?;
        let channels = structure
            .channels()
            .map(|channel| channel.name().to_owned())
            .collect();
        Self::start_with(layout, channels, bus, keys, settings).await
    }

    /// As [`IngestService::start`], for a layout that does not come from a structure file; `channels` names its channels in
    /// their order.
    ///
    /// # Errors
    /// The recording cannot be opened, or the bus refuses a declaration.
    pub fn start_with<'a>(
        layout: Layout,
        channels: Vec<String>,
        bus: &'a Bus,
        keys: Keys,
        settings: IngestSettings,
    ) -> BoxedFuture<'a, Result<Self, IngestError>> {
        Box::pin(async move {
            let IngestSettings {
                id,
                epoch,
                waiting,
                recording,
            } = settings;
            let (recorder, past) = match &recording {
                Some(recording) => {
                    let structure = keys.structure().as_str();
                    let opened = tokio::task::block_in_place(|| {
                        Recorder::open(structure, &layout, channels, recording)
                    })?;
                    (Some(Box::new(opened.0)), opened.1)
                }
                None => (None, None),
            };
            // Were frames heard of that are not recorded, their numbers must not come again with other samples.
            let epoch = past
                .as_ref()
                .map_or(epoch, |past| epoch.max(past.last.header.epoch + 1));
            let past = past.filter(|past| past.is_whole);
            let mut stream = NumberedStream {
                key: keys.frames(),
                buffer_key: keys.recording(),
                source: id.to_string(),
                epoch,
                first: 0,
                state: StreamState::Running,
                keep: if recorder.is_some() {
                    IN_MEMORY
                } else {
                    Keep::last(FRAMES_KEPT)
                },
            };
            let mut core = Alignment::new(layout.clone(), id.to_string(), epoch);
            let mut places: Vec<NodePlace> = Vec::new();
            let progress = bus
                .publish_progress(keys.progress(Service::Ingest), id.to_string())
                .await?;
            let (mut done, mut last_time_ns) = (0, None);
            if let Some(Past { last, nodes, .. }) = past {
                info!(
                    structure = keys.structure().as_str(),
                    frame = last.end(),
                    "goes on where its recording ended"
                );
                (stream.epoch, stream.first, stream.state) =
                    (last.header.epoch, last.end(), last.state);
                core = core.going_on(&last, &nodes);
                places = nodes;
                done = last.end();
                last_time_ns = last
                    .grid()
                    .zip(done.checked_sub(1))
                    .map(|(grid, number)| grid.time_ns(number));
                // Sources may wait for what this service did last before it was killed, and could not say.
                progress.set(stream.epoch, done, last_time_ns.unwrap_or(i64::MIN));
            }
            let older = recorder.as_ref().map(|recorder| Older {
                archive: Arc::new(recorder.archive()),
                recent: FRAMES_KEPT,
            });
            let frames = bus.publish_archived(stream, older).await?;
            let mut nodes = Vec::new();
            for (position, node) in layout.nodes().iter().enumerate() {
                let start = match places.get(position) {
                    Some(place) => Start::At {
                        epoch: place.epoch,
                        sequence: place.sequence,
                    },
                    None => Start::Beginning,
                };
                let settings = bus.reading(start);
                let source = node.name.to_string();
                let is_of_node = move |block: &SampleBlock| match block.header.source == source {
                    true => Ok(()),
                    false => Err("foreign-blocks"),
                };
                nodes.push(Reading {
                    key: keys.samples(&node.name),
                    buffer_key: keys.buffer(&node.name),
                    settings,
                    check: Box::new(is_of_node),
                });
            }
            let node_count = nodes.len();
            let nodes = bus
                .follow_group(nodes, bus.reading(Start::Beginning).deliveries)
                .await?;
            let service = Self {
                core,
                lateness: match waiting {
                    Waiting::Unlimited => None,
                    Waiting::Limited(allowed) => Some(Lateness::new(allowed, node_count)),
                },
                started: Instant::now(),
                last_heard: vec![Duration::ZERO; node_count],
                signs: vec![Sign::Present; node_count],
                patient_until: Duration::ZERO,
                all_gone: false,
                ended: (0..node_count)
                    .map(|node| places.get(node).is_some_and(|place| place.ended))
                    .collect(),
                tokens: bus.watch_live(keys.all_live(Service::Sensor)).await?,
                frames,
                progress,
                status: bus
                    .publish_display(keys.status(Service::Ingest, &id))
                    .await?,
                service: Name::new(Service::Ingest.as_str())?,
                pace: Pace::Live,
                pace_heard: None,
                done,
                last_time_ns,
                recorder,
                // Last, because sources start when they see it: the readers above are there by then.
                token: bus.announce(keys.live(Service::Ingest, &id)).await?,
                layout,
                nodes,
                keys,
                id,
            };
            info!(
                structure = service.keys.structure().as_str(),
                nodes = node_count,
                channels = service.layout.channel_count(),
                sampling_rate_hz = service.layout.sampling_rate_hz(),
                "ingest ready"
            );
            Ok(service)
        })
    }

    /// Runs until `stop`; samples that have arrived are still aligned.
    ///
    /// # Errors
    /// The bus is closed underneath.
    pub fn run<'a>(
        self,
        stop: impl Future<Output = ()> + Send + 'a,
    ) -> BoxedFuture<'a, Result<(), IngestError>> {
        self.run_until(Box::pin(stop))
    }

    fn run_until(
        mut self,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), IngestError>> {
        Box::pin(async move {
            let mut status = interval(STATUS_EVERY);
            status.set_missed_tick_behavior(MissedTickBehavior::Delay);
            let mut deadline = interval(DEADLINE_EVERY);
            deadline.set_missed_tick_behavior(MissedTickBehavior::Delay);
            let mut known_tokens = BTreeSet::new();
            loop {
                // Not biased: at full speed samples never stop, and status and stop must still get their turn.
                tokio::select! {
                    arrival = self.nodes.next() => match arrival {
                        Some((node, delivery)) => self.take(node, delivery).await?,
                        None => break,
                    },
                    tokens = self.tokens.changed() => {
                        self.compare_tokens(&known_tokens, &tokens);
                        known_tokens = tokens;
                    }
                    _ = deadline.tick() => {
                        self.look_at_the_clock().await?;
                        if let Some(recorder) = &mut self.recorder {
                            recorder.tend().await;
                        }
                    }
                    _ = status.tick() => self.put_status().await?,
                    () = &mut stop => break,
                }
            }
            while let Some((node, delivery)) = self.nodes.next_now() {
                self.take(node, delivery).await?;
            }
            info!(
                structure = self.keys.structure().as_str(),
                frames = self.core.counts().frames,
                "ingest stopped"
            );
            self.token.withdraw().await?;
            match self.recorder {
                Some(recorder) => recorder.close().await,
                None => Ok(()),
            }
        })
    }

    async fn take(
        &mut self,
        node: usize,
        delivery: Delivery<SampleBlock>,
    ) -> Result<(), IngestError> {
        let Delivery::Block(block) = delivery else {
            return Ok(()); // logged and counted by the stream; to the alignment it is a gap in time
        };
        self.pace = block.pace;
        if self.pace_heard.replace(block.pace) != Some(block.pace) {
            self.put_status().await?; // before anybody shows a value of it
        }
        self.ended[node] = block.state == StreamState::Ended;
        let elapsed = self.started.elapsed();
        self.last_heard[node] = elapsed;
        if self.signs[node] == Sign::Lost {
            self.signs[node] = Sign::Gone;
        }
        if let (Some(lateness), Some(grid)) = (&mut self.lateness, block.grid()) {
            let count = block.iter().count() as u64;
            if let Some(last) = count.checked_sub(1) {
                lateness.arrived(node, grid.time_ns(last), elapsed);
            }
        }
        self.handle(Input::Samples { node, block }).await
    }

    async fn handle(&mut self, input: Input) -> Result<(), IngestError> {
        let mut blocks = Vec::new();
        self.core.handle(input, &mut blocks);
        if let Some(recorder) = self.recorder.take_if(|_| !blocks.is_empty()) {
            let (recorder, recorded) = recorder.record(blocks, self.core.places()).await?;
            self.recorder = Some(recorder);
            blocks = recorded;
        }
        let is_recorded = self
            .recorder
            .as_ref()
            .is_some_and(|recorder| recorder.has_written_all());
        for block in blocks {
            let epoch = block.header.epoch;
            if let Some((number, _)) = block.iter().last() {
                self.done = number + 1;
                self.last_time_ns = block.grid().map(|grid| grid.time_ns(number));
            }
            if is_recorded {
                self.frames.release(epoch, block.end());
            }
            self.frames.put(block).await?;
            self.progress
                .set(epoch, self.done, self.last_time_ns.unwrap_or(i64::MIN));
        }
        Ok(())
    }

    /// Notes which nodes have come and gone.
    fn compare_tokens(&mut self, before: &BTreeSet<String>, after: &BTreeSet<String>) {
        for (node, layout) in self.layout.nodes().iter().enumerate() {
            let key = self.keys.live(Service::Sensor, &layout.name);
            match (before.contains(&key), after.contains(&key)) {
                (true, false) => self.signs[node] = Sign::Gone,
                (false, true) => self.signs[node] = Sign::Present,
                _ => {}
            }
        }
    }

    /// Tells a link that is down from nodes that are gone: all tokens vanish at once then. Whoever was lost meanwhile is expected
    /// again once the first one is back.
    async fn compare_with_an_outage(&mut self, elapsed: Duration) -> Result<(), IngestError> {
        let known = || {
            (0..self.signs.len())
                .filter(|node| !self.ended[*node] && !self.last_heard[*node].is_zero())
        };
        let all_gone =
            known().next().is_some() && known().all(|node| self.signs[node] != Sign::Present);
        if all_gone != self.all_gone {
            self.all_gone = all_gone;
            self.patient_until = elapsed + GRACE_OF_ALL;
            for node in 0..self.signs.len() {
                if !all_gone && self.signs[node] == Sign::Lost {
                    self.signs[node] = Sign::Gone;
                    self.handle(Input::Back { node }).await?;
                }
            }
        }
        Ok(())
    }

    async fn look_at_the_clock(&mut self) -> Result<(), IngestError> {
        let elapsed = self.started.elapsed();
        let silent = |heard: &Duration| elapsed.saturating_sub(*heard) >= GRACE;
        self.compare_with_an_outage(elapsed).await?;
        for node in 0..self.signs.len() {
            if self.ended[node] {
                continue; // it has said goodbye
            }
            let is_over = silent(&self.last_heard[node]) && elapsed >= self.patient_until;
            if self.signs[node] == Sign::Gone && is_over {
                self.signs[node] = Sign::Lost;
                let structure = self.keys.structure().as_str();
                let name = self.layout.nodes()[node].name.as_str();
                warn!(
                    structure,
                    node = name,
                    "node is gone, frames no longer wait for it"
                );
                self.handle(Input::Lost { node }).await?;
            }
        }
        if self.pace == Pace::Replayed {
            return Ok(()); // frames wait for the other nodes of a record, however far behind they are
        }
        let deadline = self
            .lateness
            .as_mut()
            .and_then(|lateness| lateness.deadline_ns(elapsed));
        match deadline {
            Some(time_ns) => self.handle(Input::Deadline { time_ns }).await,
            None => Ok(()),
        }
    }

    async fn put_status(&self) -> Result<(), IngestError> {
        #[expect(
            clippy::disallowed_methods,
            reason = "the status tells the lag behind the wall clock"
        )]
        let now = std::time::SystemTime::now();
        let since_epoch = now.duration_since(std::time::UNIX_EPOCH);
        let now_ns = since_epoch.map_or(0, |elapsed| elapsed.as_nanos() as i64);
        let mut drops: BTreeMap<String, u64> = self.core.counts().drops();
        for (reason, count) in self.nodes.counts().flat_map(|counts| counts.drops()) {
            *drops.entry(reason).or_default() += count;
        }
        drops.extend(self.recorder.iter().flat_map(|recorder| recorder.drops()));
        let status = Status {
            structure: self.keys.structure().clone(),
            service: self.service.clone(),
            id: self.id.clone(),
            time_ns: now_ns,
            lag_s: self
                .last_time_ns
                .map(|time_ns| now_ns.saturating_sub(time_ns) as f64 * 1e-9),
            pace: self.pace_heard,
            load: None,
            frames_behind: None,
            fit: None,
            undecided: BTreeMap::new(),
            state: None,
            done: self.done,
            drops,
            restarts: 0,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        Ok(self.status.put(&status).await?)
    }
}
