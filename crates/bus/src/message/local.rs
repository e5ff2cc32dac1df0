//! What a sensor node that identifies for itself sends to the station.

use serde::{Deserialize, Serialize};

use super::{
    ChannelState, Format, Header, MAX_CHANNELS, Malformed, MaskedSpan, Message, NodeState, Pace,
    bounded, check_count, check_finite, check_finite_list, check_range,
};

/// Most answers of the station that a node has taken since its last message.
const MAX_ANSWERS: usize = 64;

/// Largest power of two, and its inverse the smallest, that is a unit of told samples.
const LARGEST_EXPONENT: i16 = 1000;

/// The motion of the structure in few numbers, each with its variance.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MotionNumbers {
    /// Means.
    pub mean: Vec<f64>,
    /// Variances, as many, all positive.
    pub variance: Vec<f64>,
}

/// Some samples of a node in whole units, which take two bytes each where eight would be told of noise.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ToldSamples {
    /// By channel: its unit is two to this power, in SI units.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    exponents: Vec<i16>,
    /// By instant and channel: units, one further from zero than they are unless negative; 0 where a sample is missing.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    units: Vec<i32>,
}

impl ToldSamples {
    /// Samples by instant and channel, NaN where one is missing, in units of two to these powers by channel. What is no whole number of units is
    /// rounded; what is more than 2³¹ of them is missing.
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

    /// Returns the samples by instant and channel, NaN where one is missing.
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
            "channels of told samples",
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
                what: "told samples",
                found: self.units.len(),
                expected,
            }),
        }
    }
}

/// What is told of the motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ToldMotion {
    /// Modal coordinates or responses.
    Numbers(MotionNumbers),
    /// Samples.
    Samples(ToldSamples),
}

impl ToldMotion {
    /// Means with their variances; or samples, which have none, in units of two to these powers by channel.
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

    /// Returns means and variances; of samples the samples by instant and channel, NaN where one is missing, and no variances.
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

/// From which density a node has started towards its message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeLineage {
    /// Its own last message, 0 for the prior of the structure file.
    pub own: u64,
    /// Messages whose answers it has taken since then.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_ANSWERS>")]
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
    pub motion: Option<ToldMotion>,
}

/// How the screening of one channel of a node stands; the station tells it on the topic of the channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScreenedChannel {
    /// In training, screening, or faulty.
    pub state: ChannelState,
    /// Samples rejected since the filter started.
    pub rejected: u64,
    /// Samples screened since then.
    pub screened: u64,
    /// Share of rejected samples among the recent ones; in single precision, as people look at it.
    pub recent_share: f32,
    /// Running standard deviation of its residuals, unit of the channel.
    pub scale: f32,
    /// The latest stretch in which every sample was rejected, where it has changed since the message before.
    pub masked: Option<MaskedSpan>,
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
    /// Instants since its last message at which it had a sample of any channel: 0 where all is predicted.
    pub samples: u64,
    /// Its observed channels, in the order of the structure file; none where outliers are not screened.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub screening: Vec<ScreenedChannel>,
    /// Whether more follows.
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
