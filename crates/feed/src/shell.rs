//! Connects the core to the sources and to the bus.

mod conditions;
mod of_history;
mod of_ingest;

use std::panic::resume_unwind;
use std::time::Duration;

use spandrel_bus::{
    Block, BoxedFuture, Bus, Event, EventKind, InstrumentState, Keep, Keys, LiveToken, Name,
    NumberedPublisher, NumberedStream, ProgressWatch, SampleBlock, Service, StreamState,
};
use spandrel_service::{
    EventPublisher, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval};
use tracing::{info, warn};

use crate::connect::{Arrivals, Arrived, Clocks, read};
use crate::core_input::{FeedInput, Output};
use crate::error::FeedError;
use crate::feed::Feed;
use crate::gap::GapReport;
use crate::gate::Ahead;
use crate::settings::FeedConfig;
use crate::source_plan::SourcePlan;
use conditions::Conditions;
use of_ingest::last_ns;

/// Interval at which time passes for the core. Blocks of slow channels wait so long at most.
pub(crate) const TICK: Duration = Duration::from_millis(50);
/// Number of samples that a node keeps for readers that missed some, as `spandrel simulate` does.
const SAMPLES_KEPT: u64 = 16_384;
/// Behaviour of the feed when all sources have ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhenEnded {
    /// The feed stops.
    Stop,
    /// The feed waits for the stop signal.
    Wait,
}

/// Start-up settings of the feed.
#[derive(Clone, Debug)]
pub struct FeedPlan {
    /// The instance. The time of its clock is the epoch of the nodes.
    pub instance: ServiceInstance,
    /// The structures, in the order of the configuration.
    pub structures: Vec<Monitored>,
    /// The sources.
    pub config: FeedConfig,
    /// Behaviour of the feed when all sources have ended.
    pub when_ended: WhenEnded,
}

/// The feed of all sources of a process.
///
/// Structures without a common source have tasks of their own. A structure whose ingest is missing
/// or slow, or whose instrument repeats a long backlog, does not delay the others.
#[derive(Debug)]
pub struct FeedService {
    parts: Vec<Part>,
}

/// The sources of one structure, or of several structures that share a source.
#[derive(Debug)]
struct Part {
    bus: Bus,
    core: Feed,
    clocks: Clocks,
    publishers: Vec<NumberedPublisher<SampleBlock>>,
    /// The samples of each node that ingest has not processed.
    ahead: Vec<Ahead>,
    conditions: Conditions,
    structures: Vec<FedStructure>,
    node_tokens: Vec<LiveToken>,
    when_ended: WhenEnded,
}

/// A structure with at least one node or condition that a source feeds.
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
        let (config, epoch) = (&plan.config, plan.instance.clock.epoch());
        let mut parts = Vec::new();
        for of_part in config.parts() {
            parts.push(Part::start(plan, of_part, epoch).await?);
        }
        for remark in &config.remarks {
            warn!("{remark}");
        }
        info!(
            sources = config.sources.len(),
            nodes = config.nodes.len(),
            "feed ready"
        );
        Ok(Self { parts })
    }

    async fn run_until(self, mut stop: Stop<'_>) -> Result<(), FeedError> {
        let (stopped, stopping) = watch::channel(false);
        let mut is_stopped = false;
        // The set aborts its tasks when it is dropped.
        let mut running = JoinSet::new();
        for part in self.parts {
            let mut stopping = stopping.clone();
            let stop = async move {
                // A dropped sender also means that the service stops.
                let _ = stopping.wait_for(|is_stopped| *is_stopped).await;
            };
            running.spawn(part.run_until(Box::pin(stop)));
        }
        loop {
            tokio::select! {
                ended = running.join_next() => match ended {
                    Some(Ok(ended)) => ended?,
                    // The whole service restarts. Otherwise it would continue without the part.
                    Some(Err(error)) => {
                        if let Ok(panic) = error.try_into_panic() {
                            resume_unwind(panic);
                        }
                    }
                    None => break,
                },
                () = &mut stop, if !is_stopped => {
                    is_stopped = true;
                    stopped.send_replace(true);
                }
            }
        }
        if !is_stopped {
            info!("all sources have ended");
        }
        info!("feed stopped");
        Ok(())
    }
}

