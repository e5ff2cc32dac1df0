//! An alert: the state of one parameter under one rule, and the reasons.

use serde::{Deserialize, Serialize};
use spandrel_bus::{AlertMessage, AlertState, FitReasons, FitVerdict, Name, UndecidedBecause};

use crate::credibility::loss_within_record;
use crate::{LossEstimate, ParameterEstimate, Reference};

/// The state of one parameter under one rule since the last change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Alert {
    /// Index of the rule in the structure file, from 0.
    pub rule: usize,
    /// Index of the parameter in state order.
    pub parameter: usize,
    /// State of the alert after the change.
    pub state: AlertState,
    /// The estimate that caused the decision.
    pub estimate: ParameterEstimate,
    /// Measurement time since which the loss has been credible, ns since the Unix epoch, UTC.
    /// `None` while the loss is not credible.
    pub since_ns: Option<i64>,
    /// Loss specified by the rule, as a share of the reference.
    pub rule_loss: f64,
    /// Probability of the loss at and above which the rule raises an alert, 0 to 1.
    pub rule_credibility: f64,
    /// Current probability that the loss exceeds the loss of the rule, 0 to 1. It is 0 while the
    /// reference is learnt.
    pub probability_of_loss: f64,
    /// Reference with which the parameter is compared. `None` while the reference is learnt.
    pub reference: Option<Reference>,
    /// Estimated loss with its 95 % interval, as shares of the reference. `None` while the
    /// reference is learnt.
    pub loss: Option<LossEstimate>,
    /// The person who has acknowledged the alert, with a note.
    pub acknowledgement: Option<Acknowledged>,
    /// The decision in words.
    pub why: String,
    /// The verdict on the fit at the last frame. `None` if the fit is not assessed.
    pub fit: Option<FitVerdict>,
    /// The reasons why the fit is not supported.
    pub fit_reasons: FitReasons,
    /// Whether the filter follows a sudden change. The loss is then still changing.
    pub follows_jump: bool,
    /// The reason why no decision is possible. `None` while alerts are decided.
    pub undecided_because: Option<UndecidedBecause>,
    /// Number of earlier messages for this state, with other losses.
    pub revision: u32,
}

/// A person who has acknowledged an alert.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Acknowledged {
    /// Name of the person.
    pub who: String,
    /// A note, which may be empty.
    pub note: String,
}

impl Alert {
    /// Returns `true` if `other` is the same alert in the same state, possibly with a different
    /// loss.
    pub(crate) fn is_same_state(&self, other: &Self) -> bool {
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

    /// Returns the loss with the interval due to the uncertainty of this record alone. `None` while
    /// the reference is learnt.
    pub(crate) fn loss_within_record(&self) -> Option<LossEstimate> {
        self.reference
            .as_ref()
            .map(|reference| loss_within_record(&self.estimate, reference))
    }

    /// Converts the alert to its message on the bus. No other code knows both forms.
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
        // An alert restored from an earlier version can contain a name that is invalid now.
        .legible()
    }
}
