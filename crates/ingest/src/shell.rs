//! Connects the alignment of one structure to the bus.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use spandrel_bus::{
    Block, BoxedFuture, Bus, Delivery, Event, EventKind, Forget, FrameBlock, Keep, Keys, LiveToken,
    LiveWatch, NumberedPublisher, NumberedStream, Older, Pace, ProgressPublisher, Reading,
    SampleBlock, Service, Start, StreamCounts, StreamGroup, StreamState,
};
use spandrel_service::{
    Clock, EventPublisher, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use spandrel_waveforms::Displays;
use tokio::time::{Instant, MissedTickBehavior, interval};
use tracing::{info, warn};

use crate::align::{Alignment, AlignmentInput, NodePlace};
use crate::block_watch::{BlockReport, BlockWatch};
use crate::drop_watch::{DropReport, DropWatch};
use crate::error::IngestError;
use crate::layout::{Layout, NodeLayout};
use crate::missing_share::MissingShare;
use crate::quality_watch::QualityWatch;
use crate::recorder::{FolderChange, Past, Recorder, RecordingSettings};
use crate::timekeeping::Timekeeping;

mod clocks;

/// Number of frames kept for subscribers that start late or missed frames. It exceeds the
/// flow-control window of a replay. Without a recording, all of them are in memory.
pub const FRAMES_KEPT: u64 = 131_072;
/// Frames in memory if there is a recording, for subscribers that are almost up to date.
///
/// They include the latest recorded frames and all frames that wait for the disk. Older frames come
/// from the recording.
const IN_MEMORY: Keep = Keep {
    last: 8_192,
    needed: None,
    released: Some(Forget {
        at_least: 1_024,
        after: Duration::ZERO,
    }),
};

/// Interval between checks of the deadline.
const DEADLINE_EVERY: Duration = Duration::from_millis(50);
/// Time without samples after which a node without a token is lost. Its last blocks may still be in
/// transit.
const GRACE: Duration = Duration::from_secs(2);
/// Like `GRACE`, but for the case that the tokens of all nodes disappear. The cause is a broken
/// link, and the tokens return one by one.
const GRACE_OF_ALL: Duration = Duration::from_secs(12);
/// Time without an excluded block after which a node is no longer locked out.
const LOCKOUT_OVER_AFTER: Duration = Duration::from_secs(3);
/// Time without a rejected block after which the next one is reported again.
const REJECTION_OVER_AFTER: Duration = Duration::from_secs(60);

/// Policy for how long a frame waits for late samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameWait {
    /// Frames wait indefinitely, so that the same record always gives the same frames. Intended for
    /// replay and simulation.
    Unlimited,
    /// Frames wait this long after other nodes have delivered them. Intended for sensors that may
    /// fall silent.
    Limited(Duration),
}

/// Start-up settings of the ingest service of one structure.
#[derive(Clone, Debug)]
pub struct IngestPlan {
    /// Session, id and clock of the service. The time of the clock is the epoch of the first run.
    pub instance: ServiceInstance,
    /// The structure whose samples are aligned to frames.
    pub monitored: Monitored,
    /// Settings of the recording. With `None`, frames are not recorded, and every start begins a
    /// new epoch.
    pub recording: Option<RecordingSettings>,
}

/// Settings of ingest for one frame layout.
#[derive(Clone, Debug)]
pub struct IngestSettings {
    /// How long frames wait for late samples.
    pub waiting: FrameWait,
    /// Whether the nodes publish waveforms and spectra of their samples. Ingest then publishes
    /// none.
    pub nodes_publish_waveforms: bool,
    /// Settings of the recording. With `None`, frames are not recorded, and every start begins a
    /// new epoch.
    pub recording: Option<RecordingSettings>,
}

/// The state of a node's liveliness token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sign {
    /// The token is present, or has never been present. A sensor may run without a token.
    Present,
    /// The token has disappeared, but samples may still be in transit.
    Gone,
    /// The token has disappeared, and no samples have arrived since.
    Lost,
}

