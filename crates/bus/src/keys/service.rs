//! The names of the services.

use crate::name::Name;

/// The services that occur in key expressions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Service {
    /// A sensor node, real, simulated or replayed.
    Sensor,
    /// The service that connects instruments to the bus.
    Feed,
    /// The sensor-ingest service.
    Ingest,
    /// The identification worker.
    Identify,
    /// The central station.
    Fuse,
    /// The alert service.
    Alert,
    /// The service that follows natural frequencies.
    Modes,
    /// The service that judges lasting changes.
    Judge,
    /// The service that reports earthquakes.
    Reports,
    /// The history service.
    History,
    /// The service that notifies people of alerts.
    Notify,
    /// The dashboard.
    Dashboard,
}

impl Service {
    /// All services.
    pub const ALL: [Self; 12] = [
        Self::Sensor,
        Self::Feed,
        Self::Ingest,
        Self::Identify,
        Self::Fuse,
        Self::Alert,
        Self::Modes,
        Self::Judge,
        Self::Reports,
        Self::History,
        Self::Notify,
        Self::Dashboard,
    ];

    /// Returns the name of the service in a key expression.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Sensor => "sensor",
            Self::Feed => "feed",
            Self::Ingest => "ingest",
            Self::Identify => "identify",
            Self::Fuse => "fuse",
            Self::Alert => "alert",
            Self::Modes => "modes",
            Self::Judge => "judge",
            Self::Reports => "reports",
            Self::History => "history",
            Self::Notify => "notify",
            Self::Dashboard => "dashboard",
        }
    }

    /// Returns the name of the service, as a chunk of a key.
    #[must_use]
    pub fn name(self) -> Name {
        Name::of_service(self)
    }

    /// Returns the service of this name. `None` if there is none.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|service| service.as_str() == name)
    }
}
