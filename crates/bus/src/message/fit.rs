//! Verdicts on the fit of the model, and reasons why alerts cannot be decided.
//!
//! This file alone contains the wording of verdicts and reasons. All messages and pages use it.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::{
    Format, MAX_CHANNELS, Malformed, Message, bounded, check_count, check_finite, check_range,
};
use crate::name::Name;

/// Verdict on whether the data support the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FitVerdict {
    /// All measures of fit agree with the model.
    Supported,
    /// The model omits something that matters. The filter widens the intervals accordingly.
    Doubtful,
    /// The data contradict the model, so that an estimate is meaningless.
    Contradicted,
}

impl FitVerdict {
    /// All verdicts, from the best to the worst.
    pub const ALL: [Self; 3] = [Self::Supported, Self::Doubtful, Self::Contradicted];

    /// Returns the name of the verdict, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Supported => "supported",
            Self::Doubtful => "doubtful",
            Self::Contradicted => "contradicted",
        }
    }

    /// Returns the verdict as a clause without a full stop.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Supported => "the data support the model",
            Self::Doubtful => "the model omits a significant effect",
            Self::Contradicted => "the data contradict the model",
        }
    }
}

/// A measure of fit that disagrees with the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FitReason {
    /// The innovations suddenly exceed the expectation of the filter.
    InnovationBurst,
    /// A parameter is at its bound.
    ParameterAtBound,
    /// A parameter lies far outside its prior.
    FarFromPrior,
    /// The model explains too little of the response.
    LittleExplained,
    /// The identified noise is much larger than the stated noise.
    ExcessNoise,
    /// The innovations are correlated over time.
    CorrelatedInnovations,
    /// The corrections of a parameter keep the same sign for longer than white innovations allow.
    WanderingParameters,
    /// The innovations follow the measured excitation.
    ExcitationInInnovations,
    /// The natural frequencies of the model differ from the measured ones.
    NaturalFrequencies,
}

impl FitReason {
    /// All reasons, in the order in which they are reported.
    pub const ALL: [Self; 9] = [
        Self::InnovationBurst,
        Self::ParameterAtBound,
        Self::FarFromPrior,
        Self::LittleExplained,
        Self::ExcessNoise,
        Self::CorrelatedInnovations,
        Self::WanderingParameters,
        Self::ExcitationInInnovations,
        Self::NaturalFrequencies,
    ];

    /// Returns the name of the reason, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::InnovationBurst => "innovation-burst",
            Self::ParameterAtBound => "parameter-at-bound",
            Self::FarFromPrior => "far-from-prior",
            Self::LittleExplained => "little-explained",
            Self::ExcessNoise => "excess-noise",
            Self::CorrelatedInnovations => "correlated-innovations",
            Self::WanderingParameters => "wandering-parameters",
            Self::ExcitationInInnovations => "excitation-in-innovations",
            Self::NaturalFrequencies => "natural-frequencies",
        }
    }

    /// Returns the reason in words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::InnovationBurst => "the innovations suddenly became large",
            Self::ParameterAtBound => "a parameter is at its bound",
            Self::FarFromPrior => "a parameter lies far outside its prior",
            Self::LittleExplained => "the model explains too little of the response",
            Self::ExcessNoise => "the estimated noise is much larger than the stated noise",
            Self::CorrelatedInnovations => "the innovations are correlated over time",
            Self::WanderingParameters => {
                "the corrections of a parameter keep their sign for too long"
            }
            Self::ExcitationInInnovations => "the innovations follow the measured excitation",
            Self::NaturalFrequencies => {
                "the natural frequencies of the model differ from the measured ones"
            }
        }
    }

    fn bit(self) -> u16 {
        1 << self as u16
    }
}

/// Reasons for a verdict other than supported. JSON contains a list of names, postcard one bit per
/// reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FitReasons(u16);

impl FitReasons {
    /// Iterates over the reasons in the order in which they are reported.
    pub fn iter(self) -> impl Iterator<Item = FitReason> {
        FitReason::ALL
            .into_iter()
            .filter(move |reason| self.contains(*reason))
    }

    /// Returns `true` if `reason` is one of the reasons.
    #[must_use]
    pub fn contains(self, reason: FitReason) -> bool {
        self.0 & reason.bit() != 0
    }

    /// Returns the reasons together with another one.
    #[must_use]
    pub fn with(self, reason: FitReason) -> Self {
        Self(self.0 | reason.bit())
    }