/// The ingest service of one structure: it aligns the samples of all nodes to frames, and publishes
/// and records the frames.
///
/// The service starts with an [`IngestPlan`] and runs until it is stopped. Samples that have
/// arrived by then are still aligned. Without a recording, every start begins a new epoch.
#[derive(Debug)]
pub struct IngestService {
    core: Alignment,
    layout: Layout,
    /// `None` if frames wait without limit.
    timekeeping: Option<Timekeeping>,
    started: Instant,
    nodes: StreamGroup<SampleBlock>,
    last_heard: Vec<Duration>,
    /// Whether a node has delivered something, in this or an earlier run of ingest.
    has_begun: Vec<bool>,
    /// Number of samples that nodes published before ingest began to read them.
    earlier_samples: u64,
    signs: Vec<Sign>,
    /// Time until which no node is lost, because all tokens disappeared at once.
    patient_until: Duration,
    /// Whether the tokens of all active nodes are missing.
    all_gone: bool,
    /// Whether the last block of each node ended its stream.
    ended: Vec<bool>,
    tokens: LiveWatch,
    frames: NumberedPublisher<FrameBlock>,
    displays: Displays,
    progress: ProgressPublisher,
    status: StatusPublisher,
    drop_watch: DropWatch,
    lockout_watch: BlockWatch,
    rejection_watch: BlockWatch,
    /// Blocks with another number of channels.
    channel_watch: BlockWatch,
    quality_watch: QualityWatch,
    missing_share: MissingShare,
    clock: Clock,
    events: EventPublisher,
    keys: Keys,
    /// Pace of the last block. The nodes of a structure are either all live or all replayed.
    pace: Pace,
    /// Pace of the last block for the status; `None` before the first block.
    pace_heard: Option<Pace>,
    done: u64,
    last_time_ns: Option<i64>,
    /// `None` while the disk thread writes.
    recorder: Option<Box<Recorder>>,
    token: LiveToken,
}

/// Where the service begins.
struct Beginning {
    core: Alignment,
    stream: NumberedStream,
    /// Position of each node. Empty without recorded frames.
    places: Vec<NodePlace>,
    done: u64,
    last_time_ns: Option<i64>,
}

impl Beginning {
    /// Begins an epoch of the service `id`, without earlier frames.
    fn of_epoch(epoch: u64, id: String, layout: &Layout, keys: &Keys, keep: Keep) -> Self {
        Self {
            core: Alignment::new(layout.clone(), id.clone(), epoch),
            stream: NumberedStream {
                key: keys.frames(),
                buffer_key: keys.recording(),
                source: id,
                epoch,
                first: 0,
                state: StreamState::Running,
                keep,
            },
            places: Vec::new(),
            done: 0,
            last_time_ns: None,
        }
    }

    /// Resumes from the recorded frames, and reports them as processed.
    fn after(self, past: Past, keys: &Keys, progress: &ProgressPublisher) -> Self {
        let Self {
            core,
            mut stream,
            mut done,
            ..
        } = self;
        let last_time_ns = past.last_time_ns();
        let Past {
            last,
            nodes,
            is_whole,
        } = past;
        let core = if is_whole {
            (stream.epoch, stream.first, stream.state) =
                (last.header.epoch, last.end(), last.state);
            done = last.end();
            core.going_on(&last, &nodes)
        } else {
            core.beginning_after(&last, &nodes)
        };
        info!(
            structure = keys.structure().as_str(),
            frame = last.end(),
            is_new_epoch = !is_whole,
            "resuming where the recording ended"
        );
        // Sources may be waiting for progress that this service made but could not publish before
        // it was killed.
        progress.set(stream.epoch, done, last_time_ns.unwrap_or(i64::MIN));
        Self {
            core,
            stream,
            places: nodes,
            done,
            last_time_ns,
        }
    }
}

/// Reports that the service has restarted after these recorded frames, if there are any.
///
/// The event has the time of the wall clock, because several restarts can follow the same frame.
fn restart(past: &Past, keys: &Keys, clock: Clock) -> Option<Event> {
    let end = past.last.end();
    let age_s = clock.seconds_since(past.last_time_ns()?);
    Some(Event {
        structure: keys.structure().clone(),
        time_ns: clock.now_ns(),
        kind: EventKind::Restart,
        subject: "ingest".to_owned(),
        what: match past.is_whole {
            true => format!("ingest has restarted and resumes from frame {end}"),
            false => format!("ingest has restarted and begins a new epoch after frame {end}"),
        },
        why: if age_s < 0.0 {
            format!("its last frame was {:.1} s ahead of the clock", -age_s)
        } else {
            format!("its last frame was {age_s:.1} s old")
        },
    })
}

