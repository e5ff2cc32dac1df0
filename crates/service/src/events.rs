//! Events, on the bus and in the log.

use spandrel_bus::{Bus, BusError, DisplayPublisher, Event, EventKind, Keys, MonitoringState};
use tracing::{Level, info, warn};

/// Publishes the events of one structure and logs them.
#[derive(Debug)]
pub struct EventPublisher(DisplayPublisher<Event>);

impl EventPublisher {
    /// Declares the topic.
    ///
    /// # Errors
    /// Returns an error if the bus rejects the declaration.
    pub async fn declare(bus: &Bus, keys: &Keys) -> Result<Self, BusError> {
        Ok(Self(bus.publish_display(keys.event()).await?))
    }

    /// Logs an event and publishes it.
    ///
    /// # Errors
    /// Returns an error if the event is malformed, or if the session is closed.
    pub async fn put(&self, event: &Event) -> Result<(), BusError> {
        log_event(event, None);
        self.0.put(event).await
    }
}

/// Logs an event, as a warning if it reports a fault or a recovery from one, otherwise as
/// information.
///
/// The log contains the measurement time in ns since 1970 as on the bus, or in seconds since
/// `start_ns` if that is given.
pub fn log_event(event: &Event, start_ns: Option<i64>) {
    let (structure, subject) = (event.structure.as_str(), event.subject.as_str());
    let (what, why) = (event.what.as_str(), event.why.as_str());
    let time_s = start_ns.map(|start_ns| event.time_ns.saturating_sub(start_ns) as f64 / 1e9);
    let time_ns = start_ns.is_none().then_some(event.time_ns);
    if level(event) == Level::WARN {
        warn!(structure, subject, time_s, time_ns, what, why, "event");
    } else {
        info!(structure, subject, time_s, time_ns, what, why, "event");
    }
}

/// Returns the level at which an event is logged.
fn level(event: &Event) -> Level {
    match event.kind {
        EventKind::Monitoring if event.subject == MonitoringState::Watching.as_str() => Level::INFO,
        EventKind::Calibration
        | EventKind::LeadingClass
        | EventKind::NodeBack
        | EventKind::ChannelBack
        | EventKind::SamplesBack
        | EventKind::ClockRight
        | EventKind::Maintenance
        | EventKind::NoticeSent
        | EventKind::Annotation
        | EventKind::CaughtUp
        | EventKind::HistoryBack
        | EventKind::ModeFound
        | EventKind::ModeParted
        | EventKind::EarthquakeReport
        | EventKind::ModeProposed
        | EventKind::ModelAgrees
        | EventKind::StateBack => Level::INFO,
        EventKind::Restart
        | EventKind::Takeover
        | EventKind::Unidentified
        | EventKind::NodeExcluded
        | EventKind::NodeSilent
        | EventKind::ChannelExcluded
        | EventKind::ChannelInDoubt
        | EventKind::SamplesDropped
        | EventKind::ClockWrong
        | EventKind::ClockMoved
        | EventKind::NoticeFailed
        | EventKind::ClockDoubtful
        | EventKind::Monitoring
        | EventKind::Gap
        | EventKind::Overloaded
        | EventKind::HistoryUnavailable
        | EventKind::LastingChange
        | EventKind::ModeLost
        | EventKind::ModePaired
        | EventKind::ModelContradicted
        | EventKind::Earthquake
        | EventKind::EarthquakeUnreported
        | EventKind::ReaderDisconnected
        | EventKind::StateLost => Level::WARN,
    }
}
