//! One noise parameter at display rate.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_finite, check_range};
use crate::name::Name;

/// Mean and standard deviation of one noise parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoiseDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// The noise parameter.
    pub name: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Mean, in the unit of the parameter.
    pub mean: f64,
    /// Standard deviation, in the unit of the parameter.
    pub std: f64,
}

impl Message for NoiseDisplay {
    const TYPE: &'static str = "noise";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_finite("mean", self.mean)?;
        check_range("std", self.std, 0.0, f64::MAX)
    }
}