/// Returns how the samples of each node are read. `places` are the positions of the nodes, empty
/// for the beginning of all samples.
fn readings(
    bus: &Bus,
    keys: &Keys,
    layout: &Layout,
    places: &[NodePlace],
) -> Vec<Reading<SampleBlock>> {
    let reading = |(position, node): (usize, &NodeLayout)| {
        let start = match places.get(position) {
            Some(place) => Start::At {
                epoch: place.epoch,
                sequence: place.read_from(),
            },
            None => Start::Beginning,
        };
        let source = node.name.to_string();
        let is_of_node = move |block: &SampleBlock| match block.header.source == source {
            true => Ok(()),
            false => Err("foreign-blocks"),
        };
        Reading {
            key: keys.samples(&node.name),
            buffer_key: keys.buffer(&node.name),
            settings: bus.reading(start),
            check: Box::new(is_of_node),
        }
    };
    layout.nodes().iter().enumerate().map(reading).collect()
}

impl spandrel_service::Service for IngestService {
    type Plan = IngestPlan;
    type Error = IngestError;

    /// Validates the structure and connects to the bus.
    ///
    /// # Errors
    /// Returns an error if the structure has no valid frame layout, the recording cannot be opened,
    /// or the bus rejects a declaration.
    fn start(plan: &IngestPlan) -> BoxedFuture<'_, Result<Self, IngestError>> {
        Box::pin(Self::start_from(plan))
    }

    /// Runs until `stop` completes. Samples that have already arrived are still aligned.
    ///
    /// # Errors
    /// Returns an error if the bus has been closed, or if the recording is lost or cannot be
    /// closed.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), IngestError>> {
        self.run_until(stop)
    }
}

impl IngestService {
    async fn start_from(plan: &IngestPlan) -> Result<Self, IngestError> {
        let Monitored {
            structure, keys, ..
        } = &plan.monitored;
        let layout = Layout::of(structure).map_err(|source| IngestError::Layout {
            structure: structure.name().to_owned(),
            source,
        })?;
        let channels = structure
            .channels()
            .map(|channel| channel.name().to_owned())
            .collect();
        let lateness = Duration::try_from_secs_f64(structure.ingest().lateness_s);
        let settings = IngestSettings {
            waiting: lateness.map_or(FrameWait::Unlimited, FrameWait::Limited),
            nodes_publish_waveforms: structure
                .fusion()
                .is_some_and(|plan| plan.publishes_waveforms()),
            recording: plan.recording.clone(),
        };
        Self::start_with(layout, channels, &plan.instance, keys.clone(), settings).await
    }

