//! Connects the core to the sources and to the bus.

use std::collections::BTreeMap;
use std::time::Duration;

use spandrel_bus::{
    Block, BoxedFuture, Bus, Event, EventKind, InstrumentState, Keep, Keys, LiveToken, Name,
    NumberedPublisher, NumberedStream, ProgressWatch, SampleBlock, Service, StreamState,
    is_without_date,
};
use spandrel_service::{
    EventPublisher, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{info, warn};

use crate::connect::{Arrivals, Arrived, Clocks, read};
use crate::core_input::{Input, Output, Recorded};
use crate::error::FeedError;
use crate::feed::Feed;
use crate::gap::GapReport;
use crate::gate::Ahead;
use crate::settings::FeedConfig;
use crate::source_plan::SourcePlan;

/// Interval at which time passes for the core. Blocks of slow channels wait so long at most.
pub(crate) const TICK: Duration = Duration::from_millis(50);
/// Number of samples that a node keeps for readers that missed some, as `spandrel simulate` does.
const SAMPLES_KEPT: u64 = 16_384;
/// Timeout of the query for the last frame of ingest.
const POSITION_TIMEOUT: Duration = Duration::from_secs(2);
/// Number of such queries while ingest is present.
const POSITION_ATTEMPTS: u32 = 5;
/// Longest wait at a stop until ingest has processed the last samples.
const PATIENCE_AFTER_STOP: Duration = Duration::from_secs(2);

/// What happens when all sources have ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhenEnded {
    /// The feed stops.
    Stop,
    /// The feed waits for the stop signal.
    Wait,
}

/// What the feed needs to start.
#[derive(Clone, Debug)]
pub struct FeedPlan {
    /// The instance. The time of its clock is the epoch of the nodes.
    pub instance: ServiceInstance,
    /// The structures, in the order of the configuration.
    pub structures: Vec<Monitored>,
    /// The sources.
    pub config: FeedConfig,
    /// What happens when all sources have ended.
    pub when_ended: WhenEnded,
}

/// The feed of all sources of a process.
#[derive(Debug)]
pub struct FeedService {
    bus: Bus,
    core: Feed,
    clocks: Clocks,
    publishers: Vec<NumberedPublisher<SampleBlock>>,
    /// The samples of each node that ingest has not processed.
    ahead: Vec<Ahead>,
    structures: Vec<FedStructure>,
    node_tokens: Vec<LiveToken>,
    when_ended: WhenEnded,
}

/// A structure with at least one node that a source feeds.
#[derive(Debug)]
struct FedStructure {
    /// Index in the configuration.
    index: usize,
    keys: Keys,
    is_distributed: bool,
    status: StatusPublisher,
    events: EventPublisher,
    progress: ProgressWatch,
    token: LiveToken,
}

impl spandrel_service::Service for FeedService {
    type Plan = FeedPlan;
    type Error = FeedError;

    fn start(plan: &FeedPlan) -> BoxedFuture<'_, Result<Self, FeedError>> {
        Box::pin(Self::start_from(plan))
    }

    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), FeedError>> {
        Box::pin(self.run_until(stop))
    }
}

impl FeedService {
    async fn start_from(plan: &FeedPlan) -> Result<Self, FeedError> {
        let FeedPlan {
            instance,
            structures: monitored,
            config,
            when_ended,
        } = plan;
        let bus = &instance.bus;
        let epoch = instance.clock.epoch();
        let (mut publishers, mut node_keys) = (Vec::new(), Vec::new());
        for node in &config.nodes {
            let Some(of) = monitored.get(node.structure) else {
                continue;
            };
            let name = Name::new(&*node.name)?;
            let stream = NumberedStream {
                key: of.keys.samples(&name),
                buffer_key: of.keys.buffer(&name),
                source: name.to_string(),
                epoch,
                first: 0,
                state: StreamState::Running,
                keep: Keep::last(SAMPLES_KEPT),
            };
            publishers.push(bus.publish_numbered(stream).await?);
            node_keys.push(of.keys.live(Service::Sensor, &name));
        }
        let mut structures = Vec::new();
        for (index, of) in monitored.iter().enumerate() {
            if !config.nodes.iter().any(|node| node.structure == index) {
                continue;
            }
            structures.push(FedStructure {
                index,
                keys: of.keys.clone(),
                is_distributed: of.structure.fusion().is_some(),
                status: instance.publish_status(Service::Feed, &of.keys).await?,
                events: EventPublisher::declare(bus, &of.keys).await?,
                progress: bus
                    .watch_progress(of.keys.progress(Service::Ingest))
                    .await?,
                token: instance.announce(Service::Feed, &of.keys).await?,
            });
        }
        let mut node_tokens = Vec::new();
        for key in node_keys {
            node_tokens.push(bus.announce(key).await?);
        }
        for remark in &config.remarks {
            warn!("{remark}");
        }
        info!(
            sources = config.sources.len(),
            nodes = config.nodes.len(),
            "feed ready"
        );
        Ok(Self {
            bus: bus.clone(),
            core: Feed::new(config.clone(), epoch),
            clocks: Clocks::start(instance.clock),
            publishers,
            ahead: vec![Ahead::default(); config.nodes.len()],
            structures,
            node_tokens,
            when_ended: *when_ended,
        })
    }

