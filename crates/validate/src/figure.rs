//! A figure of an example: its published, required and measured value.

use serde::{Deserialize, Serialize};

/// Requirement on a measured number.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Required {
    /// Within a distance of a value.
    Within {
        /// Target value.
        of: f64,
        /// Largest allowed distance from it.
        by: f64,
    },
    /// In a closed range.
    Between {
        /// Lower end.
        low: f64,
        /// Upper end.
        high: f64,
    },
    /// At least this value.
    AtLeast(f64),
    /// At most this value.
    AtMost(f64),
    /// No requirement: the number is a limit or a substitute, which is shown and not judged.
    Reported,
}

impl Required {
    /// Returns the requirement to be within a share of a value, such as 0.05 for ± 5 %.
    #[must_use]
    pub fn relative(of: f64, share: f64) -> Self {
        Self::Within {
            of,
            by: of.abs() * share,
        }
    }

    /// Returns `true` if a measured number meets the requirement. NaN never does.
    #[must_use]
    pub fn holds(&self, measured: f64) -> bool {
        match *self {
            // The end of the range meets the requirement even if the difference is rounded up: 1.03
            // is within 1 ± 0.03.
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
            // A requirement of one part in 10⁵ needs digits to that part.
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

/// Default number of significant digits.
const DIGITS: usize = 4;
/// Maximum number of significant digits.
const MOST_DIGITS: usize = 15;

/// Formats a number with four significant digits, in scientific notation if it is very small or
/// large.
pub(crate) fn number(value: f64) -> String {
    with_digits(value, DIGITS)
}

/// Formats a measured number with enough digits to decide whether it meets the requirement.
///
/// The last digit is worth a tenth of the allowed distance or less. The printed number meets the
/// requirement if and only if the number does.
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

/// Number of seeds that must meet a requirement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Judgement {
    /// Every seed must meet it.
    Each,
    /// The mean over the seeds must meet it.
    Mean,
    /// Two of three seeds must meet it.
    TwoThirds,
}

/// A measured number of one seed, with its requirement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    /// Name with unit, such as `velocity error at floor 1 (m/s)`, unique within its case.
    pub name: String,
    /// Published number, or `None` if the source printed none.
    pub published: Option<f64>,
    /// Requirement on the measured number.
    pub required: Required,
    /// Number of seeds that must meet the requirement.
    pub judgement: Judgement,
    /// Measured number, or `None` if it could not be determined.
    pub measured: Option<f64>,
    /// Reason why a miss is expected, or `None` if a miss fails the run. The requirement remains
    /// that of the specification.
    #[serde(default)]
    pub known_miss: Option<String>,
}

impl Figure {
    /// Creates a figure that every seed must meet. A measured NaN becomes `None`.
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

    /// Adds the published number.
    #[must_use]
    pub fn published(mut self, value: f64) -> Self {
        self.published = Some(value);
        self
    }

    /// States why this figure is known to miss its requirement.
    ///
    /// A known miss is shown as missed, with the requirement, the measured number and this reason.
    /// It does not fail the run. If the figure meets its requirement nevertheless, it is shown as
    /// holding.
    #[must_use]
    pub fn known_miss(mut self, reason: &str) -> Self {
        self.known_miss = Some(reason.to_owned());
        self
    }

    /// States why this figure is known to miss its requirement, as [`Figure::known_miss()`] does,
    /// if the measured number is within `limits`. A miss beyond them fails the run.
    #[must_use]
    pub fn known_miss_within(self, limits: Required, reason: &str) -> Self {
        match self.measured {
            Some(measured) if limits.holds(measured) => self.known_miss(reason),
            _ => self,
        }
    }

    /// Sets the number of seeds that must meet the requirement, which is every seed by default.
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
    fn requirements_hold_at_their_limits_and_never_for_nan() {
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
    fn measured_number_has_the_digits_of_its_requirement() {
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