    /// Starts the service for a layout that does not come from a structure file.
    ///
    /// `channels` contains the names of the channels in layout order. Otherwise this function works
    /// like [`Service::start`](spandrel_service::Service::start).
    ///
    /// # Errors
    /// Returns an error if the recording cannot be opened, or if the bus rejects a declaration.
    pub fn start_with<'a>(
        layout: Layout,
        channels: Vec<String>,
        instance: &'a ServiceInstance,
        keys: Keys,
        settings: IngestSettings,
    ) -> BoxedFuture<'a, Result<Self, IngestError>> {
        Box::pin(async move {
            let IngestSettings {
                waiting,
                nodes_publish_waveforms,
                recording,
            } = settings;
            let ServiceInstance { bus, id, clock } = instance;
            let epoch = clock.epoch();
            let shown = layout.node_channels(&channels)?;
            let names = shown.iter().flat_map(|node| node.channels.clone());
            let missing_share = MissingShare::new(names.collect(), layout.sampling_rate_hz());
            let (recorder, past) = match &recording {
                Some(recording) => {
                    let structure = keys.structure().as_str();
                    let (recorder, past) = tokio::task::block_in_place(|| {
                        Recorder::open(structure, &layout, channels, recording)
                    })?;
                    (Some(Box::new(recorder)), past)
                }
                None => (None, None),
            };
            let restart = past.as_ref().and_then(|past| restart(past, &keys, *clock));
            // If frames were published but not recorded, their numbers must not be reused for other
            // samples.
            let epoch = past
                .as_ref()
                .map_or(epoch, |past| epoch.max(past.last.header.epoch + 1));
            let keep = match recorder {
                Some(_) => IN_MEMORY,
                None => Keep::last(FRAMES_KEPT),
            };
            let beginning = Beginning::of_epoch(epoch, id.to_string(), &layout, &keys, keep);
            let progress = bus
                .publish_progress(keys.progress(Service::Ingest), id.to_string())
                .await?;
            let Beginning {
                core,
                stream,
                places,
                done,
                last_time_ns,
            } = match past {
                Some(past) => beginning.after(past, &keys, &progress),
                None => beginning,
            };
            let older = recorder.as_ref().map(|recorder| Older {
                archive: Arc::new(recorder.archive()),
                recent: FRAMES_KEPT,
            });
            let frames = bus.publish_archived(stream, older).await?;
            let rate_hz = layout.sampling_rate_hz();
            let shown = match nodes_publish_waveforms {
                true => Vec::new(), // two messages of each second would contradict each other
                false => shown,
            };
            let displays = Displays::start(bus, &keys, shown, rate_hz).await?;
            let readings = readings(bus, &keys, &layout, &places);
            let node_count = readings.len();
            let allowed = match waiting {
                FrameWait::Unlimited => None,
                FrameWait::Limited(allowed) => Some(allowed),
            };
            let nodes = bus
                .follow_group(readings, bus.reading(Start::Beginning).deliveries)
                .await?;
            let service = Self {
                core,
                timekeeping: allowed.map(|allowed| Timekeeping::new(allowed, node_count)),
                started: Instant::now(),
                last_heard: vec![Duration::ZERO; node_count],
                has_begun: (0..node_count)
                    .map(|node| places.get(node).is_some())
                    .collect(),
                earlier_samples: 0,
                signs: vec![Sign::Present; node_count],
                patient_until: Duration::ZERO,
                all_gone: false,
                ended: (0..node_count)
                    .map(|node| places.get(node).is_some_and(|place| place.ended))
                    .collect(),
                tokens: bus.watch_live(keys.all_live(Service::Sensor)).await?,
                frames,
                displays,
                progress,
                status: instance.publish_status(Service::Ingest, &keys).await?,
                drop_watch: DropWatch::new(
                    node_count,
                    allowed.unwrap_or_default().as_secs_f64(),
                    layout.tolerance_ns() as f64 / 1e9,
                ),
                lockout_watch: BlockWatch::new(node_count, LOCKOUT_OVER_AFTER),
                rejection_watch: BlockWatch::new(node_count, REJECTION_OVER_AFTER),
                channel_watch: BlockWatch::new(node_count, REJECTION_OVER_AFTER),
                quality_watch: QualityWatch::new(node_count),
                missing_share,
                clock: *clock,
                events: EventPublisher::declare(bus, &keys).await?,
                pace: Pace::Live,
                pace_heard: None,
                done,
                last_time_ns,
                recorder,
                // The token comes last, because sources start when they see it. The readers above
                // exist by then.
                token: instance.announce(Service::Ingest, &keys).await?,
                layout,
                nodes,
                keys,
            };
            info!(
                structure = service.keys.structure().as_str(),
                nodes = node_count,
                channels = service.layout.channel_count(),
                sampling_rate_hz = service.layout.sampling_rate_hz(),
                "ingest ready"
            );
            if let Some(restart) = restart {
                service.events.put(&restart).await?;
            }
            Ok(service)
        })
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
                // The selection must not be biased. At full speed samples never stop, and status
                // and stop must still be served.
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
                    _ = status.tick() => {
                        self.report_clocks().await?;
                        self.report_quality().await?;
                        self.put_status().await?;
                        self.report_drops().await?;
                        self.report_folder().await?;
                    }
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
            self.displays.close().await;
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
        let has_begun = std::mem::replace(&mut self.has_begun[node], true);
        let block = match delivery {
            Delivery::Block(block) => block,
            // The stream has logged and counted the loss. The alignment treats it as a gap in time.
            Delivery::Gap(gap) => {
                // A node without a buffer can run for days before ingest starts.
                if !has_begun {
                    self.earlier_samples = self.earlier_samples.saturating_add(gap.to - gap.from);
                }
                return Ok(());
            }
        };
        self.pace = block.pace;
        if self.pace_heard.replace(block.pace) != Some(block.pace) {
            // The status must arrive before any value of this block.
            self.put_status().await?;
        }
        self.ended[node] = block.state == StreamState::Ended;
        self.quality_watch.arrived(node, block.clock_quality);
        let elapsed = self.started.elapsed();
        self.last_heard[node] = elapsed;
        if self.signs[node] == Sign::Lost {
            self.signs[node] = Sign::Gone;
        }
        let arrived = |timekeeping: &mut Timekeeping| timekeeping.arrived(node, &block, elapsed);
        for input in self.timekeeping.as_mut().map_or_else(Vec::new, arrived) {
            self.handle(input).await?;
        }
        self.handle(AlignmentInput::Samples { node, block }).await
    }

    async fn handle(&mut self, input: AlignmentInput) -> Result<(), IngestError> {
        let mut blocks = Vec::new();
        let epoch = self.core.epoch();
        let recorded = self.recorder.as_ref();
        let recorded = recorded.map_or(0, |recorder| recorder.recorded_epoch());
        if recorded > epoch {
            let recorded = AlignmentInput::Recorded { epoch: recorded };
            self.core.handle(recorded, &mut blocks);
        }
        self.core.handle(input, &mut blocks);
        if self.core.epoch() != epoch
            && let Some(timekeeping) = &mut self.timekeeping
        {
            timekeeping.begin_run();
        }
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
            self.displays.offer(&block);
            self.missing_share.take(&block);
            self.frames.put(block).await?;
            self.progress
                .set(epoch, self.done, self.last_time_ns.unwrap_or(i64::MIN));
        }
        Ok(())
    }

    /// Updates the token state of nodes whose tokens have appeared or disappeared.
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

    /// Distinguishes a broken link from nodes that have disappeared, because a broken link removes
    /// all tokens at once.
    ///
    /// After the outage, when the first token is back, all lost nodes are expected again.
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
                    self.handle(AlignmentInput::Back { node }).await?;
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
                // The node has ended its stream.
                continue;
            }
            let is_over = silent(&self.last_heard[node]) && elapsed >= self.patient_until;
            if self.signs[node] == Sign::Gone && is_over {
                self.signs[node] = Sign::Lost;
                self.quality_watch.forget(node);
                let structure = self.keys.structure().as_str();
                let name = self.layout.nodes()[node].name.as_str();
                warn!(
                    structure,
                    node = name,
                    "node disappeared; frames no longer wait for it"
                );
                self.handle(AlignmentInput::Lost { node }).await?;
            }
        }
        if self.pace == Pace::Replayed {
            // Frames wait for the other nodes of a record, however far behind they are.
            return Ok(());
        }
        let timekeeping = self.timekeeping.as_mut();
        match timekeeping.and_then(|timekeeping| timekeeping.deadline(elapsed)) {
            Some(deadline) => self.handle(deadline).await,
            None => Ok(()),
        }
    }

    /// Publishes an event for each node that starts or ceases to lose a large share of its samples.
    async fn report_drops(&mut self) -> Result<(), IngestError> {
        let mut reports = Vec::new();
        let counts = self.core.node_counts();
        let elapsed = self.started.elapsed();
        self.drop_watch.read(counts, elapsed, &mut reports);
        let nodes: Vec<StreamCounts> = self.nodes.counts().collect();
        let excluded = nodes.iter().map(|counts| counts.follow.locked_out_blocks);
        let excluded = self.lockout_watch.read(excluded, elapsed);
        reports.extend(excluded.into_iter().map(lockout));
        let rejected = nodes.iter().map(StreamCounts::rejected);
        for report in self.rejection_watch.read(rejected, elapsed) {
            let why = nodes[report.node].last_rejection.as_deref();
            reports.extend(rejection(report, why.unwrap_or_default()));
        }
        let wrong = self.core.node_counts().map(|counts| counts.wrong_channels);
        for report in self.channel_watch.read(wrong, elapsed) {
            let why = "its blocks have another number of channels than the structure file states";
            reports.extend(rejection(report, why));
        }
        for report in reports {
            let kind = match report.is_over {
                true => EventKind::SamplesBack,
                false => EventKind::SamplesDropped,
            };
            self.put_node_event(report.node, kind, report.what, report.why)
                .await?;
        }
        Ok(())
    }

    /// Publishes an event about the node with this index in the layout.
    async fn put_node_event(
        &self,
        node: usize,
        kind: EventKind,
        what: String,
        why: String,
    ) -> Result<(), IngestError> {
        let Some(node) = self.layout.nodes().get(node) else {
            return Ok(()); // all reports have the indices of the layout
        };
        let event = Event {
            structure: self.keys.structure().clone(),
            time_ns: self.last_time_ns.unwrap_or(0),
            kind,
            subject: node.name.to_string(),
            what,
            why,
        };
        self.events.put(&event).await?;
        Ok(())
    }

    /// Publishes an event when the folder of the recording is lost or back.
    async fn report_folder(&mut self) -> Result<(), IngestError> {
        let changes = self
            .recorder
            .as_mut()
            .map(|recorder| recorder.take_changes());
        for change in changes.unwrap_or_default() {
            let (kind, what, why) = match change {
                FolderChange::Lost => (
                    EventKind::StateLost,
                    "frames are not recorded; they wait in memory",
                    "the folder of the recording is gone or cannot be written",
                ),
                FolderChange::Back => (
                    EventKind::StateBack,
                    "frames are recorded again",
                    "the folder of the recording is back",
                ),
            };
            let event = Event {
                structure: self.keys.structure().clone(),
                time_ns: self.last_time_ns.unwrap_or(0),
                kind,
                subject: "ingest".to_owned(),
                what: what.to_owned(),
                why: why.to_owned(),
            };
            self.events.put(&event).await?;
        }
        Ok(())
    }

    async fn put_status(&self) -> Result<(), IngestError> {
        let mut drops: BTreeMap<String, u64> = self.core.counts().drops();
        for (reason, count) in self.nodes.counts().flat_map(|counts| counts.drops()) {
            *drops.entry(reason).or_default() += count;
        }
        let lost = drops.remove("lost-items").unwrap_or(0);
        let lost = lost.saturating_sub(self.earlier_samples);
        if lost > 0 {
            drops.insert("lost-items".to_owned(), lost);
        }
        drops.extend(self.recorder.iter().flat_map(|recorder| recorder.drops()));
        if self.frames.refused_queries() > 0 {
            let refused = self.frames.refused_queries();
            drops.insert("refused-queries".to_owned(), refused);
        }
        if self.displays.dropped() > 0 {
            drops.insert("shed-frames".to_owned(), self.displays.dropped());
        }
        let report = Report {
            clocks: self.node_clocks(),
            missing: self.missing_share.shares(),
            done: self.done,
            processed_ns: self.last_time_ns,
            drops,
            pace: self.pace_heard,
            ..Report::default()
        };
        Ok(self.status.put(report).await?)
    }
}

/// Reports a node that a higher epoch under its name excludes, or no longer excludes.
fn lockout(report: BlockReport) -> DropReport {
    let (what, why) = match report.is_over {
        true => (
            "the blocks of the node are no longer dropped",
            "no other source excludes them",
        ),
        false => (
            "the blocks of the node are dropped: another source uses its name with a higher epoch",
            "a second program, or an earlier run with its clock in the future; the node is read \
             again once it alone has delivered for 5 s and 10 blocks",
        ),
    };
    DropReport {
        node: report.node,
        what: what.to_owned(),
        why: why.to_owned(),
        is_over: report.is_over,
    }
}

/// Reports a node whose messages cannot be used, for this reason. Its other messages can be, so there
/// is no report of an end.
fn rejection(report: BlockReport, why: &str) -> Option<DropReport> {
    let why = match why {
        "foreign-blocks" => "another source publishes on the topic of this node",
        other => other,
    };
    (!report.is_over).then(|| DropReport {
        node: report.node,
        what: format!(
            "messages of the node were rejected, {} at first",
            report.blocks
        ),
        why: why.to_owned(),
        is_over: false,
    })
}