    /// Returns `true` if there is no reason.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0 == 0
    }

    /// Returns the reasons in words, separated by commas, or an empty text if there are none.
    #[must_use]
    pub fn words(self) -> String {
        self.iter()
            .map(FitReason::words)
            .collect::<Vec<_>>()
            .join(", ")
    }
}

impl FromIterator<FitReason> for FitReasons {
    fn from_iter<I: IntoIterator<Item = FitReason>>(reasons: I) -> Self {
        Self(
            reasons
                .into_iter()
                .fold(0, |bits, reason| bits | reason.bit()),
        )
    }
}

impl Serialize for FitReasons {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            return serializer.collect_seq(self.iter());
        }
        self.0.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for FitReasons {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if deserializer.is_human_readable() {
            let reasons: Vec<FitReason> =
                bounded::list::<_, _, { FitReason::ALL.len() }>(deserializer)?;
            return Ok(reasons.into_iter().collect());
        }
        let bits = u16::deserialize(deserializer)?;
        let known: Self = FitReason::ALL.into_iter().collect();
        match bits & !known.0 {
            0 => Ok(Self(bits)),
            unknown => Err(D::Error::custom(format_args!(
                "bits {unknown:#b} are not reasons of a fit"
            ))),
        }
    }
}

/// Describes a verdict and its reasons.
///
/// Example: `the data contradict the model: a parameter is at its bound`.
#[must_use]
pub fn fit_in_words(verdict: FitVerdict, reasons: FitReasons) -> String {
    match verdict {
        FitVerdict::Doubtful | FitVerdict::Contradicted if !reasons.is_empty() => {
            format!("{}: {}", verdict.words(), reasons.words())
        }
        FitVerdict::Supported | FitVerdict::Doubtful | FitVerdict::Contradicted => {
            verdict.words().to_owned()
        }
    }
}

/// Reason why the alerts of a parameter cannot be decided.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum UndecidedBecause {
    /// The filter is still learning its noise levels.
    NoiseTraining,
    /// A measured excitation has no usable samples.
    ExcitationSilent,
    /// The data contradict the model.
    FitContradicted,
    /// The estimate is at a bound of the parameter.
    ParameterAtBound,
    /// The estimate or its reference is too uncertain. Even twice the loss of the rule would not
    /// raise an alert.
    NothingLearnt,
    /// A sensor in use is probably faulty.
    SensorInDoubt,
}

impl UndecidedBecause {
    /// All reasons, in decreasing order of importance.
    pub const ALL: [Self; 6] = [
        Self::NoiseTraining,
        Self::ExcitationSilent,
        Self::FitContradicted,
        Self::ParameterAtBound,
        Self::NothingLearnt,
        Self::SensorInDoubt,
    ];

    /// Returns the name of the reason, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::NoiseTraining => "noise-training",
            Self::ExcitationSilent => "excitation-silent",
            Self::FitContradicted => "fit-contradicted",
            Self::ParameterAtBound => "parameter-at-bound",
            Self::NothingLearnt => "nothing-learnt",
            Self::SensorInDoubt => "sensor-in-doubt",
        }
    }

    /// Returns the reason in words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::NoiseTraining => "the filter is still learning its noise levels",
            Self::ExcitationSilent => "a measured excitation delivers no usable samples",
            Self::FitContradicted => FitVerdict::Contradicted.words(),
            Self::ParameterAtBound => "the estimate is at a bound of the parameter",
            Self::NothingLearnt => {
                "the estimate or its reference is too uncertain to reveal even twice the loss of \
                 the rule"
            }
            Self::SensorInDoubt => "a sensor is probably faulty",
        }
    }
}

/// Measures of fit of one observed channel. `None` if a measure is not yet known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelFitDisplay {
    /// Name of the channel.
    pub channel: Name,
    /// Largest absolute autocorrelation of the innovations over the lags of one period, 0 to 1.
    /// White innovations have a value near 0.
    pub largest_autocorrelation: Option<f64>,
    /// Share of the channel's variance that the model or the stated noise explains, 0 to 1.
    pub explained_share: Option<f64>,
    /// Correlation of the innovations with the measured excitation, −1 to 1. It is the value with
    /// the largest magnitude over the lags of one period.
    pub excitation_correlation: Option<f64>,
    /// Identified noise divided by stated noise, as standard deviations.
    pub noise_ratio: Option<f64>,
}

/// Verdict on the fit of one structure, published at display rate and on every change.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FitDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The verdict.
    pub verdict: FitVerdict,
    /// Reasons why the verdict is not supported.
    pub reasons: FitReasons,
    /// Whether the filter follows a sudden change. If so, the estimates are still moving.
    pub follows_jump: bool,
    /// Measures of fit per observed channel, in the order of the structure file.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub channels: Vec<ChannelFitDisplay>,
}