    async fn run_until(mut self, mut stop: Stop<'_>) -> Result<(), FeedError> {
        let mut arrivals = Arrivals::default();
        // The set aborts its tasks when it is dropped.
        let mut connections = JoinSet::new();
        let sources = self.core.config().sources.clone();
        let mut outlets = Vec::new();
        for (index, source) in sources.iter().enumerate() {
            let outlet = arrivals.add(index, &source.kind, self.clocks);
            match source.kind.can_repeat() {
                true => outlets.push((index, outlet)),
                // The first samples wait in the queue while ingest is queried.
                false => {
                    connections.spawn(read(source, None, outlet));
                }
            }
        }
        let recorded = tokio::select! {
            recorded = self.recorded() => recorded,
            () = &mut stop => return self.withdraw().await,
        };
        for (structure, recorded) in &recorded {
            let (structure, recorded) = (*structure, *recorded);
            let input = Input::Recorded {
                structure,
                recorded,
            };
            self.handle(input).await?;
        }
        for (index, outlet) in outlets {
            let Some(source) = sources.get(index) else {
                continue;
            };
            let of_source = |structure: &usize| {
                let nodes = &self.core.config().nodes;
                let node = |node: usize| nodes.get(node).map(|node| node.structure);
                source
                    .channels
                    .iter()
                    .any(|channel| node(channel.node) == Some(*structure))
            };
            let since_ns = recorded
                .iter()
                .filter(|(structure, _)| of_source(structure))
                .map(|(_, recorded)| last_ns(recorded))
                .min();
            connections.spawn(read(source, since_ns, outlet));
        }
        self.serve(&mut arrivals, &mut stop).await?;
        while let Some(Arrived { input, at }) = arrivals.next_now() {
            self.handle_at(input, at).await?;
        }
        self.handle(Input::Stop).await?;
        self.wait_for_ingest().await;
        self.put_status().await?;
        self.withdraw().await
    }

    /// Passes inputs to the core until `stop` completes or all sources have ended.
    async fn serve(
        &mut self,
        arrivals: &mut Arrivals,
        stop: &mut Stop<'_>,
    ) -> Result<(), FeedError> {
        let mut tick = interval(TICK);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut status = interval(STATUS_EVERY);
        status.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut have_ended = false;
        loop {
            let held = self.held();
            tokio::select! {
                arrived = arrivals.next(&held), if !have_ended => match arrived {
                    Some(Arrived { input, at }) => self.handle_at(input, at).await?,
                    None => {
                        have_ended = true;
                        if self.when_ended == WhenEnded::Stop {
                            info!("all sources have ended");
                            return Ok(());
                        }
                    }
                },
                _ = tick.tick() => self.handle(Input::Tick).await?,
                _ = status.tick() => self.put_status().await?,
                () = &mut *stop => return Ok(()),
            }
        }
    }

