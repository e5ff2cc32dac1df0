//! The health of each sensor, derived from all messages about it.

use crate::levels::Level;
use crate::store::{ALL_CHANNELS, Store};
use crate::topic::{Kind, SeriesName};
use serde::Serialize;
use spandrel_bus::{
    ChannelHealthDisplay, ChannelState, Name, NodeClock, NodeHealth, Service, Soundness,
};
use spandrel_structure::DrawnSensor;

/// Measurement time without a used sample after which a channel counts as silent (ns).
const SILENT_AFTER_NS: i64 = 3_000_000_000;

/// Health of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum SensorHealth {
    /// Its samples arrive and are used.
    Alive,
    /// Its node was present and has disappeared.
    Gone,
    /// No samples arrive, or none were usable.
    Silent,
    /// The clock of its node differs from that of most nodes, and its samples are not used.
    WrongClock,
    /// Its samples are perhaps wrong.
    InDoubt,
    /// Its samples are wrong and are not used.
    Faulty,
    /// Its node disagrees with the other nodes and is excluded.
    Excluded,
    /// Its record or simulation has ended.
    Ended,
    /// None of its samples has arrived since the start of the server, nor has any other data.
    NoSample,
    /// No present message shows whether its samples are used.
    Unknown,
}

impl SensorHealth {
    /// Returns `true` if its samples are used.
    pub(crate) fn delivers(self) -> bool {
        matches!(self, Self::Alive | Self::InDoubt)
    }

    /// Returns `true` if the sensor needs attention.
    pub(crate) fn is_trouble(self) -> bool {
        match self {
            Self::Gone
            | Self::Silent
            | Self::WrongClock
            | Self::InDoubt
            | Self::Faulty
            | Self::Excluded => true,
            // The sentence on the missing data concerns all sensors.
            Self::Alive | Self::Ended | Self::NoSample | Self::Unknown => false,
        }
    }
}

/// A channel and its health.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct SensorState<'s> {
    pub(crate) channel: String,
    pub(crate) node: String,
    pub(crate) health: SensorHealth,
    /// Comparison with the other sensors, if there is any.
    pub(crate) compared: Option<&'s ChannelHealthDisplay>,
    /// When its node samples, if not at the times of the frames, if its clock is wrong, or if its
    /// source states the quality of its clock.
    pub(crate) clock: Option<NodeClock>,
    /// Measurement time of its last used sample (s since the Unix epoch, UTC).
    pub(crate) last_used_s: Option<f64>,
    /// Its samples of the last minute. `None` without samples.
    pub(crate) level: Option<Level>,
}

/// Returns the state of all channels in frame order.
pub(crate) fn sensor_states(store: &Store) -> Vec<SensorState<'_>> {
    let sensors = store.about.drawing.sensors.iter();
    let state = |sensor: &DrawnSensor| {
        let level = store.levels.of(sensor.channel.as_str());
        let has_none = level.is_none() && store.has_never_measured();
        SensorState {
            channel: sensor.channel.clone(),
            node: sensor.node.clone(),
            health: match health(store, sensor) {
                SensorHealth::Alive | SensorHealth::Unknown if has_none => SensorHealth::NoSample,
                SensorHealth::Alive if store.is_stale() => SensorHealth::Unknown,
                health => health,
            },
            compared: compared(store, sensor),
            clock: clock(store, sensor),
            last_used_s: store
                .used_ns
                .get(sensor.channel.as_str())
                .map(|time_ns| *time_ns as f64 / 1e9),
            level,
        }
    };
    sensors.map(state).collect()
}

/// Returns the comparison of a channel with the others.
fn compared<'s>(store: &'s Store, sensor: &DrawnSensor) -> Option<&'s ChannelHealthDisplay> {
    let display = store.state.sensor_health.get(sensor.node.as_str())?;
    let mut channels = display.channels.iter();
    channels.find(|channel| channel.channel.as_str() == sensor.channel)
}

