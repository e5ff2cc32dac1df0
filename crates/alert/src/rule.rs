//! What the owner asks for: which loss, how sure, for how long.

use serde::{Deserialize, Serialize};

use crate::{AlertError, Reference};

/// Asks for an alert when a parameter has lost a share of its reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rule {
    pub(crate) loss: f64,
    pub(crate) credibility: f64,
    pub(crate) sustain_ns: i64,
    pub(crate) clear_credibility: f64,
    pub(crate) reference: ReferenceRule,
}

/// Where the reference comes from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum ReferenceRule {
    /// Known beforehand.
    Given(Reference),
    /// Learnt from the estimates of the first span.
    Learnt {
        /// Its length, ns.
        span_ns: i64,
    },
}

impl Rule {
    /// Asks for `loss` (share, 0 to 1) with probability `credibility` (0 to 1) for `sustain_s` (s), against the design value.
    /// A raised alert is cleared below probability `clear_credibility` (0 to `credibility`).
    ///
    /// # Errors
    /// [`AlertError::Setting`] with the setting, what was found and what is allowed.
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

    /// Counts the loss from this reference.
    pub fn with_reference(self, reference: Reference) -> Self {
        Self {
            reference: ReferenceRule::Given(reference),
            ..self
        }
    }

    /// Counts the loss from what the first `span_s` (s) teach.
    ///
    /// # Errors
    /// As [`Rule::new`].
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

    /// The loss asked about, share of the reference.
    pub fn loss(&self) -> f64 {
        self.loss
    }

    /// Probability of the loss from which an alert is raised.
    pub fn credibility(&self) -> f64 {
        self.credibility
    }

    /// How long that probability must last, ns.
    pub fn sustain_ns(&self) -> i64 {
        self.sustain_ns
    }

    /// Probability of the loss below which a raised alert is cleared.
    pub fn clear_credibility(&self) -> f64 {
        self.clear_credibility
    }

    /// Where the reference comes from.
    pub fn reference(&self) -> ReferenceRule {
        self.reference
    }
}

/// Longest span in a rule, s: ten years.
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
    fn settings_out_of_range_are_refused_with_the_range() {
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
