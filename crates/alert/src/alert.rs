//! An alert: where one parameter stands against one rule, and why.

use serde::{Deserialize, Serialize};
use spandrel_bus::{AlertMessage, AlertState, FitReasons, FitVerdict, Name, UndecidedBecause};

use crate::credibility::loss_within_record;
use crate::{LossEstimate, ParameterEstimate, Reference};

/// Where one parameter stands against one rule, since the last change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Alert {
    /// Number of the rule in the structure file, from 0.
    pub rule: usize,
    /// Number of the parameter in state order.
    pub parameter: usize,
    /// The state from now on.
    pub state: AlertState,
    /// The estimate that decided.
    pub estimate: ParameterEstimate,
    /// Since when the loss has been credible, ns; `None` while it is not.
    pub since_ns: Option<i64>,
    /// Loss that the rule asks about, share of the reference.
    pub rule_loss: f64,
    /// Probability that the rule asks for.
    pub rule_credibility: f64,
    /// Probability of that loss now; 0 while the reference is learnt.
    pub probability_of_loss: f64,
    /// What the loss is counted from; `None` while it is learnt.
    pub reference: Option<Reference>,
    /// The loss with its 95 % interval; `None` while the reference is learnt.
    pub loss: Option<LossEstimate>,
    /// Who has acknowledged, and what they noted.
    pub acknowledgement: Option<Acknowledged>,
    /// The decision in words.
    pub why: String,
    /// The verdict on the fit at the last frame; `None` where nobody judges it.
    pub fit: Option<FitVerdict>,
    /// Why the fit is not supported.
    pub fit_reasons: FitReasons,
    /// Whether the filter follows a sudden change: the loss is still moving.
    pub follows_jump: bool,
    /// Why nothing is decided now; `None` while alerts are decided.
    pub undecided_because: Option<UndecidedBecause>,
    /// How often this was said before, with another loss.
    pub revision: u32,
}

/// Who has seen an alert.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Acknowledged {
    /// Who.
    pub who: String,
    /// A note; may be empty.
    pub note: String,
}

impl Alert {
    /// Returns `true` if this is the alert `other` in the same state, perhaps with another loss.
    pub(crate) fn says_the_same(&self, other: &Self) -> bool {
        let said = |alert: &Self| {
            (
                alert.rule,
                alert.parameter,
                alert.state,
                alert.since_ns,
                alert.undecided_because,
            )
        };
        said(self) == said(other) && self.acknowledgement == other.acknowledgement
    }

    /// Returns the loss with its interval within this record; `None` while the reference is learnt.
    pub(crate) fn loss_within_record(&self) -> Option<LossEstimate> {
        self.reference
            .as_ref()
            .map(|reference| loss_within_record(&self.estimate, reference))
    }

    /// The message that says so to others; the only place that knows both forms.
    pub fn to_message(&self, structure: &Name, parameter: &Name) -> AlertMessage {
        AlertMessage {
            structure: structure.clone(),
            parameter: parameter.clone(),
            time_ns: self.estimate.time_ns,
            state: self.state,
            since_ns: self.since_ns,
            rule_loss: self.rule_loss,
            rule_credibility: self.rule_credibility,
            credibility: self.probability_of_loss,
            loss: self.loss.map(|estimate| estimate.loss),
            loss_interval: self.loss.map(|loss| loss.interval()),
            loss_interval_within_record: self.loss_within_record().map(|loss| loss.interval()),
            mean: self.estimate.mean,
            std: self.estimate.std,
            reference: self.reference.map(|reference| reference.mean()),
            reference_std: self.reference.map(|reference| reference.std()),
            acknowledged_by: self
                .acknowledgement
                .as_ref()
                .map(|acknowledged| acknowledged.who.clone()),
            why: self.why.clone(),
            fit: self.fit,
            fit_reasons: self.fit_reasons,
            follows_jump: self.follows_jump,
            undecided_because: self.undecided_because,
            revision: self.revision,
        }
        // one that was remembered by an earlier version may hold a name that none would send now
        .legible()
    }
}
