//! Comparison of the sensors of one node with the others, at display rate.

use serde::{Deserialize, Serialize};

use super::{Format, MAX_CHANNELS, Malformed, Message, check_count, check_finite, check_range};
use crate::name::Name;

/// Judgement of a channel by comparison with the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Soundness {
    /// Not compared, because there is no common motion to compare it by, or not enough yet.
    Unchecked,
    /// It agrees with the others.
    Sound,
    /// A fault is more probable than none.
    InDoubt,
    /// A fault is almost certain.
    Faulty,
}

/// Kind of a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// A multiple of the motion.
    Gain,
    /// The opposite sign.
    Sign,
    /// The motion at another time.
    Delay,
    /// Less than the motion, and unrelated to it.
    Dead,
    /// Something that the others do not measure.
    Disturbed,
    /// An offset that moves or is large.
    Drift,
    /// Peaks that are cut off.
    Clipped,
    /// The motion of another channel, which measures the motion of this one.
    Exchanged,
}

/// Health of one channel, from the comparison with the other channels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelHealthDisplay {
    /// Name of the channel.
    pub channel: Name,
    /// The judgement.
    pub state: Soundness,
    /// Probability of a fault, 0 to 1.
    pub probability: f64,
    /// Most probable fault. `None` if the channel works or is unchecked.
    pub fault: Option<FaultKind>,
    /// Ratio of the channel to the motion that the other channels imply, negative for the opposite
    /// sign. `None` before the first comparison.
    pub gain: Option<f64>,
    /// Delay of the channel relative to the other channels (s), positive if the channel is later.
    /// `None` before the first comparison.
    pub delay_s: Option<f64>,
    /// Coherence with the other channels, 0 to 1. `None` before the first comparison.
    pub coherence: Option<f64>,
}

/// Health of the channels of one node, from the comparison of all channels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SensorHealthDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the node.
    pub node: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Health of the channels of the node that are compared with others.
    pub channels: Vec<ChannelHealthDisplay>,
}

impl Message for SensorHealthDisplay {
    const TYPE: &'static str = "sensor-health";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_count("channels", self.channels.len(), 1, MAX_CHANNELS)?;
        for channel in &self.channels {
            check_range("probability", channel.probability, 0.0, 1.0)?;
            let gain = channel.gain.map(|gain| check_finite("gain", gain));
            let delay = channel.delay_s.map(|delay| check_finite("delay_s", delay));
            let coherence = channel.coherence;
            let coherence = coherence.map(|one| check_range("coherence", one, 0.0, 1.0));
            [gain, delay, coherence]
                .into_iter()
                .flatten()
                .collect::<Result<(), _>>()?;
        }
        Ok(())
    }
}