    /// Returns for each source whether it must wait for ingest.
    fn held(&mut self) -> Vec<bool> {
        for of in self.structures.iter().filter(|of| !of.is_distributed) {
            let Some(progress) = of.progress.latest() else {
                continue;
            };
            let nodes = self.core.config().nodes.iter().zip(&mut self.ahead);
            for (_, ahead) in nodes.filter(|(node, _)| node.structure == of.index) {
                ahead.processed(progress.header.time_ns);
            }
        }
        let config = self.core.config();
        let is_ahead = |node: usize| {
            let of = config.nodes.get(node).map(|node| node.structure);
            let is_ingested = self
                .structures
                .iter()
                .any(|structure| Some(structure.index) == of && !structure.is_distributed);
            is_ingested && self.ahead.get(node).is_some_and(|ahead| !ahead.has_room())
        };
        let is_held = |source: &SourcePlan| {
            source.kind.can_repeat() && source.channels.iter().any(|channel| is_ahead(channel.node))
        };
        config.sources.iter().map(is_held).collect()
    }

    async fn handle(&mut self, input: Input) -> Result<(), FeedError> {
        let now = self.clocks.now();
        self.handle_at(input, now).await
    }

    async fn handle_at(
        &mut self,
        input: Input,
        at: crate::core_input::Moment,
    ) -> Result<(), FeedError> {
        let mut outputs = Vec::new();
        self.core.handle(input, at, &mut outputs);
        for output in outputs {
            match output {
                Output::Block { node, block } => {
                    let last = block.grid().zip(block.count().checked_sub(1));
                    if let (Some(ahead), Some((grid, last))) = (self.ahead.get_mut(node), last) {
                        ahead.published(grid.time_ns(last), block.count());
                    }
                    if let Some(publisher) = self.publishers.get(node) {
                        publisher.put(block).await?;
                    }
                }
                Output::Lost(lost) => self.report_lost(&lost).await?,
                Output::SetBack {
                    node,
                    from_ns,
                    to_ns,
                } => {
                    let node = self.core.config().nodes.get(node);
                    let name = node.map_or("", |node| node.name.as_str());
                    warn!(
                        node = name,
                        from_ns, to_ns, "clock of the instrument went back; a new epoch begins"
                    );
                }
                Output::State { source, state, why } => self.log_state(source, state, why),
                Output::Error { source, why, count } => {
                    warn!(
                        source = self.source_name(source),
                        why, count, "source error"
                    );
                }
            }
        }
        Ok(())
    }

    fn source_name(&self, source: usize) -> &str {
        let source = self.core.config().sources.get(source);
        source.map_or("", |source| source.name.as_str())
    }

    fn log_state(&self, source: usize, state: InstrumentState, why: Option<String>) {
        let (source, state_name) = (self.source_name(source), state.as_str());
        match state {
            InstrumentState::Failed | InstrumentState::Silent => {
                warn!(source, state = state_name, why, "source state");
            }
            InstrumentState::Connecting
            | InstrumentState::Connected
            | InstrumentState::Receiving
            | InstrumentState::Ended => info!(source, state = state_name, "source state"),
        }
    }

    /// Publishes and logs lost samples as an event of their structure.
    async fn report_lost(&self, lost: &GapReport) -> Result<(), FeedError> {
        let Some(node) = self.core.config().nodes.get(lost.node) else {
            return Ok(());
        };
        let of = self.structures.iter().find(|of| of.index == node.structure);
        let Some(of) = of else {
            return Ok(());
        };
        let event = Event {
            structure: of.keys.structure().clone(),
            time_ns: lost.from_ns,
            kind: EventKind::Gap,
            subject: node.name.clone(),
            what: format!(
                "{} samples of channel {} lost up to {} s",
                lost.samples,
                lost.channel,
                seconds(lost.to_ns)
            ),
            why: lost.because.to_string(),
        };
        Ok(of.events.put(&event).await?)
    }

    /// Queries the frames that exist already, for each structure that ingest records.
    async fn recorded(&self) -> BTreeMap<usize, Recorded> {
        let mut recorded = BTreeMap::new();
        for of in self.structures.iter().filter(|of| !of.is_distributed) {
            let found = self.recorded_of(of).await;
            let structure = of.keys.structure().as_str();
            match found {
                Some(found) => {
                    info!(
                        structure,
                        frame = found.next,
                        "feed resumes where the frames end"
                    );
                    recorded.insert(of.index, found);
                }
                None => info!(structure, "no frames to resume from"),
            }
        }
        recorded
    }

