//! The owner's rules: loss, credibility and duration.

use serde::{Deserialize, Serialize};

use crate::{AlertError, Reference};

/// A rule that raises an alert when a parameter has lost a share of its reference.
///
/// The alert is raised when the probability of the loss has reached the credibility for the sustain
/// time. It is cleared when the probability has stayed below the clear credibility for the sustain
/// time. The clear credibility is at most the credibility, which prevents flapping.
///
/// The reference is the design value by default. A stricter credibility or a longer sustain time
/// prevents false alarms, but delays an alert.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rule {
    pub(crate) loss: f64,
    pub(crate) credibility: f64,
    pub(crate) sustain_ns: i64,
    pub(crate) clear_credibility: f64,
    pub(crate) reference: ReferenceRule,
}

/// The origin of the reference with which a loss is compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum ReferenceRule {
    /// A reference known in advance.
    Given(Reference),
    /// A reference learnt from the estimates of the first span.
    Learnt {
        /// Length of the span, ns.
        span_ns: i64,
    },
}

impl Rule {
    /// Creates a rule that raises an alert when a loss has had a sufficient probability for long
    /// enough.
    ///
    /// - `loss`: share of the reference, 0 to 1. The reference is the design value.
    /// - `credibility`: required probability of this loss, 0 to 1
    /// - `sustain_s`: time for which the probability must last (s, 0 to 3.2e8)
    /// - `clear_credibility`: probability below which a raised alert is cleared, 0 to `credibility`
    ///
    /// # Errors
    /// Returns [`AlertError::Setting`] with the setting, its value and the valid range.
    pub fn new(
        loss: f64,
        credibility: f64,
        clear_credibility: f64,
        sustain_s: f64,
    ) -> Result<Self, AlertError> {
        let credibility = check_between("credibility", credibility, 0.0, 1.0)?;
        Ok(Self {
            loss: check_between("loss", loss, 0.0, 1.0)?,
            credibility,
            sustain_ns: ns_from_s(check_between(
                "sustain time in s",
                sustain_s,
                0.0,
                MAX_SPAN_S,
            )?),
            clear_credibility: check_between(
                "clear credibility",
                clear_credibility,
                0.0,
                credibility,
            )?,
            reference: ReferenceRule::Given(Reference::DESIGN),
        })
    }

    /// Replaces the reference of the loss, which is the design value by default.
    pub fn with_reference(self, reference: Reference) -> Self {
        Self {
            reference: ReferenceRule::Given(reference),
            ..self
        }
    }

    /// Replaces the reference of the loss by the one learnt from the estimates of the first
    /// `span_s` (s, 0 to 3.2e8).
    ///
    /// # Errors
    /// Returns [`AlertError::Setting`] if the span is out of range.
    pub fn with_learnt_reference(self, span_s: f64) -> Result<Self, AlertError> {
        let span_ns = ns_from_s(check_between(
            "learning time in s",
            span_s,
            0.0,
            MAX_SPAN_S,
        )?);
        Ok(Self {
            reference: ReferenceRule::Learnt { span_ns },
            ..self
        })
    }

    /// Returns the loss that the rule watches for, as a share of the reference (0 to 1).
    pub fn loss(&self) -> f64 {
        self.loss
    }

    /// Returns the credibility: the probability of the loss at and above which an alert is raised
    /// (0 to 1).
    pub fn credibility(&self) -> f64 {
        self.credibility
    }

    /// Returns the sustain time (ns).
    ///
    /// An alert is raised when the probability of the loss has reached the credibility for this
    /// long. It is cleared when the probability has stayed below the clear credibility for as long.
    pub fn sustain_ns(&self) -> i64 {
        self.sustain_ns
    }

    /// Returns the clear credibility: the probability of the loss below which a raised alert is
    /// cleared (0 to the credibility).
    pub fn clear_credibility(&self) -> f64 {
        self.clear_credibility
    }

    /// Returns the origin of the reference with which the loss is compared.
    pub fn reference(&self) -> ReferenceRule {
        self.reference
    }
}

/// Maximum time span in a rule, s: ten years.
const MAX_SPAN_S: f64 = 3.2e8;

fn ns_from_s(seconds: f64) -> i64 {
    (seconds * 1e9).round() as i64
}

fn check_between(
    setting: &'static str,
    found: f64,
    low: f64,
    high: f64,
) -> Result<f64, AlertError> {
    if (low..=high).contains(&found) {
        return Ok(found);
    }
    Err(AlertError::Setting {
        setting,
        found,
        low,
        high,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_names_the_range_of_a_setting() {
        assert_eq!(
            Rule::new(1.5, 0.95, 0.5, 10.0).unwrap_err().to_string(),
            "loss is 1.5, must lie between 0 and 1"
        );
        assert!(Rule::new(0.1, f64::NAN, 0.5, 10.0).is_err());
        assert!(Rule::new(0.1, 0.95, 0.5, -1.0).is_err());
        assert!(Rule::new(0.1, 0.9, 0.95, 1.0).is_err());
        assert!(
            Rule::new(0.1, 0.9, 0.5, 1.0)
                .unwrap()
                .with_learnt_reference(f64::INFINITY)
                .is_err()
        );
    }
}
