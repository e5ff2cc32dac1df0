//! What a sensor node that identifies for itself sends to the station.

use serde::{Deserialize, Serialize};

use super::{
    Format, Header, MAX_CHANNELS, Malformed, Message, NodeState, Pace, check_count, check_finite, check_finite_list,
    check_range,
};

/// Most answers of the station that a node has taken since its last message.
const MAX_ANSWERS: usize = 64;

/// The motion of the structure in few numbers, each with its variance; or some samples of a node, as they are.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MotionNumbers {
    /// Means; or samples by instant and channel, NaN where one is missing.
    pub mean: Vec<f64>,
    /// Variances, as many, all positive; none for samples.
    pub variance: Vec<f64>,
}

/// From which density a node has started towards its message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeLineage {
    /// Its own last message, 0 for the prior of the structure file.
    pub own: u64,
    /// Messages whose answers it has taken since then.
    pub answers: Vec<u64>,
}

/// A density of the parameters, and what goes with it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalDensity {
    /// Means of the parameters, in the order of the structure file, ratios to nominal.
    pub mean: Vec<f64>,
    /// Their covariance: upper triangle by columns, p(p+1)/2 values, or the p variances alone.
    pub covariance: Vec<f64>,
    /// From which density the node started; none after it had to start anew.
    pub lineage: Option<NodeLineage>,
    /// Its motion, where the structure file asks for it.
    pub motion: Option<MotionNumbers>,
}

/// What a node sends once in a fusion period, and when its samples end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalMessage {
    /// Source: the node; epoch: of the node's worker; sequence: its count of fusion periods, from 1; time: of its last
    /// sample, by its own clock.
    pub header: Header,
    /// Whether its samples come as they are measured.
    pub pace: Pace,
    /// None where there is nothing new: the samples ended within a period.
    pub density: Option<LocalDensity>,
    /// Times the filter of the node has started anew.
    pub restarts: u64,
    /// Whether more follows.
    pub state: NodeState,
}

pub(super) fn check_density(mean: &[f64], covariance: &[f64]) -> Result<(), Malformed> {
    check_count("parameters", mean.len(), 1, MAX_CHANNELS)?;
    let (triangle, variances) = (mean.len() * (mean.len() + 1) / 2, mean.len());
    if covariance.len() != triangle && covariance.len() != variances {
        return Err(Malformed::Length { what: "covariance", found: covariance.len(), expected: triangle });
    }
    check_finite_list("mean", mean)?;
    check_finite_list("covariance", covariance)
}

pub(super) fn check_motion(motion: &MotionNumbers) -> Result<(), Malformed> {
    check_count("numbers of motion", motion.mean.len(), 0, MAX_CHANNELS)?;
    if motion.variance.is_empty() {
        let is_infinite = |value: &&f64| value.is_infinite();
        return match motion.mean.iter().find(is_infinite) {
            Some(value) => check_finite("sample of another node", *value),
            None => Ok(()),
        };
    }
    if motion.variance.len() != motion.mean.len() {
        let (found, expected) = (motion.variance.len(), motion.mean.len());
        return Err(Malformed::Length { what: "variances of motion", found, expected });
    }
    check_finite_list("motion", &motion.mean)?;
    motion.variance.iter().try_for_each(|variance| {
        check_finite("variance of motion", *variance)?;
        check_range("variance of motion", *variance, f64::MIN_POSITIVE, f64::MAX)
    })
}

impl Message for LocalMessage {
    const TYPE: &'static str = "local";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        if let Some(density) = &self.density {
            check_density(&density.mean, &density.covariance)?;
            if let Some(lineage) = &density.lineage {
                check_count("answers taken", lineage.answers.len(), 0, MAX_ANSWERS)?;
            }
            if let Some(motion) = &density.motion {
                check_motion(motion)?;
            }
        }
        self.header.check(1)
    }
}
