//! What becomes of a decision when the structure file says something else.
//!
//! A decision goes on as if nothing had been if its rule is the same; comments, formatting, the place of a rule and whatever
//! does not concern alerts are not looked at. An alert that stands and that the rules of now do not raise ends, in words.

use super::{Decision, Stage, Watching};
use crate::support::Support;
use crate::wording::{End, describe_end};
use crate::{Alert, ReferenceRule, probability_of_loss};
use spandrel_bus::AlertState;

/// Whether the estimates to come are of the same model as those before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Model {
    /// They are.
    Same,
    /// The structure file says something else of model, sensors or filter: the identification begins at its prior.
    Changed,
}

impl Decision {
    /// Goes on where `former`, a decision on the parameter of the same name, stood; appends what has changed by that.
    pub(crate) fn succeed(&mut self, former: &Self, model: Model, alerts: &mut Vec<Alert>) {
        let learns = matches!(self.rule.reference(), ReferenceRule::Learnt { .. });
        let keeps_reference =
            former.rule.reference() == self.rule.reference() && (model == Model::Same || !learns);
        (self.knowledge, self.last) = (former.knowledge, former.last);
        (self.support, self.jump) = (former.support, former.jump);
        if keeps_reference {
            self.stage = former.stage.clone();
        }
        if keeps_reference && former.rule == self.rule {
            self.decided = former.decided;
            self.last_alert = former.last_alert.clone().map(|last| self.renumbered(last));
        } else {
            self.judge_anew(former, model, alerts);
        }
        if model == Model::Changed {
            self.handle(super::Input::NewSource, alerts);
        }
    }

    /// The end of this decision, which no rule of the structure file continues; `None` where nothing of it stood.
    pub(crate) fn ended(mut self, end: &End) -> Option<Alert> {
        let state = match self.state() {
            AlertState::Raised | AlertState::Acknowledged | AlertState::Unconfirmed => {
                AlertState::Cleared
            }
            AlertState::Pending | AlertState::Undecided => AlertState::Normal,
            AlertState::Learning | AlertState::Normal | AlertState::Cleared => return None,
        };
        if let Stage::Watching { watch, .. } = &mut self.stage {
            *watch = Watching::Normal;
        }
        self.support = Support::default();
        let alert = self.alert(state)?;
        Some(Alert {
            why: describe_end(&self.subject, end),
            ..alert
        })
    }

    /// Takes up by its own rule what stood by another.
    fn judge_anew(&mut self, former: &Self, model: Model, alerts: &mut Vec<Alert>) {
        if former.state() == AlertState::Undecided {
            self.last_alert = former.last_alert.clone().map(|last| self.renumbered(last));
        }
        let Stage::Watching { watch: stood, .. } = &former.stage else {
            return; // nothing can have stood while a reference was learnt
        };
        match stood.clone() {
            Watching::Normal => self.take_up(Watching::Normal),
            Watching::Pending { .. } => {
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
                    self.last_alert = self.alert(self.state()); // the same state, with the numbers of this rule
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

    /// Why an alert that `former` had raised is over by the rule of this decision; `None` while it stands.
    fn end(&self, former: &Self, model: Model) -> Option<End> {
        let (Stage::Watching { reference, .. }, Some((estimate, _))) = (&self.stage, &self.last)
        else {
            return Some(End::ReferenceLearntAnew);
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