    async fn recorded_of(&self, of: &FedStructure) -> Option<Recorded> {
        let structure = of.keys.structure().as_str();
        let needs_it = self.core.config().sources.iter().any(|source| {
            source.kind.can_repeat()
                && source.channels.iter().any(|channel| {
                    let node = self.core.config().nodes.get(channel.node);
                    node.is_some_and(|node| node.structure == of.index)
                })
        });
        let live = of.keys.all_live(Service::Ingest);
        if needs_it {
            // The samples stay at the source until ingest can say what it has.
            let mut watch = self.bus.watch_live(live.clone()).await.ok()?;
            if watch.present().is_empty() && timeout(POSITION_TIMEOUT, watch.some()).await.is_err()
            {
                warn!(structure, "waiting for the ingest service on this bus");
                watch.some().await;
            }
        }
        let recording = of.keys.recording();
        for _ in 0..POSITION_ATTEMPTS {
            if let Some(at) = self.bus.stream_position(&recording, POSITION_TIMEOUT).await {
                if at.state == StreamState::Ended || at.header.sequence == 0 {
                    return None;
                }
                let last = self
                    .bus
                    .last_item::<spandrel_bus::FrameBlock>(&recording, POSITION_TIMEOUT)
                    .await;
                if let Some((block, _)) = last {
                    let recorded = Recorded {
                        frames: block.grid()?,
                        next: block.end(),
                    };
                    return self.is_plausible(structure, &recorded).then_some(recorded);
                }
            }
            let present = self.bus.query_tokens(&live, POSITION_TIMEOUT).await.ok()?;
            if present.is_empty() {
                break;
            }
        }
        None
    }

    /// Returns `true` if frames can be continued by samples that are measured now.
    fn is_plausible(&self, structure: &str, recorded: &Recorded) -> bool {
        let last_ns = last_ns(recorded);
        let now_ns = self.clocks.now().wall_ns;
        if is_without_date(last_ns) || last_ns > now_ns {
            warn!(
                structure,
                last_ns, now_ns, "the last frame is not of the past; the feed does not resume"
            );
            return false;
        }
        true
    }

    async fn put_status(&self) -> Result<(), FeedError> {
        for of in &self.structures {
            let (processed_ns, done) = self.core.published(of.index);
            let config = self.core.config();
            let feeds = |source: &SourcePlan| {
                source.channels.iter().any(|channel| {
                    let node = config.nodes.get(channel.node);
                    node.is_some_and(|node| node.structure == of.index)
                })
            };
            let instruments = config
                .sources
                .iter()
                .enumerate()
                .filter(|(_, source)| feeds(source))
                .filter_map(|(index, source)| Some((source.name.clone(), self.core.status(index)?)))
                .collect();
            let report = Report {
                done,
                processed_ns,
                drops: self.core.drops(of.index),
                instruments,
                ..Report::default()
            };
            of.status.put(report).await?;
        }
        Ok(())
    }

    /// Waits until ingest has processed the last samples, because it can fetch samples only while
    /// this process runs.
    async fn wait_for_ingest(&mut self) {
        for of in &mut self.structures {
            let Some(last_ns) = self.core.published(of.index).0 else {
                continue;
            };
            let done = of.progress.latest();
            let is_done = |time_ns: i64| time_ns >= last_ns;
            if done.is_none_or(|progress| !is_done(progress.header.time_ns)) {
                let reached = of
                    .progress
                    .wait_for(|progress| is_done(progress.header.time_ns));
                // Another node may be missing, so that frames wait for it.
                let _ = timeout(PATIENCE_AFTER_STOP, reached).await;
            }
        }
    }

    async fn withdraw(self) -> Result<(), FeedError> {
        info!("feed stopped");
        let tokens = self.structures.into_iter().map(|of| of.token);
        for token in self.node_tokens.into_iter().chain(tokens) {
            token.withdraw().await?;
        }
        Ok(())
    }
}

/// Returns the time of the last frame, ns.
fn last_ns(recorded: &Recorded) -> i64 {
    recorded.frames.time_ns(recorded.next.saturating_sub(1))
}

/// Formats a time as seconds since 1970.
fn seconds(time_ns: i64) -> String {
    let mut text = String::new();
    spandrel_record::record_time::write_seconds(time_ns, &mut text);
    text
}