impl FitDisplay {
    /// Returns the verdict in words, with its reasons and whether the filter follows a sudden
    /// change.
    #[must_use]
    pub fn words(&self) -> String {
        let followed = if self.follows_jump {
            "; the filter is tracking a sudden change"
        } else {
            ""
        };
        fit_in_words(self.verdict, self.reasons) + followed
    }
}

impl Message for FitDisplay {
    const TYPE: &'static str = "fit";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_count("channels of a fit", self.channels.len(), 0, MAX_CHANNELS)?;
        for channel in &self.channels {
            check_finite(
                "largest autocorrelation",
                channel.largest_autocorrelation.unwrap_or(0.0),
            )?;
            check_finite("explained share", channel.explained_share.unwrap_or(0.0))?;
            check_range(
                "excitation correlation",
                channel.excitation_correlation.unwrap_or(0.0),
                -1.0,
                1.0,
            )?;
            check_range(
                "noise ratio",
                channel.noise_ratio.unwrap_or(0.0),
                0.0,
                f64::MAX,
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display(verdict: FitVerdict, reasons: &[FitReason]) -> FitDisplay {
        let channel = ChannelFitDisplay {
            channel: Name::new("roof").unwrap(),
            largest_autocorrelation: Some(0.35),
            explained_share: None,
            excitation_correlation: Some(-0.25),
            noise_ratio: Some(1.1),
        };
        let reasons = reasons.iter().copied().collect();
        let structure = Name::new("tower").unwrap();
        FitDisplay {
            structure,
            time_ns: 5,
            verdict,
            reasons,
            follows_jump: false,
            channels: vec![channel],
        }
    }

    #[test]
    fn reasons_are_words_in_json_and_bits_in_postcard() {
        let shown = display(
            FitVerdict::Contradicted,
            &[
                FitReason::ExcitationInInnovations,
                FitReason::ParameterAtBound,
            ],
        );
        let text = String::from_utf8(shown.encode().unwrap()).unwrap();
        assert!(
            text.contains(r#""reasons":["parameter-at-bound","excitation-in-innovations"]"#),
            "{text}"
        );
        assert_eq!(
            FitDisplay::decode("application/json", text.as_bytes()).unwrap(),
            shown
        );
        for reason in FitReason::ALL {
            let reasons: FitReasons = [reason].into_iter().collect();
            let bytes = postcard::to_stdvec(&reasons).unwrap();
            assert_eq!(
                postcard::from_bytes::<FitReasons>(&bytes)
                    .unwrap()
                    .iter()
                    .collect::<Vec<_>>(),
                [reason]
            );
            assert!(
                serde_json::to_string(&reason)
                    .unwrap()
                    .contains(reason.as_str()),
                "{reason:?}"
            );
        }
        let unknown = postcard::to_stdvec(&(1_u16 << FitReason::ALL.len())).unwrap();
        assert!(postcard::from_bytes::<FitReasons>(&unknown).is_err());
    }

    #[test]
    fn words_equal_those_of_the_json_message() {
        for verdict in FitVerdict::ALL {
            assert_eq!(
                serde_json::to_string(&verdict).unwrap(),
                format!("\"{}\"", verdict.as_str())
            );
        }
        for because in UndecidedBecause::ALL {
            assert_eq!(
                serde_json::to_string(&because).unwrap(),
                format!("\"{}\"", because.as_str())
            );
        }
    }

    #[test]
    fn text_of_a_verdict_names_its_reasons() {
        let words = display(FitVerdict::Doubtful, &[FitReason::CorrelatedInnovations]).words();
        assert_eq!(
            words,
            "the model omits a significant effect: the innovations are correlated over time"
        );
        let shown = FitDisplay {
            follows_jump: true,
            ..display(FitVerdict::Supported, &[])
        };
        assert_eq!(
            shown.words(),
            "the data support the model; the filter is tracking a sudden change"
        );
    }

    #[test]
    fn measures_out_of_range_are_refused() {
        let mut shown = display(FitVerdict::Supported, &[]);
        shown.channels[0].excitation_correlation = Some(1.5);
        assert!(matches!(shown.check(), Err(Malformed::Range { .. })));
        shown.channels[0].excitation_correlation = None;
        shown.channels[0].noise_ratio = Some(f64::INFINITY);
        assert!(shown.check().is_err());
    }
}
