//! How a service is doing.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_count, check_finite, check_text};
use crate::name::Name;

/// Most reasons in one status: they come from a closed set.
const MAX_REASONS: usize = 1024;

/// Put once per second by every service.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// The structure.
    pub structure: Name,
    /// The service, as in its key.
    pub service: Name,
    /// The instance, as in its key.
    pub id: Name,
    /// Wall clock, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Wall clock minus time of the last item done, s; none before the first.
    pub lag_s: Option<f64>,
    /// Number of the first item not yet done.
    pub done: u64,
    /// What was dropped, lost or mended, counted by reason since the start.
    pub drops: BTreeMap<String, u64>,
    /// Restarts since the start.
    pub restarts: u64,
    /// Version of the program.
    pub version: String,
}

impl Message for Status {
    const TYPE: &'static str = "status";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        if let Some(lag) = self.lag_s {
            check_finite("lag", lag)?;
        }
        check_count("drops", self.drops.len(), 0, MAX_REASONS)?;
        for reason in self.drops.keys() {
            check_text("drop reason", reason)?;
        }
        check_text("version", &self.version)
    }
}