/// Returns when the node of a sensor samples, as ingest reports it.
fn clock(store: &Store, sensor: &DrawnSensor) -> Option<NodeClock> {
    let of_ingest = |((service, _), _): &(&(Service, Name), _)| *service == Service::Ingest;
    let mut statuses = store.state.statuses().filter(of_ingest);
    statuses.find_map(|(_, status)| status.clocks.get(sensor.node.as_str()).copied())
}

fn health(store: &Store, sensor: &DrawnSensor) -> SensorHealth {
    let (node, channel) = (sensor.node.as_str(), sensor.channel.as_str());
    if clock(store, sensor).is_some_and(|clock| clock.difference_s.is_some()) {
        return SensorHealth::WrongClock;
    }
    let is_faulty = store
        .state
        .outliers
        .get(channel)
        .is_some_and(|outlier| outlier.state == ChannelState::Faulty);
    if is_faulty || store.excluded.contains(channel) {
        return SensorHealth::Faulty;
    }
    match compared(store, sensor).map(|compared| compared.state) {
        Some(Soundness::Faulty) => return SensorHealth::Faulty,
        Some(Soundness::InDoubt) => return SensorHealth::InDoubt,
        Some(Soundness::Unchecked | Soundness::Sound) | None => {}
    }
    match store.state.nodes.get(node).map(|display| display.state) {
        Some(NodeHealth::Excluded) => return SensorHealth::Excluded,
        Some(NodeHealth::Silent) => return SensorHealth::Silent,
        Some(NodeHealth::Ended) => return SensorHealth::Ended,
        Some(NodeHealth::Used) => return SensorHealth::Alive,
        None => {}
    }
    let is_node =
        |(service, id): &(Service, Name)| *service == Service::Sensor && id.as_str() == node;
    let is_there = store.state.present().any(is_node);
    let was_there = store.state.seen.iter().any(is_node);
    if was_there && !is_there {
        return if all_nodes_left(store) {
            SensorHealth::Ended
        } else {
            SensorHealth::Gone
        };
    }
    // Estimates name the used channels of the response only.
    if let Some(share) = used_share(store, channel).filter(|_| sensor.excitation) {
        return match share > 0.0 {
            true => SensorHealth::Alive,
            false => SensorHealth::Silent,
        };
    }
    let last_used = store.used_ns.get(channel);
    match (last_used, store.used_ns.values().max()) {
        (Some(used), Some(latest)) if latest - used > SILENT_AFTER_NS => SensorHealth::Silent,
        (Some(_), _) => SensorHealth::Alive,
        (None, Some(latest))
            if !sensor.excitation
                && began_ns(store).is_some_and(|began| latest - began > SILENT_AFTER_NS) =>
        {
            SensorHealth::Silent
        }
        // Without a model, the first epoch shows which channels are used.
        (None, Some(_)) if !store.about.is_filtered && store.about.observes(channel) => {
            SensorHealth::Silent
        }
        (None, _) if is_there => SensorHealth::Alive,
        (None, _) => SensorHealth::Unknown,
    }
}

/// Returns the share of the samples of a channel that the filter uses, as the alert service reports
/// it.
fn used_share(store: &Store, channel: &str) -> Option<f64> {
    let display = store.state.monitoring()?;
    let mut channels = display.channels.iter();
    let of_channel = channels.find(|of| of.channel.as_str() == channel)?;
    Some(of_channel.used_share)
}

/// Returns the time of the first received estimate.
fn began_ns(store: &Store) -> Option<i64> {
    store
        .series(&SeriesName::new(Kind::Consistency, ALL_CHANNELS))?
        .first_ns()
}

/// Returns `true` if no node is present.
///
/// Either a record or simulation has ended, or everything is switched off. The silence of the data
/// reveals the latter.
fn all_nodes_left(store: &Store) -> bool {
    !store.state.has(Service::Sensor)
}
