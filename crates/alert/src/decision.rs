//! Decides when one parameter has lost what one rule asks about; no clock, no network.
//!
//! ```text
//! learning → normal ⇄ pending → raised → acknowledged
//!              ↑  ↖              ↓            ↓
//!              │   └─────────  cleared    (cleared and)
//!              └──────────────────────────  normal
//! ```
//!
//! Normal becomes pending when the probability P of the loss reaches the credibility, and raised when it has stayed there
//! for the sustain time. A raised alert is cleared when P has stayed below the clear credibility for the sustain time: so
//! it does not flap. A cleared alert that nobody has acknowledged waits for it; one that was acknowledged is normal at once.

use serde::{Deserialize, Serialize};
use spandrel_bus::AlertState;

use crate::{
    Alert, Learning, ParameterEstimate, Reference, Rule,
    alert::Acknowledged,
    credibility::{loss_estimate, probability_of_loss},
    rule::ReferenceRule,
    wording::describe,
};

/// What a decision reacts to.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// The estimate of a frame, in order of time.
    Estimate(ParameterEstimate),
    /// Estimates are missing: what was sustained is not known to have been.
    Gap,
    /// The source of the estimates has started again, from a checkpoint or from its prior.
    NewSource,
    /// The filter diverged, and was restarted from its prior.
    Restart,
    /// A person has seen the alert.
    Acknowledge(Acknowledged),
}

/// The parameter that a decision watches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Subject {
    /// Number of the parameter in state order.
    pub parameter: usize,
    /// Its name.
    pub name: String,
    /// What it scales, in words, such as `stiffness`.
    pub quantity: String,
    /// Standard deviation that the filter starts from, ratio to nominal.
    pub prior_std: f64,
}

/// The state of one parameter against one rule.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    rule_number: usize,
    rule: Rule,
    subject: Subject,
    stage: Stage,
    knowledge: Knowledge,
    last_estimate: Option<ParameterEstimate>,
    last_alert: Option<Alert>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Stage {
    Learning { started_ns: Option<i64>, span_ns: i64, learning: Learning },
    Watching { reference: Reference, watch: Watching },
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Watching {
    Normal,
    Pending {
        since_ns: i64,
    },
    Raised {
        since_ns: i64,
        acknowledged: Option<Acknowledged>,
        low_since_ns: Option<i64>,
    },
    ClearedUnseen,
    /// Cleared without being acknowledged, and credible again.
    PendingUnseen {
        since_ns: i64,
    },
}

/// Whether the estimate rests on measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum Knowledge {
    Measured,
    /// The filter has restarted from its prior and has not yet gone far from it.
    Prior,
}

/// A restarted filter has measured something once its standard deviation is less than this share of the prior's.
const MEASURED_SHARE_OF_PRIOR: f64 = 0.5;

impl Decision {
    /// Watches `subject` by rule number `rule_number` of the structure file, from 0.
    pub fn new(rule_number: usize, rule: Rule, subject: Subject) -> Self {
        let stage = match rule.reference() {
            ReferenceRule::Given(reference) => Stage::Watching { reference, watch: Watching::Normal },
            ReferenceRule::Learnt { span_ns } => {
                Stage::Learning { started_ns: None, span_ns, learning: Learning::new() }
            }
        };
        Self {
            rule_number,
            rule,
            subject,
            stage,
            knowledge: Knowledge::Measured,
            last_estimate: None,
            last_alert: None,
        }
    }

    /// Reacts to one input; appends an alert for each change of state. Tells whether the input had a meaning now: an
    /// acknowledgement of nothing has none.
    pub fn handle(&mut self, input: Input, alerts: &mut Vec<Alert>) -> bool {
        match input {
            Input::Estimate(estimate) => self.handle_estimate(estimate, alerts),
            Input::Gap => self.interrupt(),
            Input::NewSource => {
                self.interrupt();
                self.knowledge = Knowledge::Prior;
            }
            Input::Restart => {
                self.interrupt();
                self.restart();
            }
            Input::Acknowledge(acknowledged) => return self.acknowledge(acknowledged, alerts),
        }
        true
    }

    /// The state; `None` before the first change.
    pub fn last_alert(&self) -> Option<&Alert> {
        self.last_alert.as_ref()
    }

