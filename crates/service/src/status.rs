//! The status of a service.

use std::collections::BTreeMap;
use std::time::Duration;

use spandrel_bus::{
    BusError, DisplayPublisher, FitVerdict, InstrumentStatus, Keys, Load, Maintenance, Name,
    NodeClock, Pace, Service, Standing, Status, UndecidedBecause,
};

use crate::{Clock, ServiceInstance};

/// Interval between status messages.
pub const STATUS_EVERY: Duration = Duration::from_secs(1);

/// What a service reports about itself. [`StatusPublisher::put`] adds the other fields of
/// [`Status`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Sequence number of the first item that has not been processed.
    pub done: u64,
    /// Time of the last processed item, ns since the Unix epoch. `None` before the first item, and
    /// if the service has no items.
    pub processed_ns: Option<i64>,
    /// Number of dropped, lost or recovered items since the start, by reason.
    pub drops: BTreeMap<String, u64>,
    /// Number of restarts since the start.
    pub restarts: u64,
    /// Whether the samples are live or replayed.
    pub pace: Option<Pace>,
    /// Role of the process.
    pub state: Option<Standing>,
    /// Load of the service.
    pub load: Option<Load>,
    /// Number of frames that the service has not yet processed.
    pub frames_behind: Option<u64>,
    /// Verdict on the fit after the last frame.
    pub fit: Option<FitVerdict>,
    /// Number of watched parameters without a decision, by reason.
    pub undecided: BTreeMap<UndecidedBecause, u64>,
    /// State of each instrument by its name.
    pub instruments: BTreeMap<String, InstrumentStatus>,
    /// When the nodes sample, for those that do not sample at the times of the frames.
    pub clocks: BTreeMap<Name, NodeClock>,
    /// Share of the latest frames without a sample, for the channels that miss samples.
    pub missing: BTreeMap<Name, f64>,
    /// Present maintenance of the structure.
    pub maintenance: Vec<Maintenance>,
}

impl Report {
    /// Returns the time between the last processed item and now, in seconds. Returns `None` without
    /// a processed item.
    #[must_use]
    pub fn lag_s(&self, clock: &Clock) -> Option<f64> {
        self.processed_ns
            .map(|time_ns| clock.seconds_since(time_ns))
    }
}

/// Publishes the status of one service of one structure.
#[derive(Debug)]
pub struct StatusPublisher {
    publisher: DisplayPublisher<Status>,
    structure: Name,
    service: Service,
    id: Name,
    clock: Clock,
}

impl StatusPublisher {
    /// Declares the status topic of one instance of `service`, for the structure of `keys`.
    ///
    /// # Errors
    /// Returns an error if the bus rejects the declaration.
    pub async fn declare(
        instance: &ServiceInstance,
        service: Service,
        keys: &Keys,
    ) -> Result<Self, BusError> {
        let ServiceInstance { bus, id, clock } = instance;
        Ok(Self {
            publisher: bus.publish_display(keys.status(service, id)).await?,
            structure: keys.structure().clone(),
            service,
            id: id.clone(),
            clock: *clock,
        })
    }

    /// Publishes a report, and adds the present time and the lag: the time since the last processed
    /// item was measured.
    ///
    /// # Errors
    /// Returns an error if the report is malformed, or if the session is closed.
    pub async fn put(&self, report: Report) -> Result<(), BusError> {
        let status = Status {
            structure: self.structure.clone(),
            service: self.service.name(),
            id: self.id.clone(),
            time_ns: self.clock.now_ns(),
            lag_s: report.lag_s(&self.clock),
            pace: report.pace,
            state: report.state,
            done: report.done,
            load: report.load,
            frames_behind: report.frames_behind,
            fit: report.fit,
            undecided: report.undecided,
            instruments: report.instruments,
            clocks: report.clocks,
            missing: report.missing,
            maintenance: report.maintenance,
            drops: report.drops,
            restarts: report.restarts,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        self.publisher.put(&status).await
    }
}
