//! One number of an example: published, required, measured.

use serde::{Deserialize, Serialize};

/// What a measured number must be.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Required {
    /// Within a distance of a value.
    Within {
        /// The value.
        of: f64,
        /// The largest distance.
        by: f64,
    },
    /// In a closed range.
    Between {
        /// Its lower end.
        low: f64,
        /// Its upper end.
        high: f64,
    },
    /// At least this.
    AtLeast(f64),
    /// At most this.
    AtMost(f64),
    /// Nothing: the number is a limit or a substitute, shown and not judged.
    Reported,
}

impl Required {
    /// Within a share of a value, such as 0.05 for ± 5 %.
    #[must_use]
    pub fn relative(of: f64, share: f64) -> Self {
        Self::Within {
            of,
            by: of.abs() * share,
        }
    }

    /// Says whether a measured number is what it must be; a number that is none never is.
    #[must_use]
    pub fn holds(&self, measured: f64) -> bool {
        match *self {
            // the end itself holds, also where the difference is rounded up: 1.03 is within 1 ± 0.03
            Self::Within { of, by } => (measured - of).abs() <= by + 2.0 * f64::EPSILON * of.abs(),
            Self::Between { low, high } => (low..=high).contains(&measured),
            Self::AtLeast(least) => measured >= least,
            Self::AtMost(most) => measured <= most,
            Self::Reported => true,
        }
    }
}

impl std::fmt::Display for Required {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match *self {
            // a value that is required to a part in 10⁵ has to be seen to that part
            Self::Within { of, by } => {
                write!(formatter, "{} ± {}", measured_number(of, self), number(by))
            }
            Self::Between { low, high } => write!(formatter, "{} to {}", number(low), number(high)),
            Self::AtLeast(least) => write!(formatter, "≥ {}", number(least)),
            Self::AtMost(most) => write!(formatter, "≤ {}", number(most)),
            Self::Reported => write!(formatter, "–"),
        }
    }
}

/// Significant digits of a number when nothing asks for more.
const DIGITS: usize = 4;
/// Significant digits that a number has at most.
const MOST_DIGITS: usize = 15;

/// Writes a number with four significant digits, in powers of ten where it is very small or large.
pub(crate) fn number(value: f64) -> String {
    with_digits(value, DIGITS)
}

/// Writes a measured number with as many digits as decide whether it is what is required: its last one is a tenth of the
/// allowed distance or less, and what is printed holds if and only if the number does.
pub(crate) fn measured_number(value: f64, required: &Required) -> String {
    let decides = |text: &String| {
        let printed = text.parse::<f64>().unwrap_or(f64::NAN);
        let fine = match *required {
            Required::Within { by, .. } => by == 0.0 || (printed - value).abs() <= 0.05 * by,
            Required::Between { low, high } => (printed - value).abs() <= 0.05 * (high - low),
            Required::AtLeast(_) | Required::AtMost(_) | Required::Reported => true,
        };
        fine && required.holds(printed) == required.holds(value)
    };
    let texts = (DIGITS..MOST_DIGITS).map(|digits| with_digits(value, digits));
    texts
        .into_iter()
        .find(decides)
        .unwrap_or_else(|| with_digits(value, MOST_DIGITS))
}

fn with_digits(value: f64, digits: usize) -> String {
    let magnitude = value.abs();
    let trimmed = |text: &str| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text.to_owned(),
    };
    if value == 0.0 || !value.is_finite() {
        format!("{value}")
    } else if (1e-3..1e5).contains(&magnitude) {
        let decimals = (digits as i32 - 1 - magnitude.log10().floor() as i32).max(0) as usize;
        trimmed(&format!("{value:.decimals$}"))
    } else {
        let text = format!("{value:.*e}", digits - 1);
        match text.split_once('e') {
            Some((mantissa, exponent)) => format!("{}e{exponent}", trimmed(mantissa)),
            None => text,
        }
    }
}

/// Over how many seeds a requirement holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Judgement {
    /// Each seed has to hold it.
    Each,
    /// The mean over the seeds has to hold it.
    Mean,
    /// Two of three seeds have to hold it.
    TwoThirds,
}

