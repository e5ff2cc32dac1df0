//! Message of a sensor node that identifies locally, to the station.

use serde::{Deserialize, Serialize};

use super::{
    ChannelState, Format, Header, MAX_CHANNELS, Malformed, MaskedSpan, Message, NodeState, Pace,
    bounded, check_count, check_finite, check_finite_list, check_range,
};

/// Maximum number of station replies in the lineage of one message.
const MAX_ANSWERS: usize = 64;

/// Maximum absolute exponent of a unit, as a power of two.
const LARGEST_EXPONENT: i16 = 1000;

/// Motion of the structure as a few numbers with their variances.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MotionNumbers {
    /// Means.
    pub mean: Vec<f64>,
    /// Variances, one per mean, all positive.
    pub variance: Vec<f64>,
}

/// Samples of a node in whole units. A sample usually takes two bytes instead of eight, because it
/// omits digits below the noise.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ToldSamples {
    /// Exponent per channel. The unit is two to this power, in SI units.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    exponents: Vec<i16>,
    /// Samples in units, by time step and channel; 0 if a sample is missing. Values from 0 upwards
    /// are stored incremented by one.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    units: Vec<i32>,
}

impl ToldSamples {
    /// Encodes samples by time step and channel, with one exponent per channel.
    ///
    /// NaN represents a missing sample. Samples are rounded to whole units. A sample with a
    /// magnitude of 2³¹ − 1 units or more is missing.
    #[must_use]
    pub fn new(samples: &[f64], exponents: &[i16]) -> Self {
        let unit = exponents
            .iter()
            .map(|exponent| 2f64.powi(i32::from(*exponent)))
            .cycle();
        let told = |(sample, unit): (&f64, f64)| match (sample / unit).round() {
            units if units.abs() < f64::from(i32::MAX) => units as i32 + i32::from(units >= 0.0),
            _ => 0,
        };
        Self {
            exponents: exponents.to_vec(),
            units: samples.iter().zip(unit).map(told).collect(),
        }
    }

    /// Decodes the samples by time step and channel. NaN represents a missing sample.
    #[must_use]
    pub fn samples(&self) -> Vec<f64> {
        let unit = self
            .exponents
            .iter()
            .map(|exponent| 2f64.powi(i32::from(*exponent)))
            .cycle();
        let sample = |(units, unit): (&i32, f64)| match units {
            0 => f64::NAN,
            units => f64::from(units - i32::from(*units > 0)) * unit,
        };
        self.units.iter().zip(unit).map(sample).collect()
    }

    fn check(&self) -> Result<(), Malformed> {
        check_count(
            "channels of sent samples",
            self.exponents.len(),
            1,
            MAX_CHANNELS,
        )?;
        for exponent in &self.exponents {
            let largest = f64::from(LARGEST_EXPONENT);
            check_range(
                "exponent of a unit",
                f64::from(*exponent),
                -largest,
                largest,
            )?;
        }
        let expected = self.units.len().next_multiple_of(self.exponents.len());
        match self.units.len() == expected {
            true => Ok(()),
            false => Err(Malformed::Length {
                what: "sent samples",
                found: self.units.len(),
                expected,
            }),
        }
    }
}

/// Transmitted motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ToldMotion {
    /// Modal coordinates or responses, with variances.
    Numbers(MotionNumbers),
    /// Samples.
    Samples(ToldSamples),
}

impl ToldMotion {
    /// Creates the message from means and variances, or from samples.
    ///
    /// If `exponents` is empty, `mean` and `variance` are stored as numbers. Otherwise, `mean`
    /// contains samples, encoded with one exponent per channel, and `variance` is ignored.
    #[must_use]
    pub fn new(mean: &[f64], variance: &[f64], exponents: &[i16]) -> Self {
        match exponents.is_empty() {
            true => Self::Numbers(MotionNumbers {
                mean: mean.to_vec(),
                variance: variance.to_vec(),
            }),
            false => Self::Samples(ToldSamples::new(mean, exponents)),
        }
    }

    /// Returns means and variances.
    ///
    /// For samples, returns the samples by time step and channel (NaN = missing), and no variances.
    #[must_use]
    pub fn into_numbers(self) -> (Vec<f64>, Vec<f64>) {
        match self {
            Self::Numbers(numbers) => (numbers.mean, numbers.variance),
            Self::Samples(told) => (told.samples(), Vec::new()),
        }
    }

