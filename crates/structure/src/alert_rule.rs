//! Alert rules of a structure file: watched parameters, loss, credibility and duration.

use crate::structure::Structure;

/// A rule that raises an alert when a parameter has lost a share of its reference.
#[derive(Debug, Clone, PartialEq)]
pub struct AlertRule {
    /// Watched parameters (indices in state order), each evaluated separately.
    pub parameters: Vec<usize>,
    /// Loss as a share of the reference (0 to 1).
    pub loss: f64,
    /// Probability of the loss (0 to 1) at which the alert is raised.
    pub credibility: f64,
    /// Duration (s) for which the probability must stay at that level.
    pub sustain_s: f64,
    /// Probability of the loss (0 to 1) below which a raised alert is cleared; less than
    /// `credibility`.
    pub clear_credibility: f64,
    /// The reference value for the loss.
    pub reference: Reference,
}

/// The reference value for a loss.
#[derive(Debug, Clone, PartialEq)]
pub enum Reference {
    /// Baseline that is learnt from the estimates of the first seconds.
    Baseline {
        /// Learning time (s).
        learn_s: f64,
    },
    /// Values from the structure file (ratios to nominal), one entry per watched parameter.
    ///
    /// A design reference has the mean 1 and a stated standard deviation.
    Given {
        /// Mean of the reference.
        mean: Vec<f64>,
        /// Standard deviation of the reference, not negative.
        std: Vec<f64>,
    },
}

/// Loss threshold for a parameter that no alert rule watches.
const UNWATCHED_LOSS: f64 = 0.05;

impl Structure {
    /// Returns the loss threshold (share of the reference) of the first rule that watches a
    /// parameter, or 0.05 if no rule watches it.
    #[must_use]
    pub fn loss_of_interest(&self, parameter: usize) -> f64 {
        self.alert_rules()
            .iter()
            .find(|rule| rule.parameters.contains(&parameter))
            .map_or(UNWATCHED_LOSS, |rule| rule.loss)
    }
}
