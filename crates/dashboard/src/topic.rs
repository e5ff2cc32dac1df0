//! Names of series: a kind, and an item of that kind.

use crate::series::{Combine, Series};
use std::fmt;

/// Kind of a series.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Kind {
    /// A parameter: mean and standard deviation (ratios to nominal).
    Parameter,
    /// The loss of a parameter: the loss and the ends of its 95 % interval (shares of the
    /// reference), and the probability that the loss exceeds that of the rule.
    Loss,
    /// A noise level: mean and standard deviation of a variance (unit²).
    Noise,
    /// Innovations of a channel: minimum and maximum of an interval (unit of the channel).
    Innovation,
    /// Agreement of model and data: normalised innovation squared per used channel, 1 in the ideal
    /// case.
    Consistency,
    /// Screening of a channel: share of rejected samples among the recent ones, and number of
    /// rejected samples.
    Outlier,
    /// Plausibility of a model class.
    Class,
    /// A node in distributed identification: its distance from the other nodes, and the distance at
    /// which it is suspicious.
    Node,
    /// A condition, such as a temperature: its value (unit of the condition).
    Condition,
    /// The natural frequency of a declared mode, and its standard deviation (Hz).
    Mode,
    /// Samples of a channel: minimum and maximum of a bucket (unit of the channel).
    Waveform,
}

impl Kind {
    /// All kinds.
    pub(crate) const ALL: [Self; 11] = [
        Self::Parameter,
        Self::Loss,
        Self::Noise,
        Self::Innovation,
        Self::Consistency,
        Self::Outlier,
        Self::Class,
        Self::Node,
        Self::Condition,
        Self::Mode,
        Self::Waveform,
    ];

    /// Returns the word for the kind in requests.
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Parameter => "parameter",
            Self::Loss => "loss",
            Self::Noise => "noise",
            Self::Innovation => "innovation",
            Self::Consistency => "consistency",
            Self::Outlier => "outlier",
            Self::Class => "class",
            Self::Node => "node",
            Self::Condition => "condition",
            Self::Mode => "mode",
            Self::Waveform => "waveform",
        }
    }

    /// Returns `true` if the history service stores series of this kind.
    pub(crate) fn is_in_history(self) -> bool {
        !matches!(self, Self::Innovation | Self::Consistency | Self::Waveform)
    }

    /// Returns the names of the columns.
    pub(crate) fn columns(self) -> &'static [&'static str] {
        match self {
            Self::Parameter | Self::Noise => &["mean", "std"],
            Self::Loss => &["loss", "low", "high", "probability_of_loss"],
            Self::Innovation | Self::Waveform => &["least", "largest"],
            Self::Consistency => &["normalised_innovation_squared"],
            Self::Outlier => &["recent_share", "flagged"],
            Self::Class => &["plausibility"],
            Self::Node => &["distance", "distance_limit"],
            Self::Condition => &["value"],
            Self::Mode => &["frequency", "std"],
        }
    }

    /// Creates an empty series of this kind.
    pub(crate) fn series(self) -> Series {
        Series::new(match self {
            Self::Parameter | Self::Noise | Self::Mode => &[Combine::Last, Combine::Last],
            Self::Loss => &[
                Combine::Last,
                Combine::Last,
                Combine::Last,
                Combine::Largest,
            ],
            Self::Innovation | Self::Waveform => &[Combine::Least, Combine::Largest],
            Self::Consistency | Self::Class | Self::Condition => &[Combine::Last],
            Self::Outlier => &[Combine::Largest, Combine::Sum],
            Self::Node => &[Combine::Largest, Combine::Last],
        })
    }
}

/// Name of one series, written `parameter/storey-2` in requests.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct SeriesName {
    pub(crate) kind: Kind,
    /// Name of the parameter, noise level, channel, class, node, condition or mode.
    pub(crate) of: String,
}

impl SeriesName {
    pub(crate) fn new(kind: Kind, of: impl Into<String>) -> Self {
        Self {
            kind,
            of: of.into(),
        }
    }

    /// Parses a name. Returns `None` unless it is a kind, a slash and a non-empty text.
    pub(crate) fn parse(text: &str) -> Option<Self> {
        let (kind, of) = text.split_once('/')?;
        let kind = Kind::ALL.into_iter().find(|known| known.as_str() == kind)?;
        (!of.is_empty()).then(|| Self::new(kind, of))
    }
}

impl fmt::Display for SeriesName {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}/{}", self.kind.as_str(), self.of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn series_names_are_parsed_back() {
        for kind in Kind::ALL {
            let name = SeriesName::new(kind, "storey-2");
            assert_eq!(SeriesName::parse(&name.to_string()), Some(name));
        }
        for wrong in ["", "parameter", "parameter/", "stiffness/storey-2"] {
            assert_eq!(SeriesName::parse(wrong), None, "{wrong:?}");
        }
    }
}