    pub(super) fn check(&self) -> Result<(), Malformed> {
        match self {
            Self::Numbers(numbers) => check_motion(numbers),
            Self::Samples(samples) => samples.check(),
        }
    }
}

/// Origin of a node's density.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeLineage {
    /// Number of the node's own message from which it started; 0 for the prior of the structure
    /// file.
    pub own: u64,
    /// Numbers of the messages whose replies the node has used since then.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_ANSWERS>")]
    pub answers: Vec<u64>,
}

/// Density of the parameters, with its origin and the motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalDensity {
    /// Means of the parameters, in the order of the structure file, ratios to nominal.
    pub mean: Vec<f64>,
    /// Covariance of the parameters: upper triangle by columns, p(p+1)/2 values, or only the p
    /// variances.
    pub covariance: Vec<f64>,
    /// Origin of the density. `None` after a restart of the node.
    pub lineage: Option<NodeLineage>,
    /// Motion at the node, if the structure file requests it.
    pub motion: Option<ToldMotion>,
}

/// Screening state of one channel of a node. The station publishes it on the topic of the channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScreenedChannel {
    /// State of the screening: training, screening or faulty.
    pub state: ChannelState,
    /// Number of samples rejected since the filter started.
    pub rejected: u64,
    /// Number of samples screened since the filter started.
    pub screened: u64,
    /// Share of rejected samples among the recent samples. Single precision suffices for display.
    pub recent_share: f32,
    /// Running standard deviation of the residuals, unit of the channel.
    pub scale: f32,
    /// Latest interval in which all samples were rejected, if it has changed since the previous
    /// message.
    pub masked: Option<MaskedSpan>,
}

/// Message of a node, sent once per fusion period and at the end of its samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalMessage {
    /// Source: the node; epoch: of its worker; sequence: count of fusion periods, from 1; time: of
    /// its last sample, by the node's clock.
    pub header: Header,
    /// Whether the samples are live or replayed.
    pub pace: Pace,
    /// The density. `None` if there is no new information, because the samples ended within a
    /// period.
    pub density: Option<LocalDensity>,
    /// Number of restarts of the node's filter.
    pub restarts: u64,
    /// Number of time steps since the last message with a sample of at least one channel. If it is
    /// 0, the density is only a prediction.
    pub samples: u64,
    /// Observed channels, in the order of the structure file. Empty if outliers are not screened.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub screening: Vec<ScreenedChannel>,
    /// Whether more messages follow.
    pub state: NodeState,
}

pub(super) fn check_density(mean: &[f64], covariance: &[f64]) -> Result<(), Malformed> {
    check_count("parameters", mean.len(), 1, MAX_CHANNELS)?;
    let (triangle, variances) = (mean.len() * (mean.len() + 1) / 2, mean.len());
    if covariance.len() != triangle && covariance.len() != variances {
        return Err(Malformed::Length {
            what: "covariance",
            found: covariance.len(),
            expected: triangle,
        });
    }
    check_finite_list("mean", mean)?;
    check_finite_list("covariance", covariance)
}

pub(super) fn check_motion(motion: &MotionNumbers) -> Result<(), Malformed> {
    check_count("numbers of motion", motion.mean.len(), 0, MAX_CHANNELS)?;
    if motion.variance.len() != motion.mean.len() {
        let (found, expected) = (motion.variance.len(), motion.mean.len());
        return Err(Malformed::Length {
            what: "variances of motion",
            found,
            expected,
        });
    }
    check_finite_list("motion", &motion.mean)?;
    motion.variance.iter().try_for_each(|variance| {
        check_finite("variance of motion", *variance)?;
        check_range("variance of motion", *variance, f64::MIN_POSITIVE, f64::MAX)
    })
}

impl Message for LocalMessage {
    const TYPE: &'static str = "local";
    const VERSION: u16 = 2;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        if let Some(density) = &self.density {
            check_density(&density.mean, &density.covariance)?;
            if let Some(lineage) = &density.lineage {
                check_count("answers taken", lineage.answers.len(), 0, MAX_ANSWERS)?;
            }
            if let Some(motion) = &density.motion {
                motion.check()?;
            }
        }
        check_count("screened channels", self.screening.len(), 0, MAX_CHANNELS)?;
        for channel in &self.screening {
            check_range("recent share", f64::from(channel.recent_share), 0.0, 1.0)?;
            check_finite("scale", f64::from(channel.scale))?;
        }
        self.header.check(1)
    }
}