    /// Where the parameter stands at the last estimate, for a decision that has had nothing to announce; `None` before the
    /// first estimate.
    pub fn unannounced(&self) -> Option<Alert> {
        self.alert(self.state()).filter(|_| self.last_alert.is_none())
    }

    /// The parameter watched.
    pub fn subject(&self) -> &Subject {
        &self.subject
    }

    /// The rule by which it is watched.
    pub fn rule(&self) -> &Rule {
        &self.rule
    }

    fn handle_estimate(&mut self, estimate: ParameterEstimate, alerts: &mut Vec<Alert>) {
        self.last_estimate = Some(estimate);
        if estimate.std < MEASURED_SHARE_OF_PRIOR * self.subject.prior_std {
            self.knowledge = Knowledge::Measured;
        }
        match &self.stage {
            Stage::Learning { .. } => self.learn(estimate, alerts),
            Stage::Watching { reference, watch } => {
                let probability = probability_of_loss(&estimate, reference, self.rule.loss());
                let next = self.next(watch.clone(), probability, estimate.time_ns);
                self.enter(next, alerts);
            }
        }
    }

    /// Adds an estimate to the reference, and starts to watch when the span is over.
    fn learn(&mut self, estimate: ParameterEstimate, alerts: &mut Vec<Alert>) {
        let Stage::Learning { started_ns, span_ns, learning } = &mut self.stage else {
            return;
        };
        let start_ns = *started_ns.get_or_insert(estimate.time_ns);
        if estimate.time_ns < start_ns {
            // A source that starts again at an earlier time, such as a record replayed twice.
            (*started_ns, *learning) = (Some(estimate.time_ns), Learning::new());
        }
        let is_over = estimate.time_ns.saturating_sub(start_ns) >= *span_ns;
        learning.add(estimate.mean, estimate.std);
        let learnt = learning.summary().filter(|_| is_over);
        // A reference that is too uncertain is learnt on.
        match learnt.and_then(|span| Reference::new(span.mean, span.variance().sqrt()).ok()) {
            Some(reference) => {
                self.stage = Stage::Watching { reference, watch: Watching::Normal };
                self.announce(alerts);
            }
            None if self.last_alert.is_none() => self.announce(alerts),
            None => {}
        }
    }

    /// The state after an estimate with this probability of the loss.
    fn next(&self, watch: Watching, probability: f64, time_ns: i64) -> Watching {
        let is_credible = probability >= self.rule.credibility();
        let is_sustained = |since_ns: i64| time_ns.saturating_sub(since_ns) >= self.rule.sustain_ns();
        let rise = |since_ns: i64, otherwise: Watching| match is_sustained(since_ns) {
            true => Watching::Raised { since_ns, acknowledged: None, low_since_ns: None },
            false => otherwise,
        };
        match watch {
            Watching::Normal if is_credible => rise(time_ns, Watching::Pending { since_ns: time_ns }),
            Watching::Pending { since_ns } if is_credible => rise(since_ns, Watching::Pending { since_ns }),
            Watching::Normal | Watching::Pending { .. } => Watching::Normal,
            Watching::ClearedUnseen if is_credible => rise(time_ns, Watching::PendingUnseen { since_ns: time_ns }),
            Watching::PendingUnseen { since_ns } if is_credible => rise(since_ns, Watching::PendingUnseen { since_ns }),
            Watching::ClearedUnseen | Watching::PendingUnseen { .. } => Watching::ClearedUnseen,
            Watching::Raised { since_ns, acknowledged, low_since_ns } => {
                // The prior of a filter that has just restarted is no news of the structure: it clears no alert.
                let is_low = probability < self.rule.clear_credibility() && self.knowledge == Knowledge::Measured;
                let low_since_ns = is_low.then(|| low_since_ns.unwrap_or(time_ns));
                match low_since_ns.filter(|since_ns| is_sustained(*since_ns)) {
                    Some(_) if acknowledged.is_some() => Watching::Normal,
                    Some(_) => Watching::ClearedUnseen,
                    None => Watching::Raised { since_ns, acknowledged, low_since_ns },
                }
            }
        }
    }

