//! Outlier screening of one channel at display rate.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_finite, check_range};
use crate::name::Name;

/// State of the screening of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ChannelState {
    /// The initial scale is not yet known.
    Training,
    /// Outliers are screened.
    Screening,
    /// The sensor is faulty; all samples are dropped.
    Faulty,
}

/// An interval in which all samples of a channel were rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MaskedSpan {
    /// Time of the first frame, ns since the Unix epoch, UTC.
    pub from_ns: i64,
    /// Time of the last frame so far, ns since the Unix epoch, UTC.
    pub to_ns: i64,
    /// Number of samples in the interval.
    pub samples: u64,
}

/// Result of the screening of one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OutlierDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the channel.
    pub channel: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// State of the screening.
    pub state: ChannelState,
    /// Number of samples rejected since the last message of this channel.
    pub flagged: u64,
    /// Number of samples rejected since the start.
    pub rejected: u64,
    /// Number of samples screened since the start.
    pub screened: u64,
    /// Share of rejected samples among the recent samples.
    pub recent_share: f64,
    /// Running scale of the residuals, in the unit of the channel.
    pub scale: f64,
    /// Latest interval without a used sample. It continues if it ends at the time of this message.
    pub masked: Option<MaskedSpan>,
}

impl Message for OutlierDisplay {
    const TYPE: &'static str = "outlier";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_range("recent share", self.recent_share, 0.0, 1.0)?;
        check_finite("scale", self.scale)
    }
}