/// One measured number of one seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    /// What it is, with its unit, such as `velocity error at floor 1 (m/s)`; unique in its case.
    pub name: String,
    /// What the source printed, where it printed a number.
    pub published: Option<f64>,
    /// What is required.
    pub required: Required,
    /// Over how many seeds.
    pub judgement: Judgement,
    /// What came out; no number where it could not be had.
    pub measured: Option<f64>,
    /// Why a miss is expected; `None` where a miss is a surprise. The requirement stays that of the specification.
    #[serde(default)]
    pub known_miss: Option<String>,
}

impl Figure {
    /// Makes a figure that each seed has to hold; a measured NaN becomes a figure that could not be had.
    #[must_use]
    pub fn new(name: impl Into<String>, measured: f64, required: Required) -> Self {
        let measured = measured.is_finite().then_some(measured);
        Self {
            name: name.into(),
            published: None,
            required,
            judgement: Judgement::Each,
            measured,
            known_miss: None,
        }
    }

    /// Adds what the source printed.
    #[must_use]
    pub fn published(mut self, value: f64) -> Self {
        self.published = Some(value);
        self
    }

    /// States why this figure is known to miss its requirement.
    ///
    /// A known miss is shown as missed, with the requirement, the measured number and this reason. It does not fail the
    /// run. A figure that meets its requirement after all is shown as holding.
    #[must_use]
    pub fn known_miss(mut self, reason: &str) -> Self {
        self.known_miss = Some(reason.to_owned());
        self
    }

    /// States why this figure is known to miss its requirement, and how far: a miss beyond the limits is a surprise.
    #[must_use]
    pub fn known_miss_within(self, limits: Required, reason: &str) -> Self {
        match self.measured {
            Some(measured) if limits.holds(measured) => self.known_miss(reason),
            _ => self,
        }
    }

    /// Asks for the requirement in another way than of each seed.
    #[must_use]
    pub fn judged(mut self, judgement: Judgement) -> Self {
        self.judgement = judgement;
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requirements_hold_at_their_ends_and_never_for_nan() {
        assert!(Required::Within { of: 1.0, by: 0.5 }.holds(1.5));
        assert!(!Required::relative(2.0, 0.05).holds(2.11));
        assert!(
            Required::Within { of: 1.0, by: 0.03 }.holds(1.03)
                && Required::Within { of: 1.0, by: 0.03 }.holds(0.97)
        );
        assert!(Required::relative(-2.0, 0.05).holds(-2.09));
        assert!(
            Required::Between {
                low: 0.0,
                high: 1.0
            }
            .holds(0.0)
        );
        assert!(!Required::AtLeast(1.0).holds(0.999));
        for required in [
            Required::AtLeast(0.0),
            Required::AtMost(0.0),
            Required::relative(1.0, 1.0),
        ] {
            assert!(!required.holds(f64::NAN), "{required}");
        }
    }

    #[test]
    fn numbers_are_written_with_four_digits() {
        for (value, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.995, "0.995"),
            (123.456, "123.5"),
            (1200.0, "1200"),
            (4.1e-6, "4.1e-6"),
            (-0.0123456, "-0.01235"),
        ] {
            assert_eq!(number(value), text);
        }
    }

    #[test]
    fn a_measured_number_is_written_as_finely_as_it_is_judged() {
        for (value, required, text) in [
            (
                0.075_398_22,
                Required::Within {
                    of: 0.075_398_2,
                    by: 1e-6,
                },
                "0.0753982",
            ),
            (0.950_04, Required::AtLeast(0.95), "0.95"),
            (0.949_96, Required::AtLeast(0.95), "0.94996"),
            (1.030_04, Required::Within { of: 1.0, by: 0.03 }, "1.03004"),
            (4.1e-6, Required::Reported, "4.1e-6"),
            (0.0, Required::AtMost(0.0), "0"),
        ] {
            assert_eq!(measured_number(value, &required), text);
        }
        assert_eq!(
            Required::Within {
                of: 0.075_398_2,
                by: 1e-6
            }
            .to_string(),
            "0.0753982 ± 1e-6"
        );
    }
}
