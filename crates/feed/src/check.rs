//! Connects to all sources for some time and counts what arrives, without a bus.

use std::collections::BTreeMap;
use std::time::Duration;

use spandrel_bus::InstrumentStatus;
use spandrel_service::Clock;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

use crate::connect::{Arrivals, Clocks, read};
use crate::core_input::FeedInput;
use crate::feed::Feed;
use crate::settings::FeedConfig;
use crate::shell::TICK;
use crate::source_plan::{MqttSession, SourceKind};

/// What arrived from one source.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckedSource {
    /// Name of the source.
    pub name: String,
    /// Kind and address.
    pub description: String,
    /// State, counts and last error.
    pub status: InstrumentStatus,
    /// The configured channels.
    pub channels: Vec<CheckedChannel>,
    /// The configured conditions.
    pub conditions: Vec<CheckedCondition>,
    /// Number of samples of channels without a mapping, by name.
    pub unmapped: BTreeMap<String, u64>,
}

/// Samples of one channel that arrived from a source during the check.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckedChannel {
    /// Name of the channel in the source.
    pub label: String,
    /// Structure that the channel feeds.
    pub structure: String,
    /// Node of the structure.
    pub node: String,
    /// Channel of the node.
    pub channel: String,
    /// SI unit.
    pub unit: &'static str,
    /// Number of samples.
    pub samples: u64,
    /// Sampling rate of the node, Hz.
    pub nominal_hz: f64,
    /// Measured sampling rate, Hz. `None` before there are enough samples.
    pub measured_hz: Option<f64>,
    /// Shortest and longest time from measurement to arrival, s.
    pub latency_s: Option<(f64, f64)>,
    /// Least and largest value, SI unit.
    pub range: Option<(f64, f64)>,
}

/// Values of one condition that arrived from a source during the check.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckedCondition {
    /// Name of the condition in the source.
    pub label: String,
    /// Name of the structure to which the condition belongs.
    pub structure: String,
    /// Name of the condition.
    pub name: String,
    /// Unit of the condition, as in condition messages.
    pub unit: &'static str,
    /// Number of values that arrived.
    pub values: u64,
    /// Last value received, in the unit of the condition. `None` if none has arrived.
    pub last: Option<f64>,
}

/// Listens to all sources for `duration`, or until `stop` completes.
pub async fn listen(
    mut config: FeedConfig,
    clock: Clock,
    duration: Duration,
    stop: impl Future<Output = ()>,
) -> (Vec<CheckedSource>, BTreeMap<String, u64>) {
    let clocks = Clocks::start(clock);
    for source in &mut config.sources {
        // A check must not take over the session of a running feed.
        if let SourceKind::Mqtt(topic) = &mut source.kind {
            topic.client_id.push_str("-check");
            topic.session = MqttSession::Clean;
        }
    }
    let mut core = Feed::new(config, clock.epoch());
    let mut arrivals = Arrivals::default();
    let mut tasks = JoinSet::new();
    for (index, source) in core.config().sources.iter().enumerate() {
        let outlet = arrivals.add(index, &source.kind, clocks);
        tasks.spawn(read(source, None, outlet));
    }
    let mut tick = interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let end = sleep_until(Instant::now() + duration);
    tokio::pin!(end, stop);
    let mut outputs = Vec::new();
    loop {
        tokio::select! {
            arrived = arrivals.next(&[]) => match arrived {
                Some(arrived) => core.handle(arrived.input, arrived.at, &mut outputs),
                None => break,
            },
            _ = tick.tick() => core.handle(FeedInput::Tick, clocks.now(), &mut outputs),
            () = &mut end => break,
            () = &mut stop => break,
        }
        outputs.clear();
    }
    let mut drops = BTreeMap::new();
    for structure in 0..core.config().structures.len() {
        for (reason, count) in core.drops(structure) {
            *drops.entry(reason).or_default() += count;
        }
    }
    (report(&core), drops)
}

fn report(core: &Feed) -> Vec<CheckedSource> {
    let config = core.config();
    let mut sources = Vec::new();
    for (index, plan) in config.sources.iter().enumerate() {
        let (Some((seen, unmapped)), Some(status)) = (core.seen(index), core.status(index)) else {
            continue;
        };
        let channels = plan
            .channels
            .iter()
            .zip(seen)
            .filter_map(|(channel, seen)| {
                let node = config.nodes.get(channel.node)?;
                Some(CheckedChannel {
                    label: channel.label.clone(),
                    structure: config.structures.get(node.structure)?.name.clone(),
                    node: node.name.clone(),
                    channel: channel.channel.clone(),
                    unit: channel.unit,
                    samples: seen.samples,
                    nominal_hz: node.rate_hz,
                    measured_hz: seen.measured_hz,
                    latency_s: seen.latency_s,
                    range: seen.range,
                })
            });
        let conditions = plan
            .conditions
            .iter()
            .zip(core.seen_conditions(index))
            .filter_map(|(condition, (values, last))| {
                Some(CheckedCondition {
                    label: condition.label.clone(),
                    structure: config.structures.get(condition.structure)?.name.clone(),
                    name: condition.name.clone(),
                    unit: condition.unit,
                    values,
                    last,
                })
            });
        sources.push(CheckedSource {
            name: plan.name.clone(),
            description: plan.kind.description(),
            status,
            channels: channels.collect(),
            conditions: conditions.collect(),
            unmapped: unmapped.clone(),
        });
    }
    sources
}
