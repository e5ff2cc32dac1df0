//! The health of one channel.

use serde::{Deserialize, Serialize};

/// Size from which an acceleration is printed in m/s² (m/s²).
const LARGE: f64 = 0.1;

/// A kind of fault, with its size.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Fault {
    /// The channel measures a multiple of the motion: the factor, positive.
    Gain(f64),
    /// The channel measures the motion with the wrong sign: the factor, positive.
    Sign(f64),
    /// The channel measures the motion late (s); negative = early.
    Delay(f64),
    /// The channel does not follow the motion and measures less than it: it is dead or stuck.
    Dead,
    /// The channel measures more than the motion, or something else.
    Disturbed,
    /// The offset of the channel moves or is large: its value relative to the others (m/s²).
    Drift(f64),
    /// The peaks of the channel are cut off at this value (m/s²).
    Clipped(f64),
    /// The channel is exchanged with another one.
    Exchanged,
}

/// The judgement of a channel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Soundness {
    /// There was not enough common motion yet.
    #[default]
    Unchecked,
    /// The channel agrees with the others.
    Sound,
    /// A fault is more probable than none.
    InDoubt,
    /// A fault is almost certain.
    Faulty,
}

/// The health of one channel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ChannelHealth {
    /// The judgement.
    pub soundness: Soundness,
    /// Probability of a fault, 0 to 1.
    pub probability: f64,
    /// The most probable fault. `None` for a channel that works.
    pub fault: Option<Fault>,
    /// Ratio of the channel to the motion that the other channels imply, 1 for a channel that
    /// works. `None` before the first comparison.
    pub gain: Option<f64>,
    /// Delay of the channel relative to the other channels (s), positive if the channel is later.
    /// `None` before the first comparison.
    pub delay_s: Option<f64>,
    /// Coherence of the channel with the other channels, 0 to 1. `None` before the first
    /// comparison.
    pub coherence: Option<f64>,
}

impl Fault {
    /// Returns the fault as a predicate, such as "does not follow the motion of the others".
    #[must_use]
    pub fn words(self) -> String {
        match self {
            Self::Gain(factor) => format!("measures {factor:.2} times the motion of the others"),
            Self::Sign(_) => "measures with the opposite sign".to_owned(),
            Self::Delay(delay_s) if delay_s < 0.0 => {
                format!("is {:.0} ms earlier than the others", -1e3 * delay_s)
            }
            Self::Delay(delay_s) => format!("is {:.0} ms later than the others", 1e3 * delay_s),
            Self::Dead => "does not follow the motion of the others".to_owned(),
            Self::Disturbed => "measures something that the others do not".to_owned(),
            Self::Drift(offset) => {
                let offset = acceleration(offset);
                format!("has an offset of {offset} relative to the other sensors")
            }
            Self::Clipped(value) => format!("is cut off at {}", acceleration(value)),
            Self::Exchanged => "is exchanged with another one".to_owned(),
        }
    }
}

/// Returns an acceleration (m/s²) with its unit. A small one has more digits in mm/s².
fn acceleration(value: f64) -> String {
    if value.abs() < LARGE {
        format!("{:.1} mm/s2", 1e3 * value)
    } else {
        format!("{value:.2} m/s2")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_drifts_and_ranges_are_not_rounded_to_zero() {
        assert_eq!(
            Fault::Drift(0.004).words(),
            "has an offset of 4.0 mm/s2 relative to the other sensors"
        );
        assert_eq!(
            Fault::Drift(-0.25).words(),
            "has an offset of -0.25 m/s2 relative to the other sensors"
        );
        assert_eq!(Fault::Clipped(-0.0496).words(), "is cut off at -49.6 mm/s2");
        assert_eq!(Fault::Clipped(19.62).words(), "is cut off at 19.62 m/s2");
    }
}
