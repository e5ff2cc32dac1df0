//! The screening of one channel at display rate.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_finite, check_range};
use crate::name::Name;

/// How the screening of a channel stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ChannelState {
    /// Its first scale is not yet known.
    Training,
    /// Outliers are screened.
    Screening,
    /// The sensor is faulty: none of its samples are used.
    Faulty,
}

/// A stretch in which every sample of a channel was rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MaskedSpan {
    /// Time of its first frame, ns since the Unix epoch, UTC.
    pub from_ns: i64,
    /// Time of its last frame so far.
    pub to_ns: i64,
    /// Samples in it.
    pub samples: u64,
}

/// What the screening has done to one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OutlierDisplay {
    /// The structure.
    pub structure: Name,
    /// The channel.
    pub channel: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// How its screening stands.
    pub state: ChannelState,
    /// Samples rejected since the last message of this channel.
    pub flagged: u64,
    /// Samples rejected since the start.
    pub rejected: u64,
    /// Samples screened since the start.
    pub screened: u64,
    /// Share of rejected samples among the recent ones.
    pub recent_share: f64,
    /// The running scale of its residuals, in the unit of the channel.
    pub scale: f64,
    /// The latest stretch without a used sample; it goes on if its end is the time of this message.
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
