//! An epoch: a stretch of measurement time with one value per quantity and condition.

use serde::{Deserialize, Serialize};

/// Values of one epoch, in the order of the settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Epoch {
    /// Middle of the epoch (s since 1970-01-01 UTC).
    pub time_s: f64,
    /// Value of each quantity (above 0, in its unit), or `None` if it was not determined.
    pub quantities: Vec<Option<f64>>,
    /// Value of each condition (in the unit of its kind), or `None` if it was not measured.
    pub conditions: Vec<Option<f64>>,
}
