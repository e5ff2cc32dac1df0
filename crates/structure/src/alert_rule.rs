//! What the owner wants to be told: which loss, how sure, for how long.

use crate::structure::Structure;

/// Asks for an alert when a parameter has lost a share of its reference with a given credibility.
#[derive(Debug, Clone, PartialEq)]
pub struct AlertRule {
    /// Parameters (indices in state order) that the rule watches, each on its own.
    pub parameters: Vec<usize>,
    /// The loss, a share of the reference (0..1).
    pub loss: f64,
    /// Probability of that loss (0..1) from which the alert is raised.
    pub credibility: f64,
    /// How long (s) the probability must stay there.
    pub sustain_s: f64,
    /// Probability of that loss (0..1) below which a raised alert is cleared; below `credibility`.
    pub clear_credibility: f64,
    /// What the loss is counted from.
    pub reference: Reference,
}

/// The value a loss is counted from.
#[derive(Debug, Clone, PartialEq)]
pub enum Reference {
    /// Learnt from the estimates of the first seconds.
    Baseline {
        /// How long to learn (s).
        learn_s: f64,
    },
    /// Given by the owner (ratios to nominal), an entry per watched parameter; the design is 1 with its deviation.
    Given {
        /// Mean of the reference.
        mean: Vec<f64>,
        /// Its standard deviation, not negative.
        std: Vec<f64>,
    },
}

/// What a display asks of a parameter that no alert rule watches.
const UNWATCHED_LOSS: f64 = 0.05;

impl Structure {
    /// Returns what a display asks of a parameter: the loss (share of the reference) and, where it is known beforehand, the
    /// reference (ratio to nominal) of the first rule that watches it.
    #[must_use]
    pub fn displayed_loss(&self, parameter: usize) -> (f64, f64) {
        let rule = self.alert_rules().iter().find_map(|rule| {
            let position = rule
                .parameters
                .iter()
                .position(|watched| *watched == parameter)?;
            Some((rule, position))
        });
        let loss = rule.map_or(UNWATCHED_LOSS, |(rule, _)| rule.loss);
        let reference = match rule.map(|(rule, position)| (&rule.reference, position)) {
            Some((Reference::Given { mean, .. }, position)) => {
                mean.get(position).copied().unwrap_or(1.0)
            }
            // a baseline is learnt by the alert service; until then a loss is counted from the design
            Some((Reference::Baseline { .. }, _)) | None => 1.0,
        };
        (loss, reference)
    }
}