impl Part {
    async fn start(plan: &FeedPlan, config: FeedConfig, epoch: u64) -> Result<Self, FeedError> {
        let FeedPlan {
            instance,
            structures: monitored,
            when_ended,
            ..
        } = plan;
        let bus = &instance.bus;
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
            if !config.feeds(index) {
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
        Ok(Self {
            bus: bus.clone(),
            clocks: Clocks::start(instance.clock),
            publishers,
            ahead: vec![Ahead::default(); config.nodes.len()],
            conditions: Conditions::declare(bus, monitored, &config).await?,
            core: Feed::new(config, epoch),
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
            let input = FeedInput::Recorded {
                structure,
                recorded,
            };
            self.handle(input).await?;
        }
        let stored = tokio::select! {
            stored = self.stored() => stored,
            () = &mut stop => return self.withdraw().await,
        };
        for input in stored.iter().map(of_history::Stored::input) {
            self.handle(input).await?;
        }
        for (index, outlet) in outlets {
            let Some(source) = sources.get(index) else {
                continue;
            };
            let fed = self.core.config().structures_of(source);
            let frames_ns = recorded
                .iter()
                .filter(|(structure, _)| fed.contains(structure))
                .map(|(_, recorded)| last_ns(recorded))
                .min();
            let of_source = stored.iter().filter(|stored| stored.source == index);
            let conditions_ns = of_source.map(|stored| stored.newest_ns).min();
            let since_ns = match source.channels.is_empty() {
                true => conditions_ns,
                // Values that the history has not written yet are older than the last frame.
                false => {
                    frames_ns.map(|frames_ns| conditions_ns.unwrap_or(frames_ns).min(frames_ns))
                }
            };
            connections.spawn(read(source, since_ns, outlet));
        }
        self.serve(&mut arrivals, &mut stop).await?;
        while let Some(Arrived { input, at }) = arrivals.next_now() {
            self.handle_at(input, at).await?;
        }
        self.handle(FeedInput::Stop).await?;
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
                            return Ok(());
                        }
                    }
                },
                _ = tick.tick() => self.handle(FeedInput::Tick).await?,
                _ = status.tick() => self.put_status().await?,
                () = &mut *stop => return Ok(()),
            }
        }
    }

    async fn handle(&mut self, input: FeedInput) -> Result<(), FeedError> {
        let now = self.clocks.now();
        self.handle_at(input, now).await
    }

    async fn handle_at(
        &mut self,
        input: FeedInput,
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
                Output::Condition {
                    source,
                    condition,
                    time_ns,
                    value,
                } => {
                    self.conditions
                        .put((source, condition), time_ns, value)
                        .await?
                }
                Output::Lost(lost) => self.report_lost(&lost).await?,
                Output::SetBack {
                    node,
                    from_ns,
                    to_ns,
                } => {
                    // Ingest never reaches the times that the wrong clock stated.
                    if let Some(ahead) = self.ahead.get_mut(node) {
                        ahead.forget();
                    }
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

    async fn put_status(&self) -> Result<(), FeedError> {
        for of in &self.structures {
            let (processed_ns, done) = self.core.published(of.index);
            let config = self.core.config();
            let feeds = |source: &SourcePlan| config.all_structures_of(source).contains(&of.index);
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

    async fn withdraw(self) -> Result<(), FeedError> {
        let tokens = self.structures.into_iter().map(|of| of.token);
        for token in self.node_tokens.into_iter().chain(tokens) {
            token.withdraw().await?;
        }
        Ok(())
    }
}

/// Formats a time as seconds since 1970.
fn seconds(time_ns: i64) -> String {
    let mut text = String::new();
    spandrel_record::record_time::write_seconds(time_ns, &mut text);
    text
}