    /// Takes up a state, and announces it if people have been told another one, or another time of its start.
    fn enter(&mut self, next: Watching, alerts: &mut Vec<Alert>) {
        if let Stage::Watching { watch, .. } = &mut self.stage {
            *watch = next;
        }
        let told = self.last_alert.as_ref().map_or((AlertState::Normal, None), |last| (last.state, last.since_ns));
        let state = self.state();
        if told == (state, self.since_ns()) {
            return;
        }
        if (told.0, state) == (AlertState::Acknowledged, AlertState::Normal) {
            alerts.extend(self.alert(AlertState::Cleared));
        }
        self.announce(alerts);
    }

    /// What was sustained starts anew; what is raised stays raised.
    fn interrupt(&mut self) {
        if let Stage::Watching { watch, .. } = &mut self.stage {
            match watch {
                Watching::Pending { .. } => *watch = Watching::Normal,
                Watching::PendingUnseen { .. } => *watch = Watching::ClearedUnseen,
                Watching::Raised { low_since_ns, .. } => *low_since_ns = None,
                Watching::Normal | Watching::ClearedUnseen => {}
            }
        }
    }

    fn restart(&mut self) {
        self.knowledge = Knowledge::Prior;
        if let Stage::Learning { started_ns, learning, .. } = &mut self.stage {
            // The filter diverged: what it said before is no reference.
            (*started_ns, *learning) = (None, Learning::new());
        }
    }

    fn acknowledge(&mut self, by: Acknowledged, alerts: &mut Vec<Alert>) -> bool {
        let Stage::Watching { watch, .. } = &mut self.stage else {
            return false;
        };
        let next = match watch {
            Watching::Raised { since_ns, acknowledged: None, low_since_ns } => {
                Watching::Raised { since_ns: *since_ns, acknowledged: Some(by), low_since_ns: *low_since_ns }
            }
            Watching::ClearedUnseen => Watching::Normal,
            Watching::PendingUnseen { since_ns } => Watching::Pending { since_ns: *since_ns },
            Watching::Normal | Watching::Pending { .. } | Watching::Raised { .. } => return false,
        };
        self.enter(next, alerts);
        true
    }

    fn state(&self) -> AlertState {
        match &self.stage {
            Stage::Learning { .. } => AlertState::Learning,
            Stage::Watching { watch, .. } => match watch {
                Watching::Normal => AlertState::Normal,
                Watching::Pending { .. } | Watching::PendingUnseen { .. } => AlertState::Pending,
                Watching::Raised { acknowledged: None, .. } => AlertState::Raised,
                Watching::Raised { acknowledged: Some(_), .. } => AlertState::Acknowledged,
                Watching::ClearedUnseen => AlertState::Cleared,
            },
        }
    }

    /// Since when the loss has been credible, ns.
    fn since_ns(&self) -> Option<i64> {
        match &self.stage {
            Stage::Learning { .. } => None,
            Stage::Watching { watch, .. } => match watch {
                Watching::Pending { since_ns }
                | Watching::PendingUnseen { since_ns }
                | Watching::Raised { since_ns, .. } => Some(*since_ns),
                Watching::Normal | Watching::ClearedUnseen => None,
            },
        }
    }

    fn announce(&mut self, alerts: &mut Vec<Alert>) {
        if let Some(alert) = self.alert(self.state()) {
            self.last_alert = Some(alert.clone());
            alerts.push(alert);
        }
    }

    /// The alert that says `state` at the last estimate.
    fn alert(&self, state: AlertState) -> Option<Alert> {
        let estimate = self.last_estimate?;
        let (reference, acknowledgement) = match &self.stage {
            Stage::Learning { .. } => (None, None),
            Stage::Watching { reference, watch: Watching::Raised { acknowledged, .. } } => {
                (Some(*reference), acknowledged.clone())
            }
            Stage::Watching { reference, .. } => (Some(*reference), None),
        };
        let mut alert = Alert {
            rule: self.rule_number,
            parameter: self.subject.parameter,
            state,
            estimate,
            since_ns: self.since_ns(),
            rule_loss: self.rule.loss(),
            rule_credibility: self.rule.credibility(),
            probability_of_loss: reference
                .map_or(0.0, |reference| probability_of_loss(&estimate, &reference, self.rule.loss())),
            reference,
            loss: reference.map(|reference| loss_estimate(&estimate, &reference)),
            acknowledgement,
            why: String::new(),
        };
        alert.why = describe(&self.subject, &self.rule, &alert);
        Some(alert)
    }
}

mod succession;

pub use succession::Model;

#[cfg(test)]
mod tests;
