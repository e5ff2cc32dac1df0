//! The effect of a changed structure file on a decision.
//!
//! A decision continues unchanged if its rule is the same. Comments, formatting, the position of a
//! rule and settings that do not affect alerts are ignored. An active alert that the new rules do
//! not raise ends with an explanation.

use super::{Decision, Stage, Watching};
use crate::support::{DecidedFrames, Support};
use crate::wording::{End, describe_end};
use crate::{Alert, ReferenceRule, probability_of_loss};
use spandrel_bus::AlertState;

/// Whether a new structure file describes the same model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Model {
    /// The model is the same.
    Same,
    /// Model, sensors or filter have changed: the identification starts from its prior.
    Changed,
}

impl Decision {
    /// Continues from `former`, a decision on the parameter of the same name. Appends alerts for
    /// changes.
    pub(crate) fn succeed(&mut self, former: &Self, model: Model, alerts: &mut Vec<Alert>) {
        let learns = matches!(self.rule.reference(), ReferenceRule::Learnt { .. });
        let keeps_reference =
            former.rule.reference() == self.rule.reference() && (model == Model::Same || !learns);
        (self.knowledge, self.last) = (former.knowledge, former.last);
        (self.support, self.jump) = (former.support, former.jump);
        self.motion = former.motion.clone();
        if keeps_reference {
            self.stage = former.stage.clone();
        }
        if keeps_reference && former.rule == self.rule {
            self.decided = former.decided;
            self.last_alert = former.last_alert.clone().map(|last| self.renumbered(last));
        } else {
            self.reevaluate(former, model, alerts);
        }
        if model == Model::Changed {
            self.handle(super::DecisionInput::NewSource, alerts);
        }
    }

    /// Ends a decision whose rule is no longer in the structure file. Returns the alert for its
    /// last state, cleared or normal, with the reason `end`. Returns `None` if no alert was active.
    pub(crate) fn ended(mut self, end: &End) -> Option<Alert> {
        let state = match self.state() {
            AlertState::Raised | AlertState::Acknowledged | AlertState::Unconfirmed => {
                AlertState::Cleared
            }
            AlertState::Pending | AlertState::Undecided | AlertState::SofteningInMotion => {
                AlertState::Normal
            }
            AlertState::Learning | AlertState::Normal | AlertState::Cleared => return None,
        };
        if let Stage::Watching { watch, .. } = &mut self.stage {
            *watch = Watching::Normal;
        }
        self.support = Support::default();
        self.decided = DecidedFrames::default();
        self.motion.suspend();
        let alert = self.alert(state)?;
        Some(Alert {
            why: describe_end(&self.subject, end),
            ..alert
        })
    }

    /// Applies the rule of this decision to the state under another rule.
    fn reevaluate(&mut self, former: &Self, model: Model, alerts: &mut Vec<Alert>) {
        if former.state() == AlertState::Undecided {
            self.last_alert = former.last_alert.clone().map(|last| self.renumbered(last));
        }
        let Stage::Watching { watch: stood, .. } = &former.stage else {
            return; // no alert can exist while a reference is learnt
        };
        match stood.clone() {
            Watching::Normal if self.motion.softening_since_ns().is_none() => {
                self.take_up(Watching::Normal);
            }
            Watching::Normal | Watching::Pending { .. } => {
                self.motion.suspend();
                self.take_up(Watching::Normal);
                self.announce(alerts);
            }
            Watching::Raised {
                since_ns,
                acknowledged,
                is_confirmed,
                ..
            } => match self.end(former, model) {
                None => {
                    self.take_up(Watching::Raised {
                        since_ns,
                        acknowledged,
                        low_since_ns: None,
                        is_confirmed,
                    });
                    // The state is the same, but the message contains the values of the new rule.
                    self.last_alert = self.alert(self.state());
                }
                Some(end) => {
                    self.take_up(if acknowledged.is_some() {
                        Watching::Normal
                    } else {
                        Watching::ClearedUnseen
                    });
                    let why = describe_end(&self.subject, &end);
                    self.last_alert = self
                        .alert(AlertState::Cleared)
                        .map(|alert| Alert { why, ..alert });
                    alerts.extend(self.last_alert.clone());
                    if self.state() != AlertState::Cleared {
                        self.announce(alerts);
                    }
                }
            },
            Watching::ClearedUnseen => {
                self.take_up(Watching::ClearedUnseen);
                self.last_alert = former.last_alert.clone().map(|last| self.renumbered(last));
            }
            Watching::PendingUnseen { .. } => {
                self.take_up(Watching::ClearedUnseen);
                self.announce(alerts);
            }
        }
    }

    /// Returns the reason why the new rule ends an alert of `former`. `None` if the alert remains.
    fn end(&self, former: &Self, model: Model) -> Option<End> {
        let (Stage::Watching { reference, .. }, Some((estimate, _))) = (&self.stage, &self.last)
        else {
            return Some(End::ReferenceRelearnt);
        };
        if model == Model::Changed {
            return Some(End::RuleAndModelChanged);
        }
        let probability = probability_of_loss(estimate, reference, self.rule.loss());
        let (from, to) = (former.rule.clone(), self.rule.clone());
        (probability < self.rule.credibility()).then_some(End::RuleChanged {
            from,
            to,
            probability,
        })
    }

    fn take_up(&mut self, next: Watching) {
        if let Stage::Watching { watch, .. } = &mut self.stage {
            *watch = next;
        }
    }

    fn renumbered(&self, alert: Alert) -> Alert {
        Alert {
            rule: self.rule_number,
            parameter: self.subject.parameter,
            ..alert
        }
    }
}
